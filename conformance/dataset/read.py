"""Make an episode of what the importers read, or of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode, Gap, Track
from dexkit.errors import SessionError
from dexkit.hand import Floats
from dexkit.models import MODELS
from dexkit.traces.reader import Trace
from dexkit.traces.sessions.carried import format_of
from dexkit.traces.sessions.episodes import read_episode
from dexkit.traces.sessions.imported import MEASURED, import_record
from dexkit.traces.sessions.lerobot_in import Dataset
from dexkit.traces.sessions.model import Part, Session
from dexkit.traces.sessions.resample import gap_of, hold, interpolate
from dexkit.traces.sessions.streams import COMMAND, STATE, Stream, pressures_of, streams_of

__all__ = [
    "episode_of_dataset",
    "episode_of_recording",
    "episode_of_session",
    "read_quickly",
]

_FASTEST = 50.0
"""Frames per second, at most, at which a recording is looked at; hands move below 5 Hz."""
_LONGEST = 4 * 3600.0  # s of a recording
_LEAST_GAP = 0.25  # s without a message: 7 frames of 30 Hz


def episode_of_dataset(dataset: Dataset, number: int) -> Episode:
    """An episode of a LeRobot dataset.

    :raises SessionError: its data are missing or of another form than the features declare.
    """
    session = dataset.read(number, joints_only=True)
    episode = episode_of_session(session)
    episode.stated = dataset.statistics(number)
    return episode


def read_quickly(folder: Path) -> Episode:
    """An episode of xr_teleoperate; hands are left as they are in it.

    :raises SessionError: no frame in it can be used.
    """
    return episode_of_session(read_episode(folder, joints_only=True))


def episode_of_session(session: Session) -> Episode:
    """An episode of frames: of a dataset, or of xr_teleoperate."""
    times = (session.times_ns - session.times_ns[0]) / 1e9
    tasks = session.about.get("task")
    return Episode(
        name=session.name,
        form=session.form,
        fps=session.stated_rate or session.rate,
        t=times,
        tracks=[_track_of_part(part, session.touches.get(part.name)) for part in session.parts],
        measured=session.clock == MEASURED,
        stamps=session.stamps,
        numbers=session.numbers,
        gaps=[] if session.clock != MEASURED else _gaps(session.times_ns, "frames"),
        tasks=None if tasks is None else [tasks] if tasks.strip() else [],
        features=session.features,
        cameras=session.cameras,
        folder=session.folder,
        problems=[*session.corrections, *session.problems.sentences()],
    )


def _track_of_part(part: Part, touch: Floats | None) -> Track:
    state, command = part.values.get(STATE, {}), part.values.get(COMMAND, {})
    return Track(
        part.name,
        part.joints,
        state=state.get("q"),
        action=command.get("q"),
        dq=state.get("dq"),
        tau=state.get("tau"),
        touch=touch,
        model=part.model,
    )


def episode_of_recording(trace: Trace, name: str) -> Episode:
    """An episode of a recording: of the wire, or an import.

    States are interpolated, commands held, at the frames of an import, or at
    50 Hz. What lies in a gap of a stream is NaN.

    :raises SessionError: it has no joints.
    """
    record = import_record(trace)
    streams = [s for s in streams_of(trace, keep_samples=False) if len(s) > 1]
    if not streams:
        raise SessionError(f"{trace.path} has no joints of a known hand, robot or session")
    imported = not format_of(record.format).whole and not record.aligned
    grid = _frames(streams) if imported else _grid(streams)
    touches = {p.part: p for p in pressures_of(trace, streams)}
    found: dict[str, dict[str, Stream]] = {}
    for stream in streams:
        found.setdefault(stream.part.removesuffix("_arms"), {})[stream.kind] = stream
    gaps = [
        gap
        for s in streams
        for gap in _gaps(s.times_ns, s.topic, int(grid[0]), _LEAST_GAP if not imported else 0.0)
    ]
    tracks = []
    for part, both in found.items():
        state, command = both.get(STATE), both.get(COMMAND)
        touch = touches.get(part)
        known = state or command
        assert known is not None
        tracks.append(
            Track(
                part,
                known.joints,
                state=_sampled(state, "q", grid),
                action=_sampled(command, "q", grid),
                dq=_sampled(state, "dq", grid),
                tau=_sampled(state, "tau", grid),
                touch=None if touch is None else touch.at(grid),
                model=MODELS.get(known.model),
            )
        )
    return Episode(
        name=name,
        form=record.format,
        fps=record.rate_hz if imported else _FASTEST,
        t=(grid - grid[0]) / 1e9,
        tracks=tracks,
        measured=not imported or record.clock == MEASURED,
        gaps=gaps,
        tasks=[record.task] if record.task else None,
    )


def _frames(streams: Sequence[Stream]) -> NDArray[np.int64]:
    """The times of the frames of an import."""
    found: NDArray[np.int64] = np.unique(np.concatenate([s.times_ns for s in streams]))
    return found


def _grid(streams: Sequence[Stream]) -> NDArray[np.int64]:
    begin = min(int(s.times_ns[0]) for s in streams)
    end = max(int(s.times_ns[-1]) for s in streams)
    count = int(min((end - begin) / 1e9, _LONGEST) * _FASTEST) + 1
    found: NDArray[np.int64] = np.rint(np.arange(count) * 1e9 / _FASTEST).astype(np.int64) + begin
    return found


def _sampled(stream: Stream | None, field: str, grid: NDArray[np.int64]) -> Floats | None:
    if stream is None or field not in stream.values:
        return None
    method = hold if stream.kind == COMMAND else interpolate
    return method(stream.times_ns, stream.values[field], grid)


def _gaps(
    times_ns: NDArray[np.int64], what: str, first_ns: int | None = None, least: float = 0.0
) -> list[Gap]:
    first = int(times_ns[0]) if first_ns is None else first_ns
    steps = np.diff(times_ns) / 1e9
    limit = max(gap_of(times_ns), least)
    return [
        Gap(float((times_ns[i] - first) / 1e9), float((times_ns[i + 1] - first) / 1e9), what)
        for i in np.flatnonzero(steps > limit).tolist()
    ]
