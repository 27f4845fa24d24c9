"""The recorder: round trip, full queues and disks, kills."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dexkit.errors import UsageError
from dexkit.traces import Recorder, open_trace
from dexkit.traces import recorder as recorder_module
from dexkit.traces.recorder import FLUSH_INTERVAL
from tests.each import each
from tests.patience import PATIENCE
from tests.service_helpers import wait_until
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, T0, cmd, messages_on_disk, state


def put_all(recorder: Recorder, count: int) -> int:
    return sum(
        recorder.put(STATE, STATE_TYPE, state(0.001 * i), T0 + i * 1000, T0 + i * 1000 - 7)
        for i in range(count)
    )


def test_recorded_messages_equal_the_written_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, metadata={"note": "hello"}) as recorder:
        assert put_all(recorder, 2000) == 2000
        recorder.put(CMD, CMD_TYPE, cmd(1.5), T0 + 5, 3)
        recorder.add_metadata("conditions", {"a": "b"})
    assert (recorder.written, recorder.dropped) == (2001, 0)
    assert recorder.offered == {STATE: 2000, CMD: 1}
    trace = open_trace(path)
    assert (trace.truncated, trace.warnings, trace.profile) == (False, [], "ros2")
    samples = trace.samples(STATE)
    assert samples.payloads == [state(0.001 * i) for i in range(2000)]
    assert samples.log_time_ns.tolist() == [T0 + i * 1000 for i in range(2000)]
    assert samples.publish_time_ns.tolist() == [T0 + i * 1000 - 7 for i in range(2000)]
    assert trace.samples(CMD).payloads == [cmd(1.5)]
    assert trace.metadata["conditions"] == {"a": "b"}
    about = trace.metadata["dexkit_recorder"]
    assert (about["note"], about["messages"], about["dropped"]) == ("hello", "2001", "0")


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    compression=st.sampled_from(["zstd", "lz4", "none"]),
    puts=st.lists(
        st.tuples(
            st.sampled_from([(CMD, CMD_TYPE), (STATE, STATE_TYPE), ("rt/x", STATE_TYPE)]),
            st.integers(0, 2**62),
            st.integers(0, 2**62),
            st.binary(max_size=300),
        ),
        max_size=50,
    ),
)
def test_any_samples_survive_the_round_trip(
    tmp_path: Path,
    compression: str,
    puts: list[tuple[tuple[str, str], int, int, bytes]],
) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, overwrite=True, compression=compression) as recorder:
        for (topic, type_name), log, publish, data in puts:
            assert recorder.put(topic, type_name, data, log, publish)
    got = [tuple(m) for m in open_trace(path).messages()]
    put = [(t, n, log, publish, data) for (t, n), log, publish, data in puts]
    assert got == sorted(put, key=lambda row: row[2])


def test_an_existing_file_is_kept_without_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(UsageError, match="exists"):
        Recorder(path).open()
    assert path.read_text() == "precious"
    with Recorder(path, overwrite=True):
        pass
    assert open_trace(path).message_count == 0


def test_an_unknown_type_is_refused_at_once(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder, pytest.raises(UsageError, match="unknown"):
        recorder.put("rt/x", "other::msg::dds_::Thing_", b"\0" * 8, T0)


class Gate:
    """Holds the recorder's writer, as a disk that does not answer would."""

    def __init__(self, recorder: Recorder) -> None:
        self.reached = threading.Event()
        self.open = threading.Event()
        self._add = recorder._writer.add_message
        recorder._writer.add_message = self  # type: ignore[method-assign, assignment]

    def __call__(self, *args: object) -> None:
        self.reached.set()
        assert self.open.wait(60)
        self._add(*args)  # type: ignore[arg-type]


def test_a_blocked_disk_drops_and_counts_and_never_blocks_the_receiver(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path, max_messages=100)
    recorder.open()
    gate = Gate(recorder)
    assert put_all(recorder, 1) == 1
    assert gate.reached.wait(60)
    # the writer holds one message; the queue takes 99 more; nothing waits
    assert put_all(recorder, 250) == 99
    recorder.put(CMD, CMD_TYPE, cmd(0.0), T0)
    assert recorder.dropped == 152
    gate.open.set()
    recorder.close()
    assert (recorder.written, recorder.dropped) == (100, 152)
    trace = open_trace(path)
    assert trace.message_count == 100
    about = trace.metadata["dexkit_recorder"]
    assert about["messages"] == "100"
    assert about["dropped"] == "152"
    assert about[f"dropped {STATE}"] == "151"
    assert about[f"dropped {CMD}"] == "1"


