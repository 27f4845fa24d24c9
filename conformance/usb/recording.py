"""Decode a USB recording for the checks."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.processor_waits import Starvation, Waits
from dexkit.conformance.kit.stimulus_record import Beats, Stall
from dexkit.conformance.usb.frames import MotorReading, Scale, StateReading, read_state
from dexkit.conformance.usb.record import (
    RECORD,
    Descriptors,
    SideRecord,
    Transfer,
    UsbPhase,
    UsbRecord,
    topic,
)
from dexkit.hand import JointSpec, Side, Subject
from dexkit.models import DEX3_1
from dexkit.traces import ChannelInfo, SampleArray

__all__ = ["Answer", "Device", "Endpoint", "Exchange", "UsbRecording", "UsbSide", "parse_device"]

Floats = NDArray[np.float64]


class TraceLike(Protocol):
    """The methods of a recording that are used here."""

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Metadata records by name."""

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """All of them."""

    def load(self, topics: Sequence[str]) -> Mapping[str, SampleArray]:
        """Messages by topic."""


@dataclass(frozen=True)
class Endpoint:
    """One endpoint of interface 0."""

    address: int
    kind: int
    size: int

    @property
    def bulk(self) -> bool:
        """Whether it is a bulk endpoint."""
        return self.kind & 3 == 2

    @property
    def inward(self) -> bool:
        """Whether it sends to the host."""
        return bool(self.address & 0x80)


@dataclass(frozen=True)
class Device:
    """The descriptors, parsed as far as they go.

    :param endpoints: of interface 0, alternate setting 0.
    """

    vendor: int = 0
    product: int = 0
    release: int = 0
    manufacturer: str = ""
    name: str = ""
    serial: str = ""
    endpoints: tuple[Endpoint, ...] = ()


def parse_device(raw: Descriptors) -> Device:
    """Read the raw descriptors (USB 2.0 specification 9.6)."""
    if len(raw.device) < 18:
        return Device()
    vendor, product, release, *indices = struct.unpack_from("<HHHBBB", raw.device, 8)
    maker, name, serial = (raw.strings.get(i, "") for i in indices)
    endpoints = _endpoints(raw.configuration)
    return Device(vendor, product, release, maker, name, serial, endpoints)


def _endpoints(raw: bytes) -> tuple[Endpoint, ...]:
    found: list[Endpoint] = []
    at, mine = 0, False
    while at + 2 <= len(raw) and raw[at] >= 2:
        part = raw[at : at + raw[at]]
        if part[1] == 4 and len(part) >= 9:
            mine = part[2] == 0 and part[3] == 0
        elif part[1] == 5 and len(part) >= 7 and mine:
            found.append(Endpoint(part[2], part[3], part[4] | part[5] << 8))
        at += raw[at]
    return tuple(found)


@dataclass(frozen=True)
class Answer:
    """One frame from the device.

    :param t: seconds of the recording at which it was received.
    """

    t: float
    transfer: Transfer
    reading: StateReading


@dataclass(frozen=True)
class Exchange:
    """A command and its answer, None if there was no answer."""

    t: float
    command: Transfer
    answer: Answer | None


@dataclass(eq=False)
class UsbSide:
    """One hand's transfers and the phases of its stimulus."""

    side: Side
    record: SideRecord
    transfers: Sequence[Transfer]
    origin_ns: int

    @property
    def joints(self) -> tuple[JointSpec, ...]:
        """In the order of the IDL."""
        return DEX3_1.joints[self.side]

    @cached_property
    def device(self) -> Device:
        """Its descriptors."""
        return parse_device(self.record.descriptors)

    def seconds(self, time_ns: int) -> float:
        """A log time as seconds of the recording."""
        return (time_ns - self.origin_ns) / 1e9

    def phases(self, name: str) -> list[UsbPhase]:
        """The phases of that name."""
        return [p for p in self.record.phases if p.name == name]

    def span(self, phase: UsbPhase) -> tuple[float, float]:
        """Begin and end of a phase, seconds."""
        return self.seconds(phase.begin_ns), self.seconds(phase.end_ns)

    def during(self, phase: UsbPhase) -> list[Transfer]:
        """The transfers that were submitted in it."""
        return [t for t in self.transfers if phase.begin_ns <= t.submitted_ns < phase.end_ns]

    @cached_property
    def answers(self) -> list[Answer]:
        """Every frame from the device."""
        return list(self._answers_in(self.transfers))

    def answers_in(self, phase: UsbPhase) -> list[Answer]:
        """The frames from the device in a phase."""
        return [a for a in self.answers if phase.begin_ns <= a.transfer.submitted_ns < phase.end_ns]

    def _answers_in(self, transfers: Sequence[Transfer]) -> Iterator[Answer]:
        for transfer in transfers:
            if transfer.inward and not transfer.status:
                reading = read_state(transfer.data)
                yield Answer(self.seconds(transfer.done_ns), transfer, reading)

    def exchanges(self, phase: UsbPhase) -> list[Exchange]:
        """Commands of a phase, each with the answer before the next command."""
        known = {a.transfer.done_ns: a for a in self.answers}
        found: list[Exchange] = []
        for transfer in self.during(phase):
            t = self.seconds(transfer.submitted_ns)
            if not transfer.inward:
                found.append(Exchange(t, transfer, None))
            elif found and found[-1].answer is None and not transfer.status:
                last = found[-1]
                found[-1] = Exchange(last.t, last.command, known[transfer.done_ns])
        return found

    # -- motion ---------------------------------------------------------------------------------

    def motor(self, answer: Answer, joint: int) -> MotorReading | None:
        """A joint's motor in an answer."""
        place = self.record.buses[joint]
        return next((m for m in answer.reading.motors if (m.bus, m.id) == place), None)

    def q(self, answer: Answer) -> Floats:
        """Joint positions of an answer, rad, shape (7,); NaN where there is none."""
        found = np.full(len(self.joints), np.nan)
        places = {(m.bus, m.id): m.position for m in answer.reading.motors}
        for i, (place, joint) in enumerate(zip(self.record.buses, self.joints, strict=True)):
            if place in places:
                found[i] = places[place] / Scale(joint.gear_ratio).q
        return found

    def positions(self, phase: UsbPhase, *, before: bool = False) -> tuple[Floats, Floats]:
        """Times and joint positions of a phase's answers, shapes (n,) and (n, 7).

        :param before: include the last answer before it, which has the positions at its begin.
        """
        answers = self.answers_in(phase)
        if before:
            earlier = [a for a in self.answers if a.transfer.submitted_ns < phase.begin_ns]
            answers = earlier[-1:] + answers
        if not answers:
            return np.empty(0), np.empty((0, len(self.joints)))
        return np.array([a.t for a in answers]), np.array([self.q(a) for a in answers])


