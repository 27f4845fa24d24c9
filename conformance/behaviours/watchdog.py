"""What happens when commands end, and when they return."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dexkit.conformance.behaviours.gains import (
    drive_fingers,
    drive_gripper,
    step_softly,
)
from dexkit.conformance.behaviours.grip import (
    finger_squeezes,
    grip_from_below,
    grip_softly,
    gripper_squeeze,
    squeeze_fingers,
    unprotected,
)
from dexkit.conformance.behaviours.motion import robot_follows
from dexkit.conformance.behaviours.timeout_protection import latch_and_clear
from dexkit.conformance.checks import STROKE_S, Context, Outcome, check, timing
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.obedience import first_goals, silent, stopped
from dexkit.conformance.checks.robot import RobotContext, no_state, only_phase, speed_between
from dexkit.conformance.checks.silences import roles_of, stops_moving
from dexkit.conformance.checks.steps import obeyed_before, steps_of
from dexkit.conformance.checks.timing import gaps, survived
from dexkit.conformance.kit.measurement_error import Measure, Quantity
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import CLOSED, OPEN, FingerScript
from dexkit.conformance.stimuli.gripper import NEARLY, GripperScript
from dexkit.conformance.stimuli.hand import ASIDE_SECONDS
from dexkit.conformance.stimuli.phases import Moment, Place, stimulus
from dexkit.conformance.stimuli.robot import SPEED, RobotScript
from dexkit.conformance.stimuli.script import Pose, Steps, with_gains
from dexkit.hand import Floats, Side

_SILENCE, _LONG_SILENCE = 3.3, 67.0
"""Seconds without a command: longer than counters of 8 bits in steps of 10 ms last; in a thorough
run, than those of 16 bits in milliseconds."""
_REGRIP_SECONDS = 0.6
"""Seconds of a grip at the end: hands with gains touch the object after 0.2 s."""
_ALONE_SECONDS = 0.35
"""Seconds in which the first command after a silence is the only one: a hand that has received it
has begun to move by then (DEX1-MOVE-09)."""
_SLOWEST_HZ, _FASTEST_HZ = 30.0, 1000.0
"""Commands a second before a silence: the time-out counts seconds, whatever the client's rate."""
_GRIP_ON_SECONDS = 1.5
"""Seconds for which position servos grip on after a silence, which they need not let go in: five
seconds of contact, in which a force that fades within six is down to a sixth."""


@stimulus("silence resume rejected", GripperScript, after="squeeze")
def stop_gripper_commands(script: GripperScript) -> Steps:
    """No commands for long: to each side alone where they have topics of their own."""
    sides = script.plan.sides
    pressing, free = script.plan.pressing, script.plan.free
    long = _LONG_SILENCE if script.patient else _SILENCE
    first = free[0] if free else sides[0]
    rest = [s for s in sides if s != first]
    alone = bool(rest) and not script.codec.shared and "rejected" in script.plan.phases
    if not alone:
        yield from grip_softly(script, pressing)
        yield from grip_from_below(script, pressing)
        script.grip = dict(gripper_squeeze(script, pressing))
        if free and script.gains_used:
            yield from drive_gripper(script, free, 0.16, last_hz=_FASTEST_HZ)
        script.report("... silence: after a second the hand must brake")
        yield from script.silence("silence", long)
        script.grip = {}
        yield from _resume(script, script.other_place())
        yield from step_softly(script, sides)
    else:
        script.grip.pop(first, None)
        if script.gains_used:
            if not free:
                yield from script.turn("center", {first: (script.low(first),)}, least=0.5)
            yield from drive_gripper(script, (first,), 0.16, last_hz=_FASTEST_HZ)
        script.report(f"... silence on the {first} side, then broken commands: it must brake")
        yield from _silent_beside(script, first, [s for s in rest if s in pressing])
        # away from where it was going before the silence
        yield from _resume(script, {first: (NEARLY * script.stroke,)})
        script.report("... silence on both sides: both must brake")
        yield from _silent_both(script, first, rest, long)
        script.grip = {}
        yield from _resume(script, script.other_place())


