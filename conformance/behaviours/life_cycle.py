"""Clients come and go, and the service starts and stops."""

from __future__ import annotations

import math

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.obedience import arrival, away_first
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.hand import JointMode


@check("DEX1-LIFE-01", "DEX3-LIFE-01", "H1-LIFE-01")
def late_joiner(ctx: Context) -> Outcome:
    """Time until a subscriber created during a session receives state."""
    phase = ctx.phases()[-1]
    waited = phase.observed.get(f"first_state_s_{ctx.side}")
    limit = ctx.tolerance("max_wait_s")
    begin, end = ctx.span(phase)
    if waited is not None and waited <= limit:
        return ctx.passed(
            f"{waited * 1e3:.0f} ms",
            f"first state {waited * 1e3:.0f} ms after it was discovered",
            wait_s=waited,
        ).timed(waited, limit, span=(begin, end))
    text = "nothing" if waited is None else f"the first state only after {waited:.2f} s"
    outcome = ctx.failed(
        "nothing" if waited is None else f"{waited:.2f} s",
        f"a subscriber that joined at {begin:.2f} s received {text}",
        ctx.at(ctx.states.topic, begin, end),
    )
    least = end - begin if waited is None else waited
    # discovery is a conversation
    return outcome.timed(least, limit).if_late(least - limit)


@check("DEX1-LIFE-02", "DEX3-LIFE-02")
def restarted_client(ctx: Context) -> Outcome:
    """The steps of a restarted client, and of a client after a second client has ended."""
    alone = [p for p in ctx.phases("recover") if p.params.get("after") == "two-writers"]
    if alone:
        left = arrival(ctx, "after a second client had gone", alone)
        if left.met is False:
            return left
    for phase in ctx.phases():
        wrong = away_first(ctx, phase, "commanded by a restarted client")
        if wrong is not None:
            return wrong
    return arrival(ctx, "commanded by a restarted client")


@check("DEX1-LIFE-03", "DEX3-LIFE-03")
def restarted_service(ctx: Context) -> Outcome:
    """State and the step after a restart of the service, with a client that kept running."""
    phase = ctx.phases()[0]
    before = [p for p in ctx.phases("restarted") if p.end_ns <= phase.begin_ns]
    begin, end = ctx.span(before[-1] if before else phase)
    later = ctx.states.t[ctx.states.t > begin]
    waited = float(later[0]) - begin if len(later) else np.inf
    if waited > ctx.tolerance("max_wait_s"):
        what = "no state" if not len(later) else f"no state for {waited:.2f} s"
        outcome = ctx.failed(
            "no state",
            f"{what} after the service was ready again",
            ctx.at(ctx.states.topic, begin, min(begin + waited, end)),
        )
        least = min(waited, end - begin)
        outcome = outcome.timed(least, ctx.tolerance("max_wait_s"))
        return outcome.if_late(waited - ctx.tolerance("max_wait_s"))
    wrong = away_first(ctx, phase, "after a restart of its service")
    if wrong is not None:
        return wrong
    outcome = arrival(ctx, "after a restart of its service")
    if not outcome.met:
        return outcome
    again = Measure(waited, ctx.tolerance("max_wait_s"), span=(begin, begin + waited))
    return outcome.resting_on(*outcome.measures, again)


@check("DEX1-LIFE-04", "DEX3-LIFE-04")
def shutdown(ctx: Context) -> Outcome:
    """Time from SIGTERM to the end of the service, and until its publisher disappears."""
    phase = ctx.phases()[-1]
    begin, end = ctx.span(phase)
    ended, gone = phase.observed.get("exit_s"), phase.observed.get("gone_s")
    place = ctx.at(ctx.states.topic, begin, end)
    if ended is None or ended > ctx.tolerance("max_exit_s"):
        seen = "had to be killed" if ended is None else f"took {ended:.1f} s to end"
        outcome = ctx.failed("does not end", f"after SIGTERM the service {seen}", place)
        least, limit = end - begin if ended is None else ended, ctx.tolerance("max_exit_s")
        return outcome.timed(least, limit).if_late(least - limit)
    if gone is None or gone > ctx.tolerance("max_gone_s"):
        seen = "is still announced" if gone is None else f"was announced for {gone:.1f} s"
        outcome = ctx.failed(
            "still announced", f"the state's publisher {seen} after the service had ended", place
        )
        least, limit = end - begin if gone is None else gone, ctx.tolerance("max_gone_s")
        outcome = outcome.timed(least, limit).if_late(least - limit)
        return outcome.because(
            "the process ends without deleting its participant, so that its peers wait for the "
            "lease to run out"
        )
    return ctx.passed(
        f"{ended:.2f} s",
        f"ended after {ended:.2f} s, and its publisher disappeared {gone:.2f} s later",
        exit_s=ended,
    ).resting_on(
        Measure(ended, ctx.tolerance("max_exit_s"), span=(begin, end)),
        Measure(gone, ctx.tolerance("max_gone_s"), span=(begin, end)),
    )


