"""Test Markdown, badge, JUnit and comparison, and the commands that write them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner, Result

from dexkit.cli import cli
from dexkit.conformance.faults import plan_for
from dexkit.conformance.faults.robot import NoCrc
from dexkit.conformance.faults.usb import StaleCrc
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.result_file import read_json, write_json
from dexkit.conformance.kit.results import RunResult, Verdict
from dexkit.conformance.kit.run_record import RECORD, run_record
from dexkit.conformance.kit.suite_run import SuiteOptions, judge_recording
from dexkit.conformance.report.badge import badge_text, render_badge
from dexkit.conformance.report.compare import (
    Comparison,
    render_comparison,
    render_comparison_markdown,
)
from dexkit.conformance.report.html import render
from dexkit.conformance.report.junit import write_junit
from dexkit.conformance.report.labels import VERDICTS, catch_sentence
from dexkit.conformance.report.markdown import MOST_CARDS, render_markdown
from dexkit.conformance.report.terminal import MARKS
from dexkit.conformance.usb.recording import UsbRecording
from dexkit.conformance.virtual import run_virtual
from dexkit.conformance.virtual.usb import run_virtual_usb
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.templates import plain
from dexkit.traces import Recorder, open_trace, sample_path
from tests.conformance_helpers import copy_of, short_run
from tests.each import each
from tests.report_helpers import HOSTILE, result_of_every_kind, run_named
from tests.reproduction_helpers import write_trace, write_usb

# ------------------------------------------------------------------------------- Markdown


def test_markdown_has_every_verdict_and_full_text_of_failures() -> None:
    result = result_of_every_kind()
    text = render_markdown(result)
    assert text.startswith("## ❌ Fail: plain words as Dex1-1")
    for verdict in Verdict:
        assert VERDICTS[verdict].mark in text
    failed = next(r for r in result.results if r.verdict is Verdict.FAIL)
    need = failed.requirement
    for part in (need.sentence, failed.observed, failed.cause, need.advice, need.source):
        assert plain(part) in text
    assert "rt/plain words` at 1.250 s to 1.500 s, log time `1700000001250000000`" in text
    assert "left hand reached: **moving**" in text
    assert "itself late by 0.10 ms (median), 1.50 ms" in text


def test_external_text_stays_text_in_markdown() -> None:
    text = render_markdown(result_of_every_kind(HOSTILE))
    text = re.sub(r"`[^`\n]*`", "", text.replace("\\`", ""))  # code shows what it holds
    assert "<script" not in text
    assert "http://evil" not in text
    assert not re.search(r"@\w", text)
    table = [line for line in text.splitlines() if line.startswith("|")]
    for line in table:
        assert len(re.findall(r"(?<!\\)\|", line)) in (len(Verdict) + 2, 6), line


def test_length_of_markdown_is_limited() -> None:
    result = result_of_every_kind()
    bad = next(r for r in result.results if r.verdict is Verdict.FAIL)
    many = [
        replace(bad, requirement=replace(bad.requirement, id=f"DEX1-MANY-{i:02}"))
        for i in range(MOST_CARDS + 7)
    ]
    text = render_markdown(replace(result, results=many))
    assert text.count("\n### ") == MOST_CARDS
    assert "... and 7 more." in text
    assert len(text) < 65536


def test_verdicts_have_same_name_in_all_reports() -> None:
    for verdict in Verdict:
        assert VERDICTS[verdict].text == str(verdict)
        assert MARKS[verdict][0].lower() == str(verdict)


# ---------------------------------------------------------------------------------- badge


@each(
    ("verdicts", "subject", "text"),
    [
        ((Verdict.PASS, Verdict.PASS), {}, "2/2 pass"),
        ((Verdict.PASS, Verdict.PASS), {"device": "emulated"}, "2/2 pass (emulated)"),
        ((Verdict.PASS, Verdict.PASS), {"backend": "sim-dex1"}, "2/2 pass (simulated)"),
        ((Verdict.PASS, Verdict.PASS), {"backend": ""}, "2/2 pass (recorded)"),
        ((Verdict.PASS, Verdict.WARN), {}, "1/2 pass, 1 warn"),
        ((Verdict.PASS, Verdict.NOT_APPLICABLE), {}, "1/2 pass, 1 not applicable"),
        ((Verdict.PASS, Verdict.NOT_CLAIMED), {}, "1/1 pass"),
        ((Verdict.PASS, Verdict.FAIL), {}, "fail, 1 of 2 not met"),
        ((Verdict.PASS, Verdict.ERROR), {}, "inconclusive, 1 of 2 pass"),
        ((), {}, "inconclusive, 0 of 0 pass"),
    ],
)
def test_badge_states_only_the_judged_grade(
    verdicts: tuple[Verdict, ...], subject: dict[str, str], text: str
) -> None:
    run = run_named("h", "", **dict(zip(("TOPIC_01", "TOPIC_02"), verdicts, strict=False)))
    run.subject.pop("hand")
    run.subject.update(subject)
    assert badge_text(run) == ("Dex1-1 drop-in", text)


def test_requirements_of_other_dialects_are_not_counted() -> None:
    run = run_named("h", "", TOPIC_01=Verdict.PASS, TOPIC_02=Verdict.NOT_APPLICABLE)
    other = replace(run.results[1].requirement, dialects=("unitree_hg",))
    run.results[1] = replace(run.results[1], requirement=other)
    assert badge_text(run)[1] == "1/1 pass"


def test_the_badge_is_an_image_with_its_text() -> None:
    svg = render_badge(result_of_every_kind())
    root = ElementTree.fromstring(svg)
    assert root.attrib["role"] == "img"
    title = root.find("{http://www.w3.org/2000/svg}title")
    assert title is not None
    verdicts, caught = title.text.rsplit("; ", 1)
    assert verdicts == "Dex1-1 drop-in: fail, 1 of 6 not met; Dex1-1 safety: not judged"
    assert caught == catch_sentence(result_of_every_kind())
    assert "http" not in svg.replace("http://www.w3.org/2000/svg", "")
    width = float(root.attrib["width"])
    ends = [
        float(t.attrib["x"]) + float(t.attrib["textLength"])
        for t in root.iter("{http://www.w3.org/2000/svg}text")
    ]
    assert max(ends) < width


# ---------------------------------------------------------------------------------- JUnit


def test_junit_counts_every_verdict_and_is_valid_xml(tmp_path: Path) -> None:
    write_junit(result_of_every_kind(HOSTILE), tmp_path / "r.xml")
    suite = ElementTree.parse(tmp_path / "r.xml").getroot()
    counts = {name: int(suite.attrib[name]) for name in ("tests", "failures", "errors", "skipped")}
    assert counts == {"tests": 14, "failures": 2, "errors": 4, "skipped": 4}
    assert len(suite.findall("testcase/skipped")) == 4
    assert "cause:    cause <script>" in "".join(suite.itertext())


# ----------------------------------------------------------------------------- comparison


def three_runs() -> list[RunResult]:
    ok, bad, warn = Verdict.PASS, Verdict.FAIL, Verdict.WARN
    return [
        run_named("Grip", "2026-01-02", TOPIC_01=ok, RATE_01=bad, RATE_03=ok, MOVE_02=ok),
        run_named("Grip", "2026-01-01", TOPIC_01=ok, RATE_01=ok, RATE_03=warn, MOVE_02=bad),
        run_named("Hand", "2026-01-03", TOPIC_01=ok, RATE_01=bad, MOVE_02=Verdict.BLOCKED),
    ]


def test_regressions_compare_runs_of_one_hand_in_order_of_time() -> None:
    found = Comparison(three_runs(), ["new", "old", "other"])
    assert [(c.requirement.id, c.before, c.after) for c in found.regressions] == [
        ("DEX1-RATE-01", 1, 0)
    ]
    better = {c.requirement.id for c in found.changes if not c.worse}
    assert better == {"DEX1-RATE-03", "DEX1-MOVE-02"}


def test_unjudged_result_is_not_a_regression() -> None:
    runs = [
        run_named("Grip", "1", TOPIC_01=Verdict.PASS),
        run_named("Grip", "2", TOPIC_01=Verdict.BLOCKED),
        run_named("Grip", "3", TOPIC_01=Verdict.NOT_APPLICABLE),
    ]
    assert Comparison(runs).changes == []


def test_unnamed_recordings_are_not_compared_as_one_hand() -> None:
    runs = [
        run_named("a", "1", TOPIC_01=Verdict.PASS),
        run_named("a", "2", TOPIC_01=Verdict.FAIL),
    ]
    for run in runs:
        run.subject = {"model": "dex1-1", "recording": "run.mcap"}
    assert Comparison(runs).regressions == []


def test_external_names_are_escaped_in_comparison() -> None:
    runs = [result_of_every_kind(HOSTILE), result_of_every_kind("b")]
    assert "<script" not in render_comparison(Comparison(runs))
    assert "<script" not in render_comparison_markdown(Comparison(runs))


def test_comparison_refuses_different_models() -> None:
    other = replace(run_named("a", "1"), subject={"model": "dex3-1"})
    with pytest.raises(UsageError, match=r"different models: dex1-1, dex3-1"):
        Comparison([run_named("a", "1"), other])
    with pytest.raises(UsageError, match="two results or more"):
        Comparison([run_named("a", "1")])


# ------------------------------------------------------------------------- from the suite


def test_suite_writes_requested_report_files(tmp_path: Path) -> None:
    options = SuiteOptions.make(
        backend="sim-dex1",
        side="left",
        markdown=tmp_path / "r.md",
        report=tmp_path / "r.html",
    )
    trace = copy_of(short_run())
    trace.metadata[RECORD] = run_record(
        subject=options.rig(0).subject,
        dialect="unitree_go",
        sides=(Side.LEFT,),
        phases=(),
        rounds=1,
        requirements=(),
        claims=Claims(),
    )
    judge_recording(options, Recording.decode(trace, sides=(Side.LEFT,)))
    assert (tmp_path / "r.md").read_text().startswith("## ")
    assert "simulated" in (tmp_path / "r.html").read_text()
    with pytest.raises(UsageError, match="no such directory"):
        SuiteOptions.make(backend="sim-dex1", markdown=tmp_path / "missing" / "r.md")


# ----------------------------------------------------------------------------- commands


def run(*args: object) -> Result:
    return CliRunner().invoke(cli, [str(a) for a in args])


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result beside its recording."""
    folder = tmp_path_factory.mktemp("judged")
    source = sample_path("dex1_hand_dropout")
    (folder / "run.mcap").write_bytes(source.read_bytes())
    view = Recording.decode(open_trace(folder / "run.mcap"))
    write_json(judge(view, subject={"recording": "run.mcap"}), folder / "result.json")
    return folder


