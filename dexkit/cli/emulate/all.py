"""``dexkit emulate all``: a robot with two hands, as processes.

Robot and hands are processes of their own. In one process they would share an interpreter lock:
with a G1 beside two Dex3-1 the hands fell from 1000 to 960 states a second, and the robot
missed one state in forty, at half the load of a processor.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import click

from dexkit.backends import simulators
from dexkit.child_processes import READY_TIMEOUT, Tool
from dexkit.cli.command_help import Command
from dexkit.cli.emulate.lerobot import LOOPBACK
from dexkit.cli.options import (
    dds_options,
    dialect_option,
    duration_option,
    force_option,
    quiet_option,
    view_option,
)
from dexkit.cli.settings import set_option
from dexkit.cli.status_line import STATUS_LINES, StatusLine
from dexkit.errors import DexkitError, EmulatorError
from dexkit.models import short_names
from dexkit.robots import ROBOTS
from dexkit.stop_signals import StopRequest, stop_on_signals
from dexkit.teleop.hands import teleop_hand
from dexkit.view.viewer_process import viewer

__all__ = ["emulate_all"]

_SIMULATORS = simulators()
_HANDS = {short: hand for short, hand in short_names().items() if hand.name in _SIMULATORS}
_POLL = 0.05  # seconds between looks whether all parts live
_XR, _LEROBOT = "xr_teleoperate", "lerobot"
_XR_HANDS, _LEROBOT_HANDS = "dex3", "dex1"  # each client's own default


@click.command(
    "all",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C, SIGTERM or --duration",
        1: "a part failed, or its own exit code",
    },
)
@click.option(
    "--for",
    "client",
    type=click.Choice([_XR, _LEROBOT]),
    default=_XR,
    help="The client: LeRobot's unitree_g1 gets its ports on ZeroMQ (docs/lerobot.md).",
)
@click.option(
    "--robot", type=click.Choice(list(reversed(ROBOTS))), default="g1", help="Which robot."
)
@click.option(
    "--hands",
    type=click.Choice([*_HANDS, "none"]),
    help=f"Which hands, both sides.  [default: {_XR_HANDS}; {_LEROBOT_HANDS} for lerobot]",
)
@dialect_option("Topics, types and units of the hands.  [default: the hand model's first]")
@set_option(
    "Setting of the hands, e.g. object=40; right.object=40 is for one hand. 'dexkit backends' "
    "lists the settings."
)
@dds_options(default_domain=None, domain_default_text="1; 0 for lerobot")
@duration_option()
@force_option()
@view_option()
@quiet_option()
def emulate_all(
    client: str,
    robot: str,
    hands: str | None,
    dialect: str | None,
    settings: tuple[str, ...],
    domain: int | None,
    interface: str,
    duration: float | None,
    force: bool,
    view: bool,
    quiet: bool,
) -> None:
    """Emulate a robot with two hands on Unitree's topics.

    \b
    Examples:
      dexkit emulate all
      dexkit emulate all --robot h1 --hands dex1
      dexkit emulate all --set right.object=40 --duration 60
      dexkit emulate all --for lerobot --hands none

    Prints "ready: ..." when all topics are up, and what to start next. Ctrl-C or SIGTERM ends
    it. When one part ends, all parts end, with its error and exit code.
    """  # noqa: D301  # click wants the backspace itself
    for_lerobot = client == _LEROBOT
    hands = hands or (_LEROBOT_HANDS if for_lerobot else _XR_HANDS)
    domain = domain if domain is not None else 0 if for_lerobot else 1
    if for_lerobot and not ROBOTS[robot].lerobot_name:
        raise click.UsageError(f"LeRobot does not support the {robot}")
    if for_lerobot and interface != "lo":
        raise click.UsageError(
            "--for lerobot uses loopback only; it cannot be combined with --interface"
        )
    if hands == "none" and (dialect or settings):
        raise click.UsageError("--dialect and --set need hands")
    common = ["--domain", str(domain), "--interface", interface]
    common += ["--force"] * force
    parts = {robot: ("emulate", robot, *common)}
    if hands != "none":
        own = [option for text in settings for option in ("--set", text)]
        own += ["--dialect", dialect] if dialect else []
        parts["hands"] = (
            "serve",
            _SIMULATORS[_HANDS[hands].name],
            "--side",
            "both",
            *own,
            *common,
            *["--quiet"] * quiet,
        )
    if for_lerobot:
        parts[_LEROBOT] = ("emulate", "lerobot-g1", "--domain", str(domain))
    with (
        stop_on_signals() as stop,
        viewer(domain, interface, stop.event, click.echo) if view else nullcontext(),
        _Processes(parts, quiet) as processes,
    ):
        processes.wait_ready(stop)
        if not stop:
            title = ROBOTS[robot].title
            if hands != "none":
                title += f" and two {_HANDS[hands].title}s"
            click.echo(f"ready: {title}, domain {domain}, {interface}")
            for_whom = _for_lerobot(robot) if for_lerobot else _for_xr(robot, hands, domain)
            click.echo("\n".join([*for_whom, *_next_steps(domain, interface)]))
            sys.stdout.flush()
            processes.watch(stop, duration)


def _for_xr(robot: str, hands: str, domain: int) -> list[str]:
    """The command that starts xr_teleoperate."""
    if domain not in (0, 1):
        return ["xr_teleoperate joins domain 1 with --sim, else 0: docs/whole-robot.md"]
    driven = teleop_hand(_HANDS[hands].name) if hands in _HANDS else None
    end = f" --ee={driven.option or hands}" if driven else ""
    sim = " --sim" if domain == 1 else ""
    lines = [
        "next, in xr_teleoperate/teleop (docs/whole-robot.md):",
        f"  python teleop_hand_and_arm.py --arm={ROBOTS[robot].teleop_name}{end}{sim}",
    ]
    if driven and driven.note:
        lines.append(f"  ({driven.note})")
    return lines


def _for_lerobot(robot: str) -> list[str]:
    """The command that starts LeRobot."""
    name = ROBOTS[robot].lerobot_name
    return [
        "next, with LeRobot (docs/lerobot.md):",
        f"  lerobot-teleoperate --robot.type={name} --robot.is_simulation=false "
        f"--robot.robot_ip={LOOPBACK} ...",
        f"  (LeRobot's {name} commands the robot only; its hands are on DDS)",
    ]


def _next_steps(domain: int, interface: str) -> list[str]:
    """Return the other commands that a user can run next."""
    where = "" if interface == "lo" else f" --interface {interface}"
    return [
        f'with Unitree\'s SDK: ChannelFactoryInitialize({domain}, "{interface}")',
        f"who is there: dexkit doctor --domain {domain}{where}",
    ]


class _Process:
    """One process of the emulated robot, with its status line and last errors."""

    def __init__(self, name: str, arguments: tuple[str, ...], status: StatusLine) -> None:
        self.name = name
        self.status = ""
        self._line = status
        self._error: list[str] = []
        self.tool = Tool(*arguments, on_line=self._take_line, environment={STATUS_LINES: "1"})

    def _take_line(self, line: str) -> None:
        first, _, rest = line.partition(": ")
        if first == "status":
            self.status = rest
        elif self._error or first == "error":
            self._error.append(rest if first == "error" else line.strip())
        elif not line.startswith("INFO counters"):
            self._line.clear()
            out = first in ("ready", "stopped")
            text = rest if first == "ready" else f"{self.name}: {line}"
            click.echo(text, err=not out)

    @property
    def ready(self) -> bool:
        return bool(self.tool.place)

    def failure(self) -> DexkitError:
        """The error for a process that ended by itself."""
        self.tool.stop()  # so that all its output is read
        code = self.tool.exit_code or 0
        if self._error:
            message, *hint = self._error
            error = DexkitError(f"{self.name}: {message}", hint=" ".join(hint))
        elif code < 0:
            error = DexkitError(f"{self.name}: killed by signal {-code}")
        else:
            error = DexkitError(
                f"{self.name}: ended by itself, exit code {code}", hint=self.tool.last_lines
            )
        error.exit_code = code if code > 0 else 1
        return error


class _Processes:
    """All parts; a context manager. Leaving it ends them together."""

    def __init__(self, parts: dict[str, tuple[str, ...]], quiet: bool) -> None:
        self._commands = parts
        self._status = StatusLine(quiet)
        self.parts: list[_Process] = []

    def __enter__(self) -> _Processes:
        try:
            for name, arguments in self._commands.items():
                self.parts.append(_Process(name, arguments, self._status))
        except BaseException:
            self._stop()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self._status.clear()
        self._stop()

    def _stop(self) -> None:
        if not self.parts:
            return
        with ThreadPoolExecutor(len(self.parts)) as pool:
            polite = list(pool.map(lambda part: part.tool.stop(), self.parts))
        for part, was in zip(self.parts, polite, strict=True):
            if not was:
                click.echo(f"{part.name}: did not end when asked to, and was killed", err=True)

    def _check(self) -> None:
        """Whether all live.

        :raises DexkitError: one does not.
        """
        for part in self.parts:
            if not part.tool.running:
                raise part.failure()

    def wait_ready(self, stop: StopRequest) -> None:
        """Until all topics are up.

        :raises DexkitError: a part ended instead, or took too long.
        """
        end = time.monotonic() + READY_TIMEOUT
        while not all(part.ready for part in self.parts) and not stop.wait(_POLL):
            self._check()
            if time.monotonic() > end:
                late = ", ".join(part.name for part in self.parts if not part.ready)
                raise EmulatorError(f"{late}: not ready after {READY_TIMEOUT:g} s")

    def watch(self, stop: StopRequest, duration: float | None) -> None:
        """Show one status line for all processes, until asked to stop or time is up.

        :raises DexkitError: a part ended.
        """
        end = None if duration is None else time.monotonic() + duration
        shown = ""
        while not stop.wait(_POLL):
            self._check()
            if end is not None and time.monotonic() >= end:
                return
            line = " | ".join(part.status for part in self.parts if part.status)
            if line != shown:
                self._status.show(line)
                shown = line
