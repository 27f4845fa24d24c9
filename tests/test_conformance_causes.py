"""Test the likely causes that checks determine from measured values."""

from __future__ import annotations

import numpy as np
import pytest

from dexkit.conformance.checks.causes import of_positions, of_scale, of_type
from dexkit.conformance.faults import mutants, run_mutant
from dexkit.conformance.faults.trials import topic_plan
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.kit.results import Verdict
from dexkit.hand import Side
from dexkit.models import dialect
from tests.each import each

GRIPPER = joints_of(dialect("unitree_go"), Side.LEFT)
LEFT, RIGHT = (joints_of(dialect("dex3"), side) for side in Side)


@each(
    ("q", "expected"),
    [
        ([0.0, 98.0], "percent"),
        ([0.0, 309.0], "degrees"),
        ([-5.4, 0.0], "sign of q is wrong"),
        ([0.0, 65535.0], "counts"),
        ([0.0, 7.0], ""),
        ([np.nan], ""),
    ],
)
def test_cause_names_unit_of_gripper_positions(q: list[float], expected: str) -> None:
    found = of_positions(np.array(q)[:, None], GRIPPER, GRIPPER)
    assert (expected in found) if expected else not found


def test_cause_names_signs_of_other_side() -> None:
    ends = np.array([[j.q_min for j in RIGHT], [j.q_max for j in RIGHT]])
    assert "other side's positions" in of_positions(ends, LEFT, RIGHT)
    assert of_positions(np.full((3, 7), 2.9), LEFT, RIGHT) == ""


@each(
    ("reached", "expected"),
    [
        ([4.86, 0.54, 2.7], "mirrored"),
        ([0.1, 0.9, 0.5], "0 to 1"),
        ([10.0, 90.0, 50.0], "percent"),
        ([0.54, 4.86, 2.7], ""),
        ([0.54, 3.0, 2.7], ""),
    ],
)
def test_cause_names_scale_from_steps(reached: list[float], expected: str) -> None:
    targets = np.array([0.54, 4.86, 2.7])
    found = of_scale(targets, np.array(reached), 5.4)
    assert (expected in found) if expected else not found


def test_cause_names_types_of_another_hand() -> None:
    go, dex3 = dialect("unitree_go"), dialect("dex3")
    assert "swapped" in of_type({go.cmd_type}, go.state_type, go)
    assert "--dialect unitree_hg or dex3" in of_type({dex3.state_type}, go.state_type, go)
    assert "another package" in of_type({"my::MotorStates_"}, go.state_type, go)
    assert of_type({"std_msgs::String_"}, go.state_type, go) == ""


@pytest.mark.parametrize(
    ("mutant", "requirement", "expected"),
    [
        ("OtherStateType", "DEX1-TOPIC-01", "is the type of another hand"),
        ("Percent", "DEX1-FIELD-03", "percent"),
        ("Inverted", "DEX1-MOVE-01", "mirrored"),
        ("Frozen", "DEX1-MOVE-01", "Nothing moves at all"),
    ],
)
def test_cause_names_mistake_of_wrong_hand(mutant: str, requirement: str, expected: str) -> None:
    wrong = next(m for m in mutants() if m.name == mutant and m.kills == requirement)
    result = run_mutant(wrong.made, topic_plan(wrong, short=True))
    found = next(
        r for r in result.results if (r.requirement.id, r.verdict) == (requirement, Verdict.FAIL)
    )
    assert expected in found.cause
    assert f"cause:    {found.cause}" in found.explain()