def _silent_beside(script: GripperScript, side: Side, pressing: Sequence[Side]) -> Steps:
    """No command to one side, then only rejected ones, while the others grip.

    They make a step after the time-out: one time-out for all sides shows then.
    """
    timeout = script.model.command_timeout
    phase = script.begin("silence", (side,))
    script.grip[side] = ()
    yield from grip_from_below(script, pressing)
    while script.elapsed(phase) < timeout + 0.1:
        yield from script.command()
    script.grip = {side: ()}
    beside = script.beside_others((side,), ASIDE_SECONDS)
    yield from script.hold(script.beside_s)
    for ended in (phase, *beside):
        script.end(ended)
    rejected = script.begin("rejected", (side,))
    # they must not wake it, either
    script.grip[side] = (Motor(q=math.nan),)
    yield from grip_softly(script, pressing)
    while script.elapsed(rejected) < 0.8 * timeout:
        yield from script.command()
    script.end(rejected)
    # they press on: a driver may lower its effort in the first second
    script.grip = dict(gripper_squeeze(script, pressing))


def _silent_both(script: GripperScript, first: Side, rest: Sequence[Side], seconds: float) -> Steps:
    """No commands; the others stay silent longer than the first side."""
    both, long = script.begin("silence", (first,)), script.begin("silence", rest)
    script.grip = dict.fromkeys((first, *rest), ())
    yield from script.hold(script.model.command_timeout + 0.6)
    script.end(both)
    del script.grip[first]
    yield from _resume(script, {first: script.other_place()[first]})
    yield from step_softly(script, (first,))
    while script.elapsed(long) < seconds:
        yield from script.command()
    script.end(long)


def _resume(script: GripperScript, goals: Mapping[Side, Pose]) -> Steps:
    """A step after a silence, whose first command is alone for a while: it counts as it is."""
    script.goal.update(goals)
    phase = script.begin("resume", tuple(goals), targets=goals)
    yield from script.command()
    yield from script.through(phase, _ALONE_SECONDS, lambda: script.wait(0.01))
    yield from script.until_settled(
        phase, tuple(goals), least=0.6 - _ALONE_SECONDS, most=2.5, stand=script.standing
    )


@stimulus("silence", GripperScript, moment=Moment.STARTED, after="grip", applies=with_gains)
@stimulus("silence rejected", GripperScript, moment=Moment.NOT_STARTED, applies=with_gains)
def stop_gripper_commands_again(script: GripperScript) -> Steps:
    """The commands end once more, at the end."""
    sides = script.plan.sides
    script.grip = {}
    pressing, free = script.plan.pressing, script.plan.free
    # a free hand is elsewhere in this silence: one that goes to a fixed position shows then
    starts = {s: (script.low(s) if s in pressing else script.middle(s),) for s in sides}
    yield from script.everyone("center", starts)
    script.grip = dict(gripper_squeeze(script, pressing))
    yield from drive_gripper(script, free, 0.16, last_hz=_SLOWEST_HZ)
    first, *rest = sides
    if rest and not script.codec.shared and "rejected" in script.plan.phases:
        begun = script.begin("silence", (first,))
        rejected = script.begin("rejected", rest)
        script.grip = {first: (), **dict.fromkeys(rest, (Motor(q=math.inf),))}
        yield from script.hold(script.model.command_timeout + 0.6)
        script.end(begun)
        script.end(rejected)
    else:
        yield from script.silence("silence", script.model.command_timeout + 0.6)
    script.grip = {}
    yield from _resume(script, script.other_place())


