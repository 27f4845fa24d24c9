"""Whether hands and arms carry out what they are commanded.

An object in a hand stops its joints in the closing direction, for as long as it is held; nothing
stops a hand in the opening direction, or few of its fingers for a moment only. So a state that
stays more closed than any action of the last moments was not driven. Numbers that are exactly
constant are another check's: the stream froze.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.check import Check, Data, Figure
from dexkit.conformance.dataset.checks.assignment import misassigned
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import joints_text, runs_of
from dexkit.conformance.dataset.relation import Relation, moments, relations
from dexkit.conformance.dataset.unit_fit import is_radians, other_units
from dexkit.hand import Floats

__all__ = ["CHECKS"]

Mask = NDArray[np.bool_]

_USED = 0.1  # strokes that a joint is asked to move, to be judged
_LATE = 0.6  # s that a hand may take to begin: Inspire's take 0.4 behind a robot's network
_SLOW = 0.4  # strokes a second, at least, of a hand that is driven: the slowest take 1.2 s
_SHORT_HAND = 0.15  # strokes that a driven hand may be short: friction, weak gains, stiff skin
_SHORT_ARM = 0.25  # rad that an arm may be short: gravity at a low gain, a table that it leans on
_SECONDS = 0.5  # s, at least, that it is not driven, after all this
_FEW_S = 2.0  # s, likewise, of few fingers: other fingers, or a handle, hold them for a moment
_TOWARDS = 0.08  # strokes that a joint moves towards its action within these, if it is driven
_MOST = 0.75  # of the joints that are asked
_ASKED = 0.3  # strokes of closing that are asked of a hand that stays open, to count
_NEVER = 0.07  # strokes of motion that are none: what noise, friction and the other fingers cause
_FOLLOWS = 0.85  # correlation of a joint with its action, although an object stops it
_OPEN = 0.15  # strokes from the open end, within which a hand is open
_STRAIGHT = 0.97  # correlation of a joint that moves in proportion, with the noise of encoders
_GAIN = 0.4  # of the action's motion: less is no joint that is driven, in free air


def _followed(episode: Episode) -> Iterator[Finding | Figure]:
    shares = []
    for r in relations(episode):
        asked = r.action_span > _USED * r.stroke
        if r.increments or not asked.any():
            continue
        if other_units(r) is not None or misassigned(episode, r.part):
            continue  # told with its cause
        bad = np.zeros(r.state.shape, dtype=bool)
        if (r.farthest > _short(r)).any():
            low, high = r.asked
            bad = (_not_driven(r, low, high) | _stays_open(r, low, high)) & asked
        weak = _weak(r)
        shares.append(1 - float((bad | weak).any(axis=1).mean()))
        found = _finding(r, bad, weak)
        if found is not None and (backwards := _backwards(r)) is not None:
            yield backwards
        elif found is not None:
            yield found
    if shares:
        yield Figure("following, %", 100 * min(shares))


def _finding(r: Relation, bad: Mask, weak: NDArray[np.bool_]) -> Finding | None:
    """One finding for a part: the stretches, and the joints that are weak throughout."""
    least = max(3, round(_SECONDS / r.step))
    found = [
        (begin, end, joint)
        for joint in np.flatnonzero(bad.any(axis=0) & ~weak).tolist()
        for begin, end in runs_of(bad[:, joint], least)
        # what stands still exactly is frozen, which another check tells
        if np.ptp(r.state[begin:end, joint]) > 0 and not _action_stuck(r, joint, begin, end)
    ]
    whole = np.flatnonzero(weak).tolist()
    if r.track.is_hand and _hooked(r, found):
        found = [(b, e, j) for b, e, j in found if (e - b) * r.step > _FEW_S]
    joints = sorted({j for _, _, j in found} | set(whole))
    if not joints:
        return None
    does = "do" if 1 < len(joints) < len(r.track.joints) else "does"
    if whole and 2 * len(whole) >= len(joints):
        slope = max(float(np.median(r.fit[0][whole])), 0.0)
        return Finding(
            "not-followed",
            Use.DROP,
            f"{joints_text(r.track, joints)} {does} {100 * slope:.0f} % of what the action says: "
            "it was off or without force, or it is another one that was commanded",
            part=r.part,
            joints=tuple(joints),
            value=slope,
            limit=_GAIN,
        )
    begin, end = min(b for b, _, _ in found), max(e for _, e, _ in found)
    away = max(float(np.abs(r.state[b:e, j] - r.action[b:e, j]).max()) for b, e, j in found)
    during = np.zeros(len(r.t), dtype=bool)
    for b, e, _ in found:
        during[b:e] = True
    return Finding(
        "not-followed",
        Use.DROP,
        f"{joints_text(r.track, joints)} {does} not do what the action says for "
        f"{during.sum() * r.step:.1f} s, up to {away:.2f}{_unit(r)} away from it, where no object "
        "stops a hand: it was off, tripped or without force",
        part=r.part,
        joints=tuple(joints),
        begin_s=round(float(r.t[begin]), 3),
        end_s=round(float(r.t[end - 1]), 3),
        value=away,
        unit=_unit(r).strip(),
    )


def _hooked(r: Relation, found: list[tuple[int, int, int]]) -> bool:
    """Whether few fingers of a hand are concerned, and the others do what they are asked."""
    used = r.action_span > _USED * r.stroke
    joints = sorted({j for _, _, j in found})
    if not joints or 2 * len(joints) >= used.sum():
        return False
    begin, end = min(b for b, _, _ in found), max(e for _, e, _ in found)
    during = slice(max(0, begin - round(_LATE / r.step)), end)
    told, done = np.ptp(r.action[during], axis=0), np.ptp(r.state[during], axis=0)
    others = np.flatnonzero(told > 2 * _USED * r.stroke)
    others = others[~np.isin(others, joints)]
    return bool((done[others] > _GAIN * told[others]).mean() > 0.5) if len(others) else True


def _backwards(r: Relation) -> Finding | None:
    """A hand that is stopped on the wrong side, again and again, and follows otherwise: it counts
    backwards, by state and action.
    """
    closing, limits = r.track.closing, r.track.limits
    if closing is None or limits is None or len(closing) < 2 or is_radians(r.track):
        return None
    moving = r.moving & (closing != 0)
    if not moving.any() or r.own[moving].min() < _FOLLOWS:
        return None
    low, high = r.asked
    short = _short(r)
    # what would be an object, if it were the other way round, and what would be none then
    over = (r.state - high > short) & (closing > 0) | (low - r.state > short) & (closing < 0)
    under = (low - r.state > short) & (closing > 0) | (r.state - high > short) & (closing < 0)
    if under.any() or not over[:, moving].any(axis=0).all():
        return None
    return Finding(
        "units",
        Use.REVIEW,
        f"{joints_text(r.track, range(len(closing)))} is stopped where it opens and never where it "
        "closes: observation and action are 1 to 0, not 0 to 1, or it is another model",
        part=r.part,
    )


def _short(r: Relation) -> Floats:
    """How far each joint may be from where it should be, shape (joints,)."""
    if not r.track.is_hand:
        return np.maximum(_SHORT_ARM, _SHORT_HAND * r.stroke)
    margin = 0.0 if r.track.model is None else 1.3 * r.track.model.limit_margin  # zeros differ
    return np.maximum(_SHORT_HAND * r.stroke, margin)


def _gone(r: Relation) -> Floats:
    """How far each joint went in the last moment, in strokes."""
    window = min(max(1, round(_SECONDS / r.step)), len(r.state) - 1)
    before = np.concatenate((np.repeat(r.state[:1], window, axis=0), r.state[:-window]))
    return np.asarray((r.state - before) / r.stroke)


def _not_driven(r: Relation, low: Floats, high: Floats) -> Mask:
    """Where each joint is beyond what it is asked for, on the side where nothing stops it, and
    stands still there, or does not come back as the slowest driven one would.
    """
    short, gone = _short(r), _gone(r)
    still = np.abs(gone) < _NEVER
    ramp = (_SLOW * r.stroke)[None] * r.t[:, None]
    slow_high = np.maximum.accumulate(high + ramp) - ramp
    slow_low = np.minimum.accumulate(low - ramp) + ramp
    over = (r.state - high > short) & still | (r.state - slow_high > short) & (gone > -_TOWARDS)
    under = (low - r.state > short) & still | (slow_low - r.state > short) & (gone < _TOWARDS)
    if r.track.is_hand:
        closing = r.track.closing
        known = np.zeros(len(short)) if closing is None else closing
        # an object holds a joint whose closing is not known, or neither way, on one side
        both = over.any(axis=0) & under.any(axis=0)
        over &= (known > 0) | (known == 0) & both
        under &= (known < 0) | (known == 0) & both
    # the way from the pose before the first command is not judged
    begun = r.t - r.t[0] > _LATE + 0.5 / _SLOW
    return np.asarray((over | under) & begun[:, None])


def _stays_open(r: Relation, low: Floats, high: Floats) -> Mask:
    """Where a hand that is asked to close stays open: not even an object has met most of its
    fingers there.
    """
    bad = np.zeros(r.state.shape, dtype=bool)
    if not r.track.is_hand:
        return bad
    closing = r.track.closing
    if closing is None and r.moving.any() and r.own[r.moving].min() > _STRAIGHT:
        return bad  # it follows, in a unit of its own
    # of a hand that is not known either end may be the open one
    ways = [closing] if closing is not None else [np.ones(len(r.stroke)), -np.ones(len(r.stroke))]
    least, most = _ends(r)
    still = np.abs(_gone(r)) < _NEVER
    for way in ways:
        where = np.where(way > 0, r.state - least, most - r.state) / r.stroke
        wanted = np.where(way > 0, low - least, most - high) / r.stroke
        asked = (wanted - where > _ASKED) & (way != 0)
        idle = asked & (where < _OPEN) & still
        needed = np.maximum(((wanted > _ASKED) & (way != 0)).sum(axis=1), 1)
        # one finger that meets an object at once is nothing strange; most of a hand is
        bad |= idle & (idle.sum(axis=1) > _MOST * needed)[:, None]
        # nor is a finger that an object stops; one that never moves while the others do is
        if (r.state_span > 0.2 * r.stroke).any():
            lacks = np.where(way > 0, r.action - r.state, r.state - r.action) / r.stroke
            never = (r.state_span < _NEVER * r.stroke) & (where < _OPEN).all(axis=0) & (way != 0)
            for j in np.flatnonzero(never & (lacks > _ASKED).any(axis=0)).tolist():
                bad[:, j] |= len(list(runs_of(lacks[:, j] > _ASKED, 3))) > 1
    return bad


def _ends(r: Relation) -> tuple[Floats, Floats]:
    """The ends of each joint's way, as known or as seen."""
    return r.track.limits or (
        np.minimum(r.state.min(axis=0), r.action.min(axis=0)),
        np.maximum(r.state.max(axis=0), r.action.max(axis=0)),
    )


