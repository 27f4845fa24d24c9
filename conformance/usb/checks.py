"""The USB checks: each judges one hand's transfers for one requirement.

As in :mod:`dexkit.conformance.checks`, a check never passes on missing evidence, and takes
every limit from its requirement's tolerances.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import BaseContext, Outcome, check
from dexkit.conformance.results import Evidence
from dexkit.conformance.stimuli.usb import BUSES, DRIVEN, FREE
from dexkit.conformance.sums import total
from dexkit.conformance.usb.frames import NO_VALUES, STATE_SIZE, Scale, read_command
from dexkit.conformance.usb.record import UsbPhase, topic
from dexkit.conformance.usb.recording import Answer, Exchange, Floats, UsbRecording, UsbSide
from dexkit.hand import Side
from dexkit.wire.dex3_usb import MANUFACTURER, PRODUCT, PRODUCT_ID, VENDOR_ID

__all__ = ["UsbContext"]

_ORDINARY = ("exchange", "burst", "move", "lock", "pause", "drive", "tripped", "clear")
"""Phases in which every command is valid and is followed by a wait for its answer."""
_MOVE_S = 0.2
"""Seconds that each motor has to move (``conformance/stimuli/usb.py``, phase "move")."""
_COARSEST = 0.03
"""s between two answers over which a speed is integrated; most of a move takes 0.1 s."""
_DAMAGED = ("malformed", "broadcast", "short")
"""Phases that begin with an invalid frame; good commands follow."""


@dataclass(frozen=True)
class UsbContext(BaseContext[UsbRecording, UsbSide]):
    """One requirement to be judged for the USB transfers of one hand."""

    def tolerance(self, name: str) -> float:
        """A tolerance of the requirement."""
        return self.requirement.tolerance(name)

    def phases(self) -> list[UsbPhase]:
        """The phases that the requirement needs."""
        return self.hand.phases(self.requirement.phase or "")

    def at(self, seconds: float, end: float | None = None, *, inward: bool = True) -> Evidence:
        """A place in the recording."""
        return self.place(topic(self.hand.side, inward=inward), seconds, end)

    def over(self, phase: UsbPhase) -> Evidence:
        """The time of a phase, as a place in the recording."""
        return self.at(*self.hand.span(phase))


# ------------------------------------------------------------------------------- descriptors


@check("DEX3USB-DESC-01")
def _ids(c: UsbContext) -> Outcome:
    device, wanted = c.hand.device, (VENDOR_ID, PRODUCT_ID[c.hand.side])
    figure = f"{device.vendor:04X}:{device.product:04X}"
    if (device.vendor, device.product) == wanted:
        return c.passed(figure)
    other = next(
        (s for s in Side if (device.vendor, device.product) == (VENDOR_ID, PRODUCT_ID[s])), None
    )
    what = f", which is a {other} hand" if other else ""
    return c.failed(figure, f"the {c.hand.side} hand's device is {figure}{what}")


@check("DEX3USB-DESC-02")
def _release(c: UsbContext) -> Outcome:
    release = c.hand.device.release
    figure = f"{release >> 8:x}.{release & 0xFF:02x}"
    return c.passed(figure) if release == 0x0100 else c.failed(figure, f"bcdDevice is {figure}")


@check("DEX3USB-DESC-03")
def _strings(c: UsbContext) -> Outcome:
    device = c.hand.device
    wanted = (MANUFACTURER, PRODUCT[c.hand.side])
    figure = f"{device.manufacturer!r}, {device.name!r}, serial {device.serial!r}"
    if (device.manufacturer, device.name) == wanted and device.serial:
        return c.passed(device.serial, figure)
    return c.failed(device.name or "none", f"the strings are {figure}")


@check("DEX3USB-DESC-04")
def _speed(c: UsbContext) -> Outcome:
    speed = c.hand.record.descriptors.speed
    if not speed:
        return c.skipped("this host does not report the speed")
    name = {1: "low", 2: "full", 3: "high"}.get(speed, "super")
    return c.passed(name) if speed == 3 else c.failed(name, f"it runs at {name} speed")


@check("DEX3USB-DESC-05")
def _endpoints(c: UsbContext) -> Outcome:
    endpoints = c.hand.device.endpoints
    bulk = Counter(e.inward for e in endpoints if e.bulk)
    figure = ", ".join(f"{e.address:#04x} {'bulk' if e.bulk else 'not bulk'}" for e in endpoints)
    if bulk == {True: 1, False: 1}:
        return c.passed(" ".join(f"{e.address:#04x}" for e in endpoints if e.bulk), figure)
    return c.failed(f"{bulk.total()} bulk", f"interface 0 has {figure or 'no endpoints'}")


@check("DEX3USB-DESC-06")
def _packet_size(c: UsbContext) -> Outcome:
    sizes = sorted({e.size for e in c.hand.device.endpoints if e.bulk})
    figure = ", ".join(map(str, sizes))
    if sizes == [c.tolerance("size")]:
        return c.passed(figure)
    return c.failed(figure, f"wMaxPacketSize is {figure}")


# ---------------------------------------------------------------------------------- exchange


def _ordinary(c: UsbContext) -> Iterator[Exchange]:
    for phase in c.hand.record.phases:
        if phase.name in _ORDINARY:
            yield from c.hand.exchanges(phase)


@check("DEX3USB-XCHG-01")
def _answered(c: UsbContext) -> Outcome:
    exchanges = list(_ordinary(c))
    silent = [x for x in exchanges if x.answer is None]
    figure = f"{len(exchanges) - len(silent)} of {len(exchanges)}"
    if not silent:
        return c.passed(figure)
    places = [c.at(x.t, inward=False) for x in silent]
    return c.failed(figure, f"{len(silent)} of {len(exchanges)} commands got no answer", *places)


@check("DEX3USB-XCHG-02")
def _once(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    sent = sum(not t.inward for t in c.hand.during(phase))
    answers = c.hand.answers_in(phase)
    figure = f"{len(answers)} to {sent}"
    if len(answers) <= sent:
        return c.passed(figure)
    observed = f"{len(answers)} frames came to {sent} commands"
    return c.failed(figure, observed, *(c.at(a.t) for a in answers[sent:]))


@check("DEX3USB-XCHG-03")
def _unasked(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    begin, end = c.hand.span(phase)
    found = c.hand.answers_in(phase)
    if not any(t.inward for t in c.hand.during(phase)):
        return c.skipped("nothing was read while no command was sent")
    if not found:
        return c.passed(f"none in {end - begin:.2f} s")
    observed = f"{len(found)} frames came in {end - begin:.2f} s without a command"
    return c.failed(f"{len(found)} frames", observed, *(c.at(a.t) for a in found))


@check("DEX3USB-XCHG-04")
def _two(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = len(c.hand.answers_in(phase))
    if 1 <= answers <= 2:
        return c.passed(f"{answers} answers")
    return c.failed(f"{answers} answers", f"two commands got {answers} answers", c.over(phase))


def _bursts(c: UsbContext) -> list[tuple[UsbPhase, list[float], float]]:
    """Each burst with its answer times and its rate, the fastest first.

    Other load of the machine can only slow a burst down.
    """
    found = []
    for phase in c.phases():
        begin, end = c.hand.span(phase)
        times = [
            (x.answer.transfer.done_ns - x.command.submitted_ns) / 1e9
            for x in c.hand.exchanges(phase)
            if x.answer is not None
        ]
        if times and end > begin:
            found.append((phase, times, len(times) / (end - begin)))
    return sorted(found, key=lambda burst: -burst[2])


@check("DEX3USB-RATE-01")
def _rate(c: UsbContext) -> Outcome:
    bursts = _bursts(c)
    if not bursts:
        return c.skipped("no exchange in a burst")
    _, times, rate = bursts[0]
    figure = f"{rate:.0f} Hz"
    if rate >= c.tolerance("min_rate_hz"):
        return c.passed(figure, rate_hz=rate)
    observed = f"{figure} in the fastest of {len(bursts)} bursts of {len(times)} exchanges"
    outcome = c.failed(figure, observed, *(c.over(phase) for phase, _, _ in bursts), rate_hz=rate)
    return outcome.if_late(1 / rate - 1 / c.tolerance("min_rate_hz"), how="mean")


@check("DEX3USB-RATE-02")
def _latency(c: UsbContext) -> Outcome:
    bursts = _bursts(c)
    if not bursts:
        return c.skipped("no exchange in a burst")
    (p50, p99), phase = min(
        ((tuple(np.percentile(times, [50, 99])), phase) for phase, times, _ in bursts),
        key=lambda found: found[0][1],
    )
    figure = f"{p99 * 1e3:.2f} ms"
    if p99 <= c.tolerance("max_s"):
        return c.passed(figure, p50_s=p50, p99_s=p99)
    observed = f"99 of 100 within {figure}, the median is {p50 * 1e3:.2f} ms"
    outcome = c.failed(figure, observed, c.over(phase), p50_s=p50, p99_s=p99)
    return outcome.if_late(p99 - c.tolerance("max_s"), how="p99")


# ------------------------------------------------------------------------------------ frames


def _all(
    c: UsbContext, good: Callable[[Answer], bool], what: str, answers: list[Answer] | None = None
) -> Outcome:
    """Fail unless every frame is good; ``what`` names the fault of the others."""
    answers = c.hand.answers if answers is None else answers
    if not answers:
        return c.skipped("no frame came")
    wrong = [a for a in answers if not good(a)]
    if not wrong:
        return c.passed(f"{len(answers)} frames")
    figure = f"{len(wrong)} of {len(answers)}"
    return c.failed(figure, f"{figure} frames have {what}", *(c.at(a.t) for a in wrong))


@check("DEX3USB-SIZE-01")
def _size(c: UsbContext) -> Outcome:
    sizes = Counter(a.reading.length for a in c.hand.answers)
    figure = ", ".join(f"{n} bytes ({times})" for n, times in sizes.most_common(4))
    return _all(c, lambda a: a.reading.length == STATE_SIZE, f"another size: {figure}")


@check("DEX3USB-SIZE-02")
def _both_sizes(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    joint = phase.params["joint"]
    part = _part(c.hand, phase, joint, phase.params["begin"], phase.params["target"])
    size = phase.params["size"]
    figure = f"{size} bytes: {part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed("both", figure)
    observed = f"a frame of {size} bytes got {phase.params['answers']} answers; {figure}"
    return c.failed(f"not {size}", observed, c.over(phase)).about(joint)


@check("DEX3USB-HEAD-01")
def _head(c: UsbContext) -> Outcome:
    heads = {a.reading.head.hex(" ") for a in c.hand.answers} - {"fc fd"}
    return _all(c, lambda a: a.reading.head == b"\xfc\xfd", f"the head {', '.join(sorted(heads))}")


@check("DEX3USB-CRC-01")
def _frame_crc(c: UsbContext) -> Outcome:
    return _all(c, lambda a: a.reading.crc_right, "a wrong CRC")


@check("DEX3USB-CRC-02")
def _motor_crc(c: UsbContext) -> Outcome:
    if not any(a.reading.motors for a in c.hand.answers):
        return c.skipped("no motor packet came")
    return _all(c, lambda a: all(m.intact for m in a.reading.motors), "a damaged motor packet")


@check("DEX3USB-CRC-03")
def _sensor_crc(c: UsbContext) -> Outcome:
    if not any(a.reading.sensors for a in c.hand.answers):
        return c.skipped("no sensor packet came")
    return _all(c, lambda a: all(s.intact for s in a.reading.sensors), "a damaged sensor packet")


@check("DEX3USB-PACK-01")
def _whole(c: UsbContext) -> Outcome:
    odd = next((a.reading.strange[0] for a in c.hand.answers if a.reading.strange), "")
    return _all(c, lambda a: not a.reading.strange, odd)


def _places(answer: Answer) -> list[tuple[int, int]]:
    return sorted((m.bus, m.id) for m in answer.reading.motors)


def _to_all(c: UsbContext) -> list[Answer]:
    """The answers to commands that addressed every motor by its own id."""
    return [x.answer for x in _ordinary(c) if x.answer is not None]


@check("DEX3USB-PACK-02")
def _seven(c: UsbContext) -> Outcome:
    def good(answer: Answer) -> bool:
        places = _places(answer)
        counted = [(b, i) for b in range(5) for i in range(sum(p[0] == b for p in places))]
        return len(places) == 7 and places == counted

    answers = _to_all(c)
    odd = next((_places(a) for a in answers if not good(a)), [])
    figure = " ".join(f"{b}.{i}" for b, i in odd) or "none"
    return _all(c, good, f"{len(odd)} motors (bus.id): {figure}", answers)


@check("DEX3USB-PACK-03")
def _map(c: UsbContext) -> Outcome:
    answers = _to_all(c)
    odd = next((_places(a) for a in answers if _places(a) != sorted(BUSES)), [])
    figure = " ".join(f"{b}.{i}" for b, i in odd)
    good = sorted(BUSES)
    return _all(c, lambda a: _places(a) == good, f"motors at (bus.id) {figure}", answers)


@check("DEX3USB-PACK-04")
def _nine(c: UsbContext) -> Outcome:
    def good(answer: Answer) -> bool:
        places = [(s.bus, s.id) for s in answer.reading.sensors]
        return len(places) == 9 == len(set(places))

    counts = sorted({len(a.reading.sensors) for a in c.hand.answers})
    return _all(c, good, f"{', '.join(map(str, counts))} sensor packets, or one twice")


@check("DEX3USB-SENS-01")
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
    return _all(c, lambda a: elements(a) == 33, f"{figure} values that are not {codes}")


@check("DEX3USB-VALUE-01")
def _supply(c: UsbContext) -> Outcome:
    volts = np.array([a.reading.pin_v for a in c.hand.answers])
    low, high = c.tolerance("min_v"), c.tolerance("max_v")
    outcome = _all(
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


# ------------------------------------------------------------------------------------ motion


def _part(hand: UsbSide, phase: UsbPhase, joint: int, begin: float, target: float) -> float:
    """Part of the way to its target that a joint went in a phase; NaN if it is not reported."""
    _, q = hand.positions(phase)
    known = q[np.isfinite(q[:, joint]), joint]
    return float((known[-1] - begin) / (target - begin)) if len(known) else math.nan


def _travel(hand: UsbSide, phase: UsbPhase, *, before: bool = True) -> Floats:
    """The largest distance of each joint from its first position, rad; 0 if not reported."""
    _, q = hand.positions(phase, before=before)
    if len(q) < 2:
        return np.zeros(len(hand.joints))
    travel: Floats = np.nan_to_num(np.nanmax(np.abs(q - q[0]), axis=0))
    return travel


def _quiet_motors(
    c: UsbContext, phases: list[UsbPhase], name: Callable[[UsbPhase], str]
) -> Outcome:
    """Fail if a joint moved in any of the phases."""
    limit = c.tolerance("max_q")
    most = 0.0
    for phase in phases:
        if not c.hand.answers_in(phase):
            return c.skipped(f"no answer came {name(phase)}")
        travel = _travel(c.hand, phase)
        most = max(most, float(travel.max()))
        if travel.max() > limit:
            joint = int(travel.argmax())
            observed = f"{_named(c, [joint])} moved by {travel.max():.2f} rad {name(phase)}"
            outcome = c.failed(
                f"{travel.max():.2f} rad", observed, c.over(phase), moved=travel.max()
            )
            return outcome.about(joint)
    return c.passed(f"{most:.3f} rad", moved=most)


@check("DEX3USB-MODE-01")
def _mode(c: UsbContext) -> Outcome:
    judged = 0
    for phase in c.hand.record.phases:
        answers = c.hand.answers_in(phase)
        if "status" not in phase.params or not answers:
            continue
        judged += 1
        wanted = phase.params["status"]
        last = answers[-1]
        odd = {f"{m.bus}.{m.id}": m.status for m in last.reading.motors if m.status != wanted}
        if odd:
            figure = ", ".join(f"motor {who} reports {status}" for who, status in odd.items())
            observed = f"commanded status {wanted}, {figure}"
            return c.failed(f"not {wanted}", observed, c.at(last.t))
    return c.passed("0 and 1") if judged else c.skipped("no answer to judge by")


@check("DEX3USB-MODE-02")
def _lock(c: UsbContext) -> Outcome:
    return _quiet_motors(c, c.phases(), lambda phase: "although it was to lock")


def _moves(c: UsbContext) -> Iterator[tuple[UsbPhase, int, float, float]]:
    for phase in c.phases():
        yield phase, phase.params["joint"], phase.params["begin"], phase.params["target"]


@check("DEX3USB-MOVE-01")
def _follows(c: UsbContext) -> Outcome:
    parts: dict[int, float] = {}
    wrong = []
    late = []
    least = c.tolerance("min_part")
    for phase, joint, begin, target in _moves(c):
        part = parts[joint] = _part(c.hand, phase, joint, begin, target)
        # overshooting by the same distance is not following either
        if not least <= part <= 2 - least:
            wrong.append((joint, phase))
            # no delay sends a joint the wrong way or too far
            late.append((least - part) * _MOVE_S if -0.1 < part < least else math.inf)
    figure = f"{min(parts.values()):.0%} .. {max(parts.values()):.0%}"
    if not wrong:
        return c.passed(figure, f"of the way in 0.2 s: {figure}")
    text = ", ".join(f"{_named(c, [joint])} {parts[joint]:.0%}" for joint, _ in wrong)
    outcome = c.failed(figure, f"part of the way: {text}", *(c.over(p) for _, p in wrong))
    return outcome.about(*(joint for joint, _ in wrong)).if_late(*late)


@check("DEX3USB-MOVE-02")
def _others(c: UsbContext) -> Outcome:
    most = 0.0
    earlier: set[int] = set()
    for phase, joint, _, _ in _moves(c):
        travel = _travel(c.hand, phase)
        # the joint that moved before may still be moving
        travel[[joint, *earlier]] = 0.0
        earlier.add(joint)
        most = max(most, float(travel.max()))
        if travel.max() > c.tolerance("max_q"):
            other = int(travel.argmax())
            moved, commanded = (_named(c, [i]) for i in (other, joint))
            observed = f"{moved} moved by {travel.max():.2f} rad when {commanded} was commanded to"
            outcome = c.failed(f"{travel.max():.2f} rad", observed, c.over(phase))
            return outcome.about(other, joint)
    return c.passed(f"{most:.3f} rad", moved=most)


@check("DEX3USB-MOVE-03")
def _limits(c: UsbContext) -> Outcome:
    margin = c.tolerance("margin")
    beyond = 0.0
    for answer in c.hand.answers:
        for i, (joint, q) in enumerate(zip(c.hand.joints, c.hand.q(answer), strict=True)):
            over = max(joint.q_min - q, q - joint.q_max)
            beyond = max(beyond, over)  # a comparison with NaN is false
            if over > margin:
                span = f"{joint.q_min:.2f} .. {joint.q_max:.2f}"
                return c.failed(
                    f"{q:.2f} rad", f"{joint.name} at {q:.2f} rad of {span}", c.at(answer.t)
                ).about(i)
    return c.passed(f"{beyond:.3f} rad beyond")


@check("DEX3USB-UNIT-01")
def _speed_unit(c: UsbContext) -> Outcome:
    ratios: dict[int, float] = {}
    late: dict[int, float] = {}
    for phase, joint, _, _ in _moves(c):
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
    for phase, joint, _, _ in _moves(c):
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
            observed = text.format(ratio, _named(c, [joint]))
            return c.failed(figure, observed, *map(c.over, c.phases())).about(joint)
    return c.passed(figure)


# -------------------------------------------------------------------------------- protection


def _flags(c: UsbContext, answer: Answer) -> dict[int, bool]:
    """The time-out flag by joint."""
    motors = [c.hand.motor(answer, joint) for joint in range(len(c.hand.joints))]
    return {i: m.tripped for i, m in enumerate(motors) if m is not None}


def _named(c: UsbContext, joints: list[int]) -> str:
    return ", ".join(c.hand.joints[i].name for i in joints)


@check("DEX3USB-PROT-01")
def _trips(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the silence")
    flags = _flags(c, answers[0])
    silent = [i for i, tripped in flags.items() if not tripped and i != FREE]
    if not silent:
        return c.passed(f"{sum(flags.values())} tripped")
    observed = f"after 1.5 s without a command {_named(c, silent)} show no time-out"
    return c.failed(f"{len(silent)} not", observed, c.at(answers[0].t)).about(*silent)


def _driven(c: UsbContext, joint: int) -> float | None:
    """Seconds for which a joint driven at a steady speed went on after the last command.

    :returns: None when it had no such speed before, so that its stop cannot be detected.
    """
    silences, drives = c.hand.phases("silence"), c.hand.phases("drive")
    after = [a for s in silences for a in c.hand.answers if a.transfer.submitted_ns >= s.end_ns]
    if not drives or not after:
        return None
    t, q = c.hand.positions(drives[0])
    late = t > t[-1] - 0.15 if len(t) else t > 0
    if late.sum() < 3:
        return None
    speed = float(np.polyfit(t[late], q[late, joint], 1)[0])
    if not abs(speed) >= c.tolerance("min_dq"):
        return None
    return float(c.hand.q(after[0])[joint] - q[-1, joint]) / speed


_NO_SPEED = "the motor was not driven before the silence, so its stop proves nothing"


@check("DEX3USB-PROT-02")
def _stops(c: UsbContext) -> Outcome:
    (silence,) = c.phases()
    driven = _driven(c, DRIVEN)
    if driven is None:
        return c.skipped(_NO_SPEED)
    figure = f"{driven:.2f} s"
    if driven <= c.tolerance("max_s"):
        return c.passed(figure, driven_s=driven)
    observed = f"without commands it went as far as in {figure} of driving"
    # a busy machine delays the answers that the speed is measured by
    places = [c.over(phase) for phase in (silence, *c.hand.phases("drive"))]
    outcome = c.failed(figure, observed, *places, driven_s=driven).about(DRIVEN)
    return outcome.if_late(driven - c.tolerance("max_s"))


@check("DEX3USB-PROT-03")
def _stays(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if len(answers) < 2:
        return c.skipped("too few answers after the silence")
    for answer in answers[1:]:
        cleared = [i for i, tripped in _flags(c, answer).items() if not tripped and i != FREE]
        if cleared:
            observed = f"{_named(c, cleared)} cleared the flag while bit 7 was set"
            return c.failed("cleared", observed, c.at(answer.t)).about(*cleared)
    moved = abs(float(c.hand.q(answers[-1])[DRIVEN]) - phase.params["begin"][DRIVEN])
    if moved <= c.tolerance("max_q"):
        return c.passed(f"{moved:.3f} rad", moved=moved)
    observed = f"it followed a position command by {moved:.2f} rad while tripped"
    outcome = c.failed(f"{moved:.2f} rad", observed, c.over(phase), moved=moved)
    return outcome.about(DRIVEN)


@check("DEX3USB-PROT-04")
def _cleared(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer to a command with bit 7 = 0")
    tripped = [i for i, flag in _flags(c, answers[-1]).items() if flag]
    if tripped:
        observed = f"{_named(c, tripped)} still tripped after 0.25 s of commands with bit 7 = 0"
        return c.failed(f"{len(tripped)} tripped", observed, c.over(phase)).about(*tripped)
    part = _part(c.hand, phase, DRIVEN, phase.params["begin"], phase.params["target"])
    figure = f"{part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed(figure)
    return c.failed(figure, f"after clearing it went {figure}", c.over(phase)).about(DRIVEN)


@check("DEX3USB-PROT-05")
def _disabled(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the silence")
    if any(_flags(c, a).get(FREE) for a in answers):
        observed = f"{_named(c, [FREE])} reports a time-out although its protection was off"
        return c.failed("tripped", observed, c.over(phase)).about(FREE)
    driven = _driven(c, FREE)
    if driven is None:
        return c.skipped(_NO_SPEED)
    if driven < c.tolerance("min_s"):
        observed = f"{_named(c, [FREE])} stopped {driven:.2f} s into the silence"
        return c.failed(f"{driven:.2f} s", observed, c.over(phase), driven_s=driven).about(FREE)
    begin, target = (phase.params[name][FREE] for name in ("begin", "targets"))
    part = _part(c.hand, phase, FREE, begin, target)
    figure = f"{part:.0%} of the way"
    if part >= c.tolerance("min_part"):
        return c.passed(figure)
    return c.failed(figure, f"after the pause it went {figure}", c.over(phase)).about(FREE)


@check("DEX3USB-PROT-06")
def _early(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    answers = c.hand.answers_in(phase)
    if not answers:
        return c.skipped("no answer after the pause")
    tripped = [i for i, flag in _flags(c, answers[0]).items() if flag]
    if not tripped:
        return c.passed("none")
    observed = f"{_named(c, tripped)} tripped within {phase.params['seconds']:g} s"
    return c.failed(f"{len(tripped)} tripped", observed, c.over(phase)).about(*tripped)


# ----------------------------------------------------------------------------------- damaged


def _harmless(name: str, *kinds: str) -> None:
    @check(name)
    def judge(c: UsbContext) -> Outcome:
        phases = [p for p in c.phases() if p.params["kind"] in kinds]
        if not phases:
            return c.skipped("such a frame was not sent")
        return _quiet_motors(c, phases, lambda p: f"on the frame '{p.params['kind']}'")


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
        i: _part(c.hand, phase, i, begin[i], target)
        for i, (bus, _) in enumerate(c.hand.record.buses)
        if bus == phase.params["bus"] and abs(target - begin[i]) >= c.tolerance("min_way")
    }
    figure = ", ".join(f"{_named(c, [i])} {part:.0%}" for i, part in parts.items())
    if min(parts.values()) >= c.tolerance("min_part"):
        return c.passed("followed", figure)
    return c.failed("ignored", f"part of the way: {figure}", c.over(phase)).about(*parts)


# -------------------------------------------------------------------------------- connection


@check("DEX3USB-CONN-01")
def _again(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    exchanges = c.hand.exchanges(phase)
    silent = [x for x in exchanges if x.answer is None]
    if silent or not exchanges:
        observed = f"{len(silent)} of {len(exchanges)} commands after it got no answer"
        if c.hand.record.trouble:
            observed += f" ({c.hand.record.trouble})"
        return c.failed("silent", observed, c.over(phase))
    return _quiet_motors(c, [phase], lambda p: "when the interface was claimed again")
