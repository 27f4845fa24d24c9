"""What the mode byte of a motor says and does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.obedience import stays
from dexkit.conformance.checks.robot import RobotContext, joint_of
from dexkit.conformance.checks.silences import mode_bytes, roles_of
from dexkit.conformance.checks.steps import not_driven, own_speed, steps_of
from dexkit.conformance.kit.motor_messages import MotorCodec, Motors
from dexkit.conformance.stimuli.fingers import CLOSED, SPLITS, FingerScript
from dexkit.conformance.stimuli.phases import Moment, Place, stimulus
from dexkit.conformance.stimuli.robot import RobotScript
from dexkit.conformance.stimuli.script import Steps
from dexkit.conformance.stimuli.usb import UsbScript, UsbSteps
from dexkit.conformance.usb.context import UsbContext, quiet_motors
from dexkit.conformance.usb.frames import Motor
from dexkit.hand import Floats, JointMode, Side
from dexkit.models import ModeByte

_WIDE = (CLOSED + 5.0, 5.0)
"""Percent of closing between which joints are locked under way."""
_FAR = 80.0
"""Percent of closing that is far from both poses."""
_UNDER_WAY = 0.08
"""Seconds after which a joint moves fast in a step with the client's gains."""


@stimulus("lock", FingerScript, after="limp", leaves=Place.AWAY)
def lock_all(script: FingerScript) -> Steps:
    """All motors locked, with a q elsewhere."""
    script.report("locked motors: they must not follow their q")
    yield from script.hold(0.1)
    yield from _lock(script, CLOSED, 0.3)


@stimulus("lock", FingerScript, moment=Moment.NEW_CLIENT, after="nan")
def lock_again(script: FingerScript) -> Steps:
    """All motors locked once more, by a new client."""
    yield from _lock(script, _FAR, 0.25)


def _lock(script: FingerScript, percent: float, seconds: float) -> Steps:
    """All motors locked, with a q that is so far closed."""
    sides = script.plan.sides
    targets = {s: script.pose(s, percent) for s in sides}
    every = {s: frozenset(range(len(script.joints[s]))) for s in sides}
    yield from script.hold_as(
        "lock", sides, seconds, _locked_motors(script, script.all(percent), every), targets=targets
    )


@stimulus("mixed", FingerScript, after="lock", leaves=Place.AWAY)
def lock_some(script: FingerScript) -> Steps:
    """Steps in which some joints are locked under way: three times, with other joints."""
    script.report("some joints are locked under way: they must stop, and the others go on")
    sides = script.plan.sides
    for turn in range(len(SPLITS)):
        percent = _WIDE[turn % 2]  # wide: a joint that is not braked must have room to run
        poses = {s: script.pose(s, percent) for s in sides}
        hands = script.all(percent)
        splits = script.next_splits()
        yield from script.hold(_UNDER_WAY, hands)
        yield from script.hold_as(
            "mixed", sides, 0.35, _locked_motors(script, hands, splits), targets=poses
        )
        script.goal.update(poses)


def _locked_motors(
    script: FingerScript, hands: Mapping[Side, Motors], joints: Mapping[Side, frozenset[int]]
) -> dict[Side, Motors]:
    """The commands with status 0 for some joints."""
    return {
        s: [
            replace(m, mode=script.codec.mode(i, JointMode.BRAKE)) if i in joints[s] else m
            for i, m in enumerate(motors)
        ]
        for s, motors in hands.items()
    }


@stimulus("off", RobotScript, after="limp", leaves=Place.AWAY)
def switch_off_robot_joint(script: RobotScript) -> Steps:
    """Mode 0, and a command that asks to move."""
    yield from script.refused("off", mode=0)


@stimulus("lock", UsbScript, after="move")
def lock_usb_joints(script: UsbScript) -> UsbSteps:
    """Position commands with status 0: nothing may move."""
    motors = [replace(m, status=0) for m in script.goals_inward(script.hold_commands())]
    yield from script.send_for(0.05, script.frame(Motor(protect=True)))
    phase = script.begin("lock", status=0)
    yield from script.send_for(0.2, script.frame(motors))
    script.end(phase)


@check("DEX3-MODE-01", rests_on=("mode",))
def reported(ctx: Context) -> Outcome:
    """The id and the status in the mode bytes of states."""
    return all_of(_ids(ctx), _reported_status(ctx))


