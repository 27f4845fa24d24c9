"""Judging gives the pinned verdicts: of every sample, and of every wrong hand and robot."""

from __future__ import annotations

import pytest

from dexkit.conformance.mutants import Mutant, mutants
from dexkit.conformance.mutants.matrix import Score, chosen, cost, try_one
from tests.pinned import BLAMED, SAMPLE_VERDICTS, blamed, blamed_sets, key, load, sample_verdicts

WHERE = "see tests/pinned/__init__.py"


def test_samples_get_the_pinned_verdicts() -> None:
    assert sample_verdicts() == load(SAMPLE_VERDICTS), WHERE


def test_every_wrong_hand_is_pinned_with_the_requirements_that_it_breaks() -> None:
    declared = {key(m): sorted({m.kills, *m.also}) for m in mutants()}
    assert declared == load(BLAMED), WHERE


def one_of_each_layer() -> list[Mutant]:
    """The cheapest of each layer; the soak tries all of every model."""
    found: dict[str, Mutant] = {}
    for mutant in sorted(mutants(), key=lambda m: (cost(m), m.model, m.name)):
        found.setdefault(mutant.layer, mutant)
    return list(found.values())


def test_one_wrong_hand_of_each_layer_gets_the_pinned_blame() -> None:
    pinned = load(BLAMED)
    for mutant in one_of_each_layer():
        assert blamed(try_one(mutant)) == pinned[key(mutant)], f"{key(mutant)}: {WHERE}"


@pytest.mark.soak
def test_every_wrong_hand_gets_the_pinned_blame() -> None:
    requirements, every = chosen()
    score = Score(requirements)
    for _ in score.run(every):
        pass
    assert blamed_sets(score.outcomes) == load(BLAMED), WHERE
