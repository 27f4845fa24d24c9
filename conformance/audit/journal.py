"""Keep the records of an audit on the disk, one line each, so that it can go on later.

A line is written in one call when its file is done. What a kill or a full disk leaves behind is a
cut last line, which the next audit does over. One audit at a time writes to a journal.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from dexkit.conformance.audit.records import FORMAT, VERSION, EpisodeRecord, State
from dexkit.errors import UsageError
from dexkit.escaping import output_error

__all__ = ["Entry", "Journal"]

_FIRST = f'{{"format":"{FORMAT}","version":{VERSION}}}\n'.encode()


class Entry(NamedTuple):
    """Position of a record in the journal, and the data that show whether it is still valid."""

    at: int
    length: int
    size: int
    tag: str
    sha256: str
    settings: str
    state: State


class Journal:
    """The records of an audit; a context manager.

    :param path: the file; created if it is not there.
    :ivar entries: the newest record of each file, by name.
    :raises UsageError: it is something else, or another audit writes to it.
    :raises OutputError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, Entry] = {}
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
        try:
            self._file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
        except OSError as error:
            raise output_error(path, error) from error
        try:
            self._begin()
        except BaseException:
            self._file.close()
            raise

    def _begin(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"another audit writes to {self.path}", hint="choose another folder with --out"
            ) from None
        except OSError:
            pass  # a file system without locks
        self._end = 0
        first = os.pread(self._file.fileno(), len(_FIRST), 0)
        if first and first != _FIRST[: len(first)]:
            raise UsageError(
                f"{self.path} is not the journal of an audit of this version",
                hint="choose another folder with --out, or delete it",
            )
        if first == _FIRST:
            self._load()
        else:
            self._truncate(0)
            self._append(_FIRST)

    def _load(self) -> None:
        self._end = len(_FIRST)
        with open(self.path, "rb") as file:
            file.seek(self._end)
            for line in file:
                try:
                    if not line.endswith(b"\n"):
                        raise ValueError("cut")
                    self._note(EpisodeRecord.of_line(line), self._end, len(line))
                except ValueError:
                    break  # what follows a cut line was not written by this program
                self._end += len(line)
        self._truncate(self._end)

    def _note(self, record: EpisodeRecord, at: int, length: int) -> None:
        key = (record.size, record.tag, record.sha256, record.settings, record.state)
        self.entries[record.name] = Entry(at, length, *key)

    def _truncate(self, size: int) -> None:
        try:
            self._file.truncate(size)
        except OSError as error:
            raise output_error(self.path, error) from error
        self._end = size

    def _append(self, line: bytes) -> None:
        try:
            done = 0
            while done < len(line):
                done += os.pwrite(self._file.fileno(), line[done:], self._end + done)
        except OSError as error:
            raise output_error(self.path, error) from error
        self._end += len(line)

    def add(self, record: EpisodeRecord) -> None:
        """Keep a record, in place of an older one of the same file.

        :raises OutputError: it cannot be written.
        """
        line = record.as_line()
        at = self._end
        self._append(line)
        self._note(record, at, len(line))

    def read(self, entry: Entry) -> EpisodeRecord:
        """The record of an entry."""
        return EpisodeRecord.of_line(os.pread(self._file.fileno(), entry.length, entry.at))

    def records(self, names: Iterable[str]) -> Iterator[EpisodeRecord]:
        """The records of these files, one at a time; those that are not done are left out."""
        for name in names:
            if name in self.entries:
                yield self.read(self.entries[name])

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()
