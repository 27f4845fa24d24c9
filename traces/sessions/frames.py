"""Sample a recording as frames of one rate: states interpolated, commands held, no values in gaps.

The grid is in the recording's own time: frame k is at start + k / fps. In a gap of a stream there
is no frame, and a new run of frames begins after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError, WireError
from dexkit.hand import Floats
from dexkit.traces.names import SESSION
from dexkit.traces.reader import Trace, TraceMessage, signed_times
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.imported import RECORD, ImportRecord, import_record
from dexkit.traces.sessions.model import REST_TOPIC
from dexkit.traces.sessions.paths import below
from dexkit.traces.sessions.pictures import read_picture
from dexkit.traces.sessions.resample import gap_of, hold, interpolate, period_of
from dexkit.traces.sessions.streams import (
    COMMAND,
    FIELDS,
    Pressure,
    Stream,
    pressures_of,
    streams_of,
)
from dexkit.traces.sessions.typed import parse_record

__all__ = ["RULE", "Frames", "Pictures", "Source", "open_source", "sample"]

RULE = (
    "states and touch are interpolated between their neighbours, commands and pictures are the "
    "newest at the time of the frame (zero-order hold); no frame lies in a gap of any of them, "
    "which is ten usual periods, at least 0.1 s"
)
_LEAST = 2  # frames of a run
_MOST = 10_000_000
"""Frames of a recording, those in gaps included: 92 hours at 30 Hz."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The single pictures of a camera.

    :param load: returns the encoded picture at an index; None if it is not available.
    :param paths: their files, present or former, relative to the session.
    """

    camera: str
    times_ns: NDArray[np.int64]
    load: Callable[[int], bytes | None]
    paths: tuple[str, ...] = ()


@dataclass(eq=False)
class Source:
    """A recording to be sampled.

    :param streams: those with at least two samples.
    :param pressures: what the hands feel, likewise.
    :param pictures: those that can be read.
    :param absent: those of which only the paths are known.
    :param imported: how it was imported.
    :param lost: data that frames cannot represent.
    :param problems: data that cannot be read.
    """

    trace: Trace
    streams: list[Stream]
    pressures: list[Pressure]
    pictures: list[Pictures]
    absent: list[Pictures]
    imported: ImportRecord
    lost: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def measured(self) -> dict[str, float]:
        """Hz of each topic, from its usual period."""
        found = {s.topic: _rate(s.times_ns) for s in self.streams}
        found |= {tactile.topic: _rate(tactile.times_ns) for tactile in self.pressures}
        found |= {p.camera: _rate(p.times_ns) for p in self.pictures}
        return {name: rate for name, rate in found.items() if rate}

    @property
    def rate(self) -> float:
        """Its natural frame rate, Hz: of its pictures, else its commands, else its states."""
        for times in (
            [p.times_ns for p in self.pictures],
            [s.times_ns for s in self.streams if s.kind == COMMAND],
            [s.times_ns for s in self.streams],
        ):
            rates = [r for t in times if (r := _rate(t))]
            if rates:
                return min(rates)
        return 0.0


@dataclass(frozen=True, eq=False)
class Frames:
    """One run of frames without a gap.

    :param times_ns: shape (n,).
    :param values: by part, kind and field; shape (n, joints).
    :param pressure: by part, shape (n, elements).
    :param pictures: by camera, the index of each frame's picture.
    """

    times_ns: NDArray[np.int64]
    values: dict[tuple[str, str, str], Floats]
    pressure: dict[str, Floats]
    pictures: dict[str, NDArray[np.intp]]

    def __len__(self) -> int:
        return len(self.times_ns)


def _rate(times: NDArray[np.int64]) -> float:
    period = period_of(times)
    return 1.0 / period if period > 0 else 0.0


def open_source(trace: Trace, pictures: Path | None = None) -> Source:
    """The streams and pictures of a recording.

    :param pictures: the folder that was imported, in which pictures are looked for that are not in
        the recording; None not to read them. A recording cannot choose it.
    :raises SessionError: it has no joints, or the record of its import is not valid.
    """
    imported = import_record(trace)
    lost = []
    streams = []
    # those of an aligned episode say that they are of a DDS recording
    for stream in streams_of(trace, keep_samples=bool(imported.aligned)):
        if len(stream) >= _LEAST:
            streams.append(stream)
        else:
            lost.append(f"{stream.topic}: a single sample")
    if not streams:
        raise SessionError(f"{trace.path} has no joints of a known hand, robot or session")
    pressures: list[Pressure] = []
    problems = []
    for tactile in pressures_of(trace, streams):
        if tactile.unusable:
            text = (
                f"{tactile.topic}: {tactile.unusable} messages whose lists are not as long as "
                "the areas"
            )
            problems.append(text)
        if len(tactile) >= _LEAST:
            pressures.append(tactile)
        else:
            lost.append(f"{tactile.topic}: {'a single' if len(tactile) else 'no usable'} sample")
    known = {s.topic for s in streams} | {tactile.topic for tactile in pressures}
    for channel in trace.channels:
        if channel.message_count and channel.topic not in known | _session_topics(trace):
            lost.append(f"{channel.topic}: no joints in it")
    if REST_TOPIC in trace.topics:
        lost.append(f"{REST_TOPIC}: what an imported session has beside joints and pictures")
    readable, absent = _pictures(trace, imported, pictures, lost, problems)
    commands = [s for s in streams if s.kind == COMMAND]
    if there := [f for f in FIELDS[COMMAND][1:] if any(f in s.values for s in commands)]:
        lost.append(f"{', '.join(there)} of the commands")
    return Source(trace, streams, pressures, readable, absent, imported, lost, problems)


def _session_topics(trace: Trace) -> set[str]:
    return {t for t in trace.topics if t.startswith(SESSION)}


class _Reference(msgspec.Struct):
    """Where a picture is: its file, and the time in it if it is a video."""

    path: str
    seconds: float | None = None


def _pictures(
    trace: Trace,
    imported: ImportRecord,
    folder: Path | None,
    lost: list[str],
    problems: list[str],
) -> tuple[list[Pictures], list[Pictures]]:
    """The cameras whose pictures can be read, and those of which only the paths are known."""
    found, absent = [], []
    filled = {c.topic for c in trace.channels if c.message_count}
    for name in imported.cameras:
        embedded = ros_types.group_topic(name, "compressed")
        referenced = ros_types.group_topic(name, "reference")
        if embedded in filled:
            messages = list(trace.messages([embedded]))
            found.append(Pictures(name, _times(messages), _embedded(messages)))
        elif referenced in filled:
            messages = list(trace.messages([referenced]))
            entries = [_reference(trace, m) for m in messages]
            if any(e.seconds is not None for e in entries):
                lost.append(f"{name}: its video stays where it is")
                continue
            paths = tuple(e.path for e in entries)
            if folder is None:
                absent.append(Pictures(name, _times(messages), lambda i: None, paths))
                problems.append(
                    f"{name}: its pictures are left out, which are not in the recording; name the "
                    "folder that was imported: --pictures DIR"
                )
                continue
            load = _referenced(_session_folder(trace, imported, folder), paths)
            found.append(Pictures(name, _times(messages), load, paths))
    return found, absent


def _session_folder(trace: Trace, imported: ImportRecord, folder: Path) -> Path:
    """The session's folder in what was imported, or that itself."""
    place = imported.pictures_folder
    if PurePosixPath(place).is_absolute():  # so wrote dexkit 0.1; nothing is looked for there
        return folder
    try:
        found = below(folder, place)
    except SessionError as error:
        raise SessionError(f"{trace.path}: pictures_folder of {RECORD}: {error.message}") from error
    return found if found.is_dir() else folder


