"""Run an emulated device on a TCP port of this machine.

One client is served at a time; others wait until it disconnects. While unplugged, the client's
connection is reset and new ones are refused.
"""

from __future__ import annotations

import contextlib
import socket
import struct

from dexkit.clock import Clock
from dexkit.emulators.line_server import CHUNK, LineServer
from dexkit.emulators.serial_line import SerialLine
from dexkit.errors import EmulatorError
from dexkit.tcp_listener import listen

__all__ = ["TcpPort"]

_HOST = "127.0.0.1"  # loopback only: an emulated device has no password
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: drop what was not sent yet


class TcpPort(LineServer):
    """Runs a line on a TCP port.

    :param line: with its device; it has no line time.
    :param port: to listen on; 0 for a free one, which is kept across unplugging.
    :raises EmulatorError: the port cannot be opened.
    """

    name = "TCP port"

    def __init__(self, line: SerialLine, port: int = 0, *, clock: Clock | None = None) -> None:
        super().__init__(line, clock)
        self.port = port
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        try:
            self._plug()
        except BaseException:
            self.close()
            raise

    @property
    def path(self) -> str:
        """``HOST:PORT``, for clients to connect to."""
        return f"{_HOST}:{self.port}"

    @property
    def place(self) -> str:
        """Description for the ready line."""
        return f"tcp={self.path}"

    @property
    def _descriptor(self) -> int:
        here = self._client or self._listener
        return -1 if here is None else here.fileno()

    def _plug(self) -> None:
        try:
            listener = listen(_HOST, self.port)
        except OSError as error:
            raise EmulatorError(
                f"cannot listen on {self.path}: {error.strerror}",
                hint="another emulator may use the port; 0 takes a free one",
            ) from error
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener

    def _unplug(self) -> None:
        self._drop(reset=True)
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _drop(self, *, reset: bool = False) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        if reset:
            with contextlib.suppress(OSError):
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        client.close()

    def _read(self) -> None:
        if self._client is None:
            self._accept()
            return
        try:
            data = self._client.recv(CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        now = self._clock.now()
        self.line.advance_to(now)
        if not data:
            self._drop()
            self.line.disconnected()
        elif not self.line.unplugged:
            self.line.receive(data, now)
            if self.line.broken:  # not the protocol: nothing after these bytes can be parsed
                self._drop(reset=True)
                self.line.disconnected()

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            client, _ = self._listener.accept()
        except OSError:  # gone again
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client

    def _write(self, data: bytes) -> None:
        if self._client is None:
            return
        try:
            written = self._client.send(data)
        except OSError:
            written = 0
        self.overruns += len(data) - written
        if written != len(data):  # the rest would be out of step
            self._drop(reset=True)
            self.line.disconnected()

    def __enter__(self) -> TcpPort:
        return self
