"""Test the likely causes that checks determine from measured values."""

from __future__ import annotations

import pytest

from dexkit.conformance.faults import mutants, run_mutant
from dexkit.conformance.faults.trials import topic_plan
from dexkit.conformance.kit.results import Verdict


@pytest.mark.parametrize(
    ("mutant", "requirement", "expected"),
    [
        ("OtherStateType", "DEX1-TOPIC-01", "is the type of another hand"),
        ("Percent", "DEX1-FIELD-03", "percent"),
        ("Degrees", "DEX1-FIELD-03", "degrees"),
        ("Inverted", "DEX1-MOVE-02", "mirrored"),
        ("Frozen", "DEX1-MOVE-02", "Nothing moves at all"),
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
