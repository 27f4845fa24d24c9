"""A hand on the virtual clock, clients on its topics, and what truly happens meanwhile."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.virtual import Sample, Service
from dexkit.errors import WireError
from dexkit.hand import Floats, Side, Subject
from dexkit.messages import message_type
from dexkit.models import Dialect, model
from dexkit.teleop import Pose

__all__ = ["Client", "Figure", "Stage"]

_STEP = 0.01
"""Seconds from one note of what is true to the next."""
_FRESH_S = 0.1
"""Seconds after a client starts, or a pause of the network, for which its state may be old."""
_RESTART_S = 2.0
"""Seconds that the hand's service takes to start."""
_LONGEST_END = 30.0
"""Seconds after SIGTERM at which a service that has not ended keeps its device from the next."""


class Figure(NamedTuple):
    """Where a figure was measured, and of which kind it is."""

    kind: str
    client: str
    task: str
    side: str
    joint: int


class Client(ABC):
    """A program that reads states and sends commands.

    :param number: which client of the hand it is, from 0.
    """

    period = 0.01
    """Seconds from one command to the next."""
    stamp_age = 0.0
    """Seconds by which its computer's clock is behind that of the hand's."""

    def __init__(self, number: int = 0) -> None:
        self.number = number
        self.goals: Mapping[Side, Pose] = {}
        self.course: Callable[[float], Mapping[Side, Pose]] | None = None
        """The goals at a time, in place of those that stay."""
        self.due = 0.0
        self.began: float | None = None
        """When it sent its first command."""
        self.crashed = False
        """Its receiving thread has ended: a state had fewer motors than it reads."""

    def wanted(self, now: float) -> Mapping[Side, Pose]:
        """What its user wants of each side, in q."""
        return self.course(now) if self.course else self.goals

    def receive(self, now: float, states: Mapping[Side, Sequence[float]]) -> None:
        """Take a state: q of the sides in it. Not every client looks at it."""
        return

    @abstractmethod
    def commands(self, now: float) -> Mapping[Side, Sequence[Motor]]:
        """The commands of a turn; none before it is ready."""


