"""Render a result as JUnit XML: one test case per requirement and side."""

from __future__ import annotations

from pathlib import Path

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Result, RunResult, Verdict
from dexkit.conformance.report.labels import catch_sentence, hand_name
from dexkit.conformance.report.pages import fill
from dexkit.documents import write_file

__all__ = ["write_junit"]

_SKIPPED = (Verdict.NOT_APPLICABLE, Verdict.NOT_CLAIMED)


def _counted(entry: Result, result: RunResult) -> Verdict:
    """The verdict as it counts for the hands."""
    about_hand = not entry.requirement.about_client or result.client_only
    passes = entry.verdict in (Verdict.PASS, Verdict.WARN, *_SKIPPED)
    return entry.verdict if about_hand or passes else Verdict.NOT_APPLICABLE


def write_junit(result: RunResult, path: Path) -> None:
    """Write the file. A warning passes; an unjudged requirement is skipped; all others fail.

    What the client does wrong is skipped, too: it fails no hand. Where only requirements about the
    client were selected, it fails.
    """
    cases = [(entry, _counted(entry, result)) for entry in [*result.results, *result.client]]
    verdicts = [counted for _, counted in cases]
    text = fill(
        "junit.xml",
        result=result,
        hand=hand_name(result),
        counts={
            "tests": len(verdicts),
            "failures": verdicts.count(Verdict.FAIL),
            "errors": verdicts.count(Verdict.ERROR) + verdicts.count(Verdict.BLOCKED),
            "skipped": sum(v in _SKIPPED for v in verdicts),
        },
        properties={
            **result.subject,
            **result.environment,
            **{f"stage.{side}": stage for side, stage in result.stage.items()},
            **{f"harness.{name}": f"{value:g}" for name, value in result.harness.items()},
            "overall": result.overall,
            **{f"grade.{kind}": result.grade(kind).sentence() for kind in Kind},
            "catch-rate": catch_sentence(result),
        },
        cases=cases,
        SKIPPED=_SKIPPED,
    )
    write_file(path, text)
