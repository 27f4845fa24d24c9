"""What is looked for only where it can be is what a search of everything finds."""

from __future__ import annotations

import numpy as np
import pytest

from dexkit.conformance.kit.excess import Course, Excess
from dexkit.conformance.kit.row_selection import SomeTimes, Times
from dexkit.hand import Floats

LAG, PART, LONGEST = 0.04, 0.15, 0.02


def a_course(kind: str, seed: int, n: int = 3000) -> Course:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.normal(0.002, 1e-4, n))
    speed = np.sin(3 * t) * (t % 2 < 1)
    if kind == "jump":
        speed[n // 2] = 40.0
    q = np.concatenate(([0.0], np.cumsum(np.diff(t) * speed[1:]))) + rng.normal(0, 1e-4, n)
    if kind == "frozen":
        q[n // 3 : n // 3 + 200] = q[n // 3]
    if kind == "gaps":
        t += np.cumsum(np.where(np.arange(n) % 400 == 7, 0.3, 0.0))
    if kind == "slow":
        t *= 10
    rows = np.flatnonzero(rng.random(n) > 0.05)
    times = SomeTimes(Times(t), rows)
    q, speed, steps = q[rows], speed[rows], np.diff(t[rows])
    integral, path = (
        np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2 * steps)))
        for v in (speed, np.abs(speed))
    )
    barred = [(2.0, 2.5)] if kind == "barred" else []
    return Course(times, q, integral, path, lag=LAG, part=PART, longest=LONGEST, barred=barred)


def every_window(course: Course, seconds: float, barred: list[tuple[float, float]]) -> Excess:
    t, q, integral = course.t, course.q, course.dq_integral
    found = []
    for start, end in enumerate(np.searchsorted(t, t + seconds).tolist()):
        if end == len(t) or np.diff(t[start : end + 1]).max() > LONGEST:
            continue
        if t[end] - t[start] >= 2 * seconds:
            continue
        near = [integral[(t >= t[row] - LAG) & (t <= t[row] + LAG)] for row in (start, end)]
        moved = q[end] - q[start]
        beyond = max(
            moved - (near[1].max() - near[0].min()), (near[1].min() - near[0].max()) - moved
        ) - PART * (course.path[end] - course.path[start])
        if any(t[start] < b and t[end] > a for a, b in barred):
            beyond = -np.inf
        found.append(Excess(float(beyond), start, end))
    return max(found, key=lambda f: f.rad)


@pytest.mark.parametrize("kind", ["good", "jump", "frozen", "gaps", "barred"])
def test_the_largest_excess_is_that_of_all_windows(kind: str) -> None:
    course = a_course(kind, 1)
    barred = [(2.0, 2.5)] if kind == "barred" else []
    for seconds in (0.05, 0.4):
        wanted = every_window(course, seconds, barred)
        assert course.worst(seconds, -np.inf) == wanted
        assert course.worst(seconds, wanted.rad) == wanted
        lower = course.worst(seconds, wanted.rad + 1e-9)
        assert lower is None or lower.rad <= wanted.rad
        # the same from integrals that differ as sums round, and no more is integral to be possible
        rough = Course(
            course.times,
            course.q,
            course.dq_integral * (1 + 1e-13),
            course.path * (1 - 1e-13),
            exactly=lambda: (course.dq_integral, course.path),
            lag=LAG,
            part=PART,
            longest=LONGEST,
            barred=barred,
        )
        assert rough.bound([seconds]) >= wanted.rad
        assert rough.worst(seconds, -np.inf) == rough.worst(seconds, wanted.rad) == wanted


def delayed(kind: str) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(3)
    asked = np.cumsum(rng.normal(size=9100)) / 30
    seen = asked[60:9060] + rng.normal(size=9000) / 100
    return {
        "delayed": (seen, asked),
        "still": (np.zeros(9000), asked),
        "constant": (np.zeros(9000), np.zeros(9100)),
        "huge": (seen * 1e200, asked * 1e200),
    }[kind]
