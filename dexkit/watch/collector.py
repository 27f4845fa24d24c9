"""Collect the traffic on DDS, sans IO: samples and endpoints in, a picture of any moment out.

::

    collector = Collector()
    collector.take(topic, type_name, payloads, received_ns, sent_ns)
    picture = collector.picture(collector.seconds(time.time_ns()))
    for topic in picture.topics:
        print(topic.name, topic.rate, topic.age, topic.missed)

The same collector serves a live domain, where the moment is now, and a recording, where it is any.

**Times** are seconds since the first sample. A sample's time is its source timestamp, moved by what
lies between that writer's clock and this one: the least difference between reception and source
timestamp so far. So samples that are taken together, 30 times a second, keep their distances.
Without source timestamps it is the time of reception.

Not for several threads at once: the caller locks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError
from dexkit.hand import Floats, JointSpec, MotorError, Subject
from dexkit.messages import Columns, message_type
from dexkit.messages.columns import RowReader
from dexkit.models import HandModel, ModeByte
from dexkit.pressure import RestingPressure, known
from dexkit.robots import RobotModel
from dexkit.watch.cycles import Cycles
from dexkit.watch.fields import Field, Part, parts_of
from dexkit.watch.history import History

__all__ = [
    "NEAR_LIMIT",
    "STALE",
    "Collector",
    "Picture",
    "SubjectView",
    "TopicView",
    "fault_names",
]

NEAR_LIMIT = 0.015
"""Part of a joint's stroke beside a limit that counts as near it."""
STALE = 0.5
"""Seconds after which a state is old."""

_RATE_WINDOW = 1.0
_KEPT = 120.0  # seconds of a live topic
_DRIFT = 1e-4  # seconds a second by which two clocks may run apart
_MOST_TOPICS = 256
_MOST_WRITERS = 16  # whose cycles are counted, of a topic

Times = NDArray[np.int64]


@dataclass(frozen=True)
class TopicView:
    """One topic of one type at a moment.

    :param role: ``state``, ``cmd``, ``low``, ``arm`` or ``other``.
    :param rate: samples in the last second.
    :param expected: those that the vendor's publisher sends; 0 where that is not known.
    :param age: seconds since the last sample; NaN before the first.
    :param gaps: intervals longer than 2.5 periods; ``missed`` the cycles missing in them,
        ``longest`` the longest, seconds.
    :param writers: how many wrote in the last second.
    :param publishers: processes that publish it, as far as they say so; ``subscribers`` likewise.
    :param undecodable: samples that are not the message they claim to be.
    """

    name: str
    type_name: str
    role: str
    rate: float
    expected: float
    age: float
    samples: int
    gaps: int
    missed: int
    longest: float
    writers: int
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    undecodable: int


