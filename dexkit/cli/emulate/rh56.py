"""``dexkit emulate rh56``: Inspire's RH56DFX on a pseudo-terminal."""

from __future__ import annotations

import sys

import click

from dexkit.cli.emulate.stdin import A_MISTAKE, read_faults
from dexkit.cli.options import (
    Number,
    any_baudrate_option,
    fault_options,
    latency_timer_option,
    line_time_option,
    object_option,
    seed_option,
    side_option,
    start_option,
)
from dexkit.errors import EmulatorError, UsageError
from dexkit.hand import Side
from dexkit.stop_signals import stop_on_signals
from dexkit.wire import rh56

__all__ = ["emulate_rh56"]


@click.command("rh56", context_settings={"show_default": True})
@side_option("Hand to emulate.", default="right")
@click.option("--link", required=True, metavar="PATH", help="Link that clients open.")
@object_option("Percent of closing at which the joints touch an object")
@start_option("Percent of closing at first; by default a relaxed pose.")
@click.option(
    "--id",
    "number",
    type=click.IntRange(rh56.IDS[0], rh56.IDS[-1]),
    default=1,
    metavar="N",
    help="Its id on the line.",
)
@click.option(
    "--baudrate",
    type=click.IntRange(9600, 1_000_000),
    default=rh56.BAUD_RATE,
    metavar="B",
    help="Bits a second that the hand understands.",
)
@line_time_option()
@click.option(
    "--answer-time",
    type=Number(0, 1000),
    default=0.0,
    metavar="MS",
    help="From a request to its answer; what the real hand needs is not known.",
)
@latency_timer_option(0.0)
@fault_options("unplug@5s:for=2s, drop:p=0.1, locked@3s")
@seed_option("the faults")
@any_baudrate_option()
def emulate_rh56(
    sides: tuple[Side, ...],
    link: str,
    object_pct: float | None,
    start: float | None,
    number: int,
    baudrate: int,
    line_time: bool,
    answer_time: float,
    latency_timer: float,
    faults: tuple[str, ...],
    faults_from_stdin: bool,
    seed: int,
    any_baudrate: bool,
) -> None:
    """Emulate an Inspire RH56DFX hand on its serial line.

    Prints "ready: PATH SIDE ..." when it answers there. Ctrl-C or SIGTERM ends it and removes the
    link.
    """
    from dexkit.emulators.rh56 import Rh56Hand

    if len(sides) != 1:
        raise UsageError("a line has one hand", hint="run one emulator for each side")
    with (
        stop_on_signals() as request,
        Rh56Hand(
            sides[0],
            link=link,
            number=number,
            object_pct=object_pct,
            start_pct=start,
            baudrate=baudrate,
            answer_time=answer_time * 1e-3,
            line_time=line_time,
            latency_timer=latency_timer * 1e-3,
            faults=faults,
            seed=seed,
            check_baudrate=not any_baudrate,
        ) as hand,
    ):
        if faults_from_stdin:
            read_faults(hand.inject, request)
        click.echo(f"ready: {hand.path} {sides[0]} id={number} baudrate={baudrate}")
        sys.stdout.flush()
        while not request.wait(0.2):
            if hand.port.error is not None:
                raise EmulatorError(f"the emulator stopped: {hand.port.error}")
    click.echo(f"stopped: {hand.path}: {hand.bus.counters.summary() or 'nothing was sent'}")
    if hand.bus.failure is not None:
        raise EmulatorError(f"the emulator failed inside: {hand.bus.failure!r}", hint=A_MISTAKE)
