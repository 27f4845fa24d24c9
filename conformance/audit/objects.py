"""Read an object behind a URL (fsspec) by ranges, in blocks of a few megabytes.

A block that fails is asked for again. Whatever the size of the object, a few blocks are in memory.
"""

from __future__ import annotations

import io
import time
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

from dexkit.errors import UsageError
from dexkit.redaction import redact, redact_logs

__all__ = ["BLOCK", "Object", "RangeFile", "file_system", "tag_of"]

BLOCK = 4 << 20
"""Bytes that are asked for at once."""
_BLOCKS = 4  # that a file keeps
_TRIES = 3  # for a block
_STATUS: dict[int, type[OSError]] = {
    **dict.fromkeys((401, 403), PermissionError),
    **dict.fromkeys((404, 410), FileNotFoundError),
}
_PAUSE = 0.5  # seconds before the first repetition; twice as long before the next
_TAGS = (
    *("ETag", "etag", "md5Hash", "md5", "sha256", "blob_id", "generation", "versionId"),
    *("mtime", "LastModified", "Last-Modified", "last_modified", "updated", "created"),
)
"""Names, in fsspec's file systems, of attributes that change with an object, best first."""


def file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it.

    :raises UsageError: fsspec, or what it needs for that kind of URL, is not installed; or the URL
        is none.
    """
    redact_logs()
    try:
        import fsspec
    except ImportError:
        raise UsageError(
            f"{redact(url, url)} is a URL, which needs fsspec", hint="pip install 'dexkit[audit]'"
        ) from None
    try:
        return fsspec.core.url_to_fs(url)  # type: ignore[no-any-return]
    except Exception as error:  # each file system has errors of its own
        raise UsageError(
            f"{redact(url, url)}: {redact(error, url)}", hint="pip install s3fs, gcsfs, ... for it"
        ) from None


def tag_of(about: dict[str, Any]) -> str:
    """A tag that changes whenever the object does, from its file system's attributes; or empty."""
    return next((str(about[key]) for key in _TAGS if about.get(key)), "")


class Object:
    """An object behind a URL, with its size and version when it was opened.

    :ivar size: bytes; 0 if the storage does not say.
    :ivar ranges: whether a part of it can be asked for.
    :raises Exception: whatever the storage's library raises, here and in the methods.
    """

    def __init__(self, url: str) -> None:
        self._files, self._path = file_system(url)
        about = self._files.info(self._path)
        self.size, self._tag = int(about.get("size") or 0), tag_of(about)
        self._web = "http" in self._files.protocol
        self.ranges = self.size > 0 and about.get("partial", True) is not False
        if self.ranges and self._web:
            try:
                self._part(self.size - 1, self.size)
            except ValueError:  # the server sends all of it, whatever it is asked for
                self.ranges = False

    def part(self, begin: int, end: int) -> bytes:
        """The bytes from ``begin`` to before ``end``.

        :raises OSError: the storage does not give them, or fewer, or more.
        """
        for number in range(_TRIES):
            try:
                data = self._part(begin, end)
                if len(data) != end - begin:
                    raise OSError(f"{len(data)} bytes came instead of {end - begin}")
                return data
            except (FileNotFoundError, PermissionError):
                raise
            except Exception as error:  # each storage has errors of its own
                status = getattr(error, "status", 0)  # a web server's
                if status in _STATUS:
                    raise _STATUS[status](f"HTTP status {status}") from error
                if number + 1 == _TRIES:
                    raise OSError(f"{type(error).__name__}: {error}") from error
                time.sleep(_PAUSE * 2**number)
        raise AssertionError

    def _part(self, begin: int, end: int) -> bytes:
        data: bytes
        if self._web:
            # this one stops reading when more comes than was asked for
            with self._files.open(self._path, "rb", cache_type="none", size=self.size) as source:
                source.seek(begin)
                data = source.read(end - begin)
        else:
            data = self._files.cat_file(self._path, start=begin, end=end)
        return data

    def pieces(self) -> Iterator[bytes]:
        """All of it, a block at a time.

        :raises OSError: it was replaced meanwhile, so that the pieces are of two objects.
        """
        if self.ranges:
            for begin in range(0, self.size, BLOCK):
                yield self.part(begin, min(begin + BLOCK, self.size))
        else:
            more = {"block_size": 0} if self._web else {}  # one request, as it comes
            with self._files.open(self._path, "rb", **more) as source:
                while piece := source.read(BLOCK):
                    yield piece
        self.check()

    def check(self) -> None:
        """Raise OSError if the object has changed."""
        self._files.invalidate_cache()
        about = self._files.info(self._path)
        if (int(about.get("size") or 0), tag_of(about)) != (self.size, self._tag):
            raise OSError("it was replaced while it was read")

    def open(self) -> io.BufferedReader:
        """The object as a file, which reads ranges as they are needed."""
        return io.BufferedReader(RangeFile(self), 1 << 16)


class RangeFile(io.RawIOBase):
    """An object as a file; keeps the blocks that were used last."""

    def __init__(self, source: Object) -> None:
        self._source, self._at = source, 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()

    def readable(self) -> bool:
        """Yes."""
        return True

    def seekable(self) -> bool:
        """Yes."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._source.size}[whence]
        self._at = max(0, base + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Read from one block."""
        number, begin = divmod(self._at, BLOCK)
        if self._at >= self._source.size:
            return 0
        if number not in self._blocks:
            at = number * BLOCK
            self._blocks[number] = self._source.part(at, min(at + BLOCK, self._source.size))
            if len(self._blocks) > _BLOCKS:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(number)
        data = memoryview(self._blocks[number])[begin : begin + len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)
