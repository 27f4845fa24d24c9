"""A conformance run without DDS, devices or waiting: a hand in memory on a virtual clock.

The same script drives it and the same checks judge it as in a live run; half a minute of hand
takes a fraction of a second. It exists to prove the checks: the reference hands
(:mod:`~dexkit.conformance.virtual.gripper`, :mod:`~dexkit.conformance.virtual.fingers`) do
everything right, and each mutant in :mod:`dexkit.conformance.mutants` changes one thing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from dexkit.conformance.motor_messages import Motor, Wire
from dexkit.conformance.robot import wire_for
from dexkit.conformance.stimuli import (
    Join,
    Leave,
    Observation,
    Plan,
    Restart,
    Role,
    Send,
    StartService,
    StopService,
    script_for,
)
from dexkit.conformance.stimuli.script import Pose
from dexkit.conformance.stimulus_record import RECORD, Stimulus
from dexkit.errors import WireError
from dexkit.hand import Side
from dexkit.models import Dialect
from dexkit.traces import ChannelInfo, SampleArray, TraceEndpoint

__all__ = ["MemoryTrace", "Sample", "Service", "run_virtual"]

EPOCH_NS = 1_700_000_000_000_000_000
RIVAL = 1000
"""The second client's number."""


@dataclass(frozen=True)
class Sample:
    """One state on its way to the wire."""

    topic: str
    type_name: str
    payload: bytes
    sent: float


class Service:
    """Puts hands on the topics, as a good service does.

    Its own hands never move; each model's reference service plays good ones.

    :param touch: where each side touches an object, in the plan's terms.
    """

    tick = 0.003
    """Seconds by which time passes."""
    period = 0.003
    """Seconds from state to state."""
    serves_late_readers = True
    reader_durability = "Volatile"
    writer_reliability = "reliable"
    exit_s: float | None = 0.2
    """Seconds that it takes to end when it is told to; None is for ever."""
    gone_s: float | None = 0.05
    """Seconds until its publishers have vanished from the domain after that, or None."""
    restarted = False
    """Whether there was a service before this one."""
    loaded = False
    """Whether a slow reliable reader listens."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Side, float]
    ) -> None:
        self.dialect = dialect
        self.wire = wire_for(dialect)
        self.sides = tuple(sides)
        self.command_type = dialect.cmd_type
        self.state_type = dialect.state_type
        self.now = 0.0
        self.stamp = 0.0
        """Source timestamp of the command that is received, in its own time."""
        self._due = 0.0
        self._heard: dict[Side, tuple[bytes, tuple[Motor, ...] | None]] = {}

    @property
    def hears(self) -> bool:
        """Whether DDS would join its reader with an official client's writer."""
        matched = self.reader_durability == "Volatile"
        return matched and self.command_type == self.dialect.cmd_type

    def endpoints(self) -> list[TraceEndpoint]:
        """What discovery sees of it."""
        found: dict[str, TraceEndpoint] = {}
        for side in self.sides:
            command, state = self.dialect.topics(side)
            found[command] = TraceEndpoint(
                command, "reader", "best_effort", self.reader_durability, "", self.command_type
            )
            found[state] = TraceEndpoint(
                state, "writer", self.writer_reliability, "Volatile", "", self.state_type
            )
        return list(found.values())

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """A command message came.

        :param client: which of the clients there have been sent it, from 0.
        """
        for side in self.sides:
            if self.wire.command_topics[side] != topic:
                continue
            if self._heard.get(side, (b"", None))[0] != payload:
                try:
                    self._heard[side] = (payload, self.wire.read_command(payload, side))
                except WireError:
                    continue
            motors = self._heard[side][1]
            if motors is not None:
                self.motors(side, motors)

    def foreign(self, topic: str, type_name: str, payload: bytes) -> None:
        """A message of another type was published on a command topic: DDS keeps it away."""
        return

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        """One side's part of it."""
        return

    def begin(self, now: float) -> None:
        """It comes up at that time, after a service before it has ended."""
        self.restarted = True
        self.now = self._due = now

    def brake(self) -> None:
        """Let go of the hands: the service ends."""
        return

    def end(self) -> list[Sample]:
        """It is told to end: brake, and say so a last time."""
        self.brake()
        self.now += self.tick
        self.live(self.tick)
        return self.publish()

    def advance(self, dt: float) -> list[Sample]:
        """Let time pass; what was published meanwhile."""
        self.now += dt
        self.live(dt)
        if self.now + 1e-9 < self._due:
            return []
        self._due += self.period
        return self.publish()

    def positions(self, side: Side) -> Pose:
        """Where a hand is."""
        return (0.0,) * self.wire.joints

    def live(self, dt: float) -> None:
        """Let time pass for the hands."""
        return

    def publish(self) -> list[Sample]:
        """One state of everybody."""
        if self.wire.shared:
            return [self.sample(self.dialect.state_topic, self.sides)]
        return [self.sample(self.wire.state_topics[s], (s,)) for s in self.sides]

    def sample(self, topic: str, sides: tuple[Side, ...]) -> Sample:
        """A state message of these sides."""
        return Sample(topic, self.state_type, self.payload(sides), self.now)

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of these sides on the wire.

        :param length: motors in the sequence, if not the dialect's.
        """
        return self.wire.state_payload({}, length)


@dataclass
class MemoryTrace:
    """A recording that was never in a file."""

    endpoints: list[TraceEndpoint] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    truncated: bool = False
    rows: dict[tuple[str, str], list[tuple[int, int, bytes]]] = field(default_factory=dict)

    def put(self, topic: str, type_name: str, log_ns: int, sent_ns: int, data: bytes) -> None:
        """Record one sample."""
        self.rows.setdefault((topic, type_name), []).append((log_ns, sent_ns, data))

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel."""
        return [
            ChannelInfo(topic, kind, "", len(rows), rows[0][0], rows[-1][0], {}, topic)
            for (topic, kind), rows in self.rows.items()
        ]

    def load(
        self, topics: Iterable[str] | None = None, *, decode: bool = False
    ) -> dict[str, SampleArray]:
        """Samples by topic; nothing is decoded here."""
        wanted = None if topics is None else set(topics)
        found: dict[str, SampleArray] = {}
        for (topic, kind), rows in self.rows.items():
            if wanted is None or topic in wanted:
                found[topic] = SampleArray(
                    topic,
                    kind,
                    np.array([r[0] for r in rows], dtype=np.int64),
                    np.array([r[1] for r in rows], dtype=np.int64),
                    [r[2] for r in rows],
                )
        return found


