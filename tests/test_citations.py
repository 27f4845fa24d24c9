"""Citations of docs/sources and relative links between the docs resolve."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote

from dexkit.conformance.kit.requirements import catalogue
from tests.each import each

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "docs" / "sources"

CITATION = re.compile(r"(docs/[\w./-]+\.md)#([\w-]+)")
INTERNAL = re.compile(
    r"\bfacts/|\bfacts (?:[A-G]\b|\w+ [A-G]\.?\d)|\bfact sheet"  # what only the authors could read
    r"|\bseed \d{3}\b|\bS00\d\b"
    r"|(?<![\w[.#-])[A-G]\.\d{1,2}\b(?![.\d])"  # a section without its page
    r"|\bF [A-G]\b(?! [A-G0-9]{1,2}\b)|\bD \d{1,2}\b|\((?:D10 \d+|[A-F]\d{1,2})[):;,]"
)
"""Fact sheets, numbered documents and bare section codes: of no use to anyone outside."""
LIKELY = re.compile(r"[fsSA-G(](?:acts?[ /]|act sheet|eed \d|00\d|\.\d| [A-G\d]|D10 \d|[A-F]\d)")
"""What any of these has, without looking behind: found in a twentieth of the time."""

PROSE = (".py", ".toml", ".md", ".idl", ".c", ".h", ".sh", ".yml", ".yaml", ".html", "Makefile")
MESSAGES = re.compile(r"@final struct \w+ \{.*")  # IDL in tests, whose struct is called F
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


def test_no_citation_names_an_internal_document() -> None:
    found = []
    for name, text in texts().items():
        if name.startswith("docs/sources/") or not name.endswith(PROSE):
            continue
        for number, line in enumerate(text.split("\n"), 1):
            if LIKELY.search(line) and (match := INTERNAL.search(MESSAGES.sub("", line))):
                found.append(f"{name}:{number}: {match.group()}")
    assert not found, "\n".join(found)


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


def test_anchors_are_unique() -> None:
    for path in SOURCES.glob("*.md"):
        ids = re.findall(r'<a id="([^"]+)"', path.read_text(encoding="utf-8"))
        assert len(ids) == len(set(ids)), path.name


def test_every_source_of_the_catalogue_has_text() -> None:
    """A citation alone means nothing to a vendor: who says so stands beside it."""
    for requirement in catalogue(None, None):
        assert re.search(r"[A-Za-z]{3,}", CITATION.sub("", requirement.source)), requirement.id


@each(
    "text",
    [
        "(facts/unitree-dex B.1)", "facts/mx64 D2", "# F A.5", "seed 002", "(facts G)", "(D5)",
        "(B.7)", "the fact sheet", "facts, Unitree D 17", "S002",
    ],
)  # fmt: skip
def test_internal_names_are_found(text: str) -> None:
    assert INTERNAL.search(text)


@each(
    "text",
    ["docs/sources/unitree-dex.md#b1", "[B.1](sources/unitree-dex.md#b1)", "FE 0D 1F [D 2]"[:8],
     "the facts are these", "--seed 7", "F 2.5"],
)  # fmt: skip
def test_other_names_are_not_reported_as_internal(text: str) -> None:
    assert not INTERNAL.search(text)
