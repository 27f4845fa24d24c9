"""The file of a recorder: its name, its lock, its content after a kill or a full disk."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dexkit.errors import TraceError, UsageError
from dexkit.traces import Recorder, open_trace
from tests.dds_helpers import wait_until
from tests.each import each
from tests.trace_helpers import STATE, STATE_TYPE, T0, state


def put(recorder: Recorder, first: int, count: int) -> None:
    for n in range(first, first + count):
        recorder.put(STATE, STATE_TYPE, state(float(n)), T0 + n * 2_000_000)


def recorded(path: Path) -> list[bytes]:
    return list(open_trace(path).samples(STATE).payloads)


def part(path: Path) -> Path:
    return path.with_name(path.name + ".part")


def old(path: Path) -> bytes:
    """A recording of one message, and its bytes."""
    with Recorder(path) as recorder:
        put(recorder, 0, 1)
    return path.read_bytes()


# -- replacing -------------------------------------------------------------------------------------


def test_the_old_recording_stays_until_there_is_a_message(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    path.chmod(0o640)
    recorder = Recorder(path, overwrite=True, keep_empty=False)
    recorder.open()
    wait_until(lambda: part(path).stat().st_size)
    assert path.read_bytes() == before
    put(recorder, 1, 3)
    wait_until(lambda: recorder.written and not part(path).exists())
    # readers may follow it as it grows
    assert open_trace(path).truncated
    assert recorded(path) == [state(1.0), state(2.0), state(3.0)]
    recorder.close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert not open_trace(path).truncated


def test_without_a_message_the_old_recording_stays_for_good(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    with Recorder(path, overwrite=True, keep_empty=False) as recorder:
        recorder.add_metadata("note", {"a": "b"})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.mcap"]
    # and one that may be empty replaces it: a run of the kit must not be judged by an older one
    with Recorder(path, overwrite=True):
        pass
    assert open_trace(path).message_count == 0
    assert os.listdir(tmp_path) == ["a.mcap"]


# -- two recorders ---------------------------------------------------------------------------------


@pytest.mark.parametrize("messages", [0, 1], ids=["beside it", "in its place"])
def test_a_second_recorder_is_refused_at_every_stage(tmp_path: Path, messages: int) -> None:
    path = tmp_path / "a.mcap"
    old(path)
    with Recorder(path, overwrite=True) as first:
        put(first, 10, messages)
        wait_until(lambda: first.written == messages)
        for overwrite in (True, False):
            with pytest.raises(UsageError, match=r"being recorded|exists"):
                Recorder(path, overwrite=overwrite).open()
        with pytest.raises(UsageError, match="being recorded"):
            Recorder(path, overwrite=True).open()
        put(first, 20, 2)
    assert recorded(path) == [*[state(10.0)] * messages, state(20.0), state(21.0)]
    # and afterwards it is free
    with Recorder(path, overwrite=True) as again:
        put(again, 7, 1)
    assert recorded(path) == [state(7.0)]


def test_only_one_of_several_simultaneous_recorders_records(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for existing in (False, True):
        if existing:
            assert path.exists()
        recorders = [Recorder(path, overwrite=True) for _ in range(8)]
        refused: list[UsageError] = []
        gate = threading.Barrier(len(recorders))

        def start(recorder: Recorder, gate: threading.Barrier = gate) -> None:
            gate.wait()
            try:
                recorder.open()
            except UsageError as error:
                refused.append(error)  # noqa: B023

        threads = [threading.Thread(target=start, args=(r,)) for r in recorders]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        open_ones = [r for r in recorders if r._thread is not None]
        assert len(open_ones) <= 1
        assert len(refused) == len(recorders) - len(open_ones)
        for recorder in open_ones:
            put(recorder, 1, 1)
            recorder.close()
        if not open_ones:  # each was in the other's way: told, and nothing is lost
            assert all("being recorded" in e.message for e in refused)
    assert not part(path).exists()


# -- killed ----------------------------------------------------------------------------------------

CHILD = textwrap.dedent(
    """
    import sys, time
    from dexkit.traces import Recorder
    from dexkit.traces.recording_file import RecordingFile
    if sys.argv[3] == "publish":
        RecordingFile.publish = lambda self, fd=None: (print("at it", flush=True), time.sleep(60))
    recorder = Recorder(sys.argv[1], overwrite=True)
    recorder.open()
    for n in range(int(sys.argv[2])):
        recorder.put("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_", bytes(16), n + 1)
    while recorder.written < int(sys.argv[2]):
        time.sleep(0.002)
    print("at it", flush=True)
    time.sleep(60)
    """
)


@contextmanager
def killed(path: Path, messages: int, where: str = "") -> Iterator[None]:
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), str(messages), where],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    try:
        assert child.stdout.readline() == "at it\n"
    finally:
        child.kill()
        child.communicate()
    yield


def test_kill_before_the_first_message_keeps_the_old_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    with killed(path, 0):
        assert path.read_bytes() == before
        # what is left beside it is recognised and taken over
        with Recorder(path, overwrite=True) as recorder:
            put(recorder, 1, 1)
        assert recorded(path) == [state(1.0)]
        assert os.listdir(tmp_path) == ["a.mcap"]


def test_killed_between_the_first_message_and_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    with killed(path, 3, "publish"):
        assert path.read_bytes() == before
        assert open_trace(part(path)).message_count == 3
        with pytest.raises(UsageError, match="holds messages") as raised:
            Recorder(path, overwrite=True).open()
        assert "rename" in raised.value.hint
        assert open_trace(part(path)).message_count == 3


# -- deleted, renamed ------------------------------------------------------------------------------


def test_a_file_that_is_deleted_ends_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path)
    recorder.open()
    put(recorder, 0, 5)
    wait_until(lambda: recorder.written)
    path.unlink()
    wait_until(lambda: recorder.error)
    with pytest.raises(TraceError, match="was deleted while it was recorded"):
        recorder.close()


def test_renamed_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        put(recorder, 0, 1)
        wait_until(lambda: recorder.written)
        path.rename(tmp_path / "b.mcap")
        path.write_bytes(b"somebody else's")
        wait_until(lambda: recorder.displaced)
        put(recorder, 1, 1)
    assert "renamed or replaced" in recorder.displaced
    assert recorded(tmp_path / "b.mcap") == [state(0.0), state(1.0)]
    assert path.read_bytes() == b"somebody else's"


# -- a full disk -----------------------------------------------------------------------------------


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Room for so many bytes in each file; writes what fits and then fails, as a disk does."""
    monkeypatch.setattr("dexkit.traces.recorder.FLUSH_INTERVAL", 0.0)
    monkeypatch.setattr("dexkit.traces.recorder._POLL", 0.001)
    room = [1 << 60]
    write = os.write

    def limited(fd: int, data: bytes) -> int:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            return write(fd, data)
        left = room[0] - os.fstat(fd).st_size
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data[:left])

    monkeypatch.setattr(os, "write", limited)
    return room


