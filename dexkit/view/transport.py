"""Which moment is shown: following a live domain, or playing a recording; sans IO."""

from __future__ import annotations

__all__ = ["SPEEDS", "Transport"]

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0)


class Transport:
    """The position on the time line. Times of the line are seconds, ``now`` is a monotonic clock.

    :param live: the end of the line is now; it is followed unless paused.
    :param end: of a recording, seconds.

    :ivar at: the moment that is shown.
    :ivar paused: whether it stands.
    :ivar speed: of playing a recording.
    """

    def __init__(self, *, live: bool, end: float = 0.0) -> None:
        self.live = live
        self.begin = 0.0
        self.end = end
        self.at = 0.0
        self.paused = False
        self.speed = 1.0
        self._last: float | None = None

    @property
    def following(self) -> bool:
        """Whether it shows now."""
        return self.live and not self.paused

    def advance(self, now: float, begin: float, end: float) -> float:
        """Advance with the clock; return the time to show.

        :param begin: of the line, ``end`` its end: of a live one what the history reaches back to,
            and now.
        """
        passed = 0.0 if self._last is None else max(0.0, now - self._last)
        self._last = now
        self.begin, self.end = begin, max(begin, end)
        if self.following:
            self.at = self.end
        elif not self.paused:
            self.at += self.speed * passed
            if self.at >= self.end:
                self.at = self.end
                self.paused = True
        self.at = min(max(self.at, self.begin), self.end)
        return self.at

    def hold(self) -> None:
        """Ignore the time until the next :meth:`advance`."""
        self._last = None

    def seek(self, at: float) -> None:
        """Jump to a time; a live line pauses there."""
        self.at = min(max(at, self.begin), self.end)
        if self.live:
            self.paused = True

    def step(self, seconds: float) -> None:
        """Pause this much later, or earlier."""
        self.seek(self.at + seconds)
        self.paused = True

    def restart(self) -> None:
        """Follow now again; a recording jumps to its begin."""
        if self.live:
            self.paused = False
        else:
            self.seek(0.0)

    def toggle(self) -> None:
        """Pause, or go on; a recording at its end starts again."""
        self.paused = not self.paused
        if not self.live and not self.paused and self.at >= self.end:
            self.at = self.begin
