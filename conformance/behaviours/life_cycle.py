"""Clients come and go, and the service starts and stops."""

from __future__ import annotations

import math

import numpy as np

from dexkit.conformance.behaviours.gains import drive_fingers, drive_gripper
from dexkit.conformance.behaviours.grip import gripper_squeeze
from dexkit.conformance.behaviours.speed import move_at_own_speeds
from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.obedience import arrival, first_goals
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.stimuli.fingers import FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import Moment, Place, stimulus
from dexkit.conformance.stimuli.robot import RobotScript
from dexkit.conformance.stimuli.script import (
    Join,
    Leave,
    Restart,
    StartService,
    Steps,
    StopService,
    of_position_servos,
)
from dexkit.hand import ROBOT, Floats, JointMode

_AT_SHUTDOWN = (30.0, 45.0)
"""Percent of closing from which hands move when their service ends: far enough from both ends and
from the object that it is seen if one opens or closes then. Two hands stand at different ones: a
service that sends both to the same place moves at least one of them."""
_BETWEEN_PLACES, _NEW_CLIENT_SECONDS = 30.0, 2.0
"""Percent of closing at which position servos stand for a new client, between the places of other
clients' commands, and for how many seconds."""


@stimulus("late-joiner", GripperScript, after="old-stamps")
def join_late_at_gripper(script: GripperScript) -> Steps:
    """A new subscriber appears while free hands close."""
    script.goal.update(script.nearly_closed())
    yield from _join_late(script)


@stimulus("late-joiner", FingerScript, after="old-stamps", needs=Place.ANY, leaves=Place.ANY)
def join_late_at_fingers(script: FingerScript) -> Steps:
    """A new subscriber appears while hands go back."""
    script.goal.update(script.homes())
    yield from _join_late(script)


def _join_late(script: HandScript) -> Steps:
    script.report("a second subscriber joins late: it must get the state at once")
    phase = script.begin("late-joiner", script.plan.sides)
    yield Join()
    while script.elapsed(phase) < 3.0:
        yield from script.command()
        if script.elapsed(phase) >= 0.3 and set(script.plan.sides) <= set(script.obs.joined):
            break
    phase.observed = {f"first_state_s_{s}": script.obs.joined.get(s) for s in script.plan.sides}
    script.end(phase)
    yield from script.do(Leave())


@stimulus("late-joiner", RobotScript, after="recover", leaves=Place.AWAY)
def join_robot_late(script: RobotScript) -> Steps:
    """A new subscriber appears."""
    phase = script.phase("late-joiner")
    yield Join()
    while script.elapsed(phase) < 2.0 and ROBOT not in script.obs.joined:
        yield from script.put(script.order)
    phase.observed[f"first_state_s_{ROBOT}"] = script.obs.joined.get(ROBOT)
    script.end(phase)
    yield Leave()


@stimulus("restart", HandScript, moment=Moment.CLIENTS, after="company")
def restart_client(script: HandScript) -> Steps:
    """The commanding program goes away, and another one comes."""
    script.report("the commanding program is restarted: the new one must be obeyed")
    yield Restart()
    yield from script.in_turn("restart")
    yield from script.schedule(Moment.NEW_CLIENT)


@stimulus(
    "",
    FingerScript,
    moment=Moment.NEW_CLIENT,
    after="squeeze",
    before="nan",
    applies=of_position_servos,
)
def stand_for_new_client(script: FingerScript) -> Steps:
    """A position servo stands for a while where no other client has sent it, so that it is seen
    if the goals of one are still in force; and gets speeds again. Runs of hands with gains have
    no time for it.
    """
    yield from script.to("center", _BETWEEN_PLACES)
    yield from script.hold(_NEW_CLIENT_SECONDS)
    if "speeds" in script.plan.phases:
        yield from move_at_own_speeds(script)
    else:
        yield from script.back()


@stimulus("restart", RobotScript, after="resume", leaves=Place.AWAY)
def restart_robot_client(script: RobotScript) -> Steps:
    """The client goes away, another comes, and makes a step."""
    script.report("the commanding program is restarted: the new one must be obeyed")
    yield Restart()
    script.next_ns = script.obs.now_ns
    yield from script.keep(0.2)
    yield from script.step("restart")


