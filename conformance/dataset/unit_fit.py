"""Recognise the unit that positions have, where it is not that of the joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.limits import misplaced, reach_of, rows_of
from dexkit.conformance.dataset.relation import Relation, middle, moments, shifted
from dexkit.hand import Floats

__all__ = ["Units", "is_radians", "other_units", "wrong_units"]

_APART = 0.12  # strokes RMS between state and action: less is lag, an object, or a coarse unit
_FITS = 0.06  # strokes RMS that are left if the unit is found: lag and noise
_BETTER = 0.3  # of what it was, is what is left then
_RELATED = 0.8  # correlation of the two, whichever unit they have
_LIKE = 0.5  # of the span of the other, is that of what follows it or is followed
_BEYOND = 0.12  # strokes beyond a limit, that are no end stop, zero or noise
_OFTEN = 0.03  # of the frames, that are beyond it: not one spike
_INSIDE = 0.98  # of the values that lie within the limits if the unit is found
_HARDLY = 0.08  # of the stroke: a hand that is used moves more
_TURN = 7.0  # rad: no arm turns so far
_MOST_DEGREES = 400.0
_ONE = 1.06  # most that a hand reaches which counts in parts of its travel
_FACTOR = 2.0  # between action and state, that neither an object nor a weak arm makes
_NEAR = 0.12  # logarithm: 12 % from a known factor, by noise and sag
_SPREAD = 0.3  # of the factor, between the joints: more is no unit

Limits = tuple[Floats, Floats]
Line = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""From limits, scale and offset of each joint, which make the unit of the limits."""


def _turns(factor: float) -> Line:
    return lambda low, high: (np.full(len(low), factor), np.zeros(len(low)))


def _share(whole: float) -> Line:
    return lambda low, high: ((high - low) / whole, low)


def _rest(whole: float) -> Line:
    return lambda low, high: ((low - high) / whole, high)


_UNITS: tuple[tuple[str, float, Line], ...] = (
    ("in degrees", _MOST_DEGREES, _turns(np.pi / 180)),
    ("0 to 1 of the way", _ONE, _share(1)),
    ("1 to 0, so that 1 is the lower end", _ONE, _rest(1)),
    ("in percent", 106.0, _share(100)),
    ("100 to 0, so that 100 is the lower end", 106.0, _rest(100)),
    ("0 to 1000", 1060.0, _share(1000)),
    ("1000 to 0, so that 1000 is the lower end", 1060.0, _rest(1000)),
    ("0 to 255", 270.0, _share(255)),
    ("in half turns", 2.2, _turns(np.pi)),
    ("in turns", 1.1, _turns(2 * np.pi)),
)
"""Name, the largest value that it can have, and how it becomes the unit of the limits."""

_RADIANS = "in radians, perhaps"
_OF_PARTS = (*_UNITS[3:8], (_RADIANS, 2.2, _turns(1 / 1.7)), _UNITS[2])
"""Likewise, of hands that count in parts of their travel; a finger's is 1.7 rad."""

_FACTORS = (
    ("in degrees", 180 / np.pi),
    ("in percent where the other is in parts of 1", 100.0),
    ("in thousandths where the other is in parts of 1", 1000.0),
    ("in half turns", 1 / np.pi),
    ("in turns", 1 / (2 * np.pi)),
)


@dataclass(frozen=True)
class Units:
    """Another unit than the right one.

    :param which: ``state``, ``action``, or ``state and action``.
    :param text: what it is, after ``is``.
    :param sure: how well it explains the values, 0 to 1.
    """

    which: str
    text: str
    sure: float


def is_radians(track: Track) -> bool:
    """Whether positions should be in radians."""
    if track.model is not None:
        return track.model.unit == "rad"
    return not (track.is_hand and len(track.joints) == 6)


def _limits(track: Track) -> Limits | None:
    """Limits of the joints, also where only the number of joints tells the hand."""
    if track.limits is not None or not track.is_hand:
        return track.limits
    if len(track.joints) == 6:  # Inspire's and BrainCo's count in parts of their travel
        return np.zeros(6), np.ones(6)
    reach = reach_of(track)
    return None if reach is None else (reach.low, reach.high)


# -- state against action ----------------------------------------------------------------------


@lru_cache(maxsize=8)  # of the parts of the episode that is being judged: two checks ask
def other_units(r: Relation) -> Units | None:
    """The unit of the state, or of the action, where they are not the same."""
    limits = _limits(r.track)
    if limits is None:
        return _factor(r)
    low, high = limits
    wide = high - low
    moving = np.minimum(r.state_span, r.action_span) > 0
    moving &= np.maximum(r.state_span, r.action_span) > 0.1 * np.minimum(wide, 1.0)
    if not moving.any() or middle(r.moments.apart()[moving] / wide[moving]) < _APART:
        return None
    return _converted(r, limits, moving)


