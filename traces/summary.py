"""Read the summary of a recording, and find contradictions to its data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from dexkit.traces import mcap_records
from dexkit.traces.mcap_records import Attachment, ChunkIndex, Footer, Opcode, Statistics

__all__ = ["Found", "Summary", "contradictions"]


class _Chunk(Protocol):
    at: int
    offset: int
    total: int
    length: int
    start_ns: int
    end_ns: int
    size: int
    compression: str
    cut: bool
    counts: dict[int, list[int]] | None
    index: tuple[int, int]
    index_offsets: dict[int, int]


@dataclass
class Found:
    """Contents of the data section.

    :param left_out: offsets of chunks that are too large to be read.
    """

    segments: Sequence[_Chunk]
    schemas: Mapping[int, object]
    channels: Mapping[int, object]
    attachments: list[tuple[int, int, Attachment]] = field(default_factory=list)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    left_out: set[int] = field(default_factory=set)


@dataclass
class Summary:
    """The records after the data section.

    :ivar begin: where they begin in the file; ``end``: where the footer does.
    :ivar definitions: schemas and channels: opcode, body, offset.
    :ivar groups: runs of records of one kind: opcode, begin and end.
    """

    begin: int = 0
    end: int = 0
    footer: Footer | None = None
    definitions: list[tuple[int, bytes, int]] = field(default_factory=list)
    statistics: list[Statistics] = field(default_factory=list)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[tuple[int, int, Attachment]] = field(default_factory=list)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    offsets: list[tuple[int, int, int]] = field(default_factory=list)
    groups: list[list[int]] = field(default_factory=list)

    def add(self, opcode: int, body: bytes, at: int, end: int) -> None:
        """Add one record.

        :raises BadRecord: it cannot be read.
        """
        if self.groups and self.groups[-1][0] == opcode and self.groups[-1][2] == at:
            self.groups[-1][2] = end
        else:
            self.groups.append([opcode, at, end])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.definitions.append((opcode, body, at))
        elif opcode == Opcode.STATISTICS:
            self.statistics.append(mcap_records.statistics(body))
        elif opcode == Opcode.CHUNK_INDEX:
            self.chunks.append(mcap_records.chunk_index(body))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            self.attachments.append(mcap_records.attachment_index(body))
        elif opcode == Opcode.METADATA_INDEX:
            self.metadata.append(mcap_records.metadata_index(body))
        elif opcode == Opcode.SUMMARY_OFFSET:
            self.offsets.append(mcap_records.summary_offset(body))


def contradictions(summary: Summary, found: Found, *, complete: bool) -> Iterator[str]:
    """Contradictions between the summary and the data section, as sentences.

    :param complete: whether all schemas and channels are known.
    """
    if summary.footer is None:
        return
    yield from _layout(summary, summary.footer)
    yield from _chunks(summary, found)
    for what, told, there in (
        ("attachment", summary.attachments, found.attachments),
        ("metadata record", summary.metadata, found.metadata),
    ):
        if not told:
            continue  # indexes may be left out
        by_place = {entry[0]: entry for entry in there}
        for entry in told:
            if (other := by_place.pop(entry[0], None)) is None:
                yield f"the summary lists a {what} at byte {entry[0]}, which is not there"
            elif entry != other:
                yield f"the summary describes the {what} at byte {entry[0]} wrongly"
        for at in by_place:
            yield f"the {what} at byte {at} is not in the summary"
    for statistics in summary.statistics:
        yield from _counts(statistics, summary, found, complete)


def _layout(summary: Summary, footer: Footer) -> Iterator[str]:
    """The footer and the summary's own offsets."""
    begin = summary.begin if summary.groups else 0
    if summary.begin and footer.summary != begin and (footer.summary or summary.groups):
        yield f"the footer says that the summary begins at byte {footer.summary}, not {begin}"
    groups = {tuple(g) for g in summary.groups}
    first = next((g[1] for g in summary.groups if g[0] == Opcode.SUMMARY_OFFSET), 0)
    if footer.offsets != first and (first or footer.offsets != summary.end):
        yield f"the footer says that the summary's offsets begin at byte {footer.offsets}"
    for opcode, at, length in summary.offsets:
        if length and (opcode, at, at + length) not in groups:
            yield f"the summary has no records of kind {opcode:#x} at byte {at}, as it says itself"


def _chunks(summary: Summary, found: Found) -> Iterator[str]:
    if not summary.chunks:
        return
    there = {s.at: s for s in found.segments if s.total}
    listed = {c.at for c in summary.chunks}
    for at in sorted(there.keys() - listed):
        yield f"the chunk at byte {at} is not in the summary"
    for at in sorted(listed - there.keys() - found.left_out):
        yield f"the summary lists a chunk at byte {at}, which is not there"
    if len(listed) != len(summary.chunks):
        yield "the summary lists a chunk twice"
    for chunk in summary.chunks:
        segment = there.get(chunk.at)
        if segment is None:
            continue
        begin, end = segment.index
        if (
            (chunk.length, chunk.packed, chunk.size)
            != (segment.total, segment.length, segment.size)
            or chunk.compression != segment.compression
            or (chunk.start_ns, chunk.end_ns) != (segment.start_ns, segment.end_ns)
        ):
            yield f"the summary describes the chunk at byte {chunk.at} wrongly"
        elif chunk.index_length != end - begin or chunk.offsets != segment.index_offsets:
            yield f"the summary describes the message index of the chunk at byte {chunk.at} wrongly"


def _counts(
    statistics: Statistics, summary: Summary, found: Found, complete: bool
) -> Iterator[str]:
    totals: dict[int, int] = {}
    first, last = 2**64, 0
    for segment in found.segments:
        for channel_id, (count, begin, end) in (segment.counts or {}).items():
            totals[channel_id] = totals.get(channel_id, 0) + count
            first, last = min(first, begin), max(last, end)
    unknown = any(s.counts is None for s in found.segments)
    rows: list[tuple[str, int, int, bool]] = [
        ("chunks", statistics.chunks, sum(1 for s in found.segments if s.total), True),
        ("attachments", statistics.attachments, len(found.attachments), True),
        ("metadata records", statistics.metadata, len(found.metadata), True),
        ("schemas", statistics.schemas, len(found.schemas), complete),
        ("channels", statistics.channels, len(found.channels), complete),
        ("messages", statistics.messages, sum(totals.values()), not unknown),
    ]
    for what, said, are, known in rows:
        if known and said != are:
            yield f"the summary counts {said} {what}, there are {are}"
    if unknown:
        return
    said_by = {k: n for k, n in statistics.by_channel.items() if n}
    if said_by and said_by != totals:
        wrong = sorted(k for k in said_by.keys() | totals.keys() if said_by.get(k) != totals.get(k))
        k = wrong[0]
        yield (
            f"the summary counts {said_by.get(k, 0)} messages of channel {k}, there are "
            f"{totals.get(k, 0)}"
        )
    if totals and (statistics.start_ns, statistics.end_ns) != (first, last):
        yield "the summary has other times of the first and last message than the chunks"
