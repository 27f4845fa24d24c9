"""dq and ddq agree with q.

A hand that does not report measurements (but the command, a filtered value or another joint's)
contradicts itself: q moves while dq is 0, or tau_est shows contact while q continues into the
object. The checks compare the members of the state in windows, so that a fault of half a second is
detected like a permanent one. Allowed are measurements up to 20 ms old, prediction between them,
coarse encoders, a constant factor on dq (DEX1-FIELD-16 reports it), and torque in contact only.

Integrals in windows with motion miss a dq that alternates between twice the speed and 0, and one
that is stuck while the joint stands: these are compared from one state to the next, and at rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.robot import RobotContext, joint_of
from dexkit.conformance.checks.speeds import FEW, FOUGHT_OVER, by_times, filled, q_and_dq
from dexkit.conformance.checks.timing import encoder_step
from dexkit.conformance.kit import sums
from dexkit.conformance.kit.excess import Course
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.kit.row_selection import Rows, Selected, SomeTimes, Times
from dexkit.conformance.kit.sums import mean, total
from dexkit.hand import Floats
from dexkit.unseen import UNSEEN_S

Windows: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp], Floats]


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


_STEPS = 3.0
"""Smallest second difference of q, encoder steps, that shows an acceleration: rounding of three
positions makes up to two steps, with a standard deviation of 0.7."""


def _integral(t: Floats, x: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum((x[1:] + x[:-1]) / 2 * np.diff(t))))


@dataclass(frozen=True)
class _Bends:
    """Where a second difference over a window can be computed; the same for every joint.

    :param middle: rows of the samples, with ``before`` and ``behind`` a window away, and the
        seconds to these, ``a`` and ``b``.
    :param even: whether it can be computed there.
    """

    window: float
    middle: NDArray[np.intp]
    before: NDArray[np.intp]
    behind: NDArray[np.intp]
    a: Floats
    b: Floats
    even: NDArray[np.bool_]

    @classmethod
    def of(cls, t: Floats, window: float) -> _Bends:
        """Not at a gap, and not at samples with late timestamps. In such a short window a
        timestamp that is late by a tenth of the window has the effect of an acceleration.
        """
        middle = np.flatnonzero((t >= t[0] + window) & (t <= t[-1] - window))
        before = np.searchsorted(t, t[middle] - window)
        behind = np.searchsorted(t, t[middle] + window)
        a, b = t[middle] - t[before], t[behind] - t[middle]
        even = (np.abs(a - window) < 0.2 * window) & (np.abs(b - window) < 0.2 * window)
        steps, usual = np.diff(t), median(np.diff(t))
        uneven = (steps > usual + 0.1 * window) | (steps < 0.3 * usual)
        count = np.concatenate(([0], np.cumsum(uneven)))
        even &= count[behind] == count[before]
        return cls(window, middle, before, behind, a, b, even)

    def bend(self, x: Floats) -> Floats:
        """Second difference of x, per second squared; 0 where it cannot be computed."""
        middle = x[self.middle]
        with np.errstate(divide="ignore", invalid="ignore"):  # a gap has no even neighbours
            slope = (x[self.behind] - middle) / self.b - (middle - x[self.before]) / self.a
        return np.asarray(np.where(self.even, slope / self.window, 0.0))


_MEDIANS = 6.0
"""Medians of what q shows beyond which normal noise is once in 20,000 states."""


@check("DEX1-FIELD-06", "DEX3-FIELD-05", rests_on=("ddq",))
def acceleration(ctx: Context) -> Outcome:
    """Compare ddq with the second difference of q over a window."""
    states = ctx.states
    if not ((states.ddq != 0) & ~np.isnan(states.ddq)).any():
        return ctx.absent("ddq is not filled (0 throughout)")
    window = ctx.tolerance("window_s")
    worst = (1.0, 0)
    judged = False
    t = states.clock
    bends = ctx.once(("bends", window), lambda: _Bends.of(t, window))
    for joint in range(len(ctx.joints)):
        q = states.q[:, joint]
        if STAIRS * held_s(ctx, joint) > window:
            continue  # it changes faster than it is measured
        # integrated twice, so that it can be compared with q over the same window
        dq = _integral(t, states.ddq[:, joint])
        reported, seen = map(bends.bend, (_integral(t, dq), q))
        # the steps of a coarse encoder are not an acceleration
        rounding = _STEPS * encoder_step(ctx, joint) / window**2
        noise = _MEDIANS * median(np.abs(seen))  # most of the time no joint accelerates
        busy = np.abs(seen) > max(ctx.tolerance("min_ddq_rad_s2"), rounding, noise)
        if busy.sum() < 20:
            continue
        judged = True
        ratio = total(reported[busy] * seen[busy]) / total(seen[busy] ** 2)
        worst = max(worst, (ratio, joint), key=lambda w: abs(w[0] - 1.0))
    if not judged:
        return ctx.skipped("the hand hardly accelerates where its states arrive regularly")
    ratio, joint = worst
    text = ctx.named(f"ddq is {ratio:.2f} times what q shows", joint)
    if ctx.tolerance("min_ratio") <= ratio <= ctx.tolerance("max_ratio"):
        return ctx.passed(f"x {ratio:.2f}", text, ratio=ratio)
    # such late timestamps have the effect of the smallest acceleration judged here
    size = 0.1 * window
    outcome = ctx.failed(f"x {ratio:.2f}", text, ratio=ratio).about(joint).if_late(size, how="p99")
    return outcome.because("its sign is wrong") if ratio < 0 else outcome


STAIRS = 3.0
"""Measurements that a slope of q is taken over."""


_STAIR_PART = 0.005
"""Least part of the range of a step between two measurements that counts for their usual time."""


_LONGEST_HOLD_S = 0.1
"""Longest time between two measurements of a joint that moves, seconds."""


_LAGS = np.array([1.25, 4.0, 10.0, 25.0])
"""Lengths of the windows in which q is compared with the integral of dq, in lags."""


class _Joint:
    """A joint's states without repetitions.

    :ivar times: of its measurements.
    :ivar t: seconds; ``q``, rad, and ``dq``, rad/s, have the same length.
    """

    @classmethod
    def from_context(cls, ctx: Context, joint: int) -> _Joint:
        """The joint's data, cached for all checks."""
        return ctx.once_of_joint("joint", joint, lambda: cls(ctx, joint))

    def __init__(self, ctx: Context, joint: int) -> None:
        clock = ctx.once("clock", lambda: Times(ctx.states.clock))
        found = _measurements(ctx, joint)
        self.times = SomeTimes(clock, found)
        self._rising = clock.rising
        rows = slice(None) if len(found) == len(ctx.states) else found
        self.t = self.times.t
        self.q: Floats = ctx.states.q[:, joint][rows]
        self.dq: Floats = ctx.states.dq[:, joint][rows]
        self._steps: Floats = np.diff(self.t)

    def windows(self, seconds: float, longest: float) -> tuple[Rows | slice, Rows]:
        """First and last rows of all windows of that length without a gap above ``longest``."""
        ends = self.times.shifted(seconds)
        gap = self._steps > longest
        if self._rising and 2 * longest <= seconds and not gap.any():
            # every window that ends before the last row is whole, and not too long
            ends = ends[: int(np.searchsorted(ends, len(self.t)))]
            return slice(0, len(ends)), ends
        starts = np.flatnonzero(ends < len(self.t))
        ends = ends[starts]
        gaps = np.concatenate(([0], np.cumsum(gap)))
        whole = (gaps[ends] == gaps[starts]) & (self.t[ends] - self.t[starts] < 2 * seconds)
        return starts[whole], ends[whole]

    @property
    def dq_integral(self) -> Floats:
        """The integral of dq up to each measurement, rad."""
        return self._integrals[0]

    @property
    def path(self) -> Floats:
        """The integral of abs(dq) up to each measurement, rad."""
        return self._integrals[1]

    @cached_property
    def _integrals(self) -> tuple[Floats, Floats]:
        return self.integrals(self.dq)

    def integrals(self, speeds: Floats) -> tuple[Floats, Floats]:
        """The integrals of speeds and of their absolute values up to each measurement, rad."""
        return self._integral(speeds), self._integral(np.abs(speeds))

    def _integral(self, speeds: Floats) -> Floats:
        found = np.empty(len(speeds))
        found[:1] = 0.0
        steps = found[1:]
        np.add(speeds[1:], speeds[:-1], out=steps)
        steps *= 0.5
        steps *= self._steps
        np.cumsum(steps, out=steps)
        return found


