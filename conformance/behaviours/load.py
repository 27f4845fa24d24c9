"""A loaded machine delays neither states nor commands."""

from __future__ import annotations

import math

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check, rate_measure
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.obedience import silent
from dexkit.conformance.checks.steps import obeyed_before, rest_error, steps_of
from dexkit.conformance.checks.timing import gaps, least_rate
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import Place, stimulus
from dexkit.conformance.stimuli.script import Join, Leave, Role, Steps

_LOADS = ((400.0, 1.2, 1), (2500.0, 0.8, 10))
"""Loads: commands a second, seconds, and commands at a time. The first is twice what teleoperation
sends, the second what Unitree's C++ example sends (docs/sources/unitree-dex.md#b1)."""


@stimulus("load", HandScript, after="single speeds ends", needs=Place.ANY, leaves=Place.ANY)
def apply_load(script: HandScript) -> Steps:
    """Many commands, and a reliable subscriber that hardly ever reads."""
    here, there = dict(script.goal), script.other_place()
    count = 40  # points of the way there and back
    parts = [0.3 * (1 - abs(2 * i / count - 1)) for i in range(count + 1)]
    points = [
        script.codec.encode(
            {
                s: script.motors(
                    s, tuple(a + part * (b - a) for a, b in zip(here[s], there[s], strict=True))
                )
                for s in script.plan.sides
            }
        )
        for part in parts
    ]
    yield from script.do(Join(Role.LAGGARD))
    period = script.period_ns
    for rate, seconds, at_a_time in _LOADS:
        script.report(f"{rate:g} commands a second and a slow reader: state must keep its rate")
        script.period_ns = round(at_a_time * 1e9 / rate)
        phase = script.begin("load", script.plan.sides)
        while (at := script.elapsed(phase) / seconds) < 1.0:
            yield from script.send(points[int(at * count)] * at_a_time)
        script.end(phase)
    script.period_ns = period
    yield from script.do(Leave(Role.LAGGARD))


@check("DEX1-LOAD-01", "DEX3-LOAD-01")
def under_load(ctx: Context) -> Outcome:
    """States, motion and, of hands with gains, how old q is under load."""
    parts = [_states(ctx), _obeys(ctx)]
    if not ctx.recording.dialect.position_servo and all(part.met is not False for part in parts):
        parts.append(_late(ctx))
    return all_of(*parts)


def _states(ctx: Context) -> Outcome:
    """Rate and gaps of the state under load."""
    limit = ctx.tolerance("max_gap_s")
    least = least_rate(ctx)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        clock = ctx.states.clock
        inside = clock[(clock >= begin) & (clock <= end)]
        rate = len(inside) / (end - begin)
        before = clock[clock < begin]
        if len(before) > 1:  # a hand that is slow anyway is not made slow by the load
            usual = (len(before) - 1) / float(before[-1] - before[0])
            least = min(least, ctx.tolerance("min_rate_part") * usual)
        found = gaps(ctx, limit, begin, end)
        text = f"{rate:.1f} Hz under load"
        if found:
            a, b = found[0]
            text = f"{text}; no state from {a:.3f} to {b:.3f} s"
            return silent(ctx, found, limit, f"{b - a:.2f} s", text)
        if rate < least:
            place = ctx.at(ctx.states.topic, begin, end)
            outcome = ctx.failed(f"{rate:.1f} Hz", text, place, rate_hz=rate)
            late = 1 / rate - 1 / least if rate > 0 else math.inf
            return outcome.rated(rate, least, end - begin).if_late(late, how="mean")
    span = begin, end
    met = ctx.passed(f"{rate:.1f} Hz", text, rate_hz=rate)
    return met.resting_on(rate_measure(rate, least, end - begin, span=span))


