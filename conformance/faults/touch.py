"""Wrong hands with a topic for their tactile areas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dexkit.conformance.faults.registry import BOTH, Call, changes, wrong_hand
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import FingerHand
from dexkit.conformance.virtual.inspire import FtpService
from dexkit.hand import Side
from dexkit.models import INSPIRE_FTP
from dexkit.traces import TraceEndpoint

_TOPS = [i for i, area in enumerate(INSPIRE_FTP.dialects[0].areas) if area.place.endswith(" top")]


@wrong_hand("FTP-TOUCH-01", brief=True)
class NoTouch(FtpService):
    """Publishes no touch topic, as the vendor's driver on a serial line."""

    def endpoints(self) -> list[TraceEndpoint]:
        topics = {self.touch_topic(s) for s in self.sides}
        return [e for e in super().endpoints() if e.topic not in topics]

    def touch(self) -> list[Sample]:
        return []


@changes(FtpService, "touch_topic", "FTP-TOUCH-01", brief=True)
def SpellsSideOut(self: Any, touch_topic: Call, side: Side) -> str:
    """Publishes touch on a topic that ends with the side in full."""
    return f"rt/inspire_hand/touch/{side}"


@wrong_hand("FTP-TOUCH-01", brief=True)
class NoPalm(FtpService):
    """Leaves the list of the palm empty."""

    touch_lengths: Mapping[str, int] = {**FtpService.touch_lengths, "palm_touch": 0}


@changes(FtpService, "touch", "FTP-TOUCH-03", brief=True)
def TouchPauses(self: Any, touch: Call) -> Any:
    """Publishes no touch for half a second once, and states all the time."""
    return [] if 2.0 < self.now < 2.5 else touch()


@wrong_hand("FTP-TOUCH-03", brief=True)
class RareTouch(FtpService):
    """Publishes touch ten times a second."""

    touch_period = 0.1


@changes(FtpService, "pressures", "FTP-SENS-04", sides=BOTH)
def CountsFromTheThumb(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Publishes the areas of the fingers in the opposite order, the thumb's first."""
    pressure = pressures(hand)
    pressure[_TOPS] = pressure[_TOPS[::-1]]
    return pressure
