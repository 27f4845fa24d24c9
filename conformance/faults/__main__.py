"""Command line: ``python -m dexkit.conformance.faults``, of a checkout."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    FILE,
    OUTPUT_FILE,
    dialect_option,
    jobs_option,
    list_option,
    require_option,
    seed_option,
    verbose_option,
)
from dexkit.console import Console
from dexkit.documents import check_output_paths
from dexkit.errors import DexkitError, UsageError
from dexkit.models import MODELS
from dexkit.robots import ROBOTS
from dexkit.stop_signals import StopRequest, stop_on_signals

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dexkit.conformance.faults.generated.campaign import Campaign, Trial
    from dexkit.conformance.faults.matrix import Score, WrongHandResult
    from dexkit.conformance.faults.outsiders import Verdicts


def _follow(
    total: int, found: Iterator[WrongHandResult | Trial | Verdicts], stop: StopRequest
) -> None:
    """Show the progress of trials. Raises `click.Abort` when a signal stopped them."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"{total} hands", total=total)
        for done, outcome in enumerate(found, 1):
            text = f"{done} of {total}: {escape(outcome.name)}"
            progress.update(task, advance=1, description=text)
    if stop:
        raise click.Abort


def _end_with(
    result: Campaign | Score, console: Console, json_path: Path | None, *, verbose: bool
) -> NoReturn:
    """Print and write a result, and end with its exit code."""
    result.print(console, verbose=verbose)
    if json_path:
        result.write_json(json_path)
    sys.exit(0 if result.perfect else 1)


def _try_outsiders(source: str, console: Console, json_path: Path | None, jobs: int | None) -> None:
    """Try the hands of a file or module, and end with the exit code."""
    from dexkit.conformance.faults import outsiders

    hands = outsiders.load(source)
    by_index: dict[int, Verdicts] = {}

    def each() -> Iterator[Verdicts]:
        for index, verdicts in outsiders.try_all(source, len(hands), stop, jobs):
            by_index[index] = verdicts
            yield verdicts

    try:
        with stop_on_signals() as stop:
            _follow(len(hands), each(), stop)
    finally:  # what is done is kept when it is stopped, or a hand ends its process
        found = [by_index[index] for index in sorted(by_index)]
        outsiders.print_verdicts(console, found)
        if json_path:
            outsiders.write_verdicts(json_path, found)
    sys.exit(0 if all(v.right for v in found) else 1)


