"""What a run found: one object, written as JSON, from which every report is rendered.

Verdicts (h2spec and Autobahn grade theirs likewise; a plain pass or fail hides too much):

============== ============================================================================
pass           judged, and met
fail           a MUST that is not met
warn           a SHOULD that is not met; does not fail the hand
not claimed    about a unit that the vendor does not claim (:mod:`~.claims`)
not applicable cannot be judged here, with the reason; never counts as a pass
blocked        another requirement failed first, or the kit's own machine was too busy
error          the kit's own fault
============== ============================================================================
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from dexkit import __version__, documents
from dexkit.conformance.requirements import Level, Requirement
from dexkit.errors import UsageError
from dexkit.untrusted import REMARK, one_line

__all__ = [
    "BUSY",
    "FORMAT",
    "TOO_BUSY",
    "Evidence",
    "Overall",
    "Result",
    "RunResult",
    "Stage",
    "Verdict",
    "environment",
    "overall_of",
    "read_json",
    "worst",
]

TOO_BUSY = "the machine was too busy"
"""How the reason of a result begins that a busy machine may have caused."""
BUSY = "the machine was busy"
"""How the reason of a failure begins that was seen on a busy machine, but is larger than that."""
FORMAT = "dexkit-conformance-result"
VERSION = 2


class Verdict(str, Enum):
    """What was found for one requirement; see the module."""

    PASS = "pass"
    FAIL = "fail"
    WARN = "warn"
    NOT_CLAIMED = "not claimed"
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
    Verdict.NOT_CLAIMED,
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


class Stage(str, Enum):
    """How far a hand got: the first question when it fails."""

    NO_PARTICIPANT = "no participant"
    PARTICIPANT_SEEN = "participant seen"
    TOPIC_SEEN = "topic seen"
    TYPE_MATCHED = "type matched"
    SAMPLES_FLOWING = "samples flowing"
    MOVING = "moving"

    def __str__(self) -> str:
        return self.value


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
    :param observed: what was seen, in words.
    :param reason: why it was not judged, or empty.
    :param values: measured figures by name.
    :param cause: the likely cause of a failure.
    :param blocked_by: id of the requirement that failed first, or empty.
    """

    requirement: Requirement
    side: str
    verdict: Verdict
    figure: str = ""
    observed: str = ""
    reason: str = ""
    evidence: tuple[Evidence, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    cause: str = ""
    blocked_by: str = ""

    @property
    def expected(self) -> str:
        """What would have been right, in a few words."""
        return self.requirement.expected or self.requirement.sentence

    def explain(self) -> str:
        """Everything a person needs to act on it, in lines."""

        def say(name: str, text: str) -> None:
            lines.append(f"  {name + ':':<9} {one_line(text, REMARK)}")

        lines = [f"{self.requirement.id} ({self.requirement.level}) {self.side}: {self.verdict}"]
        say("required", self.requirement.sentence)
        if self.expected != self.requirement.sentence:
            say("expected", self.expected)
        if self.observed:
            say("observed", self.observed)
        if self.reason:
            say("reason", self.reason)
        for place in self.evidence:
            until = f" .. {place.end_s:.3f} s" if place.end_s is not None else ""
            say("where", f"{one_line(place.topic)} at {place.time_s:.3f} s{until}")
        if self.verdict in (Verdict.FAIL, Verdict.WARN):
            if self.cause:
                say("cause", self.cause)
            say("try", self.requirement.advice)
            say("source", self.requirement.source)
        return "\n".join(lines)


def environment() -> dict[str, str]:
    """Versions and machine, for the report."""
    return {
        "dexkit": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


def overall_of(results: Iterable[Result]) -> Overall:
    """Fail if a MUST failed; inconclusive if one is open, or nothing was judged at all."""
    found = list(results)
    if any(r.verdict is Verdict.FAIL for r in found):
        return Overall.FAIL
    opened = (Verdict.BLOCKED, Verdict.ERROR)
    if not any(r.verdict.judged for r in found) or any(
        r.verdict in opened and r.requirement.level is Level.MUST for r in found
    ):
        return Overall.INCONCLUSIVE
    return Overall.PASS


@dataclass
class RunResult:
    """A whole run.

    :param subject: what was judged: ``backend``, ``recording``, ``dialect``, ``sides``, ...
    :param stage: per side how far it got.
    :param duration_s: seconds of the recording.
    :param notes: remarks on the recording.
    :param harness: how fair the kit's own machine was, where it made the run: ``jitter_p50_ms``
        and ``jitter_p99_ms``, by which it was late itself, and ``starved``, the part of the run,
        0 to 1, in which programs waited for a processor.
    :param claims: by unit, whether the vendor claims it; None where nothing is said.
    :param catalogue: how many requirements there are for such a run, selected or not; 0 if it is
        not known.
    """

    subject: dict[str, str]
    results: list[Result]
    stage: dict[str, Stage] = field(default_factory=dict)
    duration_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=environment)
    recorded_at: str = ""
    harness: dict[str, float] = field(default_factory=dict)
    claims: dict[str, bool] | None = None
    catalogue: int = 0

    @property
    def partial(self) -> bool:
        """Whether only a part of the catalogue was selected: no proof of a drop-in."""
        return sum(self.counts().values()) < self.catalogue

    @property
    def starved(self) -> float:
        """Part of the run, 0 to 1, in which programs waited for a processor on its machine."""
        return self.harness.get("starved", 0.0)

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
        """Whether the run should be done again, because the kit's own machine was busy: a MUST is
        open only for that, or all that failed was seen while it was so.
        """
        failed = [r for r in self.results if r.verdict is Verdict.FAIL]
        if failed:
            return all(r.reason.startswith(BUSY) for r in failed)
        return self.overall is Overall.INCONCLUSIVE and any(
            r.verdict is Verdict.BLOCKED and r.reason.startswith(TOO_BUSY) for r in self.results
        )

    @property
    def overall(self) -> Overall:
        """The verdict on the whole run; see :func:`overall_of`."""
        return overall_of(self.results)

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
        of = f"{total} of {self.catalogue}" if self.partial else f"{total}"
        return f"{heads[self.overall]} ({of} requirements: {', '.join(parts)})"

    def as_dict(self) -> dict[str, Any]:
        """The result as plain data."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "overall": str(self.overall),
            "sentence": self.sentence(),
            "subject": dict(self.subject),
            "claims": None if self.claims is None else dict(self.claims),
            "stage": {side: str(stage) for side, stage in self.stage.items()},
            "recorded_at": self.recorded_at,
            "duration_s": round(self.duration_s, 3),
            "catalogue": self.catalogue,
            "counts": {str(v): n for v, n in self.counts().items()},
            "harness": {name: round(value, 4) for name, value in self.harness.items()},
            "environment": dict(self.environment),
            "notes": list(self.notes),
            "results": [_result_dict(r) for r in self.results],
        }

    def write_json(self, path: Path) -> None:
        """Write the result file."""
        documents.write_file(path, json.dumps(self.as_dict(), indent=2) + "\n")


def _result_dict(result: Result) -> dict[str, Any]:
    requirement = asdict(result.requirement)
    del requirement["negative"]  # about the catalogue, no part of the format
    requirement["level"] = str(result.requirement.level)
    return {
        "id": result.requirement.id,
        "side": result.side,
        "verdict": str(result.verdict),
        "figure": result.figure,
        "expected": result.expected,
        "observed": result.observed,
        "reason": result.reason,
        "cause": result.cause,
        "blocked_by": result.blocked_by,
        "evidence": [asdict(e) for e in result.evidence],
        "values": {name: v for name, v in result.values.items() if math.isfinite(v)},
        "requirement": requirement,
    }


def read_json(path: Path) -> RunResult:
    """Read a result file back.

    :raises UsageError: it is not one, of a version that this dexkit does not know, or something
        in it is not as ``result.schema.json`` says: the error names the place.
    """
    data = documents.read_json(path)
    about = data if isinstance(data, dict) else {}
    if about.get("format") != FORMAT:
        raise UsageError(
            f"{path} is not a result file of dexkit",
            hint="'dexkit check --json FILE' and the suite's '--json FILE' write them",
        )
    if about.get("version") != VERSION:
        raise UsageError(f"{path} is version {one_line(about.get('version'), 40)} of {FORMAT}")
    _validate(data, path)
    return RunResult(
        subject=data["subject"],
        stage={side: Stage(stage) for side, stage in data["stage"].items()},
        duration_s=data["duration_s"],
        notes=data["notes"],
        environment=data["environment"],
        harness=data["harness"],
        claims=data["claims"],
        catalogue=data["catalogue"],
        recorded_at=data["recorded_at"],
        results=[_result_of(entry) for entry in data["results"]],
    )


@cache
def _validator() -> Any:
    import jsonschema

    text = Path(__file__).with_name("report").joinpath("result.schema.json").read_text("utf-8")
    return jsonschema.Draft202012Validator(json.loads(text))


def _validate(data: Any, path: Path) -> None:
    """Hold a document to the schema that is published with dexkit.

    :raises UsageError: naming the first place that is not as it says.
    """
    from jsonschema.exceptions import relevance

    error = min(_validator().iter_errors(data), key=relevance, default=None)
    if error is None:
        return
    while error.context:  # of several alternatives: what is wrong with the nearest
        error = min(error.context, key=relevance)
    where = one_line(error.json_path.removeprefix("$").removeprefix(".") or "the document")
    raise UsageError(
        f"{path}: {where} {_expected(error.validator, error.validator_value, error.instance)}",
        hint="the file is damaged, or was written by another program; docs/reports.md says what is "
        "in a result file",
    )


_KINDS = {
    dict: "an object",
    list: "a list",
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    type(None): "null",
}
_NAMES = {
    "object": "an object",
    "array": "a list",
    "string": "a text",
    "boolean": "true or false",
    "integer": "a whole number",
    "number": "a number",
    "null": "null",
}


def _expected(rule: str, value: Any, found: Any) -> str:
    """What a rule of the schema wants, and what is there instead."""
    is_there = _KINDS[type(found)]
    if isinstance(found, str | int | float | bool):
        is_there = one_line(json.dumps(found), 60)
    if rule == "type":
        kinds = [value] if isinstance(value, str) else value
        return f"must be {' or '.join(_NAMES[kind] for kind in kinds)}, not {is_there}"
    if rule == "required":
        missing = [name for name in value if name not in found]
        return f"has no {', '.join(missing)}"
    if rule == "enum":
        return f"must be one of {', '.join(json.dumps(v) for v in value)}, not {is_there}"
    if rule == "const":
        return f"must be {json.dumps(value)}, not {is_there}"
    if rule in ("minimum", "maximum"):
        return f"must be {'at least' if rule == 'minimum' else 'at most'} {value:g}, not {is_there}"
    if rule == "additionalProperties":
        return "holds something that is not known"
    if rule in ("maxLength", "maxItems", "maxProperties", "minLength"):
        return f"is too {'short' if rule == 'minLength' else 'long'} ({rule} {value})"
    if rule == "pattern":
        return f"is not of the form {value}: {is_there}"
    return f"is not as it should be ({rule})"


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
        cause=entry["cause"],
        blocked_by=entry["blocked_by"],
        evidence=tuple(Evidence(**e) for e in entry["evidence"]),
        values=entry["values"],
    )
