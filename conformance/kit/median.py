"""A faster median and percentile than numpy's, with the same results to the last bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["median", "medians", "percentile"]


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


def medians(values: Floats, rows: NDArray[np.intp]) -> Floats:
    """The :func:`median` of each of many ranges of a column, ranges of one length at once.

    :param rows: from the first to before the second, shape (n, 2).
    """
    first, lengths = rows[:, 0], rows[:, 1] - rows[:, 0]
    found = np.full(len(rows), np.nan)
    for n in np.unique(lengths[lengths > 0]).tolist():
        some = np.flatnonzero(lengths == n)
        table = values[first[some, None] + np.arange(n)]
        ordered = np.partition(table, n // 2, axis=1)
        middle = ordered[:, n // 2]
        if n % 2 == 0:
            middle = (ordered[:, : n // 2].max(axis=1) + middle) / 2
        found[some] = np.where(np.isnan(table.max(axis=1)), np.nan, middle)
    return found


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
