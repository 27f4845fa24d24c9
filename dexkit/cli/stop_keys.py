"""Keys that stop a program, where it has a terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["stop_keys"]

_STOP = b" q"


@contextmanager
def stop_keys() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether space or q was pressed; it does not wait.

    Keys are read only by a program in the foreground of a terminal.
    """
    descriptor = _terminal()
    if descriptor is None:
        yield lambda: False
        return
    before = termios.tcgetattr(descriptor)

    def pressed() -> bool:
        if not select.select([descriptor], [], [], 0)[0]:
            return False
        return any(key in _STOP for key in os.read(descriptor, 64))

    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield pressed
    finally:
        termios.tcsetattr(descriptor, termios.TCSANOW, before)


def _terminal() -> int | None:
    """The descriptor of the terminal that this program may read; None where there is none."""
    try:
        descriptor = sys.stdin.fileno()
        if os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp():
            return descriptor
    except (OSError, ValueError, AttributeError):
        pass
    return None
