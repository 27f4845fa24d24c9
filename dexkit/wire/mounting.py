"""How each joint's motor is mounted: direction, zero and gearing.

The manual gives none of the three; docs/bringup.md finds them on a hand. A motor reports its
position ``ratio * (sign * q + offset)``, rotor side, for the joint position ``q``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.hand import JointSpec

__all__ = ["FURTHEST", "Mounting"]

FURTHEST = 4 * math.pi
"""rad: largest offset of a joint's zero. The wire has room for more than 300."""
_RATIOS = (1.0, 1000.0)


@dataclass(frozen=True)
class Mounting:
    """Direction, zero and gearing of every joint's motor.

    :param signs: +1 where the motor turns as its joint does, else -1.
    :param offsets: the motor's position where the joint is at 0, rad at the joint.
    :param ratios: turns of the rotor for one of the joint.
    :raises UsageError: a sign, offset or ratio is invalid, or the lengths differ.
    """

    signs: tuple[int, ...]
    offsets: tuple[float, ...]
    ratios: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.signs) == len(self.offsets) == len(self.ratios):
            raise UsageError(
                f"{len(self.signs)} sign(s), {len(self.offsets)} offset(s) and "
                f"{len(self.ratios)} ratio(s)",
                hint="each joint has one of each",
            )
        for sign in self.signs:
            if sign not in (1, -1):
                raise UsageError(f"a sign is +1 or -1, not {sign}")
        for offset in self.offsets:
            if not abs(offset) <= FURTHEST:
                raise UsageError(f"an offset is up to {FURTHEST:.2f} rad, not {offset:g}")
        for ratio in self.ratios:
            if not _RATIOS[0] <= ratio <= _RATIOS[1]:
                raise UsageError(f"a ratio is {_RATIOS[0]:g} to {_RATIOS[1]:g}, not {ratio:g}")

    @classmethod
    def default(cls, joints: Sequence[JointSpec]) -> Mounting:
        """The default mounting: motors turn as their joints do, from the same zero."""
        n = len(joints)
        return cls((1,) * n, (0.0,) * n, tuple(joint.gear_ratio for joint in joints))

    def joint(self, index: int, position: float) -> float:
        """Joint position of a motor position that is divided by the ratio, rad."""
        return self.signs[index] * (position - self.offsets[index])

    def motor(self, index: int, q: float) -> float:
        """Motor position, divided by the ratio, of a joint position, rad."""
        return self.signs[index] * q + self.offsets[index]
