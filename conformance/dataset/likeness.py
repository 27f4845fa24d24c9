"""Find the motion of an episode in another one, by few numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.motion import series_of
from dexkit.hand import Floats

__all__ = ["alike", "shape_of"]

_STEP_S = 0.2  # s between two numbers; twice as long until there are few enough
_MOST = 128
_SMOOTH_S = 0.25  # s of each of three averages: nothing faster than 2 Hz is left
_CUT_S = 1.2  # s by which an end may have been cut
_OTHER = (
    0.03  # difference, against the motion: a copy with noise has less, another take 0.3 or more
)
_LEAST = 0.85  # of the longer one that must be in both
_ROUGH = 0.2  # the same at a shift that is wrong by a quarter of a step, 0.1 for a quick motion
_STILL = 0.02  # strokes: less is no motion that could be found again


def shape_of(episode: Episode) -> list[float]:
    """The motion of an episode: the time between two numbers, s, and a mixture of all joints at
    these times, smoothed; empty where nothing moves.
    """
    found = [
        series.q
        for track in sorted(episode.tracks, key=lambda t: t.part)
        for what in ("action", "state")
        if (series := series_of(track, what)) is not None
    ]
    if not found or episode.duration < 5 * _STEP_S:
        return []
    table = np.concatenate(found, axis=1)
    weights = np.cos(0.4 + 2.3999632 * np.arange(table.shape[1]))  # no two joints count alike
    mixed = table @ weights
    mixed = mixed - mixed[0]  # so that the ends of the averages stay near
    width = max(1, round(_SMOOTH_S * episode.fps))
    for _ in range(3):
        mixed = _averaged(mixed, width)
    if np.ptp(mixed) < _STILL:
        return []
    step = _STEP_S
    while episode.duration / step > _MOST:
        step *= 2
    at = np.arange(0, episode.duration, step)
    return [step, *(round(float(v), 4) for v in np.interp(at, episode.t, mixed))]


def _averaged(values: Floats, width: int) -> Floats:
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    sums = np.concatenate([[0.0], np.cumsum(padded)])
    return np.asarray((sums[width:] - sums[:-width]) / width)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A motion, with what a copy of it must agree in."""

    step: float
    values: Floats

    @property
    def seconds(self) -> float:
        return self.step * len(self.values)

    @property
    def spread(self) -> float:
        return float(self.values.std())


def alike(shapes: Mapping[str, Sequence[float]]) -> Iterator[tuple[str, str, float]]:
    """Pairs of names with nearly the same motion, and their difference against the motion.

    :param shapes: by name, as :func:`shape_of` returns them; of episodes with the same joints.
    """
    known = [(n, _Shape(s[0], np.array(s[1:]))) for n, s in shapes.items() if len(s) > 5]
    known.sort(key=lambda item: item[1].seconds)
    seconds = np.array([s.seconds for _, s in known])
    spreads = np.array([s.spread for _, s in known])
    for i, (name, shape) in enumerate(known):
        last = int(np.searchsorted(seconds, seconds[i] + _CUT_S + shape.step, side="right"))
        others = np.flatnonzero(
            np.abs(spreads[i + 1 : last] - spreads[i]) < 0.15 * max(spreads[i], 1e-9)
        )
        for k in _near(shape, [known[k][1] for k in (others + i + 1).tolist()]):
            other, second = known[others[k] + i + 1]
            difference = _difference(shape, second)
            if difference < _OTHER:
                yield name, other, difference


def _near(shape: _Shape, others: Sequence[_Shape]) -> Iterator[int]:
    """Which of the others may be alike, by a look at all of them together."""
    for step in {other.step for other in others}:  # never shorter than that of the first
        places = [i for i, other in enumerate(others) if other.step == step]
        rows = [others[i].values for i in places]
        lengths = np.array([len(row) for row in rows])
        table = np.zeros((len(rows), lengths.max()))
        for row, values in zip(table, rows, strict=True):
            row[: len(values)] = values
        x = shape.values[:: round(step / shape.step)]
        for i in np.flatnonzero(_rough(x, table, lengths, step) < _ROUGH).tolist():
            yield places[i]


def _rough(x: Floats, table: Floats, lengths: NDArray[np.intp], step: float) -> Floats:
    """The least difference of one motion from others at shifts of half a step, shape (others,).

    :param table: the others, shape (others, numbers); 0 behind the end of each.
    """
    best = np.full(len(table), np.inf)
    least = _LEAST * np.maximum(lengths, len(x)) - 5
    reach = int(np.ceil(_CUT_S / step))
    between = (table[:, 1:] + table[:, :-1]) / 2
    for shift in range(-reach, reach + 1):
        for half, values in enumerate((table, between)):
            begin, end = max(2, 1 - shift), min(len(x) - 2, values.shape[1] - shift)
            if end - begin < least.min():
                continue
            there = np.arange(begin, end) + shift < (lengths - 2 - half)[:, None]
            count = there.sum(axis=1)
            wanted = np.where(there, x[begin:end], 0.0)
            apart = np.where(there, x[begin:end] - values[:, begin + shift : end + shift], 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.sqrt(_variance(apart, count) / _variance(wanted, count))
            good = (count >= least) & np.isfinite(ratio)
            best[good] = np.minimum(best[good], ratio[good])
    return best


def _variance(values: Floats, count: NDArray[np.intp]) -> Floats:
    """Of each row, of which ``count`` are values and the others 0."""
    mean = values.sum(axis=1) / count
    return np.asarray(np.maximum(np.einsum("ij,ij->i", values, values) / count - mean**2, 0.0))


def _difference(a: _Shape, b: _Shape) -> float:
    """The root mean square of the difference at the best shift, against the motion."""
    step = max(a.step, b.step)
    x, y = (s.values[:: round(step / s.step)] for s in (a, b))
    if len(x) > len(y):
        x, y = y, x
    reach = int(np.ceil(_CUT_S / step))
    whole = np.arange(-reach, reach + 1, dtype=float)
    nearest = whole[np.argmin(_apart(x, y, whole))]
    return float(_apart(x, y, np.linspace(nearest - 1, nearest + 1, 33)).min())


def _apart(x: Floats, y: Floats, shifts: Floats) -> Floats:
    """The difference at each shift, shape (shifts,); infinite where too little is left."""
    where = np.arange(len(x)) + shifts[:, None]
    there = (where >= 1) & (where <= len(y) - 2.001)
    there[:, :2] = there[:, -2:] = False  # the averages differ at a cut
    count = there.sum(axis=1)
    wanted = np.where(there, x, 0.0)
    apart = np.where(there, x - _cubic(y, np.where(there, where, 1.0)), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(_variance(apart, count) / _variance(wanted, count))
    return np.where((count + 5 >= _LEAST * len(y)) & np.isfinite(ratio), ratio, np.inf)


def _cubic(values: Floats, at: Floats) -> Floats:
    """Interpolated by cubics through four neighbours; 1 <= at < len(values) - 2."""
    i = np.floor(at).astype(int)
    u = at - i
    a, b, c, d = (values[i + k] for k in (-1, 0, 1, 2))
    return np.asarray(
        b + 0.5 * u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))
    )
