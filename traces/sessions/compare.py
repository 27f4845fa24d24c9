"""Compare two recordings of one session, such as two replays or two hands.

B is shifted onto A (by the commands, whose motion is the same in both), then every joint that both
have is compared at A's times, within what both cover and not across gaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError
from dexkit.hand import Floats
from dexkit.traces.reader import SampleArray, Trace
from dexkit.traces.sessions.align import Alignment, Track, align
from dexkit.traces.sessions.resample import interpolate
from dexkit.traces.sessions.streams import COMMAND, STATE, Stream, streams_of

__all__ = ["Comparison", "JointDifference", "TopicCounts", "compare"]

LEAST_CORRELATION = 0.9
"""Lowest confidence at which two recordings count as one session."""


@dataclass(frozen=True)
class TopicCounts:
    """Messages, mean rate in Hz and longest gap in seconds of a topic; 0 where it is missing."""

    topic: str
    messages: tuple[int, int]
    rates: tuple[float, float]
    gaps: tuple[float, float]
    types: tuple[str, str]


@dataclass(frozen=True)
class JointDifference:
    """One joint of both, position.

    :param rms: in ``unit``.
    :param worst: the largest difference, in ``unit``, ``worst_at`` seconds after A's first message.
    :param first_at: where it first exceeds the tolerance, likewise; None where it never does.
    :param samples: number of compared samples; 0 if the recordings do not overlap.
    """

    part: str
    kind: str
    joint: str
    rms: float
    worst: float
    worst_at: float
    first_at: float | None
    samples: int
    unit: str = "rad"


@dataclass(frozen=True)
class Comparison:
    """Differences of two recordings.

    :param offset: seconds by which B's clock is later than A's for the same motion.
    :param alignment: how that was found; None if it was given.
    :param only: topics with messages that only A, and only B, has.
    :param tolerance: in the unit of each joint.
    """

    offset: float
    alignment: Alignment | None
    only: tuple[tuple[str, ...], tuple[str, ...]]
    topics: tuple[TopicCounts, ...]
    joints: tuple[JointDifference, ...]
    tolerance: float
    overlap: float
    notes: tuple[str, ...] = field(default=())

    @property
    def equal(self) -> bool:
        """Whether both have the same topics and types, and no joint differs by more than the
        tolerance. Without a joint that could be compared they are not.
        """
        return not self.reasons

    @property
    def reasons(self) -> list[str]:
        """Why they are not equal, in sentences without an end; empty if they are."""
        found = [
            f"only {name} has {', '.join(topics)}"
            for name, topics in zip("AB", self.only, strict=True)
            if topics
        ]
        found += [
            f"{t.topic} has other types: {' and '.join(map(str, t.types))}"
            for t in self.topics
            if t.types[0] != t.types[1]
        ]
        if not any(j.samples for j in self.joints):
            found.append("no joint could be compared")
        elif apart := [j.joint for j in self.joints if not j.samples]:
            found.append(f"no time in common: {', '.join(apart)}")
        if wrong := [j for j in self.joints if j.first_at is not None]:
            names = ", ".join(dict.fromkeys(j.joint for j in wrong))
            found.append(f"more than {self.tolerance:g} {wrong[0].unit} apart: {names}")
        return found


def compare(
    a: Trace,
    b: Trace,
    *,
    topics: Sequence[str] | None = None,
    offset: float | None = None,
    tolerance: float = 0.05,
) -> Comparison:
    """Compare two recordings.

    :param topics: only these, in any spelling, patterns allowed; each has to be in one of them.
    :param offset: seconds by which B is later; None to find it.
    :param tolerance: difference of a position that counts, rad.
    :raises UsageError: a topic is in neither, or the offset cannot be found.
    """
    loaded = [_load(trace, topics) for trace in (a, b)]
    if topics is not None and not (loaded[0] or loaded[1]):
        raise UsageError(f"neither recording has a topic {', '.join(topics)}")
    names = [{t for t, s in one.items() if len(s)} for one in loaded]
    streams = [
        streams_of(trace, sorted(some), positions=True)
        for trace, some in zip((a, b), names, strict=True)
    ]
    alignment = None
    if offset is None:
        alignment = _alignment(a, b, streams[0], streams[1])
        offset = alignment.offset
    shift = round(offset * 1e9)
    first = a.first_ns
    pairs = _pairs(streams[0], streams[1])
    joints = [
        _difference(one, other, k, shift, first, tolerance)
        for one, other in pairs
        for k in range(len(one.joints))
    ]
    begin = max(a.first_ns, b.first_ns - shift)
    end = min(a.last_ns, b.last_ns - shift)
    return Comparison(
        offset=offset,
        alignment=alignment,
        only=(tuple(sorted(names[0] - names[1])), tuple(sorted(names[1] - names[0]))),
        topics=tuple(
            _counts(t, loaded[0].get(t), loaded[1].get(t)) for t in sorted(names[0] & names[1])
        ),
        joints=tuple(joints),
        tolerance=tolerance,
        overlap=max(0.0, (end - begin) / 1e9),
        notes=() if joints else ("they have no joint in common",),
    )


def _alignment(a: Trace, b: Trace, ones: Sequence[Stream], others: Sequence[Stream]) -> Alignment:
    """Find by how much B is later than A, by its commands, else by its states.

    :raises UsageError: they have no motion in common, or it is not the same.
    """
    found = None
    for kind in (COMMAND, STATE):
        tracks = [
            Track(one.times_ns, one.q, other.times_ns, other.q)
            for one, other in _pairs(ones, others)
            if one.kind == kind
        ]
        found = align(tracks)
        if found is not None:
            break
    if found is None:
        raise UsageError(
            f"{a.path.name} and {b.path.name} cannot be aligned: no joint moves in both for a "
            "second",
            hint="state by how many seconds the second is later with --offset",
        )
    if found.correlation < LEAST_CORRELATION:
        raise UsageError(
            f"{a.path.name} and {b.path.name} are not runs of one session: their motion correlates "
            f"by {found.correlation:.2f} at best (at least {LEAST_CORRELATION} is needed)",
            hint="state by how many seconds the second is later with --offset",
        )
    return found


def _load(trace: Trace, topics: Sequence[str] | None) -> dict[str, SampleArray]:
    if topics is None:
        return trace.load(payloads=False)
    from dexkit.traces.names import select_topics

    picked, _ = select_topics(trace.topics, topics)
    return trace.load(picked, payloads=False) if picked else {}


def _pairs(ones: Sequence[Stream], others: Sequence[Stream]) -> list[tuple[Stream, Stream]]:
    by_name = {(s.part, s.kind): s for s in others}
    return [
        (one, other)
        for one in ones
        if (other := by_name.get((one.part, one.kind))) is not None and other.joints == one.joints
    ]


def _difference(
    one: Stream, other: Stream, joint: int, shift: int, first: int, tolerance: float
) -> JointDifference:
    name = one.names[joint]
    times: NDArray[np.int64] = one.times_ns
    theirs = interpolate(other.times_ns - shift, other.q[:, joint : joint + 1], times)[:, 0]
    apart: Floats = np.abs(one.q[:, joint] - theirs)
    good = np.flatnonzero(np.isfinite(apart))
    if not len(good):
        return JointDifference(one.part, one.kind, name, np.nan, np.nan, np.nan, None, 0, one.unit)
    values, at = apart[good], (times[good] - first) / 1e9
    worst = int(np.argmax(values))
    beyond = np.flatnonzero(values > tolerance)
    return JointDifference(
        part=one.part,
        kind=one.kind,
        joint=name,
        rms=float(np.sqrt(np.mean(values**2))),
        worst=float(values[worst]),
        worst_at=float(at[worst]),
        first_at=float(at[beyond[0]]) if len(beyond) else None,
        samples=len(good),
        unit=one.unit,
    )


def _counts(topic: str, a: SampleArray | None, b: SampleArray | None) -> TopicCounts:

    def rate(s: SampleArray | None) -> float:
        if s is None or len(s) < 2 or s.log_time_ns[-1] == s.log_time_ns[0]:
            return 0.0
        return (len(s) - 1) * 1e9 / float(s.log_time_ns[-1] - s.log_time_ns[0])

    def gap(s: SampleArray | None) -> float:
        return float(np.diff(s.log_time_ns).max(initial=0)) / 1e9 if s is not None else 0.0

    return TopicCounts(
        topic=topic,
        messages=(len(a or ()), len(b or ())),
        rates=(rate(a), rate(b)),
        gaps=(gap(a), gap(b)),
        types=(a.type_name if a else "", b.type_name if b else ""),
    )
