"""The commands that the documents show: lines of fenced blocks, as a reader would type them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ROOT", "Shown", "shown_commands"]

ROOT = Path(__file__).resolve().parent.parent
_BLOCK = re.compile(r"(?ms)^( *)```(\w*)\n(.*?)^ *```")
_PROGRAM = re.compile(
    r"(?s)(?:\$ )?(?:sudo )?((?:[A-Z_]+=\S+ )*)(dexkit|pytest|python|make) (?!  )(.*)"
)
_SYNOPSIS = re.compile(r"\[[-A-Z]|\.\.\.|\||\b[A-Z]{2,}[a-z]*\b(?!=)")
"""What only a line that explains a command's options has."""


@dataclass(frozen=True)
class Shown:
    """One command of a document.

    :param block: the line at which its block begins.
    :param words: without redirections, pipes and ``&``.
    :param environment: variables before the command.
    """

    document: str
    block: int
    line: int
    program: str
    words: tuple[str, ...]
    environment: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.document}:{self.line}: {self.program} {shlex.join(self.words)}"


def shown_commands() -> Iterator[Shown]:
    """Every command of README.md and docs/, but no synopses (``[--out DIR]``)."""
    documents = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    for path in documents:
        text = path.read_text(encoding="utf-8")
        for block in _BLOCK.finditer(text):
            if block[2] not in ("", "console"):
                continue
            first = text.count("\n", 0, block.start(3)) + 1
            yield from _of_block(str(path.relative_to(ROOT)), first, block[3])


def _of_block(document: str, first: int, text: str) -> Iterator[Shown]:
    number = first
    for line in re.split(r"(?<!\\)\n", text):
        found = _PROGRAM.match(line.strip())
        if found is not None and not _SYNOPSIS.search(found[3].split("#")[0]):
            words = tuple(_words(found[3].replace("\\\n", " ")))
            yield Shown(document, first, number, found[2], words, tuple(found[1].split()))
        number += 1 + line.count("\n")


def _words(text: str) -> Iterator[str]:
    """The words up to a comment, a redirection, a pipe or ``&``."""
    lexer = shlex.shlex(text, posix=True, punctuation_chars="&|<>;")
    lexer.whitespace_split = True
    for word in lexer:
        if set(word) <= set("&|<>;"):
            return
        yield word
