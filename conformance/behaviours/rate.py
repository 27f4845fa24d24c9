"""How often the state comes, and how regularly.

Rates, jitter and freshness are judged in sliding windows, so a temporary fault counts like a
permanent one. Source timestamps are used where the recording has them, so that late reception does
not count against the hand. In a run of the kit, gaps and jitter are also judged by reception times,
because there the kit's own lateness is known and taken into account.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check, rate_measure
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.robot import RobotContext, wrong_rows
from dexkit.conformance.checks.timing import (
    gap_measures,
    gaps,
    least_rate,
    slow,
    state_clocks,
    survived,
    too_slow,
)
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.kit.sums import total
from dexkit.hand import Floats

# stimuli with separate requirements for the state's rate
OWN_GAP_RULE = (
    *("silence", "guard", "shutdown"),
    *("nan", "out-of-range", "empty", "short", "long", "wrong-id"),
    *("foreign", "burst", "load"),
)


OWN_RATE_RULE = ("load", "burst", "shutdown")
"""Stimuli during which another requirement judges the state rate, or there is no service."""


_PAUSE = 5.0
"""An interval counts as a pause from this multiple of the usual interval on."""


_GAP = 0.1  # s; longer intervals are gaps, which RATE-03 judges


_ALIKE = 0.8
"""Part of a gap for which another topic is silent, if both have the same gap."""


_STRIDE = 0.1  # s from one window to the next


def _spans(ctx: Context, names: tuple[str, ...]) -> list[tuple[float, float]]:
    """Begin and end of the phases of these names."""
    return [ctx.span(p) for name in names for p in ctx.recording.phases(name, ctx.side)]


def _slow_stretches(ctx: Context) -> list[tuple[float, float, Floats]]:
    """Begin, end and intervals of each stretch with too low a rate in every window.

    The longest interval of a window is left out, because RATE-03 judges a single late state.
    """
    clock = ctx.states.clock
    lengths, starts = np.diff(clock), clock[:-1]
    keep = lengths <= _GAP
    for begin, end in _spans(ctx, OWN_RATE_RULE):
        keep &= (clock[1:] <= begin) | (starts >= end)
    lengths, starts = lengths[keep], starts[keep]
    window = ctx.tolerance("window_s")
    passed = np.concatenate(([0.0], np.cumsum(lengths)))
    found: list[tuple[int, int]] = []
    starting = np.arange(0.0, float(passed[-1]) - window, _STRIDE)
    if (lengths >= 0).all():
        rows = np.searchsorted(passed, (starting, starting + window)).T
    else:  # unsorted: the result for one time would depend on the others in the query
        each = [np.searchsorted(passed, (at, at + window)) for at in starting]
        rows = np.array(each, dtype=np.intp).reshape(-1, 2)
    rows = rows[rows[:, 1] - rows[:, 0] >= 2]
    first, last = rows.T
    longest = np.maximum.reduceat(np.append(lengths, 0.0), rows.ravel())[::2] if len(rows) else 0.0
    seconds = passed[last] - passed[first] - np.maximum(longest, 0.0)
    with np.errstate(divide="ignore"):
        rates = (last - first - 1) / seconds
    for i, j in rows[rates < least_rate(ctx)].tolist():
        if found and i <= found[-1][1]:
            found[-1] = found[-1][0], j
        else:
            found.append((i, j))
    return [_exactly(ctx, starts, lengths, i, j) for i, j in found]


def _exactly(
    ctx: Context, starts: Floats, lengths: Floats, first: int, last: int
) -> tuple[float, float, Floats]:
    """The stretch between the first and the last slow intervals of [first, last)."""
    several = round(_STRIDE * ctx.tolerance("min_rate_hz"))
    passed = np.concatenate(([0.0], np.cumsum(lengths[first:last])))
    mean = (passed[several:] - passed[:-several]) / several
    late = np.flatnonzero(mean * ctx.tolerance("min_rate_hz") > 1.0)
    if len(late):
        # the mean over [k, k + several) rises when slow intervals enter at its end
        first, last = first + int(late[0]), first + int(late[-1]) + several
        much = 2 / ctx.tolerance("min_rate_hz")
        sudden = np.flatnonzero(lengths[first:last] > much)
        if len(sudden):
            first += int(sudden[0])
    return float(starts[first]), float(starts[last - 1] + lengths[last - 1]), lengths[first:last]


def _rate(ctx: Context) -> tuple[float, float] | None:
    """(mean rate outside of gaps, seconds observed), or None if that is too short."""
    intervals = np.diff(ctx.states.clock)
    steady = intervals[intervals <= _GAP]
    seconds = total(steady)
    if seconds < ctx.tolerance("min_observed_s"):
        return None
    return len(steady) / seconds, seconds


def _rate_without_pauses(ctx: Context) -> tuple[float, float]:
    """(mean rate outside of gaps and of one pause in each second, seconds observed).

    A pause is an interval that is more than five times as long as usual.
    """
    intervals = np.diff(ctx.states.clock)
    steady = intervals[intervals <= _GAP]
    ends = np.cumsum(steady)
    seconds = np.maximum(ends - steady, 0.0).astype(np.intp)
    order = np.lexsort((steady, seconds))
    longest = order[np.flatnonzero(np.diff(seconds[order], append=-1))]
    kept = np.ones(len(steady), dtype=np.bool_)
    kept[longest[steady[longest] > _PAUSE * median(steady)]] = False
    left = total(steady[kept])
    return int(kept.sum()) / left, left


def _too_short(ctx: Context) -> Outcome:
    return ctx.skipped(
        f"less than {ctx.tolerance('min_observed_s'):g} s of steady state in the recording"
    )


@check("DEX1-RATE-01", "DEX3-RATE-01", "H1-RATE-01", rests_on=(TIMES,))
def rate(ctx: Context) -> Outcome:
    """The rate in sliding windows; a mean rate that is not the original's only warns."""
    return all_of(_rate_in_windows(ctx), warning(_usual_rate(ctx)))


