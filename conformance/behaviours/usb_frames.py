"""Sizes, packets and units of the frames on USB."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.kit.sums import total
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.usb import BUSES, Out, UsbScript, UsbSteps
from dexkit.conformance.usb.context import (
    UsbContext,
    all_frames,
    moves,
    named_joints,
    ordinary,
    part_of_way,
)
from dexkit.conformance.usb.frames import NO_VALUES, STATE_SIZE, Scale, read_command
from dexkit.conformance.usb.recording import Answer


@stimulus("short", UsbScript, after="broadcast")
def send_other_size(script: UsbScript) -> UsbSteps:
    """The other size of the command frame, with a small step of the index finger."""
    size = 734 if script.size == 1234 else 1234
    joint = len(script.joints) - 1
    yield from script.hold_still(0.05)
    hold = script.hold_commands()
    target = script.goal_inward(joint)
    phase = script.begin("short", size=size, joint=joint, begin=script.q[joint], target=target)
    hold[joint] = replace(hold[joint], q=target)
    yield from script.do(Out(script.frame(hold, size=size)))
    phase.params["answers"] = yield from script.count_silent_frames(0.2)
    yield from script.exchange(script.frame(script.hold_commands()))
    script.end(phase)


_COARSEST = 0.03
"""s between two answers over which a speed is integrated; most of a move takes 0.1 s."""


@check("DEX3USB-SIZE-01")
def _frame(c: UsbContext) -> Outcome:
    size = _size(c)
    return all_of(size, _head(c)) if size.met else size


def _size(c: UsbContext) -> Outcome:
    sizes = Counter(a.reading.length for a in c.hand.answers)
    figure = ", ".join(f"{n} bytes ({times})" for n, times in sizes.most_common(4))
    return all_frames(c, lambda a: a.reading.length == STATE_SIZE, f"another size: {figure}")


@check("DEX3USB-SIZE-02")
def _both_sizes(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    joint = phase.params["joint"]
    part = part_of_way(c.hand, phase, joint, phase.params["begin"], phase.params["target"])
    size = phase.params["size"]
    figure = f"{size} bytes: {part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed("both", figure)
    observed = f"a frame of {size} bytes got {phase.params['answers']} answers; {figure}"
    return c.failed(f"not {size}", observed, c.over(phase)).about(joint)


def _head(c: UsbContext) -> Outcome:
    heads = {a.reading.head.hex(" ") for a in c.hand.answers} - {"fc fd"}
    return all_frames(
        c, lambda a: a.reading.head == b"\xfc\xfd", f"the head {', '.join(sorted(heads))}"
    )


@check("DEX3USB-PACK-01")
def _whole(c: UsbContext) -> Outcome:
    odd = next((a.reading.strange[0] for a in c.hand.answers if a.reading.strange), "")
    return all_frames(c, lambda a: not a.reading.strange, odd)


def _places(answer: Answer) -> list[tuple[int, int]]:
    return sorted((m.bus, m.id) for m in answer.reading.motors)


def _to_all(c: UsbContext) -> list[Answer]:
    """The answers to commands that addressed every motor by its own id."""
    return [x.answer for x in ordinary(c) if x.answer is not None]


@check("DEX3USB-PACK-02")
def _motors(c: UsbContext) -> Outcome:
    return all_of(_seven(c), warning(_map(c)))


def _seven(c: UsbContext) -> Outcome:
    def good(answer: Answer) -> bool:
        places = _places(answer)
        counted = [(b, i) for b in range(5) for i in range(sum(p[0] == b for p in places))]
        return len(places) == 7 and places == counted

    answers = _to_all(c)
    odd = next((_places(a) for a in answers if not good(a)), [])
    figure = " ".join(f"{b}.{i}" for b, i in odd) or "none"
    return all_frames(c, good, f"{len(odd)} motors (bus.id): {figure}", answers)


def _map(c: UsbContext) -> Outcome:
    answers = _to_all(c)
    odd = next((_places(a) for a in answers if _places(a) != sorted(BUSES)), [])
    figure = " ".join(f"{b}.{i}" for b, i in odd)
    good = sorted(BUSES)
    return all_frames(c, lambda a: _places(a) == good, f"motors at (bus.id) {figure}", answers)


@check("DEX3USB-PACK-04")
def _sensors(c: UsbContext) -> Outcome:
    return all_of(_nine(c), warning(_elements(c)))


def _nine(c: UsbContext) -> Outcome:
    def good(answer: Answer) -> bool:
        places = [(s.bus, s.id) for s in answer.reading.sensors]
        return len(places) == 9 == len(set(places))

    counts = sorted({len(a.reading.sensors) for a in c.hand.answers})
    return all_frames(c, good, f"{', '.join(map(str, counts))} sensor packets, or one twice")


def _elements(c: UsbContext) -> Outcome:
    def slots(answer: Answer) -> Iterator[tuple[tuple[int, int, int], int]]:
        for s in answer.reading.sensors:
            for slot, count in enumerate(s.pressure):
                yield (s.bus, s.id, slot), count

    # 30000 counts are 240 kPa too: a slot that holds anything else at some time has an element
    pressed = {at for a in c.hand.answers for at, n in slots(a) if n not in NO_VALUES}

    def elements(answer: Answer) -> int:
        return sum(
            n not in NO_VALUES or (n == NO_VALUES[1] and at in pressed) for at, n in slots(answer)
        )

    counts = sorted({elements(a) for a in c.hand.answers})
    figure = ", ".join(map(str, counts))
    codes = " or ".join(map(str, NO_VALUES))
    return all_frames(c, lambda a: elements(a) == 33, f"{figure} values that are not {codes}")


@check("DEX3USB-VALUE-01")
def _supply(c: UsbContext) -> Outcome:
    volts = np.array([a.reading.pin_v for a in c.hand.answers])
    low, high = c.tolerance("min_v"), c.tolerance("max_v")
    outcome = all_frames(
        c,
        lambda a: low <= a.reading.pin_v <= high,
        f"a supply of {np.nanmin(volts):.1f} to {np.nanmax(volts):.1f} V",
    )
    return outcome


@check("DEX3USB-VALUE-02")
def _errors(c: UsbContext) -> Outcome:
    (phase,) = c.hand.phases("exchange")
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no frame came while it rested")
    for answer in answers:
        faulty = {f"motor {m.bus}.{m.id}": m.error for m in answer.reading.motors if m.error}
        if answer.reading.error:
            faulty["hand"] = answer.reading.error
        if faulty:
            figure = ", ".join(f"{who} {bits:#x}" for who, bits in faulty.items())
            return c.failed(f"{len(faulty)} faulty", f"error bits: {figure}", c.at(answer.t))
    return c.passed("none")


@check("DEX3USB-UNIT-01")
def _speed_unit(c: UsbContext) -> Outcome:
    ratios: dict[int, float] = {}
    late: dict[int, float] = {}
    for phase, joint, _, _ in moves(c):
        points = [
            (a.t, m) for a in c.hand.answers_in(phase) if (m := c.hand.motor(a, joint)) is not None
        ]
        scale = Scale(c.hand.joints[joint].gear_ratio)
        t = np.array([at for at, _ in points])
        q = np.array([m.position for _, m in points]) / scale.q
        dq = np.array([m.speed for _, m in points]) / scale.dq
        # an integral over samples that are far apart is meaningless, whatever caused the gap
        close = len(points) > 2 and np.diff(t).max() <= _COARSEST
        if close and abs(q[-1] - q[0]) > 0.05:
            way = total((dq[1:] + dq[:-1]) / 2 * np.diff(t))
            ratio = ratios[joint] = way / float(q[-1] - q[0])
            # answers that arrive late by some time shift the integral by at most that time
            # multiplied by all changes of the speed
            beyond = max(c.tolerance("min_ratio") - ratio, ratio - c.tolerance("max_ratio"))
            changes = total(np.abs(np.diff(dq)))
            late[joint] = beyond * abs(float(q[-1] - q[0])) / changes if changes else math.inf
    outcome = _ratio(c, ratios, "the integrated speed is {:.2f} of the way of {}")
    if outcome.met is False:
        return outcome.if_late(late[outcome.joints[0]], how="p99")
    return outcome


@check("DEX3USB-UNIT-02")
def _torque_unit(c: UsbContext) -> Outcome:
    ratios: dict[int, float] = {}
    for phase, joint, _, _ in moves(c):
        scale = Scale(c.hand.joints[joint].gear_ratio)
        law, reported = [], []
        # the first answer may hold the state before the command
        for x in c.hand.exchanges(phase)[1:]:
            order = next(
                (
                    m
                    for b, i, m in read_command(x.command.data) or ()
                    if (b, i) == c.hand.record.buses[joint]
                ),
                None,
            )
            motor = c.hand.motor(x.answer, joint) if x.answer else None
            if order is None or motor is None:
                continue
            error = (order.q - motor.position) / scale.q
            slip = (order.dq - motor.speed) / scale.dq
            law.append(order.kp / scale.kp * error + order.kd / scale.kd * slip)
            reported.append(motor.torque / scale.tau)
        both = np.array([law, reported])
        if both.size and np.abs(both[0]).max() > c.tolerance("min_tau"):
            ratios[joint] = total(both[0] * both[1]) / total(both[0] ** 2)
    return _ratio(c, ratios, "the reported torque is {:.2f} of what the gains demand of {}")


def _ratio(c: UsbContext, ratios: Mapping[int, float], text: str) -> Outcome:
    if not ratios:
        return c.skipped("no motion to judge by")
    figure = f"{min(ratios.values()):.2f} .. {max(ratios.values()):.2f}"
    for joint, ratio in ratios.items():
        if not c.tolerance("min_ratio") <= ratio <= c.tolerance("max_ratio"):
            observed = text.format(ratio, named_joints(c, [joint]))
            return c.failed(figure, observed, *map(c.over, c.phases())).about(joint)
    return c.passed(figure)
