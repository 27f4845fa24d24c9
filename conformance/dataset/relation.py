"""How the state of a part follows its action; computed once for a part."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.motion import middle, quick_size, stroke
from dexkit.hand import Floats

__all__ = [
    "Moments",
    "Relation",
    "correlations",
    "middle",
    "moments",
    "relations",
    "running",
    "shifted",
]

_RATE = 25.0  # Hz at which parts are compared: hands and arms move below 5 Hz
_EARLIEST = 0.4  # s by which a state may be ahead: a set whose action is late is judged elsewhere
_LATEST = 1.0  # s of delay that are tried: hands and their recorders take up to 0.6
_LATE = 0.6  # s that a hand may take to begin: Inspire's take 0.4 behind a robot's network
_LEAST = 12  # frames that are compared at least
_MOVES = 0.04  # of the stroke: less is noise, or the last step of a coarse encoder (64 of a stroke)


@dataclass(frozen=True, eq=False)
class Moments:
    """Means, variances and covariance of the columns of two tables, shape (columns,) each."""

    mean_s: Floats
    mean_a: Floats
    var_s: Floats
    var_a: Floats
    cov: Floats

    @property
    def correlation(self) -> Floats:
        """0 where one does not move."""
        size = np.sqrt(self.var_s * self.var_a)
        return np.asarray(np.where(size > 1e-18, self.cov / np.where(size > 0, size, 1), 0.0))

    def apart(self, scale: Floats | float = 1.0, offset: Floats | float = 0.0) -> Floats:
        """RMS of ``scale * s + offset - a``."""
        square = (
            scale * scale * self.var_s
            + self.var_a
            - 2 * scale * self.cov
            + (scale * self.mean_s + offset - self.mean_a) ** 2
        )
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def moments(state: Floats, action: Floats) -> Moments:
    """Of two tables of the same shape."""
    count = len(state)
    mean_s, mean_a = state.sum(axis=0) / count, action.sum(axis=0) / count
    s, a = state - mean_s, action - mean_a
    return Moments(
        mean_s,
        mean_a,
        np.einsum("ij,ij->j", s, s) / count,
        np.einsum("ij,ij->j", a, a) / count,
        np.einsum("ij,ij->j", s, a) / count,
    )


@dataclass(frozen=True, eq=False)
class Relation:
    """A part's frames that have both state and action, at 25 Hz or less.

    :param track: the part.
    :param t: s, shape (n,); ``step`` is the usual time between two.
    :param state: shape (n, joints); likewise ``action``.
    :param stroke: how far each joint goes, shape (joints,).
    :param lag: frames by which the state is behind its action, as all joints together show it.
    """

    track: Track
    t: Floats
    step: float
    state: Floats
    action: Floats
    stroke: Floats
    lag: int

    @property
    def part(self) -> str:
        """Name of the part."""
        return self.track.part

    @cached_property
    def state_span(self) -> Floats:
        """Highest less lowest, shape (joints,)."""
        return np.asarray(self.state.max(axis=0) - self.state.min(axis=0))

    @cached_property
    def action_span(self) -> Floats:
        """Highest less lowest, shape (joints,)."""
        return np.asarray(self.action.max(axis=0) - self.action.min(axis=0))

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Joints whose state and action both move, shape (joints,)."""
        return np.asarray(np.minimum(self.state_span, self.action_span) > _MOVES * self.stroke)

    @cached_property
    def pair(self) -> tuple[Floats, Floats]:
        """State and action with the lag taken out."""
        return shifted(self.state, self.action, self.lag)

    @cached_property
    def moments(self) -> Moments:
        """Of state and action with the lag taken out."""
        return moments(*self.pair)

    @cached_property
    def own(self) -> Floats:
        """Correlation of each joint's state with its action, without the lag."""
        return self.moments.correlation

    @cached_property
    def fit(self) -> tuple[Floats, Floats]:
        """Slope and offset of the line from a joint's action to its state, shape (joints,) each."""
        m = self.moments
        slope = np.where(m.var_a > 1e-12, m.cov / np.where(m.var_a > 1e-12, m.var_a, 1), 0.0)
        return slope, m.mean_s - slope * m.mean_a

    @cached_property
    def apart(self) -> Floats:
        """RMS distance of state and action without the lag, in strokes, shape (joints,)."""
        return self.moments.apart() / self.stroke

    @cached_property
    def farthest(self) -> Floats:
        """Largest distance of state and action without the lag, shape (joints,)."""
        state, action = self.pair
        return np.asarray(np.abs(state - action).max(axis=0))

    @cached_property
    def asked(self) -> tuple[Floats, Floats]:
        """Lowest and highest position that each joint was asked for in the time that it may take to
        begin, shape (n, joints).
        """
        late = max(_LATE, self.lag * self.step + 0.3)
        back, ahead = max(1, round(late / self.step)), max(1, round(0.1 / self.step))
        return (
            running(self.action, back, ahead, np.minimum),
            running(self.action, back, ahead, np.maximum),
        )

    @property
    def lags(self) -> range:
        """Delays, in frames, that a hand or an arm may have."""
        return range(min(round(0.7 / self.step), len(self.t) // 3) + 1)

    @cached_property
    def increments(self) -> bool:
        """Whether the actions are steps, not positions: they move as the state's speed."""
        if not self.moving.any() or middle(self.own[self.moving]) > 0.6:
            return False
        speed = np.gradient(self.state, axis=0)
        found = moments(*shifted(speed, self.action, self.lag)).correlation
        return middle(found[self.moving]) > 0.8  # speed is noisy, other signals are 0


@lru_cache(maxsize=1)  # the episode that is being judged, and no memory for others
def relations(episode: Episode) -> tuple[Relation, ...]:
    """The parts that have a state and an action to compare."""
    found = [_relation(episode, track) for track in episode.tracks]
    return tuple(r for r in found if r is not None)


def _relation(episode: Episode, track: Track) -> Relation | None:
    """A part of an episode; None where there is too little of it."""
    if track.state is None or track.action is None or len(episode) < _LEAST:
        return None
    if track.state.shape != track.action.shape:
        return None
    steps = episode.t[1:] - episode.t[:-1]
    stride = max(1, int(1 / (_RATE * max(middle(steps), 1e-4))))
    state, action, t = track.state[::stride], track.action[::stride], episode.t[::stride]
    whole = np.isfinite(state.sum(axis=1) + action.sum(axis=1))
    if not whole.all():
        state, action, t = state[whole], action[whole], t[whole]
    if len(t) < _LEAST:
        return None
    step = middle(t[1:] - t[:-1])
    wide = stroke(track)
    return Relation(track, t, step, state, action, wide, _lag(state, action, wide, step))


def _lag(state: Floats, action: Floats, wide: Floats, step: float) -> int:
    (s, of_state), (a, of_action) = _centred(state), _centred(action)
    spread = np.minimum(of_state, of_action) / np.sqrt(len(state))
    moving = spread > _MOVES / 4 * wide
    if not moving.any():
        return 0
    s, a = s[:, moving] / of_state[moving], a[:, moving] / of_action[moving]
    most = len(state) // 3
    back, late = min(round(_EARLIEST / step), most), min(round(_LATEST / step), most)
    # all shifts at once, with room for the longest: not divided by the overlap, as ends lose
    # little, and no shift wins by a short one
    size = quick_size(len(state) + max(back, late))
    both = np.fft.rfft(np.concatenate((s.T, a.T)), size)
    count = len(both) // 2
    score = np.fft.irfft(np.einsum("ij,ij->j", both[:count], both[count:].conj()), size)
    return int(np.argmax(score[np.arange(-back, late + 1)])) - back


def running(values: Floats, back: int, ahead: int, best: np.ufunc) -> Floats:
    """The best of the last ``back`` and the next ``ahead`` rows, for each row."""
    found, reach = values, 1
    wide = back + ahead + 1
    while reach < wide:
        step = min(reach, wide - reach)
        moved = np.concatenate((np.repeat(found[:1], step, axis=0), found[:-step]))[: len(values)]
        found, reach = best(found, moved), reach + step
    last = np.repeat(found[-1:], ahead, axis=0)
    return np.asarray(np.concatenate((found[ahead:], last))[: len(values)])


def shifted(state: Floats, action: Floats, lag: int) -> tuple[Floats, Floats]:
    """The rows of the two that belong together if the state is ``lag`` frames behind."""
    if lag > 0:
        return state[lag:], action[:-lag]
    return (state[:lag], action[-lag:]) if lag < 0 else (state, action)


def correlations(left: Floats, right: Floats) -> Floats:
    """Correlation of each column with each of the other table; 0 where one does not move."""
    return np.asarray(np.einsum("ij,ik->jk", _unit(left), _unit(right)))


def _centred(values: Floats) -> tuple[Floats, Floats]:
    """Columns without their mean, and the length of each, shape (columns,)."""
    found = values - values.sum(axis=0) / len(values)
    return found, np.sqrt(np.einsum("ij,ij->j", found, found))


def _unit(values: Floats) -> Floats:
    """Columns without their mean and of length 1; 0 where one does not move."""
    found, size = _centred(values)
    return np.asarray(found / np.where(size > 1e-9 * np.sqrt(len(values)), size, np.inf))
