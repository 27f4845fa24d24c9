"""Sessions of other formats become recordings: ``dexkit import``."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer

from dexkit.cli import cli
from dexkit.conformance.kit.recording import Recording
from dexkit.errors import SessionError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.messages.earlier import EARLIER
from dexkit.messages.schemas import ros2msg
from dexkit.messages.unitree_hg import HandState_, MotorState_, PressSensorState_
from dexkit.traces import Trace, open_trace, sample_path
from dexkit.traces.reader import Definition
from dexkit.traces.sessions import old_layouts, ros_types
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.sessions.episodes import parse_document
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.model import REST_TOPIC, picture_topic, reference_topic
from dexkit.traces.sessions.pictures import parse_picture
from dexkit.traces.sessions.streams import COMMAND, STATE, Stream, streams_of
from dexkit.traces.writer import RecordingWriter
from tests.each import each
from tests.session_helpers import dexkit, document, episode, jpeg, png, streamed, whole

HG = "unitree_hg::msg::dds_::HandState_"


def streams(trace: Trace) -> dict[tuple[str, str], Stream]:
    return {(s.part, s.kind): s for s in streams_of(trace)}


def positions(found: dict[str, Any], key: str, part: str) -> np.ndarray:
    return np.array([item[key][part]["qpos"] for item in found["data"]])


def imported(tmp_path: Path, text: str, *options: object) -> Trace:
    code, output = dexkit("import", episode(tmp_path / "e", text), tmp_path / "e.mcap", *options)
    assert code in (0, 1), output
    return open_trace(tmp_path / "e.mcap")


# -- episodes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["v0.5", "v1.1", "v1.4"])
@pytest.mark.parametrize("hand", ["dex1-1", "dex3-1"])
def test_every_version_of_the_writer_is_read(tmp_path: Path, version: str, hand: str) -> None:
    ends = "hand" if version == "v0.5" else "ee"
    found = document(hand=hand, ends=ends, named=version != "v1.4", cameras=0)
    text = streamed(found) if version == "v1.4" else whole(found)
    source = episode(tmp_path / "task" / "episode_0000", text)
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert code == 0, output
    trace = open_trace(tmp_path / "out.mcap")
    assert not trace.warnings
    record = trace.metadata[RECORD]
    expected = {"v0.5": "before v1.0", "v1.1": "v1.0 to v1.2", "v1.4": "v1.3 or later"}
    assert expected[version] in record["format"]
    assert (record["clock"], record["rate_hz"]) == ("nominal", "30")
    got = streams(trace)
    assert len(got) == 8
    for side in Side:
        for kind, key in ((STATE, "states"), (COMMAND, "actions")):
            made = got[f"{side}_hand", kind]
            assert made.model == hand
            assert set(made.values) == {"q"}  # what the source does not have is not there
            assert np.array_equal(made.q, positions(found, key, f"{side}_{ends}"))
            arm = got[f"{side}_arm", kind]
            assert np.array_equal(arm.q, positions(found, key, f"{side}_arm"))
    times = got["left_hand", STATE].times_ns
    assert np.array_equal(times - times[0], np.round(np.arange(60) * 1e9 / 30).astype(int))
    assert trace.first_ns == 1_751_932_800 * 10**9  # the file's date


def test_commands_have_what_the_client_sends(tmp_path: Path) -> None:
    trace = imported(tmp_path, streamed(document(cameras=0)))
    found = message_type("unitree_hg::msg::dds_::HandCmd_").decode(
        next(trace.messages(["rt/dex3/right/cmd"])).data
    )
    assert [m.mode for m in found.motor_cmd] == [0x10 | i for i in range(7)]
    assert {(round(m.kp, 3), round(m.kd, 3)) for m in found.motor_cmd} == {(1.5, 0.2)}
    record = trace.metadata[RECORD]
    assert record["absent rt/dex3/right/cmd"] == "dq tau kp kd"
    assert record["absent rt/dex3/right/state"] == "dq tau"


@each("share", [0.3, 0.5, 0.9, 0.999])
def test_an_interrupted_file_is_read_to_its_last_whole_item(share: float) -> None:
    found = document(frames=20)
    for text in (streamed(found), streamed(found, end=False), whole(found)):
        cut = text[: int(len(text) * share)]
        document_ = parse_document(cut, "cut")
        assert not document_.whole
        assert 0 < len(document_.items) <= 20
        assert document_.items == found["data"][: len(document_.items)]
        assert document_.info == found["info"]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 255))
def test_a_damaged_file_is_refused_or_read_in_part(place: int, byte: int) -> None:
    data = bytearray(streamed(document(frames=3, cameras=0)).encode())
    data[place % len(data)] = byte
    try:
        found = parse_document(data.decode("utf-8", "replace"), "damaged")
    except SessionError:
        return
    assert len(found.items) <= 3


def test_a_file_cut_in_a_character_is_read(tmp_path: Path) -> None:
    found = document(frames=4, cameras=0)
    for item in found["data"]:
        item["sim_state"] = "ü"
    data = whole(found).replace("\\u00fc", "ü").encode()
    source = episode(tmp_path / "e", "")
    last = data.rindex("ü".encode())
    (source / "data.json").write_bytes(data[: last + 1])
    code, output = dexkit("import", source, tmp_path / "e.mcap")
    assert (code, "up to its last whole item" in output) == (1, True)
    assert len(streams(open_trace(tmp_path / "e.mcap"))["left_arm", STATE]) == 3


def test_faulty_items_are_reported_and_the_others_kept(tmp_path: Path) -> None:
    found = document(frames=30, cameras=0)
    data = found["data"]
    data[3]["states"]["left_ee"]["qpos"][2] = float("nan")
    data[4]["states"]["left_ee"]["qpos"] = ["1.0"] * 7
    data[5]["actions"]["right_ee"]["qpos"] = [0.1] * 6
    data[6]["states"] = "none"
    data[7]["actions"]["left_arm"]["qpos"][0] = 10**400
    found["data"].insert(10, ["not an item"])
    trace = imported(tmp_path, whole(found))
    got = streams(trace)
    assert len(got["left_hand", STATE]) == 27
    assert len(got["right_hand", COMMAND]) == 29
    assert len(got["left_arm", COMMAND]) == 29
    assert len(got["right_arm", COMMAND]) == 30
    told = " ".join(v for k, v in trace.metadata[RECORD].items() if k.startswith("problem"))
    for part in ("not finite", "no list of numbers", "6 values instead of 7", "no objects"):
        assert part in told
    assert "item 5" in told
    # a frame that is left out is a gap and moves nothing
    t = got["left_hand", STATE].times_ns
    assert t[-1] - t[0] == round(29 * 1e9 / 30)


def test_names_and_texts_that_no_file_can_hold_are_kept_as_json(tmp_path: Path) -> None:
    found = document(frames=3, cameras=0)
    found["text"]["goal"] = "half \ud800"
    for item in found["data"]:
        item["sim_state"] = "\ud800"
        item["colors"] = {"../a": "x.jpg", "color_0": "\ud800.jpg"}
        item["states"]["a/b"] = {"qpos": [1.0]}
        item["states"]["left_arm"]["qpos"][0] = 1e308
    trace = imported(tmp_path, json.dumps(found))
    rest = json.loads(ros_types.decode_string(next(trace.messages([REST_TOPIC])).data))
    assert rest["states"]["a/b"] == {"qpos": [1.0]}
    assert rest["sim_state"] == "\ud800"
    assert rest["colors"]["../a"] == "x.jpg"
    code, output = dexkit("export", tmp_path / "e.mcap", "--to", "lerobot", "--out", tmp_path / "d")
    assert (code, "no float32 can hold" in output) == (2, True)
    code, _ = dexkit("export", tmp_path / "e.mcap", "--to", "episodes", "--out", tmp_path / "t")
    assert code == 0
    back = json.loads((tmp_path / "t" / "episode_0000" / "data.json").read_text())
    assert back == found


def test_several_episodes_become_a_folder_of_recordings(tmp_path: Path) -> None:
    for task, goal in (("cup", "take the cup"), ("door", "open the door")):
        for i in range(2):
            text = streamed(document(frames=5, cameras=0, goal=goal))
            episode(tmp_path / "data" / task / f"episode_{i:04d}", text)
    episode(tmp_path / "data" / "door" / "episode_0002", "{")
    code, output = dexkit("import", tmp_path / "data", tmp_path / "one.mcap")
    assert (code, "5 sessions" in output) == (2, True)
    code, output = dexkit("import", tmp_path / "data", tmp_path / "out")
    assert (code, "door/episode_0002: refused" in output) == (1, True)
    made = sorted(p.relative_to(tmp_path / "out").as_posix() for p in tmp_path.rglob("*.mcap"))
    assert made == [f"{t}/episode_000{i}.mcap" for t in ("cup", "door") for i in range(2)]
    tasks = {open_trace(tmp_path / "out" / m).metadata[RECORD]["task"] for m in made}
    assert tasks == {"take the cup", "open the door"}
    assert dexkit("import", tmp_path / "data", tmp_path / "out", "--episode", "x")[0] == 2
    assert dexkit("import", tmp_path / "data" / "cup", tmp_path / "out2")[0] == 0


def test_nothing_to_import_is_an_error(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for source in (empty, tmp_path / "missing", episode(tmp_path / "e", whole({"data": []}))):
        code, _ = dexkit("import", source, tmp_path / "out.mcap")
        assert code == 2
        assert not (tmp_path / "out.mcap").exists()


# -- sides, models, pictures ---------------------------------------------------------------------


def test_swapped_states_are_exchanged_and_reported(tmp_path: Path) -> None:
    good = document(hand=6, frames=90, cameras=0, named=True)
    bad = document(hand=6, frames=90, cameras=0, named=True, swapped=True)
    trace = imported(tmp_path, whole(bad))
    record = trace.metadata[RECORD]
    assert "exchanged" in record["correction 1"]
    assert "Inspire" in record["correction 1"]
    left = streams(trace)["left_hand", STATE]
    assert np.array_equal(left.q, positions(good, "states", "left_ee"))
    for options, text in (((), whole(good)), (("--set", "keep-sides=yes"), whole(bad))):
        (tmp_path / "e" / "data.json").write_text(text)
        code, _ = dexkit("import", tmp_path / "e", tmp_path / "e.mcap", "--overwrite", *options)
        record = open_trace(tmp_path / "e.mcap").metadata[RECORD]
        assert "correction 1" not in record
        assert (code, "problem 1" in record) == ((1, True) if options else (0, False))


def test_grippers_with_swapped_order_are_found_in_the_data(tmp_path: Path) -> None:
    trace = imported(tmp_path, streamed(document(200, "dex1-1", cameras=0, swapped=True)))
    assert "mixed up the order" in trace.metadata[RECORD]["correction 1"]


def test_hands_that_stand_still_are_left_as_they_are(tmp_path: Path) -> None:
    found = document(hand=6, frames=60, cameras=0, swapped=True)
    for item in found["data"]:
        for key in ("states", "actions"):
            for side in Side:
                item[key][f"{side}_ee"]["qpos"] = [1.0] * 6
    assert "correction 1" not in imported(tmp_path, whole(found)).metadata[RECORD]


def test_a_hand_of_an_unknown_model_is_a_group_of_joints(tmp_path: Path) -> None:
    trace = imported(tmp_path, streamed(document(hand=6, cameras=0)))
    assert "rt/session/left_hand/state" in trace.topics
    assert streams(trace)["left_hand", STATE].model == ""
    # seven joints whose positions are none of a Dex3: another hand
    found = document(cameras=0)
    for item in found["data"]:
        item["states"]["left_ee"]["qpos"] = [700.0] * 7
    code, output = dexkit("import", episode(tmp_path / "f", whole(found)), tmp_path / "f.mcap")
    assert (code, "far outside its limits" in output) == (1, True)
    code, output = dexkit("import", tmp_path / "f", tmp_path / "g.mcap", "--set", "hand=dex1-1")
    assert (code, "which is no dex1-1" in output) == (1, True)
    assert dexkit("import", tmp_path / "f", tmp_path / "h.mcap", "--set", "hand=dex9")[0] == 2


def test_pictures_are_referenced_or_embedded(tmp_path: Path) -> None:
    source = episode(tmp_path / "e", streamed(document(frames=5, cameras=2)), 2, 5)
    (source / "colors" / "000003_color_1.jpg").unlink()
    (source / "colors" / "000004_color_1.jpg").write_bytes(b"no picture")
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert (code, "missing (colors/000003_color_1.jpg)" in output) == (1, True)
    trace = open_trace(tmp_path / "a.mcap")
    first = next(trace.messages([reference_topic("color_1")]))
    assert json.loads(ros_types.decode_string(first.data)) == {"path": "colors/000000_color_1.jpg"}
    assert trace.metadata[RECORD]["pictures_folder"] == "."
    code, output = dexkit("import", source, tmp_path / "b.mcap", "--set", "embed-pictures=yes")
    assert (code, "neither JPEG nor PNG" in output) == (1, True)
    trace = open_trace(tmp_path / "b.mcap")
    pictures = [
        ros_types.decode_compressed_image(m.data)
        for m in trace.messages([picture_topic("color_1")])
    ]
    assert [p.data for p in pictures] == [jpeg(8, 6, i) for i in range(3)]
    assert {p.form for p in pictures} == {"jpeg"}


def test_pictures_elsewhere_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(jpeg(8, 6))
    found = document(frames=2, cameras=3)
    for item in found["data"]:
        item["colors"] = {"color_0": "../secret.jpg", "color_1": str(tmp_path / "secret.jpg")}
        item["colors"]["color_2"] = "link.jpg"
    source = episode(tmp_path / "e", whole(found))
    (source / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    code, output = dexkit("import", source, tmp_path / "e.mcap", "--set", "embed-pictures=yes")
    assert code == 1
    assert (output.count("leads out of it"), output.count("through a link")) == (3, 1)
    assert not [t for t in open_trace(tmp_path / "e.mcap").topics if "color" in t]


def test_picture_formats_and_sizes_are_read() -> None:
    for data, expected in ((jpeg(640, 480), ("jpeg", 640, 480, 3)), (png(4, 2), ("png", 4, 2, 3))):
        found = parse_picture(data)
        assert found is not None
        assert (found.form, found.width, found.height, found.channels) == expected
        for size in range(20):
            parse_picture(data[:size])
    assert parse_picture(b"") is None


def test_unknown_episode_data_are_kept_as_json(tmp_path: Path) -> None:
    found = document(frames=4, cameras=0)
    for i, item in enumerate(found["data"]):
        item["tactiles"] = {"left_ee": [i, 2, 3]}
        item["states"]["torso"] = {"height": 0.5}
    trace = imported(tmp_path, whole(found))
    rest = [json.loads(ros_types.decode_string(m.data)) for m in trace.messages([REST_TOPIC])]
    assert [r["tactiles"]["left_ee"][0] for r in rest] == [0, 1, 2, 3]
    assert rest[0]["states"]["torso"] == {"height": 0.5}
    assert "qpos" not in rest[0]["states"]["left_arm"]


# -- JSON lines ----------------------------------------------------------------------------------


def test_session_in_json_lines_keeps_its_times(tmp_path: Path) -> None:
    found = document(frames=10, cameras=0)
    lines = [json.dumps({"info": found["info"], "text": found["text"]})]
    for i, item in enumerate(found["data"]):
        item["timestamp"] = 1_700_000_000.0 + 0.05 * i
        lines.append(json.dumps(item))
    lines.insert(4, "{broken")
    (tmp_path / "a.jsonl").write_text("\n".join(lines) + '\n{"states": ')
    code, output = dexkit("import", tmp_path / "a.jsonl", tmp_path / "a.mcap")
    assert (code, "line 5, and 1 more" in output) == (1, True)
    trace = open_trace(tmp_path / "a.mcap")
    assert trace.metadata[RECORD]["clock"] == "measured"
    assert trace.first_ns == 1_700_000_000 * 10**9
    assert float(trace.metadata[RECORD]["rate_hz"]) == pytest.approx(20, rel=1e-3)
    assert len(streams(trace)["left_hand", STATE]) == 10


def test_times_that_no_message_can_hold_are_not_used(tmp_path: Path) -> None:
    """A ROS stamp ends in January 2038."""
    late = document(frames=3, cameras=0)
    for i, item in enumerate(late["data"]):
        item["timestamp_ns"] = 2**62 - 10 + i
    late["info"]["date"] = "2099-01-01"
    far = document(frames=3, cameras=0, fps=0.1)
    for i, item in enumerate(far["data"]):
        item["idx"] = 10**9 - 9 + i
    for name, found, why in (
        ("late", late, "whose time is missing or none; nominal ones are used (item 0, and 2 more)"),
        ("far", far, "(idx) are too large"),
    ):
        source = episode(tmp_path / name, whole(found))
        code, output = dexkit("import", source, tmp_path / f"{name}.mcap")
        assert (code, why in output) == (1, True), output
        trace = open_trace(tmp_path / f"{name}.mcap")
        assert trace.duration == pytest.approx(2 / (30 if name == "late" else 0.1))


# -- LeRobot -------------------------------------------------------------------------------------

G1_DEX3 = [
    f"k{s}{j}"
    for s in ("Left", "Right")
    for j in ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch")
] + ["kLeftWristYaw", "kRightWristYaw"]
LEFT_HAND = ["Thumb0", "Thumb1", "Thumb2", "Middle0", "Middle1", "Index0", "Index1"]
RIGHT_HAND = ["Thumb0", "Thumb1", "Thumb2", "Index0", "Index1", "Middle0", "Middle1"]
NAMES = [
    *G1_DEX3,
    *(f"kLeftHand{j}" for j in LEFT_HAND),
    *(f"kRightHand{j}" for j in RIGHT_HAND),
]


def dataset(root: Path, version: str, names: list[str], matrix: np.ndarray, **columns: Any) -> Path:
    """A dataset of one episode as LeRobot lays it out; of v3.0 two episodes in one file."""
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    n = len(matrix)
    feature = {"dtype": "float32", "shape": [len(names)], "names": [names]}
    info = {
        "codebase_version": version,
        "robot_type": "Unitree_G1_Dex3",
        "fps": 30,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if version != "v3.0"
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {"observation.state": feature, "action": feature},
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    episodes = 2 if version == "v3.0" else 1
    table: dict[str, Any] = {
        "observation.state": [list(map(float, row)) for row in matrix] * episodes,
        "action": [list(map(float, row)) for row in matrix] * episodes,
        "timestamp": [np.float32(i / 30) for i in range(n)] * episodes,
        "frame_index": list(range(n)) * episodes,
        "episode_index": [e for e in range(episodes) for _ in range(n)],
        "index": list(range(n * episodes)),
        "task_index": [0] * n * episodes,
    }
    table.update(columns)
    name = "file-000" if version == "v3.0" else "episode_000000"
    pq.write_table(pa.table(table), root / "data" / "chunk-000" / f"{name}.parquet")
    rows = [{"episode_index": e, "tasks": ["take it"], "length": n} for e in range(episodes)]
    if version == "v3.0":
        (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        for row in rows:
            row.update({"data/chunk_index": 0, "data/file_index": 0})
        path = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        pq.write_table(pa.Table.from_pylist(rows), path)
    else:
        (root / "meta" / "episodes.jsonl").write_text("\n".join(map(json.dumps, rows)))
        (root / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "take it"}\n')
    return root


@each("version", ["v2.1", "v3.0"])
def test_lerobot_datasets_are_read_by_the_place_of_the_columns(
    tmp_path: Path, version: str
) -> None:
    found = document(frames=40, cameras=0)
    order = [("left_arm", 6), ("right_arm", 6), ("left_arm", 7), ("right_arm", 7)]
    matrix = np.concatenate(
        [
            *(positions(found, "states", p)[:, :n] for p, n in order[:2]),
            *(positions(found, "states", p)[:, 6:7] for p, _ in order[2:]),
            positions(found, "states", "left_ee"),
            positions(found, "states", "right_ee"),
        ],
        axis=1,
    )
    source = dataset(tmp_path / "d", version, NAMES, matrix)
    code, output = dexkit("import", source, tmp_path / "out", "--episode", "episode_000000")
    assert code == 0, output
    assert "corrected: episode_000000: right hand" in output
    assert output.count("corrected") == 1  # the left hand's names are right
    trace = open_trace(tmp_path / "out" / "episode_000000.mcap")
    got = streams(trace)
    for side in Side:
        hand = got[f"{side}_hand", STATE]
        assert hand.model == "dex3-1"
        assert np.array_equal(hand.q, positions(found, "states", f"{side}_ee"))
        assert f"k{side.capitalize()}Elbow" in got[f"{side}_arm", STATE].joints
    assert trace.metadata[RECORD]["task"] == "take it"
    if version == "v3.0":
        assert dexkit("import", source, tmp_path / "all")[0] == 0
        assert len(list((tmp_path / "all").glob("*.mcap"))) == 2


INSPIRE = [
    f"k{side}Hand{finger}"
    for side in ("Left", "Right")
    for finger in ("Pinky", "Ring", "Middle", "Index", "ThumbBend", "ThumbRotation")
]


def test_names_of_several_models_are_no_hand_unless_one_is_named(tmp_path: Path) -> None:
    matrix = np.linspace(0.1, 0.9, 12 * 20).reshape(20, 12).astype(np.float32)
    source = dataset(tmp_path / "d", "v2.1", INSPIRE, matrix)
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert code == 1
    assert "left_hand may be one of inspire-dfx, inspire-ftp" in output
    assert {s.model for s in streams_of(open_trace(tmp_path / "a.mcap"))} == {""}
    for hand, rounded in (("inspire-dfx", False), ("inspire-ftp", True)):
        out = tmp_path / f"{hand}.mcap"
        code, output = dexkit("import", source, out, "--set", f"hand={hand}")
        assert code == 0, output
        assert ("is rounded to the whole numbers of" in output) == rounded
        got = streams(open_trace(out))
        assert {s.model for s in got.values()} == {hand}
        assert np.allclose(got["right_hand", STATE].q, matrix[:, 6:], atol=0.0006 if rounded else 0)


@each("end", [".q", ".pos"])
def test_names_of_lerobots_robots_are_read(tmp_path: Path, end: str) -> None:
    matrix = np.full((5, 14), 0.1, dtype=np.float32)
    names = [f"k{s}Hand{j}{end}" for s in ("Left", "Right") for j in LEFT_HAND]
    code, output = dexkit(
        "import", dataset(tmp_path / "d", "v2.1", names, matrix), tmp_path / "a.mcap"
    )
    assert code == 0, output
    assert {s.model for s in streams_of(open_trace(tmp_path / "a.mcap"))} == {"dex3-1"}


def test_lerobot_columns_of_other_kinds_are_reported(tmp_path: Path) -> None:
    matrix = np.full((5, len(NAMES)), 0.1)
    cases: dict[str, dict[str, Any]] = {
        "strings": {"action": ["a"] * 5},
        "digits": {"action": [["0.1"] * 28] * 5},
        "mixed": {"action": [[0.1] * 28, [0.1] * 27, *[[0.1] * 28] * 3]},
        "doubles": {"action": pa.array(matrix.tolist(), pa.list_(pa.float64()))},
        "nulls": {"action": [[None] * 28] * 5},
    }
    for name, columns in cases.items():
        source = dataset(tmp_path / name, "v2.1", NAMES, matrix, **columns)
        code, output = dexkit("import", source, tmp_path / f"{name}.mcap")
        assert code == (0 if name == "doubles" else 1), output
        got = streams(open_trace(tmp_path / f"{name}.mcap"))
        assert ("left_hand", STATE) in got
        assert (("left_hand", COMMAND) in got) == (name == "doubles")


@each(
    "file,content,why",
    [
        ("meta/info.json", b"{", "not valid JSON"),
        ("meta/info.json", b'{"codebase_version": "v1.6", "fps": 30}', "version v1.6"),
        ("meta/info.json", b'{"codebase_version": "v2.1", "fps": "30", "features": {}}', "no rate"),
        ("meta/episodes.jsonl", b"", "no list of its episodes"),
        ("data/chunk-000/episode_000000.parquet", b"PAR1", "cannot be read as Parquet"),
    ],
    ids=str,
)
def test_datasets_that_cannot_be_read_are_refused(
    tmp_path: Path, file: str, content: bytes, why: str
) -> None:
    source = dataset(tmp_path / "d", "v2.1", NAMES, np.zeros((3, 28)))
    (source / file).write_bytes(content)
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert code == 2
    assert why in output


@each("pattern", ["data/{episode_index:9999999999d}", "data/{episode_index:{episode_index}}"])
def test_no_path_of_a_dataset_fills_the_memory(tmp_path: Path, pattern: str) -> None:
    source = dataset(tmp_path / "d", "v2.1", NAMES, np.zeros((3, 28)))
    info = json.loads((source / "meta" / "info.json").read_text())
    (source / "meta" / "info.json").write_text(json.dumps({**info, "data_path": pattern}))
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert (code, "no path that can be used" in output) == (2, True), output


def test_frame_numbers_beyond_all_times_are_counted(tmp_path: Path) -> None:
    numbers = [1e300, 2e300, 3e300]
    source = dataset(tmp_path / "d", "v2.1", NAMES, np.full((3, 28), 0.1), frame_index=numbers)
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert (code, "frames are counted instead" in output) == (1, True), output


def test_a_dataset_does_not_lead_elsewhere(tmp_path: Path) -> None:
    source = dataset(tmp_path / "d", "v2.1", NAMES, np.zeros((3, 28)))
    info = json.loads((source / "meta" / "info.json").read_text())
    info["data_path"] = "../../{episode_index}.parquet"
    (source / "meta" / "info.json").write_text(json.dumps(info))
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert (code, "leads out of it" in output) == (2, True)


# -- ROS 2 bags ----------------------------------------------------------------------------------


def old_state(when: str, q: float) -> bytes:
    """A HandState of 2024 as its bytes are, little endian."""
    import struct

    motor = struct.pack("<B3x4f2hf2II4I", 1, q, 0, 0, 0, 20, 21, 12, 1, 2, 3, 4, 5, 6, 7)
    sensor = struct.pack("<12f12f", *range(12), *range(12))
    imu = struct.pack("<4f3f3f3fh2x", *range(13), 30)
    motors, press = struct.pack("<I", 1) + motor, struct.pack("<I", 1) + sensor
    if when == "2024-08":
        body = motors + imu + press + struct.pack("<2f2I", 24, 1, 8, 9)
    else:
        body = motors + press + imu + struct.pack("<4f4I", 24, 1, 48, 5, 6, 7, 8, 9)
    return b"\x00\x01\x00\x00" + body


def bag(
    path: Path, storage: StoragePlugin, topics: dict[str, tuple[str, str, list[bytes]]]
) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, (name, definition, payloads) in topics.items():
            connection = writer.add_connection(
                topic, name, msgdef=definition, rihs01="RIHS01_" + "0" * 64
            )
            for i, data in enumerate(payloads):
                writer.write(connection, 10**18 + i * 10**7, data)
    return path


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("when", ["2024-08", "2024-12"])
def test_bags_of_earlier_layouts_are_read(
    tmp_path: Path, storage: StoragePlugin, when: str
) -> None:
    layouts = {layout.when: layout for layout in EARLIER[HG]}
    assert set(layouts) == {"2024-08", "2024-12"}
    definition = ros2msg(layouts[when].struct)
    payloads = [old_state(when, 0.1 * i) for i in range(5)]
    topics = {
        "/dex3/left/state": ("unitree_hg/msg/HandState", definition, payloads),
        "/chatter": ("std_msgs/msg/String", "string data\n", [ros_types.encode_string("hi")]),
    }
    source = bag(tmp_path / "bag", storage, topics)
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert code == 0, output
    assert "earlier layout" in output
    trace = open_trace(tmp_path / "out.mcap")
    found = [message_type(HG).decode(m.data) for m in trace.messages(["rt/dex3/left/state"])]
    assert [round(f.motor_state[0].q, 5) for f in found] == [0.0, 0.1, 0.2, 0.3, 0.4]
    last = found[-1]
    assert last.reserve == (8, 9)
    assert last.power_v == 24
    assert last.press_sensor_state[0].pressure == tuple(range(12))
    assert last.press_sensor_state[0].lost == 0
    assert last.imu_state.temperature == 30
    assert last.system_v == (0 if when == "2024-08" else 48)
    assert trace.samples("rt/chatter").type_name == "std_msgs::msg::dds_::String_"


@each("when", ["2024-08", "2024-12", "present"])
def test_a_bag_without_schemas_is_read_by_the_layout_that_fits(when: str) -> None:
    state = HandState_([MotorState_(q=0.25)], [PressSensorState_()])
    payload = message_type(HG).encode(state) if when == "present" else old_state(when, 0.25)
    found = old_layouts.matching_layout(HG, [payload])
    assert found is not None
    assert when in found[0]
    assert old_layouts.matching_layout(HG, [payload + bytes(12)]) is None


def test_a_bag_without_schemas_is_imported(tmp_path: Path) -> None:
    """A .db3 as ROS 2 before Iron writes it: no table of message definitions."""
    path = tmp_path / "old.db3"
    with sqlite3.connect(path) as db:
        db.executescript(
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
            "INSERT INTO schema VALUES (3, 'humble');"
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,"
            " metadata TEXT NOT NULL);"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
        )
        names = {"/dex3/left/state": "unitree_hg/msg/HandState", "/x": "pkg/msg/Unknown"}
        for i, (topic, kind) in enumerate(names.items(), 1):
            db.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (i, topic, kind))
            for n in range(3):
                row = (None, i, 10**18 + n, old_state("2024-08", 0.5))
                db.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
    code, output = dexkit("import", path, tmp_path / "out.mcap")
    assert code == 1, output
    assert "/x is left out" in output
    assert "fit the layout of 2024-08" in output
    got = streams(open_trace(tmp_path / "out.mcap"))
    assert np.allclose(got["left_hand", STATE].q[:, 0], 0.5)


def test_a_damaged_bag_is_refused(tmp_path: Path) -> None:
    for name, content in (("a.db3", b"SQLite format 3\x00" + bytes(50)), ("b.mcap", b"\x89MCAP")):
        path = tmp_path / name
        path.write_bytes(content)
        code, _ = dexkit("import", path, tmp_path / "out.mcap")
        assert code == 2
        assert not (tmp_path / "out.mcap").exists()


def of_states(path: Path, payload: bytes = b"") -> Path:
    """The database of a bag of five states of a left Dex3-1."""
    mt = message_type(HG)
    topics = {"/dex3/left/state": (mt.ros_name, mt.ros2msg, [payload] * 5)}
    return next(bag(path, StoragePlugin.SQLITE3, topics).glob("*.db3"))


@each(
    "change,why",
    [
        ("UPDATE messages SET data = 'text' WHERE id = 2", "that are no bytes"),
        ("UPDATE messages SET timestamp = -5 WHERE id = 2", "without a time"),
        ("DELETE FROM messages WHERE id = 2", "that its metadata counts are not in the bag"),
    ],
    ids=str,
)
def test_invalid_row_of_a_bag_is_left_out(tmp_path: Path, change: str, why: str) -> None:
    mt = message_type(HG)
    payload = mt.encode(mt.of_motors([MotorState_()] * 7))
    with sqlite3.connect(of_states(tmp_path / "b", payload)) as db:
        db.execute(change)
    code, output = dexkit("import", tmp_path / "b", tmp_path / "out.mcap")
    assert (code, why in output) == (1, True), output
    assert open_trace(tmp_path / "out.mcap").message_count == 4


# -- the rest ------------------------------------------------------------------------------------


def piped(path: Path) -> None:
    """Put a pipe that nobody writes in a file's place."""
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)


