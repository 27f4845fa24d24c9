"""A commanded joint moves, arrives and settles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.checks import STROKE_S, Context, Outcome, causes, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.goals import OWN_RULE, Goals, goals_of
from dexkit.conformance.checks.robot import RobotContext, joint_of, no_state
from dexkit.conformance.checks.stands import no_torque
from dexkit.conformance.checks.steps import (
    DISOBEYS,
    Step,
    rest_error,
    rests_before,
    speed_of,
    steps,
    steps_of,
)
from dexkit.conformance.kit.sums import mean
from dexkit.conformance.stimuli.fingers import CLOSED, FEW_MOTORS, OPEN, FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import ASIDE, HandScript
from dexkit.conformance.stimuli.phases import Moment, Place, stimulus
from dexkit.conformance.stimuli.robot import STEP, RobotScript
from dexkit.conformance.stimuli.script import Pose, Steps, of_position_servos
from dexkit.conformance.stimuli.usb import UsbScript, UsbSteps
from dexkit.conformance.usb.context import UsbContext, moves, named_joints, part_of_way, travel_of
from dexkit.hand import Floats, Side


@stimulus("move", UsbScript, after="exchange")
def move_usb_joints(script: UsbScript) -> UsbSteps:
    """Each motor in turn to a new position, by 0.2 rad; the others hold."""
    script.report("moving one joint at a time by 0.2 rad")
    hold = script.hold_commands()
    yield from script.send_for(0.05, script.frame(hold))
    for joint in range(len(script.joints)):
        target = script.goal_inward(joint)
        phase = script.begin("move", joint=joint, begin=script.q[joint], target=target, status=1)
        hold[joint] = replace(hold[joint], q=target)
        yield from script.send_for(0.2, script.frame(hold))
        script.end(phase)


_CLOSES, _OPENS = 0.09, 6.02
"""rad, just within the zones that mean fully closed and open in the gripper's DDS interface
specification: their limits, 0.1 and 6.0, are no exact numbers in a message."""
_VENDORS_MODE = 1
"""Mode byte of the vendor's test programs; teleoperation sends 0
(docs/sources/unitree-dex.md#b1)."""
_SINGLES, _SINGLE_SECONDS = 5, 0.25
"""Commands that are sent once, and how long none follows, s: less than any time-out."""
_LATE_SINGLE_SECONDS = 0.6
"""The same for hands with a control of their own: those of a real G1 answer 0.37 s late."""


@stimulus("step", GripperScript, leaves=Place.AWAY)
def step_each_gripper(script: GripperScript) -> Steps:
    """Large steps of one side, the others hold."""
    for side in script.plan.sides:
        yield from _step_gripper(script, side)


def _step_gripper(script: GripperScript, side: Side) -> Steps:
    script.report(f"large steps of the {side} hand; the other one must not move")
    places = (script.high(), _VENDORS_MODE), (script.low(side), 0)
    for target, script.mode in places:
        script.goal[side] = (target,)
        phase = script.begin("step", (side,), targets={side: {0: target}})
        yield from script.until_settled(phase, (side,), least=0.6, most=2.5)


@stimulus(
    "ends", GripperScript, after="step", before="fingerprint", needs=Place.ANY, leaves=Place.AWAY
)
def move_gripper_to_ends(script: GripperScript) -> Steps:
    """Fully open, and fully closed where there is no object."""
    script.report("fully open and fully closed")
    sides = script.plan.sides
    yield from script.everyone("ends", dict.fromkeys(sides, (script.stroke,)), most=1.5)
    free = script.plan.free
    if free:
        script.goal.update(dict.fromkeys(free, (0.0,)))
        phase = script.begin("ends", free, targets={s: {0: 0.0} for s in free})
        yield from script.until_settled(phase, free, least=0.5, most=2.8)


@stimulus(
    "dead-zone",
    GripperScript,
    after="ends",
    leaves=Place.AWAY,
    applies=lambda plan: plan.dialect.interface_specification,
)
def move_gripper_to_dead_zones(script: GripperScript) -> Steps:
    """The inner limits of the zones that mean fully open and fully closed."""
    script.report("the zones that mean fully open and fully closed")
    sides = script.plan.sides
    free = script.plan.free
    for q, end, chosen in ((_OPENS, script.stroke, sides), (_CLOSES, 0.0, free)):
        if chosen:
            script.goal.update(dict.fromkeys(chosen, (q,)))
            phase = script.begin("dead-zone", chosen, targets={s: {0: end} for s in chosen})
            yield from script.until_settled(phase, chosen, least=0.6, most=2.8)


@stimulus("joint", FingerScript)
def move_one_by_one(script: FingerScript) -> Steps:
    """One joint after the other closes; then every second one opens, and the others.

    Where there are many, all of them open together. Joints that share a motor are one.
    """
    script.report("one joint after the other: no other joint may move")
    sides = script.plan.sides
    motors = script.model.motors
    turns = [(joints, CLOSED) for joints in motors]
    few = len(motors) <= FEW_MOTORS
    if few:  # no two neighbours together: those are the ones that get mixed up
        turns += [(sum(motors[i::2], ()), OPEN) for i in (0, 1)]
    for joints, percent in turns:
        targets = {s: {joint: script.pose(s, percent)[joint] for joint in joints} for s in sides}
        for s, moved in targets.items():
            script.goal[s] = tuple(moved.get(i, q) for i, q in enumerate(script.goal[s]))
        phase = script.begin("joint", sides, targets=targets)
        yield from script.until_settled(phase, sides, least=0.5, most=1.5)
    if not few:
        yield from script.turn("center", {s: script.pose(s, OPEN) for s in sides}, least=0.5)


@stimulus("step", FingerScript, after="joint")
def step_each_hand(script: FingerScript) -> Steps:
    """One hand closes, the other holds; one opens while the other closes; that one opens."""
    script.report("each hand alone; the other one must not move")
    away = {s: script.pose(s, CLOSED - 5.0) for s in script.plan.sides}
    yield from script.in_turn("step", away=away, stand=script.settling)


@stimulus("ends", FingerScript, after="single speeds", leaves=Place.AWAY)
@stimulus(
    "ends",
    FingerScript,
    moment=Moment.STARTED,
    after="squeeze",
    needs=Place.ANY,
    leaves=Place.AWAY,
    applies=of_position_servos,
)
def move_fingers_to_ends(script: FingerScript) -> Steps:
    """One finger after the other to both ends of its range, with the thumb out of the way.

    Position servos again after a restart: one that calibrates itself may come back with other ends.
    Runs of hands with gains have no time for it.
    """
    script.report("to both ends of each joint's range, fingers and thumb in turn")
    sides = script.plan.sides
    for thumb in (False, True):
        poses = {s: _end_pose(script, s, thumb=thumb) for s in sides}
        script.goal.update(poses)
        phase = script.begin("ends", sides, targets=poses)
        free = [s for s in sides if script.reachable(s)]
        # an object holds some joints back until the end
        yield from script.until_settled(
            phase, free, least=script.least if free else 1.0, most=1.5, stand=script.standing
        )


def _end_pose(script: FingerScript, side: Side, *, thumb: bool) -> Pose:
    """The thumb closed and the fingers open, or the other way round, to the ends."""
    pose = []
    for j in script.joints[side]:
        closes = j.name.startswith("thumb") is thumb
        towards = (1 if closes else -1) * (j.closing or 1)
        pose.append(j.q_max if towards > 0 else j.q_min)
    return tuple(pose)


@stimulus("single", HandScript, after="replay")
def send_once(script: HandScript) -> Steps:
    """Commands that are not repeated: every one counts, and the newest most of all."""
    script.report("commands that are sent once: each must be obeyed")
    if script.goal != {s: script.home(s) for s in script.plan.sides}:
        yield from script.everyone("center", {s: script.home(s) for s in script.plan.sides})
    home = dict(script.goal)
    away = {s: script.aside(s, 0.4 * ASIDE) for s in home}
    decoy = {s: script.aside(s, -0.2 * ASIDE) for s in home}
    encode = script.codec.encode
    seconds = _SINGLE_SECONDS if script.plan.dialect.gains_are_used else _LATE_SINGLE_SECONDS
    for i in range(_SINGLES):
        goal = home if i % 2 else away
        if i % 3 == 2:  # a newer command replaces one that has just arrived
            yield from script.send(encode({s: script.motors(s, q) for s, q in decoy.items()}))
        script.goal.update(goal)
        phase = script.begin("single", script.plan.sides, targets=goal)
        yield from script.command()
        yield from script.through(phase, seconds, lambda: script.wait(0.01))


@stimulus("joint", RobotScript, leaves=Place.AWAY)
def move_robot_joints(script: RobotScript) -> Steps:
    """Each joint in turn by a fifth of a radian; its slot is ``params["slot"]``."""
    script.report("moving one joint at a time by 0.2 rad")
    for slot in script.robot.used:
        yield from script.step("joint", slot)


@check("DEX1-MOVE-02", "DEX3-MOVE-02")
def arrives(ctx: Context) -> Outcome:
    """Progress towards the target of each step; where it is made, the distance at its end."""
    progress = _direction(ctx)
    if progress.met is False:
        return progress
    found = steps(ctx)
    figures = [s.error_figure(str(s)) for s in found]
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=progress)
    return outcome.because(_cause(found))


