"""From DDS into a recorder: which topics, which types, and what discovery saw meanwhile.

A plain DDS reader must know the type. Types come from discovery (any endpoint of a known type
on a wanted topic, reader or writer) and, for topics asked for by name on which there is nobody
yet, from the hand models, so that the reader is there before the writer: a controller that forks
never learns of readers that appear later (facts/unitree-dex B.7).
"""

from __future__ import annotations

import fnmatch
import threading
import time
from collections.abc import Callable, Iterable

from dexkit.dds import DdsNode, Endpoint, Qos, Reader
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import DIALECTS
from dexkit.traces.names import dds_topic
from dexkit.traces.recorder import Recorder

__all__ = ["DdsRecording", "record_topics"]

#: Samples that a reader keeps until they are taken; 2 s of a 500 Hz topic.
DEPTH = 1000
# Seconds between metadata records with the endpoints, at most; they change when a run starts.
_ENDPOINTS_EVERY = 0.25
# Seconds in which discovery may tell the type of a topic asked for by name; on one machine it takes
# a few tens of milliseconds.
_LOOK = 0.5
# Seconds after which the thread looks around although nothing woke it.
_IDLE = 0.1


class DdsRecording:
    """Puts the samples of a domain's topics into a recorder, in a thread; a context manager.

    :param node: give it one that nothing else uses: its own endpoints are taken for the
        recorder's and left out of the metadata record ``dds_endpoints``.
    :param recorder: open, and closed by whoever opened it, after this has stopped.
    :param topics: names in any spelling, or patterns; None for every topic whose type is known.
    :param types: DDS type names by topic, for topics that must be subscribed before discovery
        tells their type.

    Endpoints and their QoS are stored whenever they change, so a killed recording has them too.
    """

    def __init__(
        self,
        node: DdsNode,
        recorder: Recorder,
        topics: Iterable[str] | None = None,
        *,
        types: dict[str, str] | None = None,
    ) -> None:
        self.node = node
        self.recorder = recorder
        self._patterns = None if topics is None else [dds_topic(t) for t in topics]
        self._types = {dds_topic(t): name for t, name in (types or {}).items()}
        self._readers: dict[tuple[str, str], Reader] = {}
        self._known_channels: set[tuple[str, str]] = set()
        self._unknown: dict[str, str] = {}
        self._seen: dict[tuple[str, str], list[str]] = {}
        self._reliability: dict[tuple[str, str], str] = {}
        self._fresh: list[Endpoint] = []
        self._fresh_lock = threading.Lock()
        self._wake = threading.Event()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None
        self._unsubscribe: Callable[[], None] | None = None

    @property
    def subscribed(self) -> list[str]:
        """Topics that are being recorded, whether or not samples have come."""
        return sorted({topic for topic, _ in list(self._readers)})

    @property
    def unknown(self) -> dict[str, str]:
        """Wanted topics that cannot be recorded, with the type that dexkit does not know."""
        return dict(self._unknown)

    def start(self) -> None:
        """Subscribe and begin; waits up to half a second for the types of topics in use."""
        for topic, type_name in self._types.items():
            self._subscribe(topic, type_name)
        guesses = {t: _model_types(t) for t in self._patterns or () if t not in self._types}
        guesses = {topic: types for topic, types in guesses.items() if types}

        # readers of types that nobody uses look like peers of another dialect to a service
        def unused(endpoints: list[Endpoint]) -> set[str]:
            return guesses.keys() - {e.topic for e in endpoints if not e.own}

        self.node.discovery.wait(lambda endpoints: not unused(endpoints), timeout=_LOOK)
        for topic in sorted(unused(self.node.endpoints())):
            for type_name in guesses[topic]:
                self._subscribe(topic, type_name)
        self._unsubscribe = self.node.discovery.subscribe(
            lambda event: self._note(event.endpoint) if event.appeared else None
        )
        self._thread = threading.Thread(target=self._run, name="dds-recording", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take what has arrived, unsubscribe. May be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        if self._unsubscribe is not None:
            self._unsubscribe()
        self._stopping = True
        self._wake.set()
        thread.join()
        for reader in self._readers.values():
            reader.close()
        if self._error is not None:
            raise self._error

    def __enter__(self) -> DdsRecording:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _note(self, endpoint: Endpoint) -> None:
        # in the dispatcher's thread: only note it
        if not endpoint.own and not endpoint.topic.startswith("DCPS"):
            with self._fresh_lock:
                self._fresh.append(endpoint)
            self._wake.set()

    def _run(self) -> None:
        try:
            told = -_ENDPOINTS_EVERY
            changed = False
            while True:
                self._wake.wait(_IDLE)
                self._wake.clear()
                stopping = self._stopping
                changed |= self._discover()
                self._take()
                now = time.monotonic()
                if changed and (stopping or now - told >= _ENDPOINTS_EVERY):
                    self.recorder.add_metadata("dds_endpoints", self._endpoint_record())
                    told, changed = now, False
                if stopping:
                    return
        except Exception as error:  # raised by stop(), in the caller's thread
            self._error = error

    def _discover(self) -> bool:
        with self._fresh_lock:
            fresh, self._fresh = self._fresh, []
        changed = False
        for endpoint in fresh:
            text = _describe(endpoint)
            known = self._seen.setdefault((endpoint.topic, endpoint.kind), [])
            if text not in known:
                known.append(text)
                changed = True
            if endpoint.kind == "writer":
                key = (endpoint.topic, endpoint.type_name)
                self._reliability.setdefault(key, endpoint.qos.reliability)
            if self._wants(endpoint.topic):
                self._subscribe(endpoint.topic, endpoint.type_name)
        return changed

    def _wants(self, topic: str) -> bool:
        if self._patterns is None:
            return True
        return any(topic == p or fnmatch.fnmatchcase(topic, p) for p in self._patterns)

    def _subscribe(self, topic: str, type_name: str) -> None:
        if (topic, type_name) in self._readers:
            return
        try:
            kind = message_type(type_name)
        except UsageError:
            self._unknown[topic] = type_name
            return
        self._readers[topic, type_name] = self.node.reader(
            topic, kind, qos=Qos.reader_default(), depth=DEPTH, on_data=self._wake.set
        )

    def _take(self) -> None:
        for key, reader in self._readers.items():
            samples = reader.take()
            if not samples:
                continue
            topic, type_name = key
            if key not in self._known_channels:
                self._known_channels.add(key)
                self.recorder.add_channel(topic, type_name, self._channel_metadata(key))
            for sample in samples:
                # a writer may send no timestamp, which DDS gives as a negative number
                source = max(sample.source_timestamp_ns, 0)
                self.recorder.put(topic, type_name, sample.data, sample.reception_ns, source)

    def _channel_metadata(self, key: tuple[str, str]) -> dict[str, str]:
        metadata = {
            "dds.domain": str(self.node.domain),
            "recorder.qos.reliability": "best_effort",
            "recorder.qos.history": f"keep_last({DEPTH})",
        }
        if key in self._reliability:
            metadata["qos.reliability"] = self._reliability[key]
        return metadata

    def _endpoint_record(self) -> dict[str, str]:
        return {
            f"{topic} {kind}" + (f" {number}" if number > 1 else ""): text
            for (topic, kind), texts in self._seen.items()
            for number, text in enumerate(texts, 1)
        }


def record_topics(
    node: DdsNode,
    recorder: Recorder,
    topics: Iterable[str] | None = None,
    *,
    types: dict[str, str] | None = None,
    stop: threading.Event | None = None,
    duration: float | None = None,
    on_tick: Callable[[DdsRecording], None] | None = None,
    tick: float = 0.5,
) -> DdsRecording:
    """Record until ``stop`` is set or ``duration`` seconds have passed.

    :param on_tick: called every ``tick`` seconds, in the calling thread.
    :returns: the recording, stopped: what it subscribed and what it could not.
    :raises UsageError: neither ``stop`` nor ``duration`` would ever end it.
    """
    if stop is None and duration is None:
        raise UsageError("a recording needs a duration or something that stops it")
    stop = stop if stop is not None else threading.Event()
    recording = DdsRecording(node, recorder, topics, types=types)
    end = None if duration is None else time.monotonic() + duration
    with recording:
        while recorder.error is None:
            left = tick if end is None else min(tick, end - time.monotonic())
            if left <= 0 or stop.wait(left):
                break
            if on_tick is not None:
                on_tick(recording)
    return recording


def _model_types(topic: str) -> list[str]:
    """The types that a hand model has on ``topic``, in any of its dialects."""
    found = []
    for dialect in DIALECTS.values():
        for side in Side:
            cmd, state = dialect.topics(side)
            if topic == cmd:
                found.append(dialect.cmd_type)
            if topic == state:
                found.append(dialect.state_type)
    return list(dict.fromkeys(found))


def _describe(endpoint: Endpoint) -> str:
    """An endpoint as the sample recordings describe theirs, with its type added."""
    qos = endpoint.qos
    durability = "".join(word.capitalize() for word in qos.durability.split("_"))
    history = "KeepAll" if qos.depth is None else f"KeepLast(depth={qos.depth})"
    return (
        f"{qos.reliability}, Durability.{durability}, History.{history}, type={endpoint.type_name}"
    )
