"""Test that references pass and each wrong hand fails exactly its requirements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.conformance.checks import check_of
from dexkit.conformance.faults import Mutant, mutants, plan_for, run_mutant
from dexkit.conformance.faults.__main__ import command
from dexkit.conformance.faults.matrix import (
    Score,
    WrongHandResult,
    chosen,
    essential,
)
from dexkit.conformance.faults.trials import blamed, cost
from dexkit.conformance.kit.requirements import Level, catalogue, select
from dexkit.conformance.kit.results import Overall, Verdict
from dexkit.conformance.layers import layer
from dexkit.errors import UsageError
from dexkit.hand import Side
from tests.each import each

LEFT, BOTH = (Side.LEFT,), (Side.LEFT, Side.RIGHT)


@pytest.mark.parametrize(
    ("dialect", "sides"),
    [
        ("unitree_go", BOTH),
        pytest.param("unitree_go", LEFT, marks=pytest.mark.soak),
        ("unitree_hg", LEFT),  # the pair is one in each dialect; both hands are in the first
        pytest.param("unitree_hg", BOTH, marks=pytest.mark.soak),
        # the same service as in unitree_go, in other units, which test_dialects compares
        pytest.param("unitree_actuator", LEFT, marks=pytest.mark.soak),
        pytest.param("unitree_actuator", BOTH, marks=pytest.mark.soak),
        ("dex3", LEFT),  # both hands of many joints take long
        pytest.param("dex3", BOTH, marks=pytest.mark.soak),
        pytest.param("dex5", LEFT, marks=pytest.mark.soak),
        pytest.param("dex5", BOTH, marks=pytest.mark.soak),
        pytest.param("brainco", BOTH, marks=pytest.mark.soak),
        pytest.param("inspire_dfx", BOTH, marks=pytest.mark.soak),
        pytest.param("inspire_ftp", BOTH, marks=pytest.mark.soak),
    ],
)
def test_reference_hand_passes(dialect: str, sides: tuple[Side, ...]) -> None:
    plan = plan_for(dialect, sides=sides)
    result = run_mutant(layer("dds").reference(plan.dialect.model), plan)
    bad = [r.explain() for r in result.results if r.verdict not in GOOD]
    assert not bad, "\n".join(bad)
    assert result.overall is Overall.PASS
    assert result.judged >= 30
    # with both hands, and an object in one, every requirement can be judged
    if sides == BOTH and dialect != "unitree_hg":
        assert {r.requirement.id for r in result.results if r.verdict is Verdict.PASS} == {
            r.id for r in catalogue(plan.dialect.model) if dialect in r.dialects
        }


GOOD = (Verdict.PASS, Verdict.NOT_APPLICABLE)

BY_ID = {r.id: r for r in catalogue(None, None)}


def one_of_each_check() -> list[Mutant]:
    """Of each layer a wrong hand for each check, on topics of hands for each check of a MUST, which
    a short run shows; ``make pins`` tries all of every model.
    """
    others = [m for m in mutants() if m.layer != "dds"]
    found: dict[tuple[str, object], Mutant] = {}
    for mutant in (*essential(mutants()), *sorted(others, key=cost)):
        found.setdefault((mutant.layer, check_of(BY_ID[mutant.kills])), mutant)
    # not those that need a whole run of a hand of many joints
    return [m for m in found.values() if not (m.whole and cost(m) >= 6)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "given", one_of_each_check(), ids=lambda m: f"{m.layer}-{m.model}-{m.name}"
)
def test_wrong_hand_fails_its_requirement(given: Mutant) -> None:
    found = blamed(given, short=True)
    assert given.kills in found, given.summary
    assert found <= set(given.pinned or ()), given.summary


def test_every_requirement_of_every_layer_has_a_wrong_hand() -> None:
    assert {m.kills for m in mutants()} == set(BY_ID)
    musts = {r.id for r in BY_ID.values() if r.level is Level.MUST}
    assert {m.kills for m in essential(mutants())} == musts


def test_every_wrong_hand_has_a_summary() -> None:
    every = mutants()
    assert all(t.summary for t in every)
    assert len({(t.layer, t.model, t.name) for t in every}) == len(every)


@each(
    ("layer_name", "model"),
    [
        ("dds", "dex1-1"),
        ("dds", "dex3-1"),
        ("dds", "dex5-1"),
        ("dds", "brainco-revo2"),
        ("dds", "inspire-dfx"),
        ("dds", "inspire-ftp"),
        ("robot", "h1"),
        ("robot", "g1"),
    ],
)
def test_third_of_the_requirements_forbid_something(layer_name: str, model: str) -> None:
    every = catalogue(model, layer_name)
    assert sum(r.negative for r in every) >= len(every) / 3


# ------------------------------------------------------------------------------- the matrix


def score_of(*outcomes: WrongHandResult) -> Score:
    score = Score(select(catalogue(), prefixes=["DEX1-FIELD-01"]))
    score.outcomes += outcomes
    return score


def test_a_requirement_without_a_wrong_hand_is_an_error() -> None:
    score = score_of()
    assert [r.id for r in score.unproven] == ["DEX1-FIELD-01"]
    assert not score.perfect


def test_missed_and_extra_failures_are_errors() -> None:
    nan = next(t for t in mutants() if t.kills == "DEX1-FIELD-01")
    assert score_of(WrongHandResult(nan)).perfect
    survivor = score_of(WrongHandResult(nan, missed=("DEX1-FIELD-01",)))
    assert survivor.unproven
    assert not survivor.perfect
    assert not score_of(WrongHandResult(nan, wrongly=("DEX1-MOVE-02",))).perfect


def test_selection_by_model_includes_usb_and_topics() -> None:
    requirements, given = chosen("dex3-1", ["DEX3-IMU", "DEX3USB-DESC-01"])
    assert {r.id for r in requirements} == {"DEX3-IMU-01", "DEX3USB-DESC-01"}
    assert {t.layer for t in given} == {"dds", "usb"}


def test_command_prints_and_writes_the_score(tmp_path: Path) -> None:
    path = tmp_path / "score.json"
    arguments = ["--require", "DEX3USB-DESC-0", "--result", str(path), "--jobs", "1", "-v"]
    run = CliRunner().invoke(command, arguments)
    assert run.exit_code == 0, run.output
    assert "4 of 4 requirements proven" in run.output
    assert "OtherSide: A left hand with the product id of a right one." in run.output
    score = json.loads(path.read_text())
    assert score["perfect"] is True
    assert score["requirements"]["DEX3USB-DESC-01"]["killed_by"] == ["OtherSide"]


def test_list_names_hands_and_tries_none() -> None:
    run = CliRunner().invoke(command, ["--model", "dex1-1", "--require", "DEX1-FIELD-08", "--list"])
    assert run.exit_code == 0, run.output
    assert "HotByte" in run.output
    assert "DEX1-FIELD-08" in run.output
    assert "left and right" in run.output
    good = CliRunner().invoke(command, ["--generated", "3", "--good", "--list"])
    assert good.exit_code == 0, good.output
    assert good.output.count("good   ") == 3
    refused = CliRunner().invoke(command, ["--list", "--result", "x.json"])
    assert isinstance(refused.exception, UsageError)
