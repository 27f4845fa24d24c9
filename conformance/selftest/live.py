"""A self-test on a hand: exchanges at a steady rate, until it is at rest again."""

from __future__ import annotations

from collections.abc import Callable

from dexkit.clock import Clock, Rate, RealClock
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
) -> None:
    """Run a test on a hand that is open.

    What the hand raises ends the test, which keeps what was found so far.

    :param turn: called before each exchange; it may stop the test, and must not block. If it
        raises, the hand is left at rest first.
    """
    gate = CommandGate(hand.spec)
    rate = Rate(1.0 / test.procedure.setup.period, clock or RealClock())
    failure: BaseException | None = None
    silent = 0
    while not test.finished:
        if failure is None:
            try:
                turn(test)
            except BaseException as error:
                failure = error
                test.stop(End.STOPPED, "this program failed")
        try:
            state = hand.exchange(gate.admit(test.command))
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
