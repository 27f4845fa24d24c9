"""A page for each requirement, and the list of them.

Of a requirement that is like another one, only the differences are written.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable

from dexkit.conformance.faults import mutants
from dexkit.conformance.kit.requirements import Kind, Level, Requirement, catalogue, renamed
from dexkit.conformance.layers import LAYERS
from dexkit.models import BUILT_IN
from tools.consequences.table import sentence

__all__ = ["REQUIREMENT", "area_table", "pages"]

REQUIREMENT = re.compile(r"\b[A-Z0-9]+(?:-[A-Z]+)+-\d+\b")
"""The id of a requirement."""

_CITED = re.compile(r"docs/(sources/[\w-]+\.md#([a-z][\w-]*))")

_wrong_hands = functools.cache(mutants)


def pages() -> dict[str, str]:
    """Markdown of the list and of each requirement, by its path as seen from docs/."""
    made: dict[str, str] = {}
    index = ["# Requirements", "", "Each has a page of its own, whose address stays.", ""]
    area = ""
    for layer in LAYERS:
        for requirement in catalogue(layer=layer):
            heading = f"{requirement.model}: {requirement.area}"
            if heading != area:
                area = heading
                index += ["", f"## {heading}", ""]
            index.append(f"- {requirement.id} ({requirement.level}) {requirement.title}")
            made[f"requirements/{requirement.id}.md"] = _page(requirement)
    index += ["", "## Areas that a model has not", *area_table()]
    return {"requirements/index.md": "\n".join(index) + "\n", **made}


def _page(requirement: Requirement) -> str:
    killers = [m.name for m in _wrong_hands(requirement.layer) if m.kills == requirement.id]
    lines = [f"# {requirement.id}: {requirement.title}", ""]
    return "\n".join([*lines, *_entry(requirement, _judged_from(requirement), killers)])


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
    if consequence := sentence(requirement.id):
        lines.append(f"*Consequence:* {consequence}  ")
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
        return f"[{section.upper() if len(anchor) == 1 else section}](../{target})"

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
        other = " of the other hand" if requirement.moves_other_side else ""
        where = f"stimulus {' or '.join(f'`{name}`' for name in requirement.phases)}{other}"
    if len(requirement.dialects) == 3 or requirement.layer == "robot":
        return where
    return f"{where}, in {' and '.join(requirement.dialects)}"


def area_table() -> list[str]:
    """Lines of the areas that each model has not, of those in which a hand can fail or warn."""
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
    return lines
