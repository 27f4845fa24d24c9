"""Pieces of a run in which a gripper presses on its object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.row_selection import Rows
from dexkit.hand import Floats
from dexkit.models import model


@dataclass(frozen=True)
class _Pressing:
    """A stretch of states in which a gripper is commanded into its object.

    :param begin: seconds; likewise ``end``.
    :param tau: median of abs(tau_est), N m.
    :param q: median, rad; likewise ``goal``, clamped to the stroke.
    :param kp: the lowest commanded, N m/rad.
    :param most: the largest kp times the distance from the goal, N m, in it and in the
        :data:`_OBEYS_S` before it: of a goal that changes the hand may still follow an earlier one.
    """

    begin: float
    end: float
    tau: float
    q: float
    goal: float
    kp: float
    most: float


_OBEYS_S = 0.1
"""Seconds from a command to the state of a hand that follows it, or more."""


def newest_commands(ctx: Context) -> tuple[Rows, Floats]:
    """For each state, the row of the newest command (-1 without one) and its age in seconds."""
    t, asked = ctx.states.t, ctx.commands.t
    rows = np.searchsorted(asked, t, "right") - 1
    ages = np.where(rows >= 0, t - asked[np.maximum(rows, 0)], np.inf)
    return rows, ages


def goals_at(ctx: Context, rows: Rows) -> Floats:
    """The commanded q within the stroke, at each state."""
    spec = ctx.joints[0]
    return np.asarray(np.clip(ctx.commands.q[np.maximum(rows, 0), 0], spec.q_min, spec.q_max))


def _usual_kp(ctx: Context) -> float:
    """The kp of the model's own client, N m/rad."""
    return model(ctx.recording.dialect.model).gains[0][0]


def stiffness_at(ctx: Context, rows: Rows) -> Floats:
    """Kp of the command before each state, N m/rad; the usual one where gains are not used."""
    usual = _usual_kp(ctx)
    if not ctx.recording.dialect.gains_are_used:
        return np.full(len(rows), usual)
    return np.asarray(ctx.commands.kp[np.maximum(rows, 0), 0])


def contacts(ctx: Context, touch: float) -> list[_Pressing]:
    """Consecutive pieces of all stretches in which a hand presses on an object."""
    states, spec = ctx.states, ctx.joints[0]
    rows, ages = newest_commands(ctx)
    goals = goals_at(ctx, rows)
    depth, settle = ctx.tolerance("min_depth_stroke"), ctx.tolerance("settle_s")
    stiff, usual = stiffness_at(ctx, rows), _usual_kp(ctx)
    with np.errstate(invalid="ignore"):
        pressing = (
            (ages < ctx.tolerance("max_age_s"))
            & (goals < touch - depth)
            & (states.q[:, 0] < touch + ctx.tolerance("near_stroke"))
            & (states.q[:, 0] > spec.q_min + ctx.tolerance("near_stroke"))
            & (stiff >= 0.5 * usual)
            & np.isfinite(states.tau[:, 0])
        )
    edges = np.flatnonzero(np.diff(np.concatenate(([0], pressing.view(np.int8), [0]))))
    asked = stiff * (states.q[:, 0] - goals)
    found = []
    window = ctx.tolerance("window_s")
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        begin, end = float(states.t[first]) + settle, float(states.t[last - 1])
        while begin + window <= end:
            before, *inside = np.searchsorted(states.t, (begin - _OBEYS_S, begin, begin + window))
            piece = slice(*inside)
            if piece.stop - piece.start >= 5:
                found.append(
                    _Pressing(
                        begin,
                        begin + window,
                        median(np.abs(states.tau[piece, 0])),
                        median(states.q[piece, 0]),
                        median(goals[piece]),
                        float(stiff[piece].min()),
                        float(asked[before : piece.stop].max()),
                    )
                )
            begin += window
    return found
