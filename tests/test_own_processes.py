"""Child processes of dexkit: what they import, when they end, what they leave behind."""

from __future__ import annotations

import fcntl
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from dexkit.child_processes import END_WITH_PARENT, Tool, command_line, module_line
from dexkit.emulators.mx64 import EmulatedProcess
from dexkit.errors import DexkitError
from dexkit.open_file_limit import require_open_files
from dexkit.temporary_folder import PREFIX, TemporaryFolder, sweep

_HOSTILE = """
import os
open(os.path.join(os.path.dirname(os.path.abspath(__file__)), "was-run"), "w").close()
raise SystemExit(99)
"""


@pytest.fixture
def hostile_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with modules that must not be imported."""
    folder = tmp_path / "work"
    folder.mkdir()
    for name in ("click", "json", "dexkit", "rich", "cyclonedds", "socket", "typing", "pickle"):
        (folder / f"{name}.py").write_text(_HOSTILE)
    for name in ("numpy", "multiprocessing", "logging"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(_HOSTILE.replace("was-run", "../was-run"))
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    return folder


def test_programs_import_nothing_from_the_working_directory(hostile_folder: Path) -> None:
    commands = (
        ("check", "--list", "--dialect", "dex3"),
        ("doctor", "--scan", "none", "--domain", "1", "--seconds", "0.2"),
    )
    started = [
        subprocess.Popen(command_line(*c), stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for c in commands
    ]
    for command, process in zip(commands, started, strict=True):
        out = process.communicate(timeout=60)[0].decode()
        # 1: the doctor finds fault with an empty domain
        assert process.returncode in (0, 1), (command, out)
    with Tool("emulate", "mx64", "--link", str(hostile_folder / "link")) as tool:
        tool.wait_ready(threading.Event())
    emulator = EmulatedProcess([])
    emulator.close()
    assert not (hostile_folder / "was-run").exists()


@pytest.mark.soak
def test_workers_import_nothing_from_the_working_directory(hostile_folder: Path) -> None:
    arguments = ("--require", "DEX1-RATE-03", "--jobs", "1", "--result", "out")
    command = module_line("dexkit.conformance.faults", *arguments)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert (hostile_folder / "out").exists()
    assert not (hostile_folder / "was-run").exists()


def test_a_checkout_that_is_not_installed_is_found(tmp_path: Path) -> None:
    done = subprocess.run(
        [command_line()[0], "-S", "-c", "import sys; print(sys.path)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "site-packages" not in done.stdout
    # -S: no site-packages, so only dexkit itself is found, and its dependencies are not
    done = subprocess.run(
        [sys.executable, "-S", *command_line("--version")[1:]],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert "No module named 'click'" in done.stderr


def _ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


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


def test_process_that_ignores_sigterm_is_killed(tmp_path: Path) -> None:
    code = (
        "import signal, time, dexkit.child_processes as p\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "p.STOP_TIMEOUT = 0.05\n"
        "p.end_with_parent()\n"
        "print('up', flush=True)\n"
        "time.sleep(60)\n"
    )
    theirs, ours = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        pass_fds=(theirs,),
        env={**os.environ, END_WITH_PARENT: str(theirs)},
        stdout=subprocess.PIPE,
    )
    os.close(theirs)
    assert process.stdout is not None
    assert process.stdout.readline() == b"up\n"
    os.close(ours)
    assert process.wait(20) == -signal.SIGKILL
    process.stdout.close()


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


def test_folder_removed_before_its_lock_is_made_again(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    genuine = fcntl.flock
    removed: list[Path] = []

    def sweeping(descriptor: int, how: int) -> None:
        if how == fcntl.LOCK_EX:  # another process removes the new folder before it is locked
            monkeypatch.setattr(fcntl, "flock", genuine)
            removed.extend(sweep())
        genuine(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", sweeping)
    with TemporaryFolder() as folder:
        assert removed
        assert folder not in removed
        assert folder.exists()
        assert sweep() == []


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


def test_descriptor_limit_is_raised_where_permitted() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = len(os.listdir("/proc/self/fd"))
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (used + 5, before[1]))
        require_open_files(20, "a test")
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > used + 5
        with pytest.raises(DexkitError, match="a test needs 100000000 more open files"):
            require_open_files(10**8, "a test")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
