"""What kp, kd, dq and tau of a command do."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.nudges import STIFFNESS, displacement_noise, is_alike, nudges
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
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import CLOSED, OPEN, FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import ASIDE
from dexkit.conformance.stimuli.phases import Place, stimulus
from dexkit.conformance.stimuli.robot import SPEED, RobotScript
from dexkit.conformance.stimuli.script import Steps, with_gains, without_gains
from dexkit.hand import Side

_PUSH = (0.25, 1.0)
"""Least and greatest torque of a push, N m: the greatest is that of a grip by the client's lead."""
_NUDGE, NUDGE_SECONDS = 0.6, 0.3
"""A torque that pushes a hand that is held by kp, N m, and for how long, s."""
_BACK_SECONDS = 0.15
"""Seconds in which it comes back from there."""
_LIMP_SECONDS = 0.22
"""Seconds of zero gains with one q; the other side makes a step meanwhile, as in ``single``."""
_SOFTEST, _SOFT_STEP = 0.8, 0.3
"""kp, N m/rad, and size, in parts of the stroke, of a soft step."""
_PUSH_SPEED, _PUSH_DAMPING, _PUSH_SECONDS = 0.1, 0.3, 0.35  # strokes/s, N m s/rad, s
_FED_DQ, _FED_TAU, _FED_SECONDS = -0.5, 0.1, 0.5
"""A feed-forward towards closed and a torque towards open, rad/s and N m, and for how long, s: with
the client's gains they move the end of a step by less than 0.02 rad. A hand that takes them for
limits makes a quarter of the step."""
_SOFTER = 0.1
"""Stiffness of a soft step as a part of the client's."""
_MILD = 1.0 / 3.0
"""The same of a step with the stiffness of Unitree's C++ example, 0.5 N m/rad where its grip has
1.5 (docs/sources/unitree-dex.md#b1)."""
_TORQUE, _TORQUE_DAMPING, _TORQUE_SECONDS = 0.3, 0.5, 0.25  # N m, N m s/rad, s
# rad/s and N m s/rad of joints that are driven by a velocity
_DRIVE_SPEED, _DRIVE_DAMPING = 0.35, 0.5
# of joints that move slowly, N m/rad and N m s/rad: still under way five seconds later
_SLOW_GAINS = (0.2, 0.8)
_SLOW_PART = 0.08
"""The same of position servos: part of their full speed."""
_TORQUE_PART = 0.1  # of the joint's largest torque
_MOVED = 0.1  # rad after which the torque is taken off


@stimulus("stiffness", GripperScript, after="foreign")
def push_each_held(script: GripperScript) -> Steps:
    """A torque pushes hands that are held by kp without contact, after the bad commands."""
    yield from push_held(script, script.plan.sides)


def push_held(script: GripperScript, sides: Sequence[Side]) -> Steps:
    """Push hands that are held without contact by a torque."""
    if not sides or not script.gains_used or "stiffness" not in script.plan.phases:
        return
    yield from script.hold_as("stiffness", sides, NUDGE_SECONDS, nudged(script, sides))
    yield from script.hold(_BACK_SECONDS)


def nudged(script: GripperScript, sides: Sequence[Side]) -> dict[Side, Motors]:
    """Commands to hold, with a torque beside."""
    return {s: (replace(script.motors(s, script.goal[s])[0], tau=_NUDGE),) for s in sides}


@stimulus(
    "limp unlike push drive fed",
    GripperScript,
    after="burst",
    applies=with_gains,
)
def drive_without_kp(script: GripperScript) -> Steps:
    """Commands without a position gain."""
    sides = script.plan.sides
    yield from script.everyone("center", dict.fromkeys(sides, (0.8 * script.stroke,)))
    if script.plan.phases & {"limp", "unlike"}:
        script.report("commands without force (zero gains): the hand must not be pulled")
        for side in sides:
            yield from _gripper_limp(script, side)
    if "push" in script.plan.phases:
        # in opposite directions, so that a torque of the other side's shows
        for names in (("pull", "push"), ("push", "pull")):
            yield from push_gripper(script, dict(zip(sides, names, strict=False)))
    if "drive" in script.plan.phases:
        yield from drive_gripper(script, sides, 0.16, seconds=0.35)
    if "fed" in script.plan.phases:
        yield from _feed_forward(script, sides)
    else:
        yield from script.back()


