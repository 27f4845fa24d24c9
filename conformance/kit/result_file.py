"""The result file: its form, and how it is written and read.

The classes say what is in the file, in the order in which it is written; docs/reports.md describes
it. Its JSON schema is made of them (``make docs``). What follows from other members (sentences,
counts, grades) is for programs that only read, and is not read back.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from dexkit import documents
from dexkit.conformance.kit.measurement_error import Quantity
from dexkit.conformance.kit.plots import Plot
from dexkit.conformance.kit.requirements import Kind, Level
from dexkit.conformance.kit.results import (
    Disturbance,
    Evidence,
    Overall,
    Result,
    RunResult,
    Stage,
    Story,
    Verdict,
    counts_of,
    overall_of,
)
from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.records import as_plain, from_object, to_record

__all__ = [
    "FORMAT",
    "VERSION",
    "ResultFile",
    "as_document",
    "parse_result",
    "read_json",
    "write_json",
]

FORMAT: Final = "dexkit-conformance-result"
VERSION: Final = 4

Count = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]
Amount = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Joint = Annotated[int, msgspec.Meta(ge=0, le=1000)]
SideName = Annotated[str, msgspec.Meta(pattern="^(left|right|robot)$")]
Confidence = Literal["vendor document", "vendor code", "measured", "inferred"]
LayerName = Literal["dds", "usb", "robot", "client"]
HarnessFigure = Annotated[
    str, msgspec.Meta(pattern="^(jitter_p50_ms|jitter_p99_ms|starved|waited|longest_wait_ms)$")
]
_SHA256 = re.compile("[0-9a-f]{64}")


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """A part of the file; every member must be there, and no other."""


class RequirementRecord(_Record):
    """A requirement, as :class:`~dexkit.conformance.kit.requirements.Requirement`.

    A claimed SHOULD is a MUST here.
    """

    id: str
    model: str
    area: str
    level: Level
    title: str
    sentence: str
    rationale: str
    source: str
    confidence: Confidence
    needs: str
    advice: str
    after: tuple[str, ...]
    dialects: tuple[str, ...]
    tolerances: dict[str, float]
    realtime: bool
    layer: LayerName
    cause: str
    expected: str
    capability: str
    repeat: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
    like: str
    plots: tuple[Plot, ...]
    kind: Kind
    original: str


class MeasureRecord(_Record):
    """The figure with a limit that a verdict rests on, as
    :class:`~dexkit.conformance.kit.measurement_error.Measure`.

    :param margin: distance to the limit, positive on the side that passes.
    :param error: the kit's own error of such a figure at that place; null if it is not known.
    :param margin_in_errors: margin divided by error; null where that is 0 or not known.
    """

    value: Number
    limit: Number
    unit: str
    quantity: Quantity
    larger_is_worse: bool
    margin: Number
    error: Amount | None
    margin_in_errors: float | None


class ResultRecord(_Record):
    """The result of a requirement on one side, as :class:`~dexkit.conformance.kit.results.Result`.

    :param expected: what would have been right, in a few words.
    """

    id: str
    side: SideName
    verdict: Verdict
    figure: str
    expected: str
    observed: str
    reason: str
    cause: str
    blocked_by: str
    evidence: tuple[Evidence, ...]
    values: dict[str, float]
    joints: tuple[Joint, ...]
    disturbance: Disturbance
    plots: tuple[Plot, ...]
    retry: bool
    measure: MeasureRecord | None
    requirement: RequirementRecord


class GradeRecord(_Record):
    """The verdict on the requirements of one kind."""

    overall: Overall
    sentence: str
    counts: dict[Verdict, Count]


class ClientRecord(_Record):
    """The verdict on the client that commanded the hands. It does not count in that on the hands,
    unless only requirements about the client were selected.
    """

    overall: Overall
    sentence: str
    results: tuple[ResultRecord, ...]


class ResultFile(_Record):
    """A result of a dexkit conformance run, as :class:`~dexkit.conformance.kit.results.RunResult`.

    :param overall: fail: a MUST is not met; inconclusive: a MUST could not be judged, or nothing
        was.
    :param sentence: the verdict in one sentence.
    :param counts: requirements by verdict, sides taken together.
    :param stories: what failed, put together; files that were written before have none.
    :param recorded_at: UTC, ISO 8601.
    :param catalogue: how many requirements there are for such a run, selected or not.
    :param client: null where the kit was the client, or nobody commanded the hands.
    """

    format: Literal["dexkit-conformance-result"]
    version: Literal[4]
    overall: Overall
    sentence: str
    grades: dict[Kind, GradeRecord]
    subject: dict[str, str]
    claims: dict[str, bool] | None
    stage: dict[SideName, Stage]
    recorded_at: str
    duration_s: Amount
    catalogue: Count
    counts: dict[Verdict, Count]
    harness: dict[HarnessFigure, Amount]
    environment: dict[str, str]
    run: dict[str, str]
    notes: tuple[str, ...]
    results: tuple[ResultRecord, ...]
    client: ClientRecord | None
    stories: tuple[Story, ...] = ()

    def __post_init__(self) -> None:
        for name in ("model", "dialect", "sides"):
            if name not in self.subject:
                raise ValueError(f"subject: has no {name}")
        digest = self.subject.get("recording_sha256")
        if digest is not None and not _SHA256.fullmatch(digest):
            raise ValueError("subject.recording_sha256: is no SHA-256")


def as_document(result: RunResult) -> dict[str, Any]:
    """The content of the result's file, as plain data."""
    client = None
    if result.client:
        client = ClientRecord(
            overall=overall_of(result.client),
            sentence=result.client_sentence(),
            results=_records(result.client),
        )
    grades = {kind: result.grade(kind) for kind in Kind}
    record = ResultFile(
        format=FORMAT,
        version=VERSION,
        overall=result.overall,
        sentence=result.sentence(),
        grades={
            kind: GradeRecord(overall=g.overall, sentence=g.sentence(), counts=dict(g.counts))
            for kind, g in grades.items()
        },
        subject=result.subject,
        claims=result.claims,
        stage=result.stage,
        recorded_at=result.recorded_at,
        duration_s=round(result.duration_s, 3),
        catalogue=result.catalogue,
        counts=counts_of(result.results),
        harness={name: round(value, 4) for name, value in result.harness.items()},
        environment=result.environment,
        run=result.run,
        notes=tuple(result.notes),
        results=_records(result.results),
        client=client,
        stories=tuple(result.stories),
    )
    found: dict[str, Any] = as_plain(record)
    return found


