"""``dexkit audit``: judge every episode of an archive."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import Number, jobs_option, out_option
from dexkit.cli.settings import Setting, Settings, settings_option
from dexkit.cli.status_line import StatusLine
from dexkit.console import Console
from dexkit.errors import ConformanceError
from dexkit.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from dexkit.conformance.audit.audit import AuditProgress

_STATUS_PERIOD = 0.2  # seconds
_FAIL_ON = ("never", "fail", "unusable", "warn")
_PARQUET = {"auto": None, "parquet": True, "jsonl": False}
_SETTINGS = (
    Setting(
        "format",
        "|".join(_PARQUET),
        click.Choice([*_PARQUET]),
        "Format of the tables; auto is Parquet if pyarrow is installed.",
        "auto",
    ),
    Setting(
        "cameras",
        "yes|no",
        click.Choice(["yes", "no"]),
        "Look at pictures, as far as they can be decoded; no is quicker.",
        "yes",
    ),
    Setting("timeout", "S", Number(min=1), "Seconds for one task: a file.", 600.0),
    Setting("memory", "MIB", click.IntRange(256, 2**24), "Memory for one process.", 4096),
)


@click.command(
    "audit",
    cls=Command,
    exit_codes={
        0: "no episode is to be dropped, and hands in recordings meet every MUST",
        1: "an episode is to be dropped, or a MUST is not met",
        2: "an episode is not usable, damaged or inconclusive, or there is none; see --fail-on",
    },
)
@click.argument("locations", nargs=-1, required=True, metavar="PATH|URL...")
@out_option(
    "Folder for journal, tables and page. Results of unchanged episodes are reused.",
    "audit-out",
)
@click.option(
    "--fail-on",
    type=click.Choice(_FAIL_ON),
    default="unusable",
    show_default=True,
    help="Which findings make the exit code non-zero; each level includes those before it.",
)
@jobs_option()
@click.option(
    "--ray",
    is_flag=False,
    flag_value="auto",
    metavar="[ADDRESS]",
    help="Judge on a Ray cluster (extra [ray]): at HOST:PORT, the running one of this machine "
    "(auto, the default without ADDRESS), or a new one for this audit only (local).",
)
@settings_option(_SETTINGS)
def command(
    locations: tuple[str, ...],
    out: Path,
    fail_on: str,
    jobs: int | None,
    ray: str | None,
    settings: Settings,
) -> None:
    """Say of every episode whether to train on it: keep, review or drop, and why.

    Episodes are those of LeRobot datasets, task folders of xr_teleoperate, recordings (mcap) and
    ROS 2 bags, in folders or behind URLs, mixed as they are. The hands in recordings of the wire
    are judged as well, as 'dexkit check' does.

    Writes a row for each episode and finding, as Parquet or JSON lines, a summary page, and
    episodes.json, with which 'dexkit export --drop' makes the cleaned set. A faulty file becomes a
    row and does not stop the audit. Run the same command again to continue a stopped audit
    (docs/audit.md).
    """
    from dexkit.conformance.audit.audit import FAIL_ON, Audit, Limits
    from dexkit.conformance.audit.cluster import Cluster

    assert _FAIL_ON == FAIL_ON
    if ray is not None and jobs is not None:
        raise click.UsageError(
            "--jobs counts processes on this machine; it cannot be combined with --ray"
        )
    limits = Limits(seconds=settings["timeout"], memory=settings["memory"] * 2**20)
    audit = Audit(
        locations,
        out.absolute(),
        limits=limits,
        parquet=_PARQUET[settings["format"]],
        cameras=settings["cameras"] == "yes",
        working_folder=Path.cwd(),
    )
    # Python's worker processes begin with the working folder in front of their import path
    os.chdir("/")
    runner = limits.pool(jobs) if ray is None else Cluster(ray, limits).run
    status = StatusLine(quiet=False)
    last = 0.0

    def progress(outcome: AuditProgress) -> None:
        nonlocal last
        if status and time.monotonic() - last >= _STATUS_PERIOD:
            last = time.monotonic()
            status.show(_status(outcome))

    with stop_on_signals() as stop:
        outcome = audit.run(runner, stop, progress)
    status.clear()
    _print(Console(), outcome)
    if stop:
        raise click.Abort
    if not outcome.total:
        raise ConformanceError(
            "no episode was found, which is not a pass",
            hint="an episode is in a LeRobot dataset (meta/info.json), a folder of xr_teleoperate "
            "(data.json), a recording (.mcap) or a ROS 2 bag (metadata.yaml, .db3)",
        )
    sys.exit(outcome.exit_code(fail_on))


def _status(outcome: AuditProgress) -> str:
    rest = outcome.remaining_s
    parts = [f"{outcome.done:,} of {outcome.total:,} episodes"]
    if outcome.seconds:
        parts.append(f"{outcome.examined_s / outcome.seconds:,.0f} times real time")
    parts.append(f"{outcome.uses['drop']} to drop")
    if rest is not None:
        parts.append(f"{_duration(rest)} left")
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _print(console: Console, outcome: AuditProgress) -> None:
    def tell(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    uses = ", ".join(f"{outcome.uses[use]:,} {use}" for use in ("keep", "review", "drop"))
    unusable = f", {outcome.unusable} not usable or inconclusive" if outcome.unusable else ""
    total = f"{outcome.done:,} of {outcome.total:,} episodes, {outcome.recorded_s / 3600:,.2f} h"
    tell(f"{total}: {uses}{unusable}")
    if outcome.failing or outcome.warned:
        tell(
            f"hands in recordings of the wire: {outcome.failing} with a failure, "
            f"{outcome.warned} with a warning"
        )
    if outcome.sets:
        tell(f"{outcome.sets} dataset{'s' * (outcome.sets > 1)} whose metadata are to be looked at")
    if outcome.reused:
        tell(f"{outcome.reused:,} unchanged since the last audit")
    if outcome.examined_s and outcome.seconds:
        speed = outcome.examined_s / outcome.seconds
        tell(f"{speed:,.0f} times real time ({outcome.seconds:.1f} s)")
    for path in outcome.files:
        tell(f"wrote {path}")
    for caption, command in outcome.commands:
        tell(f"{caption}:\n  {command}")
    if outcome.stopped:
        tell("stopped before its end; the same command goes on")
