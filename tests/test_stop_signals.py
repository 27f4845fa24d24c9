"""Signals that ask for a stop, during a wait and repeated."""

from __future__ import annotations

import signal

import pytest

from dexkit.stop_signals import stop_on_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_a_wait_for_the_stop_request(number: int) -> None:
    with stop_on_signals() as request:
        with request.event._cond:  # as wait() holds it for moments
            signal.raise_signal(number)
            assert request
        assert request.wait(60)
        assert request.signum == number


def test_a_second_interrupt_interrupts_at_once() -> None:
    with stop_on_signals() as request:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert request.signum == signal.SIGTERM


def test_program_can_request_its_own_stop() -> None:
    with stop_on_signals() as request:
        assert not request
        request.set()
        assert request.wait(0)
        assert request.signum == 0
