"""Runs cases: each batch in a process of its own, as many at once as there is room for."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any

from tools.campaign import children, isolation
from tools.campaign.case import ROOT, Batch, Case, Finding, Lane, Skip
from tools.campaign.registry import case

__all__ = ["Campaign", "Findings", "Progress", "Task", "run_task"]

GRACE = 15.0
"""Seconds before the end in which nothing new begins, for what is under way to end by itself."""
FUZZED = 5.0
"""Seconds of a batch of a fuzzer; of a sample ``SAMPLED``."""
SAMPLED = 0.5
SOAKED = 20.0
"""Seconds of the soak in a sample."""
_TRIES = 3
"""Batches of a case that may fail by the campaign's own fault before it is left out."""
_ENDING = 6.0
"""Seconds for a batch that is asked to end, to clean up."""

# Forks of a process that has imported all cases: an interpreter of its own for each batch would
# import for seconds what it runs for a few.
_processes = multiprocessing.get_context("forkserver")
_processes.set_forkserver_preload(["tools.campaign.registry"])


@dataclass(frozen=True)
class Task:
    """One batch.

    :param log: file for what the code under test prints.
    :param domain: first of ten DDS domains that no other batch uses.
    :param only: number of the only input that is of interest; -1 for all.
    :param data: an input to be tried alone.
    """

    case: str
    seed: str
    batch: int
    log: str = os.devnull
    domain: int = 20
    seconds: float = FUZZED
    sample: bool = False
    only: int = -1
    data: str = ""
    own_network: bool = False


@dataclass
class Progress:
    """What was done of one case.

    :ivar batches: that were begun.
    :ivar seconds: that its batches took.
    """

    batches: int = 0
    units: int = 0
    seconds: float = 0.0
    skipped: str = ""
    failed: str = ""
    failures: int = 0
    notes: list[str] = field(default_factory=list)


