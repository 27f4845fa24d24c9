"""Run the bridge: DDS endpoints and threads around :mod:`dexkit.bridge.forwarding`.

One thread for each direction, so that a client that reads slowly holds up no command.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dexkit.bridge.forwarding import Commands, Direction, Outgoing, States
from dexkit.clock import Clock, RealClock
from dexkit.command_age import PAUSE, PauseWatch, SampleAges
from dexkit.dds import DdsNode, Endpoint, Reader, Sample, Writer
from dexkit.errors import DexkitError, TopicConflict, UsageError
from dexkit.hand import Side
from dexkit.models import Dialect, model
from dexkit.service.realtime import precise_timers
from dexkit.single_publisher import SEARCH, NodeTopics, SolePublisher
from dexkit.threads import Worker

__all__ = ["Bridge", "BridgeEnd"]

_log = logging.getLogger("dexkit.bridge")
_counters_log = logging.getLogger("dexkit.bridge.counters")

_TICK = 0.05  # seconds after which a direction looks at the clock when nothing comes
_JOIN = 2.0  # seconds that a stopping thread is given; a write blocks for 0.1 at most


@dataclass(frozen=True)
class BridgeEnd:
    """A dialect on a domain, one of the two that a bridge connects. Both may be on one node."""

    node: DdsNode
    dialect: Dialect

    def __str__(self) -> str:
        return f"{self.dialect.name} on domain {self.node.domain}, {self.node.interface}"


class Bridge:
    """Forward commands from ``client`` to ``gripper`` and states back, until :meth:`stop`.

    :param client: the end that clients are on; :param gripper: that of the grippers.
    :param sides: which grippers.
    :param force: start although another program publishes on the topics that the bridge writes.
    :raises UsageError: the ends are the same, or their dialects are of different hands.
    """

    CONFLICT_HINT = "stop it, choose another domain for one end, or add --force"

    def __init__(
        self,
        client: BridgeEnd,
        gripper: BridgeEnd,
        *,
        sides: Sequence[Side] = tuple(Side),
        force: bool = False,
        clock: Clock | None = None,
    ) -> None:
        if client.dialect.model != gripper.dialect.model:
            raise UsageError(
                f"{client.dialect.name} is of a {client.dialect.model}, "
                f"{gripper.dialect.name} of a {gripper.dialect.model}"
            )
        if len(model(client.dialect.model).joints[Side.LEFT]) > 1:
            raise UsageError(f"{client.dialect.name} is of a hand; grippers are bridged")
        if client.dialect == gripper.dialect and client.node.domain == gripper.node.domain:
            raise UsageError(
                f"both ends are {client}: the bridge would answer itself",
                hint="name two dialects, or two domains",
            )
        self.client, self.gripper = client, gripper
        self.sides = tuple(sides)
        self.states = States(gripper.dialect, client.dialect, self.sides)
        self.commands = Commands(client.dialect, gripper.dialect, self.sides, self.states)
        self._force = force
        self._clock: Clock = clock if clock is not None else RealClock()
        self._stop = threading.Event()
        self._loops: list[_DirectionLoop] = []
        self._sole = SolePublisher(
            [
                NodeTopics(end.node, frozenset(topics), _of_type(kind))
                for end, topics, kind in (
                    (client, self.states.outputs, client.dialect.state_type),
                    (gripper, self.commands.outputs, gripper.dialect.cmd_type),
                )
            ],
            hint=self.CONFLICT_HINT,
            force=force,
        )

    # -- life -------------------------------------------------------------------------------

    def __enter__(self) -> Bridge:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def start(self) -> None:
        """Look for other publishers, then create readers and writers.

        :raises TopicConflict: another program publishes on the topics that the bridge writes, or
            bridges in the opposite direction (unless ``force``).
        :raises DdsSetupError: an endpoint cannot be made.
        """
        sole = self._sole
        if not self._force:
            self._refuse_loop()
        sole.search()
        claim = sole.announce()
        try:
            for direction, source, target in (
                (self.commands, self.client, self.gripper),
                (self.states, self.gripper, self.client),
            ):
                self._loops.append(_DirectionLoop(self, direction, source.node, target.node, claim))
            sole.settle(self._wake_loops)
            for loop in self._loops:
                loop.thread.start()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Leave the topics. The grippers get no more commands, and brake. May be called twice."""
        self._stop.set()
        self._sole.close()
        for loop in self._loops:
            loop.close()

    def _wake_loops(self) -> None:
        for loop in self._loops:
            loop.wake()

    # -- status and counters ------------------------------------------------------------------

    @property
    def failure(self) -> Exception | None:
        """The error that ended a thread of the bridge or of its nodes; or None."""
        needed = [loop.thread.failure for loop in self._loops]
        needed += [self.client.node.failure, self.gripper.node.failure]
        return next((error for error in needed if error is not None), None)

    @property
    def clients(self) -> int:
        """Readers of the states sent."""
        return self._matched(self.states)

    @property
    def grippers(self) -> int:
        """Readers of the commands sent."""
        return self._matched(self.commands)

    def _matched(self, direction: Direction) -> int:
        return sum(
            w.matched for loop in self._loops if loop.direction is direction for w in loop.writers
        )

    def snapshot(self) -> dict[str, dict[str, int]]:
        """All counters by direction."""
        found = {
            name: {
                **direction.counts.snapshot(),
                **{str(side): n for side, n in direction.parts.items()},
            }
            for name, direction in (("commands", self.commands), ("states", self.states))
        }
        found["company"] = {"rivals": self._sole.rivals}
        return found

    def log_counters(self) -> None:
        """Log :meth:`snapshot` as one line of JSON."""
        _counters_log.info("counters %s", json.dumps(self.snapshot()))

    # -- rivals -------------------------------------------------------------------------------

    def rival(self) -> str | None:
        """Another publisher of a topic that this bridge writes, as a sentence; or None."""
        return self._sole.describe_rival()

    def reverse_bridge(self) -> str | None:
        """A process that seems to bridge in the opposite direction, as a sentence; or None."""
        clients = _foreign_writers(
            self.client.node, self.commands.inputs, self.client.dialect.cmd_type
        )
        hands = _foreign_writers(
            self.gripper.node, self.states.inputs, self.gripper.dialect.state_type
        )
        own = f"(pid {os.getpid()})"
        both = {e.process for e in clients} & {e.process for e in hands}
        for process in sorted(both):
            if process and own not in process:
                return (
                    f"{process} commands on {self.client} and answers on {self.gripper}: "
                    "if it bridges the other way, the two will answer each other"
                )
        return None

    def _refuse_loop(self) -> None:
        for node in {self.client.node, self.gripper.node}:
            node.discovery.wait(lambda _: self.reverse_bridge() or self.rival(), SEARCH)
        if found := self.reverse_bridge():
            raise TopicConflict(found, hint=self.CONFLICT_HINT)


