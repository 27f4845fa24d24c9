r"""Escape text from outside (topic names, notes, result files) before it is printed or written.

A name can hold escape sequences that move a terminal's cursor or write its title, characters that
turn the direction of what follows (U+202E), lines of its own, or markup. Nothing of that is to
reach a terminal or a page raw. It is done where text leaves the program:

- the standard streams are :class:`Guard`\ ed as long as a command runs: control characters are
  shown as escapes such as ``\x1b``;
- tables are printed by :class:`dexkit.console.Console`: its own colours pass, those in texts not;
- pages are written through :func:`html`, Markdown through ``plain``, XML through :func:`visible`.

A line break is no control character there, so names in a line go through :func:`one_line`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
from collections.abc import Iterable, Iterator
from html import escape
from typing import IO, Any, NoReturn, TextIO, cast

from dexkit.errors import OutputError

__all__ = [
    "LONGEST",
    "REMARK",
    "Guard",
    "guarded",
    "html",
    "one_line",
    "open_standard_streams",
    "output_error",
    "visible",
]

LONGEST = 300
"""Characters of a name that are shown; the rest is an ellipsis."""
REMARK = 2000
"""Characters of a remark or an error that are shown."""

# C0 but tab and line feed, DEL, C1; invisible and direction-changing format characters (category
# Cf), separators of lines and paragraphs, surrogates, and U+FFFE and U+FFFF, which XML forbids
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u180e"
    "\u200b-\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff\ufff9-\ufffb\ufffe\uffff"
    "\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    "\U000e0000-\U000e0fff]"
)
_BREAK = re.compile("[\t\n]")
_CLEAR_LINE = "\r\x1b[K"
"""Begin of a status line: it overwrites the one before."""


def _escaped(match: re.Match[str]) -> str:
    code = ord(match.group())
    if code < 0x100:
        return {9: "\\t", 10: "\\n", 13: "\\r"}.get(code, f"\\x{code:02x}")
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def visible(text: str) -> str:
    """``text`` with control characters as escapes; tabs and line feeds stay."""
    return text if text.isprintable() else _CONTROL.sub(_escaped, text)


def one_line(text: object, longest: int = LONGEST) -> str:
    """A name or a remark in one line: tabs and line feeds as escapes, too, and no longer than
    ``longest`` characters.
    """
    shown = str(text)
    if len(shown) > longest:
        shown = f"{shown[: longest - 1]}…"
    return shown if shown.isprintable() else _BREAK.sub(_escaped, visible(shown))


def html(text: object) -> str:
    """``text`` as HTML or XML that shows just that."""
    return escape(visible(str(text)))


class Guard:
    """A text stream on which control characters are shown, and errors are dexkit's own.

    A write may begin with carriage return and "clear line", as status lines do. What has been
    cleaned otherwise is written to :attr:`trusted`.

    :param missing: the stream was closed when the program started, and ``stream`` is the null
        device. The program runs on, so that its files are still written; :meth:`finish` raises.
    :raises OutputError: by each of its writes: disk full, pipe closed, ...
    """

    def __init__(self, stream: IO[str], name: str, *, missing: bool = False) -> None:
        self._stream = stream
        self._name = name
        self._missing = missing
        self._written = False
        self._error: OSError | None = None
        self.trusted = _Trusted(self)

    # click takes ``buffer``, where there is one, and would write past this
    def __getattr__(self, name: str) -> Any:
        if name == "buffer":
            raise AttributeError(name)
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write ``text``, cleaned."""
        if not isinstance(text, str):
            raise TypeError(f"only text can be written, not {type(text).__name__}")
        begin = _CLEAR_LINE if text.startswith(_CLEAR_LINE) and self.isatty() else ""
        self.write_trusted(begin + visible(text.removeprefix(begin)))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each of ``lines``."""
        for line in lines:
            self.write(line)

    def write_trusted(self, text: str) -> None:
        """Write ``text`` unchanged, except for characters that the stream's encoding lacks."""
        self._check()
        if not text:
            return  # /dev/full takes not even that, and click tries it
        self._written = True
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        try:
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                plain = text.encode(encoding, "backslashreplace").decode(encoding)
                self._stream.write(plain)
        except OSError as error:
            self._lost(error)

    def flush(self) -> None:
        """Flush it."""
        self._check()
        try:
            self._stream.flush()
        except OSError as error:
            self._lost(error)

    def finish(self) -> None:
        """Flush it at the end of the program.

        :raises OutputError: what was written did not reach the stream.
        """
        self.flush()
        if self._missing and self._written:
            raise output_error(self._name, OSError(errno.EBADF, "it is closed"))

    def _check(self) -> None:
        """Raise the first error again: its first receiver may have ignored it."""
        if self._error is not None:
            raise output_error(self._name, self._error) from self._error

    def _lost(self, error: OSError) -> NoReturn:
        self._error = error
        # what is left in its buffer must not be tried again when the interpreter ends
        with contextlib.suppress(OSError, ValueError):
            sink = os.open(os.devnull, os.O_WRONLY)
            os.dup2(sink, self._stream.fileno())
            os.close(sink)
        raise output_error(self._name, error) from error


class _Trusted:
    """A guarded stream for who cleans by himself."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard

    def __getattr__(self, name: str) -> Any:
        return getattr(self._guard, name)

    def write(self, text: str) -> int:
        self._guard.write_trusted(text)
        return len(text)


def output_error(what: object, error: OSError) -> OutputError:
    """The error to raise when a file or stream cannot be written."""
    found = OutputError(f"cannot write {what}: {error.strerror or error}")
    if error.errno == errno.EPIPE:
        found.exit_code = 141  # as of a program that dies of SIGPIPE
    return found


def open_standard_streams() -> set[str]:
    """Open the null device in place of each standard stream that was closed at the start.

    Otherwise the file that is opened next, a device or a recording, gets its number: libraries
    print into it, and child processes read from it. Python's stream is None in that case.

    :returns: names of the streams that were closed: ``stdin``, ``stdout``, ``stderr``.
    """
    missing = set()
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # takes the lowest number that is free; where there is no null device, none is used
            with contextlib.suppress(OSError):
                os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            missing.add(name)
            mode = "w" if number else "r"
            # not closed with the stream: the number must stay taken until the very end
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
    return missing


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Guard the standard output and error stream; flushes them at the end.

    :raises OutputError: the output cannot be written.
    """
    missing = open_standard_streams()
    before = sys.stdout, sys.stderr
    out = Guard(sys.stdout, "standard output", missing="stdout" in missing)
    sys.stdout = cast(TextIO, out)
    sys.stderr = cast(TextIO, Guard(sys.stderr, "standard error"))
    try:
        try:
            yield
        finally:
            out.finish()
    finally:
        with contextlib.suppress(OutputError):
            sys.stderr.flush()
        sys.stdout, sys.stderr = before
