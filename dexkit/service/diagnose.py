"""Find peers that do not match this service, from DDS discovery."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from dexkit.hand import Side
from dexkit.models import Dialect
from dexkit.topics import Role, roles, split_prefix, topics_of, under_prefix

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
    types: dict[str, set[str]] = {}
    for endpoint in foreign:
        types.setdefault(endpoint.topic, set()).add(endpoint.type_name)
    ours = list(topics_of(dialect))
    whose = set(sides)
    found = []
    for topic, role in ours:
        if not whose & set(role.sides):
            continue
        for foreign_type in sorted(types.get(topic, set()) - {role.type_name}):
            found.append(
                f"{topic}: a peer uses {foreign_type}, this service {role.type_name}; "
                "they never match" + _advice(roles(topic, foreign_type))
            )
    # a client of the other side belongs to another service, unless its dialect puts both sides
    # in one topic and this one does not, or the other way round
    together = any(len(role.sides) > 1 for _, role in ours)
    for topic in sorted(types):
        for role in roles(topic):
            if (
                role.dialect.model == dialect.model
                and role.type_name in types[topic]
                and (len(role.sides) > 1) != together
            ):
                found.append(
                    f"a peer is on {topic}, which is not served here."
                    f" Try --dialect {role.dialect.name}"
                )
    prefix = split_prefix(ours[0][0])[0]
    bare = {under_prefix(split_prefix(topic)[1], prefix) for topic, _ in ours}
    for topic in sorted(types):
        theirs, plain = split_prefix(topic)
        if theirs != prefix and under_prefix(plain, prefix) in bare:
            found.append(
                f"a peer is on {topic}; this hand is on {under_prefix(plain, prefix)} "
                "(--prefix, or that of the client)"
            )
    written = {e.topic for e in foreign if e.kind == "writer"}
    for topic in sorted({e.topic for e in foreign if e.kind == "reader"} - written):
        models = [r.dialect.model for r in roles(topic) if r.kind != "cmd"]
        if models and dialect.model not in models:
            found.append(
                f"a peer waits on {topic}, the state of a {models[0]}, which no process publishes; "
                f"a {dialect.model} is served here"
            )
    return found


def _advice(others: Sequence[Role]) -> str:
    return f". Try --dialect {others[0].dialect.name}" if others else ""
