"""A terminal whose space bar is a dead-man key, and on which questions are asked in between."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

from dexkit.bringup import DeadMan, Question
from dexkit.errors import UsageError
from dexkit.escaping import one_line

__all__ = ["Terminal"]

_ASK_PERIOD = 0.1
"""Seconds between two calls of ``meanwhile`` while a question waits."""


class Terminal:
    """Standard input, which has to be a terminal of which this program is in the foreground.

    :raises UsageError: it is not.
    """

    def __init__(self) -> None:
        try:
            self._input = sys.stdin.fileno()
            usable = os.isatty(self._input) and os.tcgetpgrp(self._input) == os.getpgrp()
        except (OSError, ValueError, AttributeError):
            usable = False
        if not usable:
            raise UsageError(
                "the dead-man key needs a terminal in the foreground",
                hint="start it in a terminal; an emulated hand can be brought up with --answers "
                "FILE --unattended",
            )

    @contextmanager
    def keys(self) -> Iterator[Callable[[float], bool]]:
        """Yields a function of the time that says whether the space bar is held; never waits."""
        before = termios.tcgetattr(self._input)
        watch = DeadMan()

        def held(now: float) -> bool:
            data = b""
            if select.select([self._input], [], [], 0)[0]:
                data = os.read(self._input, 4096)
                if not data:  # the terminal has gone
                    raise click.Abort
            return watch.held(now, data)

        try:
            tty.setcbreak(self._input, termios.TCSAFLUSH)
            yield held
        finally:
            # what the key still repeats is no answer to the next question
            termios.tcsetattr(self._input, termios.TCSAFLUSH, before)

    def ask(self, question: Question, meanwhile: Callable[[], None]) -> str:
        """The person's answer: one of the choices, or its number.

        :param meanwhile: called ten times a second; what it raises ends the question.
        """
        listed = ", ".join(f"{i} {choice}" for i, choice in enumerate(question.choices, 1))
        while True:
            click.echo(f"{question.text}\n  {listed}: ", nl=False)
            while not select.select([self._input], [], [], _ASK_PERIOD)[0]:
                meanwhile()
            line = os.read(self._input, 4096)
            if not line:
                raise click.Abort
            text = line.decode(errors="replace").strip().lower()
            if text.isdecimal() and len(text) < 3 and 0 < int(text) <= len(question.choices):
                return question.choices[int(text) - 1]
            if text in question.choices:
                return text
            if text:  # an empty line, or spaces of the key, only repeat the question
                click.echo(f"{one_line(text, 40)!r} is none of them")