def test_no_source_waits_for_a_pipe(tmp_path: Path) -> None:
    matrix = np.full((3, 28), 0.1)

    def of(version: str, file: str) -> Callable[[Path], None]:
        return lambda root: piped(dataset(root, version, NAMES, matrix) / file)

    def of_bag(root: Path) -> None:
        piped(of_states(root))

    def of_tables(file: str) -> Callable[[Path], None]:
        def make(root: Path) -> None:
            recording = imported(root.parent / f"{root.name}_of", whole(document(frames=3))).path
            assert dexkit("export", recording, "--to", "csv", "--out", root)[0] == 0
            for path in [root / file] if file else root.glob("*.csv"):
                piped(path)

        return make

    sources: dict[str, tuple[str, Callable[[Path], None]]] = {
        "lines.jsonl": ("jsonl", piped),
        "episode": ("episodes", lambda root: piped(root / "data.json")),
        "info": ("lerobot", of("v2.1", "meta/info.json")),
        "rows": ("lerobot", of("v2.1", "meta/episodes.jsonl")),
        "frames": ("lerobot", of("v2.1", "data/chunk-000/episode_000000.parquet")),
        "bag": ("rosbag2", of_bag),
        "about": ("tables", of_tables("session.json")),
        "csv": ("tables", of_tables("")),
    }
    for name, (form, make) in sources.items():
        make(tmp_path / name)
        code, output = dexkit("import", tmp_path / name, tmp_path / "out.mcap", "--from", form)
        assert (code, "ordinary file" in output or "no list" in output) == (2, True), output


