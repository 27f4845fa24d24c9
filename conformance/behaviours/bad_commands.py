"""Commands with values or lengths that no client should send do no harm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from dexkit.conformance.checks import Context, Outcome, causes, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.nudges import STIFFNESS, displacement_noise, is_alike, nudges
from dexkit.conformance.checks.obedience import sags, silent, stays, unharmed
from dexkit.conformance.checks.robot import LATE_S, RobotContext, no_state
from dexkit.conformance.checks.steps import (
    Step,
    disobeyed,
    missed,
    obeyed_before,
    steps,
    steps_of,
)
from dexkit.conformance.checks.timing import gaps
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import ASIDE_SECONDS, HandScript
from dexkit.conformance.stimuli.phases import Moment, Place, stimulus
from dexkit.conformance.stimuli.robot import STEP, RobotScript
from dexkit.conformance.stimuli.script import (
    NOT_FINITE,
    Join,
    Leave,
    Payloads,
    Role,
    Send,
    Steps,
)
from dexkit.hand import Side
from dexkit.unseen import UNSEEN_S

_FLOOD = 500
"""Commands of a burst."""
_BAD = {
    "nan": "broken commands (NaN and infinity): nothing may move",
    "out-of-range": "commands far out of range: no harm may be done",
    "empty": "empty commands: nothing may move",
    "short": "commands for a motor too few: nothing may move",
    "long": "commands for more motors than there are: nothing may move",
    "negative": "negative gains: nothing may run away",
    "wrong-id": "mode bytes with each other's id: the wrong joint must not move",
}


@stimulus("fingerprint", HandScript, after="step joint dead-zone")
def make_fingerprint(script: HandScript) -> Steps:
    """Steps to compare the ``recover`` steps with."""
    for _ in range(2):
        yield from script.everyone("fingerprint", script.other_place(), most=script.step_most)


@stimulus("nan", HandScript, after="fingerprint")
def send_not_finite(script: HandScript) -> Steps:
    """NaN and infinity in each field, on each side alone."""
    yield from _send_and_recover(script, "nan")


@stimulus("out-of-range", HandScript, after="nan")
def send_out_of_range(script: HandScript) -> Steps:
    """Positions far outside of the range, and beyond each end."""
    yield from _send_and_recover(script, "out-of-range")


@stimulus("empty long negative foreign", GripperScript, after="out-of-range")
def send_malformed_to_gripper(script: GripperScript) -> Steps:
    """Commands for no motor, for motors too many, with negative gains, and of another type."""
    kinds = "empty long negative foreign" if script.gains_used else "empty long foreign"
    yield from _send_and_recover(script, kinds)


@stimulus("foreign empty short long negative wrong-id", FingerScript, after="out-of-range")
def send_malformed(script: FingerScript) -> Steps:
    """Every other kind, with one step after them, to save time."""
    yield from _send_and_recover(script, "foreign empty short long negative wrong-id")


def _send_and_recover(script: HandScript, kinds: str, *, most: float | None = None) -> Steps:
    """Bad commands of these kinds, and a good step after all of them.

    :param most: seconds of the step, if not as of every other one.
    """
    most = script.step_most if most is None else most
    these = [name for name in kinds.split() if name in script.plan.phases]
    for name in these:
        if name != these[0]:
            yield from script.hold(script.between_bad)
        yield from _send_foreign(script) if name == "foreign" else _send_kind(script, name)
    if these:
        yield from script.everyone(
            "recover", script.other_place(), most=most, after=" ".join(these)
        )


def _send_kind(script: HandScript, name: str) -> Steps:
    """Bad commands of one kind, for a while on each side alone where it has a topic of its own."""
    script.report(_BAD[name])
    if name == "nan":
        for side in script.plan.sides:
            kinds = [{side: motors} for motors in not_finite_motors(script, side)]
            # long enough for a step of the other side beside them
            each = max(7 * script.period_ns / 1e9, ASIDE_SECONDS / len(kinds))
            yield from _send_bad(script, name, (side,), kinds, each)
    elif isinstance(script, GripperScript):
        yield from _send_to_gripper(script, name)
    elif isinstance(script, FingerScript):
        yield from _send_to_fingers(script, name)


def _send_to_gripper(script: GripperScript, name: str) -> Steps:
    sides = script.plan.sides
    if name == "out-of-range":
        # taken modulo a turn, 11 rad leads to the wrong end, and 1000 rad to the right one
        places = (11.0, -1000.0, 1.3 * script.stroke, -0.3 * script.stroke)
        far = [dict.fromkeys(sides, (Motor(q=q),)) for q in places]
        yield from _send_beyond_each_end(script, name, far, 0.15)
    elif name == "long":
        good = {s: script.motors(s, pose) for s, pose in script.goal.items()}
        for alone in _each_alone(script):
            mine = {s: good[s] for s in alone}
            others = {s: m for s, m in good.items() if s not in alone}
            rest = script.codec.encode(others) if others else []
            longer = [
                script.codec.encode_longer(mine, [Motor(q=_gripper_far(script, alone[0]))] * more)
                + rest
                for more in (1, 19)
            ]
            yield from _send_bad(script, name, alone, longer, 0.1)
    elif name == "negative":
        kp, kd = script.model.gains[0]
        for alone in _each_alone(script):
            near = {s: script.aside(s, 0.1)[0] for s in alone}
            for damping in (-kd, kd):
                wrong = {s: (Motor(q=q, kp=-kp, kd=damping),) for s, q in near.items()}
                yield from _send_bad(script, name, alone, [wrong], 0.15)
    else:
        for alone in _each_alone(script):
            yield from _send_bad(script, name, alone, [_gripper_empty(script, alone)], 0.15)


def _gripper_empty(
    script: GripperScript, sides: Sequence[Side]
) -> Mapping[Side, Motors] | Payloads:
    """Commands without a motor."""
    if script.codec.shared:
        return script.codec.encode_empty(sides)
    return dict.fromkeys(sides, ())


def _gripper_far(script: GripperScript, side: Side) -> float:
    """A q far from the goal."""
    return script.low(side) if script.goal[side][0] > 0.6 * script.stroke else script.high()


def _send_to_fingers(script: FingerScript, name: str) -> Steps:
    if name == "out-of-range":
        far = [
            {s: _at(script, s, [end] * len(script.joints[s])) for s in script.plan.sides}
            for end in (11.0, -1000.0)
        ]
        for way in (0.3, -0.3):
            ends = {
                s: [(j.q_max if way > 0 else j.q_min) + way * j.stroke for j in joints]
                for s, joints in script.joints.items()
            }
            far.append({s: _at(script, s, ends[s]) for s in script.plan.sides})
        # long enough for the fastest joint to leave its range from anywhere
        travel = min(j.stroke / j.dq_max for joints in script.joints.values() for j in joints)
        each = max(0.2, 0.7 * travel)
        yield from _send_beyond_each_end(script, name, far, each, most=1.5)
    else:
        for alone in _each_alone(script):
            wrong = _malformed(script, name, alone)
            for malformed in wrong:
                each = 0.18 if name != "negative" else 0.25 / len(wrong)
                yield from _send_bad(script, name, alone, [malformed], each)


def _malformed(
    script: FingerScript, name: str, sides: Sequence[Side]
) -> Sequence[Mapping[Side, Motors] | Payloads]:
    """The bad commands of a phase to these sides, whole messages where they share one."""
    good = {s: script.motors(s, script.goal[s]) for s in sides}
    surplus = replace(good[sides[0]][0], q=1.0)
    if script.codec.shared and name == "empty":
        return [script.codec.encode_empty(sides)]
    if script.codec.shared and name == "short":
        return [script.codec.encode_shorter(good)]
    if script.codec.shared and name == "long":
        return [script.codec.encode_longer(good, [surplus] * more) for more in (1, 13)]
    if name == "empty":
        return [{s: [] for s in sides}]
    if name == "short":
        return [{s: motors[:-1] for s, motors in good.items()}]
    if name == "long":
        return [
            {s: [*m, *[replace(m[0], q=1.0)] * more] for s, m in good.items()} for more in (1, 13)
        ]
    if name == "negative":
        near = {s: script.motors(s, script.aside(s, 0.1)) for s in sides}
        # kp alone, in all but the first joint: that one may be checked for all
        return [
            {s: [replace(m, kp=-m.kp, kd=-m.kd) for m in motors] for s, motors in near.items()},
            {
                s: [good[s][0], *(replace(m, kp=-m.kp, kd=0.1 * m.kd) for m in motors[1:])]
                for s, motors in near.items()
            },
        ]
    return [{s: _crossed(script, s, motors) for s, motors in good.items()}]


def _crossed(script: FingerScript, side: Side, motors: Motors) -> Motors:
    """Two motors with each other's id, and a goal elsewhere for the first."""
    first, other = script.roles.crossed
    target = script.other_place()[side][first]
    crossed = list(motors)
    crossed[first] = replace(motors[first], q=target, mode=script.codec.mode(other))
    crossed[other] = replace(motors[other], mode=script.codec.mode(first))
    return crossed


