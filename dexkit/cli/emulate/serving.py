"""Options and run loop shared by the emulators of devices on a line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

import click

from dexkit.cli.emulate.stdin import A_MISTAKE, read_faults
from dexkit.cli.options import (
    Number,
    any_baudrate_option,
    fault_options,
    latency_timer_option,
    line_time_option,
    seed_option,
)
from dexkit.errors import EmulatorError, UsageError
from dexkit.hand import Side
from dexkit.stop_signals import StopRequest

__all__ = ["Served", "line_options", "line_settings", "one_side", "serve"]

F = TypeVar("F", bound=Callable[..., Any])


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


def line_options(
    device: str, *, baudrate: int, most: int, faults: str, latency_timer: float = 0.0
) -> Callable[[F], F]:
    """The options of a device on a serial line, from ``--baudrate`` to ``--any-baudrate``.
    :func:`line_settings` makes the device's arguments of them.

    :param device: what the help calls it.
    :param baudrate: its own; ``most`` that can be given.
    :param faults: examples.
    """
    options = (
        click.option(
            "--baudrate",
            type=click.IntRange(9600, most),
            default=baudrate,
            metavar="B",
            help=f"Baud rate of the {device}.",
        ),
        line_time_option(),
        click.option(
            "--answer-time",
            type=Number(0, 1000),
            default=0.0,
            metavar="MS",
            help=f"Time from a request to its answer; that of the real {device} is not known.",
        ),
        latency_timer_option(latency_timer),
        fault_options(faults),
        seed_option("the faults"),
        any_baudrate_option(),
    )

    def add(function: F) -> F:
        for option in reversed(options):
            function = option(function)
        return function

    return add


def line_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """The values of :func:`line_options` as arguments of an emulated device: milliseconds become
    seconds; without those that :func:`serve` uses.
    """
    return {
        "baudrate": given["baudrate"],
        "answer_time": given["answer_time"] * 1e-3,
        "line_time": given["line_time"],
        "latency_timer": given["latency_timer"] * 1e-3,
        "faults": given["faults"],
        "seed": given["seed"],
        "check_baudrate": not given["any_baudrate"],
    }


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


def serve(device: Served, request: StopRequest, *, faults_from_stdin: bool) -> None:
    """Serve until a stop is requested; then close the device and print its counters.

    :raises EmulatorError: its service ended, or it failed inside.
    """
    if faults_from_stdin:
        read_faults(device.inject, request)
    click.echo("\n".join(device.ready_lines))
    sys.stdout.flush()
    while not request.wait(0.2):
        if device.error is not None:
            raise EmulatorError(f"the emulator stopped: {device.error}") from device.error
    device.close()
    for line in device.summaries():
        click.echo(f"stopped: {line}")
    if device.failure is not None:
        raise EmulatorError(f"the emulator failed inside: {device.failure!r}", hint=A_MISTAKE)
