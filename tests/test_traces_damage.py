"""Damaged and hostile recordings: what is lost is told, what is left is read, and none takes more
time or memory than its size allows."""

from __future__ import annotations

import json
import os
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.writer import CompressionType

from dexkit.cli import main
from dexkit.cli.info import _print as print_info
from dexkit.cli.info import summary
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.errors import DexkitError, TraceError, TraceUnreadable, TraceUnsupported
from dexkit.messages import message_type
from dexkit.messages.columns import Columns
from dexkit.messages.layout import STRUCTS
from dexkit.messages.unitree_go import MotorState_, MotorStates_
from dexkit.traces import Recorder, open_trace, sample_path, schemas
from dexkit.traces.container import MAX_RATIO, SPARE
from tests.dds_helpers import free_domain
from tests.trace_helpers import (
    CMD,
    CMD_TYPE,
    STATE,
    STATE_TYPE,
    T0,
    Shape,
    cmd,
    mcap_bytes,
    rows,
    write,
)
from tools.campaign.fuzz.recordings import content, count_calls

MAGIC = b"\x89MCAP0\r\n"


def recorded(path: Path, n: int = 24) -> Path:
    """A small recording by dexkit itself."""
    with Recorder(path) as recorder:
        recorder.add_metadata("dds_endpoints", {f"{CMD} writer 1": "reliable, Durability.Volatile"})
        for topic, log, publish, data in rows(n):
            recorder.put(topic, CMD_TYPE if topic == CMD else STATE_TYPE, data, log, publish)
    return path


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str | bytes) -> bytes:
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(data)) + data


HEADER = MAGIC + record(1, text("ros2") + text(""))
END = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC


def chunk(inner: bytes, name: bytes = b"", size: int | None = None) -> bytes:
    packed = {b"": bytes, b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}[name](inner)
    size = len(inner) if size is None else size
    head = struct.pack("<QQQII", 0, 2**63, size, zlib.crc32(inner), len(name)) + name
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def message(channel: int, time: int, data: bytes = b"") -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, time, time) + data)


def definition(schema_text: str | None = None, encoding: str = "ros2msg") -> bytes:
    kind = message_type(STATE_TYPE)
    body = text(kind.ros_name) + text(encoding) + text(schema_text or kind.ros2msg)
    channel = struct.pack("<HH", 1, 1) + text(STATE) + text("cdr") + text("")
    return record(3, struct.pack("<H", 1) + body) + record(4, channel)


def places(data: bytes, opcode: int) -> list[int]:
    """Where records of that kind begin, outside of chunks."""
    found, at = [], len(MAGIC)
    while at + 9 <= len(data) - len(MAGIC):
        kind, length = struct.unpack_from("<BQ", data, at)
        found += [at] * (kind == opcode)
        at += 9 + length
    return found


# -- flipped bytes -------------------------------------------------------------------------------


def flips(tmp_path: Path, data: bytes, step: int) -> list[str]:
    """Flips after which something else is read and nothing is said."""
    path = write(tmp_path / "flipped.mcap", data)
    wanted, told = content(path)
    assert not told
    silent = []
    for mask in (None, 0xFF):
        for at in range(0, len(data), step):
            flipped = bytearray(data)
            flipped[at] ^= 1 << (7 * at % 8) if mask is None else mask
            write(path, bytes(flipped))
            try:
                got, told = content(path)
            except DexkitError:
                continue
            if got != wanted and not told:
                silent.append(f"byte {at}, mask {mask}")
    return silent


def test_flipped_byte_is_reported(tmp_path: Path) -> None:
    assert flips(tmp_path, recorded(tmp_path / "a.mcap").read_bytes(), 101) == []


@pytest.mark.soak
def test_each_flipped_byte_is_reported(tmp_path: Path) -> None:
    assert flips(tmp_path, recorded(tmp_path / "a.mcap").read_bytes(), 1) == []
    assert flips(tmp_path, sample_path("dex1_legacy_v1_1").read_bytes(), 997) == []


def test_every_byte_of_a_finished_recording_is_under_a_checksum(tmp_path: Path) -> None:
    for path in (recorded(tmp_path / "a.mcap"), sample_path("dex1_pick_place")):
        trace = open_trace(path)
        assert (trace.damage, trace.notes) == ([], [])
        data = path.read_bytes()
        (at,) = places(data, 15)
        assert struct.unpack_from("<I", data, at + 9)[0] == zlib.crc32(data[:at])


