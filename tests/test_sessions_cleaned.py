"""Data sets without some episodes: ``dexkit export SET OUT --drop``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.sessions.lerobot_in import Dataset
from dexkit.traces.sessions.lerobot_stats import Aggregate, statistics
from tests.each import each
from tests.session_helpers import dexkit, document, episode, streamed

LENGTHS = [5, 3, 7, 4, 6, 2, 8]
DROPPED = [1, 2, 5]
KEPT = [0, 3, 4, 6]
CAMERA = "observation.images.high"
VECTORS = ("observation.state", "action")
JOINTS = [f"kLeftHandThumb{i}" for i in range(3)]
INDEXES = {"episode_index", "index"}


def frames(number: int, first: int) -> pa.Table:
    """The frames of an episode: float32 with any bits, and a column that no other program has."""
    n = LENGTHS[number]
    random = np.random.default_rng(number)
    columns: dict[str, Any] = {}
    for name in VECTORS:
        values = random.normal(number, 1, 3 * n).astype(np.float32)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(values), 3)
    columns |= {
        "timestamp": (np.arange(n) / 30).astype(np.float32),
        "frame_index": np.arange(n),
        "episode_index": np.full(n, number),
        "index": np.arange(first, first + n),
        "task_index": np.full(n, number % 3),
        "note": pa.array(
            [None if i % 2 else f"é {number} {i}" for i in range(n)], pa.large_string()
        ),
        "next.done": np.arange(n) == n - 1,
    }
    table = pa.table(columns)
    return table.replace_schema_metadata({"huggingface": '{"info": {}}', "a": "b"})


def own_statistics(table: pa.Table) -> dict[str, Any]:
    """As an episode has them; of a picture made up."""
    names = [*VECTORS, "timestamp", "frame_index", "episode_index", "index", "task_index"]
    found: dict[str, Any] = {}
    for name in names:
        values = np.array(table[name].to_pylist())
        found[name] = statistics(values)
        if values.dtype.kind == "i":
            found[name] |= {k: [int(found[name][k][0])] for k in ("min", "max")}
    level = float(table["episode_index"][0].as_py())
    picture = {k: [[[level + i]] for i in range(3)] for k in ("min", "max", "mean", "std")}
    return found | {CAMERA: picture | {"count": [10]}}


def made(
    root: Path, version: str, *, videos: bool = True, files: Sequence[Sequence[int]] = ()
) -> Path:
    """A dataset of seven episodes and three tasks as LeRobot lays it out.

    :param files: of v3.0, the episodes of each file.
    """
    files = files or [[0, 1, 2], [3, 4], [5], [6]]
    old = version != "v3.0"
    meta = root / "meta"
    meta.mkdir(parents=True)
    starts = np.cumsum([0, *LENGTHS]).tolist()
    tables = [frames(n, starts[n]) for n in range(len(LENGTHS))]
    stats = [own_statistics(table) for table in tables]
    rows = [
        {"episode_index": n, "tasks": [f"task {n % 3}"], "length": LENGTHS[n], "who": "Zoë"}
        for n in range(len(LENGTHS))
    ]
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [3], "names": [JOINTS]} for name in VECTORS
    }
    if videos:
        features[CAMERA] = {"dtype": "video", "shape": [8, 8, 3], "names": None}
    info: dict[str, Any] = {
        "codebase_version": version,
        "robot_type": "x",
        "fps": 30,
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "total_tasks": 3,
        "chunks_size": 3 if old else 1000,
        "splits": {"train": "0:5", "test": "5:7"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if old
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
        "own key": {"a": [1, None]},
    }
    if videos:
        info["video_path"] = (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
            if old
            else "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        )
    if old:
        info |= {"total_videos": len(LENGTHS) * videos, "total_chunks": 3}
        for n, table in enumerate(tables):
            path = root / f"data/chunk-{n // 3:03d}/episode_{n:06d}.parquet"
            write(path, [table])
            if videos:
                path = root / f"videos/chunk-{n // 3:03d}/{CAMERA}/episode_{n:06d}.mp4"
                put(path, f"video of {n}")
        put_lines(meta / "episodes.jsonl", rows)
        put_lines(meta / "tasks.jsonl", [{"task_index": i, "task": f"task {i}"} for i in range(3)])
    else:
        for number, episodes in enumerate(files):
            write(root / f"data/chunk-000/file-{number:03d}.parquet", [tables[n] for n in episodes])
            put(root / f"videos/{CAMERA}/chunk-000/file-{number:03d}.mp4", f"videos of {episodes}")
            for n in episodes:
                place = {"chunk_index": 0, "file_index": number}
                rows[n] |= {f"data/{k}": v for k, v in place.items()}
                rows[n] |= {f"videos/{CAMERA}/{k}": v for k, v in place.items()}
                rows[n] |= {f"videos/{CAMERA}/from_timestamp": n / 3}
                rows[n] |= {"dataset_from_index": starts[n], "dataset_to_index": starts[n + 1]}
                rows[n] |= {f"stats/{f}/{k}": v for f, s in stats[n].items() for k, v in s.items()}
        for number, part in enumerate([rows[:4], rows[4:]]):
            path = meta / f"episodes/chunk-000/file-{number:03d}.parquet"
            write(path, [pa.Table.from_pylist(part)])
        write(meta / "tasks.parquet", [pa.table({"task_index": range(3), "task": ["a", "b", "c"]})])
    if version == "v2.1":
        put_lines(
            meta / "episodes_stats.jsonl",
            [{"episode_index": n, "stats": stats[n]} for n in range(len(LENGTHS))],
        )
    if version != "v2.1":
        names = ("min", "max", "mean", "std", "q01", "q50")
        whole = own_statistics(pa.concat_tables(tables))
        whole = {f: {k: s[k] for k in names if k in s} for f, s in whole.items()}
        put(meta / "stats.json", json.dumps(whole))
    put(meta / "info.json", json.dumps(info))
    put(root / "README.md", "read me")
    put(root / "images" / "a" / "b.png", "picture")
    put(root / ".cache" / "x", "cache")
    return root


def write(path: Path, tables: Sequence[pa.Table]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(str(path), tables[0].schema) as writer:
        for table in tables:
            writer.write_table(table)


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def put_lines(path: Path, rows: Sequence[Any]) -> None:
    put(path, "".join(json.dumps(row) + "\n" for row in rows))


def verdicts(path: Path, source: Path, found: dict[Any, str]) -> Path:
    """A file as ``dexkit audit`` writes it, with another source's episodes in it."""
    entries = [
        {
            "source": source.name,
            "place": str(source.resolve()),
            "episode": e,
            "verdict": v,
            "reasons": [f"because of {e}.", "And more."],
        }
        for e, v in found.items()
    ]
    other = {"source": "other", "place": "/no/such/set", "episode": 0, "verdict": "drop"}
    document = {"format": "dexkit-episodes", "version": 1, "episodes": [*entries, other]}
    put(path, json.dumps({**document, "later": "key"}))
    return path


