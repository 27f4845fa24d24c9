"""The hand follows a session of commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.command_age import PAUSE
from dexkit.conformance.checks import STROKE_S, Context, Late, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, judged
from dexkit.conformance.checks.steps import own_speed, rest_error, speed_of, steps_of
from dexkit.conformance.kit.row_selection import Selected, finite_rows
from dexkit.conformance.kit.sums import mean
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.conformance.stimuli.script import Send, Steps
from dexkit.hand import Floats


@stimulus("replay", HandScript, after="burst limp push")
def replay_session(script: HandScript) -> Steps:
    """The recorded session, if there is one, and back to the middle."""
    if script.plan.session is not None:
        yield from _replay(script, script.plan.session)
        yield from script.everyone("center", script.homes())


def _replay(script: HandScript, session: CommandSession) -> Steps:
    sides = [s for s in script.plan.sides if s in session.sides]
    if not sides:
        return
    dialect = script.plan.dialect
    timeline = script.timeline
    newest = {s: session.first(s, dialect) for s in sides}
    script.goal.update({s: tuple(m.q for m in motors) for s, motors in newest.items()})
    reachable = [s for s in sides if script.reachable(s)]
    yield from script.until_settled(None, reachable, least=0.4, most=2.0)
    script.report(f"replaying {session.duration:.0f} s of the recorded session {session.name}")
    phase = script.begin("replay", sides, session=session.name)
    start = script.obs.now_ns
    for i, (at, motors) in enumerate(timeline):
        late = script.obs.now_ns - start - at
        if late > PAUSE * 1e9:  # all that fell due, sent at once, would move the hand wildly
            script.report(f"this program stood still for {late / 1e9:.2f} s; the session is held")
            start += late
        newest.update(motors)
        payloads = script.codec.encode(newest if script.codec.shared else motors)
        later = timeline[i + 1][0] if i + 1 < len(timeline) else at + script.period_ns
        yield from script.do(Send(payloads, start + later))
    script.end(phase)
    script.next_ns = script.obs.now_ns
    script.goal.update({s: tuple(m.q for m in newest[s]) for s in sides})


_GRID = 0.005  # seconds; clients send commands at 200 Hz


_TOLERANCES = (
    *("min_session_s", "min_travel_stroke", "blocked_tau_nm", "blocked_speed_rad_s"),
    *("min_speed_rad_s", "min_step_stroke"),
)
"""Tolerances that the error figures depend on."""


_SAME = 1e-12
"""Largest relative difference between sums of squares in different order."""


_ROUNDING = 1e-11
"""Largest relative error of a sum of squares."""


_STEPS = (16, 4)
"""Step of the coarse search over delays, before the fine search."""


@dataclass(frozen=True)
class Tracking:
    """Error figures of one joint in one session.

    :param delay: seconds by which the command has to be shifted for the least error.
    :param rms: error at that delay, rad; see :func:`_within_reach` for a slow hand.
    :param peak: likewise.
    :param raw: RMS without shifting, rad.
    """

    joint: int
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


def measure(ctx: Context, search: float) -> list[Tracking] | str:
    """Error figures of the joints that the session moves, or the reason why there are none."""
    tolerances = ctx.requirement.tolerances
    used = tuple(tolerances.get(name) for name in _TOLERANCES)
    return ctx.once(("tracking", search, *used), lambda: _measured(ctx, search))


def _measured(ctx: Context, search: float) -> list[Tracking] | str:
    span = _session(ctx)
    if isinstance(span, str):
        return span
    rows = _Rows(ctx.commands.t, ctx.states.t)
    found = [_measure(ctx, joint, span, search, rows) for joint in range(len(ctx.joints))]
    figures = [f for f in found if isinstance(f, Tracking)]
    return figures or next(f for f in found if isinstance(f, str))


class _Rows:
    """The newest command and state at each of other times.

    Nearly all joints have the same times, so results are kept.
    """

    def __init__(self, commands: Floats, states: Floats) -> None:
        self._commands, self._states = commands, states
        self._known: dict[tuple[object, ...], NDArray[np.intp]] = {}

    def of_states(self, times: Floats) -> NDArray[np.intp]:
        """Row of the newest state; -1 before the first."""
        return self._find(self._states, times, ())

    def of_commands(self, times: Floats, good: Selected) -> NDArray[np.intp]:
        """Row of the newest command among the good ones, or the first of them."""
        which = b"" if isinstance(good, slice) else good.tobytes()
        return np.clip(self._find(self._commands[good], times, (which,)), 0, None)

    def _find(self, t: Floats, times: Floats, which: tuple[object, ...]) -> NDArray[np.intp]:
        key = (*which, len(times), *times[:1].tolist())  # times lie on a grid
        if key not in self._known:
            self._known[key] = np.searchsorted(t, times, "right") - 1
        return self._known[key]


def _measure(
    ctx: Context, joint: int, span: tuple[float, float], search: float, rows: _Rows
) -> Tracking | str:
    begin, end = span
    good = finite_rows(ctx.commands.q[:, joint])
    cq = ctx.commands.q[:, joint][good]
    if len(cq) < 2 or len(ctx.states) < 2:
        return "too few commands or states"
    grid: Floats = np.asarray(np.arange(begin + search + 0.1, end, _GRID))
    if len(grid) * _GRID < ctx.tolerance("min_session_s") - search - 0.2:
        return f"the session is shorter than {ctx.tolerance('min_session_s'):g} s"
    at = rows.of_states(grid)
    if len(at) and at[0] < 0:
        grid, at = grid[at >= 0], at[at >= 0]
    if not len(grid):
        return "the commands hardly move in this recording"
    # Delays are steps of the grid: the commands are sampled once, on a grid that begins earlier.
    most = round(search / _GRID)
    longer = np.concatenate([grid[0] - _GRID * np.arange(most, 0, -1), grid])
    asked = commanded = cq[rows.of_commands(longer, good)]
    goal = commanded[most:]
    if float(np.ptp(goal)) < ctx.tolerance("min_travel_stroke", joint):
        return "the commands hardly move in this recording"
    q = ctx.states.q[:, joint][at]
    free = _free(ctx, joint, at, goal) & np.isfinite(q)
    if free.sum() * _GRID < 1.0:
        return "the hand is blocked for nearly the whole session"
    top_speed = _top_speed(ctx, joint)
    if top_speed is not None:
        asked = _within_reach(commanded, top_speed * _GRID)
    # sum of w (q - asked)^2 for every delay, as products of whole columns; small about the mean
    at_work = slice(None) if free.all() else np.flatnonzero(free)
    middle = mean(q[at_work])
    seen, asked, commanded = q - middle, asked - middle, commanded - middle
    seen[~free] = 0.0
    n = len(grid)
    best = _best_delay(seen, asked, free)
    reached = asked[most - best : most - best + n][at_work]
    # a hand that is sometimes faster than assumed lies between the reachable goal and the command
    error = seen[at_work] - reached
    if top_speed is not None:
        wanted = commanded[most - best : most - best + n][at_work]
        low, high = np.minimum(reached, wanted), np.maximum(reached, wanted)
        error = seen[at_work] - np.clip(seen[at_work], low, high)
    error = np.abs(error)
    worst = int(np.argmax(error))
    return Tracking(
        joint=joint,
        begin=begin,
        end=end,
        delay=best * _GRID,
        rms=math.sqrt(mean(error**2)),
        peak=float(error[worst]),
        peak_at=float(grid[at_work][worst]),
        raw=math.sqrt(mean((seen - asked[most:])[at_work] ** 2)),
        blocked=float((~free).mean()),
    )


def _best_delay(seen: Floats, asked: Floats, free: NDArray[np.bool_]) -> int:
    """The shortest delay with the least sum of squares, in steps of the grid.

    :param seen: positions; 0 where they do not count.
    :param asked: what they are compared with: longer by the longest delay.
    :param free: which positions count.
    """
    n, delays = len(seen), len(asked) - len(seen) + 1
    squared = asked**2
    late = sliding_window_view(asked, n)[::-1]  # by delay
    # einsum, for BLAS would start threads for this
    own = float(np.einsum("i,i", seen, seen))
    some = None if free.all() else free.astype(np.float64)
    if some is None:
        sums = np.concatenate(([0.0], np.cumsum(squared)))
        squares = (sums[n:] - sums[:-n])[::-1]
    else:
        late2 = sliding_window_view(squared, n)[::-1]

    def errors(of: slice) -> Floats:
        """The sums of squares at some delays; of two or more, for one alone adds up otherwise."""
        wanted = squares[of] if some is None else np.einsum("ki,i->k", late2[of], some)
        return np.asarray(own + wanted - 2.0 * np.einsum("ki,i->k", late[of], seen))

    same = _SAME * own  # differences between machines are smaller
    off = _ROUNDING * (own + float(np.einsum("i,i", asked, asked)))
    # between neighbouring delays the root of the sum changes by no more than the command
    change = math.sqrt(float(np.einsum("i,i", *[np.diff(asked)] * 2))) * (1 + _ROUNDING)
    first, last = 0, delays - 1
    for step in _STEPS:
        if last - first <= 2 * step:
            continue
        tried, every = np.arange(first, last + 1, step), np.arange(first, last + 1)
        found = errors(slice(first, last + 1, step))
        most = math.sqrt(max(float(found.min()), 0.0) + same + 2 * off)
        beyond = np.sqrt(np.maximum(found - off, 0.0)) - most
        larger = (np.abs(every[:, None] - tried) * change < beyond).any(axis=1)
        left = every[~larger]
        first, last = int(left[0]), int(left[-1])
    first = max(0, min(first, last - 1))
    found = errors(slice(first, max(last, first + 1) + 1))
    return first + int(np.argmax(found <= max(float(found.min()), 0.0) + same))


def _top_speed(ctx: Context, joint: int) -> float | None:
    """Speed limit assumed for a joint, rad/s: a gripper's slowest in large steps of the run, or a
    finger joint's limiting speed; at least the required minimum.

    None if the requirement does not allow for it, without a limit, or without such steps: the
    client of an external session knew the state.
    """
    if "min_speed_rad_s" not in ctx.requirement.tolerances:
        return None
    if len(ctx.joints) > 1:
        reached = own_speed(ctx, joint, ctx.requirement.tolerance("min_step_stroke"))
        return None if reached is None else max(reached, ctx.tolerance("min_speed_rad_s"))
    shown = [
        speed_of(step)
        for phase in ctx.phases("step")
        for step in steps_of(ctx, phase)
        if step.joint == joint and abs(step.size) >= ctx.tolerance("min_step_stroke", joint)
    ]
    speeds = [speed for speed in shown if speed is not None]
    return max(min(speeds), ctx.tolerance("min_speed_rad_s")) if speeds else None


def _within_reach(goal: Floats, most: float) -> Floats:
    """The goal that a hand of limited speed can reach.

    :param goal: rad, at equal intervals.
    :param most: largest change in one interval, rad.
    """
    reached = goal.copy()
    for i in range(1, len(goal)):
        step = goal[i] - reached[i - 1]
        reached[i] = reached[i - 1] + min(max(step, -most), most)
    return reached


def _free(ctx: Context, joint: int, at: NDArray[np.intp], goal: Floats) -> NDArray[np.bool_]:
    """Rows in which no object blocks a joint.

    A gripper's object is known from the run's settings. Otherwise a joint that presses and does not
    move counts as blocked.
    """
    states = ctx.states
    if ctx.recording.stimulus is not None:
        if ctx.object_at is None:
            return np.ones(len(at), dtype=np.bool_)
        if len(ctx.joints) == 1:
            q = states.q[:, joint][at]
            return np.asarray((goal > ctx.object_at + 0.2) | (q > ctx.object_at + 0.3))
    presses = np.abs(states.tau[:, joint][at]) >= ctx.tolerance("blocked_tau_nm")
    stands = np.abs(states.dq[:, joint][at]) < ctx.tolerance("blocked_speed_rad_s")
    return np.asarray(~(presses & stands))


@check("DEX1-TRACK-01", "DEX3-TRACK-01", explained_by=("kp", "tau"))
def follows(ctx: Context) -> Outcome:
    """RMS error at the best delay; a long delay only warns."""
    figures = measure(ctx, ctx.tolerance("search_s"))
    if isinstance(figures, str):
        return ctx.skipped(figures)
    if ctx.recording.provenance.nominal:  # a delay is by times, which nobody measured here
        return _error(ctx, figures)
    return all_of(_error(ctx, figures), warning(_delay(ctx, figures)))


def _error(ctx: Context, figures: Sequence[Tracking]) -> Outcome:
    """The RMS error."""
    several = len(ctx.joints) > 1
    each = ", ".join(f"{ctx.joints[f.joint].name} {f.rms:.3f}" for f in figures)
    values = {f"rms_rad_{ctx.joints[f.joint].name}": f.rms for f in figures if several}

    def figure(found: Tracking) -> Figure:
        text = (
            f"RMS {found.rms:.3f} {ctx.unit}, peak {found.peak:.2f} {ctx.unit} at "
            f"{found.peak_at:.2f} s, delay {found.delay * 1e3:.0f} ms, RMS without removing it "
            f"{found.raw:.3f} {ctx.unit}"
        )
        if found.blocked:
            text += f"; {found.blocked:.0%} of the time blocked by an object and left out"
        if several:
            text = f"is worst: {text}; RMS by joint: {each}"
        return Figure(
            found.rms,
            found.begin,
            found.end,
            found.joint,
            text,
            shown=f"rms {found.rms:.3f} {ctx.unit}",
            limit=ctx.tolerance("max_rms_stroke", found.joint) + rest_error(ctx, found.joint),
            late=STROKE_S * found.rms / ctx.joints[found.joint].stroke * (found.end - found.begin),
            values={"peak_rad": found.peak, "delay_s": found.delay, **values},
        )

    outcome = judged(ctx, map(figure, figures), "rms_rad", "max_rms_stroke", nothing="")
    if outcome.met:
        return outcome
    return outcome.about(*(f.joint for f in sorted(figures, key=lambda f: -f.rms)))


def _delay(ctx: Context, figures: Sequence[Tracking]) -> Outcome:
    """The delay with the least error."""
    found = sorted(figures, key=lambda f: f.delay)[len(figures) // 2]
    size = found.delay - ctx.tolerance("max_delay_s")
    figure = Figure(
        found.delay,
        found.begin,
        found.end,
        text=f"the position follows the command by {found.delay * 1e3:.0f} ms",
        shown=f"{found.delay * 1e3:.0f} ms",
        late=Late((max(size, 0.0),), "mean"),
    )
    return judged(ctx, [figure], "delay_s", "max_delay_s", nothing="")
