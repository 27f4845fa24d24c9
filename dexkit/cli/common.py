"""What the sub-commands share: options, and stopping (:mod:`dexkit.stop_signals`)."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import click

from dexkit.escaping import REMARK, one_line
from dexkit.stop_signals import StopRequest, stop_on_signals

F = TypeVar("F", bound=Callable[..., Any])

__all__ = [
    "MOST_REMARKS",
    "SEED",
    "STATUS_LINES",
    "Number",
    "StatusLine",
    "StopRequest",
    "dds_options",
    "log_to_stderr",
    "stop_on_signals",
]

MOST_REMARKS = 100
"""Different warnings about peers in one run: what they announce is theirs to make up."""
STATUS_LINES = "DEXKIT_STATUS_LINES"
"""Environment variable: set by a command that starts others and shows what they are doing."""


class Number(click.FloatRange):
    """A finite number. ``click.FloatRange`` lets NaN pass, which is neither too small nor too
    large, and numbers that no clock or timer can count.
    """

    _LARGEST = 1e9  # seconds: 30 years

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number."""
        found: float = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{one_line(value, 40)} is not a finite number.", param, ctx)
        if abs(found) > self._LARGEST:
            self.fail(f"{one_line(value, 40)} is larger than {self._LARGEST:g}.", param, ctx)
        return found


SEED = click.IntRange(0, 2**32 - 1)
"""Where a chance begins that can be repeated."""


def dds_options(*, default_domain: int | None) -> Callable[[F], F]:
    """``--domain`` and ``--interface``; the interface defaults to loopback."""

    def decorate(function: F) -> F:
        function = click.option(
            "--interface",
            default="lo",
            show_default=True,
            metavar="IF",
            help="Network interface. Traffic stays on this machine unless one is named.",
        )(function)
        domain_help = "DDS domain: 0 is the robot, 1 xr_teleoperate's simulation."
        return click.option(
            "--domain",
            type=click.IntRange(0, 230),
            default=default_domain,
            show_default=default_domain is not None,
            help=domain_help,
        )(function)

    return decorate


class _OneLine(logging.Formatter):
    """Each message in a line of its own, whatever names are in it."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        record.message = one_line(record.message, REMARK)
        return super().formatMessage(record)


def log_to_stderr(quiet: bool, status: bool, always: str) -> None:
    """Log to stderr for as long as the command runs.

    :param quiet: warnings only.
    :param status: a status line is kept at the bottom; log lines are written over it.
    :param always: name of a logger that is heard however quiet: the counters at exit are wanted.
    """
    clear = "\r\x1b[K" if status else ""
    level = logging.WARNING if quiet else logging.INFO
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine(f"{clear}%(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.getLogger(always).setLevel(logging.INFO)


class StatusLine:
    """One line that says how a command is doing, renewed again and again.

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
        """Say this now.

        :param brief: what a command that shows several of these has room for.
        """
        if self._lines:
            print(f"status: {brief or text}", flush=True)
        elif self.on_terminal:
            # a line that is broken in two could not be written over
            room = os.get_terminal_size(sys.stderr.fileno()).columns - 1
            if 0 < room < len(text):
                text = f"{text[: room - 1]}…"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Take it away."""
        if self.on_terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
