"""What the USB device says about itself."""

from __future__ import annotations

from collections import Counter

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.usb.context import UsbContext
from dexkit.hand import Side
from dexkit.wire.dex3_usb import MANUFACTURER, PRODUCT, PRODUCT_ID, VENDOR_ID

HIGH_SPEED = 3
"""As libusb numbers the speeds; 0 is one that the host does not report."""


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
def _release_and_strings(c: UsbContext) -> Outcome:
    return all_of(_release(c), _strings(c))


def _release(c: UsbContext) -> Outcome:
    release = c.hand.device.release
    figure = f"{release >> 8:x}.{release & 0xFF:02x}"
    return c.passed(figure) if release == 0x0100 else c.failed(figure, f"bcdDevice is {figure}")


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
    return c.passed(name) if speed == HIGH_SPEED else c.failed(name, f"it runs at {name} speed")


@check("DEX3USB-DESC-05")
def _endpoints(c: UsbContext) -> Outcome:
    pair = _pair(c)
    if not pair.met or c.hand.record.descriptors.speed not in (0, HIGH_SPEED):
        return pair
    return all_of(pair, warning(_packet_size(c)))


def _pair(c: UsbContext) -> Outcome:
    endpoints = c.hand.device.endpoints
    bulk = Counter(e.inward for e in endpoints if e.bulk)
    figure = ", ".join(f"{e.address:#04x} {'bulk' if e.bulk else 'not bulk'}" for e in endpoints)
    if bulk == {True: 1, False: 1}:
        return c.passed(" ".join(f"{e.address:#04x}" for e in endpoints if e.bulk), figure)
    return c.failed(f"{bulk.total()} bulk", f"interface 0 has {figure or 'no endpoints'}")


def _packet_size(c: UsbContext) -> Outcome:
    sizes = sorted({e.size for e in c.hand.device.endpoints if e.bulk})
    figure = ", ".join(map(str, sizes))
    if sizes == [c.tolerance("size")]:
        return c.passed(figure)
    return c.failed(figure, f"wMaxPacketSize is {figure}")
