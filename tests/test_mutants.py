"""The kit's teeth: good hands pass, each wrong hand is caught by its requirement alone."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from dexkit.conformance.mutants import MUTANTS, REFERENCES, plan_for, run_mutant, trial
from dexkit.conformance.results import Overall, Verdict
from dexkit.hand import Side

BY_NAME = {m.name: m for m in MUTANTS}
GOOD = ("unitree_go", "unitree_hg", "unitree_actuator", "left only")


def try_mutant(name: str) -> dict[str, set[str]]:
    mutant = BY_NAME[name]
    return dict(trial(mutant, run_mutant(mutant.service)))


def try_reference(name: str) -> tuple[Overall, set[Verdict], int]:
    plan = plan_for(sides=(Side.LEFT,)) if name == "left only" else plan_for(name)
    result = run_mutant(REFERENCES[plan.dialect.model], plan)
    return result.overall, {r.verdict for r in result.results}, result.judged


@pytest.fixture(scope="module")
def trials() -> dict[str, object]:
    """All runs, on all cores: each is half a minute of a hand in a second."""
    workers = min(4, os.cpu_count() or 1)
    # not forked: other test modules may have left threads behind
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        mutants = dict(zip(BY_NAME, pool.map(try_mutant, BY_NAME, chunksize=4), strict=True))
        good = dict(zip(GOOD, pool.map(try_reference, GOOD), strict=True))
    return {**mutants, **good}


@pytest.mark.parametrize("name", GOOD)
def test_a_good_hand_passes(
    name: str, trials: dict[str, tuple[Overall, set[Verdict], int]]
) -> None:
    overall, verdicts, judged = trials[name]
    assert overall is Overall.PASS
    assert verdicts <= {Verdict.PASS, Verdict.NOT_APPLICABLE}
    assert judged >= 30


@pytest.mark.parametrize("name", BY_NAME)
def test_a_wrong_hand_is_caught_for_the_right_reason(
    name: str, trials: dict[str, dict[str, set[str]]]
) -> None:
    assert trials[name] == {"missed": set(), "wrongly": set()}, BY_NAME[name].summary


def test_every_mutant_says_what_it_does_wrong() -> None:
    assert all(m.summary for m in MUTANTS)
    assert len(BY_NAME) == len(MUTANTS)
