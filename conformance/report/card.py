"""The card of a requirement: its results with cause, evidence and advice.

Built once from the results of one requirement, and drawn as HTML, for a terminal, as Markdown and
as plain text (JUnit, pytest).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

from dexkit.conformance.kit.requirements import Kind, Requirement
from dexkit.conformance.kit.results import (
    Evidence,
    Result,
    RunResult,
    Story,
    Verdict,
    grouped,
    worst,
)
from dexkit.escaping import REMARK, one_line

__all__ = [
    "Blocked",
    "Card",
    "Fact",
    "Item",
    "Told",
    "blocked_groups",
    "cards",
    "near_limits",
    "told",
    "what_is_wrong",
]


class Item(str, Enum):
    """The kind of a card's line; the value is its label on a terminal."""

    REQUIRED = "required"
    EXPECTED = "expected"
    ORIGINAL = "original"
    OBSERVED = "observed"
    MEASURED = "measured"
    REASON = "reason"
    WHERE = "where"
    CAUSE = "cause"
    USUALLY = "usually"
    TRY = "try"
    SOURCE = "source"

    def __str__(self) -> str:
        return self.value

    @property
    def label(self) -> str:
        """Its label on a page, of up to two words."""
        labels = {
            Item.ORIGINAL: "the original",
            Item.USUALLY: "usual cause",
            Item.TRY: "what to try",
        }
        return labels.get(self, self.value)


@dataclass(frozen=True)
class Fact:
    """One line of a card.

    :param sides: the sides that it is true for, if not all of the card's; else empty.
    :param place: of :attr:`Item.WHERE`, the place in the recording that ``text`` describes.
    """

    item: Item
    text: str
    sides: str = ""
    place: Evidence | None = None


@dataclass(frozen=True)
class Card:
    """The results of one requirement.

    :param results: of the sides that the card is about, one or more.
    """

    results: tuple[Result, ...]

    @classmethod
    def from_results(cls, results: Sequence[Result]) -> Card:
        """The card of these results of one requirement."""
        return cls(tuple(results))

    @property
    def requirement(self) -> Requirement:
        """The requirement."""
        return self.results[0].requirement

    @property
    def verdict(self) -> Verdict:
        """The verdict of all sides together."""
        return worst(r.verdict for r in self.results)

    @property
    def sides(self) -> str:
        """``left and right``, or ``client, left and right`` of a requirement about the client."""
        names = " and ".join(r.side for r in self.results)
        return f"client, {names}" if self.requirement.about_client else names

    @property
    def expected(self) -> str:
        """The expected result, where that is shorter than the sentence; else empty."""
        text = self.results[0].expected
        return "" if text == self.requirement.sentence else text

    @property
    def causes(self) -> list[tuple[str, str]]:
        """(sides, cause), one entry for each cause that a check determined."""
        found: dict[str, list[str]] = {}
        for result in self.results:
            if result.cause:
                found.setdefault(result.cause, []).append(result.side)
        return [(", ".join(sides), cause) for cause, sides in found.items()]

    @property
    def figures(self) -> str:
        """What was measured where it is not met, in a few characters."""
        shown = [r.figure for r in self.results if r.verdict is self.verdict and r.figure]
        return ", ".join(dict.fromkeys(shown))

    @property
    def source(self) -> str:
        """The source of the requirement, and its confidence."""
        return f"{self.requirement.source} (confidence: {self.requirement.confidence})"

    def facts(self) -> Iterator[Fact]:
        """All lines of the card, in order; a fact of all sides appears once."""
        need = self.requirement
        kind = f", {need.kind}" if need.kind is Kind.SAFETY else ""
        yield Fact(Item.REQUIRED, f"{need.sentence} ({need.level}{kind})")
        if self.expected:
            yield Fact(Item.EXPECTED, self.expected)
        if need.original:
            yield Fact(Item.ORIGINAL, need.original)
        for result in self.results:
            yield from self.findings(result)
        causes = self.causes
        for sides, cause in causes:
            yield Fact(Item.CAUSE, cause, sides if len(causes) > 1 else "")
        if self.verdict in (Verdict.FAIL, Verdict.WARN) and not causes and need.cause:
            yield Fact(Item.USUALLY, need.cause)
        if any(r.retry for r in self.results):
            yield Fact(Item.TRY, "Run it again on a machine that does nothing else.")
        blocked_by_load = any(
            r.verdict is Verdict.BLOCKED and not r.blocked_by for r in self.results
        )
        if self.verdict in (Verdict.FAIL, Verdict.WARN) or blocked_by_load:
            yield Fact(Item.TRY, self.requirement.advice)
            yield Fact(Item.SOURCE, self.source)

    def findings(self, result: Result) -> Iterator[Fact]:
        """The lines about one of the results: what was seen, and where."""
        side = result.side if len(self.results) > 1 else ""
        if result.observed:
            yield Fact(Item.OBSERVED, result.observed, side)
        if result.measured:
            yield Fact(Item.MEASURED, result.measured, side)
        if result.reason:
            yield Fact(Item.REASON, result.reason, side)
        for place in result.evidence:
            yield Fact(Item.WHERE, _described(place), side, place)

    def as_text(self) -> str:
        """The card as lines of plain text."""
        need = self.requirement
        lines = [f"{need.id} ({need.level}) {self.sides}: {self.verdict}"]
        for fact in self.facts():
            side = f"{fact.sides}: " if fact.sides else ""
            label = f"{fact.item}:"
            lines.append(f"  {label:<9} {one_line(side + fact.text, REMARK)}")
        return "\n".join(lines)


