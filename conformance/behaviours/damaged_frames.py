"""Damaged frames on USB do no harm."""

from __future__ import annotations

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.usb.context import UsbContext, named_joints, part_of_way, quiet_motors

_DAMAGED = ("malformed", "broadcast", "short")
"""Phases that begin with an invalid frame; good commands follow."""


def _harmless(name: str, *kinds: str) -> None:
    @check(name)
    def judge(c: UsbContext) -> Outcome:
        phases = [p for p in c.phases() if p.params["kind"] in kinds]
        if not phases:
            return c.skipped("such a frame was not sent")
        return quiet_motors(c, phases, lambda p: f"on the frame '{p.params['kind']}'")


_harmless("DEX3USB-BAD-01", "frame-crc")
_harmless("DEX3USB-BAD-02", "packet-crc", "packet-head")
_harmless("DEX3USB-BAD-03", "truncated")
_harmless("DEX3USB-BAD-04", "over-long")
_harmless("DEX3USB-BAD-05", "size-241", "size-huge")
_harmless("DEX3USB-BAD-06", "wrong-id")


@check("DEX3USB-BAD-07")
def _goes_on(c: UsbContext) -> Outcome:
    judged = 0
    for phase in c.hand.record.phases:
        if phase.name not in _DAMAGED:
            continue
        for x in c.hand.exchanges(phase)[1:]:
            judged += 1
            if x.answer is None:
                kind = phase.params.get("kind", phase.name)
                observed = f"after the frame '{kind}' a good command got no answer"
                return c.failed("silent", observed, c.at(x.t, inward=False))
    return c.passed(f"{judged} answers") if judged else c.skipped("no good command was sent after")


@check("DEX3USB-BAD-08")
def _broadcast(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    begin, target = phase.params["begin"], phase.params["target"]
    parts = {
        i: part_of_way(c.hand, phase, i, begin[i], target)
        for i, (bus, _) in enumerate(c.hand.record.buses)
        if bus == phase.params["bus"] and abs(target - begin[i]) >= c.tolerance("min_way")
    }
    figure = ", ".join(f"{named_joints(c, [i])} {part:.0%}" for i, part in parts.items())
    if min(parts.values()) >= c.tolerance("min_part"):
        return c.passed("followed", figure)
    return c.failed("ignored", f"part of the way: {figure}", c.over(phase)).about(*parts)
