"""How hard a hand presses on an object, and for how long.

A position-controlled gripper is a spring of stiffness kp. The displacement by a torque without
contact gives its stiffness; on an object it must press with the same stiffness.

A hand that obeys tau = kp (q - q_now) + kd (dq - dq_now) + tau does so in contact as well: a boost
at a stall crushes the object, and a limit that is lower in contact drops it. The force in contact
is compared with that law; a hand whose tau_est has another scale while it moves is judged by that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dexkit.conformance.behaviours.gains import NUDGE_SECONDS, nudged, push_held, step_softly
from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.contacts import contacts
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.checks.nudges import STIFFNESS, has_own_force, nudges
from dexkit.conformance.checks.soft_grips import soft_grips_of, softer_grips, usual_part
from dexkit.conformance.checks.stands import (
    _GRID_S,
    FEW_STANDS,
    no_stand,
    no_torque,
    stands,
    torque_member,
    torque_unit,
)
from dexkit.conformance.checks.steps import obeyed_before
from dexkit.conformance.checks.timing import longest_gap
from dexkit.conformance.checks.torque_law import (
    FEW_SHOWN,
    LAGS_S,
    torque_by_law,
    torque_factors,
    torque_scales,
)
from dexkit.conformance.kit.measurement_error import Measure, Quantity
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.row_selection import Rows
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import BEYOND, CLOSED, OPEN, FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import ASIDE_SECONDS
from dexkit.conformance.stimuli.phases import Moment, stimulus
from dexkit.conformance.stimuli.script import Plan, Steps, of_position_servos, without_gains
from dexkit.hand import Floats, Side

# of the stroke: how far xr_teleoperate commands ahead (docs/sources/unitree-dex.md#b3)
_LEAD = 0.18 / 5.4
_FIRST_GRIP = 1.5
"""Seconds of the first grip: until a driver has lowered its effort (DEX1-FORCE-10), and a little
more."""
_GRIP, _LONG_GRIP = 2.5, 30.0
"""Seconds of equal commands between two pushes; those of a thorough run."""
_SQUEEZE = 1.3
"""Seconds of a squeeze: contact takes 0.3 s on an idle machine, and twice that after a pause."""
_CAMERA_HZ = 30.0
"""Commands a second of a client that sends one for each picture of a camera."""
_SOFT_GRIPS = ((1.9, 0.3), (0.8, 0.6), (8.0, 0.2))
"""kp, N m/rad, and how far they are commanded into the object, rad: 0.5 to 1.6 N m each. The last
is beyond what a byte holds in steps of 1/32, and about the lead of xr_teleoperate."""
_SOFT_SECONDS = 0.4
_GRIP_SECONDS = 1.1
"""Seconds of a grip after a restart of position servos."""
_BEYOND, _BEYOND_TAU, _BEYOND_AFTER = 0.05, 0.7, 0.3
"""A grip by a q below the closed end: by which part of the stroke, its torque, N m, and how much
longer than a time-out it lasts, s: a command that is clamped is in force as any other."""
_RELEASE = 0.3
"""Seconds of zero gains at the q of a squeeze."""


@stimulus("grip stiffness", GripperScript, after="ends", before="dead-zone fingerprint")
def grip_first(script: GripperScript) -> Steps:
    """Grip and hold stiffness before any disturbance."""
    pressing, free = script.plan.pressing, script.plan.free
    if pressing:
        script.report("a first grip")
        script.grip = _by_the_lead(script, pressing)
        beyond = {s: {0: motors[0].q} for s, motors in script.grip.items()}
        phase = script.begin("grip", pressing, targets=beyond)
        yield from script.hold(0.3)
        yield from push_held(script, free)
        while script.elapsed(phase) < _FIRST_GRIP:
            yield from script.command()
        script.end(phase)
        script.grip = {}
        yield from script.turn(
            "center", {s: script.home(s) for s in pressing}, least=0.4, stand=script.standing
        )
    else:
        yield from push_held(script, free)


@stimulus(
    "grip nudge squeeze release soft-grip soft silence resume rejected",
    GripperScript,
    after="late-joiner",
)
def squeeze_gripper(script: GripperScript) -> Steps:
    """Close on the object: by xr_teleoperate's lead for long, then by half as much again.

    Meanwhile the other side is held, and pushed by a torque at first and at last. In the end zero
    gains at the q of the squeeze; the grip stays in force.
    """
    _sides, phases = script.plan.sides, script.plan.phases
    pressing, free = script.plan.pressing, script.plan.free
    if free:
        yield from script.everyone("center", {**script.goal, **script.nearly_closed()})
    if phases & {"grip", "nudge"}:
        yield from _hold_long(script, pressing, free)
    if pressing:
        if phases & {"grip", "nudge"}:  # each grip counts as the first one
            script.grip = {}
            opened = {s: (script.low(s),) for s in pressing}
            yield from script.turn("center", opened, least=0.4, stand=script.standing)
        script.report("squeezing the object")
        script.grip = dict(gripper_squeeze(script, pressing))
        beyond = {s: {0: motors[0].q} for s, motors in script.grip.items()}
        yield from script.hold_as("squeeze", pressing, _SQUEEZE, targets=beyond)
        if script.gains_used and "release" in phases:
            grip = dict(script.grip)
            script.grip = {s: (replace(m[0], kp=0.0, kd=0.0),) for s, m in grip.items()}
            yield from script.hold_as("release", pressing, _RELEASE)
            script.grip = grip


def _hold_long(script: GripperScript, pressing: Sequence[Side], free: Sequence[Side]) -> Steps:
    """Equal commands for long: a grip by the client's lead, and a hand held without contact.

    They come at the rate of a camera, so that one command to the wrong side would be in force
    long enough to show. A torque pushes the free hand at first and at last.
    """
    script.report("the same commands for long: they must stay in force")
    script.grip = _by_the_lead(script, pressing)
    period, script.period_ns = script.period_ns, round(1e9 / _CAMERA_HZ)
    beyond = {s: {0: motors[0].q} for s, motors in script.grip.items()}
    gripping = [script.begin("grip", pressing, targets=beyond)] if pressing else []
    pushed = nudged(script, free)
    push = free and script.gains_used
    yield from script.hold(0.2)
    for seconds in (_LONG_GRIP if script.patient else _GRIP, 0.1):
        if push:
            yield from script.hold_as("nudge", free, NUDGE_SECONDS, pushed)
        yield from script.hold(seconds)
    for phase in gripping:
        script.end(phase)
    script.period_ns = period


def _by_the_lead(script: GripperScript, sides: Sequence[Side]) -> dict[Side, Motors]:
    """Commands into the objects of these sides by xr_teleoperate's lead."""
    lead = _LEAD * script.stroke
    return {s: (Motor(q=max(script.plan.objects[s] - lead, 0.0)),) for s in sides}


