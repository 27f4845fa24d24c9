"""How the kit judges the Dex5-1 hand."""

from __future__ import annotations

from dexkit import models
from dexkit.conformance.hands.record import JointRoles, ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy

__all__ = ["DEX5_1"]

DEX5_1 = ModelUnderTest(
    model=models.DEX5_1,
    prefixes={"DEX5": "dds"},
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("dexkit.conformance.virtual.dex5:Dex5Service"),
    quick_phases=("joint", "late-joiner"),
    # first flexing joints of four fingers: none of them shares its motor
    roles=JointRoles(driven=(1, 5), slow=(9, 13)),
    # nearly as far as the session closes
    objects={Side.RIGHT: 60.0},
    session="dex5_synthetic",
)
