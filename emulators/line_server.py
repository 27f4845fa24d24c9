"""Serve an emulated line to clients of any transport, in a thread."""

from __future__ import annotations

import contextlib
import os
import threading
from abc import ABC, abstractmethod

from dexkit.clock import Clock, RealClock
from dexkit.descriptors import wait_readable
from dexkit.emulators.faults import Fault
from dexkit.emulators.serial_line import SerialLine
from dexkit.threads import Worker

__all__ = ["BUSY_TICK", "CHUNK", "LineServer"]

CHUNK = 4096
BUSY_TICK = 4e-3
_SPIN = 120e-6  # a sleep ends some 50 to 100 us late: poll for the rest
_IDLE_TICK = 20e-3
_MAX_BACKLOG = 0.1
"""Backlog, seconds of line time, above which reading stops: a client that floods the line is
throttled, as by an adapter's buffers, instead of filling this program's memory."""


class LineServer(ABC):
    """Base class of servers of a line; a derived class has the client's file descriptor.

    :param line: with its devices.
    :param clock: the line's clock.

    ``run`` serves until ``stop``; ``start`` does so in a thread. Also a context manager. A derived
    class calls :meth:`_plug` at the end of its ``__init__``, and is ready then.

    :ivar overruns: bytes lost because no client read them.
    :ivar error: the error that ended the service, or None.
    """

    name = "line"

    def __init__(self, line: SerialLine, clock: Clock | None = None) -> None:
        self.line = line
        self.overruns = 0
        self.error: BaseException | None = None
        self._clock: Clock = clock or RealClock()
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._stopping = False
        self._closed = False
        self._thread: threading.Thread | None = None
        self._injected: list[Fault] = []
        self._lock = threading.Lock()

    # --- for the derived class

    @property
    @abstractmethod
    def path(self) -> str:
        """Path or address that a client opens."""

    @property
    @abstractmethod
    def place(self) -> str:
        """Description for the ready line."""

    @property
    @abstractmethod
    def _descriptor(self) -> int:
        """The client's file descriptor; -1 while unplugged."""

    @abstractmethod
    def _plug(self) -> None:
        """Become available to clients."""

    @abstractmethod
    def _unplug(self) -> None:
        """Disappear for clients. May be called twice."""

    @abstractmethod
    def _read(self) -> None:
        """Read received bytes from the descriptor."""

    @abstractmethod
    def _write(self, data: bytes) -> None:
        """Write to the client, without waiting for it."""

    # --- running

    def start(self) -> None:
        """Serve in a background thread."""
        self._thread = Worker(self.name, self.run, failed=self._record_error)
        self._thread.start()

    def _record_error(self, error: Exception) -> None:
        self.error = error

    def stop(self) -> None:
        """Ask :meth:`run` to return; may be called from a signal handler or another thread."""
        self._stopping = True
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")

    def inject(self, fault: Fault) -> None:
        """Inject a fault, its time counted from now; from any thread."""
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
            if line.unplugged != (self._descriptor < 0):
                if line.unplugged:
                    self._unplug()
                else:
                    self._plug()
            out = line.due(now)
            if out:
                self._write(out)
            self._wait(line.next_time)

    def _wait(self, next_time: float | None) -> None:
        """Sleep until the next event, and read the client's bytes."""
        deadline = self._clock.now() + (BUSY_TICK if self.line.busy else _IDLE_TICK)
        sharp = next_time is not None and next_time < deadline
        if sharp and next_time is not None:
            deadline = next_time
        fds = [self._wake_read]
        if self._descriptor >= 0 and self.line.behind(self._clock.now()) < _MAX_BACKLOG:
            fds.append(self._descriptor)
        while True:
            left = deadline - self._clock.now()
            if left <= 0:
                return
            pause = max(0.0, left - _SPIN) if sharp else left
            ready = wait_readable(fds, pause)
            if self._wake_read in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_read, CHUNK)
                return
            if ready:
                self._read()
                return

    def close(self) -> None:
        """Stop, and disappear for clients. May be called twice."""
        if self._closed:
            return
        self.stop()
        if self._thread is not None:
            self._thread.join()
        self._closed = True
        self._unplug()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def __enter__(self) -> LineServer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
