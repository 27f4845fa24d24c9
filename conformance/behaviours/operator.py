"""An operator with the client of xr_teleoperate moves the hand: a closed loop.

In all other phases the commands do not depend on the hand's answers. Here they depend on the
states, as with the genuine client: a hand whose state is late is commanded slowly. The operator's
motion is the profile ``check`` of :mod:`dexkit.teleop.profiles`, kept clear of an object; the
phase's parameters are enough to compute the operator's goal at any time (:func:`operator_of`).

The client gets the newest state each time its receiving thread would have read one. That a silent
side stops the other's states, too, is not part of this phase.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

from dexkit.conformance.checks import STROKE_S, Context, Outcome, check
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import Moment, stimulus
from dexkit.conformance.stimuli.script import Plan, Send, Steps
from dexkit.hand import Side
from dexkit.models import Dialect
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.tracking import Step, TrackingFigures, tracking_figures

OPERATOR = "operator"
"""Name of the phase."""
_PROFILE = "check"
_CLEAR = 0.1  # of the stroke: room left to the object
_DEEPEST = 0.5  # how far the profile closes a hand of several joints
_POLL = 0.001  # s between two reads while the client waits for a state


def _most(plan: Plan[Side], side: Side) -> float:
    """Largest closing of a side, 0 to 1, for :class:`~dexkit.teleop.Operator`."""
    touch = plan.objects.get(side)
    if touch is None:
        return 1.0
    if not plan.dialect.is_gripper:  # percent of closing
        return min(1.0, max(0.0, (touch / 100 - _CLEAR) / _DEEPEST))
    return min(1.0, max(0.0, 1.0 - touch / plan.dialect.q_open - _CLEAR))


def operator_of(phase: Phase, dialect: Dialect) -> Operator:
    """The operator of a phase, from its parameters in the recording."""
    hands = [s for s in phase.sides if isinstance(s, Side)]
    most = {s: float(phase.params.get(f"most_{s}", 1.0)) for s in hands}
    return Operator(profile(phase.params["profile"], dialect.model), dialect, most=most)


@stimulus(OPERATOR, HandScript, moment=Moment.CLIENTS)
def operate(script: HandScript) -> Steps:
    """An operator at Unitree's client, and back to the middle."""
    if script.plan.dialect.has_client:  # none of the requirements applies to other dialects
        yield from _close_the_loop(script)
    yield from script.everyone("center", script.homes())


def _close_the_loop(script: HandScript) -> Steps:
    """Unitree's client in a closed loop with the hand."""
    plan = script.plan
    script.report("an operator at Unitree's client: full strokes, steps, slow motion")
    phase = script.begin(OPERATOR, plan.sides, profile=_PROFILE)
    phase.params.update({f"most_{s}": f"{_most(plan, s):.6g}" for s in plan.sides})
    operator = operator_of(phase, plan.dialect)
    client = client_for(plan.dialect, plan.sides)
    period = round(1e9 * client.period)
    tick = begin = script.obs.now_ns

    def receive() -> float:
        now, q = (script.obs.now_ns - begin) / 1e9, script.obs.q
        client.receive(now, {s: q[s] for s in plan.sides if s in q})
        return now

    while script.elapsed(phase) < operator.profile.duration:
        now = receive()
        commands = client.step(now, {}, operator.inputs(now, plan.sides))
        payloads = script.codec.encode(
            {s: [Motor(**m._asdict()) for m in motors] for s, motors in commands.items()}
        )
        # the next turn, without making up for turns that were missed
        tick = max(tick + period, script.obs.now_ns)
        while True:
            wakes = max(client.receiver.wakes_at, now + _POLL)
            wake = tick if math.isinf(wakes) else min(tick, begin + round(wakes * 1e9))
            yield from script.do(Send(payloads, wake))
            payloads = []
            if script.obs.now_ns >= tick:
                break
            now = receive()
    script.end(phase)
    script.next_ns = script.obs.now_ns
    last = script.obs.q
    script.goal.update({s: last[s] for s in plan.sides if s in last})


_PART = 0.75
"""Part of its nominal rate that the modelled client must reach; below it the hand is not judged."""


@dataclass(frozen=True)
class _OperatorFigures:
    """Measured figures of one side.

    :param client_hz: commands a second of the client in the phase.
    :param joints: those of the joints that the operator moves, by index.
    """

    begin: float
    end: float
    client_hz: float
    joints: dict[int, TrackingFigures]


