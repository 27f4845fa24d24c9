"""Keys that a program with a terminal takes: to stop, or to go on."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["is_stop", "keys", "stop_keys"]

_STOP = b" q"


def is_stop(pressed: bytes) -> bool:
    """Whether space or q is among the keys."""
    return any(key in _STOP for key in pressed)


@contextmanager
def stop_keys() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether space or q was pressed; it does not wait.

    Keys are read only by a program in the foreground of a terminal.
    """
    with keys() as pressed:
        yield lambda: is_stop(pressed())


@contextmanager
def keys() -> Iterator[Callable[[], bytes]]:
    """Yields a function that returns the keys pressed since its last call; it does not wait.

    There are none without a terminal, and in its background.
    """
    descriptor = _terminal()
    if descriptor is None:
        yield lambda: b""
        return
    before = termios.tcgetattr(descriptor)

    def pressed() -> bytes:
        if not select.select([descriptor], [], [], 0)[0]:
            return b""
        return os.read(descriptor, 64)

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
