"""What all cases in the guest share: the host, USB/IP, processes, and reports."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import subprocess
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dexkit.errors import DexkitError
from tools.lab.guest.programs import Program

__all__ = [
    "HOST",
    "Bench",
    "Failed",
    "Serve",
    "Unprivileged",
    "attach",
    "attach_times",
    "detach",
    "dexkit",
    "kernel_log",
    "pin_of",
    "rule",
    "run",
    "udevd",
    "use",
    "wait_for",
]

HOST = "10.0.2.2"
"""The host's loopback address, as QEMU's user network shows it."""
_VHCI = Path("/sys/devices/platform/vhci_hcd.0")
_FREE = 4  # VDEV_ST_NULL of the kernel's usbip_common.h
_PATIENCE = 30.0
_TRIES = 5
_START = 180.0  # seconds for a program to start: Python's imports on an emulated processor
Unprivileged = 1000
"""User and group id of an ordinary user."""


class Failed(Exception):
    """A case did not show what it should."""


class Bench:
    """The connection to the host, and the cases' results."""

    def __init__(self, words: dict[str, str]) -> None:
        self.words = words
        self._socket = socket.create_connection((HOST, int(words["control"])), _PATIENCE)
        self._lines = self._socket.makefile("rw")

    def ask(self, **message: Any) -> dict[str, Any]:
        """Send one message to the host; its answer."""
        self._lines.write(json.dumps(message) + "\n")
        self._lines.flush()
        answer: dict[str, Any] = json.loads(self._lines.readline())
        return answer

    def fact(self, **facts: object) -> None:
        """Add to the facts about this guest."""
        self.ask(do="fact", facts={name: str(value) for name, value in facts.items()})

    def case(self, group: str, name: str, do: Callable[[], str]) -> bool:
        """Do one; its result goes to the host. Returns whether it passed."""
        print(f"--- {group}: {name}", flush=True)
        started = time.monotonic()
        status = "passed"
        try:
            said = do()
        except Exception as error:
            status, said = "failed", _text(error)
            traceback.print_exc()
        seconds = time.monotonic() - started
        case = {"group": group, "name": name, "status": status, "said": said, "seconds": seconds}
        self.ask(do="case", case=case)
        return status == "passed"

    def skip(self, group: str, name: str, why: str) -> None:
        """Say that one was not tried."""
        case = {"group": group, "name": name, "status": "skipped", "said": why}
        self.ask(do="case", case=case)


def _text(error: Exception) -> str:
    if isinstance(error, Failed):
        return str(error)
    if isinstance(error, DexkitError):
        return f"{type(error).__name__}: {error.message}; {error.hint}"
    return f"{type(error).__name__}: {error}"


def wait_for(what: Callable[[], Any], why: str, timeout: float = _PATIENCE) -> float:
    """Wait until ``what`` is true; the seconds that it took.

    :raises Failed: it did not become true.
    """
    started = time.monotonic()
    while not what():
        if time.monotonic() - started > timeout:
            raise Failed(f"{why}: not in {timeout:.0f} s")
        time.sleep(0.01)
    return time.monotonic() - started


def run(*command: str, timeout: float = _START) -> str:
    """Run a program; what it printed on both outputs.

    :raises Failed: it ended with another code than 0.
    """
    done = subprocess.run(
        command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=timeout
    )
    if done.returncode:
        raise Failed(f"{' '.join(command[:4])}: code {done.returncode}: {done.stdout[-600:]}")
    return done.stdout


# --- USB/IP of the kernel


def pin_of(busid: str) -> Path | None:
    """The kernel's folder of the device that was attached as ``busid``, once it has one."""
    for fields in _status():
        if int(fields[2]) != _FREE and fields[6] != "0-0":
            folder = Path("/sys/bus/usb/devices") / fields[6]
            if _attached.get(int(fields[1])) == busid and (folder / "idVendor").exists():
                return folder
    return None


_attached: dict[int, str] = {}
attach_times: list[float] = []
"""Seconds that each ``usbip attach`` took."""


def _status() -> list[list[str]]:
    lines = (_VHCI / "status").read_text().splitlines()[1:]
    return [line.split() for line in lines if line.strip()]


def _used() -> set[int]:
    return {int(fields[1]) for fields in _status() if int(fields[2]) != _FREE}


