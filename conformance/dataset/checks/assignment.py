"""Whether each column is the joint that it is called: sides, order of joints, signs.

A state belongs to the joint whose action it follows. Joints and sides that move alike cannot be
told apart, and are not judged. Where state and action are misplaced alike, the limits of a known
hand can tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.limits import order_by_limits, other_side_by_limits, rows_of
from dexkit.conformance.dataset.motion import joints_text, part_text
from dexkit.conformance.dataset.relation import (
    Relation,
    correlations,
    middle,
    moments,
    relations,
    shifted,
)
from dexkit.conformance.dataset.unit_fit import other_units
from dexkit.hand import Floats

__all__ = ["CHECKS", "assigned", "misassigned"]

_FOLLOWS = 0.75  # correlation of a part with the action that it follows; an object lowers it
_JOINT = 0.85  # likewise of one joint
_LEAD = 0.3  # by which it follows the other one better than its own
_MOVES = 0.1  # strokes that a part moves, to be compared
_NEARER = 0.4  # of its distance from its own action, is that from the other one
_APART = 0.03  # strokes RMS from its own action, at least: noise, a coarse encoder, lag
_AHEAD = 0.08  # s that no state is ahead of its action
_APART_S = 0.2  # s that no two hands of a robot differ in delay
_OPPOSITE = -0.8  # correlation of a joint that moves against its action
_RECORDED = ("left and right hand look swapped", "states of left and right hand exchanged")


def misassigned(episode: Episode, part: str) -> bool:
    """Whether a part's columns are those of another side, joint, or sign."""
    return any(f.part in ("", part) for f in assigned(episode) if f.use is not Use.KEEP)


@lru_cache(maxsize=1)  # of the episode that is being judged
def assigned(episode: Episode) -> tuple[Finding, ...]:
    """What is found of sides, order and signs, and of units that count backwards."""
    exchanged = list(_sides(episode))
    parts = {f.part for f in exchanged}
    if "" in parts:
        return tuple(exchanged)
    rest = [f for r in relations(episode) if r.part not in parts for f in _joints(r)]
    return (*exchanged, *rest)


def _named(name: str, episode: Episode) -> Iterator[Finding]:
    yield from (f for f in assigned(episode) if f.check == name)


# -- sides -------------------------------------------------------------------------------------


def _sides(episode: Episode) -> Iterator[Finding]:
    told = [p for p in episode.problems if any(words in p for words in _RECORDED)]
    for text in told[:1]:
        yield Finding("sides", Use.REVIEW, _once(text))
    by_part = {r.part: r for r in relations(episode) if not r.increments}
    for left_name, left in by_part.items():
        if not left_name.startswith("left_"):
            continue
        right = by_part.get("right_" + left_name.removeprefix("left_"))
        if right is None or left.state.shape[1] != right.state.shape[1] or told:
            continue
        if (exchanged := _exchanged(left, right)) is not None:
            yield Finding("sides", Use.DROP, exchanged)
    wrong = {}
    for track in episode.hands:
        given = {"its observation": track.state, "its action": track.action}
        named = [k for k, v in given.items() if other_side_by_limits(track, rows_of(v))]
        if named:
            wrong[track.part] = " and ".join(named)
    every = len(wrong) == len(episode.hands)
    for part, what in wrong.items():
        yield Finding(
            "sides" if every else "sign",
            Use.DROP,
            f"{part_text(part)}: {what} lies where only the other hand can be: "
            + ("left and right are exchanged" if every else "its signs are inverted, or its side"),
            part=part,
        )


def _once(text: str) -> str:
    return text.replace(
        "states of left and right hand exchanged: in the source, ", "in the source "
    )


