"""``dexkit emulate``: emulate devices on serial lines and USB, robots, and whole robots."""

from __future__ import annotations

import click

from dexkit.cli.lazy_group import LazyGroup, Sections

__all__ = ["command"]

_SECTIONS: Sections = {
    "Robots": {
        "all": (
            "dexkit.cli.emulate.all:emulate_all",
            "Emulate a whole robot: a robot and two hands.",
        ),
        "g1": (
            "dexkit.cli.emulate.robot:emulate_g1",
            "Emulate a G1 without hands (rt/lowcmd, rt/lowstate, unitree_hg).",
        ),
        "h1": (
            "dexkit.cli.emulate.robot:emulate_h1",
            "Emulate an H1 without hands (rt/lowcmd, rt/lowstate, unitree_go).",
        ),
        "lerobot-g1": (
            "dexkit.cli.emulate.lerobot:emulate_lerobot_g1",
            "Serve LeRobot's ports (ZeroMQ) for an emulated G1.",
        ),
    },
    "Devices": {
        "dex1-motor": (
            "dexkit.cli.emulate.dex1_motor:emulate_dex1_motor",
            "Emulate the serial motor of a Dex1-1 on a pseudo-terminal.",
        ),
        "dex3-usb": (
            "dexkit.cli.emulate.dex3_usb:emulate_dex3_usb",
            "Emulate a Dex3-1 hand on USB (USB/IP).",
        ),
        "mx64": (
            "dexkit.cli.emulate.mx64:emulate_mx64",
            "Emulate an MX-64 with an EZGripper on a pseudo-terminal.",
        ),
        "revo2": (
            "dexkit.cli.emulate.revo2:emulate_revo2",
            "Emulate a BrainCo Revo2 hand on a pseudo-terminal.",
        ),
        "rh56": (
            "dexkit.cli.emulate.rh56:emulate_rh56",
            "Emulate an Inspire RH56 hand on a pseudo-terminal or a TCP port.",
        ),
    },
}


@click.command(cls=LazyGroup, sections=_SECTIONS)
def command() -> None:
    """Emulate a device or a robot, so that programs can be tried without it."""
