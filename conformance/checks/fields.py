"""Check the values of the fields in each state."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance import sums
from dexkit.conformance.checks import Context, Outcome, causes, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.plots import Plot, PlotKind
from dexkit.conformance.provenance import TIMES
from dexkit.conformance.recording import joints_of
from dexkit.conformance.row_selection import Times
from dexkit.hand import Floats

Windows: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp], Floats]

_STAND_S = 0.1  # seconds without motion after which a joint counts as standing


@check("DEX1-FIELD-01", "DEX3-FIELD-01", "H1-FIELD-01")
def length(ctx: Context) -> Outcome:
    """Samples decode and have one motor per hand."""
    states, wanted = ctx.states, ctx.recording.dialect.length
    wrong = np.flatnonzero(states.length != wanted)
    if not len(wrong):
        return ctx.passed(str(wanted), f"{len(states)} samples, each of length {wanted}")
    i = int(wrong[0])
    what = states.errors.get(i) or f"length {states.length[i]}"
    return ctx.failed(
        f"{len(wrong)} of {len(states)}",
        f"{len(wrong)} of {len(states)} samples are wrong; the first: {what}",
        *(ctx.at(states.topic, float(states.t[k])) for k in wrong[:5]),
        wrong=len(wrong),
    )


@check("DEX1-FIELD-02", "DEX3-FIELD-02", "H1-FIELD-02")
def finite(ctx: Context) -> Outcome:
    """No NaN, no infinity."""
    states = ctx.states
    there = states.length >= ctx.recording.dialect.index[ctx.side] + len(ctx.joints)
    if not there.any():
        return ctx.skipped("no sample holds this hand's motor")
    columns = {"q": states.q, "dq": states.dq, "ddq": states.ddq, "tau_est": states.tau}
    good = {name: np.isfinite(column) for name, column in columns.items()}
    bad = {n: np.flatnonzero(there & ~g.all(axis=1)) for n, g in good.items() if not g.all()}
    bad = {name: rows for name, rows in bad.items() if len(rows)}
    if not bad:
        return ctx.passed("all finite", f"{int(there.sum())} samples")
    name, rows = next(iter(bad.items()))
    joint = int(np.argmin(np.isfinite(columns[name][rows[0]])))
    outcome = ctx.failed(
        f"{name} = {columns[name][rows[0], joint]}",
        "; ".join(
            ctx.named(f"{n} is not finite in {len(r)} samples", joint) for n, r in bad.items()
        ),
        *(ctx.at(states.topic, float(states.t[k])) for k in rows[:5]),
    ).about(joint)
    shown = (Plot.of_member(name),) if name != "q" else ()
    return outcome.shown_by(*shown, PlotKind.POSITION)


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


@check("DEX1-FIELD-14", rests_on=(TIMES,))
@worst("speed_rad_s", "max_speed_rad_s", nothing="no state with a position that lasts long enough")
def plausible_speed(ctx: Context) -> Figures:
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


@check(
    "DEX1-FIELD-04",
    "DEX3-FIELD-04",
    rests_on=(
        TIMES,
        "dq",
    ),
)
def velocity(ctx: Context) -> Outcome:
    """Mean of dq over a window against the difference of q over it, in the worst joint."""
    known: dict[bytes, Windows] = {}
    found = [_velocity(ctx, joint, known) for joint in range(len(ctx.joints))]
    judged = [o for o in found if o.met is not None]
    return max(judged, key=lambda o: o.values["relative_rms"]) if judged else found[0]


def _windows(times: Times, window: float) -> Windows:
    """Rows at which windows begin and end, and their lengths in seconds."""
    t = times.t
    ends = times.shifted(window)
    starts = np.flatnonzero(ends < len(t))
    ends = ends[starts]
    span = t[ends] - t[starts]
    keep = (span > 0) & (span < 2 * window) & (ends - starts >= 4)
    return starts[keep], ends[keep], span[keep]


def _velocity(ctx: Context, joint: int, known: dict[bytes, Windows]) -> Outcome:
    states = ctx.states
    q, dq = states.q[:, joint], states.dq[:, joint]
    good = ctx.known_states(joint, "q", "dq")
    t, q, dq = states.clock[good], q[good], dq[good]
    if len(t) < 10 or float(t[-1] - t[0]) <= 0:
        return ctx.skipped("too few states")
    if not (dq[:10].any() or dq.any()):
        return ctx.absent("dq is not filled (0 throughout)")
    window = ctx.tolerance("window_s")
    # the same for all joints, unless some states lack joints
    which = b"" if isinstance(good, slice) else good.tobytes()
    if which not in known:
        every = isinstance(good, slice)
        times = ctx.once("clock", lambda: Times(states.clock)) if every else Times(t)
        known[which] = _windows(times, window)
    starts, ends, span = known[which]
    if not len(starts):
        return ctx.skipped("the states are too far apart to derive a velocity")
    # nearly always all rows up to the last window
    first = slice(len(starts)) if int(starts[-1]) == len(starts) - 1 else starts
    slope = q.take(ends)
    slope -= q[first]
    slope /= span
    moving = np.flatnonzero(np.abs(slope) > 0.5)
    if len(moving) < 50:
        return ctx.skipped("the hand hardly moves in this recording")
    cumulated = np.empty(len(dq))
    cumulated[0] = 0.0
    steps = cumulated[1:]
    np.add(dq[1:], dq[:-1], out=steps)
    steps *= 0.5
    steps *= t[1:] - t[:-1]
    np.cumsum(steps, out=steps)

    def mean(rows: NDArray[np.intp]) -> Floats:
        passed = cumulated.take(ends[rows]) - cumulated.take(starts[rows])
        return np.asarray(passed / span[rows])

    slopes, means = slope[moving], mean(moving)
    size = math.sqrt(sums.mean(slopes**2))
    error = math.sqrt(sums.mean((means - slopes) ** 2)) / size
    text = ctx.named(
        f"dq differs from the slope of q by {error:.0%} of its size ({size:.2f} {ctx.unit}/s RMS)",
        joint,
    )
    if error <= ctx.tolerance("max_relative_rms"):
        return ctx.passed(f"{error:.0%} off", text, relative_rms=error)
    worst = starts[np.argmax(np.abs(mean(np.arange(len(ends))) - slope))]
    turned = sums.mean(means * slopes) < 0
    return (
        ctx.failed(
            f"{error:.0%} off",
            text + ("; its sign is turned" if turned else ""),
            ctx.at(states.topic, float(t[worst]), float(t[worst]) + window),
            relative_rms=error,
        )
        .about(joint)
        .if_late((error - ctx.tolerance("max_relative_rms")) * window, how="mean")
    )
