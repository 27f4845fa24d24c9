"""The folder in which recordings and verdicts are kept from one ``make pins`` to the next.

All checkouts of a user share it: what is kept is found by its key, and written in one step. A file
that is damaged counts as missing. The files that were not used for longest are removed.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
import platformdirs

from dexkit.documents import write_file
from tools.pins.recordings import Broken, KeptTrace, unpack

__all__ = ["Store", "default_folder"]

Kept = dict[str, dict[str, tuple[str, str]]]
"""Verdict and figure of each side, by the key of a requirement's verdicts."""
_GENERATIONS = 8
"""How many times the verdicts of one state of the checks are kept."""
_RECORDING, _VERDICTS = "recording", "verdicts"
_ABANDONED_S = 86400.0
"""Age at which a file that was never finished is removed."""


def default_folder() -> Path:
    """Where it is if nothing else is said."""
    return Path(platformdirs.user_cache_path("dexkit")) / "pins"


class Store:
    """Recordings and verdicts in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def _path(self, key: str, kind: str) -> Path:
        return self.folder / key[:2] / f"{key}.{kind}"

    def _read(self, key: str, kind: str) -> bytes | None:
        path = self._path(key, kind)
        try:
            data = path.read_bytes()
            os.utime(path)  # used now
        except OSError:
            return None
        return data

    def _write(self, key: str, kind: str, data: bytes) -> None:
        path = self._path(key, kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, data)

    def packed(self, key: str) -> bytes | None:
        """The content of a recording's file; None if there is none."""
        return self._read(key, _RECORDING)

    def recording(self, key: str) -> KeptTrace | None:
        """A recording; None if there is none, or it is damaged."""
        data = self.packed(key)
        with contextlib.suppress(Broken):
            return None if data is None else unpack(data)
        return None

    def keep_recording(self, key: str, data: bytes) -> None:
        """Keep a recording."""
        self._write(key, _RECORDING, data)

    def verdicts(self, key: str) -> Kept:
        """What is known of a recording."""
        data = self._read(key, _VERDICTS)
        with contextlib.suppress(msgspec.MsgspecError):
            return {} if data is None else msgspec.json.decode(data, type=Kept)
        return {}

    def keep_verdicts(self, key: str, found: Mapping[str, Mapping[str, tuple[str, str]]]) -> None:
        """Keep all verdicts of a recording, beside those of earlier states of the checks."""
        earlier = [(k, v) for k, v in self.verdicts(key).items() if k not in found]
        most = (_GENERATIONS - 1) * len(found)
        kept = dict(earlier[-most:]) | dict(found)
        self._write(key, _VERDICTS, msgspec.json.encode(kept))

    def _files(self) -> Iterator[tuple[float, int, Path]]:
        """Time of the last use, bytes and path of each file."""
        for path in self.folder.glob("??/*"):
            with contextlib.suppress(OSError):
                found = path.stat()
                yield found.st_mtime, found.st_size, path

    def tidy(self, most: float) -> tuple[int, int]:
        """Remove what was not used for longest, until there are no more than so many bytes.

        :returns: bytes that are left, and that were removed.
        """
        removed = left = 0
        for used, size, path in sorted(self._files(), reverse=True):
            begun = not path.name.endswith((_RECORDING, _VERDICTS))
            if left + size > most or (begun and used < time.time() - _ABANDONED_S):
                with contextlib.suppress(OSError):
                    path.unlink()
                removed += size
            else:
                left += size
        return left, removed
