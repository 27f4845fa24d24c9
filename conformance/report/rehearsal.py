"""The page of a rehearsed replay: findings, figures of every joint, and their plots."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

from dexkit import __version__
from dexkit.conformance.report.pages import document
from dexkit.conformance.report.svg_charts import Band, Level, Line, chart
from dexkit.conformance.report.tables import no_wrap, table
from dexkit.conformance.virtual.rehearsal import JointFigures, Rehearsal, Rehearsed
from dexkit.escaping import html as escape
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
    sections = [
        _head(prepared, rehearsal),
        _facts(rehearsal, source, options),
        _findings(prepared),
        *(_hand(rehearsal, side) for side in rehearsal.plan.sides),
        "<p class='dim'>The emulator is the model's reference hand: its motors obey the law of the "
        "commands, with inertia, friction and stops that are tuned and not measured, and no "
        "object. A real hand differs.</p>",
    ]
    return document(f"Rehearsal of {rehearsal.plan.name}", "".join(sections))


def _head(prepared: Prepared, rehearsal: Rehearsal) -> str:
    refused, machine = prepared.refused, rehearsal.machine
    if refused:
        css, title = "bad", "It is refused"
        text = "Refused for: " + ", ".join(dict.fromkeys(f.name for f in refused))
        text += ". What follows is what would happen otherwise."
    elif machine.end is End.DONE:
        css, title = "ok", "It can be played"
        text = "The emulated hand has played it to the end."
    else:
        css, title = "bad", "It would be stopped"
        text = machine.reason
    return (
        f'<header class="verdict {css}"><p class="question">Rehearsal of a replay</p>'
        f"<h1>{title}<small>{escape(rehearsal.plan.name)}</small></h1>"
        f"<p>{escape(text)}</p></header>"
    )


def _facts(rehearsal: Rehearsal, source: str, options: str) -> str:
    plan, machine = rehearsal.plan, rehearsal.machine
    spoken = plan.dialect
    rows = {
        "session": source,
        "hands": f"{model(spoken.model).title}, {', '.join(map(str, plan.sides))} ({spoken.name})",
        "commands": f"{plan.commands:,} in {plan.duration:.2f} s",
        "options": options or "none",
        "ramp": f"{machine.guards.ramp_speed:g} rad/s",
        "ended": machine.reason,
        "dexkit": __version__,
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    cells = "".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in rows.items())
    return f'<dl class="facts">{cells}</dl>'


def _findings(prepared: Prepared) -> str:
    if not prepared.findings:
        return "<h2>Findings</h2><p>Nothing was found.</p>"
    rows = [
        (
            no_wrap(f"<code>{escape(f.name)}</code>"),
            no_wrap(f'<b class="{_CSS[f.level]}">{f.level}</b>'),
            no_wrap(escape(f.where)),
            escape(f.text),
            no_wrap(f"<code>{escape(f.option)}</code>") if f.option else escape(f.advice),
        )
        for f in prepared.findings
    ]
    return "<h2>Findings</h2>" + table(("finding", "verdict", "hand", "what", "cure"), rows)


def _hand(rehearsal: Rehearsal, side: Side) -> str:
    hand = rehearsal.hands[side]
    limits = joint_limits(rehearsal.plan.dialect, side)
    figures = hand.figures(limits.tau)
    bands = [
        Band(str(phase), begin, end)
        for phase, begin, end in rehearsal.phases
        if phase is not Phase.PLAY and end - begin > 0.05
    ]
    parts = [f"<h2>{str(side).capitalize()} hand</h2>"]
    if figures:
        parts.append(_figures(figures, limits.tau.tolist()))
    if len(hand.t) < 2:
        return "".join([*parts, "<p>It was not played.</p>"])
    span = (0.0, float(hand.t[-1]))
    parts.append(_overview(rehearsal, hand, span, bands))
    drawn = _drawn(hand, limits.stroke.tolist())
    for j in drawn:
        q = hand.q[:, j]
        middle = float(np.median(q))
        room = 0.05 * float(limits.stroke[j])
        parts.append(
            chart(
                f"{side} {hand.names[j]}: command and emulated position",
                [Line("command", "cmd", hand.t, hand.command[:, j]), Line("q", "state", hand.t, q)],
                y_unit="rad",
                span=span,
                bands=bands,
                height=150,
                include=(middle - room, middle + room),
            )
        )
    rest = [name for j, name in enumerate(hand.names) if j not in drawn]
    if rest:
        parts.append(f"<p>Neither commanded to move nor moved: {escape(', '.join(rest))}.</p>")
    return "".join(parts)


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
) -> str:
    """The largest distance from a command, and the largest torque, over time."""
    limits = joint_limits(rehearsal.plan.dialect, hand.side)
    machine = rehearsal.machine
    away = np.abs(hand.command - hand.q)
    part = 100 * (away / np.array(machine.farthest_allowed(hand.side))).max(axis=1)
    stopped = Level(100.0, f"stopped beyond, for {machine.guards.distance_time:g} s")
    torque = 100 * (np.abs(hand.tau) / limits.tau).max(axis=1)
    return chart(
        f"{hand.side} hand: distance from the command, of the farthest joint",
        [Line("distance", "state", hand.t, part)],
        y_unit="% of allowed",
        span=span,
        bands=bands,
        levels=[stopped],
        height=140,
        include=(0.0,),
    ) + chart(
        f"{hand.side} hand: torque, of the joint nearest to its largest one",
        [Line("torque", "force", hand.t, torque)],
        y_unit="% of largest",
        span=span,
        bands=bands,
        height=140,
        include=(0.0, 10.0),
    )


def _figures(figures: Sequence[JointFigures], tau_max: Sequence[float]) -> str:
    rows = [
        (
            no_wrap(escape(f.name)),
            f"{f.commanded:.2f}",
            f"{f.moved:.2f}",
            f"{f.rms:.3f}",
            f"{f.worst:.3f} at {f.at:.2f} s",
            f"{f.speed:.1f}",
            f"{f.torque:.2f} of {most:.2f}",
            f"{f.ripple:.3f}",
            f"{f.limit:.1%}",
        )
        for f, most in zip(figures, tau_max, strict=True)
    ]
    heads = (
        "joint",
        "commanded over, rad",
        "moved over, rad",
        "rms distance, rad",
        "largest distance, rad",
        "fastest, rad/s",
        "largest torque, N·m",
        "torque ripple rms, N·m",
        "time at largest torque",
    )
    return table(heads, rows)
