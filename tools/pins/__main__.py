"""Command line: ``python -m tools.pins``, which ``make pins`` runs."""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from pathlib import Path

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dexkit.conformance.faults.matrix import in_processes
from dexkit.console import Console
from dexkit.errors import DexkitError
from dexkit.stop_signals import StopRequest, stop_on_signals
from tools.pins.matrix import found_pins, tasks, tried
from tools.pins.pinned import FOLDER, Pins
from tools.pins.store import Store, default_folder
from tools.pins.trial import Task, same_again
from tools.pins.verdicts import Verdicts

_GB = 1e9


@click.command("pins")
@click.option("--update", is_flag=True, help="Write what is found as the pinned verdicts.")
@click.option(
    "--only",
    multiple=True,
    metavar="TEXT",
    help="Only those with TEXT in their name: dds-dex3-1, a class, a requirement, a sample.",
)
@click.option(
    "--audit",
    type=click.IntRange(1),
    metavar="N",
    help="Instead, play N of the kept recordings again: are they still the same?",
)
@click.option("--jobs", "-j", type=click.IntRange(1), help="Processes; one per processor.")
@click.option(
    "--cache",
    type=click.Path(file_okay=False, path_type=Path),
    default=default_folder,
    show_default=True,
    help="Where recordings and verdicts are kept.",
)
@click.option(
    "--most",
    type=click.FloatRange(0),
    default=4.0,
    show_default=True,
    metavar="GB",
    help="How much of them is kept.",
)
@click.option(
    "--pinned",
    type=click.Path(file_okay=False, path_type=Path),
    default=FOLDER,
    help="Folder of the pinned verdicts; tests/pinned by default.",
)
@click.pass_context
def main(
    context: click.Context,
    update: bool,
    only: tuple[str, ...],
    audit: int | None,
    jobs: int | None,
    cache: Path,
    most: float,
    pinned: Path,
) -> None:
    """Say whether every wrong hand and every sample is judged as pinned.

    Prints what differs: of a wrong hand the requirements that newly (+) or no longer (-) find fault
    with it, of a sample each verdict or figure. What was done is kept, and not done again after
    Ctrl-C.

    Exit code: 0 all as pinned, or written; 1 something differs; 2 the options make no sense; 130
    stopped.
    """
    console = Console()
    try:
        with stop_on_signals() as stop:
            given = tasks(cache.absolute(), only)
            if audit:
                differs = _audit(console, given, audit, stop, jobs)
            else:
                pins = Pins.load(pinned)
                found, complete = _try(console, given, stop, jobs)
                everything = complete and not only
                lines = list(pins.differences(found, everything=everything))
                for line in lines:
                    console.print(line, markup=False, soft_wrap=True)
                style = "red" if lines else "green"
                console.print(f"{len(lines)} differences", style=style)
                differs = bool(lines)
                if update and complete:
                    pins.updated(found, everything=everything).save(pinned)
                    differs = False
            if stop:
                console.print("stopped; the same command goes on from here", style="yellow")
                context.exit(130)
            left, removed = Store(cache).tidy(most * _GB)
    except DexkitError as error:
        raise click.UsageError(f"{error.message}\n{error.hint}", context) from error
    gone = f", {removed / _GB:.2f} GB not used for longest removed" if removed else ""
    console.print(f"{cache}: {left / _GB:.2f} GB of at most {most:g}{gone}", soft_wrap=True)
    context.exit(1 if differs else 0)


def _progress() -> Progress:
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    return Progress(*columns, console=Console(stderr=True), transient=True)


def _try(
    console: Console, given: Sequence[Task], stop: StopRequest, jobs: int | None
) -> tuple[Pins, bool]:
    """The pins that are found, and whether all are."""
    begin = time.monotonic()
    verdicts: dict[str, Verdicts] = {}
    judged = played = 0
    with _progress() as progress:
        shown = progress.add_task("", total=len(given))
        for task, done in tried(given, stop, jobs):
            verdicts[task.name] = done.verdicts
            judged += done.judged > 0
            played += done.played
            progress.update(shown, advance=1, description=task.name)
    console.print(
        f"{len(verdicts)} of {len(given)} hands and samples; {judged} of them judged, {played} of "
        f"those played, in {time.monotonic() - begin:.0f} s",
        soft_wrap=True,
    )
    tasks_done = [task for task in given if task.name in verdicts]
    return found_pins(tasks_done, verdicts), len(tasks_done) == len(given)


def _audit(
    console: Console, given: Sequence[Task], count: int, stop: StopRequest, jobs: int | None
) -> bool:
    """Play some hands again; whether one plays something else than what is kept."""
    hands = [task for task in given if task.mutant is not None]
    chosen = random.sample(hands, min(count, len(hands)))
    same = differ = 0
    with _progress() as progress:
        shown = progress.add_task("", total=len(chosen))
        for task, result in in_processes(same_again, chosen, stop, jobs):
            progress.update(shown, advance=1, description=task.name)
            same += result is True
            if result is False:
                differ += 1
                console.print(f"{task.name}: plays something else than what is kept", markup=False)
    unknown = len(chosen) - same - differ
    text = f"{same} recordings are still the same, {differ} are not, {unknown} are not kept"
    console.print(text, style="red" if differ else "green")
    return differ > 0


if __name__ == "__main__":
    main()
