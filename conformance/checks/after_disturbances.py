"""Check a hand after disturbances: bad commands, silence, another client."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.firmness import STIFFNESS, displacement_noise, is_alike, nudges
from dexkit.conformance.checks.motion import Step, disobeyed, obeyed_before, steps, steps_of
from dexkit.conformance.measurement_error import Measure
from dexkit.conformance.median import median
from dexkit.hand import Floats
from dexkit.unseen import UNSEEN_S

__all__ = ["fastest"]

_AFTER_ABUSE = ("recover", "resume", "company", "restart", "service-restart")
_RESTARTED = ("company", "restart", "service-restart")
_AT_A_STOP = 0.05
"""Distance from an end of the stroke, as a part of it, at which a gripper may be at its stop."""
_AT_REST_PART = 0.01
"""Part of the range by which q may vary in the 0.1 s before a step that begins at rest."""
_FAST_S = 0.05
"""Seconds over which the fastest part of a step is measured: several states of the slowest rate."""


@check("DEX1-ABUSE-01", "DEX3-ABUSE-01")
def unchanged(ctx: Context) -> Outcome:
    """Compare duration and speed of good steps, and the displacement by a torque, after each abuse
    with those before any; also the errors of the steps between the phases.
    """
    between = [*ctx.phases("center"), *ctx.phases()]
    for phase in (p for p in between if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            if step.error > ctx.tolerance("max_error_stroke", step.joint):
                return disobeyed(ctx, "between two phases", step)
    first = [s for s in steps(ctx) if abs(s.size) >= ctx.tolerance("min_step_stroke", s.joint)]
    speeds = judged(
        ctx, _speeds(ctx, first), "speed_rad_s", "min_speed_part", nothing=ctx.passed("no step")
    )
    if not speeds.met:
        return speeds
    nothing = "no two steps that can be compared"
    return _other_stiffness(ctx) or judged(
        ctx, _durations(ctx, first), "ratio", "max_ratio", nothing=nothing
    )


def _like(first: list[Step], step: Step) -> list[Step]:
    return [s for s in first if s.joint == step.joint and 0.7 < step.size / s.size < 1.4]


def _durations(ctx: Context, first: list[Step]) -> Figures:
    """The duration of each step, as a part of that of the same step before."""
    for phase in (p for name in _AFTER_ABUSE for p in ctx.phases(name)):
        for step in steps_of(ctx, phase):
            seconds = _duration(step)
            known = [d for d in map(_duration, _like(first, step)) if d is not None]
            if seconds is None or not known:
                continue  # other requirements judge whether it arrives at all
            slack = ctx.tolerance("slack_s" if phase.name == "recover" else "soft_start_s")
            longest = ctx.tolerance("max_ratio") * (max(known) + slack)
            yield step.figure(
                seconds / (max(known) + slack),
                f"{seconds:.2f} s from 10 to 90 % at {step.begin:.1f} s, {max(known):.2f} s in the "
                "same step before any bad command",
                late=seconds - longest,
                measure=Measure(seconds, longest, span=(step.begin, step.end)),
            )


def _duration(step: Step) -> float | None:
    """Seconds from 10 to 90 % of a step; None if it does not get there."""
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not (part >= 0.9).any():
        return None
    return float(step.t[np.argmax(part >= 0.9)] - step.t[np.argmax(part >= 0.1)])


def _speeds(ctx: Context, first: list[Step]) -> Figures:
    """The speeds of steps after bad commands, after a restart or with a second client, each with
    the least that it may be after the same step before.
    """
    # the first step for another client, and after a restart, may begin softly
    later = [p for name in _RESTARTED for p in ctx.phases(name)[1:]]
    for phase in (p for p in (*ctx.phases("recover"), *later) if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            before = ctx.q(step.begin - 0.1, step.begin)[:, step.joint]
            at_rest = len(before) and np.ptp(before) < _AT_REST_PART * step.stroke
            if not (at_rest and ctx.seen(step.begin - 0.1, step.begin)):
                continue  # it was under way, so that this is not the same step
            now = fastest(step)
            known = [
                # a hand of constant speed is not faster over a longer distance, a spring-like one
                # is
                fast * min(1.0, abs(step.size / s.size))
                for s in _like(first, step)
                if (fast := fastest(s)) is not None
            ]
            if now is None or not known:
                continue
            least = ctx.tolerance("min_speed_part") * min(known)
            yield step.figure(
                now,
                f"{now:.1f} {ctx.unit}/s at its fastest in a step at {step.begin:.1f} s, "
                f"{min(known):.1f} {ctx.unit}/s in the same step before any bad command",
                limit=least,
                late=0.8 * abs(step.size) * (1.0 / max(now, 1e-3) - 1.0 / least),
            )


def fastest(step: Step) -> float | None:
    """The speed of a step's fastest part, rad/s; None if it has no such part, does not arrive, or
    moved while there was no state.
    """
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not (part >= 0.9).any():
        return None
    until = int(np.argmax(part >= 0.9))
    if np.diff(step.t[: until + 1], prepend=step.begin).max() > UNSEEN_S:
        return None
    later = np.searchsorted(step.t, step.t + _FAST_S)
    whole = np.flatnonzero(later < len(step.t))
    if not len(whole):
        return None
    took = step.t[later[whole]] - step.t[whole]
    return abs(step.size) * float(np.max((part[later[whole]] - part[whole]) / took))


def _other_stiffness(ctx: Context) -> Outcome | None:
    """The failure of a hand that a torque displaces more or less than it did at first."""
    pulses = [p for p in ctx.phases(STIFFNESS) if obeyed_before(ctx, p)]
    found = nudges(ctx, pulses)
    if len(found) < 2:
        return None
    first, *later = sorted(found, key=lambda n: n.begin)
    if first.way < ctx.tolerance("min_motion_stroke"):
        return None
    parts = ctx.tolerance("min_way_part"), ctx.tolerance("max_way_part")
    noise = displacement_noise(ctx, pulses)
    for nudge in later:
        if not is_alike(first, nudge, parts, noise):
            text = (
                f"a torque displaced it by {nudge.way:.3f} {ctx.unit} at {nudge.begin:.1f} s, and "
                f"by {first.way:.3f} {ctx.unit} before any bad command"
            )
            place = ctx.at(ctx.states.topic, nudge.begin, nudge.end)
            figure = f"{nudge.way:.3f} {ctx.unit}"
            return ctx.failed(figure, text, place, motion_rad=nudge.way)
    return None


@check("DEX1-WDOG-05")
@worst(
    "motion_rad",
    "min_motion_stroke",
    nothing="no command after a pause was alone for long enough",
)
def first_command_counts(ctx: Context) -> Figures:
    """Motion of the hand by the first command after a pause, until the second command."""
    for step in (s for p in ctx.phases() if obeyed_before(ctx, p) for s in steps_of(ctx, p)):
        sent = ctx.commands.t[ctx.commands.t >= step.begin]
        if abs(step.size) < ctx.tolerance("min_step_stroke", step.joint) or len(sent) < 2:
            continue
        alone = float(sent[1] - sent[0])
        if alone < ctx.tolerance("min_alone_s"):
            continue
        way = (step.q[step.t <= sent[1]] - step.start) * np.sign(step.size)
        moved = float(way.max()) if len(way) else 0.0
        text = (
            f"the first command after a pause, alone for {alone:.2f} s, moved it by {moved:.3f} "
            f"{ctx.unit} towards {step.target:.2f} {ctx.unit}"
        )
        yield Figure(moved, step.begin, step.begin + alone, step.joint, text, late=alone)


@check("DEX1-WDOG-06")
@worst("part", "min_part", nothing="it neither pressed nor moved when the commands stopped")
def in_force(ctx: Context) -> Figures:
    """Force or speed shortly before the time-out, relative to that at the last command."""
    window, states, until = ctx.tolerance("window_s"), ctx.states, ctx.tolerance("until_s")
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        _, end = ctx.span(phase)
        sent = good[good <= end]
        if not len(sent) or end - sent[-1] < until:
            continue
        last = float(sent[-1])
        late = last + until - window
        spans = [states.between(a, a + window) for a in (last - window, late)]
        if min(len(states.t[s]) for s in spans) < 5:
            continue
        what = ""
        if ctx.object_at is not None:
            before, after = (median(np.abs(states.tau[s, 0])) for s in spans)
            if before >= ctx.tolerance("min_tau_nm"):
                part, what = after / before, f"presses with {after:.2f} N m, {before:.2f} N m"
        if not what:
            before, after = (_speed(states.t[s], states.q[s, 0]) for s in spans)
            place, spec = median(states.q[spans[1], 0]), ctx.joints[0]
            near = _AT_A_STOP * spec.stroke
            free = spec.q_min + near < place < spec.q_max - near
            free = free and not _arrives(ctx, last, abs(before) * until)
            if not free or abs(before) < ctx.tolerance("min_speed_stroke"):
                continue
            unit = f"{ctx.unit}/s"
            part, what = after / before, f"moves at {after:.2f} {unit}, {before:.2f} {unit}"
        text = f"{until:g} s after the last command it {what} at that command"
        yield Figure(part, late, late + window, text=text)


def _arrives(ctx: Context, at: float, way: float) -> bool:
    """Whether the last command before a time has a position that is nearer than so far, rad."""
    row = int(np.searchsorted(ctx.commands.t, at, "right")) - 1
    here = ctx.q(at - 0.05, at)[:, 0]
    if not ctx.commands.kp[row, 0] > 0 or not len(here):
        return False
    return abs(float(ctx.commands.q[row, 0]) - median(here)) < way


def _speed(t: Floats, q: Floats) -> float:
    """Slope of the line through all of them, which noise changes little, rad/s."""
    t = t - t.mean()
    return float(t @ (q - q.mean())) / max(float(t @ t), 1e-9)
