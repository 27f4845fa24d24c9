"""Read the joints of a recording as streams: one table over time for each part and direction.

A part is a hand of a side (``left_hand``), a robot (``g1``), or a group of joints that no message
of Unitree's carries (``left_arm``, of an imported episode). The profiles map topics and motors to
joints: :mod:`dexkit.models` and :mod:`dexkit.robots`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError, WireError
from dexkit.hand import Floats, Side
from dexkit.messages import Columns, message_type
from dexkit.models import MODELS, model
from dexkit.pressure import resting_pressure
from dexkit.robots import ROBOTS
from dexkit.topics import Role, roles
from dexkit.traces.clock_steps import refuse_clock_steps
from dexkit.traces.names import SESSION
from dexkit.traces.reader import SampleArray, Trace
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.imported import absent_fields
from dexkit.traces.sessions.resample import interpolate

__all__ = [
    "COMMAND",
    "FIELDS",
    "HAND",
    "MEMBERS",
    "STATE",
    "Pressure",
    "Stream",
    "may_be_radians",
    "pressures_of",
    "streams_of",
]

Times = NDArray[np.int64]
Readings = NDArray[np.floating[Any]]

_MOST_RAD = 4 * np.pi

STATE, COMMAND = "state", "command"
HAND = "_hand"
"""End of the name of a hand's part."""
FIELDS = {STATE: ("q", "dq", "tau"), COMMAND: ("q", "dq", "tau", "kp", "kd")}
"""The fields of a motor that a stream has, in this order. ``tau`` is ``tau_est`` of a state."""
MEMBERS = {
    STATE: {"q": "q", "dq": "dq", "tau": "tau_est"},
    COMMAND: {f: f for f in FIELDS[COMMAND]},
}
"""For each of these fields, the member of a motor in a message."""


@dataclass(frozen=True, eq=False)
class Stream:
    """The states or the commands of one part.

    :param part: ``left_hand``, ``right_hand``, a robot's name, or the name of an imported group.
    :param kind: :data:`STATE` or :data:`COMMAND`.
    :param joints: names, in the order of the columns.
    :param times_ns: reception, ns since the epoch, ascending, shape (n,).
    :param values: by field of :data:`FIELDS`, rad, rad/s and N·m, shape (n, n_joints); a field
        that the source does not have is missing here. NaN where a message lacks a joint.
    :param pressure: of a state of a hand with sensors, as in the message, shape (n, number of
        elements); None without sensors.
    :param elements: a name for each of its columns.
    :param model: the hand model's or robot's name; empty for a group without a profile.
    """

    part: str
    kind: str
    joints: tuple[str, ...]
    times_ns: Times
    values: Mapping[str, Floats]
    topic: str
    model: str = ""
    pressure: Readings | None = None
    elements: tuple[str, ...] = ()
    samples: SampleArray | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def q(self) -> Floats:
        """Positions, rad, shape (n, n_joints)."""
        return self.values["q"]

    @property
    def unit(self) -> str:
        """The unit of q: that of the hand model, rad for robots, and for groups without a profile
        whose values can be rad.
        """
        if self.model in MODELS:
            return MODELS[self.model].unit
        return "rad" if self.model or may_be_radians(self.q) else "unknown unit"

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names that are unique in the recording: ``left_thumb_0``."""
        if self.model and self.part.endswith(HAND):
            return tuple(f"{self.part.removesuffix(HAND)}_{j}" for j in self.joints)
        return self.joints

    @property
    def tactile(self) -> Pressure | None:
        """Pressures of the sensors in the states; None without sensors."""
        if self.pressure is None:
            return None
        return Pressure(self.part, self.elements, self.times_ns, self.pressure, self.topic)

    def between(self, begin_ns: int, end_ns: int) -> Stream:
        """The samples received in [begin, end)."""
        a, b = np.searchsorted(self.times_ns, [begin_ns, end_ns])
        return replace(
            self,
            times_ns=self.times_ns[a:b],
            values={name: v[a:b] for name, v in self.values.items()},
            pressure=None if self.pressure is None else self.pressure[a:b],
            samples=None,
        )


@dataclass(frozen=True, eq=False)
class Pressure:
    """Pressures of a hand's sensors, from its states or its touch topic.

    :param part: ``left_hand``, ``right_hand``.
    :param elements: a name for each column.
    :param times_ns: reception, ns since the epoch, ascending, shape (n,).
    :param values: as in the messages, shape (n, n_elements).
    :param unusable: messages of a touch topic that are left out, as a list is not as long as its
        area.
    :param zeroed: the hand itself counts from its rest.
    """

    part: str
    elements: tuple[str, ...]
    times_ns: Times
    values: Readings
    topic: str
    unusable: int = 0
    zeroed: bool = False

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements that are unique in the recording."""
        return tuple(f"{self.part}_{e}" for e in self.elements)

    @property
    def at_rest(self) -> list[float | None]:
        """What each element reads at rest, by :mod:`dexkit.pressure`; None without a value."""
        seconds = (self.times_ns - self.times_ns[:1]) / 1e9
        values = self.values.astype(np.float64, copy=False)
        found = resting_pressure(np.maximum.accumulate(seconds), values)
        return [round(v, 3) if math.isfinite(v) else None for v in found.tolist()]

    def at(self, times_ns: Times) -> Floats:
        """Interpolated, shape (len(times_ns), n_elements); NaN outside of the data and in gaps."""
        return interpolate(self.times_ns, self.values, times_ns)

    def is_known(self, times_ns: Times) -> NDArray[np.bool_]:
        """Whether each time lies in the data, and in no gap."""
        here = np.zeros((len(self), 1))
        return np.isfinite(interpolate(self.times_ns, here, times_ns))[:, 0]


