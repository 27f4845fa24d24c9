"""Check rate, gaps, order and freshness of the state.

Rates, jitter and freshness are judged in sliding windows, so a temporary fault counts like a
permanent one. Source timestamps are used where the recording has them, so that late reception does
not count against the hand. In a run of the kit, gaps and jitter are also judged by reception times,
because there the kit's own lateness is known and taken into account.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Late, Outcome, check, rate_measure
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.measurement_error import Measure
from dexkit.conformance.median import median, percentile
from dexkit.conformance.provenance import TIMES
from dexkit.conformance.sums import total
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
_STRIDE = 0.1  # s from one window to the next
COARSEST = 0.02
"""Coarsest encoder step of a good hand, as a part of the joint's range."""
_FEW_CHANGES = 10
"""Fewest changes of q that show an encoder's step."""
_ON_LATTICE = 0.9
"""Part of the changes that must be multiples of an encoder's step: noise makes others."""
_OFF_LATTICE = 0.05
"""Tolerance of a multiple of the encoder's step, as a part of the step, for rounded values."""
_EXPLAINED = 1.5
"""Steps of a coarse encoder for which a joint may seem to stand still."""
_STEPS = 2.0  # usual times between states that the last state of a position counts for at most
_IN_A_ROW = 5  # held positions, whose median ignores one outlier


def _times(ctx: Context) -> Iterator[Floats]:
    """The times of the states for gaps and jitter.

    Source timestamps, and reception times if the recording says how late the kit was.
    """
    yield ctx.states.clock
    if ctx.recording.stimulus is not None:
        yield ctx.states.t


def gaps(ctx: Context, longer_than: float, begin: float, end: float) -> list[tuple[float, float]]:
    """Intervals within [begin, end] without state, longer than ``longer_than`` seconds."""
    found: list[tuple[float, float]] = []
    for clock in _times(ctx):
        inside = clock[(clock >= begin) & (clock <= end)]
        edges = np.concatenate(([begin], inside, [end]))
        where = np.flatnonzero(np.diff(edges) > longer_than)
        again = [(float(edges[i]), float(edges[i + 1])) for i in where]
        found += [(a, b) for a, b in again if not any(x < b and a < y for x, y in found)]
    return sorted(found)


def longest_gap(ctx: Context, limit: float, begin: float, end: float) -> Measure:
    """The longest interval without state within [begin, end] against a limit, s."""
    longest = 0.0
    for clock in _times(ctx):
        inside = clock[(clock >= begin) & (clock <= end)]
        edges = np.concatenate(([begin], inside, [end]))
        longest = max(longest, float(np.diff(edges).max()))
    return Measure(longest, limit, span=(begin, end))


def gap_beside_states(times: Floats, states: Floats) -> tuple[float, float]:
    """The longest interval between times beyond pauses of the states, and its begin.

    A restarted service or a paused machine is silent on all topics.
    """
    times = np.concatenate((times, states[-1:]))
    found = (0.0, float(times[0]))
    for begin, end in pairwise(times.tolist()):
        if end - begin > found[0]:
            own = states[(states > begin) & (states < end)]
            quiet = float(np.diff(np.concatenate(([begin], own, [end]))).max())
            found = max(found, (end - begin - quiet, begin))
    return found


def survived(ctx: Context, outcome: Outcome, gap: float) -> Outcome:
    """The outcome of a gap in the state, seconds: at most a warning where it is no longer than the
    requirement's ``survived_s``.
    """
    if gap > ctx.requirement.tolerances.get("survived_s", 0.0):
        return outcome
    return outcome.tolerated().because(
        "Real hands of this model were seen to lose their state for about a second, again and "
        "again. A client that waits for it stands still meanwhile, with both hands; one that goes "
        "by the age of the state holds its targets."
    )


def gap_measures(found: Iterable[tuple[float, float]], limit: float) -> list[Measure]:
    """The gaps (begin, end) as measures against the longest allowed one, s."""
    return [Measure(b - a, limit, span=(a, b)) for a, b in found]


def _spans(ctx: Context, names: tuple[str, ...]) -> list[tuple[float, float]]:
    """Begin and end of the phases of these names."""
    return [ctx.span(p) for name in names for p in ctx.recording.phases(name, ctx.side)]


