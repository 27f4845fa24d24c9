"""Read and check files of users, and write files completely or not at all.

Reading raises one typed error that names the file, whatever is wrong with it: not there, a folder,
a device, a pipe, too large, no UTF-8, no JSON or TOML, nested without end, a key twice, a number
that is none. Writing replaces a file in one step: what was there stays until the new one is whole.
A file that several programs change has one writer at a time (:func:`update_file`).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import math
import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import tomli

from dexkit.errors import DexkitError, UsageError
from dexkit.escaping import one_line, output_error
from dexkit.staging import followed, whole_file

__all__ = [
    "DEEPEST",
    "LARGEST",
    "LOCK_PATIENCE",
    "check_output_paths",
    "limit_depth",
    "open_ordinary",
    "parse_json",
    "parse_toml",
    "read_bytes",
    "read_json",
    "read_text",
    "read_toml",
    "update_file",
    "write_file",
]

LARGEST = 64 * 1024 * 1024
"""Bytes of a file that is read; a result of the largest run has less than one million."""
_PIECE = 1 << 18
DEEPEST = 32
"""Levels of a document; dexkit's own have less than ten."""
_DIGITS = 20
"""Digits of a whole number: 64 bits."""


LOCK_PATIENCE = 10.0
"""Seconds to wait for another writer, which needs some milliseconds."""
_POLL_INTERVAL = 0.01  # seconds between attempts
_NO_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS})


def open_ordinary(
    path: Path, *, error: type[DexkitError] = UsageError, hint: str = ""
) -> io.BufferedReader:
    """Open an ordinary file to be read. A pipe without a writer would be waited for, without end,
    and a device may never end; neither is opened to be read.

    :param error: what is raised when it is no ordinary file, or cannot be opened.
    :param hint: what to do then.
    """
    try:
        file = open(path, "rb", opener=_open_without_waiting)  # noqa: SIM115
    except (OSError, ValueError) as why:  # ValueError: a null character in the name
        reason = why.strerror if isinstance(why, OSError) else str(why)
        raise error(f"cannot read {path}: {reason}", hint=hint) from why
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise error(f"cannot read {path}: it is not an ordinary file", hint=hint)
    return file


def read_bytes(
    path: Path,
    largest: int = LARGEST,
    *,
    error: type[DexkitError] = UsageError,
    hint: str = "",
) -> bytes:
    """The content of an ordinary file of at most ``largest`` bytes.

    :param error: what is raised when it cannot be read.
    :param hint: what to do then.
    """
    data = bytearray()
    with open_ordinary(path, error=error, hint=hint) as file:
        try:
            # in pieces: read(largest) would reserve so much memory first
            while len(data) <= largest and (piece := file.read(_PIECE)):
                data += piece
        except OSError as why:
            raise error(f"cannot read {path}: {why.strerror}", hint=hint) from why
    if len(data) > largest:
        raise error(f"cannot read {path}: it is larger than {largest >> 20} MB", hint=hint)
    return bytes(data)


