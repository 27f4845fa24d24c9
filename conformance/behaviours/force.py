"""tau_est, or a current, shows the force that a joint applies.

Position servos have no gains, and no source says how much force a goal beyond the object makes. So
their grip is recognised by position, and its force compared with that of other grips of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import ROUNDING, Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.contacts import contacts
from dexkit.conformance.checks.figures import Figure, Figures, with_object, worst
from dexkit.conformance.checks.robot import RobotContext, between, only_phase
from dexkit.conformance.checks.stands import (
    FEW_STANDS,
    Stand,
    no_stand,
    no_torque,
    stands,
    torque_member,
    torque_unit,
)
from dexkit.conformance.checks.steps import Step, steps_of
from dexkit.conformance.kit.median import medians
from dexkit.conformance.kit.results import Evidence
from dexkit.hand import Floats

Ranges: TypeAlias = NDArray[np.intp]
"""Rows from the first to before the second, shape (n, 2)."""


def squeezes(ctx: Context) -> tuple[float, float] | None:
    """(begin, end) of the last half second of the last squeeze that has states."""
    for phase in reversed(ctx.phases()):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        tau = ctx.tau(begin, end)
        if np.isfinite(tau).all(axis=1).any():
            return begin, end
    return None


def _squeeze(ctx: Context) -> tuple[float, float, float] | None:
    """(median tau_est of the last half second, begin, end) of a squeeze.

    The failure's place is the whole phase, because an overload before the last half second delays
    the contact too.
    """
    span = squeezes(ctx)
    if span is None:
        return None
    tau = ctx.tau(*span)[:, 0]
    begin = next(b for b, e in map(ctx.span, reversed(ctx.phases())) if e == span[1])
    return float(np.median(tau[np.isfinite(tau)])), begin, span[1]


@check("DEX1-FORCE-01")
@with_object
@worst("tau_nm", "min_tau_nm", nothing="no state while it squeezed")
def in_contact(ctx: Context) -> Figures:
    """tau_est in size while squeezing an object.

    A gripper without force fills 0 throughout: no known client acts on it.
    """
    if no_torque(ctx) is not None:
        none = ctx.failed("not filled", "tau_est is 0 throughout: this gripper measures no force")
        yield replace(none, absent=True).tolerated()
        return
    found = _squeeze(ctx)
    if found is not None:
        tau, begin, end = found
        yield Figure(abs(tau), begin, end, text=f"tau_est {tau:.3f} N m while squeezing")


def _ranges(t: Floats, begins: Floats, ends: Floats, side: Literal["left", "right"]) -> Ranges:
    """Rows of t in each interval: the first, and the first after it, shape (n, 2)."""
    return np.column_stack([np.searchsorted(t, begins), np.searchsorted(t, ends, side)])


def _bounds(values: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Lowest and highest value in each range, NaN if one of them is not a number.

    For an empty range, the value at its beginning.
    """
    longer = np.append(values, np.nan)  # an end may be one past the last row
    if not len(ranges):
        return np.empty(0), np.empty(0)
    low, high = (f.reduceat(longer, ranges.ravel())[::2] for f in (np.minimum, np.maximum))
    return low, high


def _still(ctx: Context) -> Floats:
    """Begins of the consecutive windows during the commands in which q does not change."""
    window, asked = ctx.tolerance("min_rest_s"), ctx.commands.t
    begins: Floats = np.asarray(np.arange(float(asked[0]), float(asked[-1]) - window, window))
    ranges = _ranges(ctx.states.t, begins, begins + window, "left")
    full = np.diff(ranges)[:, 0] >= 5
    low, high = _bounds(ctx.states.q[:, 0], ranges[full])
    return begins[full][high - low <= ctx.tolerance("max_ripple_stroke")]


