"""The summary page of an audit: what to keep, review and drop, and why; trends and groups."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

import numpy as np

from dexkit import __version__
from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.training_summary import TrainingSummary
from dexkit.conformance.dataset.findings import Use
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Overall, Verdict
from dexkit.conformance.kit.run_record import catalogue_digest
from dexkit.conformance.layers import LAYERS
from dexkit.conformance.report.charts import Chart, Line
from dexkit.conformance.report.labels import ANSWERS
from dexkit.conformance.report.pages import fill

__all__ = ["Group", "Summary", "render"]

_WORST = 200
"""Files with something to say that the page lists; the tables have all."""
_ROWS = 60
"""Rows of a group's table."""
_MOST = 3
"""Requirements that are named for a file or a group."""
_DAY = 86_400.0


@dataclass
class Group:
    """Episodes that have something in common; ``failing`` are to be dropped, or fail a MUST."""

    files: int = 0
    failing: int = 0
    unusable: int = 0
    seconds: float = 0.0
    failures: Counter[str] = field(default_factory=Counter)

    def add(self, record: EpisodeRecord, failed: Iterable[str]) -> None:
        """Count a file."""
        self.files += 1
        self.failing += record.failed
        self.unusable += record.exit_code == 2
        self.seconds += record.facts.get("duration_s") or 0.0
        self.failures.update(failed)


@dataclass(frozen=True)
class _Line:
    """A file's line on the page."""

    name: str
    overall: str
    state: State
    error: str
    where: str
    failed: tuple[tuple[str, str], ...]
    more: int
    damaged: bool = False


class Summary:
    """Contents of the page, collected file by file; its size does not grow with the archive.

    :ivar groups: by title (``robot``, ``model``, ...) and name.
    :ivar requirements: by ``hand`` or ``client`` and id: in how many files it fails, and warns.
    """

    def __init__(self) -> None:
        self.training = TrainingSummary()
        self.all = Group()
        self.states: Counter[State] = Counter()
        self.overall: Counter[str] = Counter()
        self.groups: dict[str, dict[str, Group]] = {}
        self.requirements: dict[tuple[str, str], Counter[str]] = {}
        self.days: dict[float, Group] = {}
        self.clients: Counter[str] = Counter()
        self.truncated = self.damaged = 0
        self._worst: list[tuple[tuple[int, int, int], int, _Line]] = []
        self._count = 0

    def add(self, record: EpisodeRecord) -> None:
        """Count an episode."""
        self.training.add(record)
        if record.is_set:
            return
        facts = record.facts
        verdicts = record.verdicts()
        failed = [name for name, verdict in verdicts.items() if verdict is Verdict.FAIL]
        self.all.add(record, failed)
        self.states[record.state] += 1
        if record.overall:  # what could not be judged is counted by its state alone
            self.overall[record.overall] += 1
        self.truncated += bool(facts.get("truncated"))
        self.damaged += bool(facts.get("damage"))
        if record.client:
            self.clients[record.client] += 1
        for about, found in (("hand", verdicts), ("client", record.verdicts(about_client=True))):
            for name, verdict in found.items():
                if verdict in (Verdict.FAIL, Verdict.WARN):
                    counts = self.requirements.setdefault((about, name), Counter())
                    counts[str(verdict)] += 1
        for title, name in self._group_names(record):
            group = self.groups.setdefault(title, {}).setdefault(name, Group())
            group.add(record, failed)
        if day := _day(facts.get("recorded_at", "")):
            self.days.setdefault(day, Group()).add(record, failed)
        self._rank(record, failed)

    def _group_names(self, record: EpisodeRecord) -> list[tuple[str, str]]:
        found = [(key, value) for key, value in record.facts.get("labels", {}).items()]
        if dialect := record.facts.get("dialect"):
            found.append(("dialect", dialect))
        folder = record.name.rpartition("/")[0]
        return [*found, ("folder", folder)] if folder else found

    def _rank(self, record: EpisodeRecord, failed: Sequence[str]) -> None:
        if not record.overall:  # of the wire only; the others have cards
            return
        badness = record.sort_key
        if badness == (0, 0, 0):
            return
        shown = []
        for finding in record.findings:
            named = finding.requirement in failed and finding.about != "client"
            if named and finding.verdict is Verdict.FAIL:
                shown.append((finding.requirement, f"{finding.side}: {finding.observed}"))
        line = _Line(
            record.name,
            record.overall,
            record.state,
            record.error,
            _where(record.facts),
            tuple(shown[:_MOST]),
            max(0, len(shown) - _MOST),
            bool(record.facts.get("damage") or record.facts.get("truncated")),
        )
        # the heap's smallest is the least bad, and of equals the last one
        entry = (tuple(-n for n in badness), -self._count, line)
        self._count += 1
        heapq.heappush(self._worst, entry)  # type: ignore[misc]
        if len(self._worst) > _WORST:
            heapq.heappop(self._worst)

    @property
    def worst(self) -> list[_Line]:
        """Files with failures, errors or warnings, worst first."""
        return [line for _, _, line in sorted(self._worst, reverse=True)]

    @property
    def remarkable(self) -> int:
        """Number of files with failures, errors or warnings."""
        return self._count


def _day(recorded_at: str) -> float:
    try:
        moment = datetime.fromisoformat(recorded_at)
    except ValueError:
        return 0.0
    return moment.timestamp() // _DAY * _DAY


def _where(facts: Mapping[str, Any]) -> str:
    labels = [
        value if value.lower().startswith(key) else f"{key} {value}"
        for key, value in facts.get("labels", {}).items()
    ]
    recorded = facts.get("recorded_at", "")[:16].replace("T", " ")  # to the minute, UTC
    parts = [recorded, facts.get("dialect", ""), *labels]
    return ", ".join(part for part in parts if part)


