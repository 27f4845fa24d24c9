"""Find where a joint moves further than its reported speed allows, searching only possible windows.

A window begins at one measurement and ends at another, a given time later. What q moved in it
beyond the integral of dq is worked out for every window of a recording, or, several times as
fast, for those alone whose blocks of measurements leave room for more than a given excess.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dexkit.conformance.kit.row_selection import Rows, SomeTimes, extremes
from dexkit.hand import Floats

__all__ = ["Course", "Excess"]

_SPANNED = 4
"""Blocks in which the windows that begin in one block may end; others are always looked at."""
_ROUNDING = 1e-12
"""Part of the largest number by which a bound may be wrong."""
_MANY = 8
"""One in so many rows is left to be looked at one by one; with more of them, all are."""


@dataclass(frozen=True)
class Excess:
    """The window with the largest excess.

    :param rad: by how much q moved beyond what dq allows.
    :param start: row at which it begins, as ``end``.
    """

    rad: float
    start: int
    end: int


class Course:
    """Measured and reported motion of a joint.

    :param times: of its measurements, rising.
    :param q: rad.
    :param dq_integral: the integral of dq, rad.
    :param path: the integral of its size, rad.
    :param lag: seconds by which dq may be early or late.
    :param part: of ``path`` that q may move beyond.
    :param longest: seconds; windows with a longer step between two measurements do not count.
    :param barred: begin and end, seconds, of what no window may overlap.
    :param exactly: computes the ``dq_integral`` and ``path`` of which a window's excess is
        computed, where these differ, by no more than rounding, from those that are given.
    """

    def __init__(
        self,
        times: SomeTimes,
        q: Floats,
        dq_integral: Floats,
        path: Floats,
        *,
        lag: float,
        part: float,
        longest: float,
        barred: list[tuple[float, float]],
        exactly: Callable[[], tuple[Floats, Floats]] | None = None,
    ) -> None:
        self.times, self.t = times, times.t
        self.q, self.rough, self._exactly = q, (dq_integral, path), exactly
        self._lag, self._part, self._barred = lag, part, barred
        self._known: dict[float, Floats] = {}
        gap = np.diff(self.t) > longest
        self._gaps = np.concatenate(([0], np.cumsum(gap))) if gap.any() else None

    @cached_property
    def _integrals(self) -> tuple[Floats, Floats]:
        return self.rough if self._exactly is None else self._exactly()

    @property
    def dq_integral(self) -> Floats:
        """The integral of dq, exactly."""
        return self._integrals[0]

    @property
    def path(self) -> Floats:
        """The integral of its size, exactly."""
        return self._integrals[1]

    def bound(self, lengths: Sequence[float]) -> float:
        """Upper bound of the excess in windows of these lengths, seconds; infinite if unknown."""
        return max(float(self._bounds(s).max()) for s in lengths) if self._blocks else np.inf

    def _bounds(self, seconds: float) -> Floats:
        """As :meth:`_Blocks.bounds`, worked out once."""
        assert self._blocks is not None
        if seconds not in self._known:
            self._known[seconds] = self._blocks.bounds(seconds)
        return self._known[seconds]

    def worst(self, seconds: float, above: float) -> Excess | None:
        """The window of that length with the largest excess, the first of several.

        :param above: excesses below it need not be found.
        :returns: None without such a window.
        """
        blocks = self._blocks
        starts = None
        if blocks is not None:
            bounds = self._bounds(seconds)
            if above == -np.inf:  # an excess that is there leaves few places for a larger one
                first = self._worst_in(blocks.rows(int(np.argmax(bounds))), seconds)
                above = -np.inf if first is None else first.rad
            if above > -np.inf:
                starts = blocks.rows(*np.flatnonzero(bounds >= above).tolist())
        if starts is None or len(starts) * _MANY > len(self.t):
            ends = self.times.shifted(seconds)
            return self._worst_of(np.arange(len(ends)), ends, seconds)
        return self._worst_in(starts, seconds)

    def _worst_in(self, starts: Rows, seconds: float) -> Excess | None:
        """Of the windows that begin at some rows."""
        ends = np.searchsorted(self.t, self.t[starts] + seconds)
        return self._worst_of(starts, ends, seconds)

    def _worst_of(self, starts: Rows, ends: Rows, seconds: float) -> Excess | None:
        inside = np.flatnonzero(ends < len(self.t))
        starts, ends = starts[inside], ends[inside]
        whole = self.t[ends] - self.t[starts] < 2 * seconds
        if self._gaps is not None:
            whole &= self._gaps[ends] == self._gaps[starts]
        if not whole.all():
            starts, ends = starts[whole], ends[whole]
        if not len(starts):
            return None
        low, high, at, to = self._allowed(starts, ends)
        moved = self.q[ends] - self.q[starts]
        beyond = np.maximum(moved - (high[to] - low[at]), (low[to] - high[at]) - moved)
        beyond -= self._part * (self.path[ends] - self.path[starts])
        for begin, end in self._barred:
            beyond[(self.t[starts] < end) & (self.t[ends] > begin)] = -np.inf
        i = int(np.argmax(beyond))
        return Excess(float(beyond[i]), int(starts[i]), int(ends[i]))

    def _allowed(
        self, starts: Rows, ends: Rows
    ) -> tuple[Floats, Floats, Rows | slice, Rows | slice]:
        """Extremes of ``dq_integral`` around rows, and where those of starts and ends are."""
        n = len(starts)
        if n * _MANY > len(self.t):
            return *self._around, starts, ends
        at = self.t[np.concatenate((starts, ends))]
        first = np.searchsorted(self.t, at - self._lag)
        last = np.searchsorted(self.t, at + self._lag, "right")
        return *extremes(self.dq_integral, first, last), slice(0, n), slice(n, 2 * n)

    @cached_property
    def _around(self) -> tuple[Floats, Floats]:
        """The least and greatest of ``dq_integral`` within the lag of each row."""
        first = self.times.shifted(-self._lag)
        return extremes(self.dq_integral, first, self.times.shifted(self._lag, "right"))

    @cached_property
    def _blocks(self) -> _Blocks | None:
        span = float(self.t[-1] - self.t[0])
        # so many that a block and its neighbours lie within the lag of each of its rows
        size = min(int(0.5 * self._lag * (len(self.t) - 1) / span), 32) if span > 0 else 0
        return _Blocks(self, size, self._lag, self._part) if size >= 4 else None


class _Blocks:
    """Blocks of rows, each with lower and upper bounds of its values."""

    def __init__(self, course: Course, size: int, lag: float, part: float) -> None:
        self._size, self._t = size, course.t
        n = len(course.t)
        self._count = count = -(-n // size)
        first = np.arange(count) * size
        last = np.minimum(first + size, n) - 1

        def bounds(values: Floats) -> tuple[Floats, Floats]:
            padded = np.full(count * size, values[-1])
            padded[:n] = values
            table = padded.reshape(count, size).T.copy()  # long rows are compared much faster
            return table.min(axis=0), table.max(axis=0)

        dq_integral, path = course.rough
        q_low, q_high = bounds(course.q)
        dq_integral_low, dq_integral_high = bounds(dq_integral)
        # around every row of a block lie the blocks beside it, if they are near enough; if not
        # even the block itself does, the row does
        begins, ends = course.t[first], course.t[last]
        self._begins, self._numbers = begins, np.arange(float(count))
        near = lag * (1 - 1e-9) - 1e-9
        least, most = dq_integral_low.copy(), dq_integral_high.copy()
        beside = ends[1:] - begins[:-1] <= near
        least[1:] = np.where(beside, np.minimum(least[1:], dq_integral_low[:-1]), least[1:])
        least[:-1] = np.where(beside, np.minimum(least[:-1], dq_integral_low[1:]), least[:-1])
        most[1:] = np.where(beside, np.maximum(most[1:], dq_integral_high[:-1]), most[1:])
        most[:-1] = np.where(beside, np.maximum(most[:-1], dq_integral_high[1:]), most[:-1])
        alone = ends - begins > near
        least[alone], most[alone] = dq_integral_high[alone], dq_integral_low[alone]
        before, after = part * path[first], part * path[last]
        # of what ends in a block, and of what begins in one; see :meth:`bounds`
        self._end_up, self._end_down = q_high - most - before, q_low - least + before
        self._start_up, self._start_down = q_low - least - after, q_high - most + after
        largest = max(
            float(np.abs(v).max()) for v in (q_low, q_high, dq_integral_low, dq_integral_high)
        )
        rounding = _ROUNDING + 4 * n * float(np.finfo(np.float64).eps)
        self._slack = rounding * (1 + largest + abs(float(path[-1])))

    def bounds(self, seconds: float) -> Floats:
        """For each block, an upper bound of the excess in windows that begin in it."""
        most = self._count - 1
        ahead = self._begins + seconds
        # the last block that begins until then, in which, or behind which, the first window ends
        begin = np.interp(ahead, self._begins, self._numbers).astype(np.intp)
        begin -= self._begins[begin] > ahead
        # the last window ends before the first one of the next block
        end = np.minimum(np.append(begin[1:], most) + 1, most)
        # moved - most = (q - high) at the end - (q - low) at the start; least - moved likewise
        up, down = self._end_up[begin], self._end_down[begin]
        for step in range(1, _SPANNED):
            block = np.minimum(begin + step, end)
            np.maximum(up, self._end_up[block], out=up)
            np.minimum(down, self._end_down[block], out=down)
        found: Floats = np.maximum(up - self._start_up, self._start_down - down) + self._slack
        found[end - begin >= _SPANNED] = np.inf
        found[ahead > self._t[-1]] = -np.inf  # no window begins here
        return found

    def rows(self, *blocks: int) -> Rows:
        """The rows of some blocks."""
        found = (np.array(blocks, dtype=np.intp)[:, None] * self._size) + np.arange(self._size)
        return found[found < len(self._t)]
