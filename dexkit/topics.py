"""The hand topics of all dialects, with their dialect and side."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.models import DIALECTS, Dialect

__all__ = [
    "HAND_TOPICS",
    "Role",
    "checked_prefix",
    "prefixes_of",
    "roles",
    "split_prefix",
    "topics_of",
    "under_prefix",
]

_PREFIX = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


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


def checked_prefix(text: str) -> str:
    """A prefix as people write it (``r2``, ``/r2``, ``rt/r2/``), without ``rt`` and slashes.

    :raises UsageError: it cannot be a part of a topic's name.
    """
    bare = text.strip("/").removeprefix("rt/")
    if bare == "rt" or not _PREFIX.fullmatch(bare):
        raise UsageError(
            f"{text!r} is no prefix of topics", hint="letters, digits and _, for example r2"
        )
    return bare


def under_prefix(topic: str, prefix: str) -> str:
    """``rt/dex3/left/cmd`` under the prefix ``r2``: ``rt/r2/dex3/left/cmd``."""
    return f"rt/{prefix}/{topic.removeprefix('rt/')}" if prefix else topic


def split_prefix(topic: str) -> tuple[str, str]:
    """The prefix of a hand's topic and the topic without it; of other topics ``""`` and itself.

    Robots that share a domain put their hands under names of their own: ``rt/r2/dex3/left/cmd``
    is ``("r2", "rt/dex3/left/cmd")``.
    """
    root, *parts = topic.split("/")
    if root != "rt" or topic in HAND_TOPICS:
        return "", topic
    for i in range(1, len(parts)):
        bare = "/".join([root, *parts[i:]])
        if bare in HAND_TOPICS:
            # a copy at a low rate is no other robot
            return ("", topic) if parts[i - 1] == "lf" else ("/".join(parts[:i]), bare)
    return "", topic


def prefixes_of(topics: Iterable[str]) -> list[str]:
    """The prefixes under which hands are, sorted; ``""`` for hands without one."""
    split = map(split_prefix, topics)
    return sorted({prefix for prefix, bare in split if bare in HAND_TOPICS})
