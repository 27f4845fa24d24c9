"""Start dexkit's programs in the guest without importing Python's modules each time.

On an emulated processor the imports of ``dexkit serve`` take longer than what it is started for. A
server process (:mod:`multiprocessing.forkserver`) imports them once; each program is a fork of it:
a process of its own, with its own user, signals, threads, libusb and DDS.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from multiprocessing.context import ForkServerContext
from pathlib import Path

__all__ = ["MODULES", "Program", "prepare"]

MODULES = (
    "dexkit.cli.bringup",
    "dexkit.cli.calibrate",
    "dexkit.cli.doctor",
    "dexkit.cli.doctor_devices",
    "dexkit.cli.serve",
    "dexkit.dds",
    "dexkit.drivers.dex1_serial",
    "dexkit.drivers.dex3_usb",
    "dexkit.drivers.dex3_usb.bringup",
    "dexkit.drivers.ezgripper",
    "dexkit.messages.unitree_go",
    "dexkit.messages.unitree_hg",
    "dexkit.service",
    "tools.lab.guest.__main__",
    "tools.lab.guest.probe",
    "usb.backend.libusb1",
)
"""What the server imports. None of them starts a thread."""
_PROBE = "probe"


def _context() -> ForkServerContext:
    return multiprocessing.get_context("forkserver")


def prepare() -> None:
    """Start the server; it imports in the background."""
    _context().set_forkserver_preload(list(MODULES))
    from multiprocessing import forkserver

    forkserver.ensure_running()


class Program:
    """One process.

    :param words: the arguments of ``dexkit``, or ``probe`` and those of
        :mod:`tools.lab.guest.probe`.
    :param user: who runs it, with this group of the same number; None for root.
    :param groups: that the user is in, too.
    :param terminal: path of the terminal that it is started in; without one it has no input.

    :ivar out: the file with what it prints, on both outputs.
    """

    def __init__(
        self,
        *words: str,
        user: int | None = None,
        groups: Sequence[int] = (),
        terminal: str = "",
    ) -> None:
        self.words = words
        self.out = Path(f"/tmp/program-{time.monotonic_ns()}.log")
        self.out.touch()
        arguments = (str(self.out), words, user, tuple(groups), terminal)
        self._process = _context().Process(target=_main, args=arguments)
        self._process.start()

    def text(self, begin: int = 0) -> str:
        """What it has printed, from byte ``begin`` on."""
        return self.out.read_bytes()[begin:].decode(errors="replace")

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.exitcode

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def wait(self, timeout: float) -> int:
        """Wait for its end; its exit code.

        :raises subprocess.TimeoutExpired: it runs on.
        """
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(self.words, timeout)
        return self._process.exitcode

    def close(self, patience: float) -> None:
        """End it as Ctrl-C does, or at once if that takes longer than ``patience`` seconds."""
        if self.code is None:
            self.signal(signal.SIGINT)
            try:
                self.wait(patience)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.join()


def _main(
    out: str, words: Sequence[str], user: int | None, groups: Sequence[int], terminal: str
) -> None:
    if terminal:
        os.setsid()
        os.dup2(os.open(terminal, os.O_RDWR), 0)  # it becomes the session's terminal
        sys.stdin = os.fdopen(0, closefd=False)
    descriptor = os.open(out, os.O_WRONLY | os.O_APPEND)
    for number in (1, 2):
        os.dup2(descriptor, number)
    os.close(descriptor)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if user is not None:
        os.setgroups(groups)
        os.setgid(user)
        os.setuid(user)
    sys.argv = ["dexkit", *words]
    if words[0] == _PROBE:
        from tools.lab.guest import probe

        probe.main(*words[1:])
    else:
        from dexkit.cli import main

        sys.exit(main())