def gripper_squeeze(script: GripperScript, sides: Sequence[Side]) -> dict[Side, Motors]:
    """Commands into the objects of these sides."""
    depth = 1.5 * _LEAD * script.stroke
    return {s: (Motor(q=script.plan.objects[s] - depth),) for s in sides}


def never_silent(plan: Plan[Any]) -> bool:
    """Whether a gripper gets commands all the time."""
    return not plan.phases & {"silence", "resume", "rejected"}


@stimulus("soft-grip soft", GripperScript, after="squeeze", applies=never_silent)
def grip_and_step_softly(script: GripperScript) -> Steps:
    """Grips of less stiffness, and a step of less; in other runs while there is a silence."""
    pressing = script.plan.pressing
    yield from grip_softly(script, pressing)
    yield from grip_from_below(script, pressing)
    script.grip = {}
    yield from step_softly(script, script.plan.sides)


def grip_softly(script: GripperScript, pressing: Sequence[Side]) -> Steps:
    """Grips of less stiffness than the client's."""
    if not script.gains_used or "soft-grip" not in script.plan.phases or not pressing:
        return
    touch = script.plan.objects
    for kp, depth in _SOFT_GRIPS:
        soft = {s: Motor(q=max(touch[s] - depth, 0.0), kp=kp) for s in pressing}
        yield from _soft_grip(script, soft, _SOFT_SECONDS)


def grip_from_below(script: GripperScript, pressing: Sequence[Side]) -> Steps:
    """A grip of little stiffness whose q is below the closed end."""
    if not script.gains_used or "soft-grip" not in script.plan.phases or not pressing:
        return
    touch = script.plan.objects
    below = {s: Motor(q=-_BEYOND * script.stroke, kp=_BEYOND_TAU / touch[s]) for s in pressing}
    yield from _soft_grip(script, below, script.model.command_timeout + _BEYOND_AFTER)


def _soft_grip(script: GripperScript, motors: Mapping[Side, Motor], seconds: float) -> Steps:
    targets = {s: {0: motor.q} for s, motor in motors.items()}
    script.grip.update({s: (motor,) for s, motor in motors.items()})
    yield from script.hold_as("soft-grip", tuple(motors), seconds, targets=targets)


@stimulus("grip", GripperScript, moment=Moment.NEW_CLIENT, applies=without_gains)
@stimulus("grip", GripperScript, moment=Moment.STARTED, applies=without_gains)
def grip_again(script: GripperScript) -> Steps:
    """A grip after the restart of the service.

    Not in dialects with gains: there the steps after a restart show a loss of torque.
    """
    pressing = script.plan.pressing
    if not pressing:
        return
    script.report("squeezing the object again")
    script.grip = dict(gripper_squeeze(script, pressing))
    yield from script.hold_as("regrip", pressing, _SQUEEZE)
    script.grip = {}
    yield from script.turn("center", {s: (script.high(),) for s in pressing}, least=0.5)


def unprotected(plan: Plan[Any]) -> bool:
    """Whether no joint has time-out protection; with it, hands squeeze in a phase of its own."""
    return not plan.phases & {"guard", "guard-latch", "guard-clear"}


@stimulus("squeeze beside-grip silence resume", FingerScript, after="firmer", applies=unprotected)
def squeeze_object(script: FingerScript) -> Steps:
    """All fingers close on the object, for seconds; then a hand without one makes a step."""
    pressing = script.plan.pressing
    if pressing:
        script.report("squeezing the object")
        yield from squeeze_fingers(script, pressing, 2.0, beside=True)


def squeeze_fingers(
    script: FingerScript,
    sides: Sequence[Side],
    seconds: float,
    name: str = "squeeze",
    *,
    beside: bool = False,
) -> Steps:
    """All fingers close on the object, as a phase.

    :param beside: the other hands make a step in the last part of it.
    """
    squeeze = finger_squeezes(script, sides, {})
    targets = {
        s: {i: m.q for i, m in enumerate(squeeze[s]) if script.joints[s][i].closing} for s in sides
    }
    phases = [script.begin(name, sides, targets=targets)]
    if beside:
        yield from script.hold(seconds - ASIDE_SECONDS, squeeze)
        phases += step_beside_grip(script, sides)
        seconds = ASIDE_SECONDS
    yield from script.hold(seconds, squeeze)
    for phase in phases:
        script.end(phase)


