"""Do the tasks of an audit on a Ray cluster: the same function, one file a task.

The nodes need dexkit in the same version, and reach the files under the same paths or URLs. A task
whose process or node dies is done again on another one; its record is taken once, by this process.
"""

from __future__ import annotations

import contextlib
import os
import resource
import secrets
import signal
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from dexkit.conformance.audit.examine import Task, examine, settings_key
from dexkit.conformance.audit.records import EpisodeRecord
from dexkit.conformance.audit.workers import WorkerLost
from dexkit.errors import ConformanceError, UsageError
from dexkit.escaping import one_line
from dexkit.redaction import redact

if TYPE_CHECKING:
    from dexkit.conformance.audit.audit import Limits

__all__ = ["THIS_MACHINE", "Cluster"]

THIS_MACHINE = "local"
"""The address of a cluster of this machine alone, which ends with the audit."""
_HAS_TOKENS = (2, 52)  # the version of Ray that learned to ask for one
_PATIENCE = 10.0  # seconds for the head node to answer
_LOOK = 0.2  # seconds between looks at the stop request
_AGAIN = 3  # times that a task is done again whose process or node died
_AHEAD = 3  # tasks that are handed to the cluster, for each of its processors
_FEWEST = 16  # likewise, in all


class Cluster:
    """A connection to a Ray cluster; ends with :meth:`close`, or when tasks have been run.

    :param address: ``host:port`` of its head node, ``auto`` for the one that runs on this machine,
        ``local`` for a new one on this machine.
    :param limits: what one file may take. Time is taken by the task's own process, so that a task
        that waits for a processor does not lose any.
    :raises UsageError: Ray is not installed, or is too old for a cluster of its own.
    :raises ConformanceError: there is no such cluster.

    Whoever reaches a cluster can run code on it, and Ray's servers listen on every address of the
    machine, also for a cluster of this machine alone. So that one has a token, drawn for the audit.
    """

    def __init__(self, address: str, limits: Limits) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to anybody
        local = address == THIS_MACHINE
        if local:  # before Ray is imported, which reads it then; its servers inherit it
            os.environ["RAY_AUTH_MODE"] = "token"
            os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        try:
            import ray
        except ImportError:
            raise UsageError("--ray needs Ray", hint="pip install 'dexkit[ray]'") from None
        self._ray: Any = ray
        if local and tuple(map(int, ray.__version__.split(".")[:2])) < _HAS_TOKENS:
            raise UsageError(
                f"a cluster of Ray {ray.__version__} would run code for every network",
                hint="pip install 'ray>=2.52', or --jobs instead of --ray local",
            )
        try:
            _check_address(address, ray)  # Ray itself would try for minutes
            ray.init(
                address,
                log_to_driver=False,
                logging_level="ERROR",
                include_dashboard=False if local else None,
            )
        except (OSError, ValueError, RuntimeError) as error:
            raise ConformanceError(
                f"no Ray cluster at {redact(address, address)}: "
                f"{one_line(redact(error, address), 300)}",
                hint="'ray start --head' starts one; --ray local starts one for this audit only",
            ) from error
        self._examine = ray.remote(num_cpus=1, max_retries=_AGAIN)(_examine)
        self._limits = limits

    def run(
        self, tasks: Iterable[Task], stop: object
    ) -> Iterator[tuple[Task, list[EpisodeRecord] | WorkerLost]]:
        """Examine episodes until a stop request is true; yields each once, in any order."""
        ray, waiting = self._ray, iter(tasks)
        pending: dict[Any, Task] = {}
        exhausted = False
        try:
            while not stop:
                # the number of processors changes as nodes come and go
                room = max(_FEWEST, _AHEAD * int(ray.cluster_resources().get("CPU", 1)))
                while not exhausted and len(pending) < room:
                    task = next(waiting, None)
                    if task is None:
                        exhausted = True
                        break
                    settings = settings_key(task.cameras)
                    reference = self._examine.remote(
                        task, settings, self._limits.seconds, self._limits.memory
                    )
                    pending[reference] = task
                if not pending:
                    return
                done, _ = ray.wait(list(pending), num_returns=1, timeout=_LOOK)
                for reference in done:
                    yield pending.pop(reference), self._result(reference)
        finally:
            for reference in pending:
                with contextlib.suppress(Exception):  # a cluster that has gone needs no cancelling
                    ray.cancel(reference, force=True)
            self.close()

    def _result(self, reference: Any) -> list[EpisodeRecord] | WorkerLost:
        ray = self._ray
        try:
            found: list[EpisodeRecord] | WorkerLost = ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            return WorkerLost(
                f"a node of the cluster cannot do it: {one_line(str(error.cause), 500)}"
            )
        except ray.exceptions.RayError as error:
            # its process or node died, and did again each time
            return WorkerLost(f"its process died ({type(error).__name__})")
        return found

    def close(self) -> None:
        """Leave the cluster; one that was made for this audit ends."""
        self._ray.shutdown()


def _check_address(address: str, ray: Any) -> None:
    """Raise OSError if nothing answers at a ``host:port``, or where Ray looks for it."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    host = host.strip("[]")
    socket.create_connection((host, int(port)), _PATIENCE).close()
    if address.startswith("ray://") or host not in ("localhost", "127.0.0.1", "::1"):
        return
    # a driver of Ray replaces these names by an address that other machines reach
    host = ray.util.get_node_ip_address()
    try:
        socket.create_connection((host, int(port)), _PATIENCE).close()
    except OSError as error:
        raise OSError(
            f"Ray looks for it at {host}:{port}, where nothing answers; start the head node with "
            f"--node-ip-address={host}, or with 127.0.0.2 and give that"
        ) from error


class _TooLong(BaseException):
    """Ends a task; no handler of errors catches it."""


def _examine(
    task: Task, settings: str, seconds: float, memory: int
) -> list[EpisodeRecord] | WorkerLost:
    """Examine episodes in a process of the cluster.

    :param settings: those of the audit; a node with another dexkit would judge differently.
    """
    mine = settings_key(task.cameras)
    if mine != settings:
        raise RuntimeError(
            f"its dexkit or catalogue differs from the audit's ({mine}, not {settings})"
        )

    def too_long(signum: int, frame: FrameType | None) -> None:
        raise _TooLong

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _data() + memory  # Ray itself has reserved some
    before = signal.signal(signal.SIGALRM, too_long)
    try:
        if hard == resource.RLIM_INFINITY or limit < hard:
            resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
        signal.setitimer(signal.ITIMER_REAL, seconds)
        return examine(task)
    except _TooLong:
        return WorkerLost(f"it took longer than {seconds:g} s")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _data() -> int:
    """Bytes of memory that count for the limit, of this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    return 0
