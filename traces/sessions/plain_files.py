"""Copy folders that hold nothing but folders and ordinary files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Container, Iterator
from pathlib import Path

from dexkit.documents import open_ordinary
from dexkit.errors import SessionError
from dexkit.escaping import one_line

__all__ = ["OF_DOWNLOADS", "copy_file", "plain_files"]

OF_DOWNLOADS = frozenset({".cache", ".git"})
"""What Hugging Face and Git know of the files that were downloaded: not of those of a copy."""

_PIECE = 1 << 20


def plain_files(root: Path, without: Container[str] = ()) -> Iterator[tuple[str, bool]]:
    """What is below a folder: paths relative to it, and whether each is a folder; a folder comes
    before what is in it.

    :param without: paths that are not looked into, nor named.
    :raises SessionError: a link, which may lead anywhere; or a folder that cannot be read.
    """
    waiting = [""]
    while waiting:
        place = waiting.pop()
        try:
            with os.scandir(root / place) as entries:
                found = sorted(entries, key=lambda e: e.name)
        except OSError as error:
            raise SessionError(f"cannot read {root / place}: {error.strerror}") from error
        for entry in found:
            path = f"{place}/{entry.name}" if place else entry.name
            if path in without:
                continue
            if entry.is_symlink():
                raise SessionError(
                    f"{one_line(str(root / path), 300)} is a link",
                    hint="copy the folder with what its links lead to: cp -rL",
                )
            folder = entry.is_dir(follow_symlinks=False)
            yield path, folder
            if folder:
                waiting.append(path)


def copy_file(source: Path, target: Path) -> None:
    """Copy the content of an ordinary file; the folders above the copy are made.

    :raises SessionError: the source cannot be read, is no ordinary file, or the target exists.
    :raises OSError: the copy cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with open_ordinary(source, error=SessionError) as file:
        try:
            copy = open(target, "xb")  # noqa: SIM115
        except FileExistsError as error:
            raise SessionError(f"{source}: another file has its name in the copy") from error
        with copy:
            shutil.copyfileobj(file, copy, _PIECE)