def _rate_in_windows(ctx: Context) -> Outcome:
    """Rate in sliding windows, outside of gaps."""
    clock = ctx.states.clock
    measured = _rate(ctx)
    if measured is None:
        # without any steady interval the rate is too low, not unknown
        seconds = float(clock[-1] - clock[0]) if len(clock) > 1 else 0.0
        if seconds < ctx.tolerance("min_observed_s"):
            return _too_short(ctx)
        mean = (len(clock) - 1) / seconds
    else:
        mean, seconds = measured
    if slow(ctx, mean):
        outcome = ctx.failed(
            f"{mean:.1f} Hz",
            f"{len(ctx.states)} states, {mean:.1f} Hz over {seconds:.1f} s",
            ctx.at(ctx.states.topic, float(ctx.states.t[0]), float(ctx.states.t[-1])),
            rate_hz=mean,
        ).rated(mean, least_rate(ctx), seconds)
        return too_slow(ctx, outcome, mean)
    slowed = _slow_stretches(ctx)
    if not slowed:
        text = f"{mean:.1f} Hz over {seconds:.1f} s"
        met = ctx.passed(f"{mean:.1f} Hz", text, rate_hz=mean)
        return met.rated(mean, least_rate(ctx), seconds)
    rates = [len(intervals) / total(intervals) for _, _, intervals in slowed]
    begin, end, _ = slowed[0]
    many = "" if len(slowed) == 1 else f", the first of {len(slowed)} such stretches"
    period = 1 / ctx.tolerance("min_rate_hz")
    measures = [
        rate_measure(r, least_rate(ctx), b - a, span=(a, b))
        for r, (a, b, _) in zip(rates, slowed, strict=True)
    ]
    outcome = ctx.failed(
        f"{min(rates):.1f} Hz",
        f"{mean:.1f} Hz over {seconds:.1f} s, but {rates[0]:.1f} Hz from {begin:.2f} s to "
        f"{end:.2f} s{many}",
        *(ctx.at(ctx.states.topic, a, b) for a, b, _ in slowed),
        rate_hz=min(rates),
    ).resting_on(*measures)
    return outcome.if_late(*(1 / r - period for r in rates), how="mean")


