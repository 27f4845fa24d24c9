"""Test that the catalogue is well formed, complete and documented."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from dexkit.conformance.checks import REGISTRY, check_of
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit import requirements
from dexkit.conformance.kit.requirements import Level, catalogue, models, parse, select
from dexkit.conformance.kit.selection import quick
from dexkit.conformance.kit.suite_run import SuiteOptions
from dexkit.conformance.layers import LAYERS
from dexkit.conformance.stimuli import Plan, phases_for, script_class
from dexkit.conformance.stimuli.script import default_objects
from dexkit.documents import parse_toml
from dexkit.errors import DexkitError, UsageError
from dexkit.hand import Side
from dexkit.models import model
from tests import hostile
from tests.each import each

GOOD = """
model = "dex1-1"
[[requirement]]
id = "DEX1-X-01"
area = "A"
level = "MUST"
title = "t"
sentence = "At most {limit:g}."
rationale = "r"
source = "s"
confidence = "measured"
needs = "state"
advice = "a"
tolerances = { limit = "model:command_timeout" }
"""


def test_tolerances_come_from_the_model_and_fill_the_sentence() -> None:
    (requirement,) = parse(GOOD)
    assert requirement.tolerance("limit") == 1.0
    assert requirement.sentence == "At most 1."


@each(
    ("old", "new", "expected"),
    [
        ('id = "DEX1-X-01"', 'id = "x"', "id: Expected str matching"),
        ('level = "MUST"', 'level = "must"', "level: Invalid enum value"),
        ('confidence = "measured"', 'confidence = "sure"', "confidence: Expected str matching"),
        ('needs = "state"', 'needs = "luck"', "needs: Expected str matching"),
        ('advice = "a"', 'advise = "a"', "unknown field advise"),
        ('"model:command_timeout"', '"model:nothing"', "has no figure"),
        ('"model:command_timeout"', '"1 s"', "a tolerance is a number"),
        ('needs = "state"', 'needs = "state"\nafter = ["DEX1-Y-01"]', "does not come before"),
        ('needs = "state"', 'needs = "state"\ndialects = ["latin"]', "no dialect"),
        (
            'needs = "state"',
            'needs = "state"\ncapability = "song"',
            "capability: Expected str matching",
        ),
        ('needs = "state"', 'needs = "state"\nrepeat = 0', "repeat: Expected int >= 1"),
        ('model = "dex1-1"', 'model = "dex1-1"\nretried = []', "unknown keys ['retried']"),
    ],
)
def test_error_names_the_mistake_in_a_requirement(old: str, new: str, expected: str) -> None:
    with pytest.raises(UsageError, match=expected.replace("[", r"\[").replace("]", r"\]")):
        parse(GOOD.replace(old, new))


def test_every_must_and_should_has_a_likely_cause() -> None:
    assert [r.id for r in catalogue(None, None) if r.level is not Level.INFO and not r.cause] == []


def test_requirement_ids_are_unique() -> None:
    table = GOOD[GOOD.index("[[") :]
    with pytest.raises(UsageError, match="occurs once"):
        parse(GOOD + table)


def test_every_requirement_has_one_check_and_every_check_a_requirement() -> None:
    every = catalogue(None, None)
    assert all(check_of(r) for r in every)
    assert set(REGISTRY) <= {r.id for r in every}


@each("name", models())
def test_needed_stimuli_exist(name: str) -> None:
    needed, played = phases_for(catalogue(name)), set()
    for dialect in model(name).dialects:
        plan = Plan(dialect, tuple(Side), default_objects(dialect, tuple(Side)), phases=needed)
        script = script_class(name)(plan)
        script.length()
        played |= {p.name for p in script.phases}
    # there is no session here
    assert needed - played == ({"replay"} if under_test(name).session else set())


def test_selection_includes_stimuli_of_dependencies() -> None:
    (only,) = select(catalogue(), prefixes=["DEX1-LIFE-02"])
    assert {"restart", "resume", "step"} <= phases_for([only])


def test_requirements_are_selected_by_prefix_and_level() -> None:
    rates = select(catalogue(), prefixes=["dex1-rate"])
    assert {r.id for r in rates} == {"DEX1-RATE-01", "DEX1-RATE-03"}
    musts = select(catalogue(), level="must")
    assert musts
    assert {r.level for r in musts} == {Level.MUST}
    assert len(select(catalogue(), level="should")) > len(musts)
    with pytest.raises(UsageError, match="no requirement begins with 'DEX9'"):
        select(catalogue(), prefixes=["DEX9"])
    with pytest.raises(UsageError, match="no level"):
        select(catalogue(), level="may")


@pytest.mark.soak
def test_quick_requirements_are_known_for_all_models() -> None:
    everything = catalogue(layer=None)
    assert {r.layer for r in everything} == set(LAYERS)
    assert {r.model for r in quick(everything)} == {r.model for r in everything}


def test_unwritable_output_is_reported_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match="it is a directory"):
        SuiteOptions.make(backend="sim-dex1", report=tmp_path)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(UsageError, match="its directory is read-only"):
        SuiteOptions.make(backend="sim-dex1", result=tmp_path / "r.json")


def test_invalid_catalogue_is_refused_by_name() -> None:
    rng = random.Random(1)
    document = parse_toml(GOOD, "good")
    good = 0
    for _ in range(500):
        changed = hostile.mutated(document, rng)
        if not isinstance(changed, dict):
            continue
        try:
            requirements._of_document(changed, "it", {})
        except DexkitError:
            continue
        good += 1
    assert good
    for text in ("[" * 5000, "a = nan", "model = 1", 'requirement = "x"'):
        with pytest.raises(UsageError):
            parse(text)
