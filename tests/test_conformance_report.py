"""The report page: self-contained, complete, and safe with what is in a recording."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.conformance.judge import judge
from dexkit.conformance.mutants import gripper
from dexkit.conformance.report.html import render
from dexkit.conformance.report.plots import nice_ticks, pieces, thin
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.view import Recording
from dexkit.conformance.virtual import run_virtual
from dexkit.hand import Side
from dexkit.traces import open_trace, sample_path
from tests.conformance_helpers import copy_of, short_run

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
    view = Recording.of(open_trace(sample_path("dex1_hand_dropout")))
    return render(judge(view, subject={"recording": "dex1_hand_dropout.mcap"}), view)


def test_it_needs_nothing_but_itself(failing: str) -> None:
    structure = parsed(failing)
    assert all(link.startswith("#") for link in structure.links)
    assert "script" not in structure.counts
    assert not re.search(r"https?://|url\(|@import", failing)
    assert len(failing) < 200_000


def test_verdict_evidence_and_every_requirement_are_on_it(failing: str) -> None:
    assert '<header class="verdict bad">' in failing
    assert "<h1>Fail<small>" in failing
    assert "gap(s); the first from 9.49" in failing
    assert 'class="alarm"' in failing
    for requirement in catalogue("dex1-1"):
        assert requirement.id in failing
    # per side: position, force, intervals twice; the gap has two of its own
    assert parsed(failing).counts["svg"] == 8 + 2


def test_it_knows_light_dark_phone_and_print(failing: str) -> None:
    for query in ("prefers-color-scheme:dark", "max-width:640px", "@media print"):
        assert query in failing
    assert 'name="viewport"' in failing


def test_a_live_run_shows_its_phases() -> None:
    view = Recording.of(short_run())
    page = render(judge(view, subject={"backend": "x", "device": "emulated"}), view)
    parsed(page)
    assert "No real hand was involved" in page
    assert ">steps</span>" in page
    assert ">silence</span>" in page


def test_a_hand_that_was_never_heard_has_a_page_too() -> None:
    trace = copy_of(short_run())
    trace.rows = {k: v for k, v in trace.rows.items() if k[0].endswith("cmd")}
    view = Recording.of(trace)
    page = render(judge(view), view)
    parsed(page)
    assert "No state of this hand was received" in page


def test_nan_in_states_does_not_reach_the_drawing() -> None:
    from dexkit.conformance.mutants import plan_for

    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step"}))
    view = Recording.of(run_virtual(plan, gripper.NanVelocity))
    assert "nan" not in "".join(re.findall(r' d="[^"]*"', render(judge(view), view)))


def test_names_from_outside_are_escaped() -> None:
    view = Recording.of(short_run())
    page = render(judge(view, subject={"backend": "<script>alert(1)</script>"}), view)
    assert "script" not in parsed(page).counts


floats = st.floats(-1e6, 1e6)


@settings(max_examples=60)
@given(values=st.lists(floats, min_size=1, max_size=400), points=st.integers(10, 50))
def test_thinning_keeps_the_extremes_and_the_order(values: list[float], points: int) -> None:
    x, y = np.arange(len(values), dtype=float), np.array(values)
    xs, ys = thin(x, y, points)
    assert len(xs) <= max(points, len(values) if len(values) <= points else 0)
    assert (np.diff(xs) > 0).all()
    assert (ys.min(), ys.max()) == (y.min(), y.max())


@settings(max_examples=60)
@given(low=floats, width=st.floats(1e-3, 1e6))
def test_ticks_lie_within_and_are_few(low: float, width: float) -> None:
    ticks = nice_ticks(low, low + width)
    assert 1 <= len(ticks) <= 12
    slack = 1e-6 * max(1.0, abs(low), width)
    assert all(low - slack <= t <= low + width + slack for t in ticks)


def test_a_curve_is_cut_where_samples_are_missing() -> None:
    x = np.concatenate((np.arange(0, 1, 0.01), np.arange(3, 4, 0.01)))
    assert [len(p[0]) for p in pieces(x, x)] == [100, 100]
