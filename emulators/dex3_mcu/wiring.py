"""Bus addresses and mounting of the motors and sensors of an emulated Dex3-1.

The manual does not give them (docs/dex3-protocol.md), so an emulated hand can have any.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import (
    DEFAULT_BUS_MAP,
    MOTOR_STATE,
    N_BUSES,
    SENSOR_STATE,
    STATE_BUS_SIZE,
    BusMap,
    Mounting,
)

__all__ = ["Wiring"]

_FURTHEST_ZERO = 2.0  # rad at the joint
_MOST_MOTORS, _MOST_SENSORS = 3, 4  # of a bus: "3+4" of the manual
_GEARED = (189.0, 214.0)  # ratios of "one with gears": 108 * 1.75, and the F-1515-214
_DIRECT = 108.0


@dataclass(frozen=True)
class Wiring:
    """Bus and id of every motor and sensor, and the motors' direction, zero and gearing."""

    bus_map: BusMap
    mounting: Mounting

    @classmethod
    def assumed(cls, side: Side) -> Wiring:
        """The wiring that dexkit assumes for a real hand."""
        return cls(DEFAULT_BUS_MAP, Mounting.default(DEX3_1.joints[side]))

    @classmethod
    def random(cls, seed: int) -> Wiring:
        """A random wiring, reproducible by its seed.

        Motors are permuted, mirrored and offset, and one joint has another gear ratio. Ids start at
        0 on every bus, as the manual says, and the packets of a bus fit its buffer.
        """
        rng = random.Random(seed)
        n, sensors = len(DEX3_1.joints[Side.LEFT]), len(DEX3_1.sensors)
        while True:
            motor_buses = [rng.randrange(N_BUSES) for _ in range(n)]
            sensor_buses = [rng.randrange(N_BUSES) for _ in range(sensors)]
            if all(_fits(motor_buses.count(b), sensor_buses.count(b)) for b in range(N_BUSES)):
                break
        ratios = [_DIRECT] * n
        ratios[rng.randrange(n)] = rng.choice(_GEARED)
        return cls(
            BusMap(_numbered(motor_buses, rng), _numbered(sensor_buses, rng)),
            Mounting(
                tuple(rng.choice((1, -1)) for _ in range(n)),
                tuple(round(rng.uniform(-_FURTHEST_ZERO, _FURTHEST_ZERO), 4) for _ in range(n)),
                tuple(ratios),
            ),
        )

    def describe(self, side: Side) -> dict[str, Any]:
        """Describe the wiring for a JSON file, as a person would find it on the hand."""
        return {
            "motors": {
                f"{bus}.{number}": {"joint": joint.name, "sign": sign, "offset": o, "ratio": r}
                for (bus, number), joint, sign, o, r in zip(
                    self.bus_map.motors,
                    DEX3_1.joints[side],
                    self.mounting.signs,
                    self.mounting.offsets,
                    self.mounting.ratios,
                    strict=True,
                )
            },
            "sensors": {
                f"{bus}.{number}": sensor.place
                for (bus, number), sensor in zip(self.bus_map.sensors, DEX3_1.sensors, strict=True)
            },
        }


def _fits(motors: int, sensors: int) -> bool:
    return (
        motors <= _MOST_MOTORS
        and sensors <= _MOST_SENSORS
        and motors * MOTOR_STATE.size + sensors * SENSOR_STATE.size <= STATE_BUS_SIZE
    )


def _numbered(buses: Sequence[int], rng: random.Random) -> tuple[tuple[int, int], ...]:
    """(bus, id) of each; the ids of a bus from 0, in any order."""
    free = {bus: rng.sample(range(buses.count(bus)), buses.count(bus)) for bus in sorted({*buses})}
    return tuple((bus, free[bus].pop()) for bus in buses)
