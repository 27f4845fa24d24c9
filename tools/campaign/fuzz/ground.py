"""A place where dexkit's commands read damaged sources, and what they may touch there.

An input is one changed file of a source: its path, a line break, and its bytes; without a line
break the file is absent. The other files are as they were made.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from dexkit.cli import main
from dexkit.errors import DexkitError
from dexkit.traces import open_trace
from tools.campaign.case import Skip
from tools.campaign.fuzz.case import Difference

__all__ = ["ELSEWHERE", "HERE", "Files", "Ground", "command_line"]

Files = Mapping[str, bytes]
"""Contents by path."""
HERE = "@HERE@"
"""Stands for the path of the scratch folder in an input, so that it is the same in each run."""
ELSEWHERE = "elsewhere"
"""Folder beside the sources whose files nothing may read or change."""
_UNREAD = (0, 1)  # ns: access before change, which is when a file system notes an access
_CODES = (0, 1, 2)


class Ground:
    """A scratch folder: ``sources``, ``out`` for outputs, ``tmp`` for temporary files, and files
    that nothing may touch.

    :param sources: files of all sources.
    :param links: paths in them that are symbolic links, with their targets.
    :param elsewhere: files that nothing may read or change.
    :raises Skip: the file system does not note when a file is read.
    """

    def __init__(
        self, root: Path, sources: Files, elsewhere: Files, links: Mapping[str, str] | None = None
    ) -> None:
        self.root = root
        self.sources = root / "sources"
        self.out = root / "out"
        self._tmp = root / "tmp"
        self._files = sources
        self._links = dict(links or {})
        self._untouched = {root / ELSEWHERE / name: data for name, data in elsewhere.items()}
        self._changed = ""
        self._before = tempfile.tempdir
        tempfile.tempdir = str(self._tmp)
        self._make()
        canary = next(iter(self._untouched))
        canary.read_bytes()
        if _untouched(canary):
            raise Skip("the scratch folder's file system does not note when a file is read")
        os.utime(canary, ns=_UNREAD)

    def close(self) -> None:
        """Give the temporary folder back to others."""
        tempfile.tempdir = self._before

    def _make(self) -> None:
        for path in self.root.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for folder in (self.sources, self.out, self._tmp, self.root / ELSEWHERE):
            folder.mkdir()
        for name, data in self._files.items():
            _write(self.sources / name, data)
        for name, target in self._links.items():
            (self.sources / name).parent.mkdir(parents=True, exist_ok=True)
            (self.sources / name).symlink_to(target)
        for path, data in self._untouched.items():
            _write(path, data)
            os.utime(path, ns=_UNREAD)
        self._expected = self._tree(self.sources)
        self._changed = ""

    def run(self, data: bytes, commands: Callable[[Ground, str, int], object]) -> None:
        """Try an input: its file is changed, and ``commands`` get the path of its source below
        ``sources`` and a number that is the input's own.

        :raises Difference: something was touched that must not be.
        """
        name = self._place(data)
        good = False
        try:
            commands(self, name.partition("/")[0], zlib.crc32(data))
            self._check(name)
            good = True
        finally:
            if not good:
                self._make()
            shutil.rmtree(self.out)
            self.out.mkdir()

    def _place(self, data: bytes) -> str:
        if self._changed:
            _write(self.sources / self._changed, self._files[self._changed])
        head, there, content = data.partition(b"\n")
        self._changed = name = head.decode()
        if there:
            _write(self.sources / name, content.replace(HERE.encode(), os.fsencode(self.root)))
        else:
            (self.sources / name).unlink()
        return name

    def _check(self, changed: str) -> None:
        for path in self._untouched:
            if not _untouched(path):
                raise Difference(f"{path.name} was read or changed, which is not in the source")
        known = {self.sources.name, self.out.name, self._tmp.name, ELSEWHERE}
        if wrong := set(os.listdir(self.root)) - known:
            raise Difference(f"outside of the output: {sorted(wrong)}")
        if len(os.listdir(self.root / ELSEWHERE)) != len(self._untouched):
            raise Difference("a file was written or deleted elsewhere")
        if left := os.listdir(self._tmp):
            raise Difference(f"temporary files are left: {left}")
        if wrong := (self._tree(self.sources) ^ self._expected) - {changed}:
            raise Difference(f"the source was changed: {sorted(wrong)}")

    @staticmethod
    def _tree(folder: Path) -> set[str]:
        return {
            os.path.relpath(os.path.join(at, name), folder)
            for at, _, names in os.walk(folder)
            for name in names
        }

    def outputs(self) -> list[Path]:
        """The files that were written."""
        return sorted(self.out / name for name in self._tree(self.out))

    def dexkit(self, *words: object) -> int:
        """Run a command line in this process, as its program does.

        :returns: its exit code, which is 0, 1 or 2.
        :raises Difference: it is another one, it ran out of memory, or it failed (2) and left a
            file in the output.
        """
        before = len(self.outputs())
        code, text = command_line(words)
        if "out of memory" in text:
            raise Difference("out of memory")
        if code not in _CODES:
            raise Difference(f"exit code {code}: {text[:200]}")
        if code == 2 and len(self.outputs()) > before:
            raise Difference(f"it failed and left {self.outputs()[0].name}: {text[:200]}")
        return code

    def read_outputs(self) -> None:
        """Each recording in the output is whole.

        :raises Difference: one is not.
        """
        for path in self.outputs():
            if path.suffix != ".mcap":
                continue
            try:
                trace = open_trace(path)
                count = sum(1 for _ in trace.messages())
            except DexkitError as error:
                raise Difference(f"an output cannot be read: {error}") from error
            if trace.damage or trace.truncated or not count:
                raise Difference(f"an output is damaged or empty: {trace.damage}")


def command_line(words: Iterable[object]) -> tuple[int, str]:
    """Run ``dexkit`` in this process, as its program does; its exit code, and what it prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    return code, printed.getvalue()


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _untouched(path: Path) -> bool:
    found = os.stat(path)
    return (found.st_atime_ns, found.st_mtime_ns) == _UNREAD
