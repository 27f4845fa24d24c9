"""Hands and a DDS node that tests hold by the strings."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from dexkit.clock import Clock, RealClock
from dexkit.errors import HandLost
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, Side
from dexkit.models import DEX1_1
from tests.patience import PATIENCE


class ScriptedHand:
    """A hand that reaches its goal at once; can be unplugged, made to fail, or to hang.

    :param exchange_timeout: seconds; short only where a hand hangs: a busy machine makes it late.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        io_rate: float = 1000.0,
        simulated: bool = True,
        clock: Clock | None = None,
        q: float = 0.0,
        exchange_timeout: float = 5.0,
    ) -> None:
        self._spec = DEX1_1.spec(
            side, io_rate=io_rate, simulated=simulated, exchange_timeout=exchange_timeout
        )
        self.clock: Clock = clock if clock is not None else RealClock()
        self.q = q
        self.plugged = True
        self.errors: list[Exception] = []
        self.hang = threading.Event()
        self.hang.set()
        self.opens = 0
        self.closes = 0
        self.is_open = False
        self.commands: queue.SimpleQueue[HandCommand] = queue.SimpleQueue()
        self.last: HandCommand | None = None

    @property
    def spec(self) -> HandSpec:
        return self._spec

    def open(self) -> None:
        if not self.plugged:
            raise HandLost("no such device")
        self.opens += 1
        self.is_open = True

    def close(self) -> None:
        self.closes += 1
        self.is_open = False

    def exchange(self, command: HandCommand) -> HandState:
        self.hang.wait()
        if not self.plugged:
            raise HandLost("the device went away")
        if self.errors:
            raise self.errors.pop(0)
        self.last = command
        self.commands.put(command)
        mode = int(command.mode[0])
        if mode != JointMode.BRAKE and command.kp[0] > 0:
            self.q = float(command.q[0])
        return HandState.from_values(self.q, stamp=self.clock.now(), mode=mode)


@dataclass(frozen=True)
class FakeSample:
    data: bytes
    source_timestamp_ns: int = field(default_factory=time.time_ns)
    writer: int = 1


@dataclass(frozen=True)
class FakeEndpoint:
    topic: str
    type_name: str
    kind: str
    own: bool = False
    process: str = ""
    user_data: bytes = b""
    key: str = ""


@dataclass
class FakeNode:
    """One process's view of DDS, without DDS."""

    foreign: list[FakeEndpoint] = field(default_factory=list)
    sent: list[tuple[str, bytes]] = field(default_factory=list)
    inbox: dict[str, list[FakeSample]] = field(default_factory=dict)
    wake: dict[str, Callable[[], object]] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    open_entities: int = 0
    closed: bool = False

    def writer(self, topic: str, type_name: str, *, user_data: bytes = b"") -> FakeWriter:
        self.types[topic] = type_name
        self.open_entities += 1
        return FakeWriter(self, topic)

    def reader(
        self, topic: str, type_name: str, *, on_data: Callable[[], object] | None = None
    ) -> FakeReader:
        self.types[topic] = type_name
        self.open_entities += 1
        if on_data is not None:
            self.wake[topic] = on_data
        return FakeReader(self, topic)

    def endpoints(self) -> list[FakeEndpoint]:
        return list(self.foreign)

    def close(self) -> None:
        self.closed = True

    def deliver(self, topic: str, data: bytes) -> None:
        self.inbox.setdefault(topic, []).append(FakeSample(data))
        self.wake[topic]()


@dataclass
class FakeWriter:
    node: FakeNode
    topic: str
    matched: int = 1

    def write_raw(self, data: bytes, source_timestamp_ns: int | None = None) -> bool:
        self.node.sent.append((self.topic, data))
        return True

    def close(self) -> None:
        self.node.open_entities -= 1


@dataclass
class FakeReader:
    node: FakeNode
    topic: str

    def take(self) -> list[FakeSample]:
        samples, self.node.inbox[self.topic] = self.node.inbox.get(self.topic, []), []
        return samples

    def close(self) -> None:
        self.node.open_entities -= 1


def wait_until(condition: Callable[[], Any], timeout: float = PATIENCE, what: str = "") -> None:
    """Poll ``condition`` until it holds; fails the test after ``timeout`` seconds."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout} s for {what or condition}"
        time.sleep(0.002)


def deliver_until(
    node: FakeNode, topic: str, payload: bytes, condition: Callable[[], object]
) -> None:
    """Send a command again until it shows: one that falls into a pause of this program is lost."""
    wait_until(lambda: node.deliver(topic, payload) or condition())  # type: ignore[func-returns-value]
