"""Names that stand in a file and become names of files: refused or encoded, here and nowhere else.

A path to be read must lead to something below the folder that the user named, also through links
(:func:`below`). A text that becomes the name of a new file is encoded (:func:`file_name`).
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

from dexkit.errors import SessionError
from dexkit.escaping import one_line, visible

__all__ = ["below", "file_name"]

# Bytes of a name and of a path that Linux can open.
_NAME, _PATH = 255, 4095
# Separators, and what other systems refuse in a name.
_FORBIDDEN = re.compile(r'[<>:"/\\|?*\t\n]')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def below(folder: Path, name: str) -> Path:
    """The file that a path in a file of ``folder`` names.

    :raises SessionError: the path is no relative one, leads out of the folder, also by ``..`` or a
        link, is too long, or has control characters.
    """
    pure = PurePosixPath(name.replace("\\", "/"))
    if not name or pure.is_absolute() or ".." in pure.parts:
        raise _refused(folder, name, "leads out of it")
    if visible(name) != name or "\t" in name or "\n" in name:
        raise _refused(folder, name, "has characters that are no text")
    sizes = [len(part.encode()) for part in pure.parts]
    if max(sizes, default=0) > _NAME or sum(sizes) + len(sizes) > _PATH:
        raise _refused(folder, name, "is too long")
    root = os.path.realpath(folder)
    found = os.path.realpath(os.path.join(root, *pure.parts))
    if os.path.commonpath([root, found]) != root:
        raise _refused(folder, name, "leads out of it through a link")
    return Path(found)


def _refused(folder: Path, name: str, why: str) -> SessionError:
    return SessionError(
        f"{folder}: the path {one_line(name, 100)!r} {why}",
        hint="paths are relative to that folder, and end below it; copy a folder with what its "
        "links lead to: cp -rL",
    )


def file_name(text: str, longest: int = 100) -> str:
    """A text as the name of a file: no separators or control characters, and never empty.

    A name that is one already stays. Different texts may give one name.

    :param longest: bytes of UTF-8.
    """
    plain = "".join("_" if visible(c) != c else c for c in _FORBIDDEN.sub("_", text))
    plain = re.sub(r"^[.\s]|[.\s]$", "_", plain)
    if not plain or _RESERVED.fullmatch(plain):
        plain = f"_{plain}"
    return plain.encode()[:longest].decode("utf-8", "ignore")
