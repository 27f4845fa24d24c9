"""Find joints whose states stand still while their commands move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["frozen_joints"]

_MOVES = 0.1
"""Commanded motion, as a part of the stroke, that a joint cannot miss in a whole session."""
_BESIDE = 0.05
"""Distance of a command from the state, as a part of the stroke, that must move the joint."""
_LEAST_S = 0.5
"""Seconds for which commands ask for motion, in each direction."""
_LONGEST_S = 0.1
"""Most seconds that one state stands for."""


def frozen_joints(
    t: Floats, q: Floats, sent: Floats, goal: Floats, follows: NDArray[np.bool_], stroke: Floats
) -> dict[int, tuple[float, float]]:
    """The joints whose states are frozen, each with the longest time of that, (begin, end) in s.

    A joint is frozen where its q does not change by a bit while commands ask for motion in both
    directions, or in the whole session. In one direction an object may hold it, unless another
    joint of the hand is frozen at the same time.

    :param t: times of the states, s, ascending, shape (n,); ``q`` their positions, (n, joints).
    :param sent: times of the commands, s, ascending, shape (m,); ``goal`` their positions,
        (m, joints).
    :param follows: whether a command drives a joint, (m, joints).
    :param stroke: width of each joint's range, (joints,).
    """
    if len(t) < 2 or not len(sent):
        return {}
    at = np.searchsorted(sent, t, side="right") - 1
    goals, driven = goal[at], follows[at] & (at >= 0)[:, None] & np.isfinite(goal[at])
    lasts = np.minimum(np.diff(t, append=t[-1]), _LONGEST_S)[:, None] * driven
    with np.errstate(invalid="ignore"):
        ahead = (goals - q) / stroke
    up, down = lasts * (ahead > _BESIDE), lasts * (ahead < -_BESIDE)
    found: dict[int, tuple[float, float]] = {}
    rows = slice(0, 0)
    for j in range(q.shape[1]):
        begins = np.append(0, np.flatnonzero(np.diff(q[:, j])) + 1)
        ends = np.append(begins[1:], len(t)) - 1
        asked = np.minimum(np.add.reduceat(up[:, j], begins), np.add.reduceat(down[:, j], begins))
        mine = goals[driven[:, j], j]
        if len(begins) == 1 and len(mine) and np.ptp(mine) > _MOVES * stroke[j]:
            asked = np.maximum(up[:, j].sum(), down[:, j].sum())[None]
        still = np.where(asked >= _LEAST_S, t[ends] - t[begins], 0.0)
        longest = int(np.argmax(still))
        if still[longest] > 0:
            if still[longest] > t[rows.stop - 1] - t[rows.start] or not found:
                rows = slice(begins[longest], ends[longest] + 1)
            found[j] = float(t[begins[longest]]), float(t[ends[longest]])
    if found:  # joints that are as still in the same messages, though asked in one direction only
        asked_way = np.ptp(np.where(driven[rows], goals[rows], goals[rows.start]), axis=0)
        alike = (np.ptp(q[rows], axis=0) == 0) & (asked_way > _MOVES * stroke)
        span = float(t[rows.start]), float(t[rows.stop - 1])
        found |= {j: span for j in np.flatnonzero(alike).tolist() if j not in found}
    return found