def _operator_figures(recording: Recording, side: Side) -> _OperatorFigures | str:
    phases = recording.phases(OPERATOR, side)
    if not phases:
        return "no operator in this recording"
    phase, hand = phases[0], recording.sides[side]
    begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
    sent = hand.commands.t[(hand.commands.t >= begin) & (hand.commands.t <= end)]
    if len(sent) < 2:
        return (
            "Unitree's client sent no command: it waits for a state that it can use, of each hand"
        )
    operator = operator_of(phase, recording.dialect)
    joints = {}

    @cache  # every joint asks for the same times
    def pose_at(t: float) -> tuple[float, ...] | None:
        return operator.intent(t - begin, side)

    for i, joint in enumerate(hand.joints):

        def wanted(t: float, i: int = i) -> float | None:
            pose = pose_at(t)
            return None if pose is None else pose[i]

        figures = tracking_figures(
            hand.states.t, hand.states.q[:, i], wanted, joint.stroke, begin=begin, end=end
        )
        if figures.steps or figures.figures():
            joints[i] = figures
    return _OperatorFigures(begin, end, (len(sent) - 1) / float(sent[-1] - sent[0]), joints)


def _judge(
    ctx: Context,
    name: str,
    limit: str,
    value: Callable[[TrackingFigures], float],
    of_step: Callable[[Step], float] | None,
    text: Callable[[float], str],
    nothing: str,
) -> Outcome:
    """The joint with the worst figure against a tolerance."""
    side = ctx.side
    assert isinstance(side, Side), "these requirements are about hands"
    found = ctx.once("operator figures", lambda: _operator_figures(ctx.recording, side))
    if isinstance(found, str):
        return ctx.skipped(found)
    figures = {i: value(f) for i, f in found.joints.items()}
    figures = {i: x for i, x in figures.items() if not math.isnan(x)}
    if not figures:
        return ctx.skipped(nothing)
    joint = max(figures, key=lambda i: figures[i] / ctx.tolerance(limit, i))
    worst = figures[joint]
    values = {name: worst, "client_hz": found.client_hz}
    if name == "stroke_s":
        values["stroke_mean_s"] = found.joints[joint].stroke_mean_s
    if len(ctx.joints) > 1:
        values |= {f"{name}_{ctx.joints[i].name}": x for i, x in figures.items()}
    values = {k: v for k, v in values.items() if math.isfinite(v)}
    observed = ctx.named(text(worst), joint)
    if worst <= ctx.tolerance(limit, joint):
        return ctx.passed(text(worst), observed, **values)
    dialect = ctx.recording.dialect
    sides = tuple(Side) if dialect.commands_both else (side,)
    wanted = 1.0 / client_for(dialect, sides).period
    if found.client_hz < _PART * wanted:
        skipped = ctx.skipped(
            f"the kit's own client managed {found.client_hz:.0f} of {wanted:.0f} commands a "
            f"second: '{text(worst)}' may be its machine's fault; run again"
        )
        return replace(skipped, retry=True)
    places = [ctx.at(ctx.states.topic, found.begin, found.end)]
    if of_step is not None:
        steps = [s for s in found.joints[joint].steps if not of_step(s) < worst]
        places = [ctx.at(ctx.states.topic, s.at, s.end) for s in steps] or places
    size, how = (worst - ctx.tolerance(limit, joint)), "total" if of_step else "mean"
    if limit.endswith("_stroke"):
        size *= STROKE_S / ctx.joints[joint].stroke
    return ctx.failed(text(worst), observed, *places, **values).about(joint).if_late(size, how=how)


@check("DEX1-OPER-01", "DEX1-OPER-06", "DEX3-OPER-01")
def stroke(ctx: Context) -> Outcome:
    """Time of a full stroke."""

    def text(seconds: float) -> str:
        if math.isinf(seconds):
            return "the hand hardly moves"
        return f"full stroke {seconds:.2f} s"

    return _judge(
        ctx,
        "stroke_s",
        "max_stroke_s",
        lambda f: f.stroke_s,
        lambda s: s.stroke_s,
        text,
        "no step was long enough: something is in the way",
    )


@check("DEX1-OPER-02", "DEX3-OPER-02")
def lag(ctx: Context) -> Outcome:
    """Lag of the joint behind a slowly moving operator, seconds."""

    def text(seconds: float) -> str:
        if math.isinf(seconds):
            return "does not follow a slow motion"
        return f"lags {seconds * 1e3:.0f} ms"

    return _judge(
        ctx,
        "lag_s",
        "max_lag_s",
        lambda f: f.lag_s,
        None,
        text,
        "no slow motion was long enough",
    )


@check("DEX1-OPER-03", "DEX3-OPER-03")
def overshoot(ctx: Context) -> Outcome:
    """Overshoot of the joint beyond the operator's target."""
    return _judge(
        ctx,
        "overshoot_rad",
        "max_overshoot_stroke",
        lambda f: f.overshoot,
        lambda s: s.overshoot,
        lambda x: f"overshoots by {x:.3f} {ctx.unit}",
        "no step was completed",
    )


@check("DEX1-OPER-04", "DEX3-OPER-04")
def stuck(ctx: Context) -> Outcome:
    """Distance of the joint from the operator's target at rest."""
    return _judge(
        ctx,
        "stuck_rad",
        "max_stuck_stroke",
        lambda f: f.stuck,
        lambda s: s.stuck,
        lambda x: f"rests {x:.3f} {ctx.unit} off",
        "the hand came to rest after no step",
    )
