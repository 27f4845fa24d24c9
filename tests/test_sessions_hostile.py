"""Hostile episodes, datasets and records of imports: refused with their place, or left out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexkit.errors import SessionError
from dexkit.traces import open_trace
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.edit import cut
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.model import reference_topic
from dexkit.traces.sessions.paths import below
from dexkit.traces.writer import RecordingWriter
from tests.each import each
from tests.session_helpers import document, episode, jpeg, png, streamed
from tests.test_sessions_import import NAMES, dataset, dexkit

DEEP = "[" * 100_000
NESTED: Any = []
for _ in range(200):
    NESTED = [NESTED]


# -- names of files ------------------------------------------------------------------------------


@each(
    "name,why",
    [
        ("", "leads out"),
        ("/etc/passwd", "leads out"),
        ("../a", "leads out"),
        ("a/../../b", "leads out"),
        ("a\\..\\..\\b", "leads out"),
        ("link/a", "through a link"),
        ("a\x00b", "no text"),
        ("a\nb", "no text"),
        ("a\x1b[31m", "no text"),
        ("a\u202eb", "no text"),
        ("\ud800", "no text"),
        ("a" * 256, "too long"),
        ("é" * 128, "too long"),
        ("a/" * 2100 + "b", "too long"),
    ],
)
def test_path_that_is_none_below_its_folder_is_refused(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "link").symlink_to(tmp_path)
    with pytest.raises(SessionError, match=why) as caught:
        below(tmp_path / "d", name)
    assert str(tmp_path / "d") in str(caught.value)
    assert str(caught.value).isprintable()


# -- the record of an import ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported episode with one camera, whose pictures are beside it in the folder ``e``."""
    folder = tmp_path_factory.mktemp("recording")
    source = episode(folder / "e", streamed(document(frames=10)))
    for i in range(10):
        (source / "colors" / f"{i:06d}_color_0.jpg").write_bytes(png(8, 6))
    code, output = dexkit("import", source, folder / "a.mcap")
    assert code == 0, output
    return folder / "a.mcap"


def forged(recording: Path, out: Path, **values: str) -> Path:
    """A copy with other values in the record of its import."""
    trace = open_trace(recording)
    metadata = {**trace.metadata, RECORD: {**trace.metadata[RECORD], **values}}
    cut(trace, out, metadata=metadata)
    return out


def replaced(recording: Path, out: Path, topic: str, data: bytes) -> Path:
    """A copy with another payload in all messages of a topic."""
    trace = open_trace(recording)
    with RecordingWriter(out) as writer:
        for name, values in trace.metadata.items():
            writer.add_metadata(name, values)
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        for m in trace.messages():
            payload = data if m.topic == topic else m.data
            writer.put(numbers[m.topic, m.type_name], payload, m.log_time_ns)
    return out


@each(
    "key,value,why",
    [
        *(("rate_hz", v, ": rate_hz") for v in ("x", "nan", "inf", "0", "-1e308", "1e400", "")),
        *(("first_ns", v, ": first_ns") for v in ("²", "9" * 5000, "-1", "1.5", "1_0")),
        *(("clock", v, ": clock") for v in ("\x00", "")),
        *(("names", v, "names") for v in (DEEP, "", "{", '{"left_hand": [1]}', '["a"]', "NaN")),
        *(("cameras", v, "cameras") for v in (DEEP, "[]", '{"a": {}}', '{"a": "x"}')),
        *(("cameras", json.dumps({v: "colors"}), "cameras") for v in ("../a", "a" * 300, "\x00")),
        *(("info", v, "info") for v in (DEEP, "NaN", "[]", json.dumps({"a": NESTED}))),
        *(("text", v, "text") for v in (DEEP, "0", '{"a": ' + "9" * 5000 + "}")),
        ("aligned", "x", "is not the time of a frame"),
        *(("pictures_folder", v, "leads out") for v in ("../..", "a/../../b", "")),
        ("pictures_folder", "\x00", "no text"),
    ],
)
def test_hostile_record_of_an_import_is_refused(
    tmp_path: Path, recording: Path, key: str, value: str, why: str
) -> None:
    path = forged(recording, tmp_path / "a.mcap", **{key: value})
    forms = {"aligned": ["episodes"]}.get(key, ["episodes", "lerobot"])
    for form in forms:
        to = ["--to", form, "--out", tmp_path / form, "--pictures", recording.parent / "e"]
        code, output = dexkit("export", path, *to)
        assert (code, str(path) in output) == (2, True), output
        assert why in output
        assert not (tmp_path / form).exists()
        # and the others are exported
        code, output = dexkit("export", path, recording, *to)
        assert (code, "a.mcap: refused" in output) == (1, True), output
        assert (tmp_path / form).is_dir()
    if key in ("rate_hz", "first_ns", "clock"):
        assert dexkit("rehearse", path, "--check")[0] == 2


