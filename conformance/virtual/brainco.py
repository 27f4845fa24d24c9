"""A BrainCo Revo2 that meets every requirement."""

from __future__ import annotations

from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.models import BRAINCO_REVO2

__all__ = ["BrainCoService"]


class BrainCoHand(ServoHand):
    """Six joints; dq of a command limits the speed (docs/sources/unitree-dex.md#j1)."""

    model = BRAINCO_REVO2


class BrainCoService(ServoService):
    """Revo2 hands on their topics."""

    hand = BrainCoHand
