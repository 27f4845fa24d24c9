"""Measured figures with a limit, and how far the kit's own error bears on the verdict.

A check says what it measured as one or more :class:`Measure`; :func:`weigh` adds the kit's error
for that kind of figure, at that place of that recording:

=========== =======================================================================================
time        the 99th percentile by which the kit's own timer was late there, or the receive delay
            that it measured against itself at the start of the run, whichever is larger; 0 on the
            virtual clock; unknown in a recording of somebody else
position,   the resolution of the message: the step of a 32-bit float of that size
torque
=========== =======================================================================================

Of several places, the one that the error explains least decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

import numpy as np

__all__ = ["Clocked", "Measure", "Quantity", "weigh"]

_FAR = 1e3
"""Margin, in errors, from which on nobody needs to know how many they are."""
BEFORE = 1.0
"""Seconds before a place without an end that are looked at, too."""


class Quantity(str, Enum):
    """The kind of a measured figure: which error the kit makes with it."""

    TIME = "time"
    POSITION = "position"
    TORQUE = "torque"

    def __str__(self) -> str:
        return self.value


class Clocked(Protocol):
    """A recording that knows how well its times were measured."""

    def time_error(self, begin: float, end: float) -> float | None:
        """The kit's error of a time in [begin, end], seconds; None if it is not known."""
        ...


@dataclass(frozen=True)
class Measure:
    """A measured figure and its limit.

    :param value: in ``unit``, as ``limit`` and ``error``.
    :param larger_is_worse: False where the limit is the least that is asked for.
    :param error: of the kit, not negative; None if it is not known.
    :param per_second: by how much ``value`` is wrong where a time of it is wrong by a second: 1
        for a duration, other than that for a rate.
    :param span: begin and end of the place, seconds; None for the outcome's first place.
    """

    value: float
    limit: float
    unit: str = "s"
    quantity: Quantity = Quantity.TIME
    larger_is_worse: bool = True
    error: float | None = None
    per_second: float = 1.0
    span: tuple[float, float] | None = None

    @property
    def margin(self) -> float:
        """Distance to the limit, positive on the side that passes."""
        return self.limit - self.value if self.larger_is_worse else self.value - self.limit

    @property
    def margin_in_errors(self) -> float | None:
        """The margin in units of the kit's error; None where that is 0 or not known."""
        return self.margin / self.error if self.error else None

    @property
    def explains_failure(self) -> bool:
        """Whether the kit's error alone may have put the figure on the side that fails."""
        return self.uncertain and self.margin <= 0

    @property
    def uncertain(self) -> bool:
        """Whether the figure is nearer to its limit than the kit can measure."""
        return self.error is not None and abs(self.margin) < self.error

    def sentence(self) -> str:
        """The figure, its limit and the kit's error in one sentence."""
        text = (
            f"{self.value:.6g} {self.unit} with a limit of {self.limit:.6g} {self.unit}: "
            f"margin {self.margin:+.3g} {self.unit}"
        )
        if self.error is None:
            return f"{text}; the kit's measurement error is not known here"
        if not self.error:
            return f"{text}; the kit's measurement error is 0 here"
        if self.uncertain:
            how = "passes" if self.margin >= 0 else "fails"
            return (
                f"{text}; {how} by less than the kit's measurement error of "
                f"{self.error:.3g} {self.unit}"
            )
        if abs(self.margin) > _FAR * self.error:
            return f"{text}; the kit's measurement error is {self.error:.3g} {self.unit}"
        return (
            f"{text}, {self.margin_in_errors:+.3g} times the kit's measurement error of "
            f"{self.error:.3g} {self.unit}"
        )


def weigh(
    recording: Clocked,
    measures: Sequence[Measure],
    places: Sequence[tuple[float, float | None]],
    whole: tuple[float, float],
) -> Measure | None:
    """The measure that decides, with the kit's error; None if one has no end or there is none.

    :param places: begin and end of the outcome's places, seconds.
    :param whole: begin and end of the recording, for measures without a place.
    """
    if not all(math.isfinite(m.value) and math.isfinite(m.limit) for m in measures):
        return None  # what never came is no matter of precision
    found = [
        # of Python's own numbers: a check's may be NumPy's
        replace(
            m,
            value=float(m.value),
            limit=float(m.limit),
            error=_error(recording, m, places, whole),
        )
        for m in measures
    ]
    return min(found, key=_hardest, default=None)


def _hardest(measure: Measure) -> tuple[float, float]:
    """The order of measures: the smallest margin in errors first, or without errors as it is."""
    part = measure.margin_in_errors
    if part is None:
        part = math.copysign(math.inf, measure.margin)
    return part, measure.margin


def _error(
    recording: Clocked,
    measure: Measure,
    places: Sequence[tuple[float, float | None]],
    whole: tuple[float, float],
) -> float | None:
    if measure.quantity is not Quantity.TIME:
        return float(np.spacing(np.float32(max(abs(measure.value), abs(measure.limit)))))
    begin, end = whole
    if measure.span is not None:
        begin, end = measure.span
    elif places:
        first, last = places[0]
        begin, end = (first, last) if last is not None else (first - BEFORE, first)
    seconds = recording.time_error(begin, end)
    if seconds is None:  # no beat fell into a short place
        seconds = recording.time_error(*whole)
    return None if seconds is None else float(seconds * abs(measure.per_second))
