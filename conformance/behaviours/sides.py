"""Each hand moves by its own commands, whatever the other one gets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import STROKE_S, Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.obedience import arrival
from dexkit.conformance.checks.steps import (
    Step,
    disobeyed,
    missed,
    obeyed_before,
    rests_before,
    steps_of,
)
from dexkit.conformance.kit.measurement_error import Measure, Quantity
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.kit.sums import mean

_NEARLY, _CLEAR_WAY = 0.9, 0.3
"""Part of its whole way after which the time of a step is taken, and the least part of the step
that it must be to be compared."""


_AFTER_A_PAUSE = ("restart", "service-restart")
"""Steps of which the first follows directly after discovery."""


_CLEAR_STEP, _STANDS = 0.1, 0.02
"""Part of the stroke that a hand was commanded to go, and by which it moves that stands."""


@check("DEX1-SIDE-01", "DEX3-SIDE-01")
@worst(
    "motion_rad", "max_motion_stroke", nothing="no state of this hand while only the other moved"
)
def independent(ctx: Context) -> Figures:
    """Motion of this hand while only the other hand's target changes."""
    first = ctx.requirement.phase or ""
    names = (first, "company", *_AFTER_A_PAUSE)
    others = [(n, p) for n in names for p in ctx.recording.phases(n) if ctx.side not in p.sides]
    if not others:
        yield ctx.skipped("only one side was commanded")
    stood = any(_other_stood(ctx, phase) for _, phase in others)
    for name, phase in others:
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        t, positions = ctx.states.t[rows], ctx.states.q[rows]
        before = ctx.q(begin - 0.25, begin)
        if len(t) < 2 or not len(before):
            continue
        # the mean of each quarter of a second: a hand that oscillates about its target is
        # judged by MOVE-03
        bins = ((t - begin) / 0.25).astype(np.intp)
        counts = np.bincount(bins)
        given = ctx.commands.q[: int(np.searchsorted(ctx.commands.t, end))]
        for joint, spec in enumerate(ctx.joints):
            means = np.bincount(bins, positions[:, joint])[counts > 0] / counts[counts > 0]
            start = mean(before[:, joint])
            goals = given[np.isfinite(given[:, joint]), joint]
            goal = float(np.clip(goals[-1], spec.q_min, spec.q_max)) if len(goals) else start
            # the later steps are shorter: the end of its own one may still be ahead
            rest = 0.0 if name == first else ctx.tolerance("max_rest_stroke", joint)
            end_q = float(np.clip(goal, start - rest, start + rest))
            low, high = min(start, end_q), max(start, end_q)
            most = float(np.maximum(low - means, means - high).max(initial=0.0))
            text = (
                f"moved by {most:.3f} {ctx.unit} while only the {ctx.other} hand was commanded to "
                "move"
            )
            if stood and most > ctx.tolerance("max_motion_stroke", joint):
                text += ", which did not: the hands appear to be swapped"
            yield Figure(most, begin, end, joint, text)


def _other_stood(ctx: Context, phase: Phase) -> bool:
    """Whether the other hand stood still in a phase in which it was commanded to move."""
    other, targets = ctx.recording.sides.get(ctx.other), phase.targets.get(ctx.other, {})
    rows = slice(0) if other is None else other.states.between(*ctx.span(phase))
    if other is None or not targets or rows.stop - rows.start < 2:
        return False
    q = other.states.q[rows]
    far = [
        joint
        for joint, target in targets.items()
        if abs(target - q[0, joint]) > _CLEAR_STEP * other.joints[joint].stroke
    ]
    strokes = np.array([other.joints[joint].stroke for joint in far])
    return bool(far) and bool((np.ptp(q[:, far], axis=0) < _STANDS * strokes).all())


@check("DEX3-SIDE-03")
@worst("part", "min_part", nothing="no step that can be compared with an earlier one")
def beside_grip(ctx: Context) -> Figures:
    """The way of each joint's step beside a grip, as a part of its way in the same time of the same
    step before. So a slow hand passes.
    """
    known = [s for n in ("joint", "step") for p in ctx.phases(n) for s in steps_of(ctx, p)]
    slack, limit = ctx.tolerance("slack_s"), ctx.tolerance("min_part")
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        found = steps_of(ctx, phase)
        if not found:
            when = "while the other hand pressed on an object"
            yield ctx.failed("no state", f"no state of the {ctx.side} hand {when}")
        for step in found:
            if abs(step.size) < ctx.tolerance("min_step_stroke", step.joint):
                continue
            for like in (s for s in known if s.joint == step.joint):
                if not 0.7 < step.size / (like.size or math.inf) < 1.4:
                    continue
                seconds, way = _most_of_way(like, step.end - step.begin - slack)
                if way < _CLEAR_WAY:
                    continue
                part = _way_within(step, seconds + slack) / way
                text = (
                    f"after {seconds + slack:.2f} s it had made {max(part, 0.0):.0%} of the way "
                    f"that it made in {seconds:.2f} s without a grip of the other hand"
                )
                rad = way * abs(step.size)
                made = Measure(part * rad, limit * rad, "rad", Quantity.POSITION, False)
                yield step.figure(part, text, late=seconds * (limit - part), measure=made)


def _way_within(step: Step, seconds: float) -> float:
    """The largest part of a step that was made in its first seconds, at least 0."""
    q = step.q[step.t <= step.begin + seconds]
    return float(((q - step.start) / step.size).max(initial=0.0))


def _most_of_way(step: Step, longest: float) -> tuple[float, float]:
    """The seconds after which nearly all of a step's way was made, no more than the longest, and
    the part that was made then.
    """
    within = step.t <= step.begin + longest
    part = np.maximum((step.q[within] - step.start) / step.size, 0.0)
    if not len(part):
        return longest, 0.0
    way = float(part.max())
    return float(step.t[within][int(np.argmax(part >= _NEARLY * way))]) - step.begin, _NEARLY * way


@check("DEX1-SIDE-03")
@worst(
    "progress",
    "min_progress",
    nothing="no step to judge: only one side was commanded, the hand had stopped obeying before, "
    "or no state shows the end of a step",
)
def by_its_own(ctx: Context) -> Figures:
    """Steps of this hand while the other hand gets other values in the same members."""
    for step in (s for p in ctx.phases() if obeyed_before(ctx, p) for s in steps_of(ctx, p)):
        # the step is short: its last states, not the median of some; RATE-03 judges gaps
        last = step.q[step.t >= step.end - 0.03]
        large = abs(step.size) >= ctx.tolerance("min_step_stroke", step.joint)
        # it may still be under way, from where it was limp
        if not rests_before(ctx, step) or not len(last) or not large:
            continue
        made = replace(step, final=median(last))
        if missed(ctx, made) > ctx.tolerance("max_error_stroke", step.joint):
            yield disobeyed(ctx, "while the other hand was commanded otherwise", made)
        late = STROKE_S * abs(step.size) / step.stroke
        yield made.figure(made.progress, f"while the other hand had zero gains: {made}", late=late)


_SOON_S = 0.25  # s after the end of a step within which a moving hand must arrive


@check("DEX1-SIDE-02", "DEX3-SIDE-02")
def beside(ctx: Context) -> Outcome:
    """The steps of this hand while the other hand gets bad commands or none.

    They last as long as those commands, whatever the distance, so a slow hand that is about to
    arrive passes.
    """
    return arrival(ctx, "while the other hand got bad commands, or none", soon_s=_SOON_S)
