"""Compute how a hand follows its goal: stroke time, reaction, lag, overshoot and error.

- *stroke*: seconds from 5 to 95 % of the whole stroke, from steps over two fifths of it or more;
  of a step that goes less far, what the whole would take at the same mean speed.
- *reaction*: seconds from a step until the hand has moved by 2 % of the stroke.
- *overshoot*: how far it goes past the end of a step, rad.
- *stuck*: how far from the wanted place it rests, rad. Xr_teleoperate's filter alone leaves some
  (docs/sources/unitree-dex.md#b7); friction under a weak kp adds to it.
- *lag*: seconds by which the hand follows a steadily moving operator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats
from dexkit.unseen import UNSEEN_S

__all__ = ["FROM", "TO", "Step", "TrackingFigures", "steps_of", "tracking_figures"]

FROM, TO = 0.05, 0.95
"""Parts of a stroke between which its time is taken."""
GRID = 0.002
"""Seconds between the points at which hand and operator are compared."""
_JUMP = 0.15  # of the stroke, from one point to the next: a step
_LONG = 0.4  # of the stroke: a step long enough to time
_MOVED = 0.02  # of the stroke
_REST = 0.1  # seconds at the end of a step in which a hand at rest is looked at
_SETTLE = 0.6  # seconds that a step must be held before it is looked at
_AT_REST = 0.01  # of the stroke: movement of a hand that rests
_STEADY = 10.0  # strokes a second: an operator who is faster has jumped
_SEARCH = 0.6  # seconds of lag looked for
_FOLLOWS = 0.3  # part of the operator's way that a hand goes that follows, however late
_LAG_LEAST = 1.0  # seconds of steady motion needed for it


@dataclass(frozen=True)
class Step:
    """One step of the operator, and the joint's response.

    :param at: seconds.
    :param begin: where the joint was, rad.
    :param goal: where it was wanted, rad.
    :param stroke_s: seconds from 5 to 95 % of the whole stroke at the speed of this step;
        infinite if it hardly moved, NaN for a short step, or if no state shows when it arrived.
    :param reaction_s: seconds; NaN if it did not move, or if no state shows where it was at the
        step or when it began to move.
    :param overshoot: rad; NaN if it did not arrive.
    :param stuck: rad from the goal at rest; NaN if it did not come to rest.
    :param reached: whether it got to 95 % of the step.
    """

    at: float
    end: float
    begin: float
    goal: float
    stroke_s: float
    reaction_s: float
    overshoot: float
    stuck: float
    reached: bool


@dataclass(frozen=True)
class TrackingFigures:
    """The figures of one joint: the worst of its steps. NaN where there was no occasion.

    :param stroke_s: the slowest stroke, seconds; ``stroke_mean_s`` the mean of all.
    :param lag_s: seconds, infinite where it does not follow a slow operator; ``lag_rms`` is what
        remains when it is removed, rad.
    """

    stroke_s: float = math.nan
    stroke_mean_s: float = math.nan
    reaction_s: float = math.nan
    overshoot: float = math.nan
    stuck: float = math.nan
    lag_s: float = math.nan
    lag_rms: float = math.nan
    steps: tuple[Step, ...] = ()

    def figures(self) -> dict[str, float]:
        """Those that are known, by name."""
        found = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "steps"}
        return {name: float(v) for name, v in found.items() if not math.isnan(v)}


def tracking_figures(
    t: Floats,
    q: Floats,
    wanted: Callable[[float], float | None],
    stroke: float,
    *,
    begin: float | None = None,
    end: float | None = None,
) -> TrackingFigures:
    """The figures of one joint.

    :param t: seconds of each state, ascending, shape (n,).
    :param q: the joint's position, rad, shape (n,).
    :param wanted: where the operator wanted it at a time, rad; None while he did not.
    :param stroke: the joint's whole range, rad.
    :param begin: look from here on; None for the first state. Likewise ``end``.
    """
    good = np.isfinite(q)
    t, q = t[good], q[good]
    if len(t) < 2:
        return TrackingFigures()
    first = float(t[0]) if begin is None else max(begin, float(t[0]))
    last = float(t[-1]) if end is None else min(end, float(t[-1]))
    grid: Floats = np.asarray(np.arange(first, last, GRID))
    if len(grid) < 2:
        return TrackingFigures()
    goal: Floats = np.array([math.nan if (x := wanted(float(g))) is None else x for g in grid])
    newest = np.searchsorted(t, grid, "right") - 1
    position: Floats = q[newest]
    steps = steps_of(grid, position, goal, stroke, grid - t[newest])
    strokes = [s.stroke_s for s in steps if not math.isnan(s.stroke_s)]
    lag, rms = _lag(grid, position, goal, stroke)
    return TrackingFigures(
        stroke_s=max(strokes, default=math.nan),
        stroke_mean_s=sum(strokes) / len(strokes) if strokes else math.nan,
        reaction_s=_maximum([s.reaction_s for s in steps]),
        overshoot=_maximum([s.overshoot for s in steps]),
        stuck=_maximum([s.stuck for s in steps]),
        lag_s=lag,
        lag_rms=rms,
        steps=tuple(steps),
    )


def _maximum(values: Sequence[float]) -> float:
    return max((v for v in values if not math.isnan(v)), default=math.nan)


def steps_of(
    grid: Floats, position: Floats, goal: Floats, stroke: float, ages: Floats
) -> list[Step]:
    """The operator's jumps, and the joint's response to each until the operator moves again.

    :param ages: of the state that shows each position, seconds.
    """
    jumps = np.flatnonzero(np.abs(np.diff(goal)) > _JUMP * stroke) + 1
    # a first target where there was none is a step as well
    appears = np.flatnonzero(np.isnan(goal[:-1]) & ~np.isnan(goal[1:])) + 1
    moves = np.flatnonzero(~(np.abs(np.diff(goal)) < 1e-9)) + 1
    found = []
    for at in sorted({*jumps.tolist(), *appears.tolist()}):
        later = moves[moves > at]
        end = int(later[0]) if len(later) else len(goal)
        if (end - at) * GRID >= 0.1 and not np.isnan(goal[at]):
            span = slice(at, end)
            found.append(_step(grid[span], position[span], float(goal[at]), stroke, ages[span]))
    return found


def _step(t: Floats, q: Floats, goal: float, stroke: float, ages: Floats) -> Step:
    begin = float(q[0])
    travel = goal - begin
    nothing = math.nan
    if abs(travel) < _MOVED * stroke:
        return Step(
            float(t[0]), float(t[-1]), begin, goal, nothing, nothing, nothing, nothing, True
        )
    progress = (q - begin) / travel
    # a joint that is still on its way to the goal before turns around first
    back = np.minimum.accumulate(progress)
    turns = back.min() * abs(travel) <= -_MOVED * stroke
    moved = _first((progress - back if turns else progress) * abs(travel) >= _MOVED * stroke)
    started = _first(progress >= FROM)
    arrived = _first(progress >= TO)
    whole = TO - FROM
    stroke_s = nothing
    unseen = arrived is not None and ages[max(arrived - 1, 0)] > UNSEEN_S
    if abs(travel) >= _LONG * stroke and not unseen:
        if arrived is not None and started is not None:
            part, seconds = progress[arrived] - progress[started], t[arrived] - t[started]
        elif started is not None:  # not there when the operator moved on: as fast as it went
            part, seconds = progress.max() - progress[started], t[-1] - t[started]
        else:
            part, seconds = 0.0, t[-1] - t[0]
        speed = part * abs(travel) / max(seconds, GRID)
        stroke_s = whole * stroke / speed if speed > 1e-6 * stroke else math.inf
    reached = arrived is not None
    reaction = nothing
    if moved is not None and max(ages[0], ages[max(moved - 1, 0)]) <= UNSEEN_S:
        reaction = float(t[moved] - t[0])
    overshoot = nothing
    if reached:
        overshoot = max(0.0, float((progress[arrived:].max() - 1.0) * abs(travel)))
    stuck = nothing
    tail = q[t >= t[-1] - _REST]
    if t[-1] - t[0] >= _SETTLE and float(np.ptp(tail)) <= _AT_REST * stroke:
        stuck = abs(float(np.median(tail)) - goal)
    return Step(
        at=float(t[0]),
        end=float(t[-1]),
        begin=begin,
        goal=goal,
        stroke_s=float(stroke_s),
        reaction_s=reaction,
        overshoot=overshoot,
        stuck=stuck,
        reached=reached,
    )


def _first(where: NDArray[np.bool_]) -> int | None:
    found = np.flatnonzero(where)
    return int(found[0]) if len(found) else None


def _lag(grid: Floats, position: Floats, goal: Floats, stroke: float) -> tuple[float, float]:
    """(seconds, rad RMS left) where the operator moves without jumps for long enough."""
    back = round(_SEARCH / GRID)
    change = np.abs(np.diff(goal, prepend=goal[:1]))
    jumps = ~(change <= _STEADY * GRID * stroke)
    moves = change > 1e-6 * stroke
    # only what depends on a steady motion whatever the lag is: its past, as far back as the search
    use = np.flatnonzero(~_any_of_last(jumps, back) & _any_of_last(moves, back))
    use = use[use >= back]
    if len(use) * GRID < _LAG_LEAST:
        return math.nan, math.nan
    if float(np.ptp(position[use])) < _FOLLOWS * float(np.ptp(goal[use])):
        return math.inf, math.nan  # it does not follow at all
    best, least = (math.nan, math.inf), math.inf
    there = position[use]
    for shift in range(back + 1):
        away = there - goal[use - shift]
        if float(away @ away) > least * (1.0 + 1e-9):
            continue  # far beyond what rounding changes
        # exact, so that it is the same with every NumPy
        squares = math.fsum((away**2).tolist())
        rms = math.sqrt(squares / len(use))
        if rms < best[1]:
            best, least = (shift * GRID, rms), squares
    return best


def _any_of_last(where: NDArray[np.bool_], points: int) -> NDArray[np.bool_]:
    """Whether it was so at any of the last points, this one included."""
    count = np.concatenate(([0], np.cumsum(where)))
    at = np.arange(1, len(count))
    return np.asarray(count[at] > count[np.maximum(at - points - 1, 0)])