def test_the_queue_is_bounded_in_bytes_too(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", max_bytes=10_000)
    recorder.open()
    gate = Gate(recorder)
    recorder.put(STATE, STATE_TYPE, bytes(4000), T0)
    assert gate.reached.wait(60)
    assert recorder.put(STATE, STATE_TYPE, bytes(4000), T0)
    assert not recorder.put(STATE, STATE_TYPE, bytes(4000), T0)
    assert recorder.put(STATE, STATE_TYPE, bytes(2000), T0)
    gate.open.set()
    recorder.close()
    assert (recorder.written, recorder.dropped) == (3, 1)


@each("times", [(-1, 0), (0, -1), (2**64, 0)])
def test_invalid_time_is_refused(tmp_path: Path, times: tuple[int, int]) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        with pytest.raises(UsageError, match="not times"):
            recorder.put(CMD, CMD_TYPE, cmd(0.0), *times)
        assert recorder.put(CMD, CMD_TYPE, cmd(0.0), T0)
    assert recorder.written == 1


def test_texts_that_no_file_can_hold_are_refused_at_once(tmp_path: Path) -> None:
    path, bad = tmp_path / "a.mcap", "rt/\ud800"
    with pytest.raises(UsageError, match="UTF-8"):
        Recorder(path, metadata={"note": bad})
    with Recorder(path) as recorder:
        for call, problem in (
            (lambda: recorder.put(bad, CMD_TYPE, cmd(0.0), T0), "a topic"),
            (lambda: recorder.add_channel(bad, CMD_TYPE), "a topic"),
            (lambda: recorder.add_channel(CMD, CMD_TYPE, {"a": bad}), "'a' of metadata of"),
            (lambda: recorder.add_foreign_channel("usb", bad, ""), "name of a type"),
            (lambda: recorder.add_foreign_channel("usb", "a/msg/B", bad), "definition"),
            (lambda: recorder.add_metadata(bad, {}), "name of a metadata record"),
            (lambda: recorder.add_metadata("a", {bad: ""}), "a key of metadata 'a'"),
            (lambda: recorder.add_metadata("a", {"b": bad}), "'b' of metadata 'a'"),
            (lambda: recorder.add_metadata("a", {"b": 3}), "not int"),  # type: ignore[dict-item]
        ):
            with pytest.raises(UsageError, match=problem):
                call()
        assert recorder.put(CMD, CMD_TYPE, cmd(1.0), T0)
    assert open_trace(path).topics == [CMD]


def test_closing_twice_and_putting_after_is_harmless(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap")
    recorder.open()
    recorder.close()
    recorder.close()
    assert not recorder.put(CMD, CMD_TYPE, cmd(0.0), T0)
    assert recorder.dropped == 1


CHILD = textwrap.dedent(
    """
    import sys, time
    from dexkit.traces import Recorder
    recorder = Recorder(sys.argv[1])
    recorder.open()
    recorder.add_metadata("dds_endpoints", {"rt/dex1/left/state writer": "reliable"})
    n = 0
    while True:
        n += 1
        now = time.time_ns()
        recorder.put("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_",
                     n.to_bytes(8, "little"), now, now)
        time.sleep(0.001)
    """
)


def test_messages_are_on_disk_after_half_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the recorder's clock, which does not go on by itself here."""
    assert FLUSH_INTERVAL + recorder_module._POLL <= 0.5
    now, path = 100.0, tmp_path / "a.mcap"
    monkeypatch.setattr(recorder_module, "time", SimpleNamespace(monotonic=lambda: now))
    with Recorder(path) as recorder:
        put_all(recorder, 1)
        wait_until(lambda: recorder._queued == 0)
        assert messages_on_disk(path, STATE) == 0
        now += FLUSH_INTERVAL
        wait_until(lambda: messages_on_disk(path, STATE) == 1)


def test_sigkill_loses_nothing_that_is_on_disk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)])
    try:
        wait_until(lambda: messages_on_disk(path, STATE) > 100)
        on_disk = messages_on_disk(path, STATE)
    finally:
        child.kill()
        child.wait(PATIENCE)
    trace = open_trace(path)
    assert trace.truncated
    assert any("unfinished" in w for w in trace.warnings)
    assert trace.endpoints[0].reliability == "reliable"
    samples = trace.samples(STATE)
    assert len(samples) >= on_disk
    # and nothing before the last one is missing
    numbers = [int.from_bytes(p, "little") for p in samples.payloads]
    assert numbers == list(range(1, len(numbers) + 1))
