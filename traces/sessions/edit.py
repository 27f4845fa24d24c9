"""Cut a recording, and merge several into one. Payloads, times and schemas stay as they are."""

from __future__ import annotations

import heapq
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np

from dexkit.digests import sha256_of_file
from dexkit.errors import SessionError, TraceError, UsageError
from dexkit.traces.clock_steps import refuse_clock_steps
from dexkit.traces.names import CUT, RECORDER, select_topics
from dexkit.traces.reader import Trace, TraceMessage
from dexkit.traces.sessions.imported import NOMINAL, import_record
from dexkit.traces.writer import RecordingWriter

__all__ = ["CUT", "MERGE", "Merged", "Span", "clock_offset", "cut", "merge"]

MERGE = "dexkit_merge"
"""Name of the metadata record."""

Metadata = Mapping[str, Mapping[str, str]]

# Totals of the recorder, which apply to the whole recording only.
_TOTALS = ("messages",)
# ns of recorded time within which a second copy of a message is looked for.
_WINDOW = 2 * 10**9
# Fewest common messages for a comparison of two clocks.
_LEAST_COMMON = 10


@dataclass(frozen=True)
class Span:
    """Log times in [begin, end), ns since the epoch."""

    begin_ns: int
    end_ns: int

    def __post_init__(self) -> None:
        if self.end_ns <= self.begin_ns:
            raise UsageError("the end must be later than the begin")


@dataclass(frozen=True)
class Merged:
    """Result of a merge.

    :param written: messages in the result.
    :param duplicates: duplicate messages that were left out.
    """

    written: int
    duplicates: int


def cut(
    trace: Trace,
    out: str | os.PathLike[str],
    *,
    spans: Sequence[Span] = (),
    topics: Sequence[str] | None = None,
    stretch: int | None = None,
    metadata: Metadata | None = None,
    overwrite: bool = False,
) -> int:
    """Write a part of a recording.

    :param spans: the times to keep; none for all. They may overlap.
    :param stretch: the stretch of time to keep, from 0, of a recording whose clock steps back.
    :param topics: those to keep, in any spelling, patterns allowed; None for all.
    :param metadata: metadata records in place of the recording's.
    :returns: the number of messages written.
    :raises UsageError: a topic is not in the recording, nothing is left, or ``out`` exists.
    :raises SessionError: its clock steps back, and no stretch is named.
    :raises TraceError: it cannot be written.
    """
    _refuse_same(out, [trace])
    if stretch is None:
        refuse_clock_steps(trace.path, trace.clock_steps)
    picked = trace.topics
    if topics is not None:
        picked, missing = select_topics(trace.topics, topics)
        if missing:
            raise UsageError(
                f"{trace.path.name} has no topic {', '.join(missing)}",
                hint=f"it has: {', '.join(trace.topics) or 'none'}",
            )
    about = {
        "source": trace.path.name,
        "source_sha256": sha256_of_file(trace.path),
        "spans": "; ".join(f"{s.begin_ns} {s.end_ns}" for s in spans) or "all",
        "topics": " ".join(picked) if topics is not None else "all",
        **({} if stretch is None else {"stretch": str(stretch)}),
    }
    with RecordingWriter(out, overwrite=overwrite) as writer:
        _write_metadata(writer, _copied(trace.metadata if metadata is None else metadata))
        writer.add_metadata(CUT, about)
        numbers = {
            key: writer.add_channel(d) for key, d in trace.definitions.items() if key[0] in picked
        }
        for m in _of_stretch(trace, stretch, picked):
            if not spans or any(s.begin_ns <= m.log_time_ns < s.end_ns for s in spans):
                writer.put(numbers[m.topic, m.type_name], m.data, m.log_time_ns, m.publish_time_ns)
        if not writer.written:
            raise UsageError(
                "nothing is left: no message of these topics lies in these times",
                hint=f"{trace.path.name} has {trace.duration:.3f} s of "
                f"{', '.join(trace.topics) or 'no topics'}",
            )
        return writer.written


def _of_stretch(trace: Trace, stretch: int | None, picked: Sequence[str]) -> Iterator[TraceMessage]:
    """The messages of a stretch of time; of all, if there is one only."""
    if stretch is None:
        yield from trace.messages(picked)
        return
    wanted = set(picked)
    for number, m in trace.stretches():
        if number == stretch and m.topic in wanted:
            yield m


def clock_offset(reference: Trace, other: Trace) -> float:
    """Seconds by which the clock that received ``other`` is ahead of the reference's.

    Taken from messages that both have: those of one topic with the same source timestamp and
    payload.

    :raises UsageError: they have fewer than ten of them.
    """
    times = {_identity(m): m.log_time_ns for m in reference.messages() if m.publish_time_ns}
    apart = [
        m.log_time_ns - times[key]
        for m in other.messages()
        if m.publish_time_ns and (key := _identity(m)) in times
    ]
    if len(apart) < _LEAST_COMMON:
        raise UsageError(
            f"{reference.path.name} and {other.path.name} have {len(apart)} messages in common, "
            f"too few to compare their clocks",
            hint="state the shift yourself with --shift",
        )
    return float(np.median(apart)) / 1e9