def _direction(ctx: Context) -> Outcome:
    """Progress towards the target, as a part of the step."""
    found = [s for s in steps(ctx) if abs(s.size) >= 0.1 * s.stroke]
    figures = [
        s.figure(
            s.progress,
            f"{s}: {_how_it_missed(s)}",
            met=f"{len(found)} steps, all in the right direction",
            late=math.inf if s.progress <= -0.05 else None,  # no delay turns a hand round
        )
        for s in found
    ]
    nothing = ctx.failed(
        "no step",
        "no step could be made: there is no state during the steps, or q already was at every "
        "target",
    )
    outcome = judged(ctx, figures, "progress", "min_progress", nothing=nothing)
    return outcome.because(_cause(found)) if found else outcome


def _how_it_missed(step: Step) -> str:
    if float(np.ptp(step.q)) < 0.02 * step.stroke:
        return "it did not move"
    return "it did not reach its target" if step.progress > -0.05 else "that is the wrong direction"


def _cause(found: Sequence[Step]) -> str:
    """The likely cause of steps that miss their targets, or an empty text."""
    still = all(float(np.ptp(s.q)) < 0.02 * s.stroke for s in found)
    scale = ""
    if len({s.joint for s in found}) == 1:
        ends = np.array([(s.target, s.final) for s in found])
        scale = causes.of_scale(ends[:, 0], ends[:, 1], found[0].stroke)
    if still and not scale:
        return (
            "Nothing moves at all: commands do not reach the motors, or these are not driven; or "
            "commands are taken in another unit, in which all of them mean the same end."
        )
    return scale


