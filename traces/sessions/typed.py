"""Read untrusted documents into typed records, before anything else uses them."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

import msgspec

from dexkit import records
from dexkit.documents import parse_json
from dexkit.errors import SessionError

__all__ = ["Count", "Rate", "Vector", "parse_record", "to_record", "typed"]

T = TypeVar("T")

MOST_JOINTS = 1024
"""Elements of a vector; robots have less than a hundred."""
Rate = Annotated[float, msgspec.Meta(ge=0.1, le=2000)]
"""Plausible frames per second of a file, Hz."""
Count = Annotated[int, msgspec.Meta(ge=0, lt=10**9)]
"""Number of an episode, frame or file."""
Vector = Annotated[list[float], msgspec.Meta(max_length=MOST_JOINTS)]
"""Values of a frame, some of which may be NaN."""


def parse_record(text: str, kind: type[T], origin: object) -> T:
    """The record in a JSON text.

    :param origin: what to call it.
    :raises SessionError: it is no JSON, or of another form; with the place in the document.
    """
    return to_record(parse_json(text, origin, error=SessionError, finite=False), kind, origin)


def to_record(value: Any, kind: type[T], origin: object, *, texts: bool = False) -> T:
    """As :func:`dexkit.records.to_record`, with the error of a session."""
    return records.to_record(value, kind, origin, texts=texts, error=SessionError)


def typed(value: Any, kind: type[T]) -> T | None:
    """The value as a record, number or list of that type; None if it is of another form."""
    try:
        return to_record(value, kind, "it")
    except SessionError:
        return None