def test_another_format_than_the_sources_is_refused(tmp_path: Path) -> None:
    source = episode(tmp_path / "e", whole(document(frames=3)))
    for form in ("jsonl", "lerobot", "rosbag2", "tables"):
        code, output = dexkit("import", source, tmp_path / "out.mcap", "--from", form)
        assert (code, str(source) in output) == (2, True), output


def test_a_missing_library_names_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    source = tmp_path / "d"
    (source / "meta").mkdir(parents=True)
    (source / "meta" / "info.json").write_text("{}")
    code, output = dexkit("import", source, tmp_path / "out.mcap")
    assert (code, "dexkit[lerobot]" in output) == (2, True)
    (tmp_path / "a.db3").write_bytes(b"SQLite")
    code, output = dexkit("import", tmp_path / "a.db3", tmp_path / "out.mcap")
    assert (code, "dexkit[rosbag]" in output) == (2, True)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**31 * 10**9 - 1),
    st.lists(st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"))),
    st.lists(st.floats(allow_nan=False)),
    st.binary(),
)
def test_the_standard_types_are_coded_both_ways(
    stamp: int, names: list[str], values: list[float], data: bytes
) -> None:
    state = ros_types.JointState(stamp, tuple(names), tuple(values), (), tuple(values))
    assert ros_types.decode_joint_state(ros_types.encode_joint_state(state)) == state
    image = ros_types.CompressedImage(stamp, "".join(names), "jpeg", data)
    assert ros_types.decode_compressed_image(ros_types.encode_compressed_image(image)) == image
    assert ros_types.decode_string(ros_types.encode_string("".join(names))) == "".join(names)


