"""Hostile peers: send invalid data to a program on its domain while it works.

Malformed RTPS datagrams, NaN, giant, empty and foreign messages, participants with properties
that are no text. The program stays, its states go on, no traceback; afterwards a good client is
obeyed, and a recorder has recorded.
"""

from __future__ import annotations

import contextlib
import logging
import random
import signal
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

from dexkit.doctor import rtps
from dexkit.doctor.rtps import Locator
from dexkit.messages import encode, message_type, message_types, unitree_go, unitree_hg
from dexkit.models import Dialect
from tools.campaign.case import Batch, Case
from tools.campaign.fuzz.messages import announcements, filled
from tools.campaign.mutate import mutator
from tools.campaign.process import Program
from tools.campaign.programs import SIDE, Scene, Spec, robots_and_hands
from tools.campaign.waiting import WaitTimeout, until

__all__ = ["cases"]


class HostilePeer:
    """Sends datagrams to every participant of a domain on loopback."""

    def __init__(self, domain: int, rng: random.Random) -> None:
        self._rng = rng
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        multicast = rtps.spdp_multicast_port(domain)
        unicast = [rtps.unicast_port(domain, index) for index in range(6)]
        # discovery and, one above it, data
        self._ports = [multicast, *unicast, *(port + 1 for port in unicast)]
        self._prefix = rng.randbytes(12)
        self._payloads = announcements(rng)
        good = []
        for payload in self._payloads:
            for writer in (rtps.SPDP_WRITER, rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS):
                good.append(rtps.message(self._prefix, rtps.build_data(writer, 1, payload)))
        self._damaged = mutator(good, rng)

    def send(self, data: bytes) -> None:
        """To every port."""
        for port in self._ports:
            with contextlib.suppress(OSError):
                self._sock.sendto(data, ("127.0.0.1", port))

    def malformed(self) -> None:
        """One datagram that is damaged."""
        self.send(self._damaged()[:60_000])

    def property(self) -> None:
        """A participant whose properties are not what they should be, well-formed otherwise."""
        rng = self._rng
        prefix = b"\x01\x10" + rng.randbytes(10)
        place = Locator("127.0.0.1", 40_000 + rng.randrange(1000))
        key = rng.choice(("__Pid", "__ProcessName", "__Hostname", "x"))
        value = rng.choice(("\u00b2", "\u0661\u0662", "9" * 60, "-1", "", "\x1b[2J", "MARK"))
        data = rtps.build_participant(
            prefix, place, lease=3, properties={key: value, "__Pid": "\u00b2"}
        )
        if value == "MARK":
            data = data.replace(b"MARK", rng.choice((b"\xff\xfe\xfd\xfc", b"\xc3\x28\xa0\xa1")))
        self.send(rtps.message(prefix, rtps.build_data(rtps.SPDP_WRITER, 1, data)))

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


class _Messages:
    """Commands that are wrong in themselves, by a participant in good order."""

    def __init__(self, domain: int, dialect: Dialect, rng: random.Random) -> None:
        from dexkit.dds import DdsNode

        self.node = DdsNode(domain, "lo")
        self._rng = rng
        topic = dialect.topics(SIDE)[0]
        self._writer = self.node.writer(topic, dialect.cmd_type)
        kind = message_type(dialect.cmd_type)
        good = [kind.encode(filled(dialect.cmd_type, rng)) for _ in range(3)]
        good.append(kind.encode(kind.cls()))
        if kind.cls is unitree_go.MotorCmds_:
            nan = unitree_go.MotorCmd_(q=float("nan"), kp=5.0)
            good.append(encode(unitree_go.MotorCmds_([nan])))
            good.append(encode(unitree_go.MotorCmds_([nan] * 1000)))
        else:
            bad = unitree_hg.MotorCmd_(q=float("inf"), kp=1e38)
            good.append(encode(unitree_hg.HandCmd_(motor_cmd=[bad] * 1000)))
        self._damaged = mutator(good, rng)
        self._good = good
        # another type on the same topic
        other = rng.choice([m.name for m in message_types() if m.name != dialect.cmd_type])
        self._foreign = self.node.writer(topic, other)
        self._foreign_data = message_type(other).encode(filled(other, rng))

    def send(self) -> None:
        """One of them."""
        r = self._rng.random()
        if r < 0.2:
            self._foreign.write_raw(self._foreign_data)
        elif r < 0.6:
            self._writer.write_raw(self._rng.choice(self._good))
        else:
            # CycloneDDS of the sender refuses what is not CDR at all: its header stays
            self._writer.write_raw(self._damaged()[:60_000].ljust(8, b"\0"))

    def close(self) -> None:
        """Leave."""
        self.node.close()


