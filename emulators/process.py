"""Run ``dexkit emulate DEVICE`` as a child process: start it, inject faults, stop it."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from typing import IO

from dexkit.child_processes import command_line
from dexkit.descriptors import wait_readable
from dexkit.emulators.faults import FaultFamily, parse_fault
from dexkit.errors import EmulatorError

__all__ = ["EmulatorProcess"]


class EmulatorProcess:
    """``dexkit emulate DEVICE --fault - ...``, ready.

    :param arguments: of that command.
    :param faults: the faults that the device can have.
    :param timeout: seconds until it must have said that it is ready.
    :raises EmulatorError: it did not become ready; the hint is its output.

    :ivar ready_line: the first line that it printed.
    :ivar output: after :meth:`close`: what it printed after that line.
    :ivar errors: likewise to standard error.
    """

    def __init__(
        self,
        device: str,
        arguments: Sequence[str],
        faults: FaultFamily,
        *,
        timeout: float = 20.0,
    ) -> None:
        self._faults = faults
        self.output = self.errors = ""
        self.process = subprocess.Popen(
            command_line("emulate", device, "--fault=-", *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            self.ready_line = self._await_ready(device, timeout)
        except BaseException:
            self.close()
            raise

    def _await_ready(self, device: str, timeout: float) -> str:
        stdout = self.process.stdout
        assert stdout is not None
        deadline = time.monotonic() + timeout
        line = b""
        while not line.endswith(b"\n"):
            left = max(0.0, deadline - time.monotonic())
            ready = wait_readable([stdout.fileno()], left)
            piece = os.read(stdout.fileno(), 1) if ready else b""
            if not piece:
                try:
                    # a process that closed its output ends soon and reports why
                    self.process.wait(left)
                except subprocess.TimeoutExpired:
                    self.process.kill()
                _, stderr = self.process.communicate()
                raise EmulatorError(
                    f"the emulated {device} did not start",
                    hint=stderr.decode(errors="replace").strip(),
                )
            line += piece
        return line.decode().strip()

    def inject(self, spec: str) -> None:
        """Inject a fault now (or at its ``@TIME`` from now).

        :raises UsageError: there is no such fault.
        """
        parse_fault(spec, self._faults)  # report a bad specification here, not in the child process
        stdin: IO[bytes] | None = self.process.stdin
        assert stdin is not None
        stdin.write(spec.encode() + b"\n")
        stdin.flush()

    def close(self) -> None:
        """Stop it. May be called twice."""
        if self.process.returncode is not None:
            return
        self.process.terminate()
        try:
            stdout, stderr = self.process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            stdout, stderr = self.process.communicate()
        self.output = stdout.decode(errors="replace")
        self.errors = stderr.decode(errors="replace")