def render(
    summary: Summary,
    *,
    locations: Sequence[str],
    left: int = 0,
    commands: Sequence[tuple[str, str]] = (),
) -> str:
    """The page as text.

    :param commands: what makes the cleaned sets: caption and command line.
    :param left: episodes that were not examined, because the audit was stopped.
    """
    css, answer = _answer(summary, left)
    days = sorted(summary.days)
    return fill(
        "audit.html",
        title=f"Audit of {_count(summary.all.files, 'episode')}",
        summary=summary,
        training=summary.training,
        commands=commands,
        wire=bool(summary.overall),
        css=css,
        answer=answer,
        of=_span(summary.all.seconds),
        left=left,
        ANSWERS={str(overall): ANSWERS[overall] for overall in Overall},
        known=_facts(summary, locations),
        worst=summary.worst,
        trend=_trend(summary, days),
        changes=_changes(summary, days),
        middle=_date(days[len(days) // 2]) if days else "",
        unmet=lambda about: _unmet(summary, about),
        groups=_groups(summary),
        short=lambda name: _short(name, locations),
        count=_count,
        span=_span,
    )


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _span(seconds: float) -> str:
    return f"{seconds / 3600:,.1f} h" if seconds >= 7200 else f"{seconds / 60:.1f} min"


def _answer(summary: Summary, left: int) -> tuple[str, str]:
    """Class and title of the answer."""
    every, uses = summary.all, summary.training.uses
    counts = ", ".join(f"{uses[use]:,} {use}" for use in Use)
    title = f"{_count(every.files, 'episode')}: {counts}"
    if every.unusable:
        title += f", {every.unusable:,} not usable or inconclusive"
    if failing := summary.overall[Overall.FAIL]:
        title += f"; hands in {_count(failing, 'recording')} are no drop-ins"
    if every.failing:
        return "bad", title
    is_open = every.unusable or left or uses[Use.REVIEW] or not every.files
    return "open" if is_open else "ok", title


def _facts(summary: Summary, locations: Sequence[str]) -> dict[str, str]:
    times = sorted(summary.days)
    rows = {
        "where": ", ".join(locations),
        "recorded": f"{_date(times[0])} to {_date(times[-1])}" if times else "unknown",
        "dexkit": __version__,
        "catalogue": catalogue_digest()[:16],
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    if summary.clients:
        rows["clients"] = ", ".join(f"{n} {verdict}" for verdict, n in summary.clients.items())
    return rows


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, timezone.utc).date().isoformat()


def _short(name: str, locations: Sequence[str]) -> str:
    """A file or folder, without the location if the page is about one alone."""
    return name.removeprefix(locations[0].rstrip("/") + "/") if len(locations) == 1 else name


def _trend(summary: Summary, days: Sequence[float]) -> Chart | None:
    """The part of episodes that fail, and that cannot be used, day by day."""
    if len(days) < 2:
        return None
    x = (np.array(days) - days[0]) / _DAY
    groups = [summary.days[day] for day in days]
    failing = np.array([100 * g.failing / g.files for g in groups])
    unusable = np.array([100 * g.unusable / g.files for g in groups])
    draw = "dots" if len(days) < 8 else "line"
    return Chart(
        "episodes to drop or with a failure, and those that cannot be used, per cent by day",
        [
            Line("to drop or with a failure", "bad", x, failing, draw),
            Line("not usable or inconclusive", "other", x, unusable, draw),
        ],
        span=(0.0, float(x[-1])),
        y_unit="%",
        x_unit=f"days since {_date(days[0])}",
        include=(0.0,),
    )


def _changes(summary: Summary, days: Sequence[float]) -> list[tuple[str, str, str]]:
    """Requirements that fail more, or less, in the later half of the days than before."""
    halves = []
    for some in (days[: len(days) // 2], days[len(days) // 2 :]):
        files = sum(summary.days[day].files for day in some)
        counts: Counter[str] = Counter()
        for day in some:
            counts.update(summary.days[day].failures)
        halves.append({name: n / files for name, n in counts.items()})
    before, after = halves
    change = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in before.keys() | after.keys()}
    ordered = sorted(change, key=lambda n: (-abs(change[n]), n))[:10]
    return [
        (n, f"{before.get(n, 0.0):.0%}", f"{after.get(n, 0.0):.0%}")
        for n in ordered
        if abs(change[n]) >= 0.005
    ]


def _unmet(summary: Summary, about: str) -> list[tuple[str, str, int, int]]:
    """Id, title, failures and warnings of each requirement that is not met, worst first."""
    found = {name: c for (who, name), c in summary.requirements.items() if who == about}
    titles = {r.id: r.title for name in LAYERS for r in catalogue(None, name)} if found else {}
    ordered = sorted(found, key=lambda n: (-found[n]["fail"], -found[n]["warn"], n))
    return [(n, titles.get(n, ""), found[n]["fail"], found[n]["warn"]) for n in ordered]


def _groups(summary: Summary) -> list[tuple[str, list[tuple[str, Group]], int]]:
    """Title, groups and how many are left out: labels first, worst group first."""
    found = []
    titles = sorted(summary.groups, key=lambda title: (title in ("dialect", "folder"), title))
    for title in titles:
        groups = summary.groups[title]
        if len(groups) > 1:
            ordered = sorted(
                groups.items(), key=lambda item: (-item[1].failing / item[1].files, item[0])
            )
            found.append((title, ordered[:_ROWS], max(0, len(ordered) - _ROWS)))
    return found
