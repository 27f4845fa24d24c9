"""Pages, drawings and message modules made by tools/generate are what it would write now."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import tools.generate
from tools.generate import (
    BUILT,
    ROOT,
    built_pages,
    generated_files,
    stale_files,
    write_pages,
)


def test_generated_files_are_up_to_date() -> None:
    stale = [str(path.relative_to(ROOT)) for path in stale_files()]
    assert not stale, f"run make docs: {', '.join(stale)}"


def test_every_generator_contributes() -> None:
    made = {path.relative_to(ROOT).as_posix() for path in generated_files()}
    assert made >= {
        "dexkit/messages/unitree_go.py",
        "dexkit/messages/unitree_hg.py",
        "docs/layouts/foxglove-dex3-1.json",
        "docs/layouts/plotjuggler-dex3-1.xml",
        "docs/sources/real-hands.md",
    }


def test_pages_of_the_site_lead_to_files_of_the_checkout() -> None:
    write_pages()
    lost = []
    for name in built_pages():
        path = BUILT / name
        for target in re.findall(r"\]\(([^()\s#]+)", path.read_text(encoding="utf-8")):
            if "://" not in target and not (path.parent / target).exists():
                lost.append(f"{name}: {target}")
    assert not lost, "\n".join(lost)


def test_a_changed_or_missing_file_is_stale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    same, other, missing = (tmp_path / name for name in ("same", "other", "missing"))
    same.write_text("1")
    other.write_text("2")
    made = {same: "1", other: "changed", missing: "3"}
    monkeypatch.setattr(tools.generate, "generated_files", lambda: made)
    assert stale_files() == {other: "changed", missing: "3"}


def test_check_compares_and_writes_nothing() -> None:
    command = [sys.executable, "-m", "tools.generate", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout == "all generated files are up to date\n"
