"""SIDE-03 judges how a hand moves while the other one presses on an object."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from dexkit.conformance.faults.trials import plan_for, run_mutant
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.stimuli import phases_for
from dexkit.conformance.virtual.inspire import InspireService
from dexkit.hand import Floats, Side

SIDE_03 = next(r for r in catalogue("inspire-dfx") if r.id == "DFX-SIDE-03")


class _Supplied(InspireService.hand):
    """A hand with a part of its speed."""

    part = 1.0

    def take(self, rows: Floats, mode: Any) -> None:
        super().take(rows, mode)
        self.own = list(self.reach)

    def lead(self, dt: float) -> list[float]:
        self.reach = [self.part * speed for speed in getattr(self, "own", self.reach)]
        return super().lead(dt)


class OneSupply(InspireService):
    """Slows a hand down while the other one presses."""

    hand = _Supplied
    always, beside = 1.0, 1.0

    def live(self, dt: float) -> None:
        for side, hand in self.hands.items():
            assert isinstance(hand, _Supplied)
            others = [h for s, h in self.hands.items() if s is not side and h.touches]
            pressed = any(abs(x) > 0.005 for h in others for x in h.contact)
            hand.part = self.always * (self.beside if pressed else 1.0)
        super().live(dt)


def judged(always: float, beside: float) -> dict[Side, Result]:
    """The results of DFX-SIDE-03 in a run with its phases alone."""
    made = type("Made", (OneSupply,), {"always": always, "beside": beside})
    plan = replace(plan_for("inspire_dfx"), phases=phases_for([SIDE_03]))
    found = run_mutant(made, plan, [SIDE_03]).results
    return {Side(r.side): r for r in found if r.requirement.id == SIDE_03.id}


@pytest.mark.parametrize(
    ("always", "beside", "verdict"),
    [
        (1.0, 1.0, Verdict.PASS),
        (0.3, 1.0, Verdict.PASS),
        (1.0, 0.8, Verdict.PASS),
        (1.0, 0.125, Verdict.FAIL),
        (0.5, 0.4, Verdict.FAIL),
    ],
)
def test_a_hand_is_compared_with_itself(always: float, beside: float, verdict: Verdict) -> None:
    found = judged(always, beside)
    assert found[Side.LEFT].verdict is verdict, found[Side.LEFT].observed
    assert found[Side.RIGHT].verdict is Verdict.NOT_APPLICABLE  # it holds the object


def test_without_an_object_there_is_nothing_to_judge() -> None:
    plan = replace(plan_for("inspire_dfx"), objects={}, phases=phases_for([SIDE_03]))
    found = run_mutant(InspireService, plan, [SIDE_03]).results
    assert all(r.verdict is Verdict.NOT_APPLICABLE for r in found if r.requirement == SIDE_03)
