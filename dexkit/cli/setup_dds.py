"""``dexkit setup-dds``: CycloneDDS 0.10.x for the Python that dexkit runs in."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    dry_run_option,
)
from dexkit.errors import DdsInstallError, OutputError
from dexkit.escaping import REMARK, one_line

if TYPE_CHECKING:
    from dexkit.setup_dds.facts import Installed, Machine
    from dexkit.setup_dds.plan import Plan
    from dexkit.setup_dds.process_runner import Runner

__all__ = ["command"]


@click.command(
    "setup-dds",
    cls=Command,
    exit_codes={
        0: "DDS works",
        1: "a step failed",
        2: "not possible on this machine",
    },
)
@click.option(
    "--from-source",
    "source",
    type=LocalPath(exists=True, file_okay=False),
    metavar="DIR",
    help="Build the CycloneDDS C library 0.10.x of this checkout; it becomes part of the wheel.",
)
@click.option(
    "--wheel",
    "wheel_folder",
    type=LocalPath(file_okay=False),
    metavar="DIR",
    help="Keep the wheel here, for other environments and machines.",
)
@click.option("--no-install", is_flag=True, help="Only build the wheel for --wheel.")
@click.option(
    "--replace", is_flag=True, help="Replace an installed cyclonedds that works, or is not 0.10.x."
)
@dry_run_option("Print what would be done, and do nothing.")
@click.option(
    "--log",
    type=LocalPath(dir_okay=False),
    metavar="FILE",
    help="Log file of commands and their output.  [default: dexkit/setup-dds.log in the user's "
    "folder for logs]",
)
def command(
    source: Path | None,
    wheel_folder: Path | None,
    no_install: bool,
    replace: bool,
    dry_run: bool,
    log: Path | None,
) -> None:
    """Find or build CycloneDDS 0.10 for this Python.

    Looks for, in this order: a cyclonedds 0.10.x that works; a wheel on the package index; a
    CycloneDDS library 0.10.x to build the Python binding against (CYCLONEDDS_HOME, /opt/ros,
    a build in your home, the distribution's package). If there is none, says what to install.

    Installs into dexkit's own environment, after a test message to another process and back. Needs
    no root, and refuses the system's own Python. A failure or interruption leaves the environment
    unchanged.
    """
    from dexkit.setup_dds.execute import carry_out
    from dexkit.setup_dds.plan import Options, make_plan
    from dexkit.setup_dds.process_runner import Interrupted, ProcessRunner
    from dexkit.stop_signals import stop_on_signals

    if no_install and wheel_folder is None:
        raise click.UsageError("--no-install needs --wheel DIR, where the wheel is kept")
    with _log_file(log) as (file, path), stop_on_signals() as stop:
        runner = ProcessRunner(file, stop)
        try:
            machine, version = _inspect(runner, source)
            options = Options(
                source=str(source.resolve()) if source else "",
                source_version=version,
                replace=replace,
                keep_wheel=wheel_folder is not None,
                install=not no_install,
            )
            plan = make_plan(machine, options)
            _say_plan(machine, plan)
            if dry_run:
                _say_notes(plan)
                click.echo("dry run: nothing was changed")
                return
            progress = _Progress(file)
            found = carry_out(plan, machine, runner, progress, wheel_folder, install=not no_install)
        except Interrupted:
            click.echo("interrupted; nothing was installed", err=True)
            raise click.exceptions.Exit(130) from None
        except DdsInstallError as error:
            file.write(f"error: {error.message}\n{error.hint}\n")
            if error.exit_code == 1:
                error.hint = f"{error.hint}\nlog: {path}"
            raise
        if no_install:
            click.echo(f"the wheel works: cyclonedds {found.version}; nothing was installed")
        else:
            _say_result(found, plan)


def _inspect(runner: Runner, source: Path | None) -> tuple[Machine, str]:
    """The facts, and the version of the source."""
    from dexkit.setup_dds import inspect_machine, probe

    def find(environment: dict[str, str] | None = None) -> Installed:
        done = runner.run(probe.command(sys.executable, send=False), environment)
        return probe.result_of(done.code, done.output)

    installed = find()
    bare = {k: v for k, v in os.environ.items() if k not in inspect_machine.VARIABLES}
    needed = installed.version and len(bare) < len(os.environ)
    machine = inspect_machine.inspect_machine(installed, find(bare) if needed else None)
    return machine, inspect_machine.source_version(source) if source else ""


def _say_plan(machine: Machine, plan: Plan) -> None:
    python = machine.interpreter
    click.echo(
        one_line(
            f"Python {python.short} ({python.processor}, {python.kind}) in {python.prefix}, "
            f"{machine.distribution.name}"
        )
    )
    for line in plan.examined:
        click.echo(f"  {one_line(line, REMARK)}")
    click.echo(f"to do: {one_line(plan.action, REMARK)}")


def _say_result(found: Installed, plan: Plan) -> None:
    click.echo(one_line(f"DDS works: cyclonedds {found.version} with {', '.join(found.libraries)}"))
    _say_notes(plan)


def _say_notes(plan: Plan) -> None:
    for note in plan.notes:
        click.echo(f"note: {one_line(note, REMARK)}")


class _Progress:
    """Prints each step, with the time since the first."""

    def __init__(self, log: IO[str]) -> None:
        self._begin = time.monotonic()
        self._log = log

    def __call__(self, text: str) -> None:
        line = one_line(f"{time.monotonic() - self._begin:5.1f} s  {text}")
        click.echo(line)
        with contextlib.suppress(OSError):
            self._log.write(f"# {line}\n")


@contextlib.contextmanager
def _log_file(path: Path | None) -> Iterator[tuple[IO[str], Path]]:
    """The log, emptied; where the default place cannot be written, there is none."""
    import platformdirs

    place = path or Path(platformdirs.user_log_dir("dexkit")) / "setup-dds.log"
    try:
        if path is None:
            place.parent.mkdir(parents=True, exist_ok=True)
        file = place.open("w", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        if path is not None:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        yield io.StringIO(), Path("not written, its folder cannot be")
        return
    with contextlib.closing(file):
        yield file, place
