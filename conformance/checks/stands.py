"""Stretches in which the joints of position servos stand, at an object or free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.kit.motor_messages import state_member
from dexkit.hand import Floats
from dexkit.models import model

PART_S, _GRID_S, _PARTS = 0.1, 0.05, 3
"""Seconds after ``settle_s`` in which the force is taken, seconds from one stretch to the next, and
the parts of a stretch."""


_STANDS = 0.03  # of the stroke: motion in a stretch


_AT_GOAL = 0.03  # of the stroke: distance from the goal of a joint that has reached it


_NEAR, _CLEAR = 0.08, 0.08  # of the stroke: from where the object is, of one that touches or not


_END = 0.05  # of the stroke: distance from the ends within which a stop may press


_HEARD_S = 0.25  # s without a command, after which a hand may do what it does in a silence


_FAST = 0.5  # part of the full speed from which a goal is soon beyond the object


FEW_STANDS = 2
"""Stretches of a failure: a single one may be disturbed."""


@dataclass(frozen=True)
class Stand:
    """A stretch in which some joints stand under an unchanged command.

    :param presses: which joints the object holds back, well before their goal.
    :param free: which joints have reached their goal, where neither object nor stop is.
    :param force: median of tau_est towards closing in each third of it, shape (3, n_joints).
    """

    begin: float
    end: float
    presses: NDArray[np.bool_]
    free: NDArray[np.bool_]
    force: Floats


def stands(ctx: Context) -> list[Stand]:
    """Every such stretch of the run in which a joint presses on the object, or is free.

    The requirement says how long joints stand before their force is taken (``settle_s``), and how
    far from its goal one is held back (``min_held_stroke``).
    """
    settle, held = (ctx.requirement.tolerance(n) for n in ("settle_s", "min_held_stroke"))
    return ctx.once(("stands", settle, held), lambda: _stands(ctx, settle, held))


def _stands(ctx: Context, settle: float, held: float) -> list[Stand]:
    states, given = ctx.states, ctx.commands
    good = np.isfinite(given.q).all(axis=1) & np.isfinite(given.dq).all(axis=1)
    t, goals, speeds = given.t[good], given.q[good], given.dq[good]
    if not len(t) or not len(states):
        return []
    specs = ctx.joints
    stroke = np.array([j.stroke for j in specs])
    closing = np.array([j.closing for j in specs])
    low, high = np.array([j.q_min for j in specs]), np.array([j.q_max for j in specs])
    goals = np.clip(goals, low, high)
    changes = (np.abs(np.diff(goals, axis=0)) > 1e-6) | (np.abs(np.diff(speeds, axis=0)) > 1e-6)
    # in a silence a hand may stop pressing; the first command after it begins a stretch
    changes |= (np.diff(t) > _HEARD_S)[:, None]
    rows = np.where(changes, np.arange(1, len(t))[:, None], 0)
    since = np.vstack((np.zeros(len(specs), np.intp), np.maximum.accumulate(rows, axis=0)))
    fast = np.ones(len(specs), np.bool_)
    at = None if ctx.object_at is None else ctx.object_at / 100
    contact = np.array([j.closed_by(at) if at is not None and j.closing else np.nan for j in specs])
    found, seconds = [], round(settle + PART_S, 9)
    for begin in np.arange(float(t[0]), float(t[-1]), _GRID_S).tolist():
        end = begin + seconds
        last = int(np.searchsorted(t, end, "right")) - 1
        if end - t[last] > _HEARD_S:
            continue
        same = t[since[last]] <= begin
        rows_here = states.between(begin, end)
        q, tau = states.q[rows_here], states.tau[rows_here]
        if not same.any() or len(q) < 2 * _PARTS or not np.isfinite(q).all():
            continue
        here = np.median(q, axis=0)
        still = same & (np.ptp(q, axis=0) <= _STANDS * stroke)
        if ctx.recording.dialect.speed_units:
            fast = speeds[last] >= _FAST
        left = (goals[last] - here) * closing / stroke
        with np.errstate(invalid="ignore"):
            way = (contact - here) * closing / stroke  # NaN without an object
            presses = still & fast & (left >= held) & (np.abs(way) <= _NEAR)
            clear = np.isnan(way) | (way >= _CLEAR)
        inside = (here >= low + _END * stroke) & (here <= high - _END * stroke)
        free = still & (np.abs(left) <= _AT_GOAL) & clear & inside & (closing != 0)
        if presses.any() or free.any():
            parts = np.array_split(tau * closing, _PARTS)
            force = np.array([np.median(part, axis=0) for part in parts])
            found.append(Stand(begin, end, presses, free, force))
    return found


def torque_member(ctx: Context) -> str:
    """The state's own name of tau_est."""
    return state_member(ctx.recording.dialect.state_type, "tau_est")


def torque_unit(ctx: Context) -> str:
    """The unit of tau_est."""
    return model(ctx.recording.dialect.model).torque_unit


def no_torque(ctx: Context) -> Outcome | None:
    """Why the force of a hand cannot be judged."""
    if not np.nan_to_num(ctx.states.tau).any():
        return ctx.absent(f"{torque_member(ctx)} is not filled (0 throughout)")
    return None


def no_stand(ctx: Context) -> Outcome | None:
    """Why the grips of a hand cannot be judged."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    if not any(s.presses.any() for s in stands(ctx)):
        return ctx.skipped("the object held no joint back for long enough")
    return None