def not_finite_motors(script: HandScript, side: Side) -> list[Motors]:
    """Commands with one field each that is not finite, and a goal far away: it shows if one counts.

    Of a hand of several joints one joint has it: the last, the first and a middle one in turn.
    """
    found: list[Motors] = []
    if isinstance(script, GripperScript):
        motor = Motor(q=_gripper_far(script, side))
        for field, value in NOT_FINITE:
            if field == "q" or script.gains_used:
                found.append((replace(motor, **{field: value}),))  # type: ignore[arg-type]
        return found
    last = len(script.model.gains) - 1
    joints = (last, 0, last // 2)
    for i, (field, value) in enumerate(NOT_FINITE):
        if field in script.plan.dialect.command_fields:
            motors = list(script.motors(side, script.other_place()[side]))
            joint = joints[(i + i // 3) % 3]
            motors[joint] = replace(motors[joint], **{field: value})  # type: ignore[arg-type]
            found.append(motors)
    return found


def _at(script: HandScript, side: Side, q: Sequence[float]) -> Motors:
    """The command to go to q of every joint, rad, which may be out of range."""
    if isinstance(script, GripperScript):
        return (Motor(q=q[0]),)
    return [replace(m, q=x) for m, x in zip(script.motors(side, tuple(q)), q, strict=True)]


def _each_alone(script: HandScript) -> list[tuple[Side, ...]]:
    """Each side by itself; both where they share a message."""
    if script.codec.shared:
        return [script.plan.sides]
    return [(s,) for s in script.plan.sides]


def _send_bad(
    script: HandScript,
    name: str,
    sides: Sequence[Side],
    kinds: Sequence[Mapping[Side, Motors] | Payloads],
    each: float,
) -> Steps:
    """Bad commands to some sides, as a phase: each kind long enough to show what it does.

    The other sides go on being commanded; where there is time, they make a step.

    :param kinds: motors of each of these sides, or whole messages.
    :param each: seconds of each kind.
    """
    beside = script.beside_others(sides, len(kinds) * each)
    good = {s: script.motors(s, q) for s, q in script.goal.items() if s not in sides}
    phase = script.begin(name, sides)
    for kind in kinds:
        bad = kind if isinstance(kind, list) else script.codec.encode({**good, **kind})
        yield from script.repeat(each, lambda bad=bad: script.send(bad))  # type: ignore[misc]
        yield from script.command()  # or it would brake, as it must without good commands
    script.end(phase)
    for other in beside:
        script.end(other)


def _send_beyond_each_end(
    script: HandScript,
    name: str,
    far: Sequence[Mapping[Side, Motors]],
    each: float,
    most: float = 2.5,
) -> Steps:
    """Goals beyond the ends to all sides, each way from inside of the range.

    At an end, a hand that goes there in any case cannot be told from one that ignores them.

    :param far: in turn beyond the one end and the other.
    :param each: seconds of each.
    :param most: seconds to come back inside in between.
    """
    for way in range(2):
        if way:
            yield from script.everyone("center", script.other_place(), most=most)
        yield from _send_bad(script, name, script.plan.sides, far[way::2], each)


def _send_foreign(script: HandScript) -> Steps:
    """Another participant publishes another type on the command topics, with far targets."""
    script.report("another type on the command topics: it must not reach the hand")
    far = script.codec.encode_foreign(
        {s: script.motors(s, pose) for s, pose in script.other_place().items()}
    )
    yield from script.do(Join(Role.STRANGER))
    phase = script.begin("foreign", script.plan.sides)
    # two goals in turn cancel out in a servo whose speed does not depend on the distance
    turns = 3 if script.plan.dialect.position_servo else 1
    yield from script.beside(phase, far, Role.STRANGER, 0.4, turns)
    script.end(phase)
    yield from script.do(Leave(Role.STRANGER))


@stimulus("burst", HandScript, after="foreign stiffness")
def flood(script: HandScript) -> Steps:
    """Hundreds of commands at once to another place, the last of them back to this one."""
    script.report(f"{_FLOOD} commands at once: only the last one counts")
    far = script.codec.encode(
        {s: script.motors(s, pose) for s, pose in script.other_place().items()}
    )
    phase = script.begin("burst", script.plan.sides)
    yield from script.do(Send(far * (_FLOOD - 1), 0))
    phase.observed = {"sent_s": script.elapsed(phase)}
    yield from script.hold(0.5)
    script.end(phase)


@stimulus("nan", HandScript, moment=Moment.NEW_CLIENT, after="grip squeeze")
def send_bad_again(script: HandScript) -> Steps:
    """Commands that are not finite, and such that are far out of range, of a new client."""
    script.report("bad commands of the new client: nothing may move")
    yield from _send_not_finite_at_once(script, 0.065)
    yield from _send_far_away(script, (1000.0, -1e6), 0.15)
    yield from script.everyone(
        "recover", script.other_place(), most=1.5, after=_bad_since_recovery(script)
    )


def _send_not_finite_at_once(script: HandScript, each: float) -> Steps:
    """Every second kind of them, to all sides at once; seconds of each."""
    sides = script.plan.sides
    every = zip(*(not_finite_motors(script, s) for s in sides), strict=True)
    kinds = [dict(zip(sides, motors, strict=True)) for motors in every]
    yield from _send_bad(script, "nan", sides, kinds[::2], each)


def _send_far_away(script: HandScript, goals: Sequence[float], each: float) -> Steps:
    """Commands far beyond both ends, to all sides at once.

    :param goals: q of every joint, rad, one after the other.
    :param each: seconds of each.
    """
    sides = script.plan.sides
    if "out-of-range" in script.plan.phases:
        joints = len(script.joints[sides[0]])
        kinds = [{s: _at(script, s, [q] * joints) for s in sides} for q in goals]
        yield from _send_bad(script, "out-of-range", sides, kinds, each)


def _bad_since_recovery(script: HandScript) -> str:
    """The phases of bad commands since the last step that a hand can recover by."""
    names = [p.name for p in script.phases]
    last = max(i for i, name in enumerate(names) if name in ("restart", "resume", "recover"))
    return " ".join(dict.fromkeys(names[last + 1 :]))


@stimulus("nan", RobotScript, after="wrong-crc", leaves=Place.AWAY)
def send_robot_not_finite(script: RobotScript) -> Steps:
    """A goal elsewhere, with NaN or infinity somewhere; ``params["kind"]``."""
    kinds = {"q": math.nan, "dq": math.inf, "tau": math.nan, "kp": math.inf, "kd": math.nan}
    for kind, value in kinds.items():
        order = script.wish(**{kind: value})
        yield from script.bad("nan", partial(script.put, order), 0.15, kind=kind)


@stimulus("unused", RobotScript, after="nan", leaves=Place.AWAY)
def drive_unused_slots(script: RobotScript) -> Steps:
    """Slots without a motor are driven."""
    order = list(script.order)
    for slot in set(range(script.robot.slots)) - set(script.robot.used):
        order[slot] = Motor(q=1.0, dq=0.0, tau=5.0, kp=100.0, kd=3.0, mode=1)
    yield from script.bad("unused", lambda: script.put(order), 0.3)


@stimulus("machine", RobotScript, after="unused", leaves=Place.AWAY)
def command_other_machine(script: RobotScript) -> Steps:
    """A goal elsewhere for another machine, where messages have ``mode_machine``."""
    other = script.obs.machine % 255 + 1
    order = script.wish()
    yield from script.bad("machine", lambda: script.put(order, machine=other), 0.3)


@stimulus("foreign", RobotScript, after="machine", leaves=Place.AWAY)
def send_other_family(script: RobotScript) -> Steps:
    """Commands of the other family's type."""
    yield Join(Role.STRANGER)
    wish = list(script.order)  # of every joint: the families' slots are not the same
    for slot in script.robot.used:
        wish[slot] = replace(wish[slot], q=wish[slot].q + script.inward(slot, STEP))
    payload = script.codec.encode_foreign_command(wish)

    def send() -> Steps:
        script.next_ns += script.period_ns
        payloads = [(script.robot.cmd_topic, payload)]
        yield from script.do(Send(payloads, script.next_ns, by=Role.STRANGER))

    yield from script.keep(0.1)
    yield from script.bad("foreign", send, 0.3)
    yield Leave(Role.STRANGER)


@stimulus("recover", RobotScript, after="foreign", leaves=Place.AWAY)
def step_after_bad_commands(script: RobotScript) -> Steps:
    """A step, after all that."""
    yield from script.step("recover")


@check("DEX1-SAFE-01", "DEX3-SAFE-01")
def not_finite(ctx: Context) -> Outcome:
    """Commands with NaN and infinity in every field."""
    return stays(ctx, "commands with NaN and infinity")


@check("DEX1-SAFE-02", "DEX3-SAFE-02")
def out_of_range(ctx: Context) -> Outcome:
    """Commands to positions far outside the stroke."""
    margin = ctx.tolerance("margin_rad")
    reached: list[tuple[float, float]] = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end + 0.1)
        for joint, spec in enumerate(ctx.joints):
            q = ctx.states.q[rows, joint]
            if not len(q):
                continue
            bad = ~((q >= spec.q_min - margin) & (q <= spec.q_max + margin))
            if bad.any():
                i = int(np.argmax(bad))
                text = (
                    f"q became {q[i]:.2f} {ctx.unit}; the stroke is {spec.q_min:g} to "
                    f"{spec.q_max:.2f} {ctx.unit}"
                )
                place = ctx.at(ctx.states.topic, float(ctx.states.t[rows][i]))
                outcome = ctx.failed(f"{q[i]:.2f} {ctx.unit}", ctx.named(text, joint), place)
                return outcome.about(joint).because(causes.of_range(float(np.nanmax(q))))
            wrong = judged(
                ctx,
                _other_ways(ctx, phase, joint),
                "back_rad",
                "max_back_stroke",
                nothing=ctx.passed(""),
            )
            if not wrong.met:
                return wrong
            reached.append((float(q.min()), float(q.max())))
    outcome = unharmed(ctx, "commands far out of range")
    if outcome.met is False or outcome.reason:
        return outcome
    figure, values = "within limits", {}
    if len(ctx.joints) == 1 and reached:
        figure = f"{reached[0][0]:.2f} .. {reached[0][1]:.2f} {ctx.unit}"
        values = {"q_min": reached[-1][0], "q_max": reached[-1][1]}
    met = ctx.passed(figure, "q stayed within the stroke, then obeyed", **values)
    return met.resting_on(*outcome.measures)


_TURNS_S = 0.25  # s for a moving hand to reverse, with its allowed delay


def _other_ways(ctx: Context, phase: Phase, joint: int) -> Iterator[Figure]:
    """How far a joint moves away from the end beyond which its goal lies."""
    begin, end = ctx.span(phase)
    spec = ctx.joints[joint]
    rows = ctx.given(begin, end)
    t, q = ctx.commands.t[rows], ctx.commands.q[rows, joint]
    far = (q > spec.q_max + 0.1 * spec.stroke) * 1 - (q < spec.q_min - 0.1 * spec.stroke) * 1
    t, far = t[far != 0], far[far != 0]
    turns = np.flatnonzero(np.diff(far, prepend=0))
    for a, b, way in zip(t[turns], [*t[turns[1:]], end], far[turns], strict=True):
        # before the first of them it was at rest
        since = a + _TURNS_S if a > t[0] else a
        turning = ctx.q(a - 0.05, since)[:, joint] * way
        later = ctx.states.between(since, b)
        if not len(turning) or not len(ctx.states.t[later]):
            continue
        back = float(turning.min()) - ctx.states.q[later, joint] * way
        i = int(np.argmax(back))
        text = (
            f"commanded far {'above' if way > 0 else 'below'} its range it went the other way by "
            f"{back[i]:.2f} {ctx.unit}"
        )
        yield Figure(float(back[i]), float(ctx.states.t[later][i]), None, joint, text)


_OTHER_LENGTHS = {
    "empty": "empty commands",
    "short": "commands with one motor too few",
    "long": "commands for more motors than there are",
}


@check("DEX1-SAFE-03", "DEX3-SAFE-03")
def other_length(ctx: Context) -> Outcome:
    """Commands without a motor in them, with one too few, and with too many."""
    return all_of(*(stays(ctx.only(p), _OTHER_LENGTHS[p]) for p in ctx.requirement.phases))


@check("DEX1-SAFE-10", "DEX3-SAFE-11")
@worst("motion_rad", "max_motion_stroke", nothing="no state during commands with negative gains")
def driven_away(ctx: Context) -> Figures:
    """Motion away from q during commands with negative gains."""
    sag = sags(ctx)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - 0.1, begin), ctx.q(begin, end)
        given = ctx.given(begin, end) & (ctx.commands.kp < 0).any(axis=1)
        if not len(before) or not len(q) or not given.any():
            continue
        start = np.median(before, axis=0)
        way = np.sign(np.median(ctx.commands.q[given], axis=0) - start)
        with np.errstate(invalid="ignore"):
            away = np.max((start - q) * way, axis=0) - (0.0 if sag is None else sag)
        for joint in np.flatnonzero(np.isfinite(away)).tolist():
            most = max(0.0, float(away[joint]))
            text = f"moved by {most:.2f} {ctx.unit} away from q with negative gains"
            yield Figure(most, begin, end, joint, text)


@check("DEX1-SAFE-06", "DEX3-SAFE-07")
def foreign_type(ctx: Context) -> Outcome:
    """Messages of another type on the command topic."""
    return stays(ctx, "messages of another type on its command topic")


@check("DEX1-SAFE-07", "DEX3-SAFE-08")
@worst("motion_rad", "max_motion_stroke", nothing="no state around the burst")
def burst(ctx: Context) -> Figures:
    """Distance from the last command's goal after a burst of hundreds of commands."""
    wait, limit = ctx.tolerance("settle_s"), ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        found = gaps(ctx, limit, begin - 0.05, end)
        if found:
            text = f"no state from {found[0][0]:.3f} s on"
            yield silent(ctx, found, limit, "state stops", text)
        since = begin + (phase.observed.get("sent_s") or 0.0) + wait
        before, q = ctx.q(begin - 0.15, begin), ctx.q(since, end)
        if not len(before) or not len(q):
            yield ctx.skipped("no state around the burst")
        away = np.abs(q - np.median(before, axis=0)).max(axis=0)
        for joint, most in enumerate(away.tolist()):
            text = (
                f"{wait:g} s after the last command of the burst it was still up to "
                f"{most:.3f} {ctx.unit} away"
            )
            yield Figure(most, since, end, joint, text)


_AFTER_ABUSE = ("recover", "resume", "company", "restart", "service-restart")


_RESTARTED = ("company", "restart", "service-restart")


_AT_REST_PART = 0.01
"""Part of the range by which q may vary in the 0.1 s before a step that begins at rest."""


_FAST_S = 0.05
"""Seconds over which the fastest part of a step is measured: several states of the slowest rate."""


@check("DEX1-ABUSE-01", "DEX3-ABUSE-01")
def unchanged(ctx: Context) -> Outcome:
    """Compare duration and speed of good steps, and the displacement by a torque, after each abuse
    with those before any; also the errors of the steps between the phases.
    """
    between = [*ctx.phases("center"), *ctx.phases()]
    for phase in (p for p in between if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            if missed(ctx, step) > ctx.tolerance("max_error_stroke", step.joint):
                return disobeyed(ctx, "between two phases", step)
    first = [s for s in steps(ctx) if abs(s.size) >= ctx.tolerance("min_step_stroke", s.joint)]
    speeds = judged(
        ctx, _speeds(ctx, first), "speed_rad_s", "min_speed_part", nothing=ctx.passed("no step")
    )
    if not speeds.met:
        return speeds
    nothing = "no two steps that can be compared"
    return _other_stiffness(ctx) or judged(
        ctx, _durations(ctx, first), "ratio", "max_ratio", nothing=nothing
    )


def _like(first: list[Step], step: Step) -> list[Step]:
    return [s for s in first if s.joint == step.joint and 0.7 < step.size / s.size < 1.4]


def _durations(ctx: Context, first: list[Step]) -> Figures:
    """The duration of each step, as a part of that of the same step before."""
    for phase in (p for name in _AFTER_ABUSE for p in ctx.phases(name)):
        for step in steps_of(ctx, phase):
            seconds = _duration(step)
            known = [d for d in map(_duration, _like(first, step)) if d is not None]
            if seconds is None or not known:
                continue  # other requirements judge whether it arrives at all
            slack = ctx.tolerance("slack_s" if phase.name == "recover" else "soft_start_s")
            longest = ctx.tolerance("max_ratio") * (max(known) + slack)
            yield step.figure(
                seconds / (max(known) + slack),
                f"{seconds:.2f} s from 10 to 90 % at {step.begin:.1f} s, {max(known):.2f} s in the "
                "same step at first",
                late=seconds - longest,
                measure=Measure(seconds, longest, span=(step.begin, step.end)),
            )


def _duration(step: Step) -> float | None:
    """Seconds from 10 to 90 % of a step; None if it does not get there."""
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not (part >= 0.9).any():
        return None
    return float(step.t[np.argmax(part >= 0.9)] - step.t[np.argmax(part >= 0.1)])


def _speeds(ctx: Context, first: list[Step]) -> Figures:
    """The speeds of steps after bad commands, after a restart or with a second client, each with
    the least that it may be after the same step before.
    """
    # the first step for another client, and after a restart, may begin softly
    later = [p for name in _RESTARTED for p in ctx.phases(name)[1:]]
    for phase in (p for p in (*ctx.phases("recover"), *later) if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            before = ctx.q(step.begin - 0.1, step.begin)[:, step.joint]
            at_rest = len(before) and np.ptp(before) < _AT_REST_PART * step.stroke
            if not (at_rest and ctx.seen(step.begin - 0.1, step.begin)):
                continue  # it was under way, so that this is not the same step
            now = fastest(step)
            known = [
                # a hand of constant speed is not faster over a longer distance, a spring-like one
                # is
                fast * min(1.0, abs(step.size / s.size))
                for s in _like(first, step)
                if (fast := fastest(s)) is not None
            ]
            if now is None or not known:
                continue
            least = ctx.tolerance("min_speed_part") * min(known)
            yield step.figure(
                now,
                f"{now:.1f} {ctx.unit}/s at its fastest in a step at {step.begin:.1f} s, "
                f"{min(known):.1f} {ctx.unit}/s in the same step at first",
                limit=least,
                late=0.8 * abs(step.size) * (1.0 / max(now, 1e-3) - 1.0 / least),
            )


def fastest(step: Step) -> float | None:
    """The speed of a step's fastest part, rad/s; None if it has no such part, does not arrive, or
    moved while there was no state.
    """
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not (part >= 0.9).any():
        return None
    until = int(np.argmax(part >= 0.9))
    if np.diff(step.t[: until + 1], prepend=step.begin).max() > UNSEEN_S:
        return None
    later = np.searchsorted(step.t, step.t + _FAST_S)
    whole = np.flatnonzero(later < len(step.t))
    if not len(whole):
        return None
    took = step.t[later[whole]] - step.t[whole]
    return abs(step.size) * float(np.max((part[later[whole]] - part[whole]) / took))


def _other_stiffness(ctx: Context) -> Outcome | None:
    """The failure of a hand that a torque displaces more or less than it did at first."""
    pulses = [p for p in ctx.phases(STIFFNESS) if obeyed_before(ctx, p)]
    found = nudges(ctx, pulses)
    if len(found) < 2:
        return None
    first, *later = sorted(found, key=lambda n: n.begin)
    if first.way < ctx.tolerance("min_motion_stroke"):
        return None
    parts = ctx.tolerance("min_way_part"), ctx.tolerance("max_way_part")
    noise = displacement_noise(ctx, pulses)
    for nudge in later:
        if not is_alike(first, nudge, parts, noise):
            text = (
                f"a torque displaced it by {nudge.way:.3f} {ctx.unit} at {nudge.begin:.1f} s, and "
                f"by {first.way:.3f} {ctx.unit} at first"
            )
            place = ctx.at(ctx.states.topic, nudge.begin, nudge.end)
            figure = f"{nudge.way:.3f} {ctx.unit}"
            return ctx.failed(figure, text, place, motion_rad=nudge.way)
    return None


_SOME = 20  # states before a phase or at its end that are averaged


_END = 0.06  # s after a phase during which its last command may still act


@check("H1-CRC-02", "H1-MODE-02", "H1-GAIN-04")
@check("H1-SAFE-01", "H1-SAFE-02", "H1-SAFE-03", "G1-SAFE-05")
@worst("motion_rad", "max_motion_rad", nothing="no such command was sent")
def robot_stays(ctx: RobotContext) -> Figures:
    """Motion of joints during commands that must have no effect."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - LATE_S, begin)[-_SOME:], ctx.q(begin, end + _END)
        if not len(before) or not len(q):
            yield no_state(ctx, phase)
            return
        moved = np.nan_to_num(np.abs(q - before.mean(axis=0)).max(axis=0), nan=np.inf)
        joint = int(np.argmax(moved))
        kind = f" ({phase.params['kind']})" if "kind" in phase.params else ""
        text = f"moves by {moved[joint]:.3f} rad{kind}"
        yield Figure(float(moved[joint]), begin, end, joint, text)
