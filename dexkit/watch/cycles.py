"""Cycles of a publisher: how long one is, where there are gaps, and how many are missing."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["GAP", "Cycles", "Gap"]

GAP = 2.5
"""An interval longer than so many periods is a gap; a shorter one is jitter."""

_BLOCK = 64  # intervals after which the period is measured again
_FIRST = 16  # those after which it is measured for the first time
_REMEMBERED = 4 * _BLOCK
_MOST_GAPS = 10_000


class Gap(tuple[float, float, int]):
    """A gap: (its end, its length, cycles missed), seconds."""

    __slots__ = ()


class Cycles:
    """Counts of one publisher's missed cycles.

    The period is the median of the last whole blocks of intervals, not what a model's service
    promises: a slower publisher misses none, it is slow (its rate shows that). Nothing is judged
    before the first 16 intervals; they are judged then. What comes out does not depend on how the
    times are split over calls.

    :ivar gaps: the last gaps, oldest first.
    :ivar count: gaps, ever.
    :ivar missed: cycles missed, ever.
    """

    def __init__(self) -> None:
        self.gaps: list[Gap] = []
        self.count = 0
        self.missed = 0
        self.longest = 0.0
        self._period = 0.0
        self._early: list[tuple[float, float]] | None = []
        self._last = np.nan
        self._block: list[float] = []
        self._recent: list[float] = []

    @property
    def period(self) -> float:
        """Seconds of a period; 0 while it is not known."""
        return self._period

    def add(self, t: Floats) -> None:
        """Take the times of samples, seconds, in order."""
        if not len(t):
            return
        times = np.concatenate(([self._last], t)) if np.isfinite(self._last) else t
        self._last = float(t[-1])
        intervals = np.diff(times)
        ends = times[1:]
        at = 0
        if self._early is not None:
            at = min(len(intervals), _FIRST - len(self._early))
            self._early += zip(intervals[:at].tolist(), ends[:at].tolist(), strict=True)
            if len(self._early) < _FIRST:
                return
            first = np.array(self._early)
            self._early = None
            self._period = float(np.median(first[:, 0]))
            self._judge(first[:, 0], first[:, 1])
            self._block = first[:, 0].tolist()
        while at < len(intervals):
            stop = min(len(intervals), at + _BLOCK - len(self._block))
            part = intervals[at:stop]
            self._judge(part, ends[at:stop])
            self._block += part.tolist()
            if len(self._block) == _BLOCK:
                self._recent = [*self._recent, *self._block][-_REMEMBERED:]
                self._period = float(np.median(self._recent))
                self._block = []
            at = stop

    def _judge(self, intervals: Floats, ends: Floats) -> None:
        if self._period <= 0:
            return
        for i in np.flatnonzero(intervals > GAP * self._period).tolist():
            length = float(intervals[i])
            missed = round(length / self._period) - 1
            self.count += 1
            self.missed += missed
            self.longest = max(self.longest, length)
            self.gaps.append(Gap((float(ends[i]), length, missed)))
        if len(self.gaps) > _MOST_GAPS:
            del self.gaps[: -_MOST_GAPS // 2]

    def until(self, at: float) -> tuple[int, int, float]:
        """(gaps, missed cycles, longest gap) not later than ``at``."""
        later = [g for g in self.gaps if g[0] > at]
        if not later:
            return self.count, self.missed, self.longest
        before = [g[1] for g in self.gaps if g[0] <= at]
        return (
            self.count - len(later),
            self.missed - sum(g[2] for g in later),
            max(before, default=0.0),
        )
