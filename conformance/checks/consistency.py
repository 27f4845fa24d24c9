"""Check that q, dq and tau_est of the state agree with each other.

A hand that does not report measurements (but the command, a filtered value or another joint's)
contradicts itself: q moves while dq is 0, or tau_est shows contact while q continues into the
object. The checks compare the members of the state in windows, so that a fault of half a second is
detected like a permanent one. Allowed are measurements up to 20 ms old, prediction between them,
coarse encoders, a constant factor on dq (DEX1-FIELD-16 reports it), and torque in contact only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dexkit.conformance.checks import Context, check
from dexkit.conformance.checks.figures import Figure, Figures, with_object, worst
from dexkit.conformance.excess import Course
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.median import median
from dexkit.conformance.provenance import TIMES
from dexkit.conformance.row_selection import Rows, SomeTimes, Times, finite_rows
from dexkit.conformance.sums import total
from dexkit.hand import Floats
from dexkit.models import model
from dexkit.unseen import UNSEEN_S

__all__ = ["FOUGHT_OVER", "contacts", "filled"]

_FEW = 10
"""Fewest measurements for a verdict."""
_FAST = 0.999
"""Quantile of the reported speeds that counts as the hand's fastest, so that a single wrong value
does not count."""
_OWN = 1.2
"""Allowed factor over that speed."""
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


def _fastest(ctx: Context, joint: int) -> float:
    """The joint's fastest speed, rad/s: as reported, or its profile's where dq is not filled."""
    fast = ctx.once(("fast", joint), lambda: _reported_speed(ctx, joint))
    return (
        ctx.joints[joint].dq_max if fast is None else max(_OWN * fast, ctx.tolerance("min_speed"))
    )


def _reported_speed(ctx: Context, joint: int) -> float | None:
    """The quantile :data:`_FAST` of abs(dq); None if dq is not filled."""
    dq = ctx.states.dq[:, joint]
    dq = np.abs(dq[finite_rows(dq)])
    if not len(dq) or not dq.any():
        return None
    row = int(_FAST * (len(dq) - 1))
    return float(np.partition(dq, row)[row])


@check("DEX1-FIELD-15", "DEX3-FIELD-15", rests_on=(TIMES,))
@worst("change_rad", "max_change_rad", nothing="too few states with a position")
def jumps(ctx: Context) -> Figures:
    """The largest change of q between two states, relative to the speed limit."""
    for joint in range(len(ctx.joints)):
        good = ctx.known_states(joint, "q")
        t, q = ctx.states.clock[good], ctx.states.q[good, joint]
        if len(t) < _FEW:
            continue
        speed = _fastest(ctx, joint)
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


FOUGHT_OVER = (
    *("nan", "out-of-range", "empty", "short", "long", "wrong-id", "negative", "burst"),
    "two-writers",
)
"""Stimuli with bad or contradictory commands: a hand that obeys them may really oscillate."""


def _noise(up: Floats, down: Floats, most: float) -> float:
    """By how much q goes forth and back in nearly all of the cells in which the joint stays, rad.

    A sensor has its noise at rest as well as in motion; old values differ from fresh ones only
    while the joint moves, in fewer of the cells: the median and the median deviation from it tell
    how much noise makes. 0 where it stays in fewer than half of the cells.

    :param most: way in a cell, rad, up to which noise alone may have made it.
    """
    back = np.minimum(up, down)
    stays = (up > 0) & (down > 0) & (np.abs(up - down) <= np.maximum(0.5 * back, most))
    if 2 * int(stays.sum()) < len(back):
        return 0.0
    middle = float(np.median(back[stays]))
    return middle + _SPREADS * float(np.median(np.abs(back[stays] - middle)))


_SPREADS = 4.0
"""Median deviations from the median within which 99 % of a cell's noise is."""


@check("DEX1-FRESH-03", "DEX3-FRESH-03", rests_on=(TIMES,))
@worst("turns", "max_turns", nothing="too few states with a position")
def alternates(ctx: Context) -> Figures:
    """Number of cells with a reversal of q, in the worst window."""
    cell = ctx.tolerance("cell_s")
    count = round(ctx.tolerance("window_s") / cell)
    window = count * cell
    fought = [ctx.span(p) for n in FOUGHT_OVER for p in ctx.phases(n)]
    for joint in range(len(ctx.joints)):
        good = ctx.known_states(joint, "q")
        t, q = ctx.states.t[good], ctx.states.q[:, joint][good]
        for begin, end in fought:
            kept = (t < begin) | (t > end)
            t, q = t[kept], q[kept]
        if len(t) < _FEW:
            continue
        limit = max(
            ctx.tolerance("min_turn_stroke", joint),
            _fastest(ctx, joint) * ctx.tolerance("max_age_s"),
        )
        change = np.diff(q)
        rows = np.flatnonzero(~(np.abs(change) < ctx.tolerance("ignored_stroke", joint)))
        change = change[rows]
        cells = ((t[rows + 1] - t[0]) / cell).astype(np.intp)
        most = max(count, int((float(t.max()) - float(t[0])) / cell) + 1)
        up, down = (
            np.bincount(cells, weights=np.maximum(way * change, 0.0), minlength=most)
            for way in (1, -1)
        )
        back = np.minimum(up, down)
        # even noise of +-a goes forth and back by a third of a from state to state, and in 99 % of
        # the cells of n states by no more than a (n / 3 + 1.1 n ** 0.5)
        states, even = len(t) / most, ctx.tolerance("min_turn_stroke", joint)
        most_noise = even * (states / 3 + 1.1 * states**0.5)
        ways = np.asarray(up, dtype=float), np.asarray(down, dtype=float)
        noise = min(_noise(*ways, 2 * even), most_noise)
        often = np.convolve(back >= limit + noise, np.ones(count), "valid")
        i = int(np.argmax(often))
        turns, at = int(often[i]), float(t[0]) + i * cell
        text = (
            f"in the worst {window:.2g} s q goes forth and back within {cell:g} s {turns} times, "
            f"by up to {back[i : i + count].max():.3f} {ctx.unit}"
        )
        # a delay does not reorder states
        shown = f"{turns} times"
        yield Figure(turns, at, at + window, joint, text, shown=shown, late=math.inf)


