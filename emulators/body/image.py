"""Messages as the C structs that Unitree's SDK makes of them, and back.

The CRC of a body's messages is over that image (facts/unitree-dex A.7), and numpy sees all motors
of it at once, without one Python object for each of them, 500 times a second. On the wire (plain
CDR) the same numbers stand in the same order with other gaps, so that a few slices turn one into
the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.messages import layout, message_type
from dexkit.wire.crc32 import crc32_words

__all__ = ["Image"]

_HEADER = b"\x00\x01\x00\x00"  # plain CDR, little endian


def _dtype(struct: layout.Struct) -> np.dtype[Any]:
    """The struct with C's alignment."""
    fields: list[Any] = []
    for member in struct.fields:
        inner = member.type
        kind: Any = _dtype(inner) if isinstance(inner, layout.Struct) else "<" + inner.dtype
        shape = () if member.array is None else (member.array,)
        fields.append((member.name, kind, shape))
    return np.dtype(fields, align=True)


def _numbers(dtype: np.dtype[Any], start: int = 0) -> Iterator[tuple[int, int, int]]:
    """(offset, size, count) of each number or array of numbers in the C struct."""
    for name in dtype.names or ():
        inner, offset = dtype.fields[name][:2]  # type: ignore[index]
        base, shape = inner.subdtype or (inner, ())
        count = int(np.prod(shape)) if shape else 1
        at = start + offset
        if base.names is None:
            yield at, base.itemsize, count
        else:
            for i in range(count):
                yield from _numbers(base, at + i * base.itemsize)


def _runs(dtype: np.dtype[Any]) -> tuple[list[tuple[int, int, int]], int]:
    """(offset in CDR, offset in C, length) of what both have in one piece; the length of CDR."""
    runs: list[tuple[int, int, int]] = []
    cdr = 0
    for at, size, count in _numbers(dtype):
        cdr = -(-cdr // size) * size
        length = size * count
        if runs and cdr - runs[-1][0] == at - runs[-1][1]:
            first_cdr, first_c, _ = runs[-1]
            runs[-1] = (first_cdr, first_c, at + length - first_c)
        else:
            runs.append((cdr, at, length))
        cdr += length
    return runs, cdr + (-cdr % 4)


class Image:
    """One message of fixed length as a C struct that is changed in place.

    :param type_name: its DDS type, whose last member is the CRC.

    :ivar message: its members, as a numpy record of shape (1,); assigning to them changes it.
    """

    def __init__(self, type_name: str) -> None:
        self.type = message_type(type_name)
        dtype = _dtype(self.type.layout)
        self._bytes = np.zeros(dtype.itemsize, np.uint8)
        self._view = self._bytes.data
        self.message: Any = self._bytes.view(dtype)
        self._runs, length = _runs(dtype)
        self._cdr = bytearray(_HEADER + bytes(length))
        self._used = np.zeros(dtype.itemsize, np.uint8)
        for at, size, count in _numbers(dtype):
            self._used[at : at + size * count] = 0xFF

    def floats(self, member: str, first: str, count: int) -> NDArray[np.float32]:
        """``count`` neighbouring floats of each struct of an array, to be read and written.

        :param member: the array of structs.
        :param first: name of the first float in each.
        :returns: shape (length of the array, ``count``), a view.
        """
        inner, at = self.message.dtype.fields[member][:2]
        element, (length,) = inner.subdtype
        offset = at + element.fields[first][1]
        strides = element.itemsize, np.dtype(np.float32).itemsize
        return np.ndarray((length, count), "<f4", self._view, offset, strides)

    def crc(self) -> int:
        """The CRC that the message should have."""
        return crc32_words(self._view[:-4])

    def seal(self) -> bytes:
        """Set the CRC; the sample for the wire."""
        self.message["crc"] = self.crc()
        for cdr, at, length in self._runs:
            self._cdr[4 + cdr : 4 + cdr + length] = self._view[at : at + length]
        return bytes(self._cdr)

    def read(self, data: bytes) -> None:
        """Take the numbers of a sample; whatever its gaps hold, those of the struct stay 0.

        :raises WireError: it is not that message.
        """
        if len(data) != len(self._cdr) or not data.startswith(_HEADER):
            # another byte order, options in the header, or no such message at all
            data = self.type.encode(self.type.decode(data))
        for cdr, at, length in self._runs:
            self._view[at : at + length] = data[4 + cdr : 4 + cdr + length]
        np.bitwise_and(self._bytes, self._used, out=self._bytes)
