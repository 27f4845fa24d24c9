"""Count samples that are missing in a recording, as far as the recorder can detect; no I/O.

What is counted:

* *datagrams* that the kernel dropped because the socket's receive buffer was full. An exact count,
  but not per topic. CycloneDDS 0.10 gives readers no sequence numbers, and its "sample lost" status
  does not count gaps in them (its source raises it only for samples that are too old for their
  reader).
* samples *refused* because the reader's queue was full. An exact count per topic.
* samples that are *probably missing* on each topic: when datagrams were dropped, gaps in a writer's
  source timestamps are divided by its period. An estimate.
* *gaps* of a state topic that comes at a steady rate: by the robot's own clock where the message
  has one (``tick``), else by the writer's source timestamps. An estimate that does not tell samples
  lost on the network from a paused writer.

The readers are best-effort, so that the recorder never slows down the writers.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from datetime import datetime, timezone

__all__ = ["PAUSE", "Gaps", "Losses", "Pause"]

#: Seconds between two iterations of the recorder's loop from which on it counts as a pause.
PAUSE = 0.5
# A gap is longer than so many periods; intervals before the period estimate is used.
_GAP = 2.5
_MIN_INTERVALS = 8
# Share of a new interval in the running period.
_SHARE = 1 / 16
# Seconds after a drop within which its gap may be detected, since the next sample must arrive
# first.
_GAP_WINDOW = 5.0
_MAX_PAUSES = 20  # pauses that are kept
_MAX_WRITERS = 1024  # whose gaps are looked for
# Intervals from which a writer's period is learnt, and how much those of one period differ.
_LEARN = 32
_ALIKE = 0.3
# An interval is long from so many periods on; up to so many it compensates a late sample.
_LATE, _EARLY = 1.6, 0.6


@dataclass(frozen=True)
class Pause:
    """A time in which the recorder did not run: stopped, suspended, or not scheduled.

    :param end_ns: wall clock.
    """

    seconds: float
    end_ns: int

    def __str__(self) -> str:
        begin = datetime.fromtimestamp(self.end_ns / 1e9 - self.seconds, timezone.utc)
        return (
            f"the recorder did not run for {self.seconds:.1f} s from {begin:%Y-%m-%d %H:%M:%S} UTC"
        )


class _Stream:
    """The samples of one writer."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.last = 0
        self.intervals = 0
        self.period = 0.0
        self.missing = 0
        self.holes = 0


@dataclass(frozen=True)
class Gaps:
    """The gaps of one topic.

    :param count: how many.
    :param missing: samples that should have come in them, about.
    :param longest: seconds.
    """

    count: int
    missing: int
    longest: float


