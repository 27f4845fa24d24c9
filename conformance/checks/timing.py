"""Rates, gaps, order and freshness of the state.

Source timestamps are used where the recording has them, so that a late reception does not count
as a late hand.
"""

from __future__ import annotations

import math

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.median import median
from dexkit.hand import Floats

# stimuli with separate requirements for the state's rate
OWN_GAP_RULE = (
    *("silence", "guard", "shutdown"),
    *("nan", "out-of-range", "empty", "short", "long", "wrong-id"),
    *("negative", "foreign", "burst", "two-writers", "load"),
)


def gaps(ctx: Context, longer_than: float, begin: float, end: float) -> list[tuple[float, float]]:
    """Intervals within [begin, end] without state, longer than ``longer_than`` seconds."""
    clock = ctx.states.clock
    inside = clock[(clock >= begin) & (clock <= end)]
    edges = np.concatenate(([begin], inside, [end]))
    where = np.flatnonzero(np.diff(edges) > longer_than)
    return [(float(edges[i]), float(edges[i + 1])) for i in where]


def _observed(ctx: Context) -> tuple[Floats, float]:
    """Intervals between states, and the seconds that they add up to."""
    intervals = np.diff(ctx.states.clock)
    return intervals, float(intervals.sum())


def _rate(ctx: Context) -> tuple[float, float] | None:
    """(mean rate outside of gaps, seconds observed), or None if that is too short."""
    intervals, _ = _observed(ctx)
    steady = intervals[intervals <= 0.1]  # longer ones are judged by RATE-03
    seconds = float(steady.sum())
    if seconds < ctx.tolerance("min_observed_s"):
        return None
    return len(steady) / seconds, seconds


def slow(ctx: Context, rate: float) -> bool:
    """Whether a measured rate is below the least that is allowed.

    The limit has a margin: clocks differ, and a window may cut an interval.
    """
    return rate < (1 - ctx.tolerance("slack_part")) * ctx.tolerance("min_rate_hz")


def too_slow(ctx: Context, outcome: Outcome, rate: float, intervals: Floats) -> Outcome:
    """The outcome with its size: how much later than allowed each state comes.

    :param intervals: those that the rate is of, seconds.
    """
    period = 1 / ctx.tolerance("min_rate_hz")
    size = 1 / rate - period if rate > 0 else math.inf
    best = float(np.percentile(intervals, 25)) - period if len(intervals) else size
    return outcome.if_late(size, how="mean", best=best)


def _too_short(ctx: Context) -> Outcome:
    return ctx.skipped(
        f"less than {ctx.tolerance('min_observed_s'):g} s of steady state in the recording"
    )


@check("DEX1-RATE-01", "DEX3-RATE-01", "H1-RATE-01")
def mean_rate(ctx: Context) -> Outcome:
    """Mean rate outside of gaps."""
    clock = ctx.states.clock
    measured = _rate(ctx)
    if measured is None:
        # without any steady interval the rate is too low, not unknown
        seconds = float(clock[-1] - clock[0]) if len(clock) > 1 else 0.0
        if seconds < ctx.tolerance("min_observed_s"):
            return _too_short(ctx)
        rate = (len(clock) - 1) / seconds
    else:
        rate, seconds = measured
    if slow(ctx, rate):
        outcome = ctx.failed(
            f"{rate:.1f} Hz",
            f"{len(ctx.states)} states, {rate:.1f} Hz over {seconds:.1f} s",
            ctx.at(ctx.states.topic, float(ctx.states.t[0]), float(ctx.states.t[-1])),
            rate_hz=rate,
        )
        return too_slow(ctx, outcome, rate, np.diff(clock))
    return ctx.passed(f"{rate:.1f} Hz", f"{rate:.1f} Hz over {seconds:.1f} s", rate_hz=rate)


@check("DEX1-RATE-02", "DEX3-RATE-02", "H1-RATE-02")
def vendor_rate(ctx: Context) -> Outcome:
    """Mean rate compared with the vendor's."""
    measured = _rate(ctx)
    if measured is None:
        return _too_short(ctx)
    rate, seconds = measured
    text = f"{rate:.1f} Hz over {seconds:.1f} s"
    if ctx.tolerance("min_rate_hz") <= rate <= ctx.tolerance("max_rate_hz"):
        return ctx.passed(f"{rate:.1f} Hz", text, rate_hz=rate)
    # load of the machine cannot cause too high a rate
    outcome = ctx.failed(f"{rate:.1f} Hz", text, rate_hz=rate)
    if rate > ctx.tolerance("max_rate_hz"):
        return outcome.if_late(math.inf)
    return too_slow(ctx, outcome, rate, _observed(ctx)[0])


