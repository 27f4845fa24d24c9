"""Packed structures, mode byte and scales that the frames of Unitree's hand motors share.

The Dex3-1's packets (the Dex3-1 manual) and the frames of the Dex1-1's M4010
(docs/sources/unitree-dex.md#g) are of one family: the same mode byte, position count and checksum,
in layouts of their own.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cached_property

from dexkit.errors import EncodeError

__all__ = [
    "BROADCAST_ID",
    "MOTOR_VOLTAGE",
    "NUDGE",
    "POSITION",
    "RIS_MODE",
    "TEMPERATURE",
    "WINDING_TEMPERATURE",
    "BitField",
    "Field",
    "Scale",
    "Structure",
    "ris_mode",
]

BROADCAST_ID = 15
"""Addresses every motor of a bus; none of them answers."""

# struct code, size, lowest and highest value
_TYPES = {
    "u8": ("B", 1, 0, 0xFF),
    "i8": ("b", 1, -0x80, 0x7F),
    "u16": ("H", 2, 0, 0xFFFF),
    "i16": ("h", 2, -0x8000, 0x7FFF),
    "u32": ("I", 4, 0, 0xFFFFFFFF),
    "i32": ("i", 4, -0x80000000, 0x7FFFFFFF),
}


@dataclass(frozen=True)
class Field:
    """One member of a structure.

    :param type: ``u8``, ``i8``, ``u16``, ``i16``, ``u32`` or ``i32``.
    :param count: elements; more than one ``u8`` is packed as bytes.
    :param meaning: for people.
    :param unit: what one count is, for people; empty where it is no quantity.
    """

    name: str
    type: str
    count: int = 1
    meaning: str = ""
    unit: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        return _TYPES[self.type][1] * self.count

    @property
    def format(self) -> str:
        """Its part of a struct format."""
        if self.count == 1:
            return _TYPES[self.type][0]
        return f"{self.count}{'s' if self.type == 'u8' else _TYPES[self.type][0]}"

    @property
    def low(self) -> int:
        """Lowest value of an element."""
        return _TYPES[self.type][2]

    @property
    def high(self) -> int:
        """Highest value of an element."""
        return _TYPES[self.type][3]


@dataclass(frozen=True)
class BitField:
    """Some bits of a byte."""

    name: str
    first: int
    bits: int
    meaning: str

    @property
    def high(self) -> int:
        """Highest value."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class Structure:
    """A packed little-endian structure.

    :param head: its first bytes, empty where they are not fixed.
    :param covered: first byte covered by the CRC, and the byte after the last one.
    """

    name: str
    title: str
    head: bytes
    fields: tuple[Field, ...]
    covered: tuple[int, int]

    @cached_property
    def struct(self) -> struct.Struct:
        """Packs and unpacks it."""
        return struct.Struct("<" + "".join(f.format for f in self.fields))

    @cached_property
    def size(self) -> int:
        """Bytes."""
        return self.struct.size

    @cached_property
    def offsets(self) -> dict[str, int]:
        """First byte of each field."""
        found, offset = {}, 0
        for field in self.fields:
            found[field.name] = offset
            offset += field.size
        return found

    def field(self, name: str) -> Field:
        """The field called ``name``."""
        return next(f for f in self.fields if f.name == name)

    def pack(self, *values: int | bytes) -> bytes:
        """Bytes of the structure; ``values`` as :meth:`struct.Struct.pack` takes them.

        :raises EncodeError: a value does not fit; says which.
        """
        try:
            return self.struct.pack(*values)
        except struct.error as error:
            raise EncodeError(f"{self.name}: {self._describe_misfit(values) or error}") from None

    def _describe_misfit(self, values: tuple[int | bytes, ...]) -> str:
        rest = list(values)
        for field in self.fields:
            if field.format.endswith("s"):
                rest = rest[1:]
                continue
            for i, value in enumerate(rest[: field.count]):
                if not isinstance(value, int) or not field.low <= value <= field.high:
                    index = f"[{i}]" if field.count > 1 else ""
                    return f"{field.name}{index} = {value!r} does not fit {field.type}"
            rest = rest[field.count :]
        return ""


RIS_MODE = (
    BitField("id", 0, 4, "motor on its bus, 0 to 14; 15 addresses all of them, and none answers"),
    BitField("status", 4, 3, "0 lock (brake), 1 FOC; 6 is in the manual without a meaning"),
    BitField(
        "timeout",
        7,
        1,
        "to the motor: 1 enables its time-out protection (1 s); from the motor: 1 when the "
        "protection has tripped, until a command with 0 comes",
    ),
)
"""``RIS_Mode_t``, the mode byte (the Dex3-1 manual "Motor Control Structure")."""


def ris_mode(number: int, status: int, timeout: bool | int) -> int:
    """A mode byte.

    :raises EncodeError: a value does not fit its bits.
    """
    value = 0
    for field, part in zip(RIS_MODE, (number, status, int(timeout)), strict=True):
        if not 0 <= part <= field.high:
            raise EncodeError(f"RIS_Mode_t: {field.name} = {part} is not 0 to {field.high}")
        value |= part << field.first
    return value


@dataclass(frozen=True)
class Scale:
    """How a quantity is counted.

    :param counts: per SI unit, on the rotor's side where ``power`` is not 0.
    :param power: of the gear ratio by which the counts of a joint's SI unit grow.
    :param low: lowest count; -32768 and so on, or 0 for what must not be negative.
    :param high: highest count.
    """

    name: str
    fields: tuple[str, ...]
    unit: str
    counts: float
    low: int
    high: int
    power: int = 0

    def factor(self, ratio: float = 1.0) -> float:
        """Counts per SI unit of a joint with that gear ratio."""
        return self.counts * ratio**self.power

    def encode(self, value: float, ratio: float = 1.0) -> int:
        """Counts of ``value``: rounded toward zero (as in the vendor's library,
        docs/sources/unitree-dex.md#c9), saturated.

        :raises EncodeError: ``value`` is NaN or infinite.
        """
        if not math.isfinite(value):
            raise EncodeError(f"{self.name} = {value} cannot be sent")
        return int(min(max(value * self.factor(ratio) * NUDGE, self.low), self.high))

    def decode(self, count: int, ratio: float = 1.0) -> float:
        """SI value of ``count``."""
        return count / self.factor(ratio)

    def limits(self, ratio: float = 1.0) -> tuple[float, float]:
        """Lowest and highest SI value that the wire holds."""
        return self.decode(self.low, ratio), self.decode(self.high, ratio)


NUDGE = 1 + 2**-50
"""Compensates the rounding of a division and a multiplication, so that a decoded count encodes to
itself; far below one count."""

POSITION = Scale(
    "position", ("pos_des", "pos"), "rad", 32768 / (2 * math.pi), -(2**31), 2**31 - 1, 1
)
TEMPERATURE = Scale("temperature", ("temp", "temperature"), "°C", 1.0, -128, 127)
WINDING_TEMPERATURE = Scale("winding temperature", ("sensor",), "°C", 1.0, 0, 255)
MOTOR_VOLTAGE = Scale("motor voltage", ("vol",), "V", 2.0, 0, 255)
