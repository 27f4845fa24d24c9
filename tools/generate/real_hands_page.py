"""docs/sources/real-hands.md: what dexkit takes for granted about hands, and what real ones show.

The facts are in real_hands.toml beside this module, which says how a row is written. bases.md
counts from the requirement files what carries each MUST, and what real hands say.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from dexkit import documents
from dexkit.conformance.kit.requirements import Level, Requirement, catalogue
from dexkit.errors import UsageError
from tools.generate import DOCS

__all__ = [
    "TABLE",
    "VERDICTS",
    "Fact",
    "Hand",
    "Source",
    "bases",
    "basis",
    "files",
    "read",
    "verdicts",
]

TABLE = Path(__file__).with_name("real_hands.toml")
PAGE = DOCS / "sources" / "real-hands.md"

VERDICTS = ("contradicts", "disputed", "no evidence", "agrees")
"""The worst first: a requirement on several facts has the worst of their verdicts."""

BASES = ("vendor's code", "genuine client", "vendor's document", "vendor's software", "inference")
"""What carries a requirement. None is a hand: the project has none."""

_CLIENT = re.compile(r"xr_teleoperate|lerobot|genuine client", re.IGNORECASE)
_SERVICE = re.compile(r"_service|inspire_hand_ws|unitree_sdk2|unitree_sim_isaaclab|unitree_ros")
_LAYERS = {"usb": " on USB", "client": ", clients"}


@dataclass(frozen=True)
class Source:
    """What a fact was compared with: ``kind`` is hand, document or code."""

    text: str
    address: str
    revision: str
    kind: str


@dataclass(frozen=True)
class Fact:
    """One fact: what dexkit takes for granted, what real hands show, and what rests on it."""

    anchor: str
    name: str
    assumes: str
    where: tuple[str, ...]
    shows: str
    sources: tuple[str, ...]
    verdict: str
    requirements: tuple[str, ...]


@dataclass(frozen=True)
class Hand:
    """The facts of a hand, or of what is around it."""

    id: str
    title: str
    facts: tuple[Fact, ...]


@cache
def read(path: Path = TABLE) -> tuple[dict[str, Source], tuple[Hand, ...]]:
    """The sources by key, and the hands.

    :raises UsageError: the file is no such table.
    """
    content = documents.parse_toml(path.read_text(encoding="utf-8"), path)
    try:
        sources = {key: Source(*entry) for key, entry in content["source"].items()}
        hands = tuple(
            Hand(
                entry["id"],
                entry["title"],
                tuple(
                    Fact(
                        anchor,
                        name,
                        assumes,
                        tuple(where),
                        shows,
                        tuple(seen),
                        verdict,
                        tuple(rests),
                    )
                    for anchor, name, assumes, where, shows, seen, verdict, rests in entry["rows"]
                ),
            )
            for entry in content["hand"]
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: {error!r} is not a table of facts") from error
    return sources, hands


def basis(requirement: Requirement) -> str:
    """What carries a requirement: one of :data:`BASES`.

    The catalogue's `vendor code` is split by the programs that its source names: code of the
    vendor's service, SDK or model, or only that of a client.
    """
    match requirement.confidence:
        case "vendor document":
            return "vendor's document"
        case "measured":
            return "vendor's software"
        case "vendor code":
            only_client = _CLIENT.search(requirement.source) and not _SERVICE.search(
                requirement.source
            )
            return "genuine client" if only_client else "vendor's code"
        case _:
            return "inference"


@cache
def verdicts() -> dict[str, str]:
    """The worst verdict on each requirement that a fact names, by its id."""
    found: dict[str, str] = {}
    for hand in read()[1]:
        for fact in hand.facts:
            for requirement in fact.requirements:
                found[requirement] = min(
                    fact.verdict, found.get(requirement, VERDICTS[-1]), key=VERDICTS.index
                )
    return found


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _place(reference: str) -> str:
    page, _, anchor = reference.partition("#")
    if page.startswith("docs/sources/"):
        name = page.removeprefix("docs/sources/")
        number = f"{anchor[:1].upper()}.{anchor[1:]}"
        return f"{name.removesuffix('.md')} [{number}]({name}#{anchor})"
    if page.startswith("docs/"):
        return f"[{page.removeprefix('docs/').removesuffix('.md')}](../{page[len('docs/') :]})"
    return f"[`{page}`](../../{page})"


def _facts(hand: Hand, numbers: dict[str, int]) -> list[str]:
    lines = [
        f'<a id="{hand.id}"></a>',
        "",
        f"## {hand.title}",
        "",
        "| fact | dexkit takes for granted | real hands show | verdict | rests on it |",
        "| --- | --- | --- | --- | --- |",
    ]
    for fact in hand.facts:
        seen = "".join(f" [[{numbers[key]}]](#source-{numbers[key]})" for key in fact.sources)
        verdict = f"**{fact.verdict}**" if fact.verdict == "contradicts" else fact.verdict
        lines.append(
            f'| <a id="{fact.anchor}"></a>{_cell(fact.name)}'
            f" | {_cell(fact.assumes)} ({', '.join(map(_place, fact.where))})"
            f" | {_cell(fact.shows)}{seen} | {verdict}"
            f" | {', '.join(fact.requirements) or '-'} |"
        )
    return [*lines, ""]


def _count_rows(requirements: Iterable[Requirement]) -> list[str]:
    must = [r for r in requirements if r.level is Level.MUST]
    groups = dict.fromkeys((r.model, r.layer) for r in must)
    lines = []
    for model, layer in [*groups, ("", "")]:
        own = [r for r in must if not model or (r.model, r.layer) == (model, layer)]
        carried = Counter(map(basis, own))
        judged = Counter(verdicts().get(r.id, "") for r in own)
        figures = [
            len(own),
            *(carried[name] for name in BASES),
            *(judged[name] for name in VERDICTS),
            judged[""],
        ]
        name = model + _LAYERS.get(layer, "") if model else "all"
        lines.append(f"| {name} | {' | '.join(map(str, figures))} |")
    return lines


def page() -> str:
    """The Markdown of docs/sources/real-hands.md."""
    sources, hands = read()
    numbers = {key: number for number, key in enumerate(sources, 1)}
    lines = [
        "# Sources: what real hands show",
        "",
        "No real hand was used to make dexkit. So each fact about one that no test of dexkit can"
        " settle has a",
        "row here, beside what public programs, data sets and recordings of real hands show. The"
        " figures are",
        "theirs, or were calculated from their files.",
        "",
        "Made from `tools/generate/real_hands.toml` by `make docs`; do not edit this page.",
        "",
        "| verdict | meaning |",
        "| --- | --- |",
        "| agrees | a recording, measurement or calibration of a real hand fits |",
        "| **contradicts** | one does not: one hand is enough |",
        "| disputed | reports of real hands differ |",
        "| no evidence | none was found: the fact rests on documents, on code, or on inference |",
        "",
    ]
    for hand in hands:
        lines += _facts(hand, numbers)
    lines += [
        '<a id="sources"></a>',
        "",
        "## What was read",
        "",
        "A *hand* is a recording, a measurement or a calibration of one, or a program that its"
        " authors run on one.",
        "",
        "| | source | revision, date | kind |",
        "| --- | --- | --- | --- |",
    ]
    for key, source in sources.items():
        text = _cell(source.text)
        link = f"[{text}]({source.address})" if source.address else text
        lines.append(
            f'| <a id="source-{numbers[key]}"></a>{numbers[key]} | {link}'
            f" | {source.revision} | {source.kind} |"
        )
    lines.append("")
    return "\n".join(lines)


def bases() -> str:
    """The Markdown of bases.md: what carries the MUSTs of each model, and what hands say."""
    lines = [
        "# What the requirements rest on",
        "",
        "What carries each MUST, by its `confidence` and `source`; and the worst that the facts"
        " about [real hands](sources/real-hands.md) say about it. *Vendor's software* was run and"
        " measured; a *genuine client* is a program that drives real hands. *No row*: no fact about"
        " a hand is needed for it, or it has not been looked at. No MUST rests on a hand that this"
        " project measured.",
        "",
        "| catalogue | MUST | " + " | ".join((*BASES, *VERDICTS)) + " | no row |",
        "| --- | --- |" + " --- |" * (len(BASES) + len(VERDICTS) + 1),
        *_count_rows(catalogue(None, None)),
        "",
        "## Facts about real hands",
        "",
        "| hand | facts | " + " | ".join(VERDICTS) + " |",
        "| --- | --- |" + " --- |" * len(VERDICTS),
    ]
    hands = read()[1]
    facts = [fact for hand in hands for fact in hand.facts]
    for title, own in [*((hand.title, hand.facts) for hand in hands), ("all", facts)]:
        counted = Counter(fact.verdict for fact in own)
        figures = " | ".join(str(counted[verdict]) for verdict in VERDICTS)
        lines.append(f"| {title} | {len(own)} | {figures} |")
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The page by its path."""
    return {PAGE: page()}
