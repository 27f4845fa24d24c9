"""Run child processes of ``dexkit setup-dds``: log their output, end them when it is stopped."""

from __future__ import annotations

import contextlib
import os
import selectors
import shlex
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from typing import IO, Protocol

from dexkit.redaction import redact
from dexkit.stop_signals import StopRequest

__all__ = ["Done", "Interrupted", "ProcessRunner", "Runner"]

_GRACE = 5.0  # seconds from SIGTERM to SIGKILL
_KEPT = 400_000  # characters of output that are looked at for the cause of a failure


class Interrupted(Exception):
    """The user stopped the command; nothing was installed."""


class Done:
    """A command that has ended.

    :ivar code: exit code; negative: the signal that killed it.
    :ivar output: the end of what it printed.
    """

    def __init__(self, code: int, output: str) -> None:
        self.code = code
        self.output = output


class Runner(Protocol):
    """Runs commands."""

    def run(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        to_the_end: bool = False,
    ) -> Done:
        """Run one.

        :param environment: all its variables; None for those of this process.
        :param to_the_end: a request to stop is kept until it has ended.
        :raises Interrupted: the user wants to stop.
        """


class ProcessRunner:
    """Runs them as processes.

    :param log: gets command lines and output.
    :param stop: asks for an end.
    """

    def __init__(self, log: IO[str], stop: StopRequest) -> None:
        self._log = log
        self._stop = stop

    def run(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        to_the_end: bool = False,
    ) -> Done:
        """Run one; see :class:`Runner`. A program that is not there gives exit code 127."""
        if self._stop:
            raise Interrupted
        self._write(f"$ {shlex.join(command)}\n")
        begin = time.monotonic()
        try:
            process = subprocess.Popen(
                list(command),
                env=None if environment is None else dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for dexkit, which ends it
            )
        except OSError as error:
            text = f"{command[0]}: {error.strerror or error}\n"
            self._write(text)
            return Done(127, text)
        try:
            output = self._read(process, to_the_end)
            code = process.wait()
        except BaseException:
            _end(process)
            raise
        finally:
            if process.stdout is not None:
                process.stdout.close()
        self._write(f"[exit code {code}, {time.monotonic() - begin:.1f} s]\n\n")
        return Done(code, output)

    def _read(self, process: subprocess.Popen[bytes], to_the_end: bool) -> str:
        assert process.stdout is not None
        output = ""
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            while True:
                if self._stop and not to_the_end:
                    raise Interrupted
                if not selector.select(0.1):
                    continue
                piece = os.read(process.stdout.fileno(), 1 << 16)
                if not piece:
                    return output
                text = piece.decode(errors="replace")
                self._write(text)
                output = (output + text)[-_KEPT:]

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError):  # a full disk is reported where it does harm
            self._log.write(redact(text))
            self._log.flush()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End it with all its children."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
