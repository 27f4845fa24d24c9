"""``dexkit emulate revo2``: BrainCo's Revo2 on a pseudo-terminal."""

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
from dexkit.cli.settings import Setting, Settings
from dexkit.hand import Side
from dexkit.wire import revo2

__all__ = ["emulate_revo2"]


@device_command(
    "revo2",
    side="right",
    link="Link that clients open.",
    settings=(
        object_setting("Percent of closing at which the joints touch an object"),
        start_setting("Percent of closing at first.  [default: a relaxed pose]"),
        Setting(
            "id",
            "N",
            click.IntRange(revo2.IDS[0], revo2.IDS[-1]),
            "Its Modbus unit.  [default: 126 of a left hand, 127 of a right one]",
        ),
        *line_settings("hand", baudrate=revo2.BAUD_RATE, most=5_000_000),
    ),
    faults="unplug@5s:for=2s, drop:p=0.1",
)
def emulate_revo2(
    sides: Sequence[Side], links: Sequence[str], settings: Settings, faults: Sequence[str]
) -> AbstractContextManager[Served]:
    """Emulate a BrainCo Revo2 hand on its serial line (Modbus RTU).

    Prints "ready: PATH SIDE ..." when it answers there. Ctrl-C or SIGTERM ends it and removes the
    link.
    """
    from dexkit.emulators.revo2 import Revo2Hand

    return Revo2Hand(
        one_side(sides),
        link=one_link(links),
        number=settings["id"],
        object_pct=settings["object"],
        start_pct=settings["start"],
        **line_arguments(settings, faults),
    )
