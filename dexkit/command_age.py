"""Estimate the age of received samples, and detect pauses of a program's own loops.

A process may be paused at any point (stopped, suspended, swapped out, in a debugger, not
scheduled), and what was sent to it meanwhile waits in the socket. After a pause, nothing that may
have been sent before its end moves a hand; without one, neither does a command that is more than
:data:`PAUSE` seconds older than its writer's commands usually are.

:class:`PauseWatch` detects pauses, :class:`SampleAges` estimates how old a sample is, and
:class:`WriteDeadline` keeps a driver from writing a command that it got before a pause. None has a
thread or DDS. Times are those of :meth:`dexkit.clock.Clock.since_boot`, which go on while the
machine is suspended and do not jump with the wall clock.

**How old a sample is.** A sample carries the time at which it was written, on its writer's clock.
How that clock relates to ours is unknown, it may be hours off; but reception minus source timestamp
is that offset plus the sample's latency, so the least difference seen of a writer (its *baseline*)
is the offset plus its least latency, and what a sample exceeds it by is its age. The baseline moves
by
:data:`DRIFT` to follow clocks that run differently, and has to be confirmed anew after
:data:`FORGET` seconds without a sample.

**What is known after a pause.** With a baseline that was confirmed before, each single sample:
it counts if it was sent :data:`SETTLE` seconds after the end of the pause or later. That time is
for what the estimate may be wrong by: the least latency, and the drift. Without one, the first
samples prove nothing, they may have waited in the socket. A baseline is *confirmed* by two samples
that lie ``SETTLE`` seconds or more apart on both clocks alike: while a queue is being emptied,
source timestamps run faster than ours. Samples of a writer that is not confirmed count
:data:`QUIET` seconds after the pause, when the socket has long been emptied.

**When the writer's clock jumps** its old baseline is worthless, and a virtual machine that was
paused with all its clocks sees the same. The writer counts again when its new baseline is
confirmed, or after :data:`QUIET` seconds; so does one that is late after a long silence (its
machine was suspended). Timestamps that do not go on are no clock: such a writer is obeyed as one
without a baseline.

A latency that never was less is not seen: a client whose every sample comes 2.5 s late from the
first one on looks like one whose clock is 2.5 s behind.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass

from dexkit.clock import Clock
from dexkit.errors import HandTimeout

__all__ = [
    "DRIFT",
    "FORGET",
    "LONG_PAUSE",
    "PAUSE",
    "QUIET",
    "SETTLE",
    "PauseWatch",
    "SampleAges",
    "WriteDeadline",
]

PAUSE = 0.25
"""Seconds: a loop that did not run for longer had a pause, and an older command is stale."""
LONG_PAUSE = 1.0
"""Seconds: the command time-out of the family. After a longer pause the hands have long stopped by
themselves, and a program with a schedule of its own moves them on only when it is asked to."""
SETTLE = 0.2
"""Seconds by which a baseline is confirmed, and that a command must have been sent after the end
of a pause. Covers a least latency of 0.14 s with the drift of a minute of silence."""
QUIET = 1.0
"""Seconds after a pause until samples count whose age cannot be determined."""
DRIFT = 500e-6
"""Most that a clock runs fast or slow: what NTP slews by (RFC 5905: 500 PPM)."""
FORGET = 60.0
"""Seconds without a sample after which a baseline is not trusted: drift adds up to 0.03 s."""

_IN_PACE = 0.02  # seconds by which two samples' latencies may differ to confirm a baseline
_JUMP = 0.05  # seconds; a timestamp that goes back by more, or a baseline that falls by more
_REPEATS = (
    0.1  # seconds; a clock that does not advance for longer is not used. Coarse ones tick faster
)
_HOPELESS = 10.0  # seconds of lateness that no network has; then the timestamps are no clock
_WRITERS = 64  # remembered; the one whose last sample is oldest is forgotten first


class PauseWatch:
    """Detects pauses of a loop. For one thread, but for :meth:`away`.

    :param clock: :meth:`~dexkit.clock.Clock.since_boot` of it is used.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last: float | None = None  # nothing is a pause before the first look

    def restart(self) -> None:
        """Do not count the time since the last measurement as a pause."""
        self._last = self._clock.since_boot()

    def away(self) -> float:
        """Seconds since the last measurement or restart, for another thread; 0 before the first."""
        last = self._last
        return 0.0 if last is None else self._clock.since_boot() - last

    def measure_pause(self, allowed: float = PAUSE) -> float:
        """Seconds since the last call if they are more than ``allowed``; else 0."""
        now = self._clock.since_boot()
        last, self._last = self._last, now
        if last is None or now - last <= allowed:
            return 0.0
        return now - last


