"""Replay recordings: publish messages at their recorded times, with absolute deadlines.

Deadlines count from the start of a pass, so a late message never delays the next. Gaps are kept
unless capped. All messages are loaded beforehand (about 150 bytes each beside the payload), so that
no chunk is decompressed between two deadlines.

**After a pause of the player itself** (stopped, suspended, not scheduled; more than
:data:`~dexkit.command_age.PAUSE`) messages that became due are not sent at once: they would carry
the present time, and no hand could detect that they are stale. Instead all later deadlines shift,
and replay continues where it paused. The same happens when publishing itself cannot keep up.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from dexkit.clock import Clock, RealClock, wait_until
from dexkit.command_age import PAUSE, PauseWatch
from dexkit.errors import UsageError
from dexkit.traces.clock_steps import refuse_clock_steps
from dexkit.traces.names import select_topics
from dexkit.traces.reader import Trace, TraceMessage

__all__ = ["PlayStats", "Player"]

#: Seconds before a deadline at which waiting turns into polling the clock.
SPIN = 0.0002
# Seconds of one sleep, so that a stop is noticed within a long gap.
_MAX_SLEEP = 0.05
# Errors kept for the percentiles; older ones of a long loop are forgotten.
_MAX_ERRORS = 1_000_000


@dataclass(frozen=True)
class PlayStats:
    """Counters of a replay. Errors are seconds from the deadline to the call of ``publish``.

    :param sent: messages published.
    :param passes: complete passes over the recording.
    :param stopped: it was stopped before its end.
    :param duration: seconds from the first deadline to the end.
    :param pauses: times that the player itself was paused.
    """

    sent: int
    passes: int
    stopped: bool
    duration: float
    error_p50: float
    error_p99: float
    error_max: float
    pauses: int = 0


class Player:
    """Plays topics of a recording.

    :param topics: which, in any spelling, patterns allowed; None: the command topics, those
        that end in ``/cmd``.
    :param speed: 2.0 plays in half the time.
    :param loop: start over at the end, until stopped.
    :param max_gap: longest pause between two messages, seconds of recorded time; None keeps all.
    :raises UsageError: ``speed`` or ``max_gap`` is not positive, a topic is missing, or nothing
        is to be played.
    """

    def __init__(
        self,
        trace: Trace,
        topics: Iterable[str] | None = None,
        *,
        speed: float = 1.0,
        loop: bool = False,
        max_gap: float | None = None,
    ) -> None:
        if not 0 < speed < float("inf"):
            raise UsageError(f"speed must be a positive number, not {speed}")
        if max_gap is not None and not max_gap > 0:
            raise UsageError(f"the longest gap must be positive, not {max_gap}")
        if topics is None:
            picked = [t for t in trace.topics if t.endswith("/cmd")]
            hint = f"name topics to play; there are: {', '.join(trace.topics) or 'none'}"
            if not picked:
                raise UsageError(f"{trace.path.name} has no command topics", hint=hint)
        else:
            picked, missing = select_topics(trace.topics, topics)
            if missing:
                raise UsageError(
                    f"{trace.path.name} has no topic {', '.join(missing)}",
                    hint=f"it has: {', '.join(trace.topics) or 'none'}",
                )
        refuse_clock_steps(trace.path, trace.clock_steps)
        columns = trace.load(picked)
        self.topics = {topic: c.type_name for topic, c in columns.items()}
        self.loop = loop
        self.sent = 0
        self._messages = [
            TraceMessage(topic, c.type_name, int(log), int(publish), data)
            for topic, c in columns.items()
            for log, publish, data in zip(c.log_time_ns, c.publish_time_ns, c.payloads, strict=True)
        ]
        if not self._messages:
            raise UsageError(f"{trace.path.name} has no messages on {', '.join(picked)}")
        self._messages.sort(key=lambda m: m.log_time_ns)
        gaps = np.diff([m.log_time_ns for m in self._messages]) / 1e9
        if max_gap is not None:
            gaps = np.minimum(gaps, max_gap)
        offsets = np.concatenate(([0.0], np.cumsum(gaps))) / speed
        self._offsets: list[float] = offsets.tolist()
        # the pause between the last message of a pass and the first of the next
        self._pause = float(np.median(gaps)) / speed if len(gaps) else 1.0 / speed

    def __len__(self) -> int:
        """Messages of one pass."""
        return len(self._messages)

    @property
    def duration(self) -> float:
        """Seconds of one pass at the chosen speed."""
        return self._offsets[-1]

    @property
    def offsets(self) -> list[float]:
        """Deadline of each message of a pass, seconds from its start."""
        return list(self._offsets)

    def play(
        self,
        publish: Callable[[TraceMessage], object],
        clock: Clock | None = None,
        stop: threading.Event | None = None,
        paused: Callable[[float], object] = lambda seconds: None,
    ) -> PlayStats:
        """Call ``publish`` with each message at its time.

        :param stop: ends the play-back when set; nothing is published after it is noticed,
            which takes at most 50 ms.
        :param paused: called after each pause of the player, with its length. The replay continues
            when it returns.
        """
        clock = clock if clock is not None else RealClock()
        stop = stop if stop is not None else threading.Event()
        errors: deque[float] = deque(maxlen=_MAX_ERRORS)
        self.sent = 0
        passes = 0
        line = _TimeLine(clock, stop, paused)
        started = clock.now()
        while not stop.is_set():
            for offset, message in zip(self._offsets, self._messages, strict=True):
                late = line.reach(offset)
                if late is None:
                    break
                errors.append(late)
                publish(message)
                self.sent += 1
            else:
                passes += 1
                if not self.loop:
                    break
                line.start += self.duration + self._pause
        p50, p99, worst = np.percentile(errors, (50, 99, 100)) if errors else (0.0, 0.0, 0.0)
        return PlayStats(
            sent=self.sent,
            passes=passes,
            stopped=stop.is_set() and not (passes and not self.loop),
            duration=clock.now() - started,
            error_p50=float(p50),
            error_p99=float(p99),
            error_max=float(worst),
            pauses=line.pauses,
        )


class _TimeLine:
    """Deadlines of the messages of a pass; a pause of the player shifts them.

    :ivar start: when the pass began, or would have without pauses.
    """

    def __init__(
        self, clock: Clock, stop: threading.Event, paused: Callable[[float], object]
    ) -> None:
        self._clock = clock
        self._stop = stop
        self._paused = paused
        self._watch = PauseWatch(clock)
        self._watch.restart()
        self._seen = self.start = clock.now()
        self.pauses = 0

    def reach(self, offset: float) -> float | None:
        """Wait for a message's time; seconds by which it is late, None when stopped."""
        clock, stop = self._clock, self._stop
        while True:
            self._notice_pause()
            left = self.start + offset - clock.now()
            if stop.is_set():
                return None
            if left < -PAUSE:  # there was no pause, but publishing does not keep up
                self.start -= left
                return 0.0
            if left <= 0:
                return -left
            if left > _MAX_SLEEP:
                clock.sleep_until(clock.now() + _MAX_SLEEP / 2)
            else:
                wait_until(clock, self.start + offset, spin=SPIN)

    def _notice_pause(self) -> None:
        """Detect a pause and shift the remaining deadlines by it."""
        away = self._watch.measure_pause()
        if away:
            self.pauses += 1
            self._paused(away)
            self._watch.restart()
        now = self._clock.now()
        if away:  # not by ``away``: in suspend, the clock of the deadlines stops as well
            self.start += now - self._seen
        self._seen = now
