"""q within its limits, without jumps, and measured."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dexkit.conformance.checks import Context, Outcome, causes, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.robot import RobotContext, wrong_rows
from dexkit.conformance.checks.speeds import FEW, by_times, fastest_speed, filled, q_and_dq
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.kit.row_selection import Rows, Times
from dexkit.hand import Floats

_STAND_S = 0.1  # seconds without motion after which a joint counts as standing


@check("DEX1-FIELD-03", "DEX3-FIELD-03")
def in_stroke(ctx: Context) -> Outcome:
    """Smallest and largest q of each joint."""
    states, margin = ctx.states, ctx.tolerance("margin_rad")
    # q during out-of-range commands is judged by SAFE-02, unless it shows another scale
    excused = np.zeros(len(states), dtype=np.bool_)
    for phase in ctx.phases("out-of-range"):
        begin, end = ctx.span(phase)
        back = [ctx.span(p)[1] for p in ctx.phases("recover") if p.begin_ns >= phase.end_ns]
        excused[states.between(begin, min(back, default=end + 0.5))] = True
    widest: tuple[float, Outcome] | None = None
    for joint, spec in enumerate(ctx.joints):
        column = states.q[:, joint]
        q = column[ctx.known_states(joint, "q")]
        if not len(q):
            continue
        low, high = float(q.min()), float(q.max())
        text = ctx.named(
            f"q from {low:.3f} to {high:.3f} {ctx.unit}; the stroke is {spec.q_min:g} to "
            f"{spec.q_max:.3f} {ctx.unit}",
            joint,
        )
        outside = ((column < spec.q_min - margin) | (column > spec.q_max + margin)) & ~excused
        if outside.any():
            i = int(np.argmax(outside))
            return (
                ctx.failed(
                    f"{column[i]:.2f} {ctx.unit}",
                    f"{text}; outside in {int(outside.sum())} samples",
                    ctx.at(states.topic, float(states.t[i])),
                    q_min=low,
                    q_max=high,
                )
                .about(joint)
                .because(
                    causes.of_positions(
                        states.q[~excused],
                        ctx.joints,
                        joints_of(ctx.recording.dialect, ctx.other),
                        ctx.unit,
                    )
                )
            )
        beyond = max(spec.q_min - low, high - spec.q_max)
        if widest is None or beyond > widest[0]:
            within = ctx.passed(f"{low:.2f} .. {high:.2f} {ctx.unit}", text, q_min=low, q_max=high)
            widest = (beyond, within)
    if widest is None:
        return ctx.skipped("no state with a position")
    return _stands_far_off(ctx) or widest[1]


def _stands_far_off(ctx: Context) -> Outcome | None:
    """Fail if an out-of-range command makes a joint stop more than a stroke outside its range.

    No joint has its stop there: such a hand uses another unit for commands and states, of which the
    kit has used only a small part.
    """
    for phase in ctx.phases("out-of-range"):
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        t, positions = ctx.states.t[rows], ctx.states.q[rows]
        for joint, spec in enumerate(ctx.joints):
            q = positions[:, joint]
            far = (q < spec.q_min - spec.stroke) | (q > spec.q_max + spec.stroke)
            for i in np.flatnonzero(far):
                stand = q[i : int(np.searchsorted(t, t[i] + _STAND_S))]
                if len(stand) < 5 or t[-1] < t[i] + _STAND_S:
                    break
                if float(np.ptp(stand)) <= 0.1 * spec.stroke:
                    text = (
                        f"commanded far out of range it came to a stand at q = {q[i]:.1f} "
                        f"{ctx.unit}; "
                        f"the stroke is {spec.q_min:g} to {spec.q_max:.3f} {ctx.unit}"
                    )
                    outcome = ctx.failed(
                        f"{q[i]:.1f} {ctx.unit}",
                        ctx.named(text, joint),
                        ctx.at(ctx.states.topic, float(t[i]), float(t[i]) + _STAND_S),
                        q_stand=float(q[i]),
                    )
                    return outcome.about(joint).because(causes.of_range(float(q[i])))
    return None


@worst("speed_rad_s", "max_speed_rad_s", nothing="no state with a position that lasts long enough")
def _plausible_speed(ctx: Context) -> Figures:
    """The fastest motion of q, relative to the joint's top speed."""
    window = ctx.tolerance("window_s")
    t = ctx.states.clock
    ends = ctx.once("clock", lambda: Times(t)).shifted(window)
    starts = np.flatnonzero(ends < len(t))
    ends = ends[starts]
    near = t[ends] - t[starts] < 2 * window  # a gap in the state is judged by RATE-03
    starts, ends = starts[near], ends[near]
    moves = False
    figures = []
    for joint, spec in enumerate(ctx.joints):
        q = ctx.states.q[:, joint]
        speed = np.abs(q[ends] - q[starts]) / (t[ends] - t[starts])
        if not np.isfinite(speed).any():
            continue
        i = int(np.nanargmax(speed))
        fast, at = float(speed[i]), float(t[starts[i]])
        moves |= fast > 0
        text = (
            f"q moves by up to {fast:.1f} {ctx.unit}/s over {window:g} s: {fast / spec.dq_max:.1f} "
            "times what the joint is good for"
        )
        limit = ctx.tolerance("max_part") * spec.dq_max
        figures.append(Figure(fast, at, at + window, joint, text, limit=limit))
    if figures and not moves:
        yield ctx.skipped("the hand does not move in this recording")
    yield from figures


