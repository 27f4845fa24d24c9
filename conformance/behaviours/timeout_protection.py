"""Motors that ask for it brake when commands end (bit 7 of the mode byte)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dexkit.conformance.behaviours.gains import drive_fingers
from dexkit.conformance.behaviours.grip import finger_squeezes, step_beside_grip
from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.obedience import arrival
from dexkit.conformance.checks.silences import mode_bytes, roles_of, silences_of, stops_moving
from dexkit.conformance.checks.steps import not_driven
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import CLOSED, OPEN, FingerScript
from dexkit.conformance.stimuli.hand import ASIDE_SECONDS
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.script import Steps
from dexkit.conformance.stimuli.usb import _KD, DRIVEN, FREE, UsbScript, UsbSteps
from dexkit.conformance.usb.context import UsbContext, named_joints, part_of_way
from dexkit.conformance.usb.frames import Motor
from dexkit.conformance.usb.recording import Answer
from dexkit.hand import Side

_SPEED = 0.4  # rad/s


@stimulus("pause drive silence tripped clear", UsbScript, after="short")
def stop_usb_commands(script: UsbScript) -> UsbSteps:
    """A pause that is too short to trip; then 1.5 s without a command while a finger is driven.

    Afterwards position commands with the protection still enabled, and the same without it.
    """
    script.report("time-out protection: a pause, then 1.5 s of silence while a finger moves")
    spec = script.joints[DRIVEN]
    hold = script.hold_commands()
    yield from script.exchange(script.frame(script.hold_commands(protect=False)))
    # a place with room for what an unprotected hand would do in the silence
    open_end = spec.q_min if spec.closing > 0 else spec.q_max
    start = open_end + spec.closing * 0.25
    hold[DRIVEN] = replace(hold[DRIVEN], q=start)
    yield from script.send_for(0.35, script.frame(hold))

    yield from script.send_for(0.03, script.frame(script.hold_commands()))
    phase = script.begin("pause", seconds=0.6)
    yield from script.wait(0.6)
    yield from script.exchange(script.frame(script.hold_commands()))
    script.end(phase)
    yield from script.exchange(script.frame(script.hold_commands(protect=False)))

    motors = script.hold_commands()
    motors[DRIVEN] = Motor(1, dq=spec.closing * _SPEED, kd=_KD, protect=True)
    motors[FREE] = Motor(1, dq=script.joints[FREE].closing * _SPEED / 2, kd=_KD)
    phase = script.begin("drive")
    yield from script.send_for(0.4, script.frame(motors))
    script.end(phase)

    phase = script.begin("silence", seconds=1.5)
    yield from script.wait(1.5)
    script.end(phase)

    # the first answer has the positions; goals elsewhere come after it
    phase = script.begin("tripped")
    yield from script.exchange(script.frame(motors))
    motors = script.hold_commands()
    motors[FREE] = replace(motors[FREE], protect=False)
    for joint in (DRIVEN, FREE):
        motors[joint] = replace(motors[joint], q=script.goal_inward(joint))
    phase.params["begin"] = list(script.q)
    phase.params["targets"] = [m.q for m in motors]
    yield from script.send_for(0.25, script.frame(motors))
    script.end(phase)

    free = [replace(m, protect=False) for m in script.hold_commands()]
    free[DRIVEN] = replace(free[DRIVEN], q=script.goal_inward(DRIVEN))
    phase = script.begin("clear", begin=script.q[DRIVEN], target=free[DRIVEN].q)
    yield from script.send_for(0.25, script.frame(free))
    script.end(phase)


_STAYS = 3.0
"""Seconds after the time-out in which a hand must do what its protection says: a client that has
died is started again within them, and its operator relies on what the hand holds."""


@stimulus("guard guard-latch guard-clear", FingerScript, after="firmer")
def squeeze_and_guard(script: FingerScript) -> Steps:
    """Close on the object, with some joints protected; then no commands."""
    pressing, free = script.plan.pressing, script.plan.free
    splits = script.next_splits()
    for percent in (CLOSED - 5.0, OPEN):
        yield from _protected_step(script, percent, splits)
    squeeze = finger_squeezes(script, pressing, splits)
    phases: list[Phase] = []
    if pressing:
        script.report("squeezing the object")
        targets = {
            s: {i: m.q for i, m in enumerate(squeeze[s]) if script.joints[s][i].closing}
            for s in pressing
        }
        phases.append(script.begin("squeeze", pressing, targets=targets))
    if free:
        phases.append(script.begin("guarded", tuple(free)))
    still = {s: script.guarded(script.motors(s, script.goal[s]), s, splits) for s in free}
    yield from script.hold(1.6 - ASIDE_SECONDS, {**squeeze, **still})
    phases += step_beside_grip(script, pressing)
    moved = {s: script.guarded(script.motors(s, script.goal[s]), s, splits) for s in free}
    yield from script.hold(ASIDE_SECONDS, {**squeeze, **moved})
    for phase in phases:
        script.end(phase)
    script.report("some joints have time-out protection, some of them move, and then ...")
    yield from drive_fingers(script, "guard-drive", free, squeeze, guarded=splits)
    script.report("... silence: the protected ones must brake and say so, the others go on")
    yield from script.silence("guard", script.model.command_timeout + _STAYS)
    script.report("they stay braked until the protection is cleared")
    yield from latch_and_clear(script, splits)


def _protected_step(
    script: FingerScript, percent: float, guarded: Mapping[Side, frozenset[int]]
) -> Steps:
    """A step in which some joints have time-out protection: it changes nothing until then."""
    sides = script.plan.sides
    poses = {s: script.pose(s, percent) for s in sides}
    hands = {s: script.guarded(script.motors(s, pose), s, guarded) for s, pose in poses.items()}
    yield from script.hold_as("guarded-step", sides, 0.45, hands, targets=poses)
    script.goal.update(poses)


def latch_and_clear(script: FingerScript, guarded: Mapping[Side, frozenset[int]]) -> Steps:
    """Commands to elsewhere with the same joints protected, and then with none."""
    sides = script.plan.sides
    poses = {s: script.pose(s, CLOSED - 5.0) for s in sides}
    targets = {s: {i: poses[s][i] for i in sorted(guarded[s])} for s in sides}
    hands = {s: script.guarded(script.motors(s, poses[s]), s, guarded) for s in sides}
    yield from script.hold_as("guard-latch", sides, 0.35, hands, targets=targets)
    yield from script.everyone("guard-clear", poses, most=1.5)


@check("DEX3-GUARD-01")
def guards(ctx: Context) -> Outcome:
    """Motion after the time-out of protected joints, driven by velocity or to a position; of those
    that stop, what they report, and what clears the protection.
    """
    stops = stops_moving(ctx, (*roles_of(ctx).driven, *roles_of(ctx).slow), guarded=True)
    if stops.met is False:
        return stops
    return all_of(stops, _reports_trip(ctx), _latches(ctx), _clears(ctx))


def _reports_trip(ctx: Context) -> Outcome:
    """Bit 7 of the state's mode byte of each joint before and after the time-out."""
    if not np.nan_to_num(ctx.states.mode).any():
        return ctx.absent("mode is not filled (0 throughout)")
    silences = silences_of(ctx, "guard", "silence")
    for silence in silences:
        last, late, end = silence.last, silence.late, silence.end
        # protection is on for a while before: repeated commands must keep it from tripping
        begins = [ctx.span(p)[0] for n in ("squeeze", "guarded") for p in ctx.phases(n)]
        since = max((b for b in begins if last - 5.0 < b < last), default=last - 0.2)
        before = mode_bytes(ctx, ctx.states.between(since, last + 0.5)) >> 7
        after = mode_bytes(ctx, ctx.states.between(late, end)) >> 7
        if not len(before) or not len(after):
            return ctx.skipped("no state in the silence")
        if before.any():
            joint = int(np.argmax(before.any(axis=0)))
            return ctx.failed(
                "too early",
                ctx.named("bit 7 is set while commands arrive", joint),
                ctx.at(ctx.states.topic, since, last),
            ).about(joint)
        wrong = (after != silence.guarded).any(axis=0)
        if wrong.any():
            joint = int(np.argmax(wrong))
            seen = "not always set" if silence.guarded[joint] else "set without protection"
            return ctx.failed(
                "not set" if silence.guarded[joint] else "set",
                ctx.named(f"bit 7 is {seen} after the time-out", joint),
                ctx.at(ctx.states.topic, late, end),
            ).about(joint)
    if not any(s.end - s.late >= ctx.tolerance("stays_s") - 0.2 for s in silences):
        return ctx.skipped("no silence with protection was long enough")
    count = sum(int(s.guarded.sum()) for s in silences)
    return ctx.passed("set", f"bit 7 is set in {count} protected motors, and in no other")


