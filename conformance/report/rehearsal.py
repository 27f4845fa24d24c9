"""The page of a rehearsed replay: findings, figures of every joint, and their plots."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

from dexkit import __version__
from dexkit.conformance.report.charts import Band, Chart, Level, Line
from dexkit.conformance.report.pages import fill
from dexkit.conformance.virtual.rehearsal import Rehearsal, Rehearsed
from dexkit.hand import Side
from dexkit.models import model
from dexkit.traces.replay.machine import End, Phase
from dexkit.traces.replay.prepare import Level as Grade
from dexkit.traces.replay.prepare import Prepared, joint_limits

__all__ = ["render"]

_CSS = {
    Grade.NOTE: "dim",
    Grade.CURED: "ok",
    Grade.ACCEPTED: "warn",
    Grade.REFUSED: "bad",
}
_STILL = 0.02
"""Part of the stroke below which a joint is not drawn: neither commanded nor moved."""


def render(prepared: Prepared, rehearsal: Rehearsal, *, source: str, options: str) -> str:
    """The page as text; it loads nothing.

    :param source: the session, as it was named.
    :param options: how it was played, as on the command line.
    """
    css, answer, about = _answer(prepared, rehearsal)
    return fill(
        "rehearsal.html",
        title=f"Rehearsal of {rehearsal.plan.name}",
        css=css,
        answer=answer,
        about=about,
        session=rehearsal.plan.name,
        known=_facts(rehearsal, source, options),
        findings=prepared.findings,
        GRADES=_CSS,
        hands=[_hand(rehearsal, side) for side in rehearsal.plan.sides],
    )


def _answer(prepared: Prepared, rehearsal: Rehearsal) -> tuple[str, str, str]:
    """Class, title and reason of the answer."""
    if prepared.refused:
        names = ", ".join(dict.fromkeys(f.name for f in prepared.refused))
        about = f"Refused for: {names}. What follows is what would happen otherwise."
        return "bad", "It is refused", about
    if rehearsal.machine.end is End.DONE:
        return "ok", "It can be played", "The emulated hand has played it to the end."
    return "bad", "It would be stopped", rehearsal.machine.reason


def _facts(rehearsal: Rehearsal, source: str, options: str) -> dict[str, str]:
    plan, machine = rehearsal.plan, rehearsal.machine
    spoken = plan.dialect
    return {
        "session": source,
        "hands": f"{model(spoken.model).title}, {', '.join(map(str, plan.sides))} ({spoken.name})",
        "commands": f"{plan.commands:,} in {plan.duration:.2f} s",
        "options": options or "none",
        "ramp": f"{machine.guards.ramp_speed:g} rad/s",
        "ended": machine.reason,
        "dexkit": __version__,
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _hand(rehearsal: Rehearsal, side: Side) -> dict[str, object]:
    """Plots of a hand, and the figures of each joint with its largest torque."""
    hand = rehearsal.hands[side]
    limits = joint_limits(rehearsal.plan.dialect, side)
    bands = [
        Band(str(phase), begin, end)
        for phase, begin, end in rehearsal.phases
        if phase is not Phase.PLAY and end - begin > 0.05
    ]
    figures = [*zip(hand.figures(limits.tau), limits.tau.tolist(), strict=True)]
    if len(hand.t) < 2:
        return {"side": side, "figures": figures, "plots": []}
    span = (0.0, float(hand.t[-1]))
    plots = _overview(rehearsal, hand, span, bands)
    drawn = _drawn(hand, limits.stroke.tolist())
    for j in drawn:
        q = hand.q[:, j]
        middle = float(np.median(q))
        room = 0.05 * float(limits.stroke[j])
        plots.append(
            Chart(
                f"{side} {hand.names[j]}: command and emulated position",
                [Line("command", "cmd", hand.t, hand.command[:, j]), Line("q", "state", hand.t, q)],
                span=span,
                y_unit="rad",
                bands=bands,
                height=150,
                include=(middle - room, middle + room),
            )
        )
    return {
        "side": side,
        "figures": figures,
        "plots": plots,
        "still": [name for j, name in enumerate(hand.names) if j not in drawn],
    }


def _drawn(hand: Rehearsed, strokes: Sequence[float]) -> list[int]:
    """The joints that are commanded to move, or move; all of a gripper."""
    if len(hand.names) == 1:
        return [0]
    q = hand.q
    command = hand.command[np.isfinite(hand.command).all(axis=1)]
    moved = np.maximum(np.ptp(q, axis=0), np.ptp(command, axis=0) if len(command) else 0.0)
    return [j for j, stroke in enumerate(strokes) if moved[j] > _STILL * stroke]


def _overview(
    rehearsal: Rehearsal, hand: Rehearsed, span: tuple[float, float], bands: Sequence[Band]
) -> list[Chart]:
    """The largest distance from a command, and the largest torque, over time."""
    limits = joint_limits(rehearsal.plan.dialect, hand.side)
    machine = rehearsal.machine
    away = np.abs(hand.command - hand.q)
    part = 100 * (away / np.array(machine.farthest_allowed(hand.side))).max(axis=1)
    stopped = Level(100.0, f"stopped beyond, for {machine.guards.distance_time:g} s")
    torque = 100 * (np.abs(hand.tau) / limits.tau).max(axis=1)
    return [
        Chart(
            f"{hand.side} hand: distance from the command, of the farthest joint",
            [Line("distance", "state", hand.t, part)],
            span=span,
            y_unit="% of allowed",
            bands=bands,
            levels=[stopped],
            height=140,
            include=(0.0,),
        ),
        Chart(
            f"{hand.side} hand: torque, of the joint nearest to its largest one",
            [Line("torque", "force", hand.t, torque)],
            span=span,
            y_unit="% of largest",
            bands=bands,
            height=140,
            include=(0.0, 10.0),
        ),
    ]
