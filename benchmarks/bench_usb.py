"""Measure exchanges a second with a Dex3-1 on USB, and their processor time.

The hand is emulated in a process of its own and reached by USB/IP on this machine's loopback:
what is measured is the driver, the USB/IP client, TCP and the emulator, not a USB wire. Compared
with a raw device in another process that sends frames of the same sizes back without looking
into them, driven

- by PyUSB's own ``Device.write`` and ``Device.read`` on the USB/IP client as it comes, which is
  how one would begin;
- by the driver's own link, which leaves what the hand's two ends cost.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import usb.core
from usbip.device import In, Out, USBDevice
from usbip.function import Interface
from usbip_backend.backend import get_backend

from benchmarks import Result
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import Server, parse_server
from dexkit.drivers.dex3_usb.link import UsbLink
from dexkit.emulators.dex3_mcu import Server as UsbIpServer
from dexkit.emulators.dex3_mcu import emulated_dex3
from dexkit.hand import HandCommand, Side
from dexkit.usbip import UsbIpBackend
from dexkit.wire.dex3_usb import COMMAND_1234, PRODUCT_ID, STATE, VENDOR_ID

_SECONDS = 3.0
_RATE = 1000.0
_OUT, _IN = 0x02, 0x81


@dataclass
class _Figures:
    rate: float
    p50: float
    p99: float
    cpu: float  # seconds of this thread an exchange


def _measure(exchange: Callable[[], object], rate: float | None = None) -> _Figures:
    """As fast as it goes, or at ``rate``; the times are those of single exchanges."""
    for _ in range(100):
        exchange()
    times = []
    used = time.thread_time()
    start = time.perf_counter()
    while (begin := time.perf_counter()) - start < _SECONDS:
        exchange()
        times.append(time.perf_counter() - begin)
        if rate is not None:
            pause = start + len(times) / rate - time.perf_counter()
            if pause > 0:
                time.sleep(pause)
    elapsed = time.perf_counter() - start
    cuts = statistics.quantiles(times, n=100)
    return _Figures(
        len(times) / elapsed, cuts[49], cuts[98], (time.thread_time() - used) / len(times)
    )


# --- the peer


class _Pipes(Interface):  # type: ignore[misc]
    out = Out(_OUT, "bulk", mps=512)
    into = In(_IN, "bulk", mps=512)

    def on_out(self, endpoint: object, data: bytes) -> None:
        self.into.write(data.ljust(STATE.size, b"\0"))


class _Echo:
    plugged = True

    def __init__(self) -> None:
        self.device = USBDevice(VENDOR_ID, PRODUCT_ID[Side.LEFT], serial="echo")
        self.device.set_speed(2)
        self.device.add(_Pipes())

    def advance(self) -> float | None:
        return None

    def attached(self) -> None:
        self.device.reset_io()


def _serve_echo() -> None:
    with UsbIpServer([_Echo()], port=0) as server:
        print(server.url, flush=True)
        server.start()
        sys.stdin.read()


@contextmanager
def _echo() -> Iterator[Server]:
    code = "from benchmarks.bench_usb import _serve_echo; _serve_echo()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        yield parse_server(process.stdout.readline().strip())[0]
        process.stdin.close()


def _pyusb(server: Server) -> _Figures:
    device = usb.core.find(idVendor=VENDOR_ID, backend=get_backend(server.host, server.port))
    assert device is not None
    device.set_configuration()
    frame = bytes(COMMAND_1234.size)

    def exchange() -> None:
        device.write(_OUT, frame, 100)
        assert len(device.read(_IN, 2048, 100)) == STATE.size

    try:
        return _measure(exchange)
    finally:
        for connection in device.backend._conns.values():  # it has no other way to hang up
            connection.close()


def _link(server: Server) -> _Figures:
    usbip = UsbIpBackend(server.host, server.port)
    (device,) = usbip.enumerate_devices()
    link = UsbLink(usbip, device, "the echo")
    frame = bytes(COMMAND_1234.size)
    try:
        return _measure(lambda: link.exchange(frame, 0.1, 0.1))
    finally:
        link.close()


def run() -> list[Result]:
    """Measure; about 14 seconds."""
    command = HandCommand.position(np.full(7, 0.1), kp=1.5, kd=0.2)
    with emulated_dex3(process=True) as emulated:
        server = parse_server(emulated.url)[0]
        with Dex3Usb(Side.LEFT, Dex3Settings(server=server)) as hand:
            fast = _measure(lambda: hand.exchange(command))
            paced = _measure(lambda: hand.exchange(command), _RATE)
            link = hand.statistics.link
            lost = f"{link.timeouts} time-outs in {link.exchanges} exchanges"
    with _echo() as server:
        naive = _pyusb(server)
    with _echo() as server:
        bare = _link(server)
    return [
        Result(
            name="exchanges with an emulated Dex3-1",
            value=fast.rate,
            unit="1/s",
            peer="raw echo device, PyUSB's Device",
            peer_value=naive.rate,
            ratio=fast.rate / naive.rate,
            target="at least 1000 a second",
            met=fast.rate >= _RATE,
            note=f"p50 {fast.p50 * 1e6:.0f} us, p99 {fast.p99 * 1e6:.0f} us; the echo's p99 "
            f"{naive.p99 * 1e6:.0f} us; {lost}",
        ),
        Result(
            name="exchanges with an emulated Dex3-1",
            value=fast.rate,
            unit="1/s",
            peer="raw echo device, the driver's link",
            peer_value=bare.rate,
            ratio=fast.rate / bare.rate,
            note="the rest is frames made and taken apart at both ends, and the hand's mechanics",
        ),
        Result(
            name="p99 of an exchange at 1000 a second",
            value=paced.p99 * 1e6,
            unit="us",
            peer="limit",
            peer_value=2000.0,
            ratio=2e-3 / paced.p99,
            target="below 2000 us, 1000 a second sustained",
            met=paced.p99 < 2e-3 and paced.rate > 0.99 * _RATE,
            note=f"p50 {paced.p50 * 1e6:.0f} us; {paced.rate:.1f} a second were done",
        ),
        Result(
            name="processor time of an exchange",
            value=fast.cpu * 1e6,
            unit="us",
            peer="raw echo device, PyUSB's Device",
            peer_value=naive.cpu * 1e6,
            ratio=naive.cpu / fast.cpu,
            note=f"of which the link {bare.cpu * 1e6:.0f} us; the peer makes and checks no frames",
        ),
    ]
