"""Render a result as JUnit XML: one test case per requirement and side."""

from __future__ import annotations

import io
from pathlib import Path
from xml.etree import ElementTree

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Result, RunResult, Verdict
from dexkit.conformance.report.labels import catch_sentence, hand_name
from dexkit.documents import write_file
from dexkit.escaping import visible

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
    entries = [*result.results, *result.client]
    verdicts = [_counted(r, result) for r in entries]
    suite = ElementTree.Element(
        "testsuite",
        name=f"dexkit conformance: {hand_name(result)}",
        tests=str(len(verdicts)),
        failures=str(verdicts.count(Verdict.FAIL)),
        errors=str(verdicts.count(Verdict.ERROR) + verdicts.count(Verdict.BLOCKED)),
        skipped=str(sum(v in _SKIPPED for v in verdicts)),
        time=f"{result.duration_s:.3f}",
        timestamp=result.recorded_at,
    )
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in {
        **result.subject,
        **result.environment,
        **{f"stage.{side}": str(stage) for side, stage in result.stage.items()},
        **{f"harness.{name}": f"{value:g}" for name, value in result.harness.items()},
        "overall": str(result.overall),
        **{f"grade.{kind}": result.grade(kind).sentence() for kind in Kind},
        "catch-rate": catch_sentence(result),
    }.items():
        ElementTree.SubElement(properties, "property", name=name, value=value)
    for entry, verdict in zip(entries, verdicts, strict=True):
        case = ElementTree.SubElement(
            suite,
            "testcase",
            classname=f"{entry.requirement.model}.{entry.requirement.area}",
            name=f"{entry.requirement.id}-{entry.side}",
            time="0",
        )
        if verdict is Verdict.FAIL:
            failure = ElementTree.SubElement(case, "failure", message=entry.observed)
            failure.text = entry.explain()
        elif verdict in (Verdict.ERROR, Verdict.BLOCKED):
            error = ElementTree.SubElement(case, "error", message=entry.reason)
            error.text = entry.explain()
        elif verdict is not entry.verdict:
            message = f"a fault of the client, not of the hand: {entry.observed or entry.reason}"
            ElementTree.SubElement(case, "skipped", message=message).text = entry.explain()
        elif verdict in _SKIPPED:
            ElementTree.SubElement(case, "skipped", message=entry.reason)
        else:
            out = ElementTree.SubElement(case, "system-out")
            out.text = entry.explain()
    for element in suite.iter():
        element.attrib = {name: visible(value) for name, value in element.attrib.items()}
        element.text = visible(element.text or "") or None
    tree = ElementTree.ElementTree(suite)
    ElementTree.indent(tree)
    content = io.BytesIO()
    tree.write(content, encoding="utf-8", xml_declaration=True)
    write_file(path, content.getvalue())
