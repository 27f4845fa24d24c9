"""Plots over a whole run, for each hand: position, torque and intervals between states."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.results import RunResult, Verdict
from dexkit.conformance.report.labels import subject, whose
from dexkit.conformance.report.result_plots import command_and_state, operated, phase_bands
from dexkit.conformance.report.svg_charts import Band, Level, Line, chart, histogram
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.escaping import html as escape
from dexkit.hand import JointSpec

__all__ = ["run_plots"]


def run_plots(result: RunResult, view: Recording) -> str:
    """Plots of every judged hand, as HTML."""
    parts = [
        f"<h2>What the {subject(result, many=True)} did</h2>",
        '<p class="key"><span><i class="cmd"></i>command: the commanded position</span>'
        '<span><i class="state"></i>state: the reported position</span>'
        '<span><i class="force"></i>tau_est: the reported torque</span></p>',
    ]
    for side in view.judged:
        parts.append(_hand(result, view, view.sides[side]))
    return "".join(parts)


def _hand(result: RunResult, view: Recording, hand: SideView) -> str:
    name = whose(hand.side).capitalize()
    if not len(hand.states):
        return f"<h3>{name}</h3><p>No state of this {subject(result)} was received.</p>"
    gripper = len(hand.joints) == 1
    opening = f": opening (0 closed, {hand.joints[0].stroke:.2f} open)" if gripper else ""
    return "".join(
        [
            f"<h3>{name}{opening}</h3>",
            *(_joint(result, view, hand, index) for index in range(len(hand.joints))),
            _session(view, hand) if gripper else "",
            _operator(view, hand),
            _force(view, hand),
            _timing(view, hand),
        ]
    )


def _touch(view: Recording, hand: SideView) -> float | None:
    return view.stimulus.objects.get(hand.side) if view.stimulus else None


def _span(view: Recording) -> tuple[float, float]:
    return 0.0, max(view.duration, 0.1)


def _joint(result: RunResult, view: Recording, hand: SideView, index: int) -> str:
    joint, gripper = hand.joints[index], len(hand.joints) == 1
    name = "position" if gripper else joint.name
    figure = chart(
        f"{whose(hand.side)}, {name}: command and state over the whole run",
        command_and_state(hand, index),
        y_unit=view.unit,
        span=_span(view),
        bands=phase_bands(view, hand.side, label=gripper or index == 0) + _alarms(result, hand),
        levels=_felt(view, hand),
        height=220 if gripper else 130,
        include=(0.0, joint.stroke) if gripper else (joint.q_min, joint.q_max),
        legend=False,
        titled=False,
    )
    return (
        figure
        if gripper
        else f'<p class="joint"><b>{escape(name)}</b>{_way(joint, view.unit)}</p>{figure}'
    )


def _way(joint: JointSpec, unit: str) -> str:
    closing = {1: ", closes upwards", -1: ", closes downwards", 0: ""}[joint.closing]
    return f" ({joint.q_min:.2f} to {joint.q_max:.2f} {unit}{closing})"


def _felt(view: Recording, hand: SideView) -> list[Level]:
    """Position of a gripper's object; for other hands it is not a single angle."""
    touch = _touch(view, hand)
    return [Level(touch, "object")] if touch is not None and len(hand.joints) == 1 else []


def _session(view: Recording, hand: SideView) -> str:
    replay = view.phases("replay", hand.side)
    if not replay:
        return ""
    span = view.seconds(replay[0].begin_ns), view.seconds(replay[0].end_ns)
    session = replay[0].params.get("session", "session")
    return (
        f"<p class='lead'>The replayed session <code>{escape(session)}</code>, closer:</p>"
        + chart(
            f"{whose(hand.side)}, replayed session: command and state",
            command_and_state(hand, 0),
            y_unit=view.unit,
            span=span,
            levels=_felt(view, hand),
            include=(0.0, hand.joints[0].stroke),
            legend=False,
            titled=False,
        )
    )


def _operator(view: Recording, hand: SideView) -> str:
    """The first joint that the modelled operator moves."""
    phases = view.phases(OPERATOR, hand.side)
    if not phases:
        return ""
    span = view.seconds(phases[0].begin_ns), view.seconds(phases[0].end_ns)
    sent = hand.commands.q[(hand.commands.t >= span[0]) & (hand.commands.t <= span[1])]
    if len(sent) < 2:
        return ""
    moved = np.ptp(np.where(np.isfinite(sent), sent, 0.0), axis=0)
    return operated(view, hand, int(np.argmax(moved)), span)


def _force(view: Recording, hand: SideView) -> str:
    states, touch, gripper = hand.states, _touch(view, hand), len(hand.joints) == 1
    if gripper:
        held = (
            ""
            if touch is None
            else f" Something is between its fingers at {touch:.2f} {view.unit}."
        )
        text = f"Force (tau_est): negative is closing.{held}"
    else:
        held = (
            ""
            if touch is None
            else f" Something is between its fingers, at {touch:g} % of closing."
        )
        text = f"Torque (tau_est) of each joint.{held}"
    return f"<p>{text}</p>" + chart(
        f"{whose(hand.side)}: torque over the whole run",
        [Line("force", "force", states.t, states.tau[:, i]) for i in range(len(hand.joints))],
        y_unit=view.model.torque_unit,
        span=_span(view),
        bands=phase_bands(view, hand.side, label=False),
        height=130,
        include=(0.0,),
        legend=False,
        titled=False,
    )


def _timing(view: Recording, hand: SideView) -> str:
    clock = hand.states.clock
    intervals = np.diff(clock) * 1e3
    good = intervals > 0
    if len(intervals) <= 10 or not good.any():
        return ""
    slowest = 1e3 / view.model.min_state_rate
    levels = [Level(slowest, f"{slowest:g} ms: {view.model.min_state_rate:g} Hz")]
    return (
        "<p>Time from each state to the next. A good hand has one tall bar; the count axis is "
        "logarithmic, so that single late ones show.</p>"
        + histogram(
            f"{whose(hand.side)}: how often which interval between states",
            intervals[good],
            unit="ms",
            levels=levels,
            titled=False,
        )
        + chart(
            f"{whose(hand.side)}: intervals between states over the whole run",
            [Line("interval", "state", clock[1:][good], intervals[good])],
            y_unit="ms",
            span=_span(view),
            height=110,
            include=(0.0, slowest),
            legend=False,
            titled=False,
        )
    )


def _alarms(result: RunResult, hand: SideView) -> list[Band]:
    """Places of failures, in red."""
    return [
        Band("", e.time_s, e.end_s, "alarm")
        for r in result.results
        if r.side == str(hand.side) and r.verdict is Verdict.FAIL
        for e in r.evidence
        if e.end_s is not None and e.topic == hand.states.topic
    ]
