"""How dexkit's conformance kit judges the hand."""

from __future__ import annotations

from pathlib import Path

from dexkit.conformance.hands import JointRoles, ModelUnderTest
from dexkit.hand import Side
from dexkit.lazy import Lazy
from twofinger_hand.profile import TWOFINGER_1

__all__ = ["UNDER_TEST"]

UNDER_TEST = ModelUnderTest(
    model=TWOFINGER_1,
    requirements=(Path(__file__).with_name("requirements.toml"),),
    script=Lazy("dexkit.conformance.stimuli.fingers:FingerScript"),
    reference=Lazy("twofinger_hand.reference:TwoFingerService"),
    quick_phases=("burst", "joint", "late-joiner", "single"),
    roles=JointRoles(driven=(0, 1), slow=(3, 4)),
    objects={Side.RIGHT: 60.0},
    wrong_hands=Lazy("twofinger_hand.wrong"),
)