def _converted(r: Relation, limits: Limits, moving: NDArray[np.bool_]) -> Units | None:
    low, high = limits
    wide = high - low
    # the other way round no delay of the two is right
    sure = middle(r.own[moving]) > 0.9
    at = [moments(*shifted(r.state, r.action, k)) for k in ([r.lag] if sure else r.lags)]
    if max(middle(np.abs(m.correlation[moving])) for m in at) < _RELATED:
        return None
    apart = min(middle(m.apart()[moving] / wide[moving]) for m in at)
    best: tuple[float, Units] | None = None
    for name, largest, line in _UNITS if is_radians(r.track) else _OF_PARTS:
        scale, offset = line(low, high)
        size = np.abs(scale)
        for which, values, spans, others in (
            ("state", r.state, r.state_span, r.action_span),
            ("action", r.action, r.action_span, r.state_span),
        ):
            if not (-largest < values.min() and values.max() < largest):
                continue
            if name == _RADIANS and values.max() < _ONE:
                continue  # an object that stops the fingers is no unit
            if not _LIKE < middle((size * spans / np.maximum(others, 1e-9))[moving]) < 1 / _LIKE:
                continue  # one of them hardly moves: then it is near everything
            rms = [
                m.apart(scale, offset)
                if which == "state"
                else size * m.apart(*_back(scale, offset))
                for m in at
            ]
            left = min(_upper((v / wide)[moving]) for v in rms)
            if left < min(_FITS, _BETTER * apart) and (best is None or left < best[0]):
                best = left, Units(which, name, 1 - left)
    return None if best is None else best[1]


def _upper(values: Floats) -> float:
    """The value that a quarter exceeds."""
    return float(np.sort(values)[(3 * (len(values) - 1) + 3) // 4])


def _back(scale: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """The inverse line: state and action are compared in the action's unit."""
    return 1 / scale, -offset / scale


def _factor(r: Relation) -> Units | None:
    """Of joints without known limits: the factor between action and state."""
    close = (np.abs(r.own) > 0.9) & (np.maximum(r.state_span, r.action_span) > 0.1)
    if not close.any():
        return None
    slope = np.abs(r.fit[0][close])
    usual = middle(slope)
    if 1 / _FACTOR < usual < _FACTOR or np.ptp(np.quantile(slope, [0.25, 0.75])) > (
        _SPREAD * usual
    ):
        return None
    for text, factor in _FACTORS:
        for which, value in (("state", factor), ("action", 1 / factor)):
            if abs(np.log(usual / value)) < _NEAR:
                return Units(which, text, 0.97)
    # less than asked is not followed
    return Units("state", f"{usual:.3g} times the action", 0.9) if usual > _FACTOR else None


# -- state and action alike --------------------------------------------------------------------


def wrong_units(episode: Episode, track: Track) -> Units | None:
    """The unit of a part whose values cannot be in the right one, whatever its actions are."""
    values = {"state": rows_of(track.state), "action": rows_of(track.action)}
    values = {k: v for k, v in values.items() if len(v)}
    limits = _limits(track)
    if limits is None:
        return _turned(episode, track, values)
    low, high = limits
    beyond = _BEYOND * (high - low)
    found: dict[str, tuple[float, str]] = {}
    for which, v in values.items():
        least, most = v.min(axis=0), v.max(axis=0)
        if (least >= low - beyond).all() and (most <= high + beyond).all():
            continue
        out = (v < low - beyond) | (v > high + beyond)
        if out.mean(axis=0).max() < _OFTEN or misplaced(track, v):
            continue
        for name, largest, line in _UNITS if is_radians(track) else _OF_PARTS:
            if most.max() > largest or least.min() < -largest:
                continue
            scale, offset = line(low, high)
            made = v * scale + offset
            inside = float(((made >= low - beyond) & (made <= high + beyond)).mean())
            # what hardly moves then is near everything
            spread = middle(np.abs(scale) * (most - least) / (high - low))
            if inside >= _INSIDE and spread > _HARDLY:
                found[which] = max(found.get(which, (0.0, "")), (inside, name))
    if not found:
        return None
    sure, name = next(iter(found.values()))
    return Units(" and ".join(found), name, sure)


def _turned(episode: Episode, track: Track, values: dict[str, Floats]) -> Units | None:
    """Degrees of an arm, beside hands or arms of Unitree's, which count in radians."""
    if track.is_hand:
        return None
    most = {k: float(np.abs(v).max()) for k, v in values.items()}
    large = [k for k, v in most.items() if _TURN < v < _MOST_DEGREES]
    large = [k for k in large if np.quantile(np.abs(values[k]), 0.98, axis=0).max() > _TURN]
    if not large or not _is_unitree(episode, track):
        return None
    return Units(" and ".join(large), "in degrees", 0.97)


def _is_unitree(episode: Episode, track: Track) -> bool:
    """Whether it is an arm or a body of a robot whose joints are known to be in radians."""
    return (
        any(t.model is not None for t in episode.tracks)
        or any(n.startswith(("kLeft", "kRight")) for n in track.joints)
        or (track.part.endswith("_arm") and "xr_teleoperate" in episode.form)
    )