@dataclass(frozen=True, eq=False)
class SubjectView:
    """One hand, or a robot, at a moment; arrays of shape (n_joints,), NaN where unknown.

    :param joints: in the units of the dialect.
    :param age: seconds since the last state; ``command_age`` since the last command. NaN: none.
    :param target: commanded q, NaN where the joint is not driven or the command is too old.
    :param fault: :class:`~dexkit.hand.MotorError` bits.
    :param near: which joints are near a limit: -1 the lower, 1 the upper one, 0 neither.
    :param pressure: of the sensor elements in the order of the model's sensors and their slots, in
        the message's unit; empty without sensors.
    :param pressure_at_rest: what each of them reads at rest, by :mod:`dexkit.pressure`.
    :param touch: of a hand with a touch topic: the most that an element of each of the model's
        areas counts; NaN where it is not known or old, empty without a topic.
    :param commanders: processes that publish the command topic, as far as they say so.
    :param command_timeout: seconds after which a command no longer counts.
    :param prefix: under which its topics are; empty for none.
    """

    subject: Subject
    model: HandModel | RobotModel
    dialect: str
    joints: tuple[JointSpec, ...]
    age: float
    command_age: float
    q: Floats
    dq: Floats
    tau: Floats
    temperature: Floats
    fault: NDArray[np.uint32]
    target: Floats
    near: NDArray[np.int8]
    pressure: Floats
    pressure_at_rest: Floats
    touch: Floats
    commanders: tuple[str, ...]
    command_timeout: float
    prefix: str = ""

    @property
    def stale(self) -> bool:
        """Whether its state is old, or there is none."""
        return not self.age <= STALE

    @property
    def torque_part(self) -> Floats:
        """Torque as a part of each joint's largest, 0 to 1, shape (n_joints,); 0 where unknown."""
        most = np.array([j.tau_max for j in self.joints])
        return np.asarray(np.clip(np.abs(np.nan_to_num(self.tau)) / most, 0.0, 1.0))

    @property
    def pressure_change(self) -> Floats:
        """Change of :attr:`pressure` from what each element reads at rest; a touch may lower it."""
        return self.pressure - self.pressure_at_rest

    @property
    def touched(self) -> dict[str, float]:
        """By finger and for the palm, in the message's order: of a hand with a touch topic the
        largest of :attr:`touch`, of one with sensors the largest :attr:`pressure_change` of either
        sign. Empty without either.
        """
        fingers: dict[str, float] = {}
        for place, value in self._felt():
            finger = place.partition(" ")[0]
            before = fingers.get(finger, math.nan)
            if math.isnan(before) or abs(value) > abs(before):
                fingers[finger] = value
        return fingers

    def _felt(self) -> Iterable[tuple[str, float]]:
        if not isinstance(self.model, HandModel):
            return ()
        if len(self.touch):
            places = [area.place for area in self.model.dialects[0].areas]
            return zip(places, self.touch.tolist(), strict=True)
        places = (
            [s.place for s in self.model.sensors for _ in s.slots] if len(self.pressure) else []
        )
        return zip(places, self.pressure_change.tolist(), strict=True)

    @property
    def fraction(self) -> Floats:
        """Q as a part of each joint's stroke, 0 at the lower limit, shape (n_joints,)."""
        low = np.array([j.q_min for j in self.joints])
        return np.asarray((self.q - low) / np.array([j.stroke for j in self.joints]))

    @property
    def faults(self) -> list[str]:
        """Each fault with its joint: ``thumb_1: winding overtemperature``."""
        return [
            f"{joint.name}: {name}"
            for joint, bits in zip(self.joints, self.fault.tolist(), strict=True)
            for name in fault_names(bits)
        ]


@dataclass(frozen=True, eq=False)
class Picture:
    """The data of one time.

    :param at: seconds since the first sample.
    :param topics: by name; ``subjects`` by dialect, left before right.
    """

    at: float
    topics: tuple[TopicView, ...]
    subjects: tuple[SubjectView, ...]


def fault_names(bits: int) -> list[str]:
    """The names of motor error bits; a bit without a name is given as its number."""
    if not bits:
        return []
    names = [
        (e.name or "").lower().replace("_", " ") for e in MotorError if e.value and bits & e.value
    ]
    known = sum(e.value for e in MotorError)
    if rest := bits & ~known:
        names.append(f"{rest:#x}")
    return names


