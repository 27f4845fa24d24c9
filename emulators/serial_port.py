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
import threading
import time
import tty
from pathlib import Path

from dexkit.clock import Clock, RealClock
from dexkit.descriptors import wait_readable
from dexkit.emulators.faults import Fault
from dexkit.emulators.serial_line import SerialLine
from dexkit.errors import EmulatorError
from dexkit.temporary_folder import TemporaryFolder
from dexkit.threads import Worker

__all__ = ["Port", "client_baudrate"]

_TCGETS2 = 0x802C542A  # asm-generic and x86: termios with numeric speeds
_TERMIOS2_SIZE = 44
_OSPEED_OFFSET = 40
_CHUNK = 4096
_SPIN = 120e-6  # a sleep ends some 50 to 100 us late: poll for the rest
_BUSY_TICK = 4e-3
_IDLE_TICK = 20e-3
_MAX_BACKLOG = 0.1
"""Seconds of line time from which nothing more is read: a client that floods the line waits for
it, as it waits for the buffers of an adapter, instead of filling this program's memory."""


def client_baudrate(fd: int) -> int | None:
    """Bits a second that the terminal behind ``fd`` is set to, or None if it cannot be read."""
    buffer = array.array("B", bytes(_TERMIOS2_SIZE))
    try:
        fcntl.ioctl(fd, _TCGETS2, buffer)
    except OSError:
        return None
    speed = int.from_bytes(buffer[_OSPEED_OFFSET : _OSPEED_OFFSET + 4].tobytes(), "little")
    return speed or None


class Port:
    """Runs a line on a pseudo-terminal.

    :param line: with its devices.
    :param link: where to put the symbolic link; None for a name in a temporary directory.
    :param clock: the line's clock.
    :param check_baudrate: a client at another baud rate than a device's is not understood.
    :raises EmulatorError: ``link`` is something else than a dangling symbolic link, or its
        directory is missing or not writable, or there are no pseudo-terminals.

    ``run`` serves until ``stop``; ``start`` does so in a thread. Also a context manager.

    :ivar path: what clients open.
    :ivar overruns: bytes lost because no client read them.
    """

    def __init__(
        self,
        line: SerialLine,
        link: str | os.PathLike[str] | None = None,
        *,
        clock: Clock | None = None,
        check_baudrate: bool = True,
    ) -> None:
        self.line = line
        self.overruns = 0
        self.error: BaseException | None = None
        self._clock: Clock = clock or RealClock()
        self._check_baudrate = check_baudrate
        self._directory: TemporaryFolder | None = None
        if link is None:
            self._directory = TemporaryFolder("tty")
            self.path = str(self._directory.path / "tty")
        else:
            self.path = os.path.abspath(os.fspath(link))
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._stopping = False
        self._closed = False
        self._thread: threading.Thread | None = None
        self._injected: list[Fault] = []
        self._lock = threading.Lock()
        self._master = self._slave = -1
        self._terminal = ""
        try:
            self._apply_plug()
        except BaseException:
            self.close()
            raise

    @property
    def terminal(self) -> str:
        """The pseudo-terminal that the link names now; empty while unplugged."""
        return self._terminal

    @property
    def place(self) -> str:
        """What a ready line says of it."""
        return f"pty={self._terminal}"

    # --- plugging

    def _apply_plug(self) -> None:
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise EmulatorError(f"no pseudo-terminal: {error.strerror}") from error
        # raw before anybody sees it; the open slave keeps the master alive between clients
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
        # a link to the terminal that is ours now was left by an emulator that was killed
        if path.exists() and os.readlink(path) != self._terminal:
            raise EmulatorError(
                f"{path} is a link to {os.readlink(path)}, which exists",
                hint="another emulator may serve it; choose another path, or remove it",
            )
        temporary = f"{self.path}.{os.getpid()}.{threading.get_ident()}"
        try:
            os.symlink(self._terminal, temporary)
            os.replace(temporary, self.path)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise EmulatorError(
                f"cannot make the link {path}: {error.strerror}",
                hint="its directory must exist and be writable",
            ) from error

    def _unplug(self) -> None:
        if self._terminal:
            with contextlib.suppress(OSError):
                # somebody else may have taken the name since
                if os.readlink(self.path) == self._terminal:
                    os.unlink(self.path)
        self._terminal = ""
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    # --- running

    def start(self) -> None:
        """Serve in a background thread."""
        self._thread = Worker("serial line", self.run, failed=self._record_error)
        self._thread.start()

    def _record_error(self, error: Exception) -> None:
        self.error = error

    def stop(self) -> None:
        """Ask :meth:`run` to return; may be called from a signal handler or another thread."""
        self._stopping = True
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")

    def inject(self, fault: Fault) -> None:
        """Have a fault, its time counted from now; from any thread."""
        with self._lock:
            self._injected.append(fault)
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        line = self.line
        clock = self._clock
        while not self._stopping:
            now = clock.now()
            with self._lock:
                injected, self._injected = self._injected, []
            for fault in injected:
                line.schedule.add(fault, now)
            line.advance_to(now)
            if line.unplugged != (self._master < 0):
                if line.unplugged:
                    self._unplug()
                else:
                    self._apply_plug()
            out = line.due(now)
            if out:
                self._write(out)
            self._wait(line.next_time)

    def _wait(self, next_time: float | None) -> None:
        """Sleep until something is to be done, and take what the client sent."""
        deadline = self._clock.now() + (_BUSY_TICK if self.line.busy else _IDLE_TICK)
        sharp = next_time is not None and next_time < deadline
        if sharp and next_time is not None:
            deadline = next_time
        fds = [self._wake_read]
        if self._master >= 0 and self.line.behind(self._clock.now()) < _MAX_BACKLOG:
            fds.append(self._master)
        while True:
            left = deadline - self._clock.now()
            if left <= 0:
                return
            pause = max(0.0, left - _SPIN) if sharp else left
            ready = wait_readable(fds, pause)
            if self._wake_read in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_read, _CHUNK)
                return
            if ready:
                self._read()
                return

    def _read(self) -> None:
        try:
            data = os.read(self._master, _CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno == errno.EIO:
                # cannot happen while the slave is held open; do not turn it into a busy loop
                time.sleep(_BUSY_TICK)
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
        if self._closed:
            return
        self.stop()
        if self._thread is not None:
            self._thread.join()
        self._closed = True
        self._unplug()
        os.close(self._wake_read)
        os.close(self._wake_write)
        if self._directory is not None:
            self._directory.close()

    def __enter__(self) -> Port:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