def test_reports_are_rendered_again_from_result_file(judged: Path, tmp_path: Path) -> None:
    done = run(
        "report",
        judged / "result.json",
        "--html",
        tmp_path / "r.html",
        "--markdown",
        tmp_path / "r.md",
        "--junit",
        tmp_path / "r.xml",
    )
    assert done.exit_code == 0, done.output
    page = (tmp_path / "r.html").read_text()
    assert "<svg" in page  # the recording lies beside the result
    links = set(re.findall(r'href="([^#"][^"]*)"', page))
    assert len(links) == 1
    link = links.pop()
    assert not link.startswith("/")
    assert (tmp_path / link).resolve() == (judged / "run.mcap").resolve()
    assert "No gap or burst in the state" in (tmp_path / "r.md").read_text()
    assert ElementTree.parse(tmp_path / "r.xml").getroot().tag == "testsuite"


def write_robot(recorder: Recorder) -> str:
    """Record a robot whose states have no CRC, and the requirement that it fails."""
    plan = replace(plan_for("h1"), phases=frozenset[str]())
    write_trace(run_virtual(plan, NoCrc), recorder)
    return "H1-CRC-01"


def write_hand_on_usb(recorder: Recorder) -> str:
    """Record a good Dex3-1 whose USB device sends old checksums."""
    plan = replace(plan_for("dex3", sides=(Side.LEFT,)), phases=frozenset[str]())
    write_trace(run_virtual(plan, under_test("dex3-1").reference.load()), recorder)
    usb = UsbRecording.decode(run_virtual_usb(StaleCrc(Side.LEFT)))
    assert usb is not None
    write_usb(usb.sides[Side.LEFT], recorder)
    return "DEX3USB-CRC-01"


