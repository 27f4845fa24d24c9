"""Torque pulses on a gripper that is held by position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context
from dexkit.conformance.checks.steps import noise_at_rest
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.stimulus_record import Phase

STIFFNESS = "stiffness"
"""The phase of the pushes that are repeated throughout a run."""


_RESTS_PART = 0.005
"""Part of the stroke by which q may vary at rest."""


_MEDIAN_OFF = 0.7
"""Part of the noise of q by which its median in 0.1 s may be off, if 15 of the states are measured
and the others predicted from them: once in some hundred."""


_MOST_OFF_PART = 0.5
"""Part of a displacement that dry friction may take from it."""


@dataclass(frozen=True)
class Nudge:
    """A torque pulse on a position-controlled gripper.

    :param way: displacement by the torque, rad; ``asked`` is torque / kp.
    :param at_rest: whether the gripper stood still before it.
    :param off: how far from its goal it was then, in the direction of the torque, rad: with dry
        friction it rests anywhere near the goal, and the torque displaces it by as much less.
    """

    begin: float
    end: float
    way: float
    asked: float
    at_rest: bool
    off: float = 0.0


def nudges(ctx: Context, phases: list[Phase] | None = None) -> list[Nudge]:
    """The torque pulses of these phases, by default of the phases that the requirement needs."""
    found = []
    for phase in ctx.phases() if phases is None else phases:
        begin, end = ctx.span(phase)
        before, after = ctx.q(begin - 0.15, begin)[:, 0], ctx.q(end - 0.1, end)[:, 0]
        given = (ctx.commands.t >= begin) & (ctx.commands.t < end)
        if not len(before) or not len(after) or not given.any():
            continue
        kp, tau = median(ctx.commands.kp[given, 0]), median(ctx.commands.tau[given, 0])
        if kp > 0 and tau != 0:  # a damaged recording may hold another command here
            sign = 1 if tau > 0 else -1
            way = (median(after) - median(before)) * sign
            off = (median(before) - median(ctx.commands.q[given, 0])) * sign
            rests = float(np.ptp(before)) <= _RESTS_PART * ctx.joints[0].stroke
            found.append(Nudge(begin, end, way, abs(tau) / kp, rests, off))
    return found


def displacement_noise(ctx: Context, phases: Sequence[Phase]) -> float:
    """By how much the noise of q may change a displacement by a torque in these phases, rad."""
    return _MEDIAN_OFF * noise_at_rest(ctx, 0, phases)


def is_alike(first: Nudge, last: Nudge, parts: tuple[float, float], noise: float) -> bool:
    """Whether a displacement is like an earlier one, give or take the noise of both, and that they
    began at other distances from the goal.

    :param parts: least and most of ``last``, as parts of ``first``.
    :param noise: of a displacement, rad.
    """
    low, high = parts[0] * (first.way - noise), parts[1] * (first.way + noise)
    slack = noise + min(abs(first.off - last.off), _MOST_OFF_PART * first.asked)
    return low - slack <= last.way <= high + slack


def has_own_force(ctx: Context) -> bool:
    """Whether no torque displaced the held gripper: a position servo, which uses q alone."""
    found = nudges(ctx, [*ctx.phases(STIFFNESS), *ctx.phases("nudge")])
    least = ctx.tolerance("min_motion_stroke")
    return bool(found) and not any(n.way >= least for n in found)
