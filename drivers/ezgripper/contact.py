"""Contact: motion was commanded, and the fingers do not follow
(docs/sources/mx64-ezgripper.md#d10-14).

Pure logic on positions and time. Current is left out on purpose: Present Current of an MX-64
is no basis for a decision (docs/sources/mx64-ezgripper.md#d10-11), and a comparison with a
predicted speed calls every normal move a stall when the speed is wrong
(docs/sources/mx64-ezgripper.md#d8).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

__all__ = ["MIN_FREE_SPEED", "Contact", "ContactDetector"]

MIN_FREE_SPEED = 3.0
"""Percent of stroke a second. Free motion at least this fast, begun within 30 ms, is never
taken for contact."""


@dataclass(frozen=True)
class Contact:
    """Fingers that are stopped short of their goal.

    :param position: where they stopped, ticks from the zero.
    :param direction: sign of the motion that was stopped: -1 closing, +1 opening.
    :param since: time of the report, seconds.
    """

    position: float
    direction: int
    since: float


@dataclass
class ContactDetector:
    """Decides, sample by sample, whether the fingers have met something.

    Contact begins when, for ``window`` seconds without a break, the goal lay more than
    ``outstanding`` ticks ahead in one direction and the position changed by no more than
    ``still`` ticks. It ends when the goal is reached or lies on the other side, or when the
    fingers move on towards the goal by more than ``release`` ticks.

    The defaults: 2 ticks in 0.1 s are 0.8 %/s, below any speed the driver allows
    (:data:`MIN_FREE_SPEED`), a tick of noise either way and the start included; 25 ticks are
    1 % of the stroke, beyond what the servo's position loop leaves as its own error, and below
    the 83 ticks (0.18 rad) by which xr_teleoperate leads (docs/sources/mx64-ezgripper.md#d7).
    """

    window: float = 0.1
    still: float = 2.0
    outstanding: float = 25.0
    release: float = 25.0

    def __post_init__(self) -> None:
        self._history: deque[tuple[float, float]] = deque()
        self._direction = 0
        self._contact: Contact | None = None
        self._anchor = 0.0

    @property
    def contact(self) -> Contact | None:
        """The contact in force, or None."""
        return self._contact

    def reset(self) -> None:
        """Forget everything: nothing is commanded, or the drive was off."""
        self._history.clear()
        self._direction = 0
        self._contact = None

    def update(self, now: float, position: float, goal: float) -> Contact | None:
        """Take one sample.

        :param now: time of measurement, seconds; never earlier than the sample before.
        :param position: measured, ticks.
        :param goal: where the servo is told to go, ticks.
        """
        ahead = goal - position
        direction = 0 if abs(ahead) <= self.outstanding else (1 if ahead > 0 else -1)
        if self._contact is not None:
            return self._watch(now, position, direction)
        if direction != self._direction or direction == 0:
            # a new motion gets a whole window to begin
            self._history.clear()
            self._direction = direction
        if direction == 0:
            return None
        if self._stands_still(now, position):
            self._contact = Contact(position, direction, now)
            self._anchor = position
        return self._contact

    def _watch(self, now: float, position: float, direction: int) -> Contact | None:
        contact = self._contact
        assert contact is not None
        moved_on = (position - self._anchor) * contact.direction
        if direction != contact.direction or moved_on > self.release:
            self._contact = None
            self._history.clear()
            self._direction = direction
            if direction:
                self._history.append((now, position))
            return None
        # an object that creeps, or that pushes the fingers back when the force is lowered, is
        # still the same contact; while it swings, the deepest point counts
        if self._stands_still(now, position):
            self._anchor = position
        return contact

    def _stands_still(self, now: float, position: float) -> bool:
        history = self._history
        history.append((now, position))
        # keep one sample at or before the start of the window: the window must be covered whole
        while len(history) > 1 and now - history[1][0] >= self.window:
            history.popleft()
        if now - history[0][0] < self.window:
            return False
        low = high = position
        for _, value in history:
            low = min(low, value)
            high = max(high, value)
        return high - low <= self.still
