"""``dexkit diff``: what two recordings of one session differ in."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, Number, html_option, json_option, topic_option
from dexkit.cli.remarks import remarks
from dexkit.cli.report import write_text
from dexkit.documents import check_output_paths

if TYPE_CHECKING:
    from dexkit.traces import Trace
    from dexkit.traces.sessions.compare import Comparison

__all__ = ["command"]


@click.command(
    "diff",
    cls=Command,
    exit_codes={
        0: "equal topics and positions",
        1: "they differ, or a recording is damaged",
        2: "they cannot be compared",
    },
)
@click.argument("a", type=FILE)
@click.argument("b", type=FILE)
@click.option(
    "--offset",
    type=Number(),
    metavar="S",
    help="B is S seconds later than A.  [default: found by the commands]",
)
@click.option(
    "--tolerance",
    type=Number(min=0),
    default=0.05,
    show_default=True,
    metavar="RAD",
    help="Positions count as equal within this difference.",
)
@topic_option("Compare", "all")
@json_option("Print JSON.")
@html_option(
    "Write a page with the curves of both overlaid, the most different joints first.", report=False
)
def command(
    a: Path,
    b: Path,
    offset: float | None,
    tolerance: float,
    topics: tuple[str, ...],
    as_json: bool,
    html_path: Path | None,
) -> int:
    """Compare two runs of one session: topics, rates, gaps, and the position of every joint.

    B is aligned to A by the correlation of the commands (without commands, of the states), and each
    joint is compared at A's times where both have values.
    """
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.compare import compare

    check_output_paths([html_path], [a, b])
    traces = [open_trace(a), open_trace(b)]
    found = compare(*traces, topics=topics or None, offset=offset, tolerance=tolerance)
    for trace in traces:
        remarks("warning", trace.warnings, trace.path)
    if as_json:
        click.echo(json.dumps(_finite({"equal": found.equal, **asdict(found)}), indent=1))
    else:
        _print(found)
    if html_path is not None:
        write_text(html_path, _page(found, *traces))
        click.echo(f"page: {html_path}", err=True)
    return 0 if found.equal and not any(t.damage for t in traces) else 1


def _page(found: Comparison, a: Trace, b: Trace) -> str:
    """The joints of both, on A's clock; those that differ most come first."""
    from dexkit.conformance.report.curves import difference_page, recorded

    names = (f"A: {a.path.name}", f"B: {b.path.name}")
    one = recorded(a, names[0])
    # recordings without a second in common, perhaps years apart, each have their own time line
    begin = a.first_ns + round(found.offset * 1e9) if found.overlap else None
    other = recorded(b, names[1], begin_ns=begin)
    order = [
        (
            j.part,
            j.kind,
            j.joint,
            f"rms {j.rms:.4f}, worst {j.worst:.4f} {j.unit} at {j.worst_at:.3f} s",
        )
        for j in sorted(found.joints, key=lambda j: -j.worst if j.samples else 1.0)
        if j.samples
    ]
    drawn = ", and is drawn on A's clock" if found.overlap else ""
    conclusion = (
        f"T{_conclusion(found)[1:]}. B is {found.offset:+.4f} s later than A{drawn}; they have "
        f"{found.overlap:.3f} s in common."
    )
    title = f"{a.path.name} and {b.path.name}"
    return difference_page(title, [conclusion, *found.notes], one, other, order)


def _conclusion(found: Comparison) -> str:
    return "the same" if found.equal else f"they differ: {'; '.join(found.reasons)}"


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _print(found: Comparison) -> None:
    from rich.table import Table

    from dexkit.console import Console
    from dexkit.console import markup as escape

    console = Console(width=max(Console().width, 120))
    how = "as stated"
    if found.alignment is not None:
        how = (
            f"correlation {found.alignment.correlation:.4f}, "
            f"elsewhere at most {found.alignment.elsewhere:.4f}"
        )
    console.print(
        f"B is {found.offset:+.4f} s later than A ({how}); {found.overlap:.3f} s in common",
        highlight=False,
    )
    for name, topics in zip("AB", found.only, strict=True):
        if topics:
            console.print(f"only in {name}: {escape(', '.join(topics))}", highlight=False)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("topic", no_wrap=True)
    for heading in ("messages A", "B", "mean Hz A", "B", "longest gap s A", "B"):
        table.add_column(heading, justify="right", no_wrap=True)
    for t in found.topics:
        table.add_row(
            escape(t.topic) + ("" if t.types[0] == t.types[1] else " (types differ)"),
            *(f"{n:,}" for n in t.messages),
            *(f"{r:.1f}" for r in t.rates),
            *(f"{g:.3f}" for g in t.gaps),
        )
    console.print(table)
    joints = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("joint", "what", "unit"):
        joints.add_column(heading, no_wrap=True)
    for heading in ("rms", "worst", "at s", f"first > {found.tolerance:g} at s"):
        joints.add_column(heading, justify="right", no_wrap=True)
    for j in found.joints:
        first = "" if j.first_at is None else f"{j.first_at:.3f}"
        joints.add_row(
            escape(j.joint),
            j.kind,
            j.unit,
            *((f"{j.rms:.4f}", f"{j.worst:.4f}", f"{j.worst_at:.3f}") if j.samples else "---"),
            first if j.samples else "no time in common",
        )
    console.print()
    console.print(joints)
    for note in found.notes:
        console.print(f"note: {note}", highlight=False)
    console.print(escape(_conclusion(found)), highlight=False)
