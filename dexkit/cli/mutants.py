"""``dexkit mutants``: test the conformance checks on deliberately wrong hands."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from dexkit.cli.options import FILE, require_option, verbose_option
from dexkit.console import Console
from dexkit.models import MODELS
from dexkit.robots import ROBOTS
from dexkit.stop_signals import stop_on_signals


@click.command("mutants")
@click.option(
    "--model",
    type=click.Choice([*MODELS, *ROBOTS]),
    help="Only wrong hands, or robots, of this model.",
)
@require_option("DEX1-SAFE")
@click.option("--json", "json_path", type=FILE, metavar="FILE", help="Write the score as JSON.")
@click.option(
    "--jobs", type=click.IntRange(1, 1024), help="Processes.  [default: one per processor]"
)
@verbose_option("Print what every wrong hand does wrong.")
def command(
    model: str | None,
    require: tuple[str, ...],
    json_path: Path | None,
    jobs: int | None,
    verbose: bool,
) -> None:
    """Try the conformance checks on hands that are known to be wrong.

    Each wrong hand (a mutant) changes one thing of a hand that does everything right. The checks
    must catch it by the requirement that it breaks, and find no other fault with it. It runs on a
    virtual clock: no device, no DDS.

    Exit code: 0 every requirement is proven by a wrong hand, 1 one is missed, wrongly blamed or
    has no wrong hand, 2 there is nothing to try.
    """
    from dexkit.conformance.mutants.matrix import Score, chosen

    if json_path:
        json_path = json_path.absolute()
    # Python's worker processes begin with the working folder in front of their import path
    os.chdir("/")
    console = Console()
    requirements, trials = chosen(model, require)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with (
        stop_on_signals() as stop,
        Progress(*columns, console=Console(stderr=True), transient=True) as progress,
    ):
        task = progress.add_task(f"{len(trials)} wrong hands", total=len(trials))
        score = Score(requirements)
        for outcome in score.run(trials, stop, jobs):
            done = len(score.outcomes)
            text = f"{done} of {len(trials)}: {outcome.name}"
            progress.update(task, advance=1, description=text)
        if stop:
            raise click.Abort
    score.print(console, verbose=verbose)
    if json_path:
        score.write_json(json_path)
    sys.exit(0 if score.perfect else 1)
