"""``dexkit merge``: several recordings as one."""

from __future__ import annotations

from pathlib import Path

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, overwrite_option
from dexkit.cli.remarks import remarks
from dexkit.errors import UsageError

__all__ = ["command"]


@click.command(
    "merge",
    cls=Command,
    exit_codes={
        0: "written",
        1: "a recording is damaged; its readable part is merged",
        2: "wrong usage, or an unusable file",
    },
)
@click.argument("files", type=FILE, nargs=-1, required=True, metavar="FILE FILE... OUT")
@click.option(
    "--shift",
    "shifts",
    multiple=True,
    metavar="FILE=S",
    help="Add S seconds to the times of a file; may be repeated.",
)
@click.option(
    "--align",
    "aligned",
    is_flag=True,
    help="Put the later files on the first one's clock, by the messages that both have.",
)
@overwrite_option("OUT")
def command(
    files: tuple[Path, ...],
    shifts: tuple[str, ...],
    aligned: bool,
    overwrite: bool,
) -> int:
    """Write several recordings to OUT as one, in order of time.

    Messages that occur in several files are written once. If metadata differ, those of later files
    are stored under the file's name.
    """
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.edit import clock_offset, merge

    if len(files) < 3:
        raise UsageError("name two recordings or more, and then the file to write")
    *paths, out = files
    traces = [open_trace(p) for p in paths]
    stated = _stated(shifts, paths)
    moved = []
    for path, trace in zip(paths, traces, strict=True):
        if path in stated or not aligned or trace is traces[0]:
            moved.append(stated.get(path, 0.0))
        else:
            moved.append(-clock_offset(traces[0], trace))
            click.echo(f"{path}: shifted by {moved[-1]:+.6f} s")
    result = merge(traces, out, shifts=moved, overwrite=overwrite)
    for trace in traces:
        remarks("warning", trace.warnings, trace.path)
        if trace.attachments:
            click.echo(
                f"warning: {trace.path}: {trace.attachments} attachments are left out", err=True
            )
    click.echo(
        f"{out}: {result.written} messages of {len(traces)} recordings, "
        f"{result.duplicates} duplicates left out"
    )
    return 1 if any(t.damage for t in traces) else 0


def _stated(shifts: tuple[str, ...], paths: list[Path]) -> dict[Path, float]:
    found = {}
    for text in shifts:
        name, equals, seconds = text.rpartition("=")
        path = Path(name)
        try:
            value = float(seconds)
        except ValueError:
            value = float("nan")
        if not equals or not abs(value) < 1e9:
            raise UsageError(f"--shift {text}: not FILE=SECONDS")
        if path not in paths:
            raise UsageError(f"--shift {text}: {path} is not one of the recordings")
        found[path] = value
    return found