def read_lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def data(root: Path) -> dict[int, pa.Table]:
    """The frames of each episode, by the reading of its file."""
    found = {}
    dataset = Dataset(root)
    for n in dataset.episodes:
        table = pq.read_table(dataset.data_file(n))
        found[n] = table.filter(pa.compute.equal(table["episode_index"], n))
    return found


def check_equal(source: Path, copy: Path, kept: Sequence[int]) -> None:
    """The copy's episodes are those of the source, bit for bit and as our reader reads them."""
    before, after = data(source), data(copy)
    assert [*after] == [*range(len(kept))]
    index = 0
    for new, old in enumerate(kept):
        a, b = before[old], after[new]
        assert a.schema.equals(b.schema, check_metadata=True)
        for name in a.column_names:
            if name not in INDEXES:
                assert a[name].combine_chunks().equals(b[name].combine_chunks()), name
                assert str(a[name].to_pylist()) == str(b[name].to_pylist())
        assert b["index"].to_pylist() == [*range(index, index + len(a))]
        index += len(a)
        one, two = Dataset(source).read(old), Dataset(copy).read(new)
        assert np.array_equal(one.times_ns, two.times_ns)
        assert one.rest == two.rest
        assert one.about["tasks"] == two.about["tasks"]
        for x, y in zip(one.parts, two.parts, strict=True):
            assert (x.name, x.joints) == (y.name, y.joints)
            for kind, columns in x.values.items():
                for name, values in columns.items():
                    assert np.array_equal(values, y.values[kind][name])
        for c, d in zip(one.cameras, two.cameras, strict=True):
            assert (c.name, c.seconds) == (d.name, d.seconds)
            video, copied = source / c.paths[0], copy / d.paths[0]
            assert video.read_bytes() == copied.read_bytes()
    info, old_info = (json.loads((r / "meta/info.json").read_text()) for r in (copy, source))
    changed = {k for k in old_info if info[k] != old_info[k]}
    totals = {"total_episodes", "total_frames", "total_videos", "total_chunks"}
    assert changed <= {*totals, "splits", "dexkit"}
    assert info.keys() == old_info.keys()
    assert (info["total_episodes"], info["total_frames"]) == (len(kept), index)


