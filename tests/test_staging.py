"""Files and folders are written whole or not at all; what lies beside them is nobody else's."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from dexkit import staging
from dexkit.documents import write_file
from dexkit.errors import OutputError, SessionError, TraceError, UsageError
from dexkit.messages import message_type
from dexkit.staging import NOTE, PREFIX, Staged, whole_file, whole_folder
from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions import episodes_out, lerobot_out, rosbag, topic_tables
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.writer import RecordingWriter, definition
from tests.each import each

Write = Callable[[Path, str], None]


def a_file(out: Path, content: str) -> None:
    write_file(out, content)


def a_folder(out: Path, content: str) -> None:
    with whole_folder(out) as root:
        (root / "deep").mkdir(parents=True)
        (root / "deep" / "a").write_text(content)
        (root / "link").symlink_to("deep")


def a_recording(out: Path, content: str) -> None:
    kind = message_type("unitree_go::msg::dds_::MotorCmds_")
    with RecordingWriter(out, overwrite=True) as writer:
        channel = writer.add_channel(definition("rt/a", kind))
        writer.put(channel, b"\0\1\0\0" + content.encode(), 1)


WRITERS: list[Write] = [a_file, a_folder, a_recording]


def left(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name.startswith(PREFIX))


def killed(write: Write, out: Path, step: str, number: int = 1) -> bool:
    """Whether a process died that was to write it, at its n-th call of a function of ``os``."""
    child = os.fork()
    if not child:
        genuine, calls = getattr(os, step), iter(range(1, 10_000))

        def die(*arguments: object, **more: object) -> object:
            if next(calls) == number:
                os._exit(9)
            return genuine(*arguments, **more)

        setattr(os, step, die)
        try:
            write(out, "new")
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@each("write", WRITERS, ids=lambda w: w.__name__)
def test_a_kill_leaves_a_marked_folder_that_the_next_run_removes(
    tmp_path: Path, write: Write
) -> None:
    out = tmp_path / "out"
    dead = 0
    for step in ("write", "fsync", "replace", "rename", "unlink", "rmdir"):
        for number in (1, 2, 3):
            if not killed(write, out, step, number):
                if write is a_folder:
                    shutil.rmtree(out)
                break
            dead += 1
            for name in left(tmp_path):
                inside = sorted(p.name for p in (tmp_path / name).iterdir())
                note = (tmp_path / name / NOTE).read_text() if NOTE in inside else ""
                if note:
                    about = json.loads(note)
                    assert about["output"] == str(out)
                    assert about["pid"] != os.getpid()
                else:  # killed before it was written, or behind its removal
                    assert inside in ([], [NOTE])
            if write is a_folder and out.exists():
                assert (out / "deep" / "a").read_text() == "new"
                shutil.rmtree(out)
            write(out, "newer")
            assert left(tmp_path) == [], (step, number)
            if write is a_folder:
                assert sorted(p.name for p in out.iterdir()) == ["deep", "link"]
                shutil.rmtree(out)
    assert dead >= 6


@each("write", WRITERS, ids=lambda w: w.__name__)
@pytest.mark.parametrize("step", ["fsync", "mkdir", "write"])
def test_a_full_disk_leaves_nothing_and_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Write, step: str
) -> None:
    out = tmp_path / "out"
    if write is not a_folder:
        write(out, "old")
    before = out.read_bytes() if out.exists() else b""

    def full(*arguments: object, **more: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, step, full)
        with pytest.raises((OutputError, TraceError), match=r"out: No space left"):
            write(out, "new")
    assert left(tmp_path) == []
    assert (out.read_bytes() if out.exists() else b"") == before


def other_folders(out: Path) -> list[Path]:
    """Folders beside an output that look like those of a killed run and are not."""
    name = os.path.basename(out)
    made = []
    abandoned = {"dexkit": "1", "output": str(out), "pid": 1}
    for text in (
        None,
        "",
        "[]",
        "{",
        "7",
        json.dumps({**abandoned, "output": f"{out}2"}),
        json.dumps({**abandoned, "output": 7}),
        json.dumps({"output": str(out)}),
        "[" * 5000,
    ):
        folder = out.with_name(f"{PREFIX}{staging._digest(name)}-{len(made):016x}")
        folder.mkdir()
        (folder / "mine").write_text("mine")
        if text is not None:
            (folder / NOTE).write_text(text)
        made.append(folder)
    linked = out.with_name(f"{PREFIX}{staging._digest(name)}-{len(made):016x}")
    linked.mkdir()
    (linked / "mine").write_text("mine")
    real = out.with_name("note")
    real.write_text(json.dumps(abandoned))
    (linked / NOTE).symlink_to(real)
    return [*made, linked]


def test_what_is_not_certainly_left_by_a_killed_run_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    others = other_folders(out)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / NOTE).write_text(json.dumps({"dexkit": "1", "output": str(out), "pid": 1}))
    link = tmp_path / f"{PREFIX}{staging._digest('out')}-{'f' * 16}"
    link.symlink_to(elsewhere)
    running = Staged(out)
    running.path.write_text("of a running program")
    a_file(out, "new")
    assert all((folder / "mine").read_text() == "mine" for folder in others)
    assert (elsewhere / NOTE).exists()
    assert running.path.read_text() == "of a running program"
    running.discard()
    running.discard()
    assert len(left(tmp_path)) == len(others) + 1


def test_the_temporary_folder_is_private_and_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    staged = Staged(tmp_path / "out")
    (folder,) = left(tmp_path)
    assert stat.S_IMODE((tmp_path / folder).stat().st_mode) == 0o700
    staged.discard()
    monkeypatch.setattr(staging.secrets, "token_hex", lambda n: "0" * 2 * n)
    link = tmp_path / f"{PREFIX}{staging._digest('out')}-{'0' * 16}"
    target = tmp_path / "target"
    target.mkdir()
    link.symlink_to(target)
    with pytest.raises(OutputError, match="exists"):
        a_file(tmp_path / "out", "new")
    assert not list(target.iterdir())
    assert link.is_symlink()


def test_a_new_file_has_the_permissions_of_the_mask_and_an_old_one_its_own(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        a_file(tmp_path / "new", "x")
        a_folder(tmp_path / "folder", "x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750
    (tmp_path / "old").write_text("")
    (tmp_path / "old").chmod(0o604)
    (tmp_path / "to").symlink_to("old")
    with whole_file(tmp_path / "to") as place:
        place.write_text("y")
    assert (tmp_path / "to").is_symlink()
    assert stat.S_IMODE((tmp_path / "old").stat().st_mode) == 0o604
    assert (tmp_path / "old").read_text() == "y"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A quarter of a second of a session."""
    out = tmp_path_factory.mktemp("session") / "session.mcap"
    trace = open_trace(sample_path("dex3_pinch"))
    begin = trace.first_ns + 5 * 10**9
    cut(trace, out, spans=[Span(begin, begin + 10**9 // 4)])
    return out


def exports(session: Path) -> dict[str, Callable[[Path], object]]:
    trace = open_trace(session)
    return {
        "lerobot": lambda out: lerobot_out.export_dataset([trace], out),
        "episodes": lambda out: episodes_out.export_episodes([trace], out),
        "csv": lambda out: topic_tables.export_tables(trace, out, "csv"),
        "parquet": lambda out: topic_tables.export_tables(trace, out, "parquet"),
        "rosbag2": lambda out: rosbag.export_bag(trace, out),
    }


def place_of(tmp_path: Path, what: str, session: Path) -> Path:
    """An output that cannot be taken."""
    out = tmp_path / "ds"
    if what == "folder":
        out.mkdir()
        (out / "mine").write_text("mine")
    elif what == "empty folder":
        out.mkdir()
    elif what == "file":
        out.write_text("mine")
    elif what == "link to a folder":
        (tmp_path / "real").mkdir()
        out.symlink_to("real")
    elif what == "link to nothing":
        out.symlink_to("nothing")
    elif what == "input":
        shutil.copyfile(session, out)
    else:
        return Path(what)
    return out


@each(
    "what",
    ["folder", "empty folder", "file", "link to a folder", "link to nothing", "input", ".", "/",
     "..", "/proc/nosuch/ds"],
)  # fmt: skip
def test_an_output_that_cannot_be_taken_is_refused_before_anything_is_written(
    tmp_path: Path, session: Path, what: str
) -> None:
    out = place_of(tmp_path, what, session)
    before = sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*"))
    for form, export in exports(session).items():
        with pytest.raises(SessionError, match=r"exists|no name|cannot write") as no:
            export(out)
        assert str(out) in str(no.value), form
    assert sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*")) == before


def test_an_edited_recording_has_its_name_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    kind = message_type("unitree_go::msg::dds_::MotorCmds_")
    out.write_bytes(b"old")
    with RecordingWriter(out, overwrite=True) as writer:
        channel = writer.add_channel(definition("rt/a", kind))
        for i in range(100):
            writer.put(channel, b"\0\1\0\0" + bytes(100_000), i)
        assert out.read_bytes() == b"old"
    assert open_trace(out).message_count == 100
    out.unlink()
    writer = RecordingWriter(out)
    writer.add_channel(definition("rt/a", kind))
    assert not out.exists()
    out.write_bytes(b"another's")
    with pytest.raises(TraceError, match="exists"):
        writer.close()
    assert out.read_bytes() == b"another's"
    with pytest.raises(UsageError, match="exists"):
        RecordingWriter(out)
    with pytest.raises(ZeroDivisionError), RecordingWriter(out, overwrite=True) as writer:
        raise ZeroDivisionError
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]
