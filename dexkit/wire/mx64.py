"""The MX-64(2.0) servo as data: control table, units, modes, error bits.

Addresses, sizes, access, initial values, ranges and units are those of
docs/sources/mx64-ezgripper.md#b2; values that are contested there are marked here. Driver and
emulator take them all from this module.

``mx64.PRESENT_POSITION`` is an :class:`Item`; ``mx64.TABLE`` holds all of them by address.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag

from dexkit.errors import EncodeError, TruncatedError

# --- identity (docs/sources/mx64-ezgripper.md#b1)
MODEL = 311
MODEL_PROTOCOL_1 = 310
"""An MX-64 whose firmware speaks Protocol 1.0."""
FIRMWARE = 45
TICKS_PER_TURN = 4096

# --- units (docs/sources/mx64-ezgripper.md#b2)
TICK = 2 * math.pi / TICKS_PER_TURN
"""rad of one position unit."""
CURRENT_UNIT = 3.36e-3
"""A of one current unit."""
VELOCITY_UNIT_RPM = 0.229
VELOCITY_UNIT = VELOCITY_UNIT_RPM * 2 * math.pi / 60
"""rad/s of one velocity unit."""
ACCELERATION_UNIT = 214.577 * 2 * math.pi / 3600
"""rad/s² of one acceleration unit (214.577 rev/min²)."""
PWM_UNIT = 0.113e-2
"""Duty of one PWM unit: 885 units are 100 %."""
PWM_MAX = 885
VOLTAGE_UNIT = 0.1
RETURN_DELAY_UNIT = 2e-6
WATCHDOG_UNIT = 20e-3
WATCHDOG_TRIPPED = -1

POSITION_SPAN = 1_048_575
"""Range of goal and present position in modes 4 and 5, ticks in either direction (256 turns)."""

PROFILE_TIME_MAX = 32737
"""Largest Profile Velocity and Acceleration in ms, with Drive Mode's time-based profile."""

BAUD_RATES: dict[int, int] = {
    0: 9_600,
    1: 57_600,
    2: 115_200,
    3: 1_000_000,
    4: 2_000_000,
    5: 3_000_000,
    6: 4_000_000,
    7: 4_500_000,
}
"""Value of Baud Rate(8) to bits a second (docs/sources/mx64-ezgripper.md#b3)."""

# --- the EZGripper on its shaft (docs/sources/mx64-ezgripper.md#d)
EZGRIPPER_STROKE = 2500
"""Ticks between fully closed and fully open."""
EZGRIPPER_CLOSING = -1
"""Sign of position change that closes."""


