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
    middle = n // 2
    ordered = np.partition(values, [(n - 1) // 2, middle, n - 1])  # NaN comes last
    if np.isnan(ordered[-1]):
        return float("nan")
    low, high = float(ordered[(n - 1) // 2]), float(ordered[middle])
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
    ordered = np.partition(values, sorted({row, min(row + 1, last), last}))  # NaN comes last
    if np.isnan(ordered[-1]):
        return float("nan")
    low, high = float(ordered[row]), float(ordered[min(row + 1, last)])
    # numpy's way to interpolate, from the nearer of the two
    return high - (high - low) * (1 - part) if part >= 0.5 else low + (high - low) * part
