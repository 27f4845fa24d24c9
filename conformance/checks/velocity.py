"""Check dq against q from one state to the next, and at rest.

The windows of :mod:`~dexkit.conformance.checks.consistency` compare integrals: a dq that is twice
the speed and 0 by turns has the right one, and one that is stuck while the joint stands is in no
window with motion.
"""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import FOUGHT_OVER, filled
from dexkit.conformance.rows import finite_rows
from dexkit.hand import Floats

__all__: list[str] = []

_FEW = 10
"""States that are needed to say anything."""
_CALMS_S = 0.2
"""Seconds that a hand shakes on after contradictory commands: with a late command, and its mass."""


def _series(ctx: Context, joint: int) -> tuple[Floats, Floats, Floats]:
    """Times, q and dq of a joint where both are numbers."""
    states = ctx.states
    good = finite_rows(states.q[:, joint], states.dq[:, joint])
    return states.clock[good], states.q[good, joint], states.dq[good, joint]


def _outside(ctx: Context, t: Floats) -> Floats:
    """Rows whose times are in no phase of bad or contradictory commands, nor right after one."""
    kept = np.ones(len(t), dtype=np.bool_)
    for name in (*FOUGHT_OVER, "foreign"):
        for begin, end in map(ctx.span, ctx.phases(name)):
            kept &= (t < begin) | (t > end + _CALMS_S)
    return np.asarray(kept)


@check("DEX1-FIELD-19", "DEX3-FIELD-18")
def one_course(ctx: Context) -> Outcome:
    """In how many cells of a window dq goes forth and back by the speed itself, in the worst."""
    if not filled(ctx):
        return ctx.absent("dq is not filled (0 throughout)")
    cell = ctx.tolerance("cell_s")
    count = round(ctx.tolerance("window_s") / cell)
    worst: tuple[int, float, int, float] | None = None
    for joint in range(len(ctx.joints)):
        t, q, dq = _series(ctx, joint)
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW:
            continue
        cells = ((t[1:] - t[0]) / cell).astype(np.intp)
        cells = np.maximum(cells, 0)
        most = max(count, int(cells.max()) + 1)
        change = np.diff(dq)
        up, down = (
            np.bincount(cells, weights=np.maximum(way * change, 0.0), minlength=most)
            for way in (1, -1)
        )
        speed = np.bincount(cells, weights=np.abs(np.diff(q)), minlength=most) / cell
        back = np.minimum(up, down)
        moves = speed >= ctx.tolerance("min_speed_stroke", joint)
        odd = moves & (back > ctx.tolerance("max_part") * speed)
        often = np.convolve(odd, np.ones(count), "valid")
        i = int(np.argmax(often))
        found = (int(often[i]), float(back[i : i + count].max()), joint, float(t[0]) + i * cell)
        worst = found if worst is None or found > worst else worst
    if worst is None:
        return ctx.skipped("too few states with a velocity")
    turns, back_rad_s, joint, at = worst
    window = count * cell
    text = ctx.named(
        f"in the worst {window:.2g} s of motion dq goes forth and back within {cell:g} s {turns} "
        f"times by more than the speed, by up to {back_rad_s:.2f} {ctx.unit}/s",
        joint,
    )
    if turns <= ctx.tolerance("max_turns"):
        return ctx.passed(f"{turns} times", text, turns=turns)
    place = ctx.at(ctx.states.topic, at, at + window)
    return ctx.failed(f"{turns} times", text, place, turns=turns).about(joint)


@check("DEX1-FIELD-20", "DEX3-FIELD-19")
def at_rest(ctx: Context) -> Outcome:
    """The largest mean of dq of a joint whose q stands, and goes on to.

    A q that is measured every 50 ms stands for that long when the next motion begins, while dq may
    tell of it.
    """
    if not filled(ctx):
        return ctx.absent("dq is not filled (0 throughout)")
    cell = ctx.tolerance("cell_s")
    count = round(ctx.tolerance("min_rest_s") / cell)
    worst: tuple[float, float, int, float] | None = None
    rests = 0
    for joint, spec in enumerate(ctx.joints):
        t, q, dq = _series(ctx, joint)
        # where two clients alternate as fast as the states come, all of them show one of the two
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW or float(t[-1] - t[0]) < 2 * count * cell:
            continue
        edges = np.arange(float(t[0]), float(t[-1]), cell)
        rows = np.searchsorted(t, edges)
        full = np.diff(rows) >= ctx.tolerance("min_states")
        if not full.any():
            continue
        q, dq = q[: rows[-1]], dq[: rows[-1]]
        # an end may be one past the last row; where a cell is empty, the next row stands for it
        first = np.minimum(rows[:-1], len(q) - 1)
        low, high = np.minimum.reduceat(q, first), np.maximum.reduceat(q, first)
        mean = np.add.reduceat(dq, first) / np.maximum(np.diff(rows), 1)
        if len(low) <= count:
            continue
        lows, highs, fulls, means = (
            np.lib.stride_tricks.sliding_window_view(x, count + 1) for x in (low, high, full, mean)
        )
        rest = fulls.all(axis=1)
        rest &= highs.max(axis=1) - lows.min(axis=1) <= ctx.tolerance("max_ripple_stroke", joint)
        rests += int(rest.sum())
        if not rest.any():
            continue
        # without the first cell, which it may take to stand, and the last, in which it may begin to
        # move; a tremor in the play of a gear has no mean
        last = np.where(rest, np.abs(means[:, 1:-1].mean(axis=1)), 0.0)
        i = int(np.argmax(last))
        found = (float(last[i]) / spec.stroke, float(last[i]), joint, float(edges[i + count - 1]))
        worst = found if worst is None or found > worst else worst
    if worst is None:
        return ctx.skipped("no joint rests in this recording")
    _, speed, joint, at = worst
    limit = ctx.tolerance("max_speed_stroke", joint)
    text = ctx.named(f"dq of {speed:.3f} {ctx.unit}/s at most while q stands", joint)
    if speed <= limit:
        return ctx.passed(f"{speed:.3f} {ctx.unit}/s", text, rests=rests)
    place = ctx.at(ctx.states.topic, at - (count - 2) * cell, at + cell)
    text = ctx.named(f"at {at:.2f} s dq is {speed:.2f} {ctx.unit}/s while q stands", joint)
    return ctx.failed(f"{speed:.2f} {ctx.unit}/s", text, place).about(joint)
