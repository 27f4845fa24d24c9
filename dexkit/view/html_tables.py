"""The tables of the page, as HTML. Everything that comes from the wire is escaped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dexkit.templates import Templates
from dexkit.watch import SubjectView, TopicView
from dexkit.watch.number_format import number, seconds

__all__ = ["hand_table", "time_strip", "topics_table"]

_WIDTH, _HEIGHT = 92, 12
_TEMPLATES = Templates(
    Path(__file__).parent / "templates",
    WIDTH=_WIDTH,
    HEIGHT=_HEIGHT,
    isfinite=math.isfinite,
    number=number,
    seconds=seconds,
)


@dataclass(frozen=True)
class _Row:
    """A joint.

    :param zero: pixels in the bar between its limits, of 0; None where that is not between them.
        Likewise ``target`` of the command and ``at`` of the position, None if not known.
    :param part: of its largest torque.
    """

    name: str
    fault: bool
    near: bool
    q: float
    command: float
    tau: float
    part: float
    celsius: str
    zero: float | None
    target: float | None
    at: float | None


def _row(view: SubjectView, i: int) -> _Row:
    joint = view.joints[i]

    def x(q: float) -> float | None:
        if not math.isfinite(q):
            return None
        return min(max((q - joint.q_min) / joint.stroke, -0.02), 1.02) * (_WIDTH - 4) + 2

    q, command, celsius = (float(v[i]) for v in (view.q, view.target, view.temperature))
    return _Row(
        name=joint.name,
        fault=int(view.fault[i]) != 0,
        near=int(view.near[i]) != 0,
        q=q,
        command=command,
        tau=float(view.tau[i]),
        part=float(view.torque_part[i]),
        celsius=f"{celsius:.0f}" if math.isfinite(celsius) and celsius else "",
        zero=x(0.0) if joint.q_min < 0 < joint.q_max else None,
        target=x(command),
        at=x(q),
    )


def hand_table(view: SubjectView, title: str) -> str:
    """The joints of a hand: position between the limits with the commanded one, torque, faults."""
    near = [
        f"{joint.name} {'upper' if n > 0 else 'lower'}"
        for joint, n in zip(view.joints, view.near.tolist(), strict=True)
        if n
    ]
    who = ", ".join(view.commanders) or "unknown process"
    if all(name == "?" for name in view.commanders):
        who = "a process that does not say its name"
    rows = [_row(view, i) for i in range(len(view.joints))]
    return _TEMPLATES.fill("hand.html", view=view, title=title, rows=rows, near=near, who=who)


def topics_table(views: Sequence[TopicView], title: str) -> str:
    """Rates, ages, gaps and missed cycles, and who publishes."""
    return _TEMPLATES.fill("topics.html", views=views, title=title)


def time_strip(
    marks: Sequence[tuple[float, float, str, str]], end: float, at: float, title: str
) -> str:
    """Phases, verdicts and the moment that is shown, over the time line.

    :param marks: (begin, end, kind, title) of each, seconds.
    """
    phases = [mark for mark in marks if mark[2] == "phase"]
    return _TEMPLATES.fill(
        "strip.html",
        title=title,
        at=at,
        end=end,
        scale=1000 / end if end > 0 else 0.0,
        phases=phases,
        others=[mark for mark in marks if mark[2] != "phase"],
        current=next((name for begin, stop, _, name in phases if begin <= at <= stop), ""),
    )
