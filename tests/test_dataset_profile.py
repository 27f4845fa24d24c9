"""A session in another format is not blamed for what the format does not have."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.models import DIALECTS
from dexkit.traces import sample_path
from dexkit.traces.sessions.carried import FORMATS, format_of
from dexkit.traces.sessions.episodes import _COLUMNS
from dexkit.traces.sessions.judgeable import judgeable
from dexkit.traces.sessions.lerobot_format import COLUMNS
from dexkit.traces.sessions.streams import COMMAND, FIELDS, STATE
from tests.session_helpers import dexkit

SAMPLES = {
    "brainco_grip": "brainco-revo2",
    "dex1_hand_dropout": "dex1-1",
    "dex1_idle_then_startle": "dex1-1",
    "dex1_legacy_v1_1": "dex1-1",
    "dex1_pick_place": "dex1-1",
    "dex3_pinch": "dex3-1",
    "dex5_synthetic": "dex5-1",
    "inspire_dfx_grip": "inspire-dfx",
    "inspire_ftp_grip": "inspire-ftp",
}
FRAMED = ["lerobot", "lerobot fps=30", "episodes", "episodes fps=30"]
WHOLE = ["parquet", "csv", "rosbag2", "rosbag2 storage=mcap"]
FILLED_IN = ("TOPIC", "QOS", "START", "ORDER", "RATE", "FRESH", "MODE", "SENS", "TOUCH", "IMU")
"""Areas of what no frame has."""


WINDOWS = {"dex1_hand_dropout": "8:13"}
"""Seconds of each sample; that of the drop-out is where it is."""


@pytest.fixture(scope="module", params=SAMPLES)
def sample(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some seconds of a sample, under its name."""
    path = tmp_path_factory.mktemp("sample") / f"{request.param}.mcap"
    window = WINDOWS.get(request.param, ":6")
    assert dexkit("cut", sample_path(request.param), path, "--window", window)[0] == 0
    return path


def results(path: Path) -> list[Result]:
    """Of the hands, and of their client."""
    with judgeable(path) as (trace, _):
        result = judge(recording_of(trace, None, ()))
    return [*result.results, *result.client]


def failed(every: Iterable[Result]) -> set[str]:
    return {
        r.requirement.id
        for r in every
        if r.verdict in (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)
    }


def passed(every: Iterable[Result]) -> set[str]:
    return {r.requirement.id for r in every if r.verdict is Verdict.PASS}


def exported(sample: Path, form: str, out: Path) -> Path:
    """:param form: the format, and settings."""
    name, *settings = form.split()
    words = [word for setting in settings for word in ("--set", setting)]
    code, output = dexkit("export", sample, "--to", name, "--out", out, *words)
    assert code == 0 or "frames in gaps" in output, output
    return out


def imported(source: Path, out: Path, *options: object) -> list[Path]:
    code, output = dexkit("import", source, out, *options)
    assert code == 0 or "look swapped" in output, output
    return [out] if out.is_file() else sorted(out.rglob("*.mcap"))


def without_times(source: Path) -> None:
    """Make of an export what other programs write: no times, and no word of dexkit."""
    for path in source.rglob("data.json"):
        document = json.loads(path.read_text(encoding="utf-8"))
        del document["info"]["dexkit"]
        for item in document["data"]:
            del item["timestamp_ns"]
        path.write_text(json.dumps(document), encoding="utf-8")
    for path in source.rglob("info.json"):
        document = json.loads(path.read_text(encoding="utf-8"))
        del document["dexkit"]
        path.write_text(json.dumps(document), encoding="utf-8")


def without_effort(source: Path) -> None:
    """Make of an export a dataset with positions alone, as unitree_lerobot writes it."""
    path = source / "meta/info.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    for name in ("velocity", "effort", "pressure"):
        document["features"].pop(f"observation.{name}", None)
    path.write_text(json.dumps(document), encoding="utf-8")


@pytest.mark.parametrize("form", FRAMED)
def test_frames_of_a_good_session(tmp_path: Path, sample: Path, form: str) -> None:
    source = exported(sample, form, tmp_path / "set")
    named = ("--set", f"hand={SAMPLES[sample.stem]}")
    lerobot = form.startswith("lerobot")
    files = imported(source, tmp_path / "measured", *(() if lerobot else named))
    without_times(source)
    files += imported(source, tmp_path / "nominal", *named)
    if lerobot:
        without_effort(source)
        files += imported(source, tmp_path / "bare", *named)
    for path in files:
        found = results(path)
        assert failed(found) == set(), path
        assert passed(found), "something is judged"
        filled_in = {id for id in passed(found) if id.split("-")[1] in FILLED_IN}
        assert filled_in == set(), path


