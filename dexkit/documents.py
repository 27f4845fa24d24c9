"""Files that a user gives, and files that dexkit writes.

Reading raises one typed error that names the file, whatever is wrong with it: not there, a folder,
a device, a pipe, too large, no UTF-8, no JSON or TOML, nested without end, a key twice, a number
that is none. Writing replaces a file in one step: what was there stays until the new one is whole.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import secrets
import stat
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dexkit.errors import DexkitError, UsageError
from dexkit.untrusted import one_line, output_error

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = [
    "DEEPEST",
    "LARGEST",
    "parse_json",
    "parse_toml",
    "read_json",
    "read_text",
    "read_toml",
    "write_file",
]

LARGEST = 64 * 1024 * 1024
"""Bytes of a file that is read; a result of the largest run has less than one million."""
DEEPEST = 32
"""Levels of a document; dexkit's own have less than ten."""
_DIGITS = 20
"""Digits of a whole number: 64 bits."""


def read_text(path: Path, *, error: type[DexkitError] = UsageError, hint: str = "") -> str:
    """The text of a UTF-8 file, with or without a byte order mark.

    :param error: what is raised when it cannot be read.
    :param hint: what to do then.
    """
    try:
        # a pipe without a writer would be waited for
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as why:  # ValueError: a null character in the name
        reason = why.strerror if isinstance(why, OSError) else str(why)
        raise error(f"cannot read {path}: {reason}", hint=hint) from why
    try:
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise error(f"cannot read {path}: it is not an ordinary file", hint=hint)
            data = file.read(LARGEST + 1)
    except OSError as why:
        raise error(f"cannot read {path}: {why.strerror}", hint=hint) from why
    if len(data) > LARGEST:
        raise error(f"cannot read {path}: it is larger than {LARGEST >> 20} MB", hint=hint)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as why:
        raise error(f"{path} is not UTF-8 text (at byte {why.start})", hint=hint) from why


def read_json(path: Path, *, error: type[DexkitError] = UsageError, hint: str = "") -> Any:
    """The document in a JSON file; raises as :func:`read_text` and :func:`parse_json`."""
    return parse_json(read_text(path, error=error, hint=hint), path, error=error, hint=hint)


def read_toml(
    path: Path, *, error: type[DexkitError] = UsageError, hint: str = ""
) -> dict[str, Any]:
    """The document in a TOML file; raises as :func:`read_text` and :func:`parse_toml`."""
    return parse_toml(read_text(path, error=error, hint=hint), path, error=error, hint=hint)


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
            object_pairs_hook=_once,
        )
        _shallow(document)
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
        document = tomllib.loads(text, parse_float=_finite)
        _shallow(document)
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


def _once(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {one_line(key, 40)!r} is there twice")
        found[key] = value
    return found


def _shallow(document: Any) -> None:
    """Refuse what is nested too deeply, or has huge numbers (TOML's parser leaves them).

    :raises ValueError: it is.
    """
    level, depth = [document], 0
    while level:
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict | list):
                if depth == DEEPEST:
                    raise ValueError(_TOO_DEEP)
                below += value.values() if isinstance(value, dict) else value
            elif isinstance(value, int) and abs(value) >= 10**_DIGITS:
                raise ValueError(f"a number has more than {_DIGITS} digits")
        level, depth = below, depth + 1


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file in one step: until it is whole, and on any error, what was there stays.

    A device or a pipe is written as it is, and a link keeps leading to the file.

    :raises OutputError: it cannot be written.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode if target.exists() else None
        if mode is not None and stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if mode is not None and not stat.S_ISREG(mode):
            with target.open("wb", buffering=0) as file:
                _write_all(file.fileno(), data)
            return
        if mode is not None and not os.access(target, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        _replace(target, data, None if mode is None else stat.S_IMODE(mode))
    except (OSError, ValueError) as why:
        found = why if isinstance(why, OSError) else OSError(errno.EINVAL, str(why))
        raise output_error(path, found) from why


def _replace(target: Path, data: bytes, mode: int | None) -> None:
    temporary = target.with_name(f".dexkit-{secrets.token_hex(8)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    descriptor = os.open(temporary, flags, 0o666)  # less the mask, as of any new file
    try:
        try:
            _write_all(descriptor, data)
            if mode is not None:
                os.fchmod(descriptor, mode)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(temporary, target)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
