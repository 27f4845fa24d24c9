"""The programs that are compared: how each is run on a set, and where it says what it found."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.dataset_peers import Finding, Run, doctor

__all__ = ["Program", "dexkit_audit", "lerobot_doctor", "lerobot_lint", "measured"]

_LAUNCH = Path(__file__).parent / "launch.py"
_LINT_LEVELS = {"info": "note", "warning": "warning", "error": "failure"}
_USES = {"keep": "note", "review": "warning", "drop": "failure"}


class NothingJudged(Exception):
    """A program has judged nothing of a set; the message is its own."""


@dataclass(frozen=True)
class Program:
    """One way to judge a set.

    :param name: as the tables have it.
    :param command: its arguments for a set, and a folder of its own to write to.
    :param findings: of what it printed, and that folder; raises :exc:`NothingJudged`, ValueError,
        KeyError, TypeError, AttributeError or OSError where there are none.
    :param only_lerobot: it reads LeRobot datasets and nothing else.
    """

    name: str
    command: Callable[[Path, Path], Sequence[str]]
    findings: Callable[[str, Path], list[Finding]]
    only_lerobot: bool = True


def dexkit_audit() -> Program:
    """The audit of this dexkit, in one process as the others are."""
    command = [sys.executable, "-m", "dexkit", "audit", "--jobs", "1", "--set", "format=jsonl"]
    return Program(
        "dexkit audit",
        lambda dataset, out: [*command, "--out", str(out / "audit"), str(dataset)],
        lambda _, out: _of_audit(out / "audit"),
        only_lerobot=False,
    )


def _of_audit(folder: Path) -> list[Finding]:
    """What it found, and the episodes that it cannot read.

    :raises NothingJudged: of the set.
    """
    episodes = [json.loads(line) for line in (folder / "episodes.jsonl").open()]
    numbers = {row["episode"]: row["number"] for row in episodes}
    unread = [row for row in episodes if row["state"] != "judged"]
    if len(unread) == len(episodes):
        raise NothingJudged("; ".join(row["error"] for row in unread))
    said = [json.loads(line) for line in (folder / "findings.jsonl").open()]
    return [
        *(Finding("unreadable", "failure", row["number"], row["error"]) for row in unread),
        *(
            Finding(f["requirement"], _USES[f["verdict"]], numbers[f["episode"]], f["observed"])
            for f in said
            if f["about"] == "training"
        ),
    ]


def lerobot_doctor(command: str) -> list[Program]:
    """Its checks, and its scores.

    :param command: of a shell, such as ``/path/lerobot-doctor``.
    """
    words = shlex.split(command)
    return [
        Program(
            "lerobot-doctor",
            lambda dataset, _: [*words, "check", str(dataset), "--json"],
            lambda printed, _: doctor.checked(printed),
        ),
        Program(
            "lerobot-doctor score",
            lambda dataset, _: [*words, "score", str(dataset), "--json"],
            lambda printed, _: doctor.scored(printed),
        ),
    ]


def lerobot_lint(command: str) -> Program:
    """All its checks.

    :param command: of a shell, such as ``/path/lelint``.
    """

    def findings(_: str, out: Path) -> list[Finding]:
        return [
            Finding(
                said["check"],
                _LINT_LEVELS[said["severity"]],
                "" if said["episode"] is None else str(said["episode"]),
                said["message"],
            )
            for said in json.loads((out / "lint.json").read_text())["findings"]
        ]

    words = shlex.split(command)
    return Program(
        "lerobot-lint",
        lambda dataset, out: [*words, "check", str(dataset), "--json", str(out / "lint.json")],
        findings,
    )


def measured(program: Program, dataset: Path, timeout: float = 1800.0) -> Run:
    """Run a program on a set, without network and with empty caches.

    Whatever it does is a run: it may crash, print nonsense, or last too long. A program that reads
    LeRobot datasets only is not started on others.
    """
    dataset = dataset.resolve()
    run = Run(program.name, dataset, **_size(dataset))
    if program.only_lerobot and not any((dataset / part).is_dir() for part in ("meta", "data")):
        run.trouble = "not run: no LeRobot dataset"
        return run
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        report, printed, errors = out / "report.json", out / "stdout", out / "stderr"
        launch = [sys.executable, "-I", "-S", str(_LAUNCH), str(timeout), str(report)]
        command = [*launch, *program.command(dataset, out)]
        with printed.open("wb") as stdout, errors.open("wb") as stderr:
            subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                env=_environment(out),
                cwd=out,
                check=False,
            )
        said = errors.read_text(errors="replace")
        try:
            vars(run).update(json.loads(report.read_text()))
        except (OSError, ValueError):
            run.trouble = f"not started: {_last_line(said)}"
            return run
        try:
            run.findings = program.findings(printed.read_text(errors="replace"), out)
        except NothingJudged as e:
            run.trouble = str(e)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            late = f"ended after {timeout:g} s" if run.wall_s >= timeout else ""
            run.trouble = late or _last_line(said) or "it printed no findings"
    return run


def _environment(home: Path) -> dict[str, str]:
    """The variables of this process, without its network, Python and caches."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.lower().endswith("_proxy") and not name.startswith(("HF_", "PYTHON"))
    }
    return {
        **kept,
        "HOME": str(home),
        "HF_HOME": str(home / "hf"),
        "HF_HUB_OFFLINE": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "COLUMNS": "200",
    }


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:300] if lines else ""


def _size(dataset: Path) -> dict[str, Any]:
    """Episodes and seconds of a set, as its metadata has them."""
    try:
        info = json.loads((dataset / "meta" / "info.json").read_bytes())
        return {
            "episodes": int(info["total_episodes"]),
            "recorded_s": float(info["total_frames"]) / float(info["fps"]),
        }
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        tasks = len(list(dataset.glob("*/data.json"))) if dataset.is_dir() else 1
        return {"episodes": tasks or None}
