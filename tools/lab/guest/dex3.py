"""Both Dex3-1 hands on the guest's USB: libusb, the driver, the service, and a kernel's faults."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

from dexkit.dds import DdsNode
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.hand import HandCommand, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import HandCodec
from tools.lab.guest.bench import (
    Bench,
    Failed,
    Serve,
    Unprivileged,
    attach,
    detach,
    kernel_log,
    pin_of,
    rule,
    run,
    use,
    wait_for,
)
from tools.lab.guest.client import DOMAIN, Client
from tools.lab.guest.faults import Subject, table
from tools.lab.guest.power import autosuspend, freeze_processes, runtime_status, suspend_refused
from tools.lab.guest.stops import run_stops

__all__ = ["run_dex3"]

_BUSID = {Side.LEFT: "1-1", Side.RIGHT: "1-2"}
_STAND_IN = "1-3"  # an adapter that nothing else uses
_EXCHANGES = 100
_CYCLES = 20
_FROZEN = 3  # seconds
_STILL = 0.02  # rad
_USBDEVFS_RESET = 0x5514
_RULE = 'SUBSYSTEM=="usb", ATTR{idVendor}=="34b7", MODE="0660", GROUP="plugdev"\n'
_PLUGDEV = 46  # Debian's


def run_dex3(bench: Bench) -> None:
    """All cases of the Dex3-1."""
    lab = _Dex3(bench)
    for name, do in (
        ("the kernel enumerates both hands", lab.enumerate),
        ("PyUSB through libusb, as in docs/dex3-protocol.md", lab.pyusb),
        ("the driver through libusb, back to back", lab.driver),
        ("a C program on libusb (tools/lab/exchange.c)", lab.c_program),
        ("an ordinary user without the udev rule", lab.denied),
        ("an ordinary user with the udev rule", lab.permitted),
        ("USB autosuspend", lab.autosuspend),
    ):
        if do == lab.c_program and not bench.words.get("program"):
            bench.skip("dex3", name, "it was not compiled: see what make lab printed")
        elif not bench.case("dex3", name, do) and do == lab.enumerate:
            return
    run_stops(bench, lambda: detach(lab.places[Side.LEFT]), lambda: lab.plug(Side.LEFT))
    if not bench.case("dex3", "dexkit serve dex3-usb, both hands", lab.serve):
        return
    try:
        for name, do in (
            ("a second process on the hand", lab.second_process),
            ("USB reset while moving", lab.reset),
            ("driver unbound while moving", lab.unbound),
            ("suspending the computer while moving", lab.suspend),
            ("all processes frozen while moving, as for suspending", lab.frozen),
            (f"unplugged while moving, {_CYCLES} times, same and other port", lab.unplugged),
        ):
            bench.case("dex3 faults", name, do)
    finally:
        lab.close()


def _target(side: Side, part: float) -> list[float]:
    """A pose: each joint at ``part`` of the way between its limits' middle and its end."""
    found = []
    for joint in DEX3_1.joints[side]:
        middle = (joint.q_min + joint.q_max) / 2
        found.append(middle + part * (joint.q_max - joint.q_min) / 2)
    return found


