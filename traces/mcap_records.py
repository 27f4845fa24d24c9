"""Walk and parse the records of an mcap file (mcap.dev/spec), strictly.

A record is an opcode, a length and a body. :func:`walk` yields the offsets of records in a file or
in the bytes of a chunk. Each of the other functions takes a body and raises :class:`BadRecord`
where its inner lengths do not fit. Bytes after the last known field are allowed, because later
versions of the format may add some.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from mcap.opcode import Opcode

__all__ = [
    "CHUNK_START",
    "HEAD",
    "LEAST",
    "MAGIC",
    "PRIVATE",
    "Attachment",
    "BadRecord",
    "Channel",
    "ChunkHead",
    "ChunkIndex",
    "Footer",
    "Opcode",
    "Schema",
    "Statistics",
    "attachment",
    "attachment_index",
    "channel",
    "chunk_head",
    "chunk_index",
    "footer",
    "header",
    "metadata",
    "metadata_index",
    "schema",
    "statistics",
    "summary_offset",
    "walk",
]

MAGIC = b"\x89MCAP0\r\n"
"""Beginning and end of every file."""
PRIVATE = 0x80
"""From this opcode on, records belong to applications, and may be anything."""
HEAD = struct.Struct("<BQ")
"""Opcode and length of what follows, bytes."""
CHUNK_START = 60
"""Bytes of a chunk's body that hold all its fields but the packed records. The name of the
compression has at most 16 characters."""
LEAST = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 64,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
"""Shortest body of each kind of record, bytes."""

# A walk through a file reads this many bytes at a time; a few records between chunks.
_BLOCK = 512

_UINT16 = struct.Struct("<H")
_UINT32 = struct.Struct("<I")
_UINT64 = struct.Struct("<Q")
_TWO_IDS = struct.Struct("<HH")
_TWO = struct.Struct("<QQ")
_FOUR = struct.Struct("<QQQQ")
_FIVE = struct.Struct("<QQQQQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<QQI")
_OFFSET = struct.Struct("<BQQ")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_ENTRY = struct.Struct("<HQ")


class BadRecord(ValueError):
    """A record whose lengths do not fit it, or whose text is not UTF-8."""


class Schema(NamedTuple):
    """A type: the text of its definition."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic, of one type."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class ChunkHead(NamedTuple):
    """A chunk without its records.

    :param size: bytes of the records, unpacked; ``packed``: as they lie in the file.
    :param crc: of the unpacked records; 0 if it is not known.
    :param begin: where the packed records begin in the body.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    packed: int
    begin: int


class ChunkIndex(NamedTuple):
    """A chunk's entry in the summary. ``offsets``: each channel's message index in the file."""

    start_ns: int
    end_ns: int
    at: int
    length: int
    offsets: dict[int, int]
    index_length: int
    compression: str
    packed: int
    size: int


class Statistics(NamedTuple):
    """The summary's statistics of the whole file."""

    messages: int
    schemas: int
    channels: int
    attachments: int
    metadata: int
    chunks: int
    start_ns: int
    end_ns: int
    by_channel: dict[int, int]


class Attachment(NamedTuple):
    """An attachment without its data, or its entry in the summary."""

    log_ns: int
    create_ns: int
    name: str
    media_type: str
    size: int


class Footer(NamedTuple):
    """Where the summary and its offsets begin (0: there are none), and its CRC (0: not known)."""

    summary: int
    offsets: int
    crc: int


class _Fields:
    """Reads the fields of a body in order."""

    def __init__(self, body: bytes) -> None:
        self.body = body
        self.at = 0

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        if self.at + form.size > len(self.body):
            raise BadRecord("it ends within a field")
        found = form.unpack_from(self.body, self.at)
        self.at += form.size
        return found

    def data(self) -> bytes:
        (length,) = self.take(_UINT32)
        if self.at + length > len(self.body):
            raise BadRecord("a field is longer than the record")
        self.at += length
        return self.body[self.at - length : self.at]

    def text(self) -> str:
        try:
            return self.data().decode()
        except UnicodeDecodeError:
            raise BadRecord("a text is not UTF-8") from None

    def texts(self) -> dict[str, str]:
        (length,) = self.take(_UINT32)
        end = self.at + length
        found: dict[str, str] = {}
        while self.at < end:
            key = self.text()
            found[key] = self.text()
        if self.at != end:
            raise BadRecord("a list is longer than it says")
        return found

    def numbers(self) -> dict[int, int]:
        entries = self.data()
        if len(entries) % _ENTRY.size:
            raise BadRecord("a list ends within an entry")
        return dict(_ENTRY.iter_unpack(entries))


