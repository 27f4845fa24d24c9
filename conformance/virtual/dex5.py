"""A Dex5-1 that meets every requirement."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.virtual.fingers import FingerHand, FingerService, Flags, Ints
from dexkit.hand import JointMode
from dexkit.models import DEX5_1

__all__ = ["Dex5Hand", "Dex5Service"]


class Dex5Hand(FingerHand):
    """Twenty joints; mode 1 drives them (docs/sources/unitree-dex.md#b5)."""

    model = DEX5_1
    # low inertia, for the fingers' gains
    inertia = 3e-4
    viscous = 0.012
    coulomb = 0.0005
    brake = 0.05
    stiffness = 20.0

    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        """Mode 1 drives; all joints have the same time-out protection."""
        return np.where(mode == JointMode.FOC, mode, 0), np.zeros_like(self.tripped)

    def mode_bytes(self) -> Ints:
        """1 where a joint is driven."""
        return np.asarray(self.driven, dtype=np.intp)

    def expire(self) -> None:
        """All joints brake."""
        super().expire()
        self.status = np.zeros_like(self.status)


class Dex5Service(FingerService):
    """Dex5-1 hands on their topics."""

    hand = Dex5Hand
