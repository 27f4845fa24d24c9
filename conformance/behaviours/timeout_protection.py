"""Motors that ask for it brake when commands end (bit 7 of the mode byte)."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.obedience import arrival
from dexkit.conformance.checks.silences import mode_bytes, roles_of, silences_of, stops_moving
from dexkit.conformance.checks.steps import not_driven


@check("DEX3-GUARD-01")
def brakes(ctx: Context) -> Outcome:
    """Motion after the time-out of protected joints, driven by velocity or to a position."""
    return stops_moving(ctx, (*roles_of(ctx).driven, *roles_of(ctx).slow), guarded=True)


@check("DEX3-GUARD-02")
def reports_trip(ctx: Context) -> Outcome:
    """Bit 7 of the state's mode byte of each joint before and after the time-out."""
    silences = silences_of(ctx, "guard", "silence")
    for silence in silences:
        last, late, end = silence.last, silence.late, silence.end
        # protection is on for a while before: repeated commands must keep it from tripping
        begins = [ctx.span(p)[0] for n in ("squeeze", "guarded") for p in ctx.phases(n)]
        since = max((b for b in begins if last - 5.0 < b < last), default=last - 0.2)
        before = mode_bytes(ctx, ctx.states.between(since, last + 0.5)) >> 7
        after = mode_bytes(ctx, ctx.states.between(late, end)) >> 7
        if not len(before) or not len(after):
            return ctx.skipped("no state in the silence")
        if before.any():
            joint = int(np.argmax(before.any(axis=0)))
            return ctx.failed(
                "too early",
                ctx.named("bit 7 is set while commands arrive", joint),
                ctx.at(ctx.states.topic, since, last),
            ).about(joint)
        wrong = (after != silence.guarded).any(axis=0)
        if wrong.any():
            joint = int(np.argmax(wrong))
            seen = "not always set" if silence.guarded[joint] else "set without protection"
            return ctx.failed(
                "not set" if silence.guarded[joint] else "set",
                ctx.named(f"bit 7 is {seen} after the time-out", joint),
                ctx.at(ctx.states.topic, late, end),
            ).about(joint)
    if not any(s.end - s.late >= ctx.tolerance("stays_s") - 0.2 for s in silences):
        return ctx.skipped("no silence with protection was long enough")
    count = sum(int(s.guarded.sum()) for s in silences)
    return ctx.passed("set", f"bit 7 is set in {count} protected motors, and in no other")


@check("DEX3-GUARD-03")
def latches(ctx: Context) -> Outcome:
    """Motion by commands that do not clear the protection."""
    return not_driven(ctx, "while the time-out protection was tripped and not cleared")


@check("DEX3-GUARD-04")
def clears(ctx: Context) -> Outcome:
    """The step after the protection was cleared."""
    return arrival(ctx, "commanded without bit 7 after the protection had tripped")