@stimulus("squeeze beside-grip silence resume", FingerScript, after="squeeze", applies=unprotected)
def stop_finger_commands(script: FingerScript) -> Steps:
    """No commands to hands of which some joints move and others may press; none has protection."""
    sides = script.plan.sides
    pressing, free = script.plan.pressing, script.plan.free
    squeeze = finger_squeezes(script, pressing, {})
    if script.plan.phases & {"silence", "resume"}:
        script.report("slow motion without protection, and then ...")
        yield from drive_fingers(script, "drive", free, squeeze)
        script.report("... silence: nothing may be left driven by a velocity, a grip is kept")
        yield from script.silence("silence", script.model.command_timeout + 0.7)
        if pressing and script.plan.dialect.position_servo:
            script.report("squeezing the object on: its force must not fade")
            yield from squeeze_fingers(script, pressing, _GRIP_ON_SECONDS)
    yield from script.everyone("resume", {s: script.home(s) for s in sides}, most=1.5)


@stimulus("silence resume", FingerScript, after="squeeze guard")
def stop_each_hands_commands(script: FingerScript) -> Steps:
    """No commands to each hand alone.

    Some joints have time-out protection, which must trip more than once; and once none has, as
    a hand may latch only then. A hand that is alone gets both silences, of two hands each gets
    one: a service rarely has a fault of time in one hand alone.
    """
    sides = script.plan.sides
    if len(sides) == 1 and "guard" in script.plan.phases:
        yield from _silent_by_motion(script, _once_more(script))
        yield from _silent_by_motion(script, {})
    if len(sides) > 1 and "silence" in script.plan.phases:
        for side, bad in zip(sides, (math.nan, math.inf), strict=True):
            home = script.motors(side, script.home(side))
            rejected = [replace(m, q=bad) for m in home] if script.codec.holds_nan else []
            guarded = _once_more(script) if side is sides[0] else {}
            yield from _silent_alone(script, side, rejected, guarded)


def _silent_by_motion(script: FingerScript, guarded: Mapping[Side, frozenset[int]]) -> Steps:
    """No commands to moving hands, then a step.

    :param guarded: the joints with time-out protection.
    """
    yield from drive_fingers(script, "drive", script.plan.sides, {}, guarded=guarded)
    yield from script.silence("silence", script.model.command_timeout + 0.7)
    yield from _after_silence(script, {s: script.pose(s, CLOSED - 5.0) for s in script.plan.sides})


def _silent_alone(
    script: FingerScript, side: Side, rejected: Motors, guarded: Mapping[Side, frozenset[int]]
) -> Steps:
    """No command to one side but rejected ones, while it moves and the other is commanded.

    The first step afterwards closes that hand, away from where a hand that begins at 0 would
    go.

    :param guarded: the joints with time-out protection.
    """
    script.report(f"no good commands to the {side} hand alone: nothing may be left driven")
    yield from drive_fingers(script, "drive", (side,), {}, guarded=guarded)
    yield from _silence_alone(script, side, {side: rejected} if rejected else {})
    yield from _after_silence(
        script, {s: script.pose(s, CLOSED - 5.0 if s is side else OPEN) for s in script.plan.sides}
    )


def _silence_alone(script: FingerScript, side: Side, rejected: Mapping[Side, Motors]) -> Steps:
    """No good command to one side, as a phase; the others make a step after the time-out.

    :param rejected: what the side gets instead: it must not count as a command.
    """
    phase = script.begin("silence", (side,))
    beside: list[Phase] = []
    for seconds in (script.model.command_timeout + 0.1, script.beside_s):
        good = {s: script.motors(s, q) for s, q in script.goal.items() if s != side}
        payloads = script.codec.encode({**good, **rejected})
        yield from script.repeat(
            seconds,
            lambda payloads=payloads: script.send(payloads),  # type: ignore[misc]
        )
        if not beside:
            beside = script.beside_others((side,), ASIDE_SECONDS)
    for ended in (phase, *beside):
        script.end(ended)


def _after_silence(script: FingerScript, poses: Mapping[Side, Pose]) -> Steps:
    yield from script.everyone("resume", script.apart(poses), most=1.5)


def _once_more(script: FingerScript) -> dict[Side, frozenset[int]]:
    """The joints with time-out protection in a further silence."""
    return script.next_splits() if "guard" in script.plan.phases else {}


