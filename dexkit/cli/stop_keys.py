"""Keys that a program with a terminal takes: to stop, or to go on."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Keys", "is_enter", "is_stop", "keys"]

_STOP = b" q"
_ENTER = b"\r\n"


def is_stop(pressed: bytes) -> bool:
    """Whether space or q is among the keys."""
    return any(key in _STOP for key in pressed)


def is_enter(pressed: bytes) -> bool:
    """Whether Enter is among the keys."""
    return any(key in _ENTER for key in pressed)


class Keys:
    """The keys pressed since the last call; a call does not wait.

    There are none without a terminal, and in its background.

    :ivar terminal: whether there was one to read keys from at the start.
    """

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor
        self.terminal = descriptor is not None

    def __call__(self) -> bytes:
        """The bytes that came."""
        descriptor = self._descriptor
        # a background program that touches the terminal is stopped by the system
        if descriptor is None or not _in_foreground(descriptor):
            return b""
        if termios.tcgetattr(descriptor)[3] & termios.ICANON:
            # after Ctrl-Z and fg the terminal is as the shell has left it
            tty.setcbreak(descriptor, termios.TCSANOW)
        if not select.select([descriptor], [], [], 0)[0]:
            return b""
        return os.read(descriptor, 64)


@contextmanager
def keys() -> Iterator[Keys]:
    """Yields the :class:`Keys`, read one by one and not echoed until the end."""
    descriptor = _terminal()
    if descriptor is None:
        yield Keys(None)
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield Keys(descriptor)
    finally:
        if _in_foreground(descriptor):
            termios.tcsetattr(descriptor, termios.TCSANOW, before)


def _in_foreground(descriptor: int) -> bool:
    """Whether this program may use the terminal now."""
    try:
        return os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:
        return False


def _terminal() -> int | None:
    """The descriptor of the terminal that this program may read; None where there is none."""
    try:
        descriptor = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):
        return None
    return descriptor if _in_foreground(descriptor) else None