def test_after_a_full_disk_the_counted_messages_are_readable(
    tmp_path: Path, disk: list[int]
) -> None:
    partly = 0
    for size in [100, 300, *range(2000, 4600, 131)]:  # in the header, and anywhere in a chunk
        disk[0] = size
        path = tmp_path / f"{size}.mcap"
        recorder = Recorder(path, compression="none")
        recorder.open()
        for n in range(1, 100):
            put(recorder, n * 5 - 5, 5)
            recorder._wake.set()
            wait_until(lambda r=recorder, n=n: r.error or r.written == n * 5)  # type: ignore[misc]
            if recorder.error is not None:
                break
        with pytest.raises(TraceError, match="stopped: No space left") as raised:
            recorder.close()
        assert f"{recorder.written} messages were written" in raised.value.hint
        assert recorder.written + recorder.dropped == sum(recorder.offered.values())
        if recorder.written:
            partly += 1
            trace = open_trace(path)
            assert trace.truncated
            assert trace.message_count == recorder.written
            assert path.stat().st_size < size
        else:
            assert not path.exists()
    assert partly > 10


def test_a_full_disk_before_the_first_message_keeps_the_old_one(
    tmp_path: Path, disk: list[int]
) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    disk[0] = 500
    recorder = Recorder(path, overwrite=True)
    recorder.open()
    put(recorder, 0, 50)
    wait_until(lambda: recorder.error)
    with pytest.raises(TraceError, match="No space left"):
        recorder.close()
    assert (recorder.written, recorder.dropped) == (0, 50)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.mcap"]


# -- what others do to the file --------------------------------------------------------------------


def cut(path: Path) -> None:
    os.truncate(path, 0)


def cut_a_little(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 10)


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"Z" * 100_000)


def overwrite(path: Path, at: int) -> None:
    before = path.stat()
    with path.open("r+b") as file:
        file.seek(at)
        file.write(b"Z" * 50)
    # a disk may count time in steps of some ms: this is in another one
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000_000))


@each("more", [0, 10])
@each(
    "change",
    [
        cut,
        cut_a_little,
        append,
        lambda path: overwrite(path, 0),
        lambda path: overwrite(path, 110),
        lambda path: overwrite(path, path.stat().st_size - 50),
    ],
)
def test_write_by_another_program_is_reported(
    tmp_path: Path, change: Callable[[Path], None], more: int
) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path)
    recorder.open()
    put(recorder, 0, 10)
    wait_until(lambda: recorder.written)
    change(path)
    put(recorder, 10, more)
    with pytest.raises(TraceError, match="was changed by another program"):
        recorder.close()


# -- what others have put there --------------------------------------------------------------------


@each("content", [None, b"", b"V", b"something else altogether"])
def test_symbolic_link_in_place_of_the_partial_file_is_refused(
    tmp_path: Path, content: bytes | None
) -> None:
    path, victim = tmp_path / "a.mcap", tmp_path / "victim"
    before = old(path)
    if content is not None:
        victim.write_bytes(content)
    part(path).symlink_to(victim)
    with pytest.raises(UsageError, match="is not a file"), Recorder(path, overwrite=True):
        pass
    assert (victim.read_bytes() if victim.exists() else None) == content
    assert path.read_bytes() == before


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
def test_part_path_that_is_no_file_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "a.mcap"
    before = old(path)
    make(part(path))
    with pytest.raises(UsageError, match="is not a file"), Recorder(path, overwrite=True):
        pass
    assert path.read_bytes() == before
