"""Find the sessions of an archive: files in folders, or objects behind a URL (fsspec)."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dexkit.conformance.audit.records import FileRecord, State
from dexkit.digests import file_pieces
from dexkit.errors import DexkitError, TraceUnreadable, UsageError
from dexkit.escaping import one_line
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["Session", "TooLarge", "find", "is_url", "local_file", "problem_of"]

_SUFFIX = ".mcap"
_PIECE = 1 << 20
_TAGS = (
    *("ETag", "etag", "md5Hash", "md5", "sha256", "blob_id", "generation", "versionId"),
    *("mtime", "LastModified", "last_modified", "updated", "created"),
)
"""What file systems of fsspec call that which changes with an object, best first."""


class TooLarge(DexkitError):
    """A file is larger than an audit may copy."""


@dataclass(frozen=True)
class Session:
    """A file that is to be judged.

    :param name: how the rows call it; ``place`` is the path or URL itself.
    :param size: bytes; ``tag`` changes whenever the file does.
    """

    name: str
    place: str
    size: int
    tag: str


def is_url(location: str) -> bool:
    """Whether a location is a URL, and not a path."""
    return "://" in location


def find(location: str, working_folder: Path | None = None) -> Iterator[Session | FileRecord]:
    """The sessions at a location, by name; a record for each place that cannot be looked into.

    Of a folder those are the files that end in ``.mcap``; links to folders are not followed.

    :param location: a file, a folder or a URL.
    :param working_folder: what a relative path is relative to; None for the process' own.
    :raises UsageError: a URL without fsspec, or of a kind that is not installed.
    """
    if is_url(location):
        yield from _find_objects(location)
        return
    name = Path(location)
    base = Path(os.path.abspath((working_folder or Path()) / name))
    if not base.is_dir():
        yield _session_of(name, base)
        return
    problems: list[OSError] = []
    for folder, folders, files in os.walk(base, onerror=problems.append):
        folders.sort()
        for file in sorted(files):
            if file.lower().endswith(_SUFFIX):
                found = Path(folder, file)
                yield _session_of(name / found.relative_to(base), found)
    for error in problems:
        yield problem_of(os.fsdecode(error.filename or location), error)


def _session_of(name: Path, path: Path) -> Session | FileRecord:
    try:
        status = path.stat()
    except OSError as error:
        return problem_of(str(name), error)
    text = one_line(name.as_posix(), 4096)
    return Session(text, str(path), status.st_size, str(status.st_mtime_ns))


def _file_system(url: str) -> tuple[Any, str]:
    try:
        import fsspec
    except ImportError:
        raise UsageError(
            f"{url} is a URL, which needs fsspec", hint="pip install 'dexkit[audit]'"
        ) from None
    try:
        return fsspec.core.url_to_fs(url)  # type: ignore[no-any-return]
    except (ImportError, ValueError) as error:
        raise UsageError(f"{url}: {error}", hint="pip install s3fs, gcsfs, ... for it") from None


def _find_objects(url: str) -> Iterator[Session | FileRecord]:
    files, root = _file_system(url)
    try:
        found: dict[str, dict[str, Any]] = files.find(root, detail=True)
        if not found and not files.exists(root):
            raise FileNotFoundError(2, "there is no such object or folder")
    except Exception as error:  # each storage has errors of its own
        yield problem_of(url, error)
        return
    for path, info in sorted(found.items()):
        if not path.lower().endswith(_SUFFIX) and path != root:
            continue
        place = files.unstrip_protocol(path)
        tag = next((str(info[key]) for key in _TAGS if info.get(key)), "")
        yield Session(one_line(place, 4096), place, int(info.get("size") or 0), tag)


def problem_of(name: str, error: BaseException) -> FileRecord:
    """The record of a file or folder that its storage does not give."""
    cause: BaseException | None = error
    state = State.UNREADABLE if isinstance(error, DexkitError) else State.UNAVAILABLE
    while cause is not None:
        if isinstance(cause, FileNotFoundError | NotADirectoryError):
            state = State.GONE
        elif isinstance(cause, PermissionError):
            state = State.REFUSED
        elif isinstance(cause, TooLarge | MemoryError):
            state = State.TOO_LARGE
        cause = cause.__cause__
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    if state is State.UNAVAILABLE and not isinstance(error, OSError):
        text = f"{type(error).__name__}: {text}"
    hint = error.hint if isinstance(error, DexkitError) else ""
    return FileRecord(
        one_line(name, 4096), state=state, error=one_line(text, 2000), hint=one_line(hint, 2000)
    )


@contextlib.contextmanager
def local_file(session: Session, most: int) -> Iterator[tuple[Path, str]]:
    """The file's path and its SHA-256; of an object, of a copy that is removed behind it.

    :param most: bytes of an object that are copied.
    :raises TooLarge: it has more.
    """
    digest = hashlib.sha256()
    if not is_url(session.place):
        path = Path(session.place)
        for piece in file_pieces(path, error=TraceUnreadable):
            digest.update(piece)
        yield path, digest.hexdigest()
        return
    if session.size > most:
        raise TooLarge(f"it has {session.size} bytes, more than {most}", hint="--max-size")
    files, where = _file_system(session.place)
    with TemporaryFolder("audit") as folder:
        path = folder / "session.mcap"
        size = 0
        with files.open(where, "rb") as source, path.open("wb") as copy:
            while piece := source.read(_PIECE):
                size += len(piece)
                if size > most:
                    raise TooLarge(f"it has more than {most} bytes", hint="--max-size")
                digest.update(piece)
                copy.write(piece)
        yield path, digest.hexdigest()
