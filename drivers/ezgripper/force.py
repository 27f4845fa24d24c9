"""Estimate grip force from motor current with a calibrated table.

The table maps Present Current (absolute value, units of 3.36 mA) to grip force, by linear
interpolation; beyond its last point it goes on with the slope of the last two. The state's
``tau_est`` is the force divided by ten (docs/sources/mx64-ezgripper.md#d8-4), as in the interface
specification.

Present Current of an MX-64 is a noisy estimate (docs/sources/mx64-ezgripper.md#d10-11), so no
decision of the driver uses it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

from dexkit.errors import UsageError

__all__ = ["DEFAULT_FORCE_TABLE", "TAU_PER_FORCE", "ForceTable"]

TAU_PER_FORCE = 0.1
"""tau_est of one unit of force (docs/sources/mx64-ezgripper.md#d8-4)."""


@dataclass(frozen=True)
class ForceTable:
    """Grip force over motor current: points of rising current.

    :param points: (current units, force), current rising strictly, force never falling.
    :raises UsageError: the points do not fulfil this.
    """

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if not self.points:
            raise UsageError("a force table needs at least one point")
        previous = (-math.inf, 0.0)
        for current, force in self.points:
            if not (math.isfinite(current) and math.isfinite(force)):
                raise UsageError(f"force table: {current}: {force} is not finite")
            if current < 0 or force < 0:
                raise UsageError(f"force table: {current}: {force} is negative")
            if current <= previous[0]:
                raise UsageError(f"force table: current {current} appears twice or out of order")
            if force < previous[1]:
                raise UsageError(
                    f"force table: force falls from {previous[1]} to {force} at {current}"
                )
            previous = (current, force)

    @classmethod
    def from_mapping(cls, table: Mapping[str, object]) -> ForceTable:
        """Build a table from its JSON form (docs/sources/mx64-ezgripper.md#d8-5):
        ``{"0": 0.0, "100": 0.5, ...}``.

        :raises UsageError: keys or values are not numbers, or not a valid table.
        """
        points = []
        for key, value in table.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise UsageError(f"force table: {key}: {value!r} is not a number")
            try:
                points.append((float(key), float(value)))
            except ValueError:
                raise UsageError(f"force table: current {key!r} is not a number") from None
        return cls(tuple(sorted(points)))

    def to_mapping(self) -> dict[str, float]:
        """Return the table in the JSON form of :meth:`from_mapping`."""
        return {f"{current:g}": force for current, force in self.points}

    def covers(self, current: float) -> bool:
        """Whether ``current`` units lie within the table, so that no force is extrapolated."""
        return abs(current) <= self.points[-1][0]

    def force(self, current: float) -> float:
        """Return the force at ``current`` units; the sign of the current has no effect.

        Beyond the last point the force goes on rising as between the last two; a table of one
        point has one force.
        """
        current = abs(current)
        index = bisect_right(self.points, current, key=lambda p: p[0])
        if index == 0:
            return self.points[0][1]
        if len(self.points) == 1:
            return self.points[0][1]
        index = min(index, len(self.points) - 1)
        (c0, f0), (c1, f1) = self.points[index - 1], self.points[index]
        return f0 + (f1 - f0) * (current - c0) / (c1 - c0)

    def tau(self, current: float) -> float:
        """Return the magnitude of ``tau_est`` at ``current`` units (force / 10)."""
        return self.force(current) * TAU_PER_FORCE


DEFAULT_FORCE_TABLE = ForceTable(
    ((0.0, 0.0), (100.0, 0.5), (200.0, 1.2), (300.0, 2.0), (1023.0, 10.0))
)
"""The example of docs/sources/mx64-ezgripper.md#d8-4, for grippers without a calibrated table."""
