"""Compare several results: of different hands, or of firmware versions of one hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from dexkit.conformance.kit.requirements import Requirement
from dexkit.conformance.kit.results import Result, RunResult, Verdict, worst
from dexkit.conformance.report.curves import Recorded, beside
from dexkit.conformance.report.labels import (
    ANSWERS,
    VERDICTS,
    count_verdicts,
    device_kind,
    hand_name,
    model_title,
)
from dexkit.conformance.report.pages import fill
from dexkit.errors import UsageError
from dexkit.templates import code

__all__ = [
    "Change",
    "Comparison",
    "comparison_data",
    "render_comparison",
    "render_comparison_markdown",
]

_BADNESS = {Verdict.PASS: 0, Verdict.WARN: 1, Verdict.FAIL: 2}
"""Rank of a verdict. A verdict without a finding about the hand has none; the requirement that
blocks others is listed itself."""


@dataclass(frozen=True)
class Change:
    """A requirement whose verdict differs between two runs of the same hand.

    :param before: index of the earlier run, ``after`` of the later one.
    """

    requirement: Requirement
    before: int
    after: int
    was: Verdict
    now: Verdict

    @property
    def worse(self) -> bool:
        """Whether it is a regression."""
        return _BADNESS[self.now] > _BADNESS[self.was]


@dataclass(frozen=True)
class Row:
    """A requirement and the results of each run (none where it was not selected)."""

    requirement: Requirement
    found: tuple[tuple[Result, ...], ...]

    @property
    def verdicts(self) -> tuple[Verdict | None, ...]:
        """The verdict of each run, sides together."""
        return tuple(worst(r.verdict for r in group) if group else None for group in self.found)

    @property
    def differs(self) -> bool:
        """Whether the runs differ."""
        return len(set(self.verdicts)) > 1


class Comparison:
    """Runs of one model.

    :param names: a name for each run; for None, the hand's name, made unique.
    :raises UsageError: fewer than two, or of different models.
    """

    def __init__(self, runs: Sequence[RunResult], names: Sequence[str] | None = None) -> None:
        if len(runs) < 2:
            raise UsageError("a comparison needs two results or more")
        models = list(dict.fromkeys(run.subject.get("model", "?") for run in runs))
        if len(models) > 1:
            raise UsageError(
                f"results of different models: {', '.join(models)}",
                hint="requirements differ from model to model; compare runs of one",
            )
        self.runs = tuple(runs)
        self.names = tuple(_unique([hand_name(run) for run in runs], names))
        needs: dict[str, Requirement] = {}
        found: dict[str, list[tuple[Result, ...]]] = {}
        for index, run in enumerate(runs):
            for need, group in run.by_requirement():
                needs.setdefault(need.id, need)
                found.setdefault(need.id, [()] * len(runs))[index] = tuple(group)
        self.rows = tuple(Row(needs[name], tuple(groups)) for name, groups in found.items())

    @property
    def differing(self) -> list[Row]:
        """Requirements on which the runs differ."""
        return [row for row in self.rows if row.differs]

    @property
    def agreeing(self) -> list[Row]:
        """Requirements on which the runs agree."""
        return [row for row in self.rows if not row.differs]

    @property
    def changes(self) -> list[Change]:
        """Changes from each run to the next one of the same hand, ordered by time."""
        found: list[Change] = []
        for before, after in self._successors():
            for row in self.rows:
                was, now = row.verdicts[before], row.verdicts[after]
                if was in _BADNESS and now in _BADNESS and _BADNESS[was] != _BADNESS[now]:
                    found.append(Change(row.requirement, before, after, was, now))
        return found

    @property
    def regressions(self) -> list[Change]:
        """Changes to a worse verdict."""
        return [change for change in self.changes if change.worse]

    @property
    def improvements(self) -> list[Change]:
        """Changes to a better verdict."""
        return [change for change in self.changes if not change.worse]

    def _successors(self) -> list[tuple[int, int]]:
        hands: dict[str, list[int]] = {}
        for index, run in enumerate(self.runs):
            # without a name or a backend it is unknown whether it is the same hand
            who = run.subject.get("hand") or run.subject.get("backend")
            if who:
                hands.setdefault(who, []).append(index)
        pairs = []
        for indices in hands.values():
            ordered = sorted(indices, key=lambda i: self.runs[i].recorded_at)
            pairs += list(pairwise(ordered))
        return pairs


def _unique(own: Sequence[str], names: Sequence[str] | None) -> list[str]:
    """The hands' names; equal names are followed by the result's name."""
    return [
        name if own.count(name) == 1 else f"{name} ({names[i] if names else i + 1})"
        for i, name in enumerate(own)
    ]


def _figure(group: Sequence[Result]) -> str:
    """The figures of a run for one requirement; one figure where the sides agree."""
    figures = {r.side: r.figure for r in group if r.figure}
    if len(set(figures.values())) == 1:
        return next(iter(figures.values()))
    return ", ".join(f"{side} {figure}" for side, figure in figures.items())


def _change_text(comparison: Comparison, change: Change) -> str:
    return (
        f"{change.requirement.title}: {VERDICTS[change.was].text} in "
        f"{comparison.names[change.before]}, {VERDICTS[change.now].text} in "
        f"{comparison.names[change.after]}"
    )


# ------------------------------------------------------------------------ HTML and Markdown


def render_comparison(
    comparison: Comparison, recordings: Sequence[Recorded] = (), missing: Sequence[str] = ()
) -> str:
    """Return the page as text.

    :param recordings: of the runs, whose curves are at the end of the page.
    :param missing: the runs whose recordings are not among them.
    """
    about = f"{len(comparison.runs)} runs as {model_title(comparison.runs[0])}"
    return fill(
        "comparison.html",
        title=f"Comparison: {about}",
        about=about,
        comparison=comparison,
        parts=beside(recordings),
        names=[r.name for r in recordings],
        missing=missing,
        ANSWERS=ANSWERS,
        VERDICTS=VERDICTS,
        change_text=_change_text,
        count_verdicts=count_verdicts,
        device_kind=device_kind,
        figure=_figure,
    )


def render_comparison_markdown(comparison: Comparison) -> str:
    """The comparison as Markdown: regressions, differences, all other requirements folded away."""
    return fill(
        "comparison.md",
        about=f"{len(comparison.runs)} runs as {model_title(comparison.runs[0])}",
        comparison=comparison,
        runs=[
            _about_run(run, name)
            for run, name in zip(comparison.runs, comparison.names, strict=True)
        ],
        heads=["requirement", "what", *comparison.names],
        matrix=_matrix,
        change_text=_change_text,
    )


def comparison_data(comparison: Comparison) -> dict[str, Any]:
    """The comparison for programs, as data for JSON: names and order as in the other forms."""

    def changes(found: Sequence[Change]) -> list[dict[str, str]]:
        return [
            {
                "id": c.requirement.id,
                "from": comparison.names[c.before],
                "to": comparison.names[c.after],
                "was": str(c.was),
                "now": str(c.now),
            }
            for c in found
        ]

    return {
        "runs": [
            {"name": name, "verdict": str(run.overall), "recorded_at": run.recorded_at}
            for run, name in zip(comparison.runs, comparison.names, strict=True)
        ],
        "regressions": changes(comparison.regressions),
        "improvements": changes(comparison.improvements),
        "requirements": [
            {
                "id": row.requirement.id,
                "differs": row.differs,
                "verdicts": [None if v is None else str(v) for v in row.verdicts],
                "figures": [_figure(group) for group in row.found],
            }
            for row in comparison.rows
        ],
    }


def _about_run(run: RunResult, name: str) -> list[str]:
    """Its line in the table of runs."""
    answer, found, real = ANSWERS[run.overall], count_verdicts(run), device_kind(run)
    return [
        name + (f" ({real})" if real else ""),
        f"{answer.mark} {answer.text}",
        f"{found.passed} of {found.applicable}",
        run.recorded_at,
    ]


def _matrix(rows: Sequence[Row]) -> list[list[str]]:
    """A line for each requirement, with the verdict or figure of each run."""

    def cell(group: Sequence[Result]) -> str:
        if not group:
            return "not asked"
        word = VERDICTS[worst(r.verdict for r in group)]
        return f"{word.mark} {_figure(group) or word.text}"

    return [
        [code(row.requirement.id), row.requirement.title, *(cell(g) for g in row.found)]
        for row in rows
    ]
