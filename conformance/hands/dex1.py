"""How the kit judges the Dex1-1 gripper."""

from __future__ import annotations

from dexkit import models
from dexkit.conformance.hands.record import ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy

__all__ = ["DEX1_1"]

DEX1_1 = ModelUnderTest(
    model=models.DEX1_1,
    prefixes={"DEX1": "dds"},
    script=Lazy("dexkit.conformance.stimuli.gripper:GripperScript"),
    reference=Lazy("dexkit.conformance.virtual.gripper:ReferenceService"),
    quick_phases=("late-joiner", "load", "soft", "squeeze", "step"),
    # 2.0 rad of opening, where the session closes on an object
    objects={Side.RIGHT: 37.0},
    session="dex1_pick_place",
)
