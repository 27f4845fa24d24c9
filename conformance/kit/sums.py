"""Sums that are the same on every machine.

NumPy adds in an order that depends on its version and on the processor, so that the last bits of
its sums differ. These are the exact sums, rounded once.
"""

from __future__ import annotations

import math

from dexkit.hand import Floats

__all__ = ["mean", "total"]

_FEW = 200
"""Values that are added one by one as fast as in bulk."""
_LEAST, _MOST = 1e-200, 1e200
"""Largest values of columns that are added in bulk: their parts neither vanish nor overflow."""


def total(values: Floats) -> float:
    """The sum of a column; NaN if one of its values is, or if infinities cancel."""
    if len(values) > _FEW:
        found = _in_bulk(values)
        if found is not None:
            return found
    try:
        return math.fsum(values.tolist())
    except (ValueError, OverflowError):  # infinities of both signs; a sum beyond all floats
        return math.nan


def _in_bulk(values: Floats) -> float | None:
    """The exact sum of many values, rounded once; None if it takes :func:`math.fsum` to tell.

    Each value is cut at the same place into a high and a low part. The high parts are multiples
    of one power of two, so few of their bits differ that their sum is exact in any order; the low
    parts are cut again. When what is left is too small to change the rounded result, that result
    is the one of :func:`math.fsum`.
    """
    most = max(abs(float(values.max())), abs(float(values.min())))
    if not _LEAST < most < _MOST:  # NaN is not, either
        return 0.0 if most == 0.0 else None
    n = len(values)
    spare = (n + 2).bit_length()
    exponent = math.frexp(most)[1]
    parts: list[float] = []
    rest = values
    for _ in range(3):
        edge = math.ldexp(1.0, exponent + spare)  # its last bit is where the values are cut
        high = rest + edge
        high -= edge
        parts.append(float(high.sum()))
        exponent += spare - 53
        left = n * math.ldexp(1.0, exponent)  # the low parts add up to this at most
        low, top = math.fsum([*parts, -left]), math.fsum([*parts, left])
        if low == top:
            return low
        rest = rest - high
    return None


def mean(values: Floats) -> float:
    """The mean of a column; NaN if one of its values is, or if there are none."""
    return total(values) / len(values) if len(values) else math.nan
