"""What the summary page says of training: verdicts, reasons, the worst episodes, distributions."""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.dataset.findings import Curve, Finding, Shot, Use
from dexkit.conformance.dataset.judge import CHECKS, TITLES
from dexkit.conformance.report.charts import Band, Chart, Line
from dexkit.hand import Floats

__all__ = ["Card", "Distribution", "Refusal", "TrainingSummary"]

_WORST = 200
"""Episodes to drop or to review that the page shows; the tables have all."""
_REASONS = 6  # of an episode that are shown
_SETS = 12  # whose distributions are shown, those with the most episodes
_FEWEST = 5  # values that have a distribution
_OUTLIERS = 3  # that are named in each
_FAR = 4.0  # times the half-width of the middle half of the values, beyond it, is an outlier
_WORDS = {Use.DROP: "bad", Use.REVIEW: "warn", Use.KEEP: "ok"}


@dataclass(frozen=True)
class Card:
    """An episode to drop or to review.

    :param css: class that colours it.
    :param reasons: place in time, text; ``more`` are not shown.
    :param curves: of the moments, with their findings; ``shots`` are what a camera saw then.
    """

    name: str
    source: str
    use: Use
    css: str
    length_s: float
    reasons: tuple[tuple[str, str], ...]
    more: int
    curves: tuple[tuple[Finding, Curve], ...]
    shots: tuple[Shot, ...] = ()

    @property
    def charts(self) -> Iterator[Chart]:
        """The curves of a joint around each finding that has some."""
        for finding, curve in self.curves:
            yield _chart(finding, curve)


@dataclass(frozen=True)
class Refusal:
    """An episode, or a whole set, that could not be used."""

    name: str
    state: State
    error: str
    hint: str


@dataclass(frozen=True, eq=False)
class Distribution:
    """A figure of all episodes of a set.

    :param outliers: value and name of the episodes that are far from the others.
    """

    title: str
    chart: Chart
    middle: str
    outliers: tuple[tuple[str, str], ...]


@dataclass
class _Values:
    values: list[float] = field(default_factory=list)
    names: list[str] = field(default_factory=list)


class TrainingSummary:
    """Contents of the page, collected episode by episode.

    :ivar uses: how many episodes to keep, to review and to drop.
    :ivar reasons: by check, how many episodes to drop and to review for it.
    :ivar sets: findings about whole sets: name and finding.
    :ivar refusals: episodes that cannot be used; ``refused`` counts them all.
    """

    def __init__(self) -> None:
        self.uses: Counter[str] = Counter()
        self.seconds: Counter[str] = Counter()
        self.reasons: dict[str, Counter[str]] = {}
        self.sets: list[tuple[str, Finding]] = []
        self.refusals: list[Refusal] = []
        self.refused = 0
        self.unjudged: dict[str, Counter[str]] = {}
        self._worst: list[tuple[tuple[int, int, int], int, Card]] = []
        self._figures: dict[str, dict[str, _Values]] = defaultdict(dict)
        self._count = 0

    def add(self, record: EpisodeRecord) -> None:
        """Count an episode, or a set."""
        judgement = record.judgement
        if record.is_set:
            self.sets += [(record.name, f) for f in judgement.reasons] if judgement else []
            return
        if record.exit_code == 2 and record.state is not State.JUDGED:
            self.refused += 1
            if len(self.refusals) < _WORST:
                refusal = Refusal(record.name, record.state, record.error, record.hint)
                self.refusals.append(refusal)
        if judgement is None:
            return
        length = float(record.facts.get("duration_s") or 0.0)
        self.uses[record.use] += 1
        self.seconds[record.use] += round(length)
        for cause, use in {(f.check, f.use) for f in judgement.reasons}:
            self.reasons.setdefault(cause, Counter())[str(use)] += 1
        for check in CHECKS:
            if check.name not in judgement.judged:
                self.unjudged.setdefault(check.name, Counter())[record.form] += 1
        for name, value in judgement.figures.items():
            found = self._figures[record.source].setdefault(name, _Values())
            found.values.append(value)
            found.names.append(record.name)
        if judgement.use is not Use.KEEP:
            self._rank(record, length)

    def _rank(self, record: EpisodeRecord, length: float) -> None:
        judgement = record.judgement
        assert judgement is not None
        reasons = judgement.reasons
        card = Card(
            record.name,
            record.source,
            judgement.use,
            _WORDS[judgement.use],
            length,
            tuple((_place(f), _text(f)) for f in reasons[:_REASONS]),
            max(0, len(reasons) - _REASONS),
            tuple((judgement.findings[c.finding], c) for c in judgement.curves),
            tuple(judgement.shots),
        )
        drops = sum(f.use is Use.DROP for f in reasons)
        # the heap's smallest is the least bad, and of equals the last one
        entry = ((int(judgement.use is Use.DROP), drops, len(reasons)), -self._count, card)
        self._count += 1
        heapq.heappush(self._worst, entry)
        if len(self._worst) > _WORST:
            heapq.heappop(self._worst)

    @property
    def worst(self) -> list[Card]:
        """Episodes to drop and to review, worst first."""
        return [card for _, _, card in sorted(self._worst, reverse=True, key=lambda e: e[:2])]

    @property
    def remarkable(self) -> int:
        """Number of episodes to drop or to review."""
        return self.uses[Use.DROP] + self.uses[Use.REVIEW]

    @property
    def causes(self) -> list[tuple[str, str, int, int]]:
        """Check, title, episodes to drop and to review for it; most frequent first."""
        found = [
            (name, TITLES.get(name, name), n[Use.DROP], n[Use.REVIEW])
            for name, n in self.reasons.items()
        ]
        return sorted(found, key=lambda row: (-row[2], -row[3], row[0]))

    @property
    def silent(self) -> list[tuple[str, str, str, str]]:
        """Check, title, what it needs, and the formats of the episodes that lack it."""
        found = []
        for check in CHECKS:
            if forms := self.unjudged.get(check.name):
                needs = ", ".join(sorted(str(data.value) for data in check.needs))
                listed = ", ".join(f"{form} ({n:,})" for form, n in forms.most_common(4))
                found.append((check.name, check.title, needs, listed))
        return found

    def distributions(self) -> list[tuple[str, list[Distribution]]]:
        """By set, those with most episodes first, the distribution of each figure."""
        ordered = sorted(self._figures.items(), key=lambda item: (-_most(item[1]), item[0]))
        found = []
        for source, figures in ordered[:_SETS]:
            shown = [d for name, v in figures.items() if (d := _distribution(name, v)) is not None]
            if shown:
                found.append((source or "recordings", shown))
        return found


