"""Read a file in pieces, and its SHA-256: a recording of any size needs little memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from dexkit.documents import open_ordinary
from dexkit.errors import DexkitError, UsageError

__all__ = ["file_pieces", "sha256_of_file"]

_PIECE = 1 << 20  # bytes


def file_pieces(path: Path, *, error: type[DexkitError] = UsageError) -> Iterator[bytes]:
    """The content of an ordinary file in pieces of at most 1 MiB.

    :param error: what is raised when it cannot be read, or is no ordinary file.
    """
    with open_ordinary(path, error=error) as file:
        while True:
            try:
                piece = file.read(_PIECE)
            except OSError as why:
                raise error(f"cannot read {path}: {why.strerror}") from why
            if not piece:
                return
            yield piece


def sha256_of_file(path: Path) -> str:
    """SHA-256 of an ordinary file, as hexadecimal digits.

    :raises UsageError: it cannot be read.
    """
    digest = hashlib.sha256()
    for piece in file_pieces(path):
        digest.update(piece)
    return digest.hexdigest()