def _weak(r: Relation) -> NDArray[np.bool_]:
    """Joints that move in proportion to their action, but far less, or not at all."""
    slope, _ = r.fit
    weak = (slope < _GAIN) & (r.state_span > 0)  # else it is frozen
    if not r.track.is_hand:
        # nothing holds an arm; a rest of noise in the action is no motion
        return np.asarray(weak & (r.action_span > _SHORT_ARM) & (r.state_span < r.action_span))
    # an object stops a joint: then the line is none
    straight = weak & (r.own > _STRAIGHT) & (r.action_span > 0.3 * r.stroke)
    for joint in np.flatnonzero(straight).tolist():
        straight[joint] = _weak_when_open(r, joint)
    neither = np.zeros(len(weak), dtype=bool) if r.track.closing is None else r.track.closing == 0
    stuck = neither & (r.state_span < 0.5 * _NEVER * r.stroke) & (r.action_span > 0.2 * r.stroke)
    return np.asarray(weak & (straight | stuck))


def _weak_when_open(r: Relation, joint: int) -> bool:
    """Whether a joint moves less than its action in the open half of the way, too, where hardly an
    object is met. Of an action of two values, a trigger's, every line is straight.
    """
    state, action = r.pair
    s, a = state[:, joint], action[:, joint]
    sign = 0.0 if r.track.closing is None else float(r.track.closing[joint])
    for way in [sign] if sign else [1.0, -1.0]:
        told = way * a
        least, wide = told.min(), float(r.action_span[joint])
        near = told < least + 0.6 * wide
        between = near & (told > least + 0.15 * wide)
        if between.sum() < max(8, 0.05 * len(told)):
            return False
        m = moments(s[near][:, None], a[near][:, None])
        if m.correlation[0] < 0.9 or m.cov[0] > _GAIN * m.var_a[0]:
            return False
    return True


def _action_stuck(r: Relation, joint: int, begin: int, end: int) -> bool:
    """Whether the state goes on and the action's numbers stand still: the action's fault."""
    before = max(0, begin - round(_LATE / r.step))
    if np.ptp(r.action[before:end, joint]) > 0:
        return False
    way = r.state[before:end, joint]
    return bool(np.abs(np.diff(way)).sum() > 2 * abs(way[-1] - way[0]) + 0.3 * r.stroke[joint])


def _unit(r: Relation) -> str:
    model = r.track.model
    if model is None:
        return "" if r.track.is_hand else " rad"
    return f" {model.unit}" if model.unit == "rad" else f" of the {model.unit}"


CHECKS = (
    Check(
        "not-followed",
        "Actions that are not carried out",
        frozenset({Data.STATE, Data.ACTION}),
        _followed,
    ),
)