def finger_squeezes(
    script: FingerScript, sides: Sequence[Side], guarded: Mapping[Side, frozenset[int]]
) -> dict[Side, Motors]:
    """The command to press on the object: as far as a client can, where force is judged."""
    most = 100.0 if guarded else 0.0
    return {
        s: script.guarded(
            script.motors(s, script.pose(s, max(most, script.plan.objects[s] + BEYOND))), s, guarded
        )
        for s in sides
    }


def step_beside_grip(script: FingerScript, pressing: Sequence[Side]) -> list[Phase]:
    """Begin a step of the hands that do not press, while others do."""
    free = [s for s in script.plan.sides if s not in pressing]
    if not (free and pressing and "beside-grip" in script.plan.phases):
        return []
    script.goal.update({s: script.pose(s, CLOSED - 5.0) for s in free})
    targets = {s: script.goal[s] for s in free}
    return [script.begin("beside-grip", free, targets=targets)]


@stimulus("squeeze", FingerScript, moment=Moment.NEW_CLIENT, applies=of_position_servos)
@stimulus("squeeze", FingerScript, moment=Moment.STARTED, applies=of_position_servos)
def squeeze_again(script: FingerScript) -> Steps:
    """A position servo's limits of force are its own: what a restart does to them is seen by a
    grip.
    """
    pressing = script.plan.pressing
    if not pressing:
        return
    script.report("squeezing the object again")
    yield from squeeze_fingers(script, pressing, _GRIP_SECONDS)
    yield from script.to("center", OPEN)


_HELD = 0.2
"""Quantile of tau_est that counts as held, and from above as reached: a chattering limit lets go
half of the time."""


def _felt(
    ctx: Context, begin: float, end: float, window: float
) -> list[tuple[float, float, float]]:
    """(time, median abs(tau_est), held abs(tau_est)) of consecutive windows.

    Windows without states are left out.
    """
    found = []
    for at in np.arange(begin, end - window + 1e-9, window):
        tau = np.abs(ctx.tau(float(at), float(at) + window)[:, 0])
        tau = np.sort(tau[np.isfinite(tau)])
        if len(tau) >= 3:
            found.append((float(at), median(tau), float(tau[int(_HELD * len(tau))])))
    return found


@check("DEX1-FORCE-10")
@with_object
def lasts(ctx: Context) -> Outcome:
    """The force of a long grip, and of later ones."""
    return all_of(_stays(ctx), _comes_back(ctx))


@worst("change_part", "max_change_part", nothing="it did not press on the object for long enough")
def _stays(ctx: Context) -> Figures:
    """Rise and fall of the force of a long grip under a constant command."""
    window = ctx.tolerance("window_s")
    for phase in ctx.phases("grip"):
        begin, end = ctx.span(phase)
        touched = _touched(ctx, begin, end)
        if touched is None:
            continue
        felt = _felt(ctx, touched + ctx.tolerance("contact_s"), end, window)
        settled = touched + ctx.tolerance("settle_s")
        usual = [tau for at, tau, _ in felt if at >= settled][:3]
        if len(usual) < 3 or median(np.array(usual)) < ctx.tolerance("min_tau_nm"):
            continue
        # a driver may lower its effort at first, but no force may grow
        held, least = median(np.array(usual)), felt[0][1]
        for at, tau, kept in felt:
            least = max(min(least, tau), ctx.tolerance("min_tau_nm"))
            for now, was, change in (
                (tau, least, tau / least - 1.0),
                (kept, held, 1.0 - kept / held),
            ):
                if was == least or at >= settled:
                    text = f"tau_est of {now:.2f} N m {at - begin:.1f} s after the command, where "
                    yield Figure(change, at, at + window, text=f"{text}it was {was:.2f}")