def _measurements(ctx: Context, joint: int) -> Rows:
    """The states with a new measurement; a state that repeats q and a non-zero dq has none."""
    states = ctx.states
    q, dq = states.q[:, joint], states.dq[:, joint]
    good = ctx.known_states(joint, "q", "dq")
    t, q, dq = states.clock[good], q[good], dq[good]
    new = np.ones(len(t), dtype=np.bool_)
    if len(t):
        new[1:] = (q[1:] != q[:-1]) | (dq[1:] != dq[:-1]) | (dq[1:] == 0)
        if not ctx.once("clock", lambda: Times(states.clock)).advancing:
            new[1:] &= np.maximum.accumulate(t)[:-1] < t[1:]
    rows = np.flatnonzero(new)
    return rows if isinstance(good, slice) else np.flatnonzero(good)[rows]


@check(
    "DEX1-FIELD-16",
    "DEX3-FIELD-16",
    rests_on=(
        TIMES,
        "dq",
    ),
)
@worst("relative_rms", "max_relative_rms", nothing="the hand hardly moves in this recording")
def slope(ctx: Context) -> Figures:
    """Relative RMS error between dq and the slope of q, in the worst window."""
    if not filled(ctx):
        yield ctx.absent("dq is not filled (0 throughout)")
    window = ctx.tolerance("window_s")
    for joint, spec in enumerate(ctx.joints):
        x = _Joint.from_context(ctx, joint)
        found = _window_error(ctx, x, spec.stroke, held_s(ctx, joint))
        if found is None:
            continue
        error, ratio, at = found
        text = (
            f"in the worst window of {window:g} s dq is {error:.0%} off the slope of q, which is "
            f"{ratio:.2f} times dq"
        )
        yield Figure(
            error,
            at,
            at + window,
            joint,
            text + ("; its sign is turned" if ratio < 0 else ""),
            shown=f"{error:.0%} off",
            late=(error - ctx.tolerance("max_relative_rms")) * ctx.tolerance("slope_s"),
        )