def walk(
    source: bytes | Callable[[int, int], bytes],
    at: int = 0,
    stop: int | None = None,
    *,
    messages: list[int] | None = None,
) -> Iterator[tuple[int, int, int]]:
    """Walk from record to record; yield opcode, begin and end of each.

    Only the heads are read. The walk checks only that a whole head lies before ``stop``. A record
    that ends after ``stop`` is cut short or damaged; it is yielded as the last one. To continue
    after damage, start another walk there.

    :param source: the bytes, or a function that reads them from a file: (offset, count) -> bytes.
    :param at: offset of the first record.
    :param stop: end of the last one; needed for a file.
    :param messages: list that takes the offset of each whole message; they are not yielded then,
        which is three times as fast.
    """
    message, least = (-1 if messages is None else int(Opcode.MESSAGE)), LEAST[Opcode.MESSAGE]
    places: list[int] = [] if messages is None else messages
    note = places.append
    unpack, size = HEAD.unpack_from, HEAD.size
    if isinstance(source, bytes):
        stop = len(source) if stop is None else min(stop, len(source))
    assert stop is not None
    while at <= stop - size:
        if isinstance(source, bytes):
            window, base, last = source, 0, stop - size
        else:
            window, base = source(at, _BLOCK), at
            last = min(stop, base + len(window)) - size
            if last < at:
                return  # the file has become shorter
        while at <= last:
            opcode, length = unpack(window, at - base)
            end = at + size + length
            if opcode == message and length >= least and end <= stop:
                note(at)
            else:
                yield opcode, at, end
            at = end


def header(body: bytes) -> tuple[str, str]:
    """(profile, library)"""
    fields = _Fields(body)
    return fields.text(), fields.text()


def schema(body: bytes) -> Schema:
    """A Schema record."""
    fields = _Fields(body)
    (number,) = fields.take(_UINT16)
    return Schema(number, fields.text(), fields.text(), fields.data())


def channel(body: bytes) -> Channel:
    """A Channel record."""
    fields = _Fields(body)
    number, schema_id = fields.take(_TWO_IDS)
    return Channel(number, schema_id, fields.text(), fields.text(), fields.texts())


def metadata(body: bytes) -> tuple[str, dict[str, str]]:
    """(name, entries)"""
    fields = _Fields(body)
    return fields.text(), fields.texts()


def attachment(body: bytes) -> tuple[Attachment, int]:
    """An attachment from its first bytes, and where its data begin in the body."""
    fields = _Fields(body)
    log, created = fields.take(_TWO)
    name, kind = fields.text(), fields.text()
    (size,) = fields.take(_UINT64)
    return Attachment(log, created, name, kind, size), fields.at


def chunk_head(body: bytes) -> ChunkHead:
    """A Chunk record from its first :data:`CHUNK_START` bytes."""
    fields = _Fields(body)
    start, end, size, crc = fields.take(_CHUNK)
    compression = fields.text()
    (packed,) = fields.take(_UINT64)
    return ChunkHead(start, end, size, crc, compression, packed, fields.at)


def chunk_index(body: bytes) -> ChunkIndex:
    """A Chunk Index record."""
    fields = _Fields(body)
    start, end, at, length = fields.take(_FOUR)
    offsets = fields.numbers()
    (index_length,) = fields.take(_UINT64)
    compression = fields.text()
    packed, size = fields.take(_TWO)
    return ChunkIndex(start, end, at, length, offsets, index_length, compression, packed, size)


def attachment_index(body: bytes) -> tuple[int, int, Attachment]:
    """(offset, length, attachment without its data)"""
    fields = _Fields(body)
    at, length, log, created, size = fields.take(_FIVE)
    return at, length, Attachment(log, created, fields.text(), fields.text(), size)


def metadata_index(body: bytes) -> tuple[int, int, str]:
    """(offset, length, name)"""
    fields = _Fields(body)
    at, length = fields.take(_TWO)
    return at, length, fields.text()


def statistics(body: bytes) -> Statistics:
    """A Statistics record."""
    fields = _Fields(body)
    counts = fields.take(_STATISTICS)
    return Statistics._make((*counts, fields.numbers()))


def summary_offset(body: bytes) -> tuple[int, int, int]:
    """(opcode of the group, its offset, its length)"""
    opcode, at, length = _Fields(body).take(_OFFSET)
    return opcode, at, length


def footer(body: bytes) -> Footer:
    """A Footer record."""
    return Footer(*_Fields(body).take(_FOOTER))
