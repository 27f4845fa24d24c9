"""Curves with fewer points that look the same."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["common_times", "thin"]


def thin(t: Floats, values: Floats, most: int) -> tuple[Floats, Floats]:
    """At most ``most`` points of a curve, among them the lowest and highest of each stretch.

    A stretch without any number gives one point that is NaN.

    :param most: at least 4.
    """
    if len(t) <= most:
        return t, values
    bins = most // 2
    width = -(-len(t) // bins)
    # the last stretch is filled up with what does not count
    padded = np.full(width * bins, np.nan)
    padded[: len(t)] = values
    table = padded.reshape(bins, width)
    known = np.isfinite(table)
    first = np.arange(bins) * width
    low = first + np.where(known, table, np.inf).argmin(axis=1)
    high = first + np.where(known, table, -np.inf).argmax(axis=1)
    chosen = np.unique(np.concatenate((low, high)))
    chosen = chosen[chosen < len(t)]
    return t[chosen], values[chosen]


def common_times(curves: list[tuple[Floats, Floats]]) -> tuple[Floats, list[Floats]]:
    """Several curves on the times of all; between its points a curve keeps its last number.

    Before its first number it has that one, and without any it is 0: a chart cannot scale NaN.
    """
    times: Floats = np.unique(np.concatenate([t for t, _ in curves])) if curves else np.empty(0)
    out: list[Floats] = []
    for t, values in curves:
        finite = np.isfinite(values)
        if not finite.any():
            out.append(np.zeros(len(times)))
            continue
        at = np.searchsorted(t[finite], times, "right") - 1
        out.append(values[finite][np.maximum(at, 0)])
    return times, out