def _records(results: list[Result]) -> tuple[ResultRecord, ...]:
    records = (from_object(each, ResultRecord) for each in results)
    return tuple(
        msgspec.structs.replace(
            record, values={k: v for k, v in record.values.items() if math.isfinite(v)}
        )
        for record in records
    )


def write_json(result: RunResult, path: Path) -> None:
    """Write the result file."""
    documents.write_file(path, json.dumps(as_document(result), indent=2) + "\n")


def read_json(path: Path) -> RunResult:
    """Read a result file.

    :raises UsageError: it is not a result file, of another version, or not of the form of
        :class:`ResultFile`: the error names the place.
    """
    return parse_result(documents.read_json(path), path)


def parse_result(data: Any, path: object) -> RunResult:
    """The result in a document; raises as :func:`read_json`.

    :param path: what to call it.
    """
    about = data if isinstance(data, dict) else {}
    if about.get("format") != FORMAT:
        raise UsageError(
            f"{path} is not a result file of dexkit",
            hint="the options --result FILE of 'dexkit check' and of the suite write them",
        )
    if about.get("version") != VERSION:
        version = one_line(about.get("version"), 40)
        raise UsageError(
            f"{path}: version {version} of {FORMAT} is not read by this dexkit, but {VERSION}",
            hint="judge the recording again: dexkit check RECORDING.mcap --result RESULT.json",
        )
    hint = "the file is damaged, or of another program; docs/reports.md says what is in it"
    file = to_record(data, ResultFile, path, hint=hint)
    return RunResult(
        subject=file.subject,
        results=[from_object(each, Result) for each in file.results],
        stage=file.stage,
        duration_s=file.duration_s,
        notes=list(file.notes),
        environment=file.environment,
        recorded_at=file.recorded_at,
        harness=file.harness,
        claims=file.claims,
        catalogue=file.catalogue,
        client=[from_object(each, Result) for each in file.client.results] if file.client else [],
        run=file.run,
        stories=list(file.stories),
    )
