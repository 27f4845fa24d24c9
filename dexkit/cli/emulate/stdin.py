"""Read faults as lines of standard input, while an emulator runs."""

from __future__ import annotations

import os
from collections.abc import Callable

import click

from dexkit.errors import DexkitError
from dexkit.stop_signals import StopRequest
from dexkit.threads import Worker

__all__ = ["A_MISTAKE", "STDIN", "read_faults"]

STDIN = "-"
"""The value of an option whose values are lines of standard input."""

A_MISTAKE = "this is a mistake in dexkit; what was sent is in the log above: please report it"

_LONGEST = 4096  # bytes of a line


def read_faults(inject: Callable[[str], None], request: StopRequest) -> None:
    """Read specifications in a thread of their own; ask for a stop at the end of input.

    :param inject: has one; what it raises is printed.
    """
    Worker("standard input", _read, inject, request).start()


def _read(inject: Callable[[str], None], request: StopRequest) -> None:
    # not sys.stdin: a daemon thread inside a buffered reader can crash the interpreter's exit
    pending = b""
    while data := _read_chunk():
        *lines, pending = (pending + data).split(b"\n")
        for line in lines:
            if not line.strip():
                continue
            try:
                inject(line[:_LONGEST].decode(errors="replace"))
            except DexkitError as error:
                click.echo(f"error: {error.message}", err=True)
            except Exception as error:  # a mistake in dexkit must not end the device in silence
                click.echo(f"error: {type(error).__name__}: {error}", err=True)
        pending = pending[:_LONGEST]  # what is longer is no specification, however it goes on
    request.set()


def _read_chunk() -> bytes:
    try:
        return os.read(0, 4096)
    except OSError:  # a terminal that went away is an end of input, too
        return b""