class Stage:
    """A service of hands in memory, its clients, and the network between them.

    :param made: the service.
    :param touch: where each side touches an object, in the plan's terms.
    :ivar now: seconds of the virtual clock.
    :ivar times: when what is true was noted.
    :ivar published: a state has come.
    :ivar low: by side, the low-rate copies: when they came, and q in parts of the range.
    """

    def __init__(
        self,
        made: type[Service],
        spoken: Dialect,
        sides: Sequence[Side],
        touch: Mapping[Subject, float],
    ) -> None:
        self._made, self._touch = made, touch
        self.dialect, self.sides = spoken, tuple(sides)
        self.service: Any = made(spoken, self.sides, touch)
        self.codec = MotorCodec(spoken)
        self.now = 0.0
        self.client: Client | None = None
        self.connected = True
        self.times: list[float] = []
        self._driven: list[bool] = []
        self._away = -math.inf
        self._contacts: dict[Side, list[Sequence[float]]] = {s: [] for s in self.sides}
        self._q_true: dict[Side, list[Sequence[float]]] = {s: [] for s in self.sides}
        self._shown: dict[Side, list[tuple[float, Sequence[float]]]] = {s: [] for s in self.sides}
        self._down_until: float | None = None
        self._waiting: list[tuple[float, list[tuple[str, bytes]]]] = []
        self._low_topics = {s: spoken.low_rate_topic.format(side=s) for s in self.sides}
        self.limits = {
            s: np.array([(j.q_min, j.stroke) for j in joints_of(spoken, s)]).T for s in self.sides
        }
        self._read: dict[Side, tuple[bytes, Sequence[float] | None]] = {}
        self._encoded: tuple[object, list[tuple[str, bytes]]] = (None, [])
        self._noted = -1.0
        self.published = False
        self.low: dict[Side, list[tuple[float, Floats]]] = {}
        self._newest: dict[str, bytes] = {}

    # -------------------------------------------------------------------------------- events

    def connect(self, client: Client | None) -> None:
        """A client starts, in place of the one before; or that one is stopped."""
        self.client = client
        if client is not None:
            client.due = self.now

    def restart(self) -> None:
        """The hand's service is ended, and started again."""
        self._deliver(self.service.end())
        ends = self.service.exit_s is not None and self.service.exit_s < _LONGEST_END
        self._down_until = self.now + _RESTART_S if ends else float("inf")

    def send(self, payloads: Sequence[tuple[str, bytes]], number: int, age: float = 0.0) -> None:
        """Commands arrive at the hand."""
        if self._down_until is not None or not self.service.matches_clients:
            return
        self.service.stamp = self.now - age
        for topic, payload in payloads:
            self.service.receive(topic, payload, number)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now + 1e-9 < end:
            self._tick()

    # ---------------------------------------------------------------------------------- time

    def _tick(self) -> None:
        tick = self.service.tick
        self.now += tick
        if self._down_until is None:
            self._deliver(self.service.advance(tick))
        else:
            self._pass_while_down(tick)
        if self.client is not None:
            self._turn(self.client)
        if self.now - self._noted >= _STEP - 1e-9:
            self._note()

    def _pass_while_down(self, tick: float) -> None:
        """What the service has left driven goes on, until the next one starts."""
        assert self._down_until is not None
        self.service.now += tick
        self.service.live(tick)
        if self.now >= self._down_until:
            before = self.service
            self.service = self._made(self.dialect, self.sides, self._touch)
            self.service.take_over(before)
            self.service.begin(self.now)
            self._down_until = None

    def _deliver(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self._newest[sample.topic] = sample.payload
            if sample.type_name != self.dialect.state_type:
                continue
            sides = [side for side in self.sides if self.codec.state_topics[side] == sample.topic]
            if sides:
                self.published = True
                self._show(sides, sample.payload)
            for side in self.sides:
                if self._low_topics[side] == sample.topic:
                    q = self._q(side, sample.payload)
                    if q is not None:
                        self.low.setdefault(side, []).append((self.now, self.part(side, q)))

    def _show(self, sides: Sequence[Side], payload: bytes) -> None:
        """A state of these sides arrives at the client."""
        client = self.client
        if client is None or client.crashed or not self.connected:
            return
        if client.number and not self.service.serves_late_readers:
            return
        states = {}
        for side in sides:
            read = self._read.get(side)
            if read is None or read[0] is not payload:
                read = self._read[side] = payload, self._q(side, payload)
            if read[1] is None:
                client.crashed = True
                return
            states[side] = read[1]
            self._shown[side].append((self.now, read[1]))
        client.receive(self.now, states)

    def _q(self, side: Side, payload: bytes) -> Sequence[float] | None:
        """Q in a state; None if it cannot be read, or is too short."""
        try:
            state = self.codec.read_state(payload, side)
        except WireError:
            return None
        return None if state is None else state[0]

    def part(self, side: Side, q: Sequence[float]) -> Floats:
        """Places in parts of each joint's range."""
        low, stroke = self.limits[side]
        return np.asarray((np.array(q) - low) / stroke)

    def touch(self, side: Side) -> Sequence[float]:
        """What the elements of touch that clients read hold; NaN where they are not there."""
        hand = model(self.dialect.model)
        if self.dialect.touch_topic:
            count = sum(area.elements for area in self.dialect.areas)
            data = self._newest.get(self.dialect.touch_topic_of(side))
            if data is None:
                return [math.nan] * count
            message = message_type(self.dialect.touch_type).decode(data)
            found = [x for a in self.dialect.areas for x in getattr(message, a.member)]
            return (found + [math.nan] * count)[:count]
        slots = [(i, slot) for i, sensor in enumerate(hand.sensors) for slot in sensor.slots]
        data = self._newest.get(self.codec.state_topics[side])
        packets = self.codec.state.decode(data).press_sensor_state if data else []
        return [
            float(packets[i].pressure[slot]) if i < len(packets) else math.nan for i, slot in slots
        ]

    def _turn(self, client: Client) -> None:
        while client.due <= self.now + 1e-9:
            client.due += client.period
            commands = client.commands(self.now)
            if not commands:
                continue
            if client.began is None:
                client.began = self.now
            payloads = self._encode(commands)
            if self.connected:
                if self._waiting:  # the network is back: what was sent meanwhile comes at once
                    for then, waiting in self._waiting:
                        self.send(waiting, client.number, self.now - then)
                    self._waiting = []
                self.send(payloads, client.number, client.stamp_age)
            else:
                self._waiting.append((self.now, payloads))

    def _encode(self, commands: Mapping[Side, Sequence[Motor]]) -> list[tuple[str, bytes]]:
        key = tuple((s, tuple(m)) for s, m in commands.items())
        if self._encoded[0] != key:
            self._encoded = key, self.codec.encode(commands)
        return self._encoded[1]

    def _note(self) -> None:
        self._noted = self.now
        self.times.append(self.now)
        if self.client is None or not self.connected:
            self._away = self.now
        client = self.client
        drives = client is not None and client.began is not None
        self._driven.append(drives and self.now - self._away > _FRESH_S)
        for side in self.sides:
            hand = self.service.hands[side]
            if self.codec.joints == 1:
                self._q_true[side].append([hand.q / hand.stroke])
                self._contacts[side].append([hand.contact()])
            else:
                self._q_true[side].append(hand.q)
                self._contacts[side].append(hand.contact)

    def places(self, side: Side, since: float = 0.0) -> Floats:
        """Where each joint was from then on, in parts of its range: a row for each of the times."""
        first = bisect_left(self.times, since)
        found = np.array(self._q_true[side][first:])
        if self.codec.joints == 1:
            return found
        hand = self.service.hands[side]
        return np.asarray((found - hand.low) / (hand.high - hand.low))

    def driven(self) -> NDArray[np.bool_]:
        """Whether a client drove the hand, and the network was there, at each of the times."""
        return np.array(self._driven)

    def forces(self, side: Side, since: float = 0.0) -> Floats:
        """The force of contact of each joint from then on, N m: a row for each of the times."""
        return np.asarray(np.abs(self._contacts[side][bisect_left(self.times, since) :]))

    def shown(self, side: Side) -> tuple[Floats, Floats]:
        """(times, places) as clients have read them."""
        shown = self._shown[side]
        places = np.array([q for _, q in shown]).reshape(-1, self.codec.joints)
        low, stroke = self.limits[side]
        return np.array([now for now, _ in shown]), np.asarray((places - low) / stroke)
