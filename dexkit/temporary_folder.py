"""Temporary folders that are removed even if their program is killed.

A program holds a lock on each of its folders (``flock`` on the folder itself) while it runs.
Before a folder is made, those of this user without a lock are removed, which are those of
programs that were killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from pathlib import Path

__all__ = ["PREFIX", "TemporaryFolder", "sweep"]

PREFIX = "dexkit-scratch-"
"""Prefix of their names; a folder with it that no process has locked is removed."""


class TemporaryFolder:
    """A new folder in the system's temporary one, for this user only; a context manager.

    :param what: part of its name.

    :ivar path: the folder.
    """

    def __init__(self, what: str = "run") -> None:
        sweep()
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{what}-"))
            lock = _open(self.path)
            if lock is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if _is_same_file(self.path, lock):
                    break  # not removed by another process before it was locked
                os.close(lock)
        self._lock = lock

    def close(self) -> None:
        """Remove it. May be called twice."""
        if self._lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *exc: object) -> None:
        self.close()


def sweep(folder: Path | None = None) -> list[Path]:
    """Remove the folders that killed programs of this user have left; returns them.

    :param folder: where; by default the system's temporary folder.
    """
    removed = []
    with contextlib.suppress(OSError):
        for path in (folder or Path(tempfile.gettempdir())).glob(f"{PREFIX}*"):
            with contextlib.suppress(OSError):
                if _abandoned(path):
                    removed.append(path)
    return removed


def _abandoned(path: Path) -> bool:
    """Remove a folder if no process has locked it; whether it was removed."""
    about = path.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.geteuid():
        return False
    lock = _open(path)
    if lock is None:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where another process has it
        shutil.rmtree(path, ignore_errors=True)
        return True
    finally:
        os.close(lock)


def _open(path: Path) -> int | None:
    """A descriptor of the folder; None if it has gone."""
    try:
        return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return None


def _is_same_file(path: Path, descriptor: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    return False
