"""Count samples that are missing in a recording, as far as the recorder can detect; no I/O.

Three things are counted:

* *datagrams* that the kernel dropped because the socket's receive buffer was full. An exact count,
  but not per topic. CycloneDDS 0.10 gives readers no sequence numbers, and its "sample lost" status
  does not count gaps in them (its source raises it only for samples that are too old for their
  reader).
* samples *refused* because the reader's queue was full. An exact count per topic.
* samples that are *probably missing* on each topic: when datagrams were dropped, gaps in a writer's
  source timestamps are divided by its period. An estimate.

Losses before this machine are not detected: the readers are best-effort, so that the recorder never
slows down the writers.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import datetime, timezone

__all__ = ["PAUSE", "Losses", "Pause"]

#: Seconds between two iterations of the recorder's loop from which on it counts as a pause.
PAUSE = 0.5
# Periods without a sample that are a gap, and intervals after which the period estimate is used.
_GAP = 2.5
_MIN_INTERVALS = 8
# Share of a new interval in the running period.
_SHARE = 1 / 16
# Seconds after a drop in which its gap may be detected: the next sample must arrive first.
_GAP_WINDOW = 5.0
_MAX_PAUSES = 20  # pauses that are kept


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


class Losses:
    """Counts what was lost.

    :ivar datagrams: dropped by the kernel.
    :ivar refused: samples by topic.
    :ivar pauses: the first ones; ``paused`` counts all.
    """

    def __init__(self) -> None:
        self.datagrams = 0
        self.refused: dict[str, int] = {}
        self.pauses: list[Pause] = []
        self.paused = 0
        self._about: Counter[str] = Counter()
        self._holes = 0
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._turn: float | None = None
        self._until = float("-inf")

    def turn(self, now: float, wall_ns: int) -> Pause | None:
        """Note one iteration of the recorder's loop.

        :param now: seconds of a clock that counts suspension, too.
        :returns: the pause that has just ended, if there was one.
        """
        before, self._turn = self._turn, now
        if before is None or now - before < PAUSE:
            return None
        pause = Pause(now - before, wall_ns)
        self.paused += 1
        if len(self.pauses) < _MAX_PAUSES:
            self.pauses.append(pause)
        return pause

    def sample(self, topic: str, writer: int, source_ns: int) -> None:
        """Note a received sample. Those of one writer must come in order."""
        stream = self._streams.get((topic, writer))
        if stream is None:
            if len(self._streams) >= 4096:  # clients that come and go
                self._streams.clear()
            stream = self._streams[topic, writer] = _Stream(topic)
        before, stream.last = stream.last, source_ns
        passed = source_ns - before
        if before <= 0 or passed <= 0:  # the first, one without a time, a clock that was set
            return
        stream.intervals += 1
        known = stream.intervals > _MIN_INTERVALS
        if known and passed > _GAP * stream.period:
            stream.missing += round(passed / stream.period) - 1
            stream.holes += 1
        else:
            share = _SHARE if known else 1 / stream.intervals
            stream.period += (passed - stream.period) * share

    def look(self, now: float, dropped: int, refused: dict[str, int]) -> bool:
        """Update the counters; call it periodically.

        :param dropped: datagrams dropped since the last call.
        :param refused: samples refused in total, by topic.
        :returns: whether anything was lost since the last call.
        """
        news = dropped > 0
        self.datagrams += dropped
        if dropped:
            self._until = now + _GAP_WINDOW
        if refused != self.refused:
            self.refused, news = dict(refused), True
        for stream in self._streams.values():
            if stream.missing and now <= self._until:
                self._about[stream.topic] += stream.missing
                self._holes += stream.holes
                news = True
            stream.missing = stream.holes = 0
        return news

    @property
    def about(self) -> dict[str, int]:
        """Estimated missing samples, by topic.

        In total at most the dropped datagrams, plus one for each gap: CycloneDDS 0.10
        does not deliver the first sample of a reliable writer after one (measured).
        """
        total = self._about.total()
        scale = min(1.0, (self.datagrams + self._holes) / total) if total else 0.0
        return {topic: round(n * scale) for topic, n in sorted(self._about.items())}

    def __bool__(self) -> bool:
        return bool(self.datagrams or sum(self.refused.values()))

    def sentences(self) -> list[str]:
        """Losses and pauses as sentences for the user."""
        said = [str(pause) for pause in self.pauses]
        if self.paused > len(self.pauses):
            said.append(f"and {self.paused - len(self.pauses)} pauses more")
        if self.datagrams:
            topics = ", ".join(f"about {n} of {topic}" for topic, n in self.about.items() if n)
            said.append(
                f"at least {self.datagrams} datagrams were lost because the receive buffer was full"
                + (f" (samples: {topics})" if topics else "")
            )
        said += [
            f"{n} samples of {topic} were lost because too many waited to be taken"
            for topic, n in sorted(self.refused.items())
            if n
        ]
        return said

    def metadata(self) -> dict[str, str]:
        """Losses and pauses as a metadata record of the recording."""
        values = {
            "lost_datagrams": str(self.datagrams),
            "refused": str(sum(self.refused.values())),
        }
        values |= {f"lost about {topic}": str(n) for topic, n in self.about.items() if n}
        values |= {f"refused {topic}": str(n) for topic, n in sorted(self.refused.items()) if n}
        if self.pauses:
            values["pauses"] = "; ".join(
                f"{p.seconds:.3f} s until {p.end_ns}" for p in self.pauses
            ) + (f"; {self.paused} in all" if self.paused > len(self.pauses) else "")
        return values