@stimulus("silence", FingerScript, moment=Moment.STARTED, after="squeeze ends", needs=Place.ANY)
def stop_finger_commands_again(script: FingerScript) -> Steps:
    """The commands end once more, after a restart of the service."""
    yield from script.to("center", OPEN)
    sides = script.plan.sides
    if "guard" in script.plan.phases:
        splits = script.next_splits()
        yield from drive_fingers(script, "guard-drive", sides, {}, guarded=splits)
        yield from script.silence("guard", script.model.command_timeout + 0.3)
        yield from latch_and_clear(script, splits)
    else:
        yield from _silent_by_motion(script, {})
    pressing = script.plan.pressing
    if pressing and "squeeze" in script.plan.phases and not script.plan.dialect.position_servo:
        script.report("squeezing the object again")
        yield from squeeze_fingers(script, pressing, _REGRIP_SECONDS, "regrip")


@stimulus("pause", RobotScript, after="late-joiner", leaves=Place.AWAY)
def pause_robot_commands(script: RobotScript) -> Steps:
    """0.3 s without a command while the joint is driven by a speed."""
    yield from _stop_robot_commands(script, "pause", 0.3)


@stimulus("silence", RobotScript, after="pause", leaves=Place.AWAY)
def stop_robot_commands(script: RobotScript) -> Steps:
    """More than a second likewise."""
    yield from _stop_robot_commands(script, "silence", script.robot.command_timeout + 0.6)


def _stop_robot_commands(script: RobotScript, name: str, seconds: float) -> Steps:
    script.report("commands pause while a joint is driven: it may go on for a second, not longer")
    speed = script.inward(script.slot, SPEED)
    script.order = script.changed(kp=0.0, dq=speed)
    yield from script.keep(0.3)
    phase = script.phase(name, speed=repr(speed))
    yield from script.through(phase, seconds, lambda: script.wait(0.02))
    script.catch()
    if name == "silence" and "resume" in script.plan.phases:
        yield from resume_robot(script)


@stimulus("resume", RobotScript, after="silence", leaves=Place.AWAY)
def resume_robot(script: RobotScript) -> Steps:
    """Commands again: hold at first, then a step; once in a run."""
    if any(p.name == "resume" for p in script.phases):
        return
    script.next_ns = script.obs.now_ns
    phase = script.phase("resume", what="hold")
    yield from script.keep(0.3)
    script.end(phase)
    yield from script.step("resume", what="step")


def _silences(ctx: Context, *names: str) -> list[tuple[float, float]]:
    """(last command, end) of each phase without commands: the requirement's, and ``names``.

    An empty or non-finite command does not count: it must not keep the hand driven.
    """
    found = []
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    for phase in (*ctx.phases(), *(p for name in names for p in ctx.phases(name))):
        begin, end = ctx.span(phase)
        sent = good[good <= end]
        last = float(sent[-1]) if len(sent) else begin
        found.append((last, end))
    return found


@check("DEX1-WDOG-01")
def brakes_in_time(ctx: Context) -> Outcome:
    """Whether the hand brakes at the time-out, and is in force until then."""
    return all_of(brakes(ctx), in_force(ctx))


