"""Decode a recording of DDS topics into arrays of commands and states for each subject.

Times are seconds from the beginning of the recording: ``t`` is reception, ``sent`` the source
timestamp. Positions are in the dialect's radians (or the model's other unit), torques of states in
N·m and speeds in that unit a second, whatever the dialect's units; columns of joints have shape
(n, n_joints).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.processor_waits import Starvation
from dexkit.conformance.kit.provenance import Provenance
from dexkit.conformance.kit.run_record import RECORD as RUN
from dexkit.conformance.kit.stimulus_record import RECORD, Phase, Stimulus
from dexkit.conformance.kit.touch import Touch
from dexkit.conformance.layers import layer
from dexkit.errors import ConformanceError, UsageError
from dexkit.hand import Floats, JointSpec, Side, Subject
from dexkit.messages.columns import Columns
from dexkit.models import DIALECTS, Dialect, HandModel, dialect, model
from dexkit.other_interfaces import TWO_FINGERS, is_two_fingers, other_interface
from dexkit.robots import RobotModel
from dexkit.traces import ChannelInfo, SampleArray, TraceEndpoint
from dexkit.traces.clock_steps import ClockStep, refuse_clock_steps
from dexkit.traces.names import SESSION
from dexkit.traces.sessions.streams import HAND

if TYPE_CHECKING:
    from dexkit.conformance.usb.recording import UsbRecording

__all__ = [
    "Commands",
    "Recording",
    "SideView",
    "States",
    "TopicDecoder",
    "TraceLike",
    "detect_dialect",
    "joints_of",
]

_IMPOSSIBLE = 20.0
"""Part of a joint's torque that nobody takes for one: a drive has a few times what is rated."""
_OFTEN = 0.75
"""Quantile of the largest part in each state that must be beyond that: real hands were seen with an
offset of thousands of counts at rest (docs/sources/real-hands.md#dex3-tau)."""
_SOME = 50
"""Rows that are looked at first."""


