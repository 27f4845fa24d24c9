"""Test result files against the JSON schema of their form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import pytest

from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import CONFIDENCE
from dexkit.conformance.kit.result_file import (
    Confidence,
    LayerName,
    ResultFile,
    SideName,
    as_document,
    write_json,
)
from dexkit.conformance.layers import LAYERS
from dexkit.hand import ROBOT, Side
from dexkit.records import json_schema, to_record
from dexkit.traces import open_trace, sample_path
from tests.conformance_helpers import short_run

jsonschema = pytest.importorskip("jsonschema")


def schema() -> dict[str, Any]:
    return json_schema(ResultFile)


def validate(data: object) -> None:
    jsonschema.Draft202012Validator(schema()).validate(data)


def test_schema_is_valid() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())


@pytest.mark.parametrize("name", ["dex1_hand_dropout", "dex3_pinch"])
def test_results_of_genuine_recordings_validate(name: str, tmp_path: Path) -> None:
    result = judge(Recording.decode(open_trace(sample_path(name))), subject={"recording": name})
    write_json(result, tmp_path / "r.json")
    validate(json.loads((tmp_path / "r.json").read_text()))


def test_a_result_with_claims_and_stimulus_validates() -> None:
    recording = Recording.decode(short_run(), sides=tuple(Side))
    claims = Claims.parse('[hand]\nname = "x"\n[claims]\nvelocity = true')
    data = json.loads(json.dumps(as_document(judge(recording, claims=claims))))
    validate(data)
    assert data["harness"] == {"starved": 0.0}
    assert {r["verdict"] for r in data["results"]} >= {"pass", "fail", "blocked", "not claimed"}
    with pytest.raises(jsonschema.ValidationError):
        validate({**data, "version": 2})
    with pytest.raises(jsonschema.ValidationError):
        validate({**data, "surprise": 1})


def test_form_lists_every_value_of_a_text() -> None:
    assert get_args(Confidence) == CONFIDENCE
    assert get_args(LayerName) == tuple(LAYERS)
    for side in (*Side, ROBOT):
        assert to_record(str(side), SideName, "it") == str(side)