def _feed_forward(script: GripperScript, sides: Sequence[Side]) -> Steps:
    """The way back to the middle, with a feed-forward that hardly changes it."""
    script.report("a velocity and a torque beside a position: it must be reached all the same")
    goals = {s: script.home(s) for s in sides}
    fed = {s: (Motor(q=q, dq=_FED_DQ, tau=_FED_TAU),) for s, (q,) in goals.items()}
    yield from script.hold_as(
        "fed", sides, _FED_SECONDS, fed, targets={s: {0: q} for (s, (q,)) in goals.items()}
    )
    script.goal.update(goals)


def _gripper_limp(script: GripperScript, side: Side) -> Steps:
    """Zero gains of one side, with a q on either side of the hand, as a weight pulls the same
    way at both; the others make steps by their own gains.
    """
    others = [s for s in script.plan.sides if s != side]
    for q in (script.low(side), script.stroke):
        phase = script.begin("limp", (side,), targets={side: {0: q}})
        ends = [phase]
        if others:
            script.goal.update({s: script.aside(s, 0.4 * ASIDE) for s in others})
            targets = {s: script.goal[s] for s in others}
            ends.append(script.begin("unlike", others, targets=targets))
        yield from script.hold(_LIMP_SECONDS, {side: (Motor(q=q, kp=0.0, kd=0.0),)})
        for ended in ends:
            script.end(ended)


def push_gripper(script: GripperScript, names: Mapping[Side, str]) -> Steps:
    """Close or open each side by a torque alone, which grows until the hand moves.

    :param names: ``pull`` or ``push`` for each side.
    """
    script.report("a torque without a position gain: the hand must move with it")
    ways = {s: -1 if name == "pull" else 1 for s, name in names.items()}
    phases = []
    for name in dict.fromkeys(names.values()):
        mine = [s for s in names if names[s] == name]
        end = 0.0 if name == "pull" else script.stroke
        phases.append(script.begin(name, mine, targets={s: {0: end} for s in mine}))
    tau = dict.fromkeys(names, _PUSH[0])
    while script.elapsed(phases[0]) < _PUSH_SECONDS:
        for s, way in ways.items():
            if way * script.obs.dq.get(s, (0.0,))[0] < _PUSH_SPEED * script.stroke:
                tau[s] = min(tau[s] * 1.02, _PUSH[1])
        yield from script.command(
            {
                s: (Motor(script.goal[s][0], tau=way * tau[s], kp=0.0, kd=_PUSH_DAMPING),)
                for s, way in ways.items()
            }
        )
    for phase in phases:
        script.end(phase)


def drive_gripper(
    script: GripperScript,
    sides: Sequence[Side],
    part: float,
    kd: float = 0.5,
    *,
    seconds: float = 0.55,
    last_hz: float = 0.0,
) -> Steps:
    """Open at a steady low speed by velocity feedback alone, whatever the friction.

    :param part: of the stroke in a second: far from the stop even after a whole time-out.
    :param last_hz: rate of the last few commands; 0: as the others.
    """
    script.report("slow motion")
    if not sides:
        return
    phase = script.begin("drive", sides)
    slow = part * script.stroke
    wanted = dict.fromkeys(sides, slow)
    # by q, as dq may be wrong: over as many commands as are visible as motion
    seen: deque[tuple[int, Mapping[Side, float]]] = deque(maxlen=8)
    motors: dict[Side, Motors] = {}
    while script.elapsed(phase) < seconds:
        here = {s: script.obs.q[s][0] for s in sides if s in script.obs.q}
        seen.append((script.obs.now_ns, here))
        then, before = seen[0]
        took = max((script.obs.now_ns - then) / 1e9, 1e-3)
        for s in sides:
            if (here.get(s, 0.0) - before.get(s, 0.0)) / took < slow:
                wanted[s] = min(wanted[s] * 1.03, 20 * slow)
        motors = {s: (Motor(script.goal[s][0], wanted[s], kp=0.0, kd=kd),) for s in sides}
        yield from script.command(motors)
    if last_hz:
        period, script.period_ns = script.period_ns, round(1e9 / last_hz)
        yield from script.hold(max(0.05, 5 / last_hz), motors)
        script.period_ns = period
    script.end(phase)


@stimulus("", GripperScript, after="burst", before="replay", applies=without_gains)
def send_no_gains(script: GripperScript) -> Steps:
    """From here on, as clients of such a dialect send none."""
    script.gainless = True
    yield from ()


