"""Map low-level messages to the C structs of Unitree's SDK as numpy arrays.

All motors of a message are read and written at once, without a Python object for each, 500 times a
second. The CRC is computed over the C struct (docs/sources/unitree-dex.md#a7).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.messages import layout
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.low_level import payload_of_struct, struct_of_payload

__all__ = ["Image"]


def _dtype(struct: layout.Struct) -> np.dtype[Any]:
    """The struct with C's alignment."""
    fields: list[Any] = []
    for member in struct.fields:
        inner = member.type
        kind: Any = _dtype(inner) if isinstance(inner, layout.Struct) else "<" + inner.dtype
        fields.append((member.name, kind, () if member.array is None else (member.array,)))
    return np.dtype(fields, align=True)


class Image:
    """One message with a CRC as a C struct that is changed in place.

    :param type_name: its DDS type, one of :data:`~dexkit.wire.low_level.LOW_LEVEL_TYPES`.

    :ivar message: its members, as a numpy record array of shape (1,).
    """

    def __init__(self, type_name: str) -> None:
        self.type_name = type_name
        dtype = _dtype(layout.STRUCTS[type_name])
        self._bytes = np.zeros(dtype.itemsize, np.uint8)
        self.message: Any = self._bytes.view(dtype)

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
        return np.ndarray((length, count), "<f4", self._bytes.data, offset, strides)

    def crc(self) -> int:
        """The CRC that the message should have."""
        return crc32_words(self._bytes[:-4].data)

    def seal(self) -> bytes:
        """Set the CRC; the sample for the wire."""
        self.message["crc"] = self.crc()
        return payload_of_struct(self.type_name, self._bytes.data)

    def read(self, data: bytes) -> None:
        """Take the numbers of a sample; the gaps of the struct stay 0, whatever those of it hold.

        :raises WireError: it is not that message.
        """
        self._bytes[:] = np.frombuffer(struct_of_payload(self.type_name, data), np.uint8)