@stimulus("shutdown restarted service-restart", HandScript, moment=Moment.SERVICE)
def restart_service(script: HandScript) -> Steps:
    """End the service and start it again, where the kit can."""
    script.report("the service is stopped and started again")
    yield from script.schedule(Moment.STOPPING)
    phase = script.begin("shutdown", script.plan.sides)
    yield from script.do(StopService())
    if not script.obs.stopped:
        script.phases.remove(phase)
        script.report("the kit has not started the service, so it does not restart it")
        yield from script.schedule(Moment.NOT_STARTED)
        return
    phase.observed = dict(script.obs.stopped)
    yield from script.do(StartService())
    script.end(phase)
    script.next_ns = script.obs.now_ns
    # longer than a state may take, so that it must come without a command
    yield from script.silence("restarted", 1.1)
    yield from script.everyone("service-restart", script.after_shutdown(), most=4.0)
    yield from script.in_turn("service-restart")
    yield from script.schedule(Moment.STARTED)


@stimulus("", GripperScript, moment=Moment.STOPPING)
def drive_gripper_before_stop(script: GripperScript) -> Steps:
    """Grip and move: what was commanded last must not be in force after the restart."""
    pressing, free = script.plan.pressing, script.plan.free
    script.grip = dict(gripper_squeeze(script, pressing))
    regrip = script.begin("regrip", pressing) if pressing else None
    if free:
        yield from script.turn("center", script.nearly_closed(), least=0.5, stand=script.standing)
    if free and script.gains_used:
        yield from drive_gripper(script, free, 0.16)
    elif pressing:
        # on its own the last grip has to come from the open, and to be felt
        yield from script.hold(0.5 if free else 1.5)
    if regrip is not None:
        script.end(regrip)


@stimulus("", FingerScript, moment=Moment.STOPPING)
def move_hand_before_stop(script: FingerScript) -> Steps:
    """Move: what was commanded last must not be in force after the restart."""
    sides, (less, more) = script.plan.sides, _AT_SHUTDOWN
    free = script.plan.free
    closed_more = free[-1] if free and len(sides) > 1 else None
    poses = {s: script.pose(s, more if s is closed_more else less) for s in sides}
    yield from script.everyone("center", poses, most=1.5)
    yield from drive_fingers(script, "drive", sides, {})


@check("DEX1-LIFE-01", "DEX3-LIFE-01", "H1-LIFE-01")
def late_joiner(ctx: Context) -> Outcome:
    """Time until a subscriber created during a session receives state."""
    phase = ctx.phases()[-1]
    waited = phase.observed.get(f"first_state_s_{ctx.side}")
    limit = ctx.tolerance("max_wait_s")
    begin, end = ctx.span(phase)
    if waited is not None and waited <= limit:
        return ctx.passed(
            f"{waited * 1e3:.0f} ms",
            f"first state {waited * 1e3:.0f} ms after it was discovered",
            wait_s=waited,
        ).timed(waited, limit, span=(begin, end))
    text = "nothing" if waited is None else f"the first state only after {waited:.2f} s"
    outcome = ctx.failed(
        "nothing" if waited is None else f"{waited:.2f} s",
        f"a subscriber that joined at {begin:.2f} s received {text}",
        ctx.at(ctx.states.topic, begin, end),
    )
    least = end - begin if waited is None else waited
    # discovery is a conversation
    return outcome.timed(least, limit).if_late(least - limit)


@check("DEX1-LIFE-02", "DEX3-LIFE-02")
def restarted_client(ctx: Context) -> Outcome:
    """The steps of a restarted client, and of a client after a second client has ended."""
    alone = [p for p in ctx.phases("recover") if p.params.get("after") == "two-writers"]
    if alone:
        left = arrival(ctx, "after a second client had gone", alone)
        if left.met is False:
            return left
    return first_goals(ctx, ctx.phases(), "commanded by a restarted client")


@check("DEX1-LIFE-03", "DEX3-LIFE-03")
def restarted_service(ctx: Context) -> Outcome:
    """State and the step after a restart of the service, with a client that kept running."""
    phase = ctx.phases()[0]
    before = [p for p in ctx.phases("restarted") if p.end_ns <= phase.begin_ns]
    begin, end = ctx.span(before[-1] if before else phase)
    later = ctx.states.t[ctx.states.t > begin]
    waited = float(later[0]) - begin if len(later) else np.inf
    if waited > ctx.tolerance("max_wait_s"):
        what = "no state" if not len(later) else f"no state for {waited:.2f} s"
        outcome = ctx.failed(
            "no state",
            f"{what} after the service was ready again",
            ctx.at(ctx.states.topic, begin, min(begin + waited, end)),
        )
        least = min(waited, end - begin)
        outcome = outcome.timed(least, ctx.tolerance("max_wait_s"))
        return outcome.if_late(waited - ctx.tolerance("max_wait_s"))
    outcome = first_goals(ctx, [phase], "after a restart of its service")
    if not outcome.met:
        return outcome
    again = Measure(waited, ctx.tolerance("max_wait_s"), span=(begin, begin + waited))
    return outcome.resting_on(*outcome.measures, again)


