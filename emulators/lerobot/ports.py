"""The ports on ZeroMQ in front of an emulated G1 on DDS: sockets and threads.

Each socket belongs to one thread. A restart of the robot on DDS needs no handling here: states are
forwarded when they arrive, and commands are written whether or not they are read.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from dexkit.clock import Clock, Rate, RealClock
from dexkit.dds import DdsNode
from dexkit.emulators.lerobot.camera import CAMERA, FPS, camera_json, moving_cards
from dexkit.emulators.lerobot.freshness import CommandStream
from dexkit.emulators.lerobot.low_level_json import MOST, command_from, state_json
from dexkit.errors import EmulatorError, ExtraMissing, WireError
from dexkit.robots import G1
from dexkit.tcp_listener import listen
from dexkit.threads import Worker
from dexkit.wire import low_level

if TYPE_CHECKING:
    import zmq

__all__ = ["PORTS", "Counters", "LerobotPorts", "Ports"]

log = logging.getLogger("dexkit.lerobot")

_TICK = 50  # ms between checks whether a thread is to stop
_JOIN = 5.0


@dataclass(frozen=True)
class Ports:
    """TCP ports; 0 lets the system choose."""

    commands: int = 6000
    states: int = 6001
    camera: int = 5555


PORTS = Ports()
"""The ports hard-coded in LeRobot's client."""


@dataclass
class Counters:
    """Counters of the ports.

    :ivar states: sent.
    :ivar commands: received.
    :ivar forwarded: of those, written to DDS.
    :ivar refused: of those, that are no command.
    :ivar pictures: sent.
    :ivar pauses: of this program.
    """

    states: int = 0
    commands: int = 0
    forwarded: int = 0
    refused: int = 0
    pictures: int = 0
    pauses: int = 0