class TraceLike(Protocol):
    """The methods that judging needs of a recording; :class:`dexkit.traces.Trace` has them."""

    metadata: dict[str, dict[str, str]]
    warnings: list[str]
    mixed_types: dict[str, str]
    truncated: bool

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel."""
        ...

    @property
    def clock_steps(self) -> list[ClockStep]:
        """Where the times of a channel step back."""
        ...

    @property
    def endpoints(self) -> list[TraceEndpoint]:
        """Every endpoint that DDS discovery reported."""
        ...

    def load(
        self, topics: Iterable[str] | None = None, *, decode: bool = False
    ) -> dict[str, SampleArray]:
        """Samples by topic; ``decode``: as columns, if it can."""
        ...


@dataclass(frozen=True, eq=False)
class States:
    """The states of a subject. Values that a sample lacks are NaN.

    :param length: motors in the sequence; -1 where the sample does not decode.
    :param q: shape (n, n_joints), as ``dq``, ``ddq``, ``tau`` and ``mode``.
    :param errors: what is wrong with samples that do not decode, by index.
    :param columns: every other member, by its path; None without samples.
    """

    topic: str
    t: Floats
    sent: Floats
    length: NDArray[np.intp]
    q: Floats
    dq: Floats
    ddq: Floats
    tau: Floats
    mode: Floats
    errors: Mapping[int, str] = field(default_factory=dict)
    columns: Columns | None = None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def say_nothing(self) -> bool:
        """Whether every number in every state is 0."""
        return self.columns is not None and self.columns.are_zero

    @cached_property
    def clock(self) -> Floats:
        """The times to judge the publisher by: source timestamps where the recording has them.

        They are of the publisher's clock, which on a robot may be hours off. What separates them
        from reception in the middle of all samples is taken off, so that they can be compared
        with the recording's times.
        """
        return _publisher_times(self.t, self.sent)

    def between(self, begin: float, end: float) -> slice:
        """The samples received in [begin, end]."""
        return slice(
            int(np.searchsorted(self.t, begin)), int(np.searchsorted(self.t, end, "right"))
        )


@dataclass(frozen=True, eq=False)
class Commands:
    """The commands to a subject, of all writers. Values that a sample lacks are NaN.

    :param length: motors in the sequence; -1 where the sample does not decode.
    :param q: shape (n, n_joints), as ``dq``, ``tau``, ``kp``, ``kd`` and ``mode``.
    """

    topic: str
    t: Floats
    sent: Floats
    length: NDArray[np.intp]
    q: Floats
    dq: Floats
    tau: Floats
    kp: Floats
    kd: Floats
    mode: Floats

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def clock(self) -> Floats:
        """The times to judge the client by; see :attr:`States.clock`."""
        return _publisher_times(self.t, self.sent)


@dataclass(frozen=True, eq=False)
class SideView:
    """One hand, or a robot, in the recording.

    :param known: what several checks need and one of them has worked out, by a name.
    """

    side: Subject
    states: States
    commands: Commands
    joints: tuple[JointSpec, ...]
    known: dict[object, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def has_raw_torque(self) -> bool:
        """Whether tau_est is beyond what any such joint can do, in any unit of torque: raw counts.

        Not only once, for that is a wrong value.
        """
        part = np.abs(self.states.tau) / np.array([j.tau_max for j in self.joints])
        most = np.nan_to_num(part).max(axis=1, initial=0.0)
        return bool(len(most)) and float(np.quantile(most, _OFTEN)) > _IMPOSSIBLE


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, decoded.

    :param origin_ns: log time of second 0.
    :param duration: seconds.
    :param sides: every subject that has a topic; ``judged`` names those to be judged.
    :param stimulus: the phases of the stimulus, or None in a recording that no live run made.
    :param usb: what was transferred on USB, where the kit did that.
    :param run: the run record; empty in a recording that no live run made.
    :param low_rate: the states on the low-rate topics, where there are any.
    :param touch: what tactile areas felt, likewise.
    :param provenance: what it can hold, by where it comes from.
    """

    dialect: Dialect
    origin_ns: int
    duration: float
    sides: Mapping[Subject, SideView]
    channels: Sequence[ChannelInfo]
    endpoints: Sequence[TraceEndpoint]
    stimulus: Stimulus | None
    judged: tuple[Subject, ...]
    notes: Sequence[str] = ()
    usb: UsbRecording | None = None
    run: Mapping[str, str] = field(default_factory=dict)
    low_rate: Mapping[Subject, States] = field(default_factory=dict)
    touch: Mapping[Subject, Touch] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)

    layer = "dds"
    """Which layer's requirements it is judged by."""

    @classmethod
    def decode(
        cls,
        trace: TraceLike,
        *,
        dialect_name: str | None = None,
        sides: Sequence[Side] = (),
    ) -> Recording:
        """Decode ``trace``.

        :param dialect_name: None to take the one that the topics and types show.
        :param sides: the sides to judge; none for those that have a topic.
        :raises ConformanceError: it has no topic of the dialect.
        :raises TraceUnsupported: its stimulus record, or its USB part, cannot be read.
        """
        chosen = dialect(dialect_name) if dialect_name else detect_dialect(trace)
        slow = {s: chosen.low_rate_topic.format(side=s) for s in Side}
        felt = {s: chosen.touch_topic_of(s) for s in Side}
        title = f"{model(chosen.model).title} topic of dialect {chosen.name}"
        found = TopicDecoder(
            trace,
            MotorCodec(chosen),
            missing="" if sides else title,
            more=[*slow.values(), *felt.values()],
            usb=True,
        )
        judged = tuple(sides) or tuple(s for s in Side if found.knows(s))
        # the other side is decoded as well: checks of independence compare both
        views: dict[Subject, SideView] = {
            s: found.view(s, joints_of(chosen, s))
            for s in (Side.LEFT, Side.RIGHT)
            if s in judged or not found.present.isdisjoint(chosen.topics(s))
        }
        # a service of one hand fills the other's place in their message with zeros; a topic of its
        # own has its zeros from a hand
        left_out = () if sides else _left_out(chosen, {s: views[s] for s in judged})
        judged = tuple(s for s in judged if s not in left_out)
        # the kit itself publishes another type in the phase 'foreign'
        phases = found.stimulus.phases if found.stimulus else []
        notes = found.notes({s for p in phases if p.name == "foreign" for s in p.sides})
        common = found.common()
        if note := common["provenance"].note():
            notes.append(note)
        notes += [
            f"{views[s].states.topic} says nothing of the {s} hand (all 0), and nobody drives it: "
            f"taken for a service of one hand; --side {s} judges it all the same"
            for s in left_out
        ]
        notes += [
            f"{view.commands.topic}: {TWO_FINGERS}"
            for view in views.values()
            if len(view.commands) and is_two_fingers(view.commands.q[0], view.commands.kp[0])
        ]
        touch = {s: found.of_type(topic, chosen.touch_type) for s, topic in felt.items()}
        slow = {s: topic for s, topic in slow.items() if topic in found.present}
        return cls(
            **common,
            sides=views,
            judged=judged,
            notes=notes,
            low_rate={s: found.states(s, topic) for s, topic in slow.items()},
            touch={s: _touch(chosen, x, found.origin_ns) for s, x in touch.items() if x},
        )

    @property
    def model(self) -> HandModel | RobotModel:
        """The model that the dialect belongs to."""
        return model(self.dialect.model)

    @property
    def unit(self) -> str:
        """The unit of q, and of what is derived from it."""
        return self.model.unit

    def seconds(self, time_ns: int) -> float:
        """A log time as seconds of this recording."""
        return (time_ns - self.origin_ns) / 1e9

    def log_time(self, seconds: float) -> int:
        """A second of this recording as a log time."""
        return self.origin_ns + round(seconds * 1e9)

    def phases(self, name: str, side: Subject | None = None) -> list[Phase]:
        """The phases of that name, about that side."""
        if self.stimulus is None:
            return []
        return [
            p for p in self.stimulus.phases if p.name == name and (side is None or side in p.sides)
        ]

    def starved(self, begin: float, end: float) -> float:
        """Part of [begin, end], 0 to 1, in which programs waited for a processor."""
        if self.stimulus is None or end <= begin:
            return 0.0
        seconds = sum(
            max(0.0, min(end, self.seconds(s.end_ns)) - max(begin, self.seconds(s.begin_ns)))
            for s in self.stimulus.stalls
        )
        return seconds / (end - begin)

    def lateness(self, begin: float, end: float) -> tuple[float, float] | None:
        """Median and 99th percentile, seconds, by which the kit itself was late in [begin, end];
        None if that is not known.
        """
        if self.stimulus is None:
            return None
        return self.stimulus.beats.lateness(self.log_time(begin), self.log_time(end))

    def time_error(self, begin: float, end: float) -> float | None:
        """The kit's error of a time in [begin, end], seconds; None if it is not known."""
        if self.stimulus is None:
            return None
        return self.stimulus.time_error(self.log_time(begin), self.log_time(end))

    def excess_lateness(self, begin: float, end: float) -> Lateness | None:
        """Delay of the kit in [begin, end] beyond that of an idle machine, s; None if unknown."""
        if self.stimulus is None:
            return None
        return self.stimulus.beats.excess_lateness(self.log_time(begin), self.log_time(end))

    def starvation(self, subject: Subject, begin: float, end: float) -> Starvation | None:
        """How long the hand's processes waited for a processor in [begin, end]; None if unknown."""
        if self.stimulus is None or self.stimulus.waits is None:
            return None
        return self.stimulus.waits.starvation(subject, self.log_time(begin), self.log_time(end))


