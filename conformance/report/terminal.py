"""The result as a table for a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dexkit.conformance.report.wording import about_harness
from dexkit.conformance.results import Overall, Result, RunResult, Verdict, worst

__all__ = ["MARKS", "print_result"]

MARKS = {
    Verdict.PASS: ("pass", "green"),
    Verdict.FAIL: ("FAIL", "bold red"),
    Verdict.WARN: ("warn", "yellow"),
    Verdict.NOT_CLAIMED: ("not claimed", "dim"),
    Verdict.NOT_APPLICABLE: ("n/a", "dim"),
    Verdict.BLOCKED: ("blocked", "magenta"),
    Verdict.ERROR: ("ERROR", "bold magenta"),
}
_UNJUDGED = (Verdict.NOT_APPLICABLE, Verdict.NOT_CLAIMED)
_STYLE = {Overall.PASS: "green", Overall.FAIL: "red", Overall.INCONCLUSIVE: "magenta"}


def print_result(
    result: RunResult, console: Console, *, verbose: bool = False, more: str = ""
) -> None:
    """Print the table, then what is wrong and what to try.

    :param verbose: also list what could not be judged here, and why.
    :param more: where else the reader finds why.
    """
    sides = list(dict.fromkeys(r.side for r in result.results))
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 1, 0, 0))
    table.add_column("requirement", no_wrap=True)
    table.add_column("level", style="dim")
    table.add_column("what")
    table.add_column("verdict", no_wrap=True)
    for side in sides:
        table.add_column(side)
    hidden = 0
    for requirement, group in result.by_requirement():
        verdict = worst(r.verdict for r in group)
        if verdict in _UNJUDGED and not verbose:
            hidden += 1
            continue
        mark, style = MARKS[verdict]
        cells = {r.side: _cell(r) for r in group}
        table.add_row(
            requirement.id,
            str(requirement.level),
            requirement.title,
            f"[{style}]{mark}[/]",
            *(cells.get(side, "") for side in sides),
        )
    console.print(table)
    if hidden:
        console.print(
            f"[dim]{hidden} requirement(s) could not be judged here, or are not claimed, and are "
            "not shown"
            f"{f' ({more})' if more else ''}.[/dim]"
        )
    troubles = [r for r in result.results if r.verdict in (Verdict.FAIL, Verdict.ERROR)]
    warned = [r for r in result.results if r.verdict is Verdict.WARN]
    for entry in troubles + warned:
        console.print()
        console.print(escape(entry.explain()), highlight=False)
    _print_blocked(result, console)
    if verbose:
        reasons = [r for r in result.results if r.verdict in _UNJUDGED]
        if reasons:
            console.print("\n[dim]not judged:[/dim]")
        for entry in reasons:
            console.print(
                f"[dim]  {entry.requirement.id} {entry.side}: {escape(entry.reason)}[/dim]",
                highlight=False,
            )
    stages = ", ".join(f"{side} {stage}" for side, stage in result.stage.items())
    if stages:
        console.print(f"[dim]stage reached: {escape(stages)}[/dim]", highlight=False)
    if harness := about_harness(result):
        console.print(f"[dim]test machine: {escape(harness)}[/dim]", highlight=False)
    for note in result.notes:
        console.print(f"[dim]note: {escape(note)}[/dim]", highlight=False)
    console.print()
    console.print(f"[bold {_STYLE[result.overall]}]{escape(result.sentence())}[/]", highlight=False)


def _print_blocked(result: RunResult, console: Console) -> None:
    """What was not judged because something else failed first, by what that was."""
    groups: dict[str, dict[str, None]] = {}
    for entry in result.results:
        if entry.verdict is Verdict.BLOCKED:
            groups.setdefault(entry.reason, {})[entry.requirement.id] = None
    if groups:
        console.print()
    for reason, names in groups.items():
        console.print(f"[magenta]{escape(reason)}[/]: {', '.join(names)}", highlight=False)


def _cell(result: Result) -> str:
    mark, style = MARKS[result.verdict]
    return f"[{style}]{escape(result.figure or mark)}[/]"