class _Topic:
    """The samples of one topic of one type."""

    def __init__(self, name: str, type_name: str, most: int | None) -> None:
        self.name = name
        self.type_name = type_name
        self.parts = parts_of(name, type_name)
        self.expected = self.parts[0].expected if self.parts else 0.0
        self.fields = [f for part in self.parts for f in part.fields]
        seconds = None if most is None else _KEPT
        self.history = History(len(self.fields), most, seconds)
        self.cycles: dict[int, Cycles] = {}
        self.offsets: dict[int, tuple[float, float]] = {}
        self.bad = History(0, most, seconds)
        self._factors = np.array([f.factor for f in self.fields])
        paths = [f.paths for f in self.fields]
        self._paths = [path for each in paths for path in each]
        self._starts = np.cumsum([0, *(len(each) for each in paths)])[:-1]
        self._reader = (
            RowReader(message_type(type_name).layout, self._paths) if self.fields else None
        )
        # the writer of each of the last samples, by time
        self._writers = History(1, most, seconds)
        self._numbers: dict[int, int] = {}
        self._pressures = [i for i, f in enumerate(self.fields) if f.quantity == "pressure"]
        self._resting = RestingPressure(len(self._pressures))

    def take(
        self,
        payloads: Columns | Sequence[bytes],
        received: Floats,
        sent: Floats,
        writers: Times,
    ) -> None:
        t = self._times(received, sent, writers)
        bad: NDArray[np.intp] = np.empty(0, dtype=np.intp)
        rows: Floats = np.empty((len(t), len(self.fields)))
        if isinstance(payloads, Columns):
            rows = self._shown(payloads.table(self._paths))
            bad = np.flatnonzero(~payloads.ok)
        elif self._reader is not None:
            numbers_read, good = self._reader.read(payloads)
            rows = self._shown(numbers_read)
            bad = np.flatnonzero(~good)
        order = np.argsort(t, kind="stable")
        self.history.append(t[order], rows[order])
        if self._pressures:
            self._resting.take(t[order], rows[order][:, self._pressures])
        numbers = [self._numbers.setdefault(w, len(self._numbers)) for w in writers.tolist()]
        self._writers.append(t[order], np.array(numbers, dtype=np.float64)[order, None])
        if len(bad):
            self.bad.append(np.sort(t[bad]), np.empty((len(bad), 0)))

    def _shown(self, numbers: Floats) -> Floats:
        """The fields of each sample, from all their numbers."""
        if len(self._paths) > len(self.fields):
            numbers = np.fmax.reduceat(numbers, self._starts, axis=1)
        return np.asarray(numbers * self._factors)

    def _times(self, received: Floats, sent: Floats, writers: Times) -> Floats:
        t = received.copy()
        for writer in np.unique(writers).tolist():
            mine = writers == writer
            stamped = mine & np.isfinite(sent)
            if stamped.any():
                least = float((received[stamped] - sent[stamped]).min())
                now = float(received[stamped][-1])
                before, then = self.offsets.get(writer, (math.inf, now))
                offset = min(least, before + _DRIFT * (now - then))
                self.offsets[writer] = offset, now
                t[stamped] = sent[stamped] + offset
            if writer not in self.cycles and len(self.cycles) >= _MOST_WRITERS:
                continue
            cycles = self.cycles.setdefault(writer, Cycles())
            cycles.add(np.sort(t[mine]))
        return t

    def rate(self, at: float) -> float:
        begin, end = self.history.until(at - _RATE_WINDOW), self.history.until(at)
        count = end - begin
        if count < 2:
            return float(count)
        if begin > 0:
            return count / _RATE_WINDOW
        # the first second: what there is, over the time that it took
        t = self.history.t
        span = float(t[end - 1] - t[begin])
        return (count - 1) / span if span > 0.1 else float(count)

    def age(self, at: float) -> float:
        end = self.history.until(at)
        return at - float(self.history.t[end - 1]) if end else math.nan

    def row(self, at: float) -> Floats | None:
        end = self.history.until(at)
        return self.history.rows[end - 1] if end else None

    @property
    def at_rest(self) -> Floats:
        """A row with what the pressures read at rest, shape (n_fields,); NaN elsewhere."""
        row: Floats = np.full(len(self.fields), np.nan)
        row[self._pressures] = self._resting.level
        return row

    def writing(self, at: float) -> int:
        some = self._writers.between(at - _RATE_WINDOW, at)
        return len(np.unique(self._writers.rows[some, 0]))

    def place(self, part: Part) -> int:
        """Index of a part's first field."""
        first = 0
        for each in self.parts:
            if each is part:
                break
            first += len(each.fields)
        return first


