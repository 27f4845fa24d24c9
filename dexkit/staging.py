"""Write a file or a folder whole or not at all.

An output is made in a folder of its own beside it, flushed to the disk and renamed: what has its
name is whole. The folder is new, its name random, and no other user may look into it, so that
nothing which lies there is taken or followed. It holds a note (:data:`NOTE`) that names dexkit, the
output and the process, locked as long as that runs. What a kill or a power failure leaves behind
is therefore told from everything else: whoever writes the same output the next time removes it. A
folder of another user, without such a note, with the note of another output, or on a file system
without locks stays.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from dexkit import __version__
from dexkit.errors import DexkitError, OutputError

__all__ = ["NOTE", "PREFIX", "Staged", "followed", "whole_file", "whole_folder"]

PREFIX = ".dexkit-"
"""Begin of the names of the folders; a digest of the output's name and a random number follow."""
NOTE = "unfinished.json"
"""Name of the note in them."""
_LONGEST = 1 << 16  # bytes of a note


class Staged:
    """An output that is being made; it, and what it replaces, is untouched until it is published.

    :param target: its place. What it would lead to as a link has to be found before.

    :ivar path: where to make it: a file, a folder or a link. Nothing is there yet.
    :raises OSError: the folder beside it cannot be made.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        beginning = f"{PREFIX}{_digest(target.name)}-"
        _remove_abandoned(target, beginning)
        self._note = -1
        while self._note < 0:
            self._folder = target.with_name(f"{beginning}{secrets.token_hex(8)}")
            os.mkdir(self._folder, 0o700)
            try:
                self._note = self._write_note()
            except FileNotFoundError:
                continue  # another process took the empty folder for an abandoned one
            except BaseException:
                shutil.rmtree(self._folder, ignore_errors=True)
                raise
        self.path = self._folder / target.name

    def _write_note(self) -> int:
        descriptor = os.open(
            self._folder / NOTE, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600
        )
        try:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not os.path.samestat(os.fstat(descriptor), os.lstat(self._folder / NOTE)):
                raise FileNotFoundError
            about = {"dexkit": __version__, "output": str(self.target), "pid": os.getpid()}
            os.write(descriptor, json.dumps(about).encode() + b"\n")
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    def publish(self, *, replace: bool = True) -> None:
        """Flush it to the disk and give it its name.

        :param replace: replace a file that is there. A folder never replaces anything.
        :raises FileExistsError: something is there.
        :raises OSError: it cannot be flushed or renamed.
        """
        _flush(self.path)
        if not replace or stat.S_ISDIR(self.path.lstat().st_mode):
            self._publish_new()
        else:
            os.replace(self.path, self.target)
        self.discard()
        with contextlib.suppress(OSError):  # some file systems have no fsync of folders
            _flush_one(self.target.parent, os.O_DIRECTORY)

    def _publish_new(self) -> None:
        with contextlib.suppress(OSError):  # folders, and file systems without hard links
            os.link(self.path, self.target, follow_symlinks=False)
            return
        if os.path.lexists(self.target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
        os.rename(self.path, self.target)

    def discard(self) -> None:
        """Remove the folder, with what is in it. May be called twice."""
        if self._note >= 0:
            with contextlib.suppress(OSError):
                _remove(self._folder)
            os.close(self._note)
            self._note = -1


@contextlib.contextmanager
def whole_folder(out: Path, *, error: type[DexkitError] = OutputError) -> Iterator[Path]:
    """Make a folder in one step; yields where, which does not exist yet.

    An exception inside leaves nothing. Folders above it are made.

    :param error: what is raised.
    :raises DexkitError: something is there, a link included, or comes to be there meanwhile; it has
        no name, or cannot be written.
    """
    _check_new(out, error)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        staged = Staged(out)
        try:
            yield staged.path
            staged.publish()
        finally:
            staged.discard()
    except OSError as why:
        if isinstance(why, FileExistsError):
            _check_new(out, error)
        raise error(f"cannot write {out}: {why.strerror or why}") from why


def _check_new(out: Path, error: type[DexkitError]) -> None:
    if not out.name or out.name == "..":
        raise error(f"{str(out)!r} is no name of a new folder", hint="choose another name")
    if os.path.lexists(out):
        what = "exists: it is a link" if out.is_symlink() else "exists"
        raise error(f"{out} {what}", hint="choose another name, or delete it")


def followed(path: Path) -> Path:
    """The file that a path leads to, for writing.

    :raises PermissionError: it is a link that another user has put into a folder where anyone may,
        such as ``/tmp``. The kernel follows none there (``fs.protected_symlinks``), and the path
        that this returns would pass by that.
    :raises OSError: it is a loop of links.
    """
    try:
        link, folder = path.lstat(), path.absolute().parent.stat()
    except OSError:
        return Path(os.path.realpath(path))
    shared = folder.st_mode & stat.S_ISVTX and folder.st_mode & stat.S_IWOTH
    theirs = link.st_uid not in (os.geteuid(), folder.st_uid)
    if stat.S_ISLNK(link.st_mode) and shared and theirs:
        raise PermissionError(errno.EACCES, "it is a link that another user has put there")
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    return target


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file in one step; yields where, which does not exist yet. An exception inside leaves
    what was there.

    A link keeps leading to the file, which keeps its permissions and, as far as permitted, its
    owner. A device or a pipe is written as it is: that is what is yielded then.

    :raises OSError: it cannot be written.
    """
    target = followed(path)
    if not target.name:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    known = target.stat() if target.exists() else None
    if known is not None and stat.S_ISDIR(known.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if known is not None and not stat.S_ISREG(known.st_mode):
        yield target
        return
    if known is not None and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    staged = Staged(target)
    try:
        yield staged.path
        if known is not None:
            with open(staged.path, "rb") as file:
                with contextlib.suppress(PermissionError):
                    os.fchown(file.fileno(), known.st_uid, known.st_gid)
                os.fchmod(file.fileno(), stat.S_IMODE(known.st_mode))
        staged.publish()
    finally:
        staged.discard()


def _digest(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:8]


def _remove_abandoned(target: Path, beginning: str) -> None:
    """Remove what programs that were killed have left of this output."""
    with contextlib.suppress(OSError):
        names = [n for n in os.listdir(target.parent) if n.startswith(beginning)]
        for name in names:
            with contextlib.suppress(OSError):
                _remove_if_abandoned(target.with_name(name), target)


def _remove_if_abandoned(folder: Path, target: Path) -> None:
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        return
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(folder / NOTE, flags)
    except FileNotFoundError:
        os.rmdir(folder)  # of a kill before the note, or behind it; raises if anything is in it
        return
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where its program runs
        data = os.read(descriptor, _LONGEST)
        if not data and os.listdir(folder) == [NOTE]:
            _remove(folder)  # of a kill before it was written
            return
        with contextlib.suppress(ValueError, RecursionError):
            about = json.loads(data)
            # by name: the folder that both lie in may have been moved
            if {"dexkit", "pid"} <= about.keys() and Path(about["output"]).name == target.name:
                _remove(folder)
    except (AttributeError, TypeError, KeyError):
        return  # a note of something else
    finally:
        os.close(descriptor)


def _remove(folder: Path) -> None:
    """Remove a folder, its note last: what cannot be removed, or not yet, stays marked."""
    for name in os.listdir(folder):
        path = folder / name
        if name == NOTE:
            continue
        if stat.S_ISDIR(path.lstat().st_mode):
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
    with contextlib.suppress(OSError):
        if os.listdir(folder) == [NOTE]:
            os.unlink(folder / NOTE)
            os.rmdir(folder)


def _flush(path: Path) -> None:
    """Flush a file, or a folder with all that is in it."""
    mode = path.lstat().st_mode
    if stat.S_ISREG(mode):
        _flush_one(path)
    elif stat.S_ISDIR(mode):
        with os.scandir(path) as entries:
            for entry in entries:
                _flush(Path(entry.path))
        with contextlib.suppress(OSError):  # some file systems have no fsync of folders
            _flush_one(path, os.O_DIRECTORY)


def _flush_one(path: Path, flags: int = 0) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
