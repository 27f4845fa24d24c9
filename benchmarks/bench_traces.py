"""Measure the speed of writing and reading recordings, and the timing of replay."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from benchmarks import Result
from dexkit.messages import message_type
from dexkit.traces import Player, Recorder, TraceMessage, open_trace, sample_path

_SAMPLE = "dex1_pick_place"
_PACED_HZ = 24_000
_PACED_S = 3.0


def run() -> list[Result]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        messages = list(open_trace(sample_path(_SAMPLE)).messages())
        return [
            *_throughput(path, messages),
            _paced(path, messages),
            *_read(),
            _replay(path, messages),
        ]


def _record(path: Path, messages: list[TraceMessage]) -> tuple[float, int]:
    recorder = Recorder(path, overwrite=True, max_messages=10_000_000, max_bytes=2**31)
    begin = time.perf_counter()
    with recorder:
        for m in messages:
            recorder.put(m.topic, m.type_name, m.data, m.log_time_ns, m.publish_time_ns)
    return len(messages) / (time.perf_counter() - begin), recorder.dropped


def _mcap_alone(path: Path, messages: list[TraceMessage]) -> float:
    begin = time.perf_counter()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="peer")
        channels = {}
        for m in messages:
            if m.topic not in channels:
                kind = message_type(m.type_name)
                schema = writer.register_schema(kind.ros_name, "ros2msg", kind.ros2msg.encode())
                channels[m.topic] = writer.register_channel(m.topic, "cdr", schema)
            writer.add_message(channels[m.topic], m.log_time_ns, m.data, m.publish_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return len(messages) / (time.perf_counter() - begin)


def _rosbags_alone(path: Path, messages: list[TraceMessage]) -> float:
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter

    bag = path.parent / f"bag{time.perf_counter_ns()}"
    begin = time.perf_counter()
    with BagWriter(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for m in messages:
            if m.topic not in connections:
                kind = message_type(m.type_name)
                connections[m.topic] = writer.add_connection(
                    m.topic, kind.ros_name, msgdef=kind.ros2msg, rihs01="RIHS01_" + "0" * 64
                )
            writer.write(connections[m.topic], m.log_time_ns, m.data)
    return len(messages) / (time.perf_counter() - begin)


def _throughput(path: Path, messages: list[TraceMessage]) -> list[Result]:
    batch = messages * 2
    ours = max(_record(path, batch)[0] for _ in range(3))
    peers = {
        "mcap.writer, same thread, no queue": max(_mcap_alone(path, batch) for _ in range(3)),
        "rosbags writer (mcap), same thread": max(_rosbags_alone(path, batch) for _ in range(3)),
    }
    return [
        Result(
            name="recorder throughput, from put to file",
            value=ours,
            unit="msg/s",
            peer=peer,
            peer_value=value,
            ratio=ours / value,
            target="20,000 msg/s",
            met=ours >= 20_000,
        )
        for peer, value in peers.items()
    ]


def _paced(path: Path, messages: list[TraceMessage]) -> Result:
    """The stated rate, sustained with the default queue while the writer works."""
    recorder = Recorder(path, overwrite=True)
    total = int(_PACED_HZ * _PACED_S)
    burst = _PACED_HZ // 200
    with recorder:
        begin = time.perf_counter()
        for i in range(0, total, burst):
            for k in range(i, i + burst):
                m = messages[k % len(messages)]
                recorder.put(m.topic, m.type_name, m.data, m.log_time_ns, m.publish_time_ns)
            ahead = begin + (i + burst) / _PACED_HZ - time.perf_counter()
            if ahead > 0:
                time.sleep(ahead)
        took = time.perf_counter() - begin
    return Result(
        name=f"drops in {_PACED_S:.0f} s of {total / took:,.0f} msg/s",
        value=recorder.dropped,
        unit="messages",
        peer="messages offered",
        peer_value=total,
        ratio=recorder.written / total,
        target="no drop at 20,000 msg/s",
        met=recorder.dropped == 0 and total / took >= 20_000,
        note=f"file {path.stat().st_size / 2**20:.1f} MiB, zstd, chunks completed every 0.2 s",
    )


def _read() -> list[Result]:
    path = sample_path(_SAMPLE)

    def best(function: object, n: int = 5) -> float:
        assert callable(function)
        times = []
        for _ in range(n):
            begin = time.perf_counter()
            function()
            times.append(time.perf_counter() - begin)
        return min(times)

    def library() -> None:
        with path.open("rb") as file:
            for _ in make_reader(file).iter_messages():
                pass

    def columns() -> None:
        trace = open_trace(path)
        trace.load()

    def stream() -> None:
        for _ in open_trace(path).messages():
            pass

    peer = best(library, 3)
    return [
        Result(
            name=f"reading {_SAMPLE} (21.5 s) as {what}",
            value=value * 1e3,
            unit="ms",
            peer="mcap.reader, iter_messages",
            peer_value=peer * 1e3,
            ratio=peer / value,
        )
        for what, value in (("columns", best(columns)), ("messages", best(stream)))
    ]


def _replay(path: Path, messages: list[TraceMessage]) -> Result:
    """Two seconds at the recorded speed, in turns with the peer: both meet the same noise."""
    commands = [m for m in messages if m.topic.endswith("/cmd")]
    end = commands[0].log_time_ns + 2_000_000_000
    with Recorder(path, overwrite=True) as recorder:
        for m in commands:
            if m.log_time_ns < end:
                recorder.put(m.topic, m.type_name, m.data, m.log_time_ns, m.publish_time_ns)
    player = Player(open_trace(path))
    stats, bare = [], []
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)  # as `dexkit replay` does
    try:
        for _ in range(3):
            stats.append(player.play(lambda message: None))
            bare.append(_bare_loop(player.offsets))
    finally:
        sys.setswitchinterval(before)
    ours, peer = (float(np.median(x)) for x in ([s.error_p99 for s in stats], bare))
    middle, worst = np.median([s.error_p50 for s in stats]), max(s.error_max for s in stats)
    return Result(
        name=f"replay timing error p99, {len(player) / player.duration:.0f} msg/s",
        value=ours * 1e3,
        unit="ms",
        peer="bare loop of time.sleep to the same deadlines",
        peer_value=peer * 1e3,
        ratio=peer / ours,
        target="p99 < 1 ms",
        met=ours < 0.001,
        note=f"median of 3 runs; p50 {middle * 1e3:.4f} ms, max {worst * 1e3:.3f} ms",
    )


def _bare_loop(offsets: list[float]) -> float:
    """p99 error of the plainest loop to absolute deadlines, seconds."""
    errors = []
    start = time.monotonic()
    for offset in offsets:
        delay = start + offset - time.monotonic()
        if delay > 0:
            time.sleep(delay)
        errors.append(time.monotonic() - start - offset)
    return float(np.percentile(errors, 99))