@pytest.mark.parametrize("form", WHOLE)
def test_messages_of_a_session(tmp_path: Path, sample: Path, form: str) -> None:
    """What the session itself is blamed for, and nothing else."""
    source = exported(sample, form, tmp_path / "x")
    is_bag = form.startswith("rosbag2")
    path = source if is_bag else imported(source, tmp_path / "x.mcap")[0]
    assert failed(results(path)) == failed(results(sample))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported episode of a Dex1-1, which at 196 Hz is too slow for its service."""
    folder = tmp_path_factory.mktemp("dataset")
    source = exported(sample_path("dex1_pick_place"), "lerobot", folder / "set")
    return imported(source, folder / "in")[0]


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_of_an_imported_episode_is_still_one_of_frames(
    tmp_path: Path, dataset: Path, storage: str
) -> None:
    bag = exported(dataset, f"rosbag2 storage={storage}", tmp_path / "bag")
    found = results(bag)
    assert failed(found) == set()
    assert passed(found) == passed(results(dataset))


def test_so_is_a_merge_of_two_imported_episodes(tmp_path: Path, dataset: Path) -> None:
    source = exported(sample_path("dex3_pinch"), "lerobot", tmp_path / "set")
    other = imported(source, tmp_path / "in")[0]
    assert dexkit("merge", other, dataset, tmp_path / "both.mcap")[0] == 0
    assert failed(results(tmp_path / "both.mcap")) == set()
    assert passed(results(tmp_path / "both.mcap")) <= passed(results(dataset))


def frozen(rows: np.ndarray) -> np.ndarray:
    return np.repeat(rows[:1], len(rows), axis=0)


def wrong_sides(rows: np.ndarray) -> np.ndarray:
    return np.roll(rows, rows.shape[1] // 2, axis=1)


@pytest.mark.parametrize("spoil", [frozen, wrong_sides])
def test_a_spoiled_session_is_told_by_its_fault(
    tmp_path: Path, spoil: Callable[[np.ndarray], np.ndarray]
) -> None:
    import pyarrow
    import pyarrow.parquet

    source = exported(sample_path("dex3_pinch"), "lerobot fps=30", tmp_path / "set")
    for path in (source / "data").rglob("*.parquet"):
        table = pyarrow.parquet.read_table(path)
        at = table.column_names.index("observation.state")
        field = table.schema.field(at)
        rows = np.array(table.column(at).to_pylist(), dtype=np.float32)
        spoiled = pyarrow.array(spoil(rows).tolist(), field.type)
        pyarrow.parquet.write_table(table.set_column(at, field, spoiled), path)
    found = results(imported(source, tmp_path / "in", "--set", "keep-sides=yes")[0])
    told = {r.requirement.id for r in found if r.verdict in (Verdict.FAIL, Verdict.WARN)}
    assert told
    assert told <= {"DEX3-TRACK-01", "DEX3-FIELD-03"}


def test_a_recorder_that_stood_still_is_not_the_hand(tmp_path: Path) -> None:
    """All topics of the sample have a gap as received, and none as sent; a bag has only that."""
    source = exported(sample_path("inspire_ftp_grip"), "rosbag2", tmp_path / "bag")
    found = {r.verdict for r in results(source) if r.requirement.id == "FTP-RATE-03"}
    assert found == {Verdict.WARN}


def test_an_unnamed_hand_of_frames_is_told_how_to_be_judged(tmp_path: Path) -> None:
    source = exported(sample_path("brainco_grip"), "episodes fps=30", tmp_path / "set")
    path = imported(source, tmp_path / "in")[0]
    code, output = dexkit("check", path)
    assert code == 2
    assert "--set hand=MODEL" in output


def test_a_dataset_is_no_recording(tmp_path: Path) -> None:
    source = exported(sample_path("dex1_pick_place"), "lerobot fps=30", tmp_path / "set")
    code, output = dexkit("check", source)
    assert code == 2
    assert "dexkit audit" in output


def test_the_table_of_formats_is_what_is_read_and_written() -> None:
    lerobot = {kind: tuple(f for k, f in COLUMNS if k == kind) for kind in (STATE, COMMAND)}
    assert FORMATS["LeRobot"].fields == lerobot
    assert all(tuple(_COLUMNS) == fields for fields in FORMATS["xr_teleoperate"].fields.values())
    assert format_of("LeRobot v2.1") is FORMATS["LeRobot"]
    assert not format_of("a format of next year").whole
    assert all(f.fields == FIELDS for f in FORMATS.values() if f.whole)
    assert {DIALECTS[d].model for d in DIALECTS} >= set(SAMPLES.values())
