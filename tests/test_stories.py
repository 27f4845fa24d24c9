"""Test that the first story of a run names the fault, and that what follows is listed under it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dexkit.conformance.checks import check_of
from dexkit.conformance.faults import mutants, run_mutant
from dexkit.conformance.faults.trials import plan_for, topic_plan
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit import stories
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import RunResult, Verdict
from dexkit.conformance.report.card import cards
from dexkit.models import MODELS, model
from dexkit.robots import ROBOTS

slow = pytest.mark.slow
Change = Callable[[Any, Any], None]
"""Changes the state that a service publishes, in place."""


def first_of(change: Change, name: str = "dex1-1") -> RunResult:
    """The result of a reference hand whose states are changed."""

    class Changed(under_test(name).reference.load()):  # type: ignore[misc]
        def fields(self, side: Any) -> Any:
            found = super().fields(side)
            change(self, found)
            return found

        def fill(self, motors: Any, hand: Any) -> None:
            super().fill(motors, hand)
            change(self, motors)

        def live(self, dt: float) -> None:
            super().live(dt)
            if name != "dex1-1":
                for hand in self.hands.values():
                    hand.changed()

    return run_mutant(Changed, plan_for(model(name).dialects[0].name))


def zeros(service: Any, state: Any) -> None:
    """All zero for 12 ms every 3 s."""
    if service.now % 3.0 < 0.012:
        for member in ("q", "dq", "tau_est"):
            state[member] = state[member] * 0.0


def elsewhere(service: Any, state: Any) -> None:
    """Another position for two states every 2 s."""
    if service.now % 2.0 < 0.004:
        state["q"] = state["q"] * 0.0 + 0.3


def turned(service: Any, state: Any) -> None:
    """The velocity with the wrong sign."""
    state["dq"] = -state["dq"]


def degrees(service: Any, state: Any) -> None:
    """The velocity in degrees per second."""
    state["dq"] = 57.3 * state["dq"]


@pytest.mark.parametrize(
    ("change", "name", "words"),
    [
        (zeros, "dex1-1", "q, dq and tau_est are exactly 0 in"),
        pytest.param(
            zeros, "dex3-1", "q, dq and tau_est of all joints are exactly 0 in", marks=slow
        ),
        (elsewhere, "dex1-1", "q jumps away and back"),
        (turned, "dex1-1", "dq is -1 times the slope of q"),
        pytest.param(degrees, "dex1-1", "times the slope of q", marks=slow),
    ],
)
def test_faults_of_states_come_first(change: Change, name: str, words: str) -> None:
    result = first_of(change, name)
    failed = {r.id for r in result.results if r.verdict in (Verdict.FAIL, Verdict.WARN)}
    first = result.stories[0]
    assert words in first.sentence
    assert first.shown_by == ""
    assert set(first.explains) == failed
    assert not cards(result, [Verdict.FAIL, Verdict.WARN])  # one bug, one story


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("dex1-1 SwappedWhenRestarted", "while only the left hand was commanded"),
        ("dex1-1 IgnoresGains", "with kp = kd = 0"),
        pytest.param("dex1-1 NoWatchdog", "after the last command", marks=slow),
        ("dex1-1 FedByRejected", "while rejected ones arrive"),
        pytest.param("dex1-1 MilliNewtonMetres", "2000.00 N m", marks=slow),
        pytest.param("dex1-1 TurnedTorque", "against a commanded torque", marks=slow),
        pytest.param("dex1-1 StaleState", "a new value every 20", marks=slow),
        ("dex1-1 ShiftsForAWhile", "q jumps away and back"),
        pytest.param("dex1-1 Hiccup", "a gap from 1.998 s to 2.30", marks=slow),
        ("dex3-1 IgnoresStatus", "with status 0, which locks the motor"),
        pytest.param("dex3-1 SlowToLeave", "it began to move only after", marks=slow),
        pytest.param(
            "brainco-revo2 DeafAfterFar", "right after the phase 'out-of-range'", marks=slow
        ),
    ],
)
def test_first_story_names_the_fault(name: str, words: str) -> None:
    mutant = next(m for m in mutants() if m.layer == "dds" and f"{m.model} {m.name}" == name)
    result = run_mutant(mutant.made, topic_plan(mutant))
    assert words in result.stories[0].sentence
    failed = {r.id for r in result.results if r.verdict in (Verdict.FAIL, Verdict.WARN)}
    told = [name for story in result.stories for name in story.explains]
    assert sorted(told) == sorted(failed)  # each once


def test_good_hand_has_no_story() -> None:
    result = run_mutant(under_test("dex1-1").reference.load(), plan_for(sides=None))
    assert not result.stories


def test_names_of_checks_are_right() -> None:
    known = set()
    for name in [*MODELS, *ROBOTS]:
        for requirement in catalogue(name, None):
            check = check_of(requirement)
            behaviour = check.__module__.rpartition(".")[2]
            known |= {behaviour, f"{behaviour}.{check.__name__}"}
    assert {*stories.ORDER, *stories.FAMILIES} <= known