def test_the_standard_types_are_those_of_ros() -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    joint = ros_types.JointState(1_500_000_000_250_000_000, ("a", "bcd"), (1.0, 2.0), (), (3.0,))
    theirs = store.deserialize_cdr(
        ros_types.encode_joint_state(joint), "sensor_msgs/msg/JointState"
    )
    assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == (1_500_000_000, 250_000_000)
    assert (theirs.name, theirs.position.tolist()) == (["a", "bcd"], [1.0, 2.0])
    assert (theirs.velocity.tolist(), theirs.effort.tolist()) == ([], [3.0])
    image = ros_types.CompressedImage(5, "color_0", "png", png(2, 2))
    data = ros_types.encode_compressed_image(image)
    assert store.deserialize_cdr(data, "sensor_msgs/msg/CompressedImage").data.tobytes() == png(
        2, 2
    )
    data = ros_types.encode_string("text")
    assert store.deserialize_cdr(data, "std_msgs/msg/String").data == "text"


def test_check_says_that_a_session_was_imported(tmp_path: Path) -> None:
    source = episode(tmp_path / "e", streamed(document(frames=90, cameras=0)))
    assert dexkit("import", source, tmp_path / "e.mcap")[0] == 0
    notes = Recording.decode(open_trace(tmp_path / "e.mcap")).notes
    assert any("an imported session" in note for note in notes)