def _touched(ctx: Context, begin: float, end: float) -> float | None:
    """Time at which a gripper reached its final position, s; None without states."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, 0]
    good = np.isfinite(q)
    t, q = t[good], q[good]
    if len(q) < 10:
        return None
    last = median(q[t >= end - 0.5]) if (t >= end - 0.5).any() else float(q[-1])
    there = np.abs(q - last) <= ctx.tolerance("near_stroke")
    return float(t[np.argmax(there)]) if there.any() else None


@worst("part", "min_part", nothing="no state during a later grip")
def _comes_back(ctx: Context) -> Figures:
    """The smallest force of later grips, relative to the first."""
    grips = ctx.phases("grip")
    first = _force(ctx, grips[0]) if grips else None
    if first is None or first < ctx.tolerance("min_tau_nm"):
        yield ctx.skipped("it did not grip before")
        return
    # a driver may lower its effort at first: the least of the first grip's end
    begin, end = ctx.span(grips[0])
    pieces = _felt(ctx, max(begin, end - 0.5), end, 0.1)
    first = max(min((tau for _, tau, _ in pieces), default=first), ctx.tolerance("min_tau_nm"))
    for phase in (*grips[1:], *ctx.phases("squeeze"), *ctx.phases("regrip")):
        tau = _force(ctx, phase)
        if tau is not None and obeyed_before(ctx, phase):
            text = f"tau_est of {tau:.2f} N m in a later grip, {first:.2f} N m in the first"
            least = ctx.tolerance("min_part") * first
            measure = Measure(tau, least, "N m", Quantity.TORQUE, False)
            yield Figure(tau / first, *ctx.span(phase), text=text, measure=measure)


def _force(ctx: Context, phase: Phase) -> float | None:
    """The median abs(tau_est) of the last half second of a grip; None without states."""
    begin, end = ctx.span(phase)
    tau = np.abs(ctx.tau(max(begin, end - 0.5), end)[:, 0])
    tau = tau[np.isfinite(tau)]
    return median(tau) if len(tau) else None


@check("DEX1-FORCE-11")
@with_object
def soft_grips(ctx: Context) -> Outcome:
    """The force of grips with low stiffness: enough of it, and no more than asked for."""
    return all_of(_presses_softly(ctx), warning(_no_more_than_asked(ctx), unless_claimed=True))


@worst("tau_nm", "min_tau_nm", nothing="no state during grips with little stiffness")
def _presses_softly(ctx: Context) -> Figures:
    """The smallest tau_est of grips with low stiffness."""
    if (none := no_torque(ctx)) is not None:
        yield none
        return
    for grip in soft_grips_of(ctx):
        text = (
            f"tau_est of {grip.tau:.2f} N m with a kp of {grip.kp:g} N m/rad, where kp times the "
            f"distance is {grip.asked:.2f} N m"
        )
        yield Figure(grip.tau, grip.begin, grip.end, text=text)


_OWN = "this gripper has a force of its own"


@worst("part", "max_part", nothing="no grips to compare, one of them with the client's stiffness")
def _no_more_than_asked(ctx: Context) -> Figures:
    """The greatest force of soft grips, relative to the commanded one."""
    soft, usual = softer_grips(ctx), usual_part(ctx)
    if not soft or usual is None:
        return
    if abs(usual - 1.0) > ctx.tolerance("max_own_part") or has_own_force(ctx):
        yield ctx.skipped(_OWN)
    for grip in soft:
        text = (
            f"tau_est of {grip.tau:.2f} N m with a kp of {grip.kp:g} N m/rad, which asks for "
            f"{grip.asked:.2f} N m"
        )
        limit = ctx.tolerance("max_part") * grip.asked
        measure = Measure(grip.tau, limit, "N m", Quantity.TORQUE)
        yield Figure(grip.part, grip.begin, grip.end, text=text, measure=measure)


@check("DEX1-FORCE-15")
@with_object
@worst("part", "max_part", nothing="no force was reported while it squeezed")
def releases_with_zero_gains(ctx: Context) -> Figures:
    """tau_est after zero gains at the q of a grip, relative to that of the grip."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, after = (
            np.abs(tau[np.isfinite(tau)])
            for tau in (ctx.tau(begin - 0.3, begin)[:, 0], ctx.tau(end - 0.1, end)[:, 0])
        )
        if len(before) < 3 or len(after) < 3 or median(before) < ctx.tolerance("min_tau_nm"):
            continue
        left, had = median(after), median(before)
        text = f"tau_est {left:.2f} N m after zero gains at the same q, {had:.2f} N m before"
        measure = Measure(left, ctx.tolerance("max_part") * had, "N m", Quantity.TORQUE)
        yield Figure(left / had, begin, end, text=text, measure=measure)


@check("DEX1-FORCE-09")
@with_object
@worst("part", "min_part", nothing="it never pressed on the object for long enough")
def as_commanded(ctx: Context) -> Figures:
    """The smallest tau_est in contact, relative to kp times the distance to the goal."""
    if (none := no_torque(ctx)) is not None:
        yield none
        return
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


@check("DEX3-FORCE-05")
@with_object
def joints_as_commanded(ctx: Context) -> Outcome:
    """tau_est of pressing joints, at the end of a grip and in each piece of every one."""
    return all_of(_presses_as_commanded(ctx), _presses_as_it_moves(ctx))


@worst("part", "max_part", nothing="no joint was held back by the object")
def _presses_as_commanded(ctx: Context) -> Figures:
    """The smallest and largest tau_est of pressing joints, relative to kp times the distance to the
    goal.
    """
    limits = (ctx.tolerance("min_part"), True), (ctx.tolerance("max_part"), False)
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


_FORCE_S = 0.3
"""Seconds over which a force is taken."""
_STANDS_IN_GRIP = 0.03  # part of the range: a joint that moves by less meanwhile stands


def _first_force(ctx: Context, begin: float, end: float) -> tuple[Floats, Floats]:
    """tau_est in size of each joint in the first piece in which it stands, and that piece's end.

    A joint that is still on its way presses on nothing: its torque ends with its motion. 0 N m for
    one that never stands.
    """
    strokes = np.array([j.stroke for j in ctx.joints])
    felt, since = np.zeros(len(strokes)), np.full(len(strokes), np.inf)
    for at in np.arange(begin, end - _FORCE_S + 1e-9, _FORCE_S / 3).tolist():
        rows = ctx.states.between(at, at + _FORCE_S)
        q = ctx.states.q[rows]
        if not len(q):
            continue
        stands = np.isinf(since) & (np.ptp(q, axis=0) <= _STANDS_IN_GRIP * strokes)
        felt[stands] = np.median(np.abs(ctx.states.tau[rows]), axis=0)[stands]
        since[stands] = at + _FORCE_S
    return felt, since


