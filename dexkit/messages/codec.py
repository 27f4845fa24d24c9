"""Common code of the generated codecs: encapsulation, checks of input, and errors.

A sample is a 4-byte encapsulation header (two bytes representation identifier, two bytes
options) followed by the data (XTypes 1.3, 7.6.3.1). ``00 01`` is plain CDR (XCDR1) little
endian, ``00 00`` big endian. The two lowest option bits count the padding bytes that round the
data up to a multiple of 4; a reader ignores the other option bits.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, TypeAlias

from dexkit.errors import EncodeError, OversizeError, TruncatedError, WireError
from dexkit.messages.layout import MAX_ELEMENTS, Primitive, Struct

__all__ = ["HEADER", "ArrayLengthError", "Buffer", "check_count", "check_end", "explain", "is_big"]

Buffer: TypeAlias = "bytes | bytearray | memoryview"

HEADER = b"\x00\x01\x00\x00"

_REPRESENTATIONS = {
    0x0002: "parameter-list CDR",
    0x0003: "parameter-list CDR",
    0x0004: "XML",
    0x0006: "XCDR2",
    0x0007: "XCDR2",
    0x0008: "delimited XCDR2",
    0x0009: "delimited XCDR2",
    0x000A: "parameter-list XCDR2",
    0x000B: "parameter-list XCDR2",
}


class ArrayLengthError(ValueError):
    """A fixed array has the wrong length; :func:`explain` finds out which."""


def is_big(data: Buffer, limit: int, name: str) -> bool:
    """Read the encapsulation header; True when the data are big endian.

    :raises TruncatedError: there is no whole header.
    :raises OversizeError: the sample is longer than ``limit`` bytes.
    :raises WireError: the representation is not plain CDR.
    """
    if len(data) < 4:
        raise TruncatedError(f"{name}: {len(data)} bytes, shorter than an encapsulation header")
    if len(data) > limit:
        raise OversizeError(f"{name}: {len(data)} bytes, the longest sample has {limit}")
    head = data[0] << 8 | data[1]
    if head == 1:
        return False
    if head == 0:
        return True
    known = _REPRESENTATIONS.get(head)
    raise WireError(
        f"{name}: representation {head:#06x}{f' ({known})' if known else ''}, not plain CDR",
        hint="Unitree's types travel as plain CDR (XCDR1): 00 01 or 00 00",
    )


def truncated(name: str, need: int, have: int) -> TruncatedError:
    """The error for data that end too early."""
    return TruncatedError(f"{name}: needs at least {need} bytes, there are {have}")


def check_count(name: str, count: int, need: int, have: int) -> None:
    """Refuse a sequence length that the data cannot hold, before anything is allocated.

    :raises OversizeError: longer than :data:`~dexkit.messages.layout.MAX_ELEMENTS`.
    :raises TruncatedError: longer than the rest of the data.
    """
    if count > MAX_ELEMENTS:
        raise OversizeError(f"{name}: {count} elements, at most {MAX_ELEMENTS} are accepted")
    if need > have:
        raise TruncatedError(f"{name}: {count} elements need {need} bytes, there are {have}")


def check_end(name: str, data: Buffer, end: int) -> None:
    """Refuse bytes after the last member, except the padding to a multiple of 4.

    :raises OversizeError: more bytes than that.
    """
    rest = len(data) - end
    if rest not in (0, -end % 4):
        raise OversizeError(f"{name}: {rest} bytes after the end of the message")


def explain(message: object, kind: Struct, error: Exception) -> EncodeError:
    """Find the member that cannot be encoded, and raise an error that names it."""
    problem = _find(message, kind, kind.name)
    return EncodeError(problem or f"{kind.name}: {type(error).__name__}: {error}")


def _find(value: object, kind: Struct, path: str) -> str:
    for member in kind.fields:
        where = f"{path}.{member.name}"
        try:
            item: Any = getattr(value, member.name)
        except AttributeError:
            return f"{path} is a {type(value).__name__} without {member.name}"
        if member.array is None and not member.sequence:
            problem = _check_item(item, member.type, where)
        else:
            problem = _check_items(item, member.type, member.array, where)
        if problem:
            return problem
    return ""


def _check_items(items: Any, kind: Primitive | Struct, length: int | None, where: str) -> str:
    try:
        values: Sequence[Any] = list(items)
    except TypeError:
        return f"{where} is a {type(items).__name__}, not a sequence"
    if length is not None and len(values) != length:
        return f"{where} has {len(values)} elements, not {length}"
    if length is None and len(values) > MAX_ELEMENTS:
        return f"{where} has {len(values)} elements, at most {MAX_ELEMENTS} are sent"
    for i, value in enumerate(values):
        problem = _check_item(value, kind, f"{where}[{i}]")
        if problem:
            return problem
    return ""


def _check_item(value: Any, kind: Primitive | Struct, where: str) -> str:
    if isinstance(kind, Struct):
        return _find(value, kind, where)
    try:
        struct.pack("<" + kind.code, value)
    except (struct.error, OverflowError, TypeError, ValueError):
        if isinstance(value, (int, float)) and not (
            isinstance(value, float) and (math.isnan(value) or kind.code != "f")
        ):
            return f"{where} = {value!r} does not fit {kind.idl}"
        return f"{where} = {value!r} is not a {kind.idl}"
    return ""