class Findings:
    """The findings, each once, and the files in which they are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.found: dict[str, Finding] = {}
        self.times: dict[str, int] = {}

    def add(self, finding: Finding) -> bool:
        """Keep a finding, with its input; whether it is a new one."""
        self.times[finding.id] = self.times.get(finding.id, 0) + 1
        if finding.id in self.found:
            return False
        self.found[finding.id] = finding
        self.folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({**finding.as_dict(), "repeat": self.command(finding)}, indent=1)
        (self.folder / f"{finding.id}.json").write_text(text + "\n")
        if finding.data:
            (self.folder / f"{finding.id}.bin").write_bytes(bytes.fromhex(finding.data))
        return True

    def command(self, finding: Finding) -> str:
        """What repeats it."""
        return f"python -m tools.campaign --repeat {self.folder}/{finding.id}.json"


class Campaign:
    """A campaign.

    :param out: folder of the log and the findings.
    :param jobs: fuzzers at once; twice as many other batches run beside them, for they mostly
        wait.
    :param seconds: how long.
    :param sample: each case once, in miniature.
    :param report: is called about once a second with a line of progress.
    """

    def __init__(
        self,
        cases: Sequence[Case],
        seed: str,
        out: Path,
        *,
        jobs: int,
        seconds: float,
        sample: bool = False,
        own_network: bool = False,
        report: Callable[[str], object] = lambda line: None,
    ) -> None:
        self.cases = list(cases)
        self.seed = seed
        self.progress = {c.name: Progress() for c in cases}
        self.findings = Findings(out / "findings")
        self.stopping = False
        self._jobs = jobs
        self._sample = sample
        self._seconds = seconds
        self._own_network = own_network
        self._report = report
        self._log = out / "batches.log"
        self._lock = threading.Lock()
        self._running: dict[int, str] = {}  # case of each batch that runs, by its number
        self.began = time.monotonic()

    @property
    def left(self) -> float:
        """Seconds until the end; none after :meth:`stop`."""
        return 0.0 if self.stopping else self.began + self._seconds - time.monotonic()

    def stop(self) -> None:
        """Ask for an early end."""
        self.stopping = True

    def run(self) -> None:
        """Run until the time is over, everything is done (a sample), or :meth:`stop`."""
        self.began = time.monotonic()
        self._log.parent.mkdir(parents=True, exist_ok=True)
        self._log.write_bytes(b"")
        lanes = {lane: [c for c in self.cases if c.lane is lane] for lane in Lane}
        counts = {Lane.COMPUTE: self._jobs, Lane.LIVE: 2 * self._jobs, Lane.LONG: 1}
        loops = [lane for lane, count in counts.items() for _ in range(count) if lanes[lane]]
        with ThreadPoolExecutor(max(1, len(loops))) as pool:
            work = [pool.submit(self._serve, lanes[lane]) for lane in loops]
            while wait(work, timeout=1.0).not_done:
                self._report(self._line())
        for done in work:
            done.result()

    def _serve(self, cases: Sequence[Case]) -> None:
        """Run batches of some cases, one after the other."""
        while (chosen := self._next(cases)) is not None:
            number, task = chosen
            try:
                self._take(task, run_task(task, lambda: self.left <= 0))
            finally:
                with self._lock:
                    del self._running[number]

    def _next(self, cases: Sequence[Case]) -> tuple[int, Task] | None:
        """A batch of the case that had the least time so far; none when too little is left."""
        grace = 0.0 if self._sample else min(GRACE, self._seconds / 4)
        with self._lock:
            if self.left <= grace:
                return None
            once = self._sample or cases[0].lane is Lane.LONG
            candidates = []
            for chosen in cases:
                progress = self.progress[chosen.name]
                over = progress.skipped or progress.failures >= _TRIES
                if not over and not (once and progress.batches):
                    running = list(self._running.values()).count(chosen.name)
                    candidates.append((progress.seconds + running * FUZZED, chosen))
            if not candidates:
                return None
            _, chosen = min(candidates, key=lambda found: found[0])
            number = next(n for n in range(len(self._running) + 1) if n not in self._running)
            self._running[number] = chosen.name
            progress = self.progress[chosen.name]
            progress.batches += 1
            seconds = SAMPLED if self._sample else FUZZED
            if chosen.lane is Lane.LONG:
                seconds = SOAKED if self._sample else max(5.0, self.left - GRACE)
            task = Task(
                chosen.name,
                self.seed,
                progress.batches - 1,
                log=str(self._log),
                domain=20 + 10 * number,
                seconds=seconds,
                sample=self._sample,
                own_network=self._own_network,
            )
            return number, task

    def _take(self, task: Task, answer: dict[str, Any]) -> None:
        with self._lock:
            progress = self.progress[task.case]
            progress.seconds += answer["seconds"]
            progress.units += answer["units"]
            progress.notes = list(dict.fromkeys([*progress.notes, *answer["notes"]]))[-2:]
            if answer["outcome"] == "skipped":
                progress.skipped = answer["text"]
            elif answer["outcome"] == "failed":
                progress.failures += 1
                progress.failed = answer["text"]
            for plain in answer["findings"]:
                finding = Finding(**plain)
                if self.findings.add(finding):
                    self._report(f"FINDING {finding.case}: {finding.kind} in {finding.place}\n")

    def _line(self) -> str:
        """One line of progress."""
        with self._lock:
            units: dict[str, int] = {}
            for chosen in self.cases:
                done = self.progress[chosen.name].units
                units[chosen.unit] = units.get(chosen.unit, 0) + done
            found = len(self.findings.found)
        parts = ", ".join(f"{count:,} {unit}" for unit, count in units.items())
        left = max(0.0, self.left)
        return f"{left:.0f} s left: {parts}; findings: {found}"


def run_task(task: Task, stopped: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """Run a batch in a process of its own, and describe what came of it.

    :param stopped: the batch is to be given up; it counts for nothing then.
    :returns: ``outcome`` is ok, skipped, failed or stopped.
    """
    began = time.monotonic()
    here, there = _processes.Pipe(duplex=False)
    index = _processes.RawValue("q", -1)
    process = _processes.Process(target=_work, args=(there, index, task))
    process.start()
    there.close()
    end = began + case(task.case).limit + task.seconds
    answer = None
    how = ""
    while not here.poll(0.1):
        if stopped():
            how = "stopped"
        elif time.monotonic() > end:
            how = "hang"
        if how:
            break
    else:
        with contextlib.suppress(EOFError):
            answer = here.recv()
    if how == "stopped":
        process.terminate()
        process.join(_ENDING)
    _kill(process)
    if answer is not None:
        return {**answer, "seconds": time.monotonic() - began}
    nothing = {"text": "", "units": 0, "notes": [], "seconds": time.monotonic() - began}
    if how == "stopped":
        return {**nothing, "outcome": "stopped", "findings": []}
    code = process.exitcode or 0
    how = how or "died: " + (signal.Signals(-code).name if code < 0 else f"exit code {code}")
    detail = f"batch {task.batch}" + (f", input {index.value}" if index.value >= 0 else "")
    finding = Finding(
        task.case, how, "batch", detail, task.seed, task.batch, index.value, data=task.data
    )
    return {**nothing, "outcome": "ok", "findings": [finding.as_dict()]}


def _kill(process: Any) -> None:
    """End a batch's process and everything below it at once."""
    below = children.descendants(process.pid) if process.is_alive() else []
    process.kill()
    process.join()
    for pid in below:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
            os.kill(pid, signal.SIGCONT)


