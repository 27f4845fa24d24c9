"""Inspire's DFX hands that meet every requirement."""

from __future__ import annotations

from typing import Any

from dexkit.conformance.virtual.fingers import FingerHand
from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.models import INSPIRE_DFX

__all__ = ["InspireService"]


class InspireHand(ServoHand):
    """Six joints that go to q at full speed (docs/sources/unitree-dex.md#j2)."""

    model = INSPIRE_DFX
    speed_is_used = False


class InspireService(ServoService):
    """Both hands in one message."""

    hand = InspireHand
    tick = period = 0.003

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """Fill in q, the only member that is measured."""
        motors["q"] = hand.q[: len(motors)]