def held_s(ctx: Context, joint: int) -> float:
    """The usual time from one measurement to the next while the joint moves, seconds.

    A hand may measure more rarely than it publishes (DEX1-FRESH-01): then q is a staircase, whose
    slope shows only over several of its steps.
    """
    return ctx.once(("held", joint), lambda: _held_s(ctx, joint))


def _held_s(ctx: Context, joint: int) -> float:
    x = _Joint.from_context(ctx, joint)
    steps = np.diff(x.t)
    stairs = np.abs(np.diff(x.q)) >= _STAIR_PART * ctx.joints[joint].stroke
    clock = ctx.states.clock
    # over a pause of the states q changes as over a time between two measurements
    pauses = clock[np.flatnonzero(np.diff(clock) > UNSEEN_S)]
    stairs &= np.diff(np.searchsorted(pauses, x.t)) == 0
    steps = steps[stairs & (steps <= _LONGEST_HOLD_S)]
    return median(steps) if len(steps) >= FEW else 0.0


def _window_error(
    ctx: Context, x: _Joint, stroke: float, held: float
) -> tuple[float, float, float] | None:
    """Error, ratio and begin of a joint's worst window; None if it does not move.

    :param held: see :func:`held_s`.
    """
    step = max(ctx.tolerance("slope_s"), STAIRS * held)
    count = round(ctx.tolerance("window_s") / step)
    if len(x.t) < FEW or x.t[-1] - x.t[0] < 2 * count * step:
        return None
    grid = np.asarray(np.arange(float(x.t[0]), float(x.t[-1]) - step, step))
    first = np.searchsorted(x.t, grid)
    last = np.minimum(np.searchsorted(x.t, grid + step), len(x.t) - 1)
    span = x.t[last] - x.t[first]
    whole = (span > 0.5 * step) & (span < 2 * step)
    # what alternates faster than it is measured is not seen
    barred = _unstable(ctx)
    if step > ctx.tolerance("slope_s"):
        barred += [ctx.span(p) for name in FOUGHT_OVER for p in ctx.phases(name)]
    for begin, end in barred:
        whole &= (grid + step < begin) | (grid > end)
    clock = ctx.states.clock
    gaps = np.flatnonzero(np.diff(clock) > UNSEEN_S)  # in them dq is not known
    for begin, end in zip(clock[gaps].tolist(), clock[gaps + 1].tolist(), strict=True):
        whole &= (grid + step <= begin) | (grid >= end)
    c = x.dq_integral
    moved = np.where(whole, x.q[last] - x.q[first], 0.0)
    dq_integral = np.where(whole, c[last] - c[first], 0.0)

    def summed(values: Floats) -> Floats:
        sums = np.concatenate(([0.0], np.cumsum(values)))
        return np.asarray(sums[count:] - sums[:-count])

    moves = summed(np.abs(moved)) > ctx.tolerance("min_motion_part") * stroke
    if not moves.any():
        return None
    error = np.sqrt(
        np.maximum(summed((moved - dq_integral) ** 2), 0.0)[moves] / summed(moved**2)[moves]
    )
    i = int(np.argmax(error))
    at = int(np.flatnonzero(moves)[i])
    mine, theirs = moved[at : at + count], dq_integral[at : at + count]
    ratio = total(mine * theirs) / max(total(theirs * theirs), 1e-12)
    return float(error[i]), float(ratio), float(grid[at])