@each("written", [write_robot, write_hand_on_usb])
def test_page_of_a_robot_or_of_usb_is_drawn_from_the_recording_beside_its_result(
    written: Callable[[Recorder], str], tmp_path: Path
) -> None:
    recording, result = tmp_path / "run.mcap", tmp_path / "result.json"
    with Recorder(recording) as recorder:
        failed = written(recorder)
    first, again = tmp_path / "first.html", tmp_path / "again.html"
    run("check", recording, "--result", result, "--html", first)
    verdicts = {r.requirement.id: r.verdict for r in read_json(result).results}
    assert verdicts[failed] is Verdict.FAIL
    done = run("report", result, "--html", again)
    assert done.exit_code == 0, done.output
    assert "<svg" in again.read_text()
    assert again.read_text() == first.read_text()


def test_page_without_recording_has_no_plots(judged: Path, tmp_path: Path) -> None:
    alone = tmp_path / "result.json"
    alone.write_bytes((judged / "result.json").read_bytes())
    assert run("report", alone, "--html", tmp_path / "r.html").exit_code == 0
    page = (tmp_path / "r.html").read_text()
    assert "<svg" not in page
    assert "Plots of the evidence need the recording" in page
    assert "a gap from 9.49" in page


def test_report_refuses_another_recording(judged: Path, tmp_path: Path) -> None:
    other = sample_path("dex1_pick_place")
    page = tmp_path / "r.html"
    done = run("report", judged / "result.json", "--recording", other, "--html", page)
    assert isinstance(done.exception, UsageError)
    assert "begins at" in done.exception.message
    assert not page.exists()
    (tmp_path / "run.mcap").write_bytes(other.read_bytes())
    (tmp_path / "result.json").write_bytes((judged / "result.json").read_bytes())
    done = run("report", tmp_path / "result.json", "--html", page)
    assert done.exit_code == 0
    assert "no plots: " in done.output
    assert "<svg" not in page.read_text()


