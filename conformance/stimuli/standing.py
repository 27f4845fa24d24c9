"""How long a number of joints has stood still, from one state to the next."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

__all__ = ["Standing"]


class Standing:
    """The newest stretch of time in which no joint has moved by more than its limit.

    :param limits: most that the position of each joint may vary, in the unit of the positions.
    """

    def __init__(self, limits: Sequence[float]) -> None:
        self._limits = tuple(limits)
        self._begin_ns: int | None = None
        # of each joint, times and positions that no later one undercuts, or exceeds
        self._low: list[deque[tuple[int, float]]] = [deque() for _ in self._limits]
        self._high: list[deque[tuple[int, float]]] = [deque() for _ in self._limits]

    def restart(self) -> None:
        """Begin anew: the next positions are the first of the stretch."""
        if self._begin_ns is not None:
            self._begin_ns = None
            for extremes in (*self._low, *self._high):
                extremes.clear()

    def add(self, now_ns: int, positions: Sequence[float]) -> None:
        """Take the finite positions of all joints at a time later than that of those before."""
        if self._begin_ns is None:
            self._begin_ns = now_ns
        for x, limit, low, high in zip(positions, self._limits, self._low, self._high, strict=True):
            while low and not low[-1][1] < x:
                low.pop()
            while high and not high[-1][1] > x:
                high.pop()
            low.append((now_ns, x))
            high.append((now_ns, x))
            while high[0][1] - low[0][1] > limit:
                gone = low if low[0][0] < high[0][0] else high
                # the stretch begins after the older of the two
                self._begin_ns = max(self._begin_ns, gone.popleft()[0])

    def lasts(self, now_ns: int) -> float:
        """Seconds of the stretch up to now; 0 before the first positions."""
        return 0.0 if self._begin_ns is None else (now_ns - self._begin_ns) / 1e9
