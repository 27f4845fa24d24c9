"""The built wheel, installed in a clean environment, is the whole product."""

from __future__ import annotations

import os
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("drivers", "emulators", "conformance", "traces")
SAMPLE = ROOT / "traces" / "samples" / "dex1_pick_place.mcap"


def uv() -> str:
    found = shutil.which("uv")
    assert found, "uv is in the dev group; run the tests with 'make test' or 'uv run pytest'"
    return found


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


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    # by way of the sdist, as a package index would build it
    run(uv(), "build", "--quiet", "--out-dir", out, ROOT, cwd=out)
    return next(out.glob("*.whl"))


class Installed:
    """A clean environment with only the wheel in it."""

    def __init__(self, home: Path, python: str, wheel: Path, extra: str = "") -> None:
        self.home = home
        run(uv(), "venv", "--quiet", "--python", python, home / "env", cwd=home)
        run(uv(), "pip", "install", "--quiet", "--python", home / "env", f"{wheel}{extra}", cwd=home)

    def __call__(self, *command: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        return run(self.home / "env" / "bin" / str(command[0]), *command[1:], cwd=self.home,
                   check=check)


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    version = (ROOT / ".python-version").read_text().strip()
    yield Installed(tmp_path_factory.mktemp("clean"), version, wheel, "[conformance]")


def test_wheel_holds_every_room_whole(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    expected = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                expected.add(f"dexkit/{path.relative_to(ROOT)}")
    for path in (ROOT / "dexkit").rglob("*"):
        parts = path.relative_to(ROOT / "dexkit").parts
        if path.is_file() and "__pycache__" not in parts and parts[0] not in ROOMS:
            expected.add(f"dexkit/{'/'.join(parts)}")
    assert len(expected) > 60
    assert expected - packed == set()
    assert "dexkit/py.typed" in packed


def test_command_line_of_the_wheel(installed: Installed) -> None:
    assert installed("dexkit", "--version").stdout.startswith("dexkit, version ")
    listed = installed("dexkit", "backends").stdout
    assert "ezgripper" in listed
    assert "sim-dex1" in listed
    assert "unusable" not in listed
    assert "rt/dex1/left/state" in installed("dexkit", "info", SAMPLE).stdout
    checked = installed("dexkit", "check", SAMPLE)
    assert "DEX1-" in checked.stdout


def test_every_command_has_help(installed: Installed) -> None:
    from dexkit.cli import _COMMANDS

    for name in _COMMANDS:
        assert "Usage: dexkit" in installed("dexkit", name, "--help").stdout


def test_conformance_suite_of_the_wheel_lists_its_requirements(installed: Installed) -> None:
    result = installed(
        "pytest", "--pyargs", "dexkit.conformance", "--collect-only", "-q", "-p", "no:cacheprovider",
        "--backend", "sim-dex1",
    )
    assert "DEX1-" in result.stdout


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_without_dds_everything_else_works(
    version: str, wheel: Path, tmp_path: Path
) -> None:
    if run(uv(), "python", "find", version, cwd=tmp_path, check=False).returncode:
        pytest.skip(f"no Python {version} on this machine")
    newer = Installed(tmp_path, version, wheel)
    code = (
        "from dexkit.messages import message_type;"
        "m = message_type('unitree_go::msg::dds_::MotorCmds_');"
        "assert m.decode(m.encode(m.cls())) == m.cls();"
        "import dexkit.wire.dynamixel, dexkit.emulators.mx64, dexkit.drivers.ezgripper"
    )
    newer("python", "-c", code)
    assert newer("dexkit", "check", SAMPLE).returncode == 0
    refused = newer("dexkit", "serve", "sim-dex1", "--side", "left", check=False)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
    assert "3.10" in refused.stderr  # what is missing and what to do
