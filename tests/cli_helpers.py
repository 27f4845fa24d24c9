"""A sub-command of ``dexkit`` as a process that runs until it is told to end."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from dexkit.child_processes import command_line
from tests.patience import PATIENCE

__all__ = ["Process", "running"]


class Process:
    """A running ``dexkit COMMAND``."""

    def __init__(self, *arguments: object) -> None:
        self._popen = subprocess.Popen(
            command_line(*map(str, arguments)),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def ready(self) -> str:
        line = self.line_out()
        assert line.startswith("ready: "), self.end(signal.SIGTERM)
        return line

    def line_out(self) -> str:
        """The next line that it prints."""
        stdout = self._popen.stdout
        assert stdout is not None
        return stdout.readline().strip()

    def line(self, pattern: str) -> str:
        """The next line of its log that matches."""
        stderr: IO[str] | None = self._popen.stderr
        assert stderr is not None
        for text in stderr:
            if re.search(pattern, text):
                return text.strip()
        raise AssertionError(f"it ended without {pattern}")

    def signal(self, number: int) -> None:
        self._popen.send_signal(number)

    def end(self, number: int | None = None) -> tuple[int, str, str]:
        """Signal it, if need be, and wait: exit code, rest of stdout, rest of stderr."""
        if number is not None and self._popen.poll() is None:
            self._popen.send_signal(number)
        try:
            out, err = self._popen.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            raise
        return self._popen.returncode, out, err


@contextmanager
def running(*arguments: object) -> Iterator[Process]:
    """``dexkit`` with these arguments; killed at the end if it still runs."""
    process = Process(*arguments)
    try:
        yield process
    finally:
        process.end(signal.SIGKILL)
