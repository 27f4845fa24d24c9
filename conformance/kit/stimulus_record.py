"""The stimulus record: phases, targets and timer lateness of a run, as mcap metadata.

A live run writes the record :data:`RECORD` into its recording, so that the recording alone says
what the hand was asked to do and can be judged again at any time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import msgspec
import numpy as np

from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.processor_waits import SubjectName, Time, Waits
from dexkit.documents import parse_json
from dexkit.errors import TraceUnsupported
from dexkit.hand import ROBOT, Floats, Side, Subject
from dexkit.records import as_plain, from_object, to_record

__all__ = [
    "CALIBRATION_TOPIC",
    "RECORD",
    "Beats",
    "Calibration",
    "Phase",
    "Stall",
    "Stimulus",
    "from_metadata",
    "to_metadata",
]

T = TypeVar("T")

RECORD = "dexkit.stimulus"
CALIBRATION_TOPIC = "rt/dexkit/calibration"
"""The topic on which the kit measures itself; no hand's and no robot's."""


@dataclass
class Phase:
    """One phase of the stimulus.

    :param name: kind of stimulus: ``listen``, ``step``, ``silence``, ...
    :param sides: the subjects that it is applied to.
    :param begin_ns: log time at which it began.
    :param targets: q that joints of each side were to reach, by their index, in the dialect's
        radians.
    :param observed: what the kit saw beside the recording (a late joiner's reception).
    """

    name: str
    sides: tuple[Subject, ...]
    begin_ns: int
    end_ns: int = 0
    targets: dict[Subject, dict[int, float]] = field(default_factory=dict)
    params: dict[str, str] = field(default_factory=dict)
    observed: dict[str, float | None] = field(default_factory=dict)


class Stall(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An interval in which programs waited for a processor."""

    begin_ns: Time
    end_ns: Time


class Beats(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lateness of the kit's timer over the whole run.

    :param begin_ns: log time of offset 0.
    :param t_us: when it fired, microseconds from there.
    :param late_us: by how much too late.
    """

    begin_ns: Time = 0
    t_us: list[Time] = []
    late_us: list[Time] = []

    def __post_init__(self) -> None:
        if len(self.t_us) != len(self.late_us):
            raise ValueError("a heartbeat without a lateness")

    def lateness(self, begin_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Median and 99th percentile of it in [begin, end], seconds; None if it is not known."""
        there = self._in(begin_ns, end_ns)
        if not len(there):
            return None
        median, high = np.percentile(there, [50, 99])
        return float(median), float(high)

    def excess_lateness(self, begin_ns: int, end_ns: int) -> Lateness | None:
        """Lateness in [begin, end] beyond that of an idle machine; None if it is not known."""
        return Lateness.beyond_idle(self._in(begin_ns, end_ns))

    def _in(self, begin_ns: int, end_ns: int) -> Floats:
        """Lateness, seconds, of the beats that were due before the end and came after the begin."""
        t, late = np.array(self.t_us), np.array(self.late_us)
        begin, end = (begin_ns - self.begin_ns) / 1e3, (end_ns - self.begin_ns) / 1e3
        return np.asarray(late[(t >= begin) & (t - late <= end)] / 1e6)


class Calibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The kit measured against itself at the begin of a run; see :mod:`~.calibration`.

    :param sent: messages, each at a known instant.
    :param delay_us: from writing to taking each that arrived, microseconds, rising.
    :param late_us: by how much each was written too late, microseconds, rising.
    :param clock_us: by how much the wall clock, which stamps samples, strayed from the monotonic
        one meanwhile, microseconds.
    """

    sent: Time = 0
    delay_us: list[Time] = []
    late_us: list[Time] = []
    clock_us: Time = 0

    @property
    def time_error(self) -> float | None:
        """The 99th percentile of the delay, or the clock's error if that is larger, seconds.

        None if fewer than half of the messages arrived.
        """
        if not self.delay_us or 2 * len(self.delay_us) < self.sent:
            return None
        return max(float(np.percentile(self.delay_us, 99)), float(self.clock_us)) / 1e6


@dataclass
class Stimulus:
    """The stimulus record.

    :param phases: in order of time.
    :param objects: where each side touches its object, or None where there is none: rad for a
        hand of one joint, percent of closing for others.
    :param stalls: when programs waited for a processor.
    :param beats: how late the kit's own timer was.
    :param calibration: the kit measured against itself; None in a run without.
    :param waits: how long the hands' processes waited for a processor; None where it was not
        measured.
    :param virtual: whether the run was on a virtual clock, which is never late.
    """

    phases: list[Phase] = field(default_factory=list)
    objects: dict[Subject, float | None] = field(default_factory=dict)
    stalls: list[Stall] = field(default_factory=list)
    beats: Beats = field(default_factory=Beats)
    calibration: Calibration | None = None
    waits: Waits | None = None
    virtual: bool = False

    def time_error(self, begin_ns: int, end_ns: int) -> float | None:
        """The kit's error of a time in [begin, end], seconds; None if it is not known.

        The 99th percentile by which its timer was late then, or what it measured against itself
        if that is larger; 0 on a virtual clock.
        """
        late = self.beats.lateness(begin_ns, end_ns)
        if late is not None:
            own = self.calibration.time_error if self.calibration is not None else None
            return max(late[1], own or 0.0)
        return 0.0 if self.virtual and not self.beats.t_us else None

    def to_metadata(self) -> dict[str, str]:
        """The record's content."""
        record = _Record(
            version=1,
            phases=[from_object(phase, _PhaseRecord) for phase in self.phases],
            objects={str(side): place for side, place in self.objects.items()},
            stalls=self.stalls,
            beats=self.beats,
            calibration=self.calibration,
            waits=self.waits,
            clock="virtual" if self.virtual else None,
        )
        return to_metadata(record)

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Stimulus:
        """Parse the record's content.

        :raises TraceUnsupported: of another version, or damaged.
        """
        record = from_metadata(metadata, _Record, "the stimulus record")
        return cls(
            phases=[
                Phase(
                    p.name,
                    tuple(_subject(s) for s in p.sides),
                    p.begin_ns,
                    p.end_ns,
                    {_subject(side): targets for side, targets in p.targets.items()},
                    p.params,
                    p.observed,
                )
                for p in record.phases
            ],
            objects={_subject(side): place for side, place in record.objects.items()},
            stalls=record.stalls,
            beats=record.beats,
            calibration=record.calibration,
            waits=record.waits,
            virtual=record.clock == "virtual",
        )


class _PhaseRecord(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    sides: tuple[SubjectName, ...]
    begin_ns: Time
    end_ns: Time
    targets: dict[SubjectName, dict[int, float]]
    params: dict[str, str]
    observed: dict[str, float | None]


class _Record(msgspec.Struct, omit_defaults=True):
    version: Literal[1]
    phases: list[_PhaseRecord]
    objects: dict[SubjectName, float | None]
    stalls: list[Stall]
    beats: Beats
    calibration: Calibration | None = None
    waits: Waits | None = None
    clock: Literal["virtual"] | None = None


def _subject(name: str) -> Subject:
    return ROBOT if name == ROBOT.value else Side(name)


def to_metadata(record: object) -> dict[str, str]:
    """A record as metadata of a recording: the JSON of each of its members."""
    return {name: json.dumps(value) for name, value in as_plain(record).items()}


def from_metadata(metadata: Mapping[str, str], kind: type[T], origin: str) -> T:
    """The record that :func:`to_metadata` gave.

    :raises TraceUnsupported: of another version, or damaged.
    """
    if metadata.get("version") != "1":
        raise TraceUnsupported(
            f"{origin} is of version {metadata.get('version')!r}",
            hint="judge it with the dexkit that recorded it, or a newer one",
        )
    damaged = f"{origin} is damaged"
    plain = {
        # measured values may be NaN
        name: parse_json(text, damaged, error=TraceUnsupported, finite=False)
        for name, text in metadata.items()
    }
    return to_record(plain, kind, damaged, error=TraceUnsupported)
