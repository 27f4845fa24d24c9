"""Measure a file as it will be named in a manifest or a result: size, SHA-256 and CRC-32.

The file is read in pieces, so that a recording of any size needs little memory.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dexkit.documents import open_ordinary
from dexkit.errors import DexkitError, UsageError

__all__ = ["Digest", "digest_of", "file_pieces", "sha256_of_file"]

_PIECE = 1 << 20  # bytes


@dataclass(frozen=True)
class Digest:
    """Size and checksums of a content.

    :param size: bytes.
    :param sha256: 64 hexadecimal digits, lower case.
    :param crc: CRC-32 as zip archives have it.
    """

    size: int
    sha256: str
    crc: int


def digest_of(pieces: Iterable[bytes]) -> Digest:
    """The digest of a content that comes in pieces."""
    size, crc, sha = 0, 0, hashlib.sha256()
    for piece in pieces:
        size += len(piece)
        crc = zlib.crc32(piece, crc)
        sha.update(piece)
    return Digest(size, sha.hexdigest(), crc)


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
    return digest_of(file_pieces(path)).sha256