def attach(port: int | str, busid: str) -> int:
    """Have the kernel attach a device of the host's server ``port``; the port of vhci_hcd."""
    before, started = _used(), time.monotonic()
    # usbip looks at all of the kernel's USB devices, and fails where one goes meanwhile
    for left in reversed(range(_TRIES)):
        try:
            run("usbip", "--tcp-port", str(port), "attach", "-r", HOST, "-b", busid)
            break
        except Failed:
            if not left:
                raise
            time.sleep(0.1)
    (place,) = _used() - before
    _attached[place] = busid
    attach_times.append(time.monotonic() - started)
    return place


def detach(place: int) -> None:
    """Take a device away from the kernel, as pulling its cable does."""
    _attached.pop(place, None)
    if place not in _used():
        return  # vhci_hcd has dropped it itself
    (_VHCI / "detach").write_text(str(place))
    wait_for(lambda: place not in _used(), "vhci_hcd does not give the port back")


def kernel_log(pattern: str) -> list[str]:
    """The lines of the kernel's log that match."""
    lines = subprocess.run(["dmesg"], capture_output=True, text=True).stdout.splitlines()
    return [line for line in lines if re.search(pattern, line)]


# --- processes


class Serve(Program):
    """``dexkit serve`` in a process of its own.

    :param arguments: of the command.

    With 20 states a second, and at ordinary priority: an emulated processor is too slow for the
    rates of a robot's computer, and a service that cannot keep its rate would, at real-time
    priority, keep the kernel's own threads from running, which carry USB/IP.
    """

    def __init__(self, *arguments: str) -> None:
        started = time.monotonic()
        super().__init__("serve", *arguments, "--no-real-time", "--state-rate", "20")
        try:
            wait_for(
                lambda: "ready:" in self.text() or self.code is not None, "dexkit serve", _START
            )
        except Failed as error:
            self.end()
            raise Failed(f"{error}: {self.text()[-600:]}") from error
        if self.code is not None:
            raise Failed(f"dexkit serve ended: {self.text()[-600:]}")
        self.start_time = time.monotonic() - started

    def said(self, begin: int, pattern: str) -> str:
        """The first line from ``begin`` on that matches; empty without one."""
        for line in self.text(begin).splitlines():
            if re.search(pattern, line):
                return line.strip()
        return ""

    def mark(self) -> int:
        """Where its output ends now."""
        return self.out.stat().st_size

    def counters(self) -> list[dict[str, Any]]:
        """Its counters now, one dictionary for each topic pair."""
        begin = self.mark()
        self.signal(signal.SIGUSR1)
        ready = self.text().count("ready:")
        wait_for(lambda: self.text(begin).count("counters {") >= ready, "counters")
        return [json.loads(t) for t in re.findall(r"counters (\{.*\})", self.text(begin))]

    def end(self) -> None:
        """End it as Ctrl-C does."""
        self.close(_PATIENCE)
        print(self.text(), flush=True)


def dexkit(*words: str) -> tuple[int, str]:
    """Run a command of dexkit; its exit code, and what it printed."""
    program = Program(*words)
    try:
        return program.wait(_START), program.text()
    finally:
        program.close(_PATIENCE)


def use(*words: str, user: int | None = None, groups: Sequence[int] = ()) -> str:
    """Use a device in a process of its own, as another user if one is given; what happened.

    :param words: of :mod:`tools.lab.guest.probe`.
    """
    program = Program("probe", *words, user=user, groups=groups)
    try:
        program.wait(_START)
        return program.text().strip()
    finally:
        program.close(_PATIENCE)


@contextlib.contextmanager
def udevd() -> Iterator[None]:
    """Systemd's udev daemon with Debian's rules. libusb learns from it that a device has come."""
    daemon = subprocess.Popen(["/usr/lib/systemd/systemd-udevd"])
    try:
        wait_for(lambda: Path("/run/udev/control").exists(), "systemd-udevd")
        run("udevadm", "trigger")
        run("udevadm", "settle")
        yield
    finally:
        daemon.terminate()
        daemon.wait(_PATIENCE)


@contextlib.contextmanager
def rule(text: str) -> Iterator[None]:
    """A udev rule of the user's."""
    folder = Path("/etc/udev/rules.d")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "70-lab.rules"
    path.write_text(text)
    try:
        run("udevadm", "control", "--reload")
        yield
    finally:
        path.unlink()
        run("udevadm", "control", "--reload")
