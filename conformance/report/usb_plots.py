"""Draw the plots of results about a hand's USB device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from markupsafe import Markup

from dexkit.conformance.kit.plots import PlotKind
from dexkit.conformance.kit.results import Result
from dexkit.conformance.report.charts import Band, Chart, Level, Line, histogram
from dexkit.conformance.report.labels import whose
from dexkit.conformance.report.pages import fill
from dexkit.conformance.usb.recording import UsbRecording, UsbSide

__all__ = ["usb_plots"]

_HEAD = 96  # bytes of a long transfer
_TAIL = 16  # with the CRC of a frame


def usb_plots(result: Result, usb: UsbRecording) -> list[Markup]:
    """The plots that the result names, as HTML; plots without data are left out."""
    hand = next((h for s, h in usb.sides.items() if str(s) == result.side), None)
    kinds = [plot.kind for plot in result.plots if plot.kind in _DRAWN]
    return [Markup(shown) for kind in kinds if hand for shown in _DRAWN[kind](result, hand)]


def _descriptors(_: Result, hand: UsbSide) -> Iterator[Markup]:
    device = hand.device
    endpoints = [
        f"{e.address:#04x} {'bulk' if e.bulk else 'not bulk'} {e.size} bytes"
        for e in device.endpoints
    ]
    rows = [
        ("idVendor:idProduct", f"{device.vendor:04X}:{device.product:04X}"),
        ("bcdDevice", f"{device.release >> 8:x}.{device.release & 0xFF:02x}"),
        ("strings", f"{device.manufacturer!r}, {device.name!r}, serial {device.serial!r}"),
        ("endpoints of interface 0", ", ".join(endpoints) or "none"),
    ]
    caption = f"{whose(hand.side)}: descriptors of the device"
    yield Markup(fill("seen.html", caption=caption, heads=("", ""), rows=rows))


def _bytes_at(result: Result, hand: UsbSide) -> Iterator[Markup]:
    """The beginning of the transfer at the first place, if that has no end."""
    if not result.evidence or result.evidence[0].end_s is not None:
        return
    place = result.evidence[0]
    inward = place.topic.endswith("/in")
    there = [t for t in hand.transfers if t.inward is inward]
    if not there:
        return
    times = [t.done_ns if inward else t.submitted_ns for t in there]
    wanted = hand.origin_ns + round(place.time_s * 1e9)
    transfer = there[min(range(len(times)), key=lambda i: abs(times[i] - wanted))]
    data = transfer.data
    if len(data) <= _HEAD + _TAIL:
        rows = [_hex(data, at) for at in range(0, len(data), 8)]
    else:
        last = (len(data) - 9) // 8 * 8
        rows = [_hex(data, at) for at in range(0, _HEAD, 8)]
        rows += [f"... {len(data)} bytes in all", _hex(data, last), _hex(data, last + 8)]
    way = "from the hand" if inward else "to the hand"
    caption = f"transfer {way} at {hand.seconds(transfer.done_ns):.4f} s"
    yield Markup(fill("bytes.html", rows=rows or ["no bytes"], caption=caption))


def _hex(data: bytes, at: int) -> str:
    return f"{at:04x}  {data[at : at + 8].hex(' ')}"


def _answers(result: Result, hand: UsbSide) -> Iterator[Chart]:
    """Joint positions in the answers about the first place, if that has an end."""
    if not result.evidence or result.evidence[0].end_s is None:
        return
    place = result.evidence[0]
    span = (max(0.0, place.time_s - 0.3), (place.end_s or place.time_s) + 0.3)
    answers = [a for a in hand.answers if span[0] <= a.t <= span[1]]
    if len(answers) < 2:
        return
    t = np.array([a.t for a in answers])
    q = np.array([hand.q(a) for a in answers])
    moved = np.ptp(np.where(np.isfinite(q), q, 0.0), axis=0)
    shown = result.joints or np.argsort(-moved, kind="stable")[:2].tolist()
    bands = [Band(p.name, *hand.span(p)) for p in hand.record.phases if hand.span(p)[1] > span[0]]
    marks = [Band("here", e.time_s, e.end_s or e.time_s, "alarm") for e in result.evidence]
    yield Chart(
        f"{whose(hand.side)}: joint positions in the answers",
        [
            Line(hand.joints[i].name, css, t, q[:, i])
            for i, css in zip(shown[:3], ("state", "force", "cmd"), strict=False)
        ],
        span,
        "rad",
        bands=bands + marks,
        height=170,
    )


def _latency(result: Result, hand: UsbSide) -> Iterator[Chart]:
    """From each command to its answer."""
    found = [
        (x.answer.transfer.done_ns - x.command.submitted_ns) / 1e6
        for phase in hand.phases(result.requirement.phase or "")
        for x in hand.exchanges(phase)
        if x.answer is not None
    ]
    if len(found) < 10:
        return
    limits = result.requirement.tolerances
    levels = []
    if "max_s" in limits:
        levels.append(Level(1e3 * limits["max_s"], f"at most {1e3 * limits['max_s']:g} ms"))
    if "min_rate_hz" in limits:
        levels.append(Level(1e3 / limits["min_rate_hz"], f"{limits['min_rate_hz']:g} Hz"))
    title = f"{whose(hand.side)}: from command to answer"
    yield histogram(title, np.array(found), "ms", levels)


_DRAWN: Mapping[PlotKind, Callable[[Result, UsbSide], Iterator[Markup | Chart]]] = {
    PlotKind.DESCRIPTORS: _descriptors,
    PlotKind.BYTES: _bytes_at,
    PlotKind.ANSWERS: _answers,
    PlotKind.LATENCY: _latency,
}
