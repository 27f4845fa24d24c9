"""Records of one episode: a row with its facts, and a row for each finding."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import Enum
from typing import Any

import msgspec
from msgspec import structs

from dexkit.conformance.dataset.findings import Finding, Judgement, Use, use_of
from dexkit.conformance.kit.requirements import Kind, Level
from dexkit.conformance.kit.results import Overall, Result, Verdict, worst
from dexkit.errors import UsageError
from dexkit.records import as_plain, to_record

__all__ = ["FORMAT", "VERSION", "EpisodeRecord", "RequirementFinding", "State"]

FORMAT = "dexkit-audit"
VERSION = 3
"""Journals of version 1 may hold the credentials of URLs; those of version 2 have files."""


_DROP = 1000  # failed requirements that count as much as an episode that is to be dropped


class RequirementFinding(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One requirement on one side of a recording of the wire.

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
    def of(cls, result: Result, about: str) -> RequirementFinding:
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
    """Final state of an episode."""

    JUDGED = "judged"
    NOT_JUDGED = "nothing judged"
    """It can be read, and nothing could be judged."""
    UNREADABLE = "unreadable"
    """It is no episode, or none that can be judged."""
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


class EpisodeRecord(msgspec.Struct, forbid_unknown_fields=True):
    """One episode of an archive, or a whole set of episodes.

    :param name: by which the rows call it: path, or URL without credentials, and the number of an
        episode where a file has several.
    :param source: the dataset, the folder of episodes or the recording that it belongs to, as
        the audit was told; ``episode`` is its number or folder in it, empty for a recording.
    :param form: ``LeRobot v3.0``; empty where that is not known.
    :param is_set: it is about all episodes of ``source``, which have rows of their own.
    :param tag: changes whenever one of its files does: an etag, a time, or a digest of them.
    :param error: why it was not judged, or what is damaged; empty if all is well.
    :param settings: what the verdicts depend on besides the files; see
        :func:`~dexkit.conformance.audit.examine.settings_key`.
    :param judgement: whether to train on it, and why; None where it could not be judged.
    :param overall: of a recording of the wire, the verdict on the hands as drop-ins, and
        ``client`` that on their client; empty without one.
    :param exit_code: 2 where it is not usable; else 1 to drop it, or what ``dexkit check`` ends
        with on that recording.
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
    findings: list[RequirementFinding] = []
    source: str = ""
    episode: str = ""
    form: str = ""
    is_set: bool = False
    judgement: Judgement | None = None

    def as_line(self) -> bytes:
        """The record as a line of JSON."""
        return json.dumps(as_plain(self), separators=(",", ":")).encode() + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> EpisodeRecord:
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
        """Whether a MUST about the hands is not met, or it is to be dropped."""
        return self.overall == Overall.FAIL or self.use == Use.DROP

    @property
    def warned(self) -> bool:
        """Whether a SHOULD is not met, or somebody should look at it."""
        return self.use == Use.REVIEW or any(f.verdict is Verdict.WARN for f in self.findings)

    @property
    def use(self) -> str:
        """Keep, review or drop; empty where that could not be judged."""
        return "" if self.judgement is None else str(self.judgement.use)

    def with_findings(self, found: Sequence[Finding]) -> EpisodeRecord:
        """The record with findings of a comparison with other episodes."""
        if not found or self.judgement is None:
            return self
        findings = [*self.judgement.findings, *found]
        judgement = structs.replace(self.judgement, findings=findings, use=use_of(findings))
        exit_code = self.exit_code or int(judgement.use is Use.DROP)
        return structs.replace(self, judgement=judgement, exit_code=exit_code)

    @property
    def sort_key(self) -> tuple[int, int, int]:
        """For sorting, worst first: to drop and failures, then without verdicts, then warnings."""
        found = list(self.verdicts().values())
        return (
            -(_DROP * (self.use == Use.DROP) + found.count(Verdict.FAIL)),
            -int(self.exit_code == 2),
            -(_DROP * (self.use == Use.REVIEW) + found.count(Verdict.WARN)),
        )