class _Pace:
    """Finds gaps in the samples of a periodic writer.

    A sample that is written late is followed by an apparently early one, and nothing is missing;
    after a gap the next sample comes a whole period later. The period is that of the shortest
    common
    intervals, so that it is right even when half of the samples are missing from the start.
    """

    def __init__(self) -> None:
        self.count = 0
        self.missing = 0
        self.longest = 0  # ns
        self._last = 0
        self._first: list[int] = []
        self._period = 0.0  # ns; 0 while it is not known, NaN for an irregular writer
        self._length = 0  # ns of a long interval, with the short ones that follow it
        self._parts = 0  # intervals in it

    def sample(self, at_ns: int) -> None:
        """Note a sample by the time at which it was written."""
        passed, self._last = at_ns - self._last, at_ns
        if passed <= 0 or passed == at_ns:  # the first sample, or a clock that was set
            self._length = 0
        elif not self._period:
            self._learn(passed)
        elif self._period == self._period:  # not NaN
            self._judge(passed)

    def _learn(self, passed: int) -> None:
        self._first.append(passed)
        if len(self._first) < _LEARN:
            return
        low = sorted(self._first)[_LEARN // 4]
        alike = [i for i in self._first if abs(i - low) <= _ALIKE * low]
        regular = len(alike) >= _LEARN // 4
        self._period = sum(alike) / len(alike) if regular else float("nan")
        first, self._first = self._first, []
        for interval in first if regular else ():
            self._judge(interval)

    def _judge(self, passed: int) -> None:
        periods = passed / self._period
        if periods < _EARLY and self._length:
            self._length += passed
            self._parts += 1
            return
        if self._length and (lacking := round(self._length / self._period) - self._parts) > 0:
            self.count += 1
            self.missing += lacking
            self.longest = max(self.longest, self._length)
        self._length = 0
        if periods > _LATE:
            self._length, self._parts = passed, 1
        elif abs(periods - 1) < _ALIKE:
            self._period += (passed - self._period) / 64


class Losses:
    """Counts lost samples.

    :ivar datagrams: dropped by the kernel.
    :ivar lost: samples by topic, by the status of DDS.
    :ivar refused: samples by topic.
    :ivar pauses: the first ones; ``paused`` counts all.
    """

    def __init__(self) -> None:
        self.datagrams = 0
        self.lost: dict[str, int] = {}
        self.refused: dict[str, int] = {}
        self._paces: dict[tuple[str, int], _Pace] = {}
        self._gaps_reported: dict[str, Gaps] = {}
        self.pauses: list[Pause] = []
        self.paused = 0
        self._missing_at_drops: Counter[str] = Counter()
        self._holes = 0
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._last_loop: float | None = None
        self._until = float("-inf")

    def note_loop(self, now: float, wall_ns: int) -> Pause | None:
        """Note one iteration of the recorder's loop.

        :param now: seconds of a clock that counts suspension, too.
        :returns: the pause that has just ended, if there was one.
        """
        before, self._last_loop = self._last_loop, now
        if before is None or now - before < PAUSE:
            return None
        pause = Pause(now - before, wall_ns)
        self.paused += 1
        if len(self.pauses) < _MAX_PAUSES:
            self.pauses.append(pause)
        return pause

    def note_sample(self, topic: str, writer: int, source_ns: int) -> None:
        """Note a received sample. Those of one writer must come in order."""
        stream = self._streams.get((topic, writer))
        if stream is None:
            if len(self._streams) >= 4096:  # clients that come and go
                self._streams.clear()
            stream = self._streams[topic, writer] = _Stream(topic)
        before, stream.last = stream.last, source_ns
        passed = source_ns - before
        # the first sample, one without a time, or a clock that was set
        if before <= 0 or passed <= 0:
            return
        stream.intervals += 1
        known = stream.intervals > _MIN_INTERVALS
        if known and passed > _GAP * stream.period:
            stream.missing += round(passed / stream.period) - 1
            stream.holes += 1
        else:
            share = _SHARE if known else 1 / stream.intervals
            stream.period += (passed - stream.period) * share

    def note_state(self, topic: str, writer: int, at_ns: int) -> None:
        """Note a received sample of a state topic, which comes at a steady rate.

        :param at_ns: when it was written, by a clock of the writer's.
        """
        pace = self._paces.get((topic, writer))
        if pace is None:
            if len(self._paces) >= _MAX_WRITERS:
                return
            pace = self._paces[topic, writer] = _Pace()
        pace.sample(at_ns)

    @property
    def gaps(self) -> dict[str, Gaps]:
        """Gaps by topic, without what the kernel dropped."""
        found: dict[str, Gaps] = {}
        for (topic, _), pace in sorted(self._paces.items()):
            old = found.get(topic, Gaps(0, 0, 0.0))
            found[topic] = Gaps(
                old.count + pace.count,
                old.missing + pace.missing,
                max(old.longest, pace.longest * 1e-9),
            )
        dropped = self.dropped_by_topic
        left = {
            topic: replace(gaps, missing=gaps.missing - dropped.get(topic, 0))
            for topic, gaps in found.items()
        }
        return {topic: gaps for topic, gaps in left.items() if gaps.missing > 0}

    def update(
        self,
        now: float,
        dropped: int,
        refused: dict[str, int],
        lost: dict[str, int] | None = None,
    ) -> bool:
        """Update the counters; call it periodically.

        :param dropped: datagrams dropped since the last call.
        :param refused: samples refused in total, by topic.
        :param lost: samples lost in total by the status of DDS, by topic.
        :returns: whether anything was lost since the last call.
        """
        news = dropped > 0
        if (lost or {}) != self.lost:
            self.lost, news = dict(lost or {}), True
        if (gaps := self.gaps) != self._gaps_reported:
            self._gaps_reported, news = gaps, True
        self.datagrams += dropped
        if dropped:
            self._until = now + _GAP_WINDOW
        if refused != self.refused:
            self.refused, news = dict(refused), True
        for stream in self._streams.values():
            if stream.missing and now <= self._until:
                self._missing_at_drops[stream.topic] += stream.missing
                self._holes += stream.holes
                news = True
            stream.missing = stream.holes = 0
        return news

    @property
    def dropped_by_topic(self) -> dict[str, int]:
        """Estimated missing samples, by topic.

        In total at most the dropped datagrams, plus one for each gap: CycloneDDS 0.10
        does not deliver the first sample of a reliable writer after one (measured).
        """
        total = self._missing_at_drops.total()
        scale = min(1.0, (self.datagrams + self._holes) / total) if total else 0.0
        return {topic: round(n * scale) for topic, n in sorted(self._missing_at_drops.items())}

    def __bool__(self) -> bool:
        return bool(self.datagrams or sum(self.refused.values()) or sum(self.lost.values()))

    def status(self) -> str:
        """The losses in a few words, for a status line; empty when there are none."""
        parts = []
        if self.datagrams:
            parts.append(f"{self.datagrams} datagrams lost")
        if lost := sum(self.lost.values()):
            parts.append(f"{lost} lost")
        if refused := sum(self.refused.values()):
            parts.append(f"{refused} refused")
        if missing := sum(gaps.missing for gaps in self.gaps.values()):
            parts.append(f"about {missing} missing")
        return ", ".join(parts)

    def describe(self) -> list[str]:
        """Losses and pauses, one sentence each, for the user."""
        lines = [str(pause) for pause in self.pauses]
        if self.paused > len(self.pauses):
            lines.append(f"and {self.paused - len(self.pauses)} pauses more")
        if self.datagrams:
            topics = ", ".join(
                f"about {n} of {topic}" for topic, n in self.dropped_by_topic.items() if n
            )
            lines.append(
                f"at least {self.datagrams} datagrams were lost because the receive buffer was full"
                + (f" (samples: {topics})" if topics else "")
            )
        lines += [
            f"{n} samples of {topic} were lost because too many waited to be taken"
            for topic, n in sorted(self.refused.items())
            if n
        ]
        lines += [
            f"{n} samples of {topic} were lost (reported by DDS)"
            for topic, n in sorted(self.lost.items())
            if n
        ]
        lines += [
            f"about {gaps.missing} samples of {topic} are missing ({gaps.count} gaps, the longest "
            f"{gaps.longest:.3f} s): they were lost on the way, or their writer stood still"
            for topic, gaps in self.gaps.items()
        ]
        return lines

    def metadata(self) -> dict[str, str]:
        """Losses and pauses as a metadata record of the recording."""
        values = {
            "lost_datagrams": str(self.datagrams),
            "refused": str(sum(self.refused.values())),
            "lost": str(sum(self.lost.values())),
            "missing about": str(sum(gaps.missing for gaps in self.gaps.values())),
        }
        values |= {f"lost {topic}": str(n) for topic, n in sorted(self.lost.items()) if n}
        values |= {
            f"gaps {topic}": f"{g.count}, about {g.missing} samples, longest {g.longest:.3f} s"
            for topic, g in self.gaps.items()
        }
        values |= {f"lost about {topic}": str(n) for topic, n in self.dropped_by_topic.items() if n}
        values |= {f"refused {topic}": str(n) for topic, n in sorted(self.refused.items()) if n}
        if self.pauses:
            values["pauses"] = "; ".join(
                f"{p.seconds:.3f} s until {p.end_ns}" for p in self.pauses
            ) + (f"; {self.paused} in all" if self.paused > len(self.pauses) else "")
        return values
