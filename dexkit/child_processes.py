"""Run ``dexkit`` commands as child processes: start them, read their output, stop them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from dexkit.errors import DexkitError
from dexkit.threads import Worker

__all__ = [
    "END_WITH_PARENT",
    "READY_TIMEOUT",
    "STOP_TIMEOUT",
    "Tool",
    "code_line",
    "command_line",
    "end_with_parent",
    "module_line",
    "process_id",
]

READY_TIMEOUT = 30.0
STOP_TIMEOUT = 5.0
_START = Path(__file__).resolve().with_name("_start") / "dexkit"

END_WITH_PARENT = "DEXKIT_END_WITH_PARENT"
"""Environment variable: set for a command that is to end when its parent is killed. It is
the number of a pipe's descriptor that is never written and whose other end only the parent has:
when that is closed, however it came to it, the parent is gone."""


def command_line(*arguments: str) -> list[str]:
    """The command that starts ``dexkit ARGUMENTS`` with this interpreter, and imports nothing from
    the working folder, as ``python -P`` does where there is one.
    """
    return [sys.executable, str(_START), *arguments]


def code_line(
    code: str,
    *arguments: str,
    python: str = "",
    front: Sequence[str] = (),
    back: Sequence[str] = (),
) -> list[str]:
    """The command that runs Python code, and imports nothing from the working folder.

    ``python -c`` and ``python -m`` have that folder in front of the path; installed programs have
    it nowhere.

    :param python: interpreter; by default this one.
    :param front: folders in front of the interpreter's path; ``back``: behind it.
    """
    path = f"[*{list(front)!r}, *filter(None, sys.path), *{list(back)!r}]"
    start = f"import sys; sys.path[:] = {path}; {code}"
    return [python or sys.executable, "-c", start, *arguments]


def module_line(module: str, *arguments: str, python: str = "") -> list[str]:
    """The command ``python -m module``, as :func:`code_line` runs it."""
    code = f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    return code_line(code, *arguments, python=python)


_PID_MAX = 1 << 22  # PID_MAX_LIMIT of Linux


def process_id(text: str) -> int:
    """The process id that a peer announces as text; 0 when it is none."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 7):
        return 0
    number = int(text)
    return number if number <= _PID_MAX else 0


def end_with_parent() -> None:
    """End this process by SIGTERM when its parent does; by SIGKILL if that does not help."""
    try:
        pipe = int(os.environ[END_WITH_PARENT])
        os.set_inheritable(pipe, False)
    except (ValueError, OSError):
        return
    threading.Thread(target=_await_end, args=(pipe,), name="parent", daemon=True).start()


def _await_end(pipe: int) -> None:
    with contextlib.suppress(OSError):
        while os.read(pipe, 64):
            pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(2 * STOP_TIMEOUT)
    os.kill(os.getpid(), signal.SIGKILL)


class Tool:
    """A ``dexkit`` command in its own process; a context manager.

    :param arguments: of ``dexkit``.
    :param on_line: is given each line that it prints, in a thread that must not be kept long.
    :param environment: variables that it has beside those of this process.

    :cvar error: what is raised when it ends, or prints nothing, before it is ready; its last lines
        are the hint.
    """

    error: ClassVar[type[DexkitError]] = DexkitError

    def __init__(
        self,
        *arguments: str,
        on_line: Callable[[str], object] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.arguments = arguments
        self.ready = threading.Event()
        self.place = ""
        """The first word after ``ready:``."""
        self._on_line = on_line
        self._tail: deque[str] = deque(maxlen=40)
        # closed when this process ends, even by SIGKILL
        theirs, self._alive = os.pipe2(os.O_CLOEXEC)
        try:
            self._process = self._popen(arguments, theirs, environment or {})
        except BaseException:
            os.close(self._alive)
            raise
        finally:
            os.close(theirs)
        self._thread = Worker("tool", self._listen)
        self._thread.start()

    @staticmethod
    def _popen(
        arguments: Sequence[str], pipe: int, environment: Mapping[str, str]
    ) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command_line(*arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={
                **os.environ,
                "PYTHONUNBUFFERED": "1",
                END_WITH_PARENT: str(pipe),
                **environment,
            },
            pass_fds=(pipe,),
            # a Ctrl-C in the terminal is the caller's to act upon: it stops its tools in order
            start_new_session=True,
        )

    def __repr__(self) -> str:
        return f"dexkit {' '.join(self.arguments)}"

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._tail.append(line.rstrip())
            if line.startswith("ready:") and not self.place:
                self.place = line.split()[1] if len(line.split()) > 1 else ""
                self.ready.set()
            if self._on_line is not None:
                self._on_line(line.rstrip())
        self.ready.set()  # nothing more will come

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def last_lines(self) -> str:
        """The last lines that it printed."""
        return "\n".join(self._tail)

    def wait_ready(self, stop: threading.Event, timeout: float = READY_TIMEOUT) -> None:
        """Wait until it prints that it is ready, or ``stop`` is set."""
        end = time.monotonic() + timeout
        while not (came := self.ready.wait(0.05)) and time.monotonic() < end:
            if stop.is_set():
                return
        if not came or not any(line.startswith("ready:") for line in self._tail):
            what = "is not ready" if came is False else "ended before it was ready"
            silent = (
                "it printed nothing; a driver whose first exchange() never returns looks like that"
            )
            raise self.error(f"{self!r} {what}", hint=self.last_lines or silent)

    def stop(self) -> bool:
        """Stop the process: SIGTERM first, then SIGKILL. May be called twice.

        :returns: whether it ended when it was asked to.
        """
        if self.running:
            self._process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_TIMEOUT)
        polite = not self.running
        if not polite:
            self._process.kill()
            self._process.wait()
        self._thread.join(STOP_TIMEOUT)
        if self._alive >= 0:
            os.close(self._alive)
            self._alive = -1
        if self._process.stdout is not None:
            self._process.stdout.close()
        return polite

    def __enter__(self) -> Tool:
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()
