"""Read recordings: mcap files by dexkit or by others, finished or cut short, in bounded memory.

:func:`open_trace` indexes a file without holding its messages. Unreadable parts are listed in
:attr:`Trace.warnings`; everything else is returned, so that a killed recorder or a full disk costs
only the last moments. How the file is checked is in
:mod:`dexkit.traces.container`.
"""

from __future__ import annotations

import contextlib
import heapq
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError, TraceUnreadable, TraceUnsupported, UsageError
from dexkit.messages import Columns, MessageType, message_type
from dexkit.messages.layout import STRUCTS
from dexkit.messages.packed import Packed, rows_at
from dexkit.messages.schemas import omgidl
from dexkit.traces.bag_metadata import BAG, records_of_copy
from dexkit.traces.clock_steps import LIMIT_NS, ClockStep
from dexkit.traces.container import HEADS, MAX_CHUNK, Container, Heads, OpenFile, by_channel
from dexkit.traces.mcap_records import Schema
from dexkit.traces.names import SESSION, USB, dds_topic, dds_type, select_topics

if TYPE_CHECKING:
    from dexkit.traces import schemas

__all__ = [
    "LATEST_NS",
    "LATE_TIMES",
    "MAX_CHUNK",
    "ChannelInfo",
    "Definition",
    "SampleArray",
    "Trace",
    "TraceEndpoint",
    "TraceMessage",
    "open_trace",
    "signed_times",
]

Times = NDArray[np.int64]
LATEST_NS = 2**63 - 1
"""Last time as a signed number, in the year 2262; those of a recording are unsigned."""
LATE_TIMES = "times after the year 2262, which become the last one that fits"
"""What an export says of later ones."""

# Let glibc keep freed memory for the next chunk, up to this size. Returning it to the system page
# by page costs as much time as all the rest of reading.
_MALLOC_KEEP = 8 * 2**20
# Bytes of chunks that are held while those that overlap in time are put in order.
_MAX_HELD = 64 * 2**20
# Messages created in one step.
_PIECE = 1024
# Characters of a text from the file that are quoted in a message.
_LONGEST = 500


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
class Definition:
    """A channel's definition in the file, as a copy needs it.

    :param topic: as recorded.
    :param schema: name, encoding and text of its schema; None without one.
    """

    topic: str
    message_encoding: str
    metadata: dict[str, str]
    schema: tuple[str, str, bytes] | None


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
class _Sink:
    """Collects the data of one channel, piece by piece.

    :param payloads: the concatenated payloads of each piece; None if they are not wanted.
    :param columns: what decodes them instead, shared by all channels of the topic.
    :param rows: which numbers they have there.
    """

    log: list[NDArray[np.uint64]] = field(default_factory=list)
    publish: list[NDArray[np.uint64]] = field(default_factory=list)
    sizes: list[NDArray[np.int64]] = field(default_factory=list)
    payloads: list[NDArray[np.uint8]] | None = field(default_factory=list)
    columns: Columns | None = None
    rows: list[NDArray[np.intp]] = field(default_factory=list)


class _Held:
    """The messages of one segment, in order of log time, given piece by piece."""

    def __init__(
        self, data: bytes, begins: NDArray[np.int64], heads: Heads, names: dict[int, ChannelInfo]
    ) -> None:
        mine = np.flatnonzero(np.isin(heads["channel"], list(names)))
        mine = mine[np.argsort(heads["log"][mine], kind="stable")]
        self._data = data
        self._begins = begins[mine] + HEADS.itemsize
        self._heads = heads[mine]
        self._log: NDArray[np.uint64] = self._heads["log"].copy()
        self._names = names
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._log)

    @property
    def bytes(self) -> int:
        return len(self._data)

    @property
    def next_ns(self) -> int:
        """Log time of the next message."""
        return int(self._log[self._at])

    def before(self, time_ns: int | None) -> Iterator[TraceMessage]:
        """Those with an earlier log time; None for all."""
        end = len(self._log)
        if time_ns is not None and self._log[-1] >= time_ns:
            end = int(np.searchsorted(self._log, np.uint64(time_ns)))
        while self._at < end:
            some = slice(self._at, min(end, self._at + _PIECE))
            self._at = some.stop
            heads = self._heads[some]
            begins = self._begins[some]
            ends = begins + heads["length"].astype(np.int64) - 22
            for channel, log, publish, begin, stop in zip(
                heads["channel"].tolist(),
                heads["log"].tolist(),
                heads["publish"].tolist(),
                begins.tolist(),
                ends.tolist(),
                strict=True,
            ):
                name = self._names[channel]
                yield TraceMessage(name.topic, name.type_name, log, publish, self._data[begin:stop])