def _slow_stretches(ctx: Context) -> list[tuple[float, float, Floats]]:
    """Begin, end and intervals of each stretch with too low a rate in every window.

    The longest interval of a window is left out, because RATE-03 and RATE-04 judge a single late
    state.
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


def slow(ctx: Context, rate: float) -> bool:
    """Whether a measured rate is below the least that is allowed.

    The limit has a margin: clocks differ, and a window may cut an interval.
    """
    return rate < least_rate(ctx)


def least_rate(ctx: Context) -> float:
    """The lowest measured rate of a hand that meets the limit, Hz."""
    return (1 - ctx.tolerance("slack_part")) * ctx.tolerance("min_rate_hz")


def too_slow(ctx: Context, outcome: Outcome, rate: float, intervals: Floats) -> Outcome:
    """The outcome with its size: the delay of each state beyond the limit.

    :param intervals: the intervals of the rate, seconds.
    """
    period = 1 / ctx.tolerance("min_rate_hz")
    size = 1 / rate - period if rate > 0 else math.inf
    best = float(np.percentile(intervals, 25)) - period if len(intervals) else size
    return outcome.if_late(size, how="mean", best=best)


def _too_short(ctx: Context) -> Outcome:
    return ctx.skipped(
        f"less than {ctx.tolerance('min_observed_s'):g} s of steady state in the recording"
    )


@check("DEX1-RATE-01", "DEX3-RATE-01", "H1-RATE-01", rests_on=(TIMES,))
def rate(ctx: Context) -> Outcome:
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
        return too_slow(ctx, outcome, mean, np.diff(clock))
    slowed = _slow_stretches(ctx)
    if not slowed:
        text = f"{mean:.1f} Hz over {seconds:.1f} s"
        met = ctx.passed(f"{mean:.1f} Hz", text, rate_hz=mean)
        return met.rated(mean, least_rate(ctx), seconds)
    rates = [len(intervals) / total(intervals) for _, _, intervals in slowed]
    begin, end, _ = slowed[0]
    many = "" if len(slowed) == 1 else f", the first of {len(slowed)} such stretches"
    period = 1 / ctx.tolerance("min_rate_hz")
    best = min(float(np.percentile(intervals, 25)) for _, _, intervals in slowed) - period
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
    return outcome.if_late(*(1 / r - period for r in rates), how="mean", best=best)


@check("DEX1-RATE-02", "DEX3-RATE-02", "H1-RATE-02", rests_on=(TIMES,))
def vendor_rate(ctx: Context) -> Outcome:
    """Mean rate compared with the vendor's.

    One interval in each second is left out if it is the longest there by far: RATE-03 to RATE-05
    judge single late states.
    """
    measured = _rate(ctx)
    if measured is None:
        return _too_short(ctx)
    rate, seconds = measured
    if rate < ctx.tolerance("min_rate_hz"):
        rate, seconds = _rate_without_pauses(ctx)
    text = f"{rate:.1f} Hz over {seconds:.1f} s"
    least, most = ctx.tolerance("min_rate_hz"), ctx.tolerance("max_rate_hz")
    if least <= rate <= most:
        return ctx.passed(f"{rate:.1f} Hz", text, rate_hz=rate).rated(rate, least, seconds)
    # load of the machine cannot cause too high a rate
    outcome = ctx.failed(f"{rate:.1f} Hz", text, rate_hz=rate)
    if rate > most:
        return outcome.rated(rate, most, seconds, at_most=True).if_late(math.inf)
    return too_slow(ctx, outcome.rated(rate, least, seconds), rate, np.diff(ctx.states.clock))


@check("DEX1-RATE-03", "DEX3-RATE-03", "H1-RATE-03", rests_on=(TIMES,))
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
        return outcome.if_late(*(b - a - limit for a, b in found))
    free = np.ones(len(clock) - 1, dtype=np.bool_)
    for x, y in excluded:
        free &= (clock[1:] <= x) | (clock[:-1] >= y)
    longest = float(np.diff(clock)[free].max(initial=0.0))
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    ).timed(longest, limit)


@check("DEX1-RATE-04", "DEX3-RATE-04", rests_on=(TIMES,))
def regular(ctx: Context) -> Outcome:
    """99th percentile of the intervals in sliding windows, by source timestamp and reception, and
    the number of pauses.
    """
    intervals = np.diff(ctx.states.clock)
    seconds = total(intervals)
    if seconds < ctx.tolerance("min_observed_s"):
        return _too_short(ctx)
    p50, p99 = percentile(intervals, 50), percentile(intervals, 99)
    text = f"p50 {p50 * 1e3:.2f} ms, p99 {p99 * 1e3:.2f} ms, longest {intervals.max() * 1e3:.1f} ms"
    worst = max((_worst_p99(ctx, clock) for clock in _times(ctx)), default=(p99, 0.0, seconds))
    limit = ctx.tolerance("max_p99_s")
    if max(p99, worst[0]) <= limit:
        # at several hundred states a second, a few pauses are less than one in a hundred
        names = ("pause_s", "pauses_window_s", "max_pauses")
        pauses = _long_intervals(ctx, *(ctx.tolerance(name) for name in names))
        if not pauses.met:
            return pauses
        met = ctx.passed(f"p99 {p99 * 1e3:.2f} ms", text, p50_s=p50, p99_s=p99)
        return met.timed(max(p99, worst[0]), limit)
    if p99 > limit:
        outcome = ctx.failed(f"p99 {p99 * 1e3:.2f} ms", text, p50_s=p50, p99_s=p99)
        outcome = outcome.timed(p99, limit)
        return outcome.if_late(p99 - limit, how="p99")
    late, begin, end = worst
    outcome = ctx.failed(
        f"p99 {late * 1e3:.2f} ms",
        f"{text} in all; p99 {late * 1e3:.2f} ms from {begin:.1f} s to {end:.1f} s",
        ctx.at(ctx.states.topic, begin, end),
        p50_s=p50,
        p99_s=late,
    )
    return outcome.timed(late, limit).if_late(late - limit, how="p99")


@check("DEX1-RATE-05", "DEX3-RATE-05", rests_on=(TIMES,))
def spread(ctx: Context) -> Outcome:
    """The largest number of long intervals in a window, as published and as received."""
    return _long_intervals(
        ctx, ctx.tolerance("max_interval_s"), ctx.tolerance("window_s"), ctx.tolerance("max_count")
    )


def _long_intervals(ctx: Context, limit: float, window: float, allowed: float) -> Outcome:
    """Compare the number of long intervals between states with what is allowed.

    :param limit: s, above which an interval is long.
    :param window: s, in which they are counted.
    :param allowed: how many of them there may be.
    """
    excluded = _spans(ctx, OWN_RATE_RULE)
    most = 0
    for clock in _times(ctx):
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
            f"{most} in {window:g} s",
            f"{len(found)} intervals of more than {limit:g} s from {begin:.2f} s to {end:.2f} s",
            *(ctx.at(ctx.states.topic, a, b) for a, b in found),
            intervals=most,
        ).resting_on(*gap_measures(found, limit))
        return outcome.if_late(*(b - a - limit for a, b in found))
    return ctx.passed(
        f"{most} in {window:g} s",
        f"at most {most} intervals of more than {limit:g} s in {window:g} s",
        intervals=most,
    )


def _worst_p99(ctx: Context, clock: Floats) -> tuple[float, float, float]:
    """The largest 99th percentile of the intervals in a window, and the window; s."""
    window = ctx.tolerance("window_s")
    intervals = np.diff(clock)
    begin, end = float(clock[0]), float(clock[-1])
    starts = np.arange(begin, max(end - window, begin) + _STRIDE / 2, 5 * _STRIDE)
    rows = np.searchsorted(clock[:-1], (starts, starts + window))
    rows = rows[:, rows[1] - rows[0] >= 100]  # of fewer, one is more than 1 %
    if not rows.shape[1]:
        return (0.0, begin, end)

    def p99(i: int, j: int) -> tuple[float, float, float]:
        return percentile(intervals[i:j], 99), float(clock[i]), float(clock[j])

    # A window cannot be worse if it has fewer intervals above the worst 99th percentile so far than
    # lie above its own. The choice of the first window affects only how soon a high value is found.
    worst = p99(*rows[:, np.argmax(_count(intervals >= percentile(intervals, 99), rows))].tolist())
    above = ((rows[1] - rows[0] - 1) * 0.01).astype(np.intp)
    left = rows[:, _count(intervals >= worst[0], rows) >= above]
    return max([worst, *(p99(i, j) for i, j in left.T.tolist())])


def _count(which: NDArray[np.bool_], rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number of true values from each row in ``rows[0]`` to before that in ``rows[1]``."""
    passed = np.concatenate(([0], np.cumsum(which)))
    return np.asarray(passed[rows[1]] - passed[rows[0]])


