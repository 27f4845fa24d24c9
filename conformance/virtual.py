"""A conformance run without DDS, devices or waiting: a hand in memory on a virtual clock.

The same script drives it and the same checks judge it as in a live run; half a minute of hand
takes a fraction of a second. It exists to prove the checks: :class:`ReferenceHand` and
:class:`ReferenceService` do everything right, and each mutant in
:mod:`dexkit.conformance.mutants` changes one thing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from dexkit.conformance.phases import RECORD, Stimulus
from dexkit.conformance.stimuli import Join, Leave, Observation, Plan, Restart, Script, Send
from dexkit.conformance.wire import Motor, Wire
from dexkit.errors import WireError
from dexkit.hand import Side
from dexkit.models import DEX1_1, Dialect
from dexkit.traces import ChannelInfo, SampleArray, TraceEndpoint

__all__ = ["MemoryTrace", "ReferenceHand", "ReferenceService", "Sample", "run_virtual"]

TICK = 0.003  # seconds: the slowest rate of the vendor's service, 333 Hz (facts/unitree-dex B.2)
EPOCH_NS = 1_700_000_000_000_000_000


class ReferenceHand:
    """A gripper that obeys tau = kp (q - q_now) + kd (dq - dq_now) + tau, as the vendor's does.

    One inertia with friction between two stops, and an object if there is one. Brakes a second
    after the last command, clamps what is out of range, drops what is not finite.

    :param stroke: fully open, rad.
    :param touch: q at which it touches an object, or None.
    """

    inertia = 0.001  # kg m²
    viscous = 0.13  # N m s/rad: with a lead of 0.18 rad this moves at some 6.5 rad/s, as recorded
    coulomb = 0.02  # N m
    tau_max = 2.0  # N m
    stiffness = 40.0  # N m/rad of stops and object
    brake = 1.0  # N m s/rad of a motor with its windings shorted
    timeout = DEX1_1.command_timeout

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        self.stroke = stroke
        self.touch = touch
        self.q = 0.3 * stroke if touch is None else touch + 0.15 * stroke
        self.dq = 0.0
        self.tau = 0.0
        self.now = 0.0
        self.goal: Motor | None = None
        self.heard = -math.inf

    def command(self, motor: Motor) -> None:
        """A command came."""
        fields = (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        if all(math.isfinite(x) for x in fields):
            self.goal = self.accept(motor)
            self.heard = self.now

    def accept(self, motor: Motor) -> Motor:
        """Within the limits."""
        q = min(max(motor.q, 0.0), self.stroke)
        return Motor(q, motor.dq, motor.tau, motor.kp, motor.kd)

    @property
    def braking(self) -> bool:
        """Whether no command is in force."""
        return self.goal is None or self.now - self.heard > self.timeout

    def motor_torque(self) -> float:
        """What the motor does, N m."""
        goal = self.goal
        if goal is None or self.braking:
            return 0.0
        tau = goal.kp * (goal.q - self.q) + goal.kd * (goal.dq - self.dq) + goal.tau
        return min(max(tau, -self.tau_max), self.tau_max)

    def step(self, dt: float) -> None:
        """Let time pass."""
        self.now += dt
        self.tau = self.motor_torque()
        force = self.tau + self.contact()
        damping = self.viscous + (self.brake if self.braking else 0.0)
        # implicit in the damping, so that a stiff brake is stable at this step
        dq = (self.dq + dt * force / self.inertia) / (1.0 + dt * damping / self.inertia)
        slip = dt * self.coulomb / self.inertia
        self.dq = 0.0 if abs(dq) < slip else dq - math.copysign(slip, dq)
        self.q += dt * self.dq

    def contact(self) -> float:
        """Force of stops and object."""
        floor = 0.0 if self.touch is None else self.touch
        if self.q < floor:
            return self.stiffness * (floor - self.q)
        if self.q > self.stroke:
            return self.stiffness * (self.stroke - self.q)
        return 0.0

    def fields(self) -> dict[str, float]:
        """The state's fields."""
        return {"q": self.q, "dq": self.dq, "tau_est": self.tau}


@dataclass(frozen=True)
class Sample:
    """One state on its way to the wire."""

    topic: str
    type_name: str
    payload: bytes
    sent: float


