"""Ask before a command that was suspended moves hands on.

A program that was stopped (Ctrl-Z, SIGSTOP), or slept with its machine, goes on when somebody wakes
it, who may not know that it drives a hand. After a pause longer than
:data:`~dexkit.command_age.LONG_PAUSE` the motion that was asked for is over: the person at the
terminal is asked again, and where there is none the command ends.
"""

from __future__ import annotations

import click

from dexkit.cli.stop_keys import Keys, is_enter, is_stop
from dexkit.clock import Clock, RealClock
from dexkit.command_age import LONG_PAUSE, PauseWatch
from dexkit.stop_signals import StopRequest

__all__ = ["Consent"]

_NAP = 0.05


class Consent:
    """Whether hands may be moved on after a pause; called with its length in seconds.

    A call returns when it is answered, and sends nothing meanwhile. Space and q request a stop.

    :ivar missing: the length of a pause after which there was nobody to ask, seconds, or 0.
    """

    def __init__(self, pressed: Keys, stop: StopRequest, clock: Clock | None = None) -> None:
        self._pressed = pressed
        self._stop = stop
        self._clock = clock or RealClock()
        self.missing = 0.0

    def __call__(self, seconds: float) -> bool:
        """Ask where that is necessary; whether to go on."""
        if seconds <= LONG_PAUSE:
            return not self._stop
        watch = PauseWatch(self._clock)
        while not self._stop:
            # what was typed during the pause is no answer to a question asked after it
            if is_stop(self._pressed()):
                self._stop.set()
                break
            if not self._pressed.terminal:
                self.missing = seconds
                return False
            click.echo(
                f"\r\033[Kthis program was suspended for {seconds:.1f} s: nothing is commanded. "
                "Enter goes on; space, q or Ctrl-C stops",
                err=True,
            )
            watch.restart()
            away = self._ask(watch)
            if not away:
                return not self._stop
            seconds = away
        return False

    def _ask(self, watch: PauseWatch) -> float:
        """Wait for an answer; the length of another pause that came before it, or 0."""
        while not self._stop:
            self._clock.sleep_until(self._clock.now() + _NAP)
            pressed = self._pressed()
            away = watch.measure_pause(LONG_PAUSE)
            if is_stop(pressed):
                self._stop.set()
            elif away:
                return away
            elif is_enter(pressed):
                break
        return 0.0

    def explain(self) -> int:
        """Say that there was nobody to ask, if so; the exit code: 1, or 0."""
        if not self.missing:
            return 0
        click.echo(
            f"stopped: this program was suspended for {self.missing:.1f} s, and has no terminal to "
            "ask whether the motion is still wanted\n  start it again",
            err=True,
        )
        return 1
