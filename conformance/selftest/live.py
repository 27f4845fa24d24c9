"""A self-test on a hand: exchanges at a steady rate, until it is at rest again."""

from __future__ import annotations

from collections.abc import Callable

from dexkit.clock import Clock, Rate, RealClock
from dexkit.command_age import LONG_PAUSE, PauseWatch
from dexkit.conformance.selftest.supervision import End, SelfTest
from dexkit.errors import HandError, HandTimeout
from dexkit.hand import CommandGate, Hand

__all__ = ["run"]

_TIMEOUTS = 5
"""Exchanges without an answer, one after the other, after which the hand counts as lost."""


def run(
    hand: Hand,
    test: SelfTest,
    *,
    clock: Clock | None = None,
    turn: Callable[[SelfTest], object] = lambda test: None,
    resume: Callable[[float], bool] = lambda seconds: False,
) -> None:
    """Run a test on a hand that is open.

    What the hand raises ends the test, which keeps what was found so far. After a pause of this
    program the command that was made before it is not sent: the hand is braked, and the test goes
    on from where it is.

    :param turn: called before each exchange; it may stop the test, and must not block. If it
        raises, the hand is left at rest first.
    :param resume: called after a pause of more than :data:`~dexkit.command_age.LONG_PAUSE` while
        the test goes on, with its seconds; returns whether to go on. By default it ends.
    """
    gate = CommandGate(hand.spec)
    clock = clock or RealClock()
    rate, watch = Rate(1.0 / test.procedure.setup.period, clock), PauseWatch(clock)
    failure: BaseException | None = None
    silent = 0
    while not test.finished:
        if failure is None:
            try:
                turn(test)
            except BaseException as error:
                failure = error
                test.stop(End.STOPPED, "this program failed")
        command = test.command
        if away := watch.measure_pause():
            if away > LONG_PAUSE and test.end is None and not resume(away):
                test.stop(End.STOPPED, f"this program was suspended for {away:.1f} s")
            watch.restart()
            command = test.procedure.bench.rest()
        try:
            state = hand.exchange(gate.admit(command))
        except HandTimeout as error:
            silent += 1
            if silent >= _TIMEOUTS:
                test.abandon(error.message)
        except HandError as error:
            test.abandon(error.message)
        else:
            silent = 0
            test.step(state)
        if not test.finished:
            rate.wait()
    if failure is not None:
        raise failure
