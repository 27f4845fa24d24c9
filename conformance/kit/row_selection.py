"""Rows of columns: select them without copies, find those of a time, read ranges of them."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["Rows", "Selected", "SomeTimes", "Times", "extremes", "finite_rows"]

Rows: TypeAlias = NDArray[np.intp]

Selected: TypeAlias = "slice | NDArray[np.bool_]"
"""An index of rows; a slice gives views."""


def finite_rows(*columns: Floats) -> Selected:
    """The rows in which every column is a number: nearly always all of them."""
    good = np.isfinite(columns[0])
    for column in columns[1:]:
        good &= np.isfinite(column)
    return slice(None) if good.all() else good


_PASSES = 3
"""Passes over all values that ranges may take together to be gone through one by one."""


class Times:
    """Times of rows, and which rows lie a while after or before each of them.

    The results are those of ``np.searchsorted``. They are kept, for all joints of a hand have the
    same times.

    :param t: seconds, shape (n,).
    """

    def __init__(self, t: Floats) -> None:
        self.t = t
        self.rising = bool((t[1:] >= t[:-1]).all()) and bool(np.isfinite(t).all())
        """Whether they are in order."""
        self.advancing = self.rising and bool((t[1:] > t[:-1]).all())
        """Whether each is later than the one before."""
        self._known: dict[tuple[float, str], Rows] = {}

    def shifted(self, seconds: float, side: Literal["left", "right"] = "left") -> Rows:
        """For each time, the first row that is not before it by that much.

        :param seconds: what is added to each time.
        :param side: ``right`` for the first row that is behind it by that much.
        """
        key = (seconds, side)
        if key not in self._known:
            times = self.t + seconds
            found = _looked_up(self.t, times, side) if self.rising else None
            if found is None:
                found = np.searchsorted(self.t, times, side)
            self._known[key] = found
        return self._known[key]


class SomeTimes:
    """The times of some of the rows; lookups are those of these times alone.

    :param rows: which of all rows; rising.
    """

    def __init__(self, every: Times, rows: Rows) -> None:
        self.t: Floats = every.t if len(rows) == len(every.t) else every.t[rows]
        self._every, self._rows = every, rows
        self._before: Rows | None = None

    def shifted(self, seconds: float, side: Literal["left", "right"] = "left") -> Rows:
        """As :meth:`Times.shifted`."""
        if len(self.t) == len(self._every.t):
            return self._every.shifted(seconds, side)
        if not self._every.rising:
            return np.searchsorted(self.t, self.t + seconds, side)
        if self._before is None:
            # as many of these are before a time as there are among all rows before it
            chosen = np.zeros(len(self._every.t) + 1, dtype=np.intp)
            chosen[self._rows + 1] = 1
            self._before = np.cumsum(chosen)
        return self._before[self._every.shifted(seconds, side)[self._rows]]


def _looked_up(t: Floats, times: Floats, side: Literal["left", "right"]) -> Rows | None:
    """``np.searchsorted`` for rising times, several times as fast; None where it is not certain."""
    n = len(t)
    if n < 2:
        return None
    # interpolation goes through both columns once; its rounding is corrected by one row
    rows: Rows = np.interp(times, t, np.arange(float(n))).astype(np.intp)
    padded = np.concatenate(([-np.inf], t, [np.inf]))
    behind = np.less if side == "left" else np.less_equal
    rows += behind(t[rows], times)
    # row k is right if t[k - 1] is before the time, and t[k] is not
    ahead = ~behind(padded[rows], times)
    rows -= ahead
    right = behind(padded[rows], times) & ~behind(padded[rows + 1], times)
    return rows if right.all() else None


def extremes(values: Floats, first: Rows, last: Rows) -> tuple[Floats, Floats]:
    """The least and the greatest of ``values[first[i] : last[i]]``, for each i; NaN passes on.

    :param first: rows, each before the one in ``last``.
    """
    lengths = last - first
    n = len(lengths)
    if not n:
        return np.empty(0), np.empty(0)
    if int(lengths.sum()) < _PASSES * len(values):
        return _extremes_of_each(values, first, last)
    # two ranges of one length, which is a power of two, cover a range up to twice as long
    step = 1 << (int(np.partition(lengths, n // 50)[n // 50]).bit_length() - 1)
    low: Floats = values
    high: Floats = values
    width = 1
    while width < step:
        low = np.minimum(low[:-width], low[width:])
        high = np.maximum(high[:-width], high[width:])
        width *= 2
    fits = (lengths >= step) & (lengths <= 2 * step)
    odd = np.flatnonzero(~fits)
    begin: Rows = np.where(fits, first, 0) if len(odd) else first
    end: Rows = np.where(fits, last - step, 0) if len(odd) else last - step
    least, most = np.minimum(low[begin], low[end]), np.maximum(high[begin], high[end])
    if len(odd):
        least[odd], most[odd] = _extremes_of_each(values, first[odd], last[odd])
    return least, most


def _extremes_of_each(values: Floats, first: Rows, last: Rows) -> tuple[Floats, Floats]:
    ranges = np.column_stack((first, last)).ravel()
    longer = np.append(values, values[-1])  # an end may be one past the last row
    return np.minimum.reduceat(longer, ranges)[::2], np.maximum.reduceat(longer, ranges)[::2]