@check("DEX1-LIFE-04", "DEX3-LIFE-04")
def shutdown(ctx: Context) -> Outcome:
    """Whether a service that ends leaves the hand undriven, and how long it takes; that of a
    position servo may hold it.
    """
    ends = warning(_ends(ctx))
    return ends if ctx.recording.dialect.position_servo else all_of(_last_state(ctx), ends)


def _ends(ctx: Context) -> Outcome:
    """Time from SIGTERM to the end of the service, and until its publisher disappears."""
    phase = ctx.phases()[-1]
    begin, end = ctx.span(phase)
    ended, gone = phase.observed.get("exit_s"), phase.observed.get("gone_s")
    place = ctx.at(ctx.states.topic, begin, end)
    if ended is None or ended > ctx.tolerance("max_exit_s"):
        seen = "had to be killed" if ended is None else f"took {ended:.1f} s to end"
        outcome = ctx.failed("does not end", f"after SIGTERM the service {seen}", place)
        least, limit = end - begin if ended is None else ended, ctx.tolerance("max_exit_s")
        return outcome.timed(least, limit).if_late(least - limit)
    if gone is None or gone > ctx.tolerance("max_gone_s"):
        seen = "is still announced" if gone is None else f"was announced for {gone:.1f} s"
        outcome = ctx.failed(
            "still announced", f"the state's publisher {seen} after the service had ended", place
        )
        least, limit = end - begin if gone is None else gone, ctx.tolerance("max_gone_s")
        outcome = outcome.timed(least, limit).if_late(least - limit)
        return outcome.because(
            "the process ends without deleting its participant, so that its peers wait for the "
            "lease to run out"
        )
    return ctx.passed(
        f"{ended:.2f} s",
        f"ended after {ended:.2f} s, and its publisher disappeared {gone:.2f} s later",
        exit_s=ended,
    ).resting_on(
        Measure(ended, ctx.tolerance("max_exit_s"), span=(begin, end)),
        Measure(gone, ctx.tolerance("max_gone_s"), span=(begin, end)),
    )


def _last_state(ctx: Context) -> Outcome:
    """The mode of the last state before the service ended, and the hand's position after the
    restart.

    A last state with a driven motor may have been measured before the brake. Then the check is
    whether a moving hand continued to move.
    """
    begin, end = ctx.span(ctx.phases()[-1])
    rows = ctx.states.between(begin - 0.2, end)
    modes = ctx.states.mode[rows]
    modes = modes[np.isfinite(modes).all(axis=1)]
    status = MotorCodec(ctx.recording.dialect).status(modes.astype(np.intp))
    if len(status) < 2 or not (status[0] == JointMode.FOC).all():
        return ctx.skipped("the mode of this hand does not show whether it is driven")
    went = _went_on(ctx, begin, end)
    if went is not None and went[0] > went[1]:
        rad, limit, joint = went
        text = ctx.named(
            f"it went on by {rad:.2f} {ctx.unit} after its last command, across the restart", joint
        )
        place = ctx.at(ctx.states.topic, begin, end)
        outcome = ctx.failed("goes on", text, place, motion_rad=rad).about(joint)
        return outcome.placed(rad, limit)
    if not status[-1].any():
        return ctx.passed("brakes", "its last state shows that it is not driven any more")
    if went is not None:
        text = f"it was moving, and was found {went[0]:.2f} {ctx.unit} further on"
        return ctx.passed("stops", text, motion_rad=went[0]).placed(went[0], went[1])
    return ctx.skipped(
        "its last state shows it driven, but may have been measured before it braked; it was not "
        "moving then"
    )


def _went_on(ctx: Context, begin: float, end: float) -> tuple[float, float, int] | None:
    """Motion of a joint from the stop of its service to the restart, rad, the allowed motion, and
    the joint; None if no joint moved with room to continue.
    """
    later = ctx.states.between(end - 0.1, end + 1.0)
    after = ctx.states.q[later][ctx.states.t[later] > begin + 0.25]
    worst: tuple[float, float, int] | None = None
    for joint, spec in enumerate(ctx.joints):
        before = ctx.states.between(begin - 0.2, begin)
        t, q = ctx.states.t[before], ctx.states.q[before, joint]
        if len(q) < 2 or not len(after) or not np.isfinite(q).all():
            continue
        speed = float(q[-1] - q[0]) / max(float(t[-1] - t[0]), 1e-3)
        if abs(speed) < ctx.tolerance("min_speed_stroke", joint):
            continue
        way = 1 if speed > 0 else -1
        braked = ctx.recording.model.command_timeout + ctx.tolerance("grace_s")
        limit = abs(speed) * braked + ctx.tolerance("max_jump_stroke", joint)
        room = spec.q_max - float(q[-1]) if way > 0 else float(q[-1]) - spec.q_min
        if room < limit + 0.1 * spec.stroke:
            continue
        rad = (float(after[0, joint]) - float(q[-1])) * way
        if worst is None or rad / limit > worst[0] / worst[1]:
            worst = rad, limit, joint
    return worst


