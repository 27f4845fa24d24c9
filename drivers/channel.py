"""Byte channels to a device: a serial port or a TCP connection, both non-blocking."""

from __future__ import annotations

import array
import contextlib
import fcntl
import logging
import os
import socket
import struct
import termios
from abc import ABC, abstractmethod
from urllib.parse import urlsplit

import serial

from dexkit.drivers.serial_port import find_device, open_failed
from dexkit.errors import HandLost, HandNotFound, UsageError
from dexkit.escaping import one_line

__all__ = ["Channel", "SerialChannel", "TcpChannel", "tcp_address"]

log = logging.getLogger(__name__)

_CHUNK = 4096
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: on close, drop what the peer has not acknowledged


class Channel(ABC):
    """An open way to a device.

    :ivar place: what messages call it.
    """

    place: str

    @abstractmethod
    def fileno(self) -> int:
        """The descriptor to wait on."""

    @abstractmethod
    def read(self) -> bytes:
        """Read received bytes; empty if there are none, or at end of file.

        :raises OSError: it has gone away.
        """

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Write without blocking; return the number of bytes taken.

        :raises OSError: it has gone away.
        """

    @property
    def unsent(self) -> int:
        """Bytes that may still reach the device later, without another write."""
        return 0

    @abstractmethod
    def close(self) -> None:
        """Close it. Failures are logged."""


class SerialChannel(Channel):
    """A serial port, opened exclusively.

    :param device: path, or USB serial number of the adapter.
    :raises HandNotFound: there is none.
    :raises HandRefused: another program uses it.
    :raises HandLost: it goes away.
    """

    def __init__(self, device: str, baudrate: int) -> None:
        self.place = find_device(device).path
        try:
            self._port = serial.Serial(self.place, baudrate, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            raise open_failed(self.place, error) from error

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return int(self._port.fileno())

    def read(self) -> bytes:
        """What has come."""
        try:
            return os.read(self.fileno(), _CHUNK)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Write; return how much was taken."""
        return os.write(self.fileno(), data)

    def close(self) -> None:
        """Release the port."""
        try:
            self._port.close()
        except (OSError, termios.error) as error:  # a device that is gone
            log.debug("closing %s: %s", self.place, error)


class TcpChannel(Channel):
    """A TCP connection.

    The operating system retransmits written data for many minutes: a goal written during a network
    outage would move the hand when the network returns. So bytes that the peer has not acknowledged
    count as ``unsent``, and closing drops them.

    :param timeout: seconds to connect.
    :raises HandNotFound: the connection is refused, or the host cannot be reached.
    """

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.place = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout)
        except (OSError, UnicodeError) as error:
            raise HandNotFound(
                f"no connection to {self.place}: {error}",
                hint="is the hand on, and this machine in its network? ping its address",
            ) from error
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """What has come."""
        try:
            return self._socket.recv(_CHUNK)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Write; return how much was taken."""
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0

    @property
    def unsent(self) -> int:
        """Bytes that the peer has not acknowledged."""
        count = array.array("i", [0])
        try:
            fcntl.ioctl(self._socket.fileno(), termios.TIOCOUTQ, count)
        except OSError as error:
            raise HandLost(f"the connection to {self.place} is lost: {error}") from error
        return count[0]

    def close(self) -> None:
        """Close the connection and drop unsent bytes."""
        with contextlib.suppress(OSError, HandLost):
            if self.unsent:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self._socket.close()


def tcp_address(text: str, port: int) -> tuple[str, int]:
    """The host and port of ``HOST[:PORT]``.

    :param port: where none is given.
    :raises UsageError: the text is not an address.
    """
    try:
        parts = urlsplit(f"//{text}")
        found = port if parts.port is None else parts.port
        if not parts.hostname or parts.path or parts.query or parts.fragment or "@" in text:
            raise ValueError("no address")
        if not 1 <= found <= 65535:
            raise ValueError("no port")
    except ValueError as error:
        raise UsageError(
            f"{one_line(text, 80)} is no address: {error}",
            hint=f"HOST or HOST:PORT, as 192.168.11.210:{port}",
        ) from error
    return parts.hostname, found
