"""Check the force or current that position servos report: in a grip, and without one.

Such a hand has no gains, and no source says how much force a goal beyond the object makes. So a
grip is recognised by position, and its force is compared with that of other grips of the run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, with_object, worst
from dexkit.conformance.checks.force import raw_counts
from dexkit.conformance.motor_messages import state_member
from dexkit.hand import Floats
from dexkit.models import model

__all__ = ["FEW_STANDS", "Stand", "stands"]

_PART_S, _GRID_S, _PARTS = 0.1, 0.05, 3
"""Seconds after ``settle_s`` in which the force is taken, seconds from one stretch to the next, and
the parts of a stretch."""
_STANDS = 0.03  # of the stroke: motion in a stretch
_AT_GOAL = 0.03  # of the stroke: distance from the goal of a joint that has reached it
_NEAR, _CLEAR = 0.08, 0.08  # of the stroke: from where the object is, of one that touches or not
_AWAY = 0.15  # of the stroke: way to the object of a squeeze that is compared with others
_END = 0.05  # of the stroke: distance from the ends within which a stop may press
_HEARD_S = 0.25  # s without a command, after which a hand may do what it does in a silence
_FAST = 0.5  # part of the full speed from which a goal is soon beyond the object
FEW_STANDS = 2
"""Stretches of a failure: a single one may be disturbed."""


@dataclass(frozen=True)
class Stand:
    """A stretch in which some joints stand under an unchanged command.

    :param presses: which joints the object holds back, well before their goal.
    :param free: which joints have reached their goal, where neither object nor stop is.
    :param force: median of tau_est towards closing in each third of it, shape (3, n_joints).
    """

    begin: float
    end: float
    presses: NDArray[np.bool_]
    free: NDArray[np.bool_]
    force: Floats


def stands(ctx: Context) -> list[Stand]:
    """Every such stretch of the run in which a joint presses on the object, or is free.

    The requirement says how long joints stand before their force is taken (``settle_s``), and how
    far from its goal one is held back (``min_held_stroke``).
    """
    settle, held = (ctx.requirement.tolerance(n) for n in ("settle_s", "min_held_stroke"))
    return ctx.once(("stands", settle, held), lambda: _stands(ctx, settle, held))


def _stands(ctx: Context, settle: float, held: float) -> list[Stand]:
    states, given = ctx.states, ctx.commands
    good = np.isfinite(given.q).all(axis=1) & np.isfinite(given.dq).all(axis=1)
    t, goals, speeds = given.t[good], given.q[good], given.dq[good]
    if not len(t) or not len(states):
        return []
    specs = ctx.joints
    stroke = np.array([j.stroke for j in specs])
    closing = np.array([j.closing for j in specs])
    low, high = np.array([j.q_min for j in specs]), np.array([j.q_max for j in specs])
    goals = np.clip(goals, low, high)
    changes = (np.abs(np.diff(goals, axis=0)) > 1e-6) | (np.abs(np.diff(speeds, axis=0)) > 1e-6)
    # in a silence a hand may stop pressing; the first command after it begins a stretch
    changes |= (np.diff(t) > _HEARD_S)[:, None]
    rows = np.where(changes, np.arange(1, len(t))[:, None], 0)
    since = np.vstack((np.zeros(len(specs), np.intp), np.maximum.accumulate(rows, axis=0)))
    fast = np.ones(len(specs), np.bool_)
    at = None if ctx.object_at is None else ctx.object_at / 100
    contact = np.array([j.closed_by(at) if at is not None and j.closing else np.nan for j in specs])
    found, seconds = [], round(settle + _PART_S, 9)
    for begin in np.arange(float(t[0]), float(t[-1]), _GRID_S).tolist():
        end = begin + seconds
        last = int(np.searchsorted(t, end, "right")) - 1
        if end - t[last] > _HEARD_S:
            continue
        same = t[since[last]] <= begin
        rows_here = states.between(begin, end)
        q, tau = states.q[rows_here], states.tau[rows_here]
        if not same.any() or len(q) < 2 * _PARTS or not np.isfinite(q).all():
            continue
        here = np.median(q, axis=0)
        still = same & (np.ptp(q, axis=0) <= _STANDS * stroke)
        if ctx.recording.dialect.speed_units:
            fast = speeds[last] >= _FAST
        left = (goals[last] - here) * closing / stroke
        with np.errstate(invalid="ignore"):
            way = (contact - here) * closing / stroke  # NaN without an object
            presses = still & fast & (left >= held) & (np.abs(way) <= _NEAR)
            clear = np.isnan(way) | (way >= _CLEAR)
        inside = (here >= low + _END * stroke) & (here <= high - _END * stroke)
        free = still & (np.abs(left) <= _AT_GOAL) & clear & inside & (closing != 0)
        if presses.any() or free.any():
            parts = np.array_split(tau * closing, _PARTS)
            force = np.array([np.median(part, axis=0) for part in parts])
            found.append(Stand(begin, end, presses, free, force))
    return found


def _member(ctx: Context) -> str:
    """The state's own name of tau_est."""
    return state_member(ctx.recording.dialect.state_type, "tau_est")


