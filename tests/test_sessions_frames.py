"""Recordings become frames: LeRobot datasets and episodes, and back."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import strategies as st
from PIL import Image

from dexkit.messages import message_type
from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.sessions.frames import open_source, sample
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.model import picture_topic
from dexkit.traces.sessions.streams import COMMAND, STATE
from dexkit.traces.writer import RecordingWriter
from tests.each import each
from tests.session_helpers import document, episode, png, streamed, whole
from tests.test_sessions_import import dexkit, streams


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a Dex3 session."""
    out = tmp_path_factory.mktemp("part") / "part.mcap"
    trace = open_trace(sample_path("dex3_pinch"))
    begin = trace.first_ns + 5 * 10**9
    cut(trace, out, spans=[Span(begin, begin + 2 * 10**9)])
    return out


def read(root: Path) -> tuple[dict[str, Any], Any]:
    info = json.loads((root / "meta" / "info.json").read_text())
    return info, pq.read_table(root / "data" / "chunk-000" / "file-000.parquet")


def vectors(table: Any, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist(), dtype=np.float64)


# -- LeRobot -------------------------------------------------------------------------------------


def test_every_value_of_a_dataset_is_that_of_the_recording(tmp_path: Path, part: Path) -> None:
    code, output = dexkit(
        "export",
        part,
        "--to",
        "lerobot",
        "--out",
        tmp_path / "d",
        "--set",
        "fps=30",
        "--set",
        "task=pinch",
    )
    assert code == 0, output
    assert "dq, tau, kp, kd of the commands" in output
    info, table = read(tmp_path / "d")
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 30, "dex3-1")
    names = info["features"]["observation.state"]["names"]
    assert names[:3] == ["left_thumb_0", "left_thumb_1", "left_thumb_2"]
    assert names[-1] == "right_index_1"
    got = streams(open_trace(part))
    first = max(int(s.times_ns[0]) for s in got.values())
    assert info["dexkit"]["sessions"]["0"]["start_ns"] == str(first)
    at = first + np.round(np.arange(table.num_rows) * 1e9 / 30)
    last = min(int(s.times_ns[-1]) for s in got.values())
    assert at[-1] <= last < at[-1] + 1e9 / 30
    for column, kind, field in (
        ("observation.state", STATE, "q"),
        ("observation.velocity", STATE, "dq"),
        ("observation.effort", STATE, "tau"),
        ("action", COMMAND, "q"),
    ):
        expected = []
        for side in ("left", "right"):
            s = got[f"{side}_hand", kind]
            t, values = s.times_ns.astype(np.float64), s.values[field]
            for j in range(7):
                if kind == STATE:
                    expected.append(np.interp(at - first, t - first, values[:, j]))
                else:  # the newest command
                    expected.append(values[np.searchsorted(t, at, side="right") - 1, j])
        made = vectors(table, column)
        assert np.abs(made - np.array(expected).T).max() < 2e-5, (
            column
        )  # a sample within 1 us is taken as it is
        stats = json.loads((tmp_path / "d" / "meta" / "stats.json").read_text())[column]
        assert np.allclose(stats["mean"], made.mean(axis=0))
        assert np.allclose(stats["q90"], np.quantile(made, 0.9, axis=0))
        assert stats["count"] == [table.num_rows]
    assert vectors(table, "observation.pressure").shape == (table.num_rows, 66)
    rest = info["dexkit"]["pressure_at_rest"][part.name]
    assert {part: set(values) for part, values in rest.items()} == {
        "left_hand": {0.0},  # of an older emulator
        "right_hand": {0.0},
    }
    assert table["timestamp"].to_pylist()[3] == pytest.approx(0.1)
    row = pq.read_table(tmp_path / "d/meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    assert (row["length"], row["tasks"]) == (table.num_rows, ["pinch"])
    assert (row["dataset_from_index"], row["dataset_to_index"]) == (0, table.num_rows)
    tasks = pq.read_table(tmp_path / "d/meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "pinch"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_several_recordings_are_one_dataset(tmp_path: Path, part: Path) -> None:
    out = tmp_path / "d"
    other = sample_path("dex1_hand_dropout")
    (tmp_path / "bad.mcap").write_bytes(b"no")
    code, output = dexkit(
        "export", part, part, other, tmp_path / "bad.mcap", "--to", "lerobot", "--out", out
    )
    assert code == 1
    assert "dex1_hand_dropout.mcap: refused: it has other joints" in output
    assert "bad.mcap: refused" in output
    info, table = read(out)
    # the rate of the commands, which the recording has
    assert (info["total_episodes"], info["fps"]) == (2, 99)
    assert info["dexkit"]["measured_hz"]["part.mcap"]["rt/dex3/left/state"] == pytest.approx(
        500, 0.01
    )
    n = table.num_rows // 2
    assert table["index"].to_pylist() == list(range(2 * n))
    assert table["frame_index"].to_pylist() == [*range(n), *range(n)]
    code, _ = dexkit("import", out, tmp_path / "back")
    assert code == 0
    back = open_trace(tmp_path / "back" / "episode_000001.mcap")
    assert back.first_ns == int(info["dexkit"]["sessions"]["1"]["start_ns"])
    assert streams(back)["left_hand", STATE].model == "dex3-1"
    assert np.array_equal(streams(back)["right_hand", COMMAND].q, vectors(table, "action")[n:, 7:])
    assert dexkit("export", part, "--to", "lerobot", "--out", out)[0] == 2  # it exists


def test_no_frame_lies_in_a_gap(tmp_path: Path) -> None:
    trace = open_trace(sample_path("dex1_hand_dropout"))
    source = open_source(trace)
    runs, told = sample(source, 50.0)
    assert len(runs) >= 2
    assert any("in gaps" in text for text in told)
    for run in runs:
        for s in source.streams:
            near = np.searchsorted(s.times_ns, run.times_ns)
            ages = run.times_ns - s.times_ns[np.maximum(near - 1, 0)]
            assert ages.max() <= 0.1e9 + 1000
        assert np.allclose(np.diff(run.times_ns), 2e7, atol=2)
    code, output = dexkit(
        "export", trace.path, "--to", "lerobot", "--out", tmp_path / "d", "--set", "fps=50"
    )
    assert (code, f"as {len(runs)} episodes" in output) == (1, True)
    info, _ = read(tmp_path / "d")
    assert info["total_episodes"] == len(runs)


@each("cameras", [1, 3])
def test_pictures_are_taken_over_as_they_are(tmp_path: Path, cameras: int) -> None:
    found = document(frames=20, cameras=0)
    source = tmp_path / "e"
    for item in found["data"]:
        item["colors"] = {f"color_{c}": f"colors/{item['idx']}_{c}.png" for c in range(cameras)}
    episode(source, streamed(found))
    made = {}
    for c in range(cameras):
        for i in range(20):
            out = io.BytesIO()
            Image.new("RGB", (8 + c, 6), (10 * i, c, 0)).save(out, "PNG")
            made[c, i] = out.getvalue()
            (source / "colors" / f"{i}_{c}.png").write_bytes(made[c, i])
    for options in ((), ("--set", "embed-pictures=yes")):
        recording = tmp_path / f"r{len(options)}.mcap"
        assert dexkit("import", source, recording, *options)[0] == 0
        out = tmp_path / f"d{len(options)}"
        to = ["export", recording, "--to", "lerobot", "--out", out]
        code, output = dexkit(*to, *(() if options else ("--pictures", source)))
        assert code == 0, output
        info, table = read(out)
        assert info["fps"] == 30
        for c in range(cameras):
            name = f"observation.images.color_{c}"
            assert info["features"][name]["shape"] == [6, 8 + c, 3]
            assert [r["bytes"] for r in table[name].to_pylist()] == [made[c, i] for i in range(20)]
            stats = json.loads((out / "meta" / "stats.json").read_text())[name]
            assert np.array(stats["mean"]).shape == (3, 1, 1)
            assert stats["min"][0][0][0] == 0.0
            assert stats["max"][1][0][0] == pytest.approx(c / 255)
        # and back
        back = tmp_path / f"b{len(options)}.mcap"
        assert dexkit("import", out, back)[0] == 0
        for c in range(cameras):
            got = open_trace(back).messages([picture_topic(f"color_{c}")])
            assert [ros_types.decode_compressed_image(m.data).data for m in got] == [
                made[c, i] for i in range(20)
            ]
    (source / "colors" / "5_0.png").write_bytes(png(4, 4))
    code, output = dexkit(
        *("export", tmp_path / "r0.mcap", "--to", "lerobot", "--out", tmp_path / "x"),
        *("--pictures", source),
    )
    assert (code, "another size" in output) == (2, True)
    (source / "colors" / "5_0.png").unlink()
    code, output = dexkit(
        *("export", tmp_path / "r0.mcap", "--to", "lerobot", "--out", tmp_path / "x"),
        *("--pictures", source),
    )
    assert (code, "is missing" in output) == (2, True)
    assert not list(tmp_path.glob("x*"))


# -- episodes ------------------------------------------------------------------------------------


@each("version", ["v0.5", "v1.1", "v1.4"])
def test_an_episode_comes_back_as_it_was(tmp_path: Path, version: str) -> None:
    ends = "hand" if version == "v0.5" else "ee"
    found = document(frames=12, ends=ends, named=version != "v1.4", cameras=2)
    for i, item in enumerate(found["data"]):
        item["tactiles"] = {f"left_{ends}": [i, 1]}
        item["states"]["torso"] = {"height": 0.1 * i}
    found["data"][4]["states"].pop("left_arm")
    del found["data"][7]
    text = streamed(found) if version == "v1.4" else whole(found)
    source = episode(tmp_path / "e", text, 2, 12)
    assert dexkit("import", source, tmp_path / "a.mcap")[0] == 0
    to = ["export", tmp_path / "a.mcap", "--to", "episodes", "--out"]
    code, output = dexkit(*to, tmp_path / "n")
    assert (code, "--pictures DIR" in output) == (1, True)
    code, output = dexkit(*to, tmp_path / "t", "--pictures", tmp_path / "e")
    assert code == 0, output
    back, bare = (
        json.loads((tmp_path / name / "episode_0000" / "data.json").read_text()) for name in "tn"
    )
    assert back == bare == found
    pictures = sorted(p.name for p in (tmp_path / "t" / "episode_0000" / "colors").iterdir())
    assert len(pictures) == 22
    for name in pictures:
        assert (tmp_path / "t/episode_0000/colors" / name).read_bytes() == (
            source / "colors" / name
        ).read_bytes()


numbers = st.floats(-1.5, 1.5, width=32)
entries = st.fixed_dictionaries(
    {"qpos": st.lists(numbers, min_size=2, max_size=2), "qvel": st.just([])},
    optional={"torque": st.lists(numbers, min_size=2, max_size=2), "note": st.text(max_size=3)},
)
items = st.fixed_dictionaries(
    {"states": st.dictionaries(st.sampled_from(["left_arm", "neck"]), entries, min_size=1)},
    optional={
        "actions": st.dictionaries(st.sampled_from(["left_arm", "neck"]), entries),
        "sim_state": st.none() | st.text(max_size=3),
        "tactiles": st.dictionaries(st.sampled_from("ab"), st.lists(numbers, max_size=3)),
    },
)


def test_a_recording_becomes_an_episode_that_the_importer_reads(tmp_path: Path, part: Path) -> None:
    code, output = dexkit(
        "export",
        part,
        "--to",
        "episodes",
        "--out",
        tmp_path / "t",
        "--set",
        "fps=30",
        "--set",
        "task=pinch",
    )
    assert code == 0, output
    back = json.loads((tmp_path / "t" / "episode_0000" / "data.json").read_text())
    item = back["data"][5]
    assert set(item["states"]) == {"left_ee", "right_ee", "body"}
    assert len(item["states"]["left_ee"]["qvel"]) == 7  # which xr_teleoperate does not record
    assert len(item["tactiles"]["left_ee"]) == 33
    assert back["info"]["joint_names"]["left_ee"][0] == "left_thumb_0"
    assert back["text"]["goal"] == "pinch"
    assert any("kp" in text for text in back["info"]["dexkit"]["lost"])
    assert dexkit("import", tmp_path / "t", tmp_path / "b")[0] == 0
    trace = open_trace(tmp_path / "b" / "episode_0000.mcap")
    assert trace.metadata[RECORD]["clock"] == "measured"
    source, got = streams(open_trace(part)), streams(trace)
    assert got.keys() == source.keys()
    for key in source:
        s = source[key]
        first, q = got[key].times_ns[3], got[key].q[3]
        if key[1] == STATE:
            nearest = np.abs(s.times_ns - first).argmin()
            assert np.abs(s.q[nearest] - q).max() < 0.02
        else:
            assert np.array_equal(s.q[np.searchsorted(s.times_ns, first, side="right") - 1], q)


# -- touch ---------------------------------------------------------------------------------------


def touched(out: Path, *, lost: range = range(0), short: bool = False) -> Path:
    """Two seconds of an FTP session.

    :param lost: right touch messages that are left out, counted from the start.
    :param short: leave an element out of the first area of the left hand's tenth message.
    """
    trace, seen = open_trace(sample_path("inspire_ftp_grip")), {"l": 0, "r": 0}
    begin = trace.first_ns + 3 * 10**9
    with RecordingWriter(out) as writer:
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        for m in trace.messages():
            if not begin <= m.log_time_ns < begin + 2 * 10**9:
                continue
            data, side = m.data, m.topic[-1]
            if "/touch/" in m.topic:
                seen[side] += 1
                if side == "r" and seen[side] in lost:
                    continue
                if short and (side, seen[side]) == ("l", 10):
                    mt = message_type(m.type_name)
                    message = mt.decode(data)
                    message.fingerone_tip_touch = message.fingerone_tip_touch[:-1]
                    data = mt.encode(message)
            writer.put(numbers[m.topic, m.type_name], data, m.log_time_ns, m.publish_time_ns)
    return out


def test_touch_is_in_datasets_and_episodes(tmp_path: Path) -> None:
    source = touched(tmp_path / "a.mcap")
    for form in ("lerobot", "episodes"):
        code, output = dexkit(
            "export", source, "--to", form, "--out", tmp_path / form, "--set", "fps=30"
        )
        assert (code, "rt/inspire_hand/touch" in output) == (0, False), output
    info, table = read(tmp_path / "lerobot")
    names = info["features"]["observation.pressure"]["names"]
    assert (len(names), names[0]) == (2 * 1062, "left_hand_pinky_tip_0")
    made = vectors(table, "observation.pressure")
    sent = list(open_trace(source).messages(["rt/inspire_hand/touch/r"]))
    mt = message_type("inspire::inspire_hand_touch")
    index = [mt.decode(m.data).fingerfour_top_touch for m in sent]
    column = names.index("right_hand_index_top_0")
    start = int(info["dexkit"]["sessions"]["0"]["start_ns"])
    at = np.array([m.log_time_ns - start for m in sent], dtype=np.float64)
    frames = np.round(np.arange(len(made)) * 1e9 / 30)
    for i in range(96):
        expected = np.interp(frames, at, [row[i] for row in index])
        assert np.abs(made[:, column + i] - expected).max() < 0.01
    assert made[:, column : column + 96].max() > 100  # it presses on the object
    back = json.loads((tmp_path / "episodes" / "episode_0000" / "data.json").read_text())
    assert back["info"]["tactile_names"]["right_ee"][column - 1062] == "index_top_0"
    # counts from a rest that the hand knows itself
    assert info["dexkit"]["pressure_at_rest"] == {"a.mcap": {}}
    assert back["info"]["dexkit"]["tactile_at_rest"] == {}
    right = np.array([item["tactiles"]["right_ee"] for item in back["data"]])
    assert np.abs(right - made[:, 1062:]).max() < 0.01
