"""Select rows of columns without copying them where all are wanted."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["Selected", "finite_rows"]

Selected: TypeAlias = "slice | NDArray[np.bool_]"
"""An index of rows; a slice gives views."""


def finite_rows(*columns: Floats) -> Selected:
    """The rows in which every column is a number: nearly always all of them."""
    good = np.isfinite(columns[0])
    for column in columns[1:]:
        good &= np.isfinite(column)
    return slice(None) if good.all() else good