@check("DEX1-MOVE-03", "DEX3-MOVE-03")
@worst("ripple_rad", "max_ripple_stroke", nothing="too few states at the end of the steps")
def settles(ctx: Context) -> Figures:
    """Ripple of q at the end of each step."""
    for step in steps(ctx):
        begin = step.end - ctx.tolerance("window_s")
        tail = step.q[step.t >= begin]
        if len(tail) >= 5:
            ripple = float(np.ptp(tail))
            text = f"at the target {step.target:.2f} {ctx.unit} q still moves by {ripple:.3f} "
            text += f"{ctx.unit}, peak to peak"
            yield Figure(ripple, begin, step.end, step.joint, text)


@check("DEX1-MOVE-04", "DEX3-MOVE-04")
@worst("speed_rad_s", "min_speed_rad_s", nothing="no step of that size was finished")
def speed(ctx: Context) -> Figures:
    """Speed from 10 to 90 % of each large step."""
    for step in steps(ctx):
        shown = speed_of(step)
        if shown is not None and abs(step.size) >= ctx.tolerance("min_step_stroke", step.joint):
            way = 0.8 * abs(step.size)
            late = way / shown - way / ctx.tolerance("min_speed_rad_s")
            yield step.figure(
                shown, f"{shown:.2f} {ctx.unit}/s in the slowest large step", late=late
            )


