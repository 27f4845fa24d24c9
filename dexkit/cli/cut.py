"""``dexkit cut``: a part of a recording, by time, phase and topic."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import FILE, OUTPUT_FILE, Number, overwrite_option, topic_option
from dexkit.cli.remarks import remarks
from dexkit.errors import UsageError
from dexkit.escaping import one_line

if TYPE_CHECKING:
    from dexkit.traces import Trace
    from dexkit.traces.sessions.edit import Metadata, Span

__all__ = ["command"]


class _Window(click.ParamType):  # type: ignore[type-arg]
    name = "A:B"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float | None, float | None]:
        if isinstance(value, tuple):
            return value
        begin, colon, end = str(value).partition(":")
        if not colon:
            self.fail(f"{one_line(value, 40)!r} is not A:B, such as 2.5:8, 2.5: or :-1", param, ctx)
        seconds = Number()
        return (
            seconds.convert(begin, param, ctx) if begin else None,
            seconds.convert(end, param, ctx) if end else None,
        )


@click.command(
    "cut",
    cls=Command,
    exit_codes={
        0: "written",
        1: "the recording is damaged; its readable part is cut",
        2: "wrong usage, nothing left, or an unusable file",
    },
)
@click.argument("file", type=FILE)
@click.argument("out", type=OUTPUT_FILE)
@click.option(
    "--window",
    type=_Window(),
    default=(None, None),
    metavar="A:B",
    help="Cut from A to B seconds after the start of the recording; either may be left out.",
)
@click.option(
    "--phase",
    "phases",
    multiple=True,
    metavar="NAME",
    help="The phases of that name of a conformance run; may be repeated.",
)
@click.option(
    "--stretch",
    type=click.IntRange(min=1),
    metavar="N",
    help="Of a recording whose clock was set back, the Nth stretch of time.",
)
@topic_option("Keep", "all")
@overwrite_option("OUT")
def command(
    file: Path,
    out: Path,
    window: tuple[float | None, float | None],
    phases: tuple[str, ...],
    stretch: int | None,
    topics: tuple[str, ...],
    overwrite: bool,
) -> int:
    """Write a part of the recording FILE to OUT.

    Times count from the first message; negative times from the last. Payloads, times, schemas and
    metadata are unchanged; OUT names the recording that it was cut from.
    """
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.edit import cut

    trace = open_trace(file)
    spans, metadata = _spans(trace, *window, phases)
    written = cut(
        trace,
        out,
        spans=spans,
        topics=topics or None,
        stretch=None if stretch is None else stretch - 1,
        metadata=metadata,
        overwrite=overwrite,
    )
    remarks("warning", trace.warnings)
    if trace.attachments:
        click.echo(f"warning: {trace.attachments} attachments are left out", err=True)
    click.echo(f"{out}: {written} of {trace.message_count} messages")
    return 1 if trace.damage else 0


def _spans(
    trace: Trace,
    begin: float | None,
    end: float | None,
    phases: tuple[str, ...],
) -> tuple[list[Span], Metadata]:
    """The times to keep, and the metadata without phases that are not whole in them."""
    from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
    from dexkit.traces.sessions.edit import Span

    # the last message belongs to the recording
    first, last = trace.first_ns, trace.last_ns + 1
    low = first if begin is None else _instant(trace, begin)
    high = last if end is None else _instant(trace, end)
    for seconds, outside in ((begin, low >= last), (end, high <= first)):
        if seconds is not None and outside:
            raise UsageError(
                f"{seconds:g} s: nothing is left, {trace.path.name} is {trace.duration:g} s long",
                hint="times count from the first message, negative ones from the last",
            )
    if high <= low:
        raise UsageError("--window A:B: B must be later than A")
    spans = [Span(low, high)]
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD]) if RECORD in trace.metadata else None
    if phases:
        if stimulus is None:
            raise UsageError(
                f"{trace.path.name} has no phases: it was not recorded by a conformance run",
                hint="name times with --window",
            )
        known = [p for p in stimulus.phases if p.end_ns]
        if missing := set(phases) - {p.name for p in known}:
            raise UsageError(
                f"{trace.path.name} has no phase {', '.join(sorted(missing))}",
                hint=f"it has: {', '.join(dict.fromkeys(p.name for p in known))}",
            )
        limits = [(max(p.begin_ns, low), min(p.end_ns, high)) for p in known if p.name in phases]
        spans = [Span(b, e) for b, e in limits if e > b]
        if not spans:
            raise UsageError(f"no phase {', '.join(phases)} lies in the window")
    if stimulus is None:
        return spans, trace.metadata
    stimulus.phases = [
        p
        for p in stimulus.phases
        if p.end_ns and any(s.begin_ns <= p.begin_ns and p.end_ns <= s.end_ns for s in spans)
    ]
    return spans, {**trace.metadata, RECORD: stimulus.to_metadata()}


def _instant(trace: Trace, seconds: float) -> int:
    return (trace.first_ns if seconds >= 0 else trace.last_ns) + round(seconds * 1e9)