@check("DEX1-FIELD-15", rests_on=(TIMES,))
def gripper_jumps(ctx: Context) -> Outcome:
    """Jumps of q; and its speed, which shows another unit where every value is within the range."""
    return all_of(jumps(ctx), warning(_plausible_speed(ctx)))


@check("DEX3-FIELD-15", rests_on=(TIMES,))
@worst("change_rad", "max_change_rad", nothing="too few states with a position")
def jumps(ctx: Context) -> Figures:
    """The largest change of q between two states, relative to the speed limit."""
    for joint in range(len(ctx.joints)):
        good = ctx.known_states(joint, "q")
        t, q = ctx.states.clock[good], ctx.states.q[good, joint]
        if len(t) < FEW:
            continue
        speed = fastest_speed(ctx, joint)
        change, gaps = np.abs(np.diff(q)), np.maximum(np.diff(t), 0.0)
        # RATE-03 judges gaps; the motion within a long one is unknown
        near = gaps <= ctx.tolerance("max_gap_s")
        allowed = speed * (gaps + ctx.tolerance("max_hold_s")) + ctx.tolerance("counts_rad")
        i = int(np.argmax(np.where(near, change / allowed, 0.0)))
        far, limit, at = float(change[i]), float(allowed[i]), float(t[i])
        text = (
            f"q changes by at most {far:.3f} {ctx.unit} from one state to the next; at the hand's "
            f"fastest, {speed:.1f} {ctx.unit}/s, it may change by {limit:.2f} {ctx.unit}"
        )
        late = (far - limit) / speed
        yield Figure(far, at - 0.05, at + 0.05, joint, text, limit=limit, late=late)


_FEW = 10
"""Fewest states for a verdict."""


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
        t, q, dq = q_and_dq(ctx, joint)
        if len(t) < _FEW:
            continue
        goals = np.clip(commands.q[:, joint], spec.q_min, spec.q_max)
        sent = by_times(ctx, "sent", t, partial(_sent_until, commands.t, t))
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


@check("H1-FIELD-03")
def within_limits(ctx: RobotContext) -> Outcome:
    """Positions against each joint's limits."""
    low = np.array([j.q_min for j in ctx.joints]) - ctx.tolerance("margin_rad")
    high = np.array([j.q_max for j in ctx.joints]) + ctx.tolerance("margin_rad")
    beyond = np.nan_to_num(np.maximum(low - ctx.states.q, ctx.states.q - high), nan=-1.0)
    if not (beyond > 0).any():
        return ctx.passed("within", f"all {len(ctx.joints)} joints are within their limits")
    row, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    spec = ctx.joints[int(joint)]
    q = float(ctx.states.q[row, joint])
    return wrong_rows(
        ctx,
        (beyond > 0).any(axis=1),
        f"{q:.2f} rad",
        f"{spec.name}: q = {q:.3f} rad; its limits are {spec.q_min:g} and {spec.q_max:g}",
        (int(joint),),
    )
