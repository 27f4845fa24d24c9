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

from dexkit.conformance.checks import STROKE_S, Context, Late, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
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


def _measured(
    ctx: Context,
    name: str,
    limit: str,
    text: Callable[[float], str],
    of_joint: Callable[[TrackingFigures], float],
    of_step: Callable[[Step], float] | None = None,
) -> Figures:
    """A figure of each step of each joint, or of each joint over the whole phase.

    Where the kit's own client was slow, a figure beyond its limit may be its machine's fault.
    """
    side = ctx.side
    assert isinstance(side, Side), "these requirements are about hands"
    found = ctx.once("operator figures", lambda: _operator_figures(ctx.recording, side))
    if isinstance(found, str):
        yield ctx.skipped(found)
        return
    known = {i: x for i, f in found.joints.items() if not math.isnan(x := of_joint(f))}
    if slow := [x for i, x in known.items() if x > ctx.tolerance(limit, i)]:
        spoken = ctx.recording.dialect
        wanted = 1.0 / client_for(spoken, tuple(Side) if spoken.commands_both else (side,)).period
        if found.client_hz < _PART * wanted:
            skipped = ctx.skipped(
                f"the kit's own client managed {found.client_hz:.0f} of {wanted:.0f} commands a "
                f"second: '{text(max(slow))}' may be its machine's fault; run again"
            )
            yield replace(skipped, retry=True)
    values = {"client_hz": found.client_hz}
    if len(ctx.joints) > 1:
        values |= {f"{name}_{ctx.joints[i].name}": x for i, x in known.items()}
    for i in known:
        figures, more = found.joints[i], dict(values)
        if name == "stroke_s":
            more["stroke_mean_s"] = figures.stroke_mean_s
        places = [(of_joint(figures), found.begin, found.end)]
        if of_step is not None:
            places = [(of_step(s), s.at, s.end) for s in figures.steps]
        for value, begin, end in places:
            if not math.isnan(value):
                late = value - ctx.tolerance(limit, i)
                if limit.endswith("_stroke"):
                    late *= STROKE_S / ctx.joints[i].stroke
                yield Figure(
                    value,
                    begin,
                    end,
                    i,
                    text(value),
                    shown=text(value),
                    late=Late((max(0.0, late),), "total" if of_step else "mean"),
                    values={k: v for k, v in more.items() if math.isfinite(v)},
                )


@check("DEX1-OPER-01", "DEX3-OPER-01")
def by_teleoperation(ctx: Context) -> Outcome:
    """What an operator notices; a stroke that no operator can use fails a MUST, where a model has
    a limit for it.
    """
    noticed = [_stroke(ctx, "max_stroke_s"), _lag(ctx), _overshoot(ctx), _stuck(ctx)]
    parts = [warning(part) for part in noticed]
    if "unusable_stroke_s" in ctx.requirement.tolerances:
        parts.insert(0, _stroke(ctx, "unusable_stroke_s"))
    # the kit's own client was too slow to tell
    return next((part for part in parts if part.retry), all_of(*parts))


def _stroke(ctx: Context, limit: str) -> Outcome:
    """Time of a full stroke."""

    def text(seconds: float) -> str:
        return "the hand hardly moves" if math.isinf(seconds) else f"full stroke {seconds:.2f} s"

    figures = _measured(ctx, "stroke_s", limit, text, lambda f: f.stroke_s, lambda s: s.stroke_s)
    nothing = "no step was long enough: something is in the way"
    return judged(ctx, figures, "stroke_s", limit, nothing=nothing)


@worst("lag_s", "max_lag_s", nothing="no slow motion was long enough")
def _lag(ctx: Context) -> Figures:
    """Lag of the joint behind a slowly moving operator, seconds."""

    def text(seconds: float) -> str:
        if math.isinf(seconds):
            return "does not follow a slow motion"
        return f"lags {seconds * 1e3:.0f} ms"

    return _measured(ctx, "lag_s", "max_lag_s", text, lambda f: f.lag_s)


@worst("overshoot_rad", "max_overshoot_stroke", nothing="no step was completed")
def _overshoot(ctx: Context) -> Figures:
    """Overshoot of the joint beyond the operator's target."""
    return _measured(
        ctx,
        "overshoot_rad",
        "max_overshoot_stroke",
        lambda x: f"overshoots by {x:.3f} {ctx.unit}",
        lambda f: f.overshoot,
        lambda s: s.overshoot,
    )


@worst("stuck_rad", "max_stuck_stroke", nothing="the hand came to rest after no step")
def _stuck(ctx: Context) -> Figures:
    """Distance of the joint from the operator's target at rest."""
    return _measured(
        ctx,
        "stuck_rad",
        "max_stuck_stroke",
        lambda x: f"rests {x:.3f} {ctx.unit} off",
        lambda f: f.stuck,
        lambda s: s.stuck,
    )
