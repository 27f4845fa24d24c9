"""``dexkit export``: recordings in other formats, and data sets without some episodes."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, json_option, out_option
from dexkit.cli.remarks import remark, remarks
from dexkit.cli.settings import Setting, Settings, settings_option
from dexkit.errors import DexkitError, SessionError, UsageError
from dexkit.escaping import REMARK, one_line

if TYPE_CHECKING:
    from dexkit.traces import Trace

__all__ = ["command"]

_SETTINGS = (
    Setting(
        "storage",
        "sqlite3|mcap",
        click.Choice(["sqlite3", "mcap"]),
        "Storage of a ROS 2 bag.",
        "sqlite3",
    ),
    Setting(
        "fps",
        "N",
        click.IntRange(1, 1000),
        "Frames per second, for lerobot and episodes.  [default: measured]",
    ),
    Setting("task", "TEXT", click.STRING, "Task of all episodes.  [default: the recording's]"),
    Setting(
        "drop",
        "drop|review",
        click.Choice(["drop", "review"]),
        "With --drop FILE: the verdict to be dropped; review drops both.",
        "drop",
    ),
)
_FORMATS = ("lerobot", "episodes", "rosbag2", "parquet", "csv")
_NUMBERS = re.compile(r"\d{1,9}(,\d{1,9})*", re.ASCII)
_SHOWN = 10


@click.command(
    "export",
    cls=Command,
    exit_codes={
        0: "everything is exported",
        1: "a recording is damaged or was refused, or something in it is left out (it is listed, "
        "and all else is exported)",
        2: "wrong usage, or nothing could be exported",
    },
)
@click.argument("sessions", type=FILE, nargs=-1, required=True, metavar="SESSION...")
@click.option(
    "--to",
    "form",
    type=click.Choice(_FORMATS),
    help="The format of recordings.",
)
@out_option("The folder to write.", required=False)
@click.option(
    "--drop",
    metavar="FILE|N,N,...",
    help="Of a data set: the episodes to be left out, as the file episodes.json of dexkit audit "
    "says, or by their numbers in a LeRobot dataset.",
)
@settings_option(_SETTINGS)
@click.option(
    "--pictures",
    type=FILE,
    metavar="DIR",
    help="The folder that was imported, for lerobot and episodes: pictures that are not in the "
    "recordings are read below it, and nowhere else.",
)
@json_option("Print JSON: what became of each recording.")
def command(
    sessions: tuple[Path, ...],
    form: str | None,
    out: Path | None,
    drop: str | None,
    settings: Settings,
    pictures: Path | None,
    as_json: bool,
) -> int:
    """Write the recordings SESSION... to the folder DIR in another format.

    lerobot writes one dataset (v3.0), and episodes one task folder, for all recordings. The other
    formats write one folder for each recording.

    dexkit export SET --out DIR --drop episodes.json writes a LeRobot dataset, a task folder of
    xr_teleoperate, or a folder of these again, in its own format, without the episodes to drop.
    """
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.cleaned import is_set

    if drop is not None:
        if form is not None or pictures is not None or settings.given - {"drop"}:
            raise UsageError("--drop writes a data set in its own format: only --set drop goes")
        return _cleaned(sessions, out, drop, settings["drop"] == "review", as_json)
    if form is None or out is None or "drop" in settings.given:
        missing = "--to" if form is None else "--out" if out is None else "--drop FILE"
        raise UsageError(f"{missing} is missing", hint=_usage(sessions[0]))
    if is_set(sessions[0]):
        raise UsageError(f"{sessions[0]} is no recording", hint=_usage(sessions[0]))

    from dexkit.traces.sessions import rosbag, topic_tables

    fps, task = settings["fps"], settings["task"]
    if pictures is not None and not pictures.is_dir():
        raise UsageError(f"--pictures {pictures} is not a folder")
    if form in ("lerobot", "episodes"):
        # bytes of the command line that are no UTF-8 are escaped, as those of recordings are
        text = None if task is None else task.encode("utf-8", "backslashreplace").decode()
        return _frames(sessions, form, out, fps, text, pictures, as_json)
    if fps is not None or task is not None or pictures is not None:
        raise UsageError(f"fps, task and --pictures are for lerobot and episodes, not {form}")
    several = len(sessions) > 1
    if several and len({p.stem for p in sessions}) < len(sessions):
        raise UsageError("two of the recordings have the same name", hint="export them one by one")
    trouble = False
    done: list[dict[str, Any]] = []
    refused: list[dict[str, str]] = []
    for path in sessions:
        target = out / path.stem if several else out
        try:
            trace = open_trace(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            if form == "rosbag2":
                written, lost = rosbag.export_bag(trace, target, storage=settings["storage"])
            else:
                written, lost = topic_tables.export_tables(trace, target, form)
        except DexkitError as error:
            if not several:
                raise
            trouble = True
            remark("warning", f"refused: {error}", path)
            refused.append({"recording": str(path), "why": str(error)})
            continue
        about = {"recording": str(path), "folder": str(target), "messages": written}
        done.append({**about, "lost": lost, "problems": trace.warnings})
        trouble |= bool(trace.damage)
        remarks("warning", trace.warnings, path)
        remarks(f"not in {form}", lost)
        if not as_json:
            click.echo(one_line(f"{target}: {written} of {trace.message_count} messages", REMARK))
    if as_json:
        click.echo(json.dumps({"exported": done, "refused": refused}, indent=1))
    if not done:
        raise SessionError("none of the recordings could be exported")
    return 1 if trouble else 0


def _usage(source: Path) -> str:
    """How to export a recording, or a data set."""
    from dexkit.traces.sessions.cleaned import is_set

    if is_set(source):
        return (
            f"dexkit export {source} --out DIR --drop episodes.json writes it without the "
            "episodes that dexkit audit would drop; dexkit import makes recordings of it, for --to"
        )
    return f"dexkit export SESSION.mcap --to {'|'.join(_FORMATS)} --out DIR"


def _cleaned(
    sessions: tuple[Path, ...], out: Path | None, drop: str, review: bool, as_json: bool
) -> int:
    """Write a data set without some episodes."""
    from dexkit.traces.sessions.cleaned import by_number, by_verdict, export_cleaned
    from dexkit.traces.sessions.verdicts import read_verdicts

    source, *others = sessions
    if others or out is None:
        raise UsageError(
            "--drop takes one data set, and one folder to write",
            hint="dexkit export SET --out DIR --drop episodes.json",
        )
    if not source.is_dir():
        raise UsageError(f"{source} is no folder", hint="--drop takes a data set")
    if _NUMBERS.fullmatch(drop) and not Path(drop).exists():
        if review:
            raise UsageError("--set drop=review is for a file of verdicts")
        choice, named = by_number(source, [int(n) for n in drop.split(",")]), None
    else:
        origin = Path(drop)
        verdicts = read_verdicts(origin)
        choice, named = by_verdict(source, origin, verdicts, ["review"] if review else [])
    result = export_cleaned(source, out, choice, named)
    remarks("warning", result.problems)
    remarks("note", result.notes)
    if as_json:
        done = {"source": str(source), "folder": str(out), **asdict(result)}
        click.echo(json.dumps({"exported": [done], "refused": []}, indent=1))
        return 1 if result.problems else 0
    kept, gone = result.kept, len(result.dropped)
    click.echo(one_line(f"{out}: {kept} episodes kept, {gone} dropped", REMARK))
    for dropped in result.dropped[:_SHOWN]:
        reasons = " ".join(dropped.reasons) or "as you said"
        click.echo(one_line(f"  dropped {dropped.episode}: {reasons}", REMARK))
    if gone > _SHOWN:
        click.echo(f"  and {gone - _SHOWN} more")
    return 1 if result.problems else 0


def _frames(
    sessions: tuple[Path, ...],
    form: str,
    out: Path,
    fps: int | None,
    task: str | None,
    pictures: Path | None,
    as_json: bool,
) -> int:
    from dexkit.traces import open_trace
    from dexkit.traces.sessions import episodes_out, lerobot_out

    traces: list[Trace] = []
    refused: list[dict[str, str]] = []
    for path in sessions:
        try:
            traces.append(open_trace(path))
        except DexkitError as error:
            if len(sessions) == 1:
                raise
            remark("warning", f"refused: {error}", path)
            refused.append({"recording": str(path), "why": str(error)})
    if not traces:
        raise SessionError("none of the recordings could be exported")
    export = lerobot_out.export_dataset if form == "lerobot" else episodes_out.export_episodes
    result = export(traces, out, fps=fps, task=task, pictures=pictures)
    for trace in traces:
        remarks("warning", trace.warnings, trace.path)
    remarks("warning", result.problems)
    remarks(f"not in {form}", result.lost)
    if as_json:
        done = {"recordings": [str(t.path) for t in traces], "folder": str(out), **asdict(result)}
        click.echo(json.dumps({"exported": [done], "refused": refused}, indent=1))
    else:
        click.echo(f"{out}: {lerobot_out.describe(result)}")
    return 1 if refused or result.problems or any(t.damage for t in traces) else 0
