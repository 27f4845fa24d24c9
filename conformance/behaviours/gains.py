"""What kp, kd, dq and tau of a command do."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.nudges import STIFFNESS, nudges
from dexkit.conformance.checks.obedience import sags
from dexkit.conformance.checks.robot import (
    LATE_S,
    RobotContext,
    between,
    no_state,
    only_phase,
    speed_between,
)
from dexkit.conformance.checks.steps import (
    _RESTS,
    REST_S,
    Step,
    larger_motions,
    limited_by_speed,
    noise_at_rest,
    not_driven,
    obeyed_before,
    steps,
    steps_of,
)
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.measurement_error import Measure, Quantity
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.stimulus_record import Phase

_GROWS = 0.25
"""Part of the growth of the error by which the way may grow where a soft start limits it."""


def limited_by_start(ctx: Context, step: Step) -> bool:
    """Whether a joint's own soft start limits a step: after much larger changes of its goal from
    rest it mostly came hardly further in the time in which this step got half-way.

    Where gains limit the step, the way grows with the error.
    """
    half, grows = half_way(step), []
    if half is None:
        return False
    for one in larger_motions(ctx, step):
        before = ctx.q(one.begin - REST_S, one.begin)[:, step.joint]
        if not float(np.ptp(before)) <= _RESTS * step.stroke:
            continue
        then = min(int(np.searchsorted(one.t, one.begin + half)), len(one.t) - 1)
        further = abs(float(one.q[then]) - one.start) / (0.5 * abs(step.size)) - 1.0
        grows.append(further / (abs(one.size / step.size) - 1.0))
    return bool(grows) and median(np.array(grows)) <= _GROWS


def half_way(step: Step) -> float | None:
    """Seconds from the command to half of a step; None if it was not reached."""
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not len(part) or not (part >= 0.5).any():
        return None
    return float(step.t[int(np.argmax(part >= 0.5))]) - step.begin


def least_half_way(step: Step) -> float:
    """The same; if half of the step was not reached, a lower bound by the mean speed so far."""
    half = half_way(step)
    if half is not None:
        return half
    progress = (step.final - step.start) / step.size if step.size else 0.0
    return (step.end - step.begin) * max(1.0, 0.5 / max(progress, 1e-3))


def slower(ctx: Context, joint: int, took: float, quick: float, how: str) -> Figure:
    """How many times as long a softer step takes to half-way, with the seconds of both."""
    return Figure(
        took / quick,
        joint=joint,
        text=f"a step {how} takes {took / quick:.1f} times as long to half-way",
        measure=Measure(took, ctx.tolerance("min_ratio") * quick, larger_is_worse=False),
    )


@check("DEX1-GAIN-01", "DEX3-GAIN-01")
def zero_gains(ctx: Context) -> Outcome:
    """Motion towards q while all gains are zero."""
    return not_driven(ctx, "with kp = kd = 0")


def _driven(ctx: Context) -> list[tuple[int, int]]:
    """The joints that the stimulus drives by velocity, with direction: a gripper opens, fingers
    close.
    """
    roles = under_test(ctx.recording.model.name).roles
    if roles is None:
        return [(0, 1)]
    return [(i, 1 if ctx.joints[i].closing > 0 else -1) for i in roles.driven]


def _driven_ways(ctx: Context) -> Iterator[tuple[float, int, Phase]]:
    """Each motion under a commanded velocity without position gain, rad, with joint and phase;
    negative where the joint has moved the other way.
    """
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        given = ctx.commands.dq[ctx.given(begin, end)]
        for joint, way in _driven(ctx):
            if len(given) and not given[:, joint].any():
                continue  # driven by torque in this phase
            q = ctx.q(begin, end)[:, joint]
            if len(q) >= 2 and np.isfinite(q).all():
                yield (float(q[-1]) - float(q[0])) * way, joint, phase


@check("DEX1-GAIN-02", "DEX3-GAIN-03")
@worst("motion_rad", "min_motion_stroke", nothing="no state while a velocity was commanded")
def velocity_drives(ctx: Context) -> Figures:
    """Motion by a commanded velocity without a position gain."""
    for moved, joint, phase in _driven_ways(ctx):
        text = f"moved by {moved:.2f} {ctx.unit} while a velocity was commanded"
        yield Figure(moved, *ctx.span(phase), joint, text)


@check("DEX1-GAIN-06", "DEX3-GAIN-06")
@worst("motion_rad", "max_motion_stroke", nothing="no state while a velocity was commanded")
def velocity_way(ctx: Context) -> Figures:
    """Motion against a commanded velocity without a position gain."""
    for moved, joint, phase in _driven_ways(ctx):
        text = f"moved by {moved:.2f} {ctx.unit} with a commanded velocity"
        yield Figure(max(0.0, -moved), *ctx.span(phase), joint, text)


_REST_S, _REST_PART = 0.1, 0.01  # before a step: seconds, and part of the stroke that q may vary


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


_SMALL = 0.1  # of the range: a step after another soft one, which moved little


_TOO_SOFT = "Dry friction takes what so little stiffness gives; or the gain was rounded to 0."


@check("DEX3-GAIN-02")
def soft_steps(ctx: Context) -> Outcome:
    """Time to half of a step with low gains, compared with the client's gains.

    In some steps other joints keep the client's gains: a joint that uses theirs is as quick as they
    are.

    A step at the joint's own top speed does not depend on gains, and is left out.
    """
    stiff = {s.joint: s for p in ctx.recording.phases("stiff", ctx.side) for s in steps_of(ctx, p)}
    stuck: Outcome | None = None
    nothing, figures = "no state during the steps", []
    soft = [(s, len(p.targets.get(ctx.side, {}))) for p in ctx.phases() for s in steps_of(ctx, p)]
    for step, joints in soft:
        reference = stiff.get(step.joint)
        if reference is None or abs(step.size) < _SMALL * step.stroke:
            continue
        # after another soft step gravity may still move the joint: only the first starts from rest
        if joints == len(ctx.joints) and step.progress < ctx.tolerance("min_progress"):
            text = f"with soft gains it goes {step.progress:.0%} of its way"
            place = ctx.at(ctx.states.topic, step.begin, step.end)
            outcome = ctx.failed(f"{step.progress:.0%}", ctx.named(text, step.joint), place)
            stuck = stuck or outcome.about(step.joint).tolerated().because(_TOO_SOFT)
            continue
        quick = half_way(reference)
        if quick is None:
            return ctx.skipped(ctx.named("the stiff step did not get half-way", step.joint))
        took, quick = least_half_way(step), max(quick, 1e-3)
        if took < ctx.tolerance("min_ratio") * quick and limited_by_speed(ctx, reference):
            nothing = "its own speed limits every joint's steps, whatever their gains are"
            continue
        figures.append(slower(ctx, step.joint, took, quick, "with soft gains"))
    outcome = judged(ctx, figures, "ratio", "min_ratio", nothing=nothing)
    return outcome if outcome.met is False or stuck is None else stuck


@check("DEX1-GAIN-05")
@worst("part", "max_part", nothing="no state while it was pushed")
def spring(ctx: Context) -> Figures:
    """The largest displacement by a torque, relative to torque / kp."""
    for nudge in nudges(ctx, [*ctx.phases(), *ctx.phases(STIFFNESS)]):
        limit = ctx.tolerance("max_part") * nudge.asked
        yield Figure(
            nudge.way / nudge.asked,
            nudge.begin,
            nudge.end,
            text=f"a torque displaced it by {nudge.way:.3f} {ctx.unit}, through kp by "
            f"{nudge.asked:.3f} {ctx.unit}",
            measure=Measure(nudge.way, limit, "rad", Quantity.POSITION),
        )


_SOME = 20  # states before a phase or at its end that are averaged


@check("H1-GAIN-01")
@worst("way_rad", "tolerance_part", nothing="")
def robot_stiffness(ctx: RobotContext) -> Figures:
    """Displacement of a joint with low kp under a torque."""
    phase, begin, end, joint = only_phase(ctx)
    wanted = float(phase.params["way"])
    before = ctx.q(begin - LATE_S, begin)[-_SOME:, joint]
    after = ctx.q(begin, end)[-_SOME:, joint]
    if not len(before) or not len(after):
        yield no_state(ctx, phase)
        return
    way = float(after.mean() - before.mean())
    text = f"it is displaced by {way:.3f} rad; tau / kp is {wanted:.3f} rad"
    low, high = (1 + sign * ctx.tolerance("tolerance_part") for sign in (-1, 1))
    shown = f"{way:.3f} rad"
    yield from between(way / wanted, low, high, begin, end, joint=joint, text=text, shown=shown)


@check("H1-GAIN-02")
@worst("speed_part", "high_part", nothing="")
def velocity(ctx: RobotContext) -> Figures:
    """The speed of a joint with a commanded velocity."""
    phase, begin, end, joint = only_phase(ctx)
    wanted = float(phase.params["speed"])
    speed = speed_between(ctx, phase, (begin + end) / 2, end)
    if speed is None:
        yield no_state(ctx, phase)
        return
    text, shown = f"{speed:.2f} rad/s, commanded {wanted:.2f} rad/s", f"{speed:.2f} rad/s"
    low, high = ctx.tolerance("low_part"), ctx.tolerance("high_part")
    yield from between(speed / wanted, low, high, begin, end, joint=joint, text=text, shown=shown)


@check("H1-GAIN-03")
@worst("motion_rad", "min_motion_rad", nothing="")
def torque(ctx: RobotContext) -> Figures:
    """Motion of a joint under a torque."""
    phase, begin, end, joint = only_phase(ctx)
    q = ctx.q(begin, end + 0.05)[:, joint]
    if not len(q):
        yield no_state(ctx, phase)
        return
    wanted = float(phase.params["torque"])
    sign = math.copysign(1.0, wanted)
    way = sign * (q - q[0])
    far = float(way[np.argmax(np.abs(way))])
    yield Figure(far, begin, end, joint, f"{wanted:.2f} N m turn it by {far * sign:.3f} rad")
