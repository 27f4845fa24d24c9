"""Lookups, ranges and sums in bulk give what numpy and math give one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dexkit.conformance.kit.row_selection import SomeTimes, Times, extremes
from dexkit.conformance.kit.sums import total

SHIFTS = [(s, side) for s in (-0.3, -0.01, 0.0, 0.004, 0.04, 5.0) for side in ("left", "right")]


def times(kind: str, n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(1)
    steps = {
        "even": np.full(n, 0.002),
        "jitter": rng.exponential(0.002, n),
        "gaps": np.where(np.arange(n) % 50 == 7, 0.5, 0.002),
        "equal": np.where(np.arange(n) % 3 == 0, 0.0, 0.002),
        "back": np.where(np.arange(n) % 40 == 9, -0.01, 0.002),
        "standing": np.zeros(n),
    }[kind]
    return np.asarray(np.cumsum(steps))


@pytest.mark.parametrize("kind", ["even", "jitter", "gaps", "equal", "back", "standing"])
def test_rows_are_those_of_searchsorted(kind: str) -> None:
    t = times(kind)
    some = np.flatnonzero(np.arange(len(t)) % 5 != 2)
    for seconds, side in SHIFTS:
        found = Times(t).shifted(seconds, side)  # type: ignore[arg-type]
        assert (found == np.searchsorted(t, t + seconds, side)).all()
        for rows in (some, np.arange(len(t))):
            part = SomeTimes(Times(t), rows)
            expected = np.searchsorted(t[rows], t[rows] + seconds, side)
            assert (part.shifted(seconds, side) == expected).all()  # type: ignore[arg-type]


def test_rows_of_times_that_are_no_numbers_or_few() -> None:
    for t in ([], [1.0], [1.0, 2.0], [1.0, np.nan, 3.0], [1.0, 2.0, np.inf]):
        found = Times(np.array(t)).shifted(1.0)
        assert (found == np.searchsorted(t, np.array(t) + 1.0)).all()


def test_extremes_of_ranges_are_those_of_each_range() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=500)
    for longest in (1, 2, 9, 80, 499):
        first = rng.integers(0, 500 - longest + 1, 300)
        last = first + rng.integers(max(1, longest // 2), longest + 1, 300)
        last[:3], first[:3] = 500, [0, 250, 499]
        low, high = extremes(values, first, last)
        assert low.tolist() == [values[a:b].min() for a, b in zip(first, last, strict=True)]
        assert high.tolist() == [values[a:b].max() for a, b in zip(first, last, strict=True)]
    assert [len(c) for c in extremes(values, first[:0], last[:0])] == [0, 0]


def test_total_of_a_column_equals_fsum() -> None:
    rng = np.random.default_rng(3)
    for n in (1, 200, 201, 255, 256, 3000):
        x = rng.normal(size=n)
        scales = 10.0 ** rng.integers(-30, 30, n)
        both = np.concatenate([x, -x, [1e-17]])
        for column in (x, x**2, x * scales, both, x * 1e-290, x * 1e290, np.zeros(n), -np.zeros(n)):
            assert total(column) == math.fsum(column.tolist())
    assert math.isnan(total(np.append(x, np.nan)))
    assert total(np.append(x, np.inf)) == math.inf
    assert math.isnan(total(np.append(x, [np.inf, -np.inf])))
    assert math.isnan(total(np.full(300, 1e308)))