class _DirectionLoop:
    """The thread of one direction, with its readers and writers."""

    def __init__(
        self,
        bridge: Bridge,
        direction: Direction,
        source: DdsNode,
        target: DdsNode,
        claim: bytes,
    ) -> None:
        self.direction = direction
        self._bridge = bridge
        self._wake = threading.Event()
        self._writers: Mapping[str, Writer] = {
            topic: target.writer(topic, direction.written, user_data=claim)
            for topic in direction.outputs
        }
        self._readers: Mapping[str, Reader] = {
            topic: source.reader(topic, direction.read, on_data=self._wake.set)
            for topic in direction.inputs
        }
        self._ages = SampleAges()
        self._watch = PauseWatch(bridge._clock)
        self._watch.restart()  # from here on samples may wait to be received
        self._logged: set[str] = set()
        self.thread = Worker("bridge", self._run)

    @property
    def writers(self) -> list[Writer]:
        return list(self._writers.values())

    def wake(self) -> None:
        self._wake.set()

    def close(self) -> None:
        self._wake.set()
        if self.thread.ident is not None:
            self.thread.join(_JOIN)
        for entity in (*self._readers.values(), *self._writers.values()):
            entity.close()

    def _run(self) -> None:
        precise_timers()
        while not self._bridge._stop.is_set():
            self._run_once()

    def _run_once(self) -> None:
        clock, direction = self._bridge._clock, self.direction
        due = direction.due
        self._wake.wait(_TICK if due is None else min(_TICK, max(0.0, due - clock.now())))
        self._wake.clear()
        self._check_pause()
        self._bridge._sole.poll()
        for topic, reader in self._readers.items():
            for sample in reader.take():
                self._receive(topic, sample)
        self._send(direction.flush(clock.now()))

    def _receive(self, topic: str, sample: Sample) -> None:
        # in this order: if there is a pause in between, the sample only looks older
        now = self._bridge._clock.now()
        received = self._bridge._clock.since_boot()
        self._check_pause()
        age = self._ages.age(sample.writer, sample.source_timestamp_ns, received)
        if age <= PAUSE:
            self._send(self.direction.receive(topic, sample.data, now))
            return
        self.direction.counts.received += 1
        self.direction.counts.stale += 1
        if math.isfinite(age):
            self._log_once(
                "stale",
                f"{topic}: a message came {age:.1f} s later than usual for its writer; what is "
                f"more than {PAUSE:g} s old is not forwarded (counted, logged once)",
            )

    def _check_pause(self) -> bool:
        """Whether this thread was paused; if so, what was sent before now is not forwarded."""
        away = self._watch.measure_pause()
        if not away:
            return False
        self._ages.resumed(self._bridge._clock.since_boot())
        self.direction.paused()
        self._log_once(
            "paused",
            f"this program was paused for {away:.2f} s (stopped, suspended, or a machine that is "
            f"too busy): only what was sent later is forwarded to {', '.join(self._writers)} "
            "(counted, logged once)",
        )
        return True

    def _send(self, messages: Sequence[Outgoing]) -> None:
        for message in messages:
            if self._bridge._stop.is_set() or self._check_pause():
                return
            try:
                written = self._writers[message.topic].write_raw(message.payload)
            except DexkitError as error:
                self._log_once("write", f"cannot publish {message.topic}: {error}")
            else:
                if not written:
                    self._log_once(
                        "write", f"a reliable reader of {message.topic} does not keep up"
                    )

    def _log_once(self, kind: str, text: str) -> None:
        if kind not in self._logged:
            self._logged.add(kind)
            _log.warning("%s", text)


def _of_type(name: str) -> Callable[[Any], bool]:
    """Select endpoints of a type; one of another type on the same topic never matches."""
    return lambda endpoint: bool(endpoint.type_name == name)


def _foreign_writers(node: DdsNode, topics: Mapping[str, Any], type_name: str) -> list[Endpoint]:
    return [
        e
        for e in node.endpoints()
        if e.kind == "writer" and not e.own and e.topic in topics and e.type_name == type_name
    ]
