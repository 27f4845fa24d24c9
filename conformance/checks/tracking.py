"""How well the position follows the command over a session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.hand import Floats

_GRID = 0.005  # seconds; commands come at 200 Hz


@dataclass(frozen=True)
class Tracking:
    """Error figures of one session.

    :param delay: seconds by which the command has to be shifted for the least error.
    :param rms: error at that delay, rad.
    :param peak: likewise.
    :param raw: RMS without shifting, rad.
    """

    begin: float
    end: float
    delay: float
    rms: float
    peak: float
    peak_at: float
    raw: float
    blocked: float


def _session(ctx: Context) -> tuple[float, float] | str:
    commands = ctx.commands
    if ctx.recording.stimulus is not None:
        replays = ctx.phases("replay")
        if not replays:
            return "no session was replayed in this run"
        return ctx.span(replays[0])
    return float(commands.t[0]), float(commands.t[-1])


def measure(ctx: Context, search: float) -> Tracking | str:
    """Error figures, or why there are none."""
    span = _session(ctx)
    if isinstance(span, str):
        return span
    begin, end = span
    good = np.isfinite(ctx.commands.q)
    ct, cq = ctx.commands.t[good], ctx.commands.q[good]
    if len(ct) < 2 or len(ctx.states) < 2:
        return "too few commands or states"
    grid: Floats = np.asarray(np.arange(begin + search + 0.1, end, _GRID))
    if len(grid) * _GRID < ctx.tolerance("min_session_s") - search - 0.2:
        return f"the session is shorter than {ctx.tolerance('min_session_s'):g} s"
    at = np.searchsorted(ctx.states.t, grid, "right") - 1
    grid, at = grid[at >= 0], at[at >= 0]
    q, dq, tau = ctx.states.q[at], ctx.states.dq[at], ctx.states.tau[at]
    goal = cq[np.clip(np.searchsorted(ct, grid, "right") - 1, 0, None)]
    if not len(grid) or float(np.ptp(goal)) < ctx.tolerance("min_travel_stroke"):
        return "the commands hardly move in this recording"
    # blocked by an object: the command lies beyond it, or the motor presses and stands still
    if ctx.recording.stimulus is not None:
        free: NDArray[np.bool_] = np.ones(len(grid), dtype=np.bool_)
        if ctx.object_q is not None:
            free = (goal > ctx.object_q + 0.2) | (q > ctx.object_q + 0.3)
    else:
        free = ~((np.abs(tau) >= 0.5) & (np.abs(dq) < 0.3))
    free &= np.isfinite(q)
    if free.sum() * _GRID < 1.0:
        return "the gripper is blocked for nearly the whole session"
    best: tuple[float, float, Floats] | None = None
    raw = 0.0
    for delay in np.arange(0.0, search + _GRID / 2, _GRID):
        shifted = cq[np.clip(np.searchsorted(ct, grid - delay, "right") - 1, 0, None)]
        error = (q - shifted)[free]
        rms = float(np.sqrt(np.mean(error**2)))
        if delay == 0.0:
            raw = rms
        if best is None or rms < best[1]:
            best = (float(delay), rms, error)
    assert best is not None
    worst = int(np.argmax(np.abs(best[2])))
    return Tracking(
        begin=begin,
        end=end,
        delay=best[0],
        rms=best[1],
        peak=float(np.abs(best[2][worst])),
        peak_at=float(grid[free][worst]),
        raw=raw,
        blocked=float((~free).mean()),
    )


@check("DEX1-TRACK-01")
def follows(ctx: Context) -> Outcome:
    """RMS error at the best delay."""
    found = measure(ctx, ctx.tolerance("max_delay_s"))
    if isinstance(found, str):
        return ctx.skipped(found)
    text = (
        f"RMS {found.rms:.3f} rad, peak {found.peak:.2f} rad at {found.peak_at:.2f} s, delay "
        f"{found.delay * 1e3:.0f} ms, RMS without removing it {found.raw:.3f} rad"
    )
    if found.blocked:
        text += f"; {found.blocked:.0%} of the time blocked by an object and left out"
    values = {"rms_rad": found.rms, "peak_rad": found.peak, "delay_s": found.delay}
    if found.rms <= ctx.tolerance("max_rms_stroke"):
        return ctx.passed(f"rms {found.rms:.3f} rad", text, **values)
    return ctx.failed(
        f"rms {found.rms:.2f} rad",
        text,
        ctx.at(ctx.states.topic, found.peak_at),
        ctx.at(ctx.states.topic, found.begin, found.end),
        **values,
    )


@check("DEX1-TRACK-02")
def delay(ctx: Context) -> Outcome:
    """The best delay itself."""
    found = measure(ctx, ctx.tolerance("search_s"))
    if isinstance(found, str):
        return ctx.skipped(found)
    text = f"the position follows the command by {found.delay * 1e3:.0f} ms"
    if found.delay <= ctx.tolerance("max_delay_s"):
        return ctx.passed(f"{found.delay * 1e3:.0f} ms", text, delay_s=found.delay)
    return ctx.failed(
        f"{found.delay * 1e3:.0f} ms",
        text,
        ctx.at(ctx.states.topic, found.begin, found.end),
        delay_s=found.delay,
    )
