"""An audit of generated sessions: how many times real time, on one processor and on all.

``FILES=1000 SECONDS=60`` is the full archive (about 4 GB); the default is small. The audit is the
whole pipeline: digest, reading, verdicts, journal, tables and page. By processor time of all of
its processes, for others may use the machine; scaling is by wall-clock time. Steady state leaves
out the start of the processes and their first file.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from benchmarks import Result
from dexkit.conformance.audit.audit import Audit, Limits, Outcome, in_this_process
from dexkit.conformance.audit.journal import Journal
from tools.generate_archive import generate

_FILES = int(os.environ.get("FILES", "8"))
_SECONDS = float(os.environ.get("SECONDS", "60"))
_TARGETS = {"Dex1-1": 1000.0, "Dex3-1": 600.0}
_SAMPLES = {"Dex1-1": ["dex1_pick_place", "dex1_idle_then_startle"], "Dex3-1": ["dex3_pinch"]}


def run() -> list[Result]:
    results: list[Result] = []
    for title, samples in _SAMPLES.items():
        with tempfile.TemporaryDirectory() as folder:
            archive = Path(folder) / "archive"
            archive.mkdir()
            generate(archive, _FILES, 0, seconds=_SECONDS, samples=samples)
            results += _audits(title, archive, Path(folder))
    return results


def _audits(title: str, archive: Path, folder: Path) -> list[Result]:
    cores = len(os.sched_getaffinity(0))
    one, steady = _audit(archive, folder / "one", 1)
    many, _ = _audit(archive, folder / "many", cores)
    peers = {
        "mcap library, iter_messages": _read_with_mcap,
        "rosbags, Reader.messages": _read_with_rosbags,
    }
    target = _TARGETS[title]
    about = f"{one.total} files of {_SECONDS:g} s"
    return [
        Result(
            f"dexkit audit, {title}, a core in steady state",
            steady,
            "times real time",
            f"{target:g} times real time",
            target,
            steady / target,
            f">= {target:g}",
            steady >= target,
            about,
        ),
        *(
            Result(
                f"dexkit audit, {title}, a core in steady state",
                steady,
                "times real time",
                peer,
                reading := one.examined_s / read(archive.rglob("*.mcap")),
                steady / reading,
                note="it reads the same messages, and decodes none",
            )
            for peer, read in peers.items()
        ),
        Result(
            f"dexkit audit, {title}, {cores} processes",
            one.seconds / many.seconds / cores,
            "of linear scaling",
            "linear",
            1.0,
            one.seconds / many.seconds / cores,
            ">= 0.9",
            one.seconds / many.seconds / cores >= 0.9,
            f"{about} in {many.seconds:.2f} s instead of {one.seconds:.2f} s",
        ),
    ]


def _audit(archive: Path, out: Path, jobs: int) -> tuple[Outcome, float]:
    """What it came to, and seconds of recordings for each of processor time in steady state."""
    first = min(archive.rglob("*.mcap"))
    Audit([str(first)], out / "warm").run(in_this_process)  # loads what it needs
    begin = time.process_time()
    outcome = Audit([str(archive)], out).run(Limits().pool(jobs))
    own = time.process_time() - begin
    assert not outcome.failing
    assert not outcome.unusable
    with Journal(out / "journal.jsonl") as journal:
        facts = [journal.read(entry).facts for entry in journal.entries.values()][jobs:]
    spent = sum(f["cpu_s"] for f in facts) + own * len(facts) / outcome.total
    return outcome, sum(f["duration_s"] for f in facts) / spent


def _read_with_mcap(paths: Iterable[Path]) -> float:
    begin = time.process_time()
    for path in paths:
        with path.open("rb") as file:
            for _ in make_reader(file).iter_messages():
                pass
    return time.process_time() - begin


def _read_with_rosbags(paths: Iterable[Path]) -> float:
    begin = time.process_time()
    for path in paths:
        with Reader(path) as reader:
            for _ in reader.messages():
                pass
    return time.process_time() - begin
