"""Test the search for the stretch of time in which joints stand still."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.stimuli.standing import Standing

LIMITS = (1.0, 2.0)
_steps = st.lists(
    st.tuples(st.integers(1, 5), *(st.integers(-6, 6).map(lambda n: n / 4) for _ in LIMITS)),
    min_size=1,
    max_size=60,
)


@given(_steps)
def test_newest_stretch_is_found_that_no_joint_leaves(
    steps: list[tuple[int, float, float]],
) -> None:
    still = Standing(LIMITS)
    times: list[int] = []
    rows: list[tuple[float, float]] = []
    for pause, *q in steps:
        times.append((times[-1] if times else 0) + pause * 1_000_000)
        rows.append((q[0], q[1]))
        still.add(times[-1], q)
        first = len(rows) - 1
        while first and all(
            max(column) - min(column) <= limit
            for column, limit in zip(zip(*rows[first - 1 :], strict=True), LIMITS, strict=True)
        ):
            first -= 1
        # it begins when the last position before it was left
        begin = times[max(first - 1, 0)]
        assert still.lasts(times[-1]) == pytest.approx((times[-1] - begin) / 1e9)


def test_slow_drift_is_no_standing_and_its_end_is_seen_at_once() -> None:
    still = Standing([0.1])
    for i in range(100):
        still.add(i * 1_000_000, [0.02 * i])
        assert still.lasts(i * 1_000_000) <= 0.006
    for i in range(100, 120):
        still.add(i * 1_000_000, [2.0])
    assert still.lasts(119_000_000) == pytest.approx(0.025, abs=0.002)
