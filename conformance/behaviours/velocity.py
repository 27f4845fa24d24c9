"""dq and ddq agree with q.

A hand that does not report measurements (but the command, a filtered value or another joint's)
contradicts itself: q moves while dq is 0, or tau_est shows contact while q continues into the
object. The checks compare the members of the state in windows, so that a fault of half a second is
detected like a permanent one. Allowed are measurements up to 20 ms old, prediction between them,
coarse encoders, a constant factor on dq, and torque in contact only.

Integrals in windows with motion miss a dq that alternates between twice the speed and 0, and one
that is stuck while the joint stands: these are compared from one state to the next, and at rest.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.robot import RobotContext, joint_of
from dexkit.conformance.checks.speeds import FEW, filled
from dexkit.conformance.kit import sums
from dexkit.conformance.kit.excess import Course
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.kit.row_selection import Rows, SomeTimes, Times
from dexkit.conformance.kit.sums import mean
from dexkit.hand import Floats

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


def _integral(t: Floats, x: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum((x[1:] + x[:-1]) / 2 * np.diff(t))))


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
