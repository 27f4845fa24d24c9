"""The result as Markdown: a step summary or a comment on GitHub, a page of a wiki.

Text from outside is written so that it stays text: no HTML, no table cell, no mention of a person
comes out of a hostile name.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from dexkit.conformance.report.labels import (
    ANSWERS,
    VERDICTS,
    about_harness,
    by_gravity,
    causes,
    hand_name,
    model_title,
    nature,
    part,
    whose,
)
from dexkit.conformance.requirements import Requirement
from dexkit.conformance.results import Result, RunResult, Verdict, worst
from dexkit.untrusted import REMARK, one_line

__all__ = ["code", "plain", "render_markdown", "table"]

MOST_CARDS = 25
"""Failures told at length: a comment on GitHub holds 65536 characters."""
_SPECIAL = re.compile(r"([\\`*_\[\]|~#])")
_NOTHING = "&#8203;"
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN)


def plain(text: str) -> str:
    """``text`` as Markdown that shows just that, in one line."""
    text = one_line(" ".join(text.split()), REMARK)
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # a space of no width keeps a name behind @ from being called, and an address from being a link
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
    """The summary: verdict, areas, what is wrong, all requirements folded away."""
    answer = ANSWERS[result.overall]
    real = nature(result)
    counts = ", ".join(f"{n} {VERDICTS[v].text}" for v, n in result.counts().items() if n)
    lines = [
        f"## {answer.mark} {answer.text}: {plain(hand_name(result))} as {model_title(result)}",
        "",
        f"{counts or 'nothing was judged'}."
        + (f" The hand was **{real}**." if real in ("emulated", "simulated") else "")
        + (" A recording was judged, not a live hand." if real == "recorded" else ""),
        "",
    ]
    if of := part(result):
        lines += [f"**{of}: this does not prove a drop-in.**", ""]
    lines += [
        f"- {plain(whose(side))} reached: **{stage}**" for side, stage in result.stage.items()
    ]
    if harness := about_harness(result):
        lines.append(f"- test machine: {harness}")
    lines += ["", *_areas(result), ""]
    lines += _troubles(result)
    lines += _folded("Every requirement", _every(result))
    about = ", ".join(f"{plain(k)} {plain(v)}" for k, v in result.environment.items())
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


def _troubles(result: RunResult) -> list[str]:
    groups = [
        (need, [r for r in group if r.verdict in _TROUBLE])
        for need, group in result.by_requirement()
    ]
    groups = by_gravity(result, ((need, group) for need, group in groups if group), _TROUBLE)
    lines: list[str] = []
    for need, group in groups[:MOST_CARDS]:
        lines += _card(need, group)
    if len(groups) > MOST_CARDS:
        lines += [f"... and {len(groups) - MOST_CARDS} more.", ""]
    blocked: dict[str, dict[str, None]] = {}
    for entry in result.results:
        if entry.verdict is Verdict.BLOCKED:
            blocked.setdefault(entry.reason, {})[entry.requirement.id] = None
    for reason, names in blocked.items():
        told = ", ".join(code(name) for name in names)
        lines += [f"{VERDICTS[Verdict.BLOCKED].mark} {plain(reason)}: {told}", ""]
    return lines


def _card(need: Requirement, group: Sequence[Result]) -> list[str]:
    word = VERDICTS[worst(r.verdict for r in group)]
    sides = " and ".join(r.side for r in group)
    lines = [
        f"### {word.mark} {code(need.id)} {plain(need.title)} ({plain(sides)})",
        "",
        f"- required: {plain(need.sentence)} ({need.level})",
    ]
    if group[0].expected != need.sentence:
        lines.append(f"- expected: {plain(group[0].expected)}")
    for entry in group:
        lines.append(f"- observed, {plain(entry.side)}: {plain(entry.observed or entry.reason)}")
        if entry.observed and entry.reason:
            lines.append(f"- reason, {plain(entry.side)}: {plain(entry.reason)}")
        for place in entry.evidence[:1]:
            until = f" to {place.end_s:.3f} s" if place.end_s is not None else ""
            lines.append(
                f"- where: {code(place.topic)} at {place.time_s:.3f} s{until}, log time "
                f"`{place.log_time_ns}`"
            )
    lines += [f"- likely cause: {plain(cause)}" for _, cause in causes(list(group))]
    lines += [
        f"- try: {plain(need.advice)}",
        f"- source: {plain(need.source)} ({plain(need.confidence)})",
        "",
    ]
    return lines


def _every(result: RunResult) -> list[str]:
    sides = list(dict.fromkeys(r.side for r in result.results))
    rows = []
    for need, group in result.by_requirement():
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
