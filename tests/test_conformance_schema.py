"""Test result files against their published schema."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from dexkit.conformance.claims import Claims
from dexkit.conformance.judge import judge
from dexkit.conformance.layers import LAYERS
from dexkit.conformance.plots import PlotKind
from dexkit.conformance.recording import Recording
from dexkit.conformance.requirements import CONFIDENCE, Kind, Level
from dexkit.conformance.results import VERSION, Load, Overall, Stage, Verdict
from dexkit.hand import ROBOT, Side
from dexkit.traces import open_trace, sample_path
from tests.conformance_helpers import short_run

jsonschema = pytest.importorskip("jsonschema")


def schema() -> dict[str, Any]:
    text = files("dexkit.conformance.report").joinpath("result.schema.json").read_text("utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


def validate(data: object) -> None:
    jsonschema.Draft202012Validator(schema()).validate(data)


def test_schema_is_valid() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())


@pytest.mark.parametrize("name", ["dex1_hand_dropout", "dex3_pinch"])
def test_results_of_genuine_recordings_validate(name: str, tmp_path: Path) -> None:
    result = judge(Recording.decode(open_trace(sample_path(name))), subject={"recording": name})
    result.write_json(tmp_path / "r.json")
    validate(json.loads((tmp_path / "r.json").read_text()))


def test_a_result_with_claims_and_stimulus_validates() -> None:
    recording = Recording.decode(short_run(), sides=tuple(Side))
    claims = Claims.parse('[hand]\nname = "x"\n[claims]\nvelocity = true')
    data = json.loads(json.dumps(judge(recording, claims=claims).as_dict()))
    validate(data)
    assert data["harness"] == {"starved": 0.0}
    assert {r["verdict"] for r in data["results"]} >= {"pass", "fail", "blocked", "not claimed"}
    with pytest.raises(jsonschema.ValidationError):
        validate({**data, "version": 2})
    with pytest.raises(jsonschema.ValidationError):
        validate({**data, "surprise": 1})


def test_schema_lists_every_enumeration_value() -> None:
    known = schema()
    properties, defs = known["properties"], known["$defs"]
    assert properties["version"]["const"] == VERSION
    assert set(properties["overall"]["enum"]) == {str(o) for o in Overall}
    assert set(properties["counts"]["properties"]) == {str(v) for v in Verdict}
    assert set(defs["result"]["properties"]["verdict"]["enum"]) == {str(v) for v in Verdict}
    assert properties["stage"]["additionalProperties"]["enum"] == [str(s) for s in Stage]
    assert defs["side"]["enum"] == [*map(str, Side), ROBOT]
    assert defs["level"]["enum"] == [str(level) for level in Level]
    loads = defs["disturbance"]["properties"]["load"]["enum"]
    assert loads == [str(load) for load in Load]
    kinds = defs["plots"]["items"]["pattern"].removeprefix("^(").removesuffix(")$").split("|")
    assert kinds == [str(k) if k is not PlotKind.MEMBER else "member:.+" for k in PlotKind]
    assert defs["requirement"]["properties"]["confidence"]["enum"] == list(CONFIDENCE)
    assert defs["requirement"]["properties"]["layer"]["enum"] == list(LAYERS)
    assert defs["requirement"]["properties"]["kind"]["enum"] == [str(kind) for kind in Kind]
    assert list(properties["grades"]["properties"]) == [str(kind) for kind in Kind]