@check("DEX3-FORCE-06")
@with_object
@worst("part", "min_part", nothing="no joint pressed on the object for long enough")
def keeps_gripping(ctx: Context) -> Figures:
    """The smallest tau_est later in a long grip, relative to its beginning.

    A value that a fifth of the states do not reach does not count as held, since a chattering limit
    lets go as often.
    """
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        if end - begin < ctx.tolerance("min_hold_s"):
            continue
        # the motors' own time-outs are a second after the last command
        quiet = [p for p in ctx.phases("guard") if p.begin_ns >= phase.end_ns]
        until = ctx.span(quiet[0])[0] + 0.7 if quiet else end
        first, since = _first_force(ctx, begin + _FORCE_S, end - _FORCE_S)
        least = ctx.tolerance("min_tau_nm")
        pressing = np.flatnonzero(first / torque_scales(ctx, least) >= least).tolist()
        later = np.arange(begin + 2 * _FORCE_S, end - _FORCE_S, _FORCE_S).tolist()
        spans = [*((at, at + _FORCE_S) for at in later), (end - _FORCE_S, end)]
        spans.append((until - _FORCE_S, until))
        for a, b in spans:
            tau = ctx.tau(a, b)
            if not len(tau):
                continue
            held = np.quantile(np.abs(tau), _HELD, axis=0)
            for joint in (j for j in pressing if a >= since[j] - 1e-9):
                then, now = float(first[joint]), float(held[joint])
                text = f"tau_est of {then:.2f} N m at first, and of {now:.2f} N m later"
                limit = ctx.tolerance("min_part") * then
                measure = Measure(now, limit, "N m", Quantity.TORQUE, False)
                yield Figure(now / then, a, b, joint, text, measure=measure)


_CONTACT_S = 0.7  # s after which the joints stand at the object


@check("BRAINCO-GRIP-01")
@with_object
def keeps_grip(ctx: Context) -> Outcome:
    """Opening of a joint that presses on the object while it is commanded to close."""
    nothing = "no joint was held back by the object"
    outcome = judged(ctx, _openings(ctx), "motion_rad", "max_back_stroke", nothing=nothing)
    return outcome.tolerated() if outcome.met is False and outcome.joints else outcome


def _openings(ctx: Context) -> Figures:
    limit = ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        yield from _gives_way(ctx, phase, begin + _CONTACT_S, end)
        gap = longest_gap(ctx, limit, begin, end)
        if gap.value > limit:
            text = f"no state for {gap.value:.2f} s while it grips"
            outcome = ctx.failed(f"{gap.value:.2f} s", text, ctx.at(ctx.states.topic, begin, end))
            yield outcome.resting_on(gap).if_late(gap.value - limit)


def _gives_way(ctx: Context, phase: Phase, begin: float, end: float) -> Iterator[Figure]:
    """How far each joint that the object holds back opens."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows]
    if len(t) < 5:
        return
    for joint, target in phase.targets.get(ctx.side, {}).items():
        spec = ctx.joints[joint]
        closed = q[:, joint] * spec.closing
        if target * spec.closing - float(closed[0]) < ctx.tolerance("min_held_stroke", joint):
            continue  # it arrived, or nearly
        opened = np.maximum.accumulate(closed) - closed
        i = int(np.argmax(opened))
        text = f"opened by {opened[i]:.3f} {ctx.unit} while it was commanded to grip"
        yield Figure(float(opened[i]), float(t[i]), None, joint, text)


_AWAY = 0.15  # of the stroke: way to the object of a squeeze that is compared with others


@check("BRAINCO-FORCE-05")
@with_object
def grips_alike(ctx: Context) -> Outcome:
    """The weakest grip of each joint; and the weakest squeeze, where these are limited."""
    if "min_squeeze_part" not in ctx.requirement.tolerances:
        return _grips_alike(ctx)
    return all_of(_grips_alike(ctx), _squeezes_alike(ctx))


@worst("part", "min_part", nothing="no joint pressed with enough force to compare")
def _grips_alike(ctx: Context) -> Figures:
    """The weakest stretch of a joint's grips, relative to the strongest."""
    if (skipped := no_stand(ctx) or no_torque(ctx)) is not None:
        yield skipped
    for joint, spec in enumerate(ctx.joints):
        mine = [s for s in stands(ctx) if s.presses[joint]]
        strongest = max((float(np.abs(s.force[:, joint]).max()) for s in mine), default=0.0)
        weak = strongest < ctx.tolerance("min_strongest_part") * spec.tau_max
        if weak or len(mine) < FEW_STANDS:
            continue
        ends = [abs(float(s.force[-1, joint])) for s in mine]
        second = int(np.argsort(ends, kind="stable")[FEW_STANDS - 1])
        yield _compared(ctx, joint, ends[second], strongest, mine[second].begin, mine[second].end)


def _compared(
    ctx: Context, joint: int, weakest: float, strongest: float, begin: float, end: float
) -> Figure:
    """A joint's weakest grip, relative to its strongest."""
    unit = torque_unit(ctx)
    text = (
        f"{torque_member(ctx)} of {weakest:.2f} {unit} in a grip, where it was {strongest:.2f} "
        f"{unit} at most"
    )
    return Figure(weakest / strongest, begin, end, joint, text)