def merge(
    traces: Sequence[Trace],
    out: str | os.PathLike[str],
    *,
    shifts: Sequence[float] | None = None,
    overwrite: bool = False,
) -> Merged:
    """Write several recordings as one, in order of log time.

    A message that several of them have (same topic, type, source timestamp and payload, within 2 s)
    is written once. Of metadata records that differ, the later ones get their file's name.

    :param shifts: seconds to add to the log times of each.
    :raises UsageError: ``out`` exists or is one of them; or times become negative.
    :raises SessionError: the clock of one steps back, or their times or hands have nothing to do
        with each other.
    :raises TraceError: it cannot be written.
    """
    _refuse_same(out, traces)
    for trace in traces:
        refuse_clock_steps(trace.path, trace.clock_steps)
    _refuse_unrelated(traces, shifts)
    moved = [round(s * 1e9) for s in shifts] if shifts is not None else [0] * len(traces)
    about: dict[str, str] = {}
    with RecordingWriter(out, overwrite=overwrite) as writer:
        records: dict[str, dict[str, str]] = {}
        for number, (trace, shift) in enumerate(zip(traces, moved, strict=True), 1):
            about[f"source {number}"] = trace.path.name
            about[f"source_sha256 {number}"] = sha256_of_file(trace.path)
            about[f"shift_ns {number}"] = str(shift)
            for name, values in _copied(trace.metadata).items():
                if records.setdefault(name, values) != values:
                    records[f"{name} ({number}: {trace.path.name})"] = values
        _write_metadata(writer, records)
        numbers: dict[tuple[str, str], int] = {}
        known: dict[tuple[str, str], object] = {}
        for trace in traces:
            for key, d in trace.definitions.items():
                if key not in numbers:
                    numbers[key], known[key] = writer.add_channel(d), d.schema
                elif d.schema != known[key]:
                    raise TraceError(
                        f"{key[0]} has another schema in {trace.path.name} than in the files "
                        "before it",
                        hint="merge files of one writer, or import them first",
                    )
        recent: deque[tuple[int, bytes]] = deque()
        seen: set[bytes] = set()
        duplicates = 0
        sources = [_shifted(t, s) for t, s in zip(traces, moved, strict=True)]
        for time_ns, m in heapq.merge(*sources, key=lambda entry: entry[0]):
            if m.publish_time_ns:
                while recent and recent[0][0] < time_ns - _WINDOW:
                    seen.discard(recent.popleft()[1])
                identity = _identity(m)
                if identity in seen:
                    duplicates += 1
                    continue
                seen.add(identity)
                recent.append((time_ns, identity))
            writer.put(numbers[m.topic, m.type_name], m.data, time_ns, m.publish_time_ns)
        writer.add_metadata(MERGE, {**about, "duplicates": str(duplicates)})
        return Merged(writer.written, duplicates)


def _refuse_unrelated(traces: Sequence[Trace], shifts: Sequence[float] | None) -> None:
    """Refuse recordings that have no time in common, or are of two robots.

    :raises SessionError: they are.
    """
    nominal = [
        t
        for i, t in enumerate(traces)
        if import_record(t).clock == NOMINAL and not (shifts is not None and shifts[i])
    ]
    if nominal and len(traces) - sum(map(bool, shifts or ())) > 1:
        raise SessionError(
            f"{nominal[0].path} has nominal times: its source has none, and what it has in common "
            "with the other recordings is not known",
            hint="'dexkit import --wire' finds its times in a recording; or state where it begins: "
            "--shift FILE=S",
        )
    domains: dict[str, tuple[str, Trace]] = {}
    for trace in traces:
        for channel in trace.channels:
            domain = channel.metadata.get("dds.domain", "")
            if not (domain and channel.message_count):
                continue
            other, first = domains.setdefault(channel.topic, (domain, trace))
            if other != domain:
                raise SessionError(
                    f"{channel.topic} is of domain {other} in {first.path}, and of domain {domain} "
                    f"in {trace.path}: of two robots, whose messages could not be told apart",
                    hint="keep their recordings apart",
                )


def _shifted(trace: Trace, shift_ns: int) -> Iterator[tuple[int, TraceMessage]]:
    for m in trace.messages():
        yield m.log_time_ns + shift_ns, m


def _identity(m: TraceMessage) -> bytes:
    digest = blake2b(m.data, digest_size=12)
    digest.update(f"{m.publish_time_ns} {m.topic} {m.type_name}".encode())
    return digest.digest()


def _copied(metadata: Metadata) -> dict[str, dict[str, str]]:
    """Metadata records without the recorder's totals."""
    found = {name: dict(values) for name, values in metadata.items()}
    for key in _TOTALS:
        found.get(RECORDER, {}).pop(key, None)
    return found


def _write_metadata(writer: RecordingWriter, metadata: Metadata) -> None:
    for name, values in metadata.items():
        writer.add_metadata(name, values)


def _refuse_same(out: str | os.PathLike[str], traces: Sequence[Trace]) -> None:
    for trace in traces:
        if Path(out).exists() and os.path.samefile(out, trace.path):
            raise UsageError(f"{os.fspath(out)} is read and would be overwritten")