@check("DEX1-LIFE-05", "DEX3-LIFE-05")
def last_state(ctx: Context) -> Outcome:
    """The mode of the last state before the service ended, and the hand's position after the
    restart.

    A last state with a driven motor may have been measured before the brake. Then the check is
    whether a moving hand continued to move.
    """
    begin, end = ctx.span(ctx.phases()[-1])
    rows = ctx.states.between(begin - 0.2, end)
    modes = ctx.states.mode[rows]
    modes = modes[np.isfinite(modes).all(axis=1)]
    status = MotorCodec(ctx.recording.dialect).status(modes.astype(np.intp))
    if len(status) < 2 or not (status[0] == JointMode.FOC).all():
        return ctx.skipped("the mode of this hand does not show whether it is driven")
    went = _went_on(ctx, begin, end)
    if went is not None and went[0] > went[1]:
        rad, limit, joint = went
        text = ctx.named(
            f"it went on by {rad:.2f} {ctx.unit} after its last command, across the restart", joint
        )
        place = ctx.at(ctx.states.topic, begin, end)
        outcome = ctx.failed("goes on", text, place, motion_rad=rad).about(joint)
        return outcome.placed(rad, limit)
    if not status[-1].any():
        return ctx.passed("brakes", "its last state shows that it is not driven any more")
    if went is not None:
        text = f"it was moving, and was found {went[0]:.2f} {ctx.unit} further on"
        return ctx.passed("stops", text, motion_rad=went[0]).placed(went[0], went[1])
    return ctx.skipped(
        "its last state shows it driven, but may have been measured before it braked; it was not "
        "moving then"
    )


def _went_on(ctx: Context, begin: float, end: float) -> tuple[float, float, int] | None:
    """Motion of a joint from the stop of its service to the restart, rad, the allowed motion, and
    the joint; None if no joint moved with room to continue.
    """
    later = ctx.states.between(end - 0.1, end + 1.0)
    after = ctx.states.q[later][ctx.states.t[later] > begin + 0.25]
    worst: tuple[float, float, int] | None = None
    for joint, spec in enumerate(ctx.joints):
        before = ctx.states.between(begin - 0.2, begin)
        t, q = ctx.states.t[before], ctx.states.q[before, joint]
        if len(q) < 2 or not len(after) or not np.isfinite(q).all():
            continue
        speed = float(q[-1] - q[0]) / max(float(t[-1] - t[0]), 1e-3)
        if abs(speed) < ctx.tolerance("min_speed_stroke", joint):
            continue
        way = 1 if speed > 0 else -1
        braked = ctx.recording.model.command_timeout + ctx.tolerance("grace_s")
        limit = abs(speed) * braked + ctx.tolerance("max_jump_stroke", joint)
        room = spec.q_max - float(q[-1]) if way > 0 else float(q[-1]) - spec.q_min
        if room < limit + 0.1 * spec.stroke:
            continue
        rad = (float(after[0, joint]) - float(q[-1])) * way
        if worst is None or rad / limit > worst[0] / worst[1]:
            worst = rad, limit, joint
    return worst


@check("DEX1-LIFE-06", "DEX3-LIFE-06")
@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no state before the service ended, or none after it started again",
)
def no_new_goal(ctx: Context) -> Figures:
    """Distance of the hand, after a restart of its service, from where it may be.

    A motor may continue to its last goal (DEX1-LIFE-05), but must not move elsewhere.
    """
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        latency = ctx.tolerance("latency_s")
        before = ctx.states.between(begin - max(0.2, latency), begin + 0.2)
        later = ctx.states.between(end - 0.1, end + 1.0)
        t, q = ctx.states.t[before], ctx.states.q[before]
        after = ctx.states.q[later][ctx.states.t[later] > begin + 0.25]
        if len(q) < 3 or not len(after):
            continue
        for joint in range(len(ctx.joints)):
            place, found = q[:, joint], float(after[0, joint])
            if not np.isfinite(place).all() or not math.isfinite(found):
                continue
            first = int(np.argmax(t >= begin - 0.2))
            speed = float(place[-1] - place[first]) / max(float(t[-1] - t[first]), 1e-3)
            recent = place[t >= t[-1] - latency]
            away = max(float(recent.min()) - found, found - float(recent.max()), 0.0)
            moved = abs(speed) >= ctx.tolerance("min_speed_stroke", joint)
            rad = 0.0 if moved and (found - float(place[-1])) * speed > 0.0 else away
            text = (
                f"found {rad:.2f} {ctx.unit} from the {place[-1]:.2f} {ctx.unit} at which the "
                "service ended, where it was not going"
            )
            yield Figure(rad, begin, end, joint, text)