@check("DEX1-ORDER-01", "DEX3-ORDER-01", "H1-ORDER-01", rests_on=(TIMES,))
def order(ctx: Context) -> Outcome:
    """Source timestamps increase from sample to sample."""
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


def encoder_step(ctx: Context, joint: int) -> float:
    """The step of the encoder of a joint, rad; 0 where q shows none of up to 2 % of the range."""
    coarsest = COARSEST * ctx.joints[joint].stroke
    course = Positions.from_context(ctx, joint)
    return ctx.once(("encoder", joint), lambda: course.encoder_step(coarsest))


@dataclass(frozen=True, eq=False)
class Positions:
    """The positions of a joint that are numbers, and where they change.

    :param changes: rows that differ from the one before; ``steps``: by how much, rad.
    """

    t: Floats
    q: Floats
    changes: NDArray[np.intp]
    steps: Floats

    @classmethod
    def from_context(cls, ctx: Context, joint: int) -> Positions:
        """A joint's data, cached for all checks."""
        return ctx.once_of_joint("course", joint, lambda: cls._from_states(ctx, joint))

    @classmethod
    def _from_states(cls, ctx: Context, joint: int) -> Positions:
        good = ctx.known_states(joint, "q")
        return cls.of(ctx.states.t[good], ctx.states.q[:, joint][good])

    @classmethod
    def of(cls, t: Floats, q: Floats) -> Positions:
        """Those of a column of numbers."""
        steps = np.diff(q)
        rows = np.flatnonzero(steps != 0)  # comparing bits is several times as fast
        return cls(t, q, rows + 1, steps[rows])

    def encoder_step(self, coarsest: float) -> float:
        """The step of the encoder that these positions come from, rad; 0 where they show none.

        With an encoder, changes are multiples of its step, and the positions lie on a grid: on two,
        if it is homed again at a restart of the service. Old values of a finer encoder may change
        by equal amounts at constant speed, but do not lie on a grid.

        :param coarsest: the largest step that counts as an encoder's, rad.
        """
        size = np.abs(self.steps)
        if len(size) < _FEW_CHANGES:
            return 0.0
        step = percentile(size, 5)
        if not 0.0 < step <= (1 + _OFF_LATTICE) * coarsest:
            return 0.0
        times = np.rint(size / step)
        step = median(size[times == 1])
        times = np.rint(size / step)
        on = (times >= 1) & (np.abs(size - times * step) <= _OFF_LATTICE * step)
        if on.mean() < _ON_LATTICE:
            return 0.0
        step = float(size[on].sum() / times[on].sum())
        phases = np.mod(self.q[self.changes], step) / step
        bins = np.sort(np.bincount((20 * phases).astype(np.intp) % 20, minlength=20))
        return step if bins[-4:].sum() >= _ON_LATTICE * len(phases) else 0.0

    def is_finer_than(self, step: float) -> bool:
        """Whether :meth:`encoder_step` is certain to give no more than this; it takes a tenth of
        the time.

        It looks for the step among changes of 0.5 to 1.5 times their 5th percentile, and changes
        its mind by no more than :data:`_OFF_LATTICE` of it.
        """
        rounding = 1.001
        small = np.abs(self.steps) <= step / (1.5 * (1 + _OFF_LATTICE) * rounding)
        return bool(np.count_nonzero(small) > 0.05 * len(small) + 1)

    def held(self, samples: float, which: NDArray[np.bool_]) -> bool:
        """Whether one of these changes follows this many states of one position."""
        chosen = np.flatnonzero(which)
        before = np.where(chosen > 0, self.changes[chosen - 1], 0)
        return bool((self.changes[chosen] - before >= samples).any())


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
            begin[i] = _at_rest_until(ctx, joint, float(q[changes[i]]), begin[i], end[i])
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


def _at_rest_until(ctx: Context, joint: int, q: float, begin: float, end: float) -> float:
    """The last time in [begin, end] at which the commanded position was q.

    A hand at rest at its commanded position correctly repeats that position. ``begin`` if no
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


def _medians(rows: Floats) -> Floats:
    """The median of each row; for the usual rows of five by comparing columns."""
    if rows.shape[1] != 5:
        return np.asarray(np.median(rows, axis=1))
    a, b, c, d, e = rows.T
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    # the least and the greatest of the four are out; of low, high and e the middle one is it
    return np.asarray(np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e)))


@check("DEX1-FRESH-01", "DEX3-FRESH-01", "DEX1-FRESH-04", rests_on=(TIMES,))
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
    text = f"{met}, but every {hold * 1e3:.0f} ms from {begin:.2f} s on"
    limit = ctx.tolerance("max_hold_s")
    best = max(float(np.percentile(rows[i], 25)) - limit, 0.0)
    late = Late((max(hold - limit, 0.0),), "mean", best)
    shown = f"{usual * 1e3:.1f} ms" if hold <= limit else f"{hold * 1e3:.0f} ms"
    yield Figure(hold, begin, end, joint, text, met, shown=shown, late=late)
