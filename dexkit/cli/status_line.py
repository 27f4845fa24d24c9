"""Log lines and the status line of a command on standard error."""

from __future__ import annotations

import logging
import os
import sys
from typing import TextIO

from dexkit.escaping import REMARK, one_line

__all__ = [
    "MOST_REMARKS",
    "STATUS_LINES",
    "StatusLine",
    "Stderr",
    "log_to_stderr",
]

MOST_REMARKS = 100
"""Different warnings about peers in one run: what they announce is theirs to make up."""
STATUS_LINES = "DEXKIT_STATUS_LINES"
"""Environment variable: set by a command that starts others and shows what they are doing."""


class _OneLine(logging.Formatter):
    """Each message in a line of its own, whatever names are in it."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        record.message = one_line(record.message, REMARK)
        return super().formatMessage(record)


class Stderr(logging.StreamHandler):  # type: ignore[type-arg]
    """Writes to the standard error of the moment: a caller may have replaced and closed it."""

    def __init__(self) -> None:
        logging.Handler.__init__(self)

    @property
    def stream(self) -> TextIO:
        """The standard error at this moment."""
        return sys.stderr


def log_to_stderr(quiet: bool, status: bool, always: str) -> None:
    """Log to stderr for as long as the command runs.

    :param quiet: warnings only.
    :param status: a status line is kept at the bottom; log lines are written over it.
    :param always: a logger whose records are printed at any verbosity: the counters at exit.
    """
    clear = "\r\x1b[K" if status else ""
    level = logging.WARNING if quiet else logging.INFO
    handler = Stderr()
    handler.setFormatter(_OneLine(f"{clear}%(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.getLogger(always).setLevel(logging.INFO)


class StatusLine:
    """One line with the status of a command, renewed in place.

    At the bottom of a terminal; or, where :data:`STATUS_LINES` is set, lines ``status: ...`` of
    the standard output; or nowhere.

    :param quiet: nowhere at all.
    """

    def __init__(self, quiet: bool) -> None:
        self._lines = bool(os.environ.get(STATUS_LINES)) and not quiet
        #: whether it is at the bottom of a terminal, where other lines have to be written over it
        self.on_terminal = sys.stderr.isatty() and not quiet and not self._lines

    def __bool__(self) -> bool:
        return self._lines or self.on_terminal

    def show(self, text: str, brief: str = "") -> None:
        """Show a new text.

        :param brief: the short form, for a command that shows several.
        """
        if self._lines:
            print(f"status: {brief or text}", flush=True)
        elif self.on_terminal:
            # a line that is broken in two could not be written over
            width = os.get_terminal_size(sys.stderr.fileno()).columns - 1
            if 0 < width < len(text):
                text = f"{text[: width - 1]}…"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Clear the status line."""
        if self.on_terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
