"""The campaign finds planted faults, keeps and repeats them, and stops on a signal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10: dexkit setup-dds")

from tools.campaign.case import ROOT, Finding
from tools.campaign.run import Findings
from tools.campaign.soak import WatchedProcess, slope

PLANTED = {
    "BROKEN": "ValueError",
    "DIFFERS": "Difference",
    "FOR_EVER": "Hang",
    "GREEDY": "MemoryError",
    "CRASH": "died: SIGSEGV",
    "LeavesChild": "child left behind",
    "LeavesUnseen": "left behind",
    "DiesLoudly": "traceback",
    "Leaks": "memory grows",
    "Hangs": "hang",
}


def start(out: Path, cases: Sequence[str], *options: str) -> subprocess.Popen[str]:
    only = ",".join(f"tests.campaign_cases::{name}" for name in cases)
    return subprocess.Popen(
        [sys.executable, "-m", "tools.campaign", "--out", str(out), "--only", only, *options],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run(out: Path, cases: Sequence[str], *options: str) -> tuple[int, str, str]:
    process = start(out, cases, *options)
    output, errors = process.communicate(timeout=600)
    return process.returncode, output, errors


def result(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "result.json").read_text())
    return content


@pytest.mark.soak
def test_campaign_finds_planted_faults_and_repeats_them(tmp_path: Path) -> None:
    options = ("--sample", "--jobs", "2", "--minutes", "10")
    code, output, errors = run(tmp_path, [*PLANTED, "CLEAN", "Skipped"], *options)
    assert code == 1, errors
    out = tmp_path / "sample"
    found = {(f["case"].rpartition("::")[2], f["kind"]): f for f in result(out)["findings"]}
    assert set(found) == set(PLANTED.items()), output
    done = {c["name"].rpartition("::")[2]: c for c in result(out)["cases"]}
    assert done["CLEAN"]["units"] > 0
    assert done["Skipped"]["skipped"] == "not on this machine"
    assert found["CRASH", "died: SIGSEGV"]["index"] >= 0
    for finding in found.values():
        assert finding["id"] in output
    # one by its kept input, one by doing the batch again up to it
    for name in ("BROKEN", "CRASH"):
        command = found[name, PLANTED[name]]["repeat"].split()
        again = subprocess.run(
            [sys.executable, *command[1:]], cwd=ROOT, capture_output=True, text=True, timeout=600
        )
        assert again.returncode == 1, again.stderr
        assert "again" in again.stdout


@pytest.mark.soak
def test_campaign_has_its_own_exit_code_for_its_own_failure(tmp_path: Path) -> None:
    code, output, errors = run(tmp_path, ["CLEAN", "Fails"], "--sample", "--seed", "7")
    assert code == 2
    assert "the campaign is wrong here" in errors
    assert "seed 7" in output
    done = {c["name"]: c for c in result(tmp_path / "sample")["cases"]}
    assert done["tests.campaign_cases::CLEAN"]["units"] > 0


@pytest.mark.slow
def test_sigint_prints_the_table_and_leaves_no_process_or_file(tmp_path: Path) -> None:
    process = start(tmp_path, ["Slow"], "--minutes", "5", "--jobs", "1")
    try:
        log = tmp_path / "batches.log"
        while not (log.exists() and "scratch " in log.read_text()):
            assert process.poll() is None
        scratch = log.read_text().split("scratch ")[1].split()[0]
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "the table so far" in output
    assert not Path(scratch).exists()
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                command = Path(f"/proc/{name}/cmdline").read_bytes()
            except OSError:
                continue
            assert str(tmp_path).encode() not in command
            assert b"campaign_programs" not in command or int(name) == os.getpid()


def test_a_finding_is_kept_once_with_its_input(tmp_path: Path) -> None:
    findings = Findings(tmp_path)
    one = Finding("fuzz:x", "ValueError", "a.py:f", "first", "5", 3, 4, "00ff")
    assert findings.add(one)
    assert not findings.add(Finding("fuzz:x", "ValueError", "a.py:f", "second", "5", 9, 9, "11"))
    assert findings.add(Finding("fuzz:x", "ValueError", "a.py:g"))
    assert (tmp_path / f"{one.id}.bin").read_bytes() == b"\x00\xff"
    assert json.loads((tmp_path / f"{one.id}.json").read_text())["detail"] == "first"
    assert findings.times[one.id] == 2


def test_growth_of_memory_and_descriptors_is_distinguished_from_noise() -> None:
    steady, leaky, files = (WatchedProcess(name, 0) for name in ("steady", "leaky", "files"))
    for number in range(360):
        for one, memory, descriptors in (
            (steady, 45.0 + number % 3 * 0.1, 9 + number % 2),
            (leaky, 45.0 + number * 18 / 360, 9),
            (files, 45.0, 9 + number // 60),
        ):
            one.times.append(10.0 * number)
            one.memory.append(memory)
            one.files.append(descriptors)
            one.threads.append(3)
    assert steady.problems() == []
    assert [kind for kind, _ in leaky.problems()] == ["memory grows"]
    assert [kind for kind, _ in files.problems()] == ["descriptors grow"]
    assert slope([0.0, 1.0, 2.0], [1.0, 3.0, 5.0]) == pytest.approx(2.0)


def test_every_message_type_and_program_has_its_case() -> None:
    from dexkit.messages import message_types
    from tools.campaign.registry import all_cases

    names = [case.name for case in all_cases()]
    assert len(set(names)) == len(names)
    for kind in message_types():
        package, _, rest = kind.name.partition("::")
        assert f"fuzz:cdr.{package}.{rest.rpartition('::')[2]}" in names
    for program in ("serve-ezgripper", "bridge", "record", "publish", "emulate-all", "conformance"):
        assert {f"kill:{program}", f"stop:{program}"} <= set(names)
