"""dq of the states, and the fastest motion of a joint."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from dexkit.conformance.checks import Context
from dexkit.conformance.kit.row_selection import finite_rows
from dexkit.hand import Floats

FEW = 10
"""Fewest measurements for a verdict."""


_FAST = 0.999
"""Quantile of the reported speeds that counts as the hand's fastest, so that a single wrong value
does not count."""


_OWN = 1.2
"""Allowed factor over that speed."""


def fastest_speed(ctx: Context, joint: int) -> float:
    """The joint's fastest speed, rad/s: as reported, or its profile's where dq is not filled."""
    fast = ctx.once(("fast", joint), lambda: _reported_speed(ctx, joint))
    return (
        ctx.joints[joint].dq_max if fast is None else max(_OWN * fast, ctx.tolerance("min_speed"))
    )


def _reported_speed(ctx: Context, joint: int) -> float | None:
    """The quantile :data:`_FAST` of abs(dq); None if dq is not filled."""
    dq = ctx.states.dq[:, joint]
    dq = np.abs(dq[finite_rows(dq)])
    if not len(dq) or not dq.any():
        return None
    row = int(_FAST * (len(dq) - 1))
    return float(np.partition(dq, row)[row])


def filled(ctx: Context) -> bool:
    """Whether any dq is non-zero; usually decided by the first states."""
    dq = ctx.states.dq
    return bool(np.nan_to_num(dq[:FEW]).any() or np.nan_to_num(dq[FEW:]).any())


T = TypeVar("T")


def q_and_dq(ctx: Context, joint: int) -> tuple[Floats, Floats, Floats]:
    """Times, q and dq of a joint where both are numbers."""
    states = ctx.states
    good = ctx.known_states(joint, "q", "dq")
    return states.clock[good], states.q[good, joint], states.dq[good, joint]


def by_times(ctx: Context, name: str, t: Floats, work_out: Callable[[], T]) -> T:
    """What depends on times alone is worked out once: they are nearly always those of all joints.

    :param name: with all that it depends on beside the times.
    """
    if len(t) < len(ctx.states):
        return work_out()
    return ctx.once((name, ctx.requirement.id), work_out)
