"""Command line of the campaign: ``python -m tools.campaign``."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import click

from dexkit.errors import DexkitError
from tools.campaign import isolation
from tools.campaign.case import ROOT, Case, Finding
from tools.campaign.registry import all_cases, select
from tools.campaign.run import Campaign, repeat

__all__ = ["main"]

SAMPLE_SEED = "sample"
MINUTES, SAMPLE_MINUTES = 10.0, 4.0
FINDING, OWN_FAILURE = 1, 2


@click.command(context_settings={"show_default": True, "help_option_names": ["-h", "--help"]})
@click.option(
    "--minutes",
    type=click.FloatRange(0, min_open=True),
    help=f"How long at most.  [default: {MINUTES:g}; {SAMPLE_MINUTES:g} for a sample]",
)
@click.option("--seed", help="Of everything random.  [default: another one each time]")
@click.option("--jobs", type=click.IntRange(1), help="Cores to use.  [default: all]")
@click.option("--only", default="", help="Beginnings of case names, with commas.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("campaign-out"),
    help="Folder of the findings and the table.",
)
@click.option("--sample", is_flag=True, help="Each case once, in miniature, with a fixed seed.")
@click.option("--list", "list_only", is_flag=True, help="List the cases.")
@click.option(
    "--repeat",
    "again",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FINDING.json",
    help="Try one finding again.",
)
def command(
    minutes: float | None,
    seed: str | None,
    jobs: int | None,
    only: str,
    out: Path,
    sample: bool,
    list_only: bool,
    again: Path | None,
) -> int:
    """Try to break dexkit: fuzzers, unplugs, kills, a soak.

    Ctrl-C prints the table so far.

    Exit code: 0 no finding, 1 a finding, 2 the campaign itself failed.
    """
    if list_only:
        for known in all_cases():
            click.echo(f"{known.name:40}  {known.unit:10}  {known.what}")
        return 0
    if again is not None:
        plain = json.loads(again.read_text())
        plain.pop("repeat")
        return _repeat(Finding(**plain), own_network=not isolation.own_namespaces())
    cases = select([name.strip() for name in only.split(",") if name.strip()])
    if sample:
        out, seed = out / "sample", seed or SAMPLE_SEED
    seed = seed or str(int(time.time()))
    cores = jobs or len(os.sched_getaffinity(0))
    seconds = 60.0 * (minutes or (SAMPLE_MINUTES if sample else MINUTES))

    return _campaign(cases, seed, out, cores, seconds, sample)


def _campaign(
    cases: Sequence[Case],
    seed: str,
    out: Path,
    jobs: int,
    seconds: float,
    sample: bool,
) -> int:
    click.echo(f"seed {seed}, {jobs} core(s), {seconds / 60:g} min, {len(cases)} cases")
    if why := isolation.own_namespaces():
        click.echo(f"no network and mounts of its own ({why}): DDS domains from 20 up")
    line = _Line()
    campaign = Campaign(
        cases,
        seed,
        out,
        jobs=jobs,
        seconds=seconds,
        sample=sample,
        own_network=not why,
        report=line.report,
    )

    def stop(signum: int, frame: object) -> None:
        campaign.stop()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
    campaign.run()
    line.end()
    if campaign.stopping:
        click.echo("interrupted; the table so far:")
    click.echo(_table(campaign))
    _write_result(campaign, out / "result.json")
    failed = {name: p.failed for name, p in campaign.progress.items() if p.failed}
    for name, text in failed.items():
        click.echo(f"the campaign itself failed in {name}:\n{text}", err=True)
    if campaign.findings.found:
        return FINDING
    undone = [n for n, p in campaign.progress.items() if not (p.units or p.skipped or p.failed)]
    if sample and undone and not campaign.stopping:
        click.echo(f"not done in time: {', '.join(undone)}")
    return OWN_FAILURE if failed else 0


def _repeat(finding: Finding, *, own_network: bool) -> int:
    answer = repeat(finding, own_network=own_network)
    if answer["outcome"] == "failed":
        click.echo(answer["text"], err=True)
        return OWN_FAILURE
    for plain in answer["findings"]:
        found = Finding(**plain)
        same = "again" if found.id == finding.id else "something else"
        click.echo(f"{same}: {found.kind} in {found.place}\n{found.detail}")
    if not answer["findings"]:
        click.echo("not found again")
    return FINDING if answer["findings"] else 0


def _write_result(campaign: Campaign, path: Path) -> None:
    findings = campaign.findings
    content = {
        "seed": campaign.seed,
        "cases": [
            {"name": c.name, "what": c.what, "unit": c.unit, **vars(campaign.progress[c.name])}
            for c in campaign.cases
        ],
        "findings": [
            {
                **f.as_dict(),
                "id": f.id,
                "times": findings.times[f.id],
                "repeat": findings.command(f),
            }
            for f in findings.found.values()
        ],
    }
    path.write_text(json.dumps(content, indent=1) + "\n")


def _table(campaign: Campaign) -> str:
    findings = campaign.findings.found.values()
    rows = [("case", "done", "unit", "per s", "findings", "")]
    totals: dict[str, int] = {}
    for chosen in campaign.cases:
        progress = campaign.progress[chosen.name]
        totals[chosen.unit] = totals.get(chosen.unit, 0) + progress.units
        note = "; ".join(progress.notes)
        if progress.skipped:
            note = f"not run: {progress.skipped}"
        elif progress.failed:
            note = "failed: " + progress.failed.strip().splitlines()[-1]
        rate = progress.units / progress.seconds if progress.seconds else 0.0
        found = sum(f.case == chosen.name for f in findings)
        shown = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2f}"
        done = f"{progress.units:,}"
        rows.append((chosen.name, done, chosen.unit, shown, str(found or "-"), note))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(width) if i in (0, 2) else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append("  ".join([*cells, row[-1]]).rstrip())
    total = ", ".join(f"{count:,} {unit}" for unit, count in totals.items())
    took = time.monotonic() - campaign.began
    lines += ["", f"total: {total} in {took:.0f} s, seed {campaign.seed}"]
    if not findings:
        lines.append("no finding")
    for finding in findings:
        last = (finding.detail.strip().splitlines() or [""])[-1]
        lines += [
            f"FINDING {finding.case}: {finding.kind} in {finding.place} "
            f"({campaign.findings.times[finding.id]} times)",
            f"  {last[:200]}",
            f"  {campaign.findings.command(finding)}",
        ]
    return "\n".join(lines)


class _Line:
    """Progress: one line that is written over on a terminal, one each half minute in a log."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._next = 0.0

    def report(self, text: str) -> None:
        if text.endswith("\n"):
            sys.stderr.write(f"\r{text}" if self._terminal else text)
        elif self._terminal:
            width = shutil.get_terminal_size().columns - 1
            sys.stderr.write("\r" + text[:width].ljust(width))
        elif time.monotonic() > self._next:
            self._next = time.monotonic() + 30.0
            sys.stderr.write(text + "\n")
        sys.stderr.flush()

    def end(self) -> None:
        if self._terminal:
            sys.stderr.write("\n")


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
    except DexkitError as error:
        click.echo(f"error: {error}", err=True)
        if error.hint:
            click.echo(f"  {error.hint}", err=True)
    return OWN_FAILURE
