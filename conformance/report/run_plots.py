"""Plots over a whole run, for each hand: position, torque and intervals between states."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from dexkit.conformance.behaviours.operator import OPERATOR
from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.results import RunResult, Verdict
from dexkit.conformance.report.charts import Band, Chart, Level, Line, histogram
from dexkit.conformance.report.labels import whose
from dexkit.conformance.report.result_plots import command_and_state, followed, phase_bands
from dexkit.hand import JointSpec

__all__ = ["run_plots"]


def run_plots(result: RunResult, view: Recording) -> list[dict[str, Any]]:
    """What ``templates/result.html`` shows of every judged hand."""
    hands = [view.sides[side] for side in view.judged]
    return [_hand(result, view, hand) for hand in hands]


def _hand(result: RunResult, view: Recording, hand: SideView) -> dict[str, Any]:
    name = whose(hand.side)
    if not len(hand.states):
        return {"name": name, "gripper": False, "joints": [], "closer": [], "operator": []}
    replay = view.phases("replay", hand.side)
    return {
        "name": name,
        "gripper": len(hand.joints) == 1,
        "opens": hand.joints[0].stroke,
        "joints": [
            (joint.name, _way(joint, view.unit), _joint(result, view, hand, index))
            for index, joint in enumerate(hand.joints)
        ],
        "session": replay[0].params.get("session", "session") if replay else "",
        "closer": list(_session(view, hand)),
        "operator": list(_operator(view, hand)),
        "touch": _touch(view, hand),
        "unit": view.unit,
        "torque": Chart(
            f"{name}: torque over the whole run",
            [Line("force", "force", hand.states.t, tau) for tau in hand.states.tau.T],
            _span(view),
            view.model.torque_unit,
            bands=phase_bands(view, hand.side, label=False),
            include=(0.0,),
            height=130,
            bare=True,
        ),
        "timing": list(_timing(view, hand)),
    }


def _touch(view: Recording, hand: SideView) -> float | None:
    return view.stimulus.objects.get(hand.side) if view.stimulus else None


def _span(view: Recording) -> tuple[float, float]:
    return 0.0, max(view.duration, 0.1)


def _way(joint: JointSpec, unit: str) -> str:
    closing = {1: ", closes upwards", -1: ", closes downwards", 0: ""}[joint.closing]
    return f" ({joint.q_min:.2f} to {joint.q_max:.2f} {unit}{closing})"


def _joint(result: RunResult, view: Recording, hand: SideView, index: int) -> Chart:
    joint, gripper = hand.joints[index], len(hand.joints) == 1
    return Chart(
        f"{whose(hand.side)}, {'position' if gripper else joint.name}: command and state over the "
        "whole run",
        command_and_state(hand, index),
        _span(view),
        view.unit,
        bands=phase_bands(view, hand.side, label=index == 0) + _failures(result, hand),
        levels=_felt(view, hand),
        include=(0.0, joint.stroke) if gripper else (joint.q_min, joint.q_max),
        height=220 if gripper else 130,
        bare=True,
    )


def _felt(view: Recording, hand: SideView) -> list[Level]:
    """Position of a gripper's object; for other hands it is not a single angle."""
    touch = _touch(view, hand)
    return [Level(touch, "object")] if touch is not None and len(hand.joints) == 1 else []


def _failures(result: RunResult, hand: SideView) -> list[Band]:
    """Places of failures, in red."""
    return [
        Band("", e.time_s, e.end_s, "alarm")
        for r in result.results
        if r.side == str(hand.side) and r.verdict is Verdict.FAIL
        for e in r.evidence
        if e.end_s is not None and e.topic == hand.states.topic
    ]


def _session(view: Recording, hand: SideView) -> Iterator[Chart]:
    """A gripper's replayed session."""
    replay = view.phases("replay", hand.side)
    if replay and len(hand.joints) == 1:
        yield Chart(
            f"{whose(hand.side)}, replayed session: command and state",
            command_and_state(hand, 0),
            (view.seconds(replay[0].begin_ns), view.seconds(replay[0].end_ns)),
            view.unit,
            levels=_felt(view, hand),
            include=(0.0, hand.joints[0].stroke),
            bare=True,
        )


def _operator(view: Recording, hand: SideView) -> Iterator[Chart]:
    """The first joint that the modelled operator moves."""
    for phase in view.phases(OPERATOR, hand.side)[:1]:
        begin, end = view.seconds(phase.begin_ns), view.seconds(phase.end_ns)
        sent = hand.commands.q[(hand.commands.t >= begin) & (hand.commands.t <= end)]
        if len(sent) > 1:
            moved = np.ptp(np.where(np.isfinite(sent), sent, 0.0), axis=0)
            yield followed(view, hand, int(np.argmax(moved)), (begin, end), ())


def _timing(view: Recording, hand: SideView) -> Iterator[Chart]:
    """Intervals between states, by length and over time."""
    clock = hand.states.clock
    intervals = np.diff(clock) * 1e3
    good = intervals > 0
    if len(intervals) <= 10 or not good.any():
        return
    name, least = whose(hand.side), view.model.min_state_rate
    slowest = 1e3 / least
    yield histogram(
        f"{name}: how often which interval between states",
        intervals[good],
        "ms",
        [Level(slowest, f"{slowest:g} ms: {least:g} Hz")],
        bare=True,
    )
    yield Chart(
        f"{name}: intervals between states over the whole run",
        [Line("interval", "state", clock[1:][good], intervals[good])],
        _span(view),
        "ms",
        include=(0.0, slowest),
        height=110,
        bare=True,
    )