@check(
    "DEX1-FIELD-17",
    "DEX3-FIELD-17",
    rests_on=(
        TIMES,
        "dq",
    ),
)
@worst(
    "excess_rad",
    "max_excess_stroke",
    nothing="the states are too far apart to integrate dq",
)
def keeps_up(ctx: Context) -> Figures:
    """Motion of q that dq, up to 40 ms earlier or later, does not explain, in the worst window."""
    if not filled(ctx):
        yield ctx.absent("dq is not filled (0 throughout)")
    joints = [_Joint.from_context(ctx, joint) for joint in range(len(ctx.joints))]
    courses = {i: _course(ctx, x) for i, x in enumerate(joints) if len(x.t) >= FEW}
    lengths = (_LAGS * ctx.tolerance("max_lag_s")).tolist()

    def bound(joint: int) -> float:
        return courses[joint][0].bound(lengths) / ctx.joints[joint].stroke

    part = -math.inf
    # the presumably worst joint first, so that the others need few windows
    for joint in sorted(courses, key=bound, reverse=True):
        x, (course, factor), stroke = joints[joint], courses[joint], ctx.joints[joint].stroke
        for seconds in lengths:
            most = course.worst(seconds, part * stroke)
            if most is None or most.rad / stroke < part:
                continue
            part, excess = most.rad / stroke, max(most.rad, 0.0)
            speed = float(np.abs(factor * x.dq[most.start : most.end + 1]).max())
            begin, end = float(x.t[most.start]), float(x.t[most.end])
            text = f"from {begin:.2f} to {end:.2f} s q moved {excess:.3f} {ctx.unit} beyond what "
            late = (excess - ctx.tolerance("max_excess_stroke", joint)) / max(speed, 1e-3)
            yield Figure(excess, begin, end, joint, f"{text}dq allows", late=late)


