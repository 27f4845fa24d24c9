"""Commands with values or lengths that no client should send do no harm."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.checks import Context, Outcome, causes, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.nudges import STIFFNESS, displacement_noise, is_alike, nudges
from dexkit.conformance.checks.obedience import sags, silent, stays, unharmed
from dexkit.conformance.checks.robot import LATE_S, RobotContext, no_state
from dexkit.conformance.checks.steps import Step, disobeyed, obeyed_before, steps, steps_of
from dexkit.conformance.checks.timing import gaps
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.unseen import UNSEEN_S


@check("DEX1-SAFE-01", "DEX3-SAFE-01")
def not_finite(ctx: Context) -> Outcome:
    """Commands with NaN and infinity in every field."""
    return stays(ctx, "commands with NaN and infinity")


@check("DEX1-SAFE-02", "DEX3-SAFE-02")
def out_of_range(ctx: Context) -> Outcome:
    """Commands to positions far outside the stroke."""
    margin = ctx.tolerance("margin_rad")
    reached: list[tuple[float, float]] = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end + 0.1)
        for joint, spec in enumerate(ctx.joints):
            q = ctx.states.q[rows, joint]
            if not len(q):
                continue
            bad = ~((q >= spec.q_min - margin) & (q <= spec.q_max + margin))
            if bad.any():
                i = int(np.argmax(bad))
                text = (
                    f"q became {q[i]:.2f} {ctx.unit}; the stroke is {spec.q_min:g} to "
                    f"{spec.q_max:.2f} {ctx.unit}"
                )
                place = ctx.at(ctx.states.topic, float(ctx.states.t[rows][i]))
                outcome = ctx.failed(f"{q[i]:.2f} {ctx.unit}", ctx.named(text, joint), place)
                return outcome.about(joint).because(causes.of_range(float(np.nanmax(q))))
            wrong = judged(
                ctx,
                _other_ways(ctx, phase, joint),
                "back_rad",
                "max_back_stroke",
                nothing=ctx.passed(""),
            )
            if not wrong.met:
                return wrong
            reached.append((float(q.min()), float(q.max())))
    outcome = unharmed(ctx, "commands far out of range")
    if outcome.met is False or outcome.reason:
        return outcome
    figure, values = "within limits", {}
    if len(ctx.joints) == 1 and reached:
        figure = f"{reached[0][0]:.2f} .. {reached[0][1]:.2f} {ctx.unit}"
        values = {"q_min": reached[-1][0], "q_max": reached[-1][1]}
    met = ctx.passed(figure, "q stayed within the stroke, then obeyed", **values)
    return met.resting_on(*outcome.measures)


_TURNS_S = 0.25  # s for a moving hand to reverse, with its allowed delay


def _other_ways(ctx: Context, phase: Phase, joint: int) -> Iterator[Figure]:
    """How far a joint moves away from the end beyond which its goal lies."""
    begin, end = ctx.span(phase)
    spec = ctx.joints[joint]
    rows = ctx.given(begin, end)
    t, q = ctx.commands.t[rows], ctx.commands.q[rows, joint]
    far = (q > spec.q_max + 0.1 * spec.stroke) * 1 - (q < spec.q_min - 0.1 * spec.stroke) * 1
    t, far = t[far != 0], far[far != 0]
    turns = np.flatnonzero(np.diff(far, prepend=0))
    for a, b, way in zip(t[turns], [*t[turns[1:]], end], far[turns], strict=True):
        # before the first of them it was at rest
        since = a + _TURNS_S if a > t[0] else a
        turning = ctx.q(a - 0.05, since)[:, joint] * way
        later = ctx.states.between(since, b)
        if not len(turning) or not len(ctx.states.t[later]):
            continue
        back = float(turning.min()) - ctx.states.q[later, joint] * way
        i = int(np.argmax(back))
        text = (
            f"commanded far {'above' if way > 0 else 'below'} its range it went the other way by "
            f"{back[i]:.2f} {ctx.unit}"
        )
        yield Figure(float(back[i]), float(ctx.states.t[later][i]), None, joint, text)


@check("DEX1-SAFE-03", "DEX3-SAFE-03")
def empty(ctx: Context) -> Outcome:
    """Commands without a motor in them."""
    return stays(ctx, "empty commands")


@check("DEX1-SAFE-04")
def long(ctx: Context) -> Outcome:
    """A command with too many motors."""
    return stays(ctx, "commands for more motors than there are")


@check("DEX1-SAFE-05", "DEX3-SAFE-06")
def negative_gains(ctx: Context) -> Outcome:
    """Commands with negative kp and kd."""
    return stays(ctx, "commands with negative gains", sags=sags(ctx))


@check("DEX1-SAFE-10", "DEX3-SAFE-11")
@worst("motion_rad", "max_motion_stroke", nothing="no state during commands with negative gains")
def driven_away(ctx: Context) -> Figures:
    """Motion away from q during commands with negative gains."""
    sag = sags(ctx)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - 0.1, begin), ctx.q(begin, end)
        given = ctx.given(begin, end) & (ctx.commands.kp < 0).any(axis=1)
        if not len(before) or not len(q) or not given.any():
            continue
        start = np.median(before, axis=0)
        way = np.sign(np.median(ctx.commands.q[given], axis=0) - start)
        with np.errstate(invalid="ignore"):
            away = np.max((start - q) * way, axis=0) - (0.0 if sag is None else sag)
        for joint in np.flatnonzero(np.isfinite(away)).tolist():
            most = max(0.0, float(away[joint]))
            text = f"moved by {most:.2f} {ctx.unit} away from q with negative gains"
            yield Figure(most, begin, end, joint, text)


@check("DEX1-SAFE-06", "DEX3-SAFE-07")
def foreign_type(ctx: Context) -> Outcome:
    """Messages of another type on the command topic."""
    return stays(ctx, "messages of another type on its command topic")


@check("DEX1-SAFE-07", "DEX3-SAFE-08")
@worst("motion_rad", "max_motion_stroke", nothing="no state around the burst")
def burst(ctx: Context) -> Figures:
    """Distance from the last command's goal after a burst of hundreds of commands."""
    wait, limit = ctx.tolerance("settle_s"), ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        found = gaps(ctx, limit, begin - 0.05, end)
        if found:
            text = f"no state from {found[0][0]:.3f} s on"
            yield silent(ctx, found, limit, "state stops", text)
        since = begin + (phase.observed.get("sent_s") or 0.0) + wait
        before, q = ctx.q(begin - 0.15, begin), ctx.q(since, end)
        if not len(before) or not len(q):
            yield ctx.skipped("no state around the burst")
        away = np.abs(q - np.median(before, axis=0)).max(axis=0)
        for joint, most in enumerate(away.tolist()):
            text = (
                f"{wait:g} s after the last command of the burst it was still up to "
                f"{most:.3f} {ctx.unit} away"
            )
            yield Figure(most, since, end, joint, text)


