"""A working folder whose files are named like modules: none of them is run."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from dexkit.child_processes import code_line, command_line, module_line
from tests.each import each
from tests.patience import PATIENCE

_NAMES = ("click", "json", "numpy", "rich", "conftest", "sitecustomize", "pip", "venv", "my_hand")


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, each of whose modules leaves a file ``ran``; returns that file's path."""
    ran = tmp_path / "ran"
    folder = tmp_path / "folder"
    folder.mkdir()
    code = f"open({str(ran)!r}, 'a').write(__name__ + ' ')\n"
    for name in _NAMES:
        (folder / f"{name}.py").write_text(code)
    for name in ("dexkit", "cyclonedds"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(code)
    about = folder / "evil-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[dexkit.backends]\nevil = my_hand:Hand\n")
    monkeypatch.chdir(folder)
    return ran


def _run(command: list[str], **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@each(
    "command",
    [
        command_line("backends"),
        code_line("import json, dexkit.cli"),
        code_line("import dexkit.dds_library"),
        module_line("venv", "--help"),
        module_line("pip", "--version"),
    ],
)
def test_nothing_in_the_working_folder_is_run(command: list[str], hostile: Path) -> None:
    hostile.unlink(missing_ok=True)
    done = _run(command)
    assert not hostile.exists(), hostile.read_text()
    assert done.returncode == 0 or "No module named pip" in done.stderr, done.stderr
    assert "evil" not in done.stdout


# -- completion of the shell


@each("shell", ["bash", "zsh", "fish"])
def test_completion_script_is_printed(shell: str, hostile: Path) -> None:
    done = _run(command_line(), _DEXKIT_COMPLETE=f"{shell}_source")
    assert done.returncode == 0, done.stderr
    assert "_DEXKIT_COMPLETE" in done.stdout


@each(
    ("words", "found"),
    [
        ("dexkit se", {"plain,selftest", "plain,serve", "plain,setup-dds"}),
        ("dexkit serve my_hand:Hand --dialect unitree_g", None),
        ("dexkit serve my_hand:Hand --sid", {"plain,--side"}),
        ("dexkit install-service my_hand:Hand --side left --us", {"plain,--user"}),
    ],
)
def test_completion_loads_no_plugin(words: str, found: set[str] | None, hostile: Path) -> None:
    done = _run(
        command_line(),
        _DEXKIT_COMPLETE="bash_complete",
        COMP_WORDS=words,
        COMP_CWORD=str(len(words.split()) - 1),
    )
    assert done.returncode == 0, done.stderr
    assert not hostile.exists(), hostile.read_text()
    if found is not None:
        assert set(done.stdout.split()) == found
