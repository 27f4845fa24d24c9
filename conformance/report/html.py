"""The page of a result: self-contained, no network, no script; light, dark, phone, print.

The page needs the result only. With the recording that was judged it also shows plots of the
evidence of each failure and of the whole run. Its text is in ``templates/result.html``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from dexkit.conformance.behaviours.operator import OPERATOR
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import CAPABILITIES, Kind
from dexkit.conformance.kit.results import (
    SEVERITY,
    Grade,
    Overall,
    Result,
    RunResult,
    Stage,
    Verdict,
    grouped,
    overall_of,
    worst,
)
from dexkit.conformance.report.card import (
    Card,
    Told,
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
    quantity,
    subject,
    utc_date,
    verdicts_by_area,
    whose,
)
from dexkit.conformance.report.pages import fill
from dexkit.conformance.report.result_plots import plots_of
from dexkit.conformance.report.run_plots import run_plots
from dexkit.documents import write_file

__all__ = ["render", "utc", "write_html"]

_PLOT_BUDGET = 1_000_000
"""Bytes of plots on a page; the failures after that have none."""
_BUSY = 0.2
"""Part of a run with programs waiting for a processor from which on the page reports it."""
_RECORDED_WITH = ("dexkit", "python", "numpy", "cyclonedds", "processor", "kernel", "seed")
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN, Verdict.BLOCKED)
_TROUBLES = {
    Verdict.WARN: "What could be better, and what to try",
    Verdict.BLOCKED: "What could not be judged",
}


def write_html(
    result: RunResult,
    view: Recording | None,
    path: Path,
    *,
    recording: Path | None = None,
) -> None:
    """Write the page.

    :param view: the recording that was judged, or None: no plots then.
    :param recording: its file, which the page links to; None for the name that the result has.
    """
    link = result.subject.get("recording", "")
    if recording is not None:
        link = Path(os.path.relpath(recording.absolute(), path.absolute().parent)).as_posix()
    write_file(path, render(result, view, link=link))


def render(result: RunResult, view: Recording | None = None, *, link: str = "") -> str:
    """Return the page as text.

    :param link: where the recording is, relative to the page; empty where it is not kept.
    """
    answer = ANSWERS[result.overall]
    answers = ", ".join(f"{k} {answer_of(result.grade(k)).text.lower()}" for k in Kind)
    about = "client" if result.client_only else answers
    hand, model = hand_name(result), model_title(result)
    grade, safety = result.grade(Kind.DROP_IN), result.grade(Kind.SAFETY)
    troubles = cards(result, _TROUBLE)
    return fill(
        "result.html",
        title=f"{answer.text} ({about}): {hand} as {model}",
        result=result,
        VERDICTS=VERDICTS,
        STAGES=list(Stage),
        # the verdict
        answer=answer if result.client_only else answer_of(grade),
        hand=hand,
        model=model,
        subject=subject(result),
        real=device_kind(result),
        part=part(result),
        sentence=f"Only {result.client_sentence()}."
        if result.client_only
        else _sentence(grade, subject(result)),
        busy=result.starved > _BUSY,
        harness=about_harness(result),
        near=near_limits(result),
        client_at_fault=not result.client_only
        and (overall_of(result.client) is Overall.FAIL or bool(result.spoiled_by)),
        safety={
            "answer": answer_of(safety),
            "sentence": _sentence(safety, subject(result)),
            "unmet": _unmet_in_safety(result),
        },
        catch_sentence=catch_sentence(result),
        facts=_facts(result),
        areas=(areas := _areas(result)),
        most=max((sum(n for _, n in counts) for counts in areas.values()), default=0),
        # what is wrong
        heading=what_is_wrong(result),
        stories=[(each, _shown(each, view)) for each in told(result)],
        follows={
            card.requirement.id: number
            for number, each in enumerate(told(result), 1)
            for card in each.also
        },
        cards=list(_with_plots(troubles, view)),
        blocked=[group for group in blocked_groups(result.results) if group.before],
        trouble=_TROUBLES.get(
            worst(card.verdict for card in troubles) if troubles else Verdict.BLOCKED,
            "What is wrong, and what to try",
        ),
        operator=_operator(result),
        recorded=view is not None,
        hands=run_plots(result, view) if view is not None else [],
        # every requirement
        link=link,
        file=Path(link).name,
        clients=grouped(result.client),
        client_sentence=capital(result.client_sentence()),
        made_with=[
            *result.environment.items(),
            *((f"recorded with {k}", result.run[k]) for k in _RECORDED_WITH if k in result.run),
        ],
        anchor=_anchor,
        card_of=Card.from_results,
        has_card=lambda group: any(r.id == group[0].id for card in troubles for r in card.results),
        quantity=quantity,
        utc_date=utc_date,
        whose=whose,
        worst=lambda group: worst(r.verdict for r in group),
    )


def _sentence(grade: Grade, what: str) -> str:
    """A grade in words, for readers who do not know the kit.

    :param what: hand or robot.
    """
    if not grade.judged:
        return f"Nothing of this could be tested, so nothing can be said of the {what} here."
    text = {
        Overall.PASS: f"This {what} did everything that it must and that could be tested here.",
        Overall.FAIL: f"This {what} broke at least one rule that it must keep.",
        Overall.INCONCLUSIVE: "A rule that must be kept could not be tested: this is not a pass.",
    }[grade.overall]
    if grade.overall is Overall.PASS and (n := grade.counts[Verdict.WARN]):
        text += f" {n} recommendation{'s are' if n > 1 else ' is'} not met."
    return text


def _unmet_in_safety(result: RunResult) -> list[tuple[object, list[Result]]]:
    return [
        (need, group)
        for need, group in result.by_requirement()
        if need.kind is Kind.SAFETY
        and worst(r.verdict for r in group) in (Verdict.FAIL, Verdict.WARN)
    ]


def _facts(result: RunResult) -> list[tuple[str, str]]:
    about = result.subject.items()
    rows = [(k.replace("_", " ").replace("sha256", "SHA-256"), v) for k, v in about if v]
    rows.append(("recorded", f"{utc(result.recorded_at)}, {result.duration_s:.1f} s"))
    if result.claims is not None:
        has = [name for name, claimed in result.claims.items() if claimed]
        lacks = [name for name in CAPABILITIES if name not in has]
        rows.append(("claimed units", ", ".join(has) or "none"))
        rows.append(("not claimed", ", ".join(lacks) or "none"))
    if harness := about_harness(result):
        rows.append(("test machine", harness))
    return rows


def utc(text: str) -> str:
    """An ISO time for readers."""
    try:
        return datetime.fromisoformat(text).strftime("%Y-%m-%d %H:%M:%S UTC")
    except ValueError:
        return text or "at an unknown time"


def _areas(result: RunResult) -> dict[str, list[tuple[Verdict, int]]]:
    """How often each verdict is in each area, from that which counts most."""
    return {
        area: [(v, verdicts.count(v)) for v in SEVERITY if v in verdicts]
        for area, verdicts in verdicts_by_area(result).items()
    }


def _anchor(area: str) -> str:
    return "area-" + "".join(c if c.isalnum() else "-" for c in area.lower())


def _with_plots(
    troubles: Sequence[Card], view: Recording | None
) -> Iterator[tuple[Card, list[Markup | None]]]:
    """Each card with the plots of its evidence; None where the page can hold no more."""
    left = _PLOT_BUDGET
    for card in troubles:
        figures: list[Markup | None] = []
        for result in card.results:
            if view is not None and left > 0:
                drawn = plots_of(result, view)
                left -= sum(map(len, drawn))
                figures += drawn
            elif view is not None:
                figures.append(None)
        yield card, figures


def _shown(each: Told, view: Recording | None) -> list[Markup]:
    """A plot of what the states show by themselves; a finding's are on its card."""
    if view is None or each.own is not None or not each.story.evidence:
        return []
    of_side = next(r for r in each.also[0].results if r.side in each.story.sides)
    samples = (Plot(PlotKind.SAMPLES),)
    return plots_of(replace(of_side, evidence=each.story.evidence[:1], plots=samples), view)


def _operator(result: RunResult) -> list[tuple[str, str]]:
    """The figures of the modelled operator, if there was one."""
    return [
        (need.title, " · ".join(f"{r.side} {r.figure or VERDICTS[r.verdict].text}" for r in group))
        for need, group in result.by_requirement()
        if need.phase == OPERATOR and any(r.verdict.judged for r in group)
    ]
