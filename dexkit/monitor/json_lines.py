"""Format the monitor's data as JSON lines, without I/O."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

from dexkit.hand import Floats
from dexkit.watch import Picture, SubjectView, TopicView
from dexkit.watch.events import Event

__all__ = ["FORMAT", "json_line"]

FORMAT = 1
"""Number of the format; a key that is added does not change it."""


def json_line(picture: Picture, events: Iterable[Event], time_ns: int) -> str:
    """One line: the moment's topics and hands, and the events since the line before.

    Units are SI: seconds, radians, N·m. What is not known is null.
    """
    return json.dumps(
        {
            "format": FORMAT,
            "time_ns": time_ns,
            "topics": [_topic(view) for view in picture.topics],
            "subjects": [_subject(view) for view in picture.subjects],
            "events": [
                {"kind": e.kind, "text": e.text, "ago": _number(picture.at - e.at)} for e in events
            ],
        },
        ensure_ascii=True,
        allow_nan=False,
    )


def _number(value: float, digits: int = 6) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


def _numbers(values: Floats) -> list[float | None]:
    return [_number(v) for v in values.tolist()]


def _topic(view: TopicView) -> dict[str, object]:
    return {
        "topic": view.name,
        "type": view.type_name,
        "role": view.role,
        "rate": _number(view.rate, 2),
        "expected": view.expected or None,
        "age": _number(view.age),
        "samples": view.samples,
        "gaps": view.gaps,
        "missed": view.missed,
        "longest_gap": _number(view.longest),
        "writers": view.writers,
        "publishers": list(view.publishers),
        "subscribers": list(view.subscribers),
        "undecodable": view.undecodable,
    }


def _subject(view: SubjectView) -> dict[str, object]:
    near: Sequence[int] = view.near.tolist()
    return {
        "subject": str(view.subject),
        "prefix": view.prefix,
        "model": view.model.name,
        "dialect": view.dialect,
        "joints": [joint.name for joint in view.joints],
        "stale": view.stale,
        "age": _number(view.age),
        "command_age": _number(view.command_age),
        "q": _numbers(view.q),
        "dq": _numbers(view.dq),
        "tau": _numbers(view.tau),
        "temperature": _numbers(view.temperature),
        "target": _numbers(view.target),
        "near_limit": near,
        "faults": view.faults,
        "pressure": _numbers(view.pressure),
        "pressure_change": _numbers(view.pressure_change),
        "touch": _numbers(view.touch),
        "commanders": list(view.commanders),
    }
