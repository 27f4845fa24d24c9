"""Compare an audit with the known facts of a generated archive."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.conformance.audit.journal import Journal
from dexkit.conformance.audit.records import EpisodeRecord, RequirementFinding, State
from tools.generate_archive import ANSWERS, Answer

__all__ = ["Score", "score"]


@dataclass
class Score:
    """What an audit found, missed and wrongly blamed.

    :ivar missed: files whose fault was not found; ``blamed``: what failed in a file, on a side,
        without being a consequence of its fault; ``unread``: files without a fault that were not
        judged.
    """

    good: int = 0
    faulty: int = 0
    found: int = 0
    missed: list[str] = field(default_factory=list)
    blamed: list[str] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)

    @property
    def perfect(self) -> bool:
        """Whether every fault was found and nothing else was blamed."""
        return not (self.missed or self.blamed or self.unread)

    def text(self) -> str:
        """The score in a few lines."""
        lines = [
            f"{self.found} of {self.faulty} faults found, {len(self.missed)} missed; "
            f"{len(self.blamed)} wrongly blamed and {len(self.unread)} not judged "
            f"among {self.good + self.faulty} files, {self.good} of them good"
        ]
        for title, names in (
            ("missed", self.missed),
            ("wrongly blamed", self.blamed),
            ("not judged", self.unread),
        ):
            lines += [f"{title}: {name}" for name in names[:50]]
        return "\n".join(lines)


def score(archive: Path, audit: Path) -> Score:
    """Score the audit in the folder ``audit`` of a generated archive."""
    answers = [Answer(**entry) for entry in json.loads((archive / ANSWERS).read_text())]
    found = Score()
    with Journal(audit / "journal.jsonl") as journal:
        names = {_short(name): entry for name, entry in journal.entries.items()}
        for answer in answers:
            entry = names.get(answer.file)
            _count(found, answer, None if entry is None else journal.read(entry))
    return found


def _short(name: str) -> str:
    return "/".join(name.split("/")[-2:])


def _count(score: Score, answer: Answer, record: EpisodeRecord | None) -> None:
    score.good += not answer.fault
    score.faulty += bool(answer.fault)
    what = f"{answer.file} ({answer.fault or 'good'}, {answer.sample})"
    if record is None or (not answer.state and record.state is not State.JUDGED):
        (score.missed if answer.fault else score.unread).append(what)
        return
    if answer.fault:
        if _finds(answer, record):
            score.found += 1
        else:
            score.missed.append(what)
    allowed = {*answer.find, *answer.also}
    if not answer.state or answer.state == "truncated":
        for finding in _failed(record.findings):
            if not (finding.requirement in allowed and finding.side == answer.side):
                text = f"{finding.requirement} {finding.side}: {finding.observed}"
                score.blamed.append(f"{what}: {text}")


def _finds(answer: Answer, record: EpisodeRecord) -> bool:
    if answer.state == "truncated":
        return bool(record.facts.get("truncated"))
    if answer.state == "damaged":
        return bool(record.facts.get("damage"))
    if answer.state:
        return str(record.state) == answer.state
    return any(
        f.requirement in answer.find and f.side == answer.side
        for f in _failed(record.findings, ("fail", "warn"))
    )


def _failed(
    findings: Iterable[RequirementFinding], verdicts: tuple[str, ...] = ("fail",)
) -> Iterable[RequirementFinding]:
    for finding in findings:
        if finding.verdict in verdicts and finding.about != "client":
            yield finding
