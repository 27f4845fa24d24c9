"""Measure whether the kit's machine had enough processor time for a fair judgement."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left, bisect_right
from itertools import accumulate
from pathlib import Path

from dexkit.clock import RealClock
from dexkit.conformance.kit.stimulus_record import Beats, Stall
from dexkit.threads import Worker

__all__ = ["Heartbeat"]

_BEAT = 0.01  # seconds between heartbeats
_LATE = 0.03  # seconds late that show that the machine is too busy
_PRESSURE = (
    0.9  # part of the time in which some task waits for a processor; a run alone on two: 0.7
)
_PSI = Path("/proc/pressure/cpu")


class Heartbeat:
    """Record the lateness of the kit's timer, and when programs wait for a processor.

    The first, :attr:`beats`, is a measured delay of a program on this machine. The second also uses
    Linux' pressure stall information: the time for which some task could have run but had no
    processor. It does not show which task waited, or for how long: two programs in the background
    can fill it without delaying the hand. :mod:`~dexkit.conformance.kit.verdicts` decides what each
    of them excuses.

    :ivar stalls: when programs waited for most of the time, or this thread was woken late.
    """

    def __init__(self) -> None:
        self.stalls: list[Stall] = []
        self._begin_ns = time.time_ns()
        self._beats: list[tuple[int, int]] = []
        self._late: list[tuple[int, int, int]] = []
        self._stop = threading.Event()
        self._thread = Worker("heartbeat", self._beat)

    def _beat(self) -> None:
        clock = RealClock()
        waited, end, woken = _waited(), time.time_ns(), clock.now()
        while not self._stop.is_set():
            # from the last beat on, so that no pause between two is lost, wherever it comes
            begin, due = end, woken + _BEAT
            clock.sleep_until(due)
            end, woken = time.time_ns(), clock.now()
            late = woken - due
            # a single append, so that another thread never reads half a beat
            self._beats.append(((end - self._begin_ns) // 1000, round(late * 1e6)))
            before, waited = waited, _waited()
            short = (waited - before) * 1e9 > _PRESSURE * (end - begin)
            if late <= _LATE and not short:
                continue
            if self.stalls and begin - self.stalls[-1].end_ns < _BEAT * 1e9:
                self.stalls[-1] = Stall(self.stalls[-1].begin_ns, end)
            else:
                self.stalls.append(Stall(begin, end))

    def note_late(self, begin_ns: int, end_ns: int, seconds: float) -> None:
        """Note that the kit's thread that receives the states was late.

        It can be late where the timer is not, as the interpreter runs one thread at a time.

        :param begin_ns: since when it had not looked for samples.
        :param end_ns: when it looked again.
        :param seconds: by how much this was too long.
        """
        since = self._begin_ns
        self._late.append(
            ((begin_ns - since) // 1000, (end_ns - since) // 1000, round(seconds * 1e6))
        )

    @property
    def beats(self) -> Beats:
        """Lateness of each wake-up of this thread so far, and by how much more the receiving thread
        was late: the kit's jitter.
        """
        beats = self._beats.copy()
        times = [t for t, _ in beats]
        total = [0, *accumulate(late for _, late in beats)]
        for begin, end, late in self._late.copy():
            own = total[bisect_right(times, end)] - total[bisect_left(times, begin)]
            if late > own:
                beats.append((end, late - own))
        beats.sort()
        return Beats(self._begin_ns, [t for t, _ in beats], [late for _, late in beats])

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()


def _waited() -> float:
    """Total seconds for which some task waited for a processor; 0 where it is not available."""
    try:
        text = _PSI.read_text()
        return float(text.partition("total=")[2].split()[0]) / 1e6
    except (OSError, IndexError, ValueError):
        return 0.0
