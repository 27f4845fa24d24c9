"""The reader of recordings: shapes, truncation, selection of topics."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType

from dexkit.errors import TraceError, TraceUnreadable, TraceUnsupported
from dexkit.traces import SAMPLES, Trace, open_trace, sample_labels, sample_path
from dexkit.traces import reader as reader_module
from dexkit.traces.names import dds_topic, dds_type
from tests.each import each
from tests.trace_helpers import (
    CMD,
    CMD_TYPE,
    SHAPES,
    STATE,
    STATE_TYPE,
    T0,
    Row,
    Shape,
    cmd,
    mcap_bytes,
    rows,
    write,
)

QUICK = settings(
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def as_rows(path: Path) -> list[Row]:
    """What dexkit reads."""
    return [
        (m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in open_trace(path).messages()
    ]


# -- the shipped recordings ----------------------------------------------------------------------

RECORDED_BY_DEXKIT = ("brainco_grip", "inspire_dfx_grip", "inspire_ftp_grip")


def synthetic(trace: Trace) -> bool:
    """Whether its messages were never on DDS."""
    return trace.metadata["provenance"]["controller_commit"].startswith("none")


CAPTURED = Path(__file__).parent / "pinned" / "captured.json"
"""For each topic of each sample: messages, mean rate (Hz), interval (p50, p99, longest; ms) and
time of the first (s), as the capture itself counted them.
"""


@each("name", SAMPLES)
def test_a_sample_holds_what_its_capture_counted(name: str) -> None:
    table = json.loads(CAPTURED.read_text())[name]
    trace = open_trace(sample_path(name))
    assert not trace.truncated
    assert trace.warnings == []
    assert trace.topics == sorted(table)
    assert trace.first_ns == sample_labels(name).first_message_ns
    loaded = trace.load()
    ours = name in RECORDED_BY_DEXKIT or synthetic(trace)
    for channel in trace.channels:
        count, hz, p50, p99, worst, first = table[channel.topic]
        assert channel.supported
        assert channel.schema_encoding == ("ros2msg" if ours else "omgidl")
        assert channel.message_count == count
        times = loaded[channel.topic].log_time_ns
        gaps = np.diff(times) / 1e6
        assert len(times) == count
        assert (count - 1) / ((times[-1] - times[0]) / 1e9) == pytest.approx(hz, abs=0.06)
        assert np.percentile(gaps, 50) == pytest.approx(p50, abs=0.006)
        assert np.percentile(gaps, 99) == pytest.approx(p99, abs=0.02)
        assert gaps.max() == pytest.approx(worst, abs=0.06)
        assert (times[0] - trace.first_ns) / 1e9 == pytest.approx(first, abs=0.006)


@each("name", SAMPLES)
def test_every_payload_of_a_sample_decodes(name: str) -> None:
    trace = open_trace(sample_path(name))
    for topic, samples in trace.load().items():
        columns = samples.columns()
        assert columns.errors == {}
        kind = trace.message_type(topic)
        middle = samples.payloads[len(samples) // 2]
        # CycloneDDS fills up to a multiple of four
        encoded = kind.encode(kind.decode(middle))
        assert encoded + bytes(-len(encoded) % 4) == middle


# -- the same content in every shape ---------------------------------------------------------------


@each("shape", SHAPES, ids=str)
def test_every_shape_reads_the_same(tmp_path: Path, shape: Shape) -> None:
    expected = rows()
    path = write(tmp_path / "a.mcap", mcap_bytes(expected, shape, metadata={"a": {"b": "c"}}))
    trace = open_trace(path)
    assert (trace.truncated, trace.warnings) == (False, [])
    assert trace.metadata == {"a": {"b": "c"}}
    assert (trace.profile, trace.library) == ("ros2", "a test")
    assert as_rows(path) == expected
    counts = Counter(r[0] for r in expected)
    for channel in trace.channels:
        of_topic = [r for r in expected if r[0] == channel.topic]
        assert channel.message_count == counts[channel.topic]
        assert (channel.first_ns, channel.last_ns) == (of_topic[0][1], of_topic[-1][1])
    samples = trace.samples(CMD)
    assert samples.payloads == [r[3] for r in expected if r[0] == CMD]
    assert samples.publish_time_ns.tolist() == [r[2] for r in expected if r[0] == CMD]


shapes = st.builds(
    Shape,
    compression=st.sampled_from(CompressionType),
    chunked=st.booleans(),
    chunk_size=st.sampled_from([1, 300, 1 << 20]),
    index=st.sampled_from([IndexType.ALL, IndexType.NONE, IndexType.CHUNK]),
    summary=st.booleans(),
)


@QUICK
@given(
    shape=shapes,
    times=st.lists(
        st.tuples(
            st.booleans(), st.integers(0, 1000), st.integers(0, 2**40), st.binary(max_size=40)
        ),
        max_size=40,
    ),
)
def test_reads_what_the_mcap_library_reads(
    tmp_path: Path, shape: Shape, times: list[tuple[bool, int, int, bytes]]
) -> None:
    # the library's own seeking reader needs the channels repeated in the summary
    assume(shape.summary or shape.index is IndexType.NONE)
    written = [(CMD if c else STATE, T0 + t, p, d) for c, t, p, d in times]
    data = mcap_bytes(written, shape)
    theirs = [
        (channel.topic, m.log_time, m.publish_time, m.data)
        for _, channel, m in make_reader(io.BytesIO(data)).iter_messages()
    ]
    path = write(tmp_path / "a.mcap", data)
    ours = as_rows(path)
    # of equal times, chunks that overlap may give the later one first
    assert [r[1] for r in ours] == sorted(r[1] for r in written)
    assert Counter(ours) == Counter(theirs)
    trace = open_trace(path)
    for topic, samples in trace.load().items():
        assert (np.diff(samples.log_time_ns) >= 0).all()
        of_topic = [(m[1], m[2], m[3]) for m in ours if m[0] == topic]
        mine = zip(
            samples.log_time_ns.tolist(),
            samples.publish_time_ns.tolist(),
            samples.payloads,
            strict=True,
        )
        assert Counter(mine) == Counter(of_topic)


# -- unfinished files ------------------------------------------------------------------------------


def header_end(data: bytes) -> int:
    return 8 + 9 + struct.unpack_from("<Q", data, 9)[0]


def check_cut(tmp_path: Path, data: bytes, cut: int, expected: list[Row]) -> int:
    path = write(tmp_path / "cut.mcap", data[:cut])
    if cut < header_end(data):
        with pytest.raises(TraceUnreadable):
            open_trace(path)
        return 0
    trace = open_trace(path)
    assert trace.truncated
    assert any("unfinished" in w for w in trace.warnings)
    assert ("it holds no messages" in trace.warnings) == (trace.message_count == 0)
    got = [(m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in trace.messages()]
    assert got == expected[: len(got)], "what is left must be a prefix of what was"
    assert trace.message_count == len(got)
    return len(got)


@each("shape", SHAPES, ids=str)
def test_a_file_cut_anywhere_is_read_as_far_as_it_goes(tmp_path: Path, shape: Shape) -> None:
    expected = rows(20)
    data = mcap_bytes(expected, shape, metadata={"m": {"k": "v"}})
    last = 0
    # every byte around the ends of records, and a comb over the rest
    offsets = sorted({*range(0, len(data), 29), *range(min(120, len(data))), len(data) - 1})
    for cut in offsets:
        got = check_cut(tmp_path, data, cut, expected)
        assert got >= last, "a longer file never gives less"
        last = got
    assert last == len(expected)


def test_the_end_of_a_chunk_that_was_cut_is_salvaged(tmp_path: Path) -> None:
    expected = rows(4000)
    for compression in CompressionType:
        # one chunk, and so most of the file
        data = mcap_bytes(expected, Shape(compression, chunk_size=1 << 22))
        path = write(tmp_path / "cut.mcap", data[: len(data) // 2])
        trace = open_trace(path)
        got = [(m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in trace.messages()]
        assert len(got) > len(expected) // 5
        assert got == expected[: len(got)]


# -- hostile files ---------------------------------------------------------------------------------


@QUICK
@given(
    shape=st.sampled_from(SHAPES),
    edits=st.lists(
        st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=9)), min_size=1, max_size=6
    ),
)
def test_damage_is_a_typed_error_or_a_warning(
    tmp_path: Path, shape: Shape, edits: list[tuple[float, bytes]]
) -> None:
    data = bytearray(mcap_bytes(rows(30), shape))
    for where, replacement in edits:
        at = int(where * (len(data) - 1))
        data[at : at + len(replacement)] = replacement
    path = write(tmp_path / "a.mcap", bytes(data))
    try:
        trace = open_trace(path)
        for _ in trace.messages():
            pass
        for samples in trace.load().values():
            assert len(samples.payloads) == len(samples.log_time_ns)
        assert trace.duration >= 0
        assert isinstance(trace.endpoints, list)
    except TraceError:
        pass  # and nothing else


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


HEADER = MCAP0_MAGIC + record(1, struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0))


def chunk(packed: bytes, size: int, compression: bytes, crc: int = 0) -> bytes:
    head = struct.pack("<QQQII", 0, 0, size, crc, len(compression)) + compression
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


HOSTILE = {
    "record of 2**63 bytes": HEADER + record(5, b"abc", 2**63),
    "chunk of 2**63 bytes": HEADER + record(6, bytes(60), 2**63),
    "chunk that claims 2**60 bytes unpacked": HEADER + chunk(b"abc", 2**60, b"zstd"),
    "chunk that claims 2**60 bytes packed": HEADER
    + record(6, struct.pack("<QQQII", 0, 0, 10, 0, 0) + struct.pack("<Q", 2**60)),
    "zstd bomb": HEADER + chunk(zstandard.compress(bytes(64 * 2**20)), 100, b"zstd"),
    "compression name of 2**32 bytes": HEADER
    + record(6, struct.pack("<QQQII", 0, 0, 10, 0, 2**32 - 1) + bytes(40)),
    "schema name of 2**32 bytes": HEADER + record(3, struct.pack("<HI", 1, 2**32 - 1) + b"abc"),
    "channel metadata of 2**32 bytes": HEADER
    + record(4, struct.pack("<HHIII", 1, 1, 0, 0, 2**32 - 1) + bytes(8)),
    "message index of 2**32 bytes": HEADER
    + chunk(b"", 0, b"")
    + record(7, struct.pack("<HI", 1, 2**32 - 1)),
    "message shorter than its head": HEADER + record(5, b"abc") + bytes(40),
    "unknown compression": HEADER + chunk(b"abc", 3, b"brotli"),
    "wrong checksum": HEADER + chunk(b"abcdefghi", 9, b"", crc=1),
    "empty lz4 chunk": HEADER + chunk(b"", 0, b"lz4"),
}


@each("name", HOSTILE)
def test_hostile_length_allocates_no_memory_and_raises_nothing(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "a.mcap", HOSTILE[name])
    tracemalloc.start()
    try:
        trace = open_trace(path)
        assert list(trace.messages()) == []
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert trace.truncated
    assert trace.warnings
    assert peak < 20 * 2**20


def test_reading_holds_a_chunk_and_not_the_file(tmp_path: Path) -> None:
    many = [(STATE, T0 + i * 1000, 0, bytes(1000)) for i in range(20_000)]
    path = write(tmp_path / "a.mcap", mcap_bytes(many, Shape(chunk_size=100_000)))
    del many
    peaks = []
    for _ in range(2):  # a thread that another test left may allocate meanwhile
        tracemalloc.start()
        try:
            count = sum(1 for _ in open_trace(path).messages())
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert count == 20_000
    assert path.stat().st_size > 20 * 2**20
    assert min(peaks) < 3 * 2**20


# -- what is not a recording -----------------------------------------------------------------------


@each(
    ("content", "hint"),
    [
        (b"", "empty"),
        (b"SQLite format 3\0" + bytes(100), "db3"),
        (b"#ROSBAG V2.0\n", "ROS 1"),
        (zstandard.compress(b"x" * 100), "zstd -d"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"hello, this is text", "mcap"),
    ],
)
def test_a_foreign_file_is_refused_with_a_hint(tmp_path: Path, content: bytes, hint: str) -> None:
    with pytest.raises(TraceUnreadable) as caught:
        open_trace(write(tmp_path / "a.mcap", content))
    assert hint in caught.value.hint


def test_directory_of_a_bag_is_read_as_its_single_file(tmp_path: Path) -> None:
    write(tmp_path / "bag_0.mcap", mcap_bytes(rows(10)))
    assert open_trace(tmp_path).message_count == len(rows(10))
    write(tmp_path / "bag_1.mcap", mcap_bytes(rows(10)))
    with pytest.raises(TraceUnreadable, match="2 mcap files"):
        open_trace(tmp_path)


# -- names and layouts -----------------------------------------------------------------------------


def test_ros_names_are_the_same_thing(tmp_path: Path) -> None:
    ros = [(t.removeprefix("rt"), a, b, d) for t, a, b, d in rows(10)]
    types = {CMD.removeprefix("rt"): CMD_TYPE, STATE.removeprefix("rt"): STATE_TYPE}
    path = write(tmp_path / "a.mcap", mcap_bytes(ros, types=types))
    trace = open_trace(path)
    assert as_rows(path) == rows(10)
    assert {c.recorded_topic for c in trace.channels} == {"/dex1/left/cmd", "/dex1/left/state"}
    assert {c.type_name for c in trace.channels} == {CMD_TYPE, STATE_TYPE}
    assert len(trace.samples("/dex1/left/cmd")) == len(trace.samples("dex1/left/cmd")) == 5


@each("name", ["/dex1/left/cmd", "dex1/left/cmd", "rt/dex1/left/cmd", "/rt/dex1/left/cmd"])
def test_every_spelling_of_a_topic(name: str) -> None:
    assert dds_topic(name) == CMD


@each(
    "name",
    [
        CMD_TYPE,
        "unitree_go/msg/MotorCmds",
        "unitree_go/MotorCmds",
        "unitree_go::msg::MotorCmds",
        "unitree_go.msg.dds_.MotorCmds_",
        "unitree_go/msg/dds_/MotorCmds_",
    ],
)
def test_every_spelling_of_a_type(name: str) -> None:
    assert dds_type(name) == CMD_TYPE


def test_one_channel_of_an_unknown_kind_leaves_the_others_usable(tmp_path: Path) -> None:
    from mcap.writer import Writer

    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    image = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
    proto = writer.register_schema("foxglove.Log", "protobuf", b"\x00\xff\x00")
    good = writer.register_schema(
        "unitree_go/msg/MotorCmds",
        "ros2msg",
        reader_module.message_type(CMD_TYPE).ros2msg.encode(),
    )
    for topic, encoding, schema in (
        ("/image", "cdr", image),
        ("/log", "protobuf", proto),
        ("/bare", "json", 0),
        ("/dex1/left/cmd", "cdr", good),
    ):
        channel = writer.register_channel(topic, encoding, schema)
        writer.add_message(channel, T0, cmd(1.0), T0)
    writer.finish()
    trace = open_trace(write(tmp_path / "a.mcap", out.getvalue()))
    problems = {c.topic: c.problem for c in trace.channels}
    assert "does not know the type" in problems["rt/image"]
    assert "message encoding 'protobuf'" in problems["rt/log"]
    assert "message encoding 'json'" in problems["rt/bare"]
    assert problems[CMD] == ""
    assert len(trace.warnings) == 3
    assert trace.samples(CMD).columns()["cmds[0].q"].tolist() == [1.0]
    assert len(trace.samples("/image")) == 1
    with pytest.raises(TraceUnsupported):
        trace.message_type("/image")
