"""Read recordings: mcap files by dexkit or by others, finished or cut short, in bounded memory.

:func:`open_trace` indexes a file without holding its messages. What it cannot read it says in
:attr:`Trace.warnings`; what it can read it gives, so that a recording that was killed, or a disk
that filled up, costs its last moments and not the rest. Lengths in the file are never believed
further than the file is long, nor chunks beyond :data:`MAX_CHUNK`.
"""

from __future__ import annotations

import io
import os
import struct
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import fastcrc
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema
from numpy.typing import NDArray

from dexkit.errors import TraceUnreadable, TraceUnsupported, UsageError
from dexkit.messages import Columns, MessageType, message_type
from dexkit.messages.layout import STRUCTS
from dexkit.messages.packed import Packed, rows_at
from dexkit.messages.schemas import omgidl
from dexkit.traces.names import USB, dds_topic, dds_type, select_topics

__all__ = [
    "MAX_CHUNK",
    "ChannelInfo",
    "SampleArray",
    "Trace",
    "TraceEndpoint",
    "TraceMessage",
    "open_trace",
]

Times = NDArray[np.int64]

#: Largest chunk that is unpacked, bytes. Writers default to 1 to 4 MiB.
MAX_CHUNK = 256 * 2**20
# Largest schema, channel, metadata or index record that is believed, bytes.
_MAX_RECORD = 64 * 2**20
# Messages outside of chunks are read in runs of this many bytes.
_RUN = 4 * 2**20
# glibc keeps what is freed for the next chunk, up to the largest block that was ever freed; what it
# gives back to the system costs as much as all the rest of reading, page by page.
_KEPT = 8 * 2**20
# Messages held while chunks that overlap in time are put in order.
_MAX_PENDING = 1_000_000
_MAX_WARNINGS = 50

_MAGIC = b"\x89MCAP0\r\n"  # at the beginning and the end of a file (mcap.dev/spec)
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<QHIQQ")  # record length, channel, sequence, log time, publish time
# the same with its opcode, for many at once
_MESSAGES = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log", "publish"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
    }
)
_SKIPPED = frozenset(
    {
        Opcode.ATTACHMENT,
        Opcode.ATTACHMENT_INDEX,
        Opcode.CHUNK_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.STATISTICS,
        Opcode.SUMMARY_OFFSET,
    }
)
_crc32 = fastcrc.crc32.iso_hdlc  # zlib's, three times as fast
_by_log_time = attrgetter("log_time_ns")
_BAD_RECORD = (McapError, struct.error, UnicodeDecodeError, ValueError)


