"""``dexkit replay``: play a session on hands with care, or a recording as it is."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    FILE,
    Number,
    dds_options,
    dialect_option,
    force_option,
    html_option,
    session_options,
    side_option,
    topic_option,
    wait_option,
)
from dexkit.command_age import PAUSE
from dexkit.errors import DdsError, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.redaction import redact

if TYPE_CHECKING:
    from dexkit.cli.consent import Consent
    from dexkit.conformance.virtual.rehearsal import Rehearsal
    from dexkit.traces.replay.commands import RecordedCommands
    from dexkit.traces.replay.live import LiveReplay
    from dexkit.traces.replay.machine import Guards, ReplayMachine
    from dexkit.traces.replay.prepare import Prepared

__all__ = ["command"]

# literal, because the package is imported only when a command runs; tests/test_replay.py compares
_ACCEPTABLE = (
    "high-gains",
    "jumps",
    "limits",
    "locked",
    "pace",
    "side",
    "stale",
    "thin-rate",
    "zero-gains",
)
# parameters that mean something without a hand's state
_AS_RECORDED = {
    "source",
    "as_recorded",
    "pace",
    "loop",
    "topics",
    "max_gap",
    "domain",
    "interface",
    "peers",
    "wait_for_interface",
    "wait",
    "no_wait",
    "force",
}
_STYLES = {"note": "dim", "cured": "green", "accepted": "yellow", "refused": "bold red"}


@click.command(
    "replay",
    cls=Command,
    exit_codes={
        0: "played, or a loop was stopped, or nothing is refused with --check and --rehearse",
        1: "refused, stopped by the supervision, suspended without a terminal, damaged, or not "
        "free",
        2: "it cannot be read",
        130: "stopped",
    },
)
@click.argument("source", type=FILE)
@click.option("--check", "check_only", is_flag=True, help="Only check the session.")
@click.option(
    "--rehearse",
    is_flag=True,
    help="Only play it on the model's emulated hand, in virtual time, and write a page with the "
    "result.",
)
@html_option()
@side_option("Hands to drive.  [default: all that the session commands]")
@dialect_option("Dialect of the hands to drive.  [default: the session's]")
@click.option(
    "--pace",
    "--speed",
    "pace",
    type=Number(1e-3, 1e3),
    default=1.0,
    show_default=True,
    help="0.5 plays in twice the time. More than 1 needs --accept pace.",
)
@click.option(
    "--ramp-speed",
    type=Number(min=0.01, max=10.0),
    default=0.5,
    show_default=True,
    metavar="RAD/S",
    help="Joint speed of the motion to the first pose.",
)
@click.option(
    "--gains",
    type=click.Choice(["recorded", "model"]),
    default="recorded",
    show_default=True,
    help="kp and kd of the session, or lowered to those that the model's client sends. Commands "
    "without gains never get any.",
)
@click.option(
    "--resample",
    type=Number(min=1.0, max=1000.0),
    metavar="HZ",
    help="Commands per second, interpolated.  [default: the recorded ones]",
)
@click.option(
    "--limit",
    type=click.Choice(["refuse", "clamp"]),
    default="refuse",
    show_default=True,
    help="Commands outside the joints' limits: refuse the session, or clamp them.",
)
@click.option(
    "--jumps",
    type=click.Choice(["refuse", "stretch"]),
    default="refuse",
    show_default=True,
    help="Commands that demand too high a joint speed: refuse the session, or stretch time.",
)
@click.option(
    "--invalid",
    type=click.Choice(["refuse", "drop"]),
    default="refuse",
    show_default=True,
    help="Commands that cannot be sent (NaN, too few motors, stale, time running backwards): "
    "refuse, or leave them out.",
)
@click.option(
    "--play",
    type=click.Choice(["commands", "states"]),
    default="commands",
    show_default=True,
    help="Play the commands, or the recorded positions as commands.",
)
@click.option("--swap-sides", is_flag=True, help="Play each hand's commands on the other hand.")
@click.option(
    "--max-gap",
    type=Number(min=0, min_open=True),
    metavar="S",
    help="Shorten longer pauses to S seconds.  [default: keep them]",
)
@click.option(
    "--accept",
    multiple=True,
    type=click.Choice(_ACCEPTABLE),
    help="Play despite this finding; may be repeated.",
)
@click.option(
    "--max-distance",
    type=Number(min=0, min_open=True),
    metavar="RAD",
    help="Stop if a joint is further than RAD from its command for the time of --distance-time.  "
    "[default: a quarter of its stroke]",
)
@click.option(
    "--distance-time",
    type=Number(min=0),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Time for which a joint may be further from its command than --max-distance.",
)
@click.option(
    "--max-silence",
    type=Number(min=0.05),
    default=PAUSE,
    show_default=True,
    metavar="S",
    help="Stop if a hand publishes no state for S seconds.",
)
@click.option("--loop", is_flag=True, help="Start over at the end, until Ctrl-C.")
@session_options()
@dds_options()
@wait_option("Wait up to S seconds for the hands.")
@force_option()
@click.option(
    "--as-recorded",
    is_flag=True,
    help="Publish the payloads of a recording as they are: no checks, no ramp, no supervision.",
)
@topic_option("With --as-recorded, which it implies: play", "those that end in /cmd")
@click.option(
    "--no-wait", is_flag=True, help="With --as-recorded, which it implies: start at once."
)
@click.pass_context
def command(ctx: click.Context, /, source: Path, **given: Any) -> int:
    """Replay a session on hands, checked and supervised.

    SOURCE is a recording, or a session of any format that 'dexkit import' reads. It is checked
    first; findings are printed, and the session is refused unless an option cures them. The hands
    move slowly from their present pose to the first one, then the session is played. The hands are
    brought to rest at its end, on a fault, without states, too far from the commands, and on
    Ctrl-C, space or q.

    The default domain is 1, the simulation's: --domain 0 with a robot's interface moves real hands.

    If this program was suspended for more than a second, it asks before it moves the hands on;
    without a terminal it ends.
    """
    if given["as_recorded"] or given["no_wait"] or given["topics"]:
        return _as_recorded(ctx, source, given)
    from dexkit.models import model
    from dexkit.traces.replay.commands import read_session
    from dexkit.traces.replay.machine import Guards
    from dexkit.traces.replay.prepare import ReplayOptions, prepare
    from dexkit.traces.sessions.episodes import Options

    if given["hand"] not in (None, "none"):
        model(given["hand"])  # refused before anything is read
    options = Options(rate=given["rate"], hand=given["hand"], correct=not given["keep_sides"])
    replay_options = ReplayOptions(
        sides=given["sides"],
        dialect=given["dialect"],
        pace=given["pace"],
        gains=given["gains"],
        resample=given["resample"],
        limit=given["limit"],
        jumps=given["jumps"],
        invalid=given["invalid"],
        states=given["play"] == "states",
        swap_sides=given["swap_sides"],
        max_gap=given["max_gap"],
        accept=given["accept"],
    )
    guards = Guards(
        ramp_speed=given["ramp_speed"],
        max_distance=given["max_distance"],
        distance_time=given["distance_time"],
        stale=given["max_silence"],
        loop=given["loop"],
    )
    session = read_session(source, given["form"], given["chosen"], options)
    prepared = prepare(session, replay_options)
    _print_session(session, prepared)
    code = 1 if session.damage else 0
    if given["rehearse"]:
        code = _rehearse(prepared, guards, source, session.name, given["html_path"], ctx) or code
    elif given["html_path"] is not None:
        raise UsageError("--report writes the page of a rehearsal", hint="add --rehearse")
    if prepared.refused:
        _print_refusal(source, prepared)
        return 1
    if given["check_only"] or given["rehearse"]:
        return code
    assert prepared.plan is not None
    return _play(prepared, guards, given) or code


def _as_recorded(ctx: click.Context, source: Path, given: dict[str, Any]) -> int:
    from dexkit.cli.replay_as_recorded import play_as_recorded

    stated = click.core.ParameterSource.COMMANDLINE
    for parameter in ctx.command.params:
        name = str(parameter.name)
        if name not in _AS_RECORDED and ctx.get_parameter_source(name) is stated:
            raise UsageError(
                f"{parameter.opts[0]} does not apply to a recording that is published as it is",
                hint="leave out --as-recorded, --topic and --no-wait to play it checked and "
                "supervised",
            )
    return play_as_recorded(
        source,
        speed=given["pace"],
        **{
            name: given[name]
            for name in (
                *("loop", "topics", "max_gap", "domain", "interface"),
                *("wait", "no_wait", "force"),
            )
        },
    )


# ------------------------------------------------------------------------------ what was found


def _print_session(session: RecordedCommands, prepared: Prepared) -> None:
    from rich.table import Table

    from dexkit.console import Console, markup

    spoken = session.dialect
    assert spoken is not None
    plan = prepared.plan
    hands = plan.sides if plan else tuple(session.commands or session.states)
    speaks = f"{spoken.name}, to {plan.dialect.name}" if plan and plan.dialect != spoken else ""
    about = [f"{session.model.title}, {', '.join(map(str, hands))} ({speaks or spoken.name})"]
    if plan:
        rates = [1 / t.period for t in plan.tracks.values() if t.period]
        about.append(f"{plan.commands:,} commands in {plan.duration:.2f} s")
        about += [f"{max(rates):.3g} Hz"] if rates else []
    about.append(session.form if session.form != "recording" else _age(session.first_ns))
    click.echo(one_line(f"{session.name}: {'; '.join(filter(None, about))}", REMARK))
    if not prepared.findings:
        click.echo("nothing was found against it")
        return
    console = Console(width=max(Console().width, 100))
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("finding", "", "hand"):
        table.add_column(heading, no_wrap=True)
    table.add_column("what, and its cure", overflow="fold")
    for f in prepared.findings:
        cure = f.option or f.advice
        cure = f"\n[bold]{markup(cure)}[/]" if cure else ""
        level = f"[{_STYLES[str(f.level)]}]{f.level}[/]"
        table.add_row(markup(f.name), level, markup(f.where), markup(f.text) + cure)
    console.print(table)


def _age(first_ns: int) -> str:
    """When it was recorded."""
    seconds = time.time() - first_ns / 1e9
    if first_ns <= 0 or seconds < 0:
        return ""
    when = datetime.fromtimestamp(first_ns / 1e9, timezone.utc)
    days = int(seconds // 86400)
    ago = f"{days} day{'' if days == 1 else 's'} ago" if days else "today"
    return f"recorded {when:%Y-%m-%d %H:%M} UTC, {ago}"


def _print_refusal(source: Path, prepared: Prepared) -> None:
    names = ", ".join(dict.fromkeys(f.name for f in prepared.refused))
    click.echo(f"refused: {names}", err=True)
    hard = [f for f in prepared.refused if not f.option]
    if prepared.cures and not hard:
        click.echo(f"  cured by: {' '.join(prepared.cures)}", err=True)
        click.echo("  see what that does: the same with --rehearse", err=True)


# ------------------------------------------------------------------------------ rehearsal


def _rehearse(
    prepared: Prepared,
    guards: Guards,
    source: Path,
    name: str,
    page: Path | None,
    ctx: click.Context,
) -> int:
    """Rehearse, print a summary, write the page; the exit code."""
    from dexkit.conformance.report.rehearsal import render
    from dexkit.conformance.virtual.rehearsal import rehearse
    from dexkit.documents import check_output_paths, write_file
    from dexkit.traces.replay.machine import End

    if prepared.plan is None:
        return 1
    if page is None:
        page = Path(f"{Path(name).name.removesuffix('.mcap')}-rehearsal.html")
    check_output_paths([source], [page])
    rehearsal = rehearse(prepared.plan, guards)
    _print_rehearsal(rehearsal)
    write_file(page, render(prepared, rehearsal, source=str(source), options=_options(ctx)))
    click.echo(f"page: {page}")
    return 0 if rehearsal.machine.end is End.DONE else 1


def _options(ctx: click.Context) -> str:
    """The options that were given, for the page."""
    stated = click.core.ParameterSource.COMMANDLINE
    words = []
    for parameter in ctx.command.params:
        name = str(parameter.name)
        if isinstance(parameter, click.Option) and ctx.get_parameter_source(name) is stated:
            value = ctx.params.get(name)
            shown = [] if parameter.is_flag else value if isinstance(value, tuple) else [value]
            words += [parameter.opts[0], *map(str, shown)]
    return redact(" ".join(words))


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


# ------------------------------------------------------------------------------ the hands


def _play(prepared: Prepared, guards: Guards, given: dict[str, Any]) -> int:
    from dexkit.cli.consent import Consent
    from dexkit.cli.stop_keys import is_stop, keys
    from dexkit.dds import DdsNode
    from dexkit.interpreter import timely_threads
    from dexkit.stop_signals import stop_on_signals
    from dexkit.traces.replay.live import LiveReplay
    from dexkit.traces.replay.machine import End, ReplayMachine

    assert prepared.plan is not None
    machine = ReplayMachine(prepared.plan, guards)
    domain, interface = given["domain"], given["interface"]
    with (
        stop_on_signals() as stop,
        DdsNode(domain=domain, interface=interface) as node,
        keys() as pressed,
    ):
        consent = Consent(pressed, stop)
        live = LiveReplay(node, machine, force=given["force"], resume=consent)
        waiting = _Waiting(live, given["wait"])
        if not live.wait_ready(stop.event, waiting):
            return consent.explain() or 130
        click.echo(f"ready: playing on domain {domain}, {interface}; space, q or Ctrl-C stops")
        with timely_threads(), _status() as show:

            def turn(machine: ReplayMachine) -> None:
                show(machine)
                if stop or is_stop(pressed()):
                    machine.stop(End.ASKED, "stopped")

            live.play(turn)
    return _print_end(machine, consent)


def _print_end(machine: ReplayMachine, consent: Consent) -> int:
    from dexkit.traces.replay.machine import End

    done = machine.progress
    text = f"played {machine.at:.1f} s, sent {done.sent} commands"
    if machine.guards.loop:
        text += f", {done.passes} passes"
    for side, (away, joint, at) in done.farthest.items():
        name = machine.names(side)[joint]
        unit = machine.unit(side)
        text += f"; {side} at most {away:.2f} {unit} from its command ({name}, {at:.1f} s)"
    if done.held > 0.1:
        text += f"; held for {done.held:.1f} s by this machine"
    if done.pauses:
        text += f"; paused {done.pauses} times"
    click.echo(one_line(text, REMARK))
    if machine.end is End.DONE:
        return 0
    if machine.end is End.ASKED:
        return 0 if machine.guards.loop else 130
    if machine.end is End.SUSPENDED:
        return consent.explain()
    click.echo(one_line(f"stopped: {machine.reason}", REMARK), err=True)
    return 1


class _Waiting:
    """Prints the missing hands while the command waits for them, and ends the wait."""

    def __init__(self, live: LiveReplay, patience: float) -> None:
        self._live, self._patience = live, patience
        self._told = False

    def __call__(self, seconds: float) -> None:
        """Still waiting.

        :raises DdsError: for longer than the user wants to.
        """
        from dexkit.doctor.hand_domains import elsewhere_hint

        live = self._live
        node, missing = live.node, live.machine.missing
        if live.unsubscribed:
            topics = ", ".join(map(one_line, live.unsubscribed))
            waits, lacks = f"a subscriber of {topics}", f"no process subscribes to {topics}"
        else:
            sides = " and ".join(map(str, missing))
            waits = f"state of the {sides} hand"
            lacks = f"no usable state of the {sides} hand"
        if seconds >= self._patience:
            raise DdsError(
                f"{lacks} on domain {node.domain}, {node.interface} (waited {self._patience:g} s)",
                hint=elsewhere_hint(node) or live.advice(),
            )
        if not self._told and seconds > 0.2:
            self._told = True
            click.echo(f"waiting for {waits} ...", err=True)


@contextmanager
def _status() -> Iterator[Any]:
    """Show the progress in one line, on a terminal."""
    if not sys.stderr.isatty():
        yield lambda machine: None
        return
    shown = 0.0

    def show(machine: ReplayMachine) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= 0.5:
            shown = now
            text = f"{machine.phase}  {machine.at:.1f} of {machine.plan.duration:.1f} s"
            click.echo(f"\r\033[K{text}", nl=False, err=True)

    try:
        yield show
    finally:
        click.echo("\r\033[K", nl=False, err=True)
