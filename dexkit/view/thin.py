"""Curves with fewer points that look the same."""

from __future__ import annotations

from itertools import pairwise

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
    edges = np.linspace(0, len(t), most // 2 + 1).astype(int)
    chosen = []
    for begin, end in pairwise(edges.tolist()):
        part = values[begin:end]
        finite = np.flatnonzero(np.isfinite(part))
        if not len(finite):
            chosen.append(begin)
            continue
        low = begin + finite[np.argmin(part[finite])]
        high = begin + finite[np.argmax(part[finite])]
        chosen += sorted({int(low), int(high)})
    return t[chosen], values[chosen]


def common_times(curves: list[tuple[Floats, Floats]]) -> tuple[Floats, list[Floats]]:
    """Several curves on the times of all; between its points a curve keeps its last value."""
    times: Floats = np.unique(np.concatenate([t for t, _ in curves])) if curves else np.empty(0)
    out: list[Floats] = []
    for t, values in curves:
        if not len(t):
            out.append(np.full(len(times), np.nan))
            continue
        at = np.searchsorted(t, times, "right") - 1
        out.append(np.where(at >= 0, values[np.maximum(at, 0)], np.nan))
    return times, out
