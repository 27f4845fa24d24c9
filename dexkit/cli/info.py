"""``dexkit info``: topics, rates, gaps and damage of a recording."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, html_option, json_option
from dexkit.cli.report import write_text
from dexkit.documents import check_output_paths

if TYPE_CHECKING:
    from dexkit.traces import Trace

__all__ = ["command", "summary"]

_NUMBERS = ("messages", "mean Hz", "p50 ms", "p99 ms", "max ms", "first s")
_HEADINGS = ("topic", *_NUMBERS, "type", "schema")


def summary(trace: Trace) -> dict[str, Any]:
    """Everything that ``dexkit info`` prints, as JSON data."""
    loaded = trace.load(payloads=False)
    topics = []
    for channel in trace.channels:
        samples = loaded[channel.topic]
        row: dict[str, Any] = {
            "topic": channel.topic,
            "type": channel.type_name,
            "messages": channel.message_count,
            "schema_encoding": channel.schema_encoding,
            "problem": channel.problem,
        }
        # of a topic with two types, the columns are those of one of them
        if samples.type_name == channel.type_name and len(samples):
            times = samples.log_time_ns
            row["first_s"] = (int(times[0]) - trace.first_ns) / 1e9
            if len(times) > 1 and times[-1] > times[0]:
                gaps = np.diff(times) / 1e6
                p50, p99, worst = (
                    np.percentile(gaps, (50, 99, 100)) if len(gaps) > 1 else gaps.repeat(3)
                )
                row["mean_hz"] = (len(times) - 1) * 1e9 / int(times[-1] - times[0])
                row["gap_ms"] = {"p50": float(p50), "p99": float(p99), "max": float(worst)}
        topics.append(row)
    return {
        "file": str(trace.path),
        "bytes": trace.path.stat().st_size,
        "library": trace.library,
        "profile": trace.profile,
        "start_ns": trace.first_ns,
        "duration_s": trace.duration,
        "messages": trace.message_count,
        "truncated": trace.truncated,
        "damaged": bool(trace.damage),
        "topics": topics,
        "endpoints": [
            {
                "topic": e.topic,
                "kind": e.kind,
                "reliability": e.reliability,
                "durability": e.durability,
                "history": e.history,
                "type": e.type_name,
            }
            for e in trace.endpoints
        ],
        "metadata": trace.metadata,
        "warnings": trace.warnings,
        "notes": [*trace.notes, *_orders(trace)],
    }


def _orders(trace: Trace) -> list[str]:
    """What motion says about the order of each Dex3-1's fingers."""
    from dexkit.models import DEX3_1

    types = {(d.cmd_type, d.state_type) for d in DEX3_1.dialects}
    present = {c.type_name for c in trace.channels if c.message_count}
    if not any(set(pair) <= present for pair in types):
        return []
    from dexkit.traces.sessions.finger_order import finger_orders

    return [
        f"order of the fingers, {part.replace('_', ' ')}: {found.text}"
        for part, found in finger_orders(trace).items()
    ]


@click.command(
    "info",
    cls=Command,
    exit_codes={
        0: "the files agree with their checksums and counts",
        1: "one is damaged; its readable part is shown, and losses are listed",
        2: "one is not a recording",
    },
)
@click.argument("files", type=FILE, nargs=-1, required=True, metavar="FILE...")
@json_option("Print JSON: an object, or a list of them for several files.")
@click.option(
    "--plot", is_flag=True, help="Draw commands, states and rates over time in the terminal."
)
@html_option(
    "Write a page with their curves; several files are drawn beside each other.", report=False
)
def command(files: tuple[Path, ...], as_json: bool, plot: bool, html_path: Path | None) -> int:
    """Show the topics, types, rates, gaps and damage of recordings.

    FILE is an mcap file (or the directory of a ROS 2 bag with one in it). An unfinished file is
    read up to its end.
    """
    from dexkit.traces import open_trace

    check_output_paths([html_path], files)
    traces = [open_trace(file) for file in files]
    found = [summary(trace) for trace in traces]
    if as_json:
        click.echo(json.dumps(found if len(found) > 1 else found[0], indent=1))
    else:
        for number, (trace, data) in enumerate(zip(traces, found, strict=True)):
            if number:
                click.echo()
            _print(data)
            if plot:
                from dexkit.cli.info_plot import print_plot

                print_plot(trace)
    if html_path is not None:
        from dexkit.conformance.report.curves import page, recorded

        write_text(html_path, page([recorded(trace) for trace in traces]))
        click.echo(f"page: {html_path}", err=True)
    return 1 if any(trace.damage for trace in traces) else 0


def _print(data: dict[str, Any]) -> None:
    from dexkit.console import Console
    from dexkit.console import markup as escape
    from dexkit.escaping import LONGEST

    # wide enough for the table: in a pipe rich would cut topics to 80 columns
    console = Console(width=max(Console().width, 120))
    start = datetime.fromtimestamp(data["start_ns"] / 1e9, timezone.utc)
    state = "[red]unfinished[/red]" if data["truncated"] else "complete"
    state += ", [red]damaged[/red]" if data["damaged"] else ""
    console.print(f"[bold]{escape(data['file'])}[/bold]  {data['bytes']:,} bytes, {state}")
    if data["messages"]:
        console.print(
            f"{data['messages']:,} messages in {data['duration_s']:.3f} s "
            f"from {start:%Y-%m-%d %H:%M:%S} UTC"
        )
    else:
        console.print("no messages")
    console.print(
        f"written by {escape(data['library'] or 'an unnamed library')}",
        highlight=False,
        soft_wrap=True,
    )
    # in one call: rich needs a fraction of a millisecond for each, and there may be thousands
    lines: list[str] = []
    if data["topics"]:
        lines += ["", *_table(data["topics"])]
    for name, values in data["metadata"].items():
        lines += ["", f"[bold]{escape(name)}[/bold]"]
        lines += [f"  {escape(key, LONGEST)}: {escape(value)}" for key, value in values.items()]
    if data["warnings"] or data["notes"]:
        lines.append("")
        lines += [f"[yellow]warning:[/yellow] {escape(warning)}" for warning in data["warnings"]]
        lines += [f"note: {escape(note)}" for note in data["notes"]]
    if lines:
        console.print("\n".join(lines), highlight=False, soft_wrap=True)


def _table(topics: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each topic, and the headings. A table of rich takes a millisecond for a row."""
    from rich.markup import escape

    from dexkit.escaping import LONGEST, one_line

    rows = [_HEADINGS]
    for row in topics:
        gaps = row.get("gap_ms", {})
        rows.append(
            (
                one_line(row["topic"], LONGEST),
                f"{row['messages']:,}",
                _number(row.get("mean_hz"), 1),
                _number(gaps.get("p50"), 2),
                _number(gaps.get("p99"), 2),
                _number(gaps.get("max"), 1),
                _number(row.get("first_s"), 2),
                one_line(row["type"].replace("::msg::dds_::", " ") or "?", LONGEST),
                one_line(row["schema_encoding"] or "none", LONGEST),
            )
        )
    widths = [max(map(_width, column)) for column in zip(*rows, strict=True)]
    lines = []
    for number, cells in enumerate(rows):
        padded = []
        for place, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            blank = " " * (width - _width(cell))
            padded.append(blank + cell if 1 <= place <= len(_NUMBERS) else cell + blank)
        line = escape("  ".join(padded).rstrip())
        lines.append(line if number else f"[bold]{line}[/bold]")
    return lines


def _width(text: str) -> int:
    """Columns of the terminal that it takes."""
    from rich.cells import cell_len

    return len(text) if text.isascii() else cell_len(text)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
