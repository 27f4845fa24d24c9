"""Find the true time of each frame of an episode from a DDS recording of the same session.

xr_teleoperate writes no times. The actions of its frames are the commands that it sent, so the
recorded commands give their times. Cross-correlation finds the episode's place in the recording and
the error of its rate. A frame whose action equals a recorded command in float32 lies between that
command and the next other one, and its state narrows that. The other frames are interpolated.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dexkit.digests import sha256_of_file
from dexkit.errors import SessionError
from dexkit.hand import Floats
from dexkit.traces.reader import Trace
from dexkit.traces.sessions.align import Alignment, Track, align
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.model import (
    MEASURED,
    Camera,
    Part,
    Session,
    messages,
    record_of,
)
from dexkit.traces.sessions.resample import hold
from dexkit.traces.sessions.streams import COMMAND, STATE, Stream, streams_of
from dexkit.traces.writer import RecordingWriter

__all__ = ["LEAST_CONFIDENCE", "FrameTimes", "find_times", "write_beside"]

LEAST_CONFIDENCE = 0.5
"""Lowest confidence at which an episode counts as found in a recording."""
LEAST_CORRELATION = 0.995
"""Lowest correlation, likewise: the actions are the commands, so an episode reaches nearly 1."""
# Largest rms of the differences between actions and commands, in standard deviations of the
# commands: a correlation coefficient is blind to the amplitude.
_APART = 0.1

# Ratios of the true period to the nominal one: the loop is late, hardly ever early.
_SLOWEST, _FASTEST = 2.2, 0.95
# Length of the part of an episode that is searched for, and of a step of that search, seconds.
_CHUNK, _COARSE = 40.0, 0.05
# Seconds around its expected time within which a frame's command is searched.
_WINDOW = 0.5
# Longest run of equal commands, in periods of the frames, that still gives a time.
_LONGEST_RUN = 1.5
# Seconds by which a hand's command may be published after the other's, and after its frame.
_DISORDER = 0.005
# Seconds for which a client has a state after the next one: it polls and runs at 100 to 200 Hz.
_LAG = 0.01
# Least share of frames whose command was sent only once; with fewer, stalls are not followed.
_FOLLOWED = 0.1
# Smallest share of frames that must lie within the recording.
_COVERED = 0.9
# Seconds of the recording that are kept before the first and after the last frame.
_MARGIN = 1.0

Times = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """The place of an episode in a recording.

    :param times_ns: of each frame, on the recording's clock.
    :param rate: frames a second, on average.
    :param correlation: of the actions with the commands in force at these times.
    :param elsewhere: the best coefficient at another place.
    :param matched: share of the frames whose action equals a recorded command.
    """

    times_ns: Times
    rate: float
    correlation: float
    elsewhere: float
    matched: float

    @property
    def confidence(self) -> float:
        """0 to 1."""
        found = Alignment(0.0, self.correlation, self.elsewhere, 0.0).confidence
        return max(found, min(self.matched, max(self.correlation, 0.0)))

    def __str__(self) -> str:
        return (
            f"{self.rate:.2f} frames a second; correlation {self.correlation:.4f}, elsewhere "
            f"{self.elsewhere:.4f}; {100 * self.matched:.0f} % of the actions are recorded as "
            f"commands; confidence {self.confidence:.2f}"
        )


Pairs = Sequence[tuple[Floats, Stream]]
"""The actions of a hand, and its recorded commands; or its states on both sides."""


def find_times(session: Session, wire: Sequence[Stream]) -> FrameTimes:
    """The true time of each frame.

    :param session: with nominal times.
    :param wire: the streams of the recording.
    :raises SessionError: the recording has no commands of the session's hands, they do not move,
        or the session is not in it for certain.
    """
    pairs = _pairs(session, wire, COMMAND)
    if not pairs:
        raise SessionError("the recording has no commands of a hand of the episode")
    nominal = (session.times_ns - session.times_ns[0]) / 1e9
    begin, period, elsewhere = _coarse(pairs, nominal)
    begin, period = _refine(pairs, nominal, begin, period)
    expected = begin + period * nominal
    sent = [_Runs(actions, stream) for actions, stream in pairs]
    had = [_Runs(q, stream, _LAG) for q, stream in _pairs(session, wire, STATE)]
    frame = period / session.rate
    expected = _follow(sent, expected, frame)
    times, matched = _match(sent, had, expected, frame)
    correlation, apart = _agreement(pairs, times)
    found = FrameTimes(
        times_ns=(times * 1e9).astype(np.int64),
        rate=(len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 else session.rate,
        correlation=correlation,
        elsewhere=elsewhere,
        matched=matched,
    )
    poor = correlation < LEAST_CORRELATION or apart > _APART
    if poor or found.confidence < LEAST_CONFIDENCE:
        raise SessionError(
            f"the episode was not found in the recording with certainty: {found}; actions and "
            f"commands differ by {apart:.2f} of their motion",
            hint="was the recording made of these hands, and while this episode was?",
        )
    return found


def _pairs(session: Session, wire: Sequence[Stream], kind: str) -> Pairs:
    streams = {s.part: s for s in wire if s.kind == kind}
    return [
        (p.values[kind]["q"], streams[p.name])
        for p in session.parts
        if kind in p.values
        and p.name in streams
        and len(p.joints) == len(streams[p.name].joints)
        and p.model is not None
        and p.model.name == streams[p.name].model
    ]


def _coarse(pairs: Pairs, nominal: Floats) -> tuple[float, float, float]:
    """(time of frame 0, ratio of the periods, best coefficient elsewhere), by correlation."""
    chunk = _liveliest(pairs, nominal)
    at = nominal[chunk] - nominal[chunk][0]
    best: tuple[Alignment, float] | None = None
    length = max(float(at[-1]), 1.0)
    # neighbours of the scale differ by a quarter of a second at the end
    count = int(np.ceil(np.log(_SLOWEST / _FASTEST) / (0.25 / length))) + 1
    for scale in np.geomspace(_FASTEST, _SLOWEST, min(max(count, 8), 200)).tolist():
        times = np.round(at * scale * 1e9).astype(np.int64)
        tracks = [Track(s.times_ns, s.q, times, actions[chunk]) for actions, s in pairs]
        found = align(tracks, step=_COARSE, least_overlap=min(1.0, length / 2))
        if found is not None and (best is None or found.correlation > best[0].correlation):
            best = found, scale
    if best is None:
        raise SessionError("no joint moves in the episode and in the recording's commands")
    alignment, scale = best
    # a time of the chunk minus the offset is a time of the recording
    return -alignment.offset - scale * float(nominal[chunk][0]), scale, alignment.elsewhere


def _liveliest(pairs: Pairs, nominal: Floats) -> slice:
    """The stretch of given length with the most motion."""
    if nominal[-1] <= _CHUNK:
        return slice(0, len(nominal))
    moves = sum(
        np.nansum(np.abs(np.diff(actions, axis=0, prepend=actions[:1])), axis=1)
        for actions, _ in pairs
    )
    done = np.concatenate([[0.0], np.cumsum(moves)])
    ends = np.searchsorted(nominal, nominal + _CHUNK, side="right")
    inside = ends < len(nominal)
    start = int(np.argmax(np.where(inside, done[ends] - done[np.arange(len(nominal))], -1.0)))
    return slice(start, int(ends[start]))


def _refine(pairs: Pairs, nominal: Floats, begin: float, period: float) -> tuple[float, float]:
    """Refine both values over the whole episode."""
    length = max(float(nominal[-1]), 1.0)
    widths = (min(0.03, 0.6 / length), 0.15)
    for _ in range(5):
        scales = period * (1 + np.linspace(-widths[0], widths[0], 9))
        shifts = np.linspace(-widths[1], widths[1], 9)
        centre = begin + period * length / 2
        tried = [
            (_agreement(pairs, centre + d + s * (nominal - length / 2))[0], s, d)
            for s in scales.tolist()
            for d in shifts.tolist()
        ]
        _, period, shift = max(tried)
        begin = centre + shift - period * length / 2
        widths = (widths[0] / 3, widths[1] / 3)
    return begin, period


def _agreement(pairs: Pairs, times: Floats) -> tuple[float, float]:
    """Agreement of the actions with the commands in force at these times, over all joints:
    correlation coefficient, and rms difference in standard deviations.
    """
    at = np.round(times * 1e9).astype(np.int64)
    covariance = power_a = power_b = apart = 0.0
    for actions, stream in pairs:
        sent = hold(stream.times_ns, stream.q, at, 1.0)
        good = np.isfinite(sent).all(axis=1) & np.isfinite(actions).all(axis=1)
        if good.sum() < max(3, 0.5 * len(times)):
            return -1.0, np.inf
        apart += float(((actions[good] - sent[good]) ** 2).sum())
        a = actions[good] - actions[good].mean(axis=0)
        b = sent[good] - sent[good].mean(axis=0)
        covariance += float((a * b).sum())
        power_a += float((a * a).sum())
        power_b += float((b * b).sum())
    power = np.sqrt(power_a * power_b)
    if power <= 0:
        return -1.0, np.inf
    return covariance / power, float(np.sqrt(apart / power_b))


class _Runs:
    """The runs of equal values of a recorded stream, and where each frame's value occurs in them.

    :param rows: the value of each frame, shape (n, joints); compared in float32.
    :param lag: seconds for which a frame may have a value after the next one was received.
    """

    def __init__(self, rows: Floats, stream: Stream, lag: float = 0.0) -> None:
        wire = stream.q.astype(np.float32)
        new = np.ones(len(wire), dtype=np.bool_)
        new[1:] = (wire[1:] != wire[:-1]).any(axis=1)
        first = np.flatnonzero(new)
        at = stream.times_ns / 1e9
        self.begins = at[first]
        self.ends = np.append(at[first[1:]], at[-1:]) + lag
        places: dict[bytes, list[int]] = {}
        for k, row in enumerate(wire[first]):
            places.setdefault(row.tobytes(), []).append(k)
        none = np.zeros(0, dtype=np.intp)
        known = {row: np.array(found, dtype=np.intp) for row, found in places.items()}
        self.of_frame = [known.get(row.tobytes(), none) for row in rows.astype(np.float32)]

    def once(self, longest: float) -> Floats:
        """The middle of the only run with a frame's value; NaN: none, several, or a longer one."""
        found = np.full(len(self.of_frame), np.nan)
        for i, runs in enumerate(self.of_frame):
            if len(runs) == 1 and self.ends[runs[0]] - self.begins[runs[0]] <= longest:
                found[i] = (self.begins[runs[0]] + self.ends[runs[0]]) / 2
        return found

    def near(self, frame: int, expected: float) -> tuple[float, float] | None:
        """Begin and end of the run with a frame's value that is nearest to its expected time."""
        runs = self.of_frame[frame]
        if not len(runs):
            return None
        away = np.maximum(self.begins[runs] - expected, expected - self.ends[runs])
        best = int(np.argmin(away))
        if away[best] > _WINDOW:
            return None
        return float(self.begins[runs[best]]), float(self.ends[runs[best]])


