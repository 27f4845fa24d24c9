"""What the commands of emulated devices have in common: options, settings and run loop."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import click

from dexkit.cli.command_help import Command
from dexkit.cli.emulate.stdin import A_MISTAKE, STDIN, read_faults
from dexkit.cli.options import Number, side_option
from dexkit.cli.settings import YES_OR_NO, Setting, Settings, settings_option
from dexkit.errors import EmulatorError, UsageError
from dexkit.hand import Side
from dexkit.stop_signals import StopRequest, stop_on_signals

__all__ = [
    "ANY_BAUDRATE",
    "LINE_TIME",
    "Served",
    "device_command",
    "latency_timer",
    "line_arguments",
    "line_settings",
    "object_setting",
    "one_link",
    "one_side",
    "real_time_setting",
    "seed_setting",
    "start_setting",
    "wiring_setting",
]

_SEED = click.IntRange(0, 2**32 - 1)


class Served(Protocol):
    """An emulated device that is being served."""

    @property
    def ready_lines(self) -> Sequence[str]:
        """Lines to print when it is ready."""

    @property
    def error(self) -> BaseException | None:
        """The error that ended its service, or None."""

    @property
    def failure(self) -> Exception | None:
        """The first exception that its service has survived, or None."""

    def inject(self, spec: str) -> None:
        """Inject a fault."""

    def summaries(self) -> Sequence[str]:
        """Counters, one line each."""

    def close(self) -> None:
        """Stop. May be called twice."""


# ------------------------------------------------------------------------------ settings

LINE_TIME = Setting(
    "line-time", "yes|no", YES_OR_NO, "Simulate the transmission time of each byte.", True
)
ANY_BAUDRATE = Setting(
    "any-baudrate", "yes|no", YES_OR_NO, "Accept clients at any baud rate.", False
)


def real_time_setting(default: bool) -> Setting:
    """``real-time``: whether it has priority."""
    return Setting(
        "real-time",
        "yes|no",
        YES_OR_NO,
        "Run before ordinary processes where the system permits it (docs/service.md).",
        default,
    )


def object_setting(when: str) -> Setting:
    """``object``: where there is one."""
    percent = Number(0, 100, min_open=True, max_open=True)
    return Setting("object", "PCT", percent, f"{when}.  [default: no object]")


def start_setting(help: str, default: float | None = None) -> Setting:
    """``start``: the pose at power-on."""
    return Setting("start", "PCT", Number(0, 100), help, default)


def wiring_setting(help: str) -> Setting:
    """``wiring``: the seed of a random wiring."""
    return Setting("wiring", "SEED", _SEED, help)


def seed_setting(what: str = "the faults") -> Setting:
    """``seed`` of the random numbers of ``what``."""
    return Setting("seed", "N", _SEED, f"Seed of the random numbers of {what}.", 0)


def latency_timer(default: float) -> Setting:
    """``latency-timer`` of the adapter."""
    return Setting(
        "latency-timer",
        "MS",
        Number(0, 255),
        "Latency timer of the USB-serial adapter: an untuned FTDI has 16, a ttyACM device 0.",
        default,
    )


def line_settings(device: str, *, baudrate: int, most: int) -> tuple[Setting, ...]:
    """The settings of a device on a serial line; :func:`line_arguments` reads them.

    :param device: what the help calls it.
    :param baudrate: its own; ``most`` that can be given.
    """
    return (
        Setting(
            "baudrate", "B", click.IntRange(9600, most), f"Baud rate of the {device}.", baudrate
        ),
        LINE_TIME,
        latency_timer(0.0),
        seed_setting(),
        ANY_BAUDRATE,
    )


def line_arguments(settings: Settings, faults: Sequence[str]) -> dict[str, Any]:
    """Arguments of an emulated device of its :func:`line_settings`, in seconds."""
    return {
        "baudrate": settings["baudrate"],
        "line_time": settings["line-time"],
        "latency_timer": settings["latency-timer"] * 1e-3,
        "faults": faults,
        "seed": settings["seed"],
        "check_baudrate": not settings["any-baudrate"],
    }


# ------------------------------------------------------------------------------ commands

Maker = Callable[..., AbstractContextManager[Served]]


def device_command(
    name: str,
    *,
    side: str | None,
    link: str,
    default_link: str | None = None,
    settings: Sequence[Setting],
    faults: str,
    then: Callable[[Any], Sequence[str]] = lambda device: (),
) -> Callable[[Maker], click.Command]:
    """Make the command ``dexkit emulate NAME`` of a function that makes the device.

    The function gets ``link`` (a list), ``settings``, ``faults``, and ``sides`` where there are
    some; its docstring is the command's help.

    :param side: the default of ``--side``; None for a device that has none.
    :param link: the help of ``--link``.
    :param faults: examples.
    :param then: lines to print below those that say that it is ready.
    """

    def decorate(make: Maker) -> click.Command:
        def run(settings: Settings, faults: tuple[str, ...], **given: Any) -> None:
            from dexkit.service.realtime import real_time

            specs = [spec for spec in faults if spec != STDIN]
            with (
                # before any thread of the device is started, which inherits it
                real_time() if settings.get("real-time") else nullcontext(True) as granted,
                stop_on_signals() as request,
                make(settings=settings, faults=specs, **given) as device,
            ):
                if not granted:
                    click.echo("no real-time priority: this user has no rtprio limit", err=True)
                if STDIN in faults:
                    read_faults(device.inject, request)
                click.echo("\n".join([*device.ready_lines, *then(device)]))
                sys.stdout.flush()
                _serve(device, request)

        run.__doc__ = make.__doc__
        options: list[Callable[[Any], Any]] = [
            click.option(
                "--link",
                "links",
                required=default_link is None,
                default=() if default_link is None else (default_link,),
                multiple=True,
                metavar="PATH",
                help=link if default_link is None else f"{link}  [default: {default_link}]",
            ),
            settings_option(settings),
            click.option(
                "--fault",
                "faults",
                multiple=True,
                metavar="SPEC",
                help=f"Inject a fault, e.g. {faults}; may be repeated. - reads faults as lines of "
                "standard input, and stops at its end.",
            ),
        ]
        if side is not None:
            options.insert(0, side_option("Hand to emulate.", default=side))
        decorated: Callable[..., Any] = run
        for option in reversed(options):
            decorated = option(decorated)
        return click.command(
            name,
            cls=Command,
            exit_codes={0: "stopped by Ctrl-C or SIGTERM", 1: "the emulator failed"},
        )(decorated)

    return decorate


def one_side(sides: Sequence[Side]) -> Side:
    """The side of a device that is alone on its line.

    :raises UsageError: both sides are given.
    """
    if len(sides) != 1:
        raise UsageError(
            "this emulator has one hand on its line; --side is left or right",
            hint="run one emulator for each side",
        )
    return sides[0]


def one_link(links: Sequence[str]) -> str:
    """The place of a device that has one.

    :raises UsageError: several are given.
    """
    if len(links) != 1:
        raise UsageError("this emulator is at one place", hint="give --link once")
    return links[0]


def _serve(device: Served, request: StopRequest) -> None:
    """Serve until a stop is requested; then close the device and print its counters.

    :raises EmulatorError: its service ended, or it failed inside.
    """
    while not request.wait(0.2):
        if device.error is not None:
            raise EmulatorError(f"the emulator stopped: {device.error}") from device.error
    device.close()
    for line in device.summaries():
        click.echo(f"stopped: {line}")
    if device.failure is not None:
        raise EmulatorError(f"the emulator failed inside: {device.failure!r}", hint=A_MISTAKE)
