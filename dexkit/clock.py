"""Clocks, real or advanced by a test, and a rate that keeps absolute deadlines.

Everything that waits takes a :class:`Clock`. :class:`Rate` paces a loop; :func:`wait_until` is the
wait that it and the player of recordings share.
"""

from __future__ import annotations

import threading
import time
from typing import Protocol

from dexkit.errors import UsageError

__all__ = ["Clock", "ManualClock", "Rate", "RealClock", "wait_until"]


_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class Clock(Protocol):
    """Monotonic time in seconds and a way to wait for a point in it."""

    def now(self) -> float:
        """Seconds on a monotonic clock; the origin has no meaning."""
        ...

    def since_boot(self) -> float:
        """Seconds that go on while the machine is suspended, unlike :meth:`now`; for pauses."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return when :meth:`now` is at least ``deadline`` (at once if it already is)."""
        ...


class RealClock:
    """The machine's monotonic clock.

    ``now`` is :func:`time.monotonic`, which on Linux is CLOCK_MONOTONIC and so the same in
    every process of one machine.
    """

    def now(self) -> float:
        """Seconds of the system's monotonic clock."""
        return time.monotonic()

    def since_boot(self) -> float:
        """Seconds since the machine was started: CLOCK_BOOTTIME where there is one (Linux)."""
        return time.clock_gettime(_BOOT)

    def sleep_until(self, deadline: float) -> None:
        """Sleep until ``deadline``; an interrupted sleep is resumed by Python."""
        delay = deadline - time.monotonic()
        if delay > 0:
            time.sleep(delay)


class ManualClock:
    """A clock that moves only when advanced; for mechanics, estimators and device logic.

    ``sleep_until`` moves the clock itself, so single-threaded code runs through hours in
    microseconds.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._suspended = 0.0
        self._lock = threading.Lock()

    def now(self) -> float:
        """The time set so far, seconds."""
        return self._now

    def since_boot(self) -> float:
        """The time set so far with the time suspended, seconds."""
        return self._now + self._suspended

    def suspend(self, seconds: float) -> None:
        """Advance the time that counts suspension, but not :meth:`now`."""
        with self._lock:
            self._suspended += seconds

    def advance(self, seconds: float) -> float:
        """Move forward by ``seconds`` and return the new time.

        :raises UsageError: if ``seconds`` is negative.
        """
        if seconds < 0:
            raise UsageError(f"a clock cannot go back ({seconds} s)")
        with self._lock:
            self._now += seconds
            return self._now

    def sleep_until(self, deadline: float) -> None:
        """Jump to ``deadline`` if it lies ahead."""
        with self._lock:
            self._now = max(self._now, deadline)


def wait_until(clock: Clock, deadline: float, *, spin: float = 0.0) -> None:
    """Return when ``clock`` has reached ``deadline``, polling it for the last ``spin`` seconds.

    A sleeping thread wakes some 50 to 100 µs late, a polling one does not, at the price of
    that much processor time.
    """
    if not spin or isinstance(clock, ManualClock):
        clock.sleep_until(deadline)
        return
    clock.sleep_until(deadline - spin)
    while clock.now() < deadline:
        pass


class Rate:
    """Run a loop at a fixed rate with absolute deadlines, so that error never adds up.

    :param hz: loops a second.
    :param clock: where time comes from.
    :param spin: seconds before each deadline to stop sleeping and poll the clock instead
        (:func:`wait_until`).
    :raises UsageError: if ``hz`` is not positive or ``spin`` is negative.

    A deadline that has already passed by a whole period or more is not made up for by a burst:
    the periods missed are skipped and counted in :attr:`misses`.
    """

    def __init__(self, hz: float, clock: Clock | None = None, *, spin: float = 0.0) -> None:
        if not 0 < hz < float("inf"):
            raise UsageError(f"a rate must be a positive number of hertz, not {hz}")
        if spin < 0:
            raise UsageError(f"spin must not be negative, got {spin}")
        self.hz = hz
        self.period = 1.0 / hz
        self.spin = spin
        self.misses = 0
        self.loops = 0
        self._clock: Clock = clock if clock is not None else RealClock()
        self.reset()

    def reset(self) -> None:
        """Start counting deadlines from now; :attr:`misses` is kept."""
        self._start = self._clock.now()
        self._index = 0

    @property
    def deadline(self) -> float:
        """The next deadline, in the clock's seconds."""
        # a product, not a running sum: no error builds up over hours
        return self._start + (self._index + 1) * self.period

    def wait(self) -> int:
        """Wait for the next deadline.

        :returns: how many whole periods were missed before this call (0 when in time).
        """
        now = self._clock.now()
        late = now - self.deadline
        missed = 0
        if late >= self.period:
            missed = int(late / self.period)
            self._index += missed
            self.misses += missed
        wait_until(self._clock, self.deadline, spin=self.spin)
        self._index += 1
        self.loops += 1
        return missed
