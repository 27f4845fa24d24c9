"""Check the force of a grip against the law that the hand shows while it moves freely.

A hand that obeys tau = kp (q - q_now) + kd (dq - dq_now) + tau does so in contact as well: a boost
at a stall crushes the object, and a limit that is lower in contact drops it. The force in contact
is compared with that law; a hand whose tau_est has another scale while it moves is judged by that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import contacts
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.motor_messages import MotorCodec
from dexkit.conformance.row_selection import Rows
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats, JointMode

__all__ = ["pressed", "torque_scales"]

_FREE = ("joint", "step", "fingerprint", "stiff")
"""Phases in which the joints move without contact, by the client's gains."""
_ALIKE = 3
"""Fewest joints whose scales of tau_est can be compared."""
_FEW_SHOWN = 5
"""Fewest states for a joint's factor: a fast joint is driven for some 10 ms of each step."""
_FEW = 20
"""Fewest states for a gripper's stiffness."""
_REACHED = 0.9
"""Quantile of tau_est, relative to its command, that is compared between joints."""
_OTHER_UNITS = (1e-3, 1e3)
"""Factors of tau_est where N m and mN m are mistaken for each other, in a dialect that has both."""
_PRESSED_S = 0.3
"""Seconds at the end of a squeeze in which the joints stand."""
_HELD = 0.2
"""Quantile of tau_est that counts as held, and from above as reached."""
_STANDS = 0.01
"""Part of the range by which q of a joint that stands may vary in a piece."""
_MOST = 0.95
"""Quantile of a gripper's torque by distance that counts as its greatest stiffness."""
_LAGS_S = tuple(0.002 * i for i in range(21))
"""Ages of commands with which states are compared, 0 to 40 ms: a hand may obey and publish late."""


def pressed(
    felt: tuple[float, float],
    limits: tuple[float, float],
    text: str,
    begin: float,
    end: float,
    joint: int | None = None,
) -> Iterator[Figure]:
    """The tau_est of a piece of contact against both of its limits, N m.

    :param felt: least and greatest tau_est of the piece.
    :param limits: the least and the greatest that it may be.
    :param text: what was observed, with places for the value ``felt`` and its limit.
    :param begin: of the piece, s, as ``end``.
    """
    for value, limit, least in ((felt[0], limits[0], True), (felt[1], limits[1], False)):
        bound = f"{'at least' if least else 'at most'} {limit:.3f} N m"
        shown = text.format(felt=f"{value:.3f} N m", limit=bound)
        yield Figure(value, begin, end, joint, shown, limit=limit, at_least=least)


# ------------------------------------------------------------------------- hands of several joints


def _law(ctx: Context, rows: Rows, age: float = 0.0) -> tuple[Floats, NDArray[np.bool_]]:
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
    best, closest = _law(ctx, rows), 0.0
    for lag in _LAGS_S:
        law, driven = _law(ctx, rows, lag)
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
        if len(mine) < _FEW_SHOWN:
            continue
        low, middle, high = (float(mine[int(p * (len(mine) - 1))]) for p in (0.25, 0.5, 0.75))
        found.factors[joint] = abs(middle)
        found.reached[joint] = np.sort(np.abs(mine))[int(_REACHED * (len(mine) - 1))]
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


@check("DEX3-FORCE-09")
def one_scale(ctx: Context) -> Outcome:
    """tau_est of each joint relative to its command in free motion, compared with the others."""
    factors = _once(ctx, ctx.tolerance("min_tau_nm"))
    units = ctx.recording.dialect.torque_units or (1.0,) * len(ctx.joints)
    worst: tuple[float, int, float, float] | None = None
    for unit in dict.fromkeys(units):
        own = [i for i, u in enumerate(units) if u == unit and np.isfinite(factors.reached[i])]
        if len(own) < _ALIKE:
            continue
        usual = float(np.median(factors.reached[own]))
        for joint in own:
            factor = float(factors.reached[joint])
            apart = max(factor, usual) / max(min(factor, usual), 1e-9)
            if worst is None or apart > worst[0]:
                worst = apart, joint, factor, usual
    if worst is None:
        return ctx.skipped("too few joints were driven by a torque that shows in free motion")
    apart, joint, factor, usual = worst
    text = ctx.named(
        f"tau_est is {factor:.3g} times the commanded torque in free motion, and {usual:.3g} times "
        "in most joints",
        joint,
    )
    if apart <= ctx.tolerance("max_ratio"):
        return ctx.passed(f"x {apart:.1f}", text, ratio=apart)
    return ctx.failed(f"x {apart:.3g}", text, ratio=apart).about(joint)


@check("DEX3-FORCE-08")
@with_object
@worst("tau_nm", "max_tau_nm", nothing="no joint was held back by the object")
def presses_as_it_moves(ctx: Context) -> Figures:
    """tau_est of each standing joint that presses on the object, relative to the law."""
    for phase in (p for name in ("squeeze", "touch", "firmer", "regrip") for p in ctx.phases(name)):
        yield from _presses(ctx, *ctx.span(phase))