def _usual_rate(ctx: Context) -> Outcome:
    """Mean rate compared with the vendor's.

    One interval in each second is left out if it is the longest there by far: RATE-03 judges single
    late states.
    """
    measured = _rate(ctx)
    if measured is None:
        return _too_short(ctx)
    rate, seconds = measured
    least, most = ctx.tolerance("usual_min_hz"), ctx.tolerance("usual_max_hz")
    if rate < least:
        rate, seconds = _rate_without_pauses(ctx)
    text = f"{rate:.1f} Hz over {seconds:.1f} s"
    if least <= rate <= most:
        return ctx.passed(f"{rate:.1f} Hz", text, mean_hz=rate).rated(rate, least, seconds)
    # load of the machine cannot cause too high a rate
    unusual = f"{text}, where {least:g} to {most:g} Hz are usual"
    outcome = ctx.failed(f"{rate:.1f} Hz", unusual, mean_hz=rate)
    if rate > most:
        return outcome.rated(rate, most, seconds, at_most=True).if_late(math.inf)
    return outcome.rated(rate, least, seconds).if_late(1 / rate - 1 / least, how="mean")


@check("DEX1-RATE-03", "DEX3-RATE-03", rests_on=(TIMES,))
def steady(ctx: Context) -> Outcome:
    """Gaps, and bursts of a state that has no gap, arrives in order and has a good mean rate."""
    gap = no_gap(ctx)
    if not gap.met or (np.diff(ctx.states.sent) <= 0).any() or not _rate_in_windows(ctx).met:
        return gap
    bursts = _bursts(ctx)
    survived = ctx.requirement.tolerances.get("survived_count", 0.0)
    return all_of(gap, warning(bursts) if bursts.values["intervals"] <= survived else bursts)


@check("H1-RATE-03", rests_on=(TIMES,))
def no_gap(ctx: Context) -> Outcome:
    """Longest interval without a state."""
    limit = ctx.tolerance("max_gap_s")
    clock = ctx.states.clock
    if len(clock) < 2:
        return ctx.skipped("fewer than two states")
    # to the end of the recording: a state that never resumes is a gap too
    end = max(float(clock[-1]), ctx.recording.duration)
    found = gaps(ctx, limit, max(float(clock[0]), float(ctx.states.t[0])), end)
    excluded = _spans(ctx, OWN_GAP_RULE)
    found = [(a, b) for a, b in found if not any(x < b and a < y for x, y in excluded)]
    if found:
        longest = max(b - a for a, b in found)
        first = found[0]
        many = "a gap" if len(found) == 1 else f"{len(found)} gaps; the first"
        outcome = ctx.failed(
            f"{longest:.3f} s",
            f"{many} from {first[0]:.3f} s to {first[1]:.3f} s",
            *(ctx.at(ctx.states.topic, a, b) for a, b in found),
            max_gap_s=longest,
            gaps=len(found),
        ).resting_on(*gap_measures(found, limit))
        outcome = survived(ctx, outcome, longest)
        if all(_silent_as_a_whole(ctx, a, b) for a, b in found):
            outcome = outcome.tolerated().because(
                "No topic of the hands has a message there, and the recording has only times of "
                "reception: the recorder may have stood still, and not the hand."
            )
        return outcome.if_late(*(b - a - limit for a, b in found))
    free = np.ones(len(clock) - 1, dtype=np.bool_)
    for x, y in excluded:
        free &= (clock[1:] <= x) | (clock[:-1] >= y)
    longest = float(np.diff(clock)[free].max(initial=0.0))
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    ).timed(longest, limit)


def _silent_as_a_whole(ctx: Context, begin: float, end: float) -> bool:
    """Whether a recorder that stood still explains a gap in the state: other topics have the same
    gap, and nothing tells when the messages after it were sent.
    """
    if ctx.recording.stimulus is not None or np.isfinite(ctx.states.sent).any():
        return False
    others = [t for t in _received(ctx) if len(t) and t[0] < begin and t[-1] > end]
    quiet = [
        float(np.diff(t[(t >= begin - _GAP) & (t <= end + _GAP)]).max(initial=0.0)) for t in others
    ]
    return bool(others) and min(quiet) >= _ALIKE * (end - begin)


