"""Check the force of a grip against the law that the hand shows while it moves freely.

A hand that obeys tau = kp (q - q_now) + kd (dq - dq_now) + tau does so in contact as well: a boost
at a stall crushes the object, and a limit that is lower in contact drops it. The force in contact
is compared with that law; a hand whose tau_est has another scale while it moves is judged by that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import contacts
from dexkit.conformance.motor_messages import MotorCodec
from dexkit.conformance.rows import Rows
from dexkit.hand import Floats, JointMode

__all__ = ["torque_scales"]

_FREE = ("joint", "step", "fingerprint", "stiff")
"""Phases in which the joints move without contact, by the client's gains."""
_FEW = 20
"""Fewest states for a factor."""
_OTHER_UNITS = (1e-3, 1e3)
"""Factors of tau_est where N m and mN m are mistaken for each other, in a dialect that has both."""
_HELD = 0.2
"""Quantile of tau_est that counts as held, and from above as reached."""
_STANDS = 0.01
"""Part of the range by which q of a joint that stands may vary in a piece."""
_MOST = 0.95
"""Quantile of a gripper's torque by distance that counts as its greatest stiffness."""
_LAGS_S = tuple(0.002 * i for i in range(21))
"""Ages of commands with which a gripper's states are compared: 0 to 40 ms."""


# ------------------------------------------------------------------------- hands of several joints


def _law(ctx: Context, rows: Rows) -> tuple[Floats, NDArray[np.bool_]]:
    """The torque of each joint by the newest command at these states, N m, and whether a joint is
    driven by it, both shape (n, joints).
    """
    commands, states = ctx.commands, ctx.states
    newest = np.maximum(np.searchsorted(commands.t, states.t[rows], "right") - 1, 0)
    tau = (
        commands.kp[newest] * (commands.q[newest] - states.q[rows])
        + commands.kd[newest] * (commands.dq[newest] - states.dq[rows])
        + commands.tau[newest]
    )
    mode = np.nan_to_num(commands.mode[newest]).astype(np.intp)
    driven = MotorCodec(ctx.recording.dialect).status(mode) == JointMode.FOC
    return tau, driven & np.isfinite(tau)


@dataclass(frozen=True)
class _Factors:
    """tau_est in free motion, relative to the law; 1 where it is not known.

    :param factors: of each joint.
    :param scales: the same where tau_est is in another unit than N m, else 1.
    """

    factors: Floats
    scales: Floats


def _factors(ctx: Context, least: float) -> _Factors:
    """Compare tau_est with the law in free motion.

    :param least: torque from which states count, N m.
    """
    count = len(ctx.joints)
    units = _OTHER_UNITS if ctx.recording.dialect.torque_units else ()
    found = _Factors(np.ones(count), np.ones(count))
    if not len(ctx.commands):
        return found
    spans = [ctx.span(p) for name in _FREE for p in ctx.phases(name)]
    parts = [np.arange(len(ctx.states))[ctx.states.between(*s)] for s in spans]
    rows = np.unique(np.concatenate(parts)) if parts else np.zeros(0, dtype=np.intp)
    rows = rows[ctx.states.t[rows] >= ctx.commands.t[0]]
    if not len(rows):
        return found
    law, driven = _law(ctx, rows)
    most = 0.9 * np.array([j.tau_max for j in ctx.joints])
    with np.errstate(invalid="ignore", divide="ignore"):
        clear = driven & (np.abs(law) >= least) & (np.abs(law) <= most)
        ratios = ctx.states.tau[rows] / law
    for joint in range(count):
        mine = ratios[clear[:, joint], joint]
        mine = np.sort(mine[np.isfinite(mine)])
        if len(mine) < _FEW:
            continue
        low, middle, high = (float(mine[int(p * (len(mine) - 1))]) for p in (0.25, 0.5, 0.75))
        found.factors[joint] = abs(middle)
        # late values are small as well, but not alike
        alike = low * high > 0 and high - low <= 0.5 * abs(middle)
        if alike and any(0.5 * unit <= abs(middle) <= 2.0 * unit for unit in units):
            found.scales[joint] = abs(middle)
    return found


def _once(ctx: Context, least: float) -> _Factors:
    return ctx.once(("torque factors", least), lambda: _factors(ctx, least))


def torque_scales(ctx: Context, least: float) -> Floats:
    """By which factor tau_est of each joint is in another unit than N m; 1 where it is not.

    :param least: torque from which states in free motion count, N m.
    """
    return _once(ctx, least).scales