def test_terminal_shows_table_and_summary(judged: Path) -> None:
    table = run("report", judged / "result.json")
    assert "DEX1-RATE-03" in table.output
    assert "FAIL: a MUST is not met" in table.output
    assert "stage reached: left" in table.output
    assert run("report", judged / "result.json", "--markdown", "-").output.startswith("## ❌ Fail")


def test_badge_and_comparison_on_the_command_line(judged: Path, tmp_path: Path) -> None:
    done = run("badge", judged / "result.json", "-o", tmp_path / "b.svg")
    assert done.exit_code == 0
    assert "Dex1-1 drop-in | fail, " in done.output
    assert "(recorded)" in done.output
    assert (tmp_path / "b.svg").read_text().startswith("<svg")
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    write_json(run_named("G", "2026-01-01", TOPIC_01=Verdict.PASS), a)
    write_json(run_named("G", "2026-01-02", TOPIC_01=Verdict.FAIL), b)
    done = run("compare", a, b, "--html", tmp_path / "c.html")
    assert done.exit_code == 1
    assert "1 regression: DEX1-TOPIC-01" in done.output
    assert "Regressions (1)" in (tmp_path / "c.html").read_text()
    found = json.loads(run("compare", a, b, "--json").stdout)
    assert [c["id"] for c in found["regressions"]] == ["DEX1-TOPIC-01"]
    assert found["requirements"][0]["verdicts"] == ["pass", "fail"]
    same = run("compare", a, a)
    assert same.exit_code == 0
    assert "Nowhere: all verdicts agree" in same.output


def test_invalid_result_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("{}")
    for args in (["report"], ["badge"], ["compare", tmp_path / "x.json"]):
        done = run(*args, tmp_path / "x.json")
        assert isinstance(done.exception, UsageError), args
    assert run("report", tmp_path / "missing.json").exit_code == 2
    assert run("compare").exit_code == 2


def test_reports_state_that_only_a_part_was_selected(tmp_path: Path) -> None:
    result = replace(run_named("G", "2026-01-01", TOPIC_01=Verdict.PASS), catalogue=67)
    assert result.partial
    assert "(1 of 67 requirements: 1 pass)" in result.sentence()
    assert badge_text(result)[1].startswith("1/1 pass of 67, partial")
    assert "#14734a" not in render_badge(result)
    for text in (render(result), render_markdown(result)):
        assert "Only 1 of 67 requirements were selected" in text
    write_json(result, tmp_path / "part.json")
    assert read_json(tmp_path / "part.json").partial
    assert not replace(result, catalogue=1).partial
