"""Measures of motion that several checks use; computed once for an episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.hand import Floats

__all__ = [
    "Series",
    "frames_of",
    "joined",
    "joints_text",
    "median",
    "medians",
    "middle",
    "moves",
    "part_text",
    "quick_size",
    "runs_of",
    "runs_of_joints",
    "series_of",
    "span",
    "speed_of",
    "stroke",
]

Bools = NDArray[np.bool_]

_REVERSALS = 12  # that a joint must show before its noise is spoken of
_LARGEST = 1e6  # strokes, of numbers that are none: their squares are numbers still
_LEAP = 3.0  # a leap's step against the fastest of its neighbours
_STILL = 0.05  # share of frames with no change, at most, of a sensor that is called live: eight
# such frames in a row are no chance


def span(values: Floats | None) -> Floats:
    """Highest less lowest value of each joint, shape (joints,); 0 where there is none."""
    if values is None or not len(values):
        return np.zeros(0 if values is None else values.shape[1])
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0)
    high = np.where(finite, values, -np.inf).max(axis=0)
    found: Floats = np.where(high >= low, high - low, 0.0)
    return found


def middle(values: Floats) -> float:
    """The median, the higher of two; quicker than numpy's for a few values."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def quick_size(least: int) -> int:
    """A length, not less, for which a Fourier transform is quick."""
    power = 1 << max(least - 1, 1).bit_length()
    return next(n for n in (power * 5 // 8, power * 3 // 4, power) if n >= least)


@lru_cache(maxsize=64)
def stroke(track: Track) -> Floats:
    """How far each joint can go, shape (joints,): by its limits, else by what is seen of it, and
    1 at least: a joint of unknown range that hardly moves is not measured by its noise.
    """
    if track.limits is not None:
        low, high = track.limits
        return np.asarray(high - low)
    seen = [span(v) for v in (track.state, track.action) if v is not None]
    return np.asarray(np.maximum(np.max(seen, axis=0), 1.0))


def runs_of(mask: NDArray[np.bool_], least: int = 1) -> Iterator[tuple[int, int]]:
    """Begin and end (exclusive) of each run of true values that is at least so long."""
    if not mask.any():
        return
    room = np.zeros(len(mask) + 2, dtype=np.bool_)
    room[1:-1] = mask
    edges = np.flatnonzero(room[1:] != room[:-1])
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin >= least:
            yield begin, end


def runs_of_joints(mask: Bools, least: int = 1) -> Iterator[tuple[int, int, int]]:
    """The same of each joint, shape (frames, joints): joint, begin and end."""
    if not mask.any():
        return
    count = len(mask) + 1
    room = np.zeros((mask.shape[1], count), dtype=np.bool_)  # a frame between two joints
    room[:, 1:] = mask.T
    for begin, end in runs_of(room.ravel(), least):
        joint = begin // count
        yield joint, begin - joint * count - 1, end - joint * count - 1


def medians(values: Floats) -> Floats:
    """As numpy's of finite numbers along the first axis, and quicker where they are few."""
    half = len(values) // 2
    if len(values) % 2:
        return np.asarray(np.partition(values, half, axis=0)[half])
    both = np.partition(values, (half - 1, half), axis=0)
    return np.asarray(0.5 * (both[half - 1] + both[half]))


def median(values: Floats) -> float:
    """The same of one row."""
    return float(medians(values))


@dataclass(frozen=True, eq=False)
class Series:
    """The states, or the actions, of a part, prepared for comparisons of frames.

    :param q: parts of the stroke, shape (frames, joints); a frame without a value repeats the one
        before it.
    :param there: whether a frame has values, shape (frames,).
    :param steps: change from the frame before, shape (frames, joints); 0 in the first frame, and
        where either frame has no value.
    :param same: whether a joint has exactly the value of the frame before, likewise; false where
        either has none.
    :param quantum: the smallest change, shape (joints,): a step of a coarse encoder.
    :param noise: standard deviation of what is no motion, shape (joints,).
    """

    q: Floats
    there: Bools
    steps: Floats
    same: Bools
    quantum: Floats
    noise: Floats

    @cached_property
    def size(self) -> Floats:
        """The steps without their sign, shape (frames, joints)."""
        return np.abs(self.steps)

    @cached_property
    def spans(self) -> Floats:
        """Highest less lowest, shape (joints,)."""
        return np.asarray(self.q.max(axis=0) - self.q.min(axis=0))

    def around(self, width: int = 0) -> Floats:
        """The largest step of the three frames before each frame, and of the three that follow
        it and ``width`` more, shape (frames, joints).
        """
        count = len(self.q)
        found = self._threes[:count].copy(order="K")
        after = found[: max(count - width, 0)]
        np.maximum(after, self._threes[4 + width :][: len(after)], out=after)
        return found

    @cached_property
    def _threes(self) -> Floats:
        """The largest of three steps, of which the first ones end before the first frame."""
        padded = np.zeros((len(self.q) + 6, self.q.shape[1]), order="F")
        padded[3:-3] = self.size
        return np.asarray(np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:]))

    @cached_property
    def leaps(self) -> Bools:
        """Frames and joints whose step is far larger than those around it."""
        floor = 3 * self.quantum + 6 * self.noise + 0.004
        return np.asarray(self.size > _LEAP * self.around() + floor)

    def live(self, calm: Bools | None = None) -> Bools:
        """Whether each joint trembles, shape (joints,): its changes reverse again and again and
        have many sizes, as those of a sensor do, and not those of an encoder between two steps.

        :param calm: frames to look at, shape (frames,) or (frames, joints); all without.
        """
        later, before = self.steps[1:], self.steps[:-1]
        turned = later * before < 0
        still = self.same[1:]
        count: NDArray[np.intp] | int = len(turned)
        if calm is not None:
            table = calm if calm.ndim == 2 else calm[:, None]
            look = table[1:] & table[:-1]
            turned &= look
            still = still & look
            count = look.sum(axis=0)
        turns = turned.sum(axis=0)
        # one of few steps again and again is an encoder at the edge of a step
        wide = np.abs(later - before) > 4 * self.quantum
        return np.asarray(
            (turns >= _REVERSALS)
            & (turns >= 0.25 * count)
            & ((turned & wide).sum(axis=0) > 0.6 * turns)
            & (still.sum(axis=0) < _STILL * count)
        )


