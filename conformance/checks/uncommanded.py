"""Check for motion without a command: of a hand at rest, and outside of the commanded range.

Both checks use the whole run, not only the ends of steps. Stretches that other requirements judge
(bad commands, missing commands, commands without a position gain) are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.median import median
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
_STOPPED = ("silence", "rejected")
"""The ones at whose end a hand has stopped; its next motion starts there."""
_GRID = 0.01  # s, of the cells in which extremes of q and of goals are compared
_AT_REST_S = 0.3  # s without motion after which a joint is at rest
_UNDRIVEN_S = 0.1  # the same before the first command
_AT_REST_PART = 0.01  # of the stroke by which q may vary meanwhile


@dataclass(frozen=True)
class _Goals:
    """The position commands to one joint, rad.

    :param t: times of reception, s; only commands that change ``low`` or ``high``.
    :param low: the goal; -inf for a command that drives the joint by anything else than a
        position, inf for one that does not drive it.
    :param high: likewise, with the other sign.
    """

    t: Floats
    low: Floats
    high: Floats


def _goals(ctx: Context, joint: int, *, timeout: float = np.inf) -> _Goals:
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
    return _Goals(t[changed], low[changed], high[changed])


def _excluded(ctx: Context) -> list[tuple[float, float]]:
    """Begin and end of the excluded stretches."""
    return [ctx.span(p) for name in OWN_RULE for p in ctx.recording.phases(name, ctx.side)]


@check("DEX1-STILL-01", "DEX3-STILL-01")
@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no joint came to rest while its command stayed the same",
)
def still(ctx: Context) -> Figures:
    """The largest motion of a joint at rest with a constant goal."""
    if not len(ctx.commands):
        yield ctx.skipped("no commands to this hand in the recording")
    excluded = _excluded(ctx)
    for joint in range(len(ctx.joints)):
        for begin, end, goal in _stretches(ctx, _goals(ctx, joint), excluded):
            moved = _leaves(ctx, joint, begin, end, goal)
            if moved is None:
                continue
            rad, at = moved
            when = "before the first command"
            if goal is not None:
                when = f"at its goal {goal:.2f} {ctx.unit}"
            text = f"at rest {when}, it moved by {rad:.3f} {ctx.unit} at {at:.2f} s"
            yield Figure(rad, at, None, joint, text)


def _stretches(
    ctx: Context, goals: _Goals, excluded: list[tuple[float, float]]
) -> list[tuple[float, float, float | None]]:
    """Begin, end and goal of each stretch with one goal, outside of the excluded ones.

    The goal of the stretches before the first command, and after a restart of the service, is None.
    """
    found: list[tuple[float, float, float | None]] = []
    shutdowns = [ctx.span(p) for p in ctx.phases("shutdown")]
    restarts = [ctx.span(p) for p in ctx.phases("restarted")]
    for begin in (float(ctx.states.t[0]), *(begin for begin, _ in restarts)):
        later = ctx.commands.t[ctx.commands.t >= begin]
        found.append((begin, float(later[0]) if len(later) else ctx.recording.duration, None))
    ends = np.append(goals.t[1:], ctx.recording.duration)
    for begin, end, low, high in zip(goals.t, ends, goals.low, goals.high, strict=True):
        a, b = float(begin), float(end)
        if low != high or b - a < 2 * _AT_REST_S:
            continue
        # the new service knows nothing of the goal, and need not be where the old one was
        for x, y in sorted([*excluded, *shutdowns, *restarts]):
            if x <= a < y:
                a = y
            elif a < x < b:
                found.append((a, x, float(low)))
                a = y
        if b > a:
            found.append((a, b, float(low)))
    return found


def _leaves(
    ctx: Context, joint: int, begin: float, end: float, goal: float | None
) -> tuple[float, float] | None:
    """Motion of a joint away from its rest position, rad, and the time.

    Motion from there towards the goal does not count: a slow joint may still arrive. None if it
    does not come
    to rest in [begin, end].
    """
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
    good = np.isfinite(q)
    t, q = t[good], q[good]
    rest = _UNDRIVEN_S if goal is None else _AT_REST_S
    count = int(np.searchsorted(t, t[0] + rest)) if len(t) else 0
    if count < 5 or len(t) < 2 * count:
        return None
    windows = sliding_window_view(q, count)
    calm = np.ptp(windows, axis=1) <= _AT_REST_PART * ctx.joints[joint].stroke
    if not calm.any():
        return None
    first = int(np.argmax(calm))
    here = float(np.median(windows[first]))
    low, high = (here, here) if goal is None else (min(here, goal), max(here, goal))
    away = np.maximum(low - q[first:], q[first:] - high)
    i = int(np.argmax(away))
    return max(0.0, float(away[i])), float(t[first + i])


@check("DEX1-PATH-01", "DEX3-PATH-01")
@worst("beyond_rad", "max_beyond_stroke", nothing="too few states while positions were commanded")
def path(ctx: Context) -> Figures:
    """Excess of q over the range between earlier position and commanded goals.

    At each time q must lie between the position ``before_s`` earlier and the goals in force since
    then or up to ``max_delay_s`` before.
    """
    for joint in range(len(ctx.joints)):
        found = _beyond(ctx, joint)
        if found is not None:
            rad, at = found
            text = (
                f"at {at:.2f} s it was {rad:.3f} {ctx.unit} outside of where it had been "
                f"{ctx.tolerance('before_s'):g} s before and where it was commanded to go"
            )
            yield Figure(rad, at, None, joint, text)


def _beyond(ctx: Context, joint: int) -> tuple[float, float] | None:
    """Excess of q over the hull of its earlier position and its goals, rad, and the time."""
    good = np.isfinite(ctx.states.q[:, joint])
    t, q = ctx.states.t[good], ctx.states.q[good, joint]
    goals = _goals(ctx, joint, timeout=ctx.recording.model.command_timeout)
    before = round(ctx.tolerance("before_s") / _GRID)
    late = before + round(ctx.tolerance("max_delay_s") / _GRID)
    if len(t) < 2 or not len(goals.t):
        return None
    origin = min(float(t[0]), float(goals.t[0]))
    cells = int((float(t[-1]) - origin) / _GRID) + 1
    at = ((t - origin) / _GRID).astype(np.intp)
    here = np.full(cells, np.nan)
    here[at] = q  # the newest of each cell
    # where there are no states, as while the service restarts, it was where it appears again
    seen = np.isfinite(here)
    known = np.flatnonzero(seen)
    here = here[known[np.minimum(np.searchsorted(known, np.arange(cells)), len(known) - 1)]]
    low, high = _in_force(goals, origin, cells)
    if cells <= late:
        return None
    low = sliding_window_view(low, late + 1).min(axis=1)
    high = sliding_window_view(high, late + 1).max(axis=1)
    now, then = here[late:], here[late - before : cells - before]
    away = np.maximum(np.minimum(low, then) - now, now - np.maximum(high, then))
    away[~seen[late:]] = np.nan
    for name in OWN_RULE:
        # what it was moved by there, it may still come back from; a hand that brakes has stopped
        more = 0 if name in _STOPPED else before
        for begin, end in (ctx.span(p) for p in ctx.recording.phases(name, ctx.side)):
            i, j = (round((x - origin) / _GRID) - late for x in (begin, end))
            away[max(i, 0) : max(j + more, 0)] = np.nan
    if not np.isfinite(away).any():
        return None
    i = int(np.nanargmax(away))
    return max(0.0, float(away[i])), origin + (i + late) * _GRID


def _in_force(goals: _Goals, origin: float, cells: int) -> tuple[Floats, Floats]:
    """The lowest and highest goal in each cell, including the one in force at its begin."""
    at: NDArray[np.intp] = ((goals.t - origin) / _GRID).astype(np.intp)
    known = at < cells
    begins = origin + _GRID * np.arange(cells)
    newest = np.searchsorted(goals.t, begins, "right") - 1
    # before the first command nothing may move: the hull is the hand's position
    low = np.where(newest >= 0, goals.low[np.maximum(newest, 0)], np.inf)
    high = np.where(newest >= 0, goals.high[np.maximum(newest, 0)], -np.inf)
    np.minimum.at(low, at[known], goals.low[known])
    np.maximum.at(high, at[known], goals.high[known])
    return low, high


@check("DEX1-START-03", "DEX3-START-03")
@worst("motion_rad", "max_motion_stroke", nothing="too few states after a start")
def starts_idle(ctx: Context) -> Figures:
    """Motion and force between the first state of a started service and the first command.

    A requirement without ``max_tau_nm`` has no limit of the force.
    """
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        first = ctx.commands.t[(ctx.commands.t >= begin) & (ctx.commands.t < end)]
        rows = ctx.states.between(begin, float(first[0]) if len(first) else end)
        for joint in range(len(ctx.joints)):
            t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
            t, q = t[np.isfinite(q)], q[np.isfinite(q)]
            if len(t) < 5:
                continue
            away = np.abs(q - q[0])
            i = int(np.argmax(away))
            text = f"moved by {away[i]:.3f} {ctx.unit} before the first command after a start"
            yield Figure(float(away[i]), float(t[i]), None, joint, text)
        if "max_tau_nm" in ctx.requirement.tolerances:
            presses = judged(
                ctx,
                _presses(ctx, ctx.states.t[rows], ctx.states.tau[rows, 0]),
                "tau_nm",
                "max_tau_nm",
                nothing=ctx.passed("no force"),
            )
            if not presses.met:
                yield presses


def _presses(ctx: Context, t: Floats, tau: Floats) -> Figures:
    """The torques, N m, of a started gripper whose last command may have asked for one."""
    t, tau = t[np.isfinite(tau)], tau[np.isfinite(tau)]
    if len(t) < 5:
        return
    # a motor that releases a grip may still show its force at first
    for at in np.arange(float(t[0]) + ctx.tolerance("release_s"), float(t[-1]), 0.1).tolist():
        piece = np.abs(tau[(t >= at) & (t < at + 0.1)])
        if len(piece) >= 3:
            felt = median(piece)
            text = f"tau_est of {felt:.2f} N m before the first command after a start"
            yield Figure(felt, at, text=text)