def _course(ctx: Context, x: _Joint) -> tuple[Course, float]:
    """A joint's course with the constant factor of its dq removed, and that factor."""
    lag = ctx.tolerance("max_lag_s")
    factor = _factor(x, x.dq_integral, lag)
    course = Course(
        x.times,
        x.q,
        factor * x.dq_integral,
        abs(factor) * x.path,
        exactly=None if factor == 1.0 else lambda: x.integrals(factor * x.dq),
        lag=lag,
        part=ctx.tolerance("max_part"),
        longest=0.5 * lag,
        barred=_unstable(ctx),
    )
    return course, factor


def _unstable(ctx: Context) -> list[tuple[float, float]]:
    """Begin and end of commands with negative gains, and of two alternating clients: under them the
    joint may oscillate faster than the states show.
    """
    names = ("negative", "two-writers")
    return [ctx.span(p) for name in names for p in ctx.recording.phases(name, ctx.side)]


def _factor(x: _Joint, c: Floats, lag: float) -> float:
    """The constant factor between the slope of q and dq; 1 unless most windows agree on one.

    :param c: the integral of dq.
    """
    starts, ends = x.windows(4 * lag, 0.5 * lag)
    dq_integral = c.take(ends) - c[starts]
    reach = float(np.ptp(x.q))
    moving = np.flatnonzero(np.abs(dq_integral) > 0.05 * reach)
    if len(moving) < FEW or not reach:
        return 1.0
    moved = x.q.take(ends[moving]) - x.q[starts].take(moving)
    ratios = np.sort(moved / dq_integral.take(moving))
    low, middle, high = (float(ratios[int(p * (len(ratios) - 1))]) for p in (0.25, 0.5, 0.75))
    return middle if middle and high - low <= 0.2 * abs(middle) else 1.0


_FEW = 10
"""Fewest states for a verdict."""


_CALMS_S = 0.2
"""Seconds for which a hand may still oscillate after contradictory commands."""


def _outside(ctx: Context, t: Floats) -> Selected:
    """Rows whose times are in no phase of bad or contradictory commands, nor right after one."""
    spans = [ctx.span(p) for name in (*FOUGHT_OVER, "foreign") for p in ctx.phases(name)]
    if not spans:
        return slice(None)
    kept = np.ones(len(t), dtype=np.bool_)
    for begin, end in spans:
        kept &= (t < begin) | (t > end + _CALMS_S)
    return kept


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
        t, q, dq = q_and_dq(ctx, joint)
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
        t, q, dq = q_and_dq(ctx, joint)
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW:
            continue
        cells = by_times(ctx, "cells", t, partial(_cells, t, cell))
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
        t, q, dq = q_and_dq(ctx, joint)
        # where two clients alternate as fast as the states come, all of them show one of the two
        kept = _outside(ctx, t)
        t, q, dq = t[kept], q[kept], dq[kept]
        if len(t) < _FEW or float(t[-1] - t[0]) < 2 * count * cell:
            continue
        edges: Floats = np.asarray(np.arange(float(t[0]), float(t[-1]), cell))
        rows = by_times(ctx, "edges", t, partial(_rows_from, t, edges))
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


@check("H1-FIELD-04")
@worst("off_rad_s", "tolerance_rad_s", nothing="no joint moved")
def speed_of_q(ctx: RobotContext) -> Figures:
    """Compare dq with the change of q of each joint while it moves."""
    window = ctx.tolerance("window_s")
    for phase in ctx.phases():
        joint = joint_of(ctx, phase)
        rows = ctx.states.between(*ctx.span(phase))
        t, q, dq = ctx.states.clock[rows], ctx.states.q[rows, joint], ctx.states.dq[rows, joint]
        later = np.searchsorted(t, t + window)
        first = np.flatnonzero(later < len(t))
        if len(first) < 10:
            yield ctx.skipped("too few states while joints move")
        later = later[first]
        change = (q[later] - q[first]) / np.maximum(t[later] - t[first], 1e-6)
        sums = np.concatenate(([0.0], np.cumsum(dq)))
        reported = (sums[later] - sums[first]) / (later - first)
        off = mean(np.abs(change - reported))
        text = f"dq is off the change of q by {off:.2f} rad/s on average"
        yield Figure(off, joint=joint, text=text, shown=f"{off:.2f} rad/s")
