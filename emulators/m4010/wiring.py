"""Ids and mounting of the motors of an emulated pair of Dex1-1 grippers.

Only the vendor's service says which id is which side, and only the gear ratio of its library is
known of the mounting. So an emulated gripper can have any.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.wire.m4010 import BROADCAST_ID, GEAR_RATIO
from dexkit.wire.mounting import Mounting

__all__ = ["Wiring"]

_FURTHEST_ZERO = 6.0  # rad at the joint
_RATIOS = (20.0, 32.0)


@dataclass(frozen=True)
class Wiring:
    """Id and mounting of each side's motor."""

    ids: Mapping[Side, int]
    mountings: Mapping[Side, Mounting]

    @classmethod
    def assumed(cls) -> Wiring:
        """The wiring that dexkit assumes for real grippers."""
        straight = Mounting((1,), (0.0,), (GEAR_RATIO,))
        return cls(DEX1_1.vendor_ids, dict.fromkeys(Side, straight))

    @classmethod
    def random(cls, seed: int) -> Wiring:
        """Random ids, directions, offsets and gear ratios, reproducible by the seed."""
        rng = random.Random(seed)
        ids = rng.sample(range(BROADCAST_ID), len(Side))
        mountings = {
            side: Mounting(
                (rng.choice((1, -1)),),
                (round(rng.uniform(-_FURTHEST_ZERO, _FURTHEST_ZERO), 4),),
                (rng.choice((GEAR_RATIO, round(rng.uniform(*_RATIOS), 2))),),
            )
            for side in Side
        }
        return cls(dict(zip(Side, ids, strict=True)), mountings)
