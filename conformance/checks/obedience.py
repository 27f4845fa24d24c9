"""Whether a hand stays where it is, is unharmed, and obeys afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, judged
from dexkit.conformance.checks.steps import Step, disobeyed, missed, obeyed_before, steps_of
from dexkit.conformance.checks.timing import gap_measures, gaps, longest_gap
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.hand import Floats


def _recovery(ctx: Context, phase: Phase) -> Step | None:
    """The step after a bad command, of the joint with the largest error."""
    for after in ctx.phases("recover"):
        names = after.params.get("after", "").split()
        if phase.name in names and after.begin_ns >= phase.end_ns:
            found = steps_of(ctx, after)
            return max(found, key=lambda s: s.error / s.stroke) if found else None
    return None


def unharmed(ctx: Context, what: str) -> Outcome:
    """Fail if state stops or the hand disobeys afterwards; else an outcome with ``met`` None."""
    topic = ctx.states.topic
    judged = [p for p in ctx.phases() if obeyed_before(ctx, p)]
    if not judged:
        return ctx.skipped(f"the hand had stopped obeying before {what}")
    measures: list[Measure] = []
    for phase in judged:
        begin, end = ctx.span(phase)
        limit = ctx.tolerance("max_gap_s")
        found = gaps(ctx, limit, begin - 0.05, end + 0.2)
        if found:
            text = f"state stopped at {found[0][0]:.3f} s, during {what}"
            return silent(ctx, found, limit, "state stops", text)
        measures.append(longest_gap(ctx, limit, begin - 0.05, end + 0.2))
        step = _recovery(ctx, phase)
        if step is None:
            text = f"no state after {what}, when a good command was sent"
            return ctx.failed("no state", text, ctx.at(topic, end))
        if missed(ctx, step) > ctx.tolerance("max_error_stroke", step.joint):
            return disobeyed(ctx, f"after {what}", step)
    return Outcome(None).resting_on(*measures)


def silent(
    ctx: Context, found: Sequence[tuple[float, float]], limit: float, figure: str, text: str
) -> Outcome:
    """The failure of a hand whose state stopped; its place is the first of these gaps.

    :param limit: of a gap, seconds.
    """
    a, b = found[0]
    outcome = ctx.failed(figure, text, ctx.at(ctx.states.topic, a, b), max_gap_s=b - a)
    return outcome.resting_on(*gap_measures(found, limit)).if_late(b - a - limit)


def moves(
    ctx: Context, what: str, joints: Sequence[int] | None = None, sags: Floats | None = None
) -> Outcome:
    """Fail if a joint moves during the phase; otherwise pass, with the motion.

    :param joints: those that must not move; None for all.
    :param sags: allowed motion of each joint by gravity, rad; None for none.
    """
    nothing = ctx.passed(f"0.000 {ctx.unit}", f"no state shows motion during {what}")
    figures = _motions(ctx, what, joints, sags)
    return judged(ctx, figures, "motion_rad", "max_motion_stroke", nothing=nothing)


def _motions(ctx: Context, what: str, joints: Sequence[int] | None, sags: Floats | None) -> Figures:
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        before, q = ctx.q(begin - 0.1, begin), ctx.states.q[rows]
        if not len(before) or not len(q):
            continue
        with np.errstate(invalid="ignore"):
            deviation = np.abs(q - np.median(before, axis=0))
        for joint in range(len(ctx.joints)) if joints is None else joints:
            column = deviation[:, joint]
            known = np.isfinite(column)
            i = int(np.argmax(column)) if known.all() else int(np.argmin(known))
            at = float(ctx.states.t[rows][i])
            if not known.all():
                text = ctx.named(f"q became {q[i, joint]} during {what}", joint)
                failed = ctx.failed("q not finite", text, ctx.at(ctx.states.topic, at))
                yield failed.about(joint)
            most = float(column[i])
            if sags is not None:
                most = max(0.0, most - float(sags[joint]))
            yield Figure(most, at, None, joint, f"moved by {most:.3f} {ctx.unit} during {what}")


def stays(
    ctx: Context, what: str, joints: Sequence[int] | None = None, sags: Floats | None = None
) -> Outcome:
    """Check that no joint :func:`moves`, then that the hand is :func:`unharmed`."""
    still = moves(ctx, what, joints, sags)
    if still.met is False:
        return still
    after = unharmed(ctx, what)
    if after.met is False or after.reason:
        return after
    met = replace(still, observed=f"{still.observed}, then obeyed")
    return met.resting_on(*still.measures, *after.measures)


def stopped(t: Floats, q: Floats, last: float, still: float, limit: float) -> Measure:
    """Time at which a joint stopped after the last command, s, and the limit.

    :param t: of the states since then, s.
    :param q: of the joint, rad.
    :param last: time of the last command, s.
    :param still: remaining motion that counts as stopped, rad.
    :param limit: s after the last command.
    """
    t, q = t[np.isfinite(q)], q[np.isfinite(q)]
    later = q[::-1]
    range_left = np.maximum.accumulate(later) - np.minimum.accumulate(later)
    moving = np.flatnonzero(~(range_left[::-1] <= still))
    at = float(t[moving[-1]]) if len(moving) else last
    return Measure(max(0.0, at - last), limit, span=(last, max(at, last + limit)))


def first_goals(ctx: Context, phases: Sequence[Phase], when: str) -> Outcome:
    """Whether a hand arrives at its first goals after a pause, and does not go away first."""
    away = [found for p in phases if (found := _away_first(ctx, p, when)) is not None]
    return all_of(*away, arrival(ctx, when))


def _away_first(ctx: Context, phase: Phase, when: str) -> Outcome | None:
    """The failure of a hand that first moves or pulls away from the first goal after a pause; a
    warning where that does no harm.
    """
    figures = []
    for step in steps_of(ctx, phase):
        if abs(step.size) < ctx.tolerance("max_away_stroke", step.joint):
            continue
        way = 1 if step.size > 0 else -1
        # before it obeys; other requirements judge its motion near the goal
        near = np.flatnonzero((step.q - step.target) * way > -0.5 * abs(step.size))
        course = step.q[: int(near[0]) + 1] if len(near) else step.q
        away = float(np.max((step.start - course) * way))
        text = f"{when}, {step}, but it first went {away:.2f} {ctx.unit} the other way"
        figures.append(step.figure(away, text, shown=f"{away:.2f} {ctx.unit} away"))
    nothing = ctx.passed("no step")
    outcome = judged(ctx, figures, "away_rad", "max_away_stroke", nothing=nothing)
    if outcome.met:
        return None
    harm = ctx.tolerance("harm_stroke", outcome.joints[0])
    return outcome if outcome.values["away_rad"] > harm else warning(outcome)


def arrival(
    ctx: Context, when: str, phases: Sequence[Phase] | None = None, *, soon_s: float = 0.0
) -> Outcome:
    """Whether the steps of these phases reach their targets.

    :param phases: None for those that the requirement needs.
    :param soon_s: a joint that arrives in this time, at the speed that it has, counts as there.
    """
    obeyed = [p for p in (ctx.phases() if phases is None else phases) if obeyed_before(ctx, p)]
    if not obeyed:
        return ctx.skipped("the hand had stopped obeying before this stimulus")
    found = [s for p in obeyed for s in steps_of(ctx, p)]
    if not found:
        return ctx.failed("no state", f"no state of the {ctx.side} hand {when}")
    there = [s for s in found if not (soon_s and s.arrives_within(soon_s))]
    figures = [s.figure(missed(ctx, s), f"{when}: {s}") for s in there]
    nothing = ctx.passed("under way", f"{when}: all are about to arrive")
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)
    return replace(outcome, figure="obeys" if outcome.met else "disobeys") if there else outcome


_SAGS_AGAIN = 1.5  # factor on the sag of a limp joint, for other poses


def sags(ctx: Context) -> Floats | None:
    """Allowed sag of each limp joint, rad, measured with zero gains, whatever q was.

    None if the stimulus cannot tell sag from motion towards q.
    """
    moved = []
    for phase in ctx.phases("limp"):
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - 0.1, begin), ctx.q(begin, end)
        if len(before) and len(q):
            moved.append(q[-1] - np.median(before, axis=0))
    if len(moved) < 2:
        return None
    # first a q on one side, then one on the other
    low, high = np.min(moved, axis=0), np.max(moved, axis=0)
    slack = np.array([ctx.tolerance("max_motion_stroke", j) for j in range(len(ctx.joints))])
    one_way = (low > -slack) | (high < slack)
    return np.where(one_way, _SAGS_AGAIN * np.maximum(np.abs(low), np.abs(high)), 0.0)
