"""Sums that are the same on every machine.

NumPy adds in an order that depends on its version and on the processor, so that the last bits of
its sums differ. These are the exact sums, rounded once.
"""

from __future__ import annotations

import math

from dexkit.hand import Floats

__all__ = ["mean", "total"]


def total(values: Floats) -> float:
    """The sum of a column; NaN if one of its values is, or if infinities cancel."""
    try:
        return math.fsum(values.tolist())
    except (ValueError, OverflowError):  # infinities of both signs; a sum beyond all floats
        return math.nan


def mean(values: Floats) -> float:
    """The mean of a column; NaN if one of its values is, or if there are none."""
    return total(values) / len(values) if len(values) else math.nan