class Collector:
    """Collects the samples of a domain or a recording.

    :param most: samples of each topic whose values are kept, as far as they are not older than two
        minutes; None keeps all, for a recording.

    :ivar origin_ns: time of second 0, ns since the epoch; 0 before the first sample.
    :ivar ignored: samples of topics beyond the first 256.
    """

    def __init__(self, most: int | None = 20_000) -> None:
        self.origin_ns = 0
        self.ignored = 0
        self._most = most
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._endpoints: dict[str, tuple[str, str, str]] = {}

    # -- in ------------------------------------------------------------------------------------

    def take(
        self,
        topic: str,
        type_name: str,
        payloads: Sequence[bytes] | Columns,
        received_ns: Times | Sequence[int],
        sent_ns: Times | Sequence[int],
        writers: Times | Sequence[int] = (),
    ) -> None:
        """Take samples of one topic, in the order of their reception.

        :param payloads: as on the wire, or decoded.
        :param received_ns: when each was received, ns since the epoch.
        :param sent_ns: source timestamps, likewise; 0 or less where there is none.
        :param writers: who wrote each; nothing if that is not known.
        """
        count = len(received_ns)
        if not count:
            return
        found = self._topics.get((topic, type_name))
        if found is None:
            if len(self._topics) >= _MOST_TOPICS:
                self.ignored += count
                return
            found = self._topics[topic, type_name] = _Topic(topic, type_name, self._most)
        received = np.asarray(received_ns, dtype=np.int64)
        if not self.origin_ns:
            self.origin_ns = int(received[0])
        sent = np.asarray(sent_ns, dtype=np.int64)
        found.take(
            payloads,
            (received - self.origin_ns) / 1e9,
            np.where(sent > 0, (sent - self.origin_ns) / 1e9, np.nan),
            np.asarray(writers if len(writers) else np.zeros(count), dtype=np.int64),
        )

    def endpoint(self, key: str, topic: str, kind: str, process: str) -> None:
        """Note that a process reads or writes a topic.

        :param key: of the endpoint, for :meth:`endpoint_gone`.
        :param kind: ``"reader"`` or ``"writer"``.
        """
        self._endpoints[key] = (topic, kind, process)

    def endpoint_gone(self, key: str) -> None:
        """Forget an endpoint; one that is not known is no error."""
        self._endpoints.pop(key, None)

    # -- out -----------------------------------------------------------------------------------

    def seconds(self, time_ns: int) -> float:
        """A time as seconds since the first sample; 0 before there is one."""
        return (time_ns - self.origin_ns) / 1e9 if self.origin_ns else 0.0

    @property
    def last(self) -> float:
        """Time of the newest sample, seconds; 0 without samples."""
        return max((float(t.history.t[-1]) for t in self._topics.values() if len(t.history)),
                   default=0.0)  # fmt: skip

    def picture(self, at: float) -> Picture:
        """The data at the time ``at``, seconds since the first sample."""
        views = [self._topic_view(t, at) for _, t in sorted(self._topics.items())]
        silent = self._announced() - {t.name for t in self._topics.values()}
        views += [self._silent_view(name) for name in sorted(silent)]
        return Picture(at, tuple(sorted(views, key=lambda v: v.name)), tuple(self._subjects(at)))

    def fields(self) -> list[tuple[str, Part, Field]]:
        """Every number that has a history, with its topic and the part that it belongs to, in the
        order of topics.
        """
        topics = [topic for _, topic in sorted(self._topics.items())]
        return [(t.name, part, f) for t in topics for part in t.parts for f in part.fields]

    def curve(self, topic: str, path: str, begin: float, end: float) -> tuple[Floats, Floats]:
        """The history of a number in [begin, end]: times and values, copies.

        :raises UsageError: there is no such number.
        """
        for (name, _), found in self._topics.items():
            if name != topic:
                continue
            for i, each in enumerate(found.fields):
                if each.path == path:
                    some = found.history.between(begin, end)
                    values = found.history.rows[some, i].copy()
                    return found.history.t[some].copy(), values
        raise UsageError(f"nothing is known of {path} of {topic}")

    def gaps(self, topic: str) -> list[tuple[float, float, int]]:
        """The last gaps of a topic: end, length in seconds, cycles missed; in order of time."""
        found = [t for (name, _), t in self._topics.items() if name == topic]
        return sorted(g for t in found for c in t.cycles.values() for g in c.gaps)

    def _announced(self) -> set[str]:
        known = {name for name, _, _ in self._endpoints.values()}
        return {name for name in known if not name.startswith("DCPS")}

    def _processes(self, topic: str, kind: str) -> tuple[str, ...]:
        found = [p or "?" for t, k, p in self._endpoints.values() if (t, k) == (topic, kind)]
        return tuple(sorted(found))

    def _silent_view(self, name: str) -> TopicView:
        nan = math.nan
        return TopicView(
            name, "", "other", 0.0, 0.0, nan, 0, 0, 0, 0.0, 0,
            self._processes(name, "writer"), self._processes(name, "reader"), 0,
        )  # fmt: skip

    def _topic_view(self, topic: _Topic, at: float) -> TopicView:
        counts = [c.until(at) for c in topic.cycles.values()]
        later = len(topic.history) - topic.history.until(at)
        return TopicView(
            name=topic.name,
            type_name=topic.type_name,
            role=topic.parts[0].kind if topic.parts else "other",
            rate=topic.rate(at),
            expected=topic.expected,
            age=topic.age(at),
            samples=topic.history.added - later,
            gaps=sum(c[0] for c in counts),
            missed=sum(c[1] for c in counts),
            longest=max((c[2] for c in counts), default=0.0),
            writers=topic.writing(at),
            publishers=self._processes(topic.name, "writer"),
            subscribers=self._processes(topic.name, "reader"),
            undecodable=topic.bad.added - (len(topic.bad) - topic.bad.until(at)),
        )

    def _subjects(self, at: float) -> Iterable[SubjectView]:
        by_subject: dict[tuple[str, str, str], dict[str, tuple[_Topic, Part]]] = {}
        for _, topic in sorted(self._topics.items()):
            for part in topic.parts:
                key = (part.prefix, part.dialect, str(part.subject))
                by_subject.setdefault(key, {})[part.kind] = (topic, part)
        for _, found in sorted(by_subject.items()):
            view = self._subject_view(found, at)
            if view is not None:
                yield view

    def _subject_view(self, found: dict[str, tuple[_Topic, Part]], at: float) -> SubjectView | None:
        _, part = next(iter(found.values()))
        state = next((found[k] for k in ("state", "low") if k in found), None)
        nothing: Floats = np.full(len(part.joints), np.nan)
        q = dq = tau = temperature = nothing
        fault: NDArray[np.uint32] = np.zeros(len(part.joints), dtype=np.uint32)
        pressure: Floats = np.empty(0)
        at_rest: Floats = np.empty(0)
        age = math.nan
        if state is not None and (row := state[0].row(at)) is not None:
            age = state[0].age(at)
            q, dq, tau, temperature = (
                _values(row, state, name) for name in ("q", "dq", "tau", "temperature")
            )
            if len(bits := _values(row, state, "fault")) == len(fault):
                fault = np.nan_to_num(bits).astype(np.uint32)
            pressure = known(_values(row, state, "pressure"))
            at_rest = _values(state[0].at_rest, state, "pressure")
        touch: Floats = np.empty(0)
        felt = found.get("touch")
        if felt is not None:
            row = felt[0].row(at) if felt[0].age(at) <= STALE else None
            touch = np.full(len(felt[1].fields), np.nan)
            if row is not None:
                touch = _values(row, felt, "touch")
        target, command_age = nothing, math.nan
        command = found.get("cmd")
        if command is not None and (row := command[0].row(at)) is not None:
            command_age = command[0].age(at)
            if command_age <= part.timeout:
                target = _target(row, command)
        low, high = (np.array([getattr(j, n) for j in part.joints]) for n in ("q_min", "q_max"))
        margin = NEAR_LIMIT * (high - low)
        with np.errstate(invalid="ignore"):
            near = (q >= high - margin).astype(np.int8) - (q <= low + margin).astype(np.int8)
        return SubjectView(
            subject=part.subject,
            model=part.model,
            dialect=part.dialect,
            joints=part.joints,
            age=age,
            command_age=command_age,
            q=q,
            dq=dq,
            tau=tau,
            temperature=temperature,
            fault=fault,
            target=target,
            near=near,
            pressure=pressure,
            pressure_at_rest=at_rest,
            touch=touch,
            commanders=self._processes(command[0].name, "writer") if command else (),
            command_timeout=part.timeout,
            prefix=part.prefix,
        )


def _values(row: Floats, of: tuple[_Topic, Part], quantity: str) -> Floats:
    topic, part = of
    first = topic.place(part)
    return np.asarray(row[[first + i for i in part.columns(quantity)]])


def _target(row: Floats, command: tuple[_Topic, Part]) -> Floats:
    """Commanded q of the joints that the command drives."""
    q, kp, mode = (_values(row, command, name) for name in ("q", "kp", "mode"))
    part = command[1]
    if not len(kp):  # a command of goals alone
        return q
    if part.mode_byte is ModeByte.UNUSED:
        driven = (kp > 0) | (not part.gains_are_used)
    else:
        bits = np.nan_to_num(mode).astype(np.int64)
        driven = (bits >> 4 & 7 if part.mode_byte is ModeByte.RIS else bits) == 1
    return np.where(driven, q, np.nan)
