"""Look at the hands of each robot on a domain by themselves, without their prefix."""

from __future__ import annotations

from dataclasses import replace

from dexkit.doctor.catalogue import Finding
from dexkit.doctor.observations import DomainView, Observations
from dexkit.topics import HAND_TOPICS, prefixes_of, split_prefix, under_prefix

__all__ = ["by_prefix", "renamed"]

_LONGEST_FIRST = sorted(HAND_TOPICS, key=len, reverse=True)


def by_prefix(seen: Observations) -> list[tuple[str, Observations]]:
    """What was seen of each robot, its topics without their prefix; without a prefix first.

    The first has everything that is no hand's, too.
    """
    topics = {e.topic for view in seen.domains for e in view.endpoints}
    prefixes = [p for p in prefixes_of(topics) if p]
    if not prefixes:
        return [("", seen)]
    return [
        (prefix, replace(seen, domains=tuple(_part(view, prefix) for view in seen.domains)))
        for prefix in ("", *prefixes)
    ]


def _part(view: DomainView, prefix: str) -> DomainView:
    def is_of(topic: str) -> bool:
        own, bare = split_prefix(topic)
        return own == prefix and (not prefix or bare in HAND_TOPICS)

    endpoints = tuple(
        replace(e, topic=split_prefix(e.topic)[1]) for e in view.endpoints if is_of(e.topic)
    )
    streams = tuple(
        replace(s, topic=split_prefix(s.topic)[1]) for s in view.streams if is_of(s.topic)
    )
    return replace(view, endpoints=endpoints, streams=streams)


def renamed(finding: Finding, prefix: str) -> Finding:
    """A finding about topics without their prefix, with it."""

    def with_prefix(text: str) -> str:
        for topic in _LONGEST_FIRST:
            text = text.replace(topic, under_prefix(topic, prefix))
        return text

    where = {k: with_prefix(v) if isinstance(v, str) else v for k, v in finding.where.items()}
    return replace(
        finding, seen=with_prefix(finding.seen), fix=with_prefix(finding.fix), where=where
    )