def step_softly(script: GripperScript, sides: Sequence[Side]) -> Steps:
    """A step without contact with the least stiffness."""
    if not script.gains_used or "soft" not in script.plan.phases:
        return
    goals = {s: script.aside(s, _SOFT_STEP) for s in sides}
    yield from script.hold_as(
        "soft",
        sides,
        0.8,
        {s: (Motor(q=q, kp=_SOFTEST),) for (s, (q,)) in goals.items()},
        targets={s: {0: q} for (s, (q,)) in goals.items()},
    )
    script.goal.update(goals)


@stimulus("stiff soft mild", FingerScript, after="burst", leaves=Place.AWAY)
def step_stiff_and_soft(script: FingerScript) -> Steps:
    """A step with the client's gains, with a tenth of its stiffness and with a third of it."""
    script.report("a stiff step and a soft one: the gains must make a difference")
    yield from script.to("center", OPEN)
    kinds = ("stiff", CLOSED - 5.0, 1.0), ("soft", OPEN, _SOFTER), ("mild", CLOSED - 5.0, _MILD)
    for name, percent, part in kinds:
        poses = {s: script.pose(s, percent) for s in script.plan.sides}
        motors = {
            s: [replace(m, kp=part * m.kp) for m in script.motors(s, pose)]
            for s, pose in poses.items()
        }
        yield from script.hold_as(name, script.plan.sides, 0.6, motors, targets=poses)
        script.goal.update(poses)
    yield from _step_unevenly(script)


def _step_unevenly(script: FingerScript) -> Steps:
    """Steps in which some joints are soft and the others are not, three times with others."""
    script.report("some joints soft, the others not: each by its own gains")
    sides = script.plan.sides
    for percent in (OPEN, CLOSED - 5.0, OPEN):
        splits = script.next_splits()
        poses = {s: script.pose(s, percent) for s in sides}
        targets = {s: {i: poses[s][i] for i in sorted(splits[s])} for s in sides}
        motors = {
            s: [
                replace(m, kp=_SOFTER * m.kp) if i in splits[s] else m
                for i, m in enumerate(script.motors(s, pose))
            ]
            for s, pose in poses.items()
        }
        yield from script.hold_as("soft", sides, 0.5, motors, targets=targets)
        script.goal.update(poses)


@stimulus("limp", FingerScript, after="soft", leaves=Place.AWAY)
def limp_fingers(script: FingerScript) -> Steps:
    """Zero gains, with a q far towards closed, and then with one towards open."""
    script.report("commands without force (zero gains): the hand must not be pulled")
    sides = script.plan.sides
    yield from script.hold(0.1)
    # what moves by its weight moves the same way whatever q is
    for percent in (CLOSED, 0.0):
        targets = {s: script.pose(s, percent) for s in sides}
        yield from script.hold_as(
            "limp", sides, 0.2, script.all(percent, kp=0.0, kd=0.0), targets=targets
        )


@stimulus("push", FingerScript, after="mixed", leaves=Place.AWAY)
def push_fingers(script: FingerScript) -> Steps:
    """Close and open each flexing joint by a torque alone, while others are driven the other
    way: a torque of another joint or side shows.
    """
    script.report("a torque without a position gain: the joints must move with it")
    sides = script.plan.sides
    for first in (True, False):
        pushed = {s: _pushed_ways(script, s, first) for s in sides}
        phases = []
        for name, way, percent in (("push", 1, 100.0), ("pull", -1, 0.0)):
            targets = {
                s: {i: script.pose(s, percent)[i] for i, w in pushed[s].items() if w == way}
                for s in sides
            }
            phases.append(script.begin(name, sides, targets=targets))
        motors = {s: list(script.motors(s, script.goal[s])) for s in sides}
        for s in sides:
            for i, way in pushed[s].items():
                tau = way * math.copysign(_TORQUE, script.joints[s][i].closing)
                motors[s][i] = replace(motors[s][i], tau=tau, kp=0.0, kd=_TORQUE_DAMPING)
        yield from script.hold(_TORQUE_SECONDS, motors)
        for phase in phases:
            script.end(phase)


def _pushed_ways(script: FingerScript, side: Side, first: bool) -> dict[int, int]:
    """The flexing joints with 1 where they close and -1 where they open, first or afterwards.

    Joints of one motor go the same way. On the left no motor goes as the next one does for
    long, and neither do those of one place in two fingers; the right hand has another order.
    """
    flexing = [[i for i in m if script.joints[side][i].closing] for m in script.model.motors]
    bit = 1 if side is Side.LEFT else 2
    return {
        i: 1 if bool((n ^ n >> bit) & 1) is not first else -1
        for n, joints in enumerate(filter(None, flexing))
        for i in joints
    }


