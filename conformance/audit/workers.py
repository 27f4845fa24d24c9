"""Do tasks in several processes, of which any may die, hang or take too much memory."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

__all__ = ["Pool", "WorkerLost"]

T = TypeVar("T")
R = TypeVar("R")

_LOOK = 0.2  # seconds between looks at the stop request and the time limits
_PATIENCE = 5.0  # seconds for a process that was asked to end
_ENVIRONMENT = {
    # there is a process for each processor
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # glibc would give the memory of each file back to the system, and ask for it page by page for
    # the next one, which takes a tenth of the time
    "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
    "MALLOC_TOP_PAD_": str(16 * 2**20),
}
"""Environment of the processes, unless the user has set it."""


class WorkerLost(str):
    """Text: how the process of a task ended without a result."""

    __slots__ = ()


class _Worker(Generic[T, R]):
    """A process that does one task after the other."""

    def __init__(self, work: Callable[[T], R], memory: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(
            target=_serve, args=(theirs, work, memory), daemon=True
        )
        with _environment():
            self.process.start()
        theirs.close()
        self.task: T | None = None
        self.deadline = float("inf")

    def end(self) -> None:
        self.pipe.close()
        self.process.terminate()
        self.process.join(_PATIENCE)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class Pool(Generic[T, R]):
    """Processes that do tasks.

    A task whose process dies or takes too long is given back as :class:`WorkerLost`; a new process
    does the next one.

    :param work: a function of a module; what it raises ends its process.
    :param jobs: processes; one per processor by default.
    :param seconds: time for one task.
    :param memory: bytes that a process may have; None for any number.
    """

    def __init__(
        self,
        work: Callable[[T], R],
        *,
        jobs: int | None = None,
        seconds: float = float("inf"),
        memory: int | None = None,
    ) -> None:
        self._work, self._seconds, self._memory = work, seconds, memory or 0
        self._jobs = jobs or len(os.sched_getaffinity(0))
        self._workers: list[_Worker[T, R]] = []

    def run(self, tasks: Iterable[T], stop: object = None) -> Iterator[tuple[T, R | WorkerLost]]:
        """Do the tasks; yield each with its result as they are done, in any order.

        :param stop: ends it early when it becomes true; what is not done then is left out.
        """
        waiting = iter(tasks)
        following = next(waiting, None)
        try:
            while not stop:
                while following is not None and (worker := self._idle()) is not None:
                    if self._give(worker, following):
                        following = next(waiting, None)
                busy = {w.pipe: w for w in self._workers if w.task is not None}
                if not busy:
                    return
                for pipe in wait(list(busy), _LOOK):
                    assert isinstance(pipe, Connection)
                    yield self._take(busy.pop(pipe))
                for worker in busy.values():
                    if worker.task is not None and time.monotonic() > worker.deadline:
                        task = worker.task
                        self._remove(worker)
                        yield task, WorkerLost(f"it took longer than {self._seconds:g} s")
        finally:
            for worker in self._workers:
                worker.process.terminate()  # all of them, before any is waited for
            for worker in list(self._workers):
                self._remove(worker)

    def _idle(self) -> _Worker[T, R] | None:
        for worker in self._workers:
            if worker.task is None:
                return worker
        if len(self._workers) < self._jobs:
            self._workers.append(_Worker(self._work, self._memory))
            return self._workers[-1]
        return None

    def _give(self, worker: _Worker[T, R], task: T) -> bool:
        try:
            worker.pipe.send(task)
        except OSError:  # it died while it had nothing to do
            self._remove(worker)
            return False
        worker.task, worker.deadline = task, time.monotonic() + self._seconds
        return True

    def _take(self, worker: _Worker[T, R]) -> tuple[T, R | WorkerLost]:
        task = worker.task
        assert task is not None
        try:
            result: R = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join(_PATIENCE)
            code = worker.process.exitcode
            self._remove(worker)
            how = f"exit code {code}" if code is None or code >= 0 else _signal_name(-code)
            return task, WorkerLost(f"its process died ({how})")
        worker.task = None
        return task, result

    def _remove(self, worker: _Worker[T, R]) -> None:
        self._workers.remove(worker)
        worker.end()


def _signal_name(number: int) -> str:
    with contextlib.suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """New processes have :data:`_ENVIRONMENT`."""
    added = {name: text for name, text in _ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _serve(pipe: Connection, work: Callable[[Any], Any], memory: int) -> None:
    # Ctrl-C goes to every process of the terminal; the first one ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory:
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    with contextlib.suppress(EOFError, OSError):  # the first process has gone
        while True:
            pipe.send(work(pipe.recv()))
