"""A recording gives the verdicts of its run again: same data, in any process.

tests/test_package.py does the same in other Pythons.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.result_file import as_document
from dexkit.conformance.kit.run_record import (
    RECORD,
    catalogue_digest,
    recorded_claims,
    recorded_dialect,
    recorded_subjects,
)
from dexkit.hand import Side
from dexkit.traces import open_trace
from tests.conformance_helpers import copy_of, short_run
from tests.reproduction_helpers import CLAIMS, checked, without_surroundings, write_run


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of both kinds of evidence: figures of time with an error, and of position."""
    return write_run(tmp_path_factory.mktemp("run") / "run.mcap")


@pytest.fixture(scope="module")
def again(recording: Path) -> dict[str, Any]:
    """What ``dexkit check`` writes of it."""
    return checked(recording, recording.parent / "again.json")


def as_written(data: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(data))
    return found


def test_check_of_a_recording_repeats_the_result_of_the_run(
    recording: Path, again: dict[str, Any]
) -> None:
    # as the suite does after a run: what was asked for, not what the recording says
    view = recording_of(open_trace(recording), "unitree_go", (Side.LEFT,))
    live = judge(view, requirements=CLAIMS.apply(catalogue("dex1-1", "dds")), claims=CLAIMS)
    assert without_surroundings(again) == without_surroundings(as_written(as_document(live)))
    assert again["claims"] == dict(CLAIMS.units or {})
    measures = [r["measure"] for r in again["results"] if r["measure"]]
    assert {m["quantity"] for m in measures} >= {"time", "position"}
    assert any(m["error"] == pytest.approx(0.001234) for m in measures)


def test_selected_requirements_get_the_same_verdicts_as_in_a_whole_check(recording: Path) -> None:
    view = recording_of(open_trace(recording), None, ())
    every = {(r["id"], r["side"]): r for r in as_document(judge(view))["results"]}
    some = [r for r in catalogue("dex1-1", "dds") if r.id.startswith("DEX1-RATE")]
    part = as_document(judge(view, requirements=some))["results"]
    assert part
    assert all(every[r["id"], r["side"]] == r for r in part)


def test_order_of_sets_changes_nothing(
    recording: Path, again: dict[str, Any], tmp_path: Path
) -> None:
    assert checked(recording, tmp_path / "r.json", hash_seed="1") == again


def test_order_of_topics_in_memory_changes_nothing() -> None:
    trace = copy_of(short_run())
    turned = copy_of(trace)
    turned.rows = dict(reversed(list(trace.rows.items())))
    turned.endpoints.reverse()
    first, second = (as_document(judge(Recording.decode(t))) for t in (trace, turned))
    assert first == second


def test_run_record_says_how_the_run_was_made(recording: Path, again: dict[str, Any]) -> None:
    run = open_trace(recording).metadata[RECORD]
    assert all(
        run[k] for k in ("dexkit", "python", "numpy", "kernel", "processor", "cores", "seed")
    )
    assert run["catalogue"] == catalogue_digest()
    assert (recorded_dialect(run), recorded_subjects(run)) == ("unitree_go", (Side.LEFT,))
    assert recorded_claims(run) == CLAIMS
    assert again["run"] == run


@pytest.mark.parametrize("value", ["", "{", "7", "null", '["up"]', '{"claims": {"wings": true}}'])
def test_damaged_run_record_is_as_none(value: str) -> None:
    run = dict.fromkeys(("dialect", "sides", "claims"), value)
    assert recorded_dialect(run) is None
    assert recorded_subjects(run) == ()
    assert recorded_claims(run) == Claims()
