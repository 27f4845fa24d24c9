"""Read the tactile areas of a hand from a recording of their topic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats
from dexkit.messages.columns import Columns
from dexkit.models import TouchArea

__all__ = ["Touch"]

_STALE_S = 0.25  # s after which a recording client takes a sample for too old


@dataclass(frozen=True, eq=False)
class Touch:
    """The samples on a hand's touch topic.

    :param t: when each was received, seconds of the recording.
    :param columns: the lists of each.
    :param areas: of the hand, in the order of the message.
    """

    topic: str
    t: Floats
    columns: Columns
    areas: Sequence[TouchArea]

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def lengths(self) -> NDArray[np.intp]:
        """Elements of each area in each sample, shape (n, n_areas); -1 where it does not decode."""
        return np.stack([self.columns.count(area.member) for area in self.areas], axis=1)

    @cached_property
    def values(self) -> NDArray[np.float32]:
        """Counts, shape (n, n_areas, elements of the largest); NaN where there is no element."""
        most = max(area.elements for area in self.areas)
        found = np.full((len(self), len(self.areas), most), np.nan, np.float32)
        for i, area in enumerate(self.areas):
            paths = [f"{area.member}[{k}]" for k in range(area.elements)]
            found[:, i, : area.elements] = self.columns.table(paths)
        return found

    def median(self, begin: float, end: float) -> Floats | None:
        """The median of each element in [begin, end], shape (n_areas, elements of the largest).

        Where no sample was received in that time, the last one before it, if clients would still
        take it; else None.
        """
        first, last = np.searchsorted(self.t, begin), np.searchsorted(self.t, end, "right")
        if first == last:
            first -= 1
            if first < 0 or self.t[first] < end - _STALE_S:
                return None
        return np.asarray(np.median(self.values[first:last], axis=0), dtype=np.float64)