class TopicDecoder:
    """Decodes the topics of a dialect; hands and robots share it.

    :param codec: has the topics of each subject, and reads the columns of their motors.
    :param missing: what a recording lacks that has none of these topics; empty if it may.
    :param more: other topics that are to be read, if they are there.
    :param usb: decode what was transferred on USB as well.
    :param payloads: keep the payloads; columns alone take a tenth of the memory.
    :raises ConformanceError: there is no such topic.
    :raises SessionError: a stretch of time is there twice.
    :raises TraceUnsupported: the stimulus record, or the USB part, cannot be read.

    :ivar present: the topics that have messages.
    :ivar origin_ns: log time of second 0.
    """

    def __init__(
        self,
        trace: TraceLike,
        codec: MotorCodec,
        *,
        missing: str,
        more: Iterable[str] = (),
        usb: bool = False,
        payloads: bool = False,
    ) -> None:
        self._trace, self._codec = trace, codec
        refuse_clock_steps("the recording", trace.clock_steps)
        recorded = trace.metadata.get(RECORD)
        self.stimulus = None if recorded is None else Stimulus.from_metadata(recorded)
        self.present = {c.topic for c in trace.channels if c.message_count}
        self._known = self.present | {e.topic for e in trace.endpoints}
        own = {*codec.command_topics.values(), *codec.state_topics.values()}
        if missing and own.isdisjoint(self._known):
            raise ConformanceError(
                f"no {missing} in this recording",
                hint=f"it has: {', '.join(sorted(self.present)) or 'no messages'}",
            )
        topics = own & self.present
        wanted = sorted(topics | set(more) & self.present)
        self._samples = trace.load(wanted, decode=not payloads) if topics else {}
        times = [s.log_time_ns for topic, s in self._samples.items() if topic in topics and len(s)]
        marks = [p.begin_ns for p in self.stimulus.phases] if self.stimulus else []
        found_usb = layer("usb").decode(trace, None, ()) if usb else None
        if found_usb is not None:
            marks.append(found_usb.origin_ns)
        self.origin_ns = min([int(t[0]) for t in times] + marks, default=0)
        self._end_ns = max([int(t[-1]) for t in times] + marks, default=0)
        self._usb = None if found_usb is None else found_usb.since(self.origin_ns)

    def common(self) -> dict[str, Any]:
        """The arguments of a :class:`Recording` that do not depend on its subjects."""
        return {
            "dialect": self._codec.dialect,
            "origin_ns": self.origin_ns,
            "duration": (self._end_ns - self.origin_ns) / 1e9,
            "channels": self._trace.channels,
            "endpoints": self._trace.endpoints,
            "stimulus": self.stimulus,
            "usb": self._usb,
            "run": self._trace.metadata.get(RUN, {}),
            "provenance": Provenance.of(self._trace.metadata),
        }

    def knows(self, subject: Subject) -> bool:
        """Whether the subject has a topic: messages, or an endpoint."""
        return not self._known.isdisjoint(self._codec.dialect.topics(subject))

    def notes(self, confused: Iterable[Subject]) -> list[str]:
        """Remarks on the recording.

        :param confused: subjects to which the kit itself publishes another type.
        """
        own = {self._trace.mixed_types.get(self._codec.command_topics[s]) for s in confused}
        notes = [text for text in self._trace.warnings if text not in own]
        if self._trace.truncated:
            notes.append("the recording is unfinished; it is judged as far as it goes")
        return notes

    def of_type(self, topic: str, type_name: str) -> SampleArray | None:
        """The samples of a topic, if it is there with that type and can be decoded."""
        samples = self._samples.get(topic)
        if samples is None or samples.type_name != type_name:
            return None
        return None if samples.problem and samples.decoded is None else samples

    def view(self, subject: Subject, joints: tuple[JointSpec, ...]) -> SideView:
        """The states and commands of a subject."""
        states = self.states(subject, self._codec.state_topics[subject])
        return SideView(subject, states, self._commands(subject), joints)

    def states(self, subject: Subject, topic: str) -> States:
        """The states of a subject on a topic."""
        codec = self._codec
        samples = self.of_type(topic, codec.dialect.state_type)
        if samples is None:
            t, none = np.empty(0), np.empty((0, codec.joints))
            return States(topic, t, t, np.empty(0, np.intp), none, none, none, none, none)
        columns = samples.columns()

        def column(name: str, unit: tuple[float, ...] = ()) -> Floats:
            with np.errstate(invalid="ignore"):  # NaN in a message is judged by the checks
                values = codec.column(columns, subject, codec.state, name)
                return _times_unit(values, unit) if unit else values

        speeds, torques = codec.dialect.speed_units, codec.dialect.torque_units
        return States(
            topic=topic,
            t=_seconds(samples.log_time_ns, self.origin_ns),
            sent=self._sent(samples),
            length=codec.count(columns, codec.state_sequence),
            q=column("q"),
            dq=column("dq", speeds),
            ddq=column("ddq", speeds),
            tau=column("tau_est", torques),
            mode=column("mode"),
            errors={i: str(e) for i, e in columns.errors.items()},
            columns=columns,
        )

    def _sent(self, samples: SampleArray) -> Floats:
        """Source timestamps, seconds; NaN where they are unknown.

        A format without them has the times of reception there.
        """
        sent = _seconds(samples.publish_time_ns, self.origin_ns)
        received = self.stimulus is None and np.array_equal(
            samples.publish_time_ns, samples.log_time_ns
        )
        sent[(samples.publish_time_ns == 0) | received] = np.nan
        return sent

    def _commands(self, subject: Subject) -> Commands:
        codec = self._codec
        topic = codec.command_topics[subject]
        samples = self.of_type(topic, codec.dialect.cmd_type)
        if samples is None:
            t, none = np.empty(0), np.empty((0, codec.joints))
            count = np.empty(0, np.intp)
            return Commands(topic, t, t, count, none, none, none, none, none, none)
        columns = samples.columns()

        def column(name: str) -> Floats:
            with np.errstate(invalid="ignore"):
                return codec.column(columns, subject, codec.command, name)

        return Commands(
            topic=topic,
            t=_seconds(samples.log_time_ns, self.origin_ns),
            sent=self._sent(samples),
            length=codec.count(columns, codec.command_sequence),
            q=column("q"),
            dq=column("dq"),
            tau=column("tau"),
            kp=column("kp"),
            kd=column("kd"),
            mode=column("mode"),
        )


