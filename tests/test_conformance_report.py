"""Test the HTML report: self-contained, complete, and external text is escaped."""

from __future__ import annotations

import re
from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import strategies as st

from dexkit.conformance.faults import mutants, plan_for
from dexkit.conformance.faults import usb as wrong_usb
from dexkit.conformance.kit.judge import judge, judge_layer
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.layers.usb import LAYER as USB
from dexkit.conformance.report.charts import Chart, Line
from dexkit.conformance.report.html import render
from dexkit.conformance.report.labels import VERDICTS
from dexkit.conformance.report.result_plots import plots_of
from dexkit.conformance.virtual import run_virtual
from dexkit.hand import Side
from dexkit.traces import open_trace, sample_path
from tests.conformance_helpers import copy_of, result_of, short_run, usb_run
from tests.each import each
from tests.report_helpers import HOSTILE, result_of_every_kind

VOID = {"meta", "br", "link", "img", "input", "hr"}


class Structure(HTMLParser):
    """Checks that tags nest, and collects ids of what the page refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.counts: dict[str, int] = {}
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.links += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parsed(page: str) -> Structure:
    structure = Structure()
    structure.feed(page)
    assert structure.open == []
    return structure


@pytest.fixture(scope="module")
def failing() -> str:
    view = Recording.decode(open_trace(sample_path("dex1_hand_dropout")))
    return render(judge(view, subject={"recording": "dex1_hand_dropout.mcap"}), view)


def test_page_loads_no_other_files(failing: str) -> None:
    structure = parsed(failing)
    assert all(link.startswith("#") for link in structure.links)
    assert "script" not in structure.counts
    assert not re.search(r"https?://|url\(|@import", failing)
    assert len(failing) < 220_000


def test_page_has_verdict_evidence_and_every_requirement(failing: str) -> None:
    assert '<header class="verdict bad">' in failing
    assert "<h1>Fail<small>" in failing
    assert "a gap from 9.49" in failing
    assert 'class="alarm"' in failing
    for requirement in catalogue("dex1-1"):
        assert requirement.id in failing
    # per side: position, force, intervals twice; the gap has two more
    assert parsed(failing).counts["svg"] == 8 + 2


def test_page_of_live_run_shows_phases() -> None:
    view = Recording.decode(short_run())
    page = render(judge(view, subject={"backend": "x", "device": "emulated"}), view)
    parsed(page)
    assert "No real hand was involved" in page
    assert ">steps</span>" in page
    assert ">silence</span>" in page


def test_page_of_hand_without_state_is_written() -> None:
    trace = copy_of(short_run())
    trace.rows = {k: v for k, v in trace.rows.items() if k[0].endswith("cmd")}
    view = Recording.decode(trace)
    page = render(judge(view), view)
    parsed(page)
    assert "No state of this hand was received" in page


def test_every_verdict_is_rendered_from_the_result_alone() -> None:
    result = result_of_every_kind()
    page = render(result)
    structure = parsed(page)
    assert "svg" not in structure.counts
    for verdict in Verdict:
        word = VERDICTS[verdict]
        assert f"<b>{word.text}</b>" in page  # in a row
    failed = next(r for r in result.results if r.verdict is Verdict.FAIL)
    need = failed.requirement
    card = page[page.index(f'id="card-{need.id}"') :].partition("</article>")[0]
    who = need.source.partition(" (")[0]
    for text in (need.sentence, failed.observed, need.advice, who, need.confidence):
        assert escape(text) in card
    assert "1.250 s to 1.500 s" in card
    assert ">1700000001250000000<" in card
    assert "cause, left" in card
    assert "cause plain words right" in card
    assert f'by <a href="#{result.results[2].requirement.id}">' in page  # what blocked it
    assert "reached: <b>topic seen</b> (2 of 5)" in page
    assert "max gap <b>0.25 s</b>" in page
    assert "rate <b>199.5 Hz</b>" in page
    assert "<dt>claimed units</dt><dd>force</dd>" in page
    for link in structure.links:
        assert not link.startswith("#") or f'id="{link[1:]}"' in page


def test_external_text_is_escaped() -> None:
    page = render(result_of_every_kind(HOSTILE), link="../a b/<script>.mcap")
    structure = parsed(page)
    assert "script" not in structure.counts
    assert {link for link in structure.links if link[0] != "#"} == {"../a%20b/%3Cscript%3E.mcap"}
    assert not re.search(r"https?://", re.sub(r"\(http://evil.example\)", "", page))


def test_size_of_plots_on_page_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    view = Recording.decode(open_trace(sample_path("dex1_hand_dropout")))
    result = judge(view)
    monkeypatch.setattr("dexkit.conformance.report.html._PLOT_BUDGET", 1)
    page = render(result, view)
    assert page.count("<svg") == 8 + 2  # the first one fits
    bad = [r for r in result.results if r.verdict is Verdict.FAIL]
    result.results += [replace(r, requirement=replace(r.requirement, id="DEX1-X-99")) for r in bad]
    assert "as many as it can hold" in render(result, view)
    x = np.linspace(0, 100, 100_000)
    noise = np.random.default_rng(0).normal(size=len(x))
    assert len(Chart("t", [Line("a", "state", x, noise)], (0, 100)).__html__()) < 15_000


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.1)."""
    digits = colour.lstrip("#")
    digits = digits if len(digits) == 6 else "".join(2 * c for c in digits)
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@each("theme", ["light", "dark"])
def test_text_of_the_report_has_enough_contrast(failing: str, theme: str) -> None:
    blocks = re.findall(r":root\{([^}]*)\}", failing)
    colours: dict[str, str] = {}
    for block in blocks[: 1 if theme == "light" else 2]:
        colours |= dict(re.findall(r"--(\w+):(#[0-9a-f]+)", block))
    grounds = {"bg", "card"}
    pairs = [(name, ground) for name in ("ink", "dim", "link") for ground in grounds]
    pairs += [(name, ground) for name in ("ok", "bad", "warn", "open") for ground in grounds]
    pairs += [(name, f"{name}bg") for name in ("ok", "bad", "open")]
    pairs += [
        (name, f"{verdict}bg") for name in ("ink", "dim") for verdict in ("ok", "bad", "open")
    ]
    for text, ground in pairs:
        a, b = sorted((luminance(colours[text]), luminance(colours[ground])))
        assert (b + 0.05) / (a + 0.05) >= 4.5, (theme, text, ground)


