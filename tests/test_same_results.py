"""Faster ways to compute what numpy computes have numpy's results, to the last bit."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.kit.median import median, medians, percentile
from dexkit.conformance.kit.row_selection import finite_rows

_COLUMNS = st.lists(st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 1e-300, math.nan]))


def _same(ours: float, numpys: float) -> bool:
    return ours == numpys or (math.isnan(ours) and math.isnan(numpys))


@given(_COLUMNS.filter(bool), st.sampled_from([0.0, 25.0, 50.0, 99.0, 100.0]))
def test_median_and_percentile(values: list[float], percent: float) -> None:
    column = np.array(values)
    assert _same(median(column), float(np.median(column)))
    assert _same(percentile(column, percent), float(np.percentile(column, percent)))


def test_percentile_of_long_columns() -> None:
    random = np.random.default_rng(1)
    for n in range(100, 600, 7):
        column = random.exponential(0.002, n)
        assert percentile(column, 99) == np.percentile(column, 99), n


def test_medians_of_ranges_equal_those_of_single_ranges() -> None:
    random = np.random.default_rng(3)
    column = np.round(random.normal(size=3000), 1)
    column[::97], column[5::31], column[7], column[8] = np.nan, -0.0, np.inf, -np.inf
    rows = np.sort(random.integers(0, 3000, (400, 2)), axis=1)
    rows[::2, 1] = np.minimum(rows[::2, 0] + random.integers(0, 12, 200), 3000)
    rows[0] = 5, 5  # no values
    one_by_one = [median(column[first:last]) for first, last in rows]
    assert all(_same(*both) for both in zip(medians(column, rows), one_by_one, strict=True))


def test_rows_without_a_number_are_left_out() -> None:
    a, b = np.array([1.0, 2.0, np.nan]), np.array([np.inf, 5.0, 6.0])
    assert finite_rows(np.arange(3.0)) == slice(None)
    assert b[finite_rows(a, b)].tolist() == [5.0]