@click.command(
    cls=Command,
    exit_codes={
        0: "every requirement detects its wrong hand; with --generated and --from, every wrong "
        "hand is caught, and no good one fails or gets a warning",
        1: "a wrong hand is missed or fails another requirement, a requirement has none, or a "
        "good hand is blamed",
        2: "no hand is selected",
    },
)
@click.option(
    "--model",
    type=click.Choice([*MODELS, *ROBOTS]),
    help="Only wrong hands, or robots, of this model.",
)
@require_option("DEX1-SAFE")
@click.option(
    "--generated",
    type=click.IntRange(1, 1_000_000),
    metavar="N",
    help="Try N hands generated from faults, places and conditions.",
)
@click.option(
    "--good",
    is_flag=True,
    help="With --generated: good hands, which must not fail or get a warning.",
)
@seed_option("--generated", 1)
@click.option("--quick", is_flag=True, help="With --generated: judge them in quick runs.")
@click.option(
    "--thorough",
    is_flag=True,
    help="With --generated: in thorough runs, which take ten times as long.",
)
@click.option(
    "--outside",
    is_flag=True,
    help="With --generated: judge them as a vendor's own service is: no restart, no object.",
)
@dialect_option("With --generated: only hands with this dialect.")
@click.option("--hand", "names", multiple=True, metavar="NAME", help="Try this generated hand.")
@click.option(
    "--resume",
    type=FILE,
    metavar="FILE",
    help="With --generated: store results in this file, and skip hands that have one.",
)
@click.option(
    "--from", "source", metavar="FILE_OR_MODULE", help="Try the hands of a Python file or module."
)
@list_option("Only list the hands, with model, requirement and sides.")
@click.option(
    "--result", "json_path", type=OUTPUT_FILE, metavar="FILE", help="Write the score as JSON."
)
@jobs_option()
@verbose_option("Print the fault of every wrong hand.")
def command(
    model: str | None,
    require: tuple[str, ...],
    generated: int | None,
    good: bool,
    seed: int,
    quick: bool,
    thorough: bool,
    outside: bool,
    dialect: str | None,
    names: tuple[str, ...],
    resume: Path | None,
    source: str | None,
    list_only: bool,
    json_path: Path | None,
    jobs: int | None,
    verbose: bool,
) -> None:
    """Test the conformance checks with hands that are known to be wrong.

    Each wrong hand (a mutant) is a correct hand with one fault. The checks must detect it by the
    requirement that it breaks, and report no other. Runs use a virtual clock, without device and
    DDS.

    With --generated, hands are combined from faults, places and conditions, and judged in default,
    quick or thorough runs like those of the conformance suite. With --from, the hands are your own
    (docs/mutants.md).
    """
    if sum((generated is not None or bool(names), source is not None, bool(require))) > 1:
        raise UsageError("--generated, --hand, --from and --require cannot be combined")
    if (
        generated is None
        and not names
        and (good or dialect or resume or quick or thorough or outside)
    ):
        raise UsageError(
            "--good, --quick, --thorough, --outside, --dialect and --resume need --generated"
        )
    if quick and thorough:
        raise UsageError("--quick and --thorough exclude each other")
    if source is not None and model is not None:
        raise UsageError(
            "--model cannot be combined with --from: the file's hands have their models",
            hint="leave out --model",
        )
    if list_only and (json_path or source is not None or resume):
        raise UsageError(
            "--list tries no hand; it can be combined with --model, --require and --generated"
        )
    if json_path:
        json_path = json_path.absolute()
    if resume:
        resume = resume.absolute()
    check_output_paths([json_path, resume])
    console = Console()
    if source is not None:
        _try_outsiders(source, console, json_path, jobs)
        return
    # Python's worker processes begin with the working folder in front of their import path
    os.chdir("/")
    if generated is not None or names:
        from dexkit.conformance.faults.generated import dialects, parse, sample, sample_good
        from dexkit.conformance.faults.generated.campaign import Campaign
        from dexkit.conformance.kit.selection import RunKind

        if model in ROBOTS:
            raise UsageError(f"{model} is a robot; only hands are generated")
        hands = [parse(name) for name in names]
        if generated is not None:
            spoken = dialects(model, dialect)
            hands += (sample_good if good else sample)(generated, seed, spoken)
        if list_only:
            for each in hands:
                grade = "good" if each.good else "wrong"
                console.print(f"{grade:5}  {each.name}", markup=False, highlight=False)
            return
        kind = RunKind.QUICK if quick else RunKind.THOROUGH if thorough else RunKind.DEFAULT
        campaign = Campaign(seed, resume, kind=kind, outside=outside)
        with stop_on_signals() as stop:
            _follow(len(hands), campaign.run(hands, stop, jobs), stop)
        _end_with(campaign, console, json_path, verbose=verbose)
    from dexkit.conformance.faults.matrix import Score, chosen, print_list

    requirements, trials = chosen(model, require)
    if list_only:
        print_list(console, trials)
        return
    score = Score(requirements)
    with stop_on_signals() as stop:
        _follow(len(trials), score.run(trials, stop, jobs), stop)
    _end_with(score, console, json_path, verbose=verbose)


def main() -> None:
    """Run the command; an error is a line with a hint."""
    try:
        command.main(prog_name="python -m dexkit.conformance.faults")
    except DexkitError as error:
        click.echo(f"error: {error.message}\n  {error.hint}", err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":  # the worker processes import this module, too
    main()