class _Dex3:
    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.places: dict[Side, int] = {}
        self.service: Serve | None = None
        self.node: DdsNode | None = None
        self.clients: dict[Side, Client] = {}
        self._left: Subject | None = None

    def node_path(self, side: Side) -> str:
        folder = pin_of(_BUSID[side])
        if folder is None:
            raise Failed(f"the {side} hand is not attached")
        numbers = [int((folder / name).read_text()) for name in ("busnum", "devnum")]
        return f"/dev/bus/usb/{numbers[0]:03}/{numbers[1]:03}"

    def plug(self, side: Side) -> None:
        self.places[side] = attach(self.bench.words["hands"], _BUSID[side])
        wait_for(lambda: pin_of(_BUSID[side]), f"the kernel does not enumerate the {side} hand")

    def enumerate(self) -> str:
        started = time.monotonic()
        found = []
        for side in Side:
            self.plug(side)
            folder = pin_of(_BUSID[side])
            assert folder is not None
            words = ("idVendor", "idProduct", "manufacturer", "product", "serial", "speed")
            found.append(" ".join((folder / word).read_text().strip() for word in words))
        expected = "34b7 1010 UnitreeTC Dexthree LeftHand 2024061800 480"
        if found[0] != expected:
            raise Failed(f"{found[0]}, not {expected}")
        took = time.monotonic() - started
        return (
            "; ".join(found)
            + f" Mbit/s; {took:.2f} s for both; "
            + "; ".join(
                line.split("] ", 1)[1] for line in kernel_log("New USB device found, idVendor=34b7")
            )
        )

    def pyusb(self) -> str:
        import usb.core
        import usb.util

        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        device = usb.core.find(idVendor=0x34B7, idProduct=0x1010)
        if device is None:
            raise Failed("libusb finds no 34b7:1010")
        device.set_configuration()
        out, into = sorted(
            device.get_active_configuration()[0, 0], key=lambda e: e.bEndpointAddress
        )
        frame = codec.encode(HandCommand.brake(7), timeout=True)
        times = []
        for _ in range(_EXCHANGES):
            started = time.monotonic()
            out.write(frame)
            answer = into.read(2048, timeout=1000)
            times.append(time.monotonic() - started)
            if len(answer) != 1270:
                raise Failed(f"an answer of {len(answer)} bytes")
        state = codec.decode(bytes(answer), 0.0)
        name = f"{device.manufacturer} {device.product} {device.serial_number}"
        usb.util.dispose_resources(device)
        if codec.problems:
            raise Failed(f"{codec.problems}")
        return f"{name}: {_rate(times)}; thumb_1 at {state.q[1]:.3f} rad"

    def c_program(self) -> str:
        frame = Path("/tmp/frame")
        frame.write_bytes(
            HandCodec(DEX3_1.joints[Side.LEFT]).encode(HandCommand.brake(7), timeout=True)
        )
        words = ("34b7", "1010", "02", "81", str(frame), str(_EXCHANGES))
        return run(self.bench.words["program"], *words).strip()

    def driver(self) -> str:
        times = []
        with Dex3Usb(Side.LEFT, Dex3Settings(local=False)) as hand:
            for _ in range(_EXCHANGES):
                started = time.monotonic()
                hand.exchange(HandCommand.brake(7))
                times.append(time.monotonic() - started)
            return f"{_rate(times)}; {hand.statistics}"

    def denied(self) -> str:
        said = use("dex3", user=Unprivileged)
        mode = oct(os.stat(self.node_path(Side.LEFT)).st_mode & 0o777)
        for word in ("HandRefused", "no permission", "udev rule"):
            if word not in said:
                raise Failed(f"it says: {said}")
        return f"node {mode}: {said}"

    def permitted(self) -> str:
        with rule(_RULE):
            for side in Side:
                detach(self.places[side])
                self.plug(side)
            node = self.node_path(Side.LEFT)
            wait_for(lambda: os.stat(node).st_gid == _PLUGDEV, "udev does not apply the rule")
            said = use("dex3", user=Unprivileged, groups=[_PLUGDEV])
        if not said.startswith("opened"):
            raise Failed(said)
        mode = oct(os.stat(node).st_mode & 0o777)
        return f"{_RULE.strip()} (of docs/dex3-usb.md, for ssh): node {mode}, {said}"

    # --- the service

    def serve(self) -> str:
        words = (
            "--side",
            "both",
            "--domain",
            str(DOMAIN),
            "--set",
            "usb=system",
            "--set",
            "guesses=accept",
        )
        self.service = Serve("dex3-usb", *words)
        self.node = DdsNode(domain=DOMAIN, interface="lo")
        for side in Side:
            self.clients[side] = Client(self.node, "dex3", side, 1.5, 0.2)
        before, started = self.service.counters(), time.monotonic()
        for side, client in self.clients.items():
            client.go(_target(side, 0.3))
        rate = self.clients[Side.LEFT].rate(5.0)
        after, took = self.service.counters(), time.monotonic() - started
        for side, client in self.clients.items():
            wait_for(
                lambda c=client, s=side: c.arrived(_target(s, 0.3), 0.15),  # type: ignore[misc]
                f"the {side} hand does not arrive",
            )
        exchanged = [
            f"{side} {(_sum(b, 'exchanges') - _sum(a, 'exchanges')) / took:.0f}/s"
            for side, a, b in zip(Side, before, after, strict=True)
        ]
        self.clients[Side.RIGHT].silent()  # the left hand has the faults
        errors = sum(_sum(b, "exchange_errors") for b in after)
        return (
            f"exchanges {', '.join(exchanged)}, {errors} errors; left state {rate:.0f} Hz at the "
            f"client; ready after {self.service.start_time:.1f} s"
        )

    def second_process(self) -> str:
        said = use("dex3")
        for word in ("HandRefused", "another program"):
            if word not in said:
                raise Failed(f"it says: {said}")
        return said + "; " + self._obeys(0.1)

    def _obeys(self, part: float) -> str:
        """Command the left hand somewhere; seconds until it is there."""
        return f"obeys afterwards ({self._subject().move(_target(Side.LEFT, part)):.1f} s)"

    def _subject(self) -> Subject:
        if self._left is None:
            service, client = self.service, self.clients[Side.LEFT]
            assert service is not None
            near, far = _target(Side.LEFT, -0.3), _target(Side.LEFT, 0.5)
            self._left = Subject(self.bench, service, client, "left", near, far)
        return self._left

    def reset(self) -> str:
        node = self.node_path(Side.LEFT)

        def strike() -> None:
            fd = os.open(node, os.O_WRONLY)
            try:
                fcntl.ioctl(fd, _USBDEVFS_RESET)
            finally:
                os.close(fd)

        client = self.clients[Side.LEFT]
        begin = self.service.mark() if self.service else 0
        client.go(_target(Side.LEFT, 0.4))
        time.sleep(0.2)
        before = self.service.counters()[0] if self.service else {}
        strike()
        wait_for(lambda: client.linked, "the hand does not come back")
        wait_for(lambda: client.arrived(_target(Side.LEFT, 0.4), 0.15), "it does not obey")
        after = self.service.counters()[0] if self.service else {}
        errors = _sum(after, "exchange_errors") - _sum(before, "exchange_errors")
        said = self.service.said(begin, r"^(WARNING|ERROR)") if self.service else ""
        return f"{errors} exchanges failed, the motion went on to its goal; {said or 'no message'}"

    def unbound(self) -> str:
        folder = pin_of(_BUSID[Side.LEFT])
        assert folder is not None
        driver = Path("/sys/bus/usb/drivers/usb")

        def strike() -> None:
            (driver / "unbind").write_text(folder.name)

        def mend() -> None:
            (driver / "bind").write_text(folder.name)

        outcome = self._subject().strike(strike, mend)
        return f"{table([outcome])}; " + self._obeys(0.1)

    def autosuspend(self) -> str:
        folder = pin_of(_BUSID[Side.LEFT])
        assert folder is not None
        with autosuspend(folder) as asleep_after:
            started = time.monotonic()
            with Dex3Usb(Side.LEFT, Dex3Settings(local=False)) as hand:
                hand.exchange(HandCommand.brake(7))
                took = time.monotonic() - started
                time.sleep(0.5)  # nothing is exchanged
                while_open = runtime_status(folder)
                hand.exchange(HandCommand.brake(7))
            if while_open != "active":
                raise Failed(f"while it is open it is {while_open}")
            again = wait_for(lambda: runtime_status(folder) == "suspended", "not suspended again")
        return (
            f"suspended {asleep_after:.2f} s after it is allowed; the driver wakes it, first "
            f"answer after {took:.2f} s; while it is open it stays active; suspended again "
            f"{again:.2f} s after it is closed"
        )

    def suspend(self) -> str:
        said: list[str] = []

        def strike() -> None:
            said.extend(suspend_refused(state) for state in ("freeze", "mem"))

        outcome = self._subject().strike(strike, survived=True)
        return f"{'; '.join(said)}; {table([outcome])}; " + self._obeys(0.1)

    def frozen(self) -> str:
        took: list[float] = []
        outcome = self._subject().strike(
            lambda: took.append(freeze_processes(_FROZEN)), survived=True
        )
        return f"frozen for {took[0]:.1f} s; {table([outcome])}; " + self._obeys(0.1)

    def unplugged(self) -> str:
        subject, outcomes = self._subject(), []
        stand_in: int | None = None
        used: set[int] = set()
        for cycle in range(_CYCLES):

            def mend(cycle: int = cycle) -> None:
                nonlocal stand_in
                if stand_in is not None:
                    detach(stand_in)
                    stand_in = None
                elif cycle % 2:
                    # something else takes the port first
                    stand_in = attach(self.bench.words["adapters"], _STAND_IN)
                self.plug(Side.LEFT)
                used.add(self.places[Side.LEFT])

            outcomes.append(subject.strike(lambda: detach(self.places[Side.LEFT]), mend))
        if stand_in is not None:
            detach(stand_in)
        return f"{len(outcomes)} times, ports {sorted(used)}; {table(outcomes)}; " + self._obeys(
            0.1
        )

    def close(self) -> None:
        for client in self.clients.values():
            client.close()
        if self.node is not None:
            self.node.close()
        if self.service is not None:
            self.service.end()
        for place in self.places.values():
            detach(place)


def _sum(counters: dict[str, object], name: str) -> int:
    """A counter of all hands in a snapshot, wherever it is."""
    total = 0
    for key, value in counters.items():
        if key == name and isinstance(value, int):
            total += value
        elif isinstance(value, dict):
            total += _sum(value, name)
    return total


def _rate(times: list[float]) -> str:
    ordered = sorted(times)
    middle, late = ordered[len(ordered) // 2] * 1e3, ordered[len(ordered) * 99 // 100] * 1e3
    return f"{len(times) / sum(times):.0f} exchanges/s, p50 {middle:.2f} ms, p99 {late:.2f} ms"
