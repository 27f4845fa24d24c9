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
from dexkit.messages.layout import MAX_BYTES, MAX_ELEMENTS, Field, Primitive, Struct

__all__ = [
    "HEADER",
    "ArrayLengthError",
    "Buffer",
    "check_count",
    "check_end",
    "explain",
    "is_big",
    "pack_bytes",
    "pack_numbers",
    "pack_text",
    "take_bytes",
    "take_numbers",
    "take_text",
]

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


def check_count(name: str, count: int, need: int, have: int, most: int = MAX_ELEMENTS) -> None:
    """Refuse a sequence length that the data cannot hold, before anything is allocated.

    :raises OversizeError: longer than ``most``.
    :raises TruncatedError: longer than the rest of the data.
    """
    if count > most:
        raise OversizeError(f"{name}: {count} elements, at most {most} are accepted")
    if need > have:
        raise TruncatedError(f"{name}: {count} elements need {need} bytes, there are {have}")


def check_end(name: str, data: Buffer, end: int) -> None:
    """Refuse bytes after the last member, except the padding to a multiple of 4.

    :raises OversizeError: more bytes than that.
    """
    rest = len(data) - end
    if rest not in (0, -end % 4):
        raise OversizeError(f"{name}: {rest} bytes after the end of the message")


def pack_bytes(value: Sequence[int]) -> bytes:
    """A sequence of bytes after its length, without padding.

    :raises ValueError: longer than :data:`~dexkit.messages.layout.MAX_BYTES`, or no bytes.
    """
    data = bytes(value)
    if len(data) > MAX_BYTES:
        raise ValueError("too many bytes")
    return data


def pack_numbers(code: str, values: Sequence[Any], most: int) -> bytes:
    """A sequence of numbers and its length before them.

    :param code: format character of :mod:`struct`.
    :raises ArrayLengthError: longer than ``most``.
    """
    count = len(values)
    if count > most:
        raise ArrayLengthError
    return struct.pack(f"<I{count}{code}", count, *values)


def pack_text(value: str) -> bytes:
    """The bytes of a string after its length, with the zero at its end.

    :raises ValueError: it holds a zero, or is longer than
        :data:`~dexkit.messages.layout.MAX_BYTES`.
    """
    if "\0" in value:
        raise ValueError("a zero inside")
    return pack_bytes(value.encode() + b"\0")


def take_bytes(name: str, data: Buffer, at: int, big: bool) -> tuple[bytes, int]:
    """The sequence of bytes whose length is at ``at`` or at the next multiple of 4, and its end.

    :raises OversizeError: longer than :data:`~dexkit.messages.layout.MAX_BYTES`.
    :raises TruncatedError: longer than the rest of the data.
    """
    at += -at % 4 + 4
    if at > len(data):
        raise truncated(name, at, len(data))
    count = int.from_bytes(data[at - 4 : at], "big" if big else "little")
    if count > MAX_BYTES:
        raise OversizeError(f"{name}: {count} bytes, at most {MAX_BYTES} are accepted")
    if at + count > len(data):
        raise truncated(name, at + count, len(data))
    return bytes(data[at : at + count]), at + count


def take_numbers(
    name: str, code: str, most: int, data: Buffer, at: int, big: bool
) -> tuple[list[Any], int]:
    """The numbers whose count is at ``at`` or at the next multiple of 4, and their end.

    :raises OversizeError: more than ``most``.
    :raises TruncatedError: more than the rest of the data holds.
    """
    at += -at % 4 + 4
    if at > len(data):
        raise truncated(name, at, len(data))
    count = int.from_bytes(data[at - 4 : at], "big" if big else "little")
    end = at + count * struct.calcsize(code)
    check_count(name, count, end, len(data), most)
    return list(struct.unpack_from(f"{'>' if big else '<'}{count}{code}", data, at)), end


def take_text(name: str, data: Buffer, at: int, big: bool) -> tuple[str, int]:
    """The string whose length is at ``at`` or at the next multiple of 4, and its end.

    :raises WireError: as :func:`take_bytes`; it does not end with a zero, holds one inside, or is
        not UTF-8.
    """
    raw, end = take_bytes(name, data, at, big)
    if raw.find(b"\0") != len(raw) - 1 or not raw:
        raise WireError(f"{name}: a string of {len(raw)} bytes whose only zero is not at its end")
    try:
        return raw[:-1].decode(), end
    except UnicodeDecodeError as error:
        raise WireError(f"{name}: a string that is not UTF-8") from error


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
        if member.is_bytes:
            problem = _check_bytes(item, member, where)
        elif member.array is None and not member.sequence:
            problem = _check_item(item, member.type, where)
        else:
            problem = _check_items(item, member.type, member.array, where, member.most)
        if problem:
            return problem
    return ""


def _check_bytes(item: Any, member: Field, where: str) -> str:
    kind = "string" if member.is_text else "sequence of bytes"
    try:
        (pack_text if member.is_text else pack_bytes)(item)
    except (AttributeError, TypeError):
        return f"{where} is a {type(item).__name__}, not a {kind}"
    except ValueError as error:  # UnicodeEncodeError is one
        return f"{where} cannot be sent as a {kind}: {error}"
    return ""


def _check_items(
    items: Any, kind: Primitive | Struct, length: int | None, where: str, most: int
) -> str:
    try:
        values: Sequence[Any] = list(items)
    except TypeError:
        return f"{where} is a {type(items).__name__}, not a sequence"
    if length is not None and len(values) != length:
        return f"{where} has {len(values)} elements, not {length}"
    if length is None and len(values) > most:
        return f"{where} has {len(values)} elements, at most {most} are sent"
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
