"""The ``dexkit`` command: one module a sub-command, loaded only when it is called.

This package may import every other one; the rest of dexkit/ imports none of the packages drivers,
emulators, traces and conformance.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys

import click

from dexkit import __version__, threads
from dexkit.cli.lazy_group import LazyGroup, Sections
from dexkit.errors import DexkitError, OutputError, ResourceError
from dexkit.escaping import REMARK, guarded, one_line

__all__ = ["cli", "main"]

_SECTIONS: Sections = {
    "Serve and emulate": {
        "serve": ("dexkit.cli.serve", "Publish and subscribe Unitree's topics for a hand."),
        "emulate": ("dexkit.cli.emulate", "Emulate a device, a robot, or a robot with hands."),
        "bridge": ("dexkit.cli.bridge", "Translate between Dex1 dialects."),
        "teleop": ("dexkit.cli.teleop", "Drive a hand as xr_teleoperate does."),
    },
    "Judge": {
        "demo": ("dexkit.cli.demo", "Run the conformance suite on two emulated grippers (75 s)."),
        "check": ("dexkit.cli.check", "Check a recording against the requirements."),
        "audit": ("dexkit.cli.audit", "Judge every session of an archive."),
        "report": ("dexkit.cli.report", "Write the reports of a result."),
        "compare": ("dexkit.cli.compare", "Compare several results."),
        "badge": ("dexkit.cli.badge", "Draw a badge of a result (SVG)."),
    },
    "Sessions": {
        "record": ("dexkit.cli.record", "Record DDS topics to an mcap file."),
        "rehearse": ("dexkit.cli.rehearse", "Check a session, and play it on emulated hands."),
        "replay": ("dexkit.cli.replay", "Play a session on hands, checked and supervised."),
        "publish": ("dexkit.cli.publish", "Publish the messages of a recording as they are."),
        "info": ("dexkit.cli.info", "Show the topics, rates and damage of a recording."),
        "cut": ("dexkit.cli.cut", "Write a part of a recording."),
        "merge": ("dexkit.cli.merge", "Write several recordings as one."),
        "diff": ("dexkit.cli.diff", "Compare two recordings of one session."),
        "import": ("dexkit.cli.import_", "Write sessions of other formats as recordings."),
        "export": ("dexkit.cli.export", "Write recordings in another format."),
    },
    "Diagnose": {
        "doctor": ("dexkit.cli.doctor", "Find out why a client and a hand do not connect."),
        "monitor": ("dexkit.cli.monitor", "Show hands and topics in the terminal, live."),
        "view": ("dexkit.cli.view", "Show hands on a page in the browser, live or recorded."),
        "selftest": ("dexkit.cli.selftest", "Test a hand's joints and tactile sensors."),
    },
    "Set up": {
        "setup-dds": ("dexkit.cli.setup_dds", "Find or build CycloneDDS 0.10 for this Python."),
        "backends": ("dexkit.cli.backends", "List the backends that can be served."),
        "models": ("dexkit.cli.models", "Print hands and robots: joints, limits, topics, rates."),
        "bringup": ("dexkit.cli.bringup", "Find out how a hand is wired, a joint at a time."),
        "calibrate": ("dexkit.cli.calibrate", "Measure and store a gripper's zero and speed."),
        "install-service": (
            "dexkit.cli.install_service",
            "Write systemd units and udev rules that serve hands.",
        ),
    },
}

_NO_READER = 141
# What the dynamic linker says when a library does not fit into memory.
_NO_ROOM = ("failed to map segment", "cannot allocate memory", "Cannot allocate memory")
_HINTS = {
    errno.EMFILE: "too many open files: raise the limit (ulimit -n)",
    errno.ENFILE: "too many open files on this machine",
    errno.ENOMEM: "there is not enough memory: end other programs, or raise the limit (ulimit -v)",
    errno.EAGAIN: "too many processes or threads: end some, or raise the limit (ulimit -u)",
    errno.EADDRINUSE: "another program has that address; choose another one, or end it",
}


class _Dexkit(LazyGroup):
    def invoke(self, ctx: click.Context) -> object:
        threads.forget()
        result = super().invoke(ctx)
        threads.check()  # a command that lost a thread has failed, whatever it returned
        return result


@click.command(
    cls=_Dexkit,
    sections=_SECTIONS,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="dexkit")
def cli() -> None:
    """Serve any gripper or hand on Unitree's Dex topics, and test that it is a drop-in
    replacement.
    """


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns (through ``sys.exit``) the exit code.

    0 success, 1 a negative result or a failed operation, 2 wrong usage, an unusable file or
    device, too little memory or too few threads, 130 interrupted, 141 the reader of the output
    has closed the pipe.
    """
    # a service has small matrices only: BLAS's threads would take a sixth of each start, and stay
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # click writes completions as bytes; a shell reads them, and nothing in them is of a file
    completing = "_DEXKIT_COMPLETE" in os.environ
    try:
        with contextlib.nullcontext() if completing else guarded():
            code = _run(argv)
    except OutputError as error:
        if error.exit_code != _NO_READER:
            with contextlib.suppress(OutputError), guarded():
                _print_error(error)
        code = error.exit_code
    sys.exit(code)


def _run(argv: list[str] | None) -> int:
    try:
        return _run_command(argv)
    except (MemoryError, RuntimeError, ImportError) as error:
        lack = lack_of(error)
        if lack is None:
            raise
    # here, where the frames of what failed have freed their memory
    _print_error(lack)
    return lack.exit_code


def lack_of(error: BaseException) -> ResourceError | None:
    """The error to print for one that says that memory or threads are short; None for others."""
    if isinstance(error, MemoryError) or (
        isinstance(error, ImportError) and any(text in str(error) for text in _NO_ROOM)
    ):
        return ResourceError(
            "there is not enough memory",
            hint="end other programs, raise the limit (ulimit -v, or MemoryMax= of the service), "
            "or take a smaller part of the data",
        )
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return ResourceError(
            "no thread can be started",
            hint="raise the limit of processes and threads (ulimit -u, or TasksMax= of the service)"
            " or of memory (ulimit -v)",
        )
    return None


def _run_command(argv: list[str] | None) -> int:
    try:
        result = cli.main(args=argv, prog_name="dexkit", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.Abort:
        click.echo("interrupted", err=True)
        return 130
    except click.ClickException as error:
        error.message = _redact(error.message)  # type: ignore[misc]
        error.show()
        return error.exit_code
    except OutputError:
        raise
    except DexkitError as error:
        _print_error(error)
        return error.exit_code
    except KeyboardInterrupt:
        click.echo("interrupted", err=True)
        return 130
    except OSError as error:
        if error.filename is None and error.errno is None:
            raise
        where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        hint = _HINTS.get(error.errno or 0, "")
        _print_error(DexkitError(where + (error.strerror or str(error)), hint=hint))
        return 2


def _print_error(error: DexkitError) -> None:
    """Print an error: one line, then the hint, indented, so that no part of it can be taken for
    other output of dexkit.
    """
    click.echo(f"error: {one_line(_redact(error.message), REMARK)}", err=True)
    for line in _redact(error.hint).splitlines():
        click.echo(f"  {one_line(line, REMARK)}", err=True)


def _redact(text: str) -> str:
    from dexkit.redaction import redact  # which a command without an error does not need

    return redact(text)
