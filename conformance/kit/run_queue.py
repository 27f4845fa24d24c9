"""Measure how long other processes of this machine wait for a processor.

Linux counts for each thread the nanoseconds in which it could have run, and had no processor: the
second number of ``/proc/PID/task/TID/schedstat``. A thread that sleeps, waits for its device or
computes does not add to it. Where there is no such file (another system, a kernel without it,
another user's process behind ``hidepid``), nothing is measured.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from dexkit.clock import RealClock
from dexkit.conformance.kit.processor_waits import ProcessWaits, Waits
from dexkit.hand import Subject
from dexkit.threads import Worker

__all__ = ["MOST_FILES", "RunQueue", "Watched"]

_SAMPLE = 0.01  # seconds between samples
_SEARCH = 0.2  # seconds between searches for new processes and threads
MOST_FILES = 96
"""Files that are open at the same time, one for each thread: of more threads the rest is not
watched."""
_LONG_US = 20_000
"""Shortest wait of the kernel's workers that counts, microseconds: two samples."""
_PROC = Path("/proc")
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Watched:
    """A process to be watched.

    :param name: what it is, for messages.
    :param pid: its id; 0 for all of the kernel's workers that are bound to no processor: they pass
        on what is written to a terminal.
    :param subjects: whose hand it is a part of.
    """

    name: str
    pid: int
    subjects: tuple[Subject, ...]


class RunQueue:
    """Samples how long processes wait, in a thread of its own; a context manager.

    :param processes: those that run now; asked again and again, as services are restarted.
    """

    def __init__(self, processes: Callable[[], Iterable[Watched]]) -> None:
        self._processes = processes
        self._begin_ns = time.time_ns()
        self._t_us: list[int] = []
        self._watched: dict[Watched, _Threads] = {}
        self._busy_us: list[int] = []
        self._own_us: list[int] = []
        self._usable = os.sched_getaffinity(0) if sys.platform == "linux" else set[int]()
        self._stop = threading.Event()
        self._thread = Worker("run queue", self._run)

    @property
    def waits(self) -> Waits | None:
        """What was measured, once this has ended; None where nothing could be."""
        found = [
            ProcessWaits(
                w.name,
                w.pid,
                tuple(map(str, w.subjects)),
                threads.waited_us,
                threads.longest_us,
            )
            for w, threads in self._watched.items()
            if threads.seen
        ]
        if not found:
            return None
        busy = self._busy_us if any(self._busy_us) else []
        own = self._own_us if busy else []
        return Waits(self._begin_ns, self._t_us, found, busy, own, len(self._usable))

    def _run(self) -> None:
        clock = RealClock()
        due = search = clock.now()
        processors = _Processors(self._usable)
        while not self._stop.is_set():
            if clock.now() >= search:
                search = clock.now() + _SEARCH
                for process in self._processes():
                    if process not in self._watched:
                        kind = _Threads if process.pid else _KernelWorkers
                        self._watched[process] = kind(process.pid, len(self._t_us))
                for threads in self._watched.values():
                    threads.search(MOST_FILES - sum(t.files for t in self._watched.values()))
            own = 0
            for process, threads in self._watched.items():
                ran = threads.sample()
                own += ran if process.pid else 0
            self._own_us.append(own // 1000)
            self._busy_us.append(processors.worked())
            self._t_us.append((time.time_ns() - self._begin_ns) // 1000)
            due = max(due + _SAMPLE, clock.now())
            clock.sleep_until(due)

    def __enter__(self) -> RunQueue:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the measurement. May be called twice."""
        self._stop.set()
        self._thread.join()
        for threads in self._watched.values():
            threads.close()


class _Threads:
    """The threads of one process.

    :param before: samples before this process was known.
    """

    def __init__(self, pid: int, before: int) -> None:
        self.waited_us = [0] * before
        self.longest_us = [0] * before
        self.seen = False
        self._folder = _PROC / str(pid) / "task"
        self._files: dict[str, int] = {}
        self._last: dict[str, tuple[int, int]] = {}
        self._left_out: set[str] = set()
        self._searched = False

    @property
    def files(self) -> int:
        """Number of open files."""
        return len(self._files)

    def search(self, most: int) -> None:
        """Find new threads, and open so many files at most; the rest is left out for good."""
        new = self._new()
        for thread in new[: max(most, 0)]:
            with contextlib.suppress(OSError):
                path = self._folder / thread / "schedstat"
                self._files[thread] = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
                if self._searched:  # it has begun since then
                    self._last[thread] = 0, 0
        self._left_out.update(new[max(most, 0) :])
        self._searched = True

    def _new(self) -> list[str]:
        """The threads that are not watched yet."""
        try:
            threads = os.listdir(self._folder)
        except OSError:  # it has ended
            return []
        return [t for t in threads if t not in self._files and t not in self._left_out]

    def sample(self) -> int:
        """Add how long the threads have waited since the last sample; return how long they ran, ns,
        all together.
        """
        waited = longest = ran = 0
        for thread, file in list(self._files.items()):
            try:
                ran_ns, ns = map(int, os.pread(file, 80, 0).split()[:2])
            except (OSError, ValueError):  # the thread has ended
                os.close(self._files.pop(thread))
                self._last.pop(thread, None)
                continue
            self.seen = True
            # what one waited that was there before is not of this time
            ran_before, before = self._last.get(thread, (ran_ns, ns))
            self._last[thread] = ran_ns, ns
            ran += ran_ns - ran_before
            new = ns - before
            waited += new
            longest = max(longest, new)
        self.waited_us.append(waited // 1000)
        self.longest_us.append(longest // 1000)
        return ran

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            os.close(file)
        self._files.clear()


class _Processors:
    """The work of the processors that this process may use, as the kernel counts it.

    The hand's processes are started by this one, and may use the same.

    :param mine: their numbers.
    """

    def __init__(self, mine: Iterable[int]) -> None:
        self._names = {f"cpu{number}" for number in mine}
        self._count = 0
        self._last: int | None = None

    def worked(self) -> int:
        """Microseconds that they have worked since the last call; counted every tenth call only,
        as the file is long on a machine with many processors.
        """
        self._count += 1
        if self._count % 10 != 1:
            return 0
        try:
            rows = [line.split() for line in (_PROC / "stat").read_text().splitlines()]
            works = [list(map(int, row[1:9])) for row in rows if row and row[0] in self._names]
        except (OSError, ValueError):
            return 0
        # the fourth and fifth are idle, and waiting for a disk
        total = sum(sum(work) - sum(work[3:5]) for work in works)
        before, self._last = self._last, total
        return 0 if before is None else round((total - before) * 1e6 / _TICKS)


class _KernelWorkers(_Threads):
    """The kernel's workers that are bound to no processor.

    They do other work as well, and one of them at a time passes on what is written to a line. So
    only the longest wait counts, and only where it is so long that a line shows it.
    """

    def __init__(self, pid: int, before: int) -> None:
        super().__init__(pid, before)
        self._folder = _PROC

    def sample(self) -> int:
        """Add the longest wait of one of them."""
        ran = super().sample()
        if self.longest_us[-1] < _LONG_US:
            self.longest_us[-1] = 0
        self.waited_us[-1] = self.longest_us[-1]
        return ran

    def _new(self) -> list[str]:
        found: list[str] = []
        for name in super()._new():
            if not name.isdecimal():
                continue
            with contextlib.suppress(OSError, ValueError):
                is_one = (_PROC / name / "comm").read_text().startswith("kworker/u")
                (found.append if is_one else self._left_out.add)(name)
        return found
