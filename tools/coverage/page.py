"""The page of what is covered: grids of phases by members, and the holes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from dexkit.conformance.kit.requirements import Level
from dexkit.models import ModeByte, model
from tools.coverage.measure import COMMANDED, STATE, Covered, Measured, Sent

__all__ = ["page"]

_OTHER = "other members"
_WHOLE = "(whole recording)"
_CLIENTS = {"operator": "Unitree's client, closed loop", "replay": "a recorded session"}
"""Who sends in a phase, if not the kit's own script."""
_HEAD = """# What the requirements cover

What each check reads of a run of the reference, and what is sent there: measured (`make coverage`),
not declared. A cell has the MUSTs and, after the stroke, the other requirements that read a member
in a phase; the last row is of requirements that look at the whole recording. "sent" is the source
timestamp, "t" the time of reception.
"""


def page(found: Iterable[Measured]) -> str:
    """Markdown of all dialects."""
    parts = [_HEAD]
    for each in found:
        parts += _of_dialect(each)
    return "\n".join(parts) + "\n"


def _of_dialect(found: Measured) -> Iterable[str]:
    dialect, covered, sent = found.dialect, found.covered, found.sent
    title = f"{model(dialect.model).title}, {dialect.name}"
    read = {name for each in covered for name in each.members}
    others = sorted({_open(name) for name in read - set(STATE)})
    columns = [name for name in STATE if name in read] + ([_OTHER] if others else [])
    yield f"## {title}\n"
    yield "| phase | " + " | ".join(columns) + " |"
    yield "| --- |" + " --- |" * len(columns)
    for phase in (*sent, _WHOLE):
        about = [c for c in covered if phase in c.phases or (phase == _WHOLE and not c.phases)]
        cells = [_count(about, column) for column in columns]
        if any(cells):
            yield f"| {phase} | " + " | ".join(cells) + " |"
    if others:
        yield f"\nOther members: {', '.join(f'`{name}`' for name in others)}."
    yield from _sent_table(covered, sent)
    yield "\n**Holes.**\n"
    holes = list(_holes(found))
    yield from (f"- {hole}" for hole in holes or ["none found"])
    yield ""


def _count(covered: Sequence[Covered], column: str) -> str:
    def reads(each: Covered) -> bool:
        return bool(each.members - set(STATE)) if column == _OTHER else column in each.members

    levels = [each.requirement.level for each in covered if reads(each)]
    must = levels.count(Level.MUST)
    return f"{must} / {len(levels) - must}" if levels else ""


def _sent_table(covered: Sequence[Covered], sent: Mapping[str, Sent]) -> Iterable[str]:
    yield "\n| phase | who sends | Hz | fields other than 0 | mode bytes | judged by |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, each in sent.items():
        judged = sum(name in c.phases for c in covered)
        fields = ", ".join(f for f in COMMANDED if f in each.filled)
        modes = ", ".join(f"0x{m:02x}" for m in sorted(each.modes)[:8])
        more = f" and {len(each.modes) - 8} more" if len(each.modes) > 8 else ""
        hertz = "" if math.isnan(each.hertz) else f"{each.hertz:.0f}"
        who = _CLIENTS.get(name, "the kit") if fields or modes else "nobody"
        yield f"| {name} | {who} | {hertz} | {fields} | {modes}{more} | {judged or ''} |"


def _holes(found: Measured) -> Iterable[str]:
    dialect, covered, sent = found.dialect, found.covered, found.sent
    if found.unread:
        yield f"read by no requirement: {', '.join(f'`{path}`' for path in found.unread)}"
    filled = {name for each in sent.values() for name in each.filled}
    if dialect.gains_are_used and (never := [f for f in COMMANDED if f not in filled]):
        yield f"never commanded: {', '.join(never)}"
    asked = {phase for each in covered for phase in each.phases}
    if idle := [name for name in sent if name not in asked]:
        yield f"phases that no requirement asks for, or that only move the hand: {', '.join(idle)}"
    if dialect.mode_byte is ModeByte.RIS:
        modes = {mode for each in sent.values() for mode in each.modes}
        if absent := sorted(set(range(8)) - {mode >> 4 & 7 for mode in modes}):
            yield f"status values of the mode byte that are never sent: {absent}"
    for phase, who in _CLIENTS.items():
        if phase not in sent:
            yield f"{who} never drives it"
    yield "clients that only `make consequences` drives: LeRobot's, Unitree's example"


def _open(path: str) -> str:
    """A path without the numbers of its elements."""
    return re.sub(r"\[\d+\]", "[]", path)