class WriteDeadline:
    """The time that a driver has from getting a command to writing it: :data:`PAUSE`.

    :param clock: as for :class:`PauseWatch`.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since = clock.since_boot()

    def check(self) -> None:
        """To be called right before the command is written.

        :raises HandTimeout: it took longer than :data:`PAUSE` to get there; nothing was written.
        """
        away = self._clock.since_boot() - self._since
        if away > PAUSE:
            raise HandTimeout(
                f"this program was paused for {away:.2f} s before a command was written; "
                "it was not sent",
                hint="was it stopped or suspended, or is the machine too busy?",
            )


@dataclass(slots=True)
class _Writer:
    """Clock and latency of one writer. Times are ours, except ``source`` and ``began_source``.

    :ivar offset: least reception minus source; ``at``: when that was seen.
    :ivar source: newest source timestamp, ``moved``: when it last changed; ``received``: last
        sample.
    :ivar began: since when the baseline is being confirmed, ``began_source`` and
        ``began_offset``: the sample of then.
    :ivar confirmed: the baseline can be trusted.
    :ivar doubted: since when a clock that was trusted has been in doubt, because it jumped.
    :ivar late: since when every sample was late.
    :ivar clockless: its timestamps are not usable.
    """

    offset: float
    at: float
    source: float
    moved: float
    received: float
    began: float
    began_source: float
    began_offset: float
    confirmed: bool = False
    doubted: float | None = None
    late: float | None = None
    clockless: bool = False

    def begin(self, offset: float, source: float, now: float) -> None:
        """The baseline is to be confirmed from here on."""
        self.began, self.began_source, self.began_offset = now, source, offset
        self.confirmed = False


class SampleAges:
    """Estimates the age of samples from any number of writers. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._writers: OrderedDict[int, _Writer] = OrderedDict()
        self._resumed = -math.inf

    def resumed(self, now: float) -> None:
        """A pause has ended."""
        with self._lock:
            self._resumed = max(self._resumed, now)
            for number in [n for n, w in self._writers.items() if not (w.confirmed or w.clockless)]:
                del self._writers[number]  # nothing of it can be compared with what comes now

    def age(self, writer: int, source_ns: int, now: float) -> float:
        """Seconds since a sample was sent; infinite if it may have been sent before a pause ended.

        To be called for each sample, in the order of their reception.

        :param writer: whose sample it is, any number of its own.
        :param source_ns: its source timestamp.
        :param now: when it was received, or later.
        """
        with self._lock:
            known = self._find(writer, source_ns * 1e-9, now)
            age = self._age(known, source_ns * 1e-9, now)
            since = now - self._resumed
            if known.clockless or not known.confirmed:
                return age if since > QUIET else math.inf
            return age if since - age > SETTLE else math.inf

    def _find(self, writer: int, source: float, now: float) -> _Writer:
        known = self._writers.get(writer)
        if known is None:
            offset = now - source
            known = _Writer(offset, now, source, now, now, now, source, offset)
            known.clockless = source <= 0
            self._writers[writer] = known
        self._writers.move_to_end(writer)
        if len(self._writers) > _WRITERS:
            self._writers.popitem(last=False)
        return known

    def _age(self, known: _Writer, source: float, now: float) -> float:
        """Seconds beyond the baseline, which is kept up to date; infinite while it is in doubt."""
        self._check_clock(known, source, now)
        before, known.source = known.source, source
        silent, known.received = now - known.received > FORGET, now
        if known.clockless:
            return 0.0
        offset = now - source
        drift = DRIFT * (now - known.at)
        beyond = offset - known.offset - drift
        ahead = known.offset - drift - offset
        back = before - source
        if max(back, ahead) > _JUMP or (silent and beyond > PAUSE):
            # its clock was set, its samples until now were late, or its machine was suspended
            if known.confirmed and (back > _JUMP or max(ahead, beyond) > PAUSE):
                known.doubted = now
            known.offset, known.at = offset, now
            known.begin(offset, source, now)
        elif beyond < 0:
            known.offset, known.at = offset, now
        if silent:
            known.begin(offset, source, now)
        if not known.confirmed:
            self._confirm(known, offset, source, now)
        if known.doubted is not None and now - known.doubted > QUIET:
            known.doubted = None  # it jumps again and again
        age = max(0.0, offset - known.offset - DRIFT * (now - known.at))
        if age <= PAUSE:
            known.late = None
        elif known.late is None:
            known.late = now
        elif age > _HOPELESS and now - known.late > _HOPELESS:
            known.clockless = True
        return age if known.doubted is None else math.inf

    @staticmethod
    def _check_clock(known: _Writer, source: float, now: float) -> None:
        """Note when the timestamps do not advance; they are then not used."""
        if source != known.source:
            known.moved = now
        elif now - known.moved > _REPEATS:
            known.clockless = True

    @staticmethod
    def _confirm(known: _Writer, offset: float, source: float, now: float) -> None:
        if offset < known.began_offset - _IN_PACE:
            known.begin(offset, source, now)
        elif (
            offset <= known.began_offset + _IN_PACE
            and now - known.began >= SETTLE
            and source - known.began_source >= SETTLE - _IN_PACE
        ):
            known.confirmed, known.doubted = True, None
