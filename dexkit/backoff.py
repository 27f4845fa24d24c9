"""Growing delays between attempts.

Two jobs use it: opening a lost hand again (:mod:`dexkit.service.service`) and limiting how often a
servo is rebooted (:mod:`dexkit.drivers.ezgripper.recovery`). It has no clock and no random part:
the caller waits, on a real or a manual clock.
"""

from __future__ import annotations

__all__ = ["Backoff"]


class Backoff:
    """Growing delays between attempts: ``first``, twice that, ... up to ``maximum`` seconds.

    :param factor: how much longer each delay is than the one before.
    """

    def __init__(self, first: float = 0.1, maximum: float = 2.0, factor: float = 2.0) -> None:
        self._first = first
        self._maximum = maximum
        self._factor = factor
        self.reset()

    def reset(self) -> None:
        """Begin again with the shortest delay."""
        self._next = self._first

    def next(self) -> float:
        """Seconds to wait before the next attempt."""
        delay = self._next
        self._next = min(self._factor * delay, self._maximum)
        return delay
