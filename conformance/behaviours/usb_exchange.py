"""One answer for each command frame, how fast, and after the device is opened again."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.usb import Alone, In, Out, Reopen, UsbScript, UsbSteps
from dexkit.conformance.usb.context import UsbContext, ordinary, quiet_motors
from dexkit.conformance.usb.frames import Motor
from dexkit.conformance.usb.record import UsbPhase


@stimulus("quiet probe exchange pair", UsbScript)
def exchange_frames(script: UsbScript) -> UsbSteps:
    """No command; 20 commands to lock, at 100 Hz; a burst; then two at once."""
    script.report("exchanging frames without motion")
    yield from script.count_silent_frames(0.1)  # reads what another program has left unread
    phase = script.begin("quiet")
    yield from script.count_silent_frames(0.15)
    script.end(phase)
    yield from _probe(script)

    frame = script.frame(Motor())
    phase = script.begin("exchange", status=0, size=script.size)
    yield from script.send_for(20 * script.plan.period, frame)
    yield from script.count_silent_frames(0.05)
    script.end(phase)

    yield from exchange_burst(script)
    phase = script.begin("pair")
    for _ in range(2):
        yield from script.do(Out(frame))
    phase.params["answers"] = yield from script.count_silent_frames(0.1)
    script.end(phase)
    yield from script.exchange(frame)


def _probe(script: UsbScript) -> UsbSteps:
    """Find the size of command frame that the hand answers."""
    for size in (1234, 734):
        script.size = size
        phase = script.begin("probe", size=size)
        yield from script.do(Out(script.frame(Motor())))
        seen = yield from script.do(In())
        script.end(phase)
        if not seen.status:
            return
    script.size = 1234


@stimulus("burst", UsbScript, after="lock", before="malformed")
@stimulus("burst", UsbScript, after="clear", before="reopen")
def exchange_burst(script: UsbScript) -> UsbSteps:
    """Commands to lock as fast as they are answered; three times, at different moments."""
    frame = script.frame(Motor())
    yield from script.do(Alone(True))
    phase = script.begin("burst", status=0)
    for _ in range(script.plan.burst):
        yield from script.exchange(frame)
    script.end(phase)
    yield from script.do(Alone(False))


@stimulus("reopen", UsbScript, after="clear")
def reopen(script: UsbScript) -> UsbSteps:
    """The interface is released and claimed again; the hand holds."""
    script.report("releasing the interface and claiming it again")
    hold = script.frame(script.hold_commands())
    yield from script.exchange(hold)
    phase = script.begin("reopen")
    yield from script.do(Reopen())
    for _ in range(5):
        yield from script.exchange(hold)
        yield from script.wait_for_tick()
    script.end(phase)


@check("DEX3USB-XCHG-01")
def _answered(c: UsbContext) -> Outcome:
    exchanges = list(ordinary(c))
    silent = [x for x in exchanges if x.answer is None]
    figure = f"{len(exchanges) - len(silent)} of {len(exchanges)}"
    if not silent:
        return c.passed(figure)
    places = [c.at(x.t, inward=False) for x in silent]
    return c.failed(figure, f"{len(silent)} of {len(exchanges)} commands got no answer", *places)


@check("DEX3USB-XCHG-02")
def _one_answer(c: UsbContext) -> Outcome:
    return all_of(_once(c), _unasked(c))


def _once(c: UsbContext) -> Outcome:
    (phase,) = c.phases()
    sent = sum(not t.inward for t in c.hand.during(phase))
    answers = c.hand.answers_in(phase)
    figure = f"{len(answers)} to {sent}"
    if len(answers) <= sent:
        return c.passed(figure)
    observed = f"{len(answers)} frames came to {sent} commands"
    return c.failed(figure, observed, *(c.at(a.t) for a in answers[sent:]))


def _unasked(c: UsbContext) -> Outcome:
    (phase,) = c.hand.phases("quiet")
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
def _fast(c: UsbContext) -> Outcome:
    return all_of(_rate(c), _latency(c))


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
    return quiet_motors(c, [phase], lambda p: "when the interface was claimed again")
