"""Decisions of the service about one hand: watchdog, rejection, faults, published state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.backoff import Backoff
from dexkit.clock import ManualClock
from dexkit.command_age import PAUSE
from dexkit.errors import CommandRejected, HandError, HandFault, HandLost, HandTimeout
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.models import DEX1_1, DEX3_1
from dexkit.service.hand_core import Estimation, HandCore
from tests.each import each

TIMEOUT = DEX1_1.command_timeout
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


class Bench:
    """A core on a manual clock with an exchange loop that is stepped by hand."""

    def __init__(
        self,
        *,
        io_rate: float = 500.0,
        simulated: bool = True,
        speeds: list[tuple[float, float]] | None = None,
        **options: object,
    ) -> None:
        self.clock = ManualClock(100.0)
        self.spec = DEX1_1.spec(Side.LEFT, io_rate=io_rate, simulated=simulated)
        self.core = HandCore(self.spec, DEX1_1, self.clock, **options)  # type: ignore[arg-type]
        self.q = 1.0
        self.core.opened(self.spec, speeds)
        self.exchange()

    def exchange(self, **state: object) -> HandCommand:
        command = self.core.next_command()
        self.core.measured(HandState.from_values(self.q, stamp=self.clock.now(), **state))  # type: ignore[arg-type]
        return command

    def command(self, q: float, **fields: float) -> bool:
        return self.core.submit(HandCommand.position(q, **fields))


def test_hand_brakes_before_the_first_command() -> None:
    bench = Bench()
    assert bench.exchange().is_brake
    assert bench.core.counters.brakes == 0  # nothing was driven, so nothing stopped
    assert bench.core.view() is not None


def test_the_newest_command_wins() -> None:
    bench = Bench()
    for q in (1.1, 1.2, 1.3):
        bench.command(q)
    assert bench.exchange().q[0] == 1.3


@given(st.floats(0.0, 0.999), st.floats(1.0, 10.0))
@settings(deadline=None)
def test_the_watchdog_brakes_after_a_second_and_not_before(early: float, late: float) -> None:
    bench = Bench()
    bench.command(2.0)
    bench.clock.advance(early * TIMEOUT)
    assert not bench.exchange().is_brake
    assert bench.core.driving
    bench.clock.advance((late - early) * TIMEOUT)
    assert bench.exchange().is_brake
    assert not bench.core.driving
    assert bench.core.counters.brakes == 1
    bench.command(2.5)
    assert bench.exchange().q[0] == 2.5


def test_state_continues_while_braking() -> None:
    bench = Bench()
    bench.command(2.0)
    bench.clock.advance(5.0)
    bench.q = 1.7
    bench.exchange()
    view = bench.core.view()
    assert view is not None
    assert (view.state.q[0], view.fault) == (1.7, (0,))


@each("field", ["q", "dq", "tau", "kp", "kd"])
@each("value", [math.nan, math.inf, -math.inf])
def test_rejected_command_keeps_the_previous_one(field: str, value: float) -> None:
    bench = Bench()
    assert bench.command(2.0)
    bad = HandCommand.position(3.0)
    getattr(bad, field)[0] = value
    assert not bench.core.submit(bad)
    assert bench.exchange().q[0] == 2.0
    assert (bench.core.counters.accepted, bench.core.counters.rejected) == (1, 1)


def test_rejected_commands_do_not_reset_the_watchdog() -> None:
    bench = Bench()
    bench.command(2.0)
    for _ in range(11):
        bench.clock.advance(TIMEOUT / 10)
        bench.command(math.nan)
    assert bench.exchange().is_brake


def test_commands_outside_the_limits_are_clamped_and_counted() -> None:
    bench = Bench()
    bench.command(99.0)
    assert bench.exchange().q[0] == pytest.approx(5.4)
    assert bench.core.counters.clamped == 1


class TestPauses:
    def test_hand_brakes_after_a_pause_until_a_newer_command(self) -> None:
        bench = Bench()
        bench.command(2.0)
        assert not bench.exchange().is_brake
        bench.clock.advance(0.5)
        bench.core.paused()
        assert bench.exchange().is_brake
        now = bench.clock.now()
        for sent in (now - 0.6, now - 0.1, now, -math.inf):
            assert not bench.core.submit(HandCommand.position(3.0), sent)
            assert bench.exchange().is_brake
        counters = bench.core.counters
        assert (counters.brakes, counters.stale, counters.accepted) == (1, 4, 1)
        bench.clock.advance(0.1)
        assert bench.core.submit(HandCommand.position(3.0), now + 0.05)
        assert bench.exchange().q[0] == 3.0

    def test_command_age_counts_from_when_it_was_sent(self) -> None:
        bench = Bench()
        now = bench.clock.now()
        bench.clock.advance(1.0)
        assert not bench.core.submit(HandCommand.position(3.0), now + 1.0 - PAUSE - 0.01)
        assert bench.core.submit(HandCommand.position(3.0), now + 1.0 - PAUSE + 0.01)
        bench.clock.advance(TIMEOUT - PAUSE)
        assert not bench.exchange().is_brake
        bench.clock.advance(0.01)
        assert bench.exchange().is_brake

    def test_stale_command_does_not_reset_the_watchdog(self) -> None:
        bench = Bench()
        bench.command(2.0)
        for _ in range(11):
            bench.clock.advance(TIMEOUT / 10)
            bench.core.submit(HandCommand.position(2.0), bench.clock.now() - 2.0)
        assert bench.exchange().is_brake

    def test_pause_does_not_close_the_link(self) -> None:
        bench = Bench()
        bench.clock.advance(5.0)
        bench.core.paused()
        assert not bench.core.failed(HandTimeout("nothing was sent"))
        bench.clock.advance(0.6)
        assert bench.core.failed(HandTimeout("no answer"))


class TestLostLink:
    def test_lost_link_is_in_the_published_state(self) -> None:
        bench = Bench()
        assert bench.core.failed(HandLost("unplugged"))
        bench.core.closed()
        view = bench.core.view()
        assert view is not None
        assert view.state.q[0] == 1.0  # the last that is known
        assert view.fault == (LINK,)
        assert view.missed == 1
        bench.core.retry_failed()
        view = bench.core.view()
        assert view is not None
        assert (view.missed, view.fault) == (2, (LINK,))

    def test_after_a_lost_link_only_a_new_command_moves(self) -> None:
        bench = Bench()
        bench.command(3.0)
        assert not bench.exchange().is_brake
        bench.core.failed(HandLost("unplugged"))
        bench.core.closed()
        bench.clock.advance(0.1)
        bench.command(3.5)  # still while it is away
        bench.clock.advance(0.1)
        bench.core.opened(bench.spec)
        assert bench.exchange().is_brake
        view = bench.core.view()
        assert view is not None
        assert (view.fault, view.missed) == ((0,), 0)
        bench.clock.advance(0.001)
        bench.command(3.6)
        assert bench.exchange().q[0] == 3.6

    def test_hanging_exchange_is_reported_without_an_error(self) -> None:
        bench = Bench()
        bench.clock.advance(0.1)
        first = bench.core.view()
        assert first is not None
        assert first.fault == (0,)
        bench.clock.advance(0.5)
        view = bench.core.view()
        assert view is not None
        assert (view.fault, view.missed) == ((LINK,), 1)
        assert bench.core.view() is view  # nothing new to encode
        bench.exchange()
        view = bench.core.view()
        assert view is not None
        assert (view.fault, view.missed) == ((0,), 0)


class TestFailedExchanges:
    def test_single_timeouts_are_counted_and_keep_the_link(self) -> None:
        bench = Bench()
        bench.command(3.0)
        bench.clock.advance(0.01)
        assert not bench.core.failed(HandTimeout("no answer"))
        view = bench.core.view()
        assert view is not None
        assert (view.missed, view.fault) == (1, (0,))
        assert bench.exchange().q[0] == 3.0  # it goes on
        assert bench.core.counters.exchange_errors == 1

    def test_missed_exchanges_are_counted_since_the_last_good_one(self) -> None:
        bench = Bench()
        for expected in (1, 2):
            bench.core.failed(HandTimeout("no answer"))
            view = bench.core.view()
            assert view is not None
            assert view.missed == expected
        bench.exchange()
        bench.core.failed(HandTimeout("no answer"))
        view = bench.core.view()
        assert view is not None
        assert view.missed == 1

    def test_half_a_second_of_timeouts_closes_the_link(self) -> None:
        bench = Bench()
        for _ in range(5):
            bench.clock.advance(0.1)
            assert not bench.core.failed(HandTimeout("no answer"))
        bench.clock.advance(0.1)
        assert bench.core.failed(HandTimeout("no answer"))

    def test_fault_brakes_and_is_published(self) -> None:
        bench = Bench()
        bench.command(3.0)
        bench.exchange()
        bits = int(MotorError.OVERCURRENT)
        bench.clock.advance(0.01)
        assert not bench.core.failed(HandFault("overload", bits=[bits]))
        assert bench.core.next_command().is_brake
        bench.command(3.1)
        assert bench.core.next_command().is_brake
        view = bench.core.view()
        assert view is not None
        assert (view.fault, view.missed) == ((bits,), 1)
        # the bits stay when the next exchange merely times out
        bench.core.failed(HandTimeout("no answer"))
        view = bench.core.view()
        assert view is not None
        assert (view.fault, view.missed) == ((bits,), 2)
        assert bench.core.counters.faults == 1
        assert bench.core.counters.brakes == 1

    def test_after_a_fault_only_a_new_command_moves(self) -> None:
        bench = Bench()
        bench.command(3.0)
        bench.core.failed(HandFault("overload", bits=[1]))
        bench.clock.advance(0.01)
        bench.command(3.1)
        bench.clock.advance(0.01)
        assert bench.exchange().is_brake
        assert bench.exchange().is_brake
        bench.clock.advance(0.01)
        bench.command(3.2)
        assert bench.exchange().q[0] == 3.2

    def test_fault_does_not_close_the_link(self) -> None:
        """The backend is still recovering, perhaps for minutes while a motor cools."""
        bench = Bench()
        for _ in range(100):
            bench.clock.advance(0.6)
            assert not bench.core.failed(HandFault("hot", bits=[0x80]))
            view = bench.core.view()
            assert view is not None
            assert view.fault == (0x80,)

    @each("error", [HandLost("x"), HandError("x"), OSError("x"), KeyError("x")])
    def test_other_exceptions_close_the_link(self, error: Exception) -> None:
        assert Bench().core.failed(error)

    def test_command_rejected_by_the_hand_keeps_the_link(self) -> None:
        assert not Bench().core.failed(CommandRejected("it does not like it"))

    @each("q", [[math.nan], [math.inf], [0.0, 0.0]])
    def test_invalid_state_is_a_failure(self, q: list[float]) -> None:
        bench = Bench()
        with pytest.raises(HandError, match="backend returned"):
            bench.core.measured(HandState.from_values(q, stamp=0.0))
        view = bench.core.view()
        assert view is not None
        assert view.state.q[0] == 1.0

    def test_fault_bits_of_a_state_are_published(self) -> None:
        bench = Bench()
        bench.exchange(fault=int(MotorError.CASE_TEMPERATURE))
        view = bench.core.view()
        assert view is not None
        assert view.fault == (0x80,)


class TestPrediction:
    def test_auto_estimation_depends_on_the_rate_that_clients_need(self) -> None:
        assert not Bench(io_rate=300.0).core.predicting
        assert Bench(io_rate=30.0).core.predicting

    def test_slow_fingers_of_unknown_speed_publish_measurements(self) -> None:
        """At the joints' top speed, q would run ahead of a soft joint and jump back again."""
        clock = ManualClock(100.0)
        spec = DEX3_1.spec(Side.LEFT, io_rate=30.0, simulated=True)
        n = spec.n_joints
        core = HandCore(spec, DEX3_1, clock)
        core.opened(spec)
        q = np.full(n, -0.1)
        core.measured(HandState.from_values(q, stamp=clock.now()))
        assert (core.predicting, core.lacks_speeds) == (False, True)
        core.submit(HandCommand.position(np.full(n, -0.3), kp=0.2, kd=0.8))
        for _ in range(20):
            clock.advance(1 / 300)
            view = core.view()
            assert view is not None
            assert view.state.measured
            assert (view.state.q == q).all()
        core.opened(spec, [(2.0, 2.0)] * n)
        assert (core.predicting, core.lacks_speeds) == (True, False)

    def test_auto_prediction_measures_the_link_rate(self) -> None:
        bench = Bench(io_rate=300.0)
        bench.clock.advance(0.1)
        bench.exchange()
        assert not bench.core.predicting  # one hiccup is not a slow link
        for _ in range(50):
            bench.clock.advance(1 / 30)
            bench.exchange()
        assert bench.core.predicting
        assert bench.core.measured_rate == pytest.approx(30, rel=0.05)
        for _ in range(400):
            bench.clock.advance(1 / 300)
            bench.exchange()
        assert not bench.core.predicting

    def test_off_and_predict_set_the_estimation(self) -> None:
        assert not Bench(io_rate=5.0, estimation=Estimation.OFF).core.predicting
        assert Bench(io_rate=900.0, estimation=Estimation.PREDICT).core.predicting

    def test_a_slow_link_is_predicted_from_the_command_on(self) -> None:
        bench = Bench(io_rate=5.0, speeds=[(2.0, 2.0)])
        bench.command(5.0)
        bench.clock.advance(0.1)
        view = bench.core.view()
        assert view is not None
        assert view.state.q[0] == pytest.approx(1.2)
        assert not view.state.measured

    def test_a_lost_link_is_not_predicted(self) -> None:
        bench = Bench(io_rate=5.0, speeds=[(2.0, 2.0)])
        bench.command(5.0)
        bench.core.failed(HandLost("unplugged"))
        bench.core.closed()
        bench.clock.advance(0.3)
        view = bench.core.view()
        assert view is not None
        assert (view.state.q[0], view.state.measured) == (1.0, True)

    def test_watchdog_stops_the_prediction(self) -> None:
        bench = Bench(io_rate=5.0, speeds=[(0.1, 0.1)])
        bench.command(5.0)
        bench.clock.advance(TIMEOUT)
        bench.q = 1.1  # where the prediction is
        bench.exchange()
        first = bench.core.view()
        bench.clock.advance(0.1)
        second = bench.core.view()
        assert first is not None
        assert second is not None
        assert np.array_equal(first.state.q, second.state.q)


