"""``dexkit emulate rh56``: an Inspire RH56 on a pseudo-terminal, or on a TCP port."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager

import click

from dexkit.cli.emulate.serving import (
    Served,
    device_command,
    line_arguments,
    line_settings,
    object_setting,
    one_link,
    one_side,
    start_setting,
)
from dexkit.cli.settings import YES_OR_NO, Setting, Settings
from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.hand import Side
from dexkit.wire import rh56

__all__ = ["emulate_rh56"]

_TCP = "tcp://127.0.0.1:"
_SERIAL_ONLY = {"id", "baudrate", "line-time", "latency-timer", "any-baudrate"}


@device_command(
    "rh56",
    side="right",
    link=f"Link that clients open: the hand's serial line. {_TCP}PORT serves Modbus on that port "
    "of this machine instead; 0 takes a free one.",
    settings=(
        Setting("tactile", "yes|no", YES_OR_NO, "With tcp://: an RH56DFTP, with its areas.", False),
        object_setting("Percent of closing at which the joints touch an object"),
        start_setting("Percent of closing at first.  [default: a relaxed pose]"),
        Setting(
            "id", "N", click.IntRange(rh56.IDS[0], rh56.IDS[-1]), "Its id on the serial line.", 1
        ),
        *line_settings("hand", baudrate=rh56.BAUD_RATE, most=1_000_000),
    ),
    faults="unplug@5s:for=2s, drop:p=0.1, locked@3s",
)
def emulate_rh56(
    sides: Sequence[Side], links: Sequence[str], settings: Settings, faults: Sequence[str]
) -> AbstractContextManager[Served]:
    """Emulate an Inspire RH56 hand on its serial line, or on the network.

    Prints "ready: PATH SIDE ..." (or HOST:PORT) when it answers there. Ctrl-C or SIGTERM ends it
    and removes the link.
    """
    from dexkit.emulators.rh56 import Rh56Hand, Rh56TcpHand

    side, link = one_side(sides), one_link(links)
    on_line = line_arguments(settings, faults)
    pose = {"object_pct": settings["object"], "start_pct": settings["start"]}
    if "://" not in link:
        if settings["tactile"]:
            raise UsageError("a tactile hand is on the network", hint=f"--link {_TCP}PORT")
        return Rh56Hand(side, link=link, number=settings["id"], **pose, **on_line)
    if wrong := sorted(_SERIAL_ONLY & settings.given):
        raise UsageError(f"{wrong[0]} is of a serial line, not of {link}", hint="leave it out")
    return Rh56TcpHand(
        side,
        port=_port(link),
        tactile=settings["tactile"],
        **pose,
        **{name: on_line[name] for name in ("faults", "seed")},
    )


def _port(link: str) -> int:
    """The port of ``tcp://127.0.0.1:PORT``.

    :raises UsageError: it is another address, or no port.
    """
    port = link.removeprefix(_TCP)
    if not (link.startswith(_TCP) and port.isascii() and port.isdecimal() and len(port) <= 5):
        raise UsageError(
            f"{one_line(link, 80)} is no port of this machine", hint=f"--link {_TCP}6000"
        )
    if int(port) > 65535:
        raise UsageError(f"{port} is no TCP port", hint="1 to 65535, or 0 for a free one")
    return int(port)
