"""Run an emulated serial line on a pseudo-terminal.

A symbolic link names the terminal, because ``/dev/pts`` numbers change. The link is replaced
atomically, never over anything but a dangling link, and removed at the end. While unplugged,
link and terminal are gone, and a client sees what it sees of a pulled USB cable.
"""

from __future__ import annotations

import array
import contextlib
import errno
import fcntl
import os
import time
import tty
from pathlib import Path

from dexkit.clock import Clock
from dexkit.emulators.line_server import BUSY_TICK, CHUNK, LineServer
from dexkit.emulators.serial_line import SerialLine
from dexkit.errors import EmulatorError
from dexkit.staging import Staged
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["Port", "client_baudrate"]

_TCGETS2 = 0x802C542A  # asm-generic and x86: termios with numeric speeds
_TERMIOS2_SIZE = 44
_OSPEED_OFFSET = 40


def client_baudrate(fd: int) -> int | None:
    """Bits a second that the terminal behind ``fd`` is set to, or None if it cannot be read."""
    buffer = array.array("B", bytes(_TERMIOS2_SIZE))
    try:
        fcntl.ioctl(fd, _TCGETS2, buffer)
    except OSError:
        return None
    speed = int.from_bytes(buffer[_OSPEED_OFFSET : _OSPEED_OFFSET + 4].tobytes(), "little")
    return speed or None


class Port(LineServer):
    """Runs a line on a pseudo-terminal.

    :param line: with its devices.
    :param link: where to put the symbolic link; None for a name in a temporary directory.
    :param clock: the line's clock.
    :param check_baudrate: a client at another baud rate than the device's gets no answer.
    :raises EmulatorError: ``link`` is something else than a dangling symbolic link, or its
        directory is missing or not writable, or there are no pseudo-terminals.
    """

    name = "serial line"

    def __init__(
        self,
        line: SerialLine,
        link: str | os.PathLike[str] | None = None,
        *,
        clock: Clock | None = None,
        check_baudrate: bool = True,
    ) -> None:
        super().__init__(line, clock)
        self._check_baudrate = check_baudrate
        self._directory: TemporaryFolder | None = None
        if link is None:
            self._directory = TemporaryFolder("tty")
            self._path = str(self._directory.path / "tty")
        else:
            self._path = os.path.abspath(os.fspath(link))
        self._master = self._slave = -1
        self._terminal = ""
        try:
            self._plug()
        except BaseException:
            self.close()
            raise

    @property
    def path(self) -> str:
        """Path of the link, for clients to open."""
        return self._path

    @property
    def _descriptor(self) -> int:
        return self._master

    @property
    def terminal(self) -> str:
        """The pseudo-terminal that the link names now; empty while unplugged."""
        return self._terminal

    @property
    def place(self) -> str:
        """Description for the ready line."""
        return f"pty={self._terminal}"

    # --- plugging

    def _plug(self) -> None:
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise EmulatorError(f"no pseudo-terminal: {error.strerror}") from error
        # raw mode before a client opens it; the open slave keeps the master alive between clients
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._terminal = os.ttyname(self._slave)
        self._make_link()

    def _make_link(self) -> None:
        path = Path(self.path)
        if os.path.lexists(path) and not path.is_symlink():
            raise EmulatorError(
                f"{path} exists and is not a link", hint="choose another path, or remove it"
            )
        # a link that already names our terminal was left by a killed emulator
        if path.exists() and os.readlink(path) != self._terminal:
            raise EmulatorError(
                f"{path} is a link to {os.readlink(path)}, which exists",
                hint="another emulator may serve it; choose another path, or remove it",
            )
        try:
            staged = Staged(path)
            try:
                os.symlink(self._terminal, staged.path)
                staged.publish()
            finally:
                staged.discard()
        except OSError as error:
            raise EmulatorError(
                f"cannot make the link {path}: {error.strerror}",
                hint="its directory must exist and be writable",
            ) from error

    def _unplug(self) -> None:
        if self._terminal:
            with contextlib.suppress(OSError):
                # another program may have taken the name since
                if os.readlink(self.path) == self._terminal:
                    os.unlink(self.path)
        self._terminal = ""
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    # --- reading and writing

    def _read(self) -> None:
        try:
            data = os.read(self._master, CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno == errno.EIO:
                # cannot happen while the slave is held open; do not turn it into a busy loop
                time.sleep(BUSY_TICK)
                return
            raise
        now = self._clock.now()
        if self._check_baudrate:
            self.line.host_baudrate = client_baudrate(self._master)
        self.line.advance_to(now)
        if not self.line.unplugged:
            self.line.receive(data, now)

    def _write(self, data: bytes) -> None:
        if self._master < 0:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self.overruns += len(data) - written

    def close(self) -> None:
        """Stop, and remove link and terminal. May be called twice."""
        super().close()
        if self._directory is not None:
            self._directory.close()
            self._directory = None

    def __enter__(self) -> Port:
        return self
