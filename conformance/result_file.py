"""Read a result file, and validate it against its schema."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from dexkit import documents
from dexkit.conformance.measurement_error import Measure
from dexkit.conformance.plots import Plot
from dexkit.conformance.requirements import Kind, Level, Requirement
from dexkit.conformance.results import (
    FORMAT,
    VERSION,
    Disturbance,
    Evidence,
    Load,
    Result,
    RunResult,
    Stage,
    Verdict,
)
from dexkit.errors import UsageError
from dexkit.escaping import one_line

__all__ = ["SCHEMA", "parse_result", "read_json", "validate"]

SCHEMA = "result.schema.json"
"""The schema of a result, beside the reports."""


def read_json(path: Path) -> RunResult:
    """Read a result file.

    :raises UsageError: it is not a result file, its version is unknown, or it does not match
        ``result.schema.json``: the error names the place.
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
            hint="'dexkit check --json FILE' and the suite's '--json FILE' write them",
        )
    if about.get("version") != VERSION:
        version = one_line(about.get("version"), 40)
        raise UsageError(
            f"{path}: version {version} of {FORMAT} is not read by this dexkit, but {VERSION}",
            hint="judge the recording again: dexkit check RECORDING.mcap --json RESULT.json",
        )
    validate(data, path)
    return RunResult(
        subject=data["subject"],
        stage={side: Stage(stage) for side, stage in data["stage"].items()},
        duration_s=data["duration_s"],
        notes=data["notes"],
        environment=data["environment"],
        run=data["run"],
        harness=data["harness"],
        claims=data["claims"],
        catalogue=data["catalogue"],
        recorded_at=data["recorded_at"],
        results=[_result_of(entry) for entry in data["results"]],
        client=[_result_of(entry) for entry in (data["client"] or {"results": []})["results"]],
    )


@cache
def _validator(schema: str) -> Any:
    import jsonschema

    text = Path(__file__).with_name("report").joinpath(schema).read_text("utf-8")
    return jsonschema.Draft202012Validator(json.loads(text))


_VALID: set[tuple[str, bytes]] = set()
"""Schema and digest of each document that was found valid: some commands read one twice."""


def validate(data: Any, path: object, schema: str = SCHEMA, page: str = "docs/reports.md") -> None:
    """Validate a document against a schema that is published with dexkit.

    A document that was found valid before is not validated again.

    :param path: what to call the document.
    :param schema: file beside the reports.
    :param page: where the document is described.
    :raises UsageError: naming the first place that does not match.
    """
    about = schema, hashlib.sha256(json.dumps(data).encode()).digest()
    if about in _VALID:
        return
    from jsonschema.exceptions import relevance

    error = min(_validator(schema).iter_errors(data), key=relevance, default=None)
    if error is None:
        _VALID.add(about)
        return
    while error.context:  # of several alternatives: the error of the nearest
        error = min(error.context, key=relevance)
    where = one_line(error.json_path.removeprefix("$").removeprefix(".") or "the document")
    raise UsageError(
        f"{path}: {where} {_expected(error.validator, error.validator_value, error.instance)}",
        hint=f"the file is damaged, or was written by another program; {page} says what is in it",
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
    """The expected and the actual value for a rule of the schema."""
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
    data["plots"] = _plots(data["plots"])
    data["kind"] = Kind(data["kind"])
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
        joints=tuple(entry["joints"]),
        disturbance=Disturbance(
            **{**entry["disturbance"], "load": Load(entry["disturbance"]["load"])}
        ),
        plots=_plots(entry["plots"]),
        retry=entry["retry"],
        measure=Measure.of_dict(entry["measure"]) if entry["measure"] else None,
    )


def _plots(names: Iterable[str]) -> tuple[Plot, ...]:
    return tuple(Plot.parse(name) for name in names)
