"""What the limits of a hand's joints say of numbers: whose they can be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Track
from dexkit.hand import Floats, Side
from dexkit.models import HandModel
from dexkit.traces.sessions.model import models_by_joints
from dexkit.traces.sessions.streams import HAND

__all__ = ["Reach", "misplaced", "order_by_limits", "other_side_by_limits", "reach_of", "rows_of"]

_OUT = 0.2  # of the frames, out of the limits of the joint: no end stop, no spike
_MARGIN = 0.12  # strokes beyond a limit, which hands and their clients reach
_FIT = 0.98  # of the frames that are within the limits of the right joint


class Reach:
    """Where the joints of a hand can be.

    :param low: lowest positions, shape (joints,); ``high`` likewise.
    :param margin: how far beyond them the numbers of a good hand may lie, shape (joints,).
    """

    def __init__(self, model: HandModel, side: Side) -> None:
        specs = model.joints[side]
        self.low = np.array([j.q_min for j in specs])
        self.high = np.array([j.q_max for j in specs])
        self.margin = np.maximum(_MARGIN * (self.high - self.low), 1.2 * model.limit_margin)

    def holds(self, rows: Floats) -> bool:
        """Whether all rows are within it; quicker than :meth:`outside`."""
        return not len(rows) or bool(
            (rows.min(axis=0) >= self.low - self.margin).all()
            and (rows.max(axis=0) <= self.high + self.margin).all()
        )

    def outside(self, rows: Floats) -> Floats:
        """Share of the frames in which each joint is outside, shape (joints,)."""
        out = (rows < self.low - self.margin) | (rows > self.high + self.margin)
        return np.asarray(out.mean(axis=0))


def reach_of(track: Track, *, other: bool = False) -> Reach | None:
    """The reach of a hand, or of the hand of the ``other`` side; of one whose model is not known
    by the number of its joints, if that is of one model alone.
    """
    name = track.part.removesuffix(HAND)
    if name == track.part or name not in (Side.LEFT.value, Side.RIGHT.value):
        return None
    model = track.model
    if model is None:
        fitting = models_by_joints(len(track.joints)) if len(track.joints) > 1 else []
        if len(fitting) != 1:
            return None
        model = fitting[0]
    side = Side(name)
    return Reach(model, (Side.RIGHT if side is Side.LEFT else Side.LEFT) if other else side)


def rows_of(values: Floats | None) -> Floats:
    """The frames that have a value."""
    if values is None:
        return np.zeros((0, 1))
    whole = np.isfinite(values.sum(axis=1))
    return values if whole.all() else values[whole]


def misplaced(track: Track, rows: Floats) -> bool:
    """Whether values that are outside the limits of their joints are within those of others: of
    the other side, or in another order.
    """
    return other_side_by_limits(track, rows) or order_by_limits(track, rows) is not None


def other_side_by_limits(track: Track, rows: Floats) -> bool:
    """Whether a hand's values lie where only the other hand can be."""
    own = reach_of(track)
    if own is None or own.holds(rows):
        return False
    other = reach_of(track, other=True)
    return (
        other is not None
        and bool(own.outside(rows).max() > _OUT)
        and bool(other.outside(rows).max() <= 1 - _FIT)
    )


def order_by_limits(track: Track, rows: Floats) -> list[int] | None:
    """Joints whose values are out of their own limits, if another order brings all within."""
    own = reach_of(track)
    if own is None or rows.shape[1] < 2 or own.holds(rows):
        return None
    if own.outside(rows).max() <= _OUT:
        return None
    least, most = np.quantile(rows, [0.01, 0.99], axis=0)
    low, high = own.low - own.margin, own.high + own.margin
    fits = (least[:, None] >= low) & (most[:, None] <= high)
    places = _matching(fits)
    return None if places is None else [j for j, k in enumerate(places) if j != k]


def _matching(fits: NDArray[np.bool_]) -> Sequence[int] | None:
    """A place for each column, by augmenting paths; as many as can stay where they are."""
    count = len(fits)
    place_of = [j if fits[j, j] else -1 for j in range(count)]
    held_by = list(place_of)

    def seat(j: int, seen: set[int]) -> bool:
        for k in np.flatnonzero(fits[j]).tolist():
            if k not in seen:
                seen.add(k)
                if held_by[k] < 0 or seat(held_by[k], seen):
                    place_of[j], held_by[k] = k, j
                    return True
        return False

    for j in range(count):
        if place_of[j] < 0 and not seat(j, set()):
            return None
    return place_of
