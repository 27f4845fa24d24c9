"""What a recording lacks is counted and reported in the status line, the file and the exit code."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import pytest

from dexkit.dds import DdsNode, Writer
from dexkit.socket_losses import ReceiveBuffers
from dexkit.traces import Recorder, open_trace
from dexkit.traces.dds_recording import DdsRecording
from dexkit.traces.losses import PAUSE, Losses
from tests.dds_helpers import free_domain, wait_until
from tests.each import each
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, T0, cmd, state

MS = 1_000_000


@contextmanager
def recording_of_states(path: Path) -> Iterator[tuple[Recorder, DdsRecording, Writer]]:
    """A recording of a state topic, and the hand's writer on it."""
    domain = free_domain()
    with (
        DdsNode(domain) as hand,
        DdsNode(domain) as node,
        Recorder(path) as recorder,
        DdsRecording(node, recorder, [STATE], types={STATE: STATE_TYPE}) as recording,
    ):
        writer = hand.writer(STATE, STATE_TYPE)
        assert writer.wait_matched(10)
        yield recorder, recording, writer


# -- the arithmetic --------------------------------------------------------------------------------


_HALF = frozenset(Random(2).sample(range(1000), 500))


@each(
    ("kept", "missing"),
    [
        (lambda n: True, 0),
        (lambda n: not 200 <= n < 230, 30),
        (lambda n: n % 10 != 5, 100),  # one in ten, alone
        (lambda n: n not in _HALF, 500),  # half of them, from the start
    ],
)
def test_missing_samples_of_a_steady_topic_are_estimated(
    kept: Callable[[int], bool], missing: int
) -> None:
    losses = Losses()
    late = 0
    for n in range(1000):
        if kept(n):
            late = (n * 31) % 7 == 0  # written a quarter of a period late, the next one in time
            losses.note_state("rt/a/state", 1, T0 + n * 2 * MS + late * MS // 2)
    losses.note_state("rt/a/state", 1, T0 + 1000 * 2 * MS)
    assert losses.update(0.0, 0, {}) == bool(missing)
    found = sum(gaps.missing for gaps in losses.gaps.values())
    assert abs(found - missing) <= 0.1 * missing
    assert not losses  # whoever is to blame
    assert (f"about {found} missing" in losses.status()) == bool(missing)
    assert any("missing" in text for text in losses.describe()) == bool(missing)
    assert losses.metadata()["missing about"] == str(found)


def test_writer_that_catches_up_has_no_losses_and_irregular_writer_is_not_judged() -> None:
    losses = Losses()
    times = [T0 + n * 2 * MS for n in range(300)]
    times[100:110] = [T0 + 109 * 2 * MS + n for n in range(10)]  # stood still, then all at once
    for time_ns in times:
        losses.note_state("rt/a/state", 1, time_ns)
    random = Random(5)
    at = T0
    for _ in range(300):
        at += int(2 * MS * 10 ** random.uniform(-2, 2))
        losses.note_state("rt/b/state", 2, at)
    assert losses.gaps == {}


def test_loss_that_dds_reports_is_a_loss() -> None:
    losses = Losses()
    assert losses.update(0.0, 0, {}, {"rt/a/state": 3})
    assert losses
    assert losses.status() == "3 lost"
    assert "3 samples of rt/a/state were lost (reported by DDS)" in losses.describe()
    assert losses.metadata()["lost rt/a/state"] == "3"
    assert not losses.update(1.0, 0, {}, {"rt/a/state": 3})


def test_gaps_of_a_writer_are_in_the_file_and_in_the_status(tmp_path: Path) -> None:
    """The time at which a sample is written is given, so that a busy machine changes nothing."""
    path = tmp_path / "a.mcap"
    with recording_of_states(path) as (recorder, recording, writer):
        for n in (*range(100), *range(140, 200)):
            writer.write_raw(state(float(n)), T0 + n * 2 * MS)
        wait_until(lambda: recorder.offered.get(STATE) == 160)
        wait_until(lambda: "about 40 missing" in recording.losses.status())
    about = open_trace(path).metadata["dexkit_recorder"]
    assert about["missing about"] == "40"
    assert about[f"gaps {STATE}"] == "1, about 40 samples, longest 0.082 s"


# -- a reader that is full -------------------------------------------------------------------------


def test_full_reader_counts_refused_samples() -> None:
    domain = free_domain()
    with DdsNode(domain) as hand, DdsNode(domain) as node:
        writer = hand.writer(CMD, CMD_TYPE)
        with node.reader(CMD, CMD_TYPE, most=10) as reader:
            assert writer.wait_matched(10)
            for n in range(25):
                writer.write_raw(cmd(float(n)))
            wait_until(lambda: reader.refused == 15)
            assert [s.data for s in reader.take()] == [cmd(float(n)) for n in range(10)]
            writer.write_raw(cmd(99.0))
            wait_until(reader.take)
            assert reader.refused == 15


def test_refused_samples_are_noted_in_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dexkit.traces.dds_recording.MOST", 10)
    path = tmp_path / "a.mcap"
    with recording_of_states(path) as (_, recording, writer):
        take = recording._read_samples
        monkeypatch.setattr(recording, "_read_samples", lambda: None)  # busy with something else
        for n in range(40):
            writer.write_raw(state(float(n)))
        reader = recording._readers[STATE, STATE_TYPE]
        wait_until(lambda: reader.refused >= 20)
        monkeypatch.setattr(recording, "_read_samples", take)
        recording.stop()
        lost = recording.losses.refused[STATE]
        assert recording.losses
    trace = open_trace(path)
    assert trace.message_count + lost == 40
    assert trace.metadata["dexkit_recorder"][f"refused {STATE}"] == str(lost)


# -- the recorder as a program ---------------------------------------------------------------------

# a recorder whose sockets hold little, whatever this machine allows
CHILD = textwrap.dedent(
    """
    import socket, sys
    from dexkit.cli import main
    from dexkit.socket_losses import ReceiveBuffers
    def shrink(self, size):
        for sock in self._sockets():
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        return 65536
    if sys.argv.pop(1) == "small":
        ReceiveBuffers.enlarge = shrink
    main(sys.argv[1:])
    """
)


@contextmanager
def recorder(buffer: str, *arguments: object, **options: object) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, buffer, "record", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,  # type: ignore[call-overload]
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready:")
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.parametrize("buffer", ["small", "default"])
def test_stopped_recorder_reports_its_losses(tmp_path: Path, buffer: str) -> None:
    domain = free_domain()
    out = tmp_path / "out.mcap"
    sent = 0
    with (
        recorder(buffer, out, "--topic", STATE, "--domain", domain) as process,
        DdsNode(domain) as node,
    ):
        writer = node.writer(STATE, STATE_TYPE)
        assert writer.wait_matched(20)

        def send(count: int) -> None:
            nonlocal sent
            for _ in range(count):
                sent += 1
                writer.write_raw(state(float(sent)), T0 + sent * 2 * MS)

        send(20)
        wait_until(lambda: open_trace(out).message_count == 20)
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        send(600 if buffer == "small" else 100)
        # the stop has to be long enough to be one
        signal.sigtimedwait([], PAUSE + 0.2)
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: open_trace(out).message_count > 20)
        send(2)  # the first may be swallowed by CycloneDDS, as every first after a hole
        # one by one, so that none of these finds the buffer full
        for _ in range(2):
            before = open_trace(out).message_count
            send(1)
            wait_until(lambda n=before: open_trace(out).message_count > n)  # type: ignore[misc]
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=20)
    trace = open_trace(out)
    lost = sent - trace.message_count
    about = trace.metadata["dexkit_recorder"]
    assert "the recorder did not run for" in stderr
    assert "s until" in about["pauses"]
    assert f"{trace.message_count} messages" in stdout
    if buffer == "small":
        assert process.returncode == 1
        assert lost > 100
        datagrams = int(about["lost_datagrams"])
        assert lost - 1 <= datagrams <= lost
        assert f"{datagrams} datagrams lost" in stdout
        assert f"{datagrams} datagrams were lost because the receive buffer was full" in stderr
        assert abs(int(about[f"lost about {STATE}"]) - lost) <= 1
    else:
        assert (process.returncode, lost) == (0, 0)
        assert "0 dropped" in stdout
        assert about["lost_datagrams"] == "0"


