"""Start dexkit's programs in the guest without importing Python's modules each time.

On an emulated processor the imports of ``dexkit serve`` take longer than what it is started for.
One process imports them once; the session and each program are forks of it: processes of their
own, with their own user, signals, threads, libusb and DDS.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from dexkit.dds import cyclone_type

__all__ = ["MODULES", "Program", "with_programs"]

MODULES = (
    "dexkit.cli.bringup",
    "dexkit.cli.calibrate",
    "dexkit.cli.doctor",
    "dexkit.cli.doctor_devices",
    "dexkit.cli.serve",
    "dexkit.doctor.dds",
    "dexkit.doctor.environment",
    "dexkit.doctor.link",
    "dexkit.doctor.network",
    "dexkit.doctor.observer",
    "dexkit.doctor.report",
    "dexkit.doctor.usb",
    "dexkit.drivers.dex1_serial",
    "dexkit.drivers.dex3_usb",
    "dexkit.drivers.dex3_usb.bringup",
    "dexkit.drivers.ezgripper",
    "dexkit.messages.unitree_go",
    "dexkit.messages.unitree_hg",
    "dexkit.robots",
    "dexkit.service",
    "dexkit.view.viewer_process",
    "tools.lab.guest.probe",
    "usb.backend.libusb1",
    "usb.util",
)
"""What is imported before the forks. None of them starts a thread."""
_TYPES = (
    "unitree_go::msg::dds_::MotorCmds_",
    "unitree_go::msg::dds_::MotorStates_",
    "unitree_hg::msg::dds_::HandCmd_",
    "unitree_hg::msg::dds_::HandState_",
)
"""Of messages: CycloneDDS's classes for them take long to make, and CycloneDDS to be imported."""
_PROBE = "probe"
_POLL = 0.02  # seconds
_CONTEXT = multiprocessing.get_context("fork")


class _Server:
    """The session's end of its connection to the process that forks the programs."""

    def __init__(self) -> None:
        self.connection: Connection | None = None
        self._lock = threading.Lock()

    def ask(self, *message: Any) -> Any:
        """Send a request; the answer."""
        assert self.connection is not None
        with self._lock:
            self.connection.send(message)
            return self.connection.recv()


_server = _Server()


def with_programs(session: Callable[[], None]) -> None:
    """Import what the programs need, run ``session`` in a fork, and fork its programs meanwhile."""
    for name in MODULES:
        importlib.import_module(name)
    for name in _TYPES:
        cyclone_type(name)
    here, there = _CONTEXT.Pipe()

    def run() -> None:
        here.close()
        _server.connection = there
        session()

    forked = _CONTEXT.Process(target=run)
    forked.start()
    there.close()
    programs = {}
    while True:
        try:
            what, *rest = here.recv()
        except EOFError:
            break
        if what == "start":
            program = _CONTEXT.Process(target=_main, args=rest)
            program.start()
            programs[program.pid] = program
            here.send(program.pid)
        else:
            here.send(programs[rest[0]].exitcode)
    forked.join()


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
        start = ("start", str(self.out), words, user, tuple(groups), terminal)
        self._pid: int = _server.ask(*start)

    def text(self, begin: int = 0) -> str:
        """What it has printed, from byte ``begin`` on."""
        return self.out.read_bytes()[begin:].decode(errors="replace")

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        code: int | None = _server.ask("code", self._pid)
        return code

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        os.kill(self._pid, number)

    def wait(self, timeout: float) -> int:
        """Wait for its end; its exit code.

        :raises subprocess.TimeoutExpired: it runs on.
        """
        end = time.monotonic() + timeout
        while (code := self.code) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(self.words, timeout)
            time.sleep(_POLL)
        return code

    def close(self, patience: float) -> None:
        """End it as Ctrl-C does, or at once if that takes longer than ``patience`` seconds."""
        if self.code is None:
            self.signal(signal.SIGINT)
            try:
                self.wait(patience)
            except subprocess.TimeoutExpired:
                self.signal(signal.SIGKILL)
                self.wait(patience)


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
