"""``dexkit emulate dex3-usb``: an emulated Dex3-1 on USB/IP."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.emulate.serving import (
    Served,
    device_command,
    object_setting,
    one_link,
    real_time_setting,
    seed_setting,
    start_setting,
    wiring_setting,
)
from dexkit.cli.options import OUTPUT_FILE
from dexkit.cli.settings import YES_OR_NO, Setting, Settings
from dexkit.escaping import one_line
from dexkit.hand import Side

if TYPE_CHECKING:
    from dexkit.emulators.dex3_mcu import Dex3Hands

__all__ = ["emulate_dex3_usb"]


class _Endpoint(click.ParamType):  # type: ignore[type-arg]
    name = "endpoint"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            found = int(value, 0)
        except ValueError:
            found = -1
        # USB 2.0, 9.6.6: the direction in bit 7, the number in bits 0 to 3; 0 is the control one
        if found & ~0x8F or not found & 0x0F:
            self.fail(f"{one_line(value, 40)!r} is not an endpoint address such as 0x81")
        return found


class _Serials(click.ParamType):  # type: ignore[type-arg]
    name = "serials"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        return tuple(str(value).split(","))


def _how_to(hands: Dex3Hands) -> list[str]:
    host, port = hands.url.removeprefix("usbip://").rsplit(":", 1)
    if host == "0.0.0.0":  # every address of this machine: clients need one of them
        host = socket.gethostname()
    tcp = "" if port == "3240" else f"--tcp-port {port} "
    lines = ["as a USB device of a Linux host (as root): modprobe vhci-hcd"]
    lines += [f"  usbip {tcp}attach -r {host} -b {busid}" for busid in hands.busids]
    lines += [
        "  lsusb -d 34b7:",
        "without kernel support: dexkit serve dex3-usb --set guesses=accept "
        f"--set usb=usbip://{host}:{port}",
    ]
    return lines


@device_command(
    "dex3-usb",
    side="left",
    link="Address to serve USB/IP on; port 0 takes a free one. Any client that reaches it can "
    "move the hand: there is no password.",
    default_link="usbip://127.0.0.1:3240",
    settings=(
        Setting(
            "serial",
            "S[,S]",
            _Serials(),
            "Serial number; with --side both, of each.  [default: 2024061800,2024061801]",
        ),
        object_setting("Percent of closing at which the fingers touch an object"),
        start_setting("Percent of closing at first.  [default: at rest, about 20]"),
        Setting("out-endpoint", "EP", _Endpoint(), "Bulk OUT endpoint.  [default: 0x02]"),
        Setting("in-endpoint", "EP", _Endpoint(), "Bulk IN endpoint.  [default: 0x81]"),
        wiring_setting(
            "Random bus addresses of motors and sensors, and random directions, offsets and gear "
            "ratios.  [default: as dexkit assumes]"
        ),
        Setting(
            "polled-sensors",
            "yes|no",
            YES_OR_NO,
            "Sensors answer only where they are addressed (docs/dex3-protocol.md).",
            False,
        ),
        Setting(
            "log-commands",
            "FILE",
            OUTPUT_FILE,
            "Write a line of JSON for each command that drives a motor.",
        ),
        seed_setting(),
        real_time_setting(False),
    ),
    faults="unplug@5s:for=2s, silent:id=3, drop:p=0.05",
    then=_how_to,
)
def emulate_dex3_usb(
    sides: Sequence[Side], links: Sequence[str], settings: Settings, faults: Sequence[str]
) -> AbstractContextManager[Served]:
    """Emulate a Dex3-1 hand on USB, served by USB/IP.

    Prints "ready: URL SIDE ..." for each hand when it can be attached. Ctrl-C or SIGTERM ends it.
    """
    from dexkit.emulators.dex3_mcu import Dex3Hands, Firmware, Wiring
    from dexkit.emulators.dex3_mcu.usb import IN_ENDPOINT, OUT_ENDPOINT
    from dexkit.emulators.line_port import server_address

    host, port = server_address(one_link(links))
    seed = settings["wiring"]
    return Dex3Hands(
        sides,
        host=host,
        port=port,
        serials=settings["serial"] or (),
        object_pct=settings["object"],
        start=settings["start"],
        out_endpoint=settings["out-endpoint"] or OUT_ENDPOINT,
        in_endpoint=settings["in-endpoint"] or IN_ENDPOINT,
        faults=faults,
        firmware=Firmware(sensors_polled=settings["polled-sensors"]),
        wiring=None if seed is None else Wiring.random(seed),
        log=settings["log-commands"],
        seed=settings["seed"],
    )
