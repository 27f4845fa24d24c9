"""Child processes of dexkit: what they import, when they end, what they leave behind."""

from __future__ import annotations

import os
import resource
import select
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from dexkit.child_processes import command_line
from dexkit.temporary_folder import PREFIX, TemporaryFolder, sweep

_PARENT = """
import os, sys, threading
from dexkit.child_processes import Tool
tool = Tool("emulate", "mx64", "--link", sys.argv[1])
if sys.argv[2] == "ready":
    tool.wait_ready(threading.Event())
print(tool._process.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("when", ["ready", "at once"])
def test_child_process_ends_with_its_parent(when: str, tmp_path: Path) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", _PARENT, str(tmp_path / "link"), when],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    child = os.pidfd_open(pid)
    parent.kill()
    parent.wait(10)
    parent.communicate()
    poll = select.poll()
    poll.register(child)
    assert poll.poll(20_000), "it still runs"
    os.close(child)
    assert not os.path.lexists(tmp_path / "link")


# -------------------------------------------------------------------------- temporary folders

_RUN = """
import sys
from dexkit.temporary_folder import TemporaryFolder
folder = TemporaryFolder("run")
(folder.path / "run.mcap").write_bytes(bytes(1000))
print(folder.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def test_folders_of_killed_programs_are_removed_and_those_of_others_stay(temporary: Path) -> None:
    def start() -> tuple[subprocess.Popen[str], Path]:
        process = subprocess.Popen(
            [sys.executable, "-c", _RUN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        return process, Path(process.stdout.readline().strip())

    killed, left = start()
    killed.kill()
    killed.communicate()
    assert (left / "run.mcap").exists()
    living, kept = start()  # which sweeps, too
    try:
        assert not left.exists()
        (temporary / "dexkit-somebody").mkdir()
        (temporary / f"{PREFIX}link").symlink_to(kept)
        (temporary / f"{PREFIX}file").write_text("x")
        with TemporaryFolder() as own:
            assert sweep() == []
            assert own.exists()
            assert own.stat().st_mode & 0o077 == 0
        assert not own.exists()
        assert (kept / "run.mcap").exists()
        assert (temporary / "dexkit-somebody").exists()
    finally:
        living.communicate("")


# ------------------------------------------------------------------------------- descriptors


def test_too_few_file_descriptors_are_refused_at_start() -> None:
    commands = {
        ("doctor", "--seconds", "0.2"): "examining 11 domain(s) needs",
        ("serve", "sim-dex1", "--side", "left", "--domain", "1"): "DDS needs 16 more",
    }

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))

    started = [
        subprocess.Popen(
            command_line(*arguments),
            preexec_fn=few,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for arguments in commands
    ]
    for process, (arguments, printed) in zip(started, commands.items(), strict=True):
        err = process.communicate(timeout=60)[1]
        assert process.returncode == 2, (arguments, process.returncode, err)
        assert printed in err
        assert "ulimit -n" in err