@check("DEX1-MOVE-09", "DEX3-MOVE-08")
@worst("reaction_s", "max_reaction_s", nothing="no step of that size was finished")
def begins(ctx: Context) -> Figures:
    """Time from the command until the hand moves, for every step that arrives."""
    first = [p for name in _AFTER_A_PAUSE for p in ctx.phases(name)[:1]]
    for phase in (p for name in _PROMPT for p in ctx.phases(name)):
        limit = ctx.tolerance("max_first_s" if phase in first else "max_reaction_s")
        for step in steps_of(ctx, phase):
            way = (step.q - step.start) * np.sign(step.size) >= _BEGUN * step.stroke
            if (
                not rests_before(ctx, step)
                or abs(step.size) < ctx.tolerance("min_step_stroke", step.joint)
                or step.error > DISOBEYS * step.stroke
                or not way.any()
            ):
                continue  # other requirements judge whether it arrives
            after = float(step.t[np.argmax(way)]) - step.begin
            text = f"{step}, but it began to move only after {after:.2f} s"
            met = f"after {after:.2f} s in the step to {step.target:.2f} {ctx.unit}"
            end = step.begin + after
            yield Figure(after, step.begin, end, step.joint, text, met, limit)


_BEGUN = 0.02
"""Part of the stroke after which a hand counts as moving; a slow one takes 0.1 s for it."""


_AFTER_A_PAUSE = ("restart", "service-restart")
"""Steps of which the first follows directly after discovery."""


_PROMPT = (
    *("step", "joint", "ends", "center", "fingerprint", "recover", "old-stamps"),
    *("company", *_AFTER_A_PAUSE),
)
"""Steps that must begin at once; WDOG-03 judges those after a pause, SIDE-02 those during bad
commands to the other hand."""


@worst("part", "max_part", nothing="no command in a dead zone, or none to its end")
def _dead_zones(ctx: Context) -> Figures:
    """Size of a dead zone between the gripper's reached position and its end."""
    reached = {s.target: s.final for p in ctx.phases("ends") for s in steps_of(ctx, p)}
    for step in (s for p in ctx.phases("dead-zone") for s in steps_of(ctx, p)):
        asked = ctx.commands.q[ctx.given(step.begin, step.end), step.joint]
        if not len(asked) or step.target not in reached:
            continue
        zone = abs(float(asked[-1]) - step.target)
        part = abs(step.final - reached[step.target]) / zone if zone > 0 else 0.0
        yield step.figure(
            part,
            f"commanded to {asked[-1]:g} rad, q ends at {step.final:.3f} rad: {part:.0%} of the "
            "zone short",
        )


@check("DEX1-MOVE-08")
def ends(ctx: Context) -> Outcome:
    """Distance from fully open and fully closed, and size of the zones that mean the same."""
    return all_of(_at_ends(ctx), warning(_dead_zones(ctx)))


def _at_ends(ctx: Context) -> Outcome:
    """Distance from fully open and fully closed."""
    found = steps(ctx.only("ends"))
    text = "; ".join(
        f"commanded to {s.target:.2f} {ctx.unit}, q went to {s.final:.2f}" for s in found
    )
    nothing = ctx.failed("no state", f"no state of the {ctx.side} hand at its ends")
    figures = [s.error_figure(text) for s in found]
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)
    if not found:
        return outcome
    reached = max(s.final for s in found) / max(s.target for s in found)
    if abs(reached - 5.4 / (2 * np.pi)) < 0.02 or abs(reached - 2 * np.pi / 5.4) < 0.02:
        return outcome.because(
            "the stroke of another dialect is used: 5.4 rad in unitree_go, 2 pi in unitree_hg"
        )
    return outcome


@check("DEX1-CMD-01", "DEX3-CMD-01")
def every_command(ctx: Context) -> Outcome:
    """Progress of the hand towards a goal that was commanded once."""
    judged, missed = 0, []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, after = ctx.q(begin - 0.03, begin), ctx.q(end - 0.03, end)
        if not len(before) or not len(after):
            continue
        start, final = np.median(before, axis=0), np.median(after, axis=0)
        judged += 1
        for joint, target in phase.targets.get(ctx.side, {}).items():
            size = target - float(start[joint])
            # friction takes as much of this step as of others
            way = abs(size) - rest_error(ctx, joint)
            if way < ctx.tolerance("min_step_stroke", joint):
                continue
            progress = (float(final[joint]) - float(start[joint])) * math.copysign(1.0, size) / way
            if progress < ctx.tolerance("min_progress"):
                missed.append((begin, end, joint, target, progress))
                break
    if not judged:
        return ctx.skipped("no state while single commands were sent")
    if not missed:
        return ctx.passed(f"{judged} of {judged}", f"{judged} single commands, all obeyed")
    begin, end, joint, target, progress = missed[0]
    outcome = ctx.failed(
        f"{judged - len(missed)} of {judged}",
        ctx.named(
            f"{len(missed)} of {judged} commands that were sent once were not obeyed; the first, "
            f"to {target:.2f} {ctx.unit}, made {max(progress, 0.0):.0%} of its way in "
            f"{end - begin:.2f} s",
            joint,
        ),
        *(ctx.at(ctx.states.topic, a, b) for a, b, *_ in missed),
        missed=len(missed),
    )
    # a network may lose a single sample: repeat the run
    return replace(outcome.about(joint).if_late(end - begin), retry=True)


