"""Gives batches to worker processes, watches them, collects their findings."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from tools.campaign import children
from tools.campaign.case import ROOT, Case, Finding, Lane
from tools.campaign.state import Progress, State

__all__ = ["Engine", "Worker"]

GRACE = 15.0
"""Seconds before the end in which nothing new begins, for what is under way to end by itself."""
_TRIES = 3
"""Batches of a case that may fail by the campaign's own fault before it is left out."""


class Worker:
    """One worker process.

    :param number: decides its DDS domains.
    :param own_network: give it a network of its own.
    """

    def __init__(
        self, number: int, lane: Lane, log: IO[bytes], home: Path, *, own_network: bool
    ) -> None:
        self.number = number
        self.lane = lane
        self.case: Case | None = None
        self.task: dict[str, Any] = {}
        self.deadline = 0.0
        flags = ["--own-network"] if own_network else []
        flags += ["--nice"] if lane is Lane.COMPUTE else []
        environment = {
            name: value
            for name, value in os.environ.items()
            if name in ("PATH", "LANG", "TMPDIR") or name.startswith(("LC_", "DEXKIT_CAMPAIGN"))
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tools.campaign.worker", *flags],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            cwd=ROOT,
            start_new_session=True,
            env={
                **environment,
                "HOME": str(home),
                "PYTHONUNBUFFERED": "1",
                # this checkout, wherever a program works and whatever is installed
                "PYTHONPATH": str(ROOT),
            },
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._in, self.out = self.process.stdin, self.process.stdout

    def give(self, case: Case, task: dict[str, Any]) -> None:
        """Have it run a batch."""
        self.case = case
        self.task = {**task, "domain": 20 + 10 * self.number}
        self.deadline = time.monotonic() + case.limit + float(task.get("seconds", 0.0))
        with contextlib.suppress(BrokenPipeError):  # it has died, which is seen at once
            self._in.write(json.dumps(self.task).encode() + b"\n")
            self._in.flush()

    def read(self) -> dict[str, Any] | None:
        """Its answer; None when it has died."""
        line = self.out.readline()
        if not line.endswith(b"\n"):
            return None
        answer: dict[str, Any] = json.loads(line)
        return answer

    def kill(self) -> int:
        """End it and everything below it at once; how it had ended."""
        below = children.descendants(self.process.pid)
        self.process.kill()
        code = self.process.wait()
        for pid in below:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.kill(pid, signal.SIGCONT)
        self._close()
        return code

    def ask_to_end(self) -> None:
        """Have it give up its batch and clean up behind it."""
        self.process.send_signal(signal.SIGTERM)

    def _close(self) -> None:
        for stream in (self._in, self.out):
            with contextlib.suppress(OSError):
                stream.close()


class Engine:
    """A campaign.

    :param cases: to run.
    :param jobs: fuzzers at once; twice as many other batches run beside them, for they mostly
        wait.
    :param seconds: how long.
    :param batches: of each case; None for as many as the time allows.
    :param sample: each case once, in miniature.
    :param report: is called about once a second with a line of progress.
    """

    def __init__(
        self,
        cases: Sequence[Case],
        state: State,
        *,
        jobs: int,
        seconds: float,
        batches: int | None = None,
        sample: bool = False,
        own_network: bool = False,
        report: Callable[[str], object] = lambda line: None,
    ) -> None:
        self.cases = list(cases)
        self.state = state
        self.stopping = False
        self._jobs = jobs
        self._seconds = seconds
        self._batches = 1 if sample else batches
        self._sample = sample
        self._own_network = own_network
        self._report_progress = report
        self._selector = selectors.DefaultSelector()
        self._workers: list[Worker] = []
        self._suspects: list[dict[str, Any]] = []
        self._tries: dict[str, int] = {}
        self._given: dict[str, int] = {}
        self._began = time.monotonic()
        self._first = {name: p.units for name, p in state.cases.items()}
        state.folder.mkdir(parents=True, exist_ok=True)
        self._log: IO[bytes] = (state.folder / "workers.log").open("ab")
        self._home = Path(
            tempfile.mkdtemp(prefix="dexkit-campaign-home-", dir=children.scratch_root())
        )

    # --- running

    def stop(self) -> None:
        """Ask for an early end; a second time, an immediate one."""
        if self.stopping:
            self._seconds = 0.0
        self.stopping = True

    @property
    def _left(self) -> float:
        return self._began + self._seconds - time.monotonic()

    def run(self) -> None:
        """Run until the time is over, everything is done (a sample), or :meth:`stop`."""
        try:
            self._open_workers()
            reported = saved = time.monotonic()
            while not self.stopping and self._left > 0:
                self._feed()
                if not any(w.case for w in self._workers):
                    break
                self._collect(0.2)
                now = time.monotonic()
                if now - reported >= 1.0:
                    reported = now
                    self._report_progress(self.progress())
                if now - saved >= 10.0:
                    saved = now
                    self._save()
        finally:
            self._close()

    def _open_workers(self) -> None:
        lanes = {lane: [c for c in self.cases if c.lane is lane] for lane in Lane}
        live = 2 * self._jobs
        counts = {Lane.COMPUTE: self._jobs, Lane.LIVE: live, Lane.LONG: len(lanes[Lane.LONG])}
        for lane, count in counts.items():
            if self._sample and lane is not Lane.LONG:
                count = min(count, len(lanes[lane]))
            for _ in range(count if lanes[lane] else 0):
                self._open(lane)

    def _open(self, lane: Lane) -> Worker:
        used = {w.number for w in self._workers}
        number = next(n for n in range(len(used) + 1) if n not in used)
        worker = Worker(number, lane, self._log, self._home, own_network=self._own_network)
        self._workers.append(worker)
        self._selector.register(worker.out, selectors.EVENT_READ, worker)
        return worker

    def _feed(self) -> None:
        for worker in self._workers:
            if worker.case is not None:
                continue
            if self._suspects and worker.lane is Lane.COMPUTE:
                task = self._suspects.pop()
                worker.give(next(c for c in self.cases if c.name == task["case"]), task)
                continue
            chosen = self._choose(worker.lane)
            if chosen is not None:
                worker.give(chosen, self._task(chosen))

    def _choose(self, lane: Lane) -> Case | None:
        """The case that is furthest behind; none when too little time is left."""
        if not self._sample and self._left < min(GRACE, self._seconds / 4):
            return None
        candidates: list[tuple[float, int, Case]] = []
        for chosen in self.cases:
            if chosen.lane is not lane or self._tries.get(chosen.name, 0) >= _TRIES:
                continue
            progress = self.state.progress_of(chosen.name)
            given = self._given.get(chosen.name, 0)
            most = 1 if lane is Lane.LONG else self._batches
            if progress.skipped or (most is not None and given >= most):
                continue
            candidates.append((self._share_done(chosen, progress), len(candidates), chosen))
        if not candidates or (
            lane is Lane.LIVE and not self._sample and self._live_cases_are_done()
        ):
            return None
        return min(candidates)[2]

    def _live_cases_are_done(self) -> bool:
        """Every live case has reached its aim, and the fuzzers have not: they get the cores."""

        def short(chosen: Case) -> bool:
            progress = self.state.progress_of(chosen.name)
            return not progress.skipped and progress.units < chosen.aim

        live = any(short(c) for c in self.cases if c.lane is Lane.LIVE)
        return not live and any(short(c) for c in self.cases if c.lane is Lane.COMPUTE)

    def _share_done(self, chosen: Case, progress: Progress) -> float:
        under_way = sum(w.case is chosen for w in self._workers)
        if chosen.lane is Lane.COMPUTE:
            typical = progress.seconds / max(progress.batches, 1) or 0.5
            return (progress.seconds + under_way * typical) / chosen.weight
        typical = progress.units / max(progress.batches, 1) or 1.0
        return (progress.units + under_way * typical) / chosen.aim

    def _task(self, chosen: Case) -> dict[str, Any]:
        progress = self.state.progress_of(chosen.name)
        if progress.again:
            number = progress.again.pop()
        else:
            number = progress.batches
            progress.batches += 1
        self._given[chosen.name] = self._given.get(chosen.name, 0) + 1
        seconds = 1.0
        if chosen.lane is Lane.LONG:
            seconds = max(5.0, self._left - GRACE) if not self._sample else 20.0
        return {
            "case": chosen.name,
            "seed": self.state.seed,
            "batch": number,
            "sample": self._sample,
            "seconds": seconds,
        }

    def _collect(self, timeout: float) -> None:
        for key, _ in self._selector.select(timeout):
            worker: Worker = key.data
            answer = worker.read()
            if answer is None:
                self._died(worker)
            else:
                self._take(worker, answer)
        now = time.monotonic()
        for worker in list(self._workers):
            if worker.case is not None and now > worker.deadline:
                self._hangs(worker)

    def _take(self, worker: Worker, answer: dict[str, Any]) -> None:
        assert worker.case is not None
        progress = self.state.progress_of(worker.case.name)
        worker.case, task = None, worker.task
        progress.seconds += answer["seconds"]
        progress.units += answer["units"]
        progress.notes = list(dict.fromkeys([*progress.notes, *answer["notes"]]))[-5:]
        if answer["outcome"] == "skipped":
            progress.skipped = answer["text"]
        elif answer["outcome"] == "failed":
            self._tries[task["case"]] = self._tries.get(task["case"], 0) + 1
            progress.failed = answer["text"]
        for plain in answer["findings"]:
            self._found(Finding(**plain))

    def _found(self, finding: Finding) -> None:
        if self.state.add(finding):
            self._report_progress(f"FINDING {finding.case}: {finding.kind} in {finding.place}\n")

    def _died(self, worker: Worker) -> None:
        chosen, task = worker.case, worker.task
        self._replace(worker)
        if chosen is None:
            return
        code = worker.process.returncode
        how = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        self._suspect(chosen, task, f"died: {how}")

    def _hangs(self, worker: Worker) -> None:
        chosen, task = worker.case, worker.task
        self._replace(worker)
        assert chosen is not None
        self._suspect(chosen, task, "hang")

    def _suspect(self, chosen: Case, task: dict[str, Any], kind: str) -> None:
        """A batch that took its worker with it: do it again, noting each input beforehand."""
        trace = task.get("trace")
        index = -1
        if trace is not None:
            with contextlib.suppress(OSError, ValueError):
                index = int(Path(trace).read_text())
        elif chosen.lane is Lane.COMPUTE:
            path = self.state.folder / f"trace-{task['case'].replace(':', '-')}-{task['batch']}"
            self._suspects.append({**task, "trace": str(path)})
            return
        detail = f"batch {task['batch']}" + (f", input {index}" if index >= 0 else "")
        finding = Finding(
            chosen.name, kind, "worker", detail, self.state.seed, task["batch"], index
        )
        if trace is not None:
            Path(trace).unlink(missing_ok=True)
        self._found(finding)

    def _replace(self, worker: Worker) -> None:
        self._selector.unregister(worker.out)
        worker.kill()
        self._workers.remove(worker)
        if not self.stopping:
            self._open(worker.lane)

    def _close(self) -> None:
        """Let what is under way come to an end for some seconds, then end it."""
        busy = [w for w in self._workers if w.case is not None]
        for worker in self._workers:
            if worker.case is None or self.stopping:
                worker.ask_to_end()
        end = time.monotonic() + (0.0 if self.stopping else 3.0)
        while time.monotonic() < end and any(w.case for w in self._workers):
            self._collect(0.1)
        for worker in self._workers:
            worker.ask_to_end()
        patience = time.monotonic() + 6.0
        for worker in list(self._workers):
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.process.wait(max(0.1, patience - time.monotonic()))
            if worker.case is not None and worker in busy:
                self.state.progress_of(worker.case.name).again.append(worker.task["batch"])
            worker.kill()
        self._workers.clear()
        self._selector.close()
        self._log.close()
        self.state.wall += time.monotonic() - self._began
        self._save()
        shutil.rmtree(self._home, ignore_errors=True)

    def _save(self) -> None:
        self.state.save()

    # --- progress

    def progress(self) -> str:
        """One line."""
        took = time.monotonic() - self._began
        units: dict[str, list[int]] = {}
        for chosen in self.cases:
            done = self.state.progress_of(chosen.name).units
            entry = units.setdefault(chosen.unit, [0, 0])
            entry[0] += done
            entry[1] += done - self._first.get(chosen.name, 0)
        parts = []
        for unit, (total, new) in units.items():
            rate = f" ({_short(new / took)}/s)" if unit == "inputs" else ""
            parts.append(f"{_short(total)} {unit}{rate}")
        left = max(0.0, self._left)
        found = len(self.state.findings)
        return (
            f"{_clock(took)} gone, {_clock(left)} left: {', '.join(parts)}; "
            f"{found} finding{'' if found == 1 else 's'}"
        )

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Cases that failed by the campaign's own fault, and how."""
        return [
            (c.name, self.state.progress_of(c.name).failed)
            for c in self.cases
            if self.state.progress_of(c.name).failed
        ]


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02}"


def _short(number: float) -> str:
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= limit:
            return f"{number / (1e3 if unit == 'k' else limit):.1f}{unit}"
    return f"{number:.0f}"
