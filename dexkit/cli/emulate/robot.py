"""``dexkit emulate h1`` and ``dexkit emulate g1``: an emulated robot on Unitree's topics."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.emulate.serving import real_time_setting, seed_setting
from dexkit.cli.emulate.stdin import STDIN, read_faults
from dexkit.cli.options import (
    Number,
    dds_options,
    force_option,
    json_option,
)
from dexkit.cli.settings import YES_OR_NO, Setting, Settings, settings_option
from dexkit.cli.status_line import MOST_REMARKS, StatusLine, log_to_stderr
from dexkit.errors import DdsError, TopicConflict
from dexkit.robots import G1, H1, RobotModel
from dexkit.stop_signals import StopRequest, stop_on_signals

if TYPE_CHECKING:
    from dexkit.emulators.robot import EmulatedRobot

__all__ = ["emulate_g1", "emulate_h1"]

log = logging.getLogger("dexkit.robot")

_STATUS_PERIOD = 0.5  # seconds
_JSON_PERIOD = 1.0


def _command(model: RobotModel) -> click.Command:
    """The command of one robot."""

    def emulate(
        domain: int,
        interface: str,
        remote: tuple[str, ...],
        settings: Settings,
        force: bool,
        as_json: bool,
    ) -> None:
        from dexkit.emulators import robot as emulated
        from dexkit.service.realtime import prepare_process
        from dexkit.service.realtime import real_time as real_time_priority

        held = emulated.Remote.parse(",".join(keys for keys in remote if keys != STDIN))
        chosen = dataclasses.replace(
            model, mode_machine=settings.get("mode-machine", model.mode_machine)
        )
        peculiar = emulated.Settings(
            lenient=settings["lenient"], noise=settings["noise"], seed=settings["seed"]
        )
        status = StatusLine(quiet=False)
        log_to_stderr(quiet=True, status=status.on_terminal, always=log.name)
        robot = emulated.EmulatedRobot(
            chosen, domain=domain, interface=interface, settings=peculiar, force=force
        )
        robot.robot.remote = held
        with (
            # before its thread is started, which inherits it
            real_time_priority() if settings["real-time"] else nullcontext(True),
            stop_on_signals() as stop,
            robot,
        ):
            prepare_process()
            if STDIN in remote:

                def press(text: str) -> None:
                    robot.robot.remote = emulated.Remote.parse("" if text == "release" else text)

                read_faults(press, stop)
            click.echo(
                f"ready: {chosen.name} on {chosen.cmd_topic} and {chosen.state_topic} "
                f"({chosen.family}, {len(chosen.used)} joints in {chosen.slots} slots), "
                f"{chosen.state_rate:g} Hz, domain {domain}, {interface}"
            )
            sys.stdout.flush()
            _watch(robot, stop, status=status, as_json=as_json)
        if isinstance(robot.failure, TopicConflict):
            raise robot.failure
        if robot.failure is not None:
            raise DdsError(f"the {chosen.name} failed: {robot.failure}") from robot.failure
        if not as_json:
            click.echo(f"stopped: {robot.robot.counters.summary() or 'no state was published'}")

    machine = f"\n    mode_machine is {model.mode_machine}, and commands must repeat it."
    emulate.__doc__ = f"""Emulate Unitree's {model.name.upper()} on its low-level topics.

    {model.cmd_topic}, {model.arm_topic} and {model.state_topic} with {model.family} messages:
    {len(model.used)} joints in {model.slots} motor slots on a fixed base, IMU, battery and remote.
    Commands with a wrong CRC are ignored and reported.{machine if model.mode_machine else ""}

    \b
    Examples:
      dexkit emulate {model.name}
      dexkit emulate {model.name} --remote A,R1,lx=0.5
      dexkit emulate {model.name} --domain 0 --json    (programs that know no other domain)

    Prints "ready: ..." when the topics are up. Ctrl-C or SIGTERM ends it.
    """
    decorated = emulate
    for option in reversed(_options(model)):
        decorated = option(decorated)
    return click.command(
        model.name,
        cls=Command,
        exit_codes={
            0: "stopped by Ctrl-C or SIGTERM",
            1: "it failed while it ran, or another program publishes the same topics",
        },
    )(decorated)


def _options(model: RobotModel) -> list[Callable[[Any], Any]]:
    machine = () if model.mode_machine is None else (_mode_machine(model.mode_machine),)
    return [
        dds_options(),
        click.option(
            "--remote",
            multiple=True,
            metavar="KEYS",
            help="Keys held on the wireless remote, and positions of its sticks, e.g. A,R1,lx=0.5. "
            "- reads KEYS (or 'release') as lines of standard input, and stops at its end.",
        ),
        settings_option((*machine, *_SETTINGS)),
        force_option(),
        json_option("Print a line of JSON each second."),
    ]


def _mode_machine(default: int) -> Setting:
    return Setting(
        "mode-machine",
        "N",
        click.IntRange(1, 255),
        "mode_machine of the state, the kind of robot (the table is in unitree_ros).",
        default,
    )


_SETTINGS = (
    Setting(
        "lenient",
        "yes|no",
        YES_OR_NO,
        "Obey any mode byte but 0, and commands with another mode_machine.",
        False,
    ),
    Setting("noise", "X", Number(0, 1000), "Noise of the IMU; 1 is that of a plain one.", 0.0),
    seed_setting("the noise"),
    real_time_setting(True),
)


def _watch(
    robot: EmulatedRobot,
    stop: StopRequest,
    *,
    status: StatusLine,
    as_json: bool,
) -> None:
    """Print the status until asked to stop."""
    period = _JSON_PERIOD if as_json else _STATUS_PERIOD
    counters = robot.robot.counters
    then, states, orders = time.monotonic(), counters.states, counters.commands
    state_rate = command_rate = 0.0
    logged: set[str] = set()
    over = False
    while not over:
        over = stop.wait(period) or bool(robot.failure)
        for text in sorted(set(robot.mismatches()) - logged)[: MOST_REMARKS - len(logged)]:
            logged.add(text)
            log.warning("%s", text)
        now = time.monotonic()
        if (span := now - then) > 0.5 * period:  # the last one may be too short
            state_rate = (counters.states - states) / span
            command_rate = (counters.commands - orders) / span
            then, states, orders = now, counters.states, counters.commands
        if as_json:
            line = {
                "robot": robot.model.name,
                "state_hz": round(state_rate, 1),
                "command_hz": round(command_rate, 1),
                "driven": robot.robot.driven,
                "readers": robot.clients,
                "commanders": robot.commanders,
                "missed": robot.missed,
                **dataclasses.asdict(counters),
            }
            click.echo(json.dumps(line))
            sys.stdout.flush()
        elif status:
            what = "driven" if robot.robot.driven else "damping"
            ignored = counters.bad_crc + counters.bad_number + counters.bad_machine
            text = (
                f"{robot.model.name} {what}; state {state_rate:.0f} Hz, {robot.clients} readers; "
                f"commands {command_rate:.0f} Hz of {robot.commanders}, {ignored} ignored"
            )
            orders_in = f", {command_rate:.0f} commands/s" if robot.commanders else ""
            status.show(text, f"{robot.model.name} {what} {state_rate:.0f} Hz{orders_in}")
    status.clear()


emulate_h1 = _command(H1)
emulate_g1 = _command(G1)
