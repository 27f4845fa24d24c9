"""Registers of BrainCo's Revo2 on its serial line, Modbus RTU (docs/sources/unitree-dex.md#j1).

With unit mode :attr:`UnitMode.NORMALISED`, positions, speeds and currents are thousandths of their
full values. The joints are in the order thumb, thumb_aux, index, middle, ring, pinky; position 0 is
open.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from dexkit.hand import Side

__all__ = [
    "BAUD_RATE",
    "FULL",
    "IDS",
    "JOINTS",
    "SIDES",
    "TEXT",
    "UNITS",
    "Holding",
    "Input",
    "MotorStatus",
    "UnitMode",
    "position_and_speed",
]

BAUD_RATE = 460800
JOINTS = 6
FULL = 1000
UNITS = {Side.LEFT: 126, Side.RIGHT: 127}
"""Modbus unit of a hand as it is delivered."""
IDS = range(1, 255)


class Holding(IntEnum):
    """Addresses of holding registers."""

    SIDE = 901
    UNIT_MODE = 937
    ID = 1000
    POSITION_AND_SPEED = 1022
    """Six pairs: goal position and largest speed; a speed of 0 means full speed."""


class Input(IntEnum):
    """Addresses of input registers, six each, and of two texts of 20 bytes."""

    POSITION = 2000
    SPEED = 2006
    CURRENT = 2012
    STATUS = 2018
    FIRMWARE = 3000
    SERIAL_NUMBER = 3010


TEXT = 10
"""Registers of a text."""


class UnitMode(IntEnum):
    """Unit of positions, speeds and currents."""

    NORMALISED = 0
    PHYSICAL = 1


class MotorStatus(IntEnum):
    """State of a motor."""

    IDLE = 0
    RUNNING = 1
    STALLED = 2
    TURBO = 3


SIDES = {1: Side.RIGHT, 2: Side.LEFT}
"""Values of :attr:`Holding.SIDE`."""


def position_and_speed(positions: Sequence[int], speeds: Sequence[int]) -> list[int]:
    """The registers of :attr:`Holding.POSITION_AND_SPEED`."""
    return [value for pair in zip(positions, speeds, strict=True) for value in pair]
