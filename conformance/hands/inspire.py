"""How the kit judges Inspire's hands."""

from __future__ import annotations

from dexkit import models
from dexkit.conformance.hands.record import JointRoles, ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy

__all__ = ["INSPIRE_DFX", "INSPIRE_FTP"]

_ROLES = JointRoles(driven=(), slow=(1, 3))

INSPIRE_DFX = ModelUnderTest(
    model=models.INSPIRE_DFX,
    prefixes={"DFX": "dds"},
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("dexkit.conformance.virtual.inspire:InspireService"),
    quick_phases=("burst", "empty", "joint", "late-joiner"),
    roles=_ROLES,
    objects={Side.RIGHT: 60.0},
)

INSPIRE_FTP = ModelUnderTest(
    model=models.INSPIRE_FTP,
    prefixes={"FTP": "dds"},
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("dexkit.conformance.virtual.inspire:FtpService"),
    quick_phases=("burst", "joint", "late-joiner", "squeeze"),
    roles=_ROLES,
    objects={Side.RIGHT: 60.0},
)