# -- pictures are read where the user says, and nowhere else ---------------------------------------


@each(
    "place,folder",
    [
        ("absolute", None),
        ("absolute", "e"),
        ("..", "e"),
        ("link", "e"),
        ("path", "e"),
        (".", None),
    ],
)
def test_a_recording_takes_no_picture_of_the_readers_machine(
    tmp_path: Path, recording: Path, place: str, folder: str | None
) -> None:
    private, other = tmp_path / "private", tmp_path / "e"
    shutil.copytree(recording.parent / "e", private)
    other.mkdir()
    (other / "link").symlink_to(private)
    values = {"absolute": str(private), "..": "../private", "link": "link"}
    path = forged(recording, private / "a.mcap", pictures_folder=values.get(place, "."))
    if place == "path":
        text = json.dumps({"path": str(private / "colors" / "000000_color_0.jpg")})
        data = ros_types.encode_string(text)
        path = replaced(recording, private / "b.mcap", reference_topic("color_0"), data)
    for form in ("lerobot", "episodes"):
        out = tmp_path / form
        given = () if folder is None else ("--pictures", tmp_path / folder)
        code, output = dexkit("export", path, "--to", form, "--out", out, *given)
        assert code in (1, 2), output
        assert "--pictures DIR" in output or folder is not None
        made = [p for p in out.rglob("*") if p.is_file()]
        assert not [p for p in made if b"IHDR" in p.read_bytes()]


def test_pictures_of_several_episodes_are_found_below_the_folder_that_was_imported(
    tmp_path: Path,
) -> None:
    for name in ("e1", "e2"):
        folder = episode(tmp_path / "task" / name, streamed(document(frames=4)))
        for i in range(4):
            (folder / "colors" / f"{i:06d}_color_0.jpg").write_bytes(png(8, 6 + int(name[1])))
    assert dexkit("import", tmp_path / "task", tmp_path / "in")[0] == 0
    made = sorted((tmp_path / "in").iterdir())
    for number, given in enumerate(([tmp_path / "task"], [tmp_path / "task" / "e1"])):
        out = tmp_path / f"out{number}"
        to = ["--to", "episodes", "--out", out, "--pictures", *given]
        assert dexkit("export", *(made if number == 0 else made[:1]), *to)[0] == 0
        first = (out / "episode_0000" / "colors" / "000000_color_0.jpg").read_bytes()
        assert first == png(8, 7)
    to = ["--to", "csv", "--out", tmp_path / "c", "--pictures", "/"]
    code, output = dexkit("export", made[0], *to)
    assert (code, "not csv" in output) == (2, True)


# -- episodes ------------------------------------------------------------------------------------

Change = Callable[[dict[str, Any]], Any]


def in_items(change: Callable[[dict[str, Any]], Any]) -> Change:
    def changed(found: dict[str, Any]) -> None:
        for item in found["data"]:
            change(item)

    return changed


def part(name: str, value: Any) -> Change:
    return in_items(lambda item: item["states"].update({name: value}))