def may_be_radians(q: Floats) -> bool:
    """Whether positions of joints can be rad: within two turns. Degrees of a joint that moves, and
    per cent, lie beyond.
    """
    return not (np.abs(q) > _MOST_RAD).any()


def pressures_of(trace: Trace, streams: Sequence[Stream]) -> list[Pressure]:
    """Pressures of the hands of a recording, by part.

    :param streams: of the recording: the states of some hands have sensors in them.
    """
    found = [found for s in streams if (found := s.tactile) is not None]
    topics = {c.topic for c in trace.channels if c.message_count}
    touch = [t for t in sorted(topics) if any(r.kind == "touch" for r in roles(t))]
    loaded = trace.load(touch, decode=True) if touch else {}
    for topic, samples in loaded.items():
        for role in roles(topic, samples.type_name):
            if not samples.problem:
                found += [_touch(topic, samples, role, side) for side in role.sides]
    return sorted(found, key=lambda p: p.part)


def _touch(topic: str, samples: SampleArray, role: Role, side: Side) -> Pressure:
    columns, areas = _columns(samples), role.dialect.areas
    whole = np.ones(len(samples.log_time_ns), dtype=np.bool_)
    for area in areas:
        whole &= columns.count(area.member) == area.elements
    table = columns.table([f"{a.member}[{i}]" for a in areas for i in range(a.elements)])
    return Pressure(
        part=f"{side}{HAND}",
        elements=tuple(
            f"{a.place.replace(' ', '_')}_{i}" for a in areas for i in range(a.elements)
        ),
        times_ns=samples.log_time_ns[whole],
        values=table[whole],
        topic=topic,
        unusable=int(np.count_nonzero(~whole)),
        zeroed=True,
    )


def streams_of(
    trace: Trace,
    topics: Sequence[str] | None = None,
    *,
    positions: bool = False,
    keep_samples: bool = True,
) -> list[Stream]:
    """Every stream of a recording, in the order of topics; empty ones are left out.

    :param topics: only these, in any spelling, patterns allowed.
    :param positions: only q, without pressures and samples.
    :param keep_samples: False to leave out the samples and to read one topic at a time: that takes
        half of the memory.
    :raises UsageError: a topic is not in the recording.
    :raises SessionError: a group of joints of an import has a message that is none, or the
        recording has a stretch of time twice.
    """
    refuse_clock_steps(trace.path, trace.clock_steps)
    known = [c.topic for c in trace.channels if c.message_count]
    wanted = known if topics is None else list(trace.load(topics, payloads=False))
    found: list[Stream] = []
    absent = absent_fields(trace.metadata)
    copies = _copies(known)
    fields = ("q",) if positions else None
    keep_samples = keep_samples and not positions
    ordered = sorted((set(wanted) & set(known)) - copies)
    for some in [ordered] if keep_samples else [[topic] for topic in ordered]:
        for stream in _read(trace, some, fields, keep_samples=keep_samples):
            lacking = absent.get(stream.topic, frozenset())
            side = stream.part.removesuffix(HAND)
            values = {
                f: v
                for f, v in stream.values.items()
                if f not in lacking and f"{side}.{f}" not in lacking
            }
            if len(stream) and "q" in values:
                found.append(replace(stream, values=values))
    return found


def _copies(topics: Sequence[str]) -> set[str]:
    """The low-rate topics that are copies of a state topic of the recording."""
    there = set(topics)
    return {
        topic
        for topic in topics
        for role in roles(topic)
        if role.kind == "low" and there & {role.dialect.topics(s)[1] for s in role.sides}
    }


def _read(
    trace: Trace, topics: Sequence[str], fields: Sequence[str] | None, *, keep_samples: bool
) -> list[Stream]:
    """The streams of some topics, read together."""
    found: list[Stream] = []
    for topic, samples in trace.load(topics, decode=True).items():
        try:
            found += _streams(topic, samples, fields)
        except WireError as error:
            raise SessionError(f"{trace.path}: {topic}: {error}") from error
    return found if keep_samples else [replace(stream, samples=None) for stream in found]


