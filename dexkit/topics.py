"""The hand topics of all dialects, with their dialect and side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from dexkit.hand import Side
from dexkit.models import DIALECTS, Dialect

__all__ = ["HAND_TOPICS", "Role", "roles", "topics_of"]


@dataclass(frozen=True)
class Role:
    """The role of a topic in a dialect: state or command, and its sides.

    :param kind: ``"cmd"``, ``"state"``, ``"low"`` (the low-rate copy of the state) or ``"touch"``
        (tactile areas).
    :param sides: whose; both where they share it.
    """

    dialect: Dialect
    kind: str
    sides: tuple[Side, ...]
    type_name: str


def topics_of(dialect: Dialect) -> Iterator[tuple[str, Role]]:
    """Each topic of a dialect and its role."""
    sides: dict[tuple[str, str, str], list[Side]] = {}
    for side in Side:
        cmd, state = dialect.topics(side)
        sides.setdefault((cmd, "cmd", dialect.cmd_type), []).append(side)
        sides.setdefault((state, "state", dialect.state_type), []).append(side)
        if dialect.low_rate_topic:
            low = dialect.low_rate_topic.format(side=side)
            sides.setdefault((low, "low", dialect.state_type), []).append(side)
        if touch := dialect.touch_topic_of(side):
            sides.setdefault((touch, "touch", dialect.touch_type), []).append(side)
    for (topic, kind, type_name), whose in sides.items():
        yield topic, Role(dialect, kind, tuple(whose), type_name)


def _table() -> dict[str, list[Role]]:
    table: dict[str, list[Role]] = {}
    for dialect in DIALECTS.values():
        for topic, role in topics_of(dialect):
            table.setdefault(topic, []).append(role)
    return table


_TABLE = _table()

HAND_TOPICS = frozenset(_TABLE)
"""The topics of every dialect."""


def roles(topic: str, type_name: str | None = None) -> list[Role]:
    """The roles of a topic in each dialect that has it, of one type or any."""
    return [r for r in _TABLE.get(topic, []) if type_name in (None, r.type_name)]
