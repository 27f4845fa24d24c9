"""Two clients command one hand."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.obedience import arrival, unharmed
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.script import Join, Leave, Moment, Role, Steps, stimulus


@stimulus("two-writers restart", HandScript, moment=Moment.CLIENTS, after="operator")
def add_rival(script: HandScript) -> Steps:
    """A second client commands another place, and goes."""
    script.report("a second client commands another place, and goes again")
    yield from script.hold(0.1)
    there = script.other_place()
    rival = script.codec.encode({s: script.motors(s, pose) for s, pose in there.items()})
    targets = {s: dict(enumerate(pose)) for s, pose in there.items()}
    yield from script.do(Join(Role.RIVAL))
    phase = script.begin("two-writers", script.plan.sides, targets=targets)
    yield from script.beside(phase, rival, Role.RIVAL, 0.5)
    script.end(phase)
    yield from script.do(Leave(Role.RIVAL))
    yield from script.everyone("recover", dict(script.goal), most=1.5, after="two-writers")


@stimulus("company", HandScript, moment=Moment.CLIENTS, after="two-writers")
def add_company(script: HandScript) -> Steps:
    """A second client sends each command as well, or commands the other hand."""
    script.report("a second client commands the same: it must make no difference")
    yield from script.do(Join(Role.RIVAL))
    period = script.period_ns
    script.period_ns, script.echoed = period // 2, True
    several = len(script.plan.sides) > 1 and not script.codec.shared
    yield from script.in_turn("company", divided=several)
    script.period_ns, script.echoed, script.divided = period, False, False
    yield from script.do(Leave(Role.RIVAL))


@check("DEX1-SAFE-08", "DEX3-SAFE-09")
def two_writers(ctx: Context) -> Outcome:
    """Motion while two clients command two positions, and after one of them has ended."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before = ctx.q(begin - 0.15, begin)
        rows = ctx.states.between(begin, end)
        if not len(before):
            return ctx.skipped("no state before the second client")
        here = np.median(before, axis=0)
        for joint, there in phase.targets.get(ctx.side, {}).items():
            low, high = sorted((float(here[joint]), there))
            beyond = ctx.tolerance("max_beyond_stroke", joint)
            q = ctx.states.q[rows, joint]
            outside = ~((q >= low - beyond) & (q <= high + beyond))
            if outside.any():
                i = int(np.argmax(outside))
                text = f"commanded to {low:.2f} and {high:.2f} {ctx.unit} it went to {q[i]:.2f}"
                return ctx.failed(
                    f"{q[i]:.2f} {ctx.unit}",
                    ctx.named(f"{text} {ctx.unit}", joint),
                    ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                ).about(joint)
    outcome = unharmed(ctx, "two clients at once")
    if outcome.met is False or outcome.reason:
        return outcome
    text = "stayed between the two positions, and obeyed the remaining client"
    return ctx.passed("between", text).resting_on(*outcome.measures)


@check("DEX1-SAFE-09", "DEX3-SAFE-10")
def obeys_beside_second_client(ctx: Context) -> Outcome:
    """The steps of this hand while a second client sends the same commands, or commands the other
    hand.
    """
    return arrival(ctx, "while a second client commanded the same")