def test_full_disk_is_reported_with_the_number_of_messages_written(tmp_path: Path) -> None:
    """What it says was written is what can be read, and the exit code is an error."""
    domain = free_domain()
    out = tmp_path / "out.mcap"

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))

    options = ("--topic", STATE, "--domain", domain)
    with (
        recorder("default", out, *options, preexec_fn=small_files) as process,
        DdsNode(domain) as node,
    ):
        writer = node.writer(STATE, STATE_TYPE)
        assert writer.wait_matched(20)
        while process.poll() is None:
            writer.write_raw(state(1.0))
            signal.sigtimedwait([], 0.002)
        _, stderr = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "stopped: File too large" in stderr
    assert "Traceback" not in stderr
    count = open_trace(out).message_count
    assert count > 0
    assert f"  {count} messages were written and can be read" in stderr


def test_deleted_file_is_reported(tmp_path: Path) -> None:
    domain = free_domain()
    out = tmp_path / "out.mcap"
    with recorder("default", out, "--topic", STATE, "--domain", domain) as process:
        out.unlink()
        _, stderr = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "was deleted while it was recorded" in stderr
    assert "Traceback" not in stderr


def test_sockets_are_found_and_count_for_their_domain_only() -> None:
    domain, other = free_domain(), free_domain()
    assert not ReceiveBuffers(domain).known
    with DdsNode(domain):
        sockets = ReceiveBuffers(domain)
        assert sockets.known
        assert sockets.enlarge(100_000) >= 100_000
        assert sockets.count_new_drops() == 0
        assert not ReceiveBuffers(other).known
        assert ReceiveBuffers(other).enlarge(100_000) == 0