class TestSoftStart:
    def drive(self, bench: Bench, q: float, seconds: float) -> float:
        fastest = 0.0
        for _ in range(round(seconds * 100)):
            bench.clock.advance(0.01)
            bench.command(q)
            sent = bench.exchange().q[0]
            fastest = max(fastest, abs(sent - bench.q) / 0.01)
            bench.q = float(sent)
        return fastest

    def test_soft_start_limits_speed_to_one_stroke_a_second(self) -> None:
        bench = Bench(simulated=False)
        assert self.drive(bench, 5.4, 2.0) <= 5.4 + 1e-6
        assert bench.q == 5.4
        # it has caught up: from now on commands go through as they are
        assert self.drive(bench, 0.0, 0.01) == pytest.approx(540.0)

    def test_soft_start_repeats_after_a_reconnection(self) -> None:
        bench = Bench(simulated=False)
        self.drive(bench, 2.0, 2.0)
        bench.core.failed(HandLost("x"))
        bench.core.closed()
        bench.core.opened(bench.spec)
        assert self.drive(bench, 5.0, 0.2) <= 5.4 + 1e-6

    def test_simulated_hand_has_no_soft_start(self) -> None:
        bench = Bench()
        bench.command(5.4)
        assert bench.exchange().q[0] == 5.4


def test_backoff_doubles_up_to_its_maximum() -> None:
    backoff = Backoff()
    assert [backoff.next() for _ in range(7)] == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    backoff.reset()
    assert backoff.next() == 0.1
