"""States arrive once each and in order, and stamps of commands mean nothing."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.obedience import arrival
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.stimuli.fingers import FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.phases import Place, stimulus
from dexkit.conformance.stimuli.script import Steps


@stimulus("old-stamps", GripperScript, after="load")
@stimulus("old-stamps", FingerScript, after="load", needs=Place.ANY, leaves=Place.AWAY)
def send_old_stamps(script: HandScript) -> Steps:
    """A step whose commands have source timestamps that are an hour old."""
    script.report("a client whose clock is an hour behind: it must be obeyed")
    script.age_s = 3600.0
    yield from script.everyone("old-stamps", script.other_place(), most=1.5)
    script.age_s = 0.0


@check("DEX1-ORDER-01", "DEX3-ORDER-01", "H1-ORDER-01", rests_on=(TIMES,))
def order(ctx: Context) -> Outcome:
    """Source timestamps increase from sample to sample."""
    sent = ctx.states.sent
    if len(sent) < 2 or not np.isfinite(sent).all():
        return ctx.skipped("the recording has no source timestamps")
    steps = np.diff(sent)
    wrong = np.flatnonzero(steps <= 0)
    if not len(wrong):
        return ctx.passed("in order", f"{len(sent)} source timestamps, each later than the last")
    back = int((steps < 0).sum())
    return ctx.failed(
        f"{len(wrong)} of {len(sent)}",
        f"{back} samples older than the one before, {len(wrong) - back} with the same timestamp",
        *(ctx.at(ctx.states.topic, float(ctx.states.t[i + 1])) for i in wrong[:5]),
        out_of_order=len(wrong),
    )


@check("DEX1-ORDER-02", "DEX3-ORDER-02")
def old_stamps(ctx: Context) -> Outcome:
    """The step of a client with a wrong clock."""
    return arrival(ctx, "commanded by a client whose clock is an hour behind")