def _most(figures: Mapping[str, _Values]) -> int:
    return max((len(v.values) for v in figures.values()), default=0)


def _text(finding: Finding) -> str:
    """What is wrong; of a camera, with which one."""
    is_camera = finding.part.startswith("camera ")
    return f"{finding.part}: {finding.text}" if is_camera else finding.text


def _place(finding: Finding) -> str:
    """Where in the episode."""
    if finding.begin_s is None:
        return ""
    if finding.end_s is None or finding.end_s - finding.begin_s < 0.05:
        return f"{finding.begin_s:.1f} s"
    return f"{finding.begin_s:.1f} to {finding.end_s:.1f} s"


def _chart(finding: Finding, curve: Curve) -> Chart:
    t = np.array(curve.t)
    lines = []
    if curve.action:
        lines.append(Line("action", "cmd", t, _numbers(curve.action)))
    if curve.state:
        lines.append(Line("observation", "state", t, _numbers(curve.state)))
    bands: tuple[Band, ...] = ()
    if finding.begin_s is not None:
        end = finding.begin_s if finding.end_s is None else finding.end_s
        bands = (Band("", finding.begin_s, end, "alarm"),)
    title = f"{finding.part.replace('_', ' ')}, {curve.joint}"
    return Chart(
        title,
        lines,
        span=(float(t[0]), float(t[-1])),
        y_unit=curve.unit,
        bands=bands,
        height=150,
    )


def _numbers(values: Sequence[float | None]) -> Floats:
    return np.array([np.nan if v is None else v for v in values])


def _distribution(name: str, found: _Values) -> Distribution | None:
    values = np.array(found.values)
    if len(values) < _FEWEST or not np.ptp(values) > 0:
        return None
    title, _, unit = name.partition(", ")
    low, middle, high = np.percentile(values, [25, 50, 75])
    reach = _FAR * max((high - low) / 2, 1e-3 * abs(middle), 1e-9)
    far = [i for i in np.argsort(-np.abs(values - middle)) if abs(values[i] - middle) > reach]
    counts, edges = np.histogram(values, bins=min(40, max(8, len(values) // 4)))
    chart = Chart(
        title,
        [Line("", "count", edges[:-1], counts.astype(float), "bars")],
        span=(float(edges[0]), float(edges[-1])),
        y_unit="episodes",
        x_unit=unit,
        include=(0.0,),
        height=120,
        width=320,
    )
    outliers = tuple((f"{values[i]:.4g} {unit}", found.names[i]) for i in far[:_OUTLIERS])
    return Distribution(title, chart, f"{middle:.4g} {unit}", outliers)
