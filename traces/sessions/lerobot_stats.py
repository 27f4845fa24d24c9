"""Statistics of a feature as LeRobot has them: of frames, and over episodes
(docs/sources/sessions.md#c3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats

__all__ = ["Aggregate", "statistics"]

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_LOWER = ("min", "q01", "q10", "q50")
_UPPER = ("max", "q90", "q99")
_MOMENTS = ("mean", "std", "count")


def statistics(values: NDArray[Any]) -> dict[str, list[Any]]:
    """The statistics of a feature over its frames.

    :param values: shape (frames,) or (frames, elements).
    """
    table = values.reshape(len(values), -1).astype(np.float64)
    found = {
        "min": table.min(axis=0).tolist(),
        "max": table.max(axis=0).tolist(),
        "mean": table.mean(axis=0).tolist(),
        "std": table.std(axis=0).tolist(),
        "count": [len(table)],
    }
    quantiles: Floats = np.quantile(table, list(_QUANTILES.values()), axis=0)
    return found | {k: q.tolist() for k, q in zip(_QUANTILES, quantiles, strict=True)}


class Aggregate:
    """The statistics of a feature over episodes, from those of each, one after the other.

    Mean and standard deviation are those of all frames, by the episodes' counts. The quantiles of
    all frames cannot be had from those of episodes: as in LeRobot, the lower ones are the least,
    and the upper ones the largest of any episode.

    :ivar episodes: how many were added.
    """

    def __init__(self) -> None:
        self.episodes = 0
        self._count = 0.0
        self._mean: Floats = np.zeros(0)
        self._squares: Floats = np.zeros(0)  # squared distances from the mean, summed up
        self._bounds: dict[str, Floats] = {}

    def add(self, found: Mapping[str, Any]) -> None:
        """Add an episode.

        :param found: by name, lists of numbers of one shape, and ``count``, a list of one number.
        :raises ValueError: mean, std or count is missing, something is no number, or has another
            shape than in the episodes before.
        """
        wanted = (*_MOMENTS, *_LOWER, *_UPPER)
        try:
            table = {k: np.asarray(found[k], np.float64) for k in wanted if k in found}
        except TypeError as error:
            raise ValueError(str(error)) from error
        count = table.pop("count", np.zeros(0))
        if not {"mean", "std"} <= table.keys() or count.size != 1 or not 0 < count.item() < 1e15:
            raise ValueError("no mean, std or count")
        shape = self._mean.shape if self.episodes else table["mean"].shape
        if any(values.shape != shape for values in table.values()):
            raise ValueError("another shape")
        n = count.item()
        mean = table.pop("mean")
        with np.errstate(all="ignore"):  # NaN and infinity stay what they are
            squares = table.pop("std") ** 2 * n
            if not self.episodes:
                self._mean, self._squares = np.zeros(shape), np.zeros(shape)
                self._bounds = table
            before, self._count = self._count, self._count + n
            step = mean - self._mean
            self._mean = self._mean + step * (n / self._count)
            self._squares = self._squares + squares + step**2 * (before * n / self._count)
        self._bounds = {
            k: (np.minimum if k in _LOWER else np.maximum)(known, table[k])
            for k, known in self._bounds.items()
            if k in table
        }
        self.episodes += 1

    def statistics(self) -> dict[str, list[Any]]:
        """By name, what all episodes have."""
        moments = {"mean": self._mean, "std": np.sqrt(self._squares / (self._count or 1))}
        found = {k: v.tolist() for k, v in (self._bounds | moments).items()}
        return found | {"count": [round(self._count)]}
