"""Time in tests that hold on any machine.

What must come is waited for: :data:`PATIENCE` only ends a test that has failed. That something does
not wait longer than it says is told by what it asks the system for, see :func:`waits_of`: how late
the system ends a wait is a matter of the machine. What an emulated device does meanwhile must not
depend on it either: its clock is a :class:`StallFreeClock`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from dexkit.clock import RealClock

__all__ = ["PATIENCE", "StallFreeClock", "waits_of"]

PATIENCE = 60.0
"""Seconds after which what a test waits for will not come any more."""

_LONGEST_STEP = 0.03
"""Seconds between two looks at the clock of a serving thread that is let run: its idle tick, 20 ms,
and what a sleep overruns."""


class StallFreeClock(RealClock):
    """The clock of an emulated device, which stands still while the machine stalls this process.

    A stall between a test's look at a moving device and its next command would let the device
    arrive in between, and "stopped on its way" would depend on the machine. The device's thread
    looks at the clock at least each 20 ms; from one look to the next it goes on by 30 ms at most.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._real = self._now = super().now()

    def now(self) -> float:
        """Seconds of the system's monotonic clock, without stalls."""
        with self._lock:
            real = super().now()
            self._now += min(real - self._real, _LONGEST_STEP)
            self._real = real
            return self._now

    def sleep_until(self, deadline: float) -> None:
        """Sleep in steps, until the time without stalls is there."""
        while (left := deadline - self.now()) > 0:
            time.sleep(min(left, _LONGEST_STEP / 2))


def waits_of(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, asked: Callable[..., float]
) -> list[float]:
    """A list that gets the seconds of each wait by ``owner.name`` in the calling thread.

    A wait that ends early counts what it took, one that ends late what it asked for.

    :param asked: seconds that a call with these arguments asks for.
    """
    thread, wait, waits = threading.get_ident(), getattr(owner, name), []

    def timed(*arguments: Any) -> Any:
        wanted, begin = asked(*arguments), time.monotonic()
        try:
            return wait(*arguments)
        finally:
            if threading.get_ident() == thread:
                waits.append(min(wanted, time.monotonic() - begin))

    monkeypatch.setattr(owner, name, timed)
    return waits