@dataclass(frozen=True)
class _Press:
    """A joint that presses for a while; torques in N m, times in seconds.

    :param part: of a limit, above 1 where it is exceeded.
    """

    part: float
    joint: int
    felt: float
    limit: float
    over: bool
    begin: float
    end: float


@check("DEX3-FORCE-08")
def presses_as_it_moves(ctx: Context) -> Outcome:
    """tau_est of each standing joint that presses on the object, relative to the law."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    worst: _Press | None = None
    for phase in (p for n in ("squeeze", "touch", "firmer") for p in ctx.phases(n)):
        for found in _presses(ctx, *ctx.span(phase)):
            worst = found if worst is None or found.part > worst.part else worst
    if worst is None:
        return ctx.skipped("no joint was held back by the object")
    bound = "at most" if worst.over else "at least"
    text = ctx.named(
        f"tau_est of {worst.felt:.3f} N m in contact, where {bound} {worst.limit:.3f} N m follow "
        "from its command and from its torque in free motion",
        worst.joint,
    )
    figure = f"{worst.felt:.2f} N m"
    if worst.part <= 1.0:
        met = ctx.passed(figure, text, tau_nm=worst.felt)
        return met.pressed(worst.felt, worst.limit, at_least=not worst.over)
    place = ctx.at(ctx.states.topic, worst.begin, worst.end)
    outcome = ctx.failed(figure, text, place, tau_nm=worst.felt).about(worst.joint)
    return outcome.pressed(worst.felt, worst.limit, at_least=not worst.over)


def _presses(ctx: Context, begin: float, end: float) -> list[_Press]:
    """Both limits of each joint in each piece in which it stands under an unchanged command."""
    least, window = ctx.tolerance("min_asked_nm"), ctx.tolerance("window_s")
    scales = torque_scales(ctx, least)
    factors = _once(ctx, least).factors / scales
    strokes = np.array([j.stroke for j in ctx.joints])
    most = np.array([j.tau_max for j in ctx.joints])
    closing = np.array([j.closing for j in ctx.joints])
    states, commands = ctx.states, ctx.commands
    found = []
    for at in np.arange(begin, end - window + 1e-9, 0.5 * window).tolist():
        rows = np.arange(len(states))[states.between(at, at + window)]
        given = (commands.t >= at - ctx.tolerance("settle_s")) & (commands.t <= at + window)
        if len(rows) < 5 or int(given.sum()) < 3:
            continue
        same = (np.ptp(commands.q[given], axis=0) <= 1e-6) & (
            np.ptp(commands.kp[given], axis=0) <= 0
        )
        law, driven = _law(ctx, rows)
        asked = np.median(law, axis=0) * closing
        felt = np.sort(np.abs(states.tau[rows]) / scales, axis=0)
        low, high = (felt[int(part * (len(rows) - 1))] for part in (_HELD, 1.0 - _HELD))
        stands = np.ptp(states.q[rows], axis=0) <= _STANDS * strokes
        with np.errstate(invalid="ignore"):
            judged = same & stands & driven.all(axis=0) & (asked >= least) & np.isfinite(felt[-1])
        for joint in np.flatnonzero(judged).tolist():
            own = factors[joint]
            floor = ctx.tolerance("min_part") * min(own, 1.0) * min(asked[joint], most[joint])
            ceiling = ctx.tolerance("max_part") * max(own, 1.0) * asked[joint]
            for part, value, limit, over in (
                (high[joint] / ceiling, high[joint], ceiling, True),
                (floor / max(low[joint], 1e-6), low[joint], floor, False),
            ):
                found.append(
                    _Press(float(part), joint, float(value), float(limit), over, at, at + window)
                )
    return found


# -------------------------------------------------------------------------------------- grippers


@dataclass(frozen=True)
class _Spring:
    """What a gripper's tau_est is in the free: stiffness times the distance to q, less damping.

    :param stiffness: N m/rad; ``error`` is its standard error.
    :param residual: part of tau_est (RMS) that is not explained.
    :param least: the median of tau_est by distance, and ``most`` a high quantile of it, N m/rad:
        damping makes it less, and a late q makes it more.
    """

    stiffness: float
    error: float
    residual: float
    least: float
    most: float


def _spring(ctx: Context) -> _Spring | None:
    """The spring that moves a gripper in the free, from the age of commands that explains it best.

    The strength of a grip has no sign: only states count in which it moves towards its goal.
    """
    states, commands, spec = ctx.states, ctx.commands, ctx.joints[0]
    if not len(commands) or not states.dq[:, 0].any():
        return None
    clear = ctx.tolerance("clear_stroke")
    low = (spec.q_min if ctx.object_at is None else ctx.object_at) + clear
    q, dq, tau = states.q[:, 0], states.dq[:, 0], np.abs(states.tau[:, 0])
    with np.errstate(invalid="ignore"):
        free = np.isfinite(tau) & np.isfinite(dq) & (q > low) & (q < spec.q_max - clear)
    free &= states.t >= commands.t[0] + 1.0
    if int(free.sum()) < _FEW:
        return None
    free &= tau <= 0.9 * float(tau[free].max())  # the drive may be at its limit
    best: _Spring | None = None
    for lag in _LAGS_S:
        rows = np.searchsorted(commands.t, states.t - lag, "right") - 1
        fresh = (rows >= 0) & (states.t - lag - commands.t[np.maximum(rows, 0)] < 0.1)
        goal = np.clip(commands.q[np.maximum(rows, 0), 0], spec.q_min, spec.q_max)
        off = goal - q
        with np.errstate(invalid="ignore"):
            mine = free & fresh & (off * dq >= 0)
            mine &= np.abs(off) >= ctx.tolerance("min_off_stroke")
            mine &= np.abs(off) <= ctx.tolerance("max_off_stroke")
        if int(mine.sum()) < _FEW:
            continue
        x, y = np.column_stack((np.abs(off[mine]), -np.abs(dq[mine]))), tau[mine]
        found = _fitted(x, y)
        if found is not None and (best is None or found.residual < best.residual):
            best = found
    return best


def _fitted(x: Floats, y: Floats) -> _Spring | None:
    """The best spring; None if the values do not determine one.

    :param x: distance to the goal and -abs(dq), shape (n, 2).
    :param y: abs(tau_est).
    """
    (a, b), (c, d) = x.T @ x
    size = a * d - b * c
    total = float(y @ y)
    if size <= 1e-9 * a * d or not total:
        return None
    right = x.T @ y
    fit = np.array([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / size
    left = y - x @ fit
    variance = float(left @ left) / max(len(y) - 2, 1)
    ratios = np.sort(y / x[:, 0])
    least, most = (float(ratios[int(part * (len(y) - 1))]) for part in (0.5, _MOST))
    error, residual = np.sqrt(variance * d / size), np.sqrt(left @ left / total)
    return _Spring(float(fit[0]), float(error), float(residual), least, most)


@check("DEX1-FORCE-19")
def grips_as_it_moves(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the spring that moves the gripper freely."""
    touch = ctx.object_at
    if touch is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    spring = _spring(ctx)
    if (
        spring is None
        or spring.residual > ctx.tolerance("max_residual")
        or spring.stiffness < ctx.tolerance("min_stiffness")
        or spring.error > ctx.tolerance("max_error_part") * spring.stiffness
    ):
        return ctx.absent("its torque in free motion is not in proportion to the distance to q")
    worst: tuple[float, float, float, float, float, bool] | None = None
    softest = min(spring.stiffness, spring.least)
    stiffest = max(spring.stiffness, spring.most)
    for piece in contacts(ctx, touch):
        depth = piece.q - piece.goal
        if stiffest * depth < ctx.tolerance("min_asked_nm"):
            continue
        low = ctx.tolerance("min_part") * min(softest * depth, ctx.tolerance("max_asked_nm"))
        high = ctx.tolerance("max_part") * stiffest * depth
        for part, limit, over in (
            (piece.tau / high, high, True),
            (low / max(piece.tau, 1e-6), low, False),
        ):
            if worst is None or part > worst[0]:
                worst = part, piece.tau, limit, piece.begin, piece.end, over
    if worst is None:
        return ctx.skipped("it never pressed on the object for long enough")
    part, tau, limit, begin, end, over = worst
    text = (
        f"tau_est of {tau:.2f} N m in contact, where {'at most' if over else 'at least'} "
        f"{limit:.2f} N m follow from the {stiffest if over else softest:.1f} N m/{ctx.unit} with "
        "which it moves in the free"
    )
    if part <= 1.0:
        met = ctx.passed(f"{tau:.2f} N m", text, tau_nm=tau)
        return met.pressed(tau, limit, at_least=not over)
    outcome = ctx.failed(f"{tau:.2f} N m", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)
    return outcome.pressed(tau, limit, at_least=not over)