def _ids(ctx: Context) -> Outcome:
    """Bits 0 to 3 of each motor's mode byte."""
    states, due = ctx.states.mode, np.arange(len(ctx.joints))
    if len(states) and (states == states[0]).all() and (states[0].astype(int) & 15 == due).all():
        return ctx.passed("0 .. 6", f"{len(states)} states")  # all alike, as they mostly are
    mode = mode_bytes(ctx)
    found = mode & 15
    wrong = (found != due).any(axis=1)
    if not wrong.any():
        return ctx.passed("0 .. 6", f"{len(mode)} states")
    row = found[int(np.argmax(wrong))]
    joint = int(np.argmax(row != due))
    cause = ""
    if not mode.any():
        cause = "mode is left 0."
    elif not found.any():
        cause = "mode holds the status without the id."
    elif sorted(row) == list(range(len(ctx.joints))):
        cause = "The motors are in another order than the message has."
    return (
        ctx.failed(
            f"id {row[joint]}",
            ctx.named(f"motor {joint} has id {row[joint]}, in {int(wrong.sum())} states", joint),
            ctx.at(ctx.states.topic, float(ctx.states.t[int(np.argmax(wrong))])),
        )
        .about(joint)
        .because(cause)
    )


def _reported_status(ctx: Context) -> Outcome:
    """Bits 4 to 6, or the mode, while driven and while locked."""
    phases = ctx.phases("lock")
    for phase in phases:
        begin, end = ctx.span(phase)
        for a, b, wanted, when in (
            (begin - 0.1, begin - 0.01, JointMode.FOC, "driven"),
            (end - 0.2, end - 0.01, JointMode.BRAKE, "locked"),
        ):
            mode = mode_bytes(ctx, ctx.states.between(a, b))
            if not len(mode):
                return ctx.skipped(f"no state while {when}")
            found = np.median(MotorCodec(ctx.recording.dialect).status(mode), axis=0)
            if (found != wanted).any():
                joint = int(np.argmax(found != wanted))
                return ctx.failed(
                    f"status {found[joint]:g}",
                    ctx.named(f"status {found[joint]:g} while {when}", joint),
                    ctx.at(ctx.states.topic, a, b),
                ).about(joint)
    if not phases:
        return ctx.skipped("no motor was locked")
    return ctx.passed("1, then 0", "1 while driven, 0 while locked")


@check("DEX5-MODE-01", rests_on=("mode",))
def plain_mode(ctx: Context) -> Outcome:
    """Whether anything moves with mode 1."""
    obeyed, asked = 0, 0
    strokes = np.array([j.stroke for j in ctx.joints])
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        far = [abs(s.size) / s.stroke for s in steps_of(ctx, phase)]
        q = ctx.q(begin - 0.1, end)
        q = q[np.isfinite(q).all(axis=1)]
        if len(q) and far and max(far) >= 0.05:
            asked += 1
            # which joint moves is judged by DEX5-JOINT-01
            moved = float((np.ptp(q, axis=0) / strokes).max())
            obeyed += moved >= ctx.tolerance("min_progress") * max(far)
    if not asked:
        return ctx.failed("no step", "there is no state while the joints were moved")
    text = f"the hand moves in {obeyed} of {asked} steps with mode 1"
    if obeyed:
        return ctx.passed(f"{obeyed} of {asked}", text)
    places = [ctx.at(ctx.states.topic, *ctx.span(phase)) for phase in ctx.phases()[:1]]
    return ctx.failed("nothing moves", text, *places)


@check("DEX3-MODE-03")
def locked(ctx: Context) -> Outcome:
    """Motion towards q while the motors are locked; and whether they stop under way, or say that
    they are locked.
    """
    how = "with status 0, which locks the motor"
    driven = not_driven(ctx.only("lock"), how, "max_towards_stroke")
    ris = ctx.recording.dialect.mode_byte is ModeByte.RIS
    return all_of(driven, _stops(ctx) if ris else _reported_status(ctx))


@check("DEX3-MODE-04")
def wrong_id(ctx: Context) -> Outcome:
    """A command whose mode byte has another motor's id: that motor must not move."""
    first, other = roles_of(ctx).crossed
    names = [ctx.joints[i].name for i in (first, other)]
    quiet = [j for j in range(len(ctx.joints)) if j != first]
    outcome = stays(ctx, f"a command to {names[0]} with the id of {names[1]} ({other})", quiet)
    return outcome.about(*outcome.joints, first)