class TraceMessage(NamedTuple):
    """One recorded sample.

    :param data: the payload as recorded: encapsulation header, then CDR.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True)
class ChannelInfo:
    """One channel of a recording.

    :param topic: DDS topic (``rt/...``), however it was recorded.
    :param type_name: DDS type name (``unitree_go::msg::dds_::MotorCmds_``), likewise.
    :param first_ns: log time of the first message, ns since the epoch, or 0 without messages.
    :param metadata: what the recorder wrote beside the channel.
    :param recorded_topic: the topic as it stands in the file.
    :param problem: why dexkit cannot decode this channel, or empty.
    """

    topic: str
    type_name: str
    schema_encoding: str
    message_count: int
    first_ns: int
    last_ns: int
    metadata: dict[str, str]
    recorded_topic: str
    message_encoding: str = "cdr"
    problem: str = ""

    @property
    def supported(self) -> bool:
        """Whether the payloads can be decoded by :mod:`dexkit.messages`."""
        return not self.problem


@dataclass(frozen=True)
class TraceEndpoint:
    """A reader or writer that discovery saw during the recording; unknown parts are empty."""

    topic: str
    kind: str
    reliability: str
    durability: str = ""
    history: str = ""
    type_name: str = ""


@dataclass(frozen=True, eq=False)
class SampleArray:
    """The samples of one topic as columns, in order of log time.

    :param log_time_ns: reception, ns since the epoch, shape (n,), int64.
    :param publish_time_ns: DDS source timestamp, likewise; 0 where it is unknown.
    :param payloads: n payloads as recorded; none if they were decoded while they were read.
    :param problem: why they cannot be decoded, or empty.
    :param decoded: their columns, if so.
    """

    topic: str
    type_name: str
    log_time_ns: Times
    publish_time_ns: Times
    payloads: Sequence[bytes]
    problem: str = ""
    decoded: Columns | None = None

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def columns(self) -> Columns:
        """The fields of the payloads as numpy columns.

        :raises TraceUnsupported: their type, layout or encoding cannot be decoded.
        """
        if self.problem:
            raise TraceUnsupported(f"{self.topic}: {self.problem}")
        if self.decoded is not None:
            return self.decoded
        return message_type(self.type_name).columns(self.payloads)


@dataclass
class _Segment:
    """A chunk, or a run of messages outside of chunks.

    :param index: where its message index lies in the file.
    """

    offset: int
    length: int
    compression: str = ""
    size: int = 0
    crc: int = 0
    start_ns: int = 0
    cut: bool = False
    # channel id -> [messages, first log time, last log time]; None: not known from an index
    counts: dict[int, list[int]] | None = None
    index: tuple[int, int] = (0, 0)


@dataclass
class _Sink:
    """What is collected of one channel, piece by piece.

    :param payloads: the payloads of each piece one behind the other; None if they are not wanted.
    :param columns: what decodes them instead, shared by all channels of the topic.
    :param rows: which numbers they have there.
    """

    log: list[NDArray[np.uint64]] = field(default_factory=list)
    publish: list[NDArray[np.uint64]] = field(default_factory=list)
    sizes: list[NDArray[np.int64]] = field(default_factory=list)
    payloads: list[NDArray[np.uint8]] | None = field(default_factory=list)
    columns: Columns | None = None
    rows: list[NDArray[np.intp]] = field(default_factory=list)


class Trace:
    """A recording. Made by :func:`open_trace`; holds an index, not the messages.

    :ivar path: the file.
    :ivar truncated: the file ends before its end record: the recorder was killed, is still
        running, or the file is a partial copy.
    :ivar warnings: what is odd or missing, in sentences.
    :ivar metadata: metadata records by name; of several with one name, later keys win.
    :ivar library: what wrote the file, as it says itself.
    :ivar profile: mcap profile, ``"ros2"`` in ROS 2 bags and in dexkit's own recordings.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.truncated = False
        self.warnings: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.library = ""
        self.profile = ""
        self._segments: list[_Segment] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._info: dict[int, ChannelInfo] = {}

    # -- what it holds -------------------------------------------------------------------------

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel, by topic. Two types on one topic are two channels."""
        return sorted(self._info.values(), key=lambda c: (c.topic, c.type_name))

    @property
    def topics(self) -> list[str]:
        """The topics, sorted."""
        return sorted({c.topic for c in self._info.values()})

    @property
    def message_count(self) -> int:
        """Messages in all channels."""
        return sum(c.message_count for c in self._info.values())

    @property
    def first_ns(self) -> int:
        """Log time of the first message, ns since the epoch; 0 in an empty recording."""
        return min((c.first_ns for c in self._info.values() if c.message_count), default=0)

    @property
    def last_ns(self) -> int:
        """Log time of the last message, ns since the epoch; 0 in an empty recording."""
        return max((c.last_ns for c in self._info.values() if c.message_count), default=0)

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last."""
        return (self.last_ns - self.first_ns) / 1e9

    @property
    def endpoints(self) -> list[TraceEndpoint]:
        """The endpoints seen by discovery, from the metadata record ``dds_endpoints``."""
        found = []
        for key, value in self.metadata.get("dds_endpoints", {}).items():
            words = key.split()
            if len(words) < 2 or words[1] not in ("reader", "writer"):
                continue
            parts = [p.strip() for p in value.split(", ")]
            found.append(
                TraceEndpoint(
                    topic=dds_topic(words[0]),
                    kind=words[1],
                    reliability=parts[0],
                    durability=_part(parts, "Durability."),
                    history=_part(parts, "History."),
                    type_name=_part(parts, "type="),
                )
            )
        return found

    # -- messages ------------------------------------------------------------------------------

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[TraceMessage]:
        """The messages in order of log time, read as they are asked for.

        Memory is bounded by the chunks that overlap in time. Channels of any type are given,
        supported or not.

        :param topics: only these, in any spelling, patterns allowed; None for all.
        :raises UsageError: a topic is not in the recording.
        """
        wanted = self._wanted(topics)
        segments = sorted(self._segments, key=lambda s: s.start_ns)
        pending: list[TraceMessage] = []
        names = {i: self._info[i] for i in wanted}
        with self.path.open("rb") as file:
            for position, segment in enumerate(segments):
                found: list[tuple[int, int, int, bytes]] = []
                self._parse(self._unpack(file, segment), segment, found, names.keys())
                pending += [
                    TraceMessage(names[i].topic, names[i].type_name, log, publish, data)
                    for i, log, publish, data in found
                ]
                pending.sort(key=_by_log_time)
                ready = len(pending)
                if position + 1 < len(segments):
                    horizon = segments[position + 1].start_ns
                    ready = bisect_left(pending, horizon, key=_by_log_time)
                    ready = max(ready, len(pending) - _MAX_PENDING)
                yield from pending[:ready]
                del pending[:ready]

    def load(
        self,
        topics: Iterable[str] | None = None,
        *,
        payloads: bool = True,
        decode: bool = False,
    ) -> dict[str, SampleArray]:
        """The samples of several topics as columns, in one pass over the file.

        Of a topic that carries several types, the samples of the first type that dexkit can
        decode (or of the first, if it can decode none) are given.

        :param topics: as for :meth:`messages`.
        :param payloads: False for the times alone.
        :param decode: take types that dexkit knows apart while reading, whatever their schema
            says, and keep columns instead of payloads: a tenth of the memory.
        :raises UsageError: a topic is not in the recording.
        """
        chosen: dict[str, ChannelInfo] = {}
        wanted = self._wanted(topics)
        for info in sorted(
            (self._info[i] for i in wanted), key=lambda c: (not c.supported, -c.message_count)
        ):
            chosen.setdefault(info.topic, info)
        columns = {
            topic: Columns(STRUCTS[info.type_name])
            for topic, info in chosen.items()
            if decode and info.type_name in STRUCTS
        }
        sinks = {
            i: _Sink(
                payloads=[] if payloads and self._info[i].topic not in columns else None,
                columns=columns.get(self._info[i].topic),
            )
            for i in wanted
            if chosen[self._info[i].topic].type_name == self._info[i].type_name
        }
        bytearray(_KEPT)
        with self.path.open("rb") as file:
            for segment in self._segments:
                if segment.counts is None or not sinks.keys().isdisjoint(segment.counts):
                    known = _offsets(file, segment)
                    self._collect(self._unpack(file, segment), segment, sinks, known)
        return {
            topic: _columns(info, [s for i, s in sinks.items() if self._info[i].topic == topic])
            for topic, info in sorted(chosen.items())
        }

    def samples(self, topic: str) -> SampleArray:
        """The samples of one topic as columns; see :meth:`load`, which does several at once.

        :raises UsageError: the topic is not in the recording.
        """
        return self.load([topic])[dds_topic(topic)]

    def message_type(self, topic: str) -> MessageType:
        """The codec for the samples that :meth:`samples` gives.

        :raises UsageError: the topic is not in the recording.
        :raises TraceUnsupported: its type, layout or encoding cannot be decoded.
        """
        channels = [self._info[i] for i in self._wanted([topic])]
        info = min(channels, key=lambda c: (not c.supported, -c.message_count))
        if info.problem:
            raise TraceUnsupported(f"{info.topic}: {info.problem}")
        return message_type(info.type_name)

    def _wanted(self, topics: Iterable[str] | None) -> list[int]:
        if topics is None:
            return list(self._info)
        if isinstance(topics, str):
            topics = [topics]
        picked, missing = select_topics(self.topics, topics)
        if missing:
            raise UsageError(
                f"{self.path.name} has no topic {', '.join(missing)}",
                hint=f"it has: {', '.join(self.topics) or 'none'}",
            )
        return [i for i, c in self._info.items() if c.topic in picked]

    # -- reading the file ----------------------------------------------------------------------

    def _warn(self, text: str) -> None:
        if text not in self.warnings and len(self.warnings) < _MAX_WARNINGS:
            self.warnings.append(text)

    def _index(self) -> None:
        """Walk over the records, reading what is small and noting where the rest lies."""
        try:
            with self.path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                self._read_start(file)
                self._walk(file, size)
                self._complete(file)
        except OSError as error:
            raise TraceUnreadable(f"cannot read {self.path}: {error.strerror}") from error
        self._describe()
        if self.truncated and not self.message_count:
            self._warn("it holds no messages")

    def _read_start(self, file: BinaryIO) -> None:
        magic = file.read(len(_MAGIC))
        if magic != _MAGIC:
            raise TraceUnreadable(f"{self.path} is not an mcap file", hint=_guess(magic))
        head = file.read(_HEAD.size)
        if len(head) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            if opcode == Opcode.HEADER and length <= _MAX_RECORD:
                body = file.read(length)
                if len(body) == length:
                    try:
                        header = Header.read(_stream(body))
                    except _BAD_RECORD as error:
                        raise TraceUnreadable(
                            f"{self.path}: the header cannot be read ({error})"
                        ) from error
                    self.library, self.profile = header.library, header.profile
                    return
        raise TraceUnreadable(f"{self.path} ends, or goes wrong, within its header")

    def _walk(self, file: BinaryIO, size: int) -> None:
        at = file.tell()
        run: _Segment | None = None
        finished = False
        while at + _HEAD.size <= size:
            file.seek(at)
            opcode, length = _HEAD.unpack(file.read(_HEAD.size))
            body = at + _HEAD.size
            end = body + length
            if opcode == Opcode.FOOTER:
                finished = size >= end + len(_MAGIC)
                break
            if opcode == 0:
                # not an opcode: zeros are what a file system leaves after a power cut
                self._warn(f"nonsense from byte {at}; the remaining {size - at} bytes are lost")
                break
            if end > size:
                if opcode == Opcode.CHUNK:
                    self._add_chunk(file, body, size, cut=True)
                break
            if opcode == Opcode.MESSAGE:
                if run is None or run.length > _RUN:
                    run = _Segment(at, 0)
                    self._segments.append(run)
                run.length = end - run.offset
                run.size = run.length
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                if length > _MAX_RECORD:
                    self._warn(f"a record of {length} bytes at byte {at} is left out")
                else:
                    self._read_small(opcode, file.read(length), at)
            elif opcode == Opcode.CHUNK:
                run = None
                self._add_chunk(file, body, end)
            elif opcode == Opcode.MESSAGE_INDEX and self._segments and length <= _MAX_RECORD:
                begin, stop = self._segments[-1].index
                if at == stop or not stop:
                    self._segments[-1].index = (begin or at, end)
                self._read_message_index(file.read(length))
            elif opcode not in _SKIPPED:
                run = None  # an unknown record ends the run but is no error (mcap allows more)
            if opcode in _SKIPPED:
                run = None
            at = end
        self.truncated = not finished
        if self.truncated:
            lost = f"; {size - at} bytes after the last whole record" if size > at else ""
            self._warn(f"unfinished recording: read as far as it goes{lost}")

    def _read_small(self, opcode: int, body: bytes, at: int) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self._schemas.setdefault(schema.id, schema)
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                known = self._channels.setdefault(channel.id, channel)
                if (known.topic, known.schema_id) != (channel.topic, channel.schema_id):
                    self._warn(
                        f"channel {channel.id} is defined twice, for {known.topic} and for "
                        f"{channel.topic}; the first is used"
                    )
            else:
                record = Metadata.read(_stream(body))
                self.metadata.setdefault(record.name, {}).update(record.metadata)
        except _BAD_RECORD as error:
            self._warn(f"a record at byte {at} cannot be read ({error})")

    def _add_chunk(self, file: BinaryIO, body: int, end: int, *, cut: bool = False) -> None:
        head = file.read(min(_CHUNK_HEAD.size, end - body))
        try:
            start_ns, _end_ns, size, crc, name_length = _CHUNK_HEAD.unpack(head)
            if name_length > 16:
                raise ValueError("compression name too long")
            tail = file.read(name_length + 8)
            compression = tail[:name_length].decode()
            (length,) = struct.unpack("<Q", tail[name_length:])
        except _BAD_RECORD:
            if not cut:
                self._warn(f"the chunk at byte {body} has no readable header and is left out")
            return
        offset = body + _CHUNK_HEAD.size + name_length + 8
        if offset + length > end:
            if not cut:
                self._warn(f"the chunk at byte {body} is longer than its record and is left out")
                return
            length = end - offset
        self._segments.append(_Segment(offset, length, compression, size, crc, start_ns, cut))

    def _read_message_index(self, body: bytes) -> None:
        segment = self._segments[-1]
        if len(body) < 6:
            return
        channel_id, length = struct.unpack_from("<HI", body)
        if length % 16 or len(body) < 6 + length:
            return
        if segment.counts is None:
            segment.counts = {}
        if length:
            times = np.frombuffer(body, "<u8", count=length // 8, offset=6)[::2]
            segment.counts[channel_id] = [len(times), int(times.min()), int(times.max())]

    def _complete(self, file: BinaryIO) -> None:
        """Read into those segments that the indexes leave unknown."""
        for number, segment in enumerate(self._segments):
            # the index of the last chunk of an unfinished file may itself be cut
            doubtful = self.truncated and number + 1 == len(self._segments)
            if segment.counts is None or doubtful or not self._knows(segment.counts):
                self._survey(file, segment)

    def _knows(self, channel_ids: Iterable[int]) -> bool:
        for channel_id in channel_ids:
            channel = self._channels.get(channel_id)
            if channel is None or (channel.schema_id and channel.schema_id not in self._schemas):
                return False
        return True

    def _survey(self, file: BinaryIO, segment: _Segment) -> None:
        counts: dict[int, list[int]] = {}
        self._parse(self._unpack(file, segment), segment, survey=counts)
        segment.counts = counts
        if counts:
            segment.start_ns = min(c[1] for c in counts.values())

    def _unpack(self, file: BinaryIO, segment: _Segment) -> bytes:
        """The records in a segment; what is damaged is left out, with a warning."""
        where = f"the chunk at byte {segment.offset}"
        if max(segment.length, segment.size) > MAX_CHUNK:
            self._warn(f"{where} claims {segment.size} bytes, more than {MAX_CHUNK}; left out")
            return b""
        file.seek(segment.offset)
        packed = file.read(segment.length)
        try:
            if segment.compression == "":
                data = packed
            elif segment.compression == "zstd":
                data = _unzstd(packed, segment.size, segment.cut)
            elif segment.compression == "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(packed, segment.size)
            else:
                self._warn(f"{where} is compressed with {segment.compression!r}; left out")
                return b""
        except (zstandard.ZstdError, RuntimeError, ValueError, EOFError) as error:
            if not segment.cut:
                self._warn(f"{where} is damaged and left out ({error})")
            return b""
        if segment.cut:
            return data
        if len(data) != segment.size or (segment.crc and _crc32(data) != segment.crc):
            self._warn(f"{where} is damaged (its checksum does not match) and left out")
            return b""
        return data

    def _parse(
        self,
        data: bytes,
        segment: _Segment,
        found: list[tuple[int, int, int, bytes]] | None = None,
        wanted: Collection[int] = (),
        *,
        survey: dict[int, list[int]] | None = None,
    ) -> None:
        """Go through the records in ``data``.

        Messages of the ``wanted`` channels go into ``found``; others are counted in ``survey``.
        """
        at, end = 0, len(data)
        unpack = _MESSAGE.unpack_from
        message_opcode = int(Opcode.MESSAGE)
        try:
            while at < end:
                opcode = data[at]
                if opcode == message_opcode:
                    length, channel_id, _, log, publish = unpack(data, at + 1)
                    stop = at + 9 + length
                    if stop > end or length < 22:
                        raise ValueError("a message is longer than what is left")
                    if found is not None and channel_id in wanted:
                        found.append((channel_id, log, publish, data[at + 31 : stop]))
                    elif survey is not None:
                        entry = survey.get(channel_id)
                        if entry is None:
                            survey[channel_id] = [1, log, log]
                        else:
                            entry[0] += 1
                            entry[1] = min(entry[1], log)
                            entry[2] = max(entry[2], log)
                    at = stop
                    continue
                _, length = _HEAD.unpack_from(data, at)
                stop = at + 9 + length
                if stop > end:
                    raise ValueError("a record is longer than what is left")
                if survey is not None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._read_small(opcode, data[at + 9 : stop], segment.offset)
                at = stop
        except (struct.error, ValueError) as error:
            if not segment.cut:
                self._warn(f"records at byte {segment.offset} go wrong after {at} bytes ({error})")

    def _collect(
        self,
        data: bytes,
        segment: _Segment,
        sinks: dict[int, _Sink],
        known: NDArray[np.int64],
    ) -> None:
        """Put the messages of the channels in ``sinks`` there; as :meth:`_parse`, but in bulk.

        :param known: where the index says that messages begin.
        """
        starts: list[int] = []
        at, end = 0, len(data)
        # an index is believed where the records it names fill the chunk from there to its end
        jump = int(known[0]) if _are_all(data, known) else -1
        unpack, message = _HEAD.unpack_from, int(Opcode.MESSAGE)
        try:
            while at < end and at != jump:
                opcode, length = unpack(data, at)
                stop = at + 9 + length
                if opcode == message:
                    if stop > end or length < 22:
                        raise ValueError("a message is longer than what is left")
                    starts.append(at)
                elif stop > end:
                    raise ValueError("a record is longer than what is left")
                at = stop
        except (struct.error, ValueError) as error:
            if not segment.cut:
                self._warn(f"records at byte {segment.offset} go wrong after {at} bytes ({error})")
        begins = np.array(starts, dtype=np.int64)
        if at == jump:
            begins = np.concatenate([begins, known])
        if not len(begins):
            return
        every = rows_at(data, begins, _MESSAGES.itemsize).view(_MESSAGES)[:, 0]
        channels = every["channel"]
        begins += _MESSAGES.itemsize
        for channel_id, sink in sinks.items():
            mine = np.flatnonzero(channels == channel_id)
            if not len(mine):
                continue
            heads = every[mine]
            sink.log.append(heads["log"])
            sink.publish.append(heads["publish"])
            if sink.payloads is None and sink.columns is None:
                continue
            sizes = heads["length"].astype(np.int64) - 22
            if sink.columns is not None:
                first = len(sink.columns)
                sink.columns.append(data, begins[mine], sizes)
                sink.rows.append(np.arange(first, len(sink.columns)))
                continue
            assert sink.payloads is not None
            sink.sizes.append(sizes)
            if (sizes == sizes[0]).all():
                sink.payloads.append(rows_at(data, begins[mine], int(sizes[0])).reshape(-1))
            else:
                ends = (begins[mine] + sizes).tolist()
                pieces = [data[a:b] for a, b in zip(begins[mine].tolist(), ends, strict=True)]
                sink.payloads.append(np.frombuffer(b"".join(pieces), dtype=np.uint8))

    def _describe(self) -> None:
        totals: dict[int, list[int]] = {}
        for segment in self._segments:
            for channel_id, (count, first, last) in (segment.counts or {}).items():
                entry = totals.setdefault(channel_id, [0, first, last])
                entry[0] += count
                entry[1] = min(entry[1], first)
                entry[2] = max(entry[2], last)
        for channel_id in totals.keys() - self._channels.keys():
            self._warn(
                f"{totals[channel_id][0]} messages of channel {channel_id}, which is "
                "nowhere defined, are left out"
            )
        checked: dict[int, tuple[str, list[str]]] = {}
        for channel_id, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            count, first, last = totals.get(channel_id, [0, 0, 0])
            type_name = dds_type(schema.name) if schema else channel.metadata.get("dds.type", "")
            problem = ""
            if channel.message_encoding != "cdr":
                problem = f"message encoding {channel.message_encoding!r} is not 'cdr'"
            elif schema is None:
                problem = "it has no schema"
            else:
                if schema.id not in checked:
                    checked[schema.id] = _check_layout(type_name, schema)
                problem, notes = checked[schema.id]
                for note in notes:
                    self._warn(f"{type_name}: {note}")
            self._info[channel_id] = ChannelInfo(
                topic=dds_topic(channel.topic),
                type_name=type_name,
                schema_encoding=schema.encoding if schema else "",
                message_count=count,
                first_ns=first,
                last_ns=last,
                metadata=dict(channel.metadata),
                recorded_topic=channel.topic,
                message_encoding=channel.message_encoding,
                problem=problem,
            )
            # transfers of a conformance run on USB are there on purpose, for its judge
            if problem and count and not channel.topic.startswith(USB):
                self._warn(f"{channel.topic}: {problem}")
        types: dict[str, set[str]] = {}
        for info in self._info.values():
            types.setdefault(info.topic, set()).add(info.type_name)
        for topic, names in types.items():
            if len(names) > 1:
                self._warn(f"{topic} carries {len(names)} types: {', '.join(sorted(names))}")


def open_trace(path: str | os.PathLike[str]) -> Trace:
    """Open a recording: an mcap file, or the directory of a ROS 2 bag with one in it.

    :raises TraceUnreadable: it is missing, not an mcap file, or ends within its header.
    """
    found = Path(path)
    if found.is_dir():
        files = sorted(found.glob("*.mcap"))
        if len(files) != 1:
            raise TraceUnreadable(
                f"{found} is a directory with {len(files)} mcap files",
                hint="name one of the files"
                if files
                else "convert a .db3 bag to mcap first ('ros2 bag convert', or 'rosbags-convert')",
            )
        found = files[0]
    trace = Trace(found)
    trace._index()
    return trace


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _part(parts: Sequence[str], prefix: str) -> str:
    return next((p.removeprefix(prefix) for p in parts if p.startswith(prefix)), "")


def _guess(magic: bytes) -> str:
    """What a file that is no mcap file may be, from its first bytes."""
    if magic.startswith(b"SQLite f"):
        return "a ROS 2 .db3 bag: convert it to mcap ('ros2 bag convert', or 'rosbags-convert')"
    if magic.startswith(b"#ROSBAG"):
        return "a ROS 1 bag: convert it to mcap ('rosbags-convert')"
    if magic.startswith(b"\x28\xb5\x2f\xfd"):
        return "a zstd archive: unpack it first ('zstd -d')"
    if magic.startswith(b"version "):
        return "perhaps a Git LFS pointer: 'git lfs pull' fetches the file itself"
    if not magic:
        return "the file is empty"
    return "recordings are mcap files (https://mcap.dev)"


def _unzstd(packed: bytes, size: int, cut: bool) -> bytes:
    """Unpack at most ``size`` bytes, whatever the frame says of itself."""
    if cut:
        unpacker = zstandard.ZstdDecompressor().decompressobj()
        out = bytearray()
        try:
            # a piece at a time: a piece that fails, or exceeds the bound, ends it
            for at in range(0, len(packed), 4096):
                out += unpacker.decompress(packed[at : at + 4096])
                if len(out) > size:
                    break
        except zstandard.ZstdError:
            pass
        return bytes(out[:size])
    with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        return reader.read(size)


def _offsets(file: BinaryIO, segment: _Segment) -> NDArray[np.int64]:
    """Where messages begin in a chunk, as its message index says; whatever that is worth."""
    begin, end = segment.index
    file.seek(begin)
    data = file.read(end - begin)
    found: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    at = 0
    while at + 15 <= len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        (size,) = struct.unpack_from("<I", data, at + 11)
        if opcode == Opcode.MESSAGE_INDEX and not size % 16 and at + 15 + size <= len(data):
            found.append(np.frombuffer(data, np.dtype("<i8"), size // 8, at + 15)[1::2])
        at += 9 + length
    return np.sort(np.concatenate(found))


def _are_all(data: bytes, starts: NDArray[np.int64]) -> bool:
    """Whether messages begin at ``starts``, each where the last ends, up to the end of ``data``."""
    if not len(starts) or starts[0] < 0 or starts[-1] > len(data) - _MESSAGES.itemsize:
        return False
    heads = rows_at(data, starts, _MESSAGES.itemsize).view(_MESSAGES)[:, 0]
    lengths = heads["length"].astype(np.int64)
    return bool(
        (heads["opcode"] == Opcode.MESSAGE).all()
        and (lengths >= 22).all()
        and np.array_equal(starts + 9 + lengths, [*starts[1:], len(data)])
    )


def _columns(info: ChannelInfo, sinks: list[_Sink]) -> SampleArray:
    log = _times([t for s in sinks for t in s.log])
    publish = _times([t for s in sinks for t in s.publish])
    sizes = np.concatenate([np.empty(0, np.int64), *(z for s in sinks for z in s.sizes)])
    starts = np.cumsum(sizes) - sizes
    rows = np.concatenate([np.empty(0, np.intp), *(r for s in sinks for r in s.rows)])
    blocks = [p for s in sinks if s.payloads is not None for p in s.payloads]
    if len(log) > 1 and (np.diff(log) < 0).any():
        order = np.argsort(log, kind="stable")
        log, publish = log[order], publish[order]
        if len(sizes):
            starts, sizes = starts[order], sizes[order]
        if len(rows):
            rows = rows[order]
    decoded = sinks[0].columns
    if decoded is not None and (np.diff(rows) != 1).any():
        decoded.reorder(rows)
    payloads = Packed(blocks, starts, sizes)
    return SampleArray(info.topic, info.type_name, log, publish, payloads, info.problem, decoded)


def _times(pieces: list[NDArray[np.uint64]]) -> Times:
    # times are unsigned in the file; beyond the year 2262 they are not times
    times = np.concatenate([np.empty(0, np.uint64), *pieces])
    return np.asarray(np.minimum(times, np.uint64(2**63 - 1)), dtype=np.int64)


def _check_layout(type_name: str, schema: Schema) -> tuple[str, list[str]]:
    """(why payloads of this schema cannot be decoded, or empty; remarks)."""
    if type_name not in STRUCTS:
        return f"dexkit does not know the type {type_name}", []
    text = omgidl(STRUCTS[type_name])
    if (schema.encoding, schema.name, schema.data) == ("omgidl", type_name, text.encode()):
        return "", []  # as dexkit itself writes it
    from dexkit.traces import schemas

    ours = schemas.parse("omgidl", type_name, text)
    try:
        theirs = schemas.parse(schema.encoding, schema.name, schema.data.decode("utf-8", "replace"))
    except TraceUnsupported as error:
        return error.message, []
    breaking, harmless = schemas.differences(theirs, ours)
    if breaking:
        return (
            f"recorded with another layout of {type_name} than the current one: "
            f"{'; '.join(breaking)}",
            [],
        )
    return "", harmless