def drive_fingers(
    script: FingerScript,
    name: str,
    sides: Sequence[Side],
    others: Mapping[Side, Motors],
    *,
    guarded: Mapping[Side, frozenset[int]] | None = None,
) -> Steps:
    """Some joints by a velocity or a torque, others slowly to a position: both are under way
    for long.

    :param guarded: the joints with time-out protection.
    """
    hands = dict(others)
    targets: dict[Side, dict[int, float]] = {}
    by_torque = _by_torque(script)
    for s in sides:
        motors = script.guarded(script.motors(s, script.goal[s]), s, guarded or {})
        # to the farther place, so that it lasts
        far = max(
            (script.pose(s, percent) for percent in (CLOSED, OPEN)),
            key=lambda pose: sum(abs(pose[i] - script.goal[s][i]) for i in script.roles.slow),
        )
        for i in script.roles.driven:
            speed = math.copysign(_DRIVE_SPEED, script.joints[s][i].closing)
            dq, tau = (0.0, _DRIVE_DAMPING * speed) if i == by_torque else (speed, 0.0)
            motors[i] = replace(motors[i], dq=dq, tau=tau, kp=0.0, kd=_DRIVE_DAMPING)
        for i in script.roles.slow:
            motors[i] = _slowly(script, motors[i], far[i])
        hands[s] = motors
        targets[s] = {i: far[i] for i in script.roles.slow}
    yield from script.hold_as(name, sides, 0.3, hands, targets=targets)


def _slowly(script: FingerScript, motor: Motor, q: float) -> Motor:
    """The command to a motor to go to q for seconds, where the dialect has a way to say so."""
    if script.plan.dialect.position_servo:
        return replace(motor, q=q, dq=_SLOW_PART)
    return replace(motor, q=q, kp=_SLOW_GAINS[0], kd=_SLOW_GAINS[1])


def _by_torque(script: FingerScript) -> int | None:
    """The joint that is driven by a torque this time, where protection is for each joint."""
    script.drives += 1
    if "guard" not in script.plan.phases:
        return None
    return script.roles.driven[script.drives % len(script.roles.driven)]


@stimulus("stiffness", RobotScript, after="joint", leaves=Place.AWAY)
def soften_robot_joint(script: RobotScript) -> Steps:
    """A quarter of the client's kp, and a torque against it."""
    script.report("a soft joint, a speed, a torque")
    kp, _ = script.robot.client_gains[script.slot]
    soft = kp / 4
    script.order = script.changed(kp=soft)
    yield from script.keep(0.2)
    way = script.inward(script.slot, 0.1)
    phase = script.phase("stiffness", way=repr(way))
    script.order = script.changed(tau=soft * way)
    yield from script.keep(0.6)
    script.end(phase)
    script.order = script.changed(tau=0.0)
    yield from script.keep(0.2)
    script.order = script.changed(kp=kp)


@stimulus("velocity", RobotScript, after="stiffness", leaves=Place.AWAY)
def turn_robot_joint(script: RobotScript) -> Steps:
    """Zero kp, a speed, and kd."""
    speed = script.inward(script.slot, SPEED)
    phase = script.phase("velocity", speed=repr(speed))
    script.order = script.changed(kp=0.0, dq=speed)
    yield from script.keep(0.5)
    script.end(phase)
    script.catch()


@stimulus("torque", RobotScript, after="velocity", leaves=Place.AWAY)
def push_robot_joint(script: RobotScript) -> Steps:
    """Zero kp and kd, and a torque, until the joint has moved."""
    tau = script.inward(script.slot, _TORQUE_PART * script.robot.joint(script.slot).tau_max)
    phase = script.phase("torque", torque=repr(tau))
    begin = script.here(script.slot)
    script.order = script.changed(kp=0.0, kd=0.0, tau=tau)
    while script.elapsed(phase) < 0.4 and abs(script.here(script.slot) - begin) < _MOVED:
        yield from script.put(script.order)
    script.end(phase)
    script.catch()
    yield from script.keep(0.2)


@stimulus("limp", RobotScript, after="torque", leaves=Place.AWAY)
def limp_robot_joint(script: RobotScript) -> Steps:
    """Zero kp, and a q elsewhere."""
    yield from script.refused("limp", kp=0.0)


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


