"""The Dex3-1's USB structures as data: what struct formats, offsets and docs/dex3-protocol.md
are made from.

All structures are little-endian and packed to one byte (seed 002 "Introduction to Send and
Receive Structures"; facts/unitree-dex C.1 to C.6).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property

from dexkit.errors import EncodeError
from dexkit.hand import Side

__all__ = [
    "BROADCAST_ID",
    "COMMAND_734",
    "COMMAND_1234",
    "COMMAND_HEAD",
    "COMMAND_LAYOUTS",
    "MANUFACTURER",
    "MOTOR_CMD",
    "MOTOR_STATE",
    "N_BUSES",
    "PRODUCT",
    "PRODUCT_ID",
    "RIS_MODE",
    "SENSOR_STATE",
    "STATE",
    "STATE_BUS_SIZE",
    "STATE_HEAD",
    "VENDOR_ID",
    "BitField",
    "CommandLayout",
    "Field",
    "Structure",
    "ris_mode",
]

# --- identity (facts/unitree-dex C.1)
VENDOR_ID = 0x34B7
PRODUCT_ID = {Side.LEFT: 0x1010, Side.RIGHT: 0x1011}
MANUFACTURER = "UnitreeTC"
# the manual shows the left hand's only; the right one's is assumed
PRODUCT = {Side.LEFT: "Dexthree LeftHand", Side.RIGHT: "Dexthree RightHand"}

N_BUSES = 5
"""SUPPORTED_FINGER_NUM of the manual."""
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
    :param covered: first byte under the CRC and the byte behind the last one.
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
            raise EncodeError(f"{self.name}: {self._misfit(values) or error}") from None

    def _misfit(self, values: tuple[int | bytes, ...]) -> str:
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
"""``RIS_Mode_t``, the mode byte (seed 002 "Motor Control Structure")."""


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


MOTOR_CMD = Structure(
    "MotorCmd_t",
    "Command to one motor",
    b"\xfe\xee",
    (
        Field("head", "u8", 2, "FE EE"),
        Field("mode", "u8", 1, "RIS_Mode_t"),
        # the manual's second listing moves this byte to the end, which would break the words of
        # the CRC (facts D 23)
        Field("res", "u8", 1, "reserved"),
        Field("tor_des", "i16", 1, "torque to add, of the rotor", "1/256 mN·m"),
        Field("spd_des", "i16", 1, "velocity wanted, of the rotor", "100 · 2π/256 rad/s"),
        Field("pos_des", "i32", 1, "position wanted, of the rotor", "2π/32768 rad"),
        Field("k_pos", "i16", 1, "stiffness, of the rotor", "1/1280 mN·m/rad"),
        Field("k_spd", "i16", 1, "damping, of the rotor", "1/1280 mN·m per 100 rad/s"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 16),
)

MOTOR_STATE = Structure(
    "MotorState_t",
    "State of one motor",
    b"\xfc\xee",
    (
        Field("head", "u8", 2, "FC EE"),
        Field("mode", "u8", 1, "RIS_Mode_t; timeout = 1: the protection has tripped"),
        Field("temp", "i8", 1, "temperature of the case", "1 °C"),
        Field("sensor", "u8", 1, "temperature of the winding", "1 °C"),
        Field("vol", "u8", 1, "voltage at the terminals", "0.5 V"),
        Field("torque", "i16", 1, "torque, of the rotor", "1/256 mN·m"),
        Field("speed", "i16", 1, "velocity, of the rotor", "100 · 2π/256 rad/s"),
        Field("pos", "i32", 1, "position, of the rotor", "2π/32768 rad"),
        Field("MError", "u32", 1, "error bits; bit 0 is overcurrent"),
        Field("ExSensor1", "u16", 1, "extended sensor data"),
        Field("ExSensor2", "u16", 1, "extended sensor data"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (2, 22),
)

SENSOR_STATE = Structure(
    "SensorState_t",
    "State of one pressure sensor packet",
    b"\x7e\xe7",
    (
        Field("head", "u8", 2, "7E E7"),
        Field("mode", "u8", 1, "bits 0-3 id, bits 4-7 status"),
        Field("reverse", "u8", 1, "reserved"),
        Field("pressure", "u16", 12, "pressure; 30000 where there is no element", "8 Pa"),
        Field("temperature", "i8", 12, "temperature", "1 °C"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 40),
)


@dataclass(frozen=True)
class CommandLayout:
    """The frame to the hand, for one size of its bus buffers.

    :param bus_size: bytes of one bus buffer.
    """

    name: str
    bus_size: int

    @cached_property
    def structure(self) -> Structure:
        """``LinuxToMcuCmd_t``."""
        end = 26 + N_BUSES * self.bus_size + 4
        return Structure(
            "LinuxToMcuCmd_t",
            f"Frame to the hand, {self.name} bytes",
            b"",
            (
                Field("head", "u8", 2, "not given by the manual"),
                Field("mode", "u8", 4, "not explained by the manual; 0"),
                Field("cmd_size", "u32", N_BUSES, "bytes used of each bus buffer"),
                Field("cmd", "u8", N_BUSES * self.bus_size, f"5 buffers of {self.bus_size} bytes"),
                Field("reserve", "u32", 1, "reserved; 0"),
                Field("crc", "u32", 1, "checksum"),
            ),
            (2, end),
        )

    @cached_property
    def size(self) -> int:
        """Bytes of a frame."""
        return self.structure.size

    def bus_offset(self, bus: int) -> int:
        """First byte of a bus buffer in the frame."""
        return self.structure.offsets["cmd"] + bus * self.bus_size


# seed 002: the specification table says 1234 bytes, SUPPORTED_SEND_BUFFER_SIZE says 140 a bus
# (facts C.5, D 22)
COMMAND_1234 = CommandLayout("1234", 240)
COMMAND_734 = CommandLayout("734", 140)
COMMAND_LAYOUTS = (COMMAND_1234, COMMAND_734)

COMMAND_HEAD = b"\xfe\xfd"
"""Head of the command frame. The manual does not give it; by analogy: the motors' heads are FE EE
to and FC EE from the motor, the state frame's is FC FD. Outside the CRC."""

STATE_BUS_SIZE = 240
STATE_HEAD = b"\xfc\xfd"

STATE = Structure(
    "McuToLinuxState_t",
    "Frame from the hand",
    STATE_HEAD,
    (
        Field("head", "u8", 2, "FC FD"),
        Field("model", "u8", 1, "mode[0]: model of the hand; its values are not given"),
        Field("timeout", "u8", 1, "mode[1]: time-out protection; its values are not given"),
        Field("fans", "u8", 2, "not explained by the manual"),
        Field("state_size", "u32", N_BUSES, "bytes used of each bus buffer"),
        Field("state", "u8", N_BUSES * STATE_BUS_SIZE, f"5 buffers of {STATE_BUS_SIZE} bytes"),
        Field("pin_v", "u16", 1, "voltage of the supply", "3.3 · 21 / 65536 V"),
        Field("vin_v", "u16", 1, "internal supply voltage", "3.3 · 21 / 65536 V"),
        Field("vm_v", "u16", 1, "voltage of the motors", "3.3 · 21 / 65536 V"),
        Field("pin_a", "u16", 1, "current of the supply", "3.3 · 10 / 65536 A"),
        Field("imu_data", "i16", 6, "acceleration x y z, rotation x y z", "0.01 m/s², rad/s"),
        Field("error", "u32", 1, "error bits of the hand"),
        Field("reserve", "u32", 4, "reserved; 0"),
        Field("crc", "u32", 1, "checksum"),
    ),
    (2, 1266),
)
