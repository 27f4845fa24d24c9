"""Render a result as Markdown: a step summary or comment on GitHub, or a wiki page.

External text is escaped: a hostile name cannot make HTML, table cells or mentions of a person.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Result, RunResult, Verdict, grouped
from dexkit.conformance.report.card import (
    Card,
    Fact,
    blocked_groups,
    cards,
    near_limits,
    told,
    what_is_wrong,
)
from dexkit.conformance.report.labels import (
    ANSWERS,
    VERDICTS,
    about_harness,
    answer_of,
    capital,
    catch_sentence,
    device_kind,
    hand_name,
    model_title,
    part,
    verdicts_by_area,
    whose,
)
from dexkit.conformance.report.pages import fill
from dexkit.templates import code

__all__ = ["render_markdown"]

MOST_CARDS = 25
"""Cards at most: a comment on GitHub holds 65536 characters."""
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN)


def render_markdown(result: RunResult) -> str:
    """The summary: verdict, the two grades, areas, failures, and all requirements folded."""
    found = cards(result, _TROUBLE)
    grades = [result.grade(kind) for kind in (() if result.client_only else Kind)]
    return fill(
        "result.md",
        result=result,
        VERDICTS=VERDICTS,
        answer=ANSWERS[result.overall],
        hand=hand_name(result),
        model=model_title(result),
        real=device_kind(result),
        counts=", ".join(f"{n} {VERDICTS[v].text}" for v, n in result.counts().items() if n),
        grades=[(answer_of(grade), grade) for grade in grades],
        part=part(result),
        harness=about_harness(result),
        catch_sentence=catch_sentence(result),
        areas=_areas(result),
        heading=what_is_wrong(result),
        stories=told(result)[:MOST_CARDS],
        cards=found[:MOST_CARDS],
        more=len(found) - MOST_CARDS,
        blocked=blocked_groups(result.results),
        near=near_limits(result),
        client_sentence=capital(result.client_sentence()),
        every=_every,
        facts=_facts,
        whose=whose,
    )


def _areas(result: RunResult) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of areas."""
    areas = verdicts_by_area(result)
    shown = [v for v in Verdict if any(v in verdicts for verdicts in areas.values())]
    rows = [[a, *(str(found.count(v) or "") for v in shown)] for a, found in areas.items()]
    return ["area", *(VERDICTS[v].text for v in shown)], rows


def _facts(card: Card) -> Iterator[Fact]:
    """The lines of a card; of several places, the first one of each side."""
    placed: set[str] = set()
    for fact in card.facts():
        if fact.place is None or fact.sides not in placed:
            yield fact
        if fact.place is not None:
            placed.add(fact.sides)


def _every(results: Sequence[Result]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of these results."""
    sides = list(dict.fromkeys(r.side for r in results))
    rows = []
    for need, group in grouped(results):
        words = {r.side: VERDICTS[r.verdict] for r in group}
        cells = {r.side: f"{words[r.side].mark} {r.figure or words[r.side].text}" for r in group}
        row = [code(need.id), str(need.level), need.title]
        rows.append([*row, *(cells.get(side, "") for side in sides)])
    return ["requirement", "level", "what", *sides], rows