# --- in the batch's process


class _Stop(BaseException):
    """The parent wants an end."""


def _stop(signum: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _Stop


def _work(pipe: Connection, index: Any, task: Task) -> None:
    # The server that forked this process ends when nobody holds this: with the campaign, then, also
    # where that is killed, and this process with it.
    os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore[attr-defined]
    isolation.die_with_parent()
    isolation.subreaper()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    with open(os.devnull, "rb") as nothing, open(task.log, "ab") as log:
        os.dup2(nothing.fileno(), 0)
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    if task.own_network:
        isolation.new_network()
    if case(task.case).lane is Lane.COMPUTE:
        os.nice(5)
    home = Path(tempfile.mkdtemp(prefix="dexkit-campaign-", dir=children.scratch_root()))
    kept = {k: v for k, v in os.environ.items() if k in ("PATH", "LANG") or k.startswith("LC_")}
    os.environ.clear()
    # this checkout, wherever a program works and whatever is installed
    os.environ.update(kept, HOME=str(home), PYTHONUNBUFFERED="1", PYTHONPATH=str(ROOT))
    code = 1
    try:
        with contextlib.suppress(BrokenPipeError):
            pipe.send(_run(task, home, index))
        code = 0
    except _Stop:
        code = 0
    finally:
        with contextlib.suppress(Exception):
            children.sweep()
        shutil.rmtree(home, ignore_errors=True)
        sys.stderr.flush()
        os._exit(code)  # threads of a batch that was interrupted must not hold this up


def _run(task: Task, home: Path, index: Any) -> dict[str, Any]:
    scratch = home / "scratch"
    scratch.mkdir()
    batch = Batch(
        task.case,
        task.seed,
        task.batch,
        scratch,
        domain=task.domain,
        sample=task.sample,
        seconds=task.seconds,
        only=task.only if task.only >= 0 else None,
        index=index,
    )
    outcome, text = "ok", ""
    try:
        if task.data:
            case(task.case).repeat(batch, bytes.fromhex(task.data))
        else:
            case(task.case).run(batch)
    except Skip as reason:
        outcome, text = "skipped", str(reason)
    except Exception:
        outcome, text = "failed", traceback.format_exc()
    left = children.sweep()
    if left and outcome == "ok" and not batch.findings:
        batch.found("left behind", "process", "\n".join(left))
    return {
        "outcome": outcome,
        "text": text,
        "units": batch.units,
        "notes": batch.notes,
        "findings": [f.as_dict() for f in batch.findings],
    }


def repeat(finding: Finding, *, own_network: bool) -> dict[str, Any]:
    """Try a finding again: its input alone, or its batch up to it."""
    task = Task(
        finding.case, finding.seed, finding.batch, only=finding.index, own_network=own_network
    )
    lane = case(finding.case).lane
    seconds = 60.0 if lane is Lane.LONG else FUZZED
    return run_task(replace(task, data=finding.data, seconds=seconds))
