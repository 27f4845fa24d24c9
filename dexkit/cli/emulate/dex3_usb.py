"""``dexkit emulate dex3-usb``: an emulated Dex3-1 on USB/IP."""

from __future__ import annotations

import socket
import sys
from contextlib import nullcontext
from pathlib import Path

import click

from dexkit.cli.emulate.stdin import A_MISTAKE, read_faults
from dexkit.cli.exit_codes import Command
from dexkit.cli.options import (
    FILE,
    fault_options,
    host_option,
    object_option,
    port_option,
    real_time_option,
    seed_option,
    side_option,
    start_option,
    wiring_option,
)
from dexkit.errors import EmulatorError
from dexkit.escaping import one_line
from dexkit.hand import Side
from dexkit.stop_signals import stop_on_signals

__all__ = ["emulate_dex3_usb"]


def _endpoint(ctx: click.Context, param: click.Parameter, value: str) -> int:
    try:
        found = int(value, 0)
    except ValueError:
        found = -1
    # USB 2.0, 9.6.6: the direction in bit 7, the number in bits 0 to 3; 0 is the control endpoint
    if found & ~0x8F or not found & 0x0F:
        shown = one_line(value, 40)
        raise click.BadParameter(f"{shown!r} is not an endpoint address such as 0x81")
    return found


@click.command(
    "dex3-usb",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@side_option("Hand to emulate.", default="left")
@click.option(
    "--serial",
    "serials",
    multiple=True,
    metavar="S",
    help="Serial number; with --side both, give two.  [default: 2024061800 and 2024061801]",
)
@port_option("TCP port; 0 takes a free one.", 3240)
@host_option(
    "Address to serve on. Any client that reaches it can move the hand: there is no password."
)
@object_option("Percent of closing at which the fingers touch an object")
@start_option("Percent of closing at first.  [default: at rest, about 20]")
@click.option(
    "--out-endpoint", callback=_endpoint, default="0x02", metavar="EP", help="Bulk OUT endpoint."
)
@click.option(
    "--in-endpoint", callback=_endpoint, default="0x81", metavar="EP", help="Bulk IN endpoint."
)
@wiring_option(
    "Random bus addresses of motors and sensors, and random directions, offsets and gear "
    "ratios.  [default: as dexkit assumes]"
)
@click.option(
    "--polled-sensors",
    is_flag=True,
    help="Sensors answer only where they are addressed (docs/dex3-protocol.md).",
)
@click.option(
    "--log-commands",
    type=FILE,
    metavar="FILE",
    help="Write a line of JSON for each command that drives a motor.",
)
@fault_options("unplug@5s:for=2s, silent:id=3, drop:p=0.05")
@seed_option("the faults")
@real_time_option(default=False)
def emulate_dex3_usb(
    sides: tuple[Side, ...],
    serials: tuple[str, ...],
    port: int,
    host: str,
    object_pct: float | None,
    start: float | None,
    out_endpoint: int,
    in_endpoint: int,
    wiring: int | None,
    polled_sensors: bool,
    log_commands: Path | None,
    faults: tuple[str, ...],
    faults_from_stdin: bool,
    seed: int,
    real_time: bool,
) -> None:
    """Emulate a Dex3-1 hand on USB, served by USB/IP.

    Prints "ready: URL SIDE ..." for each hand when it can be attached. Ctrl-C or SIGTERM ends it.
    """
    from dexkit.emulators.dex3_mcu import Dex3Hands, Firmware, Wiring
    from dexkit.service.realtime import real_time as real_time_priority

    with (
        # before its thread is started, which inherits it
        real_time_priority() if real_time else nullcontext(True) as granted,
        stop_on_signals() as request,
        Dex3Hands(
            sides,
            host=host,
            port=port,
            serials=serials,
            object_pct=object_pct,
            start=start,
            out_endpoint=out_endpoint,
            in_endpoint=in_endpoint,
            faults=faults,
            firmware=Firmware(sensors_polled=polled_sensors),
            wiring=None if wiring is None else Wiring.random(wiring),
            log=log_commands,
            seed=seed,
        ) as hands,
    ):
        if not granted:
            click.echo("no real-time priority: this user has no rtprio limit", err=True)
        if faults_from_stdin:
            read_faults(hands.inject, request)
        click.echo("\n".join([*hands.ready_lines, *_how_to(hands.url, host, hands.busids)]))
        sys.stdout.flush()
        while not request.wait(0.2):
            if hands.error is not None:
                raise EmulatorError(f"the emulator stopped: {hands.error}") from hands.error
        for one in sides:
            summary = hands.device(one).counters.summary() or "nothing was sent"
            click.echo(f"stopped: {one}: {summary}")
        if hands.failure is not None:
            raise EmulatorError(f"the emulator failed inside: {hands.failure!r}", hint=A_MISTAKE)


def _how_to(url: str, host: str, busids: list[str]) -> list[str]:
    port = url.rsplit(":", 1)[1]
    if host == "0.0.0.0":  # every address of this machine: clients need one of them
        host = socket.gethostname()
        url = f"usbip://{host}:{port}"
    tcp = "" if port == "3240" else f"--tcp-port {port} "
    lines = ["as a USB device of a Linux host (as root): modprobe vhci-hcd"]
    lines += [f"  usbip {tcp}attach -r {host} -b {busid}" for busid in busids]
    lines += [
        "  lsusb -d 34b7:",
        f"without kernel support: dexkit serve dex3-usb --accept-guesses --usb {url}",
    ]
    return lines
