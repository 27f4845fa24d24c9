"""``dexkit emulate dex1-motor``: the Dex1-1's serial motor on a pseudo-terminal."""

from __future__ import annotations

from typing import Any

import click

from dexkit.cli.emulate.serving import line_options, line_settings, serve
from dexkit.cli.exit_codes import Command
from dexkit.cli.options import (
    Number,
    links_option,
    object_option,
    side_option,
    start_option,
    wiring_option,
)
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.stop_signals import stop_on_signals
from dexkit.wire import m4010

__all__ = ["emulate_dex1_motor"]


@click.command(
    "dex1-motor",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@side_option("Motor to emulate: id 0 is the right one, 1 the left one.", default="left")
@links_option(
    "Link that clients open. With --side both, one for a line with both motors, or "
    "left=PATH and right=PATH for a line each. usbip://HOST:PORT for an FTDI adapter (FT232H) on "
    "USB/IP, which has a latency timer of its own."
)
@object_option("Percent of opening at which the jaws touch an object")
@start_option("Opening at first.", 20.0)
@click.option(
    "--zero-error",
    type=Number(-6, 6),
    default=0.0,
    metavar="RAD",
    help="Report the position too large by this, until it is calibrated.",
)
@wiring_option("Random ids, directions, offsets and gear ratios, to test a bring-up.")
@line_options(
    "motor",
    baudrate=m4010.BAUD_RATE,
    most=12_000_000,
    faults="unplug@5s:for=2s, stray:before=1, silent:id=1",
)
def emulate_dex1_motor(
    sides: tuple[Side, ...],
    links: tuple[str, ...],
    object_pct: float | None,
    start: float,
    zero_error: float,
    wiring: int | None,
    faults_from_stdin: bool,
    **line: Any,
) -> None:
    """Emulate the motor of a Dex1-1 (Unitree M4010) with the gripper on its shaft.

    Prints "ready: PATH SIDE ..." for each line when it answers there. Ctrl-C or SIGTERM ends it
    and removes the link.
    """
    from dexkit.emulators.m4010 import Dex1Motors, Firmware, Wiring

    on_line = line_settings(line)
    firmware = Firmware(baudrate=on_line.pop("baudrate"), answer_time=on_line.pop("answer_time"))
    with (
        stop_on_signals() as request,
        Dex1Motors(
            sides,
            links=_places(links, sides),
            object_pct=object_pct,
            start_pct=start,
            zero_error=zero_error,
            wiring=None if wiring is None else Wiring.random(wiring),
            firmware=firmware,
            **on_line,
        ) as motors,
    ):
        serve(motors, request, faults_from_stdin=faults_from_stdin)


def _places(links: tuple[str, ...], sides: tuple[Side, ...]) -> dict[Side, str]:
    if len(links) == 1 and not links[0].startswith(tuple(f"{side}=" for side in Side)):
        return dict.fromkeys(sides, links[0])
    places: dict[Side, str] = {}
    for text in links:
        name, _, path = text.partition("=")
        if name not in [str(side) for side in sides] or Side(name) in places or not path:
            raise UsageError(
                f"--link {text} is not left=PATH or right=PATH of a hand that is emulated",
                hint="--link left=PATH --link right=PATH",
            )
        places[Side(name)] = path
    if set(places) != set(sides):
        raise UsageError("a link is needed for each side", hint="or one --link PATH for both")
    return places