@each("hand", ["", "dex3-1"])
def test_degrees_are_not_taken_for_radians(tmp_path: Path, hand: str) -> None:
    names = [f"left_hand_{j}" if hand else f"left_joint_{j}" for j in map(str.lower, LEFT_HAND)]
    matrix = np.linspace(-60, 60, 7 * 5).reshape(5, 7).astype(np.float32)
    code, output = dexkit(
        "import", dataset(tmp_path / "d", "v2.1", names, matrix), tmp_path / "a.mcap"
    )
    assert code == 1
    assert "its states reach 60" in output
    (state, command) = streams_of(open_trace(tmp_path / "a.mcap"))
    assert (state.model, command.unit) == (hand, "rad" if hand else "unknown unit")


STATES = [message_type(HG).encode(HandState_([MotorState_(q=0.1 * i)], [])) for i in range(4)]


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_bag_whose_metadata_write_the_qos_differently_is_read(
    tmp_path: Path, storage: StoragePlugin
) -> None:
    """The library compares what metadata and file write, and takes what differs for two topics."""
    topics = {"/dex3/left/state": ("unitree_hg/msg/HandState", message_type(HG).ros2msg, STATES)}
    source = bag(tmp_path / "bag", storage, topics)
    path = source / "metadata.yaml"
    profile = "offered_qos_profiles:\n      - history: keep_last\n        depth: 1\n" + "".join(
        f"        {line}\n"
        for line in (
            *("reliability: reliable", "durability: volatile"),
            *("deadline: {sec: 0, nsec: 0}", "lifespan: {sec: 0, nsec: 0}"),
            *("liveliness: automatic", "liveliness_lease_duration: {sec: 0, nsec: 0}"),
            "avoid_ros_namespace_conventions: false",
        )
    )
    text = path.read_text()
    path.write_text(re.sub(r"offered_qos_profiles: .*\n", profile, text))
    assert path.read_text() != text
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert (code, open_trace(tmp_path / "a.mcap").message_count) == (0, len(STATES)), output