@check("DEX1-WDOG-04")
def brakes(ctx: Context) -> Outcome:
    """Motion and force after the time-out of a hand that moved or pressed when silence began.

    At rest at its target, braking and holding look alike, so commands end while the hand is driven
    by a velocity or presses on an object. If it does neither, ``mode`` must change from driven to
    0.
    """
    timeout = ctx.tolerance("timeout_s")
    rejected = ctx.requirement.phase == "rejected"
    after = "good command, while rejected ones arrive" if rejected else "command"
    states, stroke = ctx.states, ctx.joints[0].stroke
    proofs: list[str] = []
    values: dict[str, float] = {}
    measures: list[Measure] = []
    for last, end in _silences(ctx):
        due = last + timeout + ctx.tolerance("grace_s")
        q_free, q_late = ctx.q(last, last + timeout)[:, 0], ctx.q(due, end)[:, 0]
        before = ctx.tau(last - 0.2, last)[:, 0]
        if len(q_late) < 5 or not len(q_free) or not len(before):
            continue
        place = ctx.at(states.topic, last + timeout, end)
        moved, still = float(np.ptp(q_late)), ctx.tolerance("max_motion_stroke")
        rows = states.between(last, end)
        stop = stopped(states.t[rows], states.q[rows, 0], last, still, due - last)
        if moved > still:
            late = f"more than {timeout:g} s after the last {after}"
            text = f"moved by {moved:.2f} {ctx.unit} {late}"
            outcome = ctx.failed(f"{moved:.2f} {ctx.unit}", text, place, motion_rad=moved)
            return outcome.resting_on(stop)
        jump, allowed = _jump(ctx, last + timeout, q_late)
        if jump > allowed:
            text = f"moved by {jump:.2f} {ctx.unit} while it braked"
            outcome = ctx.failed(f"{jump:.2f} {ctx.unit}", text, place, motion_rad=jump)
            return outcome.placed(jump, allowed).if_late(STROKE_S * (jump - allowed) / stroke)
        # at its stop it stands still even without a brake
        at_stop = not 0.05 * stroke < float(np.median(q_late)) < 0.95 * stroke
        if float(np.ptp(q_free)) >= ctx.tolerance("min_travel_stroke") and not at_stop:
            proofs.append(f"was moving, then moved only {moved:.3f} {ctx.unit}")
            values["motion_rad"] = moved
            measures.append(stop)
        pressed = float(np.median(np.abs(before)))
        if pressed >= ctx.tolerance("min_tau_nm") and ctx.object_at is not None:
            found = list(_forces_left(ctx, last, end, before))
            wrong = judged(ctx, found, "tau_nm", "max_back_nm", nothing="")
            if not wrong.met:
                return wrong
            left = found[-1]
            measures.append(Measure(left.value, left.limit or 0.0, "N m", Quantity.TORQUE))
            proofs.append(f"pressed with {pressed:.2f} N m, then with {left.value:.2f} N m")
            values["tau_nm"] = left.value
        driven = ctx.states.mode[states.between(last - 0.2, last), 0]
        if (
            not proofs
            and (driven > 0).all()
            and (states.mode[states.between(due, end), 0] == 0).all()
        ):
            proofs.append(f"stood still, and reports the brake: mode {driven[-1]:.0f}, then 0")
    if not proofs:
        return ctx.skipped(
            "this hand neither moved (it does not follow velocity commands) nor pressed on an "
            "object when the commands stopped, and its mode does not show it: braking cannot be "
            "distinguished from holding"
        )
    figure = "stops" if "motion_rad" in values else "lets go" if values else "says so"
    return ctx.passed(figure, "; ".join(proofs), **values).resting_on(*measures)


def _forces_left(ctx: Context, last: float, end: float, before: Floats) -> Iterator[Figure]:
    """The forces of a hand that pressed, after its time-out: the other way, soon, and then.

    :param before: its tau_est until the last command, N m.
    """
    since = last + ctx.tolerance("timeout_s")
    due = since + ctx.tolerance("grace_s")
    pressed = float(np.median(np.abs(before)))
    sign = 1 if float(np.median(before)) > 0 else -1
    had = f"pressed with {pressed:.2f} N m at the last command, and"
    for at, tau in _pieces(ctx, since, end):
        back = max(-float(np.median(tau)) * sign, 0.0)
        yield Figure(
            back, at, end, text=f"{had} drove the other way with {back:.2f} N m after the time-out"
        )
    # torque must not return, either
    begin = min(since + ctx.tolerance("release_s"), end - 0.1)
    for first, until, part, when in (
        (due, due + _PIECE_S, "begun_part", f"{due - last:.2f} s later"),
        (begin, end, "max_tau_part", "after the time-out"),
    ):
        sizes = [float(np.median(np.abs(tau))) for _, tau in _pieces(ctx, first, until)]
        felt, limit = max(sizes, default=0.0), ctx.tolerance(part) * pressed
        text = f"{had} still with {felt:.2f} N m {when}"
        yield Figure(felt, since, end, text=text, limit=limit)


