"""An audit of generated sessions: how many times real time, on one processor and on all.

``FILES=1000 SECONDS=60`` is the full archive (about 4 GB); the default is small. The audit is the
whole pipeline: digest, reading, verdicts, journal, tables and page. By processor time of all of
its processes, for others may use the machine; scaling is by wall-clock time.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from mcap.reader import make_reader

from benchmarks import Result
from dexkit.conformance.audit.audit import Audit, Limits, Outcome
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
    one, spent = _audit(archive, folder / "one", 1)
    many, _ = _audit(archive, folder / "many", cores)
    peer = _read_with_mcap(archive.rglob("*.mcap"))
    ratio, target = one.examined_s / spent, _TARGETS[title]
    about = f"{one.total} files of {_SECONDS:g} s"
    return [
        Result(
            f"dexkit audit, {title}, one process",
            ratio,
            "times real time",
            f"{target:g} times real time",
            target,
            ratio / target,
            f">= {target:g}",
            ratio >= target,
            f"{about} in {spent:.2f} s of processor time, start of Python included",
        ),
        Result(
            f"dexkit audit, {title}, one process",
            ratio,
            "times real time",
            "mcap library, iter_messages",
            one.examined_s / peer,
            peer / spent,
            note="the library reads the same messages, and decodes none",
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


def _spent() -> float:
    every = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in every)


def _audit(archive: Path, out: Path, jobs: int) -> tuple[Outcome, float]:
    begin = _spent()
    outcome = Audit([str(archive)], out).run(Limits().pool(jobs))
    assert not outcome.failing
    assert not outcome.unusable
    return outcome, _spent() - begin


def _read_with_mcap(paths: Iterable[Path]) -> float:
    begin = time.process_time()
    for path in paths:
        with path.open("rb") as file:
            for _ in make_reader(file).iter_messages():
                pass
    return time.process_time() - begin
