"""``dexkit import``: sessions of other formats as recordings."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, Number, json_option, overwrite_option
from dexkit.cli.remarks import remark, remarks
from dexkit.cli.settings import YES_OR_NO, Setting, Settings, settings_option
from dexkit.errors import DexkitError, SessionError, UsageError
from dexkit.escaping import REMARK, one_line

if TYPE_CHECKING:
    from dexkit.traces.sessions.episodes import Options
    from dexkit.traces.sessions.sources import Entry

__all__ = ["command"]

_SETTINGS = (
    Setting(
        "rate",
        "HZ",
        Number(min=0.1, max=2000),
        "Frames per second, if the source has no times.  [default: the source's]",
    ),
    Setting(
        "hand",
        "MODEL",
        click.STRING,
        "Model of the hands, e.g. dex3-1, or none.  [default: detected by joints and limits]",
    ),
    Setting("keep-sides", "yes|no", YES_OR_NO, "Do not exchange hands that look swapped.", False),
    Setting(
        "embed-pictures", "yes|no", YES_OR_NO, "Put single pictures into the recording.", False
    ),
)


@click.command(
    "import",
    cls=Command,
    exit_codes={
        0: "everything is imported",
        1: "something is left out (it is listed, also in the recording), or a session is refused "
        "(it is named, and the others are imported)",
        2: "wrong usage, or nothing can be imported",
    },
)
@click.argument("source", type=FILE)
@click.argument("out", type=FILE)
@click.option(
    "--from",
    "form",
    type=click.Choice(["episodes", "jsonl", "lerobot", "rosbag2", "tables"]),
    help="The format of SOURCE.  [default: detected by its files]",
)
@click.option(
    "--episode",
    "chosen",
    multiple=True,
    metavar="NAME",
    help="Only this session of SOURCE, e.g. episode_0003; may be repeated.",
)
@settings_option(_SETTINGS)
@click.option(
    "--wire",
    type=FILE,
    metavar="FILE",
    help="A recording (.mcap) of the same session; the frames get the times of its messages.",
)
@overwrite_option("existing recordings")
@json_option("Print JSON: what became of each session.")
def command(
    source: Path,
    out: Path,
    form: str | None,
    chosen: tuple[str, ...],
    settings: Settings,
    wire: Path | None,
    overwrite: bool,
    as_json: bool,
) -> int:
    """Write the sessions of SOURCE as recordings.

    SOURCE is an episode of xr_teleoperate or a folder of them, a file of JSON lines, a LeRobot
    dataset (v2.0, v2.1, v3.0), a ROS 2 bag (sqlite3 or mcap), or tables of dexkit export. OUT is
    an mcap file for one session, and a folder for several.
    """
    from dexkit.models import model
    from dexkit.traces.sessions.episodes import Options
    from dexkit.traces.sessions.paths import file_name
    from dexkit.traces.sessions.sources import choose, find

    hand = settings["hand"]
    if hand not in (None, "none"):
        model(hand)  # refused before anything is read
    options = Options(rate=settings["rate"], hand=hand, correct=not settings["keep-sides"])
    entries = find(source, form, options)
    if wire is not None:
        entries = _beside(source, entries, wire, options)
    entries = choose(source, entries, chosen)
    one = out.suffix == ".mcap"
    if one and len(entries) > 1:
        raise UsageError(
            f"{source} has {len(entries)} sessions, which do not fit into one recording",
            hint=f"name a folder (OUT without .mcap), or one of them: --episode {entries[0].name}",
        )
    trouble = False
    done: list[dict[str, Any]] = []
    refused: list[dict[str, str]] = []
    written: dict[Path, str] = {}
    for entry in entries:
        *folders, name = (file_name(part, 200) for part in entry.name.split("/"))
        target = out if one else out.joinpath(*folders, f"{name}.mcap")
        try:
            if (other := written.setdefault(target, entry.name)) != entry.name:
                raise SessionError(f"its recording would have the name of {other}'s")
            target.parent.mkdir(parents=True, exist_ok=True)
            report = entry.convert(target, settings["embed-pictures"], overwrite)
        except (DexkitError, OSError, MemoryError) as error:
            if len(entries) == 1:
                raise
            trouble = True
            why = str(error) or "out of memory"
            remark("warning", f"refused: {why}", entry.name)
            refused.append({"session": entry.name, "why": why})
            continue
        done.append({"session": entry.name, "recording": str(target), **asdict(report)})
        trouble |= bool(report.problems)
        remarks("corrected", report.corrections, entry.name)
        remarks("warning", report.problems, entry.name)
        if not as_json:
            click.echo(one_line(f"{target}: {report.messages} messages ({report.form})", REMARK))
    if as_json:
        click.echo(json.dumps({"imported": done, "refused": refused}, indent=1))
    if not done:
        raise SessionError(f"none of the {len(entries)} sessions of {source} can be imported")
    return 1 if trouble else 0


def _beside(source: Path, entries: list[Entry], wire: Path, options: Options) -> list[Entry]:
    """The same episodes, with the times of the wire."""
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.episodes import episode_folders
    from dexkit.traces.sessions.sources import beside

    folders = episode_folders(source)
    if len(folders) != len(entries):
        raise UsageError("--wire is for episodes of xr_teleoperate")
    trace = open_trace(wire)
    return [
        replace(beside(folder, trace, options, source=source), name=entry.name)
        for folder, entry in zip(folders, entries, strict=True)
    ]