_PIECE_S = 0.1


def _pieces(ctx: Context, begin: float, end: float) -> Iterator[tuple[float, Floats]]:
    """(time, tau_est) of the consecutive pieces of a stretch."""
    for at in np.arange(begin, end - 0.99 * _PIECE_S, _PIECE_S).tolist():
        tau = ctx.tau(at, at + _PIECE_S)[:, 0]
        if len(tau) >= 3 and np.isfinite(tau).all():
            yield at, tau


def _jump(ctx: Context, at: float, q_late: Floats) -> tuple[float, float]:
    """Motion of the hand while it braked, and the allowed motion, rad.

    Allowed are the run-out at its last speed and the relaxation of a squeezed object.
    """
    states = ctx.states
    before = states.between(at - 0.15, at - 0.05)
    q, t = states.q[before, 0], states.t[before]
    if len(q) < 2:
        return 0.0, 0.0
    speed = abs(float(q[-1] - q[0])) / max(float(t[-1] - t[0]), 1e-3)
    runs_on = speed * (0.05 + ctx.tolerance("grace_s"))
    jump = abs(float(np.median(q_late)) - float(q[-1]))
    return jump, ctx.tolerance("max_jump_stroke") + runs_on


@check("DEX1-WDOG-02", "DEX3-WDOG-02")
def state_in_silence(ctx: Context) -> Outcome:
    """Gaps in the state while no command is sent."""
    limit = ctx.tolerance("max_gap_s")
    # a tripped hand must continue to publish
    silences = _silences(ctx, "guard")
    spans = [(a, b) for a, b in silences if b - a >= ctx.tolerance("min_silence_s")]
    if not spans:
        return ctx.skipped("no pause of commands that was long enough")
    longest = 0.0
    for begin, end in spans:
        found = gaps(ctx, limit, begin, end)
        if found:
            a, b = found[0]
            text = f"no state from {a:.3f} s to {b:.3f} s, in the pause that began at {begin:.3f} s"
            outcome = silent(ctx, found, limit, f"{b - a:.2f} s", text)
            return survived(ctx, outcome, max(b - a for a, b in found))
        clock = ctx.states.clock
        inside = clock[(clock >= begin) & (clock <= end)]
        longest = max(longest, float(np.diff(inside).max()) if len(inside) > 1 else 0.0)
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    ).timed(longest, limit, span=(spans[0][0], spans[-1][1]))


@check("DEX1-WDOG-03", "DEX3-WDOG-03")
def resumes(ctx: Context) -> Outcome:
    """The step after a pause of commands."""
    begun = judged(
        ctx, _reactions(ctx), "reaction_s", "max_reaction_s", nothing=ctx.passed("no step")
    )
    if not begun.met:
        return begun
    phases = [p for p in ctx.phases() if obeyed_before(ctx, p)]
    outcome = first_goals(ctx, phases, "after a pause of commands")
    return outcome.resting_on(*begun.measures) if outcome.met and begun.measures else outcome


def _reactions(ctx: Context) -> Figures:
    """When the steps after a pause begin."""
    for step in (s for p in ctx.phases() if obeyed_before(ctx, p) for s in steps_of(ctx, p)):
        if abs(step.size) < ctx.tolerance("min_step_stroke", step.joint):
            continue
        begun = (step.q - step.start) / step.size >= ctx.tolerance("begun_part")
        after = float(step.t[np.argmax(begun)] if begun.any() else step.end) - step.begin
        how = "began to move only after" if begun.any() else "did not begin to move in"
        text = f"after a pause: {step}, but it {how} {after:.2f} s"
        shown = f"after {after:.2f} s"
        yield Figure(after, step.begin, step.begin + after, step.joint, text, shown=shown)


