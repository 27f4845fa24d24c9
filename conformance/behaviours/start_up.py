"""State from the start, before any command."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.kit.provenance import MESSAGES, TIMES


@check("DEX1-START-01", "DEX3-START-01", "H1-START-01", rests_on=(TIMES, MESSAGES))
def state_first(ctx: Context) -> Outcome:
    """State before the first command that the client can use: some take zeros for no state."""
    flows = _flows(ctx)
    if not ctx.recording.dialect.zero_is_no_state:
        return flows
    if len(ctx.joints) == 1:
        return all_of(flows, _some_position(ctx))
    pose = _pose(ctx)
    # a closed hand that is commanded by parts of its travel is at 0
    return all_of(flows, warning(pose) if ctx.recording.dialect.position_servo else pose)


def _some_position(ctx: Context) -> Outcome:
    """Whether any q of a gripper is not 0 before the first command."""
    first = float(ctx.commands.t[0]) if len(ctx.commands) else np.inf
    before = [v.states.q[v.states.t < first] for v in ctx.recording.sides.values()]
    if not any(len(q) for q in before):
        return ctx.skipped("no state before the first command")
    most = max(float(np.nan_to_num(np.abs(q)).max()) for q in before if len(q))
    if most > 0:
        return ctx.passed(
            f"{most:.2f} {ctx.unit}", f"up to {most:.3f} {ctx.unit} before the first command"
        )
    return ctx.failed("all zero", "every q is exactly 0 before the first command")


def _flows(ctx: Context) -> Outcome:
    """State is published before the first command."""
    if not len(ctx.commands):
        return ctx.skipped("no commands to this hand in the recording")
    first_state = float(ctx.states.t[0])
    first_command = float(ctx.commands.t[0])
    listening = ctx.phases("listen")
    begin = ctx.span(listening[0])[0] if listening else 0.0
    if first_command - begin < ctx.tolerance("min_lead_s"):
        return ctx.skipped("the recording begins after the first commands")
    lead = first_command - first_state
    # the kit's client, unlike a genuine one, does not wait for state, so its first command may be
    # received after the state that it has set off
    least = ctx.tolerance("min_lead_s") if listening else 0.0
    if lead > least:
        return ctx.passed(
            f"{lead:.2f} s before",
            f"first state {lead:.2f} s before the first command",
            lead_s=lead,
        ).timed(lead, least, at_least=True, span=(first_state, first_command))
    return ctx.failed(
        "silent",
        f"no state for {min(first_command, first_state) - begin:.2f} s; the first came "
        f"{abs(lead):.3f} s {'before' if lead > 0 else 'after'} the first command was received",
        ctx.at(ctx.commands.topic, first_command),
        lead_s=lead,
    )  # no measure: the margin has no meaning, because the service had plenty of time


def _pose(ctx: Context) -> Outcome:
    """Whether any q of a hand is not 0 before the first command."""
    first = float(ctx.commands.t[0]) if len(ctx.commands) else float("inf")
    q = ctx.states.q[ctx.states.t < first]
    q = q[np.isfinite(q).all(axis=1)]
    if not len(q):
        return ctx.skipped("no state before the first command")
    most = np.abs(q).max(axis=1)
    # zeros before the first measurement only delay the client's start
    if not most[-1]:
        return ctx.failed(
            "all zero",
            f"q is exactly 0 in every joint in {int((most == 0).sum())} of {len(q)} states before "
            "the first command, and in the last of them",
            ctx.at(ctx.states.topic, float(ctx.states.t[int(np.argmin(most))])),
        ).because(
            "The hand has not started (every number in its states is 0): is it powered?"
            if ctx.states.say_nothing
            else "Positions are never read from the device, or the hand rests with all joints at 0."
        )
    return ctx.passed("not zero", f"a joint is {most[-1]:.3f} {ctx.unit} from 0")
