"""What is in the samples."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check


@check("DEX1-FIELD-01")
def length(ctx: Context) -> Outcome:
    """Samples decode and have one motor a hand."""
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


@check("DEX1-FIELD-02")
def finite(ctx: Context) -> Outcome:
    """No NaN, no infinity."""
    states = ctx.states
    there = states.length > ctx.recording.dialect.index[ctx.side]
    if not there.any():
        return ctx.skipped("no sample holds this hand's motor")
    columns = {"q": states.q, "dq": states.dq, "ddq": states.ddq, "tau_est": states.tau}
    bad = {name: np.flatnonzero(there & ~np.isfinite(c)) for name, c in columns.items()}
    bad = {name: rows for name, rows in bad.items() if len(rows)}
    if not bad:
        return ctx.passed("all finite", f"{int(there.sum())} samples")
    name, rows = next(iter(bad.items()))
    return ctx.failed(
        f"{name} = {columns[name][rows[0]]}",
        "; ".join(f"{n} is not finite in {len(r)} samples" for n, r in bad.items()),
        *(ctx.at(states.topic, float(states.t[k])) for k in rows[:5]),
    )


@check("DEX1-FIELD-03")
def in_stroke(ctx: Context) -> Outcome:
    """Smallest and largest q."""
    states, margin = ctx.states, ctx.tolerance("margin_rad")
    outside = (states.q < -margin) | (states.q > ctx.stroke + margin)
    # what a wild command does to q is DEX1-SAFE-02's finding
    for phase in ctx.phases("out-of-range"):
        begin, end = ctx.span(phase)
        back = [ctx.span(p)[1] for p in ctx.phases("recover") if p.begin_ns >= phase.end_ns]
        outside[states.between(begin, min(back, default=end + 0.5))] = False
    q = states.q[np.isfinite(states.q)]
    low, high = float(q.min()), float(q.max())
    text = f"q from {low:.3f} to {high:.3f} rad; the stroke is 0 to {ctx.stroke:.3f} rad"
    if not outside.any():
        return ctx.passed(f"{low:.2f} .. {high:.2f} rad", text, q_min=low, q_max=high)
    i = int(np.argmax(outside))
    return ctx.failed(
        f"{states.q[i]:.2f} rad",
        f"{text}; outside in {int(outside.sum())} samples",
        ctx.at(states.topic, float(states.t[i])),
        q_min=low,
        q_max=high,
    )


@check("DEX1-FIELD-04")
def velocity(ctx: Context) -> Outcome:
    """Mean of dq over a window against the difference of q over it."""
    states = ctx.states
    good = np.isfinite(states.q) & np.isfinite(states.dq)
    t, q, dq = states.clock[good], states.q[good], states.dq[good]
    if len(t) < 10 or float(t[-1] - t[0]) <= 0:
        return ctx.skipped("too few states")
    if not dq.any():
        return ctx.skipped("dq is not filled (0 throughout)")
    window = ctx.tolerance("window_s")
    ends = np.searchsorted(t, t + window)
    starts = np.flatnonzero(ends < len(t))
    ends = ends[starts]
    span = t[ends] - t[starts]
    keep = (span > 0) & (span < 2 * window) & (ends - starts >= 4)
    starts, ends, span = starts[keep], ends[keep], span[keep]
    if not len(starts):
        return ctx.skipped("the states are too far apart to derive a velocity")
    slope = (q[ends] - q[starts]) / span
    cumulated = np.concatenate(([0.0], np.cumsum((dq[1:] + dq[:-1]) / 2 * np.diff(t))))
    mean = (cumulated[ends] - cumulated[starts]) / span
    moving = np.abs(slope) > 0.5
    if moving.sum() < 50:
        return ctx.skipped("the gripper hardly moves in this recording")
    size = float(np.sqrt(np.mean(slope[moving] ** 2)))
    error = float(np.sqrt(np.mean((mean - slope)[moving] ** 2))) / size
    text = f"dq differs from the slope of q by {error:.0%} of its size ({size:.2f} rad/s RMS)"
    if error <= ctx.tolerance("max_relative_rms"):
        return ctx.passed(f"{error:.0%} off", text, relative_rms=error)
    worst = starts[np.argmax(np.abs(mean - slope))]
    turned = float(np.mean(mean[moving] * slope[moving])) < 0
    return ctx.failed(
        f"{error:.0%} off",
        text + ("; its sign is turned" if turned else ""),
        ctx.at(states.topic, float(t[worst]), float(t[worst]) + window),
        relative_rms=error,
    )
