"""Typed records: read untrusted plain data into them, write them, and describe their form.

The form is a class of msgspec, or of :mod:`dataclasses`. Reading is strict: a text is no number,
and a member that the class does not have is an error where it says ``forbid_unknown_fields``.
"""

from __future__ import annotations

import re
from typing import Any, TypeVar

import msgspec

from dexkit.errors import DexkitError, UsageError
from dexkit.escaping import one_line

__all__ = ["as_plain", "from_object", "json_schema", "to_record"]

T = TypeVar("T")

# UnicodeError: JSON can hold half a surrogate pair, where msgspec expects another type than a text
_WRONG = (msgspec.ValidationError, RecursionError, UnicodeError)
_PLACE = re.compile(r" - at `(?:key` in `)?\$(.*)`$")


def to_record(
    value: Any,
    kind: type[T],
    origin: object,
    *,
    texts: bool = False,
    error: type[DexkitError] = UsageError,
    hint: str = "",
) -> T:
    """Plain data, as JSON or TOML has it, as a record.

    :param origin: what to call it.
    :param texts: numbers may stand in texts.
    :param error: what is raised if it is of another form; the message names the place.
    :param hint: what to do then.
    """
    try:
        return msgspec.convert(value, kind, strict=not texts, str_keys=True, dec_hook=_from_text)
    except _WRONG as why:
        text = str(why).replace("`", "")
        if place := _PLACE.search(str(why)):
            text = f"{place[1].removeprefix('.')}: {text[: text.rindex(' - at ')]}"
        raise error(f"{origin}: {one_line(text)}", hint=hint) from why


def from_object(value: object, kind: type[T]) -> T:
    """A record of that type, of the attributes of an object that is trusted."""
    return msgspec.convert(value, kind, from_attributes=True, dec_hook=_from_text)


def as_plain(record: object) -> Any:
    """The record as plain data, as JSON has it."""
    return msgspec.to_builtins(record, enc_hook=_to_plain)


def json_schema(kind: type) -> dict[str, Any]:
    """The JSON schema of a type."""
    schema = msgspec.json.schema(kind, schema_hook=lambda _: {"type": "string"})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _to_plain(value: object) -> float | str:
    """A value of a class that is a number or a text, such as NumPy's floats."""
    if isinstance(value, float):
        return float(value)
    if isinstance(value, str):
        return str(value)
    raise TypeError(f"{type(value).__name__} is no part of a record")


def _from_text(kind: Any, value: Any) -> Any:
    """A value of a class that is written as a text, and has ``parse`` to read it."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, str):
        raise ValueError(f"Expected str, got {type(value).__name__}")
    try:
        return kind.parse(value)
    except UsageError as error:
        raise ValueError(str(error)) from error
