"""Devices on DDS topics, in memory and on a virtual clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.stimuli.script import Pose
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.errors import WireError
from dexkit.hand import Side, Subject
from dexkit.models import Dialect
from dexkit.traces import TraceEndpoint

__all__ = ["Sample", "Service", "TopicDevice"]


@dataclass
class Sample:
    """One state on its way to the wire.

    Not frozen: a run has a hundred thousand of them, and those are made in a third of the time.
    """

    topic: str
    type_name: str
    payload: bytes
    sent: float


class TopicDevice(ABC):
    """Publishes and subscribes as a device that meets every requirement of DDS and of timing."""

    fault_sides: tuple[Subject, ...]
    """The subjects that are needed, by default, to see a fault."""

    tick = 0.003
    """Seconds of a step of the virtual clock."""
    period = 0.003
    """Seconds from state to state."""
    command_type = ""
    """DDS type of its command topics; empty for the dialect's."""
    state_type = ""
    serves_late_readers = True
    reader_durability = "Volatile"
    writer_reliability = "reliable"
    exit_s: float | None = 0.2
    """Seconds from SIGTERM to its end; None is never."""
    gone_s: float | None = 0.05
    """Seconds from there until its publishers have disappeared from the domain; None is never."""
    restarted = False
    """Whether there was a service before this one."""
    can_be_stopped = True
    """Whether the kit can end and start it: not one that a vendor runs."""
    loaded = False
    """Whether a slow reliable reader is matched."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Subject], touch: Mapping[Subject, float]
    ) -> None:
        self.dialect = dialect
        self.sides: tuple[Subject, ...] = tuple(sides)
        self.command_type = self.command_type or dialect.cmd_type
        self.state_type = self.state_type or dialect.state_type
        self.now = 0.0
        self.stamp = 0.0
        """Source timestamp of the command that is received, in its own time."""
        self._due = 0.0

    @classmethod
    def recorded(cls, trace: MemoryTrace) -> None:
        """Change the recording of a run: a fault of the client shows only there."""
        return

    @property
    def matches_clients(self) -> bool:
        """Whether DDS would match its reader with an official client's writer."""
        matched = self.reader_durability == "Volatile"
        return matched and self.command_type == self.dialect.cmd_type

    def endpoints(self) -> list[TraceEndpoint]:
        """Its endpoints, as discovery reports them."""
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

    @abstractmethod
    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message.

        :param client: which of the clients there have been sent it, from 0.
        """

    def foreign(self, topic: str, type_name: str, payload: bytes) -> None:
        """Take a message of another type on a command topic: DDS does not deliver it."""
        return

    def begin(self, now: float) -> None:
        """Start at that time, after a service before it has ended."""
        self.restarted = True
        self.now = self._due = now

    def take_over(self, before: TopicDevice) -> None:
        """Find the mechanics where the service before it has left them."""
        return

    def brake(self) -> None:
        """Stop driving the motors: the program ends."""
        return

    def end(self) -> list[Sample]:
        """End: brake, and publish a last state."""
        self.brake()
        self.now += self.tick
        self.live(self.tick)
        return self.publish()

    def advance(self, dt: float) -> list[Sample]:
        """Advance the time; return the states published meanwhile."""
        self.now += dt
        self.live(dt)
        if self.now + 1e-9 < self._due:
            return []
        self._due += self.period
        return self.publish()

    def live(self, dt: float) -> None:
        """Advance the mechanics."""
        return

    @abstractmethod
    def publish(self) -> list[Sample]:
        """The states of one period."""


class Service(TopicDevice):
    """A service of hands that meets every requirement of DDS and of timing.

    Its own hands never move; each model's reference service simulates some.

    :param touch: where each side touches an object, in the plan's terms.
    """

    fault_sides: tuple[Side, ...] = tuple(Side)
    sides: tuple[Side, ...]
    measured_members = frozenset(("q", "dq", "ddq", "tau_est"))
    """The members of a motor's state that it measures; of others a state holds 0 or nothing."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, tuple(sides), touch)
        self.codec = MotorCodec(dialect)
        self._decoded: dict[Side, tuple[bytes, tuple[Motor, ...] | None]] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message.

        :param client: which of the clients there have been sent it, from 0.
        """
        for side in self.sides:
            if self.codec.command_topics[side] != topic:
                continue
            decoded = self._decoded.get(side)
            if decoded is None or decoded[0] != payload:
                try:
                    decoded = (payload, self.codec.read_command(payload, side))
                except WireError:
                    continue
                self._decoded[side] = decoded
            motors = decoded[1]
            if motors is not None:
                self.motors(side, motors)

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        """Take one side's part of a command message."""
        return

    def positions(self, side: Side) -> Pose:
        """The pose of a hand."""
        return (0.0,) * self.codec.joints

    def publish(self) -> list[Sample]:
        """One state of every hand."""
        if self.codec.shared:
            return [self.sample(self.dialect.state_topic, self.sides)]
        return [self.sample(self.codec.state_topics[s], (s,)) for s in self.sides]

    def sample(self, topic: str, sides: tuple[Side, ...]) -> Sample:
        """The state message of these sides."""
        return Sample(topic, self.state_type, self.payload(sides), self.now)

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of these sides on the wire.

        :param length: motors in the sequence, if not the dialect's.
        """
        return self.codec.state_payload({}, length)
