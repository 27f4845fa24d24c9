"""What a run found: one object, written as JSON, from which every report is rendered.

Verdicts (h2spec and Autobahn grade theirs likewise; a plain pass or fail hides too much):

============== ============================================================================
pass           judged, and met
fail           a MUST that is not met
warn           a SHOULD that is not met; does not fail the hand
not applicable cannot be judged here, with the reason; never counts as a pass
blocked        another requirement failed first, or the kit's own machine was too busy
error          the kit's own fault
============== ============================================================================
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from dexkit import __version__
from dexkit.conformance.requirements import Level, Requirement
from dexkit.errors import UsageError

__all__ = [
    "FORMAT",
    "TOO_BUSY",
    "Evidence",
    "Overall",
    "Result",
    "RunResult",
    "Verdict",
    "environment",
    "worst",
]

TOO_BUSY = "the machine was too busy"
FORMAT = "dexkit-conformance-result"
VERSION = 1


class Verdict(str, Enum):
    """What was found for one requirement; see the module."""

    PASS = "pass"
    FAIL = "fail"
    WARN = "warn"
    NOT_APPLICABLE = "not applicable"
    BLOCKED = "blocked"
    ERROR = "error"

    def __str__(self) -> str:
        return self.value

    @property
    def judged(self) -> bool:
        """Whether a check came to a finding about the hand."""
        return self in (Verdict.PASS, Verdict.FAIL, Verdict.WARN)


_SEVERITY = [
    Verdict.FAIL,
    Verdict.ERROR,
    Verdict.BLOCKED,
    Verdict.WARN,
    Verdict.PASS,
    Verdict.NOT_APPLICABLE,
]


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The verdict that counts when several sides have one each."""
    return min(verdicts, key=_SEVERITY.index, default=Verdict.NOT_APPLICABLE)


