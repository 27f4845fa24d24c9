"""Print a result as a table on a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import rich.markup
from rich.table import Table
from rich.text import Text

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Overall, Result, RunResult, Verdict, grouped, worst
from dexkit.conformance.report.card import (
    Card,
    blocked_groups,
    cards,
    near_limits,
    told,
    what_is_wrong,
)
from dexkit.conformance.report.labels import about_harness, catch_sentence
from dexkit.console import Console
from dexkit.console import markup as escape
from dexkit.escaping import REMARK, one_line

__all__ = ["MARKS", "print_result"]

MARKS = {
    Verdict.PASS: ("pass", "green"),
    Verdict.FAIL: ("FAIL", "bold red"),
    Verdict.WARN: ("warn", "yellow"),
    Verdict.NOT_CLAIMED: ("not claimed", "dim"),
    Verdict.NOT_APPLICABLE: ("not applicable", "dim"),
    Verdict.BLOCKED: ("blocked", "magenta"),
    Verdict.ERROR: ("ERROR", "bold magenta"),
}
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN)
_UNJUDGED = (Verdict.NOT_APPLICABLE, Verdict.NOT_CLAIMED)
_STYLE = {Overall.PASS: "green", Overall.FAIL: "red", Overall.INCONCLUSIVE: "magenta"}


def print_result(
    result: RunResult, console: Console, *, verbose: bool = False, more: str = ""
) -> None:
    """Print the table, then the failures with advice, what is wrong in a few sentences, the two
    grades, and the verdict of the run.

    :param verbose: also list what could not be judged here, and why.
    :param more: where else the reasons are written.
    """
    hidden = _print_table(result.results, console, verbose)
    if result.client:
        console.print("\n[bold]The client that commanded the hands, not the hands:[/bold]")
        hidden += _print_table(result.client, console, verbose)
    if hidden:
        console.print(
            f"[dim]{hidden} {'requirement' if hidden == 1 else 'requirements'} could not be judged "
            f"here, or {'is' if hidden == 1 else 'are'} not claimed, and "
            f"{'is' if hidden == 1 else 'are'} not shown{f' ({more})' if more else ''}.[/dim]"
        )
    for card in cards(result, _TROUBLE):
        console.print()
        _print_card(card, console)
    _print_blocked(result, console)
    for text in near_limits(result):
        console.print(f"[yellow]{_hung(console, '', text)}[/]", highlight=False, soft_wrap=True)
    if verbose:
        reasons: dict[tuple[str, str], list[str]] = {}
        for entry in [*result.results, *result.client]:
            if entry.verdict in _UNJUDGED:
                reasons.setdefault((entry.requirement.id, entry.reason), []).append(entry.side)
        if reasons:
            console.print("\n[dim]not judged:[/dim]")
        for (id_, reason), on in reasons.items():
            text = _hung(console, f"  {id_} {' and '.join(on)}: ", reason)
            console.print(f"[dim]{text}[/dim]", soft_wrap=True)
    stages = ", ".join(f"{side} {stage}" for side, stage in result.stage.items())
    if stages:
        console.print(f"[dim]stage reached: {escape(stages)}[/dim]", highlight=False)
    if harness := about_harness(result):
        console.print(f"[dim]test machine: {escape(harness)}[/dim]", highlight=False)
    if digest := result.subject.get("recording_sha256"):
        text = f"recording judged: SHA-256 {digest}"
        console.print(f"[dim]{escape(text)}[/dim]", highlight=False, soft_wrap=True)
    for note in result.notes:
        console.print(f"[dim]note: {escape(note)}[/dim]", highlight=False)
    _print_stories(result, console)
    console.print()
    # one line each at any width, so that logs can be searched for them
    console.print(f"[dim]{escape(catch_sentence(result))}[/dim]", highlight=False, soft_wrap=True)
    if result.client and not result.client_only:
        console.print(escape(result.client_sentence()), highlight=False, soft_wrap=True)
    for grade in () if result.client_only else map(result.grade, Kind):
        style = _STYLE[grade.overall] if grade.judged else "dim"
        console.print(f"[{style}]{escape(grade.sentence())}[/]", highlight=False, soft_wrap=True)
    console.print(
        f"[bold {_STYLE[result.overall]}]{escape(result.sentence())}[/]",
        highlight=False,
        soft_wrap=True,
    )


def _print_table(results: Sequence[Result], console: Console, verbose: bool) -> int:
    """Print the table of these results; how many requirements it leaves out.

    :param verbose: leave out none.
    """
    if not results:
        return 0
    sides = list(dict.fromkeys(r.side for r in results))
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 1, 0, 0))
    table.add_column("requirement", no_wrap=True)
    table.add_column("level", style="dim")
    table.add_column("what")
    table.add_column("verdict", no_wrap=True)
    for side in sides:
        table.add_column(side)
    hidden = 0
    for requirement, group in grouped(results):
        verdict = worst(r.verdict for r in group)
        if verdict in _UNJUDGED and not verbose:
            hidden += 1
            continue
        mark, style = MARKS[verdict]
        cells = {r.side: _cell(r) for r in group}
        table.add_row(
            # Text objects, because rich parses a string as markup each time it measures it
            Text(one_line(requirement.id)),
            Text(str(requirement.level)),
            Text(one_line(requirement.title)),
            Text(mark, style),
            *(cells.get(side, Text()) for side in sides),
        )
    console.print(table)
    return hidden


def _print_card(card: Card, console: Console) -> None:
    need = card.requirement
    console.print(
        f"[bold]{escape(need.id)}[/] ({need.level}) {escape(card.sides)}: {card.verdict}",
        highlight=False,
    )
    for fact in card.facts():
        side = f"{fact.sides}: " if fact.sides else ""
        label = f"{fact.item}:"
        console.print(_hung(console, f"  {label:<9} ", side + fact.text), soft_wrap=True)


def _hung(console: Console, head: str, text: str) -> str:
    """``text`` after ``head``, further lines indented below the first one, as markup."""
    filled = textwrap.fill(
        one_line(" ".join(text.split()), REMARK),
        console.width,
        initial_indent=head,
        subsequent_indent=" " * max(2, min(len(head), 12)),
        break_long_words=False,
        break_on_hyphens=False,
    )
    return rich.markup.escape(filled)


def _print_stories(result: RunResult, console: Console) -> None:
    """Print what is wrong, likeliest first, and what follows from it."""
    stories = told(result)
    if stories:
        several = ", likeliest first" if len(stories) > 1 else ""
        console.print(f"\n[bold]{what_is_wrong(result)}{several}:[/bold]", highlight=False)
    for number, each in enumerate(stories, 1):
        text = _hung(console, f"{number:>3}. ", f"{each.story.sentence} ({each.whose})")
        style = "bold red" if number == 1 and result.overall is Overall.FAIL else "default"
        console.print(f"[{style}]{text}[/]", highlight=False, soft_wrap=True)
        if each.also:
            names = "; ".join(f"{c.requirement.id} {c.figures}".strip() for c in each.also)
            text = _hung(console, "     ", f"{each.seen}: {names}")
            console.print(f"[dim]{text}[/]", highlight=False, soft_wrap=True)


def _print_blocked(result: RunResult, console: Console) -> None:
    """Print the blocked requirements: another one failed first, or the machine was too busy."""
    groups = blocked_groups(result.results)
    if groups:
        console.print()
    for blocked in groups:
        names = ", ".join(card.requirement.id for card in blocked.cards)
        text = _hung(console, "", f"{blocked.reason}: {names}")
        console.print(f"[magenta]{text}[/]", highlight=False, soft_wrap=True)


def _cell(result: Result) -> Text:
    mark, style = MARKS[result.verdict]
    return Text(one_line(result.figure or mark), style)