@check("DEX1-RATE-03", "DEX3-RATE-03", "H1-RATE-03")
def no_gap(ctx: Context) -> Outcome:
    """Longest interval without a state."""
    limit = ctx.tolerance("max_gap_s")
    clock = ctx.states.clock
    if len(clock) < 2:
        return ctx.skipped("fewer than two states")
    # up to the end of the recording: a state that never comes back is a gap as well
    end = max(float(clock[-1]), ctx.recording.duration)
    found = gaps(ctx, limit, float(clock[0]), end)
    excluded = [ctx.span(p) for name in OWN_GAP_RULE for p in ctx.recording.phases(name, ctx.side)]
    found = [(a, b) for a, b in found if not any(x < b and a < y for x, y in excluded)]
    if found:
        longest = max(b - a for a, b in found)
        first = found[0]
        many = "a gap" if len(found) == 1 else f"{len(found)} gaps; the first"
        return ctx.failed(
            f"{longest:.3f} s",
            f"{many} from {first[0]:.3f} s to {first[1]:.3f} s",
            *(ctx.at(ctx.states.topic, a, b) for a, b in found),
            max_gap_s=longest,
            gaps=len(found),
        ).if_late(*(b - a - limit for a, b in found))
    free = np.ones(len(clock) - 1, dtype=np.bool_)
    for x, y in excluded:
        free &= (clock[1:] <= x) | (clock[:-1] >= y)
    longest = float(np.diff(clock)[free].max(initial=0.0))
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    )


@check("DEX1-RATE-04", "DEX3-RATE-04")
def regular(ctx: Context) -> Outcome:
    """99th percentile of the intervals."""
    intervals, seconds = _observed(ctx)
    if seconds < ctx.tolerance("min_observed_s"):
        return _too_short(ctx)
    p50, p99 = np.percentile(intervals, [50, 99])
    text = f"p50 {p50 * 1e3:.2f} ms, p99 {p99 * 1e3:.2f} ms, longest {intervals.max() * 1e3:.1f} ms"
    if p99 <= ctx.tolerance("max_p99_s"):
        return ctx.passed(f"p99 {p99 * 1e3:.2f} ms", text, p50_s=p50, p99_s=p99)
    outcome = ctx.failed(f"p99 {p99 * 1e3:.2f} ms", text, p50_s=p50, p99_s=p99)
    return outcome.if_late(p99 - ctx.tolerance("max_p99_s"), how="p99")


@check("DEX1-ORDER-01", "DEX3-ORDER-01", "H1-ORDER-01")
def order(ctx: Context) -> Outcome:
    """Source timestamps rise from sample to sample."""
    sent = ctx.states.sent
    if len(sent) < 2 or not np.isfinite(sent).all():
        return ctx.skipped("the recording has no source timestamps")
    steps = np.diff(sent)
    wrong = np.flatnonzero(steps <= 0)
    if not len(wrong):
        return ctx.passed("in order", f"{len(sent)} source timestamps, each later than the last")
    back = int((steps < 0).sum())
    return ctx.failed(
        f"{len(wrong)} of {len(sent)}",
        f"{back} samples older than the one before, {len(wrong) - back} with the same timestamp",
        *(ctx.at(ctx.states.topic, float(ctx.states.t[i + 1])) for i in wrong[:5]),
        out_of_order=len(wrong),
    )


@check("DEX1-FRESH-02", "DEX3-FRESH-02")
def not_frozen(ctx: Context) -> Outcome:
    """The longest interval of equal positions that ends in a jump that no joint can make."""
    limit = ctx.tolerance("max_frozen_s")
    worst = 0.0
    for joint in range(len(ctx.joints)):
        t, q = ctx.states.t, ctx.states.q[:, joint]
        good = np.isfinite(q)
        t, q = t[good], q[good]
        changes = np.flatnonzero(np.diff(q) != 0) + 1
        if len(changes) < 2:
            continue
        jump = np.abs(np.diff(q)[changes - 1])[1:]
        # count published states: a gap in the state is judged by RATE-03
        sent = np.diff(changes)
        begin, end = t[changes[:-1]], t[changes[1:] - 1]
        usual = 2 * float(np.percentile(jump, 99))  # with rare measurements every change is a jump
        at_once = t[changes[1:]] - t[changes[1:] - 1] < 0.05
        frozen = (jump >= max(ctx.tolerance("min_jump_stroke", joint), usual)) & at_once
        frozen &= sent >= ctx.tolerance("min_samples")
        held = np.zeros(len(begin))
        for i in np.flatnonzero(frozen):
            begin[i] = _at_rest_until(ctx, joint, float(q[changes[i]]), begin[i], end[i])
            held[i] = end[i] - begin[i]
        if not frozen.any():
            continue
        i = int(np.argmax(held))
        worst = max(worst, float(held[i]))
        if held[i] > limit:
            at, count = float(begin[i]), int(((t >= begin[i]) & (t <= end[i])).sum())
            return (
                ctx.failed(
                    f"{held[i]:.2f} s",
                    ctx.named(
                        f"{count} states in a row with q = {q[changes[i]]:.3f} rad over "
                        f"{held[i]:.2f} s, and then a jump of {jump[i]:.2f} rad",
                        joint,
                    ),
                    ctx.at(ctx.states.topic, at, at + float(held[i])),
                    frozen_s=float(held[i]),
                )
                .about(joint)
                .if_late(float(held[i]) - limit)
            )
    if not any(len(np.unique(c)) > 3 for c in ctx.states.q.T):
        return ctx.skipped("the hand does not move in this recording")
    return ctx.passed(
        f"{worst * 1e3:.0f} ms",
        f"no position was held for more than {worst:.3f} s and then jumped",
        frozen_s=worst,
    )


