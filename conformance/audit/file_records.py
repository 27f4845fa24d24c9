"""Records of one file: a row with its facts, and a row for each finding."""

from __future__ import annotations

import json
from enum import Enum
from typing import Any

import msgspec

from dexkit.conformance.kit.requirements import Kind, Level
from dexkit.conformance.kit.results import Overall, Result, Verdict, worst
from dexkit.errors import UsageError
from dexkit.records import as_plain, to_record

__all__ = ["FORMAT", "VERSION", "FileRecord", "Finding", "State"]

FORMAT = "dexkit-audit"
VERSION = 2
"""Journals of version 1 may hold the credentials of URLs."""


class Finding(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One requirement on one side.

    :param about: ``hand``, ``robot`` or ``client``.
    :param value: of the figure that the verdict rests on, where it rests on one; also ``limit`` and
        ``unit``.
    :param evidence_topic: of the first place in the recording that shows it, where there is one;
        also the times.
    """

    about: str
    requirement: str
    level: Level
    kind: Kind
    side: str
    verdict: Verdict
    figure: str
    observed: str
    reason: str
    blocked_by: str
    value: float | None
    limit: float | None
    unit: str
    evidence_topic: str
    evidence_s: float | None
    evidence_end_s: float | None

    @classmethod
    def of(cls, result: Result, about: str) -> Finding:
        """The row of a result."""
        place = result.evidence[0] if result.evidence else None
        measure = result.measure
        return cls(
            about,
            result.id,
            result.requirement.level,
            result.requirement.kind,
            result.side,
            result.verdict,
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
        )

    def as_row(self) -> dict[str, Any]:
        """Its values by their names."""
        return dict(zip(self.__struct_fields__, as_plain(self), strict=True))


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


class FileRecord(msgspec.Struct, forbid_unknown_fields=True):
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
    facts: dict[str, Any] = {}
    findings: list[Finding] = []

    def as_line(self) -> bytes:
        """The record as a line of JSON."""
        return json.dumps(as_plain(self), separators=(",", ":")).encode() + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> FileRecord:
        """The record that :meth:`as_line` gave.

        :raises ValueError: it is none, or cut.
        """
        try:
            return to_record(json.loads(line), cls, "a line of a journal")
        except (UsageError, RecursionError) as error:
            raise ValueError(str(error)) from None

    def verdicts(self, about_client: bool = False) -> dict[str, Verdict]:
        """The verdict on each requirement, sides taken together."""
        found: dict[str, list[Verdict]] = {}
        for finding in self.findings:
            if (finding.about == "client") is about_client:
                found.setdefault(finding.requirement, []).append(finding.verdict)
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
