"""``dexkit rehearse``: check a session, and play it on emulated hands on a virtual clock."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import html_option, json_option
from dexkit.cli.replay_session import checked_session, guards, print_refusal, session_to_play
from dexkit.cli.settings import Settings
from dexkit.errors import UsageError
from dexkit.escaping import REMARK, one_line

if TYPE_CHECKING:
    from dexkit.conformance.virtual.rehearsal import Rehearsal
    from dexkit.traces.replay.machine import Guards
    from dexkit.traces.replay.prepare import Prepared

__all__ = ["command"]


@click.command(
    "rehearse",
    cls=Command,
    exit_codes={
        0: "it can be replayed as it was rehearsed; with --check, nothing is refused",
        1: "it is refused or damaged, or the rehearsal was stopped by the supervision",
        2: "it cannot be read",
    },
)
@session_to_play()
@click.option("--check", "check_only", is_flag=True, help="Only check the session.")
@html_option("Where to write the page.  [default: SOURCE-rehearsal.html; with --json, none]")
@json_option("Print JSON: the findings, and the figures of each joint.")
@click.pass_context
def command(
    ctx: click.Context,
    /,
    source: Path,
    check_only: bool,
    html_path: Path | None,
    settings: Settings,
    as_json: bool,
    **given: Any,
) -> int:
    """Rehearse a replay: nothing is published, and no hand moves.

    SOURCE is a recording, or a session of any format that 'dexkit import' reads. It is checked as
    'dexkit replay' checks it; findings are printed with the settings that cure them. Then it is
    played on the model's emulated hands on a virtual clock, supervised as on real ones, and a page
    shows what they did.
    """
    if check_only and html_path is not None:
        raise UsageError("the page is of a rehearsal", hint="leave out --check")
    from dexkit.traces.replay.machine import End

    session, prepared = checked_session(source, settings=settings, quiet=as_json, **given)
    code = 1 if session.damage else 0
    rehearsal = None
    if not check_only:
        if html_path is None and not as_json:
            html_path = Path(f"{Path(session.name).name.removesuffix('.mcap')}-rehearsal.html")
        rehearsal = _rehearse(prepared, guards(settings), source, html_path, ctx)
        if rehearsal is None or rehearsal.machine.end is not End.DONE:
            code = 1
    if as_json:
        click.echo(json.dumps(_data(prepared, rehearsal), indent=1))
    elif rehearsal is not None:
        _print_rehearsal(rehearsal)
        click.echo(f"page: {html_path}")
    if prepared.refused:
        print_refusal(prepared)
        return 1
    return code


def _rehearse(
    prepared: Prepared, guards: Guards, source: Path, page: Path | None, ctx: click.Context
) -> Rehearsal | None:
    """Rehearse and write the page; None if nothing is left to be played."""
    from dexkit.conformance.report.rehearsal import render
    from dexkit.conformance.virtual.rehearsal import rehearse
    from dexkit.documents import check_output_paths, write_file

    if prepared.plan is None:
        return None
    check_output_paths([source], [page])
    rehearsal = rehearse(prepared.plan, guards)
    if page is not None:
        write_file(page, render(prepared, rehearsal, source=str(source), options=_options(ctx)))
    return rehearsal


def _data(prepared: Prepared, rehearsal: Rehearsal | None) -> dict[str, Any]:
    """Findings and figures as data for JSON."""
    figures = rehearsal.figures() if rehearsal else {}
    return {
        "findings": [{**asdict(f), "level": str(f.level)} for f in prepared.findings],
        "refused": bool(prepared.refused),
        "ended": rehearsal.machine.reason if rehearsal else "not rehearsed",
        "joints": [
            {"side": str(side), **asdict(f)} for side, some in figures.items() for f in some
        ],
    }


def _options(ctx: click.Context) -> str:
    """The options that were given, for the page."""
    stated = click.core.ParameterSource.COMMANDLINE
    words = []
    for parameter in ctx.command.params:
        name = str(parameter.name)
        if isinstance(parameter, click.Option) and ctx.get_parameter_source(name) is stated:
            value = ctx.params.get(name)
            values = value.texts if isinstance(value, Settings) else value
            shown = values if isinstance(values, tuple) else [values]
            words += [word for one in shown for word in (parameter.opts[0], str(one))]
    return " ".join(words)


def _print_rehearsal(rehearsal: Rehearsal) -> None:
    from rich.table import Table

    from dexkit.console import Console, markup

    machine = rehearsal.machine
    angle, torque = rehearsal.units
    click.echo(
        f"rehearsed on emulated hands, {rehearsal.seconds:.1f} s: "
        + one_line(machine.reason, REMARK)
    )
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("joint", no_wrap=True)
    for heading in (
        *(f"commanded {angle}", f"moved {angle}", "rms away", "worst away", "at s"),
        *(f"max {angle}/s", f"max {torque}", "ripple", "at limit"),
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for side, figures in rehearsal.figures().items():
        for f in figures:
            table.add_row(
                markup(f"{side} {f.name}"),
                *(f"{x:.3f}" for x in (f.commanded, f.moved, f.rms, f.worst)),
                f"{f.at:.2f}",
                f"{f.speed:.1f}",
                f"{f.torque:.2f}",
                f"{f.ripple:.3f}",
                f"{f.limit:.0%}",
            )
    Console(width=max(Console().width, 110)).print(table)
