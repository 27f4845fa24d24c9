"""Index and verify the records of an mcap file: chunks, indexes, checksums and summary.

The file is read record by record, without decompressing its chunks. Redundant data are compared:
checksums, chunk headers, message indexes, and the summary with its counts. Every difference goes
into :attr:`Container.damage`, with its offset, and reading continues: after a damaged record, at
the next offset at which whole records follow each other. Chunks are verified when they are read
(:meth:`Container.read`).
"""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import BinaryIO, cast

import fastcrc
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from numpy.typing import NDArray

from dexkit.documents import open_ordinary
from dexkit.errors import TraceUnreadable
from dexkit.messages.packed import rows_at
from dexkit.traces import mcap_records
from dexkit.traces.clock_steps import ClockStep, Order, drops_in, order_of, steps_between
from dexkit.traces.mcap_records import HEAD, LEAST, MAGIC, BadRecord, Channel, Opcode, Schema, walk
from dexkit.traces.summary import Found, Summary, contradictions

__all__ = ["HEADS", "MAX_CHUNK", "MAX_RATIO", "SPARE", "Container", "Heads", "OpenFile", "Segment"]

MAX_CHUNK = 256 * 2**20
"""Largest chunk that is unpacked, bytes. Writers default to 1 to 4 MiB."""
MAX_RATIO = 300
"""Most decompressed bytes for each byte of the file. The states of an idle robot, in which little
more than the times change, reach about 130."""
SPARE = 8 * 2**20
"""Decompressed bytes allowed in addition, for short recordings."""

# Largest schema, channel, metadata or index record that is accepted, bytes.
_MAX_RECORD = 64 * 2**20
# Messages outside of chunks are read in runs of this many bytes.
_RUN = 4 * 2**20
# A checksum is taken over, and the next record is looked for in, this many bytes at a time.
_BLOCK = 2**20
_SCAN = 2**16
# Largest number of times that reading resumes after a damaged record.
_MAX_RESUMED = 1000
# Misplaced records in one chunk after which the rest of the chunk is left out.
_MAX_FOREIGN = 100
_MAX_MESSAGES = 50

_INDEX = struct.Struct("<HI")  # channel, bytes of its entries
HEADS = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log", "publish"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
    }
)
"""A message record up to its payload; ``length`` counts from ``channel`` on."""
Heads = NDArray[np.void]
OpenFile = Callable[[], BinaryIO]
"""Opens a recording that is not a local file; returns a readable, seekable object."""

_IN_SUMMARY = frozenset(
    {
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.STATISTICS,
        Opcode.SUMMARY_OFFSET,
        Opcode.FOOTER,
    }
)
# By opcode: 1 where it may begin a record outside of chunks.
_KNOWN = np.zeros(256, dtype=np.uint64)
for _opcode, _least in LEAST.items():
    _KNOWN[_opcode] = _least
_KNOWN[Opcode.HEADER] = 0  # only once, at the beginning

_crc32 = fastcrc.crc32.iso_hdlc  # zlib's, several times as fast


@dataclass
class Segment:
    """A chunk, or a run of messages outside of chunks.

    :param at: where its record begins in the file.
    :param offset: where its packed records begin.
    :param total: length of its record, bytes; 0 for a run.
    :param index: where its message index lies in the file.
    """

    at: int
    offset: int
    length: int
    total: int = 0
    compression: str = ""
    size: int = 0
    crc: int = 0
    start_ns: int = 0
    end_ns: int = 0
    cut: bool = False
    # channel id -> [messages, first log time, last log time]; None: not known from an index
    counts: dict[int, list[int]] | None = None
    # channel id -> how its log times follow each other
    order: dict[int, Order] = field(default_factory=dict)
    index: tuple[int, int] = (0, 0)
    index_offsets: dict[int, int] = field(default_factory=dict)