def read_text(path: Path, *, error: type[DexkitError] = UsageError, hint: str = "") -> str:
    """The text of a UTF-8 file, with or without a byte order mark.

    :param error: what is raised when it cannot be read.
    :param hint: what to do then.
    """
    data = read_bytes(path, error=error, hint=hint)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as why:
        raise error(f"{path} is not UTF-8 text (at byte {why.start})", hint=hint) from why


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe without a writer is not waited for."""
    return os.open(path, flags | os.O_NONBLOCK)


def read_json(path: Path, *, error: type[DexkitError] = UsageError, hint: str = "") -> Any:
    """The document in a JSON file; raises as :func:`read_text` and :func:`parse_json`."""
    return parse_json(read_text(path, error=error, hint=hint), path, error=error, hint=hint)


def read_toml(path: Path) -> dict[str, Any]:
    """The document in a TOML file; raises as :func:`read_text` and :func:`parse_toml`."""
    return parse_toml(read_text(path), path)


def parse_json(
    text: str,
    origin: object,
    *,
    error: type[DexkitError] = UsageError,
    hint: str = "",
    finite: bool = True,
) -> Any:
    """The document in a JSON text.

    :param origin: what to call it.
    :param finite: refuse NaN and infinity, which are no JSON, but which Python writes.
    :raises DexkitError: it is no JSON, holds a key twice, a number that is not finite or has more
        than 64 bits, or is nested more than :data:`DEEPEST` levels.
    """
    try:
        document = json.loads(
            text,
            parse_constant=_no_number if finite else None,
            parse_float=_finite if finite else None,
            parse_int=_whole,
            object_pairs_hook=_without_duplicates,
        )
        limit_depth(document)
    except RecursionError:
        raise error(f"{origin} is not valid JSON: {_TOO_DEEP}", hint=hint) from None
    except ValueError as why:
        raise error(f"{origin} is not valid JSON: {one_line(why)}", hint=hint) from why
    return document


def parse_toml(
    text: str, origin: object, *, error: type[DexkitError] = UsageError, hint: str = ""
) -> dict[str, Any]:
    """The document in a TOML text.

    :param origin: what to call it.
    :raises DexkitError: it is no TOML, holds a number that is not finite or has more than 64 bits,
        or is nested more than :data:`DEEPEST` levels.
    """
    try:
        document = tomli.loads(text, parse_float=_finite)
        limit_depth(document)
    except RecursionError:
        raise error(f"{origin} is not valid TOML: {_TOO_DEEP}", hint=hint) from None
    except ValueError as why:
        raise error(f"{origin} is not valid TOML: {one_line(why)}", hint=hint) from why
    return document


_TOO_DEEP = f"nested more than {DEEPEST} levels"


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{one_line(text, 40)} is not a finite number")
    return value


def _whole(text: str) -> int:
    if len(text) > _DIGITS:
        raise ValueError(f"{one_line(text, 40)} has more than {_DIGITS} digits")
    return int(text)


def _without_duplicates(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {one_line(key, 40)!r} occurs twice")
        found[key] = value
    return found


def limit_depth(document: Any) -> None:
    """Refuse a document that is nested too deeply, or has huge numbers (TOML's parser leaves them).

    :raises ValueError: it is.
    """
    level, depth = [[document]], 0
    while level:
        below: list[Any] = []
        for values in level:
            kinds = set(map(type, values))  # of all at once, as there may be many numbers
            if dict in kinds or list in kinds:
                if depth == DEEPEST:
                    raise ValueError(_TOO_DEEP)
                below += (list(v.values()) for v in values if isinstance(v, dict))
                below += (v for v in values if isinstance(v, list))
            if int in kinds and max(abs(v) for v in values if isinstance(v, int)) >= 10**_DIGITS:
                raise ValueError(f"a number has more than {_DIGITS} digits")
        level, depth = below, depth + 1


def check_output_paths(outputs: Iterable[Path | None], inputs: Iterable[Path | None] = ()) -> None:
    """Check that no output overwrites an input or another output, before any is written.

    Devices, pipes and ``-`` (standard output) may be named more than once; None is skipped.

    :raises UsageError: two paths are one file.
    """
    taken = {_identity(path): "an input" for path in inputs if path is not None}
    for path in outputs:
        if path is None or str(path) == "-" or (path.exists() and not path.is_file()):
            continue
        identity = _identity(path)
        if identity in taken:
            raise UsageError(
                f"{path} is also {taken[identity]}", hint="choose another name for the output"
            )
        taken[identity] = "another output"


def _identity(path: Path) -> object:
    """The same for all names of a file, links included."""
    try:
        status = path.stat()
    except OSError:
        try:
            return path.absolute().resolve()
        except RuntimeError:  # a loop of links (Python 3.10)
            return path.absolute()
    return status.st_dev, status.st_ino


def write_file(path: Path, content: str | bytes | Iterable[bytes]) -> None:
    """Write a file in one step: until it is complete, and on any error, the old file stays.

    A device or a pipe is written as it is, and a link keeps leading to the file.

    :param content: text, bytes, or pieces of bytes, for what is too large for the memory.

    :raises OutputError: it cannot be written.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    pieces = [data] if isinstance(data, bytes) else data
    try:
        with whole_file(path) as place:
            _write_pieces(place, pieces)
    except (OSError, ValueError) as why:
        found = why if isinstance(why, OSError) else OSError(errno.EINVAL, str(why))
        raise output_error(path, found) from why


def _write_pieces(place: Path, pieces: Iterable[bytes]) -> None:
    flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC
    descriptor = os.open(place, flags, 0o666)  # less the mask, as of any new file
    try:
        _write_all(descriptor, pieces)
    finally:
        os.close(descriptor)


def _write_all(descriptor: int, pieces: Iterable[bytes]) -> None:
    for piece in pieces:
        view = memoryview(piece)
        while view:
            view = view[os.write(descriptor, view) :]


def update_file(path: Path, change: Callable[[str | None], str]) -> None:
    """Replace a text file by what ``change`` makes of its content, alone among all writers.

    :param change: gets the content, None where there is no file, and returns the new one. What it
        raises leaves the file as it was.
    :raises UsageError: the file or its folder cannot be read, locked or written.

    Reading and writing happen under an exclusive lock on ``.NAME.lock`` beside the file, which
    stays there. The new content is written beside the file, flushed to the disk and renamed over
    it (:mod:`dexkit.staging`): whenever the program is killed, the file is the old or the new one.
    A symbolic link stays one, and the file keeps its permissions and, as far as permitted, its
    owner.
    """
    try:
        target = followed(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with _locked(target):
            before = read_text(target) if target.exists() else None
            after = change(before)
            if after != before:
                with whole_file(target) as place:
                    _write_pieces(place, [after.encode()])
    except OSError as error:
        raise UsageError(
            f"cannot write {path}: {error.strerror or error}",
            hint="its folder must be writable and its disk not full",
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
                time.sleep(_POLL_INTERVAL)
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
