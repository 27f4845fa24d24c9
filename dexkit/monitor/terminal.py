"""A whole terminal to draw lines on, where only those that change are sent."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from rich.text import Text

from dexkit.console import Console
from dexkit.monitor.keys import keys

__all__ = ["Terminal", "has_terminal"]

_ENTER = "\x1b[?1049h\x1b[?25l\x1b[?7l"  # other screen, no cursor, lines are not broken
_LEAVE = "\x1b[?7h\x1b[?25h\x1b[?1049l"


def has_terminal() -> bool:
    """Whether standard output is a terminal that can be drawn on."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", "")


class Terminal:
    """The terminal at standard output; a context manager, which leaves it as it was.

    Keys are read where standard input is a terminal, too. Ctrl-C stays a signal.
    """

    def __init__(self) -> None:
        self._console = Console(force_terminal=True)
        self._shown: list[str] = []
        self._size = (0, 0)
        self._stack = ExitStack()
        self._input: int | None = None

    @property
    def unicode(self) -> bool:
        """Whether it shows more than ASCII."""
        return (sys.stdout.encoding or "").lower().replace("-", "").startswith("utf")

    def __enter__(self) -> Terminal:
        with ExitStack() as stack:
            self._input = stack.enter_context(_key_by_key())
            stack.callback(self._write, _LEAVE)
            self._write(_ENTER)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines, now."""
        try:
            found = os.get_terminal_size(sys.stdout.fileno())
        except OSError:
            return 80, 24
        return (found.columns or 80), (found.lines or 24)

    def redraw(self) -> None:
        """Send everything the next time."""
        self._size = (0, 0)

    def show(self, lines: Sequence[Text], size: tuple[int, int]) -> None:
        """Draw the lines of a screen of that size."""
        out = []
        if size != self._size:
            out.append("\x1b[m\x1b[2J")
            self._size, self._shown = size, []
        self._console.width = size[0]
        texts = [self._text(line) for line in lines[: size[1]]]
        for i, text in enumerate(texts):
            if i >= len(self._shown) or text != self._shown[i]:
                out.append(f"\x1b[{i + 1};1H{text}\x1b[m\x1b[K")
        self._shown = texts
        if out:
            self._write("".join(out))

    def keys(self, seconds: float) -> list[str]:
        """Keys that are pressed; waits that long for one where there is a keyboard."""
        if self._input is None or not select.select([self._input], [], [], seconds)[0]:
            return []
        data = os.read(self._input, 256)
        if not data:  # it went away
            self._input = None
        return keys(data)

    @property
    def has_keyboard(self) -> bool:
        """Whether keys can be read."""
        return self._input is not None

    def _text(self, line: Text) -> str:
        with self._console.capture() as captured:
            self._console.print(line, end="", no_wrap=True, crop=True, overflow="crop")
        return captured.get()

    def _write(self, text: str) -> None:
        stream = self._console.file
        stream.write(text)
        stream.flush()


@contextmanager
def _key_by_key() -> Iterator[int | None]:
    """The descriptor of a keyboard that gives each key at once and echoes none, or None."""
    try:
        descriptor = sys.stdin.fileno()
        if not os.isatty(descriptor) or os.tcgetpgrp(descriptor) != os.getpgrp():
            descriptor = -1
    except (OSError, ValueError, AttributeError):
        descriptor = -1
    if descriptor < 0:
        yield None
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSANOW, before)
