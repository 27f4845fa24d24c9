"""The bridge: threads and DDS around :mod:`dexkit.bridge.core`.

One thread for each direction, so that a client that reads slowly holds up no command.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dexkit.bridge.core import Commands, Direction, Outgoing, States
from dexkit.clock import Clock, RealClock
from dexkit.dds import DdsNode, Endpoint, Reader, Writer
from dexkit.errors import DexkitError, TopicConflict, UsageError
from dexkit.hand import Side
from dexkit.models import Dialect, model
from dexkit.service.realtime import precise_timers
from dexkit.threads import Worker

__all__ = ["Bridge", "End"]

_log = logging.getLogger("dexkit.bridge")
_counters_log = logging.getLogger("dexkit.bridge.counters")

_DISCOVERY = 0.3  # seconds to look for other publishers, as dexkit serve does
_JOIN = 2.0  # seconds that a stopping thread is given; a write blocks for 0.1 at most


@dataclass(frozen=True)
class End:
    """One end: a dialect on a domain. Both ends may be on one node."""

    node: DdsNode
    dialect: Dialect

    def __str__(self) -> str:
        return f"{self.dialect.name} on domain {self.node.domain}, {self.node.interface}"


class Bridge:
    """Carry commands from ``client`` to ``gripper`` and states back, until :meth:`stop`.

    :param client: the end that clients are on; :param gripper: that of the grippers.
    :param sides: which grippers.
    :param force: start although somebody else publishes what is to be published here.
    :raises UsageError: the ends are the same, or their dialects are of different hands.
    """

    COMPANY_HINT = "stop it, choose another domain for one end, or add --force"

    def __init__(
        self,
        client: End,
        gripper: End,
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
        self._ways: list[_Way] = []

    # -- life -------------------------------------------------------------------------------

    def __enter__(self) -> Bridge:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def start(self) -> None:
        """Look for others, then bring the topics up.

        :raises TopicConflict: somebody else publishes what is to be published here, or carries
            the other way what this would carry (unless ``force``).
        :raises DdsSetupError: an endpoint cannot be made.
        """
        if not self._force:
            self._refuse_company()
        try:
            for direction, source, target in (
                (self.commands, self.client, self.gripper),
                (self.states, self.gripper, self.client),
            ):
                self._ways.append(_Way(self, direction, source.node, target.node))
            for way in self._ways:
                way.thread.start()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Leave the topics. The grippers hear no more commands, and brake. May be called twice."""
        self._stop.set()
        for way in self._ways:
            way.close()

    # -- what it says of itself ---------------------------------------------------------------

    @property
    def failure(self) -> Exception | None:
        """What ended a thread that the bridge needs, those of its nodes included; or None."""
        needed = [way.thread.failure for way in self._ways]
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
            w.matched for way in self._ways if way.direction is direction for w in way.writers
        )

    def snapshot(self) -> dict[str, dict[str, int]]:
        """All counters by direction."""
        return {
            name: {
                **direction.counts.snapshot(),
                **{str(side): n for side, n in direction.parts.items()},
            }
            for name, direction in (("commands", self.commands), ("states", self.states))
        }

    def log_counters(self) -> None:
        """Log :meth:`snapshot` as one line of JSON."""
        _counters_log.info("counters %s", json.dumps(self.snapshot()))

    # -- company ------------------------------------------------------------------------------

    def others(self) -> str | None:
        """Who else publishes what this bridge publishes; None: nobody.

        Publishers of another type on a topic of that name do not count: they never match.
        """
        for end, topics, type_name in (
            (self.client, self.states.outputs, self.client.dialect.state_type),
            (self.gripper, self.commands.outputs, self.gripper.dialect.cmd_type),
        ):
            for e in _foreign_writers(end.node, topics, type_name):
                who = e.process or "somebody"
                return f"{who} already publishes {e.topic} on domain {end.node.domain}"
        return None

    def reverse(self) -> str | None:
        """Who plays the client's role here and the gripper's there: a bridge back; or None."""
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

    def _refuse_company(self) -> None:
        for node in {self.client.node, self.gripper.node}:
            node.discovery.wait(lambda _: self.others() or self.reverse(), _DISCOVERY)
        if found := self.others() or self.reverse():
            raise TopicConflict(found, hint=self.COMPANY_HINT)


class _Way:
    """One direction on DDS."""

    def __init__(
        self, bridge: Bridge, direction: Direction, source: DdsNode, target: DdsNode
    ) -> None:
        self.direction = direction
        self._bridge = bridge
        self._wake = threading.Event()
        self._writers: Mapping[str, Writer] = {
            topic: target.writer(topic, direction.written) for topic in direction.outputs
        }
        self._readers: Mapping[str, Reader] = {
            topic: source.reader(topic, direction.read, on_data=self._wake.set)
            for topic in direction.inputs
        }
        self._complained = False
        self.thread = Worker("bridge", self._run)

    @property
    def writers(self) -> list[Writer]:
        return list(self._writers.values())

    def close(self) -> None:
        self._wake.set()
        if self.thread.ident is not None:
            self.thread.join(_JOIN)
        for entity in (*self._readers.values(), *self._writers.values()):
            entity.close()

    def _run(self) -> None:
        precise_timers()
        while not self._bridge._stop.is_set():
            self._turn()

    def _turn(self) -> None:
        clock, direction = self._bridge._clock, self.direction
        due = direction.due
        self._wake.wait(None if due is None else max(0.0, due - clock.now()))
        self._wake.clear()
        for topic, reader in self._readers.items():
            for sample in reader.take():
                self._send(direction.receive(topic, sample.data, clock.now()))
        self._send(direction.flush(clock.now()))

    def _send(self, messages: Sequence[Outgoing]) -> None:
        for message in messages:
            if self._bridge._stop.is_set():
                return
            try:
                written = self._writers[message.topic].write_raw(message.payload)
            except DexkitError as error:
                self._complain(f"cannot publish {message.topic}: {error}")
            else:
                if not written:
                    self._complain(f"a reliable reader of {message.topic} does not keep up")

    def _complain(self, text: str) -> None:
        if not self._complained:
            self._complained = True
            _log.warning("%s", text)


def _foreign_writers(node: DdsNode, topics: Mapping[str, Any], type_name: str) -> list[Endpoint]:
    return [
        e
        for e in node.endpoints()
        if e.kind == "writer" and not e.own and e.topic in topics and e.type_name == type_name
    ]
