"""Emulated FTDI adapters on the guest's USB: ftdi_sio, its latency timer, and who is behind it."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

import serial

from dexkit.dds import DdsNode
from dexkit.drivers.serial_port import latency_timer, latency_warning
from dexkit.hand import Side
from tools.lab.guest.adapters import Adapters
from tools.lab.guest.bench import (
    Bench,
    Failed,
    Serve,
    Unprivileged,
    dexkit,
    kernel_log,
    rule,
    use,
    wait_for,
)
from tools.lab.guest.client import DOMAIN, Client
from tools.lab.guest.faults import Subject, table
from tools.lab.guest.power import freeze_processes
from tools.lab.guest.probe import ping

__all__ = ["run_serial"]

_DIALOUT = 20  # Debian's
_USBDEVFS_RESET = 0x5514
_CYCLES = 5
_FROZEN = 3  # seconds
_SERVED = 4
"""Milliseconds of the timer under a service: at 1 ms the adapter sends a thousand packets a second,
with or without data, which alone keep an emulated processor busy."""
_RULE = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
_PROBES = (b"AT\r\n", b"ATI\r\n", b"\x00\x78\xf0\x7e", b"~\x00x\xf0~")
_READ = 21  # bytes: present current to present temperature


def run_serial(bench: Bench) -> None:
    """All cases of the serial devices."""
    lab = _Lines(bench)
    if not bench.case("adapter", "ftdi_sio makes /dev/ttyUSB0 of the emulated FT232R", lab.plug_in):
        return
    for group, name, do in (
        ("adapter", "an ordinary user who is not in the group dialout", lab.denied),
        ("doctor", "dexkit doctor finds the 16 ms and says the cure", lab.doctor),
        ("adapter", "the udev rule that dexkit's warning names", lab.rule),
        ("adapter", "probe bytes of modem software at plug-in", lab.probes),
        ("ezgripper", "dexkit calibrate ezgripper", lab.calibrate),
    ):
        bench.case(group, name, do)
    for kind in ("ezgripper", "dex1-serial"):
        if not bench.case(kind, f"dexkit serve {kind}", lambda k=kind: lab.serve(k)):  # type: ignore[misc]
            continue
        for name, do in (
            ("a second process on the port", lab.second_process),
            ("USB reset", lab.reset),
            ("driver unbound while moving", lab.unbound),
            ("all processes frozen while moving, as for suspending", lab.frozen),
            (f"unplugged while moving, {_CYCLES} times", lab.unplugged),
        ):
            bench.case(f"{kind} faults", name, do)
        lab.end()
    lab.close()


class _Lines:
    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.adapters = Adapters(bench)
        self.service: Serve | None = None
        self.node: DdsNode | None = None
        self.subject: Subject | None = None
        self.device = "mx64"

    def plug_in(self) -> str:
        started = time.monotonic()
        path = self.adapters.plug("mx64")
        took = time.monotonic() - started
        if path != "/dev/ttyUSB0":
            raise Failed(path)
        found = kernel_log("ttyUSB0|Detected FT|ftdi_sio 1")[-3:]
        return f"{took:.2f} s; timer {latency_timer(path)} ms; " + "; ".join(
            line.split("] ", 1)[-1] for line in found
        )

    def denied(self) -> str:
        path = self.adapters.path("mx64")
        wait_for(lambda: os.stat(path).st_gid == _DIALOUT, "udev does not set the group")
        said = use("mx64", path, user=Unprivileged)
        if "no permission" not in said or "dialout" not in said:
            raise Failed(said)
        granted = use("mx64", path, user=Unprivileged, groups=[_DIALOUT])
        if "model" not in granted:
            raise Failed(granted)
        return f"{said}. In the group: {granted}"

    def doctor(self) -> str:
        done = _doctor(self.adapters.path("mx64"))
        line = next((text for text in done.splitlines() if "latency timer of" in text), "")
        cure = "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
        if "16 ms" not in line or cure not in done:
            raise Failed(done[-800:])
        return f"{line.strip()}; cure: {cure}"

    def rule(self) -> str:
        if "ATTR{latency_timer}" not in latency_warning(self.adapters.path("mx64")):
            self.adapters.set_timer("mx64", 16)
        named = latency_warning(self.adapters.path("mx64"))
        if _RULE not in named:
            raise Failed(f"the warning names another rule: {named}")
        with rule(_RULE + "\n"):
            path = self.adapters.replug("mx64")
            wait_for(lambda: latency_timer(path) == 1, "udev does not set the timer")
        return f"after plugging in: timer 1 ms, by {_RULE}"

    def probes(self) -> str:
        ask = self.bench.ask
        before = ask(do="now", device="mx64")
        path = self.adapters.replug("mx64")
        for rate in (9600, 115200, 1_000_000):
            with serial.Serial(path, rate, timeout=0.02) as port:
                for probe in _PROBES:
                    port.write(probe)
                    port.read(64)
                port.send_break(0.01)
        after = ask(do="since", device="mx64", t=before["t"])
        said = ping(path)
        moved = after["high"][0] - after["low"][0]
        if moved > 0.1 or after["setpoints"]:
            raise Failed(f"it moved by {moved:.2f} %, {after['setpoints']} set-points")
        return f"{len(_PROBES)} probes and a break at 3 rates: nothing moved; then {said}"

    # --- the services

    def calibrate(self) -> str:
        path = self.adapters.path("mx64")
        code, said = dexkit("calibrate", "ezgripper", "--device", path, "--yes")
        if code:
            raise Failed(f"code {code}: {said[-600:]}")
        return " / ".join(said.strip().splitlines()[-3:])

    def serve(self, kind: str) -> str:
        self.device = "mx64" if kind == "ezgripper" else "dex1"
        if not self.adapters.path(self.device):
            self.adapters.plug(self.device)
        self.adapters.set_timer(self.device, _SERVED)
        # by the adapter's serial number: an adapter that comes back while its old port is still
        # open becomes another ttyUSB
        words = (
            "--side",
            "left",
            "--device",
            self.adapters.serial(self.device),
            "--domain",
            str(DOMAIN),
        )
        # the default, 20 or 30 ms, is less than the hiccups of an emulated processor
        self.service = Serve(kind, *words, "--set", "timeout=0.2")
        self.node = DdsNode(domain=DOMAIN, interface="lo")
        client = Client(self.node, "unitree_go", Side.LEFT, 5.0, 0.05)
        still, unit = (1.5, "% of the opening") if kind == "ezgripper" else (0.05, "rad")
        self.subject = Subject(
            self.bench, self.service, client, self.device, [4.5], [1.0], still, 0.3, unit
        )
        before, started = self.service.counters()[0], time.monotonic()
        took = [self.subject.move([q]) for q in (4.5, 1.0, 4.5)]
        states = client.rate(3.0)
        after = self.service.counters()[0]
        seconds = time.monotonic() - started
        done = {
            name: after["hands"]["left"][name] - before["hands"]["left"][name]
            for name in ("exchanges", "exchange_errors")
        }
        return (
            f"timer {_SERVED} ms: {done['exchanges'] / seconds:.0f} exchanges/s, "
            f"{done['exchange_errors']} errors; state {states:.0f} Hz at the "
            f"client; strokes of 3.5 rad in {', '.join(f'{t:.1f}' for t in took)} s; "
            f"ready after {self.service.start_time:.1f} s"
        )

    def _the_subject(self) -> Subject:
        if self.subject is None:
            raise Failed("it is not served")
        return self.subject

    def _obeys(self) -> str:
        return f"obeys afterwards ({self._the_subject().move([3.0]):.1f} s)"

    def second_process(self) -> str:
        path = self.adapters.path(self.device)
        said = use("mx64", path)
        if "another program is using" not in said:
            raise Failed(said)
        return f"{said}; " + self._obeys()

    def reset(self) -> str:
        subject = self._the_subject()
        folder = self.adapters.interface(self.device).parent
        numbers = [int((folder / name).read_text()) for name in ("busnum", "devnum")]
        node = f"/dev/bus/usb/{numbers[0]:03}/{numbers[1]:03}"

        def strike() -> None:
            fd = os.open(node, os.O_WRONLY)
            try:
                fcntl.ioctl(fd, _USBDEVFS_RESET)
            finally:
                os.close(fd)

        # ftdi_sio has no reset handlers: the kernel unbinds and binds it again
        outcome = subject.strike(strike)
        return f"{table([outcome])}; " + self._obeys()

    def unbound(self) -> str:
        interface = self.adapters.interface(self.device).name
        driver = Path("/sys/bus/usb/drivers/ftdi_sio")
        outcome = self._the_subject().strike(
            lambda: (driver / "unbind").write_text(interface),
            lambda: (driver / "bind").write_text(interface),
        )
        return f"{table([outcome])}; " + self._obeys()

    def unplugged(self) -> str:
        subject = self._the_subject()
        outcomes = [
            subject.strike(
                lambda: self.adapters.unplug(self.device), lambda: self.adapters.plug(self.device)
            )
            for _ in range(_CYCLES)
        ]
        return f"{table(outcomes)}; " + self._obeys()

    def frozen(self) -> str:
        took: list[float] = []
        outcome = self._the_subject().strike(
            lambda: took.append(freeze_processes(_FROZEN)), survived=True
        )
        return f"frozen for {took[0]:.1f} s; {table([outcome])}; " + self._obeys()

    def end(self) -> None:
        if self.subject is not None:
            self.subject.client.close()
            self.subject = None
        if self.node is not None:
            self.node.close()
            self.node = None
        if self.service is not None:
            self.service.end()
            self.service = None

    def close(self) -> None:
        self.end()
        self.adapters.close()


def _doctor(path: str) -> str:
    # its exit code says that it has found something
    words = ("doctor", "--scan", "none", "--domain", "1", "--seconds", "0.5", "--device", path)
    return dexkit(*words)[1]
