"""Recordings are read by foreign software: rosbags, mcap-ros2-support, the mcap library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dexkit.messages import message_type
from dexkit.traces import Recorder, Trace, open_trace, sample_path
from tests.trace_helpers import CMD_TYPE, STATE_TYPE

SOURCES = ["dex1_pick_place", "dex1_legacy_v1_1", "dex3_pinch"]
EVERY = 25  # every so many messages are compared: decoding them all in Python takes long


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Sample recordings, written again by the recorder (and so with ros2msg schemas)."""
    folder = tmp_path_factory.mktemp("recorded")
    paths = {}
    for name in SOURCES:
        paths[name] = folder / f"{name}.mcap"
        with Recorder(paths[name]) as recorder:
            for i, m in enumerate(open_trace(sample_path(name)).messages()):
                if i % EVERY == 0:
                    recorder.put(m.topic, m.type_name, m.data, m.log_time_ns, m.publish_time_ns)
    return paths


def plain(value: Any) -> Any:
    """A decoded message of any library as nested tuples of numbers, in field order."""
    if isinstance(value, (int, float, np.number)):
        return float(value)
    if isinstance(value, (list, tuple, np.ndarray)):
        return tuple(plain(v) for v in value)
    names = [
        n for n in getattr(value, "__slots__", None) or value.__dataclass_fields__ if n[0] != "_"
    ]
    return tuple(plain(getattr(value, n)) for n in names)


def ours(trace: Trace) -> list[tuple[str, int, Any]]:
    return [
        (m.topic, m.log_time_ns, plain(message_type(m.type_name).decode(m.data)))
        for m in trace.messages()
    ]


@pytest.mark.parametrize("name", SOURCES)
def test_rosbags_reads_the_same_values(recorded: dict[str, Path], name: str) -> None:
    with AnyReader([recorded[name]]) as reader:
        theirs = [
            (c.topic, t, plain(reader.deserialize(raw, c.msgtype)))
            for c, t, raw in reader.messages()
        ]
        types = {c.topic: c.msgtype for c in reader.connections}
    trace = open_trace(recorded[name])
    assert types == {c.topic: message_type(c.type_name).ros_name for c in trace.channels}
    assert len(theirs) > 500
    assert sorted(theirs) == sorted(ours(trace))


@pytest.mark.parametrize("name", SOURCES)
def test_mcap_ros2_support_reads_the_same_values(recorded: dict[str, Path], name: str) -> None:
    with recorded[name].open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        theirs = [
            (channel.topic, message.log_time, plain(decoded))
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]
    assert sorted(theirs) == sorted(ours(open_trace(recorded[name])))


def test_the_mcap_library_validates_what_we_write(recorded: dict[str, Path]) -> None:
    with recorded["dex1_pick_place"].open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        count = sum(1 for _ in reader.iter_messages())
        assert reader.get_header().profile == "ros2"
    assert count == summary.statistics.message_count > 500
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}


def test_ros_2_bag_reads_the_same(tmp_path: Path) -> None:
    """A bag written by rosbags: /dex1/left/cmd, ros2msg, its own type store and CDR encoder."""
    store = get_typestore(Stores.EMPTY)
    for name in (CMD_TYPE, STATE_TYPE):
        kind = message_type(name)
        store.register(get_types_from_msg(kind.ros2msg, kind.ros_name))
    types = store.types
    bag = tmp_path / "bag"
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            "/dex1/left/cmd", "unitree_go/msg/MotorCmds", typestore=store
        )
        for i in range(20):
            motor = types["unitree_go/msg/MotorCmd"](
                mode=1,
                q=0.1 * i,
                dq=0.0,
                tau=0.0,
                kp=5.0,
                kd=0.05,
                reserve=np.array([1, 2, i], dtype=np.uint32),
            )
            message = types["unitree_go/msg/MotorCmds"](cmds=[motor])
            data = store.serialize_cdr(message, "unitree_go/msg/MotorCmds")
            writer.write(connection, 1_000 + i, data)
    trace = open_trace(bag)
    (channel,) = trace.channels
    assert channel.topic == "rt/dex1/left/cmd"
    assert channel.recorded_topic == "/dex1/left/cmd"
    assert channel.type_name == CMD_TYPE
    assert (channel.problem, trace.warnings) == ("", [])
    columns = trace.samples("rt/dex1/left/cmd").columns()
    assert columns["cmds[0].q"] == pytest.approx([0.1 * i for i in range(20)], abs=1e-6)
    assert columns["cmds[0].reserve"].shape == (20, 3)
