"""Clocks, and the rate that keeps absolute deadlines."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.clock import ManualClock, Rate, RealClock
from dexkit.errors import UsageError
from tests.each import each


class TestRate:
    @given(st.lists(st.floats(0.0, 0.0099), min_size=1, max_size=200))
    def test_work_shorter_than_a_period_never_shifts_a_deadline(self, work: list[float]) -> None:
        clock = ManualClock(3.0)
        rate = Rate(100.0, clock)
        for i, seconds in enumerate(work, 1):
            assert rate.wait() == 0
            assert clock.now() == pytest.approx(3.0 + 0.01 * i, abs=1e-9)
            clock.advance(seconds)
        assert (rate.misses, rate.loops) == (0, len(work))

    @given(st.lists(st.floats(0.0, 0.1), min_size=1, max_size=100))
    def test_deadlines_stay_on_the_grid_for_any_delays(self, work: list[float]) -> None:
        clock = ManualClock()
        rate = Rate(100.0, clock)
        last = 0.0
        for seconds in work:
            clock.advance(seconds)
            before = clock.now()
            rate.wait()
            assert clock.now() >= before
            deadline = rate.deadline - rate.period  # the one that was waited for
            assert deadline / rate.period == pytest.approx(round(deadline / rate.period), abs=1e-6)
            assert deadline > last - 1e-9
            assert clock.now() - deadline < rate.period + 1e-9  # no burst to catch up
            last = deadline
        assert rate.loops == len(work)

    def test_missed_periods_are_counted_and_skipped(self) -> None:
        clock = ManualClock()
        rate = Rate(100.0, clock)
        rate.wait()
        clock.advance(0.055)
        assert rate.wait() == 4  # deadlines 20, 30, 40 and 50 ms are gone; 60 ms is next
        assert rate.misses == 4
        rate.wait()
        assert clock.now() == pytest.approx(0.07)
        assert rate.misses == 4

    @each("hz", [0.0, -5.0, float("inf"), float("nan")])
    def test_a_rate_is_positive(self, hz: float) -> None:
        with pytest.raises(UsageError, match="positive"):
            Rate(hz)


@pytest.mark.realtime
def test_real_clock_is_the_monotonic_clock() -> None:
    clock = RealClock()
    before, now, start = time.monotonic(), clock.now(), time.monotonic()
    assert before <= now <= start
    clock.sleep_until(start + 0.02)
    assert time.monotonic() >= start + 0.02
    clock.sleep_until(start)  # the past: at once


@pytest.mark.realtime
def test_a_real_rate_does_not_drift() -> None:
    """No deadline is early, and each follows from the first, however late the machine is."""
    rate = Rate(500.0, spin=100e-6)
    first = rate.deadline
    while rate.loops + rate.misses < 50:
        due = rate.deadline
        rate.wait()
        assert time.monotonic() >= due
        assert rate.deadline == pytest.approx(first + (rate.loops + rate.misses) * 2e-3)
