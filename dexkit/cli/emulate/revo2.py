"""``dexkit emulate revo2``: BrainCo's Revo2 on a pseudo-terminal."""

from __future__ import annotations

from typing import Any

import click

from dexkit.cli.emulate.serving import line_options, line_settings, one_side, serve
from dexkit.cli.exit_codes import Command
from dexkit.cli.options import id_option, link_option, object_option, side_option, start_option
from dexkit.hand import Side
from dexkit.stop_signals import stop_on_signals
from dexkit.wire import revo2

__all__ = ["emulate_revo2"]


@click.command(
    "revo2",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@side_option("Hand to emulate.", default="right")
@link_option("Link that clients open.")
@object_option("Percent of closing at which the joints touch an object")
@start_option("Percent of closing at first; by default a relaxed pose.")
@id_option(revo2.IDS, "Its Modbus unit; by default 126 of a left hand and 127 of a right one.")
@line_options(
    "hand", baudrate=revo2.BAUD_RATE, most=5_000_000, faults="unplug@5s:for=2s, drop:p=0.1"
)
def emulate_revo2(
    sides: tuple[Side, ...],
    link: str,
    object_pct: float | None,
    start: float | None,
    number: int | None,
    faults_from_stdin: bool,
    **line: Any,
) -> None:
    """Emulate a BrainCo Revo2 hand on its serial line (Modbus RTU).

    Prints "ready: PATH SIDE ..." when it answers there. Ctrl-C or SIGTERM ends it and removes the
    link.
    """
    from dexkit.emulators.revo2 import Revo2Hand

    with (
        stop_on_signals() as request,
        Revo2Hand(
            one_side(sides),
            link=link,
            number=number,
            object_pct=object_pct,
            start_pct=start,
            **line_settings(line),
        ) as hand,
    ):
        serve(hand, request, faults_from_stdin=faults_from_stdin)