def detect_dialect(trace: TraceLike) -> Dialect:
    """The dialect whose topics and types are in the recording.

    :raises ConformanceError: none.
    """
    present = {(c.topic, c.type_name) for c in trace.channels}
    present |= {(e.topic, e.type_name) for e in trace.endpoints}
    topics = {topic for topic, _ in present}

    def score(d: Dialect) -> tuple[int, int]:
        cmd = [(d.topics(s)[0], d.cmd_type) for s in Side]
        state = [(d.topics(s)[1], d.state_type) for s in Side]
        exact = sum(pair in present for pair in cmd + state)
        named = sum(topic in topics for topic, _ in cmd + state)
        return exact, named

    best = max(DIALECTS.values(), key=score)  # the first, unitree_go, wins a tie
    if score(best) == (0, 0):
        names = ", ".join(sorted(c.topic for c in trace.channels)) or "no topics at all"
        wanted = ", ".join(dict.fromkeys(d.state_topic for d in DIALECTS.values()))
        others = dict.fromkeys(filter(None, map(other_interface, sorted(topics))))
        if any(t.startswith(SESSION) and t.split("/")[2].endswith(HAND) for t in topics):
            others["hands that nobody named: import again, with --set hand=MODEL"] = None
        raise ConformanceError(
            f"no hand of the Dex family in this recording: it has {names}",
            hint="; ".join(others) or f"a hand publishes one of {wanted}",
        )
    return best


