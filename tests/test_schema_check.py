"""The compiled check of a schema agrees with ``jsonschema``."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Iterator
from importlib.resources import files
from typing import Any

import pytest

from dexkit.conformance.judge import judge
from dexkit.conformance.recording import Recording
from dexkit.conformance.result_file import SCHEMA
from dexkit.conformance.schema_check import compiled
from dexkit.traces import open_trace, sample_path
from tests.each import each

jsonschema = pytest.importorskip("jsonschema")

_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 1.0, 1.5, -0.5, 1e300, math.nan, math.inf, "", "a", "abcd"),
    *([], [1], [1, 1, 1, 1], ["a", None], {}, {"a": 1}, {"a": "x", "b": 2, "c": []}),
)


@each(
    "schema",
    [
        {"type": "integer"},
        {"type": ["number", "null"]},
        {"type": ["object", "array", "string", "boolean"]},
        {"enum": [1, "a", None]},
        {"enum": [True, 0]},
        {"const": False},
        {"const": 1},
        {"pattern": "b"},
        {"required": ["a"]},
        {"minimum": 0, "maximum": 1},
        {"minLength": 1, "maxLength": 3},
        {"minItems": 1, "maxItems": 2},
        {"maxProperties": 1},
        {"items": {"type": "number"}},
        {"propertyNames": {"enum": ["a", "b"]}},
        {"oneOf": [{"type": "number"}, {"type": "integer"}, {"type": "null"}]},
        {"properties": {"a": {"type": "string"}}, "additionalProperties": {"type": "integer"}},
        {"properties": {"a": {"type": "integer"}}, "additionalProperties": False},
        {"additionalProperties": True},
        {"$ref": "#/$defs/tree", "$defs": {"tree": {"items": {"$ref": "#/$defs/tree"}}}},
        {"$ref": "#/$defs/x", "type": "array", "$defs": {"x": {"minItems": 1}}},
    ],
)
def test_every_keyword_is_applied_as_by_jsonschema(schema: dict[str, Any]) -> None:
    check, reference = compiled(schema), jsonschema.Draft202012Validator(schema)
    for value in _VALUES:
        assert check(value) is reference.is_valid(value), (schema, value)


@each(
    "schema", [{"not": {}}, {"enum": [[1]]}, {"$ref": "other.json"}, {"items": {"uniqueItems": 1}}]
)
def test_an_unknown_keyword_is_an_error(schema: dict[str, Any]) -> None:
    with pytest.raises(NotImplementedError):
        compiled(schema)


def published(name: str) -> dict[str, Any]:
    text = files("dexkit.conformance.report").joinpath(name).read_text("utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


def places(value: Any, parent: Any = None, key: Any = None) -> Iterator[tuple[Any, Any]]:
    """Every member and element of a document, as its container and key."""
    if parent is not None:
        yield parent, key
    if isinstance(value, dict | list):
        for k, v in list(value.items() if isinstance(value, dict) else enumerate(value)):
            yield from places(v, value, k)


def test_the_published_schema_is_checked_as_by_jsonschema() -> None:
    schema = published(SCHEMA)
    check, reference = compiled(schema), jsonschema.Draft202012Validator(schema)
    whole = judge(Recording.decode(open_trace(sample_path("dex1_pick_place")))).as_dict()
    data = json.loads(json.dumps(whole))
    results = data["results"]
    data["results"] = [r for r in results if r["plots"]][:1] + results[:1]
    assert check(data)
    assert reference.is_valid(data)
    draw = random.Random(1)
    found = set()
    for _ in range(50):
        changed = copy.deepcopy(data)
        parent, key = draw.choice(list(places(changed)))
        way = draw.choice(("replace", "remove", "add"))
        if way == "replace":
            parent[key] = draw.choice(_VALUES)
        elif way == "remove":
            del parent[key]
        elif isinstance(parent, dict):
            parent["surprise"] = draw.choice(_VALUES)
        else:
            parent.append(draw.choice(_VALUES))
        assert check(changed) is reference.is_valid(changed), (way, key)
        found.add(check(changed))
    assert found == {True, False}


def test_the_schema_of_selftests_is_compiled() -> None:
    assert not compiled(published("selftest.schema.json"))({})