def _times(messages: Sequence[TraceMessage]) -> NDArray[np.int64]:
    return signed_times(np.array([m.log_time_ns for m in messages], dtype=np.uint64))


def _embedded(messages: Sequence[TraceMessage]) -> Callable[[int], bytes | None]:
    def load(i: int) -> bytes | None:
        try:
            return ros_types.decode_compressed_image(messages[i].data).data
        except WireError:
            return None

    return load


def _referenced(folder: Path, paths: Sequence[str]) -> Callable[[int], bytes | None]:
    def load(i: int) -> bytes | None:
        picture, _ = read_picture(folder, paths[i])
        return picture.data if picture is not None else None

    return load


def _reference(trace: Trace, message: TraceMessage) -> _Reference:
    origin = f"{trace.path}: {message.topic} at {message.log_time_ns} ns"
    try:
        return parse_record(ros_types.decode_string(message.data), _Reference, origin)
    except WireError as error:
        raise SessionError(f"{origin}: {error}") from error


def sample(source: Source, fps: float) -> tuple[list[Frames], list[str]]:
    """The frames of a recording in runs without gaps, and descriptions of omitted data.

    :raises SessionError: there is no time at which all streams have values.
    """
    every = [s.times_ns for s in source.streams] + [p.times_ns for p in source.pictures]
    every += [tactile.times_ns for tactile in source.pressures]
    begin = max(int(t[0]) for t in every)
    end = min(int(t[-1]) for t in every)
    name = source.trace.path.name
    if end <= begin:
        raise SessionError(f"{name}: its streams have no time in common")
    count = int((end - begin) * fps / 1e9 + 1e-6) + 1
    if count > _MOST:
        raise SessionError(
            f"{name}: {(end - begin) / 1e9:.0f} s at {fps:g} Hz are more than {_MOST} frames",
            hint="is a time in it wrong? 'dexkit info' shows them, 'dexkit cut' writes a part",
        )
    grid = begin + np.rint(np.arange(count) * 1e9 / fps).astype(np.int64)
    good = np.ones(count, dtype=np.bool_)
    values: dict[tuple[str, str, str], Floats] = {}
    pressure: dict[str, Floats] = {}
    for s in source.streams:
        method = hold if s.kind == COMMAND else interpolate
        for f, table in s.values.items():
            values[s.part, s.kind, f] = made = method(s.times_ns, table, grid)
            if f == "q":
                good &= np.isfinite(made).all(axis=1)
    for tactile in source.pressures:
        pressure[tactile.part] = tactile.at(grid)
        good &= tactile.is_known(grid)
    shown: dict[str, NDArray[np.intp]] = {}
    for p in source.pictures:
        places = np.arange(len(p.times_ns), dtype=np.float64)[:, None]
        newest = hold(p.times_ns, places, grid, max(gap_of(p.times_ns), 1.5 / fps))[:, 0]
        good &= np.isfinite(newest)
        shown[p.camera] = np.nan_to_num(newest).astype(np.intp)
    runs, told = [], []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    for a, b in edges.reshape(-1, 2).tolist():
        if b - a < _LEAST:
            told.append(f"a single frame between gaps, {(grid[a] - begin) / 1e9:.3f} s after start")
            continue
        cut = slice(a, b)
        runs.append(
            Frames(
                grid[cut],
                {k: v[cut] for k, v in values.items()},
                {k: v[cut] for k, v in pressure.items()},
                {k: v[cut] for k, v in shown.items()},
            )
        )
    if not runs:
        raise SessionError(f"{name}: there is no frame at which all streams have values")
    if len(runs) > 1:
        told.append(
            f"{count - int(good.sum())} frames in gaps: it is written as {len(runs)} episodes"
        )
    return runs, told
