"""Floats of numbers by time: the newest ones of a live topic, or all of a recording's."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["History"]

_FIRST = 1024


class History:
    """Floats of ``width`` numbers, each with a time that never falls.

    :param most: rows that are kept at least; older ones go, at the latest when there are twice as
        many. None keeps all.
    :param seconds: rows that are older than this, seen from the newest one, need not be kept.

    :ivar added: rows that were ever appended.
    """

    def __init__(self, width: int, most: int | None = None, seconds: float | None = None) -> None:
        self._most = most
        self._seconds = seconds
        self._t: Floats = np.empty(_FIRST)
        self._rows: Floats = np.empty((_FIRST, width))
        self._count = 0
        self.added = 0

    def __len__(self) -> int:
        return self._count

    @property
    def t(self) -> Floats:
        """Times, seconds, shape (n,); valid until the next :meth:`append`."""
        return self._t[: self._count]

    @property
    def rows(self) -> Floats:
        """Shape (n, width); valid until the next :meth:`append`."""
        return self._rows[: self._count]

    def append(self, t: Floats, rows: Floats) -> None:
        """Add rows. A time before the last one is taken for the last one."""
        count = len(t)
        if not count:
            return
        if self._most is not None and count > self._most:
            self.added += count - self._most
            t, rows = t[-self._most :], rows[-self._most :]
            count = self._most
            self._count = 0  # what was there before them is older
        if self._count + count > len(self._t):
            self._make_room(count)
        there = slice(self._count, self._count + count)
        self._t[there] = t
        if self._count:
            self._t[there] = np.maximum(self._t[there], self._t[self._count - 1])
        np.maximum.accumulate(self._t[there], out=self._t[there])
        self._rows[there] = rows
        self._count += count
        self.added += count

    def _make_room(self, count: int) -> None:
        kept = self._count if self._most is None else min(self._count, self._most)
        if self._seconds is not None and self._count:
            kept = min(kept, self._count - self.until(float(self.t[-1]) - self._seconds))
        size = len(self._t)
        while kept + max(count, kept // 2) > size:  # so that rows are not moved all the time
            size *= 2
        first = self._count - kept
        if size == len(self._t):  # move down in place
            self._t[:kept] = self._t[first : self._count].copy()
            self._rows[:kept] = self._rows[first : self._count].copy()
        else:
            t, rows = np.empty(size), np.empty((size, self._rows.shape[1]))
            t[:kept], rows[:kept] = self._t[first : self._count], self._rows[first : self._count]
            self._t, self._rows = t, rows
        self._count = kept

    def until(self, at: float) -> int:
        """Number of rows up to the time ``at``."""
        return int(np.searchsorted(self.t, at, "right"))

    def between(self, begin: float, end: float) -> slice:
        """The rows in [begin, end]."""
        return slice(int(np.searchsorted(self.t, begin)), self.until(end))