@worst(
    "squeeze_part",
    "min_squeeze_part",
    nothing="no joint squeezed the object twice with enough force to compare",
)
def _squeezes_alike(ctx: Context) -> Figures:
    """The weakest squeeze of a joint, relative to its strongest one that began as far away."""
    if (skipped := no_stand(ctx) or no_torque(ctx)) is not None:
        yield skipped
    for joint, spec in enumerate(ctx.joints):
        found = _squeezes(ctx, joint)
        strongest = max((force for force, _ in found), default=0.0)
        if strongest >= ctx.tolerance("min_strongest_part") * spec.tau_max and len(found) >= 2:
            weakest, span = min(found)
            yield _compared(ctx, joint, weakest, strongest, *span)


def _squeezes(ctx: Context, joint: int) -> list[tuple[float, tuple[float, float]]]:
    """The median force of a joint in each squeeze, and when it was.

    Not of a squeeze that began at the object: on contact, the force rises with the speed.
    """
    at, spec = ctx.object_at, ctx.joints[joint]
    if at is None or not spec.closing:
        return []
    contact = spec.closed_by(at / 100)
    found = []
    for phase in ctx.phases("squeeze"):
        begin, end = ctx.span(phase)
        q = ctx.q(begin - _GRID_S, begin)[:, joint]
        if not len(q) or (contact - q[-1]) * spec.closing < _AWAY * spec.stroke:
            continue
        inside = [s for s in stands(ctx) if begin <= s.begin and s.end <= end and s.presses[joint]]
        if len(inside) >= FEW_STANDS:
            force = float(np.median([s.force[-1, joint] for s in inside]))
            found.append((force, (inside[0].begin, inside[-1].end)))
    return found


_PEAKS_S, _FEW_PEAKS = 1.05, 3
"""Window of contact in which peaks are counted, seconds, and the fewest peaks of a failure."""


@dataclass(frozen=True)
class _Peak:
    """A piece of contact, and the states in which tau_est is above its limit, N m."""

    begin: float
    end: float
    states: int
    count: int
    limit: float
    above: Floats


def _hammers(ctx: Context, peaks: list[_Peak]) -> Outcome | None:
    """The failure of a hand with repeated short peaks of force."""
    for i, first in enumerate(peaks):
        near = [p for p in peaks[i:] if p.end - first.begin <= _PEAKS_S]
        count, states = sum(p.count for p in near), sum(p.states for p in near)
        if count >= _FEW_PEAKS and count > ctx.tolerance("max_peaks_part") * states:
            hit = next(p for p in near if p.count)
            tau = float(hit.above.max())
            text = (
                f"tau_est of {tau:.2f} N m in contact in {count} of {states} states, where at most "
                f"{hit.limit:.2f} N m follow from the stiffness that it shows without contact"
            )
            place = ctx.at(ctx.states.topic, near[0].begin, near[-1].end)
            outcome = ctx.failed(f"{tau:.2f} N m", text, place, tau_nm=tau)
            return outcome.pressed(tau, hit.limit)
    return None