@check("DEX3-SAFE-04")
def short(ctx: Context) -> Outcome:
    """A command with one motor too few."""
    return stays(ctx, "commands with one motor too few")


@check("DEX3-SAFE-05")
def more_motors(ctx: Context) -> Outcome:
    """A command with too many motors."""
    return stays(ctx, "commands for more motors than there are")


_AFTER_ABUSE = ("recover", "resume", "company", "restart", "service-restart")


_RESTARTED = ("company", "restart", "service-restart")


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


_SOME = 20  # states before a phase or at its end that are averaged


_END = 0.06  # s after a phase during which its last command may still act


@check("H1-CRC-02", "H1-MODE-02", "H1-GAIN-04")
@check("H1-SAFE-01", "H1-SAFE-02", "H1-SAFE-03", "G1-SAFE-05")
@worst("motion_rad", "max_motion_rad", nothing="no such command was sent")
def robot_stays(ctx: RobotContext) -> Figures:
    """Motion of joints during commands that must have no effect."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - LATE_S, begin)[-_SOME:], ctx.q(begin, end + _END)
        if not len(before) or not len(q):
            yield no_state(ctx, phase)
            return
        moved = np.nan_to_num(np.abs(q - before.mean(axis=0)).max(axis=0), nan=np.inf)
        joint = int(np.argmax(moved))
        kind = f" ({phase.params['kind']})" if "kind" in phase.params else ""
        text = f"moves by {moved[joint]:.3f} rad{kind}"
        yield Figure(float(moved[joint]), begin, end, joint, text)
