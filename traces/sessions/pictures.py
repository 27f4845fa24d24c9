"""Pictures of a session: their files, format and size, without a picture library."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from dexkit.documents import read_bytes
from dexkit.errors import SessionError, UsageError
from dexkit.traces.sessions.paths import below

__all__ = ["Picture", "parse_picture", "read_picture"]

_LARGEST = 32 * 2**20
_JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xDA)})
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


@dataclass(frozen=True)
class Picture:
    """A compressed picture.

    :param form: ``jpeg`` or ``png``.
    """

    form: str
    width: int
    height: int
    channels: int
    data: bytes


def read_picture(folder: Path, name: str) -> tuple[Picture | None, str]:
    """(the picture, or None; the reason, as the end of "pictures that ...")."""
    try:
        path = below(folder, name)
    except SessionError:
        return None, "are not below the session's folder"
    try:
        if not path.is_file():
            return None, "are not files" if path.exists() else "are missing"
        if path.stat().st_size > _LARGEST:
            return None, f"are larger than {_LARGEST >> 20} MB"
        data = read_bytes(path, _LARGEST)
    except (OSError, UsageError):
        return None, "cannot be read"
    picture = parse_picture(data)
    return picture, "" if picture is not None else "are neither JPEG nor PNG"


def parse_picture(data: bytes) -> Picture | None:
    """Format and size of a JPEG or PNG; None if it is neither, or has no size."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 26 and data[12:16] == b"IHDR":
        width, height = struct.unpack(">II", data[16:24])
        channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(data[25], 0)
        return Picture("png", width, height, channels, data) if width and height else None
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
        elif marker in _JPEG_WITHOUT_LENGTH:
            at += 2
        elif marker in _JPEG_FRAMES:
            if at + 10 > len(data):
                return None
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return Picture("jpeg", width, height, data[at + 9], data) if width and height else None
        else:
            at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    return None
