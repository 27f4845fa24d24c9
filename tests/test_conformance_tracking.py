"""Test that DEX1-TRACK allows for the top speed of a hand that meets DEX1-MOVE-04."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.any_model import WaitsForRest
from dexkit.conformance.faults.gripper import Slow
from dexkit.conformance.faults.registry import mix
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.hand import Side
from tests.each import each

JUDGED = ("DEX1-MOVE-04", "DEX1-TRACK-01", "DEX1-TRACK-02")


class SlowGripper(ReferenceService):
    """Moves at :attr:`top` rad/s at most, and is right in all else."""

    top: ClassVar[float]

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        for side, hand in self.hands.items():
            hand = Slow.hand(hand.stroke, hand.touch)
            hand.top = self.top  # type: ignore[attr-defined]
            self.hands[side] = hand


def verdicts(service: type[ReferenceService]) -> list[Verdict]:
    plan = plan_for("unitree_go", sides=(Side.LEFT,))
    plan = replace(plan, phases=frozenset({"step", "replay"}))
    found = {r.requirement.id: r.verdict for r in run_mutant(service, plan).results}
    return [found[name] for name in JUDGED]


@each("top", [3.1, 3.6])
def test_a_gripper_that_is_as_fast_as_required_follows_a_session(top: float) -> None:
    service = type("AsFastAsRequired", (SlowGripper,), {"top": top})
    assert verdicts(service) == [Verdict.PASS] * 3


def test_a_slow_gripper_that_waits_for_rest_does_not_follow_a_session() -> None:
    service = mix(WaitsForRest, type("AsFastAsRequired", (SlowGripper,), {"top": 3.6}))
    assert verdicts(service)[:2] == [Verdict.PASS, Verdict.FAIL]
