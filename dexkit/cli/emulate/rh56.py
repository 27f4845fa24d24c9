"""``dexkit emulate rh56``: an Inspire RH56 on a pseudo-terminal, or on a TCP port."""

from __future__ import annotations

from typing import Any

import click

from dexkit.cli.emulate.serving import line_options, line_settings, one_side, serve
from dexkit.cli.exit_codes import Command
from dexkit.cli.options import id_option, link_option, object_option, side_option, start_option
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.stop_signals import stop_on_signals
from dexkit.wire import rh56

__all__ = ["emulate_rh56"]

_SERIAL_ONLY = ("number", "baudrate", "line_time", "latency_timer", "any_baudrate")


@click.command(
    "rh56",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@side_option("Hand to emulate.", default="right")
@link_option("Link that clients open: the hand's serial line.", required=False)
@click.option(
    "--modbus-tcp",
    "tcp",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    help="Instead of --link: Modbus on this TCP port of 127.0.0.1; 0 takes a free one.",
)
@click.option("--tactile", is_flag=True, help="With --modbus-tcp: an RH56DFTP, with its areas.")
@object_option("Percent of closing at which the joints touch an object")
@start_option("Percent of closing at first; by default a relaxed pose.")
@id_option(rh56.IDS, "Its id on the line.", 1)
@line_options(
    "hand",
    baudrate=rh56.BAUD_RATE,
    most=1_000_000,
    faults="unplug@5s:for=2s, drop:p=0.1, locked@3s",
)
def emulate_rh56(
    sides: tuple[Side, ...],
    link: str | None,
    tcp: int | None,
    tactile: bool,
    object_pct: float | None,
    start: float | None,
    number: int,
    faults_from_stdin: bool,
    **line: Any,
) -> None:
    """Emulate an Inspire RH56 hand on its serial line, or with --modbus-tcp on the network.

    Prints "ready: PATH SIDE ..." (or HOST:PORT) when it answers there. Ctrl-C or SIGTERM ends it
    and removes the link.
    """
    from dexkit.emulators.rh56 import Rh56Hand, Rh56TcpHand

    side, on_line = one_side(sides), line_settings(line)
    if (link is None) == (tcp is None):
        raise UsageError(
            "no place for the hand is given",
            hint="--link PATH for a serial line, or --modbus-tcp PORT",
        )
    with stop_on_signals() as request:
        hand: Rh56Hand | Rh56TcpHand
        if tcp is not None:
            _refuse_serial_options()
            hand = Rh56TcpHand(
                side,
                port=tcp,
                object_pct=object_pct,
                start_pct=start,
                tactile=tactile,
                **{name: on_line[name] for name in ("answer_time", "faults", "seed")},
            )
        else:
            if tactile:
                raise UsageError("--tactile needs --modbus-tcp", hint="--modbus-tcp PORT")
            hand = Rh56Hand(
                side,
                link=link,
                number=number,
                object_pct=object_pct,
                start_pct=start,
                **on_line,
            )
        with hand:
            serve(hand, request, faults_from_stdin=faults_from_stdin)


def _refuse_serial_options() -> None:
    """Refuse the options of a serial line beside ``--modbus-tcp``.

    :raises UsageError: one was given.
    """
    context = click.get_current_context()
    for name in _SERIAL_ONLY:
        if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT:
            option = next(p.opts[0] for p in context.command.params if p.name == name)
            raise UsageError(
                f"{option} applies to a serial line, not to --modbus-tcp", hint="leave it out"
            )
