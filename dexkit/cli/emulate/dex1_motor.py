"""``dexkit emulate dex1-motor``: the Dex1-1's serial motor on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager

from dexkit.cli.emulate.serving import (
    Served,
    device_command,
    line_arguments,
    line_settings,
    object_setting,
    start_setting,
    wiring_setting,
)
from dexkit.cli.options import Number
from dexkit.cli.settings import Setting, Settings
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.wire import m4010

__all__ = ["emulate_dex1_motor"]


@device_command(
    "dex1-motor",
    side="left",
    link="Link that clients open. With --side both, one for a line with both motors, or "
    "left=PATH and right=PATH for a line each. usbip://HOST:PORT for an FTDI adapter (FT232H) on "
    "USB/IP, which has a latency timer of its own.",
    settings=(
        object_setting("Percent of opening at which the jaws touch an object"),
        start_setting("Percent of opening at first.", 20.0),
        Setting(
            "zero-error",
            "RAD",
            Number(-6, 6),
            "Report the position too large by this, until it is calibrated.",
            0.0,
        ),
        wiring_setting("Random ids, directions, offsets and gear ratios, to test a bring-up."),
        *line_settings("motor", baudrate=m4010.BAUD_RATE, most=12_000_000),
    ),
    faults="unplug@5s:for=2s, stray:before=1, silent:id=1",
)
def emulate_dex1_motor(
    sides: Sequence[Side], links: Sequence[str], settings: Settings, faults: Sequence[str]
) -> AbstractContextManager[Served]:
    """Emulate the motor of a Dex1-1 (Unitree M4010) with the gripper on its shaft.

    The left motor has id 1, the right one id 0. Prints "ready: PATH SIDE ..." for each line when it
    answers there. Ctrl-C or SIGTERM ends it and removes the link.
    """
    from dexkit.emulators.m4010 import Dex1Motors, Firmware, Wiring

    on_line = line_arguments(settings, faults)
    firmware = Firmware(baudrate=on_line.pop("baudrate"))
    seed = settings["wiring"]
    return Dex1Motors(
        sides,
        links=_places(links, sides),
        object_pct=settings["object"],
        start_pct=settings["start"],
        zero_error=settings["zero-error"],
        wiring=None if seed is None else Wiring.random(seed),
        firmware=firmware,
        **on_line,
    )


def _places(links: Sequence[str], sides: Sequence[Side]) -> dict[Side, str]:
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
