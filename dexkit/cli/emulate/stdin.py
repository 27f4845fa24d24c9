"""Faults as lines of standard input, while an emulator runs."""

from __future__ import annotations

import os
from collections.abc import Callable

import click

from dexkit.cli.common import StopRequest
from dexkit.errors import DexkitError
from dexkit.threads import Worker

__all__ = ["read_faults"]


def read_faults(inject: Callable[[str], None], request: StopRequest) -> None:
    """Read specifications in a thread of their own; ask for a stop at the end of input.

    :param inject: has one; what it raises is printed.
    """
    Worker("standard input", _read, inject, request).start()


def _read(inject: Callable[[str], None], request: StopRequest) -> None:
    # not sys.stdin: a daemon thread inside a buffered reader can crash the interpreter's exit
    pending = b""
    while data := os.read(0, 4096):
        *lines, pending = (pending + data).split(b"\n")
        for line in lines:
            if not line.strip():
                continue
            try:
                inject(line.decode(errors="replace"))
            except DexkitError as error:
                click.echo(f"error: {error.message}", err=True)
    request.set()