def _follow(commands: Sequence[_Runs], expected: Floats, period: float) -> Floats:
    """The expected times, bent to the stalls of the loop by values that were sent only once."""
    once: Floats = np.full(len(expected), np.nan)
    for runs in commands:
        found = runs.once(_LONGEST_RUN * period)
        unknown = np.isnan(once)
        once[unknown] = found[unknown]
    kept = _ascending(once)
    if len(kept) < max(2, _FOLLOWED * len(expected)):
        return expected
    late: Floats = np.interp(np.arange(len(expected)), kept, once[kept] - expected[kept])
    return expected + late


def _match(
    commands: Sequence[_Runs], states: Sequence[_Runs], expected: Floats, period: float
) -> tuple[Floats, float]:
    """Times of the frames by their commands, and the share of frames that have one.

    A frame lies within the run of its command, of both hands. Its state, which changes more often,
    narrows that.
    """
    begins, ends = np.full(len(expected), -np.inf), np.full(len(expected), np.inf)
    matched = np.zeros(len(expected), dtype=np.bool_)
    for source in (*commands, *states):
        for i in range(len(expected)):
            run = source.near(i, expected[i])
            if run is None:
                continue
            matched[i] |= source in commands
            begin, end = max(begins[i], run[0]), min(ends[i], run[1])
            # a state alone tells nothing: it may repeat
            if matched[i] and begin - end <= _DISORDER:
                begins[i], ends[i] = begin, end
    anchors = np.full(len(expected), np.nan)
    short = ends - begins <= _LONGEST_RUN * period
    anchors[short] = (begins[short] + ends[short]) / 2
    kept = _ascending(anchors)
    if len(kept) < 2:
        return expected, float(matched.mean())
    # the residuals of the expected times are the loop's jitter and slow drift
    late = np.interp(np.arange(len(expected)), kept, anchors[kept] - expected[kept])
    times = expected + late
    # two frames must not get equal times
    least = 1e-6
    for i in range(1, len(times)):
        times[i] = max(times[i], times[i - 1] + least)
    return times, float(matched.mean())


