"""Read command lines, environments and open files of processes from /proc.

What this user may not read is left out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from dexkit.redaction import redact

__all__ = ["command_line", "environment_of", "holders", "open_sockets", "start_time"]

_PROC = Path("/proc")


def command_line(pid: int) -> str:
    """Command line of a process, its interpreter and paths shortened, or empty; URLs in it without
    their credentials.
    """
    try:
        words = (_PROC / str(pid) / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    words = [word for word in words if word]
    if len(words) > 1 and Path(words[0]).name.startswith("python") and words[1][:1] != "-":
        words = words[1:]
    return " ".join([Path(words[0]).name, *map(redact, words[1:])]) if words else ""


def environment_of(pid: int, name: str) -> str:
    """A variable of the environment in which a process was started, or empty."""
    try:
        data = (_PROC / str(pid) / "environ").read_bytes()
    except OSError:
        return ""
    prefix = name.encode() + b"="
    for item in data.split(b"\0"):
        if item.startswith(prefix):
            return item[len(prefix) :].decode(errors="replace")
    return ""


def start_time(pid: int) -> float | None:
    """When a process began, seconds since the epoch, or None. To 1/100 s."""
    try:
        # the name may hold spaces and brackets; field 22 is the 20th after it
        after = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        boot = next(
            line.split()[1]
            for line in (_PROC / "stat").read_text().splitlines()
            if line.startswith("btime ")
        )
        return float(boot) + int(after[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def _descriptors() -> Iterator[tuple[int, Path, str]]:
    """``(pid, link, target)`` of every open file that this user may read."""
    for entry in _PROC.iterdir():
        if not entry.name.isdigit():
            continue
        try:
            for link in (entry / "fd").iterdir():
                try:
                    yield int(entry.name), link, os.readlink(link)
                except OSError:
                    continue
        except OSError:
            continue


def holders(path: str) -> list[int]:
    """Processes that have a file open, other than this one.

    A name alone is not enough: in a container ``/dev/pts/3`` is another terminal.
    """
    target = os.path.realpath(path)
    wanted = _identity(target)
    found = {
        pid
        for pid, descriptor, name in _descriptors()
        if name == target and pid != os.getpid() and _identity(descriptor) == wanted
    }
    return sorted(found)


def _identity(path: str | Path) -> tuple[int, int] | None:
    """Device and inode of a file, or None if that cannot be read."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def open_sockets() -> dict[str, int]:
    """Process id by socket inode, of the processes that may be seen."""
    return {name[8:-1]: pid for pid, _, name in _descriptors() if name.startswith("socket:[")}
