"""Write recordings: a bounded queue, a writer thread, and a file that survives a killed process.

The receiver of samples calls :meth:`Recorder.put`, which only appends to a queue. When the disk
is slower than the samples, the queue fills up to its bound and further samples are dropped and
counted, so recording never slows down what is recorded. Every :data:`FLUSH_INTERVAL` the received
samples are written as a complete chunk and handed to the operating system: killing the
process (SIGKILL included) costs the last moments, not the file, as long as the writer keeps up
with the queue. A power cut may cost more, since nothing is forced onto the disk. A sample that
counts as written is in the file: :mod:`~dexkit.traces.recording_file` commits whole chunks or
nothing.

The bounds hold for all samples that are not written yet, those that the writer works on included.
After a stall the memory of the backlog is given back to the system.

Schemas are ``ros2msg`` and the profile is ``ros2``, because that is what PlotJuggler, Foxglove
and the readers of ROS 2 bags open; topics keep their DDS names (``rt/...``).
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from pathlib import Path
from typing import BinaryIO, NamedTuple, cast

from mcap.writer import CompressionType, Writer

from dexkit import __version__
from dexkit.errors import TraceError, UsageError
from dexkit.messages import MessageType, message_type
from dexkit.threads import Worker
from dexkit.traces.heap import release_freed_memory
from dexkit.traces.recording_file import ChunkIndexes, RecordingFile

__all__ = ["FLUSH_INTERVAL", "MAX_CHANNELS", "Recorder"]

#: Seconds between complete chunks in the file; less than half of the half second that may be lost.
FLUSH_INTERVAL = 0.2
# Longest sleep of the writer, seconds, and queued messages that wake it.
_POLL = 0.05
_WAKE_AT = 512
# Messages taken from the queue at a time, and bytes of them, between two readings of the clock.
_SLICE = 4096
_SLICE_BYTES = 2**20
# A backlog whose memory is given back, bytes; and those of a queued message beside its payload.
_BACKLOG = 8 * 2**20
_OVERHEAD = 256
# Bytes after which a chunk is written before its time.
_COMMIT_AT = 4 * 2**20
#: Channels, each a topic with a type, in one file: their ids are 16-bit numbers from 1 on.
MAX_CHANNELS = 2**16 - 1
# mcap times are unsigned 64-bit numbers
_TIMES = 2**64

_COMPRESSION = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class _Item(NamedTuple):
    channel: _Channel
    data: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


class _Metadata(NamedTuple):
    name: str
    values: dict[str, str]


class _Foreign(NamedTuple):
    """A type that is not one of dexkit's DDS types."""

    name: str
    ros_name: str
    ros2msg: str


class _Channel:
    """One topic and type; its mcap id once the writer has registered it."""

    def __init__(self, topic: str, kind: MessageType | _Foreign, metadata: dict[str, str]) -> None:
        self.topic = topic
        self.kind = kind
        self.metadata = metadata
        self.id = 0
        self.offered = 0
        self.dropped = 0
        self.pending = 0  # given to the writer, not yet on the disk
        self.written = 0


