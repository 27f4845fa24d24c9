"""The requirement catalogues in docs/conformance*.md, one page per layer, and the table of areas in
docs/mutants.md.

Of a requirement that is like another one, only the differences are written.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from pathlib import Path

from dexkit.conformance.mutants import mutants
from dexkit.conformance.requirements import Kind, Level, Requirement, catalogue, renamed
from dexkit.models import BUILT_IN
from tools.generate import DOCS

__all__ = ["PAGES", "area_table", "catalogue_entry", "catalogue_page", "files"]

_BEGIN = "<!-- catalogue: made from conformance/requirements, do not edit -->"
_END = "<!-- end of catalogue -->"
_AREAS = "<!-- areas: made from conformance/requirements, do not edit -->"
_END_AREAS = "<!-- end of areas -->"


_CITED = re.compile(r"docs/(sources/[\w-]+\.md#([a-z][\w-]*))")

PAGES = {
    "dds": "conformance.md",
    "robot": "conformance-robots.md",
    "usb": "conformance-usb.md",
    "client": "conformance-client.md",
}
"""The page of each layer, in docs."""


def catalogue_page(layer: str) -> str:
    """Markdown of a layer's requirements, by area."""
    wrong_hands = mutants(layer)
    lines: list[str] = []
    area = ""
    every = catalogue(layer=layer)
    derived = {r.model for r in every if r.like}  # they come after what they are like
    for requirement in sorted(every, key=lambda r: r.model in derived):
        heading = requirement.area
        if layer == "robot":
            heading = f"{requirement.model.upper()}: {heading}"
        elif layer == "usb":
            heading = heading.removeprefix("USB: ").capitalize()
        if heading != area:
            area = heading
            lines += ["", f"### {area}", ""]
        killers = [m.name for m in wrong_hands if m.kills == requirement.id]
        lines += _entry(requirement, _judged_from(requirement), killers)
    return "\n".join(lines)


_wrong_hands = functools.cache(mutants)


def catalogue_entry(requirement: Requirement, layer: str) -> str:
    """Markdown of one requirement; its citations are seen from docs/."""
    killers = [m.name for m in _wrong_hands(layer) if m.kills == requirement.id]
    return "\n".join(_entry(requirement, _judged_from(requirement), killers))


def _entry(requirement: Requirement, where: str, killers: Iterable[str]) -> list[str]:
    """Lines about one requirement.

    :param where: what it is judged from.
    :param killers: the wrong hands that it catches.
    """
    unit = f", if `{requirement.capability}` is claimed" if requirement.capability else ""
    proof = ", ".join(f"`{name}`" for name in killers)
    kind = f", {requirement.kind}" if requirement.kind is Kind.SAFETY else ""
    lines = [f"**{requirement.id}** ({requirement.level}{kind}{unit}) {requirement.sentence}  "]
    known: set[str] = set()
    if requirement.like:
        lines.append(f"Like {requirement.like}.  ")
        known = _inherited_texts(requirement)
    if requirement.rationale not in known:
        lines.append(f"{requirement.rationale}  ")
    if requirement.expected not in {requirement.sentence} | known:
        lines.append(f"*Expected:* {requirement.expected}.  ")
    if requirement.cause and not {requirement.cause, requirement.advice} <= known:
        lines.append(
            f"*Likely cause of a failure:* {requirement.cause} *Try:* {requirement.advice}  "
        )
    if requirement.original and requirement.original not in known:
        lines.append(f"*The original:* {_linked(requirement.original)}  ")
    source = f"{_linked(requirement.source)} ({requirement.confidence})"
    lines.append(f"*Source:* {source}. *Judged from:* {where}. *Proven by:* {proof}.")
    return [*lines, ""]


def _inherited_texts(requirement: Requirement) -> set[str]:
    """Texts of the requirement that this one is like, with its id replaced by this one's."""
    theirs = next(r for r in catalogue(None, None) if r.id == requirement.like)
    ours, others = (name.partition("-")[0] for name in (requirement.id, theirs.id))
    advice = (theirs.cause, theirs.advice)
    texts = (theirs.rationale, theirs.expected, *advice, theirs.original)
    return {renamed(text, others, ours) for text in texts}


def _linked(text: str) -> str:
    """``text`` with a link for each citation of docs/sources."""

    def link(match: re.Match[str]) -> str:
        target, anchor = match.groups()
        # a letter with a number is a section, all else the name of a fact
        section = re.sub(r"^([a-z])(?=\d)", lambda m: f"{m[1].upper()}.", anchor)
        return f"[{section.upper() if len(anchor) == 1 else section}]({target})"

    return _CITED.sub(link, text)


def _judged_from(requirement: Requirement) -> str:
    if requirement.layer == "usb":
        return f"phase `{requirement.phase}`" if requirement.phase else "the descriptors"
    where = {
        "nothing": "any recording",
        "endpoints": "what discovery saw",
        "state": "any state",
        "commands": "any commanded session",
        "session": "any commanded session",
        "motion": "any motion",
    }.get(requirement.needs)
    if where is None:
        kind, _, name = requirement.needs.partition(":")
        other = " of the other hand" if kind.startswith("other") else ""
        where = f"stimulus `{name}`{other}"
    if len(requirement.dialects) == 3 or requirement.layer == "robot":
        return where
    return f"{where}, in {' and '.join(requirement.dialects)}"


def area_table() -> str:
    """Markdown of the areas that each model has not, of those in which a hand can fail or warn."""
    has = {
        hand.name: dict.fromkeys(
            r.id.split("-")[1] for r in catalogue(hand.name) if r.level is not Level.INFO
        )
        for hand in BUILT_IN
    }
    every = dict.fromkeys(area for areas in has.values() for area in areas)
    lines = ["", "| model | prefix | has not |", "| --- | --- | --- |"]
    for name, areas in has.items():
        prefix = catalogue(name)[0].id.partition("-")[0]
        absent = ", ".join(area for area in every if area not in areas)
        lines.append(f"| {name} | {prefix} | {absent} |")
    return "\n".join([*lines, ""])


def files() -> dict[Path, str]:
    """The pages with their catalogues and tables generated."""
    made = {
        DOCS / name: _filled(name, _BEGIN, catalogue_page(layer), _END)
        for layer, name in PAGES.items()
    }
    return {**made, DOCS / "mutants.md": _filled("mutants.md", _AREAS, area_table(), _END_AREAS)}


def _filled(name: str, begin: str, content: str, end: str) -> str:
    """The text of a page with this content between two lines of it."""
    text = (DOCS / name).read_text(encoding="utf-8")
    head, tail = text[: text.index(begin) + len(begin)], text[text.index(end) :]
    return f"{head}\n{content}\n{tail}"
