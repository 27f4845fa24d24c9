"""What the elements of an untouched Dex3-1 read: the pressure of the air, each a little off."""

from __future__ import annotations

import math

import numpy as np

from dexkit.hand import Floats, Side
from dexkit.models import DEX3_1

__all__ = ["NOISE_PERIOD", "untouched"]

# as reported of an untouched hand (docs/sources/unitree-dex.md#b4)
_LOW, _HIGH = 101_000.0, 103_300.0
_NOISE = 40.0  # Pa, assumed: far below the difference of 1,000 that a program takes for contact
_ROWS = 64
NOISE_PERIOD = 0.05
"""Seconds for which the noise stands still: encoders keep what has not changed. Assumed."""


def _spread(count: int, first: float) -> Floats:
    """Numbers from 0 to 1 that look random and are the same on every machine."""
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    return np.asarray((first + golden * np.arange(1, count + 1)) % 1.0)


def _readings(side: Side) -> Floats:
    shape = len(DEX3_1.sensors), 12
    seed = 0.3 if side is Side.RIGHT else 0.0
    elements = shape[0] * shape[1]
    offsets = _LOW + _NOISE + (_HIGH - _LOW - 2 * _NOISE) * _spread(elements, seed)
    # each element begins elsewhere, and goes on by another step
    steps = 1.0 + 7.0 * _spread(elements, 0.1)
    phases = np.outer(np.arange(_ROWS), steps * math.sqrt(2.0)) + 5.0 * _spread(elements, 0.7)
    found = offsets + _NOISE * (2.0 * (phases % 1.0) - 1.0)
    there = np.zeros(shape, dtype=np.bool_)
    for row, sensor in zip(there, DEX3_1.sensors, strict=True):
        row[list(sensor.slots)] = True
    readings = np.where(there, found.reshape(_ROWS, *shape), math.nan)
    readings.setflags(write=False)
    return readings


_READINGS = {side: _readings(side) for side in Side}


def untouched(side: Side, t: float) -> Floats:
    """The readings at ``t`` seconds, Pa, shape (9, 12), read-only; NaN where there is no element.

    One array for each :data:`NOISE_PERIOD`.
    """
    return np.asarray(_READINGS[side][int(t / NOISE_PERIOD) % _ROWS])
