"""``dexkit emulate lerobot-g1``: LeRobot's ports in front of an emulated G1."""

from __future__ import annotations

import dataclasses
import sys

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import domain_option, host_option
from dexkit.cli.status_line import StatusLine, log_to_stderr
from dexkit.errors import EmulatorError, UsageError
from dexkit.robots import G1
from dexkit.stop_signals import stop_on_signals

__all__ = ["LOOPBACK", "emulate_lerobot_g1"]

LOOPBACK = "127.0.0.1"
_PERIOD = 0.5  # seconds between two looks
_INTERFACE = "lo"


@click.command(
    "lerobot-g1",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@domain_option("DDS domain of the emulated G1, on loopback.", 0)
@host_option("Address to listen on. Another one than of loopback lets other machines command.")
@click.option(
    "--ports",
    metavar="C,S,P",
    help="TCP ports of commands, states and pictures; 0 lets the system choose. "
    " [default: LeRobot's, 6000,6001,5555]",
)
def emulate_lerobot_g1(
    domain: int,
    host: str,
    ports: str | None,
) -> None:
    """Serve the ports of LeRobot's robot server for an emulated G1.

    Stands in for run_g1_server.py of a real G1: the robot's low-level commands and states as JSON
    over ZeroMQ, and pictures (a test card). 'dexkit emulate all --for lerobot' starts it with robot
    and hands.
    Commands are obeyed after one second without a gap of more than 0.25 s, and from one client
    only.

    Prints "ready: ..." when the ports are open. Ctrl-C or SIGTERM ends it.
    """
    from dexkit.dds import DdsNode
    from dexkit.emulators.lerobot import PORTS, LerobotPorts, Ports

    chosen = PORTS if ports is None else Ports(*_parse_ports(ports))
    status = StatusLine(quiet=False)
    log_to_stderr(quiet=True, status=status.on_terminal, always="dexkit.lerobot")
    with (
        stop_on_signals() as stop,
        DdsNode(domain=domain, interface=_INTERFACE) as node,
        LerobotPorts(node, address=host, ports=chosen) as served,
    ):
        open_ports = served.ports
        click.echo(
            f"ready: LeRobot's {G1.name} on {host}: commands {open_ports.commands}, states "
            f"{open_ports.states}, pictures {open_ports.camera}; domain {domain}, {_INTERFACE}"
        )
        sys.stdout.flush()
        states = served.counters.states
        while served.failure is None and not stop.wait(_PERIOD):
            rate, states = (served.counters.states - states) / _PERIOD, served.counters.states
            text = f"LeRobot {served.clients} client(s), {rate:.0f} states/s"
            status.show(f"{text}; {served.counters.forwarded} commands forwarded", text)
        status.clear()
        if served.failure is not None:
            raise EmulatorError(f"LeRobot's ports failed: {served.failure}") from served.failure
    counted = dataclasses.asdict(served.counters)
    click.echo(f"stopped: {', '.join(f'{number} {what}' for what, number in counted.items())}")


def _parse_ports(text: str) -> tuple[int, int, int]:
    """The three ports of an option.

    :raises UsageError: they are not three numbers below 65536.
    """
    words = text.split(",")
    if len(words) != 3 or not all(w.isdecimal() and int(w) < 65536 for w in words):
        raise UsageError(f"--ports {text}", hint="three of them, for example 6000,6001,5555")
    commands, states, camera = map(int, words)
    return commands, states, camera
