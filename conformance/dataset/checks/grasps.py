"""Whether what a hand holds stays in it.

A hand holds something while it is asked to close further than it is. It has lost it if it closes on
by itself, or if nothing presses any more, while its action stays as it is. Whether it should have
held something at all, only other episodes of the set can say: :mod:`..across`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.check import Check, Data, Figure
from dexkit.conformance.dataset.checks.assignment import misassigned
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import part_text, runs_of
from dexkit.conformance.dataset.relation import Relation, relations, running
from dexkit.conformance.dataset.unit_fit import other_units
from dexkit.hand import Floats

__all__ = ["CHECKS", "CLOSED", "CLOSINGS", "HOLDS"]

CLOSED, HOLDS, CLOSINGS = " closed, %", " holds, s", " closings"
"""How the figures end that the episodes of a set are compared by."""

_GAP = 0.03  # strokes that a hand is short of its action: xr_teleoperate asks a Dex1-1 for 0.033
_USED = 0.2  # strokes that a joint's action moves, to count
_CLOSES = 0.3  # strokes that a hand closes, to be one that does: others only open
_CLOSED = 0.6  # of the way that it goes, from which on a hand is closed
_HELD_S = 0.4  # s for which something must have been held to be lost
_LOST_S = 0.6  # s in which it is lost: what gives way more slowly is soft
_MOVES = 0.04  # strokes that a hand closes on then, at least
_PART = 0.5  # of what it was short of its action
_LEFT = 0.25  # of the pressure, or the torque, that is left when nothing is held
_CLEAR = 6.0  # times the noise, that a pressure is to be one
_BEST = np.minimum, np.maximum
_STEADY = 0.02  # strokes that a steady action changes; ``_LITTLE`` of what its hand does meanwhile,
# which tremor and a slow hand's way may be, and no cause
_LITTLE = 1 / 3


@dataclass(frozen=True, eq=False)
class _Grip:
    """The closing of a hand, mean of the joints that are used, in strokes.

    :param asked: how far closed it was asked to be for as long as it may take; ``told`` at once.
    :param closed: how far closed it is.
    :param holds: whether something holds it open.
    :param joints: that are used, and which way each closes.
    """

    asked: Floats
    told: Floats
    closed: Floats
    holds: NDArray[np.bool_]
    joints: NDArray[np.intp]


def _grasps(episode: Episode) -> Iterator[Finding | Figure]:
    for r in relations(episode):
        if not r.track.is_hand or r.increments:
            continue
        if other_units(r) is not None or misassigned(episode, r.part):
            continue
        grip = _grip(r)
        if grip is None:
            continue
        name = r.part.replace("_", " ")
        if (grip.closed - np.minimum.accumulate(grip.closed)).max() > _CLOSES:
            yield Figure(name + CLOSED, 100 * float(np.quantile(grip.closed, 0.98)))
            yield Figure(name + HOLDS, float(grip.holds.sum() * r.step))
            yield Figure(name + CLOSINGS, _closings(grip))
        if not grip.holds.any():
            continue
        lost = _closes_on(r, grip) or _lets_go(episode, r, grip)
        if lost is not None:
            at, text = lost
            yield Finding(
                "grasp",
                Use.REVIEW,
                f"{part_text(r.part)} loses what it holds at {r.t[at]:.1f} s: {text}, while its "
                "action stays closed",
                part=r.part,
                begin_s=round(float(r.t[max(0, at - round(_LOST_S / r.step))]), 3),
                end_s=round(float(r.t[at]), 3),
            )


def _grip(r: Relation) -> _Grip | None:
    known = r.track.closing
    used = r.action_span > _USED * r.stroke
    ways = [known] if known is not None else [np.ones(len(used)), -np.ones(len(used))]
    best: _Grip | None = None
    low, high = r.asked
    for way in ways:
        joints = np.flatnonzero(used & (way != 0))
        if not len(joints):
            continue
        sign, wide = way[joints], r.stroke[joints]
        ends = r.track.limits
        base = np.where(
            sign > 0,
            r.action[:, joints].min(axis=0) if ends is None else ends[0][joints],
            r.action[:, joints].max(axis=0) if ends is None else ends[1][joints],
        )

        def closure(values: Floats) -> Floats:
            return np.asarray((values - base) * sign / wide)  # noqa: B023

        asked = closure(np.where(sign > 0, low[:, joints], high[:, joints]))
        closed = closure(r.state[:, joints])
        gap = asked - closed
        enough = (gap > _GAP).sum(axis=1) >= max(1, round(0.3 * len(joints)))
        holds = enough & (asked.max(axis=1) > 0.15)
        steady = np.zeros(len(holds), dtype=bool)
        for begin, end in runs_of(holds, max(2, round(_HELD_S / r.step))):
            steady[begin:end] = True
        told = closure(r.action[:, joints]).mean(axis=1)
        grip = _Grip(asked.mean(axis=1), told, closed.mean(axis=1), steady, joints)
        if best is None or grip.holds.sum() > best.holds.sum():
            best = grip
    return best


def _closings(grip: _Grip) -> int:
    """How often the hand is told to close."""
    least, most = grip.told.min(), grip.told.max()
    return len(list(runs_of(grip.told > least + _CLOSED * (most - least), 3)))


def _closes_on(r: Relation, grip: _Grip) -> tuple[int, str] | None:
    """Where the hand closes on while its action does not."""
    wide = round(_LOST_S / r.step)
    held = max(1, round(_HELD_S / r.step))
    count = len(grip.closed)
    if count <= 3 * wide + held:
        return None
    at = np.arange(wide + held, count - wide)
    # a hand that is on its way is late, and holds nothing
    came = np.abs(grip.closed[at - wide] - grip.closed[at - wide - held])
    before = grip.holds[at - wide] & (came < _STEADY)
    gap = (grip.asked - grip.closed)[at - wide]
    went = grip.closed[at] - grip.closed[at - wide]
    same = _steady(r, grip, at, wide, wide // 2, np.maximum(_STEADY, _LITTLE * went))
    found = before & same & (went > np.maximum(_PART * gap, _MOVES)) & (gap > _MOVES)
    left = (grip.told - grip.closed)[at + wide // 2]
    found &= left < (1 - _PART) * gap
    if not found.any():
        return None
    place = int(at[np.argmax(np.where(found, went, -1))])
    return place, f"it closes on by {100 * (went[found].max()):.0f} % of its way"


def _steady(
    r: Relation,
    grip: _Grip,
    at: NDArray[np.intp],
    wide: int,
    after: int,
    most: Floats | float = _STEADY,
) -> NDArray[np.bool_]:
    """Whether the action stays as it is, before, while and for some frames ``after`` it is lost."""
    late = max(0, r.lag) + round(0.3 / r.step)
    told = grip.told[:, None]
    low, high = (running(told, wide + late, after, best)[at, 0] for best in _BEST)
    return np.asarray(high - low < most)


def _lets_go(episode: Episode, r: Relation, grip: _Grip) -> tuple[int, str] | None:
    """Where pressure or torque falls to what it is with nothing in the hand."""
    rows = np.searchsorted(episode.t, r.t - 1e-9)
    rest = grip.told < np.quantile(grip.told, 0.1) + _STEADY  # open: nothing presses there
    model = r.track.model
    # position servos hold without a current, and their force falls by itself
    servo = len(r.track.joints) == 6 if model is None else model.dialects[0].position_servo
    for name, values in (
        ("its touch falls", r.track.touch),
        ("its torque falls", None if servo or r.track.tau is None else r.track.tau[:, grip.joints]),
    ):
        if values is None or rest.sum() < 5:
            continue
        if (at := _falls(r, grip, values[rows], rest)) is not None:
            return at, name
    return None


def _falls(r: Relation, grip: _Grip, values: Floats, rest: NDArray[np.bool_]) -> int | None:
    values = np.nan_to_num(values)
    level = np.median(values[rest], axis=0)
    change = np.abs(values - level)
    noise = np.median(change[rest], axis=0) + 1e-9
    press = np.maximum(change - 4 * noise, 0).sum(axis=1)
    wide = round(_LOST_S / r.step)
    count = len(press)
    if count <= 3 * wide or press.max() < _CLEAR * noise.sum():
        return None
    at = np.arange(wide, count - wide)
    before = np.minimum(press[at - wide], press[at - wide + 1])
    after = np.max([press[at + k] for k in range(wide // 2, wide + 1)], axis=0)
    falls = (before > 0.3 * press.max()) & (after < _LEFT * before) & grip.holds[at - wide]
    falls &= _steady(r, grip, at, wide, wide) & (grip.closed[at] > grip.closed[at - wide] - _STEADY)
    return int(at[np.argmax(falls)]) if falls.any() else None


CHECKS = (
    Check(
        "grasp",
        "Objects that are lost, or not there to be held",
        frozenset({Data.STATE, Data.ACTION}),
        _grasps,
    ),
)
