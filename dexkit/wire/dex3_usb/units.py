"""Between the integers on the Dex3-1's wire and SI units on the joint's side, as one table.

The manual's figures are read as counts per unit on the *rotor's* side, with a torque unit of
1 mN·m and a velocity unit of 100 rad/s, although its command structure says "joint output": a
joint's 0.76 N·m would not fit an int16 of 1/256 mN·m (facts/unitree-dex C.9, D 24). A rotor turns
``ratio`` times as far and as fast as its joint and gives 1 / ratio of its torque, so stiffness and
damping go with 1 / ratio².
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dexkit.errors import EncodeError

__all__ = [
    "ACCELERATION",
    "CURRENT",
    "DAMPING",
    "MOTOR_VOLTAGE",
    "NO_VALUE",
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

NO_VALUE = 30000
"""Pressure count where a packet has no sensor element (seed 002 "30000 represents no value")."""

_INT16 = (-0x8000, 0x7FFF)
_UINT16 = (0, 0xFFFF)


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
        """Counts of ``value``: toward zero (as the vendor's library, facts C.9), saturated.

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
"""Makes up for the rounding of a division and a multiplication, so that a decoded count encodes
to itself and not to its neighbour; far below one count otherwise."""

_FULL_SCALE = 65536.0
_ADC = 3.3

POSITION = Scale(
    "position", ("pos_des", "pos"), "rad", 32768 / (2 * math.pi), -(2**31), 2**31 - 1, 1
)
VELOCITY = Scale(
    "velocity", ("spd_des", "speed"), "rad/s", 256 / (2 * math.pi) / 100, *_INT16, power=1
)
TORQUE = Scale("torque", ("tor_des", "torque"), "N·m", 256e3, *_INT16, power=-1)
# an int16 whose negative half would turn the joint's spring or damper round
STIFFNESS = Scale("stiffness", ("k_pos",), "N·m/rad", 1280e3, 0, 0x7FFF, power=-2)
DAMPING = Scale("damping", ("k_spd",), "N·m·s/rad", 1280e3 * 100, 0, 0x7FFF, power=-2)

TEMPERATURE = Scale("temperature", ("temp", "temperature"), "°C", 1.0, -128, 127)
WINDING_TEMPERATURE = Scale("winding temperature", ("sensor",), "°C", 1.0, 0, 255)
MOTOR_VOLTAGE = Scale("motor voltage", ("vol",), "V", 2.0, 0, 255)
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
    """Counts of a pressure; NaN becomes :data:`NO_VALUE`, and a real reading never does."""
    if math.isnan(pascal):
        return NO_VALUE
    count = PRESSURE.encode(pascal)
    return NO_VALUE + 1 if count == NO_VALUE else count
