"""A faster median and percentile than numpy's, with the same results to the last bit."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["median", "percentile"]


def median(values: Floats) -> float:
    """The median of one column; NaN if one of them is, or if there are none.

    The result is that of ``np.median``, which is slower because it also handles masked arrays.
    """
    n = len(values)
    if not n:
        return float("nan")
    if np.isnan(values.max()):
        return float("nan")
    low, high = _ordered(values, (n - 1) // 2, n // 2)
    return high if n % 2 else (low + high) / 2


def percentile(values: Floats, percent: float) -> float:
    """The percentile of one column, between its two nearest values; NaN if one of them is.

    The result is that of ``np.percentile``, which takes twenty times as long for a hundred values.

    :param values: at least one.
    :param percent: 0 to 100.
    """
    last = len(values) - 1
    place = last * (percent / 100)
    row = min(int(place), last)
    part = place - row
    if np.isnan(values.max()):
        return float("nan")
    low, high = _ordered(values, row, min(row + 1, last))
    # numpy's way to interpolate, from the nearer of the two
    return high - (high - low) * (1 - part) if part >= 0.5 else low + (high - low) * part


def _ordered(values: Floats, row: int, following: int) -> tuple[float, float]:
    """The values in these rows, if they were in order: one row, or two that follow each other."""
    ordered = np.partition(values, following)  # for one row, which takes half the time of two
    high = float(ordered[following])
    return (high if row == following else float(ordered[:following].max())), high
