"""Measures of motion that several checks use; computed once for an episode."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Track
from dexkit.hand import Floats

__all__ = ["runs_of", "span", "stroke"]


def span(values: Floats | None) -> Floats:
    """Highest less lowest value of each joint, shape (joints,); 0 where there is none."""
    if values is None or not len(values):
        return np.zeros(0 if values is None else values.shape[1])
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0)
    high = np.where(finite, values, -np.inf).max(axis=0)
    found: Floats = np.where(high >= low, high - low, 0.0)
    return found


def stroke(track: Track) -> Floats:
    """How far each joint can go, shape (joints,): by its limits, else by what is seen of it, and
    1 at least: a joint of unknown range that hardly moves is not measured by its noise.
    """
    if track.limits is not None:
        low, high = track.limits
        return np.asarray(high - low)
    seen = [span(v) for v in (track.state, track.action) if v is not None]
    return np.asarray(np.maximum(np.max(seen, axis=0), 1.0))


def runs_of(mask: NDArray[np.bool_], least: int = 1) -> Iterator[tuple[int, int]]:
    """Begin and end (exclusive) of each run of true values that is at least so long."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin >= least:
            yield begin, end