class Overall(str, Enum):
    """The verdict on the whole run, with its exit code."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"

    def __str__(self) -> str:
        return self.value

    @property
    def exit_code(self) -> int:
        """0 pass, 1 fail, 2 not usable."""
        return {Overall.PASS: 0, Overall.FAIL: 1, Overall.INCONCLUSIVE: 2}[self]


@dataclass(frozen=True)
class Evidence:
    """A place in the recording.

    :param topic: where to look.
    :param time_s: seconds from the beginning of the recording.
    :param log_time_ns: the same as a log time of the recording.
    :param end_s: end of the stretch, if it is one.
    """

    topic: str
    time_s: float
    log_time_ns: int
    end_s: float | None = None


@dataclass(frozen=True)
class Result:
    """What was found for one requirement on one side.

    :param figure: the measured figure in a few characters, for tables.
    :param observed: what was seen, in words; ``expected`` is the requirement's sentence.
    :param reason: why it was not judged, or empty.
    :param values: measured figures by name.
    """

    requirement: Requirement
    side: str
    verdict: Verdict
    figure: str = ""
    observed: str = ""
    reason: str = ""
    evidence: tuple[Evidence, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)

    def explain(self) -> str:
        """Everything a person needs to act on it, in lines."""
        lines = [f"{self.requirement.id} ({self.requirement.level}) {self.side}: {self.verdict}"]
        lines.append(f"  required: {self.requirement.sentence}")
        if self.observed:
            lines.append(f"  observed: {self.observed}")
        if self.reason:
            lines.append(f"  reason:   {self.reason}")
        for place in self.evidence:
            until = f" .. {place.end_s:.3f} s" if place.end_s is not None else ""
            lines.append(f"  where:    {place.topic} at {place.time_s:.3f} s{until}")
        if self.verdict in (Verdict.FAIL, Verdict.WARN):
            lines.append(f"  try:      {self.requirement.advice}")
            lines.append(f"  source:   {self.requirement.source}")
        return "\n".join(lines)


def environment() -> dict[str, str]:
    """Versions and machine, for the report."""
    return {
        "dexkit": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


@dataclass
class RunResult:
    """A whole run.

    :param subject: what was judged: ``backend``, ``recording``, ``dialect``, ``sides``, ...
    :param stage: per side how far it got: nothing, discovered, flowing, moving.
    :param duration_s: seconds of the recording.
    :param notes: remarks on the recording.
    :param starved: part of the run, 0 to 1, in which the kit's own machine lacked processor time.
    """

    subject: dict[str, str]
    results: list[Result]
    stage: dict[str, str] = field(default_factory=dict)
    duration_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=environment)
    recorded_at: str = ""
    starved: float = 0.0

    def counts(self) -> dict[Verdict, int]:
        """Requirements by verdict, sides taken together."""
        rows = [worst(r.verdict for r in group) for _, group in self.by_requirement()]
        return {v: rows.count(v) for v in Verdict}

    def by_requirement(self) -> list[tuple[Requirement, list[Result]]]:
        """Results grouped by requirement, in the catalogue's order."""
        groups: dict[str, list[Result]] = {}
        for result in self.results:
            groups.setdefault(result.requirement.id, []).append(result)
        return [(group[0].requirement, group) for group in groups.values()]

    @property
    def judged(self) -> int:
        """How many results came to a finding about the hand."""
        return sum(r.verdict.judged for r in self.results)

    @property
    def disturbed(self) -> bool:
        """Whether a MUST is open only because the kit's own machine was too busy."""
        return self.overall is Overall.INCONCLUSIVE and any(
            r.verdict is Verdict.BLOCKED and r.reason.startswith(TOO_BUSY) for r in self.results
        )

    @property
    def overall(self) -> Overall:
        """Fail if a MUST failed; inconclusive if one is open, or nothing was judged at all."""
        if any(r.verdict is Verdict.FAIL for r in self.results):
            return Overall.FAIL
        opened = (Verdict.BLOCKED, Verdict.ERROR)
        if self.judged == 0 or any(
            r.verdict in opened and r.requirement.level is Level.MUST for r in self.results
        ):
            return Overall.INCONCLUSIVE
        return Overall.PASS

    def sentence(self) -> str:
        """The verdict in one sentence."""
        counts = self.counts()
        total = sum(counts.values())
        parts = [f"{n} {v}" for v, n in counts.items() if n]
        heads = {
            Overall.PASS: "PASS: every MUST that could be judged is met",
            Overall.FAIL: "FAIL: a MUST is not met",
            Overall.INCONCLUSIVE: "INCONCLUSIVE: nothing can be said of the hand"
            if self.judged == 0
            else "INCONCLUSIVE: a MUST could not be judged",
        }
        return f"{heads[self.overall]} ({total} requirements: {', '.join(parts)})"

    def as_dict(self) -> dict[str, Any]:
        """The result as plain data."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "overall": str(self.overall),
            "sentence": self.sentence(),
            "subject": dict(self.subject),
            "stage": dict(self.stage),
            "recorded_at": self.recorded_at,
            "duration_s": round(self.duration_s, 3),
            "counts": {str(v): n for v, n in self.counts().items()},
            "starved": round(self.starved, 4),
            "environment": dict(self.environment),
            "notes": list(self.notes),
            "results": [_result_dict(r) for r in self.results],
        }

    def write_json(self, path: Path) -> None:
        """Write the result file."""
        path.write_text(json.dumps(self.as_dict(), indent=2) + "\n", encoding="utf-8")


def _result_dict(result: Result) -> dict[str, Any]:
    requirement = asdict(result.requirement)
    requirement["level"] = str(result.requirement.level)
    return {
        "id": result.requirement.id,
        "side": result.side,
        "verdict": str(result.verdict),
        "figure": result.figure,
        "observed": result.observed,
        "reason": result.reason,
        "evidence": [asdict(e) for e in result.evidence],
        "values": dict(result.values),
        "requirement": requirement,
    }


def read_json(path: Path) -> RunResult:
    """Read a result file back.

    :raises UsageError: it is not one, or of a version that this dexkit does not know.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT or data["version"] != VERSION:
            raise UsageError(f"{path} is version {data['version']} of {data['format']}")
        return RunResult(
            subject=data["subject"],
            stage=data["stage"],
            duration_s=data["duration_s"],
            notes=data["notes"],
            environment=data["environment"],
            starved=data["starved"],
            recorded_at=data["recorded_at"],
            results=[_result_of(entry) for entry in data["results"]],
        )
    except (KeyError, TypeError, ValueError, OSError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{path} is not a result file of dexkit ({error})") from error


def _result_of(entry: dict[str, Any]) -> Result:
    data = dict(entry["requirement"])
    data["level"] = Level(data["level"])
    data["after"] = tuple(data["after"])
    data["dialects"] = tuple(data["dialects"])
    return Result(
        requirement=Requirement(**data),
        side=entry["side"],
        verdict=Verdict(entry["verdict"]),
        figure=entry["figure"],
        observed=entry["observed"],
        reason=entry["reason"],
        evidence=tuple(Evidence(**e) for e in entry["evidence"]),
        values=entry["values"],
    )