class ReferenceService:
    """Puts hands on the topics, as a good service does.

    :param touch: where each side touches an object.
    """

    hand: type[ReferenceHand] = ReferenceHand
    period = TICK
    serves_late_readers = True
    reader_durability = "Volatile"
    writer_reliability = "reliable"

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Side, float]
    ) -> None:
        self.dialect = dialect
        self.wire = Wire(dialect)
        self.sides = tuple(sides)
        self.hands = {s: self.hand(dialect.q_open, touch.get(s)) for s in self.sides}
        self.command_type = dialect.cmd_type
        self.state_type = dialect.state_type
        self.now = 0.0
        self._due = 0.0

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
            try:
                motor = self.wire.read_command(payload, side)
            except WireError:
                continue
            if motor is not None:
                self.command(side, motor)

    def command(self, side: Side, motor: Motor) -> None:
        """One side's part of it."""
        if self.dialect.name == "unitree_hg" and math.isfinite(motor.q):
            # seed 000: gains and feed-forward of a command are not used, the ends snap
            q = 0.0 if motor.q <= 0.1 else self.dialect.q_open if motor.q >= 6.0 else motor.q
            motor = Motor(q=q)
        self.hands[side].command(motor)

    def advance(self, dt: float) -> list[Sample]:
        """Let time pass; what was published meanwhile."""
        self.now += dt
        for hand in self.hands.values():
            hand.step(dt)
        if self.now + 1e-9 < self._due:
            return []
        self._due += self.period
        return self.publish()

    def publish(self) -> list[Sample]:
        """One state of everybody."""
        fields = {s: h.fields() for s, h in self.hands.items()}
        if self.wire.shared:
            return [self.sample(self.dialect.state_topic, fields)]
        return [self.sample(self.wire.state_topics[s], {s: f}) for s, f in fields.items()]

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        """A state message."""
        return Sample(topic, self.state_type, self.wire.state_payload(fields), self.now)


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

    def load(self, topics: Iterable[str] | None = None) -> dict[str, SampleArray]:
        """Samples by topic."""
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


def run_virtual(
    plan: Plan, service_class: type[ReferenceService] = ReferenceService
) -> MemoryTrace:
    """Go through the plan with a service of that class, and return the recording."""
    service = service_class(plan.dialect, plan.sides, plan.objects)
    trace = MemoryTrace(endpoints=service.endpoints())
    script = Script(plan)
    wire = Wire(plan.dialect)
    newest: dict[str, bytes] = {}
    joined: dict[Side, float] = {}
    joined_at: float | None = None
    client = 0
    now = 0.0

    def advance(until: float) -> None:
        nonlocal now
        while now + 1e-9 < until:
            now += TICK
            for sample in service.advance(TICK):
                sent = EPOCH_NS + round(sample.sent * 1e9)
                log = EPOCH_NS + round(now * 1e9) + 100_000
                trace.put(sample.topic, sample.type_name, log, sent, sample.payload)
                if sample.type_name != plan.dialect.state_type:
                    continue
                newest[sample.topic] = sample.payload
                if joined_at is not None and service.serves_late_readers:
                    for side in plan.sides:
                        if wire.state_topics[side] == sample.topic:
                            joined.setdefault(side, now - joined_at)

    def observe() -> Observation:
        q: dict[Side, float] = {}
        dq: dict[Side, float] = {}
        for side in plan.sides:
            payload = newest.get(wire.state_topics[side])
            state = None if payload is None else wire.read_state(payload, side)
            if state is not None:
                q[side], dq[side] = state[0], state[1]
        return Observation(EPOCH_NS + round(now * 1e9), q, dq, dict(joined))

    steps = script.run()
    action = next(steps)
    while True:
        if isinstance(action, Send):
            for topic, payload in action.payloads:
                sent = EPOCH_NS + round(now * 1e9)
                trace.put(topic, plan.dialect.cmd_type, sent + 50_000, sent, payload)
                if service.hears:
                    service.receive(topic, payload, client)
            advance((action.until_ns - EPOCH_NS) / 1e9)
        elif isinstance(action, Join):
            joined_at = now
        elif isinstance(action, Leave):
            joined_at = None
        elif isinstance(action, Restart):
            client += 1
            advance(now + 0.3)
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
