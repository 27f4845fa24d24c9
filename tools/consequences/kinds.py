"""The kinds of consequences: what is measured of each, and from where on it counts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from tools.consequences.stage import Figure

__all__ = ["FORCE", "KINDS", "NO_END", "Consequence", "Kind", "consequences"]

NO_END = 99.0
"""What is written of a figure, and of a size, that has no end."""

FORCE = "force"
"""The unit of forces: N m, and of position servos what their model has in its place."""


@dataclass(frozen=True)
class Kind:
    """One kind of consequence.

    :param words: how it is told, with the hand's figure and the reference's.
    :param unit: of its figures; what is told in percent is measured in parts.
    :param size: how large it is, where 1 is its limit, from the hand's figure and the reference's.
    :param reason: why the limit is where it is.
    """

    name: str
    words: str
    unit: str
    size: Callable[[float, float], float]
    reason: str


def _more_by(limit: float) -> Callable[[float, float], float]:
    return lambda found, good: (found - good) / limit


def _away_by(limit: float) -> Callable[[float, float], float]:
    return lambda found, good: abs(found - good) / limit


def _ratio(most: float, least: float) -> Callable[[float, float], float]:
    """How many times as much, or as little."""

    def size(found: float, good: float) -> float:
        if good < 0.01:
            return 0.0
        return max(found / good / most, least * good / max(found, 1e-6))

    return size


KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "starts",
            "a client gets no state or does not start",
            "s",
            lambda found, good: found / 5.0,
            "An operator takes a program that has done nothing for 5 s for dead; xr_teleoperate "
            "itself waits for ever.",
        ),
        Kind(
            "ends",
            "a move ends at {found} instead of {good}",
            "% of its range",
            _away_by(0.05),
            "Three times the place at which xr_teleoperate's own filter leaves a Dex1-1 (half a "
            "lead of 0.18 rad), and as much as its jaws open for a finger of 5 mm.",
        ),
        Kind(
            "lags",
            "a move takes {found} instead of {good}",
            "s",
            lambda found, good: found / (2.0 * good + 0.1),
            "Twice as long as the original is plainly another hand to an operator; a tenth of a "
            "second on top of that is what nobody notices.",
        ),
        Kind(
            "misses",
            "{found} is made instead of {good}",
            "% of the move",
            lambda found, good: 0.5 * good / max(found, 1e-6) if good > 0.3 else 0.0,
            "A hand that makes less than half of a move that the original makes in this time has "
            "not made it.",
        ),
        Kind(
            "presses",
            "an object is pressed with {found} instead of {good}",
            FORCE,
            _ratio(2.5, 0.5),
            "Clients set no force, but a lead or a depth, and the stiffness of vendors differs by "
            "two; from 2.5 times on, or below half, an object is crushed or is not held.",
        ),
        Kind(
            "drops",
            "a grip falls to {found} instead of {good}, and the object is dropped",
            FORCE,
            lambda found, good: 0.5 * good / max(found, 1e-6) if good > 0.01 else 0.0,
            "Grips are made with about twice the force at which an object slips.",
        ),
        Kind(
            "lets go",
            "{found} holds the object when its client has gone, instead of {good}",
            "% of the grip",
            lambda found, good: 0.4 * good / max(found, 1e-6) if good > 0.4 else 0.0,
            "Where the original holds an object on when its client has gone, it must not fall.",
        ),
        Kind(
            "moves",
            "a joint moves by {found} against what was commanded, instead of {good}",
            "% of its range",
            _more_by(0.05),
            "As far as where a hand ends: what is seen from outside, and opens a light grip.",
        ),
        Kind(
            "reads",
            "a client reads what is {found} away from all that was true",
            "% of its range",
            _more_by(0.05),
            "One frame of a data set that is so far from anything that was true within the last "
            "0.1 s is an outlier; and a Dex1-1's next command is made of it.",
        ),
        Kind(
            "touch",
            "an element of touch reads {found} instead of {good}",
            "% of what a grip adds",
            _away_by(0.5),
            "Half of what a grip makes the elements read decides whether something is held.",
        ),
        Kind(
            "left moving",
            "a joint moves by {found} when its client has gone, instead of {good}",
            "% of its range",
            _more_by(0.05),
            "As far as where a hand ends: nobody watches a hand whose client has been stopped.",
        ),
        Kind(
            "left pressing",
            "{found} is pressed on when its client has gone, instead of {good}",
            "% of the grip",
            _more_by(0.3),
            "A third of a grip hurts, and heats a motor that nobody watches.",
        ),
    )
}


class Consequence(NamedTuple):
    """The worst consequence of one kind."""

    kind: str
    client: str
    task: str
    side: str
    joint: int
    found: float
    good: float
    size: float


def consequences(
    found: Mapping[Figure, float], good: Mapping[Figure, float]
) -> dict[str, Consequence]:
    """The worst of each kind, of those beyond its limit.

    :param found: the figures of a hand.
    :param good: those of the reference; what it has not is not compared.
    """
    worst: dict[str, Consequence] = {}
    for figure, reference in good.items():
        value = found.get(figure, math.nan)
        if math.isnan(value) or not math.isfinite(reference):
            continue  # nobody can say
        size = min(KINDS[figure.kind].size(value, reference), NO_END)
        if size <= 1.0:
            continue
        before = worst.get(figure.kind)
        if before is None or size > before.size:
            worst[figure.kind] = Consequence(*figure, min(value, NO_END), reference, size)
    return worst
