"""Start-up, late joiners and restarted clients."""

from __future__ import annotations

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.safety import arrival


@check("DEX1-START-01", "DEX3-START-01")
def state_first(ctx: Context) -> Outcome:
    """State is there before the first command."""
    first_state = float(ctx.states.t[0])
    first_command = float(ctx.commands.t[0])
    listening = ctx.phases("listen")
    begin = ctx.span(listening[0])[0] if listening else 0.0
    if first_command - begin < ctx.tolerance("min_lead_s"):
        return ctx.skipped("the recording begins when commands already flow")
    lead = first_command - first_state
    if lead > 0:
        return ctx.passed(
            f"{lead:.2f} s before",
            f"first state {lead:.2f} s before the first command",
            lead_s=lead,
        )
    return ctx.failed(
        "silent",
        f"no state for {first_command - begin:.2f} s; the first came {-lead:.3f} s after the "
        "first command",
        ctx.at(ctx.commands.topic, first_command),
        lead_s=lead,
    )


@check("DEX1-LIFE-01", "DEX3-LIFE-01")
def late_joiner(ctx: Context) -> Outcome:
    """What a subscriber received that was created in mid-session."""
    phase = ctx.phases()[-1]
    waited = phase.observed.get(f"first_state_s_{ctx.side}")
    limit = ctx.tolerance("max_wait_s")
    begin, end = ctx.span(phase)
    if waited is not None and waited <= limit:
        return ctx.passed(
            f"{waited * 1e3:.0f} ms",
            f"first state {waited * 1e3:.0f} ms after it was discovered",
            wait_s=waited,
        )
    text = "nothing" if waited is None else f"the first state only after {waited:.2f} s"
    return ctx.failed(
        "nothing" if waited is None else f"{waited:.2f} s",
        f"a subscriber that joined at {begin:.2f} s received {text}",
        ctx.at(ctx.states.topic, begin, end),
    )


@check("DEX1-LIFE-02", "DEX3-LIFE-02")
def restarted_client(ctx: Context) -> Outcome:
    """The step of the client that took over."""
    return arrival(ctx, "commanded by a restarted client")
