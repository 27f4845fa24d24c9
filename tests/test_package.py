"""The built wheel, installed in a clean environment, is the whole product."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from dexkit.traces import SAMPLES
from tests import optional
from tests.optional import UV
from tests.reproduction_helpers import checked, without_surroundings, write_run

pytestmark = pytest.mark.slow  # the wheel is built and installed

ROOT = Path(__file__).parent.parent
PACKAGES = ("drivers", "emulators", "conformance", "traces")
SAMPLE = ROOT / "traces" / "samples" / "dex1_pick_place.mcap"


def run(*command: object, cwd: Path, check: bool = True) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if k not in {"VIRTUAL_ENV", "PYTHONPATH"}}
    # an interpreter that is not on the machine is a skip, not a download
    env |= {"UV_PYTHON_DOWNLOADS": "never", "UV_NO_PROGRESS": "1"}
    result = subprocess.run(
        [str(c) for c in command], cwd=cwd, env=env, capture_output=True, text=True, timeout=180
    )
    if check:
        assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result


def made_once(
    tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]
) -> Path:
    """A folder that the first worker of a distributed run makes, for all of them."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder / "done"
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def build(out: Path) -> None:
        # by way of the sdist, as a package index would build it
        run(UV, "build", "--quiet", "--python", sys.executable, "--out-dir", out, ROOT, cwd=out)

    return next(made_once(tmp_path_factory, "dist", build).glob("*.whl"))


class Installed:
    """A clean environment with only the wheel in it."""

    def __init__(self, home: Path) -> None:
        self.home = home

    @classmethod
    def make(cls, home: Path, python: str, wheel: Path, extra: str = "") -> Installed:
        run(UV, "venv", "--quiet", "--python", python, home / "env", cwd=home)
        run(UV, "pip", "install", "--quiet", "--python", home / "env", f"{wheel}{extra}", cwd=home)
        return cls(home)

    def __call__(self, *command: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        return run(
            self.home / "env" / "bin" / str(command[0]), *command[1:], cwd=self.home, check=check
        )


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    def make(home: Path) -> None:
        Installed.make(home, sys.executable, wheel, "[conformance]")

    return Installed(made_once(tmp_path_factory, "clean", make))


def test_wheel_holds_every_package_completely_and_once(wheel: Path) -> None:
    packed = [n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n]
    assert len(packed) == len(set(packed))
    # resolved, because dexkit/ holds links to these packages
    sources = {
        path.resolve().relative_to(ROOT)
        for folder in ("dexkit", *PACKAGES)
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not {"__pycache__", "faults"} & set(path.parts)
    }
    expected = {str(p if p.parts[0] == "dexkit" else "dexkit" / p) for p in sources}
    assert set(packed) == expected


def test_the_wheel_has_no_wrong_hands(installed: Installed) -> None:
    """They are for the work on the checks, in a checkout."""
    found = installed("python", "-c", "import dexkit.conformance.faults", check=False)
    assert "No module named 'dexkit.conformance.faults'" in found.stderr


def test_command_line_of_the_wheel(installed: Installed) -> None:
    assert installed("dexkit", "--version").stdout.startswith("dexkit, version ")
    listed = installed("dexkit", "backends").stdout
    assert "ezgripper" in listed
    assert "sim-dex1" in listed
    assert "unusable" not in listed
    assert "rt/dex1/left/state" in installed("dexkit", "info", SAMPLE).stdout
    checked = installed("dexkit", "check", SAMPLE)
    assert "DEX1-" in checked.stdout


def test_conformance_suite_of_the_wheel_lists_its_requirements(installed: Installed) -> None:
    result = installed(
        "pytest",
        "--pyargs",
        "dexkit.conformance",
        "--collect-only",
        "-q",
        "-p",
        "no:cacheprovider",
        "--backend",
        "sim-dex1",
    )
    assert "DEX1-" in result.stdout


def test_sample_recordings_come_with_the_wheel(installed: Installed) -> None:
    code = (
        "from dexkit.traces import SAMPLES, open_trace, sample_path\n"
        "for name in SAMPLES: print(sample_path(name), open_trace(sample_path(name)).message_count)"
    )
    rows = [line.split() for line in installed("python", "-c", code).stdout.splitlines()]
    assert len(rows) == len(SAMPLES) > 0
    for path, messages in rows:
        assert Path(path).is_relative_to(installed.home)
        assert int(messages) > 1000


EMULATE = """
import subprocess, sys, dynamixel_sdk as d
link = sys.argv[1]
emulator = subprocess.Popen(
    [sys.executable, "-m", "dexkit", "emulate", "mx64", "--link", link], stdout=subprocess.PIPE
)
assert emulator.stdout.readline().startswith(b"ready: ")
port = d.PortHandler(link)
assert port.openPort() and port.setBaudRate(1_000_000)
for _ in range(100):  # the SDK waits for some milliseconds only
    answer = d.PacketHandler(2.0).ping(port, 1)
    if answer[1] == d.COMM_SUCCESS:
        break
print(*answer)
emulator.terminate()
assert emulator.wait(10) in (0, 143)
"""


# the first without a wheel of CycloneDDS, and the newest; make platforms tries them with it
@pytest.mark.soak
@pytest.mark.parametrize("version", ["3.11", "3.13"])
def test_without_dds_everything_else_works(version: str, wheel: Path, tmp_path: Path) -> None:
    python = optional.python(version)
    if python is None:
        pytest.skip(f"no Python {version} on this machine")
    newer = Installed.make(tmp_path, python, wheel, "[dynamixel]")
    code = (
        "from dexkit.messages import message_type;"
        "m = message_type('unitree_go::msg::dds_::MotorCmds_');"
        "assert m.decode(m.encode(m.cls())) == m.cls();"
        "import dexkit.wire.dynamixel, dexkit.emulators.mx64, dexkit.drivers.ezgripper"
    )
    newer("python", "-c", code)
    assert newer("python", "-c", EMULATE, tmp_path / "servo").stdout.split() == ["311", "0", "0"]
    assert "DEX1-" in newer("dexkit", "check", SAMPLE).stdout
    # another Python with another NumPy: the same data to the last bit
    for recording in (SAMPLE, write_run(tmp_path / "run.mcap")):
        ours = checked(recording, tmp_path / "ours.json")
        theirs = checked(recording, tmp_path / "theirs.json", newer.home / "env" / "bin" / "python")
        assert theirs["environment"]["python"].startswith(version)
        assert without_surroundings(theirs) == without_surroundings(ours)
    for command in (
        ("serve", "sim-dex1", "--side", "left"),
        ("record", tmp_path / "x.mcap"),
        ("replay", SAMPLE),
        ("demo", "--out", tmp_path / "demo"),
    ):
        refused = newer("dexkit", *command, check=False)
        assert refused.returncode == 2, command
        assert "Traceback" not in refused.stderr
        assert "CycloneDDS" in refused.stderr  # what is missing
        assert "dexkit setup-dds" in refused.stderr  # what to do
