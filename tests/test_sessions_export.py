"""Recordings become other formats and come back: ``dexkit export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from dexkit.digests import sha256_of_file
from dexkit.messages import message_type
from dexkit.robots import ROBOTS, RobotModel
from dexkit.traces import Recorder, open_trace, sample_path
from dexkit.traces.reader import Definition
from dexkit.traces.sessions import lerobot_out, ros_types, topic_tables
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.sessions.streams import streams_of
from dexkit.traces.writer import RecordingWriter, definition
from dexkit.wire.low_level import encode_with_crc
from tests.each import each
from tests.messages_helpers import NAMES, messages
from tests.robot_helpers import Bench, low_cmd
from tests.test_sessions_import import dexkit

T0 = 1_795_251_429_000_000_000


def rows(path: Path) -> list[tuple[str, int, int, bytes]]:
    return sorted(
        (m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in open_trace(path).messages()
    )


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of a session with every kind of topic of a Dex3."""
    out = tmp_path_factory.mktemp("part") / "part.mcap"
    trace = open_trace(sample_path("dex3_pinch"))
    begin = trace.first_ns + 5 * 10**9
    cut(trace, out, spans=[Span(begin, begin + 10**9 // 4)])
    return out


@each("form", ["csv", "parquet"])
def test_tables_give_the_recording_back(tmp_path: Path, part: Path, form: str) -> None:
    code, output = dexkit("export", part, "--to", form, "--out", tmp_path / "t")
    assert code == 0, output
    assert dexkit("import", tmp_path / "t", tmp_path / "back.mcap")[0] == 0
    back = open_trace(tmp_path / "back.mcap")
    assert rows(tmp_path / "back.mcap") == rows(part)
    assert back.metadata == open_trace(part).metadata
    about = json.loads((tmp_path / "t" / "session.json").read_text())
    assert any("padding" in text for text in about["lost"])
    assert dexkit("export", part, "--to", form, "--out", tmp_path / "t")[0] == 2  # it exists


def test_a_parquet_table_has_the_values_of_the_messages(tmp_path: Path, part: Path) -> None:
    assert dexkit("export", part, "--to", "parquet", "--out", tmp_path / "t")[0] == 0
    entries = json.loads((tmp_path / "t" / "session.json").read_text())["topics"]
    for entry in entries:
        table = pq.read_table(tmp_path / "t" / entry["file"])
        sent = list(open_trace(part).messages([entry["topic"]]))
        mt = message_type(entry["type"])
        assert table["log_time_ns"].to_pylist() == [m.log_time_ns for m in sent]
        assert table[f"{mt.motor_sequence}[2].q"].type == "float"
        for i in (0, len(sent) - 1):
            motors = getattr(mt.decode(sent[i].data), mt.motor_sequence)
            for j, motor in enumerate(motors):
                assert table[f"{mt.motor_sequence}[{j}].q"][i].as_py() == motor.q


@settings(max_examples=10, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(
    st.sampled_from(NAMES).flatmap(
        lambda n: st.tuples(st.just(n), st.lists(messages(n, 2), max_size=2))
    )
)
def test_messages_of_every_type_survive_tables(
    tmp_path_factory: pytest.TempPathFactory, made: tuple[str, list[Any]]
) -> None:
    name, found = made
    folder = tmp_path_factory.mktemp("any")
    mt = message_type(name)
    with RecordingWriter(folder / "a.mcap") as writer:
        number = writer.add_channel(definition("rt/any", mt))
        for i, message in enumerate(found):
            writer.put(number, mt.encode(message), T0 + i)
    for form in ("csv", "parquet"):
        topic_tables.export_tables(open_trace(folder / "a.mcap"), folder / form, form)
        if found:
            topic_tables.import_tables(folder / form, folder / f"{form}.mcap")
            assert rows(folder / f"{form}.mcap") == rows(folder / "a.mcap")


def test_damaged_tables_lose_their_rows_only(tmp_path: Path, part: Path) -> None:
    assert dexkit("export", part, "--to", "csv", "--out", tmp_path / "t")[0] == 0
    first, second, *_ = sorted((tmp_path / "t").glob("*.csv"))
    lines = first.read_text().splitlines()
    cells = lines[3].split(",")
    cells[7] = "many"
    lines[3] = ",".join(cells)
    lines[5] = lines[5][:40]
    first.write_text("\n".join(lines))
    second.write_bytes(b"\xff\xfe")
    code, output = dexkit("import", tmp_path / "t", tmp_path / "back.mcap")
    assert code == 1
    assert "row 4, and 1 more" in output
    assert "not UTF-8" in output
    lost = len(second.read_bytes())
    assert lost == 2
    names = {m[0] for m in rows(tmp_path / "back.mcap")}
    assert len(names) == 3


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_gives_the_payloads_back(tmp_path: Path, part: Path, storage: str) -> None:
    out = tmp_path / "bag"
    code, output = dexkit(
        "export", part, "--to", "rosbag2", "--set", f"storage={storage}", "--out", out
    )
    assert (code, "publish time" in output) == (0, True)
    with AnyReader([out]) as reader:
        topics = {c.topic for c in reader.connections}
        connection, _, raw = next(reader.messages())
        value = reader.deserialize(raw, connection.msgtype)
    assert topics == {f"/dex3/{s}/{k}" for s in ("left", "right") for k in ("state", "cmd")}
    motors = getattr(value, "motor_state", None) or value.motor_cmd
    assert len(motors) == 7
    assert dexkit("import", out, tmp_path / "back.mcap")[0] == 0
    assert [(t, log, d) for t, log, _, d in rows(tmp_path / "back.mcap")] == [
        (t, log, d) for t, log, _, d in rows(part)
    ]
    back, source = open_trace(tmp_path / "back.mcap").metadata, open_trace(part).metadata
    assert {k: back[k] for k in source} == source


def test_several_recordings_are_exported_and_one_refused(tmp_path: Path, part: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"nothing")
    code, output = dexkit("export", part, bad, "--to", "csv", "--out", tmp_path / "all")
    assert (code, "bad.mcap: refused" in output) == (1, True)
    assert [p.name for p in (tmp_path / "all").iterdir()] == ["part"]
    assert dexkit("export", bad, "--to", "csv", "--out", tmp_path / "one")[0] == 2


@each(
    "values",
    [
        pa.array([[1.0]] * 2),
        pa.array([{"a": 1}] * 2),
        pa.array([2**30] * 2, pa.date32()),
        pa.array([2**62] * 2, pa.timestamp("ns")),
        pa.array([1] * 2, pa.duration("s")),
        pa.array([[("a", 1)]] * 2, pa.map_(pa.string(), pa.int64())),
    ],
    ids=lambda values: str(values.type).partition("<")[0],
)
def test_a_table_with_columns_of_other_types_is_refused(
    tmp_path: Path, part: Path, values: pa.Array
) -> None:
    assert dexkit("export", part, "--to", "parquet", "--out", tmp_path / "t")[0] == 0
    path = sorted((tmp_path / "t").glob("*.parquet"))[0]
    table = pq.read_table(path).slice(0, 2)
    name = table.column_names[-1]
    pq.write_table(table.set_column(table.num_columns - 1, name, values), path)
    code, output = dexkit("import", tmp_path / "t", tmp_path / "back.mcap")
    assert (code, f"column {name}" in output, path.name in output) == (1, True, True), output
    there = len(open_trace(tmp_path / "back.mcap").definitions)
    assert there == len(open_trace(part).definitions) - 1


@each("to", ["csv", "parquet", "rosbag2", "rosbag2 --set storage=mcap"])
def test_times_after_2262_are_told(tmp_path: Path, to: str) -> None:
    mt = message_type("unitree_hg::msg::dds_::HandState_")
    data = mt.encode(mt.cls())
    known = definition("rt/dex3/left/state", mt)
    other = ros_types.STRING.definition("rt/text")
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for channel, payload in ((known, data), (other, ros_types.encode_string("a"))):
            number = writer.add_channel(channel)
            for stamp in (T0, 2**63 - 1, 2**64 - 1):
                writer.put(number, payload, stamp, stamp)
    code, output = dexkit(
        "export", tmp_path / "a.mcap", "--to", *to.split(), "--out", tmp_path / "out"
    )
    assert (code, output.count("after the year 2262")) == (0, 2), output
    assert dexkit("import", tmp_path / "out", tmp_path / "back.mcap")[0] == 0
    times = [m.log_time_ns for m in open_trace(tmp_path / "back.mcap").messages()]
    assert times == [T0] * 2 + [2**63 - 1] * 4


@each("robot", ROBOTS.values(), ids=list(ROBOTS))
def test_the_motors_of_a_robot_become_streams(tmp_path: Path, robot: RobotModel) -> None:
    path = tmp_path / "robot.mcap"
    bench = Bench(robot)
    knee = robot.slot("left_knee")
    with Recorder(path) as recorder:
        for i in range(20):
            command = low_cmd(robot, {knee: 0.3 + 0.01 * i})
            state = bench.run(0.02, command)
            for topic, kind, message in (
                (robot.cmd_topic, robot.cmd_type, command),
                (robot.state_topic, robot.state_type, state),
            ):
                assert recorder.put(topic, kind, encode_with_crc(message), T0 + i * 20_000_000)
    commands, states = streams_of(open_trace(path))
    assert (commands.kind, states.kind) == ("command", "state")
    assert commands.part == states.part == robot.name
    assert commands.joints == tuple(robot.joint(slot).name for slot in robot.used)
    column = robot.used.index(knee)
    assert commands.values["q"][:, column] == pytest.approx(0.3 + 0.01 * np.arange(20))
    assert states.values["q"][-1, column] == pytest.approx(state.motor_state[knee].q)
    code, output = dexkit("export", path, "--to", "episodes", "--out", tmp_path / "e")
    assert code == 0, output
    assert dexkit("info", path, "--plot")[0] == 0


def test_equal_values_are_distinguished(tmp_path: Path) -> None:
    mt = message_type("unitree_go::msg::dds_::MotorCmds_")
    motor = mt.motor_type.cls
    values = [0.0, -0.0, np.float32(np.nan).item(), float("inf"), 1e-45, 3.4028234e38]
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        number = writer.add_channel(definition("rt/dex1/left/cmd", mt))
        for i, q in enumerate(values):
            writer.put(number, mt.encode(mt.cls([motor(q=q)] * (i % 3))), T0 + i)
    for form in ("csv", "parquet"):
        topic_tables.export_tables(open_trace(tmp_path / "a.mcap"), tmp_path / form, form)
        topic_tables.import_tables(tmp_path / form, tmp_path / f"{form}.mcap")
        assert rows(tmp_path / f"{form}.mcap") == rows(tmp_path / "a.mcap")


@pytest.fixture
def long(tmp_path: Path, part: Path) -> Path:
    """The session twice with a gap between, with messages that a table has to tell apart."""
    out = tmp_path / "long.mcap"
    trace = open_trace(part)
    mt = message_type("unitree_hg::msg::dds_::HandState_")
    other = Definition("rt/other", "cdr", {}, ("other/msg/Other", "ros2msg", b"int32 a"))
    with RecordingWriter(out) as writer:
        channels = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        unknown = writer.add_channel(other)
        for shift in (0, 10 * 10**9):
            for i, m in enumerate(trace.messages()):
                data = m.data
                if m.topic == "rt/dex3/left/state" and i % 5 == 0:
                    data = mt.encode(mt.cls(motor_state=mt.decode(data).motor_state[:3]))
                elif m.topic == "rt/dex3/right/state" and i % 7 == 3:
                    data = data[:40]
                at = m.log_time_ns + shift
                writer.put(channels[m.topic, m.type_name], data, at, m.publish_time_ns)
                if i % 10 == 0:
                    writer.put(unknown, data, at, 0)
    return out


@each("form", ["csv", "parquet"])
def test_tables_are_the_same_in_pieces_of_any_size(
    tmp_path: Path, long: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    written, lost = topic_tables.export_tables(open_trace(long), whole, form)
    monkeypatch.setattr(topic_tables, "_VALUES_WRITTEN", 1500)
    monkeypatch.setattr(topic_tables, "_BYTES_WRITTEN", 5000)
    monkeypatch.setattr(topic_tables, "_ROWS_MEASURED", 7)
    assert topic_tables.export_tables(open_trace(long), pieces, form) == (written, lost)
    assert any("cannot be decoded" in text for text in lost)
    assert [p.name for p in sorted(pieces.iterdir())] == [p.name for p in sorted(whole.iterdir())]
    for path in whole.iterdir():
        if path.suffix == ".parquet":
            assert pq.read_table(path).equals(pq.read_table(pieces / path.name)), path.name
            assert pq.read_metadata(pieces / path.name).num_row_groups > 1
        else:
            assert path.read_bytes() == (pieces / path.name).read_bytes()


def test_pieces_are_the_samples(long: Path) -> None:
    trace = open_trace(long)
    for topic in trace.topics:
        whole = trace.samples(topic)
        pieces = list(trace.pieces(topic, 11))
        assert max(map(len, pieces)) == 11
        assert [p for piece in pieces for p in piece.payloads] == whole.payloads
        for name in ("log_time_ns", "publish_time_ns"):
            found = np.concatenate([getattr(piece, name) for piece in pieces])
            assert np.array_equal(found, getattr(whole, name))


def test_a_recording_of_many_runs_is_hashed_once(
    tmp_path: Path, long: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: list[Path] = []

    def digest(path: Path) -> str:
        hashed.append(path)
        return sha256_of_file(path)

    monkeypatch.setattr(lerobot_out, "sha256_of_file", digest)
    result = lerobot_out.export_dataset([open_trace(long)], tmp_path / "set")
    assert result.episodes > 1
    assert hashed == [long]


def test_streams_without_samples_have_the_same_values(long: Path) -> None:
    trace = open_trace(long)
    whole, alone = streams_of(trace), streams_of(trace, keep_samples=False)
    positions = streams_of(trace, positions=True)
    assert len(whole) == len(alone) == len(positions) == 4
    for a, b, c in zip(whole, alone, positions, strict=True):
        assert a.samples is not None
        assert b.samples is None
        assert c.pressure is None
        assert list(c.values) == ["q"]
        assert np.array_equal(a.q, c.q, equal_nan=True)
        assert a.values.keys() == b.values.keys()
        for name in a.values:
            assert np.array_equal(a.values[name], b.values[name], equal_nan=True)
        if a.kind == "state":
            assert a.pressure is not None
            assert b.pressure is not None
            first = a.samples.columns()["press_sensor_state[0].pressure[3]"]
            assert np.array_equal(a.pressure[:, 0], first, equal_nan=True)  # as in the messages
            assert np.array_equal(a.pressure, b.pressure, equal_nan=True)
