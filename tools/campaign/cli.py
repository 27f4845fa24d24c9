"""Command line of the campaign: ``python -m tools.campaign``."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from dexkit.errors import DexkitError, UsageError
from tools.campaign import isolation
from tools.campaign.case import ROOT, Case, Finding, Lane
from tools.campaign.engine import Engine, Worker
from tools.campaign.registry import all_cases, case, select
from tools.campaign.state import State

__all__ = ["main"]

SAMPLE_SEED = "sample"
MINUTES, SAMPLE_MINUTES = 10.0, 2.0
FINDING, OWN_FAILURE = 1, 2


@click.command(context_settings={"show_default": True, "help_option_names": ["-h", "--help"]})
@click.option(
    "--minutes",
    type=click.FloatRange(0, min_open=True),
    help=f"How long at most.  [default: {MINUTES:g}; {SAMPLE_MINUTES:g} for a sample]",
)
@click.option("--batches", type=click.IntRange(1), help="End when every case has had so many.")
@click.option("--seed", help="Of everything random.  [default: that of the state file, or 1]")
@click.option("--jobs", type=click.IntRange(1), help="Cores to use.  [default: all]")
@click.option("--only", default="", help="Beginnings of case names, with commas.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("campaign-out"),
    help="Folder of the state, the findings and the table.",
)
@click.option("--fresh", is_flag=True, help="Forget what was done before.")
@click.option("--sample", is_flag=True, help="Each case once, in miniature, with a fixed seed.")
@click.option("--list", "list_only", is_flag=True, help="List the cases.")
@click.option(
    "--repeat",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FINDING.json",
    help="Try one finding again.",
)
def command(
    minutes: float | None,
    batches: int | None,
    seed: str | None,
    jobs: int | None,
    only: str,
    out: Path,
    fresh: bool,
    sample: bool,
    list_only: bool,
    repeat: Path | None,
) -> int:
    """Try to break dexkit: fuzzers, unplugs, kills, hostile peers, full disks, a soak.

    A second call goes on where the first one ended. Ctrl-C prints the table so far.

    Exit code: 0 no finding, 1 a finding, 2 the campaign itself failed.
    """
    if list_only:
        for known in all_cases():
            click.echo(f"{known.name:40}  {known.unit:10}  {known.what}")
        return 0
    if repeat is not None:
        finding = Finding(
            **{k: v for k, v in json.loads(repeat.read_text()).items() if k != "repeat"}
        )
        return isolation.inside(lambda own: _repeat(finding, own))
    cases = select([name.strip() for name in only.split(",") if name.strip()])
    if sample:
        out, fresh, seed = out / "sample", True, seed or SAMPLE_SEED
    if fresh and out.exists():
        shutil.rmtree(out / "findings", ignore_errors=True)
    state = State.load(out, seed, fresh=fresh)
    cores = jobs or len(os.sched_getaffinity(0))
    seconds = 60.0 * (minutes or (SAMPLE_MINUTES if sample else MINUTES))

    def run(own: isolation.Isolation) -> int:
        return _campaign(cases, state, cores, seconds, batches, sample, own)

    return isolation.inside(run)


def _campaign(
    cases: Sequence[Case],
    state: State,
    jobs: int,
    seconds: float,
    batches: int | None,
    sample: bool,
    own: isolation.Isolation,
) -> int:
    click.echo(f"seed {state.seed}, {jobs} core(s), {seconds / 60:g} min, {len(cases)} cases")
    click.echo(str(own))
    line = _Line()
    engine = Engine(
        cases,
        state,
        jobs=jobs,
        seconds=seconds,
        batches=batches,
        sample=sample,
        own_network=own.network,
        report=line.report,
    )

    def stop(signum: int, frame: object) -> None:
        engine.stop()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
    engine.run()
    line.end()
    if engine.stopping:
        click.echo("interrupted; the table so far:")
    table = _table(cases, state)
    click.echo(table)
    (state.folder / "table.txt").write_text(table + "\n")
    (state.folder / "result.json").write_text(json.dumps(_result(cases, state), indent=1) + "\n")
    for name, text in engine.failures:
        click.echo(f"the campaign itself failed in {name}:\n{text}", err=True)
    if state.findings:
        return FINDING
    if sample and not engine.stopping:
        undone = [c.name for c in cases if not _done(state, c)]
        if undone:
            click.echo(f"not done in time: {', '.join(undone)}")
    return OWN_FAILURE if engine.failures else 0


def _done(state: State, chosen: Case) -> bool:
    progress = state.progress_of(chosen.name)
    return bool(progress.units or progress.skipped)


def _repeat(finding: Finding, own: isolation.Isolation) -> int:
    """Run it in a worker, under the watch of its time limit."""
    chosen = case(finding.case)
    home = Path.cwd()
    with open(os.devnull, "wb") as log:
        worker = Worker(0, chosen.lane, log, home, own_network=own.network)
        task: dict[str, Any] = {
            "case": finding.case,
            "seed": finding.seed,
            "batch": finding.batch,
            "only": finding.index,
            "seconds": 60.0 if chosen.lane is Lane.LONG else 1.0,
        }
        if finding.data:
            task["data"] = finding.data
        worker.give(chosen, task)
        import select as waiting

        ready, _, _ = waiting.select([worker.out], [], [], chosen.limit)
        answer = worker.read() if ready else None
        worker.kill()
    if answer is None:
        click.echo(f"{finding.case}: {'died' if ready else 'hangs'} again")
        return FINDING
    if answer["outcome"] == "failed":
        click.echo(answer["text"], err=True)
        return OWN_FAILURE
    for plain in answer["findings"]:
        again = Finding(**plain)
        same = "again" if again.id == finding.id else "something else"
        click.echo(f"{same}: {again.kind} in {again.place}\n{again.detail}")
    if not answer["findings"]:
        click.echo("not found again")
    return FINDING if answer["findings"] else 0


def _result(cases: Sequence[Case], state: State) -> dict[str, Any]:
    return {
        "seed": state.seed,
        "seconds": round(state.wall, 1),
        "cases": [
            {
                "name": c.name,
                "what": c.what,
                "unit": c.unit,
                "aim": c.aim,
                **vars(state.progress_of(c.name)),
                "findings": [f.id for f in state.findings.values() if f.case == c.name],
            }
            for c in cases
        ],
        "findings": [
            {**f.as_dict(), "id": f.id, "times": state.times[f.id], "repeat": state.command(f)}
            for f in state.findings.values()
        ],
    }


def _table(cases: Sequence[Case], state: State) -> str:
    rows = [("case", "done", "unit", "aim", "per s", "findings", "")]
    totals: dict[str, int] = {}
    for chosen in cases:
        progress = state.progress_of(chosen.name)
        totals[chosen.unit] = totals.get(chosen.unit, 0) + progress.units
        found = sum(f.case == chosen.name for f in state.findings.values())
        note = "; ".join(progress.notes[-2:])
        if progress.skipped:
            note = f"not run: {progress.skipped}"
        elif progress.failed:
            note = "failed: " + progress.failed.strip().splitlines()[-1]
        rate = progress.units / progress.seconds if progress.seconds else 0.0
        rows.append(
            (
                chosen.name,
                f"{progress.units:,}",
                chosen.unit,
                f"{chosen.aim:,}",
                f"{rate:,.0f}" if rate >= 10 else f"{rate:.2f}",
                str(found) if found else "-",
                note,
            )
        )
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(w) if i in (0, 2) else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append("  ".join([*cells, row[6]]).rstrip())
    total = ", ".join(f"{count:,} {unit}" for unit, count in totals.items())
    lines += ["", f"total: {total} in {state.wall / 60:.1f} min, seed {state.seed}"]
    if not state.findings:
        lines.append("no finding")
    for finding in state.findings.values():
        last = (finding.detail.strip().splitlines() or [""])[-1]
        lines += [
            f"FINDING {finding.case}: {finding.kind} in {finding.place} "
            f"({state.times[finding.id]} times)",
            f"  {last[:200]}",
            f"  {state.command(finding)}",
        ]
    return "\n".join(lines)


class _Line:
    """Progress: one line that is written over on a terminal, one each half minute in a log."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._calls = 0
        self._width = 0

    def report(self, text: str) -> None:
        if text.endswith("\n"):
            self.end()
            sys.stderr.write(text)
        elif self._terminal:
            width = shutil.get_terminal_size().columns - 1
            sys.stderr.write("\r" + text[:width].ljust(self._width))
            self._width = min(len(text), width)
        else:
            if self._calls % 30 == 0:
                sys.stderr.write(text + "\n")
            self._calls += 1
        sys.stderr.flush()

    def end(self) -> None:
        if self._terminal and self._width:
            sys.stderr.write("\n")
            self._width = 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line; the exit code."""
    os.chdir(ROOT)
    try:
        result = command.main(
            args=argv, standalone_mode=False, prog_name="python -m tools.campaign"
        )
        return int(result or 0)
    except click.ClickException as error:
        error.show()
    except click.exceptions.Abort:
        click.echo("interrupted", err=True)
    except (DexkitError, UsageError) as error:
        click.echo(f"error: {error}", err=True)
        if error.hint:
            click.echo(f"  {error.hint}", err=True)
    return OWN_FAILURE
