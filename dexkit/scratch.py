"""Temporary folders that do not outlive their program, even one that was killed.

Each holds a lock that its program has for as long as it lives; who makes a folder first removes
those of this user whose lock nobody has.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
import stat
import tempfile
from pathlib import Path
from types import TracebackType

__all__ = ["PREFIX", "Scratch", "sweep"]

PREFIX = "dexkit-"
_LOCK = ".lock"


class Scratch:
    """A new folder in the system's temporary one, for this user only; a context manager.

    :param what: part of its name.

    :ivar path: the folder.
    """

    def __init__(self, what: str = "run") -> None:
        sweep()
        self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{what}-"))
        # locked before it has its name: nobody finds it unlocked
        early = self.path / f"{_LOCK}-{secrets.token_hex(4)}"
        self._lock = os.open(early, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        os.rename(early, self.path / _LOCK)

    def close(self) -> None:
        """Remove it. May be called twice."""
        if self._lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Path:
        return self.path

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def sweep() -> list[Path]:
    """Remove the folders that killed programs of this user have left; returns them."""
    removed = []
    with contextlib.suppress(OSError):
        for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
            with contextlib.suppress(OSError):
                if _abandoned(path):
                    removed.append(path)
    return removed


def _abandoned(path: Path) -> bool:
    """Remove a folder if nobody has its lock; whether it was so."""
    about = path.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.geteuid():
        return False
    lock = os.open(path / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where somebody has it
        shutil.rmtree(path, ignore_errors=True)
        return True
    finally:
        os.close(lock)
