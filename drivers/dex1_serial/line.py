"""Exchange frames with the M4010 motors on one serial line: one command out, one data frame back.

The two motors of a robot may share a line. Two hands of one process then share one
:class:`MotorLine`, which they get from :func:`acquire`; a lock serialises their exchanges.

Unlike the vendor's library (docs/sources/unitree-dex.md#g "Receive behaviour"), this module finds
frames by head and CRC, checks the id, discards received bytes before each command, and waits for a
late answer before it sends the next command. A stray byte or a late answer costs at most one
exchange. An answer does not name its command, so an even later one is taken for the answer to the
next command. After a time-out the line must therefore be quiet for :data:`LATE` before each of the
next two commands.
"""

from __future__ import annotations

import logging
import os
import termios
import threading
import time
from dataclasses import dataclass

import serial

from dexkit.command_age import WriteDeadline
from dexkit.descriptors import wait_readable
from dexkit.drivers.serial_port import open_failed, port_errors
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout
from dexkit.wire.m4010 import DATA, FrameParser, MotorData

__all__ = ["LATE", "LineStatistics", "MotorLine", "acquire", "is_shared"]

log = logging.getLogger(__name__)

LATE = 0.01
"""Seconds to wait for a late answer before the next command is sent."""
_QUIET = 2
"""Commands after a time-out that wait for a quiet line. Two, because a late answer may be taken for
the answer to the first command, whose own answer then arrives before the second."""
_CHUNK = 4096
_MAX_STRAY_CHUNKS = 64
"""Chunks discarded at most before a command: more than an adapter and the kernel buffer."""
_MAX_LATE_CHUNKS = 8
"""Chunks read at most after the deadline of an answer, for the same reason."""


@dataclass
class LineStatistics:
    """Counters since the line was opened, for all its motors.

    :ivar exchanges: commands with an answer.
    :ivar timeouts: commands without one.
    :ivar damaged: frames with a wrong CRC.
    :ivar stray: bytes outside of frames, or received when no answer was expected.
    :ivar foreign: frames from a motor that was not addressed.
    """

    exchanges: int = 0
    timeouts: int = 0
    damaged: int = 0
    stray: int = 0
    foreign: int = 0


class MotorLine:
    """An open serial port; use :func:`acquire` to get one.

    :param path: path of the port.
    :param baudrate: bits a second.
    :raises HandNotFound: no such port, no permission, or no serial port.
    :raises HandRefused: another program uses it, or it does not support the baud rate.
    :raises HandLost: it cannot be opened for another reason.
    """

    def __init__(self, path: str, baudrate: int) -> None:
        self.path = path
        self.baudrate = baudrate
        self.statistics = LineStatistics()
        self.users = 0
        self._lock = threading.Lock()
        self._parser = FrameParser((DATA,))
        self._quiet_needed = 0
        """Commands before which the line must be quiet, as an answer may be late."""
        try:
            self._port: serial.Serial | None = serial.Serial(
                path, baudrate, timeout=0, exclusive=True
            )
        except ValueError as error:  # a baud rate that the kernel's driver does not support
            raise HandRefused(
                f"{path} does not do {baudrate} baud: {error}",
                hint="the motor needs a USB adapter for 6000000 baud, such as a CH343",
            ) from error
        except (serial.SerialException, OSError, termios.error) as error:
            raise open_failed(path, error) from error

    @property
    def broken(self) -> bool:
        """Whether it must be opened again."""
        return self._port is None

    def exchange(
        self, command: bytes, number: int, timeout: float, before: WriteDeadline | None = None
    ) -> MotorData:
        """Send a command frame and return the data frame of motor ``number``.

        :param command: a frame that motor ``number`` answers.
        :param timeout: seconds until the answer.
        :param before: checked right before the command is written.
        :raises HandTimeout: no intact answer of that motor, or ``before`` raises it.
        :raises HandLost: the port has gone away.
        """
        with self._lock:
            port = self._port
            if port is None:
                raise HandLost(f"the port {self.path} has gone away")
            try:
                with port_errors(self.path):
                    return self._exchange(port.fileno(), command, number, timeout, before)
            except HandTimeout:
                raise
            except HandError:
                self._close_port()
                raise
            except BaseException:  # Ctrl-C, perhaps between the command and its answer
                self._quiet_needed = _QUIET
                raise

    def _exchange(
        self, fd: int, command: bytes, number: int, timeout: float, before: WriteDeadline | None
    ) -> MotorData:
        statistics, parser = self.statistics, self._parser
        if self._quiet_needed and not wait_readable([fd], LATE):
            self._quiet_needed -= 1
        for _ in range(_MAX_STRAY_CHUNKS):  # bounded, for a device that sends without end
            if not (data := self._read(fd)):
                break
            statistics.stray += len(data)
        parser.reset()
        if before is not None:
            before.check()
        if os.write(fd, command) != len(command):
            raise HandLost(f"the port {self.path} takes no more bytes")
        deadline = time.monotonic() + timeout
        skipped, errors = parser.skipped, parser.crc_errors
        late = 0
        try:
            # reads after the deadline, too: the process may have been scheduled late
            while late < _MAX_LATE_CHUNKS:
                left = deadline - time.monotonic()
                late += left <= 0
                if not wait_readable([fd], max(0.0, left)):
                    break
                data = self._read(fd)
                if not data:
                    raise HandLost(f"the port {self.path} has gone away: no data")
                for frame in parser.feed(data):
                    assert isinstance(frame, MotorData)
                    if frame.id == number:
                        statistics.exchanges += 1
                        return frame
                    statistics.foreign += 1
        finally:
            statistics.stray += parser.skipped - skipped
            statistics.damaged += parser.crc_errors - errors
        statistics.timeouts += 1
        self._quiet_needed = _QUIET
        raise HandTimeout(
            f"motor {number} on {self.path} does not answer",
            hint="check its supply, the cable and the id",
        )

    @staticmethod
    def _read(fd: int) -> bytes:
        try:
            return os.read(fd, _CHUNK)
        except BlockingIOError:
            return b""

    def _close_port(self) -> None:
        """Close the port; the other user's next exchange raises ``HandLost``."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except (OSError, termios.error) as error:  # a device that is gone
                log.debug("closing %s: %s", self.path, error)

    def release(self) -> None:
        """Give the line back; the last user closes the port."""
        with _lines_lock:
            self.users -= 1
            if self.users > 0:
                return
            # compare the object: a symbolic link that is gone no longer resolves to the path
            for key in [k for k, line in _lines.items() if line is self]:
                del _lines[key]
        with self._lock:
            self._close_port()


_lines: dict[str, MotorLine] = {}
_lines_lock = threading.Lock()


def _resolve_path(path: str) -> str:
    return os.path.realpath(path)


def acquire(path: str, baudrate: int) -> MotorLine:
    """Open the line at ``path``, or share the one that this process has open.

    Raises as :class:`MotorLine`.

    :raises HandRefused: the line is open at another baud rate.
    """
    with _lines_lock:
        line = _lines.get(_resolve_path(path))
        if line is None or line.broken:
            line = _lines[_resolve_path(path)] = MotorLine(path, baudrate)
        elif line.baudrate != baudrate:
            raise HandRefused(
                f"{path} is open at {line.baudrate} baud already",
                hint=f"both motors on a line need one baud rate, not {baudrate} as well",
            )
        line.users += 1
        return line


def is_shared(line: MotorLine) -> bool:
    """Whether more than one hand uses the line."""
    with _lines_lock:
        return line.users > 1
