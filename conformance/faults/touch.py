"""Wrong hands with a topic for their tactile areas."""

from __future__ import annotations

from collections.abc import Mapping

from dexkit.conformance.faults.registry import BOTH, wrong_hand
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import FingerHand
from dexkit.conformance.virtual.inspire import FtpService
from dexkit.hand import Floats, Side
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


@wrong_hand("FTP-TOUCH-01", brief=True)
class SpellsSideOut(FtpService):
    """Publishes touch on a topic that ends with the side in full."""

    def touch_topic(self, side: Side) -> str:
        return f"rt/inspire_hand/touch/{side}"


@wrong_hand("FTP-TOUCH-02", brief=True)
class NoPalm(FtpService):
    """Leaves the list of the palm empty."""

    touch_lengths: Mapping[str, int] = {**FtpService.touch_lengths, "palm_touch": 0}


@wrong_hand("FTP-TOUCH-03", brief=True)
class TouchPauses(FtpService):
    """Publishes no touch for half a second once, and states all the time."""

    def touch(self) -> list[Sample]:
        return [] if 2.0 < self.now < 2.5 else super().touch()


@wrong_hand("FTP-TOUCH-04", brief=True)
class RareTouch(FtpService):
    """Publishes touch ten times a second."""

    touch_period = 0.1


@wrong_hand("FTP-SENS-04", sides=BOTH)
class CountsFromTheThumb(FtpService):
    """Publishes the areas of the fingers in the opposite order, the thumb's first."""

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        pressure[_TOPS] = pressure[_TOPS[::-1]]
        return pressure


@wrong_hand("FTP-TOUCH-06", sides=BOTH)
class CountsWithoutTouch(FtpService):
    """Publishes areas that have 400 counts too many: they were set to zero under a load."""

    def pressures(self, hand: FingerHand) -> Floats:
        return super().pressures(hand) + 400.0
