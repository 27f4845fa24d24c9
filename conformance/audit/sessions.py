"""Find the sessions of an archive: files in folders, or objects behind a URL (fsspec)."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dexkit.conformance.audit.file_records import FileRecord, State
from dexkit.conformance.audit.objects import Object, file_system, tag_of
from dexkit.digests import file_pieces
from dexkit.errors import DexkitError, TraceUnreadable, UsageError
from dexkit.escaping import one_line
from dexkit.redaction import redact, url_name
from dexkit.staging import PREFIX
from dexkit.temporary_folder import TemporaryFolder
from dexkit.traces.container import OpenFile

__all__ = ["SessionFile", "TooLarge", "find", "is_url", "opened", "problem_of"]

_SUFFIX = ".mcap"
_SPARE = 1 << 28  # bytes that a copy leaves free in the temporary folder


class TooLarge(DexkitError):
    """A file is larger than an audit may copy, and cannot be read otherwise."""


@dataclass(frozen=True)
class SessionFile:
    """A file that is to be judged.

    :param name: how the rows call it, and by what it is found in the journal; without credentials.
        ``place`` is the path or URL itself.
    :param size: bytes; ``tag`` changes whenever the file does.
    """

    name: str
    place: str
    size: int
    tag: str


def is_url(location: str) -> bool:
    """Whether a location is a URL, and not a path."""
    return "://" in location


def find(location: str, working_folder: Path | None = None) -> Iterator[SessionFile | FileRecord]:
    """The sessions at a location, by name; a record for each place that cannot be looked into.

    Of a folder those are the files that end in ``.mcap``; links to folders are not followed.

    :param location: a file, a folder or a URL.
    :param working_folder: what a relative path is relative to; None for the process' own.
    :raises UsageError: an empty path; a URL without fsspec, or of a kind that is not installed.
    """
    if is_url(location):
        yield from _find_objects(location)
        return
    if not location:
        raise UsageError("'' is no path", hint="'.' is this folder")
    name = Path(location)
    base = Path(os.path.abspath((working_folder or Path()) / name))
    if not base.is_dir():
        yield _session_of(name, base)
        return
    problems: list[OSError] = []
    for folder, folders, files in os.walk(base, onerror=problems.append):
        folders[:] = sorted(name for name in folders if not name.startswith(PREFIX))
        for file in sorted(files):
            if file.lower().endswith(_SUFFIX):
                found = Path(folder, file)
                yield _session_of(name / found.relative_to(base), found)
    for error in problems:
        yield problem_of(os.fsdecode(error.filename or location), error)


def _session_of(name: Path, path: Path) -> SessionFile | FileRecord:
    try:
        status = path.stat()
    except OSError as error:
        return problem_of(str(name), error)
    text = one_line(name.as_posix(), 4096)
    return SessionFile(text, str(path), status.st_size, str(status.st_mtime_ns))


def _find_objects(url: str) -> Iterator[SessionFile | FileRecord]:
    files, root = file_system(url)
    try:
        found: dict[str, dict[str, Any]] = files.find(root, detail=True)
        if not found and not files.exists(root):
            raise FileNotFoundError(2, "there is no such object or folder")
    except Exception as error:  # each storage has errors of its own
        yield problem_of(url_name(url), error, url)
        return
    for path, info in sorted(found.items()):
        if not path.lower().endswith(_SUFFIX) and path != root:
            continue
        place = files.unstrip_protocol(path)
        try:
            if not tag_of(info) or not info.get("size"):  # a web server's list has only names
                info = files.info(path)
        except Exception as error:
            yield problem_of(url_name(place), error, place)
            continue
        name = one_line(url_name(place), 4096)
        yield SessionFile(name, place, int(info.get("size") or 0), tag_of(info))


def problem_of(name: str, error: BaseException, place: str = "") -> FileRecord:
    """The record of a file or folder that its storage does not give.

    :param place: its path or URL, whose credentials the error may show.
    """
    cause: BaseException | None = error
    state = State.UNREADABLE if isinstance(error, DexkitError) else State.UNAVAILABLE
    while cause is not None:
        if isinstance(cause, FileNotFoundError | NotADirectoryError):
            state = State.GONE
        elif isinstance(cause, PermissionError) or getattr(cause, "status", 0) in (401, 403):
            state = State.REFUSED
        elif isinstance(cause, TooLarge | MemoryError):
            state = State.TOO_LARGE
        elif isinstance(cause, OSError) and state is State.UNREADABLE:
            state = State.UNAVAILABLE
        cause = cause.__cause__
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    if state is State.UNAVAILABLE and not isinstance(error, OSError):
        text = f"{type(error).__name__}: {text}"
    text = redact(text, place)
    hint = error.hint if isinstance(error, DexkitError) else ""
    return FileRecord(
        one_line(name, 4096), state=state, error=one_line(text, 2000), hint=one_line(hint, 2000)
    )


@contextlib.contextmanager
def opened(session: SessionFile, most: int) -> Iterator[tuple[Path, OpenFile | None, str]]:
    """The file's path, what opens it if it is not there, and its SHA-256.

    An object is copied to the temporary folder, block by block; the copy is removed behind it. One
    that is larger than ``most``, or than what is free there, is read where it is, by ranges, which
    transfers it several times.

    :raises TooLarge: it can neither be copied nor be read by ranges.
    :raises OSError: an object was replaced meanwhile.
    """
    digest = hashlib.sha256()
    if not is_url(session.place):
        path = Path(session.place)
        for piece in file_pieces(path, error=TraceUnreadable):
            digest.update(piece)
        yield path, None, digest.hexdigest()
        return
    source = Object(session.place)
    with TemporaryFolder("audit") as folder:
        if source.size > min(most, shutil.disk_usage(folder).free - _SPARE):
            if not source.ranges:
                raise TooLarge(
                    f"it has {source.size} bytes, more than can be copied, and its server does "
                    "not give parts of it",
                    hint="copy it to this machine",
                )
            for piece in source.pieces():
                digest.update(piece)
            yield Path(session.name), source.open, digest.hexdigest()
            source.check()
            return
        path = folder / "session.mcap"
        size = 0
        with path.open("wb") as copy:
            for piece in source.pieces():
                size += len(piece)
                if size > most:
                    raise TooLarge(f"it has more than {most} bytes", hint="copy it to this machine")
                digest.update(piece)
                copy.write(piece)
        yield path, None, digest.hexdigest()