class Trace:
    """A recording. Made by :func:`open_trace`; holds an index, not the messages.

    :ivar path: the file.
    :ivar truncated: the file ends before its end record: the recorder was killed, is still running,
        or the file is a partial copy.
    :ivar damage: contradictions and unreadable parts, as sentences with the place; more may be
        found while messages are read. Empty: everything read so far agrees with the file's
        checksums.
    :ivar warnings: the same, and other irregularities.
    :ivar notes: what cannot be checked.
    :ivar metadata: metadata records by name; of several with one name, later keys win.
    :ivar mixed_types: by topic with several types, the warning about it.
    :ivar library: the writing library, as named in the file.
    :ivar profile: mcap profile, ``"ros2"`` in ROS 2 bags and in dexkit's own recordings.
    """

    def __init__(self, path: Path, open_file: OpenFile | None = None) -> None:
        self.path = path
        self._file = Container(path, open_file)
        self._file.open()
        self.truncated = self._file.truncated
        self.damage = self._file.damage
        self.warnings = self._file.warnings
        self.mixed_types: dict[str, str] = {}
        self.notes = self._file.notes
        self.metadata = self._file.metadata
        self.library = self._file.library
        self.profile = self._file.profile
        self._info: dict[int, ChannelInfo] = {}
        self._describe()
        if BAG in self.metadata:
            self._read_bag_metadata(self.metadata[BAG])
        if self.truncated and not self.message_count:
            self._file.warn("it holds no messages")

    def _read_bag_metadata(self, copy: dict[str, str]) -> None:
        """Add the records that dexkit has put into a bag."""
        try:
            self.metadata |= {**records_of_copy(copy), **self.metadata}
        except SessionError as error:
            self._file.warn(
                f"the bag's metadata cannot be read ({error.message}): what its messages were made "
                "from is not known"
            )

    # -- contents -------------------------------------------------------------------------

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel, by topic. Two types on one topic are two channels."""
        return sorted(self._info.values(), key=lambda c: (c.topic, c.type_name))

    @property
    def definitions(self) -> dict[tuple[str, str], Definition]:
        """The definition of each channel in the file, by topic and type.

        :raises TraceUnsupported: two channels of one topic and type differ in their schema or
            encoding, so that their messages cannot be told apart.
        """
        found: dict[tuple[str, str], Definition] = {}
        for i, info in self._info.items():
            channel = self._file.channels[i]
            schema = self._file.schemas.get(channel.schema_id)
            one = Definition(
                info.recorded_topic,
                info.message_encoding,
                info.metadata,
                (schema.name, schema.encoding, schema.data) if schema else None,
            )
            other = found.setdefault((info.topic, info.type_name), one)
            if (one.schema, one.message_encoding) != (other.schema, other.message_encoding):
                raise TraceUnsupported(
                    f"{self.path.name} has two channels {_shorten(info.topic)} of type "
                    f"{_shorten(info.type_name)} with different schemas"
                )
        return found

    @cached_property
    def clock_steps(self) -> list[ClockStep]:
        """Where the times of a channel step back: what follows is another stretch of time."""
        return [s for s in self._file.clock_steps if s.channel_id in self._info]

    @property
    def attachments(self) -> int:
        """Attachments in the file, which dexkit does not read."""
        return self._file.attachments

    @property
    def topics(self) -> list[str]:
        """The topics, sorted."""
        return sorted({c.topic for c in self._info.values()})

    @cached_property
    def message_count(self) -> int:
        """Messages in all channels."""
        return sum(c.message_count for c in self._info.values())

    @cached_property
    def first_ns(self) -> int:
        """Log time of the first message, ns since the epoch; 0 in an empty recording."""
        return min((c.first_ns for c in self._info.values() if c.message_count), default=0)

    @cached_property
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
                    durability=_remainder_after(parts, "Durability."),
                    history=_remainder_after(parts, "History."),
                    type_name=_remainder_after(parts, "type="),
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
        names = {i: self._info[i] for i in self._select_channels(topics)}
        segments = sorted(self._file.segments, key=lambda s: s.start_ns)
        # (next log time, number, messages) of the segments that are being given
        held: list[tuple[int, int, _Held]] = []
        size = 0
        with self._file.open_file() as file:
            for number, segment in enumerate(segments):
                found = _Held(*self._file.read(file, segment), names)
                if found:
                    heapq.heappush(held, (found.next_ns, number, found))
                    size += found.bytes
                horizon = segments[number + 1].start_ns if number + 1 < len(segments) else None
                while held and (horizon is None or held[0][0] < horizon or size > _MAX_HELD):
                    _, first, found = heapq.heappop(held)
                    limit = horizon if size <= _MAX_HELD else None
                    if held:
                        # of equal times, those of the earlier chunk come first
                        other = held[0][0] + (first < held[0][1])
                        limit = other if limit is None else min(limit, other)
                    yield from found.before(limit)
                    if found:
                        heapq.heappush(held, (found.next_ns, first, found))
                    else:
                        size -= found.bytes

    def stretches(self) -> Iterator[tuple[int, TraceMessage]]:
        """Every message, as they follow each other in the file, with the number of its stretch of
        time, from 0; the next one begins where the clock steps back.
        """
        last: dict[int, tuple[int, int]] = {}
        current = 0
        with self._file.open_file() as file:
            for segment in self._file.segments:
                data, begins, heads = self._file.read(file, segment)
                stops = begins + HEADS.itemsize + heads["length"].astype(np.int64) - 22
                for channel, log, publish, begin, stop in zip(
                    heads["channel"].tolist(),
                    heads["log"].tolist(),
                    heads["publish"].tolist(),
                    (begins + HEADS.itemsize).tolist(),
                    stops.tolist(),
                    strict=True,
                ):
                    name = self._info.get(channel)
                    if name is None:
                        continue
                    before, stretch = last.get(channel, (log, current))
                    if before - log > LIMIT_NS and stretch == current:
                        current += 1
                    last[channel] = log, current
                    yield (
                        current,
                        TraceMessage(name.topic, name.type_name, log, publish, data[begin:stop]),
                    )

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
        wanted = self._select_channels(topics)
        for info in sorted((self._info[i] for i in wanted), key=_preference):
            chosen.setdefault(info.topic, info)
        columns = {
            topic: Columns(STRUCTS[info.type_name])
            for topic, info in chosen.items()
            if decode and info.type_name in STRUCTS
        }
        sinks: dict[int, _Sink] = {}
        by_topic: dict[str, list[_Sink]] = {topic: [] for topic in sorted(chosen)}
        for i in wanted:
            topic = self._info[i].topic
            if chosen[topic].type_name == self._info[i].type_name:
                sinks[i] = _Sink(
                    payloads=[] if payloads and topic not in columns else None,
                    columns=columns.get(topic),
                )
                by_topic[topic].append(sinks[i])
        _keep_memory()
        with self._file.open_file() as file:
            for segment in self._file.segments:
                if segment.counts is None or not sinks.keys().isdisjoint(segment.counts):
                    self._collect(*self._file.read(file, segment), sinks)
        return {topic: _columns(chosen[topic], found) for topic, found in by_topic.items()}

    def pieces(self, topic: str, rows: int) -> Iterator[SampleArray]:
        """The samples of one topic, some at a time, in bounded memory; at least one piece.

        Of a topic that carries several types, those of the type that :meth:`load` gives.

        :param rows: samples of each piece but the last.
        :raises UsageError: the topic is not in the recording.
        """
        info = self._preferred(topic)
        some: list[TraceMessage] = []
        given = False
        for message in self.messages([topic]):
            if message.type_name == info.type_name:
                some.append(message)
                if len(some) == rows:
                    yield _piece(info, some)
                    some, given = [], True
        if some or not given:
            yield _piece(info, some)

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
        info = self._preferred(topic)
        if info.problem:
            raise TraceUnsupported(f"{info.topic}: {info.problem}")
        return message_type(info.type_name)

    def _preferred(self, topic: str) -> ChannelInfo:
        """The channel whose type :meth:`load` gives."""
        channels = [self._info[i] for i in self._select_channels([topic])]
        return min(channels, key=_preference)

    def _select_channels(self, topics: Iterable[str] | None) -> list[int]:
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
        chosen = set(picked)
        return [i for i, c in self._info.items() if c.topic in chosen]

    def _collect(
        self, data: bytes, begins: NDArray[np.int64], every: Heads, sinks: dict[int, _Sink]
    ) -> None:
        """Put the messages of the channels in ``sinks`` there."""
        begins = begins + HEADS.itemsize
        whole = every.view(f"V{HEADS.itemsize}")  # copied several times as fast as members
        for channel_id, mine in by_channel(every["channel"]):
            sink = sinks.get(channel_id)
            if sink is None:
                continue
            heads = whole[mine].view(HEADS)
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
        for segment in self._file.segments:
            for channel_id, (count, first, last) in (segment.counts or {}).items():
                entry = totals.setdefault(channel_id, [0, first, last])
                entry[0] += count
                entry[1] = min(entry[1], first)
                entry[2] = max(entry[2], last)
        for channel_id in totals.keys() - self._file.channels.keys():
            self._file.report_damage(
                f"{totals[channel_id][0]} messages of channel {channel_id}, which is "
                "nowhere defined, are left out"
            )
        checked: dict[int, tuple[str, list[str]]] = {}
        for channel_id, channel in self._file.channels.items():
            schema = self._file.schemas.get(channel.schema_id)
            count, first, last = totals.get(channel_id, [0, 0, 0])
            type_name = dds_type(schema.name) if schema else channel.metadata.get("dds.type", "")
            problem = ""
            if channel.message_encoding != "cdr":
                problem = f"message encoding {_shorten(channel.message_encoding)!r} is not 'cdr'"
            elif schema is None:
                problem = "it has no schema"
            else:
                if schema.id not in checked:
                    checked[schema.id] = _check_layout(type_name, schema)
                problem, notes = checked[schema.id]
                for note in notes:
                    self._file.warn(f"{type_name}: {note}")
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
            # written on purpose, for other readers than this one
            if problem and count and not channel.topic.startswith((USB, SESSION)):
                self._file.warn(f"{_shorten(channel.topic)}: {problem}")
        if steps := self.clock_steps:  # of channels that are defined
            topics = dict.fromkeys(self._info[s.channel_id].topic for s in steps)
            some = ", ".join(map(_shorten, list(topics)[:3])) + ", ..." * (len(topics) > 3)
            self._file.warn(f"{max(steps, key=lambda s: s.seconds)} ({some})")
        types: dict[str, set[str]] = {}
        for info in self._info.values():
            types.setdefault(info.topic, set()).add(info.type_name)
        for topic, names in types.items():
            if len(names) > 1:
                some = ", ".join(sorted(names)[:5]) + ", ..." * (len(names) > 5)
                text = f"{topic} carries {len(names)} types: {some}"
                self._file.warn(text)
                self.mixed_types[topic] = text


def open_trace(path: str | os.PathLike[str], open_file: OpenFile | None = None) -> Trace:
    """Open a recording: an mcap file, or the directory of a ROS 2 bag with one in it.

    :param open_file: opens a recording that is not a local file, once for each pass over it;
        ``path`` is only its name then.
    :raises TraceUnreadable: it is missing, not an mcap file, or ends within its header.
    """
    found = Path(path)
    if open_file is not None:
        return Trace(found, open_file)
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
    return Trace(found)


@cache
def _keep_memory() -> None:
    """Let glibc keep freed memory; called once in a process."""
    with contextlib.suppress(MemoryError):  # it only saves time
        bytearray(_MALLOC_KEEP)


def _remainder_after(parts: Sequence[str], prefix: str) -> str:
    return next((p.removeprefix(prefix) for p in parts if p.startswith(prefix)), "")


def _preference(info: ChannelInfo) -> tuple[bool, int]:
    """Of the channels of one topic, the lowest decides which type is read."""
    return not info.supported, -info.message_count


def _piece(info: ChannelInfo, messages: Sequence[TraceMessage]) -> SampleArray:
    log = np.array([m.log_time_ns for m in messages], dtype=np.uint64)
    publish = np.array([m.publish_time_ns for m in messages], dtype=np.uint64)
    payloads = [m.data for m in messages]
    return SampleArray(
        info.topic, info.type_name, _times([log]), _times([publish]), payloads, info.problem
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
    return signed_times(np.concatenate([np.empty(0, np.uint64), *pieces]))


def signed_times(times: NDArray[np.uint64]) -> Times:
    """Times of a recording, ns, as signed numbers: at most :data:`LATEST_NS`."""
    return np.asarray(np.minimum(times, np.uint64(LATEST_NS)), dtype=np.int64)


def _shorten(text: str) -> str:
    """A text of a file, cut to what fits into a sentence."""
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


@cache
def _schema_text(type_name: str) -> str:
    return omgidl(STRUCTS[type_name])


@cache
def _layout(type_name: str) -> schemas.Struct:
    from dexkit.traces import schemas

    return schemas.parse("omgidl", type_name, _schema_text(type_name))


def _check_layout(type_name: str, schema: Schema) -> tuple[str, list[str]]:
    """(why payloads of this schema cannot be decoded, or empty; remarks)."""
    if type_name not in STRUCTS:
        return f"dexkit does not know the type {_shorten(type_name)}", []
    if (schema.encoding, schema.name) == ("omgidl", type_name) and (
        schema.data == _schema_text(type_name).encode()
    ):
        return "", []  # as dexkit itself writes it
    from dexkit.traces import schemas

    try:
        theirs = schemas.parse(schema.encoding, schema.name, schema.data.decode("utf-8", "replace"))
    except TraceUnsupported as error:
        return _shorten(error.message), []
    breaking, harmless = schemas.differences(theirs, _layout(type_name))
    if breaking:
        return (
            f"recorded with another layout of {type_name} than the current one: "
            f"{_shorten('; '.join(breaking))}",
            [],
        )
    return "", [_shorten(note) for note in harmless]