class OperatingMode(IntEnum):
    """Values of Operating Mode(11) (docs/sources/mx64-ezgripper.md#b4)."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


class DriveMode(IntFlag):
    """Bits of Drive Mode(10) (docs/sources/mx64-ezgripper.md#b5)."""

    NORMAL = 0
    REVERSE = 0x01
    TIME_BASED_PROFILE = 0x04


class HardwareError(IntFlag):
    """Bits of Hardware Error Status(70) and of Shutdown(63) (docs/sources/mx64-ezgripper.md#b6)."""

    NONE = 0
    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20


class MovingStatus(IntFlag):
    """Bits of Moving Status(123) (docs/sources/mx64-ezgripper.md#b7)."""

    NONE = 0
    IN_POSITION = 0x01
    PROFILE_ONGOING = 0x02
    FOLLOWING_ERROR = 0x08
    PROFILE_RECTANGLE = 0x10
    PROFILE_TRIANGLE = 0x20
    PROFILE_TRAPEZOID = 0x30


class StatusReturnLevel(IntEnum):
    """Values of Status Return Level(68)."""

    PING = 0
    READ = 1
    ALL = 2


class Access(Enum):
    """Who may change an item."""

    READ_ONLY = "R"
    READ_WRITE = "RW"


class Area(Enum):
    """Where an item lives: EEPROM survives power-off and is locked while torque is on."""

    EEPROM = "EEPROM"
    RAM = "RAM"


EEPROM_END = 64
"""Addresses below are EEPROM."""


@dataclass(frozen=True)
class Item:
    """One item of the control table.

    :param initial: value after a factory reset (EEPROM) or power-on (RAM); None where it is a
        measurement or is taken from another item.
    :param minimum: smallest value that the item takes; None for read-only items.
    :param limit: item that bounds this one: its value is the largest magnitude allowed.
    :param unit: SI (or named) unit with its factor, for people.
    """

    address: int
    size: int
    name: str
    access: Access
    initial: int | None
    minimum: int | None = None
    maximum: int | None = None
    unit: str = ""
    signed: bool = False
    limit: Item | None = None

    @property
    def area(self) -> Area:
        """EEPROM or RAM."""
        return Area.EEPROM if self.address < EEPROM_END else Area.RAM

    @property
    def end(self) -> int:
        """First address after the item."""
        return self.address + self.size

    @property
    def writable(self) -> bool:
        """Whether a Write may change it."""
        return self.access is Access.READ_WRITE

    def encode(self, value: int) -> bytes:
        """``value`` as the item's bytes; a negative one in two's complement.

        :raises EncodeError: it does not fit the item's size.
        """
        try:
            return int(value).to_bytes(self.size, "little", signed=self.signed or value < 0)
        except OverflowError:
            raise EncodeError(f"{self.name}: {value} does not fit {self.size} byte(s)") from None

    def decode(self, data: bytes | bytearray, base: int | None = None) -> int:
        """The item's value in ``data``.

        :param base: address of ``data[0]``; by default the item's own.
        :raises TruncatedError: ``data`` do not hold the item.
        """
        offset = 0 if base is None else self.address - base
        raw = data[offset : offset + self.size]
        if offset < 0 or len(raw) != self.size:
            raise TruncatedError(f"{self.name} is not within the {len(data)} bytes given")
        return int.from_bytes(raw, "little", signed=self.signed)


_R, _RW = Access.READ_ONLY, Access.READ_WRITE

MODEL_NUMBER = Item(0, 2, "Model Number", _R, MODEL)
MODEL_INFORMATION = Item(2, 4, "Model Information", _R, 0)
FIRMWARE_VERSION = Item(6, 1, "Firmware Version", _R, FIRMWARE)
ID = Item(7, 1, "ID", _RW, 1, 0, 252)
BAUD_RATE = Item(8, 1, "Baud Rate", _RW, 1, 0, 7)
RETURN_DELAY_TIME = Item(9, 1, "Return Delay Time", _RW, 250, 0, 254, "2 us")
DRIVE_MODE = Item(10, 1, "Drive Mode", _RW, 0, 0, 5)
OPERATING_MODE = Item(11, 1, "Operating Mode", _RW, 3, 0, 16)
SECONDARY_ID = Item(12, 1, "Secondary ID", _RW, 255, 0, 255)
PROTOCOL_TYPE = Item(13, 1, "Protocol Type", _RW, 2, 1, 2)
HOMING_OFFSET = Item(20, 4, "Homing Offset", _RW, 0, -1_044_479, 1_044_479, "tick", signed=True)
MOVING_THRESHOLD = Item(24, 4, "Moving Threshold", _RW, 10, 0, 1023, "0.229 rpm")
TEMPERATURE_LIMIT = Item(31, 1, "Temperature Limit", _RW, 80, 0, 100, "degC")
MAX_VOLTAGE_LIMIT = Item(32, 2, "Max Voltage Limit", _RW, 160, 95, 160, "0.1 V")
MIN_VOLTAGE_LIMIT = Item(34, 2, "Min Voltage Limit", _RW, 95, 95, 160, "0.1 V")
PWM_LIMIT = Item(36, 2, "PWM Limit", _RW, PWM_MAX, 0, PWM_MAX, "0.113 %")
CURRENT_LIMIT = Item(38, 2, "Current Limit", _RW, 1941, 0, 1941, "3.36 mA")
ACCELERATION_LIMIT = Item(40, 4, "Acceleration Limit", _RW, 32767, 0, 32767, "214.577 rev/min2")
# 435 is the e-Manual's; firmware from V42 on may come with 285 (docs/sources/mx64-ezgripper.md#f1)
VELOCITY_LIMIT = Item(44, 4, "Velocity Limit", _RW, 435, 0, 1023, "0.229 rpm")
MAX_POSITION_LIMIT = Item(48, 4, "Max Position Limit", _RW, 4095, 0, 4095, "tick")
MIN_POSITION_LIMIT = Item(52, 4, "Min Position Limit", _RW, 0, 0, 4095, "tick")
SHUTDOWN = Item(63, 1, "Shutdown", _RW, 0x34, 0, 0x3D)

TORQUE_ENABLE = Item(64, 1, "Torque Enable", _RW, 0, 0, 1)
LED = Item(65, 1, "LED", _RW, 0, 0, 1)
STATUS_RETURN_LEVEL = Item(68, 1, "Status Return Level", _RW, 2, 0, 2)
REGISTERED_INSTRUCTION = Item(69, 1, "Registered Instruction", _R, 0)
HARDWARE_ERROR_STATUS = Item(70, 1, "Hardware Error Status", _R, 0)
VELOCITY_I_GAIN = Item(76, 2, "Velocity I Gain", _RW, 1920, 0, 16383, "1/65536")
VELOCITY_P_GAIN = Item(78, 2, "Velocity P Gain", _RW, 100, 0, 16383, "1/128")
POSITION_D_GAIN = Item(80, 2, "Position D Gain", _RW, 0, 0, 16383, "1/16")
POSITION_I_GAIN = Item(82, 2, "Position I Gain", _RW, 0, 0, 16383, "1/65536")
POSITION_P_GAIN = Item(84, 2, "Position P Gain", _RW, 850, 0, 16383, "1/128")
FEEDFORWARD_2ND_GAIN = Item(88, 2, "Feedforward 2nd Gain", _RW, 0, 0, 16383, "1/4")
FEEDFORWARD_1ST_GAIN = Item(90, 2, "Feedforward 1st Gain", _RW, 0, 0, 16383, "1/4")
BUS_WATCHDOG = Item(98, 1, "Bus Watchdog", _RW, 0, 0, 127, "20 ms", signed=True)
GOAL_PWM = Item(
    100, 2, "Goal PWM", _RW, None, -PWM_MAX, PWM_MAX, "0.113 %", signed=True, limit=PWM_LIMIT
)
GOAL_CURRENT = Item(
    102, 2, "Goal Current", _RW, None, -1941, 1941, "3.36 mA", signed=True, limit=CURRENT_LIMIT
)
GOAL_VELOCITY = Item(
    104, 4, "Goal Velocity", _RW, 0, -1023, 1023, "0.229 rpm", signed=True, limit=VELOCITY_LIMIT
)
PROFILE_ACCELERATION = Item(
    108, 4, "Profile Acceleration", _RW, 0, 0, 32767, "214.577 rev/min2 (or ms)"
)
PROFILE_VELOCITY = Item(112, 4, "Profile Velocity", _RW, 0, 0, 32767, "0.229 rpm (or ms)")
GOAL_POSITION = Item(
    116, 4, "Goal Position", _RW, None, -POSITION_SPAN, POSITION_SPAN, "tick", signed=True
)
REALTIME_TICK = Item(120, 2, "Realtime Tick", _R, None, unit="1 ms")
MOVING = Item(122, 1, "Moving", _R, 0)
MOVING_STATUS = Item(123, 1, "Moving Status", _R, 0)
PRESENT_PWM = Item(124, 2, "Present PWM", _R, None, unit="0.113 %", signed=True)
PRESENT_CURRENT = Item(126, 2, "Present Current", _R, None, unit="3.36 mA", signed=True)
PRESENT_VELOCITY = Item(128, 4, "Present Velocity", _R, None, unit="0.229 rpm", signed=True)
PRESENT_POSITION = Item(132, 4, "Present Position", _R, None, unit="tick", signed=True)
VELOCITY_TRAJECTORY = Item(136, 4, "Velocity Trajectory", _R, None, unit="0.229 rpm", signed=True)
POSITION_TRAJECTORY = Item(140, 4, "Position Trajectory", _R, None, unit="tick", signed=True)
PRESENT_INPUT_VOLTAGE = Item(144, 2, "Present Input Voltage", _R, None, unit="0.1 V")
PRESENT_TEMPERATURE = Item(146, 1, "Present Temperature", _R, None, unit="degC")


@dataclass(frozen=True)
class IndirectBlock:
    """A run of indirect addresses (2 bytes each) and the data bytes they map."""

    address: int
    data: int
    count: int


INDIRECT_BLOCKS = (IndirectBlock(168, 224, 28), IndirectBlock(578, 634, 28))
INDIRECT_TARGETS = (64, 661)
"""Lowest and highest address that may be mapped: EEPROM cannot be."""
TABLE_END = 662


def indirect_address(number: int) -> Item:
    """The item Indirect Address ``number``, 1 to 56."""
    return TABLE[_indirect(number, data=False)]


def indirect_data(number: int) -> Item:
    """The item Indirect Data ``number``, 1 to 56."""
    return TABLE[_indirect(number, data=True)]


def _indirect(number: int, *, data: bool) -> int:
    index = number - 1
    for block in INDIRECT_BLOCKS:
        if 0 <= index < block.count:
            return block.data + index if data else block.address + 2 * index
        index -= block.count
    raise EncodeError(f"there is no indirect item {number}; 1 to 56")


def _build_table() -> dict[int, Item]:
    items = [value for value in globals().values() if isinstance(value, Item)]
    number = 0
    for block in INDIRECT_BLOCKS:
        for k in range(block.count):
            number += 1
            items.append(
                Item(
                    block.address + 2 * k,
                    2,
                    f"Indirect Address {number}",
                    _RW,
                    block.data + k,
                    *INDIRECT_TARGETS,
                )
            )
            items.append(Item(block.data + k, 1, f"Indirect Data {number}", _RW, 0, 0, 255))
    return {item.address: item for item in sorted(items, key=lambda i: i.address)}


TABLE: dict[int, Item] = _build_table()
"""Every item by its address, in order."""
