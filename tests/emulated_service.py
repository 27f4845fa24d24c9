"""Simulated hands with dexkit's own limits, time-out and messages, on the virtual clock."""

from __future__ import annotations

from typing import Any

from dexkit.clock import ManualClock
from dexkit.conformance.virtual import Sample, Service
from dexkit.conformance.virtual.service import TopicDevice
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import model
from dexkit.service.dialects import dialect_map
from dexkit.service.hand_core import HandCore
from dexkit.traces import TraceEndpoint

__all__ = ["EmulatedService"]


class EmulatedService(Service):
    """What ``dexkit serve`` makes of simulated hands, without threads and DDS.

    A subclass names the class of the hands, whose arguments are those of ``SimBrainCo``.
    """

    simulated: type[Any]
    tick = period = 0.002
    ticks = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.clock = ManualClock()
        self.hands = {
            s: self.simulated(s, clock=self.clock, object_at=args[2].get(s)) for s in self.sides
        }
        for hand in self.hands.values():
            hand.open()
        self._serve()

    def _serve(self) -> None:
        """Begin with the hands as they are."""
        self.cores = {}
        for s, hand in self.hands.items():
            self.cores[s] = HandCore(hand.spec, model(hand.spec.model), self.clock)
            self.cores[s].opened(hand.spec)
        groups = [tuple(self.hands)] if self.codec.shared else [(s,) for s in self.hands]
        self.maps = {
            group: dialect_map(self.dialect, {s: self.hands[s].spec for s in group})
            for group in groups
        }

    def take_over(self, before: TopicDevice) -> None:
        """Find the hands where the service before it has left them."""
        assert isinstance(before, EmulatedService)
        self.clock, self.hands = before.clock, before.hands
        self._serve()

    def endpoints(self) -> list[TraceEndpoint]:
        """Its endpoints, as discovery reports them."""
        kind = self.dialect.touch_type
        touch = [
            TraceEndpoint(topic, "writer", "reliable", "Volatile", "", kind)
            for topic in map(self.dialect.touch_topic_of, self.sides)
            if topic
        ]
        return super().endpoints() + touch

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message."""
        message = message_type(self.dialect.cmd_type).decode(payload)
        for group, mapping in self.maps.items():
            for s in group:
                if self.codec.command_topics[s] == topic:
                    command = mapping.command(message, s)
                    if command is not None:
                        self.cores[s].submit(command)

    def live(self, dt: float) -> None:
        """Let time pass."""
        self.clock.advance(dt)
        for s, core in self.cores.items():
            core.measured(self.hands[s].exchange(core.next_command()))

    def positions(self, side: Side) -> tuple[float, ...]:
        """The pose of a hand."""
        return tuple(self.hands[side].mechanics.q.tolist())

    def publish(self) -> list[Sample]:
        """One state of every hand, and what it feels."""
        samples = super().publish()
        self.ticks += 1
        if not self.dialect.touch_topic or self.ticks % 10:
            return samples
        for sides, mapping in self.maps.items():
            view = self.cores[sides[0]].view()
            felt = mapping.encode_touch({sides[0]: view}) if view is not None else None
            if felt is not None:
                topic = self.dialect.touch_topic_of(sides[0])
                samples.append(Sample(topic, self.dialect.touch_type, felt, self.now))
        return samples

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of these hands on the wire."""
        if self.cores[sides[0]].view() is None:  # before the first exchange
            self.live(0.0)
        views = {s: self.cores[s].view() for s in sides}
        return self.maps[sides].encode({s: v for s, v in views.items() if v is not None})
