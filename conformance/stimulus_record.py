"""The stimulus record: phases, targets and timer lateness of a run, as mcap metadata.

A live run writes the record :data:`RECORD` into its recording, so that the recording alone says
what the hand was asked to do and can be judged again at any time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dexkit.conformance.lateness import Lateness
from dexkit.conformance.processor_waits import Waits
from dexkit.documents import parse_json
from dexkit.errors import TraceUnsupported
from dexkit.hand import ROBOT, Floats, Side, Subject

__all__ = [
    "CALIBRATION_TOPIC",
    "RECORD",
    "Beats",
    "Calibration",
    "Phase",
    "Planned",
    "Stall",
    "Stimulus",
    "parse_stalls",
    "parse_time",
]

_LATEST = 2**62  # ns since 1970: the year 2116

RECORD = "dexkit.stimulus"
VERSION = 1
_VIRTUAL = json.dumps("virtual")  # as every value of the record: JSON
_EARLIER_ROBOT = "body"
"""The name of the subject ``robot`` in recordings of earlier versions."""
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


@dataclass(frozen=True)
class Planned:
    """Which stimuli a run was to apply.

    :param phases: names of the phases that its requirements need.
    :param rounds: how often it was to go through those between the first motion and the operator.
    """

    phases: frozenset[str]
    rounds: int = 1

    @classmethod
    def parse(cls, text: str) -> Planned:
        """Parse the record's content.

        :raises TypeError, ValueError, KeyError, TraceUnsupported: it is damaged.
        """
        found = _json(text)
        phases, rounds = found["phases"], found["rounds"]
        if not isinstance(phases, list) or not all(isinstance(p, str) for p in phases):
            raise TypeError("the names of the planned phases are no texts")
        if type(rounds) is not int:
            raise TypeError(f"{rounds!r} is no number of rounds")
        return cls(frozenset(phases), rounds)

    def as_text(self) -> str:
        """The record's content."""
        return json.dumps({"phases": sorted(self.phases), "rounds": self.rounds})


@dataclass(frozen=True)
class Stall:
    """An interval in which programs waited for a processor."""

    begin_ns: int
    end_ns: int


@dataclass
class Beats:
    """Lateness of the kit's timer over the whole run.

    :param begin_ns: log time of offset 0.
    :param t_us: when it fired, microseconds from there.
    :param late_us: by how much too late.
    """

    begin_ns: int = 0
    t_us: list[int] = field(default_factory=list)
    late_us: list[int] = field(default_factory=list)

    @classmethod
    def parse(cls, text: str) -> Beats:
        """Parse the record's content.

        :raises TypeError, ValueError, TraceUnsupported: it is damaged.
        """
        found = cls(**_json(text))
        t, late = [parse_time(t) for t in found.t_us], [parse_time(t) for t in found.late_us]
        if len(t) != len(late):
            raise ValueError("a heartbeat without a lateness")
        return cls(parse_time(found.begin_ns), t, late)

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


