"""Two clients command one hand."""

from __future__ import annotations

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.obedience import arrival
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import Moment, stimulus
from dexkit.conformance.stimuli.script import Join, Leave, Role, Steps


@stimulus("two-writers restart", HandScript, moment=Moment.CLIENTS, after="operator")
def add_rival(script: HandScript) -> Steps:
    """A second client commands another place, and goes."""
    script.report("a second client commands another place, and goes again")
    there = script.other_place()
    rival = script.codec.encode({s: script.motors(s, pose) for s, pose in there.items()})
    yield from script.do(Join(Role.RIVAL))
    phase = script.begin("two-writers", script.plan.sides, targets=there)
    yield from script.beside(phase, rival, Role.RIVAL, 0.3)
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


@check("DEX1-SAFE-09", "DEX3-SAFE-10")
def obeys_beside_second_client(ctx: Context) -> Outcome:
    """The steps of this hand while a second client sends the same commands, or commands the other
    hand.
    """
    return arrival(ctx, "while a second client commanded the same")