def filled(ctx: Context) -> bool:
    """Whether any dq is non-zero; usually decided by the first states."""
    dq = ctx.states.dq
    return bool(np.nan_to_num(dq[:_FEW]).any() or np.nan_to_num(dq[_FEW:]).any())


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
    return median(steps) if len(steps) >= _FEW else 0.0


def _window_error(
    ctx: Context, x: _Joint, stroke: float, held: float
) -> tuple[float, float, float] | None:
    """Error, ratio and begin of a joint's worst window; None if it does not move.

    :param held: see :func:`held_s`.
    """
    step = max(ctx.tolerance("slope_s"), STAIRS * held)
    count = round(ctx.tolerance("window_s") / step)
    if len(x.t) < _FEW or x.t[-1] - x.t[0] < 2 * count * step:
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
    courses = {i: _course(ctx, x) for i, x in enumerate(joints) if len(x.t) >= _FEW}
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
    if len(moving) < _FEW or not reach:
        return 1.0
    moved = x.q.take(ends[moving]) - x.q[starts].take(moving)
    ratios = np.sort(moved / dq_integral.take(moving))
    low, middle, high = (float(ratios[int(p * (len(ratios) - 1))]) for p in (0.25, 0.5, 0.75))
    return middle if middle and high - low <= 0.2 * abs(middle) else 1.0


# --------------------------------------------------------------------------------------- torque


@dataclass(frozen=True)
class _Pressing:
    """A stretch of states in which a gripper is commanded into its object.

    :param begin: seconds; likewise ``end``.
    :param tau: median of abs(tau_est), N m.
    :param q: median, rad; likewise ``goal``, clamped to the stroke.
    :param kp: the lowest commanded, N m/rad.
    :param most: the largest kp times the distance from the goal, N m, in it and in the
        :data:`_OBEYS_S` before it: of a goal that changes the hand may still follow an earlier one.
    """

    begin: float
    end: float
    tau: float
    q: float
    goal: float
    kp: float
    most: float


_OBEYS_S = 0.1
"""Seconds from a command to the state of a hand that follows it, or more."""


def _newest(ctx: Context) -> tuple[Rows, Floats]:
    """For each state, the row of the newest command (-1 without one) and its age in seconds."""
    t, asked = ctx.states.t, ctx.commands.t
    rows = np.searchsorted(asked, t, "right") - 1
    ages = np.where(rows >= 0, t - asked[np.maximum(rows, 0)], np.inf)
    return rows, ages


def _goals(ctx: Context, rows: Rows) -> Floats:
    """The commanded q within the stroke, at each state."""
    spec = ctx.joints[0]
    return np.asarray(np.clip(ctx.commands.q[np.maximum(rows, 0), 0], spec.q_min, spec.q_max))


def _usual_kp(ctx: Context) -> float:
    """The kp of the model's own client, N m/rad."""
    return model(ctx.recording.dialect.model).gains[0][0]


def _stiffness(ctx: Context, rows: Rows) -> Floats:
    """Kp of the command before each state, N m/rad; the usual one where gains are not used."""
    usual = _usual_kp(ctx)
    if not ctx.recording.dialect.gains_are_used:
        return np.full(len(rows), usual)
    return np.asarray(ctx.commands.kp[np.maximum(rows, 0), 0])


