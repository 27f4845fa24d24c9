"""Judging gives the pinned verdicts: of every sample, and of every wrong hand and robot."""

from __future__ import annotations

import pytest

from dexkit.conformance.faults import Mutant, mutants
from dexkit.conformance.faults.trials import blamed, cost
from dexkit.traces.samples import SAMPLES, sample_path
from tools.pins.matrix import found_pins, tasks, tried
from tools.pins.pinned import Pins, figures_of
from tools.pins.store import default_folder
from tools.pins.verdicts import judge_sample, verdicts_of

WHERE = "see docs/mutants.md, 'make pins'"


def test_samples_get_the_pinned_verdicts() -> None:
    found = {}
    for name in SAMPLES:
        results = judge_sample(sample_path(name))
        found[name] = figures_of(verdicts_of(results, [r.requirement.id for r in results]))
    assert found == Pins.load().samples, WHERE


def test_every_wrong_hand_is_pinned_with_the_requirement_that_it_breaks() -> None:
    pinned = Pins.load().hands
    assert {m.pin for m in mutants()} == set(pinned), WHERE
    assert all(m.kills in pinned[m.pin] for m in mutants()), WHERE


def one_of_each_layer() -> list[Mutant]:
    """The cheapest of each layer; the soak tries all of every model."""
    found: dict[str, Mutant] = {}
    for mutant in sorted(mutants(), key=lambda m: (cost(m), m.model, m.name)):
        found.setdefault(mutant.layer, mutant)
    return list(found.values())


def test_one_wrong_hand_of_each_layer_gets_the_pinned_blame() -> None:
    pinned = Pins.load().hands
    for mutant in one_of_each_layer():
        assert sorted(blamed(mutant)) == pinned[mutant.pin], f"{mutant.pin}: {WHERE}"


@pytest.mark.soak
def test_every_wrong_hand_and_sample_gets_the_pinned_verdicts() -> None:
    # what is known of this code is not tried again; the tests of tools/pins show that it is sound
    given = tasks(default_folder())
    found = found_pins(given, {task.name: done.verdicts for task, done in tried(given)})
    assert not list(Pins.load().differences(found, everything=True)), WHERE
