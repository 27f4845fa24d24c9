"""Sum up lateness in an interval: of the kit's timer, or of a hand's processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexkit.conformance.kit.sums import mean, total
from dexkit.hand import Floats

__all__ = ["IDLE", "Lateness"]

IDLE = 1e-3
"""Seconds by which timers are late on an idle machine."""


@dataclass(frozen=True)
class Lateness:
    """Lateness of the kit's timer in an interval, beyond that on an idle machine.

    :param total: all of it, seconds: what one thing that happened then may have waited.
    :param mean: of each time, seconds: what a thing that happens again and again waited.
    :param p99: 99th percentile, seconds: what one in a hundred waited.
    """

    total: float
    mean: float
    p99: float

    def figure(self, how: str) -> float:
        """The figure for a delay of that kind; see :class:`~dexkit.conformance.checks.Late`."""
        figures = {"total": self.total, "mean": self.mean, "p99": self.p99}
        return figures[how]

    @classmethod
    def beyond_idle(cls, late: Floats) -> Lateness | None:
        """Of these times of lateness, seconds, each beyond :data:`IDLE`; None if there are none."""
        if not len(late):
            return None
        beyond = np.maximum(late - IDLE, 0.0)
        return cls(total(beyond), mean(beyond), float(np.percentile(beyond, 99)))
