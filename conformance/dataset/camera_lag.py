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

__all__ = ["DRIFT", "LATENCY", "Lag", "Motion", "motion_of"]

Lags = NDArray[np.int_]

DRIFT = 0.25
"""Seconds between start and end from which on a picture drifts."""
LATENCY = 0.35
"""Seconds that a camera and its network, or the joints and theirs, may take."""
_ON_ARMS = frozenset({"wrist", "hand", "arm", "gripper", "ee"})
_DEAD = 0.01  # of a joint's stroke, which noise of the encoder may be
_STEP = 0.05  # s between values of speed that are compared
_AVERAGED = 0.15  # s of pictures before and after a time
_SMOOTH = 3  # of them, over which joints and picture are smoothed alike
_LATEST = 2.0  # s that are looked at
_CLEAR, _CLEARER = 0.6, 0.12  # correlation of a clear peak, and how much better than elsewhere
_ELSEWHERE = 0.4  # s from a peak
_LEAST_LENGTH = 6.0  # s of an episode; in a shorter one anything may correlate
_EACH_THIRD = 0.3  # correlation in each third of the episode
_BETTER = 0.12  # correlation, than in step; what fits by chance gains two thirds of that
_FASTEST_DRIFT = 0.25  # s a second: of few motions, two others fit if moved further
_CLEAR_DRIFT = 0.7  # correlation with the best drift
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
        seen = _seen(track, times)
        signals, arms = _signals(motion)
        if not len(signals):
            return None
        moved = np.stack([_speed(times, motion.t, signal) for signal in signals])
        # the picture put right by each drift, and then by the lag that is left
        put_right = np.stack(
            [np.interp(times + drift * (times / times[-1] - 0.5), times, seen) for drift in _DRIFTS]
        )
        most = round(_LATEST / _STEP)
        lags = np.arange(-most, most + 1)
        return _judged(times, seen, moved, arms, _correlations(put_right, moved, lags), lags)


def _seen(track: CameraTrack, times: Floats) -> Floats:
    """How fast a picture changes, by what is seen before and after each time.

    Pictures are averaged and what their noise changes is taken off: from one picture to the next a
    sensor's noise and a codec's key frames may change more than what moves.
    """
    flat = track.thumbs.reshape(len(track), -1).astype(np.float64)
    sums = np.concatenate([np.zeros_like(flat[:1]), np.cumsum(flat, axis=0)])
    width = max(_AVERAGED, 1.5 * float(np.median(np.diff(track.t))))

    def mean(begin: Floats, end: Floats) -> Floats:
        first = np.minimum(np.searchsorted(track.t, begin - 1e-6), len(track) - 1)
        last = np.maximum(np.searchsorted(track.t, end - 1e-6), first + 1)
        return np.asarray((sums[last] - sums[first]) / (last - first)[:, None])

    steps = np.abs(mean(times, times + width) - mean(times - width, times))
    low = len(times) // 5
    noise = 2 * np.partition(steps, low, axis=0)[low]
    return _smooth(np.sqrt(np.maximum(steps - noise, 0.0).sum(axis=1))[:, None], _SMOOTH)[:, 0]


def _signals(motion: Motion) -> tuple[list[Floats], NDArray[np.bool_]]:
    """Speeds of what a camera may see, and which of them hold an arm that moves, if any does.

    That is all parts together, those of a side, or one: it may see one arm only, whatever its name.
    """
    speeds = motion.speed
    moving = [i for i in range(len(motion.parts)) if speeds[:, i].any()]
    groups = [moving, *([i] for i in moving)]
    groups += [[i for i in moving if motion.parts[i].startswith(s)] for s in ("left", "right")]
    groups = [g for i, g in enumerate(groups) if g and g not in groups[:i]]
    arms = [any(motion.parts[i].endswith("arm") for i in group) for group in groups]
    return [speeds[:, group].sum(axis=1) for group in groups], np.array(arms) | (not any(arms))


def _speed(times: Floats, t: Floats, values: Floats) -> Floats:
    """Speeds at regular times; of large ones their root, or the fastest motion would decide."""
    return _smooth(np.sqrt(np.interp(times, t, values))[:, None], _SMOOTH)[:, 0]


def _judged(
    times: Floats, seen: Floats, moved: Floats, arms: NDArray[np.bool_], curves: Floats, lags: Lags
) -> Lag:
    """:param curves: correlations, shape (signals, drifts, lags).

    Of many lags and parts one fits by chance: so a picture is late only where it fits much better
    than in step with whatever moves.
    """
    begin = lags * _STEP - _DRIFTS[:, None] / 2
    end = lags * _STEP + _DRIFTS[:, None] / 2
    in_step = float(curves[:, (np.abs(begin) <= LATENCY) & (np.abs(end) <= LATENCY)].max())

    steady = curves[:, len(_DRIFTS) // 2]
    which = int(np.argmax(steady.max(axis=1) - (~arms)))
    constant, clear = _peak(steady[which], lags)
    if abs(constant) > LATENCY:
        clear = steady[which].max() >= max(_CLEAR, in_step + _BETTER)

    # a stream is in step where it is begun, or where it is cut
    possible = (np.abs(end - begin) >= DRIFT) & (np.minimum(np.abs(begin), np.abs(end)) <= LATENCY)
    possible &= np.abs(end - begin) <= _FASTEST_DRIFT * times[-1]
    fits = np.where(possible & arms[:, None, None], curves, -1.0)
    signal, row, column = np.unravel_index(int(np.argmax(fits)), fits.shape)
    first, last = float(begin[row, column]), float(end[row, column])
    others = max(in_step, float(steady.max()))
    drifts = bool(
        fits[signal, row, column] >= max(_CLEAR_DRIFT, others + _BETTER)
    ) and _fits_throughout(times, seen, moved[signal], first, last)
    clear = clear and not drifts and _fits_throughout(times, seen, moved[which], constant, constant)
    return Lag(constant, first, last, bool(clear), drifts)


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
    :param moved: shape (signals, times).
    :returns: shape (signals, pictures, lags).
    """
    n = seen.shape[1]
    size = 1 << (2 * n - 1).bit_length()
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (seen, moved))
    spectrum, others = np.fft.rfft(a, size), np.conj(np.fft.rfft(b, size))
    products = np.stack([np.fft.irfft(spectrum * o, size)[:, lags % size] for o in others])
    # of the times that both have at a lag
    power_a = np.cumsum(np.pad(a * a, ((0, 0), (1, 0))), axis=1)
    power_b = np.cumsum(np.pad(b * b, ((0, 0), (1, 0))), axis=1)
    of_a = power_a[:, np.minimum(n, n + lags)] - power_a[:, np.maximum(0, lags)]
    of_b = power_b[:, np.minimum(n, n - lags)] - power_b[:, np.maximum(0, -lags)]
    power = of_a * of_b[:, None]
    enough = (np.abs(lags) < n // 2) & (power > 0)
    return np.asarray(np.where(enough, products / np.sqrt(np.where(enough, power, 1.0)), 0.0))


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
