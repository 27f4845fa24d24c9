"""Why a client and this service do not meet, from what discovery shows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from dexkit.hand import Side
from dexkit.models import DIALECTS, Dialect

__all__ = ["diagnose"]


class _Endpoint(Protocol):
    @property
    def topic(self) -> str: ...
    @property
    def type_name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def own(self) -> bool: ...


def diagnose(endpoints: Iterable[_Endpoint], dialect: Dialect, sides: Iterable[Side]) -> list[str]:
    """Sentences about clients that use another topic or type than those served here.

    A client on another topic or with another type gets no error and no data; it just waits.
    """
    foreign = [e for e in endpoints if not e.own]
    served = {}
    for side in sides:
        cmd, state = dialect.topics(side)
        served[cmd] = dialect.cmd_type
        served[state] = dialect.state_type
        if dialect.low_rate_topic:
            served[dialect.low_rate_topic.format(side=side)] = dialect.state_type
    found = []
    for topic, type_name in served.items():
        for foreign_type in sorted(
            {e.type_name for e in foreign if e.topic == topic} - {type_name}
        ):
            found.append(
                f"{topic}: a peer uses {foreign_type}, this service {type_name}; they never match"
                + _advice(topic, foreign_type)
            )
    foreign_topics = {e.topic for e in foreign}
    for other in DIALECTS.values():
        if other.model != dialect.model:
            continue
        pairs = {side: set(other.topics(side)) for side in Side}
        # a client of the other side is somebody else's business, unless the dialect differs
        shared = pairs[Side.LEFT] == pairs[Side.RIGHT]
        ours = dialect.topics(Side.LEFT) == dialect.topics(Side.RIGHT)
        if shared == ours:
            continue
        for topic in sorted(foreign_topics & (pairs[Side.LEFT] | pairs[Side.RIGHT])):
            types = {e.type_name for e in foreign if e.topic == topic}
            if types & {other.cmd_type, other.state_type}:
                found.append(
                    f"a peer is on {topic}, which is not served here. Try --dialect {other.name}"
                )
    written = {e.topic for e in foreign if e.kind == "writer"}
    read = {e.topic for e in foreign if e.kind == "reader"}
    others = {
        other.topics(side)[1]: other.model
        for other in DIALECTS.values()
        for side in Side
        if other.model != dialect.model
    }
    for topic in sorted((read - written) & set(others)):
        found.append(
            f"a peer waits on {topic}, the state of a {others[topic]}, which nobody publishes; "
            f"a {dialect.model} is served here"
        )
    return found


def _advice(topic: str, type_name: str) -> str:
    for candidate in DIALECTS.values():
        pairs = {
            pair
            for side in Side
            for pair in zip(
                candidate.topics(side), (candidate.cmd_type, candidate.state_type), strict=True
            )
        }
        if (topic, type_name) in pairs:
            return f". Try --dialect {candidate.name}"
    return ""
