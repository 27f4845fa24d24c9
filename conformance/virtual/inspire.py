"""Inspire's DFX and FTP hands that meet every requirement."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexkit.conformance.virtual.fingers import GO_MOTOR, FingerHand
from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.hand import Side
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP

__all__ = ["FtpService", "InspireService"]


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


class FtpHand(InspireHand):
    """The same joints, whose forces are measured, too."""

    model = INSPIRE_FTP


class FtpService(ServoService):
    """Each hand on topics of its own, in lists of integers."""

    hand = FtpHand

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of a hand on the wire."""
        (side,) = sides
        count = self.dialect.length if length is None else length
        key = (self.hands[side].version, count)
        if self._sent.get(sides, (None, b""))[0] == key:
            return self._sent[sides][1]
        motors = np.zeros(count, GO_MOTOR)
        mine = motors[: len(self.hands[side].q)]
        if len(mine):
            self.fill(mine, self.hands[side])
        self._sent[sides] = (key, self.codec.state_lists(motors))
        return self._sent[sides][1]