@worst("more_s", "max_more_s", nothing="no motion under load, or none without it to compare with")
def _late(ctx: Context) -> Figures:
    """How much later than without load the states show a motion that is commanded under load."""
    usual = _usual_lags(ctx)
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        for joint, before in usual.items():
            lag = _lag(ctx, joint, *ctx.span(phase))
            if lag is not None:
                text = (
                    f"q follows {lag:.2f} s behind the command under load, {before:.2f} s without"
                )
                more, values = max(0.0, lag - before), {"lag_s": lag}
                yield Figure(more, *ctx.span(phase), joint, text, values=values)


_FREE_STEPS = ("fingerprint", "step", "joint", "center", "recover")
"""Phases of free steps, without load."""


_LAGS = np.arange(0.0, 0.61, 0.01)


_FOLLOWS_PART = 0.5
"""Least part of the way of a motion under load, and of its shape, in which a lag shows."""


def _usual_lags(ctx: Context) -> dict[int, float]:
    """Seconds that q is behind the command in free steps, by joint: the median.

    For a linear hand the mean delay of a step, the integral of what is left of it, is the lag
    behind a ramp; a hand of limited speed is less behind a slow ramp.
    """
    lags: dict[int, list[float]] = {}
    for phase in (p for name in _FREE_STEPS for p in ctx.phases(name) if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            if abs(step.size) < ctx.tolerance("min_way_stroke", step.joint) or len(step.t) < 5:
                continue
            left = (step.final - step.q) / (step.final - step.start or np.inf)
            if abs(step.final - step.start) >= _FOLLOWS_PART * abs(step.size):
                spent = np.diff(step.t, prepend=step.begin)
                lags.setdefault(step.joint, []).append(float(np.sum(left * spent)))
    return {joint: float(np.median(found)) for joint, found in lags.items()}


def _lag(ctx: Context, joint: int, begin: float, end: float) -> float | None:
    """By how many seconds q follows its command in [begin, end]; None if it does not follow."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
    given, goals = ctx.commands.t, ctx.commands.q[:, joint]
    good = np.isfinite(goals)
    given, goals = given[good], goals[good]
    if len(t) < 10 or not np.isfinite(q).all() or not len(given):
        return None
    shifted = np.searchsorted(given, t[None, :] - _LAGS[:, None], "right") - 1
    wanted = goals[np.maximum(shifted, 0)]
    way = float(np.ptp(wanted[0]))
    if way < ctx.tolerance("min_way_stroke", joint) or np.ptp(q) < _FOLLOWS_PART * way:
        return None
    wanted = wanted - wanted.mean(axis=1, keepdims=True)
    shown = q - q.mean()
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = wanted @ shown / np.sqrt((wanted**2).sum(axis=1) * (shown**2).sum())
    best = int(np.nanargmax(alike))
    return float(_LAGS[best]) if alike[best] >= _FOLLOWS_PART else None


@worst("part", "min_part", nothing="no way under load, or the hand had stopped obeying before")
def _obeys(ctx: Context) -> Figures:
    """How far the hand follows the way out and back that it is commanded under load."""
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        rows = ctx.given(begin, end)
        t, goals = ctx.commands.t[rows], ctx.commands.q[rows]
        before = ctx.q(begin - 0.1, begin)
        if not len(t) or not len(before) or not np.isfinite(goals).all():
            continue
        start = np.median(before, axis=0)
        for joint in range(len(ctx.joints)):
            way = goals[:, joint] - goals[0, joint]
            turn = int(np.argmax(np.abs(way)))
            size = float(way[turn])
            far = abs(size) - rest_error(ctx, joint)  # friction takes the rest
            if far < ctx.tolerance("min_way_stroke", joint):
                continue
            # it may still be on its way from the load before, or be held off its goal
            origin = float(goals[0, joint])
            if (float(start[joint]) - origin) * size < 0:
                origin = float(start[joint])
            until = float(t[turn]) + ctx.tolerance("max_delay_s")
            q = ctx.q(float(t[turn]), until)[:, joint]
            made = float(((q - origin) * np.sign(size)).max()) / far if len(q) else 0.0
            text = f"made {made:.0%} of a way of {size:.2f} {ctx.unit} under load"
            yield Figure(made, begin, until, joint, text, late=until - begin)