def joints_of(dialect: Dialect, side: Side) -> tuple[JointSpec, ...]:
    """A hand's joints in the dialect's radians."""
    joints = model(dialect.model).joints[side]
    if not dialect.is_gripper:
        return joints
    return tuple(replace(j, q_min=0.0, q_max=dialect.q_open) for j in joints)


def _times_unit(values: Floats, unit: tuple[float, ...]) -> Floats:
    """Values in another unit; one row that stands for all stays one."""
    if len(values) and values.strides[0] == 0:
        return np.broadcast_to(values[:1] * unit, values.shape)
    return np.asarray(values * unit)


def _seconds(times: NDArray[np.int64], origin: int) -> Floats:
    return np.asarray((times - origin) / 1e9, dtype=np.float64)


def _touch(dialect: Dialect, samples: SampleArray, origin: int) -> Touch:
    columns = samples.decoded if samples.decoded is not None else samples.columns()
    return Touch(samples.topic, _seconds(samples.log_time_ns, origin), columns, dialect.areas)


def _publisher_times(t: Floats, sent: Floats) -> Floats:
    """Source timestamps on the recording's clock; times of reception where there are none."""
    if not len(sent) or not np.isfinite(sent).all():
        return t
    return np.asarray(sent + median(t - sent))


def _left_out(spoken: Dialect, views: Mapping[Side, SideView]) -> tuple[Side, ...]:
    """The sides of which a service of one hand says nothing in the message of both hands."""
    if spoken.topics(Side.LEFT) != spoken.topics(Side.RIGHT):
        return ()
    empty = tuple(s for s, view in views.items() if _is_unused(spoken, view))
    return () if len(empty) == len(views) else empty


def _is_unused(spoken: Dialect, view: SideView) -> bool:
    """Whether every state of a side is 0 and no command drives it."""
    states, commands = view.states, view.commands
    said = (states.q, states.dq, states.ddq, states.tau, states.mode)
    gains = (commands.kp, commands.kd, commands.tau)
    drives = gains if spoken.gains_are_used else (commands.q,)
    # the first rows nearly always tell
    return len(states) > 0 and not any(
        np.nan_to_num(a[:_SOME]).any() or np.nan_to_num(a[_SOME:]).any() for a in (*said, *drives)
    )


def sides_of(name: str) -> tuple[Side, ...]:
    """``left``, ``right`` or ``both`` as sides.

    :raises UsageError: anything else.
    """
    if name == "both":
        return (Side.LEFT, Side.RIGHT)
    try:
        return (Side(name),)
    except ValueError:
        raise UsageError(f"no side {name!r}", hint="sides: left, right, both") from None