class PeerCase(Case):
    """One program among hostile peers."""

    unit = "hostile messages"
    limit = 300.0

    def __init__(self, spec: Spec) -> None:
        self.name = f"peers:{spec.name}"
        self.what = f"{spec.name}, among hostile peers"
        self._spec = spec

    def run(self, batch: Batch) -> None:
        logging.disable()
        scene = Scene(batch)
        with self._spec.stage(scene):
            with Program(batch, self._spec.words(scene)) as program:
                try:
                    self._among(batch, scene, program)
                except WaitTimeout as error:
                    batch.found("not working", self.name, f"{error}\n{program.output[-2000:]}")
                program.check_output(batch)
                program.signal(signal.SIGTERM)
                if program.wait(30.0) is None:
                    batch.found("does not end", self.name, program.output[-2000:])
            self._spec.after(scene, False)

    def _among(self, batch: Batch, scene: Scene, program: Program) -> None:
        if self._spec.ready:
            program.wait_for(self._spec.ready)
        self._spec.works(scene, program)
        count = 200 if batch.sample else 2500
        with _open(batch, scene.bench.dialect if scene.bench else None) as ways:
            for number in range(count):
                batch.random.choice(ways)()
                batch.units += 1
                if number % 25 == 0:
                    time.sleep(0.005)  # what overflows a socket's buffer tests nothing
        if not program.running:
            code = program.process.returncode
            batch.found("ended", self.name, f"exit code {code}: {program.output[-2000:]}")
            return
        self._spec.works(scene, program)
        if scene.client is not None and scene.bench is not None:
            self._obeys(scene)

    @staticmethod
    def _obeys(scene: Scene) -> None:
        """Check that a good client moves the hand, by its state."""
        client, bench = scene.client, scene.bench
        assert client is not None
        assert bench is not None
        state = message_type(bench.dialect.state_type)

        def q() -> float:
            if client.newest is None:
                return 0.0
            motors = state.motors(client.newest.message)
            return float(sum(abs(m.q) for m in motors))

        client.wait_states()
        start = q()
        for goal in (bench.low, bench.high):
            client.goal = goal
            with contextlib.suppress(WaitTimeout):
                until(lambda: abs(q() - start) > 0.05, "motion", 10.0)
                client.goal = None
                return
        client.goal = None
        raise WaitTimeout("a good client is not obeyed afterwards")


@contextlib.contextmanager
def _open(batch: Batch, dialect: Dialect | None) -> Iterator[list[Callable[[], Any]]]:
    hostile_peer = HostilePeer(batch.domain, batch.random)
    ways: list[Callable[[], Any]] = [
        hostile_peer.malformed,
        hostile_peer.malformed,
        hostile_peer.property,
    ]
    with contextlib.ExitStack() as stack:
        stack.callback(hostile_peer.close)
        if dialect is not None:
            messages = _Messages(batch.domain, dialect, batch.random)
            stack.callback(messages.close)
            ways += [messages.send] * 3
        yield ways


def cases() -> list[Case]:
    """Those that listen to the network."""
    return [PeerCase(spec) for spec in robots_and_hands()]