@dataclass(frozen=True)
class Calibration:
    """The kit measured against itself at the begin of a run; see :mod:`~.calibration`.

    :param sent: messages, each at a known instant.
    :param delay_us: from writing to taking each that arrived, microseconds, rising.
    :param late_us: by how much each was written too late, microseconds, rising.
    :param clock_us: by how much the wall clock, which stamps samples, strayed from the monotonic
        one meanwhile, microseconds.
    """

    sent: int = 0
    delay_us: list[int] = field(default_factory=list)
    late_us: list[int] = field(default_factory=list)
    clock_us: int = 0

    @classmethod
    def parse(cls, text: str) -> Calibration | None:
        """Parse the record's content; None for an empty text.

        :raises TypeError, ValueError, TraceUnsupported: it is damaged.
        """
        if not text:
            return None
        found = cls(**_json(text))
        delays, late = ([parse_time(t) for t in x] for x in (found.delay_us, found.late_us))
        return cls(parse_time(found.sent), delays, late, parse_time(found.clock_us))

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
    :param planned: which stimuli the run was to apply; None in recordings of earlier versions.
    """

    phases: list[Phase] = field(default_factory=list)
    objects: dict[Subject, float | None] = field(default_factory=dict)
    stalls: list[Stall] = field(default_factory=list)
    beats: Beats = field(default_factory=Beats)
    calibration: Calibration | None = None
    waits: Waits | None = None
    virtual: bool = False
    planned: Planned | None = None

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
        return {
            "version": str(VERSION),
            "phases": json.dumps(
                [
                    {
                        "name": p.name,
                        "sides": [str(s) for s in p.sides],
                        "begin_ns": p.begin_ns,
                        "end_ns": p.end_ns,
                        "targets": {
                            str(s): {str(i): q for i, q in joints.items()}
                            for s, joints in p.targets.items()
                        },
                        "params": p.params,
                        "observed": p.observed,
                    }
                    for p in self.phases
                ]
            ),
            "objects": json.dumps({str(s): q for s, q in self.objects.items()}),
            "stalls": json.dumps([[s.begin_ns, s.end_ns] for s in self.stalls]),
            "beats": json.dumps(asdict(self.beats)),
            **({"calibration": json.dumps(asdict(self.calibration))} if self.calibration else {}),
            **({"waits": self.waits.as_text()} if self.waits is not None else {}),
            **({"clock": _VIRTUAL} if self.virtual else {}),
            **({"planned": self.planned.as_text()} if self.planned is not None else {}),
        }

    @classmethod
    def from_metadata(cls, record: Mapping[str, str]) -> Stimulus:
        """Parse the record's content.

        :raises TraceUnsupported: of another version, or damaged.
        """
        if record.get("version") != str(VERSION):
            raise TraceUnsupported(
                f"stimulus record of version {record.get('version')!r}",
                hint="judge it with the dexkit that recorded it, or a newer one",
            )
        try:
            phases: list[dict[str, Any]] = _json(record["phases"])
            return cls(
                phases=[
                    Phase(
                        name=p["name"],
                        sides=tuple(_subject(s) for s in p["sides"]),
                        begin_ns=parse_time(p["begin_ns"]),
                        end_ns=parse_time(p["end_ns"]),
                        targets={_subject(s): _joints(q) for s, q in p["targets"].items()},
                        params=dict(p["params"]),
                        observed=dict(p["observed"]),
                    )
                    for p in phases
                ],
                objects={
                    _subject(s): None if q is None else float(q)
                    for s, q in _json(record["objects"]).items()
                },
                stalls=parse_stalls(record["stalls"]),
                beats=Beats.parse(record.get("beats", "{}")),
                calibration=Calibration.parse(record.get("calibration", "")),
                waits=Waits.parse(record["waits"]) if "waits" in record else None,
                virtual=record.get("clock") == _VIRTUAL,
                planned=Planned.parse(record["planned"]) if "planned" in record else None,
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise TraceUnsupported(f"the stimulus record is damaged ({error})") from error


def _subject(name: str) -> Subject:
    return ROBOT if name in (ROBOT.value, _EARLIER_ROBOT) else Side(name)


def _joints(value: Any) -> dict[int, float]:
    """Targets by joint; a bare number, as the first recordings have it, is the only joint's."""
    if isinstance(value, dict):
        return {int(i): float(q) for i, q in value.items()}
    return {0: float(value)}


def parse_stalls(text: str) -> list[Stall]:
    """Read the stalls of a record.

    :raises TypeError, ValueError, TraceUnsupported: it is damaged.
    """
    return [Stall(parse_time(a), parse_time(b)) for a, b in _json(text)]


def parse_time(value: Any) -> int:
    """A time or a duration, nanoseconds or microseconds."""
    if isinstance(value, bool) or not isinstance(value, int) or not -_LATEST <= value <= _LATEST:
        raise ValueError(f"{value!r} is not a time")
    return value


def _json(text: str) -> Any:
    # measured values may be NaN
    return parse_json(text, "the stimulus record", error=TraceUnsupported, finite=False)