def series_of(track: Track, what: str) -> Series | None:
    """The ``state`` or the ``action`` of a part; None where it has none, or less than 3 frames."""
    return _series_of(track, what)


@lru_cache(maxsize=64)
def _series_of(track: Track, what: str) -> Series | None:
    values = track.state if what == "state" else track.action
    if values is None or len(values) < 3:
        return None
    finite = np.isfinite(values)
    whole = bool(finite.all())
    there: Bools = np.asarray(finite.all(axis=1))
    if there.sum() < 3:
        return None
    scaled = np.asfortranarray(values / stroke(track))  # joint by joint: sums are quick
    np.clip(scaled, -_LARGEST, _LARGEST, out=scaled)
    if not whole:
        last = np.maximum.accumulate(np.where(there, np.arange(len(there)), -1))
        last[last < 0] = int(np.argmax(there))
        scaled = scaled[last]
    steps = np.zeros_like(scaled)
    steps[1:] = scaled[1:] - scaled[:-1]
    both = np.zeros(len(there), dtype=np.bool_)
    both[1:] = there[1:] & there[:-1]
    same = steps == 0
    if whole:
        same[0] = False
    else:
        same &= both[:, None]
        steps[~both] = 0
    sizes = np.abs(steps)
    quantum = np.where(sizes > 1e-7, sizes, np.inf).min(axis=0)
    bends = np.abs(steps[2:] - steps[1:-1])
    # the calm third of an episode: 0.385 sigma below which 30 % of a normal distribution lie; a
    # second difference has 6 times the variance
    third = int(0.3 * (len(bends) - 1))
    noise = np.partition(bends, third, axis=0)[third] / (0.385 * np.sqrt(6.0))
    return Series(scaled, there, steps, same, np.where(np.isfinite(quantum), quantum, 0), noise)


def moves(series: Series, least: float = 0.05) -> Bools:
    """Whether each joint moves, shape (joints,): by a part of its stroke, and beyond its noise."""
    return np.asarray(series.spans > np.maximum(least, 12 * series.noise))


def part_text(part: str) -> str:
    """How texts call a part: ``left_hand`` is ``the left hand``."""
    return "the " + part.replace("_", " ") if part else "all parts"


def joints_text(track: Track, joints: Sequence[int]) -> str:
    """How texts call some joints of a part."""
    count = len(track.joints)
    if len(joints) >= count:
        return part_text(track.part)
    if len(joints) == 1:
        return f"joint {track.joints[joints[0]]} of {part_text(track.part)}"
    return f"{len(joints)} of {count} joints of {part_text(track.part)}"


@lru_cache(maxsize=1)  # of the episode that is being judged
def joined(episode: Episode) -> Bools:
    """Whether each frame follows the one before it by one period, shape (frames,)."""
    found = np.ones(len(episode), dtype=np.bool_)
    steps = episode.t[1:] - episode.t[:-1]
    found[1:] = steps < 1.6 * median(steps) if len(steps) else True
    return found


def speed_of(track: Track) -> Floats | None:
    """The velocities that the part states, strokes per second; 0 where there is none."""
    if track.dq is None or (track.state is None and track.action is None):
        return None
    speed = np.nan_to_num(track.dq, posinf=0.0, neginf=0.0) / stroke(track)
    return np.asarray(np.clip(speed, -_LARGEST, _LARGEST))


def frames_of(episode: Episode, seconds: float) -> int:
    """The number of frames that a time takes, 1 at least."""
    return max(1, round(seconds * episode.fps))