def _unit(ctx: Context) -> str:
    return model(ctx.recording.dialect.model).torque_unit


def _reported(ctx: Context) -> Outcome | None:
    """Why the force of a hand cannot be judged."""
    if not np.nan_to_num(ctx.states.tau).any():
        return ctx.absent(f"{_member(ctx)} is not filled (0 throughout)")
    return None


def _without_object(ctx: Context) -> Outcome | None:
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    if not any(s.presses.any() for s in stands(ctx)):
        return ctx.skipped("the object held no joint back for long enough")
    return None


def _extreme(
    ctx: Context, which: Callable[[Stand, int], bool], force: Callable[[float], float]
) -> tuple[float, int, Stand] | None:
    """The least ``force`` of tau_est at the end of a stretch, in parts of the joint's limit, the
    joint and the stretch; the second least of each joint. None without enough stretches.
    """
    found = []
    for joint, spec in enumerate(ctx.joints):
        mine = [
            (force(float(s.force[-1, joint])) / spec.tau_max, joint, s.begin, s)
            for s in stands(ctx)
            if which(s, joint)
        ]
        found += sorted(mine, key=lambda m: m[:3])[FEW_STANDS - 1 : FEW_STANDS]
    if not found:
        return None
    part, joint, _, stand = min(found, key=lambda f: f[:2])
    return part, joint, stand


@check("BRAINCO-FORCE-03")
def reported(ctx: Context) -> Outcome:
    """Whether tau_est is anything but 0 while the hand presses on the object."""
    if (skipped := _without_object(ctx)) is not None:
        return skipped
    most = max(float(np.abs(s.force[:, s.presses]).max()) for s in stands(ctx) if s.presses.any())
    text = f"{_member(ctx)} is {most:.2f} {_unit(ctx)} at most in a grip"
    if np.nan_to_num(ctx.states.tau).any():
        return ctx.passed(f"{most:.2f}", text, tau_nm=most)
    return ctx.failed("0", f"{_member(ctx)} is 0 throughout the run, in each grip as well")


@check("BRAINCO-FORCE-01")
def force_in_grip(ctx: Context) -> Outcome:
    """The smallest tau_est towards closing of a joint that stands against the object."""
    if (skipped := _without_object(ctx) or _reported(ctx)) is not None:
        return skipped
    unit = _unit(ctx)
    worst = _extreme(ctx, lambda s, joint: bool(s.presses[joint]), float)
    if worst is None:
        return ctx.skipped("the object held no joint back for long enough")
    part, joint, one = worst
    tau = part * ctx.joints[joint].tau_max
    text = ctx.named(f"{_member(ctx)} of {tau:.2f} {unit} towards closing in a grip", joint)
    limit = ctx.tolerance("min_part")
    if part >= limit:
        return ctx.passed(f"{tau:.2f} {unit}", text, tau_nm=tau)
    place = ctx.at(ctx.states.topic, one.begin, one.end)
    outcome = ctx.failed(f"{tau:.2f} {unit}", text, place, tau_nm=tau).about(joint)
    if part <= -limit:
        return outcome.because("It has the sign of the motor or of q, and not of closing.")
    return outcome


@check("BRAINCO-FORCE-02")
def unit(ctx: Context) -> Outcome:
    """The largest tau_est in the run, relative to the joint's limit."""
    tau = np.abs(np.nan_to_num(ctx.states.tau))
    limits = np.array([j.tau_max for j in ctx.joints])
    if not len(tau):
        return ctx.skipped("no state")
    row, joint = (int(i) for i in np.unravel_index(int(np.argmax(tau / limits)), tau.shape))
    most, name = float(tau[row, joint]), _unit(ctx)
    text = ctx.named(f"{_member(ctx)} of {most:.3g} {name} at most", joint)
    if most <= ctx.tolerance("max_part") * limits[joint]:
        return ctx.passed(f"{most:.3g} {name}", text, tau_nm=most)
    place = ctx.at(ctx.states.topic, float(ctx.states.t[row]))
    if ctx.hand.has_raw_torque:
        return raw_counts(ctx, joint, most, place, name)
    return ctx.failed(f"{most:.3g} {name}", text, place, tau_nm=most).about(joint)


