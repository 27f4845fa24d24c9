"""Simulated hands for tests of programs, not of motion.

50 exchanges a second instead of 1000 take a fraction of the processor time.
"""

from __future__ import annotations

from dexkit.emulators.sim_dex1 import SimHand
from dexkit.emulators.sim_dex3 import SimDex3
from dexkit.hand import HandSpec, Side
from dexkit.models import DEX1_1, DEX3_1

__all__ = ["SLOW", "SLOW_DEX3", "SlowDex3", "SlowHand"]

SLOW = ("tests.slow_hand:SlowHand", "--state-rate", "50")
"""What ``dexkit serve`` is given for a Dex1-1."""
SLOW_DEX3 = ("tests.slow_hand:SlowDex3", "--state-rate", "50")
"""What it is given for a Dex3-1."""


class SlowHand(SimHand):
    """The simulated gripper at 50 Hz."""

    def __init__(self, side: Side) -> None:
        super().__init__(side)
        self._slow = DEX1_1.spec(side, io_rate=50.0, simulated=True)

    @property
    def spec(self) -> HandSpec:
        return self._slow


class SlowDex3(SimDex3):
    """The simulated hand at 50 Hz."""

    def __init__(self, side: Side) -> None:
        super().__init__(side)
        self._slow = DEX3_1.spec(side, io_rate=50.0, simulated=True)

    @property
    def spec(self) -> HandSpec:
        return self._slow