def _streams(
    topic: str, samples: SampleArray, fields: Sequence[str] | None = None
) -> Iterator[Stream]:
    """The streams of a topic.

    :param fields: only these, without pressures; None for everything.
    """
    if samples.type_name == ros_types.JOINT_STATE.dds_name and not samples.decoded:
        yield from _joint_states(topic, samples)
        return
    if samples.problem:
        return
    for role in roles(topic, samples.type_name)[:1]:
        if role.kind == "touch":
            continue  # no joints
        kind = COMMAND if role.kind == "cmd" else STATE
        hand = model(role.dialect.model)
        columns = _columns(samples)
        for side in role.sides:
            joints = hand.joints[side]
            first = role.dialect.index[side]
            slots = range(first, first + len(joints))
            pressure: Readings | None = None
            elements: tuple[str, ...] = ()
            if kind == STATE and hand.sensors and fields is None:
                pressure, elements = _pressure(columns, hand.sensors)
            units = role.dialect.torque_units
            values = _values(columns, samples.type_name, kind, slots, units, fields)
            yield Stream(
                part=f"{side}{HAND}",
                kind=kind,
                joints=tuple(j.name for j in joints),
                times_ns=samples.log_time_ns,
                values=values,
                topic=topic,
                model=hand.name,
                pressure=pressure,
                elements=elements,
                samples=samples,
            )
    for robot in ROBOTS.values():
        directions = {
            (robot.state_topic, robot.state_type): STATE,
            (robot.cmd_topic, robot.cmd_type): COMMAND,
            (robot.arm_topic, robot.cmd_type): COMMAND,
        }
        kind = directions.get((topic, samples.type_name), "")
        if kind:
            used = robot.arm_slots if topic == robot.arm_topic else robot.used
            yield Stream(
                part=f"{robot.name}_arms" if topic == robot.arm_topic else robot.name,
                kind=kind,
                joints=tuple(robot.joint(s).name for s in used),
                times_ns=samples.log_time_ns,
                values=_values(_columns(samples), samples.type_name, kind, used, (), fields),
                topic=topic,
                model=robot.name,
                samples=samples,
            )


def _columns(samples: SampleArray) -> Columns:
    return samples.decoded if samples.decoded is not None else samples.columns()


def _values(
    columns: Columns,
    type_name: str,
    kind: str,
    slots: Sequence[int],
    units: Sequence[float],
    fields: Sequence[str] | None,
) -> dict[str, Floats]:
    mt = message_type(type_name)
    array = next(f for f in mt.layout.fields if f.name == mt.motor_sequence).array
    values = {}
    with np.errstate(invalid="ignore"):
        for name, member in MEMBERS[kind].items():
            if fields is not None and name not in fields:
                continue
            here = [i for i in slots if array is None or i < array]
            if mt.motor_place(member, 0) is not None:
                values[name] = mt.motor_table(columns, member, here)
    if units and "tau" in values:
        values["tau"] = values["tau"] * np.asarray(units)
    return values


def _pressure(columns: Columns, sensors: Sequence[Any]) -> tuple[Readings | None, tuple[str, ...]]:
    """The sensor elements of the states; None if no state has sensor packets."""
    if not len(columns) or columns.count("press_sensor_state").max() < len(sensors):
        return None, ()
    parts, names = [], []
    for i, sensor in enumerate(sensors):
        for slot in sensor.slots:
            parts.append(f"press_sensor_state[{i}].pressure[{slot}]")
            names.append(f"{sensor.place.replace(' ', '_')}_{slot}")
    # as in the message, float32: there are a hundred columns
    table = np.empty((len(parts), len(columns)), dtype=np.float32)
    for row, part in zip(table, parts, strict=True):
        row[:] = columns.table([part])[:, 0]
    return table.T, tuple(names)


def _joint_states(topic: str, samples: SampleArray) -> Iterator[Stream]:
    """Read groups of joints as written by an import: ``rt/session/PART/state``."""
    pieces = topic.split("/")
    if not topic.startswith(SESSION) or len(pieces) != 4 or pieces[3] not in ("state", "cmd"):
        return
    decoded = [ros_types.decode_joint_state(data) for data in samples.payloads]
    if not decoded:
        return
    names = decoded[0].names
    good = [i for i, d in enumerate(decoded) if d.names == names]
    values = {}
    for name, column in (("q", "position"), ("dq", "velocity"), ("tau", "effort")):
        rows = [getattr(decoded[i], column) for i in good]
        if rows and len(rows[0]) == len(names):
            values[name] = np.array(
                [r if len(r) == len(names) else (np.nan,) * len(names) for r in rows], dtype=float
            ).reshape(len(rows), len(names))
    yield Stream(
        part=pieces[2],
        kind=COMMAND if pieces[3] == "cmd" else STATE,
        joints=names,
        times_ns=samples.log_time_ns[good],
        values=values,
        topic=topic,
        samples=samples,
    )
