"""Test that a model of Unitree's service is a drop-in for itself, and no more."""

from __future__ import annotations

from functools import cache

from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.kit.requirements import Kind, Level, catalogue
from dexkit.conformance.kit.result_file import as_document
from dexkit.conformance.kit.results import Overall, RunResult, Verdict
from dexkit.conformance.report.badge import badge_text, badges, render_badge
from dexkit.conformance.report.html import render
from dexkit.conformance.report.markdown import render_markdown
from tests.original_service import OriginalService

NOT_MET = "Not met: "
"""How the catalogue begins to say what the original does where it does not meet a requirement."""


@cache
def judged() -> RunResult:
    return run_mutant(OriginalService, plan_for())


def test_the_original_meets_every_drop_in_requirement() -> None:
    result = judged()
    drop_in = [r for r in result.results if r.requirement.kind is Kind.DROP_IN]
    good = (Verdict.PASS, Verdict.NOT_APPLICABLE)
    assert not [r.explain() for r in drop_in if r.verdict not in good]
    assert result.grade(Kind.DROP_IN).overall is Overall.PASS
    # what it does not fill, and what is about other dialects, cannot be judged; all else is
    unjudged = {r.requirement.id for r in drop_in if r.verdict is not Verdict.PASS}
    ids = {r.requirement.id for r in drop_in if r.verdict is Verdict.PASS}
    spoken = {r.id for r in catalogue("dex1-1") if "unitree_go" in r.dialects}
    assert (unjudged - ids) & spoken == {"DEX1-FIELD-08"}


def test_the_original_fails_exactly_the_safety_requirements_that_the_catalogue_names() -> None:
    failed = {
        r.requirement.id for r in judged().results if r.verdict in (Verdict.FAIL, Verdict.WARN)
    }
    named = {r.id for r in catalogue("dex1-1") if r.original.startswith(NOT_MET)}
    assert (
        failed
        == named
        == {
            *("DEX1-SAFE-01", "DEX1-SAFE-02", "DEX1-LIFE-04"),
        }
    )
    grade = judged().grade(Kind.SAFETY)
    assert grade.overall is Overall.FAIL
    assert grade.sentence().startswith("safety: FAIL: ")


def test_a_failure_in_safety_is_in_every_report() -> None:
    result = judged()
    assert badge_text(result)[1].endswith(" pass, 1 not applicable (simulated)")
    assert badge_text(result, Kind.SAFETY)[1].startswith("fail, 2 of ")
    assert badges(result) == tuple(Kind)
    both = render_badge(result)
    assert "Dex1-1 safety: fail" in both
    assert "#14734a" in both
    assert "#b3261e" in both
    for text in (render(result), render_markdown(result)):
        assert "the gripper moves by 1.6 rad while NaN is sent" in text  # the original's result
    assert "safety: FAIL: a MUST is not met" in render_markdown(result)
    assert result.exit_code() == result.exit_code(Kind.SAFETY) == 1
    assert result.exit_code(Kind.DROP_IN) == 0
    grades = as_document(result)["grades"]
    assert [grades[str(kind)]["overall"] for kind in Kind] == ["pass", "fail"]


def test_safety_requirements_say_what_the_original_does() -> None:
    for need in catalogue(None, None):
        assert bool(need.original) == (need.kind is Kind.SAFETY), need.id
        if need.original and not need.original.startswith("Not known: "):
            assert "docs/sources/" in need.original, need.id
    musts = [r for r in catalogue("dex1-1") if r.level is Level.MUST and r.kind is Kind.SAFETY]
    assert {r.id for r in musts} == {
        *("DEX1-SAFE-01", "DEX1-SAFE-02", "DEX1-SAFE-03", "DEX1-SAFE-10", "DEX1-WDOG-04"),
        *("DEX1-SIDE-02", "DEX1-ABUSE-01", "DEX1-LIFE-04"),
    }
