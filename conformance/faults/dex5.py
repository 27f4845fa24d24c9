"""Wrong hands that only the Dex5-1 can be.

The faults that it shares with the Dex3-1 are applied to it without a line here, because its
requirements are ``like`` that hand's.
"""

from __future__ import annotations

from typing import Any

from dexkit.conformance.faults import fingers
from dexkit.conformance.faults.registry import BOTH, Call, Motors, changes, reports, wrong_hand
from dexkit.conformance.virtual.dex5 import Dex5Hand
from dexkit.conformance.virtual.fingers import FingerHand, FingerService, Flags, Ints
from dexkit.hand import Floats, Side


@changes(FingerService, "motors", "DEX5-JOINT-01")
def ThumbFirst(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys commands thumb first, as the URDF numbers the fingers."""
    command(side, (*motors[4:], *motors[:4]))


@changes(FingerHand, "understood", "DEX5-MODE-01")
def DecodesRis(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Decodes the mode byte as a Dex3-1's: 1 is id 1 with status 0, which locks."""
    return (mode >> 4) & 7, mode >= 0x80


@wrong_hand("DEX5-WDOG-01")
class IndexGoesHome(fingers.GoesHome):
    """Sends its first joint to one end after the time-out, whatever was commanded."""


@reports(FingerService, "DEX5-FORCE-02", sides=BOTH)
def ThumbInTheFingersUnit(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes the torques of the thumb in mN m, as those of the fingers."""
    motors["tau_est"][16:] *= 1e3


@wrong_hand("DEX5-FORCE-06", sides=BOTH, whole=True)
class GripFades(fingers.NeverRests, Dex5Hand):
    """Presses with a third of the torque after 0.9 s of contact: a limit of the mean current."""

    pressed = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        touches = self.touches and any(abs(c) > 0.005 for c in self.contact)
        self.pressed += dt if touches else 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        self.pressed = 0.0
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, [0.3 * p for p in pull] if self.pressed > 0.9 else pull)


@changes(Dex5Hand, "move", "DEX5-FORCE-05", sides=BOTH)
def SoftThumb(hand: Any, move: Call, dt: float, pull: list[float]) -> None:
    """Moves and presses with less than half of the torque in all joints of the thumb."""
    move(dt, [0.43 * p if i >= 16 else p for i, p in enumerate(pull)])


@changes(Dex5Hand, "move", "DEX5-FORCE-05", sides=BOTH)
def WeakThumb(hand: Any, move: Call, dt: float, pull: list[float]) -> None:
    """Moves and presses with three tenths of the torque in all joints of the thumb."""
    move(dt, [0.3 * p if i >= 16 else p for i, p in enumerate(pull)])


@wrong_hand("DEX5-FORCE-05", sides=BOTH)
class LittleFingerBoosts(fingers.Boosts, Dex5Hand):
    """Its little finger presses with two and a half times the torque where it is blocked."""

    joints = (13, 14, 15)


@wrong_hand("DEX5-FORCE-05", sides=BOTH)
class RingFingerGivesIn(fingers.OtherInContact, Dex5Hand):
    """Its ring finger presses with a third of the torque where it is blocked."""

    joints = (9, 10, 11)
    factor = 0.35
