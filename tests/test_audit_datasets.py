"""An audit takes datasets, task folders and bags as they are; an episode is a row."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from dexkit.cli import main
from dexkit.conformance.audit import audit as audits
from dexkit.conformance.audit.audit import Audit, AuditProgress, in_this_process
from dexkit.conformance.audit.examine import Task
from dexkit.conformance.audit.journal import Journal
from dexkit.conformance.audit.records import EpisodeRecord
from dexkit.conformance.audit.units import find
from dexkit.conformance.audit.workers import WorkerLost
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.traces import sample_path
from tests.dataset_files import motion, write_dataset
from tests.each import each
from tests.session_helpers import document, episode, whole


def episodes(count: int, frames: int = 150) -> list[tuple[np.ndarray, np.ndarray]]:
    return [motion(frames, phase=0.7 * i) for i in range(count)]


def audited(location: Path | str, out: Path, **options: Any) -> dict[str, EpisodeRecord]:
    Audit([str(location)], out, parquet=False, **options).run(in_this_process)
    return records(out)


def records(out: Path) -> dict[str, EpisodeRecord]:
    with Journal(out / "journal.jsonl") as journal:
        return {name: journal.read(entry) for name, entry in journal.entries.items()}


def rows(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]


def test_a_mixed_tree_is_read_episode_by_episode(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    for version in ("v2.0", "v2.1", "v3.0"):
        write_dataset(tree / "sets" / version, version, episodes(2))
    for number in range(2):
        episode(tree / f"tasks/pick/episode_{number:04d}", whole(document(cameras=0)))
    shutil.copyfile(sample_path("dex1_pick_place"), tree / "wire.mcap")
    (tree / "notes.txt").write_text("nothing")
    found = audited(tree, tmp_path / "out")
    names = {name.removeprefix(f"{tree}/"): record for name, record in found.items()}
    assert {name: record.form for name, record in names.items()} == {
        **{
            f"sets/{version}/episode_00000{n}": f"LeRobot {version}"
            for version in ("v2.0", "v2.1", "v3.0")
            for n in range(2)
        },
        **{
            f"tasks/pick/episode_000{n}": "xr_teleoperate v1.0 to v1.2 (written at the end)"
            for n in range(2)
        },
        "wire.mcap": "recording",
    }
    assert all(record.error == "" for record in found.values())
    assert all(record.judgement is not None for record in found.values())
    assert names["sets/v3.0/episode_000001"].episode == "1"
    assert names["tasks/pick/episode_0001"].source == f"{tree}/tasks/pick"
    assert names["wire.mcap"].overall == "pass"
    sets = [row for row in rows(tmp_path / "out") if row["is_set"]]
    assert {row["form"] for row in sets} == {"LeRobot v2.0", "LeRobot v2.1", "LeRobot v3.0"}
    listing = json.loads((tmp_path / "out/episodes.json").read_text())
    assert (listing["format"], listing["version"]) == ("dexkit-episodes", 1)
    assert {e["place"] for e in listing["episodes"]} == {
        *(str(tree / "sets" / v) for v in ("v2.0", "v2.1", "v3.0")),
        str(tree / "tasks/pick"),
        str(tree / "wire.mcap"),
    }
    assert {type(e["episode"]) for e in listing["episodes"]} == {int, str}


def _without(path: str) -> Any:
    return lambda root: (root / path).unlink()


def _cut(path: str) -> Any:
    def cut(root: Path) -> None:
        data = (root / path).read_bytes()
        (root / path).write_bytes(data[: len(data) // 2])

    return cut


def _text(path: str, text: bytes) -> Any:
    return lambda root: (root / path).write_bytes(text)


_BROKEN = {
    "without metadata": ("v2.1", _without("meta/info.json"), 1, "info.json"),
    "without its list": ("v2.1", _without("meta/episodes.jsonl"), 1, "no list of its episodes"),
    "half a file": ("v2.1", _cut("data/chunk-000/episode_000001.parquet"), 1, "Parquet"),
    "half of all": ("v3.0", _cut("data/chunk-000/file-000.parquet"), 3, "Parquet"),
    "a line cut": ("v2.1", _cut("meta/episodes.jsonl"), 1, "episodes.jsonl, line"),
    "a file gone": ("v2.0", _without("data/chunk-000/episode_000002.parquet"), 1, ""),
    "of version 9": ("v3.0", _text("meta/info.json", b'{"codebase_version": "v9"}'), 1, "v9"),
    "no UTF-8": ("v2.1", _text("meta/info.json", b'{"a": "\xff"}'), 1, "UTF-8"),
    "no Parquet": ("v3.0", _text("data/chunk-000/file-000.parquet", b"text"), 3, "Parquet"),
}


@each("name", list(_BROKEN))
def test_a_broken_dataset_is_rows_and_never_the_end(tmp_path: Path, name: str) -> None:
    version, spoil, bad, text = _BROKEN[name]
    tree = tmp_path / "tree"
    spoil(write_dataset(tree / "spoiled", version, episodes(3)))
    write_dataset(tree / "good", "v3.0", episodes(1))
    found = audited(tree, tmp_path / "out")
    unusable = {n: r for n, r in found.items() if r.exit_code == 2}
    assert len(unusable) == bad, {n: r.error for n, r in found.items()}
    assert all(record.error for record in unusable.values())
    assert any(text in record.error for record in unusable.values()), unusable
    assert all(n.startswith(f"{tree}/spoiled") for n in unusable)
    assert found[f"{tree}/good/episode_000000"].use == "keep"
    listed = json.loads((tmp_path / "out/episodes.json").read_text())["episodes"]
    episodes_there = {r.episode for r in unusable.values()} - {""}
    assert {str(e["episode"]) for e in listed if e["verdict"] == "drop"} == episodes_there


def test_names_that_are_no_utf8_are_rows(tmp_path: Path) -> None:
    name = os.fsdecode(b"set-\xff\xfe")
    write_dataset(tmp_path / "set", "v2.1", episodes(1)).rename(tmp_path / name)
    (tmp_path / "tree").mkdir()
    (tmp_path / name).rename(tmp_path / "tree" / name)
    episode(tmp_path / "tree/x" / os.fsdecode(b"\xe9pisode"), whole(document(cameras=0)))
    found = audited(tmp_path / "tree", tmp_path / "out")
    assert [record.error for record in found.values()] == ["", ""]
    assert (tmp_path / "out/episodes.jsonl").read_bytes().decode("ascii")
    (tmp_path / "out/summary.html").read_text("utf-8")


def test_changed_episodes_are_judged_again_and_no_others(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "set", "v2.1", episodes(3))
    out = tmp_path / "out"

    def run() -> AuditProgress:
        return Audit([str(root)], out, parquet=False).run(in_this_process)

    assert run().reused == 0
    assert run().reused == 3
    os.utime(root / "data/chunk-000/episode_000001.parquet", ns=(1, 1))
    assert run().reused == 2
    (root / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "another"}\n')
    assert run().reused == 0
    assert Audit([str(root)], out, parquet=False, cameras=False).run(in_this_process).reused == 0


def test_an_episode_that_ends_its_process_does_not_take_others_with_it(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "set", "v3.0", episodes(3))

    def runner(tasks: Iterable[Task], stop: object) -> Iterator[Any]:
        for task in tasks:
            if any(unit.number == 1 for unit in task.units):
                yield task, WorkerLost("its process died (SIGKILL)")
            else:
                yield from in_this_process([task], stop)

    outcome = Audit([str(root)], tmp_path / "out", parquet=False).run(runner)
    found = {r.episode: r for r in records(tmp_path / "out").values()}
    assert (outcome.done, outcome.unusable) == (3, 1), {n: r.error for n, r in found.items()}
    assert "SIGKILL" in found["1"].error
    assert [found[n].error for n in "02"] == ["", ""]


def test_datasets_and_task_folders_behind_a_url(tmp_path: Path) -> None:
    local = tmp_path / "sets"
    write_dataset(local / "two", "v2.1", episodes(2))
    write_dataset(local / "three", "v3.0", episodes(2))
    episode(local / "task/episode_0000", whole(document(cameras=0)))
    memory = MemoryFileSystem()
    try:
        memory.put(str(local), "/sets", recursive=True)
        remote = audited("memory://sets", tmp_path / "out")
        again = Audit(["memory://sets"], tmp_path / "out", parquet=False).run(in_this_process)
    finally:
        memory.rm("/sets", recursive=True)
    here = audited(local, tmp_path / "here")
    keys = {name.removeprefix(str(local)): record.sha256 for name, record in here.items()}
    assert {n.removeprefix("memory:///sets"): r.sha256 for n, r in remote.items()} == keys
    assert len(keys) == 5
    assert again.reused == 5


def test_findings_of_the_comparison_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "set", "v3.0", episodes(3))
    name = "set/episode_000002"

    def compared(judgements: Any, whole: Any) -> dict[str, list[Finding]]:
        assert set(judgements) == {f"set/episode_00000{n}" for n in range(3)}
        assert whole.name == "set"
        found = {name: [Finding("duplicate", Use.DROP, "it is episode 0 again")]}
        return {**found, "set": [Finding("statistics", Use.REVIEW, "they are of other data")]}

    monkeypatch.setattr(audits, "across", compared)
    monkeypatch.chdir(root.parent)
    with pytest.raises(SystemExit) as ended:
        main(["audit", "set", "--jobs", "1", "--set", "format=jsonl"])
    assert ended.value.code == 1
    text = "".join(capsys.readouterr())
    assert "3 of 3 episodes, 0.00 h: 2 keep, 0 review, 1 drop" in text
    assert "1 dataset whose metadata" in text
    assert "--drop" in text
    assert "lerobot-edit-dataset" in text
    out = tmp_path / "audit-out"
    verdicts = {row["episode"]: row["verdict"] for row in rows(out)}
    assert verdicts[name] == "drop"
    assert verdicts["set"] == "review"
    (dropped,) = [
        e for e in json.loads((out / "episodes.json").read_text())["episodes"] if e["reasons"]
    ]
    assert (dropped["episode"], dropped["reasons"]) == (2, ["it is episode 0 again"])


def test_a_folder_without_episodes_has_none(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()  # of no dataset
    (tmp_path / "notes.jsonl").write_text("{}")
    assert list(find(str(tmp_path))) == []