@each(
    "change,code,told",
    [
        (part("inspire_hand", {"qpos": [0.1] * 7}), 0, ""),
        (part("_hand", {"qpos": [0.1] * 7}), 0, ""),
        (part("both_ee", {"qpos": [0.1]}), 0, ""),
        (part("left_hand", {"qpos": [0.1] * 7}), 1, "kept as JSON only: there is a left_hand"),
        (part("a" * 300, {"qpos": [0.1] * 7}), 1, "are kept as JSON only"),
        (part("a/../b", {"qpos": [0.1] * 7}), 1, "are kept as JSON only"),
        (part("wide", {"qpos": [0.1] * 5000}), 1, "1024 at most"),
        (part("left_arm", {"qpos": [10**400] * 7}), 1, "not finite"),
        (part("left_arm", {"qpos": [1e308] * 7}), 1, "which is no angle in rad"),
        (part("left_arm", 5), 0, ""),
        (part("left_arm", {"qpos": NESTED}), 1, "left_arm.qpos is no list of numbers"),
        (part("left_arm", {"qpos": ["\udc80"]}), 1, "left_arm.qpos is no list of numbers"),
        (in_items(lambda i: i["colors"].update(color_0="a" * 300)), 1, "is too long"),
        (in_items(lambda i: i["colors"].update(color_0="a/" * 3000)), 1, "is too long"),
        (in_items(lambda i: i["colors"].update(color_0="../a.jpg")), 1, "leads out"),
        (in_items(lambda i: i["colors"].update(color_0="a\x00")), 1, "no text"),
        (in_items(lambda i: i["colors"].update(color_0=["a"])), 1, "frames without a picture"),
        (in_items(lambda i: i.update(sim_state=NESTED)), 1, "nested more than"),
        (in_items(lambda i: i.update(idx=-1)), 1, "(idx) do not ascend"),
        (in_items(lambda i: i.update(idx=10**30)), 1, "(idx) do not ascend"),
        (in_items(lambda i: i.update(timestamp=float("nan"))), 1, "time is missing or none"),
        (in_items(lambda i: i.update(timestamp_ns=True)), 1, "time is missing or none"),
        *((lambda f, v=v: f["info"]["image"].update(fps=v), 1, "no rate")
          for v in (0, -1, 1e308, float("nan"), float("inf"), 10**30, True, "30", None, [[]])),
        (lambda f: f.update(info=[]), 2, "info: Expected object, got array"),
        (lambda f: f.update(info=NESTED), 2, "nested more than"),
        (lambda f: f.update(extra=NESTED), 2, "nested more than"),
        (lambda f: f.update(text="x"), 2, "text: Expected object, got str"),
        (lambda f: f.update(data={}), 2, "no list 'data'"),
        (lambda f: f.update(data=[[], 5]), 2, "no frame that can be used"),
        (lambda f: f["info"].update(date=["2025"]), 0, ""),
        (lambda f: f["text"].update(goal={"a": 1}), 0, ""),
    ],
    ids=str,
)  # fmt: skip
def test_hostile_episode(tmp_path: Path, change: Change, code: int, told: str) -> None:
    found = document(frames=3)
    change(found)
    source = episode(tmp_path / "e", json.dumps(found))
    for i in range(3):
        (source / "colors" / f"{i:06d}_color_0.jpg").write_bytes(jpeg(8, 6, i))
    got, output = dexkit("import", source, tmp_path / "e.mcap")
    assert (got, told in output) == (code, True), output
    if code == 2:
        assert str(source / "data.json") in output
        assert not (tmp_path / "e.mcap").exists()
        return
    back = ["--to", "episodes", "--out", tmp_path / "t", "--pictures", source]
    assert dexkit("export", tmp_path / "e.mcap", *back)[0] in (0, 1)


@each("text", [DEEP, '{"data": ' + DEEP, "{}", "[]", "\x00", '{"data": [' + "9" * 5000, "NaN"])
def test_text_that_is_no_episode_is_refused(tmp_path: Path, text: str) -> None:
    source = episode(tmp_path / "e", text)
    code, output = dexkit("import", source, tmp_path / "e.mcap")
    assert (code, str(source / "data.json") in output) == (2, True), output
    (tmp_path / "e.jsonl").write_text(text)
    code, output = dexkit("import", tmp_path / "e.jsonl", tmp_path / "e.mcap")
    assert (code, str(tmp_path / "e.jsonl") in output) == (2, True), output


# -- one of several ------------------------------------------------------------------------------


@each(
    "text",
    ["{", "[]", DEEP, json.dumps({"data": [{}]}), json.dumps({"info": 5, "data": [{}]})],
)
def test_one_broken_episode_is_named_and_the_others_are_imported(tmp_path: Path, text: str) -> None:
    good = streamed(document(frames=3, cameras=0))
    for name, content in (("a", good), ("b", text), ("c", good)):
        episode(tmp_path / "task" / name, content)
    code, output = dexkit("import", tmp_path / "task", tmp_path / "out")
    assert (code, "b: refused" in output) == (1, True), output
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.mcap", "c.mcap"]


# -- LeRobot -------------------------------------------------------------------------------------

VIDEO = {"dtype": "video", "shape": [480, 640, 3], "names": None}
PATTERNS = [
    *("{episode_index:c}", "{episode_index!x}", "{episode_index.__class__}", "{0}", "{", "{}"),
    *("{episode_index.nosuch}", "{episode_index[0]}", "{chunk_index:d", "{video_key.__init__}"),
    *("{episode_index:9999}", "{episode_index:" + "9" * 30 + "}", "{file_index:>{file_index}}"),
    *("../../../etc/passwd", "/etc/passwd", "data/../../x", "data\x00", "\ud800", "a" * 5000, ""),
    *("meta", ".", "data", 5, [], {}, True),
]  # fmt: skip


def described(root: Path, **values: Any) -> Path:
    """A dataset of an episode with other values in its ``info.json``."""
    source = dataset(root, "v2.1", NAMES, np.full((3, 28), 0.1))
    path = source / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    return source


