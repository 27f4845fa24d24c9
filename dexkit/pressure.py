"""Tell what touches a hand from pressures that are absolute.

A Dex3-1's element reads about 100,000 with nothing on it, each a little differently
(docs/sources/real-hands.md#touch-rest), and a touch changes that in either direction
(docs/sources/real-hands.md#touch-sign). So everything that speaks of touch takes the *change* from
what the element reads at rest, whose size counts. Recordings of emulators that rested at 0 are the
same, with 0 at rest.
"""

from __future__ import annotations

import math

import numpy as np

from dexkit.hand import Floats

__all__ = ["NO_VALUE", "STILL", "RestingPressure", "known", "resting_pressure"]

NO_VALUE = 30000.0
"""Pressure of a slot without a sensor element (docs/sources/unitree-dex.md#b4)."""
STILL = 500.0
"""Pa by which an element at rest varies at most: half of the least difference that a program of
real hands with values near 100,000 takes for a contact (docs/sources/real-hands.md#touch-sign)."""

_WINDOW = 0.5  # s
_SAMPLES = 3  # in a window, at least: the low-rate copy has four
# Pa. More than any fall that a touch of a real hand was seen to cause (3500,
# docs/sources/real-hands.md#touch-sign)
_BEGAN_TOUCHED = 5000.0


class RestingPressure:
    """Finds what each element reads at rest, from values as they come.

    That is its mean in the first half second in which it varies by :data:`STILL` at most. Where a
    later half second like that is lower by far more than a touch can make it, the first was one
    of contact, and the later one counts. Until there is one, it is the lowest value.
    """

    def __init__(self, elements: int) -> None:
        self._level: Floats = np.full(elements, math.nan)
        self._lowest: Floats = np.full(elements, math.nan)
        self._begin = math.nan
        self._clear()

    def _clear(self) -> None:
        self._count = 0
        self._sum: Floats = np.zeros_like(self._level)
        self._low: Floats = np.full_like(self._level, math.inf)
        self._high: Floats = np.full_like(self._level, -math.inf)

    @property
    def level(self) -> Floats:
        """What each element reads at rest, shape (n_elements,); NaN before its first value."""
        return np.asarray(np.where(np.isnan(self._level), self._lowest, self._level))

    def take(self, t: Floats, values: Floats) -> None:
        """Take values of some times.

        :param t: seconds, ascending, shape (n,).
        :param values: shape (n, n_elements); :data:`NO_VALUE` or NaN is no value.
        """
        values = np.where(np.isfinite(values), known(values), math.nan)
        at = 0
        while at < len(t):
            if not self._count:
                self._begin = float(t[at])
            end = int(np.searchsorted(t, self._begin + _WINDOW))
            part = values[at:end]
            if len(part):
                self._count += len(part)
                self._sum += part.sum(axis=0)
                self._low = np.minimum(self._low, part.min(axis=0))
                self._high = np.maximum(self._high, part.max(axis=0))
                self._lowest = np.fmin(self._lowest, np.fmin.reduce(part, axis=0))
            if end < len(t):
                self.end()
            at = max(at, end)

    def end(self) -> None:
        """No more values belong to the present half second."""
        if self._count >= _SAMPLES:
            mean = self._sum / self._count
            with np.errstate(invalid="ignore"):
                still = self._high - self._low <= STILL
                first = np.isnan(self._level) | (mean < self._level - _BEGAN_TOUCHED)
            self._level = np.where(still & first, mean, self._level)
        self._clear()


def known(values: Floats) -> Floats:
    """Pressures with NaN for :data:`NO_VALUE`."""
    return np.asarray(np.where(values == NO_VALUE, math.nan, values), dtype=np.float64)


def resting_pressure(t: Floats, values: Floats) -> Floats:
    """What each element of a recording reads at rest, shape (n_elements,), by the rule of
    :class:`RestingPressure`; NaN without a value.

    :param t: seconds, ascending, shape (n,).
    :param values: shape (n, n_elements).
    """
    found = RestingPressure(values.shape[1])
    found.take(t, values)
    found.end()
    return found.level
