"""Ids and mounting of the servos of emulated EZGrippers on one line."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

from dexkit.emulators.mx64.settings import GripperMechanics
from dexkit.hand import Side
from dexkit.wire import dynamixel, mx64

__all__ = ["Wiring"]

_STROKES = (2200, 2800)


@dataclass(frozen=True)
class Wiring:
    """The servos of each side's gripper by id, with their mechanics.

    :param servos: of each side; two servos are a quad gripper.
    """

    servos: Mapping[Side, Mapping[int, GripperMechanics]]

    @classmethod
    def random(cls, seed: int) -> Wiring:
        """A random wiring: one gripper or two, dual or quad, mirrored, offset, with another stroke.

        The same seed gives the same wiring.
        """
        rng = random.Random(seed)
        sides = [Side.LEFT, Side.RIGHT]
        rng.shuffle(sides)
        ids = iter(rng.sample(range(dynamixel.MAX_ID), 2 * len(sides)))
        return cls(
            {
                side: {next(ids): _mechanics(rng) for _ in range(rng.choice((1, 2)))}
                for side in sides[: rng.choice((1, 2))]
            }
        )


def _mechanics(rng: random.Random) -> GripperMechanics:
    return GripperMechanics(
        closed_at=rng.randrange(mx64.TICKS_PER_TURN),
        start=round(rng.uniform(15.0, 85.0), 1),
        mirrored=rng.choice((False, True)),
        stroke=rng.choice((mx64.EZGRIPPER_STROKE, rng.randint(*_STROKES))),
    )
