"""Files that several programs change."""

from __future__ import annotations

import errno
import fcntl
import json
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dexkit import documents
from dexkit.documents import update_file
from dexkit.drivers.ezgripper.calibration_file import GripperRecord, Store
from dexkit.errors import DexkitError, UsageError
from dexkit.traces.recording_file import RecordingFile
from tests.each import each


def _store_many(path: str, name: str, count: int, begin: object) -> None:
    begin.wait()  # type: ignore[attr-defined]
    for i in range(count):
        Store(Path(path)).write(f"{name}{i}", GripperRecord(zero=i))


def test_two_writers_keep_each_others_keys(tmp_path: Path) -> None:
    path = tmp_path / "ezgripper.json"
    spawn = multiprocessing.get_context("fork")
    begin = spawn.Barrier(2)
    writers = [
        spawn.Process(target=_store_many, args=(str(path), name, 100, begin)) for name in "ab"
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert sorted(Store(path).keys()) == sorted(f"{n}{i}" for n in "ab" for i in range(100))


@pytest.mark.parametrize("step", ["fchmod", "fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), SystemExit()])
def test_failed_update_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, error: BaseException
) -> None:
    path = tmp_path / "f.json"
    path.write_text("old")

    def fail(*args: object, **kwargs: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(os, step, fail)
        with pytest.raises(UsageError if isinstance(error, OSError) else SystemExit) as caught:
            update_file(path, lambda text: "new")
    if isinstance(error, OSError):
        assert str(path) in str(caught.value)
        assert "No space left" in str(caught.value)
    assert path.read_text() == "old"
    assert {p.name for p in tmp_path.iterdir()} == {"f.json", ".f.json.lock"}


def test_killed_update_leaves_the_old_or_the_new_file(tmp_path: Path) -> None:
    path = tmp_path / "f.json"
    for step in ("open", "write", "fsync", "replace", "close"):
        for after in (False, True):
            path.write_text("old")
            child = os.fork()
            if not child:
                true = getattr(os, step)

                def die(*args: object, true: object = true, after: bool = after, **k: object):  # type: ignore[no-untyped-def]
                    if after:
                        true(*args, **k)  # type: ignore[operator]
                    os._exit(9)

                setattr(os, step, die)
                update_file(path, lambda text: "new")
                os._exit(0)
            os.waitpid(child, 0)
            assert path.read_text() in ("old", "new"), step
            update_file(path, lambda text: f"{text}+")
            assert path.read_text() in ("old+", "new+"), step


def test_unlockable_or_unreadable_file_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "f.json"
    monkeypatch.setattr(documents, "LOCK_PATIENCE", 0.0)
    with open(tmp_path / ".f.json.lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="locked by another program") as caught:
            update_file(path, lambda text: "new")
        assert "fuser" in caught.value.hint
    path.write_bytes(b"\xff")
    with pytest.raises(UsageError, match="not UTF-8"):
        update_file(path, lambda text: "new")
    loop = tmp_path / "loop"
    loop.symlink_to("loop")
    with pytest.raises(UsageError, match="cannot write"):
        update_file(loop, lambda text: "new")
    with pytest.raises(UsageError, match="cannot write"):
        update_file(path / "below", lambda text: "new")

    def no_locks(*args: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(UsageError, match="cannot be locked"):
        update_file(tmp_path / "nfs", lambda text: "new")
    assert not (tmp_path / "nfs").exists()


def test_invalid_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "ezgripper.json"
    path.write_text("{")
    with pytest.raises(UsageError, match="not valid JSON"):
        Store(path).write("a", GripperRecord(zero=1))
    assert path.read_text() == "{"
    path.write_text('{"of somebody else": 1}')
    Store(path).write("a", GripperRecord(zero=1))
    assert json.loads(path.read_text()) == {"of somebody else": 1, "calibration": {"a": 1}}


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to make a link of another user")
@each(
    "write",
    [
        lambda path: documents.write_file(path, "new"),
        lambda path: documents.update_file(path, lambda before: "new"),
        lambda path: RecordingFile(path, overwrite=True).open(),
    ],
)
def test_link_that_another_user_put_into_a_shared_folder_is_not_followed(
    write: Callable[[Path], object], tmp_path: Path
) -> None:
    shared, victim = tmp_path / "shared", tmp_path / "victim"
    shared.mkdir()
    shared.chmod(0o1777)
    victim.write_text("old")
    link = shared / "result.json"
    link.symlink_to(victim)
    os.lchown(link, 65534, 65534)
    with pytest.raises(DexkitError, match="a link that another user has put there"):
        write(link)
    assert victim.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["shared", "victim"]
    os.lchown(link, 0, 0)  # an own one is
    documents.write_file(link, "new")
    assert victim.read_text() == "new"
