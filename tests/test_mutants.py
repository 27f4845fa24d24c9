"""The kit's teeth: good hands pass, each wrong hand is caught by its requirement alone."""

from __future__ import annotations

import pytest

from dexkit.conformance.mutants import MUTANTS, REFERENCES, Mutant, plan_for, run_mutant, trial
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.results import Overall, Verdict
from dexkit.hand import Side

LEFT, BOTH = (Side.LEFT,), (Side.LEFT, Side.RIGHT)


@pytest.mark.parametrize(
    ("dialect", "sides"),
    [
        ("unitree_go", BOTH),
        ("unitree_go", LEFT),
        ("unitree_hg", BOTH),
        ("unitree_actuator", BOTH),
        ("dex3", BOTH),
        ("dex3", LEFT),
    ],
)
def test_a_good_hand_passes(dialect: str, sides: tuple[Side, ...]) -> None:
    plan = plan_for(dialect, sides=sides)
    result = run_mutant(REFERENCES[plan.dialect.model], plan)
    assert result.overall is Overall.PASS
    assert {r.verdict for r in result.results} <= {Verdict.PASS, Verdict.NOT_APPLICABLE}
    assert result.judged >= 30
    # with both hands, and an object in one, there is an occasion for everything
    if sides == BOTH and dialect in ("unitree_go", "dex3"):
        assert {r.requirement.id for r in result.results if r.verdict is Verdict.PASS} == {
            r.id for r in catalogue(plan.dialect.model)
        }


# a Dex3-1 takes about 3 s each: all of them are a soak
CASES = [
    pytest.param(
        m, id=f"{m.model}-{m.name}", marks=[pytest.mark.soak] if m.model == "dex3-1" else []
    )
    for m in MUTANTS
]


@pytest.mark.parametrize("mutant", CASES)
def test_a_wrong_hand_is_caught_for_the_right_reason(mutant: Mutant) -> None:
    found = trial(mutant, run_mutant(mutant.service, mutant.plan))
    assert found == {"missed": set(), "wrongly": set()}, mutant.summary


def test_every_mutant_says_what_it_does_wrong() -> None:
    assert all(m.summary for m in MUTANTS)
    assert len({(m.model, m.name) for m in MUTANTS}) == len(MUTANTS)
