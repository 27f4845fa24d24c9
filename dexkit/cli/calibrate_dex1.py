"""``dexkit calibrate dex1-serial``: store the closed position in a Dex1-1's motor."""

from __future__ import annotations

import sys

import click

from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex1_serial.settings import default_path
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, Side

__all__ = ["calibrate_dex1"]


def calibrate_dex1(device: str | None, side: str | None, *, dry_run: bool, yes: bool) -> None:
    """Calibrate the motor of one side, on ``device`` or wherever it is found.

    :param dry_run: only print the position.
    :param yes: do not ask whether the jaws are held closed.
    :raises UsageError: no side, or no terminal to ask on.
    :raises HandError: as :meth:`~dexkit.drivers.dex1_serial.Dex1Serial.calibrate`.
    """
    if side is None:
        raise UsageError("no hand is given", hint="--side left or --side right")
    if not (yes or dry_run) and not sys.stdin.isatty():
        raise UsageError("cannot ask whether the jaws are closed: no terminal", hint="give --yes")
    with Dex1Serial(Side(side), Dex1Settings(device=device, config=default_path())) as hand:
        q = float(hand.exchange(HandCommand.brake(1)).q[0])
        click.echo(f"motor {hand.id} on {hand.path} reports that the jaws are at {q:.3f} rad")
        if dry_run:
            return
        question = "Nothing will move. Hold the jaws closed by hand; they become 0. Ready?"
        if not yes and not click.confirm(question):
            raise click.Abort
        click.echo(f"stored in the motor; it reports {hand.calibrate():.3f} rad now")