def _latches(ctx: Context) -> Outcome:
    """Motion by commands that do not clear the protection."""
    how = "while the time-out protection was tripped and not cleared"
    return not_driven(ctx.only("guard-latch"), how, "max_towards_stroke")


def _clears(ctx: Context) -> Outcome:
    """The step after the protection was cleared."""
    when = "commanded without bit 7 after the protection had tripped"
    return arrival(ctx, when, ctx.phases("guard-clear"))


# ---------------------------------------------------------------------------------------- USB


def _usb_flags(c: UsbContext, answer: Answer) -> dict[int, bool]:
    """The time-out flag by joint."""
    motors = [c.hand.motor(answer, joint) for joint in range(len(c.hand.joints))]
    return {i: m.tripped for i, m in enumerate(motors) if m is not None}


@check("DEX3USB-PROT-01")
def _usb_trips_for_long(c: UsbContext) -> Outcome:
    trips = _usb_trips(c)
    return all_of(trips, _usb_stays(c)) if trips.met else trips


def _usb_trips(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the silence")
    flags = _usb_flags(c, answers[0])
    silent = [i for i, tripped in flags.items() if not tripped and i != FREE]
    if not silent:
        return c.passed(f"{sum(flags.values())} tripped")
    observed = f"after 1.5 s without a command {named_joints(c, silent)} show no time-out"
    return c.failed(f"{len(silent)} not", observed, c.at(answers[0].t)).about(*silent)


def _usb_driven(c: UsbContext, joint: int) -> float | None:
    """Seconds for which a joint driven at a steady speed went on after the last command.

    :returns: None when it had no such speed before, so that its stop cannot be detected.
    """
    silences, drives = c.hand.phases("silence"), c.hand.phases("drive")
    after = [a for s in silences for a in c.hand.answers if a.transfer.submitted_ns >= s.end_ns]
    if not drives or not after:
        return None
    t, q = c.hand.positions(drives[0])
    late = t > t[-1] - 0.15 if len(t) else t > 0
    if late.sum() < 3:
        return None
    speed = float(np.polyfit(t[late], q[late, joint], 1)[0])
    if not abs(speed) >= c.tolerance("min_dq"):
        return None
    return float(c.hand.q(after[0])[joint] - q[-1, joint]) / speed


_USB_NO_SPEED = "the motor was not driven before the silence, so its stop proves nothing"


@check("DEX3USB-PROT-02")
def _usb_stops(c: UsbContext) -> Outcome:
    (silence,) = c.phases()
    driven = _usb_driven(c, DRIVEN)
    if driven is None:
        return c.skipped(_USB_NO_SPEED)
    figure = f"{driven:.2f} s"
    if driven <= c.tolerance("max_s"):
        return c.passed(figure, driven_s=driven)
    observed = f"without commands it went as far as in {figure} of driving"
    # a busy machine delays the answers that the speed is measured by
    places = [c.over(phase) for phase in (silence, *c.hand.phases("drive"))]
    outcome = c.failed(figure, observed, *places, driven_s=driven).about(DRIVEN)
    return outcome.if_late(driven - c.tolerance("max_s"))


def _usb_stays(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if len(answers) < 2:
        return c.skipped("too few answers after the silence")
    for answer in answers[1:]:
        cleared = [i for i, tripped in _usb_flags(c, answer).items() if not tripped and i != FREE]
        if cleared:
            observed = f"{named_joints(c, cleared)} cleared the flag while bit 7 was set"
            return c.failed("cleared", observed, c.at(answer.t)).about(*cleared)
    moved = abs(float(c.hand.q(answers[-1])[DRIVEN]) - phase.params["begin"][DRIVEN])
    if moved <= c.tolerance("max_q"):
        return c.passed(f"{moved:.3f} rad", moved=moved)
    observed = f"it followed a position command by {moved:.2f} rad while tripped"
    outcome = c.failed(f"{moved:.2f} rad", observed, c.over(phase), moved=moved)
    return outcome.about(DRIVEN)


@check("DEX3USB-PROT-04")
def _usb_cleared(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer to a command with bit 7 = 0")
    tripped = [i for i, flag in _usb_flags(c, answers[-1]).items() if flag]
    if tripped:
        observed = (
            f"{named_joints(c, tripped)} still tripped after 0.25 s of commands with bit 7 = 0"
        )
        return c.failed(f"{len(tripped)} tripped", observed, c.over(phase)).about(*tripped)
    part = part_of_way(c.hand, phase, DRIVEN, phase.params["begin"], phase.params["target"])
    figure = f"{part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed(figure)
    return c.failed(figure, f"after clearing it went {figure}", c.over(phase)).about(DRIVEN)


@check("DEX3USB-PROT-05")
def _usb_disabled(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the silence")
    if any(_usb_flags(c, a).get(FREE) for a in answers):
        observed = f"{named_joints(c, [FREE])} reports a time-out although its protection was off"
        return c.failed("tripped", observed, c.over(phase)).about(FREE)
    driven = _usb_driven(c, FREE)
    if driven is None:
        return c.skipped(_USB_NO_SPEED)
    if driven < c.tolerance("min_s"):
        observed = f"{named_joints(c, [FREE])} stopped {driven:.2f} s into the silence"
        return c.failed(f"{driven:.2f} s", observed, c.over(phase), driven_s=driven).about(FREE)
    begin, target = (phase.params[name][FREE] for name in ("begin", "targets"))
    part = part_of_way(c.hand, phase, FREE, begin, target)
    figure = f"{part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed(figure)
    return c.failed(figure, f"after the pause it went {figure}", c.over(phase)).about(FREE)


@check("DEX3USB-PROT-06")
def _usb_early(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the pause")
    tripped = [i for i, flag in _usb_flags(c, answers[0]).items() if flag]
    if not tripped:
        return c.passed("none")
    observed = f"{named_joints(c, tripped)} tripped within {phase.params['seconds']:g} s"
    return c.failed(f"{len(tripped)} tripped", observed, c.over(phase)).about(*tripped)
