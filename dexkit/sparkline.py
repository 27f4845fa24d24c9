"""A curve in one line of text."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["ASCII", "BLOCKS", "resampled", "sparkline"]

BLOCKS = "▁▂▃▄▅▆▇█"
ASCII = "_.-=+*#@"


def resampled(t: Floats, values: Floats, width: int, begin: float, end: float) -> Floats:
    """The mean of the finite values in each of ``width`` equal stretches of [begin, end]; else NaN.

    :param t: of the values, shape (n,).
    """
    good = np.isfinite(values) & (t >= begin) & (t <= end)
    place = ((t[good] - begin) / max(end - begin, 1e-9) * width).astype(int)
    place = np.minimum(place, width - 1)
    count = np.bincount(place, minlength=width)
    total = np.bincount(place, weights=values[good], minlength=width)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(count > 0, total / count, np.nan))


def sparkline(values: Floats, low: float, high: float, levels: str = BLOCKS) -> str:
    """A character for each value, from the lowest to the highest; a blank where it is NaN."""
    scale = len(levels) / (high - low) if high > low else 0.0
    out = []
    for value in values.tolist():
        if value != value:
            out.append(" ")
        else:
            out.append(levels[min(max(int((value - low) * scale), 0), len(levels) - 1)])
    return "".join(out)
