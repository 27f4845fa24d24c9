"""How the kit judges the robots' low-level topics."""

from __future__ import annotations

from typing import Any

from dexkit import robots
from dexkit.conformance.hands.record import ModelUnderTest
from dexkit.lazy import Lazy

__all__ = ["G1", "H1"]

_SCRIPT: Lazy[type[Any]] = Lazy("dexkit.conformance.stimuli.robot:RobotScript")
_REFERENCE: Lazy[type[Any]] = Lazy("dexkit.conformance.virtual.robot:ReferenceRobot")
_QUICK_PHASES = ("joint", "late-joiner")

H1 = ModelUnderTest(
    model=robots.H1,
    prefixes={"H1": "robot"},
    script=_SCRIPT,
    reference=_REFERENCE,
    quick_phases=_QUICK_PHASES,
)
G1 = ModelUnderTest(
    model=robots.G1,
    prefixes={"G1": "robot"},
    script=_SCRIPT,
    reference=_REFERENCE,
    quick_phases=_QUICK_PHASES,
)
