"""The reference service: a two-finger hand on a virtual clock that meets every requirement.

It proves that the requirements can be met, and every wrong hand is a change of it.
"""

from __future__ import annotations

import numpy as np

from dexkit.conformance.virtual.fingers import FingerHand, FingerService, Flags, Ints
from dexkit.hand import JointMode
from twofinger_hand.profile import TWOFINGER_1

__all__ = ["TwoFingerService"]


class TwoFingerHand(FingerHand):
    """Six joints; mode byte 1 drives one."""

    model = TWOFINGER_1
    inertia = 0.001  # kg m²
    viscous = 0.002  # N m s/rad
    coulomb = 0.005  # N m
    brake = 0.2  # N m s/rad
    stiffness = 60.0  # N m/rad

    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        """Only 1 drives; there is no time-out bit."""
        return np.where(mode == JointMode.FOC, mode, 0), np.zeros_like(self.tripped)

    def mode_bytes(self) -> Ints:
        """The mode byte of a state: 1 where a joint is driven."""
        return np.asarray(self.driven, dtype=np.intp)

    def expire(self) -> None:
        """All joints brake when the commands have stopped."""
        super().expire()
        self.status = np.zeros_like(self.status)


class TwoFingerService(FingerService):
    """Such hands on their topics."""

    hand = TwoFingerHand
