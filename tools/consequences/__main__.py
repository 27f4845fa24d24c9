"""Command line: ``python -m tools.consequences``, which ``make consequences`` runs."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import click
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dexkit.conformance.faults.matrix import in_processes
from dexkit.conformance.kit.requirements import Level
from dexkit.console import Console
from dexkit.models import MODELS
from dexkit.stop_signals import stop_on_signals
from tools.consequences.kinds import consequences
from tools.consequences.table import FILE, Table, told
from tools.consequences.work import Task, default_folder, known, tasks, work


@click.command("consequences")
@click.option(
    "--only",
    multiple=True,
    metavar="TEXT",
    help="Only wrong hands with TEXT in their name: 'dds dex3-1', a class, a requirement.",
)
@click.option("--jobs", "-j", type=click.IntRange(1), help="Processes; one per processor.")
@click.option("--kept", is_flag=True, help="Measure nothing; use what is kept.")
@click.option("--verbose", "-v", is_flag=True, help="Print the consequences of each hand.")
@click.option(
    "--cache",
    type=click.Path(file_okay=False, path_type=Path),
    default=default_folder,
    show_default=True,
    help="Where figures are kept.",
)
@click.pass_context
def main(
    context: click.Context,
    only: tuple[str, ...],
    jobs: int | None,
    kept: bool,
    verbose: bool,
    cache: Path,
) -> None:
    """Measure what clients suffer from each wrong hand, and write the table.

    Figures are kept, and not measured again after Ctrl-C. With --only the table is not written.

    Exit code: 0 done; 130 stopped.
    """
    console = Console()
    given = tasks(cache.absolute(), only)
    stopped = False
    if not kept:
        with stop_on_signals() as stop:
            _measure(console, [task for task in given if known(task) is None], stop, jobs)
            stopped = bool(stop)
    table = _table(given)
    if verbose:
        for name, kinds in table.hands.items():
            console.print(name, markup=False, highlight=False)
            for found in kinds.values():
                console.print(f"    {told(found, name.split()[1])}", markup=False, highlight=False)
    if not only:
        table.revision = _revision()
        table.save()
        console.print(f"{FILE}: {len(table.hands)} wrong hands", soft_wrap=True)
        _summary(console, table)
    if stopped:
        console.print("stopped; the same command goes on from here", style="yellow")
        context.exit(130)


def _measure(console: Console, given: Sequence[Task], stop: object, jobs: int | None) -> None:
    columns = (MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        shown = progress.add_task("", total=len(given))
        for task, broken in in_processes(work, given, stop, jobs):
            progress.update(shown, advance=1, description=task.name)
            if broken:
                console.print(broken, style="red", markup=False, soft_wrap=True)


def _table(given: Sequence[Task]) -> Table:
    """The table of what is kept."""
    good = {(t.model, t.dialect, t.sides): known(t) for t in given if t.mutant is None}
    table = Table()
    for task in given:
        found, reference = known(task), good[task.model, task.dialect, task.sides]
        if task.mutant is not None and found is not None and reference is not None:
            table.hands[task.name] = consequences(found, reference)
    return table


def _revision() -> str:
    """The commit of this code; with ``-dirty`` if files were changed since."""
    command = ("git", "describe", "--always", "--dirty", "--exclude=*")
    done = subprocess.run(command, cwd=FILE.parent, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def _summary(console: Console, table: Table) -> None:
    for model in MODELS:
        rows = [r for r in table.rows(model) if r.requirement.level is Level.MUST]
        groups = {
            "a consequence": [r for r in rows if r.own],
            "one only by hands that were made for others": [
                r for r in rows if r.shared and not r.own
            ],
            "none": [r for r in rows if r.proposed is Level.SHOULD],
            "none yet, not all of its hands are measured": [
                r for r in rows if r.proposed is Level.MUST and not r.own and not r.shared
            ],
        }
        console.print(f"{model}: {len(rows)} MUSTs", style="bold")
        for text, those in groups.items():
            ids = ", ".join(r.requirement.id for r in those)
            console.print(f"  {len(those)} have {text}: {ids}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