@check("DEX3-JOINT-01")
def order(ctx: Context) -> Outcome:
    """Which joint moves when one joint is commanded."""
    found = 0
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        commanded = phase.targets.get(ctx.side, {})
        for step in steps_of(ctx, phase):
            rows = ctx.states.between(begin, end)
            before = ctx.q(begin - 0.1, begin)
            if not len(before) or abs(step.size) < 0.05 * step.stroke:
                continue
            moved = np.abs(ctx.states.q[rows] - np.median(before, axis=0)).max(axis=0)
            strokes = np.array([j.stroke for j in ctx.joints])
            others = [j for j in range(len(ctx.joints)) if j not in commanded]
            limit = ctx.tolerance("max_others_stroke", 0) / ctx.joints[0].stroke
            wrong = [j for j in others if not moved[j] <= limit * strokes[j]]
            own = float(moved[step.joint])
            name = ctx.joints[step.joint].name
            way = abs(step.size) - min(
                step.error, DISOBEYS * step.stroke
            )  # friction takes the rest
            if own < ctx.tolerance("min_progress") * way or wrong:
                seen = ", ".join(
                    f"{ctx.joints[j].name} moved {moved[j]:.2f} {ctx.unit}" for j in wrong
                )
                outcome = ctx.failed(
                    ctx.joints[wrong[0]].name if wrong else "no motion",
                    f"{name} was commanded to go {abs(step.size):.2f} {ctx.unit} and moved "
                    f"{own:.2f} {ctx.unit}; " + (seen or "no joint moved"),
                    ctx.at(ctx.states.topic, begin, end),
                ).about(step.joint, *wrong)
                cause = _order_cause(ctx, step.joint, wrong, own < 0.1 * abs(step.size))
                return outcome.because(cause)
            found += 1
    if not found:
        return ctx.failed("no step", "there is no state while the joints were moved")
    return ctx.passed(f"{found} of {found}", f"{found} steps, each of the commanded joint")


def _order_cause(ctx: Context, joint: int, wrong: Sequence[int], still: bool) -> str:
    """Explain motion of another joint than the commanded one; empty if no cause is known."""
    name = ctx.joints[joint].name
    if still and not wrong:
        return f"{name} is not driven: its commands are lost, it is locked, or it has no power."
    if still and len(wrong) == 1:
        other = ctx.joints[wrong[0]].name
        if {name.partition("_")[0], other.partition("_")[0]} == {"middle", "index"}:
            return f"{name} and {other} are swapped, as xr_teleoperate's enum has the right hand."
        return f"{name} and {other} are swapped."
    if wrong and not still:
        return "The joints are coupled, or a command for one is applied to others as well."
    return ""


_BEFORE_S = 0.1  # s before a phase or at its end in which a pose or a pressure is taken


@check("DEX3-MOVE-09")
def whole_range(ctx: Context) -> Outcome:
    """Distance of each joint from both ends of its range, unless the object holds it back."""
    found = steps(ctx)
    if not found:
        return ctx.failed("no state", f"no state of the {ctx.side} hand at its ends")
    figures = [
        s.error_figure(str(s))
        for s in found
        if not _held(ctx, s) and not s.arrives_within(s.end - s.begin)
    ]
    nothing = "the object held every joint back, or all were still on their way"
    return judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)


def _held(ctx: Context, step: Step) -> bool:
    """Whether a joint presses on the hand's object with the commanded force, or may do so: where
    no force is measured.
    """
    spec = ctx.joints[step.joint]
    if ctx.object_at is None or (step.target - step.start) * spec.closing <= 0:
        return False
    if no_torque(ctx) is not None:
        return True
    tau = ctx.tau(step.end - _BEFORE_S, step.end)[:, step.joint]
    given = ctx.commands.kp[ctx.given(step.begin, step.end)]
    given = given[np.isfinite(given).all(axis=1)]
    if not len(tau) or not len(given):
        return False
    asked = min(float(np.median(given[:, step.joint])) * step.error, spec.tau_max)
    return abs(float(np.median(tau))) >= ctx.tolerance("min_part") * asked


