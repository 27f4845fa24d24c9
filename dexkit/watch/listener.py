"""Feed a collector from a DDS domain: a pure listener, which publishes nothing."""

from __future__ import annotations

import fnmatch
import threading
from collections.abc import Iterable

from dexkit.dds import DdsNode, DiscoveryEvent, Endpoint, Qos, Reader
from dexkit.errors import DdsError, UsageError
from dexkit.messages import message_type
from dexkit.topics import HAND_TOPICS, split_prefix
from dexkit.watch.collector import Collector

__all__ = ["Listener"]

_MOST_WAITING = 20_000  # samples of a topic between two polls
_MOST_TOPICS = 64  # besides those of hands


def _is_hand(topic: str) -> bool:
    return split_prefix(topic)[1] in HAND_TOPICS


class Listener:
    """Reads every topic whose type is known, best-effort, and has no writer. A context manager.

    A topic is read as soon as anybody announces it, be it as its reader. So the commands of a
    client that forks (docs/sources/unitree-dex.md#b7) are seen if a service was there before it.

    :param node: give it one that nothing else uses; who makes it closes it.
    :param topics: only these, patterns allowed; None for all.

    :ivar unknown: why a topic that was announced is not read.
    """

    def __init__(
        self, node: DdsNode, collector: Collector, topics: Iterable[str] | None = None
    ) -> None:
        self.node = node
        self.collector = collector
        self.unknown: dict[str, str] = {}
        self._patterns = None if topics is None else list(topics)
        self._readers: dict[tuple[str, str], Reader] = {}
        self._events: list[DiscoveryEvent] = []
        self._lock = threading.Lock()
        self._unsubscribe = node.discovery.subscribe(self._note)

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Read no more."""
        self._unsubscribe()
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()

    @property
    def dropped(self) -> int:
        """Samples that came between two polls and found no room."""
        return sum(r.refused for r in self._readers.values())

    def poll(self) -> int:
        """Pass on the samples since the last call; returns their number.

        :raises DdsError: DDS no longer works.
        """
        with self._lock:
            events, self._events = self._events, []
        for event in events:
            self._endpoint(event)
        count = 0
        for (topic, type_name), reader in self._readers.items():
            samples = reader.take()
            if samples:
                count += len(samples)
                self.collector.take(
                    topic,
                    type_name,
                    [s.data for s in samples],
                    [s.reception_ns for s in samples],
                    [s.source_timestamp_ns for s in samples],
                    [s.writer % 2**62 for s in samples],
                )
        return count

    def _note(self, event: DiscoveryEvent) -> None:
        # in the dispatcher's thread: only stored
        if not event.endpoint.own and not event.endpoint.topic.startswith("DCPS"):
            with self._lock:
                self._events.append(event)

    def _endpoint(self, event: DiscoveryEvent) -> None:
        found = event.endpoint
        if not event.appeared:
            self.collector.endpoint_gone(found.key)
            return
        if not self._wanted(found.topic):
            return
        self.collector.endpoint(found.key, found.topic, found.kind, found.process)
        self._subscribe(found)

    def _wanted(self, topic: str) -> bool:
        patterns = self._patterns
        return patterns is None or any(fnmatch.fnmatchcase(topic, p) for p in patterns)

    def _subscribe(self, found: Endpoint) -> None:
        key = (found.topic, found.type_name)
        if key in self._readers:
            return
        others = sum(not _is_hand(topic) for topic, _ in self._readers)
        if not _is_hand(found.topic) and others >= _MOST_TOPICS:
            self.unknown[found.topic] = f"no more than {_MOST_TOPICS} other topics are read"
            return
        try:
            kind = message_type(found.type_name)
        except UsageError:
            self.unknown[found.topic] = f"unknown type {found.type_name}"
            return
        try:
            self._readers[key] = self.node.reader(
                found.topic, kind, qos=Qos.reader_default(), most=_MOST_WAITING
            )
        except DdsError as error:  # a name that DDS does not allow, and a peer has all the same
            self.unknown[found.topic] = str(error)
