"""How the kit judges the BrainCo Revo2 hand."""

from __future__ import annotations

from dexkit import models
from dexkit.conformance.hands.record import JointRoles, ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy

__all__ = ["BRAINCO_REVO2"]

BRAINCO_REVO2 = ModelUnderTest(
    model=models.BRAINCO_REVO2,
    prefixes={"BRAINCO": "dds"},
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("dexkit.conformance.virtual.brainco:BrainCoService"),
    quick_phases=("burst", "empty", "joint", "late-joiner", "speeds"),
    roles=JointRoles(driven=(), slow=(0, 3)),
    objects={Side.RIGHT: 60.0},
)
