"""Encode messages that are lists of 16-bit integers of constant lengths, again and again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError
from dexkit.messages.registry import MessageType

__all__ = ["IntegerLists"]

_HEADER = 4  # bytes of encapsulation
_INT16 = np.iinfo(np.int16)


class IntegerLists:
    """A message type whose members are all lists of int16, with these lengths.

    The bytes are made once; a message costs little more than its numbers.

    :param lengths: by member, in the message's order.
    :raises UsageError: the type has other members.
    """

    def __init__(self, kind: MessageType, lengths: Mapping[str, int]) -> None:
        members = [f.name for f in kind.layout.fields if f.is_numbers and f.element_size == 2]
        if members != list(lengths) or len(members) < len(kind.layout.fields):
            raise UsageError(f"{kind.name} does not consist of lists of int16 with these names")
        self._data = bytearray(
            kind.encode(kind.cls(**{name: [0] * n for name, n in lengths.items()}))
        )
        # the header keeps the lists at multiples of four
        self._numbers: NDArray[np.int16] = np.frombuffer(self._data, "<i2")
        places: list[int] = []
        at = _HEADER
        for length in lengths.values():
            at += -at % 4 + 4
            places += range(at // 2, at // 2 + length)
            at += 2 * length
        self._places: NDArray[np.intp] = np.array(places, dtype=np.intp)

    def encode(self, values: NDArray[Any]) -> bytes:
        """The message with these numbers, list after list, shape (sum of the lengths,).

        What is not a number becomes 0; what 16 bits cannot hold, the nearest that they can.
        """
        finite = np.nan_to_num(values, posinf=_INT16.max, neginf=_INT16.min)
        self._numbers[self._places] = np.clip(np.rint(finite), _INT16.min, _INT16.max)
        return bytes(self._data)