class LerobotPorts:
    """LeRobot's ports for the G1 on a DDS domain; a context manager.

    :param node: where the emulated G1 is. Commands are written there, so it must not be the network
        of a real robot.
    :param address: which of this machine's addresses to listen on.
    :param camera: also send pictures.
    :raises ExtraMissing: pyzmq or Pillow is not installed.
    :raises EmulatorError: a port is taken.
    """

    def __init__(
        self,
        node: DdsNode,
        *,
        address: str = "127.0.0.1",
        ports: Ports = PORTS,
        camera: bool = True,
        clock: Clock | None = None,
    ) -> None:
        self.counters = Counters()
        self.failure: Exception | None = None
        self._node = node
        self._clock: Clock = clock or RealClock()
        self._zmq = _library()
        self._cards: Iterator[str] | None = moving_cards() if camera else None
        self._stop = threading.Event()
        self._told: set[str] = set()
        self._stream = CommandStream(self._clock)
        self._context = self._zmq.Context()
        try:
            self._commands = self._socket(self._zmq.PULL)
            self._commands.setsockopt(self._zmq.CONFLATE, 1)
            self._commands.setsockopt(self._zmq.MAXMSGSIZE, MOST)
            # connections are reported before their first message can be received
            self._monitor = self._commands.get_monitor_socket()
            self._states = self._socket(self._zmq.PUB)
            self._pictures = self._socket(self._zmq.PUB)
            self.ports = Ports(
                self._bind(self._commands, address, ports.commands),
                self._bind(self._states, address, ports.states),
                self._bind(self._pictures, address, ports.camera) if camera else 0,
            )
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self._threads = [
            Worker(name, work, failed=self._record_failure)
            for name, work in (
                ("lerobot-commands", self._forward_commands),
                ("lerobot-states", self._forward_states),
                *([("lerobot-camera", self._send_pictures)] if camera else ()),
            )
        ]

    @property
    def clients(self) -> int:
        """Connections to the port of the commands."""
        return len(self._stream.clients)

    def __enter__(self) -> LerobotPorts:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Close all ports. May be called twice."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(_JOIN)
        if not self._context.closed:
            self._context.destroy(linger=0)

    # -- sockets

    def _socket(self, kind: int) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self._context.socket(kind)
        made.setsockopt(self._zmq.LINGER, 0)
        # With a domain of authentication, which nobody enforces here, ZMTP before 3.0 is refused.
        # Its frames can be written by a web page, in what it posts to this port.
        made.setsockopt(self._zmq.ZAP_DOMAIN, b"dexkit")
        return made

    def _bind(self, socket: zmq.Socket[bytes], address: str, port: int) -> int:
        """Listen, on a socket that keeps networks out where the address is of loopback."""
        try:
            listener = listen(address, port)
        except (OSError, TypeError, ValueError) as error:
            raise EmulatorError(
                f"cannot listen on {address}:{port}: {getattr(error, 'strerror', None) or error}",
                hint="is another robot server running? LeRobot's client knows only these ports",
            ) from error
        host, port = listener.getsockname()
        socket.setsockopt(self._zmq.USE_FD, listener.fileno())
        try:
            socket.bind(f"tcp://{host}:{port}")
        except BaseException:
            listener.close()
            raise
        listener.detach()  # the library closes it
        return int(port)

    def _record_failure(self, error: Exception) -> None:
        self.failure = self.failure or error

    def _warn_once(self, kind: str, text: str) -> None:
        if kind not in self._told:
            self._told.add(kind)
            log.warning("%s (counted, logged once)", text)

    # -- threads

    def _forward_commands(self) -> None:
        """From the client to DDS: the newest command, if it counts."""
        zmq = self._zmq
        poller = zmq.Poller()
        poller.register(self._commands, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        with self._node.writer(G1.cmd_topic, G1.cmd_type) as writer:
            while not self._stop.is_set():
                poller.poll(_TICK)
                payload: bytes | None = None
                try:
                    payload = self._commands.recv(zmq.NOBLOCK)
                except zmq.Again:
                    pass
                # after the receive: its sender's connection has been reported by now
                self._look_at_connections()
                if self._stream.detect_pause():
                    self.counters.pauses += 1
                    self._warn_once("pause", "this program was paused: commands count again in 1 s")
                if payload is None:
                    continue
                data = self._admit(payload)
                if data is not None:
                    writer.write_raw(data)
                    self.counters.forwarded += 1
                self.counters.commands += 1  # last: all else has been counted by then

    def _admit(self, payload: bytes) -> bytes | None:
        """The sample of a command that counts."""
        try:
            data = low_level.encode_with_crc(command_from(payload))
        except WireError as error:
            self.counters.refused += 1
            self._warn_once("refused", f"a command was refused: {error}")
            return None
        counts = self._stream.counts()
        if len(self._stream.clients) > 1:
            self._warn_once(
                "clients", "two clients are connected: no command counts until one leaves"
            )
        return data if counts else None

    def _look_at_connections(self) -> None:
        zmq = self._zmq
        from zmq.utils.monitor import recv_monitor_message

        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)
            if event["event"] == zmq.EVENT_ACCEPTED:
                self._stream.connected(event["value"])
            elif event["event"] == zmq.EVENT_DISCONNECTED:
                self._stream.disconnected(event["value"])

    def _forward_states(self) -> None:
        """From DDS to all clients: the newest state, each one."""
        with self._node.reader(G1.state_topic, G1.state_type) as reader:
            while not self._stop.is_set():
                if not reader.wait(_TICK * 1e-3):
                    continue
                for sample in reader.take()[-1:]:
                    try:
                        payload = state_json(sample.message)
                    except WireError as error:
                        self._warn_once("state", f"a state cannot be read: {error}")
                        continue
                    self._states.send(payload)  # to clients that keep up; it never waits
                    self.counters.states += 1

    def _send_pictures(self) -> None:
        assert self._cards is not None
        rate = Rate(FPS, self._clock)
        while not self._stop.is_set():
            rate.wait()
            self._pictures.send(camera_json((CAMERA,), next(self._cards), time.time()))
            self.counters.pictures += 1


def _library() -> ModuleType:
    try:
        import zmq
    except ImportError as error:
        raise ExtraMissing(
            "LeRobot's ports need the package pyzmq", hint="pip install 'dexkit[zmq]'"
        ) from error
    return zmq
