"""A faster median than numpy's."""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats

__all__ = ["median"]


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
    return float(ordered[(n - 1) // 2 : middle + 1].mean())