class Recorder:
    """Records samples to an mcap file; a context manager.

    :param path: the file to write.
    :param overwrite: replace an existing file, as soon as there is a message to replace it by.
    :param keep_empty: keep a recording without messages; otherwise no file is left, and an existing
        one stays.
    :param max_messages: bound of the queue, messages.
    :param max_bytes: bound of the queue, bytes of payload.
    :param compression: ``"zstd"``, ``"lz4"`` or ``"none"``.
    :param metadata: goes into the metadata record ``dexkit_recorder``, with what the recorder
        adds: version, messages, drops.
    :raises UsageError: the file exists and ``overwrite`` is False, a bound makes no sense, or
        ``metadata`` holds anything but texts.

    Each message's mcap sequence number counts what was offered on its topic, so a dropped sample
    is also visible as a gap in the numbers.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        keep_empty: bool = True,
        max_messages: int = 200_000,
        max_bytes: int = 128 * 2**20,
        compression: str = "zstd",
        metadata: dict[str, str] | None = None,
    ) -> None:
        if compression not in _COMPRESSION:
            raise UsageError(f"compression must be one of {', '.join(_COMPRESSION)}")
        if max_messages < 1 or max_bytes < 1:
            raise UsageError("the recorder's queue must hold at least one message and one byte")
        self.path = Path(path)
        self._overwrite = overwrite
        self._keep_empty = keep_empty
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._compression = _COMPRESSION[compression]
        self._about = {"version": __version__, **_check_metadata("metadata", metadata or {})}
        self._lock = threading.Lock()
        self._queue: deque[_Item | _Metadata] = deque()
        # of messages not written yet, those that the writer holds included
        self._queued = 0
        self._queued_bytes = 0
        self._backlog = 0  # most of them, bytes with overhead, since memory was given back
        self._channels: dict[tuple[str, str], _Channel] = {}
        self._wake = threading.Event()
        self._closing = False
        self._thread: Worker | None = None
        self._file = RecordingFile(self.path, overwrite=overwrite)
        self._error: Exception | None = None
        self._written = 0

    # -- counters ---------------------------------------------------------------------

    @property
    def written(self) -> int:
        """Messages that are in the file: they can be read even if the process is killed now."""
        return self._written

    @property
    def dropped(self) -> int:
        """Messages dropped because the queue was full or the disk failed.

        After :meth:`close`: messages offered that are not in the file.
        """
        with self._lock:
            return sum(c.dropped for c in self._channels.values())

    @property
    def offered(self) -> dict[str, int]:
        """Messages offered so far by topic, dropped ones included."""
        counts: Counter[str] = Counter()
        with self._lock:
            for channel in self._channels.values():
                counts[channel.topic] += channel.offered
        return dict(counts)

    @property
    def displaced(self) -> str:
        """What happened to the file's name while it was written, or empty."""
        return self._file.displaced

    @property
    def error(self) -> Exception | None:
        """Why writing has stopped, or None."""
        return self._error

    # -- opening and closing
    # ----------------------------------------------------------------------------------

    def open(self) -> None:
        """Create the file and start the writer.

        :raises UsageError: the file exists and must not be overwritten, or is being recorded.
        :raises TraceError: it cannot be created.
        """
        if self._thread is not None:
            raise UsageError(f"{self.path} is already being recorded")
        self._file.open()
        # with the data section's checksum, every byte of a finished recording is under one
        self._writer = Writer(
            cast(BinaryIO, self._file), compression=self._compression, enable_data_crcs=True
        )
        if self._file.readable:
            # a private attribute of the library; without it memory grows, but the recording is the
            # same
            vars(self._writer)["_Writer__chunk_indices"] = ChunkIndexes(self._file)
        self._schema_ids: dict[str, int] = {}
        self._thread = Worker("recorder", self._run, failed=self._failed)
        self._thread.start()

    def close(self) -> None:
        """Write the queued messages, finish the file. May be called twice.

        :raises TraceError: writing failed; what was written before can be read.
        """
        thread = self._thread
        if thread is None or self._closing:
            return
        with self._lock:
            self._closing = True
        self._wake.set()
        thread.join()
        error = self._error
        if isinstance(error, TraceError):
            raise error
        if error is not None:
            reason = error.strerror if isinstance(error, OSError) else f"{error!r}"
            kept = f"{self._written} messages were written and can be read; {self.dropped} were not"
            raise TraceError(
                f"recording to {self.path} stopped: {reason or error}", hint=kept
            ) from error

    def __enter__(self) -> Recorder:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # -- from any thread -----------------------------------------------------------------------

    def add_channel(
        self, topic: str, type_name: str, metadata: dict[str, str] | None = None
    ) -> None:
        """Announce a topic, with metadata for its channel. :meth:`put` does so by itself.

        :raises UsageError: dexkit does not know the type, a text is not one that a file can
            hold, or there are :data:`MAX_CHANNELS` channels already.
        """
        kind = message_type(type_name)
        values = _check_metadata(f"metadata of {topic!r}", metadata or {})
        self._add(type_name, _Channel(topic, kind, {"dds.type": kind.name, **values}))

    def add_foreign_channel(self, topic: str, ros_name: str, ros2msg: str) -> None:
        """Announce a topic that is not on DDS; :meth:`put` then takes its type by ``ros_name``.

        :param ros_name: name of the type, ``dexkit_usb/msg/Transfer``.
        :param ros2msg: its definition. Payloads are CDR, as for every other topic.
        :raises UsageError: as for :meth:`add_channel`.
        """
        _check_text("the name of a type", ros_name)
        _check_text(f"the definition of {ros_name}", ros2msg)
        self._add(ros_name, _Channel(topic, _Foreign(ros_name, ros_name, ros2msg), {}))

    def _add(self, type_name: str, channel: _Channel) -> None:
        _check_text("a topic", channel.topic)
        key = (channel.topic, type_name)
        with self._lock:
            if key not in self._channels and len(self._channels) >= MAX_CHANNELS:
                raise UsageError(f"a recording holds {MAX_CHANNELS} channels at most")
            self._channels.setdefault(key, channel)

    def put(
        self,
        topic: str,
        type_name: str,
        data: bytes,
        log_time_ns: int,
        publish_time_ns: int = 0,
    ) -> bool:
        """Queue one sample; returns at once.

        :param data: the payload as on the wire: encapsulation header, then CDR.
        :param log_time_ns: reception, ns since the epoch.
        :param publish_time_ns: DDS source timestamp, ns since the epoch; 0 if unknown.
        :returns: False when it was dropped.
        :raises UsageError: a time is not one, or as for :meth:`add_channel`.
        """
        if not (0 <= log_time_ns < _TIMES and 0 <= publish_time_ns < _TIMES):
            raise UsageError(f"not times in ns since the epoch: {log_time_ns}, {publish_time_ns}")
        channel = self._channels.get((topic, type_name))
        if channel is None:
            self.add_channel(topic, type_name)
            channel = self._channels[(topic, type_name)]
        with self._lock:
            channel.offered += 1
            if (
                self._queued >= self._max_messages
                or self._queued_bytes + len(data) > self._max_bytes
                or self._closing
                or self._error is not None
            ):
                channel.dropped += 1
                return False
            self._queued += 1
            self._queued_bytes += len(data)
            self._queue.append(
                _Item(channel, data, log_time_ns, publish_time_ns, channel.offered & 0xFFFFFFFF)
            )
            wake = len(self._queue) == _WAKE_AT
        if wake:
            self._wake.set()
        return True

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Queue a metadata record; of several with one name, readers let later keys win.

        :raises UsageError: a name, key or value is not a text, or cannot be UTF-8.
        """
        _check_text("the name of a metadata record", name)
        record = _Metadata(name, _check_metadata(f"metadata {name!r}", values))
        with self._lock:
            if not self._closing:
                self._queue.append(record)

    # -- the writer's thread -------------------------------------------------------------------

    def _run(self) -> None:
        whole = False
        try:
            self._write_all()
            whole = True
        finally:
            self._file.close(keep=self._written > 0 or (whole and self._keep_empty))

    def _failed(self, error: Exception) -> None:
        """Keep an error of the disk or mount for close(). Messages not in the file are lost."""
        with self._lock:
            self._error = error
            self._queue.clear()
            for channel in self._channels.values():
                channel.dropped = channel.offered - channel.written

    def _write_all(self) -> None:
        writer = self._writer
        writer.start(profile="ros2", library=f"dexkit {__version__}")
        writer.add_metadata("dexkit_recorder", self._about)
        self._commit()
        flushed = time.monotonic()
        while True:
            self._wake.wait(_POLL)
            self._wake.clear()
            with self._lock:
                closing = self._closing
            while batch := self._take():
                self._write(batch)
                flushed = self._commit_after(flushed)
            if closing:
                break
            flushed = self._commit_after(flushed)
            if self._backlog >= _BACKLOG:
                self._backlog = 0
                release_freed_memory()
        with self._lock:
            silent = [c for c in self._channels.values() if not c.id]
            dropped: Counter[str] = Counter()
            for channel in self._channels.values():
                dropped[channel.topic] += channel.dropped
        for channel in silent:
            self._register(channel)
        self._commit()
        writer.add_metadata(
            "dexkit_recorder",
            {
                "messages": str(self._written),
                "dropped": str(dropped.total()),
                **{f"dropped {topic}": str(count) for topic, count in sorted(dropped.items())},
            },
        )
        self._commit()  # the summary is made from what is in the file
        self._file.verify()
        writer.finish()  # type: ignore[no-untyped-call]
        self._commit()

    def _take(self) -> deque[_Item | _Metadata]:
        """The next of the queue; they count as queued until they are written."""
        items: deque[_Item | _Metadata] = deque()
        size = 0
        with self._lock:
            held = self._queued_bytes + self._queued * _OVERHEAD
            self._backlog = max(self._backlog, held)
            while self._queue and len(items) < _SLICE and size < _SLICE_BYTES:
                item = self._queue.popleft()
                size += len(item.data) if isinstance(item, _Item) else 0
                items.append(item)
        return items

    def _write(self, items: deque[_Item | _Metadata]) -> None:
        """Write messages to the chunk, and let go of them."""
        writer = self._writer
        messages = size = 0
        while items:
            item = items.popleft()
            if isinstance(item, _Metadata):
                writer.add_metadata(item.name, item.values)
                continue
            if not item.channel.id:
                self._register(item.channel)
            writer.add_message(
                item.channel.id, item.log_time_ns, item.data, item.publish_time_ns, item.sequence
            )
            item.channel.pending += 1
            messages += 1
            size += len(item.data)
            del item
        with self._lock:
            self._queued -= messages
            self._queued_bytes -= size

    def _commit_after(self, committed: float) -> float:
        """Complete the chunk if it is due; return the time of the last commit."""
        now = time.monotonic()
        if now - committed < FLUSH_INTERVAL and self._file.waiting < _COMMIT_AT:
            return committed
        self._commit()
        return now

    def _commit(self) -> None:
        """Complete the chunk, commit it, and check that the file still exists."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.commit()
        with self._lock:
            for channel in self._channels.values():
                channel.written += channel.pending
                self._written += channel.pending
                channel.pending = 0
        if self._written:
            self._file.publish()
        self._file.check()

    def _register(self, channel: _Channel) -> None:
        kind = channel.kind
        if kind.name not in self._schema_ids:
            self._schema_ids[kind.name] = self._writer.register_schema(
                kind.ros_name, "ros2msg", kind.ros2msg.encode()
            )
        channel.id = self._writer.register_channel(
            channel.topic, "cdr", self._schema_ids[kind.name], channel.metadata
        )


def _check_metadata(what: str, values: dict[str, str]) -> dict[str, str]:
    """A copy of ``values``.

    :raises UsageError: a key or value is not a text, or cannot be UTF-8.
    """
    for key, value in values.items():
        _check_text(f"a key of {what}", key)
        _check_text(f"{key!r} of {what}", value)
    return dict(values)


def _check_text(what: str, text: object) -> None:
    """:raises UsageError: it is not a text, or cannot be UTF-8."""
    if not isinstance(text, str):
        raise UsageError(f"{what} must be a text, not {type(text).__name__}")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise UsageError(f"{what} cannot be written as UTF-8: {text[:100]!r}") from None
