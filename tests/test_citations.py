"""Citations of docs/sources and relative links between the docs resolve."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "docs" / "sources"

CITATION = re.compile(r"(docs/[\w./-]+\.md)#([\w-]+)")
CODE = re.compile(r"(?ms)^```.*?^```$|`[^`\n]+`")
LINK = re.compile(r"(?<!!)\[[^]]*\]\(<?([^)\s>]+)>?\)|!\[[^]]*\]\(([^)\s]+)\)")


@cache
def texts() -> dict[str, str]:
    """Every text file that belongs to the repository, by its name there."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    ).stdout
    found: dict[str, str] = {}
    for name in listed.split("\0"):
        path = ROOT / name
        if name and path.is_file() and not path.is_symlink() and path != Path(__file__).resolve():
            try:
                found[name] = path.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                continue
    return found


@cache
def anchors(path: Path) -> frozenset[str]:
    """Ids of a page: those given, and those that GitHub makes of headings."""
    text = path.read_text(encoding="utf-8")
    found = set(re.findall(r'<a (?:id|name)="([^"]+)"', text))
    times: dict[str, int] = {}
    for heading in re.findall(r"(?m)^#{1,6} +(.+?) *#*$", re.sub(r"(?ms)^```.*?^```$", "", text)):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)|<[^>]+>", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        number = times.get(slug, 0)
        times[slug] = number + 1
        found.add(f"{slug}-{number}" if number else slug)
    return frozenset(found)


def unresolved(page: Path, anchor: str) -> bool:
    return not page.is_file() or anchor not in anchors(page)


def places(pattern: re.Pattern[str], text: str) -> Iterator[tuple[int, re.Match[str]]]:
    for match in pattern.finditer(text):
        yield text.count("\n", 0, match.start()) + 1, match


def test_every_citation_resolves_to_a_section() -> None:
    seen, lost = 0, []
    for name, text in texts().items():
        for line, match in places(CITATION, text):
            seen += 1
            if unresolved(ROOT / match.group(1), match.group(2)):
                lost.append(f"{name}:{line}: {match.group()}")
    assert not lost, "\n".join(lost)
    assert seen > 300


def test_pages_that_code_names_are_there() -> None:
    """Messages and docstrings send readers to pages of docs/."""
    named = {
        (name, match.group())
        for name, text in texts().items()
        if name.endswith(".py") and not name.startswith("tests/")
        for _, match in places(re.compile(r"(?<![\w/])docs/[\w./-]+\.md\b"), text)
    }
    assert len(named) > 100
    assert not {(name, page) for name, page in named if not (ROOT / page).is_file()}


def test_every_relative_link_resolves() -> None:
    lost = []
    for name, text in texts().items():
        if not name.endswith(".md"):
            continue
        page = ROOT / name
        for line, match in places(LINK, CODE.sub(lambda m: "\n" * m.group().count("\n"), text)):
            target, _, anchor = unquote(match.group(1) or match.group(2)).partition("#")
            if re.match(r"[a-z]+:", target):
                continue
            there = (page.parent / target).resolve() if target else page
            missing = anchor not in anchors(there) if anchor and there.suffix == ".md" else False
            if not there.exists() or missing:
                lost.append(f"{name}:{line}: {match.group()}")
    assert not lost, "\n".join(lost)
