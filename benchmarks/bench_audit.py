"""An audit of generated sessions: how fast, on one processor, on all and on Ray, and how right.

``FILES=1000 SECONDS=60`` is the full archive (about 6 GB); the default is small. A fifth of its
files have a fault. ``ARCHIVE=FOLDER`` keeps the archive there, or takes the one that is there. The
audit is the whole pipeline: digest, reading, verdicts, journal, tables and page. A core's speed is
by processor time of all processes, for others may use the machine; scaling and Ray are by
wall-clock time. Steady state leaves out the start of the processes and their first file. The
peers read the same messages, and decode none, of at most ``PEER_FILES`` files of each model.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from benchmarks import Result
from dexkit.conformance.audit.audit import Audit, AuditProgress, Limits, Runner, in_this_process
from dexkit.conformance.audit.cluster import THIS_MACHINE, Cluster
from dexkit.conformance.audit.journal import Journal
from dexkit.models import BUILT_IN, HandModel
from tools.generate_archive import ANSWERS, generate
from tools.generate_archive.score import score

_FILES = int(os.environ.get("FILES", "12"))
_SECONDS = float(os.environ.get("SECONDS", "60"))
_PEER_FILES = int(os.environ.get("PEER_FILES", "10"))
_GRIPPER_TARGET, _HAND_TARGET = 1000.0, 600.0
"""Times real time, for hands of one joint and of several."""


def run() -> list[Result]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        archive = Path(os.environ.get("ARCHIVE", folder / "archive")).resolve()
        if not (archive / ANSWERS).exists():
            archive.mkdir(parents=True, exist_ok=True)
            generate(archive, _FILES, _FILES // 5, seconds=_SECONDS)
        cores = len(os.sched_getaffinity(0))
        Audit([str(min(archive.rglob("*.mcap")))], folder / "warm").run(in_this_process)
        one, own = _audit(archive, folder / "one", Limits().pool(1))
        many, _ = _audit(archive, folder / "many", Limits().pool(cores))
        files = _facts(folder / "one", one, own)
        found = [result for hand in BUILT_IN for result in _speed(hand, files)]
        found += [_scaling(one, many, cores), _score(archive, folder / "many")]
        if importlib.util.find_spec("ray") is not None:
            ray, _ = _audit(archive, folder / "ray", Cluster(THIS_MACHINE, Limits()).run)
            found += [_ray(many, ray, cores), _score(archive, folder / "ray", " on Ray")]
        return found


def _audit(archive: Path, out: Path, runner: Runner) -> tuple[AuditProgress, float]:
    """What it came to, and seconds of processor time of this process."""
    begin = time.process_time()
    outcome = Audit([str(archive)], out).run(runner)
    assert outcome.done == outcome.total
    return outcome, time.process_time() - begin


def _facts(out: Path, outcome: AuditProgress, own: float) -> list[tuple[Path, dict[str, Any]]]:
    """Path and facts of each file that was judged to its end, without the first.

    :param own: processor time of the auditing process, of which each file gets its share.
    """
    found = []
    with Journal(out / "journal.jsonl") as journal:
        for name, entry in list(journal.entries.items())[1:]:
            facts = journal.read(entry).facts
            if "model" in facts and not facts["damage"]:
                facts["cpu_s"] += own / outcome.total
                found.append((Path(name), facts))
    return found


def _speed(hand: HandModel, files: Sequence[tuple[Path, dict[str, Any]]]) -> list[Result]:
    mine = [(path, facts) for path, facts in files if facts["model"] == hand.name]
    if not mine:
        return []
    name, unit = f"dexkit audit, {hand.name}, a core in steady state", "times real time"
    target = _GRIPPER_TARGET if hand.dialects[0].is_gripper else _HAND_TARGET
    speed = _rate(facts for _, facts in mine)
    about = f"{len(mine)} files"
    some = mine[:: max(1, len(mine) // _PEER_FILES)][:_PEER_FILES]
    found = [
        Result(
            name, speed, unit, f"{target:g} {unit}", target, speed / target,
            f">= {target:g}", speed >= target, about,
        )
    ]  # fmt: skip
    peers = (
        ("mcap library, iter_messages", _read_with_mcap),
        ("rosbags, Reader.messages", _read_with_rosbags),
    )
    for peer, read in peers:
        reading = sum(f["duration_s"] for _, f in some) / read(path for path, _ in some)
        note = f"of {len(some)} of them"
        found.append(Result(name, speed, unit, peer, reading, speed / reading, note=note))
    return found


def _rate(files: Iterable[dict[str, Any]]) -> float:
    """Seconds of recordings for each second of processor time."""
    every = list(files)
    return float(sum(f["duration_s"] for f in every) / sum(f["cpu_s"] for f in every))


def _scaling(one: AuditProgress, many: AuditProgress, cores: int) -> Result:
    part = one.seconds / many.seconds / cores
    return Result(
        f"dexkit audit, {cores} processes",
        part,
        "of linear scaling",
        "linear",
        1.0,
        part,
        ">= 0.9",
        part >= 0.9,
        f"{one.total} files in {many.seconds:.1f} s instead of {one.seconds:.1f} s, "
        f"{many.examined_s / many.seconds:.0f} times real time",
    )


def _ray(many: AuditProgress, ray: AuditProgress, cores: int) -> Result:
    return Result(
        f"dexkit audit --ray local, {cores} processors",
        ray.seconds,
        "s",
        f"{cores} processes without Ray",
        many.seconds,
        many.seconds / ray.seconds,
        note="without the start of the cluster",
    )


def _score(archive: Path, out: Path, where: str = "") -> Result:
    found = score(archive, out)
    return Result(
        f"dexkit audit, faults found{where}",
        found.found,
        "faults",
        "all",
        found.faulty,
        found.found / max(1, found.faulty),
        "all, and no other",
        found.perfect,
        found.text().replace("\n", "; "),
    )


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
