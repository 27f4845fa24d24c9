"""The servo's registers: what they must hold, compared before they are written and verified after.

EEPROM is written only where it differs (its life is limited), with torque off, because the
servo refuses otherwise (docs/sources/mx64-ezgripper.md#a4, docs/sources/mx64-ezgripper.md#d3). RAM
is lost at power-off and reboot, so it is set at every start. The order matters: the operating mode
resets Goal Current and the profile, and Velocity Limit bounds the profile
(docs/sources/mx64-ezgripper.md#b4, docs/sources/mx64-ezgripper.md#b5).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from dexkit.drivers.ezgripper import block
from dexkit.drivers.ezgripper.bus import ServoBus, ServoError
from dexkit.drivers.ezgripper.scaling import CURRENT_LIMIT, VELOCITY_LIMIT
from dexkit.errors import HandRefused
from dexkit.wire import mx64
from dexkit.wire.mx64 import OperatingMode, StatusReturnLevel

__all__ = [
    "EEPROM",
    "RAM",
    "WATCHDOG_TIME",
    "WATCHDOG_UNITS",
    "ServoLimits",
    "apply_settings",
    "differences",
    "hold_here",
]

log = logging.getLogger(__name__)

EEPROM: tuple[tuple[mx64.Item, int], ...] = (
    # current-based position: force is Goal Current, and changing it needs no torque-off
    # (docs/sources/mx64-ezgripper.md#d10-8)
    (mx64.OPERATING_MODE, OperatingMode.CURRENT_BASED_POSITION),
    (mx64.DRIVE_MODE, 0),  # closing is toward smaller ticks; profile in velocities
    (mx64.HOMING_OFFSET, 0),
    (mx64.RETURN_DELAY_TIME, 2),  # 4 us (docs/sources/mx64-ezgripper.md#d3)
    (mx64.CURRENT_LIMIT, CURRENT_LIMIT),
    (mx64.VELOCITY_LIMIT, VELOCITY_LIMIT),
)
"""EEPROM items and the values that they must have (docs/sources/mx64-ezgripper.md#d3)."""

RAM: tuple[tuple[mx64.Item, int], ...] = (
    (mx64.STATUS_RETURN_LEVEL, StatusReturnLevel.ALL),
    (mx64.PROFILE_ACCELERATION, 800),
)
"""RAM items and their values (docs/sources/mx64-ezgripper.md#d3); the rest is in every exchange."""

WATCHDOG_TIME = 0.5
"""Seconds without an instruction after which the servo stops by itself: the dead man's switch
for a driver that is killed or a cable that is pulled."""
WATCHDOG_UNITS = round(WATCHDOG_TIME / mx64.WATCHDOG_UNIT)
"""The same as Bus Watchdog(98) takes it."""


@dataclass(frozen=True)
class ServoLimits:
    """The servo's own limits, read from it.

    :param temperature: °C at which it shuts down.
    :param voltage_min: V.
    :param voltage_max: V.
    """

    temperature: int
    voltage_min: float
    voltage_max: float


def differences(bus: ServoBus, servo_id: int) -> list[tuple[mx64.Item, int, int]]:
    """EEPROM items that differ: (item, value found, value wanted). Raises as the bus."""
    found = [(item, bus.read_item(servo_id, item), wanted) for item, wanted in EEPROM]
    return [entry for entry in found if entry[1] != entry[2]]


def _verify(bus: ServoBus, servo_id: int, item: mx64.Item, value: int) -> None:
    found = bus.read_item(servo_id, item)
    if found != value:
        raise HandRefused(
            f"servo {servo_id}: {item.name}({item.address}) was set to {value} but reads {found}",
            hint="another program may be writing to the same servo",
        )


def hold_here(bus: ServoBus, servo_id: int, watchdog: int = 0) -> None:
    """Set the bus watchdog, and the goal to where the servo is, with nothing in between.

    A servo stopped by its watchdog refuses goals until that is cleared; whether it then goes on
    to its old goal is not documented.
    """
    present = bus.read_item(servo_id, mx64.PRESENT_POSITION)
    bus.write_item(servo_id, mx64.BUS_WATCHDOG, 0)
    bus.write_item(servo_id, mx64.GOAL_POSITION, present)
    if watchdog:
        bus.write_item(servo_id, mx64.BUS_WATCHDOG, watchdog)


def apply_settings(bus: ServoBus, servo_id: int) -> ServoLimits:
    """Bring the registers of a servo to what the driver needs. Nothing moves.

    Torque is switched off only if EEPROM or the mapping has to change; a servo that holds
    something goes on holding it, at the position where it is.

    :returns: the limits that the servo watches itself.
    :raises HandRefused: a register does not take its value.
    :raises HandTimeout, HandLost: as the bus.
    """
    # with the level at "ping" nothing else would be answered, and at "read" writes would not
    bus.write_unacknowledged(
        servo_id,
        mx64.STATUS_RETURN_LEVEL.address,
        mx64.STATUS_RETURN_LEVEL.encode(StatusReturnLevel.ALL),
    )
    differing = [(item, wanted) for item, _, wanted in differences(bus, servo_id)]
    mapped = _mapping(bus, servo_id) == block.mapping()
    if bus.read_item(servo_id, mx64.TORQUE_ENABLE):
        # ROBOTIS' examples map indirect addresses with torque off only
        if differing or not mapped:
            bus.write_item(servo_id, mx64.TORQUE_ENABLE, 0)
        else:
            hold_here(bus, servo_id)
    # only now: a servo stopped by its watchdog may move again
    bus.write_item(servo_id, mx64.BUS_WATCHDOG, 0)
    for item, value in differing:
        log.info("servo %d: setting %s(%d) to %d", servo_id, item.name, item.address, value)
        try:
            bus.write_item(servo_id, item, value)
        except ServoError as error:
            raise HandRefused(
                f"servo {servo_id} does not take {item.name}({item.address}) = {value}: "
                f"{error.message}"
            ) from error
        _verify(bus, servo_id, item, value)
    for item, value in RAM:
        bus.write_item(servo_id, item, value)
        _verify(bus, servo_id, item, value)
    if not mapped:
        _map_block(bus, servo_id)
    bus.write_item(servo_id, mx64.BUS_WATCHDOG, WATCHDOG_UNITS)
    _verify(bus, servo_id, mx64.BUS_WATCHDOG, WATCHDOG_UNITS)
    return ServoLimits(
        temperature=bus.read_item(servo_id, mx64.TEMPERATURE_LIMIT),
        voltage_min=bus.read_item(servo_id, mx64.MIN_VOLTAGE_LIMIT) * mx64.VOLTAGE_UNIT,
        voltage_max=bus.read_item(servo_id, mx64.MAX_VOLTAGE_LIMIT) * mx64.VOLTAGE_UNIT,
    )


def _mapping(bus: ServoBus, servo_id: int) -> bytes:
    return bus.read(servo_id, mx64.INDIRECT_BLOCKS[0].address, len(block.mapping()))[0]


def _map_block(bus: ServoBus, servo_id: int) -> None:
    bus.write(servo_id, mx64.INDIRECT_BLOCKS[0].address, block.mapping())
    if _mapping(bus, servo_id) != block.mapping():
        raise HandRefused(
            f"servo {servo_id}: the indirect addresses do not take the driver's mapping",
            hint="update the servo's firmware with DYNAMIXEL Wizard 2",
        )
