"""Check tau_est against motion and command, and the feed-forward torque and stiffness of commands
against motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import contacts
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.checks.firmness import STIFFNESS, nudges
from dexkit.conformance.checks.grip import torque_scales
from dexkit.conformance.checks.motion import (
    Step,
    half_way,
    least_half_way,
    limited_by_speed,
    limited_by_start,
    noise_at_rest,
    slower,
    steps,
    steps_of,
)
from dexkit.conformance.checks.safety import sags
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.median import median
from dexkit.conformance.stimulus_record import Phase

__all__: list[str] = []

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


@check("DEX1-FORCE-08", "DEX3-FORCE-04")
def one_sign(ctx: Context) -> Outcome:
    """Whether tau_est has a consistent sign relative to the motion that the motor causes."""
    found = list(_drives(ctx))
    if not found:
        return ctx.skipped("no step from rest was made half-way")
    for joint in range(len(ctx.joints)):
        mine = sorted((d for d in found if d.joint == joint), key=lambda d: d.begin)
        signs = [d.sign for d in mine if d.sign]
        usual = 1 if sum(signs) >= 0 else -1
        odd = [d for d in mine if d.sign == -usual]
        # a single one may be left over from the previous motion
        if len(odd) >= ctx.tolerance("min_odd"):
            return _turned(ctx, odd, len(signs))
        for way in (1, -1):
            free = [d for d in mine if not d.contact]
            here, there = ([d.tau for d in free if d.way == w] for w in (way, -way))
            if min(len(here), len(there)) < 2:
                continue
            least = ctx.tolerance("min_part") * float(np.median(there))
            if float(np.median(there)) >= ctx.tolerance("min_tau_nm") and max(here) < least:
                return _one_way(ctx, next(d for d in free if d.way == way), max(here))
    clear = sum(bool(d.sign) for d in found)
    text = f"tau_est has one sign towards the motion in {clear} drives from rest; {len(found)} made"
    return ctx.passed(f"{clear} of {len(found)}", text)


@check("DEX1-FORCE-16", "DEX3-FORCE-07")
def sign_of_the_push(ctx: Context) -> Outcome:
    """Whether tau_est has the sign of the motion when the motor drives a joint from rest."""
    clear = [d for d in _drives(ctx) if d.sign]
    if not clear:
        return ctx.skipped("tau_est has no clear sign in any step from rest")
    wrong = [d for d in clear if d.sign < 0]
    for joint in range(len(ctx.joints)):
        mine = [d for d in wrong if d.joint == joint]
        # a single one may be left over from the previous motion
        if len(mine) < ctx.tolerance("min_odd"):
            continue
        among = sum(d.joint == joint for d in clear)
        text = ctx.named(
            f"tau_est has the sign against the push in {len(mine)} of {among} drives; the first at "
            f"{mine[0].begin:.2f} s, {mine[0]}, with {mine[0].tau:.2f} N m",
            joint,
        )
        places = [ctx.at(ctx.states.topic, d.begin, d.end) for d in mine[:5]]
        return ctx.failed("against the push", text, *places, turned=len(mine)).about(joint)
    text = f"tau_est has the sign of the push in {len(clear) - len(wrong)} of {len(clear)} drives"
    return ctx.passed(f"{len(clear) - len(wrong)} of {len(clear)}", text)


@check("DEX1-FORCE-20")
def constant_sign(ctx: Context) -> Outcome:
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


def _one_way(ctx: Context, drive: _Drive, most: float) -> Outcome:
    text = ctx.named(f"tau_est is at most {most:.3f} N m in size while {drive}", drive.joint)
    place = ctx.at(ctx.states.topic, drive.begin, drive.end)
    return ctx.failed("one direction", text, place, tau_nm=most).about(drive.joint)


# ------------------------------------------------------------------------------------- strength


@check("DEX1-FORCE-09")
@with_object
@worst("part", "min_part", nothing="it never pressed on the object for long enough")
def as_commanded(ctx: Context) -> Figures:
    """The smallest tau_est in contact, relative to kp times the distance to the goal."""
    for piece in contacts(ctx, ctx.touch):
        asked = min(piece.kp * (piece.q - piece.goal), ctx.tolerance("max_asked_nm"))
        if asked >= ctx.tolerance("min_asked_nm"):
            text = f"tau_est of {piece.tau:.2f} N m in contact, where kp times the distance is "
            limit = ctx.tolerance("min_part") * asked
            yield Figure(
                piece.tau / asked,
                piece.begin,
                piece.end,
                text=f"{text}{asked:.2f} N m",
                measure=Measure(piece.tau, limit, "N m", Quantity.TORQUE, False),
            )


@check("DEX3-FORCE-05", "DEX3-FORCE-10")
@with_object
@worst("part", "max_part", nothing="no joint was held back by the object")
def joints_as_commanded(ctx: Context) -> Figures:
    """The smallest and largest tau_est of pressing joints, relative to kp times the distance to the
    goal.

    A requirement without ``max_part`` has no upper limit.
    """
    limits = [(ctx.tolerance("min_part"), True)]
    if "max_part" in ctx.requirement.tolerances:
        limits.append((ctx.tolerance("max_part"), False))
    scales = torque_scales(ctx, ctx.tolerance("min_asked_nm"))
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        given = ctx.given(begin, end) & np.isfinite(ctx.commands.q).all(axis=1)
        if not given.any() or not len(ctx.q(begin, end)):
            continue
        q, tau = (np.median(x, axis=0) for x in (ctx.q(begin, end), ctx.tau(begin, end)))
        goal, kp = (np.median(a[given], axis=0) for a in (ctx.commands.q, ctx.commands.kp))
        for joint, spec in enumerate(ctx.joints):
            asked = float(kp[joint] * (goal[joint] - q[joint])) * spec.closing
            if not spec.closing or min(asked, spec.tau_max) < ctx.tolerance("min_asked_nm"):
                continue
            felt = abs(float(tau[joint] / scales[joint]))  # its sign is judged by DEX3-FORCE-01
            text = f"tau_est of {felt:.2f} N m in contact, where kp times the distance is "
            for part, at_least in limits:
                due = min(asked, spec.tau_max) if at_least else asked
                measure = Measure(felt, part * due, "N m", Quantity.TORQUE, not at_least)
                yield Figure(
                    felt / due,
                    begin,
                    end,
                    joint,
                    f"{text}{due:.2f} N m",
                    limit=part,
                    at_least=at_least,
                    measure=measure,
                )


# ----------------------------------------------------------------------- commands: torque, gains


_LATE = 0.6  # of a pull: before it, a hand may still obey the previous command
_AROUND_S = 0.02  # s before and after a time: states whose median is the position at that time


def _pushed(ctx: Context, phase: Phase, *, after: float = 0.0) -> Iterator[tuple[int, float]]:
    """Joints that a phase pushes, and their motion towards the target, rad.

    Both ends are medians: one state is off by the noise of q, which is allowed to be of the size
    of the motion. A push of which no state shows an end is left out.

    :param after: part of the phase that is skipped.
    """
    for step in steps_of(ctx, phase):
        start: float | None = None
        if after:
            start = _place(ctx, step.joint, step.begin + after * (step.end - step.begin))
        elif ctx.seen(step.begin - _REST_S, step.begin):
            start = step.start
        end = _place(ctx, step.joint, step.end)
        if start is not None and end is not None:
            yield step.joint, (end - start) * (1 if step.size > 0 else -1)


def _pushed_before_gap(ctx: Context, phase: Phase) -> Iterator[tuple[int, float]]:
    """As :func:`_pushed`, up to the last state before a gap that hides the end of a push."""
    for step in steps_of(ctx, phase):
        t = ctx.states.t[ctx.states.between(step.begin, step.end)]
        if not ctx.seen(step.begin - _REST_S, step.begin) or len(t) < 2:
            continue
        gap = int(np.diff(t, append=step.end).argmax())
        end = _place(ctx, step.joint, float(t[gap]) - _AROUND_S)
        if end is not None:
            yield step.joint, (end - step.start) * (1 if step.size > 0 else -1)


def _place(ctx: Context, joint: int, at: float) -> float | None:
    """The median of q around a time, rad: in a steady motion, that of the time itself.

    None without states on both sides of it.
    """
    begin, end = at - _AROUND_S, at + _AROUND_S
    q = ctx.q(begin, end)[:, joint]
    q = q[np.isfinite(q)]
    return median(q) if len(q) and ctx.seen(begin, end, _AROUND_S) else None


def _noise(ctx: Context, joint: int) -> float:
    """The noise of q before a push, rad."""
    return noise_at_rest(ctx, joint, [p for name in ("push", "pull") for p in ctx.phases(name)])


@check("DEX1-GAIN-03", "DEX3-GAIN-04")
def torque_drives(ctx: Context) -> Outcome:
    """Motion by a commanded torque without a position gain.

    A torque towards larger q (of a gripper) or closing (of fingers) must move the joint; the
    opposite one must not move it the wrong way.
    """
    found = list(_pushes(ctx))
    if not found:  # a part of a push can show that a joint moves enough, not that it does not
        found = [
            one
            for phase in ctx.phases()
            for joint, moved in _pushed_before_gap(ctx, phase)
            if moved >= ctx.tolerance("min_motion_stroke", joint)
            and (one := _push(ctx, phase, joint, moved))
        ]
    if not found:
        return ctx.skipped("no state shows the begin and the end of a torque command")
    for phase in ctx.phases("pull"):
        for joint, moved in _pushed(ctx, phase, after=_LATE):
            most = ctx.tolerance("max_against_stroke", joint) + _noise(ctx, joint)
            if moved < -most:
                text = ctx.named(
                    f"moved by {-moved:.2f} {ctx.unit} against a torque that was commanded", joint
                )
                place = ctx.at(ctx.states.topic, *ctx.span(phase))
                return ctx.failed("against it", text, place, motion_rad=moved).about(joint)
    if "max_speed_part" in ctx.requirement.tolerances:
        nothing = ctx.passed("no damping")
        fast = judged(ctx, _speeds(ctx), "speed_rad_s", "max_speed_part", nothing=nothing)
        if not fast.met:
            return fast
    return judged(ctx, found, "motion_rad", "min_motion_stroke", nothing="")


def _pushes(ctx: Context) -> Iterator[Figure]:
    """The motions by a torque."""
    for phase in ctx.phases():
        for joint, moved in _pushed(ctx, phase):
            yield _push(ctx, phase, joint, moved)


def _push(ctx: Context, phase: Phase, joint: int, moved: float) -> Figure:
    text = f"moved by {moved:.2f} {ctx.unit} while a torque was commanded"
    limit = ctx.tolerance("min_motion_stroke", joint) - _noise(ctx, joint)
    return Figure(moved, *ctx.span(phase), joint, text, limit=limit)


def _speeds(ctx: Context) -> Iterator[Figure]:
    """The speeds of joints that a torque moves, with the most that kd allows."""
    for phase in ctx.phases("push"):
        begin, end = ctx.span(phase)
        late = begin + _LATE * (end - begin)
        given = ctx.given(late, end)
        for joint, moved in _pushed(ctx, phase, after=_LATE):
            kd, tau = (np.abs(a[given, joint]) for a in (ctx.commands.kd, ctx.commands.tau))
            if len(kd) and kd.min() > 0:
                speed, most = moved / (end - late), float(np.median(tau / kd))
                unit = f"{ctx.unit}/s"
                text = f"moved at {speed:.2f} {unit} where tau / kd is {most:.2f} {unit}"
                limit = ctx.tolerance("max_speed_part") * most
                yield Figure(speed, late, end, joint, text, limit=limit)


@check("DEX1-GAIN-07", "DEX3-GAIN-07")
@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no state shows the begin and the end of a torque command",
)
def torque_way(ctx: Context) -> Figures:
    """Motion against a commanded torque, without a position gain and beside one.

    A joint that sags with zero gains may sag here.
    """
    sag = np.zeros(len(ctx.joints)) if (known := sags(ctx)) is None else known
    moved = [
        (way + _noise(ctx, joint) + float(sag[joint]), joint, *ctx.span(phase))
        for phase in (*ctx.phases("push"), *ctx.phases("pull"))
        for joint, way in _pushed(ctx, phase, after=_LATE)
    ]
    if moved and len(ctx.joints) == 1:
        held = nudges(ctx, [*ctx.phases(STIFFNESS), *ctx.phases("nudge")])
        moved += [(n.way, 0, n.begin, n.end) for n in held if n.at_rest]
    for way, joint, begin, end in moved:
        against = max(0.0, -way)
        text = f"moved by {against:.2f} {ctx.unit} against a commanded torque"
        yield Figure(against, begin, end, joint, text)


@check("DEX3-GAIN-05")
def grades_of_stiffness(ctx: Context) -> Outcome:
    """Time to half of a step with a third of the client's stiffness, compared with the client's
    stiffness, and with a tenth of it, compared with a third.

    A step at the joint's own top speed, or within its soft start, does not depend on gains, and is
    left out, as is one that no state shows on its way to half.
    """
    stiff = {s.joint: s for p in ctx.phases("stiff") for s in steps_of(ctx, p)}
    soft: dict[int, Step] = {}
    for phase in ctx.phases("soft"):
        for step in steps_of(ctx, phase):
            soft.setdefault(step.joint, step)
    figures: list[Figure] = []
    nothing = "no state shows how the steps got half-way"
    for step in steps(ctx):
        reference = stiff.get(step.joint)
        quick = half_way(reference) if reference is not None else None
        if reference is None or quick is None:
            return ctx.skipped(ctx.named("the stiff step did not get half-way", step.joint))
        took, quick = least_half_way(step), max(quick, 1e-3)
        if not (_seen_to_half(ctx, step) and _seen_to_half(ctx, reference)):
            continue
        soon = took < ctx.tolerance("min_ratio") * quick
        if soon and any(by(ctx, reference) for by in (limited_by_speed, limited_by_start)):
            nothing = "its own speed or start limits every joint's steps, whatever their gains are"
            continue
        figures.append(slower(ctx, step.joint, took, quick, "with a third of the stiffness"))
        softer = soft.get(step.joint)
        if softer is not None and half_way(step) is not None and _seen_to_half(ctx, softer):
            how = "with a tenth of the stiffness, compared with a third,"
            took, quick = least_half_way(softer), max(took, 1e-3)
            figures.append(slower(ctx, step.joint, took, quick, how))
    return judged(ctx, figures, "ratio", "min_ratio", nothing=nothing)


def _seen_to_half(ctx: Context, step: Step) -> bool:
    """Whether states show a step up to twice the time to half of it, and so its fastest part."""
    half = half_way(step)
    return half is None or ctx.seen(step.begin, min(step.begin + 2 * half, step.end))


# ---------------------------------------------------------------------------------------- low
# stiffness


@check("DEX1-GAIN-04")
def soft_commands(ctx: Context) -> Outcome:
    """Progress of a step with low stiffness, as a part of the step."""
    return _progress(ctx, "with little stiffness")


@check("DEX1-GAIN-08")
def fed_commands(ctx: Context) -> Outcome:
    """Progress of a step whose commands have a velocity and a torque, as a part of the step."""
    return _progress(ctx, "with a feed-forward of velocity and torque")


def _progress(ctx: Context, how: str) -> Outcome:
    """The least progress of the steps of the phases that the requirement needs."""
    found = [s for s in steps(ctx) if abs(s.size) >= 0.1 * s.stroke]
    figures = [s.figure(s.progress, f"{how} {s}") for s in found]
    return judged(ctx, figures, "progress", "min_progress", nothing=f"no state during a step {how}")
