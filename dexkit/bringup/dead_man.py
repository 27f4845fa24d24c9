"""Detect from a terminal's bytes whether the space bar is held; sans-IO.

A terminal sends no event when a key is released: a held key repeats, and silence is the release.
"""

from __future__ import annotations

__all__ = ["ARM", "PAUSE", "RELEASE", "DeadMan"]

RELEASE = 0.15
"""Seconds without a repeat after which the key counts as released. Terminals repeat 25 to 30 times
a second; a slower one never arms."""
ARM = 4
"""Presses in a row, none of them later than :data:`RELEASE`, that count as held: a person who
touches the key once moves nothing."""
PAUSE = 0.1
"""Seconds between two calls after which the program was paused. What was read since then may be
old: the key has to be held anew."""
_SPACE = b" "


class DeadMan:
    """Detect whether the dead-man key is held, from the times of its key presses.

    ``held`` is True from the fourth press of an unbroken series until :data:`RELEASE` seconds after
    the last one, until another key, or until the caller was paused.
    """

    def __init__(self) -> None:
        self._series = 0
        self._last = self._called = -1e9

    def held(self, now: float, data: bytes) -> bool:
        """Whether the key is held.

        :param now: monotonic seconds.
        :param data: the bytes that were read since the last call.
        """
        paused = now - self._called > PAUSE
        self._called = now
        if paused or data.strip(_SPACE):
            self._series = 0  # another key stops at once
            return False
        if data:
            fresh = now - self._last <= RELEASE
            # presses that are read together came one after the other, but count once
            self._series = self._series + 1 if fresh else 1
            self._last = now
        elif now - self._last > RELEASE:
            self._series = 0
        return self._series >= ARM
