"""Test capability claims: reading the file, and their effect on verdicts."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

import dexkit.conformance
from dexkit.conformance.checks import Outcome
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import CAPABILITIES, Level, Requirement, catalogue
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.kit.verdicts import Excuse, Judgement
from dexkit.conformance.report.labels import hand_name
from dexkit.errors import UsageError
from dexkit.hand import Side
from tests.conformance_helpers import result_of, short_run
from tests.each import each

DOCS = Path(__file__).parent.parent / "docs" / "capabilities.md"
VELOCITY = next(r for r in catalogue("dex1-1") if r.id == "DEX1-FIELD-04")


@each(
    ("text", "expected"),
    [
        ("[claims]\nforse = true", "claims: Object contains unknown field forse"),
        ("[claims]\nforce = 1", "claims.force: Expected bool, got int"),
        ("[claim]\nforce = true", "Object contains unknown field claim"),
        ("claims = true", "claims: Expected object, got bool"),
        ("[hand]\ncolour = 'red'", "hand: Expected str matching regex '^(name|"),
        ("[hand]\nname = 1", "hand[...]: Expected str, got int"),
        ("[hand]\nmodel = 'dex9'", "no hand model 'dex9'"),
        ("[claims", "capabilities.toml is not valid TOML: "),
    ],
)
def test_invalid_claims_file_is_error(text: str, expected: str) -> None:
    with pytest.raises(UsageError, match=re.escape(expected)):
        Claims.parse(text)


def test_claims_file_for_other_model_is_error(tmp_path: Path) -> None:
    path = tmp_path / "capabilities.toml"
    path.write_text("[hand]\nmodel = 'dex3-1'\n")
    assert Claims.load(path, "dex3-1").hand["model"] == "dex3-1"
    with pytest.raises(UsageError, match="about a dex3-1, and a dex1-1 is to be judged"):
        Claims.load(path, "dex1-1")
    with pytest.raises(UsageError, match="cannot read"):
        Claims.load(tmp_path / "missing.toml", "dex1-1")


def test_example_and_documentation_list_every_unit() -> None:
    assert dexkit.conformance.__file__ is not None
    example = Path(dexkit.conformance.__file__).parent / "kit" / "capabilities.example.toml"
    claims = Claims.load(example, "dex1-1")
    assert claims.units is not None
    text, documented = example.read_text(), DOCS.read_text()
    for unit, meaning in CAPABILITIES.items():
        assert re.search(rf"^{unit} = ", text, re.M)
        assert f"| `{unit}` | {meaning}" in documented


def test_every_unit_has_a_requirement() -> None:
    judged = {r.capability for r in catalogue(None, None)}
    # no client reads ddq; files that claim it are still read
    assert judged == {"", *CAPABILITIES} - {"acceleration"}


def test_without_claims_file_verdicts_are_unchanged() -> None:
    claims = Claims()
    assert claims.apply(catalogue()) == catalogue()
    assert claims.claimed(VELOCITY) is None


def test_claimed_units_are_must_and_others_not_claimed() -> None:
    recording = Recording.decode(short_run())
    silent = judge(recording)
    assert result_of(silent, VELOCITY.id).requirement.level is Level.SHOULD
    assert silent.claims is None
    claimed = judge(recording, claims=Claims.parse("[claims]\nvelocity = true"))
    assert result_of(claimed, VELOCITY.id).requirement.level is Level.MUST
    assert result_of(claimed, VELOCITY.id).verdict is Verdict.PASS
    assert claimed.claims is not None
    assert claimed.claims["velocity"]
    assert not claimed.claims["force"]
    nothing = judge(recording, claims=Claims.parse('[hand]\nname = "X"\nfirmware = "1"'))
    assert result_of(nothing, VELOCITY.id).verdict is Verdict.NOT_CLAIMED
    assert (nothing.subject["hand"], nothing.subject["firmware"]) == ("X", "1")
    assert hand_name(nothing) == "X 1"  # the reports show it under that name


def concluded(requirement: Requirement, text: str, outcome: Outcome) -> Result:
    claims = Claims.parse(text) if text else Claims()
    (applied,) = claims.apply([requirement])
    return Judgement(applied, Side.LEFT, claims, {}).run_check(lambda: outcome, lambda _: Excuse())


@each("met", [None, True])
def test_claimed_unit_without_data_fails(met: bool | None) -> None:
    absent = Outcome(met, observed="all 0", reason="" if met else "dq is 0", absent=True)
    usual = Verdict.PASS if met else Verdict.NOT_APPLICABLE
    assert concluded(VELOCITY, "", absent).verdict is usual
    found = concluded(VELOCITY, "[claims]\nvelocity = true", absent)
    assert found.verdict is Verdict.FAIL
    assert "but the unit 'velocity' is claimed" in found.observed


def test_claimed_should_fails_instead_of_warning() -> None:
    bad = Outcome(False, "200 %", "dq is off")
    assert concluded(VELOCITY, "", bad).verdict is Verdict.WARN
    assert concluded(VELOCITY, "[claims]\nvelocity = true", bad).verdict is Verdict.FAIL


def test_claimed_info_stays_info() -> None:
    info = replace(VELOCITY, level=Level.INFO)
    assert concluded(info, "[claims]\nvelocity = true", Outcome(False)).verdict is Verdict.WARN
