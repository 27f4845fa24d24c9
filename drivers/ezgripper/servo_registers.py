"""Write and verify the servo registers that the driver needs.

EEPROM is written only where it differs (its write cycles are limited), with torque off, because the
servo refuses otherwise (docs/sources/mx64-ezgripper.md#a4, docs/sources/mx64-ezgripper.md#d3). RAM
is lost at power-off and reboot, so it is written at every start. The order matters: a new operating
mode resets Goal Current and the profile, and Velocity Limit bounds the profile
(docs/sources/mx64-ezgripper.md#b4, docs/sources/mx64-ezgripper.md#b5).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from dexkit.drivers.ezgripper import register_block
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
    # current-based position: Goal Current limits the force, and may be written with torque on
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
"""RAM items and their values (docs/sources/mx64-ezgripper.md#d3); exchanges write the others."""

WATCHDOG_TIME = 0.5
"""Seconds without an instruction after which the servo stops by itself, for example after the
driver is killed or the cable is pulled."""
WATCHDOG_UNITS = round(WATCHDOG_TIME / mx64.WATCHDOG_UNIT)
"""The same in units of Bus Watchdog(98)."""


@dataclass(frozen=True)
class ServoLimits:
    """Limits read from the servo's registers.

    :param temperature: Temperature Limit(31), °C, above which it shuts down.
    :param voltage_min: Min Voltage Limit(34), V.
    :param voltage_max: Max Voltage Limit(32), V.
    """

    temperature: int
    voltage_min: float
    voltage_max: float


def differences(
    bus: ServoBus, servo_id: int, *, mirrored: bool = False
) -> list[tuple[mx64.Item, int, int]]:
    """List EEPROM items that differ: (item, value read, value needed). Raises as the bus.

    :param mirrored: as :func:`apply_settings`.
    """
    needed = dict(EEPROM) | ({mx64.DRIVE_MODE: int(mx64.DriveMode.REVERSE)} if mirrored else {})
    found = [(item, bus.read_item(servo_id, item), wanted) for item, wanted in needed.items()]
    return [entry for entry in found if entry[1] != entry[2]]


def _verify(bus: ServoBus, servo_id: int, item: mx64.Item, value: int) -> None:
    found = bus.read_item(servo_id, item)
    if found != value:
        raise HandRefused(
            f"servo {servo_id}: {item.name}({item.address}) was set to {value} but reads {found}",
            hint="another program may be writing to the same servo",
        )


def hold_here(bus: ServoBus, servo_id: int, watchdog: int = 0) -> None:
    """Write the bus watchdog, and right after it the present position as goal.

    A servo with a tripped watchdog refuses goals until that is cleared; whether it then moves on to
    its old goal is not documented.
    """
    present = bus.read_item(servo_id, mx64.PRESENT_POSITION)
    bus.write_item(servo_id, mx64.BUS_WATCHDOG, 0)
    bus.write_item(servo_id, mx64.GOAL_POSITION, present)
    if watchdog:
        bus.write_item(servo_id, mx64.BUS_WATCHDOG, watchdog)


def apply_settings(bus: ServoBus, servo_id: int, *, mirrored: bool = False) -> ServoLimits:
    """Write the values that the driver needs to the registers of a servo. No motion.

    :param mirrored: the fingers close while the encoder's position rises: the servo counts the
        other way (Drive Mode), so that closing is toward smaller ticks for everything else.

    Torque is switched off only if EEPROM or the mapping must change; otherwise a servo that holds
    an object goes on holding it at its present position.

    :returns: the servo's own limits.
    :raises HandRefused: a register does not keep its value.
    :raises HandTimeout, HandLost: as the bus.
    """
    # first: at a lower Status Return Level the servo does not answer writes, or reads and writes
    bus.write_unacknowledged(
        servo_id,
        mx64.STATUS_RETURN_LEVEL.address,
        mx64.STATUS_RETURN_LEVEL.encode(StatusReturnLevel.ALL),
    )
    differing = [
        (item, wanted) for item, _, wanted in differences(bus, servo_id, mirrored=mirrored)
    ]
    mapped = _mapping(bus, servo_id) == register_block.mapping()
    if bus.read_item(servo_id, mx64.TORQUE_ENABLE):
        # ROBOTIS' examples write indirect addresses only with torque off
        if differing or not mapped:
            bus.write_item(servo_id, mx64.TORQUE_ENABLE, 0)
        else:
            hold_here(bus, servo_id)
    # after the mapping: a servo with a tripped watchdog may move once that is cleared
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
    return bus.read(servo_id, mx64.INDIRECT_BLOCKS[0].address, len(register_block.mapping()))[0]


def _map_block(bus: ServoBus, servo_id: int) -> None:
    bus.write(servo_id, mx64.INDIRECT_BLOCKS[0].address, register_block.mapping())
    if _mapping(bus, servo_id) != register_block.mapping():
        raise HandRefused(
            f"servo {servo_id}: the indirect addresses do not take the driver's mapping",
            hint="update the servo's firmware with DYNAMIXEL Wizard 2",
        )
