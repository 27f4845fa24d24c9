"""Convert between the Dex3-1's integer fields and SI units at the joint.

The manual's figures are read as counts per unit on the *rotor's* side, with a torque unit of
1 mN·m and a velocity unit of 100 rad/s, although its command structure says "joint output": a
joint's 0.76 N·m would not fit an int16 of 1/256 mN·m (docs/sources/unitree-dex.md#c9,
docs/sources/unitree-dex.md#d24). A rotor turns ``ratio`` times as far and as fast as its joint and
gives 1 / ratio of its torque, so stiffness and damping go with 1 / ratio².
"""

from __future__ import annotations

import math

from dexkit.wire.ris import (
    MOTOR_VOLTAGE,
    POSITION,
    TEMPERATURE,
    WINDING_TEMPERATURE,
    Scale,
)

__all__ = [
    "ACCELERATION",
    "CURRENT",
    "DAMPING",
    "MOTOR_VOLTAGE",
    "NO_VALUE",
    "NO_VALUE_COUNTS",
    "POSITION",
    "PRESSURE",
    "ROTATION",
    "SCALES",
    "STIFFNESS",
    "TEMPERATURE",
    "TORQUE",
    "VELOCITY",
    "VOLTAGE",
    "WINDING_TEMPERATURE",
    "Scale",
]

NO_VALUE = 3750
"""Pressure count that dexkit sends where a packet has no sensor element: 30000 Pa (the Dex3-1
manual "30000 represents no value"; a count is 8 Pa). No element reads that: the air is 12500
counts (docs/dex3-usb.md)."""
NO_VALUE_COUNTS = 30000
"""The same, where a hand's processor means counts. These are 240 kPa, which a pressed element may
read, so they say that there is none only in a slot that never holds anything else."""

_INT16 = (-0x8000, 0x7FFF)
_UINT16 = (0, 0xFFFF)


_FULL_SCALE = 65536.0
_ADC = 3.3

VELOCITY = Scale(
    "velocity", ("spd_des", "speed"), "rad/s", 256 / (2 * math.pi) / 100, *_INT16, power=1
)
TORQUE = Scale("torque", ("tor_des", "torque"), "N·m", 256e3, *_INT16, power=-1)
# an int16, whose negative half would invert the joint's stiffness or damping
STIFFNESS = Scale("stiffness", ("k_pos",), "N·m/rad", 1280e3, 0, 0x7FFF, power=-2)
DAMPING = Scale("damping", ("k_spd",), "N·m·s/rad", 1280e3 * 100, 0, 0x7FFF, power=-2)

PRESSURE = Scale("pressure", ("pressure",), "Pa", 1 / 8, *_UINT16)
# vin_v stands beside the formula of the current in the manual; by its name it is a voltage
VOLTAGE = Scale("voltage", ("pin_v", "vin_v", "vm_v"), "V", _FULL_SCALE / (_ADC * 21.0), *_UINT16)
CURRENT = Scale("current", ("pin_a",), "A", _FULL_SCALE / (_ADC * 10.0), *_UINT16)
# the manual: raw = x / 100, without a unit. Read as the units of IMUState_ on DDS
ACCELERATION = Scale("acceleration", ("imu_data[0:3]",), "m/s²", 100.0, *_INT16)
ROTATION = Scale("rotation", ("imu_data[3:6]",), "rad/s", 100.0, *_INT16)

SCALES = (
    POSITION,
    VELOCITY,
    TORQUE,
    STIFFNESS,
    DAMPING,
    TEMPERATURE,
    WINDING_TEMPERATURE,
    MOTOR_VOLTAGE,
    PRESSURE,
    VOLTAGE,
    CURRENT,
    ACCELERATION,
    ROTATION,
)


def encode_pressure(pascal: float) -> int:
    """Counts of a pressure; NaN becomes :data:`NO_VALUE`, and a real reading neither that nor
    :data:`NO_VALUE_COUNTS`.
    """
    if math.isnan(pascal):
        return NO_VALUE
    count = PRESSURE.encode(pascal)
    return count + 1 if count in (NO_VALUE, NO_VALUE_COUNTS) else count
