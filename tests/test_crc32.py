"""The words CRC against the vectors of docs/sources and a bitwise implementation."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import EncodeError
from dexkit.wire.crc32 import crc32_words
from tests.each import each

# docs/sources/unitree-dex.md#c8; the last four are all-zero LowCmd_/LowState_ images, go and hg
# (docs/sources/unitree-dex.md#a7)
VECTORS = [
    (bytes(4), 0xC704DD7B),
    (b"\xff" * 4, 0x00000000),
    (b"\x01\0\0\0", 0xC3C5C0CC),
    (b"12345678", 0xFEFC54F9),
    (bytes(range(16)), 0x081B46CA),
    (bytes(range(256)) * 4, 0x8ADA4578),
    (bytes(728), 0xEAC26C88),
    (bytes(1228), 0x3E3EEF37),
    (bytes(1264), 0x2768D24E),
    (bytes(202 * 4), 0x4B5A4880),
    (bytes(294 * 4), 0x85F11EA6),
    (bytes(250 * 4), 0xFE172F9F),
    (bytes(522 * 4), 0xD64BB04A),
]


def bitwise(data: bytes) -> int:
    """Bit by bit over the words, from the polynomial alone."""
    crc = 0xFFFFFFFF
    for i in range(0, len(data), 4):
        word = int.from_bytes(data[i : i + 4], "little")
        for bit in range(31, -1, -1):
            feedback = (crc >> 31) ^ (word >> bit & 1)
            crc = (crc << 1) & 0xFFFFFFFF
            if feedback:
                crc ^= 0x04C11DB7
    return crc


@each(("data", "crc"), VECTORS)
def test_crc_equals_documented_values(data: bytes, crc: int) -> None:
    assert crc32_words(data) == crc
    assert bitwise(data) == crc


words = st.lists(st.binary(min_size=4, max_size=4), max_size=40).map(b"".join)


@settings(deadline=None)
@given(words)
def test_crc_equals_a_bitwise_computation(data: bytes) -> None:
    assert crc32_words(data) == bitwise(data)
    assert crc32_words(memoryview(bytearray(data))) == bitwise(data)


@each("length", [1, 2, 3, 5, 1270])
def test_crc_refuses_data_that_are_not_whole_words(length: int) -> None:
    with pytest.raises(EncodeError, match="whole 32-bit words"):
        crc32_words(bytes(length))
