"""tau_est of a gripper: in contact, at rest, and its sign."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import ROUNDING, Context, Outcome, check
from dexkit.conformance.median import median
from dexkit.hand import Floats

Ranges: TypeAlias = NDArray[np.intp]
"""Rows from the first to before the second, shape (n, 2)."""


def squeezes(ctx: Context) -> tuple[float, float] | None:
    """(begin, end) of the last half second of the last squeeze that has states."""
    for phase in reversed(ctx.phases()):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        tau = ctx.states.tau[ctx.states.between(begin, end)]
        if np.isfinite(tau).all(axis=1).any():
            return begin, end
    return None


def _squeeze(ctx: Context) -> tuple[float, float, float] | None:
    """(median tau_est, begin, end) of a gripper while it squeezes."""
    span = squeezes(ctx)
    if span is None:
        return None
    tau = ctx.states.tau[ctx.states.between(*span), 0]
    return float(np.median(tau[np.isfinite(tau)])), *span


@check("DEX1-FORCE-01")
def in_contact(ctx: Context) -> Outcome:
    """tau_est while squeezing an object."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    found = _squeeze(ctx)
    if found is None:
        return ctx.skipped("no state while it squeezed")
    tau, begin, end = found
    text = f"tau_est {tau:.3f} N m while squeezing"
    limit = ctx.tolerance("min_tau_nm")
    if abs(tau) >= limit:
        met = ctx.passed(f"{tau:.2f} N m", text, tau_nm=tau)
        return met.pressed(abs(tau), limit, at_least=True)
    place = ctx.at(ctx.states.topic, begin, end)
    outcome = ctx.failed(f"{tau:.2f} N m", text, place, tau_nm=tau)
    return outcome.pressed(abs(tau), limit, at_least=True)


def _ranges(t: Floats, begins: Floats, ends: Floats, side: Literal["left", "right"]) -> Ranges:
    """Rows of t in each interval: the first, and the first after it, shape (n, 2)."""
    return np.column_stack([np.searchsorted(t, begins), np.searchsorted(t, ends, side)])


def _bounds(values: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Lowest and highest value in each range, NaN if one of them is not a number.

    For an empty range, the value at its beginning.
    """
    longer = np.append(values, np.nan)  # an end may be one past the last row
    if not len(ranges):
        return np.empty(0), np.empty(0)
    low, high = (f.reduceat(longer, ranges.ravel())[::2] for f in (np.minimum, np.maximum))
    return low, high


def _still(ctx: Context) -> Floats:
    """Begins of the consecutive windows during the commands in which q does not change."""
    window, asked = ctx.tolerance("min_rest_s"), ctx.commands.t
    begins: Floats = np.asarray(np.arange(float(asked[0]), float(asked[-1]) - window, window))
    ranges = _ranges(ctx.states.t, begins, begins + window, "left")
    full = np.diff(ranges)[:, 0] >= 5
    low, high = _bounds(ctx.states.q[:, 0], ranges[full])
    return begins[full][high - low <= ctx.tolerance("max_ripple_stroke")]


@check("DEX1-FORCE-02")
def at_rest(ctx: Context) -> Outcome:
    """tau_est while the gripper rests at its target without contact."""
    states, commands = ctx.states, ctx.commands
    if len(commands) < 2:
        return ctx.skipped("no commands to this hand")
    window = ctx.tolerance("min_rest_s")
    known = ctx.recording.stimulus is not None
    begins = _still(ctx)
    rows = _ranges(states.t, begins, begins + window, "right")
    asked = _ranges(commands.t, begins, begins + window, "left")
    low, high = _bounds(states.q[:, 0], rows)
    goal_low, goal_high = _bounds(commands.q[:, 0], asked)
    rests = (np.diff(rows)[:, 0] >= 5) & (np.diff(asked)[:, 0] >= 3)
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        rests &= high - low <= ctx.tolerance("max_ripple_stroke")
        rests &= goal_high - goal_low <= ctx.tolerance("max_ripple_stroke")
    rests &= _bounds(commands.kp[:, 0], asked)[0] > 0
    if known and ctx.object_at is not None:
        rests &= low > ctx.object_at + 0.1
    taus: list[tuple[float, float]] = []
    for i in np.flatnonzero(rests):
        here, there = slice(*rows[i]), slice(*asked[i])
        error = median(states.q[here, 0]) - median(commands.q[there, 0])
        if abs(error) <= ctx.tolerance("max_error_stroke"):
            taus.append((median(np.abs(states.tau[here, 0])), float(begins[i])))
    if not taus:
        return ctx.skipped("the gripper never rests at its target in this recording")
    # the median of all rests: one of them may be an unannounced contact
    level, begin = sorted(taus)[len(taus) // 2]
    text = f"tau_est {level:.3f} N m at rest (median of {len(taus)} rests)"
    limit = ctx.tolerance("max_tau_nm")
    if level <= limit:
        return ctx.passed(f"{level:.3f} N m", text, tau_nm=level).pressed(level, limit)
    return ctx.failed(
        f"{level:.2f} N m", text, ctx.at(states.topic, begin, begin + window), tau_nm=level
    ).pressed(level, limit)


@check("DEX1-FORCE-03")
def sign(ctx: Context) -> Outcome:
    """Sign of tau_est while squeezing."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    found = _squeeze(ctx)
    if found is None or found[0] == 0.0:
        return ctx.skipped("no force was reported while it squeezed")
    tau, begin, end = found
    text = f"tau_est {tau:+.3f} N m while closing on an object"
    if tau < 0:
        return ctx.passed("negative", text, tau_nm=tau)
    return ctx.failed("positive", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)


@check("DEX1-FORCE-04", "DEX3-FORCE-02")
def unit(ctx: Context) -> Outcome:
    """The largest tau_est, as a part of the joint's torque limit."""
    worst: tuple[float, float, int, float] = (0.0, 0.0, 0, 0.0)
    for joint, spec in enumerate(ctx.joints):
        tau = np.abs(ctx.states.tau[:, joint])
        if not np.isfinite(tau).any():
            continue
        i = int(np.nanargmax(tau))
        worst = max(worst, (float(tau[i]) / spec.tau_max, float(tau[i]), joint, ctx.states.t[i]))
    part, tau_nm, joint, at = worst
    text = ctx.named(f"|tau_est| of at most {tau_nm:.2f} N m", joint)
    if part <= ctx.tolerance("max_part") * (1.0 + ROUNDING):
        return ctx.passed(f"{tau_nm:.2f} N m", text, tau_nm=tau_nm)
    return ctx.failed(
        f"{tau_nm:.3g} N m", text, ctx.at(ctx.states.topic, float(at)), tau_nm=tau_nm
    ).about(joint)


@check("DEX1-FORCE-05")
def unsigned(ctx: Context) -> Outcome:
    """The smallest tau_est in a dialect where it is the strength of the grip."""
    tau = ctx.states.tau[:, 0]
    if not np.isfinite(tau).any():
        return ctx.skipped("no state with a tau_est")
    i = int(np.nanargmin(tau))
    least = float(tau[i])
    text = f"tau_est from {least:.2f} to {float(np.nanmax(tau)):.2f} N m"
    if least >= -ctx.tolerance("min_tau_nm"):
        return ctx.passed(f"{least:.2f} N m", text, tau_nm=least)
    return ctx.failed(
        f"{least:.2f} N m", text, ctx.at(ctx.states.topic, float(ctx.states.t[i])), tau_nm=least
    )
