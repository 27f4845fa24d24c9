"""Record DDS topics: subscribe, pass samples to a recorder, and store the endpoints seen.

A DDS reader needs the topic's type. Types come from discovery (any reader or writer of a known type
on a wanted topic) and, for topics asked for by name without endpoints yet, from the hand models, so
that the reader exists before the writer: a controller that forks never discovers later readers
(docs/sources/unitree-dex.md#b7).
"""

from __future__ import annotations

import fnmatch
import logging
import threading
import time
from collections.abc import Callable, Iterable
from functools import cache, partial
from typing import Literal

from dexkit.dds import DdsNode, Endpoint, Qos, Reader
from dexkit.errors import DdsError, UsageError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.messages.codec import HEADER
from dexkit.models import DIALECTS
from dexkit.socket_losses import ReceiveBuffers
from dexkit.threads import Worker
from dexkit.topics import HAND_TOPICS, split_prefix
from dexkit.traces.losses import Losses
from dexkit.traces.names import dds_topic
from dexkit.traces.recorder import Recorder

__all__ = ["DdsRecording", "record_topics"]

_log = logging.getLogger(__name__)

#: Samples that a reader keeps until they are taken; 40 s of a 500 Hz topic.
MOST = 20_000
#: Socket receive buffer requested from the system, bytes: 3 s of ten such topics.
RECEIVE_BUFFER = 16 * 2**20
#: Discovered topics that are subscribed at most, hand topics not counted.
MAX_TOPICS = 256
# Descriptions of endpoints that are kept.
_MAX_SEEN = 1000
# Seconds between checks for losses, and between loss records in the file.
_LOSS_CHECK_INTERVAL = 0.25
_LOSS_RECORD_INTERVAL = 2.0
# Seconds between metadata records with the endpoints, at most; they change when a run starts.
_ENDPOINTS_INTERVAL = 0.25
# Seconds to wait for discovery of the type of a topic asked for by name; on one machine it takes
# a few tens of milliseconds.
_DISCOVERY_WAIT = 0.5
# Seconds between calls of on_tick.
_TICK = 0.5
# Seconds between checks of the thread when no sample wakes it.
_IDLE = 0.1
# Seconds by which this thread is late from which on it is told.
_LATE = 0.01


