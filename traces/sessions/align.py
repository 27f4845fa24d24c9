"""Find the time offset between two recordings of one motion by cross-correlation.

Both sides are sampled on one grid, and for every shift the correlation coefficient of all joints
together is computed over the overlapping samples (with masks, so that gaps do not count). It is 1
for the same motion; its distance from the best coefficient at another shift tells whether the match
is unique.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats
from dexkit.traces.sessions.resample import gap_of, interpolate

__all__ = ["Alignment", "Track", "align"]

Times = NDArray[np.int64]

# Seconds of a step of the grid; finer than a command's period, refined by a parabola afterwards.
_STEP = 0.01
# Longest grid, samples: 30 min. Beyond that the step is larger.
_LONGEST = 180_000
# Seconds around the best shift in which a second one does not count: neighbours correlate.
_NEIGHBOURHOOD = 0.5
# rad (or of the unit's range) below which a joint does not move.
_STILL = 1e-3


@dataclass(frozen=True)
class Track:
    """One quantity on both sides, shape (n, k) each, with its times in ns."""

    a_times: Times
    a: Floats
    b_times: Times
    b: Floats


@dataclass(frozen=True)
class Alignment:
    """Offset of the motion of B in A, and its quality.

    :param offset: seconds by which B is later: a time of B minus ``offset`` is a time of A.
    :param correlation: coefficient at that shift, -1 to 1.
    :param elsewhere: the best coefficient further than half a second away, 0 if there is none.
    :param overlap: seconds that both cover at that shift.
    """

    offset: float
    correlation: float
    elsewhere: float
    overlap: float

    @property
    def confidence(self) -> float:
        """0 to 1: how good the best shift is, and how much better than any other."""
        lead = max(self.correlation - max(self.elsewhere, 0.0), 0.0)
        return max(self.correlation, 0.0) * min(1.0, lead / 0.2)


def align(
    tracks: Sequence[Track], *, least_overlap: float = 1.0, step: float = _STEP
) -> Alignment | None:
    """The shift at which B correlates best with A; None without motion or overlap.

    :param least_overlap: seconds that both must cover at a shift for it to count; at least half of
        the shorter side.
    :param step: seconds of a step of the grid; a parabola refines the best one.
    """
    tracks = [t for t in tracks if len(t.a_times) > 1 and len(t.b_times) > 1]
    if not tracks:
        return None
    a_begin, a_end = _span([t.a_times for t in tracks])
    b_begin, b_end = _span([t.b_times for t in tracks])
    step = max(step, max(a_end - a_begin, b_end - b_begin) / 1e9 / _LONGEST)
    a_grid = np.arange(a_begin, a_end + 1, round(step * 1e9))
    b_grid = np.arange(b_begin, b_end + 1, round(step * 1e9))
    size = 1 << int(np.ceil(np.log2(len(a_grid) + len(b_grid))))
    covariance: Floats = np.zeros(size)
    a_power: Floats = np.zeros(size)
    b_power: Floats = np.zeros(size)
    overlap: Floats = np.zeros(size)
    for t in tracks:
        a_all = interpolate(t.a_times, t.a, a_grid, max(gap_of(t.a_times), 2 * step))
        b_all = interpolate(t.b_times, t.b, b_grid, max(gap_of(t.b_times), 2 * step))
        for a, b in zip(a_all.T, b_all.T, strict=True):
            if not (_moves(a) and _moves(b)):
                continue
            n, sums = _masked(a, b, size)
            covariance = covariance + sums[0]
            a_power = a_power + sums[1]
            b_power = b_power + sums[2]
            overlap = np.maximum(overlap, n)
    # at a shift where one side stands still, the correlation is random
    floor = 0.05 * np.sqrt(a_power.max(initial=0.0) * b_power.max(initial=0.0))
    power = np.sqrt(np.maximum(a_power, 0) * np.maximum(b_power, 0))
    least = max(least_overlap, 0.5 * float(overlap.max(initial=0.0)) * step)
    possible = (overlap * step >= least) & (power > max(floor, 1e-9))
    if not possible.any():
        return None
    r = np.where(possible, covariance / np.where(power > 0, power, 1.0), -2.0)
    # index k is a shift of k samples, those above the length of A are negative ones
    order = np.concatenate([np.arange(size - len(b_grid) + 1, size), np.arange(len(a_grid))])
    shifts = np.concatenate([np.arange(-len(b_grid) + 1, 0), np.arange(len(a_grid))])
    r, n = np.clip(r[order], -2.0, 1.0), overlap[order]
    best = int(np.argmax(r))
    shift = float(shifts[best])
    if 0 < best < len(r) - 1 and r[best - 1] > -2 and r[best + 1] > -2:
        bend = r[best - 1] - 2 * r[best] + r[best + 1]
        if bend < 0:
            shift += 0.5 * float(r[best - 1] - r[best + 1]) / float(bend)
    far = np.abs(shifts - shifts[best]) * step > _NEIGHBOURHOOD
    elsewhere = float(r[far].max(initial=0.0))
    # sample i of B lies at sample i + shift of A
    offset = (b_begin - a_begin) / 1e9 - shift * step
    return Alignment(offset, float(r[best]), max(elsewhere, 0.0), float(n[best] * step))


def _span(times: Sequence[Times]) -> tuple[int, int]:
    return min(int(t[0]) for t in times), max(int(t[-1]) for t in times)


def _moves(values: Floats) -> bool:
    good = values[np.isfinite(values)]
    return len(good) > 1 and float(np.std(good)) > _STILL


def _masked(a: Floats, b: Floats, size: int) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
    """For every shift: samples that both have, and over these covariance and both variances."""
    there_a, there_b = np.isfinite(a), np.isfinite(b)
    a = np.where(there_a, a - a[there_a].mean(), 0.0)
    b = np.where(there_b, b - b[there_b].mean(), 0.0)
    fa, fb = np.fft.rfft(a, size), np.conj(np.fft.rfft(b, size))
    ma, mb = np.fft.rfft(there_a, size), np.conj(np.fft.rfft(there_b, size))
    n = np.rint(np.fft.irfft(ma * mb, size))
    count = np.maximum(n, 1.0)
    sum_a, sum_b = np.fft.irfft(fa * mb, size), np.fft.irfft(ma * fb, size)
    cov = np.fft.irfft(fa * fb, size) - sum_a * sum_b / count
    var_a = np.fft.irfft(np.fft.rfft(a * a, size) * mb, size) - sum_a**2 / count
    var_b = np.fft.irfft(ma * np.conj(np.fft.rfft(b * b, size)), size) - sum_b**2 / count
    return n, (cov, np.maximum(var_a, 0.0), np.maximum(var_b, 0.0))
