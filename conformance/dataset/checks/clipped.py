"""Whether actions were cut off: they end at one value, and the joints go on.

A joint that stops at the end of its way, or whose operator stops it, has its state there, too. One
whose action was cut off has a state that goes beyond it, for as long as the action stays there.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import joints_text
from dexkit.conformance.dataset.relation import Relation, relations, shifted
from dexkit.conformance.dataset.unit_fit import other_units

__all__ = ["CHECKS"]

_BEYOND_ARM = 0.12  # rad that an arm is beyond its action, which gravity does not make
_BEYOND_HAND = 0.1  # strokes, likewise: end stops and zeros of good hands make less
_SECONDS = 0.3  # s in all, at least
_AT_END = 0.9  # of the frames at the end value, that have the state there or beyond
_OF_BEYOND = 0.9  # of the frames with the state beyond, that have the action at its end


def _clipped(episode: Episode) -> Iterator[Finding]:
    for r in relations(episode):
        if r.increments:
            continue
        short = _beyond(r)
        if (r.farthest < short).all() or other_units(r) is not None:
            continue
        # without going beyond an end of its action none can have been cut off there
        past = np.maximum(
            r.state.max(axis=0) - r.action.max(axis=0), r.action.min(axis=0) - r.state.min(axis=0)
        )
        perhaps = np.flatnonzero(past > short / 4).tolist()
        found = {j: at for j in perhaps if (at := _cut(r, j, float(short[j])))}
        if not found:
            continue
        joints = sorted(found)
        begin, end = min(b for b, _, _ in found.values()), max(e for _, e, _ in found.values())
        away = max(a for _, _, a in found.values())
        unit = r.track.model.unit if r.track.model else "" if r.track.is_hand else "rad"
        yield Finding(
            "clipped",
            Use.DROP,
            f"the action of {joints_text(r.track, joints)} is cut off: it ends at one value, and "
            f"the observation goes on by up to {away:.2f} {unit}".rstrip(),
            part=r.part,
            joints=tuple(joints),
            begin_s=round(float(r.t[begin]), 3),
            end_s=round(float(r.t[end]), 3),
            value=away,
            unit=unit,
        )


def _beyond(r: Relation) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    if not r.track.is_hand:
        return np.full(len(r.stroke), _BEYOND_ARM)
    margin = 0.0 if r.track.model is None else 1.3 * r.track.model.limit_margin
    return np.maximum(_BEYOND_HAND * r.stroke, margin)


def _cut(r: Relation, joint: int, short: float) -> tuple[int, int, float] | None:
    """First and last frame, and the farthest that the state is beyond an end of the action."""
    state, action = shifted(r.state[:, joint], r.action[:, joint], r.lag)
    if r.action_span[joint] < short:
        return None
    for sign in (1.0, -1.0):
        s, a = sign * state, sign * action
        end = a.max()
        # exactly there: whoever cuts writes the same number each time
        flat = a >= end - 1e-6 * max(1.0, abs(end))
        if flat.sum() * r.step < _SECONDS or flat.all():
            continue
        usual = float(np.median((s - a)[~flat]))  # gravity, or another zero
        past = s - end - usual
        far = past > short
        if far.sum() * r.step < _SECONDS:
            continue
        there = (past[flat] > -short / 2).mean()
        # the state comes later, or is held longer, at most by what it takes to turn
        near = np.convolve(flat, np.ones(5), "same") > 0
        if there > _AT_END and near[far].mean() > _OF_BEYOND:
            places = np.flatnonzero(flat)
            return int(places[0]), int(places[-1]), float(past.max())
    return None


CHECKS = (
    Check("clipped", "Actions that are cut off", frozenset({Data.STATE, Data.ACTION}), _clipped),
)
