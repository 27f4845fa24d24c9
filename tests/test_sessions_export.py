"""Recordings become other formats and come back: ``dexkit export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from dexkit.cli import cli
from dexkit.messages import message_type
from dexkit.robots import ROBOTS, RobotModel
from dexkit.traces import Recorder, open_trace, sample_path
from dexkit.traces.reader import Definition
from dexkit.traces.sessions import topic_tables
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


def test_programs_read_what_became_of_each_session(tmp_path: Path, part: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"nothing")
    run = CliRunner().invoke
    there = run(
        cli, ["export", str(part), str(bad), *f"--to csv --out {tmp_path}/t --json".split()]
    )
    found = json.loads(there.stdout)
    assert [one["recording"] for one in found["exported"]] == [str(part)]
    assert [one["recording"] for one in found["refused"]] == [str(bad)]
    back = run(cli, ["import", found["exported"][0]["folder"], f"{tmp_path}/b.mcap", "--json"])
    (one,) = json.loads(back.stdout)["imported"]
    assert one["messages"] == found["exported"][0]["messages"]
    assert Path(one["recording"]).is_file()


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


@pytest.mark.slow
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