@each("pattern", PATTERNS, ids=lambda v: repr(v)[:40])
def test_hostile_path_of_a_dataset(tmp_path: Path, pattern: Any) -> None:
    source = described(tmp_path / "d", data_path=pattern)
    code, output = dexkit("import", source, tmp_path / "o.mcap")
    assert (code, str(source) in output) == (2, True), output
    features = {"observation.images.x": VIDEO}
    path = source / "meta" / "info.json"
    info = json.loads(path.read_text()) | {"data_path": _DATA, "video_path": pattern}
    path.write_text(json.dumps(info | {"features": info["features"] | features}))
    code, output = dexkit("import", source, tmp_path / "o.mcap")
    assert code == (1 if isinstance(pattern, str) else 2), output
    if code == 1:
        assert "x: " in output


_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"


@each(
    "key,value,place",
    [
        *(("fps", v, "no rate") for v in (None, 0, -1, 1e308, "30", True, [[]], {})),
        *(("features", v, ": features") for v in (None, [], 5, {"a": 5}, {"a": {"dtype": 5}})),
        *(("chunks_size", v, ": chunks_size") for v in (0, -1, "a", 1e308, None)),
        *(("robot_type", v, ": robot_type") for v in (5, [])),
        ("chunks_size", "\udc80", "surrogates not allowed"),
        *(("codebase_version", v, "codebase_version") for v in (5, [], None)),
        *(("dexkit", v, ": dexkit") for v in (5, [], {"parts": {}}, {"sessions": []})),
        ("dexkit", {"sessions": {"0": {"start_ns": "²"}}}, ": dexkit.sessions[...].start_ns"),
        ("dexkit", {"sessions": {"0": {"start_ns": "9" * 19}}}, "January 2038"),
        *(
            ("dexkit", {"parts": [{"part": p, "joints": NAMES, "features": NAMES} | more]}, place)
            for p, more, place in (
                ("a/b", {}, ": dexkit.parts[0].part"),
                ("a" * 300, {}, ": dexkit.parts[0].part"),
                (5, {}, ": dexkit.parts[0].part"),
                ("left_hand", {"model": "dex3-1"}, "28 joints is no dex3-1"),
                ("inspire_hand", {"model": "dex3-1"}, "is no dex3-1"),
                ("left_hand", {"model": "nosuch"}, "nosuch"),
                ("a", {"joints": [5]}, ": dexkit.parts[0].joints[0]"),
            )
        ),
        ("extra", NESTED, "nested more than"),
        ("extra", 10**400, "more than 20 digits"),
    ],
    ids=str,
)
def test_hostile_description_of_a_dataset(tmp_path: Path, key: str, value: Any, place: str) -> None:
    source = described(tmp_path / "d", **{key: value})
    code, output = dexkit("import", source, tmp_path / "o.mcap")
    assert (code, place in output) == (2, True), output


ROW = {"episode_index": 1, "tasks": ["b"]}


@each(
    "file,line,told",
    [
        ("episodes", "{", "episodes.jsonl, line 2"),
        ("episodes", "[]", "episodes.jsonl, line 2"),
        ("episodes", DEEP, "episodes.jsonl, line 2"),
        ("episodes", "\x00", "episodes.jsonl, line 2"),
        *(
            ("episodes", json.dumps(ROW | {"episode_index": v}), ": episode_index")
            for v in (-1, 1.5, "1", None, True, 10**18, [])
        ),
        ("episodes", json.dumps(ROW | {"tasks": 5}), ": tasks"),
        ("episodes", json.dumps(ROW | {"data/chunk_index": "x"}), "data/chunk_index"),
        ("episodes", json.dumps(ROW | {"episode_index": 0}), "episode 0 occurs twice"),
        ("episodes", json.dumps(ROW), "episode_000001.parquet: No such file"),
        ("tasks", "{", "tasks.jsonl, line 2"),
        ("tasks", '{"task_index": [], "task": "a"}', ": task_index"),
        ("tasks", '{"task_index": 1, "task": []}', ": task"),
    ],
    ids=str,
)
def test_hostile_row_of_a_dataset_is_named_and_the_others_are_imported(
    tmp_path: Path, file: str, line: str, told: str
) -> None:
    source = dataset(tmp_path / "d", "v2.1", NAMES, np.full((3, 28), 0.1))
    path = source / "meta" / f"{file}.jsonl"
    path.write_text(f"{path.read_text().rstrip()}\n{line}\n")
    code, output = dexkit("import", source, tmp_path / "out")
    assert (code, told in output) == (1, True), output
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["episode_000000.mcap"]