def _presses(ctx: Context, begin: float, end: float) -> Iterator[Figure]:
    """Each joint in each piece in which it stands under an unchanged command."""
    least, window = ctx.tolerance("min_asked_nm"), ctx.tolerance("window_s")
    scales = torque_scales(ctx, least)
    factors = _once(ctx, least).factors / scales
    strokes = np.array([j.stroke for j in ctx.joints])
    most = np.array([j.tau_max for j in ctx.joints])
    closing = np.array([j.closing for j in ctx.joints])
    states, commands = ctx.states, ctx.commands
    text = (
        "tau_est of {felt} in contact, where {limit} follow from its command and from its torque "
        "in free motion"
    )
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
            felt_there = float(low[joint]), float(high[joint])
            limits = float(floor), float(ceiling)
            yield from pressed(felt_there, limits, text, at, at + window, joint)


@check("DEX3-FORCE-11", "BRAINCO-FORCE-11")
@with_object
def stops_at_object(ctx: Context) -> Outcome:
    """The least part of the way from the object to its goal that a joint goes.

    One joint is enough, as an object need not touch all. A requirement with ``min_tau_nm`` also
    limits the torque of the joints that go farther.
    """
    touch, most = ctx.touch, 0.0
    judged = False
    for phase in ctx.phases():
        begin, end = max(ctx.span(phase)[0], ctx.span(phase)[1] - _PRESSED_S), ctx.span(phase)[1]
        rows = np.arange(len(ctx.states))[ctx.states.between(begin, end)]
        past = _past_object(ctx, phase, rows, touch)
        if not past:
            continue
        judged = True
        place = ctx.at(ctx.states.topic, begin, end)
        most = max(most, min(past.values()))
        if most > ctx.tolerance("max_past_part"):
            text = (
                f"no joint is held back: all go {most:.0%} of the way or more from the object, at "
                f"{touch:g} % of closing, to their goals"
            )
            return ctx.failed(f"{most:.0%}", text, place, part=most)
        odd = _unexplained(ctx, rows, past)
        if odd is not None:
            joint, felt = odd
            text = ctx.named(
                f"q is {past[joint]:.0%} of the way from the object to its goal, where kp "
                f"(q - q_now) does not explain the {felt:.2f} N m of tau_est",
                joint,
            )
            return ctx.failed(f"{felt:.2f} N m", text, place, tau_nm=felt).about(joint)
    if not judged:
        return ctx.skipped("no joint was commanded to go past the object")
    return ctx.passed(f"{most:.0%}", f"a joint stops {most:.0%} of the way past the object or less")


def _past_object(ctx: Context, phase: Phase, rows: Rows, touch: float) -> dict[int, float]:
    """Where each joint that is commanded past the object is, 0 at the object and 1 at its goal."""
    if len(rows) < _FEW_SHOWN:
        return {}
    q = np.median(ctx.states.q[rows], axis=0)
    found = {}
    for joint, goal in phase.targets.get(ctx.side, {}).items():
        spec = ctx.joints[joint]
        contact = spec.closed_by(touch / 100)
        if (goal - contact) * spec.closing >= ctx.tolerance("min_way_stroke", joint):
            found[joint] = float((q[joint] - contact) / (goal - contact))
    return found


def _unexplained(ctx: Context, rows: Rows, past: Mapping[int, float]) -> tuple[int, float] | None:
    """A joint past the object that presses more than its command asks for, and its tau_est, N m."""
    if "min_tau_nm" not in ctx.requirement.tolerances:
        return None
    least = ctx.tolerance("min_tau_nm")
    asked = np.abs(np.median(_law(ctx, rows)[0], axis=0))
    felt = np.abs(np.median(ctx.states.tau[rows], axis=0)) / torque_scales(ctx, least)
    for joint, part in past.items():
        much = felt[joint] >= least and felt[joint] > ctx.tolerance("max_ratio") * asked[joint]
        if part > ctx.tolerance("max_past_part") and much:
            return joint, float(felt[joint])
    return None


# -------------------------------------------------------------------------------------- grippers


@dataclass(frozen=True)
class _Spring:
    """A gripper's tau_est without contact: stiffness times the distance to q, less damping.

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
    """The spring that moves a gripper without contact, by the age of commands that fits best.

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
@with_object
def grips_as_it_moves(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the spring that moves the gripper freely."""
    spring = _spring(ctx)
    if (
        spring is None
        or spring.residual > ctx.tolerance("max_residual")
        or spring.stiffness < ctx.tolerance("min_stiffness")
        or spring.error > ctx.tolerance("max_error_part") * spring.stiffness
    ):
        return ctx.skipped("its torque in free motion is not in proportion to the distance to q")
    softest = min(spring.stiffness, spring.least)
    stiffest = max(spring.stiffness, spring.most)
    text = "tau_est of {felt} in contact, where {limit} follow from the stiffness "
    text += f"{softest:.1f} to {stiffest:.1f} N m/{ctx.unit} with which it moves without contact"
    figures: list[Figure] = []
    for piece in contacts(ctx, ctx.touch):
        depth = piece.q - piece.goal
        if stiffest * depth < ctx.tolerance("min_asked_nm"):
            continue
        low = ctx.tolerance("min_part") * min(softest * depth, ctx.tolerance("max_asked_nm"))
        high = ctx.tolerance("max_part") * stiffest * depth
        figures += pressed((piece.tau, piece.tau), (low, high), text, piece.begin, piece.end)
    nothing = "it never pressed on the object for long enough"
    return judged(ctx, figures, "tau_nm", "max_tau_nm", nothing=nothing)
