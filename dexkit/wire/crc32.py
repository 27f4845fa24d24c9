"""Compute the CRC of Unitree's motors, hands and robots: CRC-32/MPEG-2 over 32-bit words.

Polynomial 0x04C11DB7, initial value 0xFFFFFFFF, not reflected, no final xor. The vendor's function
takes the data as 32-bit little-endian words and feeds each of them most significant byte first,
which is CRC-32/MPEG-2 over the data with the bytes of every word reversed
(docs/sources/unitree-dex.md#c8, docs/sources/unitree-dex.md#a7; the Dex3-1 manual "CRC32 Function
Calculation Method").
"""

from __future__ import annotations

from array import array
from collections.abc import Callable

import fastcrc

from dexkit.errors import EncodeError

__all__ = ["crc32_swapped", "crc32_words"]

crc32_swapped: Callable[[bytes | bytearray | memoryview], int] = fastcrc.crc32.mpeg_2
"""The same CRC of data with byte-swapped words, for callers that swap a whole frame once
and then need the CRCs of its parts."""

_WORD = next(code for code in "IL" if array(code).itemsize == 4)


def crc32_words(data: bytes | bytearray | memoryview) -> int:
    """CRC of ``data``, as the manual's ``crc32(ptr, len)`` gives it for ``len(data) / 4`` words.

    :raises EncodeError: the length is not a multiple of 4.
    """
    if len(data) % 4:
        raise EncodeError(f"the CRC is over whole 32-bit words; {len(data)} bytes are not")
    words = array(_WORD)
    words.frombytes(data)
    words.byteswap()
    return crc32_swapped(words.tobytes())