@check("DEX1-LIFE-06", "DEX3-LIFE-06")
def moves_nothing(ctx: Context) -> Outcome:
    """Where a hand is after a restart of its service, and its motion until the first command."""
    return all_of(_no_new_goal(ctx), _starts_idle(ctx))


@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no state before the service ended, or none after it started again",
)
def _no_new_goal(ctx: Context) -> Figures:
    """Distance of the hand, after a restart of its service, from where it may be.

    A motor may continue to its last goal (DEX1-LIFE-04), but must not move elsewhere.
    """
    for phase in ctx.phases("shutdown"):
        begin, end = ctx.span(phase)
        latency = ctx.tolerance("latency_s")
        before = ctx.states.between(begin - max(0.2, latency), begin + 0.2)
        later = ctx.states.between(end - 0.1, end + 1.0)
        t, q = ctx.states.t[before], ctx.states.q[before]
        after = ctx.states.q[later][ctx.states.t[later] > begin + 0.25]
        if len(q) < 3 or not len(after):
            continue
        for joint in range(len(ctx.joints)):
            place, found = q[:, joint], float(after[0, joint])
            if not np.isfinite(place).all() or not math.isfinite(found):
                continue
            first = int(np.argmax(t >= begin - 0.2))
            speed = float(place[-1] - place[first]) / max(float(t[-1] - t[first]), 1e-3)
            recent = place[t >= t[-1] - latency]
            away = max(float(recent.min()) - found, found - float(recent.max()), 0.0)
            moved = abs(speed) >= ctx.tolerance("min_speed_stroke", joint)
            rad = 0.0 if moved and (found - float(place[-1])) * speed > 0.0 else away
            text = (
                f"found {rad:.2f} {ctx.unit} from the {place[-1]:.2f} {ctx.unit} at which the "
                "service ended, where it was not going"
            )
            there = _of_other(ctx, joint, begin)
            if rad > 0.0 and abs(there - found) < 0.25 * rad:
                text += ", but where the other hand was: the hands appear to be swapped since"
            yield Figure(rad, begin, end, joint, text)


def _of_other(ctx: Context, joint: int, at: float) -> float:
    """Where that joint of the other hand is; NaN where that is not known."""
    other = ctx.recording.sides.get(ctx.other)
    q = np.empty(0) if other is None else other.states.q[other.states.t <= at, joint]
    return float(q[-1]) if len(q) else math.nan


@worst("idle_rad", "max_idle_stroke", nothing="too few states after a start")
def _starts_idle(ctx: Context) -> Figures:
    """Motion and force between the first state of a started service and the first command.

    A requirement without ``max_tau_nm`` has no limit of the force.
    """
    for phase in ctx.phases("restarted"):
        begin, end = ctx.span(phase)
        first = ctx.commands.t[(ctx.commands.t >= begin) & (ctx.commands.t < end)]
        rows = ctx.states.between(begin, float(first[0]) if len(first) else end)
        for joint in range(len(ctx.joints)):
            t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
            t, q = t[np.isfinite(q)], q[np.isfinite(q)]
            if len(t) < 5:
                continue
            away = np.abs(q - q[0])
            i = int(np.argmax(away))
            text = f"moved by {away[i]:.3f} {ctx.unit} before the first command after a start"
            yield Figure(float(away[i]), float(t[i]), None, joint, text)
        if "max_tau_nm" in ctx.requirement.tolerances:
            presses = judged(
                ctx,
                _presses(ctx, ctx.states.t[rows], ctx.states.tau[rows, 0]),
                "tau_nm",
                "max_tau_nm",
                nothing=ctx.passed("no force"),
            )
            if not presses.met:
                yield presses


def _presses(ctx: Context, t: Floats, tau: Floats) -> Figures:
    """The torques, N m, of a started gripper whose last command may have asked for one."""
    t, tau = t[np.isfinite(tau)], tau[np.isfinite(tau)]
    if len(t) < 5:
        return
    # a motor that releases a grip may still show its force at first
    for at in np.arange(float(t[0]) + ctx.tolerance("release_s"), float(t[-1]), 0.1).tolist():
        piece = np.abs(tau[(t >= at) & (t < at + 0.1)])
        if len(piece) >= 3:
            felt = median(piece)
            text = f"tau_est of {felt:.2f} N m before the first command after a start"
            yield Figure(felt, at, text=text)
