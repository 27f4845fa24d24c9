"""What ``dexkit replay`` and ``dexkit rehearse`` have in common: the session and its check."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from dexkit.cli.options import (
    FILE,
    Number,
    dialect_option,
    pace_option,
    side_option,
)
from dexkit.cli.settings import YES_OR_NO, Setting, Settings, settings_option
from dexkit.command_age import PAUSE
from dexkit.escaping import REMARK, one_line
from dexkit.hand import Side

if TYPE_CHECKING:
    from dexkit.traces.replay.commands import RecordedCommands
    from dexkit.traces.replay.machine import Guards
    from dexkit.traces.replay.prepare import Prepared

__all__ = ["checked_session", "guards", "print_refusal", "session_to_play"]

F = TypeVar("F", bound=Callable[..., Any])

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
_SETTINGS = (
    Setting(
        "play",
        "commands|states",
        click.Choice(["commands", "states"]),
        "Play the commands, or the recorded positions as commands.",
        "commands",
    ),
    Setting(
        "gains",
        "recorded|model",
        click.Choice(["recorded", "model"]),
        "kp and kd of the session, or lowered to those that the model's client sends. Commands "
        "without gains never get any.",
        "recorded",
    ),
    Setting(
        "rate",
        "HZ",
        Number(min=1.0, max=1000.0),
        "Commands per second, interpolated.  [default: the recorded ones]",
    ),
    Setting(
        "limit",
        "refuse|clamp",
        click.Choice(["refuse", "clamp"]),
        "Commands outside the joints' limits: refuse the session, or clamp them.",
        "refuse",
    ),
    Setting(
        "jumps",
        "refuse|stretch",
        click.Choice(["refuse", "stretch"]),
        "Commands that demand too high a joint speed: refuse the session, or stretch time.",
        "refuse",
    ),
    Setting(
        "invalid",
        "refuse|drop",
        click.Choice(["refuse", "drop"]),
        "Commands that cannot be sent (NaN, too few motors, stale, time running backwards): "
        "refuse, or leave them out.",
        "refuse",
    ),
    Setting(
        "swap-sides", "yes|no", YES_OR_NO, "Play each hand's commands on the other hand.", False
    ),
    Setting(
        "max-gap",
        "S",
        Number(min=0, min_open=True),
        "Shorten longer pauses to S seconds.  [default: keep them]",
    ),
    Setting(
        "ramp-speed",
        "RAD/S",
        Number(min=0.01, max=10.0),
        "Joint speed of the motion to the first pose.",
        0.5,
    ),
    Setting(
        "max-distance",
        "RAD",
        Number(min=0, min_open=True),
        "Stop if a joint is further than RAD from its command for the time of distance-time.  "
        "[default: a quarter of its stroke]",
    ),
    Setting(
        "distance-time",
        "S",
        Number(min=0),
        "Time for which a joint may be further from its command than max-distance.",
        1.0,
    ),
    Setting(
        "max-silence",
        "S",
        Number(min=0.05),
        "Stop if a hand publishes no state for S seconds.",
        PAUSE,
    ),
)


def session_to_play() -> Callable[[F], F]:
    """The argument and the options that say what is played, and how."""
    options = (
        click.argument("source", type=FILE),
        side_option("Hands to drive.  [default: all that the session commands]"),
        dialect_option("Dialect of the hands to drive.  [default: the session's]"),
        pace_option("More than 1 needs --accept pace."),
        click.option(
            "--accept",
            multiple=True,
            type=click.Choice(_ACCEPTABLE),
            help="Play despite this finding; may be repeated.",
        ),
        settings_option(_SETTINGS),
    )

    def decorate(function: F) -> F:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


def checked_session(
    source: Path,
    sides: tuple[Side, ...] | None,
    dialect: str | None,
    pace: float,
    accept: tuple[str, ...],
    settings: Settings,
    quiet: bool = False,
) -> tuple[RecordedCommands, Prepared]:
    """Read a session, check it and print what was found.

    :param quiet: print nothing.
    :raises DexkitError: it cannot be read.
    """
    from dexkit.traces.replay.commands import read_session
    from dexkit.traces.replay.prepare import ReplayOptions, prepare

    session = read_session(source)
    prepared = prepare(
        session,
        ReplayOptions(
            sides=sides,
            dialect=dialect,
            pace=pace,
            gains=settings["gains"],
            resample=settings["rate"],
            limit=settings["limit"],
            jumps=settings["jumps"],
            invalid=settings["invalid"],
            states=settings["play"] == "states",
            swap_sides=settings["swap-sides"],
            max_gap=settings["max-gap"],
            accept=accept,
        ),
    )
    if not quiet:
        _print_session(session, prepared)
    return session, prepared


def guards(settings: Settings, *, loop: bool = False) -> Guards:
    """The supervision of a replay."""
    from dexkit.traces.replay.machine import Guards

    return Guards(
        ramp_speed=settings["ramp-speed"],
        max_distance=settings["max-distance"],
        distance_time=settings["distance-time"],
        stale=settings["max-silence"],
        loop=loop,
    )


_STYLES = {"note": "dim", "cured": "green", "accepted": "yellow", "refused": "bold red"}


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


def print_refusal(prepared: Prepared) -> None:
    """Print why a session is refused, and what cures that."""
    names = ", ".join(dict.fromkeys(f.name for f in prepared.refused))
    click.echo(f"refused: {names}", err=True)
    hard = [f for f in prepared.refused if not f.option]
    if prepared.cures and not hard:
        click.echo(f"  cured by: {' '.join(prepared.cures)}", err=True)
        click.echo("  see what that does: the same with 'dexkit rehearse'", err=True)
