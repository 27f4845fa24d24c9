"""conformity.md: what dexkit does about each statement of the documents it was built for.

The statements are in conformity.toml beside this module, which says how a row is written.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from dexkit import documents
from dexkit.conformance.kit.requirements import catalogue
from dexkit.errors import UsageError
from tools.generate import ROOT
from tools.generate.requirement_pages import REQUIREMENT

__all__ = ["STATUSES", "TABLE", "Document", "Row", "Section", "page", "read", "reference_error"]

TABLE = Path(__file__).with_name("conformity.toml")
STATUSES = ("done", "otherwise", "open", "fact")


@dataclass(frozen=True)
class Row:
    """One statement: its status, what dexkit does, and where that can be seen."""

    says: str
    status: str
    does: str
    where: tuple[str, ...]


@dataclass(frozen=True)
class Section:
    """A section of a document."""

    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Document:
    """A document, by its own title."""

    id: str
    title: str
    about: str
    sections: tuple[Section, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All statements in their order."""
        return tuple(row for section in self.sections for row in section.rows)


@cache
def read(path: Path = TABLE) -> tuple[Document, ...]:
    """The documents of the table.

    :raises UsageError: the file is no such table.
    """
    content = documents.parse_toml(path.read_text(encoding="utf-8"), path)
    try:
        return tuple(
            Document(
                entry["id"],
                entry["title"],
                entry["about"],
                tuple(
                    Section(
                        section["title"],
                        tuple(
                            Row(says, status, does, tuple(where))
                            for says, status, does, where in section["rows"]
                        ),
                    )
                    for section in entry["section"]
                ),
            )
            for entry in content["document"]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: {error!r} is not a table of statements") from error


def reference_error(reference: str) -> str | None:
    """Why ``reference`` leads nowhere; None if it does not. Anchors of pages are not looked up."""
    if REQUIREMENT.fullmatch(reference):
        return None if reference in _requirements() else "there is no such requirement"
    path, _, name = reference.partition("#")[0].partition("::")
    if not (ROOT / path).exists():
        return "there is no such file"
    if not name:
        return None
    text = (ROOT / path).read_text(encoding="utf-8")
    # a definition: of a test, class, function or constant
    constant = rf"[\w, ]*\b{name}\b[\w, ]*(?::[^=\n]+)? = "
    defined = rf"(?m)^\s*(?:(?:async )?def {name}\(|class {name}\b|{constant})"
    return None if re.search(defined, text) else f"{path} does not define {name}"


@cache
def _requirements() -> frozenset[str]:
    return frozenset(r.id for r in catalogue(None, None))


def _link(reference: str) -> str:
    if REQUIREMENT.fullmatch(reference):
        return reference
    target, _, name = reference.partition("::")
    page, _, anchor = target.partition("#")
    if page.startswith("docs/"):
        short = page.removeprefix("docs/").removesuffix(".md")
        text = f"{short}, {anchor.replace('-', ' ')}" if anchor else short
        link = target.removeprefix("docs/")
        if short.startswith("sources/") and short != "sources/README":
            number = f"{anchor[:1].upper()}.{anchor[1:]}".removesuffix(".")
            return f"{short.removeprefix('sources/')} [{number}]({link})"
        return f"[{text}]({link})"
    return f"[{f'`{name}`' if name else f'`{target}`'}](../{target})"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def page() -> str:
    """The Markdown of the page, in docs/."""
    every = read()
    lines = [
        "# Conformity with the user's documents",
        "",
        "dexkit was built for the owner of an EZGripper who uses it in the place of a Dex1-1, and"
        " of robots",
        "with Dex3-1 hands. Four documents say how. This page has a row for every statement in"
        " them: what",
        "dexkit does, where it can be seen, and, where it does something else, why. Choices that"
        " concern more",
        "than one statement are in the [decisions](decisions.md); who wrote what is in the"
        " [sources](sources/README.md).",
        "",
        "Made from `tools/generate/conformity.toml`.",
        "",
        "| status | meaning |",
        "| --- | --- |",
        "| done | dexkit does it |",
        "| **otherwise** | dexkit does something else, for the reason given |",
        "| **open** | not done, or not known |",
        "| fact | asks nothing of the software |",
        "",
        "| document | statements | " + " | ".join(STATUSES) + " |",
        "| --- | --- |" + " --- |" * len(STATUSES),
    ]
    for document in every:
        counts = Counter(row.status for row in document.rows)
        figures = " | ".join(str(counts[status]) for status in STATUSES)
        lines.append(
            f"| [{_cell(document.title)}](#{document.id}) | {len(document.rows)} | {figures} |"
        )
    lines += ["", "No real hand, gripper or robot was used for any row.", ""]
    for document in every:
        lines += [f'<a id="{document.id}"></a>', "", f"## {document.title}", "", document.about]
        for section in document.sections:
            lines += ["", f"### {section.title}", ""]
            lines += ["| statement | status | dexkit | where |", "| --- | --- | --- | --- |"]
            for row in section.rows:
                status = row.status if row.status in ("done", "fact") else f"**{row.status}**"
                where = "<br>".join(_link(reference) for reference in row.where)
                lines.append(f"| {_cell(row.says)} | {status} | {_cell(row.does)} | {where} |")
        lines.append("")
    return "\n".join(lines)
