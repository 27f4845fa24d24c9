"""Records of one file: a row with its facts, and a row for each finding."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from dexkit.conformance.results import Overall, Result, Verdict, worst

__all__ = ["FINDING", "FORMAT", "VERSION", "FileRecord", "Finding", "State", "finding_of"]

FORMAT = "dexkit-audit"
VERSION = 2
"""Journals of version 1 may hold the credentials of URLs."""

Finding = list[Any]
"""One requirement on one side; its values are those of :data:`FINDING`, in that order."""
FINDING: dict[str, type] = {
    "about": str,
    "requirement": str,
    "level": str,
    "kind": str,
    "side": str,
    "verdict": str,
    "figure": str,
    "observed": str,
    "reason": str,
    "blocked_by": str,
    "value": float,
    "limit": float,
    "unit": str,
    "evidence_topic": str,
    "evidence_s": float,
    "evidence_end_s": float,
}
"""Columns of a finding. ``about`` is ``hand``, ``robot`` or ``client``; ``value``, ``limit`` and
``unit`` are of the figure that the verdict rests on, where it rests on one."""


class State(str, Enum):
    """Final state of a file."""

    JUDGED = "judged"
    NOT_JUDGED = "nothing judged"
    """It can be read, and no requirement could be judged."""
    UNREADABLE = "unreadable"
    """It is no recording, or none that can be judged."""
    GONE = "gone"
    """It was there when the audit began."""
    REFUSED = "no permission"
    UNAVAILABLE = "unavailable"
    """Its storage failed."""
    TOO_LARGE = "too large"
    """It needs more space, memory or time than an audit may use for one file."""
    FAILED = "failed"
    """The kit's own fault."""

    def __str__(self) -> str:
        return self.value

    @property
    def final(self) -> bool:
        """Whether an unchanged file need not be judged again."""
        return self in (State.JUDGED, State.NOT_JUDGED, State.UNREADABLE)


@dataclass
class FileRecord:
    """One file of an archive.

    :param name: path, or URL without credentials; ``tag`` changes whenever the file does: an etag,
        or a time.
    :param error: why it was not judged, or what is damaged; empty if all is well.
    :param settings: what the verdicts depend on besides the file; see
        :func:`~dexkit.conformance.audit.examine.settings_key`.
    :param overall: the verdict on the hands, and ``client`` that on their client; empty without
        one.
    :param exit_code: what ``dexkit check`` ends with on that file.
    :param facts: rates, gaps, damage, labels; see :mod:`~dexkit.conformance.audit.examine`.
    """

    name: str
    size: int = 0
    tag: str = ""
    state: State = State.FAILED
    error: str = ""
    hint: str = ""
    sha256: str = ""
    dexkit: str = ""
    catalogue: str = ""
    settings: str = ""
    overall: str = ""
    client: str = ""
    exit_code: int = 2
    facts: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def as_line(self) -> bytes:
        """The record as a line of JSON."""
        text = json.dumps({**vars(self), "state": str(self.state)}, separators=(",", ":"))
        return text.encode() + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> FileRecord:
        """The record that :meth:`as_line` gave.

        :raises ValueError: it is none, or cut.
        """
        try:
            data = json.loads(line)
            found = cls(**{**data, "state": State(data["state"])})
            if any(len(finding) != len(FINDING) for finding in found.findings):
                raise ValueError("a finding of another version")
        except (KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"not a record: {error}") from None
        return found

    def of_findings(self, name: str) -> list[Any]:
        """One column of the findings."""
        at = list(FINDING).index(name)
        return [finding[at] for finding in self.findings]

    def verdicts(self, about_client: bool = False) -> dict[str, Verdict]:
        """The verdict on each requirement, sides taken together."""
        found: dict[str, list[Verdict]] = {}
        for finding in self.findings:
            if (finding[0] == "client") is about_client:
                found.setdefault(finding[1], []).append(Verdict(finding[5]))
        return {name: worst(verdicts) for name, verdicts in found.items()}

    @property
    def failed(self) -> bool:
        """Whether a MUST about the hands is not met."""
        return self.overall == Overall.FAIL

    @property
    def sort_key(self) -> tuple[int, int, int]:
        """For sorting, worst first: failures, then files without verdicts, then warnings."""
        found = list(self.verdicts().values())
        return (
            -found.count(Verdict.FAIL),
            -int(self.exit_code == 2),
            -found.count(Verdict.WARN),
        )


def finding_of(result: Result, about: str) -> Finding:
    """The row of a result."""
    place = result.evidence[0] if result.evidence else None
    measure = result.measure
    return [
        about,
        result.requirement.id,
        str(result.requirement.level),
        str(result.requirement.kind),
        result.side,
        str(result.verdict),
        result.figure,
        result.observed,
        result.reason,
        result.blocked_by,
        None if measure is None else measure.value,
        None if measure is None else measure.limit,
        "" if measure is None else measure.unit,
        "" if place is None else place.topic,
        None if place is None else round(place.time_s, 6),
        None if place is None or place.end_s is None else round(place.end_s, 6),
    ]