def _described(place: Evidence) -> str:
    until = f" to {place.end_s:.3f} s" if place.end_s is not None else ""
    return f"{one_line(place.topic)} at {place.time_s:.3f} s{until}"


def cards(result: RunResult, verdicts: Sequence[Verdict]) -> list[Card]:
    """A card for each requirement with one of ``verdicts`` that no other requirement blocked, about
    the hands or their client. What follows from another failure has none: :func:`told` lists it.

    In the order of ``verdicts``; among equals, the one that blocks most others comes first.
    """
    follow = {name for story in result.stories for name in story.explains} - {
        story.shown_by for story in result.stories
    }
    blocks = Counter(r.blocked_by for r in result.results)
    found = [
        Card.from_results(group)
        for _, every in [*result.by_requirement(), *grouped(result.client)]
        if (group := [r for r in every if r.verdict in verdicts and not r.blocked_by])
        and group[0].id not in follow
    ]
    return sorted(
        found, key=lambda card: (verdicts.index(card.verdict), -blocks[card.requirement.id])
    )


@dataclass(frozen=True)
class Told:
    """A story with the cards of what it explains.

    :param own: the card of the requirement that shows it; None for what the states show.
    :param also: the cards of the requirements that follow from it.
    """

    story: Story
    own: Card | None
    also: tuple[Card, ...]

    @property
    def seen(self) -> str:
        """How the others are introduced: what a trial has shown, or may be."""
        follow = "because of it" if self.own is None else "and may follow from it"
        return f"also seen {follow}"

    @property
    def whose(self) -> str:
        """Sides, requirement and first place, in brackets behind the sentence."""
        parts = [" and ".join(self.story.sides)]
        if self.own is not None:
            parts.append(self.own.requirement.id)
        if self.story.evidence:
            parts.append(f"first at {self.story.evidence[0].time_s:.2f} s")
        return ", ".join(parts)


def told(result: RunResult) -> list[Told]:
    """The stories of a run, the likeliest first."""
    of = {need.id: Card.from_results(group) for need, group in result.by_requirement()}
    return [
        Told(
            story,
            of.get(story.shown_by),
            tuple(of[name] for name in story.explains if name in of and name != story.shown_by),
        )
        for story in result.stories
    ]


def what_is_wrong(result: RunResult) -> str:
    """The heading of the stories: what only warns is not wrong."""
    failed = any(r.verdict is Verdict.FAIL for r in result.results)
    return "What is wrong" if failed else "What is not as recommended"


def near_limits(result: RunResult) -> list[str]:
    """A sentence for each pass that the kit's measurement error leaves in doubt."""
    return [
        f"{r.requirement.id} {r.side}: {r.measure.sentence()}"
        for r in [*result.results, *result.client]
        if r.verdict is Verdict.PASS and r.measure is not None and r.measure.uncertain
    ]


@dataclass(frozen=True)
class Blocked:
    """Requirements that could not be judged for the same reason.

    :param before: id of the requirement that failed first; empty where the load of the machine
        is the reason.
    """

    reason: str
    before: str
    cards: tuple[Card, ...]


def blocked_groups(results: Iterable[Result]) -> list[Blocked]:
    """Blocked requirements, grouped by reason."""
    found: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for result in results:
        if result.verdict is Verdict.BLOCKED:
            group = found.setdefault((result.reason, result.blocked_by), {})
            group.setdefault(result.requirement.id, []).append(result)
    return [
        Blocked(reason, before, tuple(Card.from_results(group) for group in groups.values()))
        for (reason, before), groups in found.items()
    ]