_STOPPED = ("silence", "rejected")
"""The ones at whose end a hand has stopped; its next motion starts there."""


_GRID = 0.01  # s, of the cells in which extremes of q and of goals are compared


@check("DEX1-PATH-01", "DEX3-PATH-01")
@worst("beyond_rad", "max_beyond_stroke", nothing="too few states while positions were commanded")
def path(ctx: Context) -> Figures:
    """Excess of q over the range between earlier position and commanded goals.

    At each time q must lie between the position ``before_s`` earlier and the goals in force since
    then or up to ``max_delay_s`` before.
    """
    for joint in range(len(ctx.joints)):
        found = _beyond(ctx, joint)
        if found is not None:
            rad, at = found
            text = (
                f"at {at:.2f} s it was {rad:.3f} {ctx.unit} outside of where it had been "
                f"{ctx.tolerance('before_s'):g} s before and where it was commanded to go"
            )
            yield Figure(rad, at, None, joint, text)


def _beyond(ctx: Context, joint: int) -> tuple[float, float] | None:
    """Excess of q over the hull of its earlier position and its goals, rad, and the time."""
    good = np.isfinite(ctx.states.q[:, joint])
    t, q = ctx.states.t[good], ctx.states.q[good, joint]
    goals = goals_of(ctx, joint, timeout=ctx.recording.model.command_timeout)
    before = round(ctx.tolerance("before_s") / _GRID)
    late = before + round(ctx.tolerance("max_delay_s") / _GRID)
    if len(t) < 2 or not len(goals.t):
        return None
    origin = min(float(t[0]), float(goals.t[0]))
    cells = int((float(t[-1]) - origin) / _GRID) + 1
    at = ((t - origin) / _GRID).astype(np.intp)
    here = np.full(cells, np.nan)
    here[at] = q  # the newest of each cell
    # where there are no states, as while the service restarts, it was where it appears again
    seen = np.isfinite(here)
    known = np.flatnonzero(seen)
    here = here[known[np.minimum(np.searchsorted(known, np.arange(cells)), len(known) - 1)]]
    low, high = _in_force(goals, origin, cells)
    if cells <= late:
        return None
    low = sliding_window_view(low, late + 1).min(axis=1)
    high = sliding_window_view(high, late + 1).max(axis=1)
    now, then = here[late:], here[late - before : cells - before]
    away = np.maximum(np.minimum(low, then) - now, now - np.maximum(high, then))
    away[~seen[late:]] = np.nan
    for name in OWN_RULE:
        # what it was moved by there, it may still come back from; a hand that brakes has stopped
        more = 0 if name in _STOPPED else before
        for begin, end in (ctx.span(p) for p in ctx.recording.phases(name, ctx.side)):
            i, j = (round((x - origin) / _GRID) - late for x in (begin, end))
            away[max(i, 0) : max(j + more, 0)] = np.nan
    if not np.isfinite(away).any():
        return None
    i = int(np.nanargmax(away))
    return max(0.0, float(away[i])), origin + (i + late) * _GRID


def _in_force(goals: Goals, origin: float, cells: int) -> tuple[Floats, Floats]:
    """The lowest and highest goal in each cell, including the one in force at its begin."""
    at: NDArray[np.intp] = ((goals.t - origin) / _GRID).astype(np.intp)
    known = at < cells
    begins = origin + _GRID * np.arange(cells)
    newest = np.searchsorted(goals.t, begins, "right") - 1
    # before the first command nothing may move: the hull is the hand's position
    low = np.where(newest >= 0, goals.low[np.maximum(newest, 0)], np.inf)
    high = np.where(newest >= 0, goals.high[np.maximum(newest, 0)], -np.inf)
    np.minimum.at(low, at[known], goals.low[known])
    np.maximum.at(high, at[known], goals.high[known])
    return low, high


_SOME = 20  # states before a phase or at its end that are averaged


