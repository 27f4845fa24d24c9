"""Wrong hands of this vendor's own: each has one fault, which one requirement must find.

dexkit tries its own as well: a fault that breaks a requirement which one of ours is ``like`` is put
into our reference service.
"""

# ruff: noqa: D102  (each class has one fault; its methods only override)

from __future__ import annotations

from typing import Any

from dexkit.conformance.faults import wrong_hand
from dexkit.conformance.virtual.fingers import FingerHand
from twofinger_hand.reference import TwoFingerService


@wrong_hand("TWOFINGER-JOINT-01")
class SwapsFingers(TwoFingerService):
    """Publishes the index finger's joints before the thumb's."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["values"] = motors["values"][[3, 4, 5, 0, 1, 2]]


@wrong_hand("TWOFINGER-FIELD-03")
class Degrees(TwoFingerService):
    """Publishes q in degrees."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["q"] *= 57.3
