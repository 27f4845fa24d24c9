"""Open a recording of an archive, a file or an object behind a URL (fsspec)."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from dexkit.conformance.audit.objects import Object
from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.digests import file_pieces
from dexkit.errors import DexkitError, TraceUnreadable
from dexkit.escaping import one_line
from dexkit.redaction import redact
from dexkit.temporary_folder import TemporaryFolder
from dexkit.traces.container import OpenFile

__all__ = ["TooLarge", "is_url", "opened", "problem_of"]

_SPARE = 1 << 28  # bytes that a copy leaves free in the temporary folder


class TooLarge(DexkitError):
    """A file is larger than an audit may copy, and cannot be read otherwise."""


def is_url(location: str) -> bool:
    """Whether a location is a URL, and not a path."""
    return "://" in location


def problem_of(
    name: str, error: BaseException, place: str = "", *, source: str = ""
) -> EpisodeRecord:
    """The record of an episode or folder that its storage does not give.

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
    return EpisodeRecord(
        one_line(name, 4096),
        state=state,
        error=one_line(text, 2000),
        hint=one_line(hint, 2000),
        source=source,
    )


@contextlib.contextmanager
def opened(place: str, name: str, most: int) -> Iterator[tuple[Path, OpenFile | None, str]]:
    """The file's path, what opens it if it is not there, and its SHA-256.

    An object is copied to the temporary folder, block by block; the copy is removed behind it. One
    that is larger than ``most``, or than what is free there, is read where it is, by ranges, which
    transfers it several times.

    :param place: its path or URL; ``name`` is without credentials.
    :raises TooLarge: it can neither be copied nor be read by ranges.
    :raises OSError: an object was replaced meanwhile.
    """
    digest = hashlib.sha256()
    if not is_url(place):
        path = Path(place)
        for piece in file_pieces(path, error=TraceUnreadable):
            digest.update(piece)
        yield path, None, digest.hexdigest()
        return
    source = Object(place)
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
            yield Path(name), source.open, digest.hexdigest()
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
