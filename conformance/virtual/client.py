"""A teleoperation session on a virtual clock: a client that meets every requirement, and hands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.layers import layer
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.service import Service
from dexkit.conformance.virtual.topic_run import log_time_ns
from dexkit.hand import Side
from dexkit.models import Dialect
from dexkit.teleop import Operator, Pose, Profile, TeleopClient, client_for
from dexkit.teleop.client import JointCommand

__all__ = ["ReferenceClient", "motors_of", "run_client"]

_BEGIN_S = 0.5
"""Seconds from the start of the hands to that of the client."""
_AFTER_S = 1.6
"""Seconds of recording after the last command: longer than any time-out."""
_MOVE_S = 0.6
"""Seconds from one goal of the operator to the next."""


def motors_of(
    commands: Mapping[Side, Sequence[JointCommand]], spoken: Dialect
) -> dict[Side, list[Motor]]:
    """What the client of :mod:`dexkit.teleop` commands, as motors of a message of a dialect."""
    found = {}
    for side, joints in commands.items():
        motors = [Motor(**j._asdict()) for j in joints]
        if not spoken.gains_are_used:
            motors = [replace(m, kp=0.0, kd=0.0) for m in motors]
        found[side] = motors
    return found


class ReferenceClient:
    """Unitree's client (:mod:`dexkit.teleop`) with an operator who grasps twice and rests.

    A wrong client overrides one of the methods.

    :ivar rate: Hz.
    """

    fault_sides: tuple[Side, ...] = tuple(Side)
    """The hands that are needed to see a fault."""
    seconds = 7.0
    """Seconds from the first command to the last."""
    course: Sequence[tuple[float, float]] = (
        (0, 0.1),
        (0.8, 0.75),
        (2.3, 0.1),
        (3.6, 0.9),
        (5, 0.1),
    )
    """Motion of the operator: (time in seconds, part of closing from then on)."""
    right_up_s = 0.0
    """Seconds until the right hand's service publishes."""

    def __init__(self, dialect: Dialect, sides: Sequence[Side]) -> None:
        self.dialect = dialect
        self.sides = tuple(sides)
        self.client = self.make_client()
        self.rate = self.client.rate
        self.codec = MotorCodec(dialect)
        course = Profile("grasp", dialect.model, "closes twice", 0.0, 60.0, self._closing)
        self.operator = Operator(course, dialect)
        self.turn = 0
        self.q: dict[Side, Pose] = {}
        """The newest state of each hand."""

    def _closing(self, t: float) -> Pose:
        """The operator's closing, 0 to 1, smooth from goal to goal."""
        at = max(i for i, (begin, _) in enumerate(self.course) if begin <= t)
        (begin, goal), before = self.course[at], self.course[max(at - 1, 0)][1]
        part = min((t - begin) / _MOVE_S, 1.0)
        return (before + (goal - before) * (1.0 - math.cos(math.pi * part)) / 2,)

    def make_client(self) -> TeleopClient:
        """The client that is modelled."""
        return client_for(self.dialect, self.sides)

    def receive(self, now: float, q: Mapping[Side, Pose]) -> None:
        """Take the newest states."""
        self.q.update(q)
        self.client.receive(now, q)

    def motors(self, now: float) -> dict[Side, list[Motor]]:
        """The commands of this turn; none before there are states."""
        inputs = self.operator.inputs(now, self.sides)
        return motors_of(self.client.step(now, {}, inputs), self.dialect)

    def sends(self, now: float) -> bool:
        """Whether it sends in this turn."""
        return True

    def change(self, side: Side, motors: list[Motor]) -> list[Motor]:
        """The motors of a command as they are sent."""
        return motors

    def messages(self, now: float) -> list[tuple[str, bytes]]:
        """Messages of this cycle: (topic, payload).

        :param now: seconds since the client's start.
        """
        self.turn += 1
        motors = self.motors(now)
        if not motors or not self.sends(now):
            return []
        return self.encoded({s: self.change(s, m) for s, m in motors.items()})

    def encoded(self, hands: Mapping[Side, list[Motor]]) -> list[tuple[str, bytes]]:
        """Commands as (topic, payload)."""
        return self.codec.encode(hands)


def run_client(
    client_class: type[ReferenceClient],
    dialect: Dialect,
    sides: Sequence[Side] = tuple(Side),
    service_class: type[Service] | None = None,
) -> MemoryTrace:
    """Record a session of the client with hands; the recording has no stimulus record.

    :param service_class: the hands; the reference of the dialect's model by default.
    """
    made = service_class or layer("dds").reference(dialect.model)
    service: Service = made(dialect, tuple(sides), {})
    client = client_class(dialect, sides)
    trace = MemoryTrace(endpoints=service.endpoints())
    tick, period = round(service.tick * 1e9), round(1e9 / client.rate)
    begin = round(_BEGIN_S * 1e9)
    last = begin + round(client.seconds * 1e9)
    turns = set(range(begin, last + 1, period))
    before = 0
    for now_ns in sorted(turns | set(range(tick, last + round(_AFTER_S * 1e9), tick))):
        now = now_ns / 1e9
        log_ns = log_time_ns(now)
        for sample in service.advance((now_ns - before) / 1e9):
            its = [s for s in sides if client.codec.state_topics[s] == sample.topic]
            if its == [Side.RIGHT] and now < client.right_up_s:
                continue
            trace.put(sample.topic, sample.type_name, log_ns, log_ns, sample.payload)
            states = {s: client.codec.read_state(sample.payload, s) for s in its}
            client.receive(now, {s: state[0] for s, state in states.items() if state})
        before = now_ns
        if now_ns in turns:
            for topic, payload in client.messages(now - _BEGIN_S):
                trace.put(topic, dialect.cmd_type, log_ns, log_ns, payload)
                service.receive(topic, payload, 0)
    return trace
