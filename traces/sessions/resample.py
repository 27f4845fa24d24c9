"""Resample a stream: hold or interpolate, never across a gap."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["gap_of", "hold", "interpolate", "period_of"]

Times = NDArray[np.int64]

# Tolerance, ns, within which a sample is used without interpolation: calculated times differ by
# rounding.
_SNAP = 1000
# A gap is longer than this many periods, and at least this many seconds.
_PERIODS = 10
_LEAST = 0.1


def period_of(times_ns: Times) -> float:
    """The median period, seconds; 0 with fewer than two samples."""
    return float(np.median(np.diff(times_ns))) / 1e9 if len(times_ns) > 1 else 0.0


def gap_of(times_ns: Times) -> float:
    """Interval between two samples, seconds, that counts as a gap."""
    return max(_PERIODS * period_of(times_ns), _LEAST)


def hold(times_ns: Times, values: Floats, at_ns: Times, gap: float | None = None) -> Floats:
    """The newest value at each time (zero-order hold); NaN before the first and within a gap.

    :param values: shape (n, k).
    :param gap: seconds; None for :func:`gap_of`.
    """
    out = np.full((len(at_ns), values.shape[1]), np.nan)
    if not len(times_ns):
        return out
    limit = gap_of(times_ns) if gap is None else gap
    before = np.searchsorted(times_ns, at_ns + _SNAP, side="right") - 1
    good = before >= 0
    age = at_ns - times_ns[np.maximum(before, 0)]
    good &= age <= limit * 1e9
    out[good] = values[before[good]]
    return out


def interpolate(
    times_ns: Times, values: NDArray[np.floating[Any]], at_ns: Times, gap: float | None = None
) -> Floats:
    """Linear interpolation; NaN outside of the data and within a gap.

    :param values: shape (n, k).
    :param gap: seconds; None for :func:`gap_of`.
    """
    out = np.full((len(at_ns), values.shape[1]), np.nan)
    if not len(times_ns):
        return out
    limit = gap_of(times_ns) if gap is None else gap
    last = len(times_ns) - 1
    after = np.searchsorted(times_ns, at_ns - _SNAP, side="left")
    exact = (after <= last) & (times_ns[np.minimum(after, last)] <= at_ns + _SNAP)
    out[exact] = values[after[exact]]
    inside = ~exact & (after > 0) & (after <= last)
    a, b = after[inside] - 1, after[inside]
    span = (times_ns[b] - times_ns[a]).astype(np.float64)
    part = ((at_ns[inside] - times_ns[a]) / np.where(span > 0, span, 1.0))[:, None]
    between = values[a] * (1 - part) + values[b] * part
    between[span > limit * 1e9] = np.nan
    out[inside] = between
    return out