_BEFORE_S = 0.1  # s before a phase or at its end in which a pose or a pressure is taken


_STATUS = 7  # mask of a mode byte's status, from bit 4 on


def _mode_at(ctx: Context, begin: float, end: float) -> NDArray[np.intp] | None:
    """The mode bytes of the last command in [begin, end]."""
    mode = ctx.commands.mode[ctx.given(begin, end)]
    mode = mode[np.isfinite(mode).all(axis=1)]
    return mode[-1].astype(np.intp) if len(mode) else None


def _status(ctx: Context, mode: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The status in each joint's mode byte, and whether time-out protection is on."""
    if ctx.recording.dialect.mode_byte is ModeByte.RIS:
        return mode >> 4 & _STATUS, np.asarray(mode >> 7 & 1, dtype=np.bool_)
    return mode, np.zeros(len(mode), dtype=np.bool_)


_GOING = 0.8  # of a phase's time; a step may begin with it


_CIRCUMSTANCES = {
    "mixed": "while other joints were locked",
    "guard-latch": "while other joints had tripped",
    "guarded-step": "with time-out protection (bit 7) while commands came",
}
"""Phases in which some joints are driven in special circumstances."""


@check("DEX3-MODE-05")
@worst("part", "min_progress", nothing="no state while some joints were driven and others were not")
def own_mode(ctx: Context) -> Figures:
    """Progress of driven joints while others are locked, have tripped or are protected.

    Protection that has not tripped changes nothing: in those steps all joints count.
    """
    for phase in (*ctx.phases(), *ctx.phases("guard-latch"), *ctx.phases("guarded-step")):
        begin, end = ctx.span(phase)
        mode = _mode_at(ctx, begin, end)
        if mode is None:
            continue
        status, tripped = _status(ctx, mode)
        if phase.name == "guarded-step":
            tripped = np.zeros_like(tripped)
        target = ctx.commands.q[ctx.given(begin, end)][-1]
        # a step may have begun before some of its joints were locked
        before, after = ctx.q(begin - 0.25, begin - 0.15), ctx.q(end - _BEFORE_S, end)
        if not len(before) or not len(after):
            continue
        start, final = np.median(before, axis=0), np.median(after, axis=0)
        for joint in np.flatnonzero((status == JointMode.FOC) & ~tripped).tolist():
            size = float(target[joint] - start[joint])
            least = ctx.tolerance("min_step_stroke", joint)
            if abs(size) < least:
                continue
            # a slow joint moves as far as its speed allows, less the time to start
            speed = own_speed(ctx, joint, ctx.requirement.tolerance("min_step_stroke"))
            if speed is not None:
                reach = _GOING * max(speed, ctx.tolerance("min_speed_rad_s")) * (end - begin)
                size = math.copysign(min(abs(size), max(reach, least)), size)
            part = float(final[joint] - start[joint]) / size
            text = (
                f"made {part:.0%} of a step of {size:.2f} {ctx.unit} " + _CIRCUMSTANCES[phase.name]
            )
            yield Figure(part, begin, end, joint, text)


@worst("motion_rad", "max_run_stroke", nothing="no state while joints were locked under way")
def _stops(ctx: Context) -> Figures:
    """Run-out of a joint that is locked while it moves, and whether it then stands still.

    It may take as long to obey the lock as it took to begin the step.
    """
    # of the first one: it begins at rest
    delay = max((_delay(ctx, *ctx.span(p)) for p in ctx.phases("mixed")[:1]), default=0.0)
    for phase in ctx.phases("mixed"):
        begin, end = ctx.span(phase)
        mode = _mode_at(ctx, begin, end)
        rows = ctx.states.between(begin, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if mode is None or len(t) < 5:
            continue
        late = q[t >= begin + ctx.tolerance("settle_s") + delay]
        for joint in np.flatnonzero(mode >> 4 & _STATUS == JointMode.BRAKE).tolist():
            speed = _top_speed(t, q[:, joint])
            runs = float(np.abs(q[:, joint] - q[0, joint]).max()) - speed * delay
            still = float(np.ptp(late[:, joint])) if len(late) else 0.0
            for far, name, what in (
                (max(runs, 0.0), "max_run_stroke", "ran on by"),
                (still, "max_motion_stroke", "still moved by"),
            ):
                limit = ctx.tolerance(name, joint)
                text = f"{what} {far:.3f} {ctx.unit} after it was locked"
                # a late lock extends the run-out
                by = (far - limit) / speed if speed else None
                yield Figure(far, begin, None, joint, text, limit=limit, late=by)


_SPEED_S = 0.02  # s over which a speed is taken


def _top_speed(t: Floats, q: Floats) -> float:
    """The largest speed of a joint, rad/s."""
    later = np.searchsorted(t, t + _SPEED_S)
    ahead = later < len(t)
    if not ahead.any():
        return 0.0
    rows = np.flatnonzero(ahead)
    then = later[ahead]
    return float((np.abs(q[then] - q[rows]) / (t[then] - t[rows])).max())


def _delay(ctx: Context, begin: float, end: float) -> float:
    """Seconds from the command of the step that led into [begin, end] until a joint moves."""
    commands = ctx.commands
    rows = np.flatnonzero((commands.t > begin - 0.3) & (commands.t <= end))
    if not len(rows):
        return 0.0
    same = rows[(commands.q[rows] == commands.q[rows[-1]]).all(axis=1)]
    given = float(commands.t[same[0]])
    before = ctx.q(given - 0.05, given)
    after = ctx.states.between(given, end)
    if not len(before):
        return 0.0
    strokes = np.array([j.stroke for j in ctx.joints])
    away = np.abs(ctx.states.q[after] - np.median(before, axis=0)) / strokes
    moves = (away > _MOVES).any(axis=1)
    return float(ctx.states.t[after][np.argmax(moves)]) - given if moves.any() else 0.0


_MOVES = 0.01  # of the stroke


@check("G1-MACH-01")
def reported_machine(ctx: RobotContext) -> Outcome:
    """The values of mode_machine."""
    kinds = np.unique(ctx.low["mode_machine"][ctx.low.ok])
    reported = ", ".join(f"{k:.0f}" for k in kinds)
    if len(kinds) == 1 and kinds[0] > 0:
        return ctx.passed(reported)
    return ctx.failed(reported, f"mode_machine is {reported}")


@check("H1-MODE-01", rests_on=("mode",))
def reported_mode(ctx: RobotContext) -> Outcome:
    """Mode bytes of held motors, and of a motor that was turned off."""
    robot = ctx.recording.robot
    for phase in (*ctx.phases("hold"), *ctx.phases()):
        begin, end = ctx.span(phase)
        modes = ctx.states.mode[ctx.states.between(begin + (end - begin) / 2, end)]
        if not len(modes):
            return ctx.skipped(f"no state during '{phase.name}'")
        wanted = np.array([robot.enable[slot] for slot in robot.used])
        if phase.name == "off":
            wanted[joint_of(ctx, phase)] = 0
        wrong = np.flatnonzero((modes != wanted).any(axis=0))
        if len(wrong):
            joint = int(wrong[0])
            name, reported = ctx.joints[joint].name, modes[-1, joint]
            return ctx.failed(
                f"{reported:.0f}",
                f"{name}: mode {reported:.0f} in the state, {wanted[joint]} in the command"
                + (f"; {len(wrong)} motors differ" if len(wrong) > 1 else ""),
                ctx.at(ctx.states.topic, begin, end),
            ).about(joint)
    return ctx.passed("reported")


# ---------------------------------------------------------------------------------------- USB


@check("DEX3USB-MODE-01")
def _usb_mode(c: UsbContext) -> Outcome:
    judged = 0
    for phase in c.hand.record.phases:
        answers = c.hand.answers_in(phase)
        if "status" not in phase.params or not answers:
            continue
        judged += 1
        wanted = phase.params["status"]
        last = answers[-1]
        odd = {f"{m.bus}.{m.id}": m.status for m in last.reading.motors if m.status != wanted}
        if odd:
            figure = ", ".join(f"motor {who} reports {status}" for who, status in odd.items())
            observed = f"commanded status {wanted}, {figure}"
            return c.failed(f"not {wanted}", observed, c.at(last.t))
    return c.passed("0 and 1") if judged else c.skipped("no answer to judge by")


@check("DEX3USB-MODE-02")
def _usb_lock(c: UsbContext) -> Outcome:
    return quiet_motors(c, c.phases(), lambda phase: "although it was to lock")