@check("DEX1-FORCE-02", rests_on=("tau",))
@worst("tau_nm", "max_tau_nm", nothing="the gripper never rests at its target in this recording")
def at_rest(ctx: Context) -> Figures:
    """tau_est while the gripper rests at its target without contact."""
    states, commands = ctx.states, ctx.commands
    if (unknown := ctx.contact_unknown) is not None:
        yield unknown
    if len(commands) < 2:
        yield ctx.skipped("no commands to this hand")
    window = ctx.tolerance("min_rest_s")
    begins = _still(ctx)
    rows = _ranges(states.t, begins, begins + window, "right")
    asked = _ranges(commands.t, begins, begins + window, "left")
    low, high = _bounds(states.q[:, 0], rows)
    goal_low, goal_high = _bounds(commands.q[:, 0], asked)
    rests = (np.diff(rows)[:, 0] >= 5) & (np.diff(asked)[:, 0] >= 3)
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        rests &= high - low <= ctx.tolerance("max_ripple_stroke")
        rests &= goal_high - goal_low <= ctx.tolerance("max_ripple_stroke")
    rests &= _bounds(commands.kp[:, 0], asked)[0] > 0
    if ctx.object_at is not None:
        rests &= low > ctx.object_at + 0.1
    rows, asked, begins = rows[rests], asked[rests], begins[rests]
    errors = medians(states.q[:, 0], rows) - medians(commands.q[:, 0], asked)
    near = np.abs(errors) <= ctx.tolerance("max_error_stroke")
    sizes = medians(np.abs(states.tau[:, 0]), rows[near])
    taus = list(zip(sizes.tolist(), begins[near].tolist(), strict=True))
    if taus:
        # the median of all rests: one of them may be an unannounced contact
        level, begin = sorted(taus)[len(taus) // 2]
        text = f"tau_est {level:.3f} N m at rest (median of {len(taus)} rests)"
        yield Figure(level, begin, begin + window, text=text)


@check("DEX1-FORCE-03", rests_on=("tau",))
def sign(ctx: Context) -> Outcome:
    """That tau_est keeps its sign; and which it has in a grip, which no document says."""
    return all_of(_constant_sign(ctx), warning(_sign_in_grip(ctx)))


@with_object
def _sign_in_grip(ctx: Context) -> Outcome:
    """Sign of tau_est while squeezing."""
    found = _squeeze(ctx.only("squeeze"))
    if found is None or found[0] == 0.0:
        return ctx.skipped("no force was reported while it squeezed")
    tau, begin, end = found
    text = f"tau_est {tau:+.3f} N m while closing on an object"
    if tau < 0:
        return ctx.passed("negative", text, tau_nm=tau)
    return ctx.failed("positive", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)


@check("DEX1-FORCE-04", rests_on=("tau",))
def gripper_unit(ctx: Context) -> Outcome:
    """The largest tau_est; and the smallest, where a specification of the dialect limits it."""
    size = warning(unit(ctx))
    specified = ctx.recording.dialect.interface_specification
    return all_of(size, _unsigned(ctx)) if specified else size


@worst("below_nm", "max_below_nm", nothing="no state with a tau_est")
def _unsigned(ctx: Context) -> Figures:
    """The smallest tau_est in a dialect where it is the strength of the grip."""
    tau = ctx.states.tau[:, 0]
    if np.isfinite(tau).any():
        i = int(np.nanargmin(tau))
        text = f"tau_est from {tau[i]:.2f} to {float(np.nanmax(tau)):.2f} N m"
        at, shown = float(ctx.states.t[i]), f"{tau[i]:.2f} N m"
        yield Figure(-float(tau[i]), at, text=text, shown=shown)


@check("DEX3-FORCE-02", rests_on=("tau",))
def unit(ctx: Context) -> Outcome:
    """The largest tau_est, relative to the joint's torque limit."""
    worst: tuple[float, float, int, float] = (0.0, 0.0, 0, 0.0)
    for joint, spec in enumerate(ctx.joints):
        tau = np.abs(ctx.states.tau[:, joint])
        if not np.isfinite(tau).any():
            continue
        i = int(np.nanargmax(tau))
        worst = max(worst, (float(tau[i]) / spec.tau_max, float(tau[i]), joint, ctx.states.t[i]))
    part, tau_nm, joint, at = worst
    text = ctx.named(f"|tau_est| of at most {tau_nm:.2f} N m", joint)
    if part <= ctx.tolerance("max_part") * (1.0 + ROUNDING):
        return ctx.passed(f"{tau_nm:.2f} N m", text, tau_nm=tau_nm)
    place = ctx.at(ctx.states.topic, float(at))
    if ctx.hand.has_raw_torque:
        return raw_counts(ctx, joint, tau_nm, place)
    return ctx.failed(f"{tau_nm:.3g} N m", text, place, tau_nm=tau_nm).about(joint)


def raw_counts(
    ctx: Context, joint: int, most: float, place: Evidence, unit: str = "N m"
) -> Outcome:
    """The outcome of a hand whose tau_est is in raw counts: no other requirement judges it."""
    text = ctx.named(f"|tau_est| of at most {most:.0f}: not {unit}, looks like raw counts", joint)
    outcome = ctx.failed(f"{most:.0f} counts", text, place).about(joint).tolerated()
    return outcome.because(
        f"tau_est holds the raw register, as some real hands do. Its force in {unit} is not known, "
        "and not judged."
    )


_STEPS = (
    *("step", "joint", "ends", "fingerprint", "recover", "resume", "center", "beside"),
    *("beside-grip", "company", "restart", "service-restart"),
)
"""Phases in which a joint moves freely by a position command."""


_LEAST_STEP = 0.1  # of the stroke


_REST_S, _REST_PART = 0.1, 0.01  # before a step: seconds, and part of the stroke that q may vary


_BEGUN, _WAY = 0.01, 0.5  # parts of a step between which the motor must drive the joint


_STRONG = 0.5  # of the largest tau_est: values that count


_CLEAR = 0.75  # part of them that must have the same sign


@dataclass(frozen=True)
class _Drive:
    """A stretch in which the motor drives a joint: at the beginning of a step, or into an object.

    :param way: direction of drive: 1 or -1.
    :param tau: largest tau_est in size, N m.
    :param sign: of tau_est towards ``way``; 0 where it has both signs, or none worth the name.
    :param contact: whether it presses on the object.
    """

    joint: int
    way: int
    begin: float
    end: float
    tau: float
    sign: int
    contact: bool = False

    def __str__(self) -> str:
        if self.contact:
            return "pressing on the object"
        return f"driven towards {'larger' if self.way > 0 else 'smaller'} q"


def _drive_of(ctx: Context, step: Step) -> _Drive | None:
    """The beginning of a step: up to half of its way, from rest."""
    joint = step.joint
    before = ctx.q(step.begin - _REST_S, step.begin)[:, joint]
    if abs(step.size) < _LEAST_STEP * step.stroke or not len(before):
        return None
    if not ctx.seen(step.begin - _REST_S, step.begin):
        return None  # no state shows whether it was at rest
    if not float(np.ptp(before)) <= _REST_PART * step.stroke:
        return None  # it was still moving: its torque may brake it
    way = 1 if step.size > 0 else -1
    part = (step.q - step.start) / step.size
    half = np.flatnonzero(part >= _WAY)
    if not len(half):
        return None  # other requirements judge whether it arrives
    # before it moves, tau_est may still be that of the previous command
    first = int(np.argmax(part >= _BEGUN))
    begin = float(step.t[first])
    if not ctx.seen(float(step.t[max(first - 1, 0)]), float(step.t[half[0]])):
        return None  # no state shows the torque at the beginning
    return _driven(ctx, joint, way, begin, float(step.t[half[0]]))


def _driven(
    ctx: Context, joint: int, way: int, begin: float, end: float, *, contact: bool = False
) -> _Drive | None:
    tau = ctx.tau(begin, end)[:, joint] * way
    tau = tau[np.isfinite(tau)]
    if not len(tau):
        return None
    largest = float(np.abs(tau).max())
    sign = 0
    if largest >= ctx.tolerance("min_tau_nm"):
        strong = tau[np.abs(tau) >= _STRONG * largest]
        part = float(np.mean(strong > 0))
        sign = 1 if part >= _CLEAR else -1 if part <= 1 - _CLEAR else 0
    return _Drive(joint, way, begin, end, largest, sign, contact)


def _drives(ctx: Context) -> Iterator[_Drive]:
    for phase in (p for name in _STEPS for p in ctx.phases(name)):
        for step in steps_of(ctx, phase):
            found = _drive_of(ctx, step)
            if found is not None:
                yield found
    if len(ctx.joints) == 1 and ctx.object_at is not None:
        for piece in contacts(ctx, ctx.object_at):
            found = _driven(ctx, 0, -1, piece.begin, piece.end, contact=True)
            if found is not None:
                yield found


def _constant_sign(ctx: Context) -> Outcome:
    """Whether tau_est has the same sign in all motions towards one end, and in all contacts."""
    clear = sorted((d for d in _drives(ctx) if d.sign), key=lambda d: d.begin)
    if not clear:
        return ctx.skipped("tau_est has no clear sign in any step from rest")
    for alike in {(d.way, d.contact): None for d in clear}:
        mine = [d for d in clear if (d.way, d.contact) == alike]
        usual = 1 if sum(d.sign for d in mine) >= 0 else -1
        odd = [d for d in mine if d.sign == -usual]
        # a single one may be left over from the previous motion
        if len(odd) >= ctx.tolerance("min_odd"):
            return _turned(ctx, odd, len(mine))
    text = f"tau_est keeps its sign in {len(clear)} drives from rest and contacts"
    return ctx.passed(f"{len(clear)} alike", text)


def _turned(ctx: Context, odd: Sequence[_Drive], among: int) -> Outcome:
    first = odd[0]
    text = ctx.named(
        f"tau_est has the other sign in {len(odd)} of {among} drives; the first at "
        f"{first.begin:.2f} s, {first}, with {first.tau:.2f} N m",
        first.joint,
    )
    places = [ctx.at(ctx.states.topic, d.begin, d.end) for d in odd[:5]]
    outcome = ctx.failed("two signs", text, *places, turned=len(odd))
    return outcome.about(first.joint)


@check("DEX3-FORCE-01")
@with_object
def contact(ctx: Context) -> Outcome:
    """Closing torque of the joints that press on an object."""
    rows = squeezes(ctx)
    if rows is None:
        return ctx.skipped("no state while it squeezed")
    begin, end = rows
    tau = np.median(ctx.tau(begin, end), axis=0)
    closing = np.array([j.closing for j in ctx.joints])
    felt = tau * closing
    pressing = felt[closing != 0]
    weakest, strongest = float(pressing.min()), float(pressing.max())
    text = f"tau_est towards closing from {weakest:.2f} to {strongest:.2f} N m while squeezing"
    if strongest >= ctx.tolerance("min_tau_nm") and weakest > -ctx.tolerance("min_tau_nm"):
        return ctx.passed(f"{strongest:.2f} N m", text, tau_nm=strongest)
    outcome = ctx.failed(
        f"{strongest:.2f} N m", text, ctx.at(ctx.states.topic, begin, end), tau_nm=strongest
    )
    if not ctx.states.tau.any():
        return outcome.because("tau_est is not filled (0 throughout).")
    if weakest <= -ctx.tolerance("min_tau_nm"):
        return outcome.because("tau_est has the wrong sign, in some joints or on this side.")
    return outcome


def _extreme(
    ctx: Context, which: Callable[[Stand, int], bool], force: Callable[[float], float]
) -> tuple[float, int, Stand] | None:
    """The least ``force`` of tau_est at the end of a stretch, in parts of the joint's limit, the
    joint and the stretch; the second least of each joint. None without enough stretches.
    """
    found = []
    for joint, spec in enumerate(ctx.joints):
        mine = [
            (force(float(s.force[-1, joint])) / spec.tau_max, joint, s.begin, s)
            for s in stands(ctx)
            if which(s, joint)
        ]
        found += sorted(mine, key=lambda m: m[:3])[FEW_STANDS - 1 : FEW_STANDS]
    if not found:
        return None
    part, joint, _, stand = min(found, key=lambda f: f[:2])
    return part, joint, stand


@check("BRAINCO-FORCE-01")
def force_in_grip(ctx: Context) -> Outcome:
    """The smallest tau_est towards closing of a joint that stands against the object."""
    if (skipped := no_stand(ctx)) is not None:
        return skipped
    if no_torque(ctx) is not None:
        none = f"{torque_member(ctx)} is 0 throughout the run, in each grip as well"
        return ctx.failed("0", none).tolerated().because("It is not read from the device.")
    unit = torque_unit(ctx)
    worst = _extreme(ctx, lambda s, joint: bool(s.presses[joint]), float)
    if worst is None:
        return ctx.skipped("the object held no joint back for long enough")
    part, joint, one = worst
    tau = part * ctx.joints[joint].tau_max
    text = ctx.named(f"{torque_member(ctx)} of {tau:.2f} {unit} towards closing in a grip", joint)
    limit = ctx.tolerance("min_part")
    if part >= limit:
        return ctx.passed(f"{tau:.2f} {unit}", text, tau_nm=tau)
    place = ctx.at(ctx.states.topic, one.begin, one.end)
    outcome = ctx.failed(f"{tau:.2f} {unit}", text, place, tau_nm=tau).about(joint)
    if part <= -limit:
        return outcome.because("It has the sign of the motor or of q, and not of closing.")
    return outcome


@check("BRAINCO-FORCE-02")
def servo_unit(ctx: Context) -> Outcome:
    """The largest tau_est in the run, relative to the joint's limit."""
    tau = np.abs(np.nan_to_num(ctx.states.tau))
    limits = np.array([j.tau_max for j in ctx.joints])
    if not len(tau):
        return ctx.skipped("no state")
    row, joint = (int(i) for i in np.unravel_index(int(np.argmax(tau / limits)), tau.shape))
    most, name = float(tau[row, joint]), torque_unit(ctx)
    text = ctx.named(f"{torque_member(ctx)} of {most:.3g} {name} at most", joint)
    if most <= ctx.tolerance("max_part") * limits[joint]:
        return ctx.passed(f"{most:.3g} {name}", text, tau_nm=most)
    place = ctx.at(ctx.states.topic, float(ctx.states.t[row]))
    if ctx.hand.has_raw_torque:
        return raw_counts(ctx, joint, most, place, name)
    return ctx.failed(f"{most:.3g} {name}", text, place, tau_nm=most).about(joint)


@check("BRAINCO-FORCE-04", rests_on=("tau",))
def none_without_contact(ctx: Context) -> Outcome:
    """The largest tau_est of a joint that has reached its goal and touches nothing."""
    if (skipped := no_torque(ctx)) is not None:
        return skipped
    unit = torque_unit(ctx)
    worst = _extreme(ctx, lambda s, joint: bool(s.free[joint]), lambda tau: -abs(tau))
    if worst is None:
        return ctx.skipped("no joint stood at its goal for long enough")
    part, joint, one = -worst[0], *worst[1:]
    tau = part * ctx.joints[joint].tau_max
    if (unknown := ctx.contact_unknown) is not None:
        shows = ctx.named(f"{tau:.2f} {unit} at its goal", joint)
        if part <= ctx.tolerance("max_part"):
            return unknown
        advice = ctx.requirement.advice
        return replace(unknown, reason=f"{unknown.reason}; {shows}: {_IF_NOTHING}. {advice}")
    text = ctx.named(
        f"{torque_member(ctx)} of {tau:.2f} {unit} at its goal, where it touches nothing", joint
    )
    if part <= ctx.tolerance("max_part"):
        return ctx.passed(f"{tau:.2f} {unit}", text, tau_nm=tau)
    place = ctx.at(ctx.states.topic, one.begin, one.end)
    outcome = ctx.failed(f"{tau:.2f} {unit}", text, place, tau_nm=tau).about(joint)
    return outcome.because(_OFFSET) if _has_offset(ctx, joint) else outcome


_IF_NOTHING = "if nothing touched it there, that is an offset"


_OFFSET = "It is there before the joint has pressed on anything: an offset."


def _has_offset(ctx: Context, joint: int) -> bool:
    """Whether a joint shows too much force even before its first grip."""
    limit = ctx.tolerance("max_part") * ctx.joints[joint].tau_max
    gripped = min((s.begin for s in stands(ctx) if s.presses[joint]), default=np.inf)
    before = [s for s in stands(ctx) if s.free[joint] and s.end < gripped]
    over = [s for s in before if abs(float(s.force[-1, joint])) > limit]
    return len(over) >= FEW_STANDS


@check("H1-FORCE-01")
@worst("tau_part", "high_part", nothing="the joint was turned for too short a time")
def reported_torque(ctx: RobotContext) -> Figures:
    """tau_est while only tau is commanded."""
    phase, begin, end, joint = only_phase(ctx)
    tau = ctx.tau(begin + 0.01, end)[:, joint]
    if len(tau) < 3:
        return
    wanted, reported = float(phase.params["torque"]), float(np.median(tau))
    text, shown = f"tau_est is {reported:.2f} N m, tau was {wanted:.2f} N m", f"{reported:.2f} N m"
    low, high = ctx.tolerance("low_part"), ctx.tolerance("high_part")
    part = reported / wanted
    yield from between(part, low, high, begin, end, joint=joint, text=text, shown=shown)
