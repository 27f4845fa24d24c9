"""Detect swapped states of two hands: each follows the commands of the other side.

xr_teleoperate v1.0 and v1.1 record the states of Inspire hands with the sides swapped
(docs/sources/sessions.md#a4), and mixed versions of controller and main program can cause the same
with other hands. Version and data decide together: sides are exchanged only if each hand's states
follow the other hand's commands and not its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dexkit.hand import Floats
from dexkit.traces.sessions.model import Part
from dexkit.traces.sessions.streams import COMMAND, STATE

__all__ = ["SideEvidence", "swap_states", "swapped_sides"]

# Largest delay of a hand behind its command, seconds.
_LATEST = 0.6
# Frames per second of which all delays are tried: the effort is frames times delays.
_FASTEST = 2000.0
# Smallest correlation with the other side, and its smallest margin over the own side.
_LEAST = 0.7
_LEAD = 0.3
# Standard deviation, in units of the joints, below which nothing moves.
_STILL = 0.01


@dataclass(frozen=True)
class SideEvidence:
    """Correlation of states with the commands of the own and of the other side, for the worse hand.

    NaN if a hand does not move, or both have the same commands.
    """

    own: float
    other: float

    @property
    def swapped(self) -> bool:
        """Whether each hand follows the other one's commands."""
        return self.other >= _LEAST and not self.own > self.other - _LEAD

    @property
    def straight(self) -> bool:
        """Whether each hand follows its own commands."""
        return self.own >= _LEAST and not self.other > self.own - _LEAD

    def __str__(self) -> str:
        return f"states follow the commands of the other side by {self.other:.2f}, " + (
            f"of their own by {self.own:.2f}"
        )


def swapped_sides(parts: Sequence[Part], rate: float) -> SideEvidence | None:
    """Compute the evidence for swapped sides; None if there are not two hands."""
    hands = {p.name: p for p in parts if STATE in p.values and COMMAND in p.values}
    try:
        left, right = hands["left_hand"], hands["right_hand"]
    except KeyError:
        return None
    if len(left.joints) != len(right.joints):
        return None
    steps = max(1, round(_LATEST * min(rate, _FASTEST)))

    def follows(state: Part, command: Part) -> float:
        return _correlation(state.values[STATE]["q"], command.values[COMMAND]["q"], steps)

    return SideEvidence(
        own=float(np.min([follows(left, left), follows(right, right)])),
        other=float(np.min([follows(left, right), follows(right, left)])),
    )


def swap_states(parts: Sequence[Part]) -> list[Part]:
    """The parts with the states of the left and the right hand exchanged."""
    states = {p.name: p.values[STATE] for p in parts if STATE in p.values}
    other = {"left_hand": "right_hand", "right_hand": "left_hand"}
    return [
        replace(p, values={**p.values, STATE: states[other[p.name]]})
        if p.name in other and other[p.name] in states
        else p
        for p in parts
    ]


def _correlation(state: Floats, command: Floats, steps: int) -> float:
    """The best coefficient of all joints together at a delay of 0 to ``steps`` frames."""
    best = np.nan
    for delay in range(min(steps, len(state) - 2) + 1):
        s, c = state[delay:], command[: len(command) - delay]
        good = np.isfinite(s).all(axis=1) & np.isfinite(c).all(axis=1)
        if good.sum() < 10:
            continue
        s, c = s[good] - s[good].mean(axis=0), c[good] - c[good].mean(axis=0)
        moving = (s.std(axis=0) > _STILL) | (c.std(axis=0) > _STILL)
        power = np.sqrt((s[:, moving] ** 2).sum() * (c[:, moving] ** 2).sum())
        if power > 0:
            best = np.fmax(best, (s[:, moving] * c[:, moving]).sum() / power)
    return float(best)