@check("H1-MOVE-01", "H1-SAFE-04", "H1-LIFE-02")
@worst("error_rad", "max_error_rad", nothing="no step was made")
def robot_follows(ctx: RobotContext) -> Figures:
    """Final position of each step of a joint."""
    for phase in (p for p in ctx.phases() if p.targets):
        begin, end = ctx.span(phase)
        q = ctx.q(begin, end)[-_SOME:]
        if not len(q):
            yield no_state(ctx, phase)
            return
        ((joint, goal),) = phase.targets[ctx.side].items()
        error = abs(mean(q[:, joint]) - goal)
        error = error if math.isfinite(error) else math.inf
        text, late = f"ends {error:.3f} rad from its target", STROKE_S * error / STEP
        yield Figure(error, begin, end, joint, text, late=late)


@check("H1-MOVE-02")
@worst("motion_rad", "max_motion_rad", nothing="no joint was moved")
def robot_independent(ctx: RobotContext) -> Figures:
    """Motion of other joints while one is commanded."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        q = ctx.q(begin, end)
        if not len(q):
            yield no_state(ctx, phase)
            return
        moved = np.nan_to_num(np.abs(q - q[0]).max(axis=0), nan=np.inf)
        mine = joint_of(ctx, phase)
        moved[mine] = 0.0
        joint = int(np.argmax(moved))
        text = f"moves by {moved[joint]:.3f} rad with {ctx.joints[mine].name}"
        yield Figure(float(moved[joint]), begin, end, joint, text)


# ---------------------------------------------------------------------------------------- USB


_USB_MOVE_S = 0.2
"""Seconds that each motor has to move (:func:`move_usb_joints`)."""


@check("DEX3USB-MOVE-01")
def _usb_follows(c: UsbContext) -> Outcome:
    parts: dict[int, float] = {}
    wrong = []
    late = []
    least = c.tolerance("min_part")
    for phase, joint, begin, target in moves(c):
        part = parts[joint] = part_of_way(c.hand, phase, joint, begin, target)
        # overshooting by the same distance is not following either
        if not least <= part <= 2 - least:
            wrong.append((joint, phase))
            # no delay sends a joint the wrong way or too far
            late.append((least - part) * _USB_MOVE_S if -0.1 < part < least else math.inf)
    figure = f"{min(parts.values()):.0%} .. {max(parts.values()):.0%}"
    if not wrong:
        return c.passed(figure, f"of the way in 0.2 s: {figure}")
    text = ", ".join(f"{named_joints(c, [joint])} {parts[joint]:.0%}" for joint, _ in wrong)
    outcome = c.failed(figure, f"part of the way: {text}", *(c.over(p) for _, p in wrong))
    return outcome.about(*(joint for joint, _ in wrong)).if_late(*late)


@check("DEX3USB-MOVE-02")
def _usb_others(c: UsbContext) -> Outcome:
    most = 0.0
    earlier: set[int] = set()
    for phase, joint, _, _ in moves(c):
        travel = travel_of(c.hand, phase)
        # the joint that moved before may still be moving
        travel[[joint, *earlier]] = 0.0
        earlier.add(joint)
        most = max(most, float(travel.max()))
        if travel.max() > c.tolerance("max_q"):
            other = int(travel.argmax())
            moved, commanded = (named_joints(c, [i]) for i in (other, joint))
            observed = f"{moved} moved by {travel.max():.2f} rad when {commanded} was commanded to"
            outcome = c.failed(f"{travel.max():.2f} rad", observed, c.over(phase))
            return outcome.about(other, joint)
    return c.passed(f"{most:.3f} rad", moved=most)


@check("DEX3USB-MOVE-03")
def _usb_limits(c: UsbContext) -> Outcome:
    margin = c.tolerance("margin")
    beyond = 0.0
    for answer in c.hand.answers:
        for i, (joint, q) in enumerate(zip(c.hand.joints, c.hand.q(answer), strict=True)):
            over = max(joint.q_min - q, q - joint.q_max)
            beyond = max(beyond, over)  # a comparison with NaN is false
            if over > margin:
                span = f"{joint.q_min:.2f} .. {joint.q_max:.2f}"
                return c.failed(
                    f"{q:.2f} rad", f"{joint.name} at {q:.2f} rad of {span}", c.at(answer.t)
                ).about(i)
    return c.passed(f"{beyond:.3f} rad beyond")