def slower(joint: int, took: float, quick: float, least: float, how: str) -> Figure:
    """How many times as long a softer step takes to half-way, with the seconds of both.

    :param least: how many times as long it has to take.
    """
    return Figure(
        took / quick,
        joint=joint,
        text=f"a step {how} takes {took / quick:.1f} times as long to half-way",
        measure=Measure(took, least * quick, larger_is_worse=False),
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
    """Motion by a commanded velocity without a position gain, negative the other way."""
    for moved, joint, phase in _driven_ways(ctx):
        against = moved <= -ctx.tolerance("min_motion_stroke", joint)
        way = f"{-moved:.2f} {ctx.unit} the other way" if against else f"{moved:.2f} {ctx.unit}"
        text = f"moved by {way} while a velocity was commanded"
        yield Figure(moved, *ctx.span(phase), joint, text)


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
    """Motion by a commanded torque: never against it, and with it, which only warns."""
    return all_of(warning(_moves_with_torque(ctx)), _moves_against_torque(ctx))


def _moves_with_torque(ctx: Context) -> Outcome:
    """Motion of a gripper towards larger q and of fingers towards closing, without a position
    gain.
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


@worst(
    "against_rad",
    "max_motion_stroke",
    nothing="no state shows the begin and the end of a torque command",
)
def _moves_against_torque(ctx: Context) -> Figures:
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


def _grades_of_stiffness(ctx: Context) -> Outcome:
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
    least, nothing = ctx.tolerance("min_grade_ratio"), "no state shows how the steps got half-way"
    for step in (s for p in ctx.phases("mild") for s in steps_of(ctx, p)):
        reference = stiff.get(step.joint)
        quick = half_way(reference) if reference is not None else None
        if reference is None or quick is None:
            return ctx.skipped(ctx.named("the stiff step did not get half-way", step.joint))
        took, quick = least_half_way(step), max(quick, 1e-3)
        if not (_seen_to_half(ctx, step) and _seen_to_half(ctx, reference)):
            continue
        soon = took < least * quick
        if soon and any(by(ctx, reference) for by in (limited_by_speed, limited_by_start)):
            nothing = "its own speed or start limits every joint's steps, whatever their gains are"
            continue
        figures.append(slower(step.joint, took, quick, least, "with a third of the stiffness"))
        softer = soft.get(step.joint)
        if softer is not None and half_way(step) is not None and _seen_to_half(ctx, softer):
            how = "with a tenth of the stiffness, compared with a third,"
            took, quick = least_half_way(softer), max(took, 1e-3)
            figures.append(slower(step.joint, took, quick, least, how))
    return judged(ctx, figures, "grade_ratio", "min_grade_ratio", nothing=nothing)


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
    """Time to half of steps with a tenth and with a third of the client's stiffness."""
    return all_of(_soft_steps(ctx), _grades_of_stiffness(ctx))


def _soft_steps(ctx: Context) -> Outcome:
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
        least = ctx.tolerance("min_ratio")
        figures.append(slower(step.joint, took, quick, least, "with soft gains"))
    outcome = judged(ctx, figures, "ratio", "min_ratio", nothing=nothing)
    return outcome if outcome.met is False or stuck is None else stuck


@check("DEX1-GAIN-05")
def spring(ctx: Context) -> Outcome:
    """Displacement by a torque, and whether it is still the same after a long hold."""
    return all_of(_displaced(ctx), _still_held(ctx))


@worst("part", "max_part", nothing="no state while it was pushed")
def _displaced(ctx: Context) -> Figures:
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


def _still_held(ctx: Context) -> Outcome:
    """The displacement by a torque after a long hold, compared with that before it."""
    found = nudges(ctx)
    if len(found) < 2:
        return ctx.skipped("no state during two pushes")
    least, most = ctx.tolerance("min_later_part"), ctx.tolerance("max_later_part")
    shown = [n for n in found if n.way >= ctx.tolerance("min_motion_stroke")]
    if not shown:
        return ctx.skipped(
            "a torque does not displace this hand: it does not show whether it holds"
        )
    noise = displacement_noise(ctx, ctx.phases())
    pairs = [(a, b) for a, b in zip(found[::2], found[1::2], strict=False) if a in shown]
    for first, last in pairs:
        text = (
            f"a torque displaced it by {first.way:.3f} {ctx.unit}, and after "
            f"{last.begin - first.end:.1f} "
            f"s of equal commands by {last.way:.3f} {ctx.unit}"
        )
        if not is_alike(first, last, (least, most), noise):
            place = ctx.at(ctx.states.topic, last.begin, last.end)
            return ctx.failed(f"{last.way:.3f} {ctx.unit}", text, place, motion_rad=last.way)
    if not pairs:
        return ctx.skipped("the first push displaced it too little to compare the last with it")
    return ctx.passed(f"{last.way:.3f} {ctx.unit}", text, motion_rad=last.way)


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
