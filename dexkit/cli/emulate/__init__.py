"""``dexkit emulate``: emulate devices on serial lines and USB, robots, and whole robots."""

from __future__ import annotations

import importlib

import click

__all__ = ["command"]

# name -> (module, attribute, one-line help); the help is here so that a listing imports nothing
_DEVICES = {
    "all": (
        "dexkit.cli.emulate.all",
        "emulate_all",
        "Emulate a whole robot: a robot and two hands.",
    ),
    "dex1-motor": (
        "dexkit.cli.emulate.dex1_motor",
        "emulate_dex1_motor",
        "Emulate the serial motor of a Dex1-1 on a pseudo-terminal.",
    ),
    "dex3-usb": (
        "dexkit.cli.emulate.dex3_usb",
        "emulate_dex3_usb",
        "Emulate a Dex3-1 hand on USB (USB/IP).",
    ),
    "g1": (
        "dexkit.cli.emulate.robot",
        "emulate_g1",
        "Emulate a G1 without hands (rt/lowcmd, rt/lowstate, unitree_hg).",
    ),
    "h1": (
        "dexkit.cli.emulate.robot",
        "emulate_h1",
        "Emulate an H1 without hands (rt/lowcmd, rt/lowstate, unitree_go).",
    ),
    "lerobot-g1": (
        "dexkit.cli.emulate.lerobot",
        "emulate_lerobot_g1",
        "Serve LeRobot's ports (ZeroMQ) for an emulated G1.",
    ),
    "revo2": (
        "dexkit.cli.emulate.revo2",
        "emulate_revo2",
        "Emulate a BrainCo Revo2 hand on a pseudo-terminal.",
    ),
    "rh56": (
        "dexkit.cli.emulate.rh56",
        "emulate_rh56",
        "Emulate an Inspire RH56 hand on a pseudo-terminal or a TCP port.",
    ),
    "mx64": (
        "dexkit.cli.emulate.mx64",
        "emulate_mx64",
        "Emulate an MX-64 with an EZGripper on a pseudo-terminal.",
    ),
}


class _Devices(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_DEVICES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = _DEVICES.get(cmd_name)
        if entry is None:
            return None
        command = getattr(importlib.import_module(entry[0]), entry[1])
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, _DEVICES[name][2]) for name in sorted(_DEVICES)])


@click.command(cls=_Devices)
def command() -> None:
    """Emulate a device, so that programs can be tried without it."""
