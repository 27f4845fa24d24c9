"""Detect contact: the goal is away from the position, and the fingers do not move
(docs/sources/mx64-ezgripper.md#d10-14).

It uses positions and time only. Present Current of an MX-64 is too noisy for a decision
(docs/sources/mx64-ezgripper.md#d10-11), and a comparison with a predicted speed takes every normal
motion for a stall when the prediction is wrong (docs/sources/mx64-ezgripper.md#d8).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

__all__ = ["MIN_FREE_SPEED", "Contact", "ContactDetector"]

MIN_FREE_SPEED = 3.0
"""Percent of stroke a second. Free motion at least this fast that begins within 30 ms is never
reported as contact."""


@dataclass(frozen=True)
class Contact:
    """Fingers stopped before their goal.

    :param position: position of the stop, ticks from the zero.
    :param direction: sign of the stopped motion: -1 closing, +1 opening.
    :param since: time of detection, seconds.
    """

    position: float
    direction: int
    since: float


@dataclass
class ContactDetector:
    """Detects contact from one sample at a time.

    Contact begins when, throughout ``window`` seconds, the goal is more than ``outstanding`` ticks
    ahead in one direction and the position changes by at most ``still`` ticks. It ends when the
    goal is reached or on the other side, or when the fingers move towards the goal by more than
    ``release`` ticks.

    The defaults: 2 ticks in 0.1 s are 0.8 %/s, below any speed that the driver allows
    (:data:`MIN_FREE_SPEED`), with one tick of noise and the start of a motion included; 25 ticks
    are 1 % of the stroke, more than the steady-state error of the servo's position loop and less
    than the 83 ticks (0.18 rad) by which xr_teleoperate leads (docs/sources/mx64-ezgripper.md#d7).
    """

    window: float = 0.1
    still: float = 2.0
    outstanding: float = 25.0
    release: float = 25.0

    def __post_init__(self) -> None:
        # latest possible time of measurement, position
        self._history: deque[tuple[float, float]] = deque()
        self._direction = 0
        self._contact: Contact | None = None
        self._anchor = 0.0

    @property
    def contact(self) -> Contact | None:
        """The present contact, or None."""
        return self._contact

    def reset(self) -> None:
        """Clear contact and history: nothing is commanded, or the drive was off."""
        self._history.clear()
        self._direction = 0
        self._contact = None

    def update(
        self, now: float, position: float, goal: float, *, received: float | None = None
    ) -> Contact | None:
        """Process one sample; return the present contact, or None.

        :param now: time of measurement, seconds, the earliest possible; never earlier than the
            previous sample's.
        :param position: measured position, ticks.
        :param goal: goal position of the servo, ticks.
        :param received: the latest possible time of measurement; None: ``now``. After a late
            answer two positions can be much closer in time than their requests.
        """
        latest = now if received is None else received
        ahead = goal - position
        direction = 0 if abs(ahead) <= self.outstanding else (1 if ahead > 0 else -1)
        if self._contact is not None:
            return self._update_contact(now, latest, position, direction)
        if direction != self._direction:
            # a new motion may take a whole window to begin, and this sample does not count:
            # the goal is written after it, after a pause of this program perhaps
            self._history.clear()
            self._direction = direction
            return None
        if direction == 0:
            return None
        if self._is_still(now, latest, position):
            self._contact = Contact(position, direction, now)
            self._anchor = position
        return self._contact

    def _update_contact(
        self, now: float, latest: float, position: float, direction: int
    ) -> Contact | None:
        contact = self._contact
        assert contact is not None
        moved_on = (position - self._anchor) * contact.direction
        if direction != contact.direction or moved_on > self.release:
            self._contact = None
            self._history.clear()
            if direction and direction == self._direction:
                self._history.append((latest, position))
            self._direction = direction
            return None
        # slow creep, or fingers pushed back when the current is lowered, keep the same contact;
        # the anchor moves only when the position is still
        if self._is_still(now, latest, position):
            self._anchor = position
        return contact

    def _is_still(self, now: float, latest: float, position: float) -> bool:
        history = self._history
        history.append((latest, position))
        # keep one sample certainly before the start of the window: it must be covered whole
        while len(history) > 1 and now - history[1][0] >= self.window:
            history.popleft()
        if now - history[0][0] < self.window:
            return False
        low = high = position
        for _, value in history:
            low = min(low, value)
            high = max(high, value)
        return high - low <= self.still
