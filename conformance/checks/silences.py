"""Pauses of the commands to a hand of several joints, and what moves in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.checks.figures import Figure, judged
from dexkit.conformance.checks.obedience import stopped
from dexkit.conformance.hands import JointRoles, under_test
from dexkit.conformance.kit.median import medians
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.hand import Floats
from dexkit.models import ModeByte


def roles_of(ctx: Context) -> JointRoles:
    """The joints that the stimulus uses."""
    roles = under_test(ctx.recording.model.name).roles
    assert roles is not None  # every hand of several joints has them
    return roles


def mode_bytes(ctx: Context, rows: slice = slice(None)) -> NDArray[np.intp]:
    """Mode bytes of whole states, shape (n, 7)."""
    mode = ctx.states.mode[rows]
    return mode[np.isfinite(mode).all(axis=1)].astype(np.intp)


def motions_in(ctx: Context, joints: Sequence[int], begin: float, end: float) -> Floats:
    """Motion of each joint from begin to end, as a part of its stroke."""
    q = ctx.q(begin, end)[:, list(joints)]
    if len(q) < 5:
        return np.full(len(joints), np.nan)
    return np.asarray(np.ptp(q, axis=0) / [ctx.joints[j].stroke for j in joints])


@dataclass(frozen=True)
class Silence:
    """A phase without commands to this hand; times in seconds.

    :param last: the last command that was neither empty nor not finite.
    :param late: the time-out after that, with grace.
    :param driven: the phase in which joints were set in motion just before, if any were.
    :param guarded: whether each joint has time-out protection.
    """

    last: float
    late: float
    end: float
    driven: Phase | None
    guarded: NDArray[np.bool_]


def protected(ctx: Context, at: float) -> NDArray[np.bool_]:
    """Whether each joint has time-out protection by the last good command until ``at``."""
    commands = ctx.commands
    good = np.isfinite(commands.q).all(axis=1) & np.isfinite(commands.mode).all(axis=1)
    rows = np.flatnonzero(good & (commands.t <= at))
    if not len(rows) or ctx.recording.dialect.mode_byte is not ModeByte.RIS:
        return np.zeros(len(ctx.joints), dtype=np.bool_)
    return np.asarray(commands.mode[rows[-1]].astype(np.intp) >> 7 & 1, dtype=np.bool_)


def silences_of(ctx: Context, *names: str) -> list[Silence]:
    """The phases without commands."""
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    found = []
    for phase in (p for name in names for p in ctx.phases(name)):
        begin, end = ctx.span(phase)
        sent = good[good <= end]
        last = min(float(sent[-1]), begin + 0.05) if len(sent) else begin
        late = last + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        drives = [p for name in ("drive", "guard-drive") for p in ctx.phases(name)]
        just = [p for p in drives if 0 <= phase.begin_ns - p.end_ns < 1e8]
        guarded = protected(ctx, last)
        found.append(Silence(last, late, end, just[0] if just else None, guarded))
    return found


def stops_moving(ctx: Context, joints: Sequence[int], *, guarded: bool) -> Outcome:
    """Fail if joints that move when commands end still move after the time-out, or if others leave
    their place.

    :param guarded: whether joints with time-out protection are judged, or those without.
    """
    driven = [s for s in silences_of(ctx, "silence", "guard") if s.driven is not None]
    if not driven:
        return ctx.skipped("this hand held an object when the commands stopped")
    for silence in driven:
        if (stray := _strays(ctx, silence, guarded=guarded)) is not None:
            return stray
    outcomes = [
        _stops_in(ctx, mine, s)
        for s in driven
        if (mine := [j for j in joints if s.guarded[j] == guarded])
    ]
    if not outcomes:
        return ctx.skipped("no joint that moved when the commands stopped was to be judged")
    failed = [o for o in outcomes if o.met is False]
    passed = [o for o in outcomes if o.met]
    return (failed or passed or outcomes)[0]


_MEDIAN_S = 0.05  # s, of a place


def _strays(ctx: Context, silence: Silence, *, guarded: bool) -> Outcome | None:
    """Failure of a joint that neither moved nor was on its way, and leaves its place; else None.

    The way to its last goal is no leaving: a slow joint may still arrive.
    """
    roles, last, end = roles_of(ctx), silence.last, silence.end
    mine = [
        j
        for j in range(len(ctx.joints))
        if j not in roles.driven and j not in roles.slow and silence.guarded[j] == guarded
    ]
    before = ctx.q(last - _MEDIAN_S, last)[:, mine]
    rows = ctx.states.between(last, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows][:, mine]
    sent = np.flatnonzero(np.isfinite(ctx.commands.q).all(axis=1) & (ctx.commands.t <= last))
    if not mine or not len(before) or len(q) < 5 or not len(sent):
        return None
    spec = [ctx.joints[j] for j in mine]
    limits = [j.q_min for j in spec], [j.q_max for j in spec]
    here, goal = np.median(before, axis=0), np.clip(ctx.commands.q[sent[-1], mine], *limits)
    low, high = np.minimum(here, goal), np.maximum(here, goal)
    limit = ctx.requirement.tolerance("max_motion_stroke")
    beyond = np.maximum(low - q, q - high) / [j.stroke for j in spec]
    ends = np.searchsorted(t, t + _MEDIAN_S)
    windows = np.column_stack((np.arange(len(t)), ends))[ends < len(t)]
    figures = []
    for i in np.flatnonzero((beyond > limit).any(axis=0)).tolist():
        away = np.nan_to_num(medians(beyond[:, i], windows))  # noise is no motion
        if len(away):
            at = int(np.argmax(away))
            rad = float(away[at]) * spec[i].stroke
            text = f"left its place by {rad:.2f} {ctx.unit} after the last command"
            figures.append(Figure(rad, float(t[at]), end, mine[i], text))
    nothing = ctx.passed("in its place")
    outcome = judged(ctx, figures, "motion_rad", "max_motion_stroke", nothing=nothing)
    return None if outcome.met else outcome


def _stops_in(ctx: Context, joints: Sequence[int], silence: Silence) -> Outcome:
    last, late, end = silence.last, silence.late, silence.end
    before = motions_in(ctx, joints, last, last + ctx.tolerance("timeout_s"))
    after = motions_in(ctx, joints, late, end)
    if np.isnan(after).any() or np.isnan(before).any():
        return ctx.skipped("too few states in the silence")
    worst = int(np.argmax(after))
    joint = joints[worst]
    rad = float(after[worst]) * ctx.joints[joint].stroke
    rows = ctx.states.between(last, end)
    stop = stopped(
        *(ctx.states.t[rows], ctx.states.q[rows, joint]),
        last,
        ctx.tolerance("max_motion_stroke", joint),
        late - last,
    )
    if after[worst] > ctx.requirement.tolerance("max_motion_stroke"):
        outcome = ctx.failed(
            f"{rad:.2f} {ctx.unit}",
            ctx.named(
                f"moved by {rad:.2f} {ctx.unit} more than {ctx.tolerance('timeout_s'):g} s "
                "after the "
                "last command",
                joint,
            ),
            ctx.at(ctx.states.topic, late, end),
            motion_rad=rad,
        )
        return outcome.about(joint).resting_on(stop)
    if before.max() < ctx.requirement.tolerance("min_travel_stroke"):
        return ctx.skipped(
            "no joint that was set in motion still moved when the commands stopped: "
            "a braked joint cannot be distinguished from one at rest"
        )
    met = ctx.passed("stops", f"moving, then still ({rad:.3f} {ctx.unit})", motion_rad=rad)
    return met.resting_on(stop)