@pytest.mark.parametrize("storage", StoragePlugin)
@each("as_file", [True, False])
def test_messages_that_are_packed_one_by_one_are_unpacked(
    tmp_path: Path, storage: StoragePlugin, as_file: bool
) -> None:
    """Also where a file of the bag is given by itself, whose metadata are elsewhere."""
    topics = {"/dex3/left/state": ("unitree_hg/msg/HandState", message_type(HG).ros2msg, STATES)}
    packed = [zstandard.ZstdCompressor().compress(data) for data in STATES]
    source = bag(tmp_path / "bag", storage, {t: (n, d, packed) for t, (n, d, _) in topics.items()})
    path = source / "metadata.yaml"
    text = path.read_text().replace("compression_mode: ''", "compression_mode: message")
    path.write_text(text.replace("compression_format: ''", "compression_format: zstd"))
    if as_file:
        (source,) = (p for p in source.iterdir() if p != path)
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert code == 0, output
    assert [m.data for m in open_trace(tmp_path / "a.mcap").messages()] == STATES


def test_a_recording_of_the_low_rate_topic_has_observations(tmp_path: Path) -> None:
    trace = open_trace(sample_path("dex3_pinch"))
    topics = ["rt/dex3/left/state", "rt/dex3/left/cmd"]
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        numbers = {
            t: writer.add_channel(
                replace(d, topic=t.replace("/dex3/left/state", "/lf/dex3/left/state"))
            )
            for (t, _), d in trace.definitions.items()
            if t in topics
        }
        for m in trace.messages(topics):
            writer.put(numbers[m.topic], m.data, m.log_time_ns)
    found = streams_of(open_trace(tmp_path / "a.mcap"))
    assert {(s.part, s.kind) for s in found} == {("left_hand", STATE), ("left_hand", "command")}


