"""Test how many wrong hands a run is said to catch, in every report."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rich.console import Console

from dexkit.conformance import hands
from dexkit.conformance.kit.catch_rates import BLAME_RATES, CATCH_RATES, wilson
from dexkit.conformance.kit.results import RunResult
from dexkit.conformance.report.badge import render_badge
from dexkit.conformance.report.html import render
from dexkit.conformance.report.junit import write_junit
from dexkit.conformance.report.labels import catch_sentence
from dexkit.conformance.report.markdown import render_markdown
from dexkit.conformance.report.terminal import print_result
from dexkit.escaping import html
from dexkit.models import HandModel
from dexkit.templates import plain
from tests.report_helpers import result_of_every_kind


def test_every_hand_of_dexkit_is_measured_in_quick_and_default_runs() -> None:
    models = {h.model.name for h in hands.BUILT_IN if isinstance(h.model, HandModel)}
    assert set(CATCH_RATES) == set(BLAME_RATES) == models
    for rates in (*CATCH_RATES.values(), *BLAME_RATES.values()):
        assert set(rates) >= {"quick", "default"}


def test_sentence_has_the_number_of_each_kind_of_run_with_its_interval() -> None:
    sentence = catch_sentence(result_of_every_kind())
    for rates in (CATCH_RATES, BLAME_RATES):
        hits, tried = rates["dex1-1"]["default"]
        low, high = (f"{100 * bound:.0f}" for bound in wilson(hits, tried))
        assert f"default run {hits} of {tried} (95 % interval {low} to {high} %)" in sentence


def renderings(result: RunResult, folder: Path) -> Iterator[tuple[str, str]]:
    """Each report's name, and its text without its own escapes."""
    sentence = catch_sentence(result)
    out = io.StringIO()
    print_result(result, Console(file=out, width=60))
    yield "terminal", out.getvalue()
    yield "page", render(result).replace(html(sentence), sentence)
    yield "Markdown", render_markdown(result).replace(plain(sentence), sentence)
    image = ElementTree.fromstring(render_badge(result))
    title = image.find("{http://www.w3.org/2000/svg}title")
    assert title is not None
    yield "title of the badge", title.text or ""
    write_junit(result, folder / "junit.xml")
    yield "JUnit", (folder / "junit.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize("model", ["dex1-1", "g1", "of another package"])
def test_every_report_has_the_sentence(model: str, tmp_path: Path) -> None:
    result = result_of_every_kind()
    result = replace(result, subject={**result.subject, "model": model})
    assert ("not been measured" in catch_sentence(result)) is (model != "dex1-1")
    for name, text in renderings(result, tmp_path):
        assert catch_sentence(result) in text, name


def test_wilson_interval() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(8, 10)
    assert (round(low, 3), round(high, 3)) == (0.490, 0.943)
    assert wilson(10, 10)[1] == pytest.approx(1.0)
