"""How the kit judges the Dex3-1 hand, on DDS and on USB."""

from __future__ import annotations

from dexkit import models
from dexkit.conformance.hands.record import JointRoles, ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy

__all__ = ["DEX3_1"]

DEX3_1 = ModelUnderTest(
    model=models.DEX3_1,
    prefixes={"DEX3": "dds", "DEX3USB": "usb"},
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("dexkit.conformance.virtual.fingers:Dex3Service"),
    quick_phases=("burst", "joint", "late-joiner", "single"),
    roles=JointRoles(driven=(3, 4), slow=(5, 6), crossed=(4, 6)),
    # nearly as far as the session closes
    objects={Side.RIGHT: 60.0},
    session="dex3_pinch",
)
