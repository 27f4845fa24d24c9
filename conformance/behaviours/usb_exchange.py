"""One answer for each command frame, how fast, and after the device is opened again."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.usb.context import UsbContext, ordinary, quiet_motors
from dexkit.conformance.usb.record import UsbPhase


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
