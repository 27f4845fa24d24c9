"""State from the start, and no motion before the first command."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.kit.median import median
from dexkit.hand import Floats


@check("DEX1-START-02")
def legacy_ready(ctx: Context) -> Outcome:
    """Whether any q is not 0 before the first command, on the legacy topic."""
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


@check("DEX1-START-01", "DEX3-START-01", "H1-START-01")
def state_first(ctx: Context) -> Outcome:
    """State is published before the first command."""
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


@check("DEX3-START-02")
def rest_pose(ctx: Context) -> Outcome:
    """Whether any q is not 0 before the first command."""
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


@check("DEX1-START-03", "DEX3-START-03")
@worst("motion_rad", "max_motion_stroke", nothing="too few states after a start")
def starts_idle(ctx: Context) -> Figures:
    """Motion and force between the first state of a started service and the first command.

    A requirement without ``max_tau_nm`` has no limit of the force.
    """
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        first = ctx.commands.t[(ctx.commands.t >= begin) & (ctx.commands.t < end)]
        rows = ctx.states.between(begin, float(first[0]) if len(first) else end)
        for joint in range(len(ctx.joints)):
            t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
            t, q = t[np.isfinite(q)], q[np.isfinite(q)]
            if len(t) < 5:
                continue
            away = np.abs(q - q[0])
            i = int(np.argmax(away))
            text = f"moved by {away[i]:.3f} {ctx.unit} before the first command after a start"
            yield Figure(float(away[i]), float(t[i]), None, joint, text)
        if "max_tau_nm" in ctx.requirement.tolerances:
            presses = judged(
                ctx,
                _presses(ctx, ctx.states.t[rows], ctx.states.tau[rows, 0]),
                "tau_nm",
                "max_tau_nm",
                nothing=ctx.passed("no force"),
            )
            if not presses.met:
                yield presses


def _presses(ctx: Context, t: Floats, tau: Floats) -> Figures:
    """The torques, N m, of a started gripper whose last command may have asked for one."""
    t, tau = t[np.isfinite(tau)], tau[np.isfinite(tau)]
    if len(t) < 5:
        return
    # a motor that releases a grip may still show its force at first
    for at in np.arange(float(t[0]) + ctx.tolerance("release_s"), float(t[-1]), 0.1).tolist():
        piece = np.abs(tau[(t >= at) & (t < at + 0.1)])
        if len(piece) >= 3:
            felt = median(piece)
            text = f"tau_est of {felt:.2f} N m before the first command after a start"
            yield Figure(felt, at, text=text)
