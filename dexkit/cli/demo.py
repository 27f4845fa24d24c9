"""``dexkit demo``: the conformance suite on two emulated EZGrippers, in some 75 seconds."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import out_option, view_option
from dexkit.console import Console
from dexkit.errors import ConformanceError
from dexkit.stop_signals import stop_on_signals

__all__ = ["command"]

_INTRO = (
    "[bold]Can another vendor's gripper replace Unitree's Dex1-1?[/bold]\n",
    "Two EZGrippers are emulated, down to the servo at the end of a serial line; the right one "
    "has something between its fingers. dexkit drives them and puts them on the topics of a "
    "Dex1-1. Then a test program takes the robot's role: it moves them, provokes them, and "
    "replays a teleoperation session recorded with Unitree's own client. All of it is recorded, "
    "and the recording is judged.\n",
)


@click.command(
    "demo",
    cls=Command,
    exit_codes={
        0: "the hands passed",
        1: "they did not",
        2: "they could not be judged",
    },
)
@out_option("Where to write report.html, recording.mcap and result.json.", "demo-out")
@click.option(
    "--backend",
    default="ezgripper",
    show_default=True,
    help="Backend to demonstrate, with an emulated device.",
)
@view_option()
def command(out: Path, backend: str, view: bool) -> None:
    """Run the conformance suite on two emulated EZGrippers; takes about 75 seconds.

    Traffic stays on this machine, on a DDS domain of its own.
    """
    from dexkit.conformance.kit.suite_run import SuiteOptions, run_suite
    from dexkit.conformance.report.terminal import print_result

    console = Console()
    out.mkdir(parents=True, exist_ok=True)
    options = SuiteOptions.make(
        backend=backend,
        result=out / "result.json",
        report=out / "report.html",
        recording=out / "recording.mcap",
        view=view,
    )
    for paragraph in _INTRO:
        console.print(paragraph)
    begin = time.monotonic()
    lock = threading.Lock()

    def print_progress(text: str) -> None:
        with lock:
            console.print(f"[dim]{time.monotonic() - begin:5.1f} s[/dim]  {text}")

    with stop_on_signals() as stop:
        try:
            result = run_suite(options, print_progress, stop.event)
        except ConformanceError:
            if not stop:
                raise
            console.print("stopped; nothing is left running")
            sys.exit(130)
    console.print()
    print_result(result, console)
    seconds = time.monotonic() - begin
    console.print(f"\n{seconds:.0f} s. Look at it: [bold]{out / 'report.html'}[/bold]")
    console.print(
        f"[dim]{options.recording} has the ros2msg schemas that Foxglove and PlotJuggler read; "
        f"'dexkit check {options.recording}' judges it again, and 'dexkit view "
        f"{options.recording}' shows it.[/dim]"
    )
    if result.judged == 0:
        raise ConformanceError("nothing was judged, which is not a pass")
    sys.exit(result.overall.exit_code)