@dataclass(frozen=True, eq=False)
class UsbRecording:
    """The USB part of a recording.

    :param origin_ns: log time of second 0.
    """

    origin_ns: int
    sides: Mapping[Side, UsbSide]
    stalls: Sequence[Stall] = field(default_factory=tuple)
    beats: Beats = field(default_factory=Beats)
    waits: Waits | None = None

    @classmethod
    def decode(cls, trace: TraceLike) -> UsbRecording | None:
        """Decode the USB part of ``trace``, or None when it has none.

        :raises TraceUnsupported: it cannot be read.
        """
        if RECORD not in trace.metadata:
            return None
        record = UsbRecord.from_metadata(trace.metadata[RECORD])
        topics = {s: [topic(s, inward=i) for i in (False, True)] for s in record.sides}
        known = {c.topic for c in trace.channels}
        present = [t for side in topics.values() for t in side if t in known]
        samples = trace.load(present) if present else {}
        transfers: dict[Side, list[Transfer]] = {}
        for side, names in topics.items():
            found = [
                Transfer.from_payload(payload, int(sent), int(done))
                for name in names
                if name in samples
                for payload, sent, done in zip(
                    samples[name].payloads,
                    samples[name].publish_time_ns,
                    samples[name].log_time_ns,
                    strict=True,
                )
            ]
            transfers[side] = sorted(found, key=lambda t: (t.submitted_ns, t.done_ns))
        origin_ns = min((t.submitted_ns for side in transfers.values() for t in side), default=0)
        return cls(
            origin_ns,
            {s: UsbSide(s, part, transfers[s], origin_ns) for s, part in record.sides.items()},
            record.stalls,
            record.beats,
            record.waits,
        )

    def since(self, origin_ns: int) -> UsbRecording:
        """Return a copy with another second 0."""
        sides = {s: replace(side, origin_ns=origin_ns) for s, side in self.sides.items()}
        return UsbRecording(origin_ns, sides, self.stalls, self.beats, self.waits)

    def log_time(self, seconds: float) -> int:
        """The log time, nanoseconds, of a second of the recording."""
        return self.origin_ns + round(seconds * 1e9)

    def starved(self, begin: float, end: float) -> float:
        """Part of [begin, end], 0 to 1, in which programs waited for a processor."""
        if end <= begin:
            return 0.0
        seconds = sum(
            max(
                0.0,
                min(end, (s.end_ns - self.origin_ns) / 1e9)
                - max(begin, (s.begin_ns - self.origin_ns) / 1e9),
            )
            for s in self.stalls
        )
        return seconds / (end - begin)

    def starvation(self, subject: Subject, begin: float, end: float) -> Starvation | None:
        """How long the hand's processes waited for a processor in [begin, end]; None if unknown."""
        if self.waits is None:
            return None
        return self.waits.starvation(subject, self.log_time(begin), self.log_time(end))

    def lateness(self, begin: float, end: float) -> tuple[float, float] | None:
        """Median and 99th percentile, seconds, by which the kit itself was late in [begin, end];
        None if that is not known.
        """
        return self.beats.lateness(self.log_time(begin), self.log_time(end))

    def time_error(self, begin: float, end: float) -> float | None:
        """The kit's error of a time in [begin, end], seconds; None if it is not known."""
        late = self.lateness(begin, end)
        return None if late is None else late[1]

    def excess_lateness(self, begin: float, end: float) -> Lateness | None:
        """Delay of the kit in [begin, end] beyond that of an idle machine, s; None if unknown."""
        return self.beats.excess_lateness(self.log_time(begin), self.log_time(end))
