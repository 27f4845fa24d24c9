"""What tau_est shows in free motion of tau = kp (q - q_now) + kd (dq - dq_now) + tau."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.row_selection import Rows
from dexkit.hand import Floats, JointMode

_FREE = ("joint", "step", "fingerprint", "stiff")
"""Phases in which the joints move without contact, by the client's gains."""


FEW_SHOWN = 5
"""Fewest states for a joint's factor: a fast joint is driven for some 10 ms of each step."""


_REACHED = 0.9
"""Quantile of tau_est, relative to its command, that is compared between joints."""


_OTHER_UNITS = (1e-3, 1e3)
"""Factors of tau_est where N m and mN m are mistaken for each other, in a dialect that has both."""


LAGS_S = tuple(0.002 * i for i in range(21))
"""Ages of commands with which states are compared, 0 to 40 ms: a hand may obey and publish late."""


def torque_by_law(ctx: Context, rows: Rows, age: float = 0.0) -> tuple[Floats, NDArray[np.bool_]]:
    """The torque of each joint by the newest command at these states, N m, and whether a joint is
    driven by it, both shape (n, joints).

    :param age: seconds that the command must be old.
    """
    commands, states = ctx.commands, ctx.states
    newest = np.maximum(np.searchsorted(commands.t, states.t[rows] - age, "right") - 1, 0)
    tau = (
        commands.kp[newest] * (commands.q[newest] - states.q[rows])
        + commands.kd[newest] * (commands.dq[newest] - states.dq[rows])
        + commands.tau[newest]
    )
    return tau, ctx.once("commands that drive", lambda: _driving(ctx))[newest] & np.isfinite(tau)


def _driving(ctx: Context) -> NDArray[np.bool_]:
    """Whether each command drives each joint, by its mode byte."""
    mode = np.nan_to_num(ctx.commands.mode).astype(np.intp)
    return np.asarray(MotorCodec(ctx.recording.dialect).status(mode) == JointMode.FOC)


def _law_shown(ctx: Context, rows: Rows) -> tuple[Floats, NDArray[np.bool_]]:
    """The law by commands of the age whose torque tau_est follows best, whatever its scales are.

    By the newest commands, the first states of each motion would not show the torque that these
    ask for, and a fast joint is driven for little longer.
    """
    tau, most = ctx.states.tau[rows], np.array([j.tau_max for j in ctx.joints])
    best, closest = torque_by_law(ctx, rows), 0.0
    for lag in LAGS_S:
        law, driven = torque_by_law(ctx, rows, lag)
        used = driven & np.isfinite(tau)
        x, y = np.where(used, np.clip(law, -most, most), 0.0), np.where(used, tau, 0.0)
        sizes = np.sqrt((x**2).sum(axis=0) * (y**2).sum(axis=0))
        alike = float((np.abs((x * y).sum(axis=0)) / np.maximum(sizes, 1e-9)).mean())
        if alike > closest + 1e-9:  # more than rounding
            best, closest = (law, driven), alike
    return best


@dataclass(frozen=True)
class _Factors:
    """tau_est in free motion, relative to the law; 1 where it is not known.

    :param factors: of each joint.
    :param scales: the same where tau_est is in another unit than N m, else 1.
    :param reached: a high quantile of the same, NaN where it is not known: the first states of a
        motion still show the torque of the command before.
    """

    factors: Floats
    scales: Floats
    reached: Floats


def _factors(ctx: Context, least: float) -> _Factors:
    """Compare tau_est with the law in free motion.

    :param least: torque from which states count, N m.
    """
    count = len(ctx.joints)
    units = _OTHER_UNITS if ctx.recording.dialect.torque_units else ()
    found = _Factors(np.ones(count), np.ones(count), np.full(count, np.nan))
    if not len(ctx.commands):
        return found
    spans = [ctx.span(p) for name in _FREE for p in ctx.phases(name)]
    parts = [np.arange(len(ctx.states))[ctx.states.between(*s)] for s in spans]
    rows = np.unique(np.concatenate(parts)) if parts else np.zeros(0, dtype=np.intp)
    rows = rows[ctx.states.t[rows] >= ctx.commands.t[0]]
    if not len(rows):
        return found
    law, driven = _law_shown(ctx, rows)
    most = 0.9 * np.array([j.tau_max for j in ctx.joints])
    with np.errstate(invalid="ignore", divide="ignore"):
        clear = driven & (np.abs(law) >= least) & (np.abs(law) <= most)
        ratios = ctx.states.tau[rows] / law
    for joint in range(count):
        mine = ratios[clear[:, joint], joint]
        mine = np.sort(mine[np.isfinite(mine)])
        if len(mine) < FEW_SHOWN:
            continue
        low, middle, high = (float(mine[int(p * (len(mine) - 1))]) for p in (0.25, 0.5, 0.75))
        found.factors[joint] = abs(middle)
        found.reached[joint] = np.sort(np.abs(mine))[int(_REACHED * (len(mine) - 1))]
        # late values are small as well, but not alike
        alike = low * high > 0 and high - low <= 0.5 * abs(middle)
        if alike and any(0.5 * unit <= abs(middle) <= 2.0 * unit for unit in units):
            found.scales[joint] = abs(middle)
    return found


def torque_factors(ctx: Context, least: float) -> _Factors:
    """As :func:`_factors`, worked out once."""
    return ctx.once(("torque factors", least), lambda: _factors(ctx, least))


def torque_scales(ctx: Context, least: float) -> Floats:
    """By which factor tau_est of each joint is in another unit than N m; 1 where it is not.

    :param least: torque from which states in free motion count, N m.
    """
    return torque_factors(ctx, least).scales