PLAN = plan_for(sides=(Side.LEFT,))
WRONG = {m.name: m.made for m in mutants() if m.model == "dex1-1"}


@pytest.mark.parametrize(
    ("name", "phases", "need", "titles"),
    [
        ("Hiccup", {"step"}, "RATE-03", ["time from each state", "command and state"]),
        (
            "HalfRate",
            {"step"},
            "RATE-01",
            ["rate of the state", "how often", "time from each"],
        ),
        ("StaleState", {"step"}, "FRESH-01", ["each sample of the state"]),
        ("Slow", {"step"}, "MOVE-04", ["steps laid over", "command and state"]),
        ("NanVelocity", {"step"}, "FIELD-01", ["left hand: dq", "command and state"]),
        ("OldTopic", {"step"}, "TOPIC-01", ["On the network"]),
    ],
)
def test_failure_shows_plots_of_its_requirement(
    name: str, phases: set[str], need: str, titles: list[str]
) -> None:
    view = Recording.decode(
        run_virtual(replace(PLAN, phases=frozenset(phases)), WRONG[name]),
        dialect_name="unitree_go",
        sides=(Side.LEFT,),
    )
    found = result_of(judge(view), f"DEX1-{need}")
    assert found.verdict in (Verdict.FAIL, Verdict.WARN)
    figures = plots_of(found, view)
    assert len(figures) == len(titles)
    for figure, title in zip(figures, titles, strict=True):
        parsed(figure)
        assert title in figure
    if "steps laid over" in titles[0]:
        assert 'class="bad line"' in figures[0]
        assert 'class="faint line"' in figures[0]


def test_usb_failure_shows_bytes_joints_or_descriptors() -> None:
    kinds = {
        wrong_usb.StaleCrc: "transfer from the hand",
        wrong_usb.Backwards: "joint positions in the answers",
        wrong_usb.OtherRelease: "<td>2.00</td>",
        wrong_usb.Slow: "from command to answer",
    }
    view = Recording.decode(short_run())
    every = catalogue("dex3-1", "usb")
    for device, title in kinds.items():
        kills = next(m.kills for m in mutants() if m.made is device)
        usb = usb_run(device(Side.LEFT))
        found = next(r for r in judge_layer(USB, usb, every) if r.requirement.id == kills)
        (figure,) = plots_of(found, replace(view, usb=usb))
        parsed(figure)
        assert title in figure


floats = st.floats(-1e6, 1e6)