def _exchanged(left: Relation, right: Relation) -> str | None:
    own = [_follows(r) for r in (left, right)]
    ahead = min(left.lag * left.step, right.lag * right.step) < -_AHEAD
    ahead = ahead and abs(left.lag - right.lag) * left.step > _APART_S
    if min(own) >= 0.9 and not ahead:
        return None
    pairs = [(left, right), (right, left)]
    moves = [(_moves(s.state_span, s), _moves(a.action_span, a)) for s, a in pairs]
    if any(a != b for a, b in moves) or (True, True) not in moves:
        return None  # one stands still where the other moves: it does not follow it
    there = [pair for pair, (moved, _) in zip(pairs, moves, strict=True) if moved]
    crossed = [_crossed(s, a) for s, a in there]
    correlation = min(c for c, _, _ in crossed)
    lead = min(c - _follows(s) for (s, _), (c, _, _) in zip(there, crossed, strict=True))
    parts_of = [
        near / max(middle(s.apart[s.state_span > _MOVES * s.stroke]), 1e-9)
        for (s, _), (_, near, _) in zip(there, crossed, strict=True)
    ]
    nearer = min(parts_of) < _NEARER and max(parts_of) < 1 and lead > _LEAD / 3
    lags = [lag for _, _, lag in crossed]
    # both follow the other side with one delay, and their own only if one is ahead of its action
    in_time = ahead and (max(lags) - min(lags)) * left.step < _AHEAD and lead > -0.02
    if correlation < _FOLLOWS or not (lead > _LEAD or nearer or in_time):
        return None
    part = left.part.removeprefix("left_")
    return (
        f"left and right {part} are exchanged between observation and action: each follows the "
        f"action of the other side (correlation {correlation:.2f}, with its own {max(own):.2f})"
    )


def _moves(spans: Floats, r: Relation) -> bool:
    return bool((spans > _MOVES * r.stroke).any())


def _follows(r: Relation) -> float:
    """Correlation of all joints together with their actions; 0 where nothing moves."""
    m = r.moments
    square = r.stroke**2
    size = float(np.sqrt((m.var_s / square).sum() * (m.var_a / square).sum()))
    return float((m.cov / square).sum()) / size if size > 1e-9 else 0.0


def _crossed(state: Relation, action: Relation) -> tuple[float, float, int]:
    """Correlation of a state with the action of the other side at the best delay, and the median
    distance, strokes RMS, and that delay, frames. Signs do not count between two sides, which
    are mirrored.
    """
    count = min(len(state.t), len(action.t))
    s, a = state.state[:count] / state.stroke, action.action[:count] / action.stroke
    best, near, best_lag = 0.0, np.inf, 0
    moved = state.state_span > _MOVES * state.stroke
    for lag in state.lags:
        m = moments(*shifted(s, a, lag))
        size = float(np.sqrt(m.var_s.sum() * m.var_a.sum()))
        if size <= 1e-9:
            continue
        if (value := float(np.abs(m.cov).sum()) / size) > best:
            best, best_lag = value, lag
        near = min(near, *(middle(m.apart(sign)[moved]) for sign in (1.0, -1.0)))
    return best, near, best_lag


# -- order and signs ---------------------------------------------------------------------------


def _joints(r: Relation) -> Iterator[Finding]:
    if r.increments or other_units(r) is not None:
        return
    signs = _signs(r)
    order = _order(r, signs)
    if order:
        some = sorted(order.items())[:2]
        names = ", ".join(f"{r.track.joints[k]} in place of {r.track.joints[j]}" for j, k in some)
        yield Finding(
            "order",
            Use.DROP,
            f"{part_text(r.part)}: observation and action have {len(order)} joints in different "
            f"order: the observation has {names}{' ...' if len(order) > 2 else ''}",
            part=r.part,
            joints=tuple(sorted(order)),
        )
    elif signs and _of_travel(r) and len(signs) == int(r.moving.sum()):
        yield Finding(
            "units",
            Use.DROP,
            f"{part_text(r.part)}: observation and action count in opposite directions: one of "
            "them is 1 to 0, not 0 to 1",
            part=r.part,
        )
    elif signs:
        joints = sorted(signs)
        worst = min(c for c, _ in signs.values())
        yield Finding(
            "sign",
            Use.DROP,
            f"{joints_text(r.track, joints)} moves against its action "
            f"(correlation {worst:.2f}): the sign is inverted in one of them",
            part=r.part,
            joints=tuple(joints),
            value=worst,
            limit=_OPPOSITE,
        )
    else:
        for which, values in (("observation", r.state), ("action", r.action)):
            if (found := order_by_limits(r.track, values)) is not None:
                yield Finding(
                    "order",
                    Use.DROP,
                    f"{part_text(r.part)}: {which} lies outside of the limits of its joints, and "
                    "within them in another order",
                    part=r.part,
                    joints=tuple(found),
                )
                return


def _of_travel(r: Relation) -> bool:
    """Whether it is a hand that counts in parts of its travel, as far as can be told."""
    model = r.track.model
    return r.track.is_hand and (len(r.track.joints) == 6 if model is None else model.unit != "rad")