@check("BRAINCO-FORCE-04")
def none_without_contact(ctx: Context) -> Outcome:
    """The largest tau_est of a joint that has reached its goal and touches nothing."""
    if (skipped := _reported(ctx)) is not None:
        return skipped
    unit = _unit(ctx)
    worst = _extreme(ctx, lambda s, joint: bool(s.free[joint]), lambda tau: -abs(tau))
    if worst is None:
        return ctx.skipped("no joint stood at its goal for long enough")
    part, joint, one = -worst[0], *worst[1:]
    tau = part * ctx.joints[joint].tau_max
    if (unknown := ctx.contact_unknown) is not None:
        shows = ctx.named(f"{tau:.2f} {unit} at its goal", joint)
        if part <= ctx.tolerance("max_part"):
            return unknown
        advice = ctx.requirement.advice
        return replace(unknown, reason=f"{unknown.reason}; {shows}: {_IF_NOTHING}. {advice}")
    text = ctx.named(
        f"{_member(ctx)} of {tau:.2f} {unit} at its goal, where it touches nothing", joint
    )
    if part <= ctx.tolerance("max_part"):
        return ctx.passed(f"{tau:.2f} {unit}", text, tau_nm=tau)
    place = ctx.at(ctx.states.topic, one.begin, one.end)
    outcome = ctx.failed(f"{tau:.2f} {unit}", text, place, tau_nm=tau).about(joint)
    return outcome.because(_OFFSET) if _has_offset(ctx, joint) else outcome


_IF_NOTHING = "if nothing touched it there, that is an offset"
_OFFSET = "It is there before the joint has pressed on anything: an offset."


def _has_offset(ctx: Context, joint: int) -> bool:
    """Whether a joint shows too much force even before its first grip."""
    limit = ctx.tolerance("max_part") * ctx.joints[joint].tau_max
    gripped = min((s.begin for s in stands(ctx) if s.presses[joint]), default=np.inf)
    before = [s for s in stands(ctx) if s.free[joint] and s.end < gripped]
    over = [s for s in before if abs(float(s.force[-1, joint])) > limit]
    return len(over) >= FEW_STANDS


@check("BRAINCO-FORCE-05")
@with_object
@worst("part", "min_part", nothing="no joint pressed with enough force to compare")
def grips_alike(ctx: Context) -> Figures:
    """The weakest stretch of a joint's grips, relative to the strongest."""
    if (skipped := _without_object(ctx) or _reported(ctx)) is not None:
        yield skipped
    for joint, spec in enumerate(ctx.joints):
        mine = [s for s in stands(ctx) if s.presses[joint]]
        strongest = max((float(np.abs(s.force[:, joint]).max()) for s in mine), default=0.0)
        weak = strongest < ctx.tolerance("min_strongest_part") * spec.tau_max
        if weak or len(mine) < FEW_STANDS:
            continue
        ends = [abs(float(s.force[-1, joint])) for s in mine]
        second = int(np.argsort(ends, kind="stable")[FEW_STANDS - 1])
        yield _compared(ctx, joint, ends[second], strongest, mine[second].begin, mine[second].end)


def _compared(
    ctx: Context, joint: int, weakest: float, strongest: float, begin: float, end: float
) -> Figure:
    """A joint's weakest grip, relative to its strongest."""
    unit = _unit(ctx)
    text = (
        f"{_member(ctx)} of {weakest:.2f} {unit} in a grip, where it was {strongest:.2f} {unit} at "
        "most"
    )
    return Figure(weakest / strongest, begin, end, joint, text)


@check("FTP-FORCE-07")
@with_object
@worst(
    "part", "min_part", nothing="no joint squeezed the object twice with enough force to compare"
)
def squeezes_alike(ctx: Context) -> Figures:
    """The weakest squeeze of a joint, relative to its strongest one that began as far away."""
    if (skipped := _without_object(ctx) or _reported(ctx)) is not None:
        yield skipped
    for joint, spec in enumerate(ctx.joints):
        found = _squeezes(ctx, joint)
        strongest = max((force for force, _ in found), default=0.0)
        if strongest >= ctx.tolerance("min_strongest_part") * spec.tau_max and len(found) >= 2:
            weakest, span = min(found)
            yield _compared(ctx, joint, weakest, strongest, *span)


def _squeezes(ctx: Context, joint: int) -> list[tuple[float, tuple[float, float]]]:
    """The median force of a joint in each squeeze, and when it was.

    Not of a squeeze that began at the object: on contact, the force rises with the speed.
    """
    at, spec = ctx.object_at, ctx.joints[joint]
    if at is None or not spec.closing:
        return []
    contact = spec.closed_by(at / 100)
    found = []
    for phase in ctx.phases("squeeze"):
        begin, end = ctx.span(phase)
        q = ctx.q(begin - _GRID_S, begin)[:, joint]
        if not len(q) or (contact - q[-1]) * spec.closing < _AWAY * spec.stroke:
            continue
        inside = [s for s in stands(ctx) if begin <= s.begin and s.end <= end and s.presses[joint]]
        if len(inside) >= FEW_STANDS:
            force = float(np.median([s.force[-1, joint] for s in inside]))
            found.append((force, (inside[0].begin, inside[-1].end)))
    return found