def _ascending(anchors: Floats) -> NDArray[np.intp]:
    """The longest run of anchors whose times ascend, by number of frame."""
    tails: list[float] = []
    ends: list[int] = []
    before: dict[int, int] = {}
    for i in np.flatnonzero(np.isfinite(anchors)).tolist():
        place = int(np.searchsorted(tails, anchors[i]))
        if place == len(tails):
            tails.append(float(anchors[i]))
            ends.append(i)
        else:
            tails[place], ends[place] = float(anchors[i]), i
        before[i] = ends[place - 1] if place else -1
    found = []
    i = ends[-1] if ends else -1
    while i >= 0:
        found.append(i)
        i = before[i]
    return np.array(found[::-1], dtype=np.intp)


def write_beside(
    session: Session, trace: Trace, out: Path, *, embed: bool = False, overwrite: bool = False
) -> tuple[int, FrameTimes]:
    """Write an episode with its recording: hands from the recording, all other data at its true
    time.

    :returns: the number of messages, and where the episode lies.
    :raises SessionError: as :func:`find_times`, or most of the episode is not in the recording.
    """
    wire = streams_of(trace)
    found = find_times(session, wire)
    times = found.times_ns
    covered = (times >= trace.first_ns) & (times <= trace.last_ns)
    if covered.mean() < _COVERED:
        raise SessionError(
            f"only {100 * covered.mean():.0f} % of the episode lie in the recording",
            hint="start the recorder before the episode, and stop it afterwards",
        )
    if not covered.all():
        session.problems.add(
            f"{np.count_nonzero(~covered)} frames before or after the recording are left out"
        )
    hands = {s.part for s in wire}
    session = _aligned(session, found, covered, hands)
    begin = int(session.times_ns[0] - _MARGIN * 1e9)
    end = int(session.times_ns[-1] + _MARGIN * 1e9)
    with RecordingWriter(out, overwrite=overwrite) as writer:
        for name, values in trace.metadata.items():
            writer.add_metadata(name, values)
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        of_wire = (
            (m.log_time_ns, numbers[m.topic, m.type_name], m.data, m.publish_time_ns)
            for m in trace.messages()
            if begin <= m.log_time_ns <= end
        )
        of_frames = ((t, n, data, t) for t, n, data in messages(session, writer, embed=embed))
        for time_ns, number, data, sent in heapq.merge(of_wire, of_frames, key=lambda m: m[0]):
            writer.put(number, data, time_ns, sent)
        record = record_of(session, embed=embed)
        record["wire"] = trace.path.name
        record["wire_sha256"] = sha256_of_file(trace.path)
        writer.add_metadata(RECORD, record)
        return writer.written, found