def _at_rest_until(ctx: Context, joint: int, q: float, begin: float, end: float) -> float:
    """The last time in [begin, end] at which the commanded position was q.

    A hand that rests at its commanded position repeats that position correctly. ``begin`` where no
    command is known.
    """
    t, commanded = ctx.commands.t, ctx.commands.q[:, joint]
    known = np.isfinite(commanded)
    t, commanded = t[known], commanded[known]
    first, last = np.searchsorted(t, [begin, end], side="right")
    first = max(int(first) - 1, 0)  # the command in force at begin
    elsewhere = np.abs(commanded[first:last] - q) > ctx.tolerance("min_jump_stroke", joint)
    if not len(elsewhere):
        return begin
    if not elsewhere[-1]:
        return end
    there = np.flatnonzero(~elsewhere)
    return max(begin, float(t[first + there[-1] + 1])) if len(there) else begin


@check("DEX1-FRESH-01", "DEX3-FRESH-01")
def fresh(ctx: Context) -> Outcome:
    """How long a position stays the same while the hand moves."""
    worst: Outcome | None = None
    for joint in range(len(ctx.joints)):
        outcome = _fresh(ctx, joint)
        if outcome.met is False:
            return outcome
        held = outcome.values.get("hold_s", -1.0)
        if worst is None or held > worst.values.get("hold_s", -1.0):
            worst = outcome
    assert worst is not None
    return worst


def _fresh(ctx: Context, joint: int) -> Outcome:
    t, q = ctx.states.t, ctx.states.q[:, joint]
    good = np.isfinite(q)
    t, q = t[good], q[good]
    if len(q) < 2:
        return ctx.skipped("fewer than two states with a position")
    changes = np.flatnonzero(np.diff(q) != 0) + 1
    if len(changes) < 3:
        return ctx.skipped("the hand does not move in this recording")
    size = np.diff(q)[changes - 1]
    least = ctx.tolerance("min_change_stroke", joint)
    big = np.abs(size) >= least
    same_way = np.sign(size[1:]) == np.sign(size[:-1])
    # a value repeated between two large changes in one direction was old
    moving = big[1:] & big[:-1] & same_way
    holds = np.diff(t[changes])[moving]
    travel = float(np.ptp(q))
    if len(holds) < ctx.tolerance("min_intervals"):
        if travel < least:
            return ctx.skipped("the hand does not move in this recording")
        # only small changes: the values are fresher than required
        fastest = median(np.diff(t[changes]))
        return ctx.passed(
            f"{fastest * 1e3:.1f} ms", "changes from sample to sample", hold_s=fastest
        )
    hold = median(holds)
    text = f"a new value every {hold * 1e3:.1f} ms while moving (median of {len(holds)})"
    if hold <= ctx.tolerance("max_hold_s"):
        return ctx.passed(f"{hold * 1e3:.1f} ms", ctx.named(text, joint), hold_s=hold)
    starts = t[changes][:-1][moving]
    return (
        ctx.failed(
            f"{hold * 1e3:.0f} ms",
            ctx.named(text, joint),
            *(ctx.at(ctx.states.topic, float(s), float(s) + hold) for s in starts[:3]),
            hold_s=hold,
        )
        .about(joint)
        .if_late(
            hold - ctx.tolerance("max_hold_s"),
            how="mean",
            best=float(np.percentile(holds, 25)) - ctx.tolerance("max_hold_s"),
        )
    )