def test_a_chunk_whose_opcode_is_flipped_is_named(tmp_path: Path) -> None:
    for data_crc in (True, False):
        data = bytearray(mcap_bytes(rows(), Shape(chunk_size=700), data_crc=data_crc))
        at = places(data, 6)[3]
        data[at] ^= 0x80
        trace = open_trace(write(tmp_path / "a.mcap", bytes(data)))
        assert any(f"lists a chunk at byte {at}, which is not there" in d for d in trace.damage)
        assert 0 < len(list(trace.messages())) < len(rows())


def test_the_summary_cannot_rename_a_topic(tmp_path: Path) -> None:
    data = bytearray(mcap_bytes(rows(), Shape(chunk_size=700)))
    data[data.rindex(CMD.encode()) + 4] ^= 0x01
    trace = open_trace(write(tmp_path / "a.mcap", bytes(data)))
    assert trace.topics == [CMD, STATE]
    assert any("the summary" in d and "checksum" in d for d in trace.damage)
    assert any("channel" in d and "defined twice" in d for d in trace.damage)
    # with a checksum that was made right, too
    begin, offsets, _ = struct.unpack_from("<QQI", data, len(data) - 28)
    crc = zlib.crc32(data[begin : len(data) - 12])
    struct.pack_into("<QQI", data, len(data) - 28, begin, offsets, crc)
    trace = open_trace(write(tmp_path / "a.mcap", bytes(data)))
    trace.load()
    assert any("channel" in d and "defined twice" in d for d in trace.damage)


def test_records_after_garbage_are_read(tmp_path: Path) -> None:
    for shape in (Shape(chunk_size=700), Shape(chunked=False)):
        whole = mcap_bytes(rows(), shape, data_crc=True)
        for opcode in (6, 7) if shape.chunked else (5,):
            at = places(whole, opcode)[2]
            for place, value in ((at, 0), (at + 1, 0xFF), (at + 2, 1), (at + 8, 0xFF)):
                for data in (whole, whole[:-30]):  # finished or not
                    damaged = bytearray(data)
                    damaged[place] = value
                    trace = open_trace(write(tmp_path / "a.mcap", bytes(damaged)))
                    got = [tuple(m) for m in trace.messages()]
                    assert trace.damage, (opcode, place, value)
                    assert len(got) >= len(rows()) - 12, (opcode, place - at, value)
                    wanted = {(t, log, p, d) for t, log, p, d in rows()}
                    # a message outside of a chunk may itself be the one that is report_damage
                    wrong = {(g[0], g[2], g[3], g[4]) for g in got} - wanted
                    assert len(wrong) <= (not shape.chunked)


def test_rest_is_read_after_a_damaged_beginning(tmp_path: Path) -> None:
    whole = mcap_bytes(rows(), Shape(CompressionType.ZSTD, chunk_size=700), data_crc=True)
    for at in (0, 7, 8, 9, 16, 18):
        data = bytearray(whole)
        data[at] ^= 0xFF
        trace = open_trace(write(tmp_path / "a.mcap", bytes(data)))
        assert len(list(trace.messages())) == len(rows()), at
        assert trace.damage


def test_an_attachment_is_checked(tmp_path: Path) -> None:
    body = struct.pack("<QQ", 1, 1) + text("notes") + text("text/plain")
    body += struct.pack("<Q", 4) + b"abcd"
    for crc, report_damage in ((zlib.crc32(body), False), (0, False), (1, True)):
        data = HEADER + record(9, body + struct.pack("<I", crc)) + END
        assert bool(open_trace(write(tmp_path / "a.mcap", data)).damage) is report_damage


def test_a_foreign_recording_without_checksums_is_read(tmp_path: Path) -> None:
    trace = open_trace(write(tmp_path / "a.mcap", mcap_bytes(rows())))
    assert (trace.damage, trace.warnings) == ([], [])
    assert trace.notes == ["no checksum over the data section: damage there may not be noticed"]


def test_invalid_records_in_a_chunk_are_reported(tmp_path: Path) -> None:
    odd = {
        "chunk in chunk": (chunk(message(1, 1)), "does not belong there"),
        "no such kind": (record(0x10, b""), "does not belong there"),
        "unknown channel": (message(9, 1), "nowhere defined"),
        "other topic": (
            record(4, struct.pack("<HH", 1, 1) + text("rt/x") + text("cdr") + text("")),
            "defined twice",
        ),
        "too long": (struct.pack("<BQ", 5, 2**63) + bytes(30), "longer than what is left"),
    }
    for name, (extra, said) in odd.items():
        inner = definition() + message(1, 0, bytes(8)) + extra + message(1, 2**63, bytes(8))
        trace = open_trace(write(tmp_path / "a.mcap", HEADER + chunk(inner) + END))
        assert list(trace.messages()), name
        assert any(said in d for d in trace.damage), (name, trace.damage)


