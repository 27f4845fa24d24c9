"""Waits of a run that moves a hand: it ends when the kit was suspended.

What was measured is void then, and nobody has asked for the rest of the motion.
"""

from __future__ import annotations

from dexkit.clock import Clock
from dexkit.command_age import LONG_PAUSE
from dexkit.errors import ConformanceError

__all__ = ["sleep_awake"]


def sleep_awake(clock: Clock, deadline: float) -> None:
    """Sleep until ``deadline`` on the clock.

    :raises ConformanceError: it took :data:`~dexkit.command_age.LONG_PAUSE` longer than that.
    """
    begin, wanted = clock.since_boot(), max(0.0, deadline - clock.now())
    clock.sleep_until(deadline)
    away = clock.since_boot() - begin - wanted
    if away > LONG_PAUSE:
        raise ConformanceError(
            f"this program was suspended for {away:.1f} s: the run ends, and moves no hand on",
            hint="nothing is judged; run it again",
        )