def _received(ctx: Context) -> Iterator[Floats]:
    """Times of reception of the other topics of the hands."""
    recording = ctx.recording
    for side, view in recording.sides.items():
        if view.states.topic != ctx.states.topic:
            yield view.states.t
        yield view.commands.t
        if side in recording.touch:
            yield recording.touch[side].t


def _bursts(ctx: Context) -> Outcome:
    """The largest number of long intervals in a window, as published and as received."""
    limit, window = ctx.tolerance("max_interval_s"), ctx.tolerance("window_s")
    allowed = ctx.tolerance("max_count")
    excluded = _spans(ctx, OWN_RATE_RULE)
    most = 0
    for clock in state_clocks(ctx):
        lengths = np.diff(clock)
        late = np.flatnonzero(lengths > limit)
        begins, ends = clock[:-1][late], clock[1:][late]
        for begin, end in excluded:
            keep = (ends <= begin) | (begins >= end)
            begins, ends = begins[keep], ends[keep]
        counts = np.searchsorted(begins, begins + window) - np.arange(len(begins))
        most = max(most, int(counts.max(initial=0)))
        if most <= allowed:
            continue
        first = int(np.argmax(counts > allowed))
        found = [
            (float(a), float(b))
            for a, b in zip(begins[first:], ends[first : first + most], strict=False)
        ]
        begin, end = found[0][0], found[-1][1]
        outcome = ctx.failed(
            f"{most} late in {window:g} s",
            f"{len(found)} intervals of more than {limit:g} s from {begin:.2f} s to {end:.2f} s",
            *(ctx.at(ctx.states.topic, a, b) for a, b in found),
            intervals=most,
        ).resting_on(*gap_measures(found, limit))
        return outcome.if_late(*(b - a - limit for a, b in found))
    return ctx.passed(
        f"{most} late in {window:g} s",
        f"at most {most} intervals of more than {limit:g} s in {window:g} s",
        intervals=most,
    )


@check("H1-TICK-01")
def tick(ctx: RobotContext) -> Outcome:
    """How tick goes on; what it counts only warns."""
    goes_on = _tick_goes_on(ctx)
    return all_of(goes_on, warning(_tick_rate(ctx))) if goes_on.met else goes_on


def _tick_goes_on(ctx: RobotContext) -> Outcome:
    """Increments of tick, and the longest time without a change."""
    tick, clock = ctx.low["tick"], ctx.states.clock
    if len(tick) < 2:
        return ctx.skipped("fewer than two states")
    steps = np.diff(tick)
    back = np.concatenate(([False], (steps < 0) & (steps > -(2.0**31))))  # it may wrap round
    if back.any():
        return wrong_rows(ctx, back, "goes back", "tick goes back")
    changes = np.concatenate(([0], np.flatnonzero(steps) + 1, [len(tick)]))
    held = clock[changes[1:] - 1] - clock[changes[:-1]]  # a gap in the state is judged by RATE-03
    longest, i = float(held.max()), int(np.argmax(held))
    if longest <= ctx.tolerance("max_hold_s"):
        return ctx.passed(f"{longest * 1e3:.0f} ms", f"stood still for {longest:.3f} s at most")
    begin = float(ctx.states.t[changes[i]])
    return ctx.failed(
        f"{longest:.2f} s",
        f"tick stays {tick[changes[i]]:.0f} for {longest:.2f} s, in "
        f"{int(changes[i + 1] - changes[i])} states",
        ctx.at(ctx.states.topic, begin, begin + longest),
    ).if_late(longest - ctx.tolerance("max_hold_s"))


def _tick_rate(ctx: RobotContext) -> Outcome:
    """Rate of tick."""
    tick, clock = ctx.low["tick"], ctx.states.clock
    seconds = float(clock[-1] - clock[0]) if len(clock) else 0.0
    if seconds < ctx.tolerance("min_observed_s"):
        return ctx.skipped("less than a second of state in the recording")
    rate = float((tick[-1] - tick[0]) % 2.0**32) / seconds
    part = abs(rate / ctx.tolerance("rate_hz") - 1.0)
    text = f"tick counts {rate:.0f} a second"
    if part <= ctx.tolerance("tolerance_part"):
        return ctx.passed(f"{rate:.0f} Hz", text)
    return ctx.failed(f"{rate:.0f} Hz", text).if_late(part * seconds)
