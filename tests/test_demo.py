"""``dexkit demo``: its result, and its processes after a signal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10: dexkit setup-dds")


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", "from dexkit.cli import main; main()", "demo", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "NO_COLOR": "1"},
    )


def children_of(pid: int) -> set[int]:
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout
    return {int(p) for p in found.split()}


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    "how", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)]
)
def test_signal_during_the_demo_leaves_no_process(how: signal.Signals, tmp_path: Path) -> None:
    demo = start("--out", tmp_path)
    assert demo.stdout is not None
    seen = ""
    while "listening" not in seen:
        line = demo.stdout.readline()
        assert line, seen
        seen += line
    processes = children_of(demo.pid)
    assert len(processes) == 4, seen  # two emulated devices, two services
    demo.send_signal(how)
    rest = demo.stdout.read() if how is signal.SIGINT else ""
    code = demo.wait(60)
    if how is signal.SIGINT:
        assert code == 130
        assert "stopped; nothing is left running" in rest
    demo.stdout.close()
    end = time.monotonic() + 60
    while any(alive(p) for p in processes) and time.monotonic() < end:
        time.sleep(0.05)
    assert not [p for p in processes if alive(p)]


@pytest.mark.soak
def test_demo_passes_and_writes_its_files(tmp_path: Path) -> None:
    demo = start("--out", tmp_path)
    out, _ = demo.communicate(timeout=600)
    assert demo.returncode == 0, out
    result = json.loads((tmp_path / "result.json").read_text())
    judged = len({r["id"] for r in result["results"]})
    assert judged > 100
    assert f"PASS: every MUST that could be judged is met ({judged} requirements: " in out
    assert result["overall"] == "pass"
    assert (tmp_path / "report.html").stat().st_size > 50_000
    assert (tmp_path / "recording.mcap").exists()