@each("videos", [True, False])
@each("version", ["v2.0", "v2.1", "v3.0"])
def test_the_other_episodes_stay_bit_for_bit(tmp_path: Path, version: str, videos: bool) -> None:
    source, out = made(tmp_path / "set", version, videos=videos), tmp_path / "out"
    before = {p: p.read_bytes() for p in source.rglob("*") if p.is_file()}
    found = {n: "drop" if n in DROPPED else "keep" for n in range(7)}
    file = verdicts(tmp_path / "e.json", source, found)
    code, output = dexkit("export", source, "--out", out, "--drop", file)
    stray = version == "v3.0" and not videos  # the files are there, and no feature names them
    assert code == stray, output
    assert "4 episodes kept, 3 dropped" in output
    assert "dropped 1: because of 1. And more." in output
    assert (
        "copied as it is, with whatever it says of dropped episodes: README.md, images/" in output
    )
    assert ("copied whole" in output) == (version == "v3.0" and videos)
    assert ("left out, as no episode names it" in output) == stray
    check_equal(source, out, KEPT)
    assert {p: p.read_bytes() for p in source.rglob("*") if p.is_file()} == before
    assert (out / "README.md").read_text() == "read me"
    assert (out / "images/a/b.png").read_text() == "picture"
    assert not (out / ".cache").exists()
    info = json.loads((out / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:3", "test": "3:4"}
    names = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    if version == "v3.0":
        place = "{}/chunk-000/file-{:03d}"
        assert {n for n in names if n.startswith("data")} == {
            place.format("data", i) + ".parquet" for i in (0, 1, 3)
        }
        assert len([n for n in names if n.endswith(".mp4")]) == 3 * videos
        assert pq.read_metadata(out / "data/chunk-000/file-001.parquet").num_row_groups == 2
        rows = pq.read_table(out / "meta/episodes").to_pylist()
        assert [r["episode_index"] for r in rows] == [0, 1, 2, 3]
        lengths = np.cumsum([0, *(LENGTHS[n] for n in KEPT)]).tolist()
        assert [r["dataset_from_index"] for r in rows] == lengths[:-1]
        assert [r["dataset_to_index"] for r in rows] == lengths[1:]
        assert [r[f"videos/{CAMERA}/from_timestamp"] for r in rows] == [n / 3 for n in KEPT]
    else:
        assert (info["total_videos"], info["total_chunks"]) == (4 * videos, 2)
        assert len([n for n in names if n.endswith(".parquet")]) == 4
        assert "data/chunk-001/episode_000003.parquet" in names
        rows = read_lines(out / "meta/episodes.jsonl")
        assert [(r["episode_index"], r["who"]) for r in rows] == [(n, "Zoë") for n in range(4)]
        tasks = "meta/tasks.jsonl"
        assert (out / tasks).read_bytes() == (source / tasks).read_bytes()
        # nothing before the first dropped one is written again
        first = "data/chunk-000/episode_000000.parquet"
        assert (out / first).read_bytes() == (source / first).read_bytes()


@each("version", ["v2.0", "v2.1", "v3.0"])
def test_statistics_are_those_of_the_episodes_that_stay(tmp_path: Path, version: str) -> None:
    source, out = made(tmp_path / "set", version), tmp_path / "out"
    code, output = dexkit("export", source, "--out", out, "--drop", "1,2,5")
    assert code == 0, output
    tables = [table for _, table in sorted(data(out).items())]
    expected = own_statistics(pa.concat_tables(tables))
    if version == "v2.1":
        lines = read_lines(out / "meta/episodes_stats.jsonl")
        assert [line["episode_index"] for line in lines] == [0, 1, 2, 3]
        for line, old, table in zip(lines, KEPT, tables, strict=True):
            same = {k: v for k, v in own_statistics(table).items() if k != CAMERA}
            for feature, found in same.items():
                assert line["stats"][feature] == found, feature
            assert line["stats"][CAMERA]["mean"][0] == [[float(old)]]
        return
    found = json.loads((out / "meta/stats.json").read_text())
    before = json.loads((source / "meta/stats.json").read_text())
    assert found.keys() == before.keys()
    for feature, stats in found.items():
        assert stats.keys() == before[feature].keys()
        if feature != CAMERA:
            for name, values in stats.items():
                assert np.allclose(values, expected[feature][name], rtol=1e-12, atol=1e-12)
    assert isinstance(found["index"]["max"][0], int)
    if version == "v2.0":
        assert found[CAMERA] == before[CAMERA]
        assert f"statistics of the whole dataset, dropped episodes included: {CAMERA}" in output
    else:
        assert found[CAMERA]["max"][0] == [[6.0]]
        rows = pq.read_table(out / "meta/episodes").to_pylist()
        for row, table in zip(rows, tables, strict=True):
            for name in ("index", "episode_index"):
                own = own_statistics(table)[name]
                assert {k: row[f"stats/{name}/{k}"] for k in own} == own


@each("at_once", [1, 60, 10**6])
def test_statistics_are_taken_from_the_frames(tmp_path: Path, at_once: int) -> None:
    """In as many portions as there must be, whatever those of the episodes are."""
    source, out = made(tmp_path / "set", "v3.0"), tmp_path / "out"
    for path in (source / "meta/episodes").rglob("*.parquet"):
        table = pq.read_table(path)
        lost = [c for c in table.column_names if c.startswith("stats/action/")]
        pq.write_table(table.drop(lost), path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexkit.traces.sessions.lerobot_cleaned._VALUES_AT_ONCE", at_once)
        code, output = dexkit("export", source, "--out", out, "--drop", "0")
    assert code == 0, output
    found = json.loads((out / "meta/stats.json").read_text())
    expected = own_statistics(pa.concat_tables(data(out).values()))
    for feature in found.keys() - {CAMERA}:
        for name, values in found[feature].items():
            assert np.allclose(values, expected[feature][name], rtol=1e-12, atol=1e-12), name


def test_aggregated_statistics_are_those_of_all_frames() -> None:
    random = np.random.default_rng(1)
    parts = [random.normal(i, 1 + i, (5 + i, 3)) for i in range(6)]
    found = Aggregate()
    for part in parts:
        found.add(statistics(part))
    expected = statistics(np.concatenate(parts))
    got = found.statistics()
    for name in ("min", "max", "mean", "std", "count"):
        assert np.allclose(got[name], expected[name], rtol=1e-12)
    for name, bound in (("q01", np.min), ("q50", np.min), ("q90", np.max)):
        assert got[name] == bound([statistics(part)[name] for part in parts], axis=0).tolist()
    for wrong in ({}, {**expected, "mean": ["a"]}, {**expected, "min": [1.0]}, {"mean": None}):
        with pytest.raises(ValueError):  # noqa: PT011
            found.add(wrong)
    assert found.episodes == 6


def test_review_is_dropped_only_if_asked(tmp_path: Path) -> None:
    source = made(tmp_path / "set", "v2.1")
    file = verdicts(tmp_path / "e.json", source, {0: "keep", 2: "review", 4: "drop"})
    code, output = dexkit("export", source, "--out", tmp_path / "a", "--drop", file)
    assert (code, "6 episodes kept, 1 dropped" in output) == (0, True), output
    assert "4 episodes that were not judged are kept" in output
    to = ("--out", tmp_path / "b", "--drop", file, "--set", "drop=review", "--json")
    code, output = dexkit("export", source, *to)
    assert code == 0, output
    found = json.loads(output[output.index("{") :])["exported"][0]
    assert (found["kept"], [d["episode"] for d in found["dropped"]]) == (5, ["2", "4"])
    check_equal(source, tmp_path / "b", [0, 1, 3, 5, 6])
    # a second time, of what is left
    code, output = dexkit("export", tmp_path / "b", "--out", tmp_path / "c", "--drop", "0,4")
    assert code == 0, output
    check_equal(source, tmp_path / "c", [1, 3, 5])


def test_frames_are_numbered_in_the_order_of_the_files(tmp_path: Path) -> None:
    """LeRobot reads all files of v3.0 by name, and finds frames by their place."""
    files = [[3, 4], [6], [0, 1, 2], [5]]
    source, out = made(tmp_path / "set", "v3.0", files=files), tmp_path / "out"
    code, output = dexkit("export", source, "--out", out, "--drop", "1,4")
    assert code == 0, output
    read = [pq.read_table(path) for path in sorted((out / "data").rglob("*.parquet"))]
    assert pa.concat_tables(read)["index"].to_pylist() == [*range(sum(LENGTHS) - 9)]
    for row in pq.read_table(out / "meta/episodes").to_pylist():
        table = data(out)[row["episode_index"]]
        ends = table["index"][0].as_py(), table["index"][-1].as_py() + 1
        assert ends == (row["dataset_from_index"], row["dataset_to_index"])


def test_a_set_of_dexkits_export_keeps_its_origins(tmp_path: Path) -> None:
    """Start, hands and units of each episode."""
    trace = open_trace(sample_path("dex3_pinch"))
    paths = [tmp_path / f"s{i}.mcap" for i in range(4)]
    for i, path in enumerate(paths):
        begin = trace.first_ns + (5 + i) * 10**9
        cut(trace, path, spans=[Span(begin, begin + 10**9 // 4)])
    source = tmp_path / "set"
    assert dexkit("export", *paths, "--to", "lerobot", "--out", source)[0] == 0
    code, output = dexkit("export", source, "--out", tmp_path / "out", "--drop", "0,2")
    assert code == 0, output
    check_equal(source, tmp_path / "out", [1, 3])
    found = json.loads((tmp_path / "out/meta/info.json").read_text())["dexkit"]["sessions"]
    assert {k: v["file"] for k, v in found.items()} == {"0": "s1.mcap", "1": "s3.mcap"}


def task_folder(root: Path, count: int = 4) -> Path:
    for n in range(count):
        folder = episode(root / f"episode_{n:04d}", streamed(document(frames=4)), 1, 4)
        (folder / "depths").mkdir()
    put(root / "notes.txt", "notes")
    return root


def tree(root: Path) -> dict[str, bytes | None]:
    return {
        p.relative_to(root).as_posix(): p.read_bytes() if p.is_file() else None
        for p in root.rglob("*")
    }


def test_episodes_of_xr_teleoperate_keep_their_names(tmp_path: Path) -> None:
    source, out = task_folder(tmp_path / "task"), tmp_path / "out"
    put(source / ".git" / "HEAD", "x")
    found = {"episode_0001": "drop", "episode_0000": "keep"}
    file = verdicts(tmp_path / "e.json", source, found)
    code, output = dexkit("export", source, "--out", out, "--drop", file)
    assert code == 0, output
    assert "3 episodes kept, 1 dropped" in output
    assert "gaps in the numbers" in output
    expected = {k: v for k, v in tree(source).items() if not k.startswith(("episode_0001", ".git"))}
    assert tree(out) == expected
    assert expected["episode_0002/depths"] is None


def test_a_folder_of_sets_is_written_as_one(tmp_path: Path) -> None:
    source, out = tmp_path / "all", tmp_path / "out"
    made(source / "a", "v2.1")
    made(source / "b" / "c", "v3.0", files=[[0, 1, 2, 3, 4, 5, 6]])
    task_folder(source / "xr" / "task")
    (source / "xr" / "broken").mkdir()
    put(source / "readme", "text")
    put(source / "good.mcap", "recording")
    put(source / "bad.mcap", "recording")
    entries = [
        (source / "good.mcap", "", "keep"),
        (source / "bad.mcap", "", "drop"),
        ("s3://bucket/a", "", "drop"),
        *((source / "a", n, "drop") for n in range(7)),
        *((source / "b" / "c", n, "drop" if n in DROPPED else "keep") for n in range(7)),
        (source, "xr/task/episode_0002", "drop"),
        (source / "xr", "broken", "drop"),
        (source / "xr" / "task", "episode_0003", "keep"),
    ]
    document = {
        "format": "dexkit-episodes",
        "version": 1,
        "episodes": [
            {"source": ".", "place": str(p), "episode": e, "verdict": v, "reasons": []}
            for p, e, v in entries
        ],
    }
    put(tmp_path / "e.json", json.dumps(document))
    code, output = dexkit("export", source, "--out", out, "--drop", tmp_path / "e.json")
    assert code == 0, output
    assert "8 episodes kept, 13 dropped" in output
    assert "a: no episode of it is left" in output
    assert not (out / "a").exists()
    assert not (out / "xr" / "broken").exists()
    check_equal(source / "b" / "c", out / "b" / "c", KEPT)
    names = sorted(p.name for p in (out / "xr" / "task").iterdir())
    assert names == ["episode_0000", "episode_0001", "episode_0003", "notes.txt"]
    assert (out / "readme").read_text() == "text"
    assert [p.name for p in out.glob("*.mcap")] == ["good.mcap"]


def test_what_an_audit_cannot_read_is_dropped(tmp_path: Path) -> None:
    source, out = tmp_path / "all", tmp_path / "audit"
    made(source / "set", "v2.1", videos=False)
    task_folder(source / "task")
    os.truncate(source / "set/data/chunk-000/episode_000001.parquet", 300)
    os.truncate(source / "task/episode_0002/data.json", 100)
    (source / "task/episode_0003").rename(source / "task/0003")
    done = CliRunner().invoke(cli, ["audit", str(source), "--out", str(out), "--jobs", "1"])
    assert done.exit_code == 1, done.output
    found = json.loads((out / "episodes.json").read_text())["episodes"]
    dropped = {str(e["episode"]): e["reasons"] for e in found if e["verdict"] == "drop"}
    assert "cannot be read as Parquet" in dropped["1"][0]
    assert "is not an episode" in dropped["episode_0002"][0]
    for entry in found:  # the others are too short to be judged well
        if entry["episode"] not in (1, "episode_0002"):
            entry["verdict"] = "keep"
    edited = {"format": "dexkit-episodes", "version": 1, "episodes": found}
    put(out / "episodes.json", json.dumps(edited))
    code, output = dexkit(
        "export", source, "--out", tmp_path / "out", "--drop", out / "episodes.json"
    )
    assert code == 0, output
    assert (tmp_path / "out/task/0003").is_dir()
    check = data(tmp_path / "out" / "set")
    assert [len(check[n]) for n in check] == [n for i, n in enumerate(LENGTHS) if i != 1]
    assert not (tmp_path / "out/task/episode_0002").exists()


# -- what is refused -----------------------------------------------------------------------------


def test_what_cannot_be_dropped_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    source, xr = made(tmp_path / "set", "v2.1"), task_folder(tmp_path / "task")
    out = tmp_path / "out"
    good = verdicts(tmp_path / "good.json", source, {0: "drop"})
    lacking = verdicts(tmp_path / "lacking.json", source, {9: "keep"})
    folder = verdicts(tmp_path / "folder.json", xr, {"episode_0009": "drop"})
    whole = verdicts(tmp_path / "whole.json", xr, {".": "drop"})
    for arguments, why in [
        ((source, "--out", out, "--drop", lacking), "has no episode 9"),
        ((source, "--out", out, "--drop", "9"), "has no episode 9"),
        ((xr, "--out", out, "--drop", folder), "has no episode_0009"),
        ((xr, "--out", out, "--drop", whole), "has no task"),
        ((xr, "--out", out, "--drop", good), f"it is about set ({source}), other (/no/such/set)"),
        ((xr, "--out", out, "--drop", "1"), "is no LeRobot dataset"),
        ((source, "--out", out, "--drop", "0,1,2,3,4,5,6"), "would be left"),
        ((source, "--out", source / "x" / "out", "--drop", good), "lies in"),
        ((source, "--out", xr, "--drop", good), "exists"),
        ((source, "--drop", good), "one folder to write"),
        ((source, out, "--out", out, "--drop", good), "one folder to write"),
        ((source, "--out", out, "--drop", tmp_path / "none.json"), "cannot read"),
        ((source, "--out", out, "--drop", "1,"), "cannot read"),
        ((source, "--out", out, "--drop", "1", "--set", "drop=review"), "file of verdicts"),
        ((source, "--out", out, "--drop", good, "--to", "lerobot"), "own format"),
        ((source, "--out", out, "--drop", good, "--set", "fps=3"), "own format"),
        ((source, out), f"dexkit export {source} --out DIR --drop episodes.json"),
        ((source, "--to", "lerobot", "--out", out), "--drop episodes.json"),
        ((xr, "--to", "episodes"), "--drop episodes.json"),
        ((tmp_path / "e.mcap", "--to", "lerobot"), "--out is missing"),
        ((tmp_path, "--out", out, "--drop", "0"), "is no LeRobot dataset"),
        ((tmp_path / "nothing", "--out", out, "--drop", good), "is no folder"),
    ]:
        code, output = dexkit("export", *arguments)
        assert (code, why in output) == (2, True), (arguments, output)
        assert not out.exists()
    # a link to the set is the set
    (tmp_path / "link").symlink_to(source)
    assert dexkit("export", tmp_path / "link", "--out", out, "--drop", good)[0] == 0


@each(
    "change,why",
    [
        ({"format": "other"}, "format"),
        ({"version": 2}, "version"),
        ({"episodes": {}}, "episodes"),
        ({"episodes": [1]}, "episodes"),
        ({"place": None}, "place"),
        ({"place": "set"}, "no verdict on"),
        ({"place": "/a\x00"}, "no verdict on"),
        ({"episode": -1}, "episode"),
        ({"episode": 1.5}, "episode"),
        ({"episode": "/etc"}, "no verdict on"),
        ({"episode": ""}, "has no set"),
        ({"episode": "meta"}, "has no meta"),
        ({"verdict": "remove"}, "verdict"),
        ({"reasons": "x"}, "reasons"),
        ({"twice": True}, "two verdicts"),
        ({"text": "[" * 100_000}, "JSON"),
        ({"text": "NaN"}, "JSON"),
        ({"text": "\ud800"}, "UTF-8"),
    ],
)
def test_hostile_verdicts_are_refused(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    source, out = made(tmp_path / "set", "v2.1", videos=False), tmp_path / "out"
    path = verdicts(tmp_path / "e.json", source, {0: "drop"})
    found = json.loads(path.read_text())
    if change.get("twice"):
        found["episodes"].append({**found["episodes"][0], "verdict": "keep"})
    key = next(iter(change))
    (found if key in found else found["episodes"][0]).update(change)
    path.write_bytes(change.get("text", json.dumps(found)).encode("utf-8", "surrogatepass"))
    code, output = dexkit("export", source, "--out", out, "--drop", path)
    assert (code, why in output) == (2, True), output
    assert not out.exists()


def edit_info(root: Path, **values: Any) -> None:
    path = root / "meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def edit_data(root: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Of the file with the last episode."""
    path = sorted((root / "data").rglob("*.parquet"))[-1]
    table = change(pq.read_table(path))
    path.unlink()
    pq.write_table(table, path)


def column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, pa.array(values))


HOSTILE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "path out": (lambda r: edit_info(r, data_path="../../x.parquet"), "leads out"),
    "path absolute": (lambda r: edit_info(r, data_path="/etc/passwd"), "leads out"),
    "path of all": (lambda r: edit_info(r, data_path="data/x.parquet"), "cannot read"),
    "path format": (lambda r: edit_info(r, data_path="{episode_index.__class__}"), "no path"),
    "link": (lambda r: (r / "README.md").unlink() or (r / "README.md").symlink_to("/x"), "a link"),
    "link folder": (lambda r: (r / "more").symlink_to("/etc"), "a link"),
    "pipe": (lambda r: os.mkfifo(r / "pipe"), "not an ordinary file"),
    "no version": (lambda r: edit_info(r, codebase_version="v9"), "version v9"),
    "cut": (
        lambda r: [os.truncate(p, 99) for p in (r / "data").rglob("*.parquet")],
        "without its episodes: --drop ",
    ),
    "texts": (
        lambda r: edit_data(r, lambda t: column(t, "episode_index", ["6"] * len(t))),
        "not numbers",
    ),
    "missing": (
        lambda r: edit_data(r, lambda t: column(t, "episode_index", [5] * len(t))),
        "no frame of episode 6",
    ),
    "null": (
        lambda r: edit_data(
            r, lambda t: column(t, "episode_index", [None] * 3 + [6] * (len(t) - 3))
        ),
        "not numbers",
    ),
    "apart": (
        lambda r: edit_data(r, lambda t: column(t, "episode_index", [6, 5] + [6] * (len(t) - 2))),
        "lie apart",
    ),
    "index": (
        lambda r: edit_data(r, lambda t: column(t, "index", ["x"] * len(t))),
        "cannot be numbered",
    ),
    "stats": (lambda r: put(r / "meta/stats.json", "[1]"), "stats.json"),
}


@each("what", [*HOSTILE])
@each("version", ["v2.0", "v3.0"])
def test_hostile_datasets_are_refused_whole(tmp_path: Path, version: str, what: str) -> None:
    source, out = made(tmp_path / "set", version), tmp_path / "out"
    change, why = HOSTILE[what]
    change(source)
    code, output = dexkit("export", source, "--out", out, "--drop", "0,2")
    assert (code, why in output) == (2, True), output
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_list_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    for name, text in [
        ("episodes", "{"),
        ("episodes", '{"episode_index": "x"}'),
        ("episodes", '{"episode_index": 1}'),
        ("episodes_stats", "[]"),
    ]:
        source = made(tmp_path / f"set{name}{len(text)}", "v2.1")
        with open(source / f"meta/{name}.jsonl", "a") as file:
            file.write(text)
        code, output = dexkit("export", source, "--out", tmp_path / "out", "--drop", "0")
        assert (code, f"{name}.jsonl, line 8" in output) == (2, True), output
        assert not (tmp_path / "out").exists()


def test_broken_files_of_dropped_episodes_are_no_obstacle(tmp_path: Path) -> None:
    for version, name in [("v2.1", "chunk-000/episode_000001"), ("v3.0", "chunk-000/file-002")]:
        source, out = made(tmp_path / version, version), tmp_path / f"out-{version}"
        put(source / f"data/{name}.parquet", "broken")
        kept = [n for n in range(7) if n != (1 if version == "v2.1" else 5)]
        gone = "1" if version == "v2.1" else "5"
        code, output = dexkit("export", source, "--out", out, "--drop", gone)
        assert code == 0, output
        after = data(out)
        assert [len(after[n]) for n in range(6)] == [LENGTHS[n] for n in kept]


def test_what_is_wrong_and_what_is_no_part_of_a_set_is_told(tmp_path: Path) -> None:
    source, out = made(tmp_path / "set", "v2.1"), tmp_path / "out"
    (source / f"videos/chunk-001/{CAMERA}/episode_000004.mp4").unlink()
    put(source / "data/chunk-000/episode_000099.parquet", "stray")
    rows = read_lines(source / "meta/episodes.jsonl")
    rows[3]["length"] = 99
    put_lines(source / "meta/episodes.jsonl", rows)
    odd = b"odd\xff\x1b[31m".decode("utf-8", "surrogateescape")
    put(source / odd, "odd")
    code, output = dexkit("export", source, "--out", out, "--drop", "0")
    assert code == 1, output
    assert "videos that are missing: videos/chunk-001/" in output
    assert "no episode names it: data/chunk-000/episode_000099.parquet" in output
    assert "another length than the data, which the copy goes by: episode 3" in output
    assert "\x1b" not in output
    assert (out / odd).read_text() == "odd"
    assert read_lines(out / "meta/episodes.jsonl")[2]["length"] == LENGTHS[3]


def test_an_empty_column_of_numbers_is_that_of_the_file(tmp_path: Path) -> None:
    source, out = made(tmp_path / "set", "v2.0"), tmp_path / "out"
    for path in (source / "data").rglob("*.parquet"):
        pq.write_table(pq.read_table(path).drop(["episode_index", "index"]), path)
    code, output = dexkit("export", source, "--out", out, "--drop", "0")
    assert code == 0, output
    one, two = Dataset(source).read(4), Dataset(out).read(3)
    values = [s.parts[0].values["state"]["q"] for s in (one, two)]
    assert np.array_equal(*values)


def test_a_dataset_is_never_whole_in_memory(tmp_path: Path) -> None:
    """160 MB of frames that do not compress, in one file of 16 episodes."""
    root, count, rows, width = tmp_path / "set", 16, 2500, 1000
    meta = root / "meta"
    feature = {"dtype": "float32", "shape": [width], "names": None}
    info = {
        "codebase_version": "v3.0",
        "fps": 30,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {"action": feature},
    }
    put(meta / "info.json", json.dumps(info))
    places = {"data/chunk_index": 0, "data/file_index": 0, "length": rows}
    listed = [{"episode_index": n, "tasks": ["a"], **places} for n in range(count)]
    write(meta / "episodes/chunk-000/file-000.parquet", [pa.Table.from_pylist(listed)])
    random = np.random.default_rng(0)
    (root / "data/chunk-000").mkdir(parents=True)
    writer = None
    for n in range(count):
        values = random.integers(0, 2**23, rows * width, dtype=np.int32).view(np.float32)
        table = pa.table(
            {
                "action": pa.FixedSizeListArray.from_arrays(pa.array(values), width),
                "episode_index": np.full(rows, n),
            }
        )
        writer = writer or pq.ParquetWriter(
            str(root / "data/chunk-000/file-000.parquet"), table.schema, use_dictionary=False
        )
        writer.write_table(table)
    assert writer is not None
    writer.close()
    program = (
        "from dexkit.__main__ import main\n"
        "try: main()\n"
        # not getrusage, which counts what the process had from which this one was forked
        "finally: print('peak', open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            program,
            "export",
            str(root),
            "--out",
            str(tmp_path / "out"),
            "--drop",
            "0",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout.split("peak ")[1]) < 240_000  # KB
