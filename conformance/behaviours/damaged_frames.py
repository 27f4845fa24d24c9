"""Damaged frames on USB do no harm."""

from __future__ import annotations

from dataclasses import replace

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.usb import DRIVEN, Out, UsbScript, UsbSteps
from dexkit.conformance.usb.context import UsbContext, named_joints, part_of_way, quiet_motors
from dexkit.conformance.usb.frames import motor_packet, pack_command
from dexkit.wire.dex3_usb import BROADCAST_ID

_DAMAGES: dict[str, str] = {
    "frame-crc": "a frame with a wrong CRC",
    "packet-crc": "motor packets with a wrong CRC",
    "packet-head": "motor packets with a wrong head",
    "truncated": "the first 1000 bytes of a frame",
    "over-long": "a frame with 66 more bytes",
    "size-241": "a cmd_size one byte past its buffer",
    "size-huge": "a cmd_size of 4294967295",
    "wrong-id": "a packet for motor 9 of a bus with two motors",
}
"""The phases ``malformed`` by ``params["kind"]``."""
_SETTLE = 0.08  # s in which an accepted step is seen, and a late answer comes


@stimulus("malformed", UsbScript, after="lock")
def send_damaged_frames(script: UsbScript) -> UsbSteps:
    """Damaged frames that ask every motor to move; their kind is ``params["kind"]``."""
    script.report("damaged frames: nothing may move")
    for kind in _DAMAGES:
        yield from script.hold_still(0.03)
        phase = script.begin("malformed", kind=kind)
        yield from script.do(Out(_damaged(script, kind)))
        phase.params["answers"] = yield from script.count_silent_frames(_SETTLE)
        hold = script.frame(script.hold_commands())
        for _ in range(3):
            yield from script.exchange(hold)
        script.end(phase)


def _damaged(script: UsbScript, kind: str) -> bytes:
    """A frame of this kind."""
    hold = script.hold_commands()
    wish = script.goals_inward(hold)
    if kind == "frame-crc":
        return script.frame(wish, spoil=True)
    if kind == "packet-crc":
        return script.frame(wish, wrong_crc=True)
    if kind == "packet-head":
        return script.frame(wish, head=b"\xfe\xed")
    if kind == "truncated":
        whole = script.frame(wish)
        return whole[: min(1000, len(whole) - 34)]
    if kind == "over-long":
        return script.frame(wish) + bytes(66)
    bus, _ = script.plan.buses[DRIVEN]
    mine = [i for i, place in enumerate(script.plan.buses) if place[0] == bus]
    if kind == "wrong-id":
        joint = script.joints[DRIVEN]
        stray = motor_packet(9, wish[DRIVEN], joint)
        return script.frame(hold, extra={bus: [stray]})
    # the goals are on the bus whose size is wrong
    mixed = [wish[i] if i in mine else hold[i] for i in range(len(hold))]
    size = 0xFFFFFFFF if kind == "size-huge" else (240 if script.size == 1234 else 140) + 1
    return script.frame(mixed, sizes={bus: size})


@stimulus("broadcast", UsbScript, after="malformed")
def send_broadcast(script: UsbScript) -> UsbSteps:
    """One packet with id 15 on the middle finger's bus."""
    yield from script.hold_still(0.05)
    hold = script.hold_commands()
    bus, _ = script.plan.buses[DRIVEN]
    # one position for all motors of the bus: that of the first, a little inward
    target = script.goal_inward(DRIVEN, 0.15)
    begin = list(script.q)
    order = motor_packet(BROADCAST_ID, replace(hold[DRIVEN], q=target), script.joints[DRIVEN])
    elsewhere: dict[int, list[bytes]] = {bus: [order]}
    for i, (place, number) in enumerate(script.plan.buses):
        if place != bus:
            elsewhere.setdefault(place, []).append(motor_packet(number, hold[i], script.joints[i]))
    phase = script.begin("broadcast", bus=bus, target=target, begin=begin)
    yield from script.do(Out(pack_command(elsewhere, script.size)))
    phase.params["answers"] = yield from script.count_silent_frames(0.2)
    yield from script.exchange(script.frame(script.hold_commands()))
    script.end(phase)


_DAMAGED = ("malformed", "broadcast", "short")
"""Phases that begin with an invalid frame; good commands follow."""
_HARMLESS = {
    "DEX3USB-BAD-01": ("frame-crc",),
    "DEX3USB-BAD-02": ("packet-crc", "packet-head"),
    "DEX3USB-BAD-03": ("truncated",),
    "DEX3USB-BAD-04": ("over-long",),
    "DEX3USB-BAD-05": ("size-241", "size-huge"),
    "DEX3USB-BAD-06": ("wrong-id",),
}


@check(*_HARMLESS)
def _harmless(c: UsbContext) -> Outcome:
    kinds = _HARMLESS[c.requirement.id]
    phases = [p for p in c.phases() if p.params["kind"] in kinds]
    if not phases:
        return c.skipped("such a frame was not sent")
    return quiet_motors(c, phases, lambda p: f"on the frame '{p.params['kind']}'")


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