@check("DEX3-WDOG-01")
def nothing_left_moving(ctx: Context) -> Outcome:
    """Motion after the time-out of joints driven by a velocity or torque, without protection."""
    return stops_moving(ctx, roles_of(ctx).driven, guarded=False)


@check("BRAINCO-WDOG-01")
@worst("motion_rad", "max_motion_stroke", nothing="no pause of commands with states")
def takes_no_detour(ctx: Context) -> Figures:
    """Deviation of a joint from the way to its last goal while there are no commands."""
    for begin, end, goal in _pauses(ctx):
        rows = ctx.states.between(begin, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if len(t) < 5:
            continue
        low, high = np.minimum(q[0], goal), np.maximum(q[0], goal)
        beyond = np.maximum(low - q, q - high)
        for joint in range(len(ctx.joints)):
            i = int(np.nanargmax(beyond[:, joint]))
            rad = max(float(beyond[i, joint]), 0.0)
            text = f"left the way to its last goal by {rad:.3f} {ctx.unit} without a command"
            yield Figure(rad, float(t[i]), None, joint, text)


@check("BRAINCO-WDOG-04")
@worst("motion_rad", "max_motion_stroke", nothing="no joint was on its way at the time-out")
def stops_in_silence(ctx: Context) -> Figures:
    """Whether a moving joint stands still after the time-out."""
    for begin, end, goal in _pauses(ctx):
        late = begin + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        q = ctx.q(late, end)
        if len(q) < 5:
            continue
        for joint in range(len(ctx.joints)):
            if abs(goal[joint] - q[0, joint]) >= ctx.tolerance("min_left_stroke", joint):
                moved = float(np.ptp(q[:, joint]))
                text = f"moved by {moved:.2f} {ctx.unit} more than {ctx.tolerance('timeout_s'):g} s"
                yield Figure(moved, late, end, joint, f"{text} after the last command")


def _pauses(ctx: Context) -> list[tuple[float, float, Floats]]:
    """Last good command, end and its q, of each pause of commands."""
    commands = ctx.commands
    good = np.flatnonzero(np.isfinite(commands.q).all(axis=1))
    found = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        sent = good[commands.t[good] <= min(begin + 0.05, end)]
        if len(sent):
            last = int(sent[-1])
            found.append((float(commands.t[last]), end, np.asarray(commands.q[last])))
    return found


_AT_A_STOP = 0.05
"""Distance from an end of the stroke, as a part of it, at which a gripper may be at its stop."""


@worst("part", "min_part", nothing="it neither pressed nor moved when the commands stopped")
def in_force(ctx: Context) -> Figures:
    """Force or speed shortly before the time-out, relative to that at the last command."""
    window, states, until = ctx.tolerance("window_s"), ctx.states, ctx.tolerance("until_s")
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        _, end = ctx.span(phase)
        sent = good[good <= end]
        if not len(sent) or end - sent[-1] < until:
            continue
        last = float(sent[-1])
        late = last + until - window
        spans = [states.between(a, a + window) for a in (last - window, late)]
        if min(len(states.t[s]) for s in spans) < 5:
            continue
        what = ""
        if ctx.object_at is not None:
            before, after = (median(np.abs(states.tau[s, 0])) for s in spans)
            if before >= ctx.tolerance("min_force_nm"):
                part, what = after / before, f"presses with {after:.2f} N m, {before:.2f} N m"
        if not what:
            before, after = (_speed(states.t[s], states.q[s, 0]) for s in spans)
            place, spec = median(states.q[spans[1], 0]), ctx.joints[0]
            near = _AT_A_STOP * spec.stroke
            free = spec.q_min + near < place < spec.q_max - near
            free = free and not _arrives(ctx, last, abs(before) * until)
            if not free or abs(before) < ctx.tolerance("min_speed_stroke"):
                continue
            unit = f"{ctx.unit}/s"
            part, what = after / before, f"moves at {after:.2f} {unit}, {before:.2f} {unit}"
        text = f"{until:g} s after the last command it {what} at that command"
        yield Figure(part, late, late + window, text=text)


def _arrives(ctx: Context, at: float, way: float) -> bool:
    """Whether the last command before a time has a position that is nearer than so far, rad."""
    row = int(np.searchsorted(ctx.commands.t, at, "right")) - 1
    here = ctx.q(at - 0.05, at)[:, 0]
    if not ctx.commands.kp[row, 0] > 0 or not len(here):
        return False
    return abs(float(ctx.commands.q[row, 0]) - median(here)) < way


def _speed(t: Floats, q: Floats) -> float:
    """Slope of the line through all of them, which noise changes little, rad/s."""
    t = t - t.mean()
    return float(t @ (q - q.mean())) / max(float(t @ t), 1e-9)


@check("H1-WDOG-01")
@worst("speed_rad_s", "max_speed_rad_s", nothing="")
def damps(ctx: RobotContext) -> Figures:
    """Speed of a driven joint some time after the last command."""
    phase, begin, end, joint = only_phase(ctx)
    after = begin + ctx.tolerance("max_s")
    speed = speed_between(ctx, phase, after, end)
    if speed is None:
        yield no_state(ctx, phase)
        return
    text = f"{after - begin:.1f} s after the last command it turns at {speed:.2f} rad/s"
    yield Figure(abs(speed), after, end, joint, text, shown=f"{abs(speed):.2f} rad/s")


@check("H1-WDOG-02")
def robot_state_in_silence(ctx: RobotContext) -> Outcome:
    """Gaps in the state while no command is sent."""
    limit, longest = ctx.tolerance("max_gap_s"), 0.0
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        found = timing.gaps(ctx, limit, begin, end)
        if found:
            a, b = found[0]
            text = f"no state from {a:.3f} s to {b:.3f} s, {a - begin:.2f} s after the last command"
            outcome = ctx.failed(f"{b - a:.2f} s", text, ctx.at(ctx.states.topic, a, b))
            return outcome.if_late(b - a - limit)
        clock = ctx.states.clock[(ctx.states.clock >= begin) & (ctx.states.clock <= end)]
        longest = max(longest, float(np.diff(clock).max(initial=0.0)))
    return ctx.passed(f"{longest * 1e3:.0f} ms", f"the longest gap is {longest * 1e3:.1f} ms")


@check("H1-WDOG-03")
def robot_resumes(ctx: RobotContext) -> Outcome:
    """The jump when commands resume, and the step after it."""
    hold = next(p for p in ctx.phases() if not p.targets)
    begin, end = ctx.span(hold)
    q = ctx.q(begin - 0.02, end)
    if not len(q):
        return no_state(ctx, hold)
    moved = np.nan_to_num(np.abs(q - q[0]).max(axis=0), nan=np.inf)
    figures = [
        Figure(far, begin, end, joint, f"moves by {far:.3f} rad when commands arrive again")
        for joint, far in enumerate(moved.tolist())
    ]
    jump = judged(ctx, figures, "jump_rad", "max_jump_rad", nothing="")
    return robot_follows(ctx) if jump.met else jump


@check("H1-WDOG-04")
@worst("speed_part", "min_part", nothing="")
def bridges(ctx: RobotContext) -> Figures:
    """The speed of a driven joint in a short pause."""
    phase, begin, end, joint = only_phase(ctx)
    wanted = float(phase.params["speed"])
    speed = speed_between(ctx, phase, begin, end)
    if speed is None:
        yield no_state(ctx, phase)
        return
    text = f"{speed:.2f} rad/s in a pause of {end - begin:.2f} s, commanded {wanted:.2f} rad/s"
    limit, shown = ctx.tolerance("low_part"), f"{speed:.2f} rad/s"
    yield Figure(speed / wanted, begin, end, joint, text, limit=limit, shown=shown)
