"""Notice a client that moves q in commands without gains: the hand stays limp, and nothing says so.

Some clients send q alone and leave kp, kd, dq and tau 0. In the dialects whose gains are used that
is the command to be limp (docs/sources/unitree-dex.md#b2), so such a client moves nothing.
"""

from __future__ import annotations

import numpy as np

from dexkit.hand import Floats, HandCommand, HandSpec

__all__ = ["LEAST_CHANGE", "PERSISTENCE", "LimpCommands"]

PERSISTENCE = 1.0
"""Seconds from the first change of q after which a command counts."""
LEAST_CHANGE = 0.01
"""Part of the stroke by which q changes at least."""


class LimpCommands:
    """Watches the commands of one hand."""

    def __init__(self, spec: HandSpec) -> None:
        self._least = LEAST_CHANGE * (spec.q_max - spec.q_min)
        self._first: Floats | None = None  # q of the first of the commands without gains
        self._changed: float | None = None  # when q was another one than that

    def update(self, command: HandCommand, now: float) -> bool:
        """Whether ``command`` is one of a client that wants to move the hand without gains.

        True if commands have had no gains for :data:`PERSISTENCE` seconds since one of them
        changed q.

        :param now: seconds; never less than before.
        """
        if not command.is_limp:
            self._first = self._changed = None
            return False
        if self._first is None:
            self._first = command.q
        if self._changed is None and (np.abs(command.q - self._first) > self._least).any():
            self._changed = now
        return self._changed is not None and now - self._changed >= PERSISTENCE
