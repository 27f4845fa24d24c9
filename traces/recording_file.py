"""Write a recording's file: commit whole chunks or nothing, under an exclusive lock.

* Written data stay in memory until :meth:`RecordingFile.commit`, which writes them to the file. If
  that fails part-way, the file is truncated to the last commit, so every message reported as
  written can be read.
* A live recording that replaces another is written to the same name with ``.part``, and renamed
  when it contains a message. Until then the old one is untouched.
* A recording that is made of existing data (``whole``) is written beside its name
  (:mod:`dexkit.staging`), and gets that when it is finished.
* Changes by other programs are detected: deletion, renaming or truncation at the next commit,
  changed bytes at the end.
* The file is locked (``flock``) while it is written. A second recorder is refused; readers do
  not look at the lock and may follow the file as it grows.

What is left of a live recording after kill -9: without ``overwrite`` the file itself, at any time.
With it, either the old recording and a ``.part`` without messages, which the next recorder takes
over, or the new one. Only in the instant between the first commit and the renaming there is a
``.part`` with messages; it is never overwritten.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from mcap.records import ChunkIndex

from dexkit.errors import TraceError, UsageError
from dexkit.staging import Staged, followed
from dexkit.traces import mcap_records
from dexkit.traces.mcap_records import HEAD, MAGIC, Opcode, walk

__all__ = ["ChunkIndexes", "RecordingFile"]

_PART = ".part"
_CREATE = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
_OPEN_PART = _CREATE | os.O_NOFOLLOW | os.O_NONBLOCK
# Records of a recording that ended before its first message
_BEFORE_MESSAGES = frozenset({Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA})
_BLOCK = 1 << 20
_RETRIES = (0.001, 0.01, 0.05)  # seconds; testing a lock takes microseconds
_EXTRA_RETRIES = (0.1, 0.2)  # seconds, for a lock that another program gives up after _RETRIES


class RecordingFile:
    """A file for the mcap library's writer (``write``, ``tell``, ``flush``).

    :param path: its final name. A link is followed.
    :param overwrite: replace what is there.
    :param whole: it gets its name when it is closed, not before.
    :raises TraceError: another user has put a link there (:func:`~dexkit.staging.followed`).

    :ivar displaced: what happened to the file's name while it was written, or empty.
    """

    def __init__(self, path: Path, *, overwrite: bool, whole: bool = False) -> None:
        self.path = path
        self.displaced = ""
        try:
            self._target = followed(path)
        except PermissionError as error:
            raise TraceError(f"cannot create {path}: {error.strerror}") from error
        if not self._target.name:  # "/", or no name in the folder "/"
            raise UsageError(f"cannot record to {str(path)!r}: it is a folder")
        self._part = self._target.with_name(self._target.name + _PART)
        self._overwrite = overwrite
        self._whole = whole
        self._staged: Staged | None = None
        self._fd = -1
        self._regular = True
        self._is_part = False  # still written as ``.part``
        self._buffer: list[bytes] = []
        self._buffered = 0
        self._size = 0
        self._crc = 0  # of what was committed
        self._changed_ns = -1  # when the file was last changed by this program
        self._changed_by_others = (
            False  # it was changed by another one, or the clock of its disk differs
        )

    # -- opening and closing
    # ----------------------------------------------------------------------------------

    def open(self) -> None:
        """Create it.

        :raises UsageError: there is one already, or it is being recorded.
        :raises TraceError: it cannot be created.
        """
        try:
            self._open()
        except FileExistsError:
            raise UsageError(
                f"{self.path} exists", hint="choose another name, or delete the file"
            ) from None
        except OSError as error:
            raise TraceError(f"cannot create {self.path}: {error.strerror}") from error

    def _open(self) -> None:
        existing = _status(self._target)
        if existing is not None and stat.S_ISDIR(existing.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if existing is not None and not self._overwrite:
            raise FileExistsError
        if existing is not None and not stat.S_ISREG(existing.st_mode):
            self._regular = False  # a device or a pipe: nothing to keep, cut back or lock
            self._fd = self._open_device()
            return
        self._refuse_other_recorder(self._part)
        if self._whole:
            self._refuse_other_recorder(self._target)
            self._fd = self._open_staged(existing)
            return
        if existing is None:
            self._fd = self._open_new()
            return
        self._refuse_other_recorder(self._target)
        fd = self._open_beside()
        try:
            self._lock(fd, fcntl.LOCK_EX)
            # the lock may be that of a file which has got its name meanwhile
            now = _status(self._part)
            if now is None or now.st_ino != os.fstat(fd).st_ino:
                raise self._busy_error()
            self._refuse_other_recorder(self._target)
            if _is_worth_keeping(fd):
                raise UsageError(
                    f"{self._part} holds messages of a recorder that was killed, "
                    "or is no recording",
                    hint="rename it (dexkit info tells what is in it) or delete it",
                )
            os.ftruncate(fd, 0)
            with contextlib.suppress(OSError):
                os.fchmod(fd, stat.S_IMODE(existing.st_mode))
        except BaseException:
            os.close(fd)
            raise
        self._fd, self._is_part = fd, True

    def _open_new(self) -> int:
        """Create the file. Another recorder may have seen it before it was locked."""
        fd = os.open(self._target, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            self._lock(fd, fcntl.LOCK_EX)
            # A recorder that is to replace this file locks its own ``.part`` before it tests this
            # lock. If it tested too early, it continues; otherwise it is refused, and gives up
            # within _RETRIES.
            self._refuse_other_recorder(self._part, (*_RETRIES, *_EXTRA_RETRIES))
        except BaseException:
            if self._is_at(self._target, fd):
                self._target.unlink()
            os.close(fd)
            raise
        return fd

    def _open_staged(self, existing: os.stat_result | None) -> int:
        """Create the file beside its name."""
        self._staged = staged = Staged(self._target)
        self._part, self._is_part = staged.path, True
        try:
            fd = os.open(self._part, _CREATE | os.O_EXCL, 0o666)
        except BaseException:
            staged.discard()
            raise
        if existing is not None:
            with contextlib.suppress(OSError):
                os.fchmod(fd, stat.S_IMODE(existing.st_mode))
        return fd

    def _open_device(self) -> int:
        """Open a device or pipe. A pipe without a reader is refused instead of waiting for one."""
        try:
            fd = os.open(self._target, os.O_WRONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise TraceError(
                    f"cannot write to {self.path}: no program reads it",
                    hint="start the reader first",
                ) from error
            raise
        os.set_blocking(fd, True)
        return fd

    def _open_beside(self) -> int:
        """Open ``.part``. It may be another program's: a link is not followed."""
        try:
            fd = os.open(self._part, _OPEN_PART, 0o666)
            if stat.S_ISREG(os.fstat(fd).st_mode):
                return fd
            os.close(fd)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR):
                raise
        raise UsageError(f"{self._part} is not a file", hint="rename it or delete it")

    def _lock(self, fd: int, how: int, pauses: Sequence[float] = _RETRIES) -> None:
        for pause in (*pauses, None):
            try:
                fcntl.flock(fd, how | fcntl.LOCK_NB)
            except BlockingIOError:
                if pause is None:
                    raise self._busy_error() from None
                time.sleep(pause)  # another recorder may only be testing the lock
            except OSError:
                return  # a file system without locks
            else:
                return

    def _refuse_other_recorder(self, path: Path, pauses: Sequence[float] = _RETRIES) -> None:
        """Raise if another recorder writes to ``path``."""
        with contextlib.suppress(FileNotFoundError, PermissionError):
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
            try:
                self._lock(fd, fcntl.LOCK_SH, pauses)
            finally:
                os.close(fd)  # and with it the lock

    def _busy_error(self) -> UsageError:
        return UsageError(
            f"{self.path} is being recorded by another program",
            hint="choose another name, or stop that program",
        )

    def close(self, *, keep: bool) -> None:
        """Close it; uncommitted data are lost.

        :param keep: keep it under its name; otherwise remove it, and keep the file that it was to
            replace.
        :raises TraceError: it cannot be renamed.
        """
        fd, self._fd = self._fd, -1
        if fd < 0:
            return
        try:
            if not self._regular:
                return
            if keep:
                self.publish(fd)
                return
            place = self._part if self._is_part else self._target
            if self._is_at(place, fd):
                place.unlink()
        finally:
            os.close(fd)
            if self._staged is not None:
                self._staged.discard()

    def publish(self, fd: int | None = None) -> None:
        """Rename it to its final name, unless that is done.

        :raises TraceError: another recorder has begun to write there, or it cannot be renamed.
        """
        if not self._is_part:
            return
        fd = self._fd if fd is None else fd
        try:
            self._refuse_other_recorder(self._target)
            if not self._is_at(self._part, fd):
                raise TraceError(f"{self._part} was deleted while it was recorded")
            if self._staged is None:
                os.replace(self._part, self._target)
            else:
                self._staged.publish(replace=self._overwrite)
        except UsageError as error:
            raise TraceError(error.message, hint=self._kept_hint) from None
        except OSError as error:
            raise TraceError(
                f"cannot replace {self.path}: {error.strerror}", hint=self._kept_hint
            ) from error
        self._is_part = False

    @property
    def _kept_hint(self) -> str:
        return f"this recording is {self._part}" if self._staged is None else ""

    # -- for the writer ------------------------------------------------------------------------

    def write(self, data: bytes) -> int:
        """Buffer bytes; :meth:`commit` writes them to the file."""
        if data:
            self._buffer.append(bytes(data))
            self._buffered += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes written so far, committed or not."""
        return self._size + self._buffered

    def flush(self) -> None:
        """Do nothing: :meth:`commit` writes."""

    @property
    def waiting(self) -> int:
        """Bytes that are not committed."""
        return self._buffered

    def commit(self) -> None:
        """Write the buffered bytes to the file, all of them or none.

        :raises OSError: the disk is full, for example.
        """
        data, self._buffer, self._buffered = b"".join(self._buffer), [], 0
        if not data:
            return
        self._notice_changes()
        view = memoryview(data)
        done = 0
        try:
            while done < len(view):
                done += os.write(self._fd, view[done:])
        except OSError:
            if self._regular and done:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._fd, self._size)
            raise
        self._size += len(view)
        self._crc = zlib.crc32(view, self._crc)
        if self._regular:
            self._changed_ns = os.fstat(self._fd).st_mtime_ns

    def _notice_changes(self) -> None:
        """Remember whether another program has written to the file."""
        if self._regular and self._size and not self._changed_by_others:
            self._changed_by_others = os.fstat(self._fd).st_mtime_ns != self._changed_ns

    def check(self) -> None:
        """Check that it still exists.

        :raises TraceError: it was deleted or truncated.
        """
        if not self._regular:
            return
        status = os.fstat(self._fd)
        if status.st_nlink == 0:
            raise TraceError(
                f"{self._part if self._is_part else self.path} was deleted while it was recorded",
                hint="what was recorded is lost",
            )
        if status.st_size != self._size:
            raise self._changed_error()
        if not self._is_part and not self.displaced and not self._is_at(self._target, self._fd):
            self.displaced = (
                f"{self.path} was renamed or replaced while it was recorded; "
                "the recording has another name now"
            )

    def verify(self) -> None:
        """Check that the file holds the committed data.

        It is read only if its modification time has changed since the last commit, because reading
        a long recording again would delay its end.

        :raises TraceError: another program has written into it.
        """
        self._notice_changes()
        if not self._changed_by_others:
            return
        crc = at = 0
        while at < self._size:
            block = os.pread(self._fd, min(_BLOCK, self._size - at), at)
            if not block:
                break
            crc = zlib.crc32(block, crc)
            at += len(block)
        if at != self._size or crc != self._crc:
            raise self._changed_error()

    def _changed_error(self) -> TraceError:
        return TraceError(
            f"{self._part if self._is_part else self.path} was changed by another program "
            "while it was recorded",
            hint="dexkit info tells what can be read of it, if anything",
        )

    def _is_at(self, path: Path, fd: int) -> bool:
        there, here = _status(path), os.fstat(fd)
        return there is not None and (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)

    # -- reading back ------------------------------------------------------------------------

    @property
    def readable(self) -> bool:
        """Whether committed data can be read back."""
        return self._regular

    def chunk_indexes(self) -> Iterator[ChunkIndex]:
        """The index of each chunk committed, made from the file itself."""
        index: ChunkIndex | None = None
        for opcode, at, end in walk(self._read_at, len(MAGIC), self._size):
            if opcode == Opcode.MESSAGE_INDEX and index is not None:
                (channel,) = struct.unpack("<H", self._read_at(at + HEAD.size, 2))
                index.message_index_offsets[channel] = at
                index.message_index_length += end - at
                continue
            if index is not None:
                yield index
                index = None
            if opcode == Opcode.CHUNK:
                index = self._chunk_index(at, end)
            elif opcode == Opcode.DATA_END:
                return
        if index is not None:
            yield index

    def _chunk_index(self, at: int, end: int) -> ChunkIndex:
        head = mcap_records.chunk_head(self._read_at(at + HEAD.size, mcap_records.CHUNK_START))
        return ChunkIndex(
            chunk_length=end - at,
            chunk_start_offset=at,
            compression=head.compression,
            compressed_size=head.packed,
            message_end_time=head.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=head.start_ns,
            uncompressed_size=head.size,
        )

    def _read_at(self, at: int, count: int) -> bytes:
        return os.pread(self._fd, count, at)


class ChunkIndexes:
    """Replaces the list in which the mcap library collects the index of every chunk.

    With five chunks a second that list grows by 18 MB an hour; the file holds the same.
    """

    def __init__(self, file: RecordingFile) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        """Ignore it."""

    def __iter__(self) -> Iterator[ChunkIndex]:
        """Read the indexes from the file; everything must have been committed."""
        return self._file.chunk_indexes()


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _is_worth_keeping(fd: int) -> bool:
    """Whether it is not merely a recording that ended before its first message."""
    if not MAGIC.startswith(os.pread(fd, len(MAGIC), 0)):
        return True
    size = os.fstat(fd).st_size
    found = walk(lambda at, count: os.pread(fd, count, at), len(MAGIC), size)
    return any(opcode not in _BEFORE_MESSAGES for opcode, _, _ in found)
