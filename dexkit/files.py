"""Files that several programs change: one writer at a time, old or new content at any moment."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from dexkit.errors import UsageError

__all__ = ["LOCK_PATIENCE", "update_file"]

LOCK_PATIENCE = 10.0
"""Seconds to wait for another writer, which needs some milliseconds."""
_LOOK = 0.01  # seconds between attempts
_NO_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS})


def update_file(path: Path, change: Callable[[str | None], str]) -> None:
    """Replace a text file by what ``change`` makes of its content, alone among all writers.

    :param change: gets the content, None where there is no file, and returns the new one. What it
        raises leaves the file as it was.
    :raises UsageError: the file or its folder cannot be read, locked or written.

    Reading and writing happen under an exclusive lock on ``.NAME.lock`` beside the file, which
    stays there. The new content is written beside the file, flushed to the disk and renamed over
    it: whenever the program is killed, the file is the old or the new one. A symbolic link stays
    one, and the file keeps its permissions and, as far as permitted, its owner.
    """
    try:
        target = path.resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        with _locked(target):
            try:
                before: str | None = target.read_text(encoding="utf-8")
            except FileNotFoundError:
                before = None
            after = change(before)
            if after != before:
                _replace(target, after)
    except UnicodeDecodeError as error:
        raise UsageError(f"cannot read {path}: it is not UTF-8 text") from error
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links (Python 3.10)
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise UsageError(
            f"cannot write {path}: {why}", hint="its folder must be writable and have room"
        ) from error


@contextlib.contextmanager
def _locked(target: Path) -> Iterator[None]:
    lock = target.with_name(f".{target.name}.lock")
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except PermissionError:  # another user's: reading is enough for a lock on a local disk
        descriptor = os.open(lock, os.O_RDONLY | os.O_CLOEXEC)
    try:
        end = time.monotonic() + LOCK_PATIENCE
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= end:
                    raise UsageError(
                        f"{target} has been locked by another program for {LOCK_PATIENCE:g} s",
                        hint=f"which one? See: fuser -v {lock}",
                    ) from error
                time.sleep(_LOOK)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                raise UsageError(
                    f"{target} cannot be locked: {error.strerror}",
                    hint="its file system (NFS?) has no locks; keep the file on another one",
                ) from error
        yield
    finally:
        os.close(descriptor)  # which unlocks


def _replace(target: Path, text: str) -> None:
    # one name is enough under the lock, and what a killed program left is written over
    new = target.with_name(f".{target.name}.new")
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            with contextlib.suppress(FileNotFoundError):
                known = target.stat()
                with contextlib.suppress(PermissionError):
                    os.fchown(file.fileno(), known.st_uid, known.st_gid)
                os.fchmod(file.fileno(), stat.S_IMODE(known.st_mode))
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, target)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    with contextlib.suppress(OSError):  # some file systems have no fsync of folders
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
