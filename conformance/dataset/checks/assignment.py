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
from dexkit.conformance.dataset.checks.units import other_units
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.limits import order_by_limits, other_side_by_limits, rows_of
from dexkit.conformance.dataset.motion import joints_text, part_text
from dexkit.conformance.dataset.relation import (
    Relation,
    correlations,
    moments,
    relations,
    shifted,
)
from dexkit.hand import Floats

__all__ = ["CHECKS", "misassigned"]

_FOLLOWS = 0.75  # correlation of a part with the action that it follows; an object lowers it
_JOINT = 0.85  # likewise of one joint
_LEAD = 0.3  # by which it follows the other one better than its own
_MOVES = 0.1  # strokes that a part moves, to be compared
_NEARER = 0.4  # of its distance from its own action, is that from the other one
_APART = 0.03  # strokes RMS from its own action, at least: noise, a coarse encoder, lag
_OPPOSITE = -0.8  # correlation of a joint that moves against its action
_RECORDED = ("left and right hand look swapped", "states of left and right hand exchanged")


def misassigned(episode: Episode, part: str) -> bool:
    """Whether a part's columns are those of another side, joint, or sign."""
    return any(f.part in ("", part) for f in _found(episode) if f.use is not Use.KEEP)


@lru_cache(maxsize=1)  # of the episode that is being judged
def _found(episode: Episode) -> tuple[Finding, ...]:
    exchanged = list(_sides(episode))
    parts = {f.part for f in exchanged}
    if "" in parts:
        return tuple(exchanged)
    rest = [f for r in relations(episode) if r.part not in parts for f in _joints(r)]
    return (*exchanged, *rest)


def _named(name: str, episode: Episode) -> Iterator[Finding]:
    yield from (f for f in _found(episode) if f.check == name)


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
    if min(own) >= 0.9:
        return None
    pairs = [(left, right), (right, left)]
    moves = [(_moves(s.state_span, s), _moves(a.action_span, a)) for s, a in pairs]
    if any(a != b for a, b in moves) or (True, True) not in moves:
        return None  # one stands still where the other moves: it does not follow it
    there = [pair for pair, (moved, _) in zip(pairs, moves, strict=True) if moved]
    crossed = [_crossed(s, a) for s, a in there]
    correlation = min(c for c, _ in crossed)
    nearer = all(
        near < _NEARER * float(np.median(s.apart[s.state_span > _MOVES * s.stroke]))
        for (s, _), (_, near) in zip(there, crossed, strict=True)
    )
    if correlation < _FOLLOWS or max(own) > correlation - (0 if nearer else _LEAD):
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


def _crossed(state: Relation, action: Relation) -> tuple[float, float]:
    """Correlation of a state with the action of the other side at the best delay, and the median
    distance, strokes RMS. Signs do not count between two sides, which are mirrored.
    """
    count = min(len(state.t), len(action.t))
    s, a = state.state[:count] / state.stroke, action.action[:count] / action.stroke
    best, near = 0.0, np.inf
    for lag in state.lags:
        m = moments(*shifted(s, a, lag))
        size = float(np.sqrt(m.var_s.sum() * m.var_a.sum()))
        if size > 1e-9:
            best = max(best, float(np.abs(m.cov).sum()) / size)
            moved = state.state_span > _MOVES * state.stroke
            near = min(
                near, float(np.median(m.apart()[moved])), float(np.median(m.apart(-1.0)[moved]))
            )
    return best, near


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


def _order(r: Relation, signs: dict[int, tuple[float, float]]) -> dict[int, int]:
    """By joint, whose action its state follows, where a group of joints is permuted."""
    moving = np.minimum(r.state_span, r.action_span) > _MOVES * r.stroke
    if moving.sum() < 2 or r.apart[moving].max() < _APART:
        return {}
    sure = np.median(r.own[moving]) > _FOLLOWS
    best: dict[int, int] = {}
    for lag in [r.lag] if sure else r.lags[::2]:
        found = _cycles(_leaders(r, *shifted(r.state, r.action, lag), signs))
        if len(found) > len(best):
            best = found
    return best


def _leaders(
    r: Relation, state: Floats, action: Floats, signs: dict[int, tuple[float, float]]
) -> dict[int, int]:
    """By joint whose state follows another joint's action far better than its own: that one."""
    count = len(state)
    c = correlations(state, action)
    square = (
        (state**2).mean(axis=0)[:, None]
        + (action**2).mean(axis=0)
        - 2 / count * np.einsum("ij,ik->jk", state, action)
    )
    away = np.sqrt(np.maximum(square, 0.0)) / r.stroke[:, None]
    found: dict[int, int] = {}
    for j in np.flatnonzero(r.state_span > _MOVES * r.stroke).tolist():
        k = int(np.argmax(c[j] - away[j]))
        own = away[j, j]
        if k == j or c[j, k] < _JOINT or own < _APART:
            continue
        if j in signs and signs[j][1] < away[j, k]:
            continue  # inverted is nearer than exchanged
        better = c[j, j] < c[j, k] - _LEAD and away[j, k] < 0.7 * own
        if better or (away[j, k] < _NEARER * own and c[j, j] <= c[j, k]):
            found[j] = k
    return found


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