def _order(r: Relation, signs: dict[int, tuple[float, float]]) -> dict[int, int]:
    """By joint, whose action its state follows, where a group of joints is permuted."""
    moving = np.minimum(r.state_span, r.action_span) > _MOVES * r.stroke
    if moving.sum() < 2 or r.apart[moving].max() < _APART:
        return {}
    sure = middle(r.own[moving]) > _FOLLOWS
    best: dict[int, int] = {}
    for lag in [r.lag] if sure else r.lags[::2]:
        found = _exchanged_joints(r, *shifted(r.state, r.action, lag), signs)
        if len(found) > len(best):
            best = found
    return best


def _exchanged_joints(
    r: Relation, state: Floats, action: Floats, signs: dict[int, tuple[float, float]]
) -> dict[int, int]:
    """By joint of a permuted group, that whose action its state follows far better than its own."""
    count = len(state)
    c = correlations(state, action)
    square = (
        (state**2).mean(axis=0)[:, None]
        + (action**2).mean(axis=0)
        - 2 / count * np.einsum("ij,ik->jk", state, action)
    )
    away = np.sqrt(np.maximum(square, 0.0)) / r.stroke[:, None]
    own_c, own = np.diagonal(c)[:, None], np.diagonal(away)[:, None]
    better = (c > _JOINT) & (own_c < c - _LEAD) & (away < 0.7 * own)
    nearer = (c > _JOINT) & (away < _NEARER * own) & (own_c <= c)
    # of two that are exchanged one may have been stopped by an object
    perhaps = (c > _FOLLOWS) & (away < 0.9 * own) & (c > own_c + 0.1)
    wrong = (own[:, 0] > _APART) & (r.state_span > _MOVES * r.stroke)
    for j, (_, left) in signs.items():
        wrong[j] &= away[j].min() < left  # inverted is nearer than exchanged
    fits = (better | nearer | perhaps) & wrong[:, None] & wrong[None]
    np.fill_diagonal(fits, False)
    # joints of a finger move alike: the nearest pairs first, each joint once
    found: dict[int, int] = {}
    taken: set[int] = set()
    score = np.where(fits, c - away, -np.inf)
    for place in np.argsort(-score, axis=None)[: int(fits.sum())].tolist():
        j, k = divmod(place, len(c))
        if j not in found and k not in taken:
            found[j] = k
            taken.add(k)
    cycles = _cycles(found)
    sure = [j for j, k in cycles.items() if better[j, k] or nearer[j, k]]
    return cycles if 2 * len(sure) >= len(cycles) else {}


def _cycles(leaders: dict[int, int]) -> dict[int, int]:
    """The joints that are exchanged among themselves."""
    kept = dict(leaders)
    while True:
        targets = list(kept.values())
        good = {
            j: k for j, k in kept.items() if k in kept and targets.count(k) == 1 and j in targets
        }
        if len(good) == len(kept):
            return good
        kept = good


def _signs(r: Relation) -> dict[int, tuple[float, float]]:
    """Joints that move against their action: correlation, and distance if the sign is changed,
    strokes RMS.
    """
    moves = np.minimum(r.state_span, r.action_span) > _MOVES * r.stroke
    low = np.flatnonzero(moves & (r.own < 0.4))
    if not len(low):
        return {}
    at = [moments(*shifted(r.state[:, low], r.action[:, low], k)) for k in r.lags]
    c = np.array([m.correlation for m in at])
    # without the means: 1 less the value is inverted, too
    left = np.array([np.sqrt(np.maximum(m.var_s + m.var_a + 2 * m.cov, 0)) for m in at])
    worst, best = c.min(axis=0), c.max(axis=0)
    # a joint that goes to and fro is opposite to its action after half a period, too: then it
    # follows it after a whole one, or none
    found = (worst < _OPPOSITE) & (best < -worst - _LEAD)
    return {
        int(low[i]): (float(worst[i]), float(left[:, i].min() / r.stroke[low[i]]))
        for i in np.flatnonzero(found).tolist()
    }


_BOTH = frozenset({Data.STATE, Data.ACTION})
CHECKS = (
    Check("sides", "Left and right exchanged", _BOTH, lambda e: _named("sides", e)),
    Check("order", "Joints in another order", _BOTH, lambda e: _named("order", e)),
    Check("sign", "Inverted signs", _BOTH, lambda e: _named("sign", e)),
)