class _Poses(Mapping[Side, Pose]):
    """The newest poses (0) or velocities (1) of all sides, decoded only when they are looked at."""

    def __init__(self, wire: Wire, newest: Mapping[Side, bytes], which: int) -> None:
        self._wire, self._newest, self._which = wire, newest, which
        self._read: dict[Side, tuple[Pose, Pose] | None] = {}

    def _state(self, side: Side) -> tuple[Pose, Pose] | None:
        if side not in self._read:
            self._read[side] = self._wire.read_state(self._newest[side], side)
        return self._read[side]

    def __getitem__(self, side: Side) -> Pose:
        state = self._state(side)
        if state is None:
            raise KeyError(side)
        return state[self._which]

    def __iter__(self) -> Iterator[Side]:
        return (s for s in self._newest if self._state(s) is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def run_virtual(plan: Plan, service_class: type[Service]) -> MemoryTrace:
    """Go through the plan with a service of that class, and return the recording."""
    service = service_class(plan.dialect, plan.sides, plan.objects)
    trace = MemoryTrace(endpoints=service.endpoints())
    script = script_for(plan)
    wire = wire_for(plan.dialect)
    topics = {s: wire.state_topics[s] for s in plan.sides}
    states = set(topics.values())
    newest: dict[str, bytes] = {}
    joined: dict[Side, float] = {}
    joined_at: float | None = None
    stopped: dict[str, float | None] = {}
    client = 0
    now = 0.0

    def advance(until: float) -> None:
        nonlocal now
        while now + 1e-9 < until:
            now += service.tick
            take(service.advance(service.tick))

    def take(samples: Iterable[Sample]) -> None:
        for sample in samples:
            sent = EPOCH_NS + round(sample.sent * 1e9)
            log = EPOCH_NS + round(now * 1e9) + 100_000
            trace.put(sample.topic, sample.type_name, log, sent, sample.payload)
            if sample.type_name != plan.dialect.state_type or sample.topic not in states:
                continue
            newest[sample.topic] = sample.payload
            if joined_at is not None and service.serves_late_readers:
                for side in plan.sides:
                    if wire.state_topics[side] == sample.topic:
                        joined.setdefault(side, now - joined_at)

    def observe() -> Observation:
        given = {s: newest[t] for s, t in topics.items() if t in newest}
        q, dq = _Poses(wire, given, 0), _Poses(wire, given, 1)
        return Observation(
            EPOCH_NS + round(now * 1e9), q, dq, dict(joined), dict(stopped), wire.machine
        )

    def send(action: Send) -> None:
        sent = EPOCH_NS + round((now - action.age_s) * 1e9)
        service.stamp = now - action.age_s
        for topic, payload in action.payloads:
            if action.by is Role.STRANGER:
                service.foreign(topic, wire.foreign.name, payload)
                continue
            log = EPOCH_NS + round(now * 1e9) + 50_000
            trace.put(topic, plan.dialect.cmd_type, log, sent, payload)
            if service.hears:
                service.receive(topic, payload, RIVAL if action.by is Role.RIVAL else client)

    steps = script.run()
    action = next(steps)
    while True:
        if isinstance(action, Send):
            send(action)
            advance((action.until_ns - EPOCH_NS) / 1e9)
        elif isinstance(action, (Join, Leave)):
            comes = isinstance(action, Join)
            if action.role is Role.MONITOR:
                joined_at = now if comes else None
            elif action.role is Role.LAGGARD:
                service.loaded = comes
        elif isinstance(action, Restart):
            client += 1
            advance(now + 0.3)
        elif isinstance(action, StopService):
            now += service.tick
            take(service.end())
            stopped = {"exit_s": service.exit_s, "gone_s": service.gone_s}
        elif isinstance(action, StartService):
            now += 0.5
            service = service_class(plan.dialect, plan.sides, plan.objects)
            service.begin(now)
            newest.clear()
        try:
            action = steps.send(observe())
        except StopIteration:
            break
    stimulus = Stimulus(
        phases=script.phases,
        objects={s: plan.objects.get(s) for s in plan.sides},
    )
    trace.metadata[RECORD] = stimulus.to_metadata()
    return trace
