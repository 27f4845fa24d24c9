"""See one robot's part of a recording as if its topics had no prefix."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from dexkit.errors import UsageError
from dexkit.topics import HAND_TOPICS, prefixes_of, split_prefix

if TYPE_CHECKING:
    from dexkit.conformance.kit.recording import TraceLike
    from dexkit.traces.reader import ChannelInfo, SampleArray, TraceEndpoint

__all__ = ["Unprefixed", "choose_prefix"]


def choose_prefix(topics: Iterable[str], wanted: str = "") -> str:
    """The prefix of the hands to judge: the one asked for, else the only one there is.

    Hands without a prefix go first, as they did before there were prefixes.

    :raises UsageError: no hand has the prefix, or there are several robots to choose from.
    """
    found = prefixes_of(topics)
    if wanted:
        if wanted not in found:
            there = ", ".join(p or "none" for p in found) or "no hand at all"
            raise UsageError(f"no hand has the prefix {wanted}", hint=f"prefixes: {there}")
        return wanted
    if not found or "" in found:
        return ""
    if len(found) > 1:
        raise UsageError(
            f"there are hands of several robots: {', '.join(found)}",
            hint=f"choose one: --prefix {found[0]}",
        )
    return found[0]


class Unprefixed:
    """The part of a recording under a prefix; what is no hand's stays as it is.

    A :class:`~dexkit.conformance.kit.recording.TraceLike`.
    """

    def __init__(self, trace: TraceLike, prefix: str) -> None:
        self._trace = trace
        self._names: dict[str, str] = {}  # as judged: as recorded
        for topic in {c.topic for c in trace.channels} | {e.topic for e in trace.endpoints}:
            own, bare = split_prefix(topic)
            if own == prefix or bare not in HAND_TOPICS:
                self._names[bare] = topic
        self.prefix = prefix
        self.metadata = trace.metadata
        self.warnings = trace.warnings
        self.mixed_types = {split_prefix(t)[1]: why for t, why in trace.mixed_types.items()}
        self.truncated = trace.truncated
        self.clock_steps = trace.clock_steps

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel that is left."""
        bare = {recorded: judged for judged, recorded in self._names.items()}
        return [replace(c, topic=bare[c.topic]) for c in self._trace.channels if c.topic in bare]

    @property
    def endpoints(self) -> list[TraceEndpoint]:
        """Every endpoint that is left."""
        bare = {recorded: judged for judged, recorded in self._names.items()}
        return [replace(e, topic=bare[e.topic]) for e in self._trace.endpoints if e.topic in bare]

    def load(
        self, topics: Iterable[str] | None = None, *, decode: bool = False
    ) -> dict[str, SampleArray]:
        """Samples by topic, as :meth:`~dexkit.traces.Trace.load`."""
        wanted = self._names if topics is None else topics
        names = {self._names.get(topic, topic): topic for topic in wanted}
        loaded = self._trace.load(list(names), decode=decode)
        return {
            names[topic]: replace(samples, topic=names[topic])
            for topic, samples in loaded.items()
            if topic in names
        }