def _aligned(
    session: Session, found: FrameTimes, keep: NDArray[np.bool_], hands: set[str]
) -> Session:
    """The session at its true times, without the hands that the recording has."""
    places = np.flatnonzero(keep)
    numbers = np.round((session.times_ns - (session.first_ns or 0)) * session.rate / 1e9)
    rest, current = [], "{}"
    for i in range(len(session)):
        current = (session.rest[i] if session.rest else "") or current
        rest.append(json.dumps({"idx": int(numbers[i]), **json.loads(current)}, ensure_ascii=False))
    parts = [
        Part(
            p.name,
            p.joints,
            {k: {f: v[places] for f, v in c.items()} for k, c in p.values.items()},
            p.model,
        )
        for p in session.parts
        if p.name not in hands
    ]
    cameras = [
        Camera(
            c.name,
            tuple(c.paths[i] for i in places),
            c.group,
            None if c.seconds is None else tuple(c.seconds[i] for i in places),
        )
        for c in session.cameras
    ]
    about = {
        **session.about,
        "aligned": str(found),
        "alignment_confidence": f"{found.confidence:.3f}",
        "clock_note": "each frame lies within the recorded command and state that it repeats",
    }
    return replace(
        session,
        times_ns=found.times_ns[places],
        clock=MEASURED,
        rate=found.rate,
        first_ns=None,
        parts=parts,
        cameras=cameras,
        rest=[rest[i] for i in places],
        about=about,
    )
