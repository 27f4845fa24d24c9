"""Check dq against q from one state to the next, and at rest.

:mod:`~dexkit.conformance.checks.consistency` compares integrals in windows with motion. It misses a
dq that alternates between twice the speed and 0, and one that is stuck while the joint stands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import FOUGHT_OVER, filled
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.row_selection import Rows, Selected, Times
from dexkit.hand import Floats
from dexkit.unseen import UNSEEN_S

__all__: list[str] = []

T = TypeVar("T")

_FEW = 10
"""Fewest states for a verdict."""
_CALMS_S = 0.2
"""Seconds for which a hand may still oscillate after contradictory commands."""


def _series(ctx: Context, joint: int) -> tuple[Floats, Floats, Floats]:
    """Times, q and dq of a joint where both are numbers."""
    states = ctx.states
    good = ctx.known_states(joint, "q", "dq")
    return states.clock[good], states.q[good, joint], states.dq[good, joint]


def _outside(ctx: Context, t: Floats) -> Selected:
    """Rows whose times are in no phase of bad or contradictory commands, nor right after one."""
    spans = [ctx.span(p) for name in (*FOUGHT_OVER, "foreign") for p in ctx.phases(name)]
    if not spans:
        return slice(None)
    kept = np.ones(len(t), dtype=np.bool_)
    for begin, end in spans:
        kept &= (t < begin) | (t > end + _CALMS_S)
    return kept


def _by_times(ctx: Context, name: str, t: Floats, work_out: Callable[[], T]) -> T:
    """What depends on times alone is worked out once: they are nearly always those of all joints.

    :param name: with all that it depends on beside the times.
    """
    if len(t) < len(ctx.states):
        return work_out()
    return ctx.once((name, ctx.requirement.id), work_out)


def _cells(t: Floats, cell: float) -> Rows:
    """The number of the cell in which each time but the first lies."""
    return np.asarray(np.maximum(((t[1:] - t[0]) / cell).astype(np.intp), 0))


def _rows_from(t: Floats, times: Floats) -> Rows:
    """The first row that is not before each of some times."""
    return np.asarray(np.searchsorted(t, times))


@check("DEX1-FIELD-22", "DEX3-FIELD-21", rests_on=("dq",))
def velocity_filled(ctx: Context) -> Outcome:
    """Whether dq of a joint stays 0 while q moves, in a hand that fills it elsewhere."""
    if not filled(ctx):
        return ctx.absent("dq is not filled (0 throughout)")
    moved = 0
    for joint in range(len(ctx.joints)):
        t, q, dq = _series(ctx, joint)
        least = ctx.tolerance("min_way_stroke", joint)
        if len(q) < _FEW or float(np.ptp(q)) < least:
            continue
        moved += 1
        for first, last in _zeros(t, dq):
            if float(np.ptp(q[first:last])) >= least:
                begin, end = float(t[first]), float(t[last - 1])
                text = ctx.named(
                    f"dq is 0 from {begin:.1f} to {end:.1f} s, although q moves", joint
                )
                return ctx.failed("0", text, ctx.at(ctx.states.topic, begin, end)).about(joint)
    if not moved:
        return ctx.skipped("no joint moves in this recording")
    return ctx.passed("filled", "dq is not 0 throughout in any joint that moves")


def _zeros(t: Floats, dq: Floats) -> Iterator[tuple[int, int]]:
    """First row, and the one after the last, of each stretch in which dq is 0, without a pause of
    the state.
    """
    zero = dq == 0.0
    ends = np.flatnonzero(np.diff(zero) | (np.diff(t) > UNSEEN_S)) + 1
    edges = [0, *ends.tolist(), len(t)]
    return ((a, b) for a, b in pairwise(edges) if zero[a])


@check("DEX1-FIELD-19", "DEX3-FIELD-18", rests_on=("dq",))
@worst("turns", "max_turns", nothing="too few states with a velocity")
def one_course(ctx: Context) -> Figures:
    """Number of cells in which dq alternates by the speed itself, in the worst window."""
    if not filled(ctx):
        yield ctx.absent("dq is not filled (0 throughout)")
    cell = ctx.tolerance("cell_s")
    count = round(ctx.tolerance("window_s") / cell)
    window = count * cell
    for joint in range(len(ctx.joints)):
        t, q, dq = _series(ctx, joint)
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW:
            continue
        cells = _by_times(ctx, "cells", t, partial(_cells, t, cell))
        most = max(count, int(cells.max()) + 1)
        change = np.diff(dq)
        up, down = (
            np.bincount(cells, weights=np.maximum(part, 0.0), minlength=most)
            for part in (change, -change)
        )
        speed = np.bincount(cells, weights=np.abs(np.diff(q)), minlength=most) / cell
        back = np.minimum(up, down)
        moves = speed >= ctx.tolerance("min_speed_stroke", joint)
        odd = moves & (back > ctx.tolerance("max_part") * speed)
        often = np.convolve(odd, np.ones(count), "valid")
        i = int(np.argmax(often))
        turns, at = int(often[i]), float(t[0]) + i * cell
        text = (
            f"in the worst {window:.2g} s of motion dq goes forth and back within {cell:g} s "
            f"{turns} times by more than the speed, by up to {back[i : i + count].max():.2f} "
            f"{ctx.unit}/s"
        )
        yield Figure(turns, at, at + window, joint, text, shown=f"{turns} times")


@check("DEX1-FIELD-20", "DEX3-FIELD-19", rests_on=("dq",))
@worst("dq_rad_s", "max_speed_stroke", nothing="no joint rests in this recording")
def at_rest(ctx: Context) -> Figures:
    """The largest mean of dq of a joint at rest.

    If q is measured every 50 ms, it stands that long when the next motion begins, and dq may
    already show the motion: the end of a rest is left out.
    """
    if not filled(ctx):
        yield ctx.absent("dq is not filled (0 throughout)")
    cell = ctx.tolerance("cell_s")
    count = round(ctx.tolerance("min_rest_s") / cell)
    for joint in range(len(ctx.joints)):
        t, q, dq = _series(ctx, joint)
        # where two clients alternate as fast as the states come, all of them show one of the two
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW or float(t[-1] - t[0]) < 2 * count * cell:
            continue
        edges: Floats = np.asarray(np.arange(float(t[0]), float(t[-1]), cell))
        rows = _by_times(ctx, "edges", t, partial(_rows_from, t, edges))
        full = np.diff(rows) >= ctx.tolerance("min_states")
        if not full.any():
            continue
        q, dq = q[: rows[-1]], dq[: rows[-1]]
        # an end may be one past the last row; where a cell is empty, the next row stands for it
        first = np.minimum(rows[:-1], len(q) - 1)
        low, high = np.minimum.reduceat(q, first), np.maximum.reduceat(q, first)
        total, states = np.add.reduceat(dq, first), np.diff(rows)
        if len(low) <= count:
            continue
        lows, highs, fulls, totals, counts = (
            sliding_window_view(x, count + 1) for x in (low, high, full, total, states)
        )
        rest = fulls.all(axis=1)
        rest &= highs.max(axis=1) - lows.min(axis=1) <= ctx.tolerance("max_ripple_stroke", joint)
        if not rest.any():
            continue
        # without the first cell, in which it may come to rest, and the last, in which it may begin
        # to move; a tremor in the play of a gear has zero mean. Each state counts once: a cell with
        # a pause of the states has few
        mean = totals[:, 1:-1].sum(axis=1) / np.maximum(counts[:, 1:-1].sum(axis=1), 1)
        speeds = np.where(rest, np.abs(mean), 0.0)
        i = int(np.argmax(speeds))
        at = float(edges[i + count - 1])
        text = f"at {at:.2f} s dq is {speeds[i]:.3f} {ctx.unit}/s while q stands"
        shown = f"{speeds[i]:.3f} {ctx.unit}/s"
        begin = at - (count - 2) * cell
        yield Figure(float(speeds[i]), begin, at + cell, joint, text, shown=shown)


_NEWEST = 3
"""A state may show the newest command or one of the two before it."""
_SAME = 1e-6
"""Part of the range within which two numbers of single precision are the same."""


def _sent_until(sent: Floats, t: Floats) -> Rows:
    """How many commands were sent until each time."""
    return np.asarray(np.searchsorted(sent, t, "right"))


def _equal(q: Floats, goals: Floats, sent: Rows, most: float) -> Rows:
    """The states whose q is that of one of the newest commands.

    :param sent: how many commands were sent until each state.
    :param most: by how much they may differ, rad.
    """
    padded = np.concatenate((np.full(_NEWEST, np.nan), goals))
    recent = sliding_window_view(padded, _NEWEST)  # a row for each number of commands
    # few states lie between the least and the greatest of them
    low, high = np.fmin.reduce(recent.T) - 2 * most, np.fmax.reduce(recent.T) + 2 * most
    likely = np.flatnonzero((q >= low.take(sent)) & (q <= high.take(sent)))
    off = np.abs(q[likely, None] - recent[sent[likely]])
    return np.asarray(likely[(off <= most).any(axis=1)])


def _runs(rows: Rows) -> tuple[Rows, Rows]:
    """The first row of each run of rows that follow each other, and the one after its last."""
    if not len(rows):
        return rows, rows
    behind = np.flatnonzero(np.diff(rows) != 1) + 1
    return rows[np.append(0, behind)], rows[np.append(behind, 0) - 1] + 1


@check("DEX1-FIELD-21", "DEX3-FIELD-20", rests_on=("dq",))
def not_the_command(ctx: Context) -> Outcome:
    """The farthest way that dq shows while q is exactly the commanded q.

    A measurement is that for a moment only, while the joint moves.
    """
    if not filled(ctx):
        return ctx.absent("dq is not filled (0 throughout)")
    if len(ctx.commands) < 2:
        return ctx.skipped("no commands to this hand")
    never = ctx.passed("never", "q is nowhere exactly the commanded q for long")
    return judged(ctx, _commanded(ctx), "motion_rad", "max_way_stroke", nothing=never)


def _commanded(ctx: Context) -> Figures:
    """The ways that dq shows while q is that of a command."""
    commands = ctx.commands
    for joint, spec in enumerate(ctx.joints):
        t, q, dq = _series(ctx, joint)
        if len(t) < _FEW:
            continue
        goals = np.clip(commands.q[:, joint], spec.q_min, spec.q_max)
        sent = _by_times(ctx, "sent", t, partial(_sent_until, commands.t, t))
        with np.errstate(invalid="ignore"):
            same = _equal(q, goals, sent, _SAME * spec.stroke)
        firsts, lasts = _runs(same)
        if ctx.once("clock", lambda: Times(ctx.states.clock)).rising:
            # most are over before that
            long = t[lasts - 2] >= t[firsts] + ctx.tolerance("settle_s")
            firsts, lasts = firsts[long], lasts[long]
        for start, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
            # dq may still be that of the motion which has led there
            begin = int(np.searchsorted(t, t[start] + ctx.tolerance("settle_s")))
            if last - begin >= 2:
                run = slice(begin, last)
                for way, a, b in _other_ways(ctx, t[run], q[run], dq[run]):
                    text = f"q is exactly the commanded q while dq shows {way:.3f} {ctx.unit} of "
                    yield Figure(way, a, b, joint, f"{text}another way")


def _other_ways(
    ctx: Context, t: Floats, q: Floats, dq: Floats
) -> Iterator[tuple[float, float, float]]:
    """By how much dq shows another way than q in each window of a stretch, and the window."""
    beyond = _integral(t, dq) - (q - q[0])
    window = ctx.tolerance("window_s")
    for at in np.arange(float(t[0]), float(t[-1]), window).tolist():
        piece = beyond[slice(*np.searchsorted(t, (at, at + window)))]
        yield float(np.ptp(piece)) if len(piece) else 0.0, at, at + window


def _integral(t: Floats, x: Floats) -> Floats:
    """The integral of x up to each time."""
    return np.concatenate(([0.0], np.cumsum(0.5 * np.diff(t) * (x[:-1] + x[1:]))))
