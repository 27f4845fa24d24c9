"""By how much the pictures of a camera are behind the joints, by when both move."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.cameras import CameraTrack
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.motion import stroke
from dexkit.hand import Floats

__all__ = ["DRIFT", "Lag", "Motion", "motion_of"]

Lags = NDArray[np.int_]

DRIFT = 0.25
"""Seconds between start and end from which on a picture drifts."""
_ON_ARMS = frozenset({"wrist", "hand", "arm", "gripper", "ee"})
_DEAD = 0.01  # of a joint's stroke, which noise of the encoder may be
_STEP = 0.05  # s between values of speed that are compared
_SMOOTH = 3  # of them, over which joints and picture are smoothed alike
_LATEST = 2.0  # s that are looked at
_CLEAR, _CLEARER = 0.6, 0.12  # correlation of a clear peak, and how much better than elsewhere
_ELSEWHERE = 0.4  # s from a peak
_LEAST_LENGTH = 6.0  # s of an episode; in a shorter one anything may correlate
_EACH_THIRD = 0.3  # correlation in each third of the episode
_BETTER = 0.08  # than the best lag without drift; a picture in step gains a third of that
_CLEAR_DRIFT = 0.7  # correlation with the best drift
_IN_STEP = 0.5  # s
_DRIFTS: Floats = 0.2 * np.arange(-20, 21, dtype=np.float64)  # s from start to end that are tried


@dataclass(frozen=True, eq=False)
class Motion:
    """How the parts of a robot move.

    :param t: of the frames, s, shape (frames,).
    :param positions: of every joint that moves at all, in strokes, shape (frames, joints).
    :param part: of each joint, the index of its part, shape (joints,).
    :param parts: their names.
    """

    t: Floats
    positions: Floats
    part: NDArray[np.intp]
    parts: tuple[str, ...]

    @cached_property
    def speed(self) -> Floats:
        """Strokes a second, all joints of each part together, shape (frames, parts)."""
        found = np.zeros((len(self.t), len(self.parts)))
        if len(self.t) > 1 and self.positions.shape[1]:
            smooth = _smooth(self.positions, max(1, round(0.1 / self._period)))
            speeds = np.abs(np.gradient(smooth, self.t, axis=0))
            for i in range(len(self.parts)):
                found[:, i] = speeds[:, self.part == i].sum(axis=1)
        return found

    def seen_by(self, camera: str) -> Motion:
        """What a camera may see by its name: one on a wrist does not see the other arm move."""
        words = set(re.findall(r"[a-z]+", camera.lower()))
        sides = words & {"left", "right"}
        if len(sides) != 1 or not words & _ON_ARMS:
            return self  # cam_left_high is the left eye of a head
        other = ({"left", "right"} - sides).pop()
        kept = [i for i, name in enumerate(self.parts) if not name.startswith(other)]
        if not any(self.parts[i].startswith(*sides) for i in kept):
            return self
        columns = np.isin(self.part, kept)
        return replace(self, positions=self.positions[:, columns], part=self.part[columns])

    @property
    def _period(self) -> float:
        return float(np.median(np.diff(self.t)))

    def travel(self, begin: Floats, end: Floats) -> Floats:
        """How far each part gets between two times, in strokes, shape (times, parts).

        What noise of an encoder may be does not count.
        """
        found = np.zeros((len(begin), len(self.parts)))
        if not self.positions.shape[1]:
            return found
        a, b = (np.clip(np.searchsorted(self.t, x), 0, len(self.t) - 1) for x in (begin, end))
        way = np.maximum(np.abs(self.positions[b] - self.positions[a]) - _DEAD, 0.0)
        for i in range(len(self.parts)):
            found[:, i] = way[:, self.part == i].sum(axis=1)
        return found


@lru_cache(maxsize=1)
def motion_of(episode: Episode) -> Motion:
    """What moves in an episode: what was observed, or else commanded."""
    columns, parts = [], []
    for number, track in enumerate(episode.tracks):
        values = _positions(track)
        if values is not None:
            columns.append(values)
            parts += [number] * values.shape[1]
    shape = (len(episode), 0)
    positions = np.concatenate(columns, axis=1) if columns else np.zeros(shape)
    names = tuple(track.part for track in episode.tracks)
    return Motion(episode.t, positions, np.array(parts, np.intp), names)


def _positions(track: Track) -> Floats | None:
    """Positions in strokes, without gaps; None where the part has none."""
    values = track.state if track.state is not None else track.action
    if values is None or not len(values):
        return None
    values = values / stroke(track)
    finite = np.isfinite(values)
    if not finite.all():
        # the newest that is known
        rows = np.where(finite, np.arange(len(values))[:, None], 0)
        values = np.nan_to_num(np.take_along_axis(values, np.maximum.accumulate(rows), axis=0))
    return np.asarray(values)


def _smooth(values: Floats, width: int) -> Floats:
    """Means over ``width`` rows around each."""
    if width < 2:
        return values
    padded = np.concatenate([values[:1].repeat(width // 2, 0), values])
    padded = np.concatenate([padded, values[-1:].repeat(width - 1 - width // 2, 0)])
    sums = np.cumsum(np.concatenate([np.zeros_like(padded[:1]), padded]), axis=0)
    return np.asarray((sums[width:] - sums[:-width]) / width)


@dataclass(frozen=True)
class Lag:
    """By how much a picture is behind the joints, s.

    :param constant: the lag that fits best from start to end; ``clear`` whether it is certain.
    :param begin: the lag at the start of the best fit with a drift, and ``end`` at the end;
        ``drifts`` whether it is certain that it does.
    """

    constant: float
    begin: float
    end: float
    clear: bool
    drifts: bool

    def at(self, t: Floats) -> Floats:
        """The lag at times of pictures, s; 0 where it is not known."""
        if self.drifts and len(t):
            return self.begin + (self.end - self.begin) * t / max(float(t[-1]), 1e-3)
        return np.full(len(t), self.constant if self.clear else 0.0)

    @classmethod
    def of(cls, track: CameraTrack, motion: Motion) -> Lag | None:
        """None where there is too little to tell it by."""
        if len(track) < 30 or len(motion.t) < 30:
            return None
        end = min(float(track.t[-1]), float(motion.t[-1]))
        if end < _LEAST_LENGTH:
            return None
        times: Floats = np.arange(0.0, end, _STEP, dtype=np.float64)
        between = (track.t[1:] + track.t[:-1]) / 2
        seen = _speed(times, between, track.changes[1:])
        speeds = motion.speed
        signals = [speeds.sum(axis=1)]
        if np.count_nonzero(speeds.any(axis=0)) > 1:
            signals += [s for s in speeds.T if s.any()]  # a camera may see one arm only
        # the picture put right by each drift, and then by the lag that is left
        put_right = np.stack(
            [np.interp(times + drift * (times / times[-1] - 0.5), times, seen) for drift in _DRIFTS]
        )
        most = round(_LATEST / _STEP)
        lags = np.arange(-most, most + 1)
        best: tuple[float, Floats, Floats] | None = None
        for signal in signals:
            moved = _speed(times, motion.t, signal)
            curves = _correlations(put_right, moved, lags)
            if best is None or curves.max() > best[0] + 0.02:
                best = float(curves.max()), moved, curves
        assert best is not None
        _, moved, curves = best
        return _judged(times, seen, moved, curves, lags)


def _speed(times: Floats, t: Floats, values: Floats) -> Floats:
    """Speeds at regular times; of large ones their root, or the fastest motion would decide."""
    return _smooth(np.sqrt(np.interp(times, t, values))[:, None], _SMOOTH)[:, 0]


def _judged(times: Floats, seen: Floats, moved: Floats, curves: Floats, lags: Lags) -> Lag:
    """:param curves: correlations, shape (drifts, lags)."""
    steady = curves[len(_DRIFTS) // 2]
    constant, clear = _peak(steady, lags)
    row, column = np.unravel_index(int(np.argmax(curves)), curves.shape)
    drift, lag = float(_DRIFTS[row]), float(lags[column]) * _STEP
    begin, end = lag - drift / 2, lag + drift / 2
    best = float(curves[row, column])
    drifts = (
        abs(drift) >= DRIFT
        # a stream is in step where it is begun, or where it is cut
        and min(abs(begin), abs(end)) <= _IN_STEP
        and best >= max(_CLEAR_DRIFT, float(steady.max()) + _BETTER)
        and _fits_throughout(times, seen, moved, begin, end)
    )
    clear = clear and not drifts and _fits_throughout(times, seen, moved, constant, constant)
    return Lag(constant, begin, end, clear, drifts)


def _fits_throughout(times: Floats, seen: Floats, moved: Floats, begin: float, end: float) -> bool:
    """Whether a lag fits in each third: one burst of motion would fit to any other."""
    late_by = begin + (end - begin) * times / times[-1]
    right = np.interp(times + late_by, times, seen)
    both = (times + late_by >= 0) & (times + late_by <= times[-1])
    for part in np.array_split(np.flatnonzero(both), 3):
        if len(part) < 10 or not np.std(right[part]) or not np.std(moved[part]):
            return False
        if np.corrcoef(right[part], moved[part])[0, 1] < _EACH_THIRD:
            return False
    return True


def _correlations(seen: Floats, moved: Floats, lags: Lags) -> Floats:
    """Correlation of pictures, put earlier by each lag, with the joints.

    :param seen: shape (pictures, times).
    :returns: shape (pictures, lags).
    """
    n = seen.shape[1]
    a, b = seen - seen.mean(axis=1, keepdims=True), moved - moved.mean()
    size = 1 << (2 * n - 1).bit_length()
    products = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
    # of the times that both have at a lag
    power_a = np.cumsum(np.pad(a * a, ((0, 0), (1, 0))), axis=1)
    power_b = np.cumsum(np.pad(b * b, (1, 0)))
    of_a = power_a[:, np.minimum(n, n + lags)] - power_a[:, np.maximum(0, lags)]
    of_b = power_b[np.minimum(n, n - lags)] - power_b[np.maximum(0, -lags)]
    power = of_a * of_b
    enough = (np.abs(lags) < n // 2) & (power > 0)
    return np.asarray(
        np.where(enough, products[:, lags % size] / np.sqrt(np.where(enough, power, 1.0)), 0.0)
    )


def _peak(curve: Floats, lags: Lags) -> tuple[float, bool]:
    """The lag of the highest correlation, s, and whether it stands out."""
    top = int(np.argmax(curve))
    if not 0 < top < len(curve) - 1:
        return float(lags[top]) * _STEP, False
    far = np.abs(lags - lags[top]) * _STEP > _ELSEWHERE
    clear = curve[top] >= max(_CLEAR, curve[far].max(initial=-1.0) + _CLEARER)
    before, at, after = curve[top - 1 : top + 2]
    bend = before - 2 * at + after
    between = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(lags[top] + between) * _STEP, bool(clear)