def contacts(ctx: Context, touch: float) -> list[_Pressing]:
    """Consecutive pieces of all stretches in which a hand presses on an object."""
    states, spec = ctx.states, ctx.joints[0]
    rows, ages = _newest(ctx)
    goals = _goals(ctx, rows)
    depth, settle = ctx.tolerance("min_depth_stroke"), ctx.tolerance("settle_s")
    stiff, usual = _stiffness(ctx, rows), _usual_kp(ctx)
    with np.errstate(invalid="ignore"):
        pressing = (
            (ages < ctx.tolerance("max_age_s"))
            & (goals < touch - depth)
            & (states.q[:, 0] < touch + ctx.tolerance("near_stroke"))
            & (states.q[:, 0] > spec.q_min + ctx.tolerance("near_stroke"))
            & (stiff >= 0.5 * usual)
            & np.isfinite(states.tau[:, 0])
        )
    edges = np.flatnonzero(np.diff(np.concatenate(([0], pressing.view(np.int8), [0]))))
    asked = stiff * (states.q[:, 0] - goals)
    found = []
    window = ctx.tolerance("window_s")
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        begin, end = float(states.t[first]) + settle, float(states.t[last - 1])
        while begin + window <= end:
            before, *inside = np.searchsorted(states.t, (begin - _OBEYS_S, begin, begin + window))
            piece = slice(*inside)
            if piece.stop - piece.start >= 5:
                found.append(
                    _Pressing(
                        begin,
                        begin + window,
                        median(np.abs(states.tau[piece, 0])),
                        median(states.q[piece, 0]),
                        median(goals[piece]),
                        float(stiff[piece].min()),
                        float(asked[before : piece.stop].max()),
                    )
                )
            begin += window
    return found


@check("DEX1-FORCE-06")
@with_object
@worst("tau_nm", "min_tau_nm", nothing="it never pressed on the object for long enough")
def force_in_every_contact(ctx: Context) -> Figures:
    """The smallest abs(tau_est) of all pieces of all contacts with the object."""
    for piece in contacts(ctx, ctx.touch):
        text = (
            f"tau_est of {piece.tau:.3f} N m while q was at {piece.q:.2f} {ctx.unit} on the object "
            f"and {piece.goal:.2f} {ctx.unit} was commanded"
        )
        yield Figure(piece.tau, piece.begin, piece.end, text=text)


@check("DEX1-FIELD-18")
@with_object
@worst("part", "max_depth_part", nothing="tau_est shows no contact with the object")
def stops_at_object(ctx: Context) -> Figures:
    """Motion of q into the object while tau_est shows contact, as a part of the command."""
    touch = ctx.touch
    for piece in contacts(ctx, touch):
        if piece.tau < ctx.tolerance("min_tau_nm"):
            continue
        part = max((touch - piece.q) / (touch - piece.goal), 0.0)
        text = (
            f"pressing on an object at {touch:.2f} {ctx.unit} with {piece.tau:.2f} N m, q was at "
            f"{piece.q:.2f} {ctx.unit}, and {piece.goal:.2f} {ctx.unit} was commanded"
        )
        limit = ctx.tolerance("max_depth_part") * (touch - piece.goal)
        measure = Measure(touch - piece.q, limit, "rad", Quantity.POSITION)
        shown = f"{part:.0%} of the way in"
        yield Figure(part, piece.begin, piece.end, text=text, shown=shown, measure=measure)


@check("DEX1-FORCE-07")
@worst("tau_nm", "max_tau_nm", nothing="the gripper never rests without contact in this recording")
def no_force_at_any_rest(ctx: Context) -> Figures:
    """The largest tau_est at rest without contact, beyond what the distance to the goal
    explains.
    """
    states, spec = ctx.states, ctx.joints[0]
    if (unknown := ctx.contact_unknown) is not None:
        yield unknown
    if not len(states) or not len(ctx.commands):
        yield ctx.skipped("no states, or no commands to this hand")
    ends = ctx.tolerance("clear_stroke")
    low = (spec.q_min if ctx.object_at is None else ctx.object_at) + ends
    rows, ages = _newest(ctx)
    goals, stiff = _goals(ctx, rows), _stiffness(ctx, rows)
    offs = np.abs(goals - states.q[:, 0])
    feed = np.maximum(rows, 0)
    with np.errstate(invalid="ignore"):
        plain = (ctx.commands.tau[feed, 0] == 0) & (ctx.commands.dq[feed, 0] == 0)
        held = (ages < ctx.tolerance("max_age_s")) & plain & (stiff > 0)
        held &= offs <= ctx.tolerance("max_error_stroke")
    idle = ages > ctx.recording.model.command_timeout + 0.5  # before the first one, too
    window = ctx.tolerance("min_rest_s")
    for begin in np.arange(float(states.t[0]), float(states.t[-1]) - window, 0.5 * window).tolist():
        piece = slice(*np.searchsorted(states.t, (begin, begin + window)))
        q, tau = states.q[piece, 0], states.tau[piece, 0]
        if len(q) < 5 or not (np.isfinite(q).all() and np.isfinite(tau).all()):
            continue
        if q.min() < low or q.max() > spec.q_max - ends:
            continue
        if float(np.ptp(q)) > ctx.tolerance("max_ripple_stroke"):
            continue
        if held[piece].all() and float(np.ptp(goals[piece])) <= ctx.tolerance("max_ripple_stroke"):
            pull = ctx.tolerance("max_stiffness") * median(stiff[piece] * offs[piece])
        elif idle[piece].all():
            pull = 0.0
        else:
            continue
        size, limit = median(np.abs(tau)), ctx.tolerance("max_tau_nm") + pull
        text = f"tau_est of {size:.3f} N m at the worst rest without contact"
        yield Figure(size, begin, begin + window, text=text, limit=limit)