class _Snapshot:
    """A file limited to its size when it was opened; a recorder may still be writing to it."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size
        self._at = file.tell()

    def seek(self, at: int) -> int:
        self._at = at  # asking the file for its position takes as long as a read
        return self._file.seek(at)

    def read(self, count: int = -1) -> bytes:
        left = max(0, self._size - self._at)
        data = self._file.read(left if count < 0 else min(count, left))
        self._at += len(data)
        return data


class Container:
    """The records of a file; see :meth:`open`.

    :ivar truncated: the file ends before its end record.
    :ivar damage: contradictions and unreadable parts, as sentences with the offset.
    :ivar warnings: the same, and other irregularities.
    :ivar notes: facts that limit what can be verified.
    """

    def __init__(self, path: Path, open_file: OpenFile | None = None) -> None:
        self.path = path
        self.open_file = open_file or partial(_open_ordinary, path)
        self.truncated = False
        self.damage: list[str] = []
        self.warnings: list[str] = []
        self.notes: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.library = ""
        self.profile = ""
        self.segments: list[Segment] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._found = Found(self.segments, self.schemas, self.channels)
        self._summary = Summary()
        self._bodies: dict[tuple[int, int], bytes] = {}
        # a segment, channel id, and log times of its message index, as they lie in the segment
        self._indexed: list[tuple[Segment, int, NDArray[np.uint64]]] = []
        self._data_end: tuple[int, int] | None = None  # offset, and its CRC
        self._unpacked = 0
        self._size = 0
        self._complete_definitions = False

    @property
    def attachments(self) -> int:
        """Attachments in the file."""
        return len(self._found.attachments)

    @property
    def clock_steps(self) -> list[ClockStep]:
        """Where the log times of a channel step back, in the order of the file."""
        return list(steps_between(segment.order for segment in self.segments))

    # -- warnings ------------------------------------------------------------------------------

    def warn(self, text: str) -> None:
        """Add a warning, unless it is listed already."""
        _append_limited(self.warnings, text)

    def report_damage(self, text: str) -> None:
        """Add damage and a warning, unless it is listed already."""
        _append_limited(self.damage, text)
        _append_limited(self.warnings, text)

    # -- walking the records
    # ------------------------------------------------------------------------------

    def open(self) -> None:
        """Index the file: read short records, note the offsets of chunks and attachments.

        :raises TraceUnreadable: it is missing, not an mcap file, or ends within its header.
        """
        try:
            with self.open_file() as file:
                self._size = _size_of(file)
                snapshot = cast(BinaryIO, _Snapshot(file, self._size))
                self._walk(snapshot, self._read_start(snapshot))
                self._count_indexed()
                sound = self._check_sums(snapshot)
                self._apply_summary_definitions(sound)
                self._complete(snapshot, sound)
        except OSError as error:
            raise TraceUnreadable(f"cannot read {self.path}: {error.strerror or error}") from error
        for text in contradictions(self._summary, self._found, complete=self._complete_definitions):
            self.report_damage(text)

    def _read_start(self, file: BinaryIO) -> int:
        magic = file.read(len(MAGIC))
        close = len(magic) == len(MAGIC) and (
            sum(a != b for a, b in zip(magic, MAGIC, strict=True)) == 1
        )
        if magic != MAGIC and not close:
            raise TraceUnreadable(f"{self.path} is not an mcap file", hint=_guess_format(magic))
        at = len(MAGIC)
        opcode, _, end = next(self._records(file, at), (0, at, at))
        body = at + HEAD.size
        if opcode == Opcode.HEADER and end - body <= _MAX_RECORD and end <= self._size:
            try:
                file.seek(body)
                self.profile, self.library = mcap_records.header(file.read(end - body))
                if close:
                    self.report_damage("the first 8 bytes are not quite those of an mcap file")
                if end == self._size or self._is_record(file, end) or not self._has_end_magic(file):
                    return end
                problem = "the header is followed by nonsense"
            except BadRecord as error:
                problem = f"the header cannot be read ({error})"
        else:
            problem = "it ends, or goes wrong, within its header"
        found = None if close or not self._has_end_magic(file) else self._resume(file, at + 1)
        if found is None:
            raise TraceUnreadable(f"{self.path}: {problem}")
        self.report_damage(problem)
        return found

    def _has_end_magic(self, file: BinaryIO) -> bool:
        """Whether the file ends with the mcap magic bytes, as a finished one does."""
        file.seek(max(0, self._size - len(MAGIC)))
        return file.read() == MAGIC

    def _records(self, file: BinaryIO, at: int) -> Iterator[tuple[int, int, int]]:
        """The records from ``at`` on; see :func:`~dexkit.traces.mcap_records.walk`."""
        return walk(partial(_read_at, file), at, self._size)

    def _walk(self, file: BinaryIO, at: int) -> None:
        size = self._size
        self._run: Segment | None = None
        finished = False
        sure = at  # a missed record may begin from here on
        resumed = 0
        found = self._records(file, at)
        while (record := next(found, None)) is not None:
            opcode, at, end = record
            odd = not _is_possible(opcode, end - at - HEAD.size)
            if odd or end > size:
                if not odd and opcode == Opcode.CHUNK:
                    cut = self._add_chunk(file, at, end)
                    if cut > at:  # its own lengths give its end
                        at = sure = cut
                        found = self._records(file, at)
                        continue
                    if cut == size or not self._has_end_magic(file):
                        break
                behind = None
                if resumed < _MAX_RESUMED and self._data_end is None:
                    behind = self._resume(file, max(sure, at + 1 if odd else at + HEAD.size))
                if behind is None:
                    if odd or self._has_end_magic(file):
                        # zeros are what a file system leaves after a power cut
                        self.report_damage(
                            f"nonsense from byte {at}; the remaining {size - at} bytes are lost"
                        )
                    break
                resumed += 1
                self.report_damage(f"nonsense at byte {at}; {behind - at} bytes are lost")
                self._run = None
                at = sure = behind
                found = self._records(file, at)
                continue
            if opcode == Opcode.FOOTER:
                finished = self._read_footer(file, at, end)
                at = end
                break
            at, sure = self._read_record(file, opcode, at, end)
            if at != end:
                found = self._records(file, at)
        if finished:
            return
        if self._has_end_magic(file):
            self.report_damage("the end of the file is damaged: it has no footer")
            return
        self.truncated = True
        lost = f"; {size - at} bytes after the last whole record" if size > at else ""
        self.warn(f"unfinished recording: read as far as it goes{lost}")

    def _read_record(self, file: BinaryIO, opcode: int, at: int, end: int) -> tuple[int, int]:
        """Read one record, or note its offset.

        :returns: (offset of the next record, offset from which records may have been missed).
        """
        body = at + HEAD.size
        length = end - body
        if opcode == Opcode.MESSAGE:
            if self._run is None or self._run.length > _RUN:
                self._run = Segment(at, at, 0)
                self.segments.append(self._run)
            self._run.length = self._run.size = end - self._run.offset
            return end, body + LEAST[Opcode.MESSAGE]
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._run = None
        if opcode == Opcode.CHUNK:
            end = self._add_chunk(file, at, end)
            return end, end
        if opcode >= mcap_records.PRIVATE:
            self.warn(
                f"a private record (kind {opcode:#x}, {length} bytes) at byte {at} is skipped"
            )
            return end, body
        try:
            if opcode == Opcode.ATTACHMENT:
                self._read_attachment(file, at, end)
            elif length > _MAX_RECORD:
                raise BadRecord(f"it has {length} bytes")
            else:
                file.seek(body)
                self._read_short_record(opcode, file.read(length), at, end)
        except BadRecord as error:
            self.report_damage(f"the record at byte {at} cannot be read ({error}) and is left out")
            return end, body
        return end, end

    def _read_short_record(self, opcode: int, body: bytes, at: int, end: int) -> None:
        behind = self._data_end is not None
        definition = opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
        if opcode == Opcode.DATA_END:
            if behind:
                self.report_damage(f"a second end of the data section at byte {at}")
            (crc,) = struct.unpack_from("<I", body)
            self._data_end = (at, crc)
            self._summary.begin = end
        elif opcode in _IN_SUMMARY or (definition and behind):
            self._summary.add(opcode, body, at, end)
            if not behind:
                self.report_damage(
                    f"a record of the summary lies in the data section, at byte {at}"
                )
        elif definition:
            self.define(opcode, body, at)
        elif opcode == Opcode.METADATA:
            name, entries = mcap_records.metadata(body)
            self.metadata.setdefault(name, {}).update(entries)
            self._found.metadata.append((at, end - at, name))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._read_message_index(body, at, end)
        else:
            raise BadRecord("it is a second header")

    def _resume(self, file: BinaryIO, begin: int) -> int | None:
        """Find the next offset at which three whole records, or the file's last ones, follow.

        The summary section is not searched: if it is damaged, it is left out as a whole.
        """
        size = self._size
        for base in range(begin, size, _SCAN):
            file.seek(base)
            data = np.frombuffer(file.read(_SCAN + 8), dtype=np.uint8)
            if len(data) < HEAD.size:
                break
            n = len(data) - 8
            lengths = rows_at(data, np.arange(1, n), 8).view("<u8")[:, 0] if n > 1 else None
            if lengths is None:
                break
            least = _KNOWN[data[: n - 1]]
            room = np.uint64(max(0, size - base))
            likely = np.flatnonzero((least > 0) & (lengths >= least) & (lengths < room))
            for place in likely.tolist():
                if self._records_follow(file, base + place):
                    return base + int(place)
        return None

    def _records_follow(self, file: BinaryIO, at: int) -> bool:
        """Whether three whole records, or the file's last ones, follow each other from ``at``."""
        whole = 0
        for opcode, begin, end in islice(self._records(file, at), 3):
            possible = opcode != Opcode.HEADER and _is_possible(opcode, end - begin - HEAD.size)
            if not possible or end > self._size:
                return False
            if opcode == Opcode.FOOTER:
                return end + len(MAGIC) == self._size
            if end == self._size:
                return True
            whole += 1
        return whole == 3

    def _add_chunk(self, file: BinaryIO, at: int, end: int) -> int:
        """Index a chunk; return its end by its own lengths, or 0 if it is cut short."""
        size = self._size
        body = at + HEAD.size
        file.seek(body)
        try:
            head = mcap_records.chunk_head(file.read(mcap_records.CHUNK_START))
        except BadRecord as error:
            if end <= size:
                self.report_damage(
                    f"the chunk at byte {at} has no readable header ({error}); left out"
                )
            return end if end <= size else 0
        offset, length, unpacked = body + head.begin, head.packed, head.size
        segment = Segment(
            *(at, offset, length, end - at, head.compression, unpacked, head.crc),
            *(head.start_ns, head.end_ns),
        )
        inner = offset + length
        if inner != end:
            # one of the two lengths is wrong, or the file ends here
            if inner <= size and self._is_record(file, inner):
                self.report_damage(
                    f"the chunk at byte {at} is {inner - at} bytes long, and says {end - at}"
                )
                segment.total = inner - at
            elif end <= size:
                self.report_damage(
                    f"the chunk at byte {at} has {length} bytes in a record of {end - at}"
                )
                segment.length = end - offset
                inner = end
            else:
                inner = end
        if inner > size:
            segment.length, segment.cut = size - offset, True
        most = MAX_RATIO * size + SPARE - self._unpacked
        if max(segment.length, unpacked) > MAX_CHUNK:
            self.report_damage(
                f"the chunk at byte {at} claims {unpacked} bytes, more than {MAX_CHUNK}; left out"
            )
        elif unpacked > most:
            self.report_damage(
                f"the chunk at byte {at} claims {unpacked} bytes: the file's chunks unpack to more "
                f"than {MAX_RATIO} times its size; left out"
            )
        else:
            self._unpacked += unpacked
            self.segments.append(segment)
            return 0 if segment.cut else inner
        self._found.left_out.add(at)
        return 0 if segment.cut else inner

    def _is_record(self, file: BinaryIO, at: int) -> bool:
        """Whether a record, or the end of the file, is there."""
        if at == self._size:
            return True
        opcode, begin, end = next(self._records(file, at), (0, at, at))
        return _is_possible(opcode, end - begin - HEAD.size) and end <= self._size

    def _read_message_index(self, body: bytes, at: int, end: int) -> None:
        channel_id, length = struct.unpack_from("<HI", body)
        if length % 16 or len(body) < 6 + length:
            raise BadRecord("its list does not fit")
        segment = self.segments[-1] if self.segments else None
        if segment is not None:
            begin, stop = segment.index
            due = stop or segment.at + segment.total
        if segment is None or not segment.total or at != due:
            if not self._found.left_out:
                self.report_damage(f"the message index at byte {at} belongs to no chunk")
            return
        segment.index = (begin or at, end)
        segment.index_offsets[channel_id] = at
        if segment.counts is None:
            segment.counts = {}
        if length:
            entries = np.frombuffer(body, "<u8", count=length // 8, offset=6)
            times, places = entries[::2], entries[1::2]
            # in order of the file, which some writers sort by time
            times = times.copy() if (places[1:] >= places[:-1]).all() else times[places.argsort()]
            self._indexed.append((segment, channel_id, times))

    def _count_indexed(self) -> None:
        """Put messages and times of the message indexes into the counts of their segments."""
        if not self._indexed:
            return
        lengths = np.array([len(times) for _, _, times in self._indexed])
        begins = np.cumsum(lengths) - lengths
        every = np.concatenate([times for _, _, times in self._indexed])
        # at once, for a call takes as long as a thousand times
        first, last = np.minimum.reduceat(every, begins), np.maximum.reduceat(every, begins)
        drops = drops_in(every) + 1
        dropping = set((np.searchsorted(begins, drops, "right") - 1)[~np.isin(drops, begins)])
        ends = zip(every[begins].tolist(), every[begins + lengths - 1].tolist(), strict=True)
        entries = zip(lengths.tolist(), first.tolist(), last.tolist(), ends, strict=True)
        for number, ((segment, channel_id, times), (n, least, most, order)) in enumerate(
            zip(self._indexed, entries, strict=True)
        ):
            counts = segment.counts
            assert counts is not None
            known = counts.get(channel_id, [0, least, most])
            counts[channel_id] = [known[0] + n, min(known[1], least), max(known[2], most)]
            segment.order[channel_id] = order_of(times) if number in dropping else Order(*order)
        self._indexed.clear()

    def _read_attachment(self, file: BinaryIO, at: int, end: int) -> None:
        body = at + HEAD.size
        file.seek(body)
        about, begin = mcap_records.attachment(file.read(min(end - body, _BLOCK)))
        stop = body + begin + about.size
        if stop + 4 > end:
            raise BadRecord("its data are longer than the record")
        self._found.attachments.append((at, end - at, about))
        file.seek(stop)
        (crc,) = struct.unpack("<I", file.read(4))
        if crc and _compute_crc(file, body, stop) != crc:
            self.report_damage(
                f"the attachment {about.name[:60]!r} at byte {at} does not match its checksum"
            )

    def _read_footer(self, file: BinaryIO, at: int, end: int) -> bool:
        """Read the last record; return False if the file ends before the 8 bytes after it."""
        file.seek(at + HEAD.size)
        self._summary.footer = mcap_records.footer(file.read(end - at - HEAD.size))
        self._summary.end = at
        if self._size < end + len(MAGIC):
            return False
        file.seek(end)
        if file.read(len(MAGIC)) != MAGIC:
            self.report_damage("the last 8 bytes are not those of an mcap file")
        if self._size > end + len(MAGIC):
            more = self._size - end - len(MAGIC)
            self.report_damage(f"{more} bytes behind the end of the recording are not read")
        return True

    # -- checksums and summary -----------------------------------------------------------------

    def _check_sums(self, file: BinaryIO) -> bool:
        """Verify the checksums of data section and summary; return True if the summary's is
        right.
        """
        summary, footer = self._summary, self._summary.footer
        unsure = []
        if self._data_end is None:
            if not self.truncated:
                self.report_damage("the data section has no end record")
        elif not self._data_end[1]:
            unsure.append("the data section")
        elif _compute_crc(file, 0, self._data_end[0]) != self._data_end[1]:
            self.report_damage(
                f"the data section, bytes 0 to {self._data_end[0]}, does not match its checksum"
            )
        sound = False
        if footer is not None:
            if not footer.crc:
                unsure.append("the summary")
            elif _compute_crc(file, summary.begin or summary.end, summary.end + HEAD.size + 16) == (
                footer.crc
            ):
                sound = True
            else:
                self.report_damage(
                    f"the summary, bytes {summary.begin} to {summary.end}, "
                    "does not match its checksum"
                )
        if bare := sum(1 for s in self.segments if s.total and not s.crc):
            unsure.append(f"{bare} of its chunks")
        if unsure:
            self.notes.append(
                f"no checksum over {', '.join(unsure)}: damage there may not be noticed"
            )
        if self.truncated:
            self.notes.append("unfinished, so no checksum over what lies outside of its chunks")
        return sound

    def _apply_summary_definitions(self, sound: bool) -> None:
        """Use the summary's schemas and channels if its checksum is right."""
        for opcode, body, at in self._summary.definitions if sound else ():
            self._define_if_readable(opcode, body, at)

    def _define_if_readable(self, opcode: int, body: bytes, at: int) -> None:
        try:
            self.define(opcode, body, at)
        except BadRecord as error:
            self.report_damage(f"a definition at byte {at} cannot be read ({error})")

    def define(self, opcode: int, body: bytes, at: int) -> None:
        """Add a schema or channel; a second definition must equal the first."""
        key = (opcode, int.from_bytes(body[:2], "little"))
        before = self._bodies.get(key)
        if before is None:
            if opcode == Opcode.SCHEMA:
                schema = mcap_records.schema(body)
                self.schemas[schema.id] = schema
            else:
                channel = mcap_records.channel(body)
                self.channels[channel.id] = channel
            self._bodies[key] = body
        elif before != body:
            if opcode == Opcode.SCHEMA:
                if self.schemas[key[1]] != mcap_records.schema(body):
                    self.report_damage(
                        f"schema {key[1]} is defined twice, again at byte {at}, differently"
                    )
                return
            known, channel = self.channels[key[1]], mcap_records.channel(body)
            if known != channel:
                both = f", for {known.topic[:200]} and for {channel.topic[:200]}"
                self.report_damage(
                    f"channel {key[1]} is defined twice{both * (known.topic != channel.topic)}, "
                    f"again at byte {at}, differently; the first is used"
                )

    def _complete(self, file: BinaryIO, sound: bool) -> None:
        """Scan the segments without a usable message index; all of them if in doubt."""
        known = sound and bool(self._summary.definitions)
        doubt = bool(self.damage) or any(contradictions(self._summary, self._found, complete=known))
        read = 0
        for number, segment in enumerate(self.segments):
            # the index of the last chunk of an unfinished file may itself be cut
            last = self.truncated and number + 1 == len(self.segments)
            counts = segment.counts
            if (
                doubt
                or last
                or counts is None
                or not (_index_matches_header(segment) and self._are_defined(counts))
            ):
                self._scan_segment(file, segment)
                read += 1
        for opcode, body, at in () if sound else self._summary.definitions:
            self._define_if_readable(opcode, body, at)
        self._complete_definitions = bool(self._summary.definitions) or read == len(self.segments)

    def _are_defined(self, channel_ids: Iterable[int]) -> bool:
        for channel_id in channel_ids:
            channel = self.channels.get(channel_id)
            if channel is None or (channel.schema_id and channel.schema_id not in self.schemas):
                return False
        return True

    def _scan_segment(self, file: BinaryIO, segment: Segment) -> None:
        _, _, heads = self.read(file, segment)
        segment.counts = counts = {}
        segment.order.clear()
        for channel_id, some in by_channel(heads["channel"]):
            log = heads["log"][some]
            segment.order[channel_id] = order_of(log)
            counts[channel_id] = [len(some), int(log.min()), int(log.max())]
        if counts:
            first = min(c[1] for c in counts.values())
            last = max(c[2] for c in counts.values())
            if (
                segment.total
                and not segment.cut
                and (first, last)
                != (
                    segment.start_ns,
                    segment.end_ns,
                )
            ):
                self.report_damage(
                    f"the chunk at byte {segment.at} holds other times than its header says"
                )
            segment.start_ns, segment.end_ns = first, last

    # -- chunks --------------------------------------------------------------------------------

    def read(self, file: BinaryIO, segment: Segment) -> tuple[bytes, NDArray[np.int64], Heads]:
        """Read a segment: its bytes, the offsets of its messages, and their heads.

        Damaged messages are left out and reported, as are contradictions to the message index.
        """
        data = self._unpack(file, segment)
        index = _message_index(file, segment) if segment.index[1] else None
        if index is not None:
            channels, times, starts = index
            heads = _heads_at(data, starts)
            if heads is not None and self._scan_between(data, segment, starts, heads):
                if not (
                    np.array_equal(heads["channel"], channels)
                    and np.array_equal(heads["log"], times)
                ):
                    self._report_index_damage(segment)
                return data, starts, heads
        found: list[int] = []
        self._scan(data, segment, found)
        begins = np.array(found, dtype=np.int64)
        heads = rows_at(data, begins, HEADS.itemsize).view(HEADS)[:, 0]
        whole = data or not segment.size
        if index is not None and whole and not (self.truncated and segment is self.segments[-1]):
            order = np.lexsort((times, starts))
            if not (
                np.array_equal(begins, starts[order])
                and np.array_equal(heads["channel"], channels[order])
                and np.array_equal(heads["log"], times[order])
            ):
                self._report_index_damage(segment)
        return data, begins, heads

    def _report_index_damage(self, segment: Segment) -> None:
        self.report_damage(
            f"the message index of the chunk at byte {segment.at} is not that of its messages"
        )

    def _unpack(self, file: BinaryIO, segment: Segment) -> bytes:
        """Return the decompressed records of a segment; empty if they are damaged."""
        file.seek(segment.offset)
        packed = file.read(segment.length)
        if not segment.total:
            return packed
        where = f"the chunk at byte {segment.at}"
        try:
            if segment.compression == "":
                data, more = packed, False
            elif segment.compression == "zstd":
                data, more = _decompress_zstd(packed, segment.size, segment.cut)
            elif segment.compression == "lz4":
                unpacker = lz4.frame.LZ4FrameDecompressor()
                data = unpacker.decompress(packed, segment.size)
                more = not (unpacker.eof or segment.cut)
            else:
                self.report_damage(f"{where} is compressed with {segment.compression!r}; left out")
                return b""
        except (zstandard.ZstdError, RuntimeError, ValueError, EOFError) as error:
            if not segment.cut:
                self.report_damage(f"{where} is damaged and left out ({error})")
            return b""
        if segment.cut:
            return data[: segment.size]
        if more or len(data) != segment.size:
            self.report_damage(
                f"{where} is damaged (it does not unpack to {segment.size} bytes) and left out"
            )
            return b""
        if segment.crc and _crc32(data) != segment.crc:
            self.report_damage(f"{where} is damaged (its checksum does not match) and left out")
            return b""
        return data

    def _scan_between(
        self, data: bytes, segment: Segment, starts: NDArray[np.int64], heads: Heads
    ) -> bool:
        """Scan what lies between the messages at ``starts``: the definition of a channel comes
        before its first message.

        :returns: whether all of ``data`` are these messages and few other records.
        """
        ends = starts + HEAD.size + heads["length"].astype(np.int64)
        if ends[-1] != len(data) or (ends[:-1] > starts[1:]).any():
            return False
        between = np.flatnonzero(ends[:-1] < starts[1:])
        if len(between) > _MAX_FOREIGN:
            return False
        places = [(0, int(starts[0])), *zip(ends[between], starts[between + 1], strict=True)]
        for begin, end in places:
            found: list[int] = []
            for _, _, at in walk(data, int(begin), int(end), messages=found):
                begin = at
            if found or begin != end:
                return False
        for begin, end in places:
            self._scan(data, segment, [], int(end), begin=int(begin))
        return True

    def _scan(
        self,
        data: bytes,
        segment: Segment,
        found: list[int],
        stop: int | None = None,
        *,
        begin: int = 0,
    ) -> int:
        """Scan the records of a segment; append the offsets of messages to ``found``.

        :param stop: end offset; None for the end of the data.
        :returns: end offset of the last record.
        """
        odd = 0
        bad = ""
        at = after = begin
        for opcode, at, after in walk(data, begin, stop, messages=found):
            if after > len(data):
                bad = "a record is longer than what is left"
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define_if_readable(opcode, data[at + HEAD.size : after], segment.at)
            elif opcode == Opcode.MESSAGE:
                if after - at < HEADS.itemsize:
                    bad = "a message is shorter than its head"
            else:
                odd += 1
                if odd > _MAX_FOREIGN:
                    bad = "too many records that do not belong there"
                else:
                    self.report_damage(
                        f"the chunk at byte {segment.at} holds a record of kind {opcode:#x}, which "
                        f"does not belong there, after {at} bytes"
                    )
            if bad:
                break
        if not bad:
            at = after
            if found and found[-1] >= after:
                at = found[-1] + HEAD.size + HEAD.unpack_from(data, found[-1])[1]
            if stop is None and at != len(data):
                bad = "a record ends within its first 9 bytes"
        if bad and not segment.cut:
            self.report_damage(
                f"records of the chunk at byte {segment.at} go wrong after {at} bytes ({bad})"
            )
        return at


def by_channel(channels: NDArray[np.uint16]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each channel id that occurs, and the indices at which it does."""
    if not len(channels):
        return
    order = np.argsort(channels, kind="stable")
    ordered = channels[order]
    ends = [*(np.flatnonzero(ordered[1:] != ordered[:-1]) + 1).tolist(), len(order)]
    begin = 0
    for end in ends:
        yield int(ordered[begin]), order[begin:end]
        begin = end


def _append_limited(told: list[str], text: str) -> None:
    if text in told or len(told) > _MAX_MESSAGES:
        return
    told.append(text if len(told) < _MAX_MESSAGES else "and more, which is not listed")


def _index_matches_header(segment: Segment) -> bool:
    """Whether the times in a chunk's header equal those of its message index."""
    if not segment.total or not segment.counts:
        return True
    first = min(c[1] for c in segment.counts.values())
    last = max(c[2] for c in segment.counts.values())
    return (first, last) == (segment.start_ns, segment.end_ns)


def _is_possible(opcode: int, length: int) -> bool:
    """Whether a record of that kind can have that length, outside of chunks."""
    return opcode >= mcap_records.PRIVATE or (opcode in LEAST and length >= LEAST[Opcode(opcode)])


def _read_at(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)


def _compute_crc(file: BinaryIO, begin: int, end: int) -> int:
    file.seek(begin)
    crc = 0
    while begin < end:
        data = file.read(min(_BLOCK, end - begin))
        if not data:
            break
        crc = _crc32(data, crc)
        begin += len(data)
    return int(crc)


def _guess_format(magic: bytes) -> str:
    """Guess the format of a file that is not mcap from its first bytes."""
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


def _decompress_zstd(packed: bytes, size: int, cut: bool) -> tuple[bytes, bool]:
    """Decompress at most ``size`` bytes; also return whether more follow."""
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
        return bytes(out[:size]), False
    if size and zstandard.frame_content_size(packed) == size:
        try:  # in one call, into memory of that size
            whole = _of_thread.decompressor.decompress(packed, allow_extra_data=False)
            return whole, False
        except zstandard.ZstdError:
            pass  # damaged, or followed by other data: the readable part is read below
    with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        return reader.read(size), bool(reader.read(1))


class _OfThread(threading.local):
    """A thread's own decompressor; making one takes as long as decompressing a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_of_thread = _OfThread()


def _message_index(
    file: BinaryIO, segment: Segment
) -> tuple[NDArray[np.uint16], NDArray[np.uint64], NDArray[np.int64]]:
    """(channels, times, offsets) of the messages, as a chunk's index has them, by offset."""
    begin, end = segment.index
    file.seek(begin)
    data = file.read(end - begin)
    channels = [np.empty(0, np.uint16)]
    parts: list[NDArray[np.uint64]] = [np.empty(0, np.uint64)]
    for _, at, _ in walk(data):
        entry = at + HEAD.size + _INDEX.size
        if entry > len(data):
            break  # the file has become shorter
        channel, size = _INDEX.unpack_from(data, at + HEAD.size)
        if entry + size > len(data):
            break
        part = np.frombuffer(data, "<u8", size // 8, entry)
        channels.append(np.full(len(part) // 2, channel, np.uint16))
        parts.append(part)
    entries = np.concatenate(parts)
    starts = entries[1::2].view(np.int64)
    order = np.argsort(starts, kind="stable")
    return np.concatenate(channels)[order], entries[::2][order], starts[order]


def _heads_at(data: bytes, starts: NDArray[np.int64]) -> Heads | None:
    """The heads of the messages at these offsets, in rising order; None if one is no message."""
    if not len(starts) or starts[0] < 0 or starts[-1] > len(data) - HEADS.itemsize:
        return None
    heads = rows_at(data, starts, HEADS.itemsize).view(HEADS)[:, 0]
    if (heads["opcode"] != Opcode.MESSAGE).any():
        return None
    lengths = heads["length"].copy()
    return heads if LEAST[Opcode.MESSAGE] <= lengths.min() and lengths.max() <= len(data) else None


def _open_ordinary(path: Path) -> BinaryIO:
    return open_ordinary(
        path,
        error=TraceUnreadable,
        hint="a recording that comes through a pipe must be stored first",
    )


def _size_of(file: BinaryIO) -> int:
    """The bytes of an open file, or of an object that is read as one."""
    try:
        return os.fstat(file.fileno()).st_size
    except OSError:  # no file of this machine
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        return size
