"""The goals that a hand was commanded to, at each time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context
from dexkit.hand import Floats

OWN_RULE = (
    *("nan", "out-of-range", "empty", "short", "long", "wrong-id", "negative", "foreign", "burst"),
    *(
        "two-writers",
        "limp",
        "lock",
        "mixed",
        "status",
        "push",
        "pull",
        "drive",
        "silence",
        "rejected",
    ),
    *("guard-drive", "guard", "guard-latch", "guard-clear"),
)
"""Stimuli during which other requirements judge motion."""


@dataclass(frozen=True)
class Goals:
    """The position commands to one joint, rad.

    :param t: times of reception, s; only commands that change ``low`` or ``high``.
    :param low: the goal; -inf for a command that drives the joint by anything else than a
        position, inf for one that does not drive it.
    :param high: likewise, with the other sign.
    """

    t: Floats
    low: Floats
    high: Floats


def goals_of(ctx: Context, joint: int, *, timeout: float = np.inf) -> Goals:
    """The goals of one joint; non-finite commands are ignored.

    :param timeout: s after which a command is no goal any more.
    """
    commands, spec = ctx.commands, ctx.joints[joint]
    used = ctx.recording.dialect.gains_are_used
    fields = (commands.q, commands.dq, commands.tau, commands.kp, commands.kd)
    finite = np.isfinite(np.stack(fields if used else fields[:1])).all(axis=(0, 2))
    t, q = commands.t[finite], np.clip(commands.q[finite, joint], spec.q_min, spec.q_max)
    low, high = q.copy(), q.copy()
    if used:
        driven = (commands.dq[finite, joint] != 0) | (commands.tau[finite, joint] != 0)
        low[driven], high[driven] = -np.inf, np.inf
        limp = (commands.kp[finite, joint] <= 0) & ~driven
        low[limp], high[limp] = np.inf, -np.inf
    # a service that was started again has no goal, nor has one that brakes without commands
    lost = t[:-1][np.diff(t) > timeout] + timeout
    started = [ctx.span(p)[1] for p in ctx.phases("shutdown")]
    starts = np.sort(np.concatenate((np.asarray(started, dtype=np.float64), lost)))
    rows = np.searchsorted(t, starts)
    t = np.insert(t, rows, starts)
    low, high = np.insert(low, rows, np.inf), np.insert(high, rows, -np.inf)
    changed = np.ones(len(t), dtype=np.bool_)
    changed[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return Goals(t[changed], low[changed], high[changed])
