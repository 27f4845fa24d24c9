"""Find, await and end the child processes of a batch; make scratch folders."""

from __future__ import annotations

import contextlib
import os
import signal
import time

__all__ = ["command_of", "descendants", "reap", "scratch_root", "sweep", "wait_gone"]


def _parents() -> dict[int, int]:
    """Parent of each process that is no zombie."""
    found: dict[int, int] = {}
    for name in os.listdir("/proc"):
        if not name.isdigit():
            continue
        with contextlib.suppress(OSError, ValueError, IndexError):
            with open(f"/proc/{name}/stat", "rb") as file:
                fields = file.read().rpartition(b")")[2].split()
            if fields[0] not in (b"Z", b"X"):
                found[int(name)] = int(fields[1])
    return found


def descendants(root: int | None = None) -> list[int]:
    """Processes below ``root`` (this one by default)."""
    parents = _parents()
    below = {root if root is not None else os.getpid()}
    grown = True
    while grown:
        more = {pid for pid, parent in parents.items() if parent in below} - below
        below |= more
        grown = bool(more)
    return sorted(below - {root if root is not None else os.getpid()})


def command_of(pid: int) -> str:
    """Its command line."""
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return "?"


def reap() -> None:
    """Collect children that have ended and are not awaited."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def wait_gone(pids: list[int], timeout: float) -> list[int]:
    """Wait until these processes are gone; those that are not."""
    end = time.monotonic() + timeout
    while True:
        reap()
        left = [pid for pid in pids if pid in _parents()]
        if not left or time.monotonic() > end:
            return left
        time.sleep(0.02)


def sweep() -> list[str]:
    """End every process below this one; returns their descriptions."""
    reap()
    left = descendants()
    names = [f"{pid}: {command_of(pid)}" for pid in left]
    for _ in range(5):
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.kill(pid, signal.SIGCONT)
        wait_gone(left, 2.0)
        left = descendants()
        if not left:
            break
    return names


def scratch_root() -> str | None:
    """Where scratch folders go: memory where there is some, for fuzzers write many small files."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
