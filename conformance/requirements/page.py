"""The catalogue as a page: ``python -m dexkit.conformance.requirements.page`` brings it up to date
in docs/conformance.md, that of robots in docs/conformance-robots.md. Of what is like another
requirement only the differences are told.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from dexkit.conformance.requirements import Requirement, catalogue, renamed

__all__ = ["BEGIN", "END", "PAGES", "catalogue_page", "entry"]

BEGIN = "<!-- catalogue: made from conformance/requirements, do not edit -->"
END = "<!-- end of catalogue -->"


_CITED = re.compile(r"docs/(sources/[\w-]+\.md#([a-z])([\d-]*))")

PAGES = {"dds": "conformance.md", "robot": "conformance-robots.md"}
"""The page of each layer that is written here, in docs."""


def catalogue_page(layer: str = "dds") -> str:
    """Markdown of a layer's requirements, by area."""
    from dexkit.conformance.mutants import mutants

    lines: list[str] = []
    area = ""
    every = catalogue(layer=layer)
    derived = {r.model for r in every if r.like}  # they come after what they are like
    for requirement in sorted(every, key=lambda r: r.model in derived):
        whose = f"{requirement.model.upper()}: " if layer == "robot" else ""
        if f"{whose}{requirement.area}" != area:
            area = f"{whose}{requirement.area}"
            lines += ["", f"### {area}", ""]
        killers = [m.name for m in mutants() if m.kills == requirement.id]
        lines += entry(requirement, _needs(requirement), killers)
    return "\n".join(lines)


def entry(requirement: Requirement, where: str, killers: Iterable[str]) -> list[str]:
    """Lines about one requirement.

    :param where: what it is judged from.
    :param killers: the wrong hands that it catches.
    """
    unit = f", if `{requirement.capability}` is claimed" if requirement.capability else ""
    proof = ", ".join(f"`{name}`" for name in killers)
    lines = [f"**{requirement.id}** ({requirement.level}{unit}) {requirement.sentence}  "]
    known: set[str] = set()
    if requirement.like:
        lines.append(f"Like {requirement.like}.  ")
        known = _told_of(requirement)
    if requirement.rationale not in known:
        lines.append(f"{requirement.rationale}  ")
    if requirement.expected not in {requirement.sentence} | known:
        lines.append(f"*Expected:* {requirement.expected}.  ")
    if requirement.cause and not {requirement.cause, requirement.advice} <= known:
        lines.append(
            f"*Likely cause of a failure:* {requirement.cause} *Try:* {requirement.advice}  "
        )
    lines.append(
        f"*Source:* {_source(requirement)} ({requirement.confidence}). *Judged from:* {where}. "
        f"*Proven by:* {proof}."
    )
    return [*lines, ""]


def _told_of(requirement: Requirement) -> set[str]:
    """What is told of the requirement that this one is like, in this one's names."""
    theirs = next(r for r in catalogue(None, None) if r.id == requirement.like)
    ours, others = (name.partition("-")[0] for name in (requirement.id, theirs.id))
    texts = (theirs.rationale, theirs.expected, theirs.cause, theirs.advice)
    return {renamed(text, others, ours) for text in texts}


def _source(requirement: Requirement) -> str:
    """Who says so, with a link for each citation of docs/sources."""

    def link(match: re.Match[str]) -> str:
        target, letter, number = match.groups()
        return f"[{letter.upper()}{'.' if number else ''}{number}]({target})"

    return _CITED.sub(link, requirement.source)


def _needs(requirement: Requirement) -> str:
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


def main() -> None:
    """Write it into the documentation."""
    for layer, name in PAGES.items():
        path = Path(__file__).resolve().parents[2] / "docs" / name
        text = path.read_text(encoding="utf-8")
        head, tail = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
        path.write_text(f"{head}\n{catalogue_page(layer)}\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
