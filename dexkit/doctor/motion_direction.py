"""Recognise hands that move against their commands, or with each other's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["Course", "moves_against", "swapped"]

_WAY = 0.2  # of a joint's range by which it and its command must have moved to be compared
_NEAR = 0.15  # of it within which a joint is where something says


class Course(NamedTuple):
    """Position and goal of a hand at the first and the last sample: q of each joint in the
    dialect's unit.
    """

    began: Sequence[float]
    now: Sequence[float]
    asked_first: Sequence[float]
    asked: Sequence[float]


def moves_against(course: Course, ranges: Sequence[tuple[float, float]]) -> int:
    """Number of joints that moved against their commands; 0 if it is half or less of the moving
    joints.

    Such a joint stands at the position of an inverted scale, and not where it is commanded to:
    both are one place in the middle of the range, where a joint may have come from the other end.
    """
    moved = against = 0
    for began, now, first, asked, (low, high) in zip(*course, ranges, strict=True):
        way, wanted = (now - began) / (high - low), (asked - first) / (high - low)
        if abs(way) > _WAY and abs(wanted) > _WAY:
            moved += 1
            turned = abs(low + high - asked - now) < _NEAR * (high - low)
            elsewhere = abs(asked - now) > 2 * _NEAR * (high - low)
            against += way * wanted < 0 and turned and elsewhere
    return against if against > moved / 2 else 0


def swapped(left: Course, right: Course) -> bool:
    """Whether both hands moved, each to where the other one is commanded to."""
    size = max(1e-3, *(max(each) - min(each) for each in zip(*left, *right, strict=True)))

    def apart(a: Sequence[float], b: Sequence[float]) -> float:
        widest: float = max(abs(x - y) for x, y in zip(a, b, strict=True))
        return float(widest / size)

    moved = min(apart(hand.now, hand.began) for hand in (left, right)) > _WAY
    crossed = max(apart(left.now, right.asked), apart(right.now, left.asked)) < _NEAR
    own = min(apart(left.now, left.asked), apart(right.now, right.asked)) > 2 * _NEAR
    return moved and crossed and own