# -- exit codes ----------------------------------------------------------------------------------


def exit_code(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    return int(end.value.code or 0)


def hurt_sample(tmp_path: Path) -> Path:
    """A good session with one chunk damaged."""
    data = bytearray(sample_path("dex1_pick_place").read_bytes())
    at = places(bytes(data), 6)[1]
    data[at + 60] ^= 0x10
    return write(tmp_path / "report_damage.mcap", bytes(data))


def test_info_and_check_answer_damage_with_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = hurt_sample(tmp_path)
    assert exit_code("info", path, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["damaged"]
    assert 0 < told["messages"] < open_trace(sample_path("dex1_pick_place")).message_count
    assert any("is damaged" in w for w in told["warnings"])
    assert exit_code("info", sample_path("dex1_pick_place")) == 0
    assert "damage" not in capsys.readouterr().out
    assert exit_code("check", path) == 2
    out, err = capsys.readouterr()
    assert "the verdict covers the readable part only" in err
    assert "MUST" in out
    assert "is damaged" in err


def test_a_damaged_session_is_not_repeated(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="damaged"):
        CommandSession.load(hurt_sample(tmp_path))


def test_publishing_a_damaged_recording_sends_the_rest_and_warns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [(CMD, T0 + i * 1_000_000, T0, cmd(0.1 * i)) for i in range(40)]
    data = bytearray(mcap_bytes(found, Shape(chunk_size=700), data_crc=True))
    data[places(bytes(data), 6)[1] + 60] ^= 0x10
    path = write(tmp_path / "a.mcap", bytes(data))
    domain = free_domain()
    assert exit_code("publish", path, "--domain", domain, "--wait", 0, "--force") == 1
    out, err = capsys.readouterr()
    assert "sent 3" in out or "sent 2" in out
    assert "its checksum does not match" in err


# -- hostile files -------------------------------------------------------------------------------

SLOW = {
    "newlines": "\n" * 900_000,
    "blanks": " \n" * 450_000,
    "comments that are not closed": "/* " * 300_000,
    "quotes that are not closed": '"\\' * 450_000,
    "a long scope": f"module {'m' * 400_000} {{ struct T {{ {'x y;' * 100_000} }}; }};",
}


def test_a_schema_text_is_read_once(tmp_path: Path) -> None:
    # each took from a minute to hours where its time was the square of its length
    for name, schema_text in SLOW.items():
        with pytest.raises(TraceUnsupported):
            schemas.parse("omgidl", "pkg/msg/T", schema_text)
        inner = definition(schema_text, "omgidl") + message(1, 1, b"abcd")
        data = HEADER + chunk(inner, b"zstd") + END
        trace = open_trace(write(tmp_path / "a.mcap", data))
        assert not trace.channels[0].supported, name
        assert len(trace.channels[0].problem) < 1000


def test_a_comment_sign_in_a_text_is_no_comment() -> None:
    body = '@verbatim (language="c", text="see http://a.b /* # ") octet a;'
    parsed = schemas.parse(
        "omgidl", "pkg/msg/T", f"module pkg {{ module msg {{ struct T {{ {body} }}; }}; }};"
    )
    assert [f.name for f in parsed.fields] == ["a"]


def test_what_chunks_unpack_to_is_bounded_by_the_file(tmp_path: Path) -> None:
    good = chunk(definition() + message(1, 1, bytes(8)), b"zstd")
    for name in (b"zstd", b"lz4"):
        bomb = chunk(message(1, 5) * 100_000, name)
        data = HEADER + good + bomb * 6 + END
        trace = open_trace(write(tmp_path / "a.mcap", data))
        sizes = sum(s.size for s in trace._file.segments)
        assert sizes <= MAX_RATIO * len(data) + SPARE
        assert trace.message_count >= 1
        if name == b"zstd":
            assert any(f"more than {MAX_RATIO} times" in d for d in trace.damage)


def test_a_chunk_that_unpacks_to_more_than_it_says_is_left_out(tmp_path: Path) -> None:
    inner = definition() + message(1, 1)
    for name in (b"zstd", b"lz4"):
        data = HEADER + chunk(inner + message(1, 2) * 9, name, len(inner)) + END
        trace = open_trace(write(tmp_path / "a.mcap", data))
        assert not trace.message_count
        assert any("damaged" in d for d in trace.damage)


def peak(function: Any) -> int:
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_columns_take_memory_for_the_samples_that_there_are(tmp_path: Path) -> None:
    encode = message_type(STATE_TYPE).encode
    samples = [
        encode(MotorStates_([MotorState_(q=i + j, dq=j, lost=i * j) for j in range(1024 - i)]))
        for i in range(3)
    ]
    size = sum(map(len, samples))
    assert peak(lambda: Columns(STRUCTS[STATE_TYPE], samples)) < 40 * size
    with Recorder(tmp_path / "a.mcap") as recorder:
        for i, data in enumerate(samples):
            recorder.put(STATE, STATE_TYPE, data, T0 + i)
    trace = open_trace(tmp_path / "a.mcap")
    assert peak(lambda: judge(Recording.decode(trace))) < 60 * size + 20 * 2**20


def work(path: Path, data: bytes) -> int:
    """Calls that reading takes."""
    write(path, data)
    return count_calls(lambda: content(path))[1]


def many_channels(n: int) -> bytes:
    found = [
        record(4, struct.pack("<HH", i, 0) + text(f"t{i}") + text("cdr") + text(""))
        for i in range(1, n)
    ]
    spread = b"".join(chunk(message(i, i)) for i in range(1, n))
    return HEADER + b"".join(found) + spread + END


def test_what_info_shows_takes_as_long_as_there_are_channels(tmp_path: Path) -> None:
    def printed(n: int) -> int:
        path = tmp_path / f"{n}.mcap"
        write(path, many_channels(n))
        trace = open_trace(path)
        return count_calls(lambda: print_info(summary(trace)))[1]

    printed(10)  # imports
    assert printed(400) < 5 * printed(100)


def overlapping(n: int) -> bytes:
    first = definition() + b"".join(message(1, 2 * i, bytes(8)) for i in range(n))
    return HEADER + chunk(first) + b"".join(chunk(message(1, 2 * i + 1)) for i in range(n)) + END


def misleading(n: int) -> bytes:
    pair = record(12, bytes(8)) * 2 + bytes(9)
    return HEADER + bytes(9) + pair * n + END


def test_work_grows_with_the_file_and_not_with_its_square(tmp_path: Path) -> None:
    for make, n in ((many_channels, 40), (overlapping, 40), (misleading, 60)):
        small, large = (work(tmp_path / "a.mcap", make(n * k)) for k in (1, 4))
        assert large < 6 * small, make.__name__


def test_pipe_is_refused(tmp_path: Path) -> None:
    pipe = tmp_path / "a.mcap"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(TraceUnreadable, match="not an ordinary file"):
            open_trace(path)


def test_a_recording_that_grows_while_it_is_opened_is_read_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader may look at any moment of a recorder's writing."""
    path = recorded(tmp_path / "grows.mcap")
    whole, cut = path.read_bytes(), tmp_path / "cut.mcap"
    genuine, shown = os.fstat, len(whole)

    def smaller(descriptor: int) -> os.stat_result:
        found = genuine(descriptor)
        if not os.path.samestat(found, path.stat()):
            return found
        return os.stat_result((*found[:6], shown, *found[7:10]))

    def read(file: Path) -> object:
        try:
            return content(file)
        except TraceUnreadable as error:
            return str(error).replace(str(file), "")

    monkeypatch.setattr("dexkit.traces.container.os.fstat", smaller)
    for size in range(0, len(whole), 19):
        shown = size
        cut.write_bytes(whole[:size])
        assert read(path) == read(cut), size


@pytest.mark.parametrize("left_out", [0, 1, -1])
def test_a_message_that_the_index_leaves_out_is_read_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left_out: int
) -> None:
    from mcap._chunk_builder import ChunkBuilder

    genuine = ChunkBuilder.end

    def end(self: ChunkBuilder) -> bytes:
        for index in self.message_indices.values():
            del index.records[left_out]
        return genuine(self)

    monkeypatch.setattr(ChunkBuilder, "end", end)
    path = tmp_path / "index.mcap"
    every = [row for row in rows(8) if row[0] == STATE]
    path.write_bytes(mcap_bytes(every, Shape(chunk_size=1 << 20)))
    trace = open_trace(path)
    assert sum(len(s) for s in trace.load().values()) == len(every)
    assert any("the message index of the chunk" in text for text in trace.damage)