class DdsRecording:
    """Puts the samples of a domain's topics into a recorder, in a thread; a context manager.

    :param node: give it one that nothing else uses: its own endpoints are taken for the
        recorder's and left out of the metadata record ``dds_endpoints``.
    :param recorder: open, and closed by whoever opened it, after this has stopped.
    :param topics: names in any spelling, or patterns; None for every topic whose type is known.
    :param types: DDS type names by topic, for topics that must be subscribed before discovery
        tells their type.
    :param max_topics: how many discovered topics are subscribed.
    :param poll: look for samples every so many seconds, instead of whenever one arrives: fewer
        turns where thousands arrive a second. Times of reception are up to so much later then.
    :param on_late: only with ``poll``: called from the recording's thread with begin and end, ns
        since the epoch, of each time in which it did not look for samples, and the seconds that
        this was too long. What was received meanwhile has the time of the end.
    :param fresh: nothing uses the topics yet, so that no type has to be waited for.

    Endpoints and their QoS, and what was lost, are stored whenever they change, so that a killed
    recording contains them.

    :ivar losses: samples missing in the recording.
    """

    def __init__(
        self,
        node: DdsNode,
        recorder: Recorder,
        topics: Iterable[str] | None = None,
        *,
        types: dict[str, str] | None = None,
        max_topics: int = MAX_TOPICS,
        poll: float | None = None,
        on_late: Callable[[int, int, float], None] | None = None,
        fresh: bool = False,
    ) -> None:
        if on_late is not None and poll is None:
            raise UsageError("only a recording that polls can tell when it was late")
        self.node = node
        self._poll = poll
        self._discovery_wait = 0.0 if fresh else _DISCOVERY_WAIT
        self._on_late = on_late
        self.recorder = recorder
        self.losses = Losses()
        self._sockets = ReceiveBuffers(node.domain)
        self._max_topics = max_topics
        self._described = 0
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
        self._thread: Worker | None = None
        self._unsubscribe: Callable[[], None] | None = None

    @property
    def subscribed(self) -> list[str]:
        """Topics that are being recorded, with or without samples so far."""
        return sorted({topic for topic, _ in list(self._readers)})

    @property
    def unknown(self) -> dict[str, str]:
        """Reason for each wanted topic that cannot be recorded."""
        return dict(self._unknown)

    @property
    def failure(self) -> Exception | None:
        """The error that ended the recording before it was stopped, or None."""
        return self._thread.failure if self._thread is not None else None

    def start(self) -> None:
        """Subscribe and begin; waits up to half a second for the types of topics in use."""
        for topic, type_name in self._types.items():
            self._subscribe(topic, type_name)
        guesses = {t: _model_types(t) for t in self._patterns or () if t not in self._types}
        guesses = {topic: types for topic, types in guesses.items() if types}

        # to a service, a reader of an unused type looks like a peer of another dialect
        def unused(endpoints: list[Endpoint]) -> set[str]:
            return guesses.keys() - {e.topic for e in endpoints if not e.own}

        self.node.discovery.wait(
            lambda endpoints: not unused(endpoints), timeout=self._discovery_wait
        )
        for topic in sorted(unused(self.node.endpoints())):
            for type_name in guesses[topic]:
                self._subscribe(topic, type_name)
        self._unsubscribe = self.node.discovery.subscribe(
            lambda event: self._on_endpoint(event.endpoint) if event.appeared else None
        )
        if (size := self._sockets.enlarge(RECEIVE_BUFFER)) > 0:
            self.recorder.add_metadata("dexkit_recorder", {"receive_buffer": str(size)})
        self._thread = Worker("recording", self._run)
        self._thread.start()

    def stop(self) -> None:
        """Read the remaining samples and unsubscribe. May be called twice.

        :raises DexkitError: the error that ended the recording before.
        """
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
        thread.check()

    def __enter__(self) -> DdsRecording:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _on_endpoint(self, endpoint: Endpoint) -> None:
        # this runs in the discovery dispatcher's thread, so it only stores the endpoint
        if not endpoint.own and not endpoint.topic.startswith("DCPS"):
            with self._fresh_lock:
                self._fresh.append(endpoint)
            self._wake.set()

    def _run(self) -> None:
        told = looked = noted = float("-inf")
        changed = news = False
        turn, turn_ns = time.monotonic(), time.time_ns()
        while True:
            if self._poll is None:
                self._wake.wait(_IDLE)
                self._wake.clear()
            else:
                time.sleep(self._poll)
            stopping = self._stopping
            before, before_ns = turn, turn_ns
            turn, turn_ns = time.monotonic(), time.time_ns()
            if self._on_late is not None and self._poll is not None:
                late = turn - before - self._poll
                if late > _LATE:
                    self._on_late(before_ns, turn_ns, late)
            pause = self.losses.note_loop(time.clock_gettime(time.CLOCK_BOOTTIME), time.time_ns())
            if pause is not None:
                _log.warning("%s", pause)
            changed |= self._discover()
            self._read_samples()
            now = time.monotonic()
            if stopping or pause is not None or now - looked >= _LOSS_CHECK_INTERVAL:
                looked = now
                news |= self._count_losses(now) or pause is not None
                if stopping or (news and now - noted >= _LOSS_RECORD_INTERVAL):
                    self.recorder.add_metadata("dexkit_recorder", self.losses.metadata())
                    noted, news = now, False
            if changed and (stopping or now - told >= _ENDPOINTS_INTERVAL):
                self.recorder.add_metadata("dds_endpoints", self._endpoint_record())
                told, changed = now, False
            if stopping:
                return

    def _count_losses(self, now: float) -> bool:
        refused: dict[str, int] = {}
        for (topic, _), reader in self._readers.items():
            if count := reader.refused:
                refused[topic] = refused.get(topic, 0) + count
        lost: dict[str, int] = {}
        for (topic, _), reader in self._readers.items():
            if count := reader.lost:
                lost[topic] = lost.get(topic, 0) + count
        return self.losses.update(now, self._sockets.count_new_drops(), refused, lost)

    def _discover(self) -> bool:
        with self._fresh_lock:
            fresh, self._fresh = self._fresh, []
        changed = False
        for endpoint in fresh:
            text = _describe(endpoint)
            known = self._seen.get((endpoint.topic, endpoint.kind), [])
            if text not in known and self._described < _MAX_SEEN:
                self._described += 1
                self._seen[endpoint.topic, endpoint.kind] = [*known, text]
                changed = True
            if endpoint.kind == "writer" and len(self._reliability) < _MAX_SEEN:
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
        if (topic, type_name) in self._readers or len(self._unknown) >= _MAX_SEEN:
            return
        named = (
            split_prefix(topic)[1] in HAND_TOPICS
            or topic in (self._patterns or ())
            or topic in self._types
        )
        if not named and len(self._readers) >= self._max_topics:
            self._unknown[topic] = f"no more than {self._max_topics} topics are recorded"
            return
        try:
            kind = message_type(type_name)
        except UsageError:
            self._unknown[topic] = f"unknown type {type_name}"
            return
        try:
            self._readers[topic, type_name] = self.node.reader(
                topic,
                kind,
                qos=Qos.reader_default(),
                most=MOST,
                on_data=self._wake.set if self._poll is None else None,
                polled=self._poll is not None,
            )
        except DdsError as error:  # a name that DDS does not allow, although a peer uses it
            self._unknown[topic] = str(error)

    def _read_samples(self) -> None:
        for key, reader in self._readers.items():
            samples = reader.take()
            if not samples:
                continue
            topic, type_name = key
            if key not in self._known_channels:
                self._known_channels.add(key)
                self.recorder.add_channel(topic, type_name, self._channel_metadata(key))
            tick = _tick_of(type_name) if topic.endswith("state") else None
            for sample in samples:
                # a writer may send no timestamp, which DDS gives as a negative number
                source = max(sample.source_timestamp_ns, 0)
                self.losses.note_sample(topic, sample.writer, source)
                if tick is not None:
                    self.losses.note_state(topic, sample.writer, tick(sample.data) or source)
                self.recorder.put(topic, type_name, sample.data, sample.reception_ns, source)

    def _channel_metadata(self, key: tuple[str, str]) -> dict[str, str]:
        metadata = {
            "dds.domain": str(self.node.domain),
            "recorder.qos.reliability": "best_effort",
            "recorder.qos.history": f"keep_all, at most {MOST} waiting",
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
    stop: threading.Event | None = None,
    duration: float | None = None,
    on_tick: Callable[[DdsRecording], None] | None = None,
) -> DdsRecording:
    """Record until ``stop`` is set or ``duration`` seconds have passed.

    :param on_tick: called twice a second, in the calling thread.
    :returns: the recording, stopped: what it subscribed and what it could not.
    :raises UsageError: neither ``stop`` nor ``duration`` would ever end it.
    """
    if stop is None and duration is None:
        raise UsageError("a recording needs a duration or a stop event")
    stop = stop if stop is not None else threading.Event()
    recording = DdsRecording(node, recorder, topics)
    end = None if duration is None else time.monotonic() + duration
    with recording:
        while recorder.error is None:
            left = _TICK if end is None else min(_TICK, end - time.monotonic())
            if left <= 0 or stop.wait(left):
                break
            if on_tick is not None:
                on_tick(recording)
    return recording


@cache
def _tick_of(type_name: str) -> Callable[[bytes], int]:
    """Returns a function that reads the writer's clock, ns, from a sample's bytes.

    It gives 0 where the message has none.
    """
    struct = message_type(type_name).layout
    offset = 0
    if struct.is_fixed:
        for leaf in struct.leaves():
            start = -(-offset // leaf.type.size) * leaf.type.size
            if leaf.path == ("tick",):
                return partial(_tick, start + len(HEADER))
            offset = start + leaf.type.size * leaf.count
    return lambda data: 0


def _tick(at: int, data: bytes) -> int:
    if len(data) < at + 4:
        return 0
    order: Literal["little", "big"] = "little" if data[1] & 1 else "big"
    return int.from_bytes(data[at : at + 4], order) * 1_000_000  # ms


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
