"""Render a result as Markdown: a step summary or comment on GitHub, or a wiki page.

External text is escaped: a hostile name cannot make HTML, table cells or mentions of a person.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Result, RunResult, Verdict, grouped, worst
from dexkit.conformance.report.card import Card, Fact, blocked_groups, cards, near_limits, told
from dexkit.conformance.report.labels import (
    ANSWERS,
    VERDICTS,
    about_harness,
    answer_of,
    catch_sentence,
    device_kind,
    hand_name,
    model_title,
    part,
    whose,
)
from dexkit.escaping import REMARK, one_line

__all__ = ["code", "plain", "render_markdown", "table"]

MOST_CARDS = 25
"""Cards at most: a comment on GitHub holds 65536 characters."""
_SPECIAL = re.compile(r"([\\`*_\[\]|~#])")
_NOTHING = "&#8203;"
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN)


def plain(text: str) -> str:
    """Escape ``text`` for Markdown, in one line."""
    text = one_line(" ".join(text.split()), REMARK)
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # a zero-width space prevents mentions by @ and links from addresses
    return _SPECIAL.sub(r"\\\1", text).replace("@", f"@{_NOTHING}").replace("://", f":{_NOTHING}//")


def code(text: str) -> str:
    """``text`` as code; a grave accent in it would end it."""
    return f"`{one_line(' '.join(text.split())).replace('`', chr(39)).replace('|', '/')}`"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; the cells are Markdown already."""
    return [
        f"| {' | '.join(heads)} |",
        f"|{'|'.join([' --- '] * len(heads))}|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def render_markdown(result: RunResult) -> str:
    """The summary: verdict, the two grades, areas, failures, and all requirements folded."""
    answer = ANSWERS[result.overall]
    real = device_kind(result)
    counts = ", ".join(f"{n} {VERDICTS[v].text}" for v, n in result.counts().items() if n)
    lines = [
        f"## {answer.mark} {answer.text}: {plain(hand_name(result))} as {model_title(result)}",
        "",
        f"{counts or 'nothing was judged'}."
        + (f" The hand was **{real}**." if real in ("emulated", "simulated") else "")
        + (" A recording was judged, not a live hand." if real == "recorded" else ""),
        "",
    ]
    kinds = () if result.client_only else tuple(Kind)
    grades = [(answer_of(grade), grade) for grade in map(result.grade, kinds)]
    lines += [f"- {word.mark} **{plain(grade.sentence())}**" for word, grade in grades]
    lines.append("")
    if of := part(result):
        lines += [f"**{of}: this does not prove a drop-in.**", ""]
    lines += [
        f"- {plain(whose(side))} reached: **{stage}**" for side, stage in result.stage.items()
    ]
    if harness := about_harness(result):
        lines.append(f"- test machine: {harness}")
    lines += ["", plain(catch_sentence(result))]
    lines += ["", *_areas(result), ""]
    lines += _stories(result)
    lines += _troubles(result)
    lines += _folded("Every requirement", _every(result.results)) if result.results else []
    if result.client:
        lines += [f"**{plain(_capital(result.client_sentence()))}**", ""]
        lines += _folded("Every requirement about the client", _every(result.client))
    about = ", ".join(f"{plain(k)} {plain(v)}" for k, v in result.environment.items())
    if digest := result.subject.get("recording_sha256"):
        about += f"; SHA-256 of the recording {plain(digest)}"
    lines.append(f"<sub>{plain(result.recorded_at)}, {result.duration_s:.1f} s; {about}</sub>")
    return "\n".join(lines) + "\n"


def _areas(result: RunResult) -> list[str]:
    groups: dict[str, list[Verdict]] = {}
    for requirement, group in result.by_requirement():
        groups.setdefault(requirement.area, []).append(worst(r.verdict for r in group))
    shown = [v for v in Verdict if any(v in verdicts for verdicts in groups.values())]
    rows = [
        [plain(area), *(str(verdicts.count(v) or "") for v in shown)]
        for area, verdicts in groups.items()
    ]
    return table(["area", *(VERDICTS[v].text for v in shown)], rows) if groups else []


def _stories(result: RunResult) -> list[str]:
    lines = []
    for number, each in enumerate(told(result)[:MOST_CARDS], 1):
        lines.append(f"{number}. **{plain(each.story.sentence)}** ({plain(each.whose)})")
        if each.also:
            names = ", ".join(code(card.requirement.id) for card in each.also)
            lines.append(f"   also seen because of it: {names}")
    return ["### What is wrong", "", *lines, ""] if lines else []


def _troubles(result: RunResult) -> list[str]:
    found = cards(result, _TROUBLE)
    lines: list[str] = []
    for card in found[:MOST_CARDS]:
        lines += _card(card)
    if len(found) > MOST_CARDS:
        lines += [f"... and {len(found) - MOST_CARDS} more.", ""]
    mark = VERDICTS[Verdict.BLOCKED].mark
    for blocked in blocked_groups(result.results):
        names = ", ".join(code(card.requirement.id) for card in blocked.cards)
        lines += [f"{mark} {plain(blocked.reason)}: {names}", ""]
    for text in near_limits(result):
        lines += [f"- {plain(text)}", ""]
    return lines


def _card(card: Card) -> list[str]:
    need, word = card.requirement, VERDICTS[card.verdict]
    lines = [f"### {word.mark} {code(need.id)} {plain(need.title)} ({plain(card.sides)})", ""]
    placed: set[str] = set()
    for fact in card.facts():
        if fact.place is not None and fact.sides in placed:
            continue  # of several places, the first one of each side
        placed |= {fact.sides} if fact.place is not None else set()
        side = f", {plain(fact.sides)}" if fact.sides else ""
        lines.append(f"- {fact.item.label}{side}: {_text(fact)}")
    return [*lines, ""]


def _text(fact: Fact) -> str:
    place = fact.place
    if place is None:
        return plain(fact.text)
    until = f" to {place.end_s:.3f} s" if place.end_s is not None else ""
    when = f"at {place.time_s:.3f} s{until}, log time `{place.log_time_ns}`"
    return f"{code(place.topic)} {when}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _every(results: Sequence[Result]) -> list[str]:
    sides = list(dict.fromkeys(r.side for r in results))
    rows = []
    for need, group in grouped(results):
        cells = {
            r.side: f"{VERDICTS[r.verdict].mark} {plain(r.figure or VERDICTS[r.verdict].text)}"
            for r in group
        }
        rows.append(
            [code(need.id), str(need.level), plain(need.title), *(cells.get(s, "") for s in sides)]
        )
    return table(["requirement", "level", "what", *(plain(s) for s in sides)], rows)


def _folded(title: str, lines: Sequence[str]) -> list[str]:
    return ["<details>", f"<summary>{title}</summary>", "", *lines, "", "</details>", ""]