@check("DEX1-FORCE-18")
@with_object
def grips_as_it_moves(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the stiffness without contact."""
    if ctx.recording.dialect.gains_are_used:
        return warning(_fits_displacement(ctx), unless_claimed=True)
    return _fits_free_motion(ctx)


def _fits_displacement(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the hand's measured stiffness times the
    error.
    """
    if (none := no_torque(ctx)) is not None:
        return none
    found = nudges(ctx, [*ctx.phases(STIFFNESS), *ctx.phases("nudge")])
    shown = [n for n in found if n.way >= ctx.tolerance("min_motion_stroke")]
    if not found:
        return ctx.skipped("no state while it was pushed")
    if len(shown) < len(found):
        return ctx.skipped("a torque does not displace this hand: it has a force of its own")
    # relative to kp; a stiffer hand may press more, and a softer one less
    stiffest = max(1.0, *(n.asked / n.way for n in shown))
    softest = min(1.0, *(n.asked / n.way for n in shown))
    least, most = ctx.tolerance("min_part"), ctx.tolerance("max_part")
    text = "tau_est of {felt} in contact, where {limit} follow from the stiffness that it shows "
    text += "without contact"
    figures: list[Figure] = []
    peaks: list[_Peak] = []
    for piece in contacts(ctx, ctx.touch):
        asked = piece.kp * (piece.q - piece.goal)
        if asked < ctx.tolerance("min_asked_nm"):
            continue
        low = least * softest * min(asked, ctx.tolerance("max_asked_nm"))
        high = most * stiffest * asked
        span = piece.begin, piece.end
        figures += pressed((piece.tau, piece.tau), (low, high), text, *span)
        felt = np.abs(ctx.tau(*span)[:, 0])
        peak = most * stiffest * piece.most
        above = felt[felt > peak]
        peaks.append(_Peak(*span, len(felt), len(above), peak, above))
    nothing = "it never pressed on the object for long enough"
    outcome = judged(ctx, figures, "tau_nm", "max_tau_nm", nothing=nothing)
    return _hammers(ctx, peaks) or outcome if outcome.met else outcome


_FEW = 20
"""Fewest states for a gripper's stiffness."""


_PRESSED_S = 0.3
"""Seconds at the end of a squeeze in which the joints stand."""


_STANDS = 0.01
"""Part of the range by which q of a joint that stands may vary in a piece."""


_MOST = 0.95
"""Quantile of a gripper's torque by distance that counts as its greatest stiffness."""


def pressed(
    felt: tuple[float, float],
    limits: tuple[float, float],
    text: str,
    begin: float,
    end: float,
    joint: int | None = None,
) -> Iterator[Figure]:
    """The tau_est of a piece of contact against both of its limits, N m.

    :param felt: least and greatest tau_est of the piece.
    :param limits: the least and the greatest that it may be.
    :param text: what was observed, with places for the value ``felt`` and its limit.
    :param begin: of the piece, s, as ``end``.
    """
    for value, limit, least in ((felt[0], limits[0], True), (felt[1], limits[1], False)):
        bound = f"{'at least' if least else 'at most'} {limit:.3f} N m"
        shown = text.format(felt=f"{value:.3f} N m", limit=bound)
        yield Figure(value, begin, end, joint, shown, limit=limit, at_least=least)


@worst("tau_nm", "max_tau_nm", nothing="no joint was held back by the object")
def _presses_as_it_moves(ctx: Context) -> Figures:
    """tau_est of each standing joint that presses on the object, relative to the law."""
    for phase in (p for name in ("squeeze", "touch", "firmer", "regrip") for p in ctx.phases(name)):
        yield from _presses(ctx, *ctx.span(phase))


def _presses(ctx: Context, begin: float, end: float) -> Iterator[Figure]:
    """Each joint in each piece in which it stands under an unchanged command."""
    least, window = ctx.tolerance("min_asked_nm"), ctx.tolerance("window_s")
    scales = torque_scales(ctx, least)
    factors = torque_factors(ctx, least).factors / scales
    strokes = np.array([j.stroke for j in ctx.joints])
    most = np.array([j.tau_max for j in ctx.joints])
    closing = np.array([j.closing for j in ctx.joints])
    states, commands = ctx.states, ctx.commands
    text = (
        "tau_est of {felt} in contact, where {limit} follow from its command and from its torque "
        "in free motion"
    )
    for at in np.arange(begin, end - window + 1e-9, 0.5 * window).tolist():
        rows = np.arange(len(states))[states.between(at, at + window)]
        given = (commands.t >= at - ctx.tolerance("settle_s")) & (commands.t <= at + window)
        if len(rows) < 5 or int(given.sum()) < 3:
            continue
        same = (np.ptp(commands.q[given], axis=0) <= 1e-6) & (
            np.ptp(commands.kp[given], axis=0) <= 0
        )
        law, driven = torque_by_law(ctx, rows)
        asked = np.median(law, axis=0) * closing
        felt = np.sort(np.abs(states.tau[rows]) / scales, axis=0)
        low, high = (felt[int(part * (len(rows) - 1))] for part in (_HELD, 1.0 - _HELD))
        stands = np.ptp(states.q[rows], axis=0) <= _STANDS * strokes
        with np.errstate(invalid="ignore"):
            judged = same & stands & driven.all(axis=0) & (asked >= least) & np.isfinite(felt[-1])
        for joint in np.flatnonzero(judged).tolist():
            own = factors[joint]
            floor = ctx.tolerance("min_part") * min(own, 1.0) * min(asked[joint], most[joint])
            ceiling = ctx.tolerance("max_part") * max(own, 1.0) * asked[joint]
            felt_there = float(low[joint]), float(high[joint])
            limits = float(floor), float(ceiling)
            yield from pressed(felt_there, limits, text, at, at + window, joint)


@check("DEX3-FORCE-11", "BRAINCO-FORCE-11")
@with_object
def stops_at_object(ctx: Context) -> Outcome:
    """The least part of the way from the object to its goal that a joint goes.

    One joint is enough, as an object need not touch all. A requirement with ``min_tau_nm`` also
    limits the torque of the joints that go farther.
    """
    touch, most = ctx.touch, 0.0
    judged = False
    for phase in ctx.phases():
        begin, end = max(ctx.span(phase)[0], ctx.span(phase)[1] - _PRESSED_S), ctx.span(phase)[1]
        rows = np.arange(len(ctx.states))[ctx.states.between(begin, end)]
        past = _past_object(ctx, phase, rows, touch)
        if not past:
            continue
        judged = True
        place = ctx.at(ctx.states.topic, begin, end)
        most = max(most, min(past.values()))
        if most > ctx.tolerance("max_past_part"):
            text = (
                f"no joint is held back: all go {most:.0%} of the way or more from the object, at "
                f"{touch:g} % of closing, to their goals"
            )
            return ctx.failed(f"{most:.0%}", text, place, part=most)
        odd = _unexplained(ctx, rows, past)
        if odd is not None:
            joint, felt = odd
            text = ctx.named(
                f"q is {past[joint]:.0%} of the way from the object to its goal, where kp "
                f"(q - q_now) does not explain the {felt:.2f} N m of tau_est",
                joint,
            )
            return ctx.failed(f"{felt:.2f} N m", text, place, tau_nm=felt).about(joint)
    if not judged:
        return ctx.skipped("no joint was commanded to go past the object")
    return ctx.passed(f"{most:.0%}", f"a joint stops {most:.0%} of the way past the object or less")


def _past_object(ctx: Context, phase: Phase, rows: Rows, touch: float) -> dict[int, float]:
    """Where each joint that is commanded past the object is, 0 at the object and 1 at its goal."""
    if len(rows) < FEW_SHOWN:
        return {}
    q = np.median(ctx.states.q[rows], axis=0)
    found = {}
    for joint, goal in phase.targets.get(ctx.side, {}).items():
        spec = ctx.joints[joint]
        contact = spec.closed_by(touch / 100)
        if (goal - contact) * spec.closing >= ctx.tolerance("min_way_stroke", joint):
            found[joint] = float((q[joint] - contact) / (goal - contact))
    return found


def _unexplained(ctx: Context, rows: Rows, past: Mapping[int, float]) -> tuple[int, float] | None:
    """A joint past the object that presses more than its command asks for, and its tau_est, N m."""
    if "min_tau_nm" not in ctx.requirement.tolerances:
        return None
    least = ctx.tolerance("min_tau_nm")
    asked = np.abs(np.median(torque_by_law(ctx, rows)[0], axis=0))
    felt = np.abs(np.median(ctx.states.tau[rows], axis=0)) / torque_scales(ctx, least)
    for joint, part in past.items():
        much = felt[joint] >= least and felt[joint] > ctx.tolerance("max_ratio") * asked[joint]
        if part > ctx.tolerance("max_past_part") and much:
            return joint, float(felt[joint])
    return None


@dataclass(frozen=True)
class _Spring:
    """A gripper's tau_est without contact: stiffness times the distance to q, less damping.

    :param stiffness: N m/rad; ``error`` is its standard error.
    :param residual: part of tau_est (RMS) that is not explained.
    :param least: the median of tau_est by distance, and ``most`` a high quantile of it, N m/rad:
        damping makes it less, and a late q makes it more.
    """

    stiffness: float
    error: float
    residual: float
    least: float
    most: float


def _spring(ctx: Context) -> _Spring | None:
    """The spring that moves a gripper without contact, by the age of commands that fits best.

    The strength of a grip has no sign: only states count in which it moves towards its goal.
    """
    states, commands, spec = ctx.states, ctx.commands, ctx.joints[0]
    if not len(commands) or not states.dq[:, 0].any():
        return None
    clear = ctx.tolerance("clear_stroke")
    low = (spec.q_min if ctx.object_at is None else ctx.object_at) + clear
    q, dq, tau = states.q[:, 0], states.dq[:, 0], np.abs(states.tau[:, 0])
    with np.errstate(invalid="ignore"):
        free = np.isfinite(tau) & np.isfinite(dq) & (q > low) & (q < spec.q_max - clear)
    free &= states.t >= commands.t[0] + 1.0
    if int(free.sum()) < _FEW:
        return None
    free &= tau <= 0.9 * float(tau[free].max())  # the drive may be at its limit
    best: _Spring | None = None
    for lag in LAGS_S:
        rows = np.searchsorted(commands.t, states.t - lag, "right") - 1
        fresh = (rows >= 0) & (states.t - lag - commands.t[np.maximum(rows, 0)] < 0.1)
        goal = np.clip(commands.q[np.maximum(rows, 0), 0], spec.q_min, spec.q_max)
        off = goal - q
        with np.errstate(invalid="ignore"):
            mine = free & fresh & (off * dq >= 0)
            mine &= np.abs(off) >= ctx.tolerance("min_off_stroke")
            mine &= np.abs(off) <= ctx.tolerance("max_off_stroke")
        if int(mine.sum()) < _FEW:
            continue
        x, y = np.column_stack((np.abs(off[mine]), -np.abs(dq[mine]))), tau[mine]
        found = _fitted(x, y)
        if found is not None and (best is None or found.residual < best.residual):
            best = found
    return best


def _fitted(x: Floats, y: Floats) -> _Spring | None:
    """The best spring; None if the values do not determine one.

    :param x: distance to the goal and -abs(dq), shape (n, 2).
    :param y: abs(tau_est).
    """
    (a, b), (c, d) = x.T @ x
    size = a * d - b * c
    total = float(y @ y)
    if size <= 1e-9 * a * d or not total:
        return None
    right = x.T @ y
    fit = np.array([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / size
    left = y - x @ fit
    variance = float(left @ left) / max(len(y) - 2, 1)
    ratios = np.sort(y / x[:, 0])
    least, most = (float(ratios[int(part * (len(y) - 1))]) for part in (0.5, _MOST))
    error, residual = np.sqrt(variance * d / size), np.sqrt(left @ left / total)
    return _Spring(float(fit[0]), float(error), float(residual), least, most)


def _fits_free_motion(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the spring that moves the gripper freely."""
    spring = _spring(ctx)
    if (
        spring is None
        or spring.residual > ctx.tolerance("max_residual")
        or spring.stiffness < ctx.tolerance("min_stiffness")
        or spring.error > ctx.tolerance("max_error_part") * spring.stiffness
    ):
        return ctx.skipped("its torque in free motion is not in proportion to the distance to q")
    softest = min(spring.stiffness, spring.least)
    stiffest = max(spring.stiffness, spring.most)
    text = "tau_est of {felt} in contact, where {limit} follow from the stiffness "
    text += f"{softest:.1f} to {stiffest:.1f} N m/{ctx.unit} with which it moves without contact"
    figures: list[Figure] = []
    for piece in contacts(ctx, ctx.touch):
        depth = piece.q - piece.goal
        if stiffest * depth < ctx.tolerance("min_asked_nm"):
            continue
        low = ctx.tolerance("min_part") * min(softest * depth, ctx.tolerance("max_asked_nm"))
        high = ctx.tolerance("max_part") * stiffest * depth
        figures += pressed((piece.tau, piece.tau), (low, high), text, piece.begin, piece.end)
    nothing = "it never pressed on the object for long enough"
    return judged(ctx, figures, "tau_nm", "max_tau_nm", nothing=nothing)