def test_a_bag_that_can_hold_nothing_is_not_written(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        number = writer.add_channel(Definition("rt/a", "cdr", {}, None))
        writer.put(number, bytes(8), 10**18)
    code, output = dexkit("export", tmp_path / "a.mcap", "--to", "rosbag2", "--out", tmp_path / "b")
    assert (code, "no message that a bag can hold" in output) == (2, True)
    assert not (tmp_path / "b").exists()


@each("kind", ["split mcap", "sqlite3", "packed"])
def test_check_reads_bags_of_every_kind(tmp_path: Path, kind: str) -> None:
    source = tmp_path / "bag"
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    trace = open_trace(sample_path("dex3_pinch"))
    packer = zstandard.ZstdCompressor()
    with Writer(source, version=9, storage_plugin=plugin) as writer:
        mt = message_type(HG)
        connection = writer.add_connection(
            "/dex3/left/state", mt.ros_name, msgdef=mt.ros2msg, rihs01="RIHS01_" + "0" * 64
        )
        for i, m in enumerate(trace.messages(["rt/dex3/left/state"])):
            if i == 1000:
                break
            data = packer.compress(m.data) if kind == "packed" else m.data
            writer.write(connection, m.log_time_ns, data)
    if kind == "split mcap":
        text = (source / "metadata.yaml").read_text()
        (file,) = source.glob("*.mcap")
        halves = [source / f"bag_{n}.mcap" for n in range(2)]
        middle = trace.first_ns + 10**9
        for path, (low, high) in zip(halves, [(0, middle), (middle, 2**62)], strict=True):
            cut(open_trace(file), path, spans=[Span(low, high)])
        file.unlink()
        text = re.sub(
            r"(relative_file_paths:\n).*\n",
            rf"\1  - {halves[0].name}\n  - {halves[1].name}\n",
            text,
        )
        (source / "metadata.yaml").write_text(text)
    elif kind == "packed":
        (source,) = source.glob("*.mcap")
    result = CliRunner().invoke(cli, ["check", str(source), "--result", str(tmp_path / "r.json")])
    assert result.exit_code == 0, result.output
    seconds = json.loads((tmp_path / "r.json").read_text())["duration_s"]
    assert seconds > 1.5  # of both halves


def test_a_dataset_with_other_columns_is_told_which_it_has(tmp_path: Path) -> None:
    matrix = np.full((5, 2), 0.1)
    source = dataset(tmp_path / "d", "v2.1", ["a", "b"], matrix)
    path = source / "data" / "chunk-000" / "episode_000000.parquet"
    names = {"observation.state": "state", "action": "actions"}
    table = pq.read_table(path)
    pq.write_table(table.rename_columns([names.get(n, n) for n in table.column_names]), path)
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert (code, "it has: state, actions, timestamp" in output) == (2, True), output


def test_a_database_whose_clock_steps_back_is_refused(tmp_path: Path) -> None:
    """The library gives its rows in order of time."""
    topics = {"/dex3/left/state": ("unitree_hg/msg/HandState", message_type(HG).ros2msg, STATES)}
    source = bag(tmp_path / "bag", StoragePlugin.SQLITE3, topics)
    (path,) = source.glob("*.db3")
    with sqlite3.connect(path) as db:
        db.execute("UPDATE messages SET timestamp = timestamp - 1000000000 WHERE id > 2")
    code, output = dexkit("import", source, tmp_path / "a.mcap")
    assert (code, "its clock steps back by 0.990 s" in output) == (2, True), output


def test_a_table_of_plotjuggler_is_named(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text("__time,/rt/dex1/left/state/states[0]/q\n1.0,0.5\n")
    code, output = dexkit("import", tmp_path / "curves.csv", tmp_path / "out.mcap")
    assert code == 2
    assert "as PlotJuggler writes it" in output
    assert not (tmp_path / "out.mcap").exists()
