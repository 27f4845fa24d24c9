"""Values are new, and neither freeze nor go back and forth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dexkit.conformance.checks import Context, Late, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.timing import Positions, encoder_step
from dexkit.conformance.kit.median import median, percentile
from dexkit.conformance.kit.provenance import TIMES
from dexkit.hand import Floats

_EXPLAINED = 1.5
"""Steps of a coarse encoder for which a joint may seem to stand still."""


_STEPS = 2.0  # usual times between states that the last state of a position counts for at most


_IN_A_ROW = 5  # held positions, whose median ignores one outlier
_OLDER = 1.3  # times the usual age of values from which one is another


@check("DEX1-FRESH-02", "DEX3-FRESH-02", rests_on=(TIMES,))
def not_frozen(ctx: Context) -> Outcome:
    """The longest interval of equal positions that ends in an impossible jump."""
    # the first second suffices for a hand that moves in it
    if not any(len(np.unique(c)) > 3 for q in (ctx.states.q[:500], ctx.states.q) for c in q.T):
        return ctx.skipped("the hand does not move in this recording")
    never = ctx.passed("0 ms", "no position was held and then jumped", frozen_s=0.0)
    return judged(ctx, _frozen(ctx), "frozen_s", "max_frozen_s", nothing=never)


def _frozen(ctx: Context) -> Iterator[Figure]:
    """The longest interval of equal positions of each joint that ends in an impossible jump."""
    for joint in range(len(ctx.joints)):
        course = Positions.from_context(ctx, joint)
        t, q, changes = course.t, course.q, course.changes
        if len(changes) < 2:
            continue
        jump = np.abs(course.steps)
        least = ctx.tolerance("min_jump_stroke", joint)
        if not course.held(ctx.tolerance("min_samples"), jump >= least):
            continue
        # before the first command a hand may rest for any time
        first = np.inf if not len(ctx.commands) else max(float(t[0]), float(ctx.commands.t[0]))
        changes = np.concatenate(([0], changes))
        # count published states: a gap in the state is judged by RATE-03
        sent = np.diff(changes)
        begin, end = t[changes[:-1]], t[changes[1:] - 1]
        begin[0] = min(first, end[0])
        usual = 2 * percentile(jump, 99)  # with rare measurements every change is a jump
        at_once = t[changes[1:]] - t[changes[1:] - 1] < 0.05
        frozen = (jump >= max(least, usual)) & at_once
        frozen &= sent >= ctx.tolerance("min_samples")
        held = np.zeros(len(begin))
        for i in np.flatnonzero(frozen):
            # a fast hand may be far away at the next measurement
            if jump[i] <= _speed_after(t, q, int(changes[i + 1])) * ctx.tolerance("max_age_s"):
                continue
            from_q, to_q = q[changes[i : i + 2]].tolist()
            begin[i] = _at_rest_until(ctx, joint, from_q, to_q, begin[i], end[i])
            held[i] = end[i] - begin[i]
        i = int(np.argmax(held))
        if held[i] > 0.0:
            at, count = float(begin[i]), int(((t >= begin[i]) & (t <= end[i])).sum())
            text = (
                f"{count} states in a row with q = {q[changes[i]]:.3f} {ctx.unit} over "
                f"{held[i]:.2f} s, and then a jump of {jump[i]:.2f} {ctx.unit}"
            )
            yield Figure(float(held[i]), at, at + float(held[i]), joint, text)


def _speed_after(t: Floats, q: Floats, row: int) -> float:
    """Speed of q within 30 ms from a row on, rad/s."""
    last = min(int(np.searchsorted(t, t[row] + 0.03)), len(t) - 1)
    span = float(t[last] - t[row])
    return abs(float(q[last] - q[row])) / span if span > 0.0 else 0.0


def _at_rest_until(
    ctx: Context, joint: int, q: float, to_q: float, begin: float, end: float
) -> float:
    """The last time in [begin, end] at which no command asked for a motion from q towards to_q.

    A hand at rest at its commanded position, or held by an object on the other side of it,
    correctly repeats that position. ``begin`` if no command is known.
    """
    t, commanded = ctx.commands.t, ctx.commands.q[:, joint]
    known = np.isfinite(commanded)
    t, commanded = t[known], commanded[known]
    first, last = np.searchsorted(t, [begin, end], side="right")
    first = max(int(first) - 1, 0)  # the command in force at begin
    way = (commanded[first:last] - q) * np.sign(to_q - q)
    elsewhere = way > ctx.tolerance("min_jump_stroke", joint)
    if not len(elsewhere):
        return begin
    if not elsewhere[-1]:
        return end
    there = np.flatnonzero(~elsewhere)
    return max(begin, float(t[first + there[-1] + 1])) if len(there) else begin


def _medians(rows: Floats) -> Floats:
    """The median of each row; for the usual rows of five by comparing columns."""
    if rows.shape[1] != 5:
        return np.asarray(np.median(rows, axis=1))
    a, b, c, d, e = rows.T
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    # the least and the greatest of the four are out; of low, high and e the middle one is it
    return np.asarray(np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e)))


@check("DEX1-FRESH-01", "DEX3-FRESH-01", rests_on=(TIMES,))
@worst("hold_s", "max_hold_s", nothing="the hand does not move in this recording")
def fresh(ctx: Context) -> Figures:
    """Time without a new position while the hand moves."""
    for joint in range(len(ctx.joints)):
        yield from _fresh(ctx, joint)


def _fresh(ctx: Context, joint: int) -> Iterator[Figure]:
    course = Positions.from_context(ctx, joint)
    t, q, changes, size = course.t, course.q, course.changes, course.steps
    if len(changes) < 3:
        return
    least = ctx.tolerance("min_change_stroke", joint)
    # the joint has moved by less than one step of a coarse encoder meanwhile: no value is old
    explained = 0.0
    if not course.is_finer_than(least / _EXPLAINED):
        explained = _EXPLAINED * encoder_step(ctx, joint)
    big = np.abs(size) >= max(least, explained)
    # a value repeated between two large changes in one direction was old
    moving = np.flatnonzero(big[1:] & big[:-1])
    moving = moving[np.sign(size[moving + 1]) == np.sign(size[moving])]
    # how long states showed it: a time without any state is judged by the rate
    since, until = changes[moving], changes[moving + 1]
    step = np.minimum(t[until] - t[until - 1], _STEPS * median(np.diff(t)))
    holds = t[until - 1] - t[since] + step
    if len(holds) < ctx.tolerance("min_intervals"):
        if float(np.ptp(q)) >= least:
            # only small changes: the values are fresher than required
            quickest = median(np.diff(t[changes]))
            text = "changes from sample to sample"
            yield Figure(quickest, joint=joint, text=text, shown=f"{quickest * 1e3:.1f} ms")
        return
    # the median of a few in a row, so that a hand whose values become old later is found
    count = min(_IN_A_ROW, len(holds))
    starts = t[changes[moving]]
    rows = sliding_window_view(holds, count)
    near = starts[count - 1 :] - starts[: len(rows)] <= ctx.tolerance("window_s")
    medians = np.where(near, _medians(rows), median(holds))
    i = int(np.argmax(medians))
    hold, usual = float(medians[i]), median(holds)
    begin, end = float(starts[i]), float(starts[i + count - 1] + holds[i + count - 1])
    met = f"a new value every {usual * 1e3:.1f} ms while moving (median of {len(holds)})"
    worse = hold > _OLDER * usual
    text = f"{met}, but every {hold * 1e3:.0f} ms from {begin:.2f} s on" if worse else met
    limit = ctx.tolerance("max_hold_s")
    late = Late((max(hold - limit, 0.0),), "mean")
    shown = f"{usual * 1e3:.1f} ms" if hold <= limit else f"{hold * 1e3:.0f} ms"
    yield Figure(hold, begin, end, joint, text, met, shown=shown, late=late)
