"""How long the hand's processes waited for a processor in a run, as data of its recording.

:mod:`~dexkit.conformance.kit.run_queue` measures it. A process that waits could have run: it is
late by that time through no fault of its own. A process that computes does not wait, however long
it takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.row_selection import Rows
from dexkit.conformance.kit.sums import total
from dexkit.hand import Floats, Subject

__all__ = ["ProcessWaits", "Starvation", "SubjectName", "Time", "Waits", "Worst"]

_AROUND = 500_000_000  # ns before and after a place: the kernel counts work in steps of 10 ms
_FULL = 0.98  # part of the time for which processors that are never idle are counted to work


SubjectName = Annotated[str, msgspec.Meta(pattern="^(left|right|robot)$")]
Time = Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)]
"""A time or a duration, nanoseconds or microseconds; 2**62 ns since 1970 is the year 2116."""


class ProcessWaits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long one process waited, in each sample of :class:`Waits`.

    :param name: what it is, for messages.
    :param pid: its id; 0 for the kernel's workers together.
    :param subjects: whose hand it is a part of.
    :param waited_us: by all its threads together since the sample before, microseconds.
    :param longest_us: by the thread that waited longest, likewise.
    """

    name: str
    pid: Time
    subjects: tuple[SubjectName, ...]
    waited_us: list[Time] = []
    longest_us: list[Time] = []

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid})" if self.pid else self.name


@dataclass(frozen=True)
class Worst:
    """The process of a hand that waited most in an interval.

    :param part: of the time, 0 to 1, in which it waited.
    :param longest: of its waits, seconds.
    """

    process: ProcessWaits
    part: float
    longest: float


@dataclass(frozen=True)
class Starvation:
    """How long a hand's processes waited for a processor in an interval.

    :param lost: by how much they were delayed, sample by sample.
    :param longest: of all waits, seconds; both as far as other programs were the reason.
    :param worst: the process that waited most.
    """

    lost: Lateness
    longest: float
    worst: Worst


class Waits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long the processes of a run waited for a processor.

    A wait counts in the sample in which it ended.

    :param begin_ns: log time of offset 0.
    :param t_us: times of the samples, microseconds from there; rising.
    :param busy_us: time that the machine's processors worked since the sample before, all together;
        empty where it is not known.
    :param own_us: that which they worked for these processes.
    :param processors: how many they could use; 0 where it is not known.
    """

    begin_ns: Time = 0
    t_us: list[Time] = []
    processes: list[ProcessWaits] = []
    busy_us: list[Time] = []
    own_us: list[Time] = []
    processors: Annotated[int, msgspec.Meta(ge=0, le=2**16)] = 0

    def __post_init__(self) -> None:
        count = len(self.t_us)
        if any(len(x) != count for p in self.processes for x in (p.waited_us, p.longest_us)):
            raise ValueError("a process that was not looked at each time")
        if not len(self.busy_us) == len(self.own_us) in (0, count):
            raise ValueError("the work of processors was not looked at each time")

    def starvation(self, subject: Subject, begin_ns: int, end_ns: int) -> Starvation | None:
        """How long a hand's processes waited in [begin, end]; None if it is not known."""
        if not self._of(subject):
            return None
        part = self.others(begin_ns, end_ns)
        lost = Lateness.beyond_idle(part * self.delays(subject, begin_ns, end_ns))
        if lost is None:
            return None
        waited = [self._waited(p, begin_ns, end_ns) for p in self._of(subject)]
        longest = part * max(w.longest for w in waited)
        return Starvation(lost, longest, max(waited, key=lambda w: w.part))

    def others(self, begin_ns: int, end_ns: int) -> float:
        """Part of these processes' waits in [begin, end] of which other programs are the cause.

        A hand that keeps all processors busy waits for itself. Where processors work for a part p
        of the time, what needs one waits in proportion to p / (1 - p), as in any queue with
        arrivals at random. So the waits are compared with those that these processes would have
        alone: beside work of their own for 68 % of the time, other programs that take the other
        32 % cause nearly all of them.

        :returns: 0 to 1; 1 where it is not known. Where the number of processors is not known, the
            part of the work that was for other programs, which is less.
        """
        rows, spans = self._there(np.zeros(len(self.t_us)), begin_ns - _AROUND, end_ns + _AROUND)
        if not self.busy_us or not len(rows):
            return 1.0
        busy, own = (
            total(np.array(x, dtype=np.float64)[rows]) for x in (self.busy_us, self.own_us)
        )
        if busy <= 0:
            return 0.0
        whole = self.processors * total(spans[rows])
        if whole <= 0:
            return min(max((busy - own) / busy, 0.0), 1.0)
        return 1.0 - _queue(min(own, busy) / whole) / _queue(busy / whole)

    def delays(self, subject: Subject, begin_ns: int, end_ns: int) -> Floats:
        """By how much a hand's processes were delayed in each sample in [begin, end], seconds.

        The processes wait for each other, so that their waits add up; to no more than the time
        between two samples, unless a single wait was longer, for threads wait side by side, too. A
        sample counts whose waits reach into the interval.
        """
        of_subject = self._of(subject)
        waited = np.sum([p.waited_us for p in of_subject], axis=0, dtype=np.float64)
        longest = np.max([p.longest_us for p in of_subject], axis=0, initial=0)
        rows, spans = self._there(longest, begin_ns, end_ns)
        return np.asarray(np.minimum(waited, spans)[rows] / 1e6)

    def _waited(self, process: ProcessWaits, begin_ns: int, end_ns: int) -> Worst:
        longest = np.array(process.longest_us, dtype=np.float64)
        rows, spans = self._there(longest, begin_ns, end_ns)
        waited = np.minimum(process.waited_us, spans)[rows]
        seconds = max((end_ns - begin_ns) / 1e9, total(spans[rows]) / 1e6, 1e-9)
        return Worst(
            process, total(waited) / 1e6 / seconds, float(longest[rows].max(initial=0)) / 1e6
        )

    def _of(self, subject: Subject) -> list[ProcessWaits]:
        return [p for p in self.processes if subject in p.subjects]

    def _there(self, longest: Floats, begin_ns: int, end_ns: int) -> tuple[Rows, Floats]:
        """The samples that reach into [begin, end], and how long each may have been waited."""
        t = np.array(self.t_us, dtype=np.float64)
        spans = np.maximum(np.diff(t, prepend=0.0), longest)
        begin, end = (begin_ns - self.begin_ns) / 1e3, (end_ns - self.begin_ns) / 1e3
        return np.flatnonzero((t >= begin) & (t - spans <= end)), spans


def _queue(part: float) -> float:
    """How long one waits for a processor, relatively, where they work for this part of the time."""
    part = min(part, _FULL)
    return part / (1.0 - part)
