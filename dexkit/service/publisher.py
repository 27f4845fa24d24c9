"""The thread that publishes states at fixed deadlines.

One for all the hands of a process: threads that compete for the interpreter lock at the same
deadlines make each other late, and their waiting costs more than their work.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from dexkit.clock import Clock, Rate, RealClock
from dexkit.service.realtime import go_first, precise_timers
from dexkit.threads import Worker

__all__ = ["Publisher", "align"]

# Polls the clock before a deadline, because a sleeping thread wakes 50 to 100 us late; for no
# more than a small part of the period, because the exchange threads cannot run meanwhile.
_SPIN = 150e-6
_SPIN_SHARE = 0.075


def align(clock: Clock, hz: float, phase: float) -> None:
    """Wait for the next point of a grid that all threads of a process share.

    Loops that begin at different phases of one period do not meet at the interpreter lock.

    :param phase: of the period, 0 to 1; the publisher's is 0.
    """
    period = 1.0 / hz
    clock.sleep_until((math.floor(clock.now() / period) + 1 + phase) * period)


class Publisher:
    """Calls functions at a fixed rate, in one thread that runs while there are any.

    :param hz: calls a second.
    """

    def __init__(self, hz: float, clock: Clock | None = None) -> None:
        self.hz = hz
        self._clock: Clock = clock if clock is not None else RealClock()
        self._lock = threading.Lock()
        self._ticks: list[Callable[[int], None]] = []
        self._stop = threading.Event()
        self._thread: Worker | None = None
        #: what ended its thread, or None: without it nothing is published
        self.failure: Exception | None = None

    def add(self, tick: Callable[[int], None]) -> None:
        """Call ``tick`` at every deadline from now on.

        :param tick: is given the whole periods missed before; it must not raise.
        """
        with self._lock:
            self._ticks.append(tick)
            if self._thread is None:
                self._stop = threading.Event()
                self._thread = Worker("publish", self._run, self._stop, failed=self._record_failure)
                self._thread.start()

    def remove(self, tick: Callable[[int], None]) -> None:
        """Call ``tick`` no more; when this returns, no call is under way."""
        with self._lock:
            if tick in self._ticks:
                self._ticks.remove(tick)
            if self._ticks or self._thread is None:
                return
            thread, self._thread = self._thread, None
            self._stop.set()
        thread.join()

    def _record_failure(self, error: Exception) -> None:
        self.failure = error

    def _run(self, stop: threading.Event) -> None:
        precise_timers()
        go_first()
        align(self._clock, self.hz, 0.0)
        rate = Rate(self.hz, self._clock, spin=min(_SPIN, _SPIN_SHARE / self.hz))
        while True:
            missed = rate.wait()
            with self._lock:
                if stop.is_set():
                    return
                for tick in self._ticks:
                    tick(missed)
