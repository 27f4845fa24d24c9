"""Unplugging and restarting emulated devices under a service, while a client moves the hand.

Driver and device run in one process on a real pseudo-terminal or over USB/IP, without DDS, so
that a hundred of them cost a minute of one core. The emulated device is the witness: its own
position shows whether the hand moved without a command.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import Server
from dexkit.drivers.ezgripper.gripper import EZGripper, GripperSettings
from dexkit.emulators.dex3_mcu import emulated_dex3
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.emulators.mx64 import emulated_ezgripper
from dexkit.hand import Side
from dexkit.messages import encode, unitree_go, unitree_hg
from dexkit.models import dialect
from dexkit.service import HandService
from dexkit.service.hand_core import HandCore
from tools.campaign.case import Batch, Case, Lane
from tools.campaign.rig import LocalNode, WaitTimeout, open_files, until

__all__ = ["Bench", "bench_of", "cases"]

SIDE = Side.LEFT
_PAUSES = (0.02, 0.06, 0.15, 0.4, 0.9)
"""Seconds that a device is away."""
_WATCHED = 0.4
"""Seconds after the return in which nothing may move."""


class Bench:
    """A device with a driver that can be asked for.

    :ivar low: and ``high``: goals within the hand's range, in the dialect's radians.
    :ivar still: what counts as not moved, in units of :meth:`position`.
    :ivar coast: how far it may run on after it was found again, in the same units.
    """

    dialect_name = "unitree_go"
    low, high = 1.0, 4.0
    still = 0.05
    coast = 0.0

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The emulated device, powered."""
        raise NotImplementedError

    def hand(self) -> Any:
        """A driver for it."""
        raise NotImplementedError

    def position(self, device: Any) -> float:
        """Where the device itself is."""
        raise NotImplementedError

    def unplug(self, device: Any, seconds: float) -> None:
        """Pull the cable, and put it back."""
        device.inject(f"unplug:for={seconds * 1000:.0f}ms")

    def message(self, q: float) -> bytes:
        """A command."""
        motor = unitree_go.MotorCmd_(q=q, kp=5.0, kd=0.05)
        return encode(unitree_go.MotorCmds_([motor]))


class _Mx64(Bench):
    still = 0.02 * 2520  # ticks: 2 % of the stroke
    # The driver switches the torque off when it opens the servo again; the fingers run on for some
    # 0.2 s. A command from before would take them through the other half of the stroke.
    coast = 0.08 * 2520

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        with emulated_ezgripper(
            link=self.scratch / "mx64", closed_at=1510, latency_timer=0.0, check_baudrate=False
        ) as gripper:
            yield gripper

    def hand(self) -> Any:
        settings = GripperSettings(zero=1510, config=self.scratch / "ezgripper.json")
        return EZGripper(str(self.scratch / "mx64"), SIDE, settings)

    def position(self, device: Any) -> float:
        return float(device.servo.drive.encoder)


class _M4010(Bench):
    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        with Dex1Motors((SIDE,), links={SIDE: self.scratch / "m4010"}) as motors:
            yield motors

    def hand(self) -> Any:
        return Dex1Serial(SIDE, Dex1Settings(device=str(self.scratch / "m4010"), timeout=0.1))

    def position(self, device: Any) -> float:
        return float(device.motors[SIDE].q)


class _Dex3(Bench):
    dialect_name = "dex3"
    low, high = 0.2, 0.8
    still = 0.05

    def __init__(self, scratch: Path) -> None:
        super().__init__(scratch)
        self._port = 0

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        with emulated_dex3(port=self._port) as hands:
            self._port = hands.port
            yield hands

    def hand(self) -> Any:
        return Dex3Usb(SIDE, Dex3Settings(server=Server("127.0.0.1", self._port)))

    def position(self, device: Any) -> float:
        return float(np.abs(device.device(SIDE).mechanics.q).sum())

    def message(self, q: float) -> bytes:
        from dexkit.models import DEX3_1

        motors = []
        for number, joint in enumerate(DEX3_1.joints[SIDE]):
            goal = joint.q_min + q * joint.stroke
            mode = number | 1 << 4
            motors.append(unitree_hg.MotorCmd_(mode=mode, q=goal, kp=1.5, kd=0.2))
        return encode(unitree_hg.HandCmd_(motor_cmd=motors))


class _Dex5(Bench):
    """Without a device: only the commands of a client."""

    dialect_name = "dex5"
    low, high = 0.2, 0.8

    def message(self, q: float) -> bytes:
        from dexkit.models import DEX5_1

        motors = [
            unitree_hg.MotorCmd_(mode=1, q=joint.q_min + q * joint.stroke, kp=1.5, kd=0.2)
            for joint in DEX5_1.joints[SIDE]
        ]
        return encode(unitree_hg.HandCmd_(motor_cmd=motors))


_BENCHES: dict[str, type[Bench]] = {"mx64": _Mx64, "m4010": _M4010, "dex3": _Dex3, "dex5": _Dex5}


def bench_of(name: str) -> type[Bench]:
    """What knows the device called ``name``."""
    return _BENCHES[name]


class DeviceCase(Case):
    """A device that goes away and comes back, by its cable or by its power.

    :param bench: which.
    :param restart: take its power and give it back, instead of its cable.
    """

    lane = Lane.LIVE
    limit = 400.0

    def __init__(self, name: str, bench: type[Bench], *, restart: bool, aim: int) -> None:
        self.unit = "restarts" if restart else "unplugs"  # type: ignore[misc]
        what = "started again" if restart else "unplugged and put back"
        self.name = f"{'restart' if restart else 'unplug'}:{name}"
        self.what = f"the emulated {name}, {what} in motion"
        self.aim = aim
        self._bench, self._restart = bench, restart

    def run(self, batch: Batch) -> None:
        logging.disable()
        bench = self._bench(batch.scratch)
        files, threads = 0, 0
        for turn in range(2):  # what the first one loads stays
            files, threads = open_files(), threading.active_count()
            count = 1 if batch.sample else (2 if turn == 0 else 10)
            try:
                self._rounds(batch, bench, count)
            except WaitTimeout as error:
                batch.found("not recovered", self.name, str(error))
                return
            if batch.sample:
                return
        with contextlib.suppress(WaitTimeout):
            until(lambda: open_files() <= files, "descriptors", 5.0)
            until(lambda: threading.active_count() <= threads, "threads", 5.0)
        if (now := open_files()) > files:
            batch.found("descriptors leak", self.name, f"{files} before, {now} after 10 of them")
        if (now := threading.active_count()) > threads:
            batch.found("threads leak", self.name, str([t.name for t in threading.enumerate()]))

    def _rounds(self, batch: Batch, bench: Bench, count: int) -> None:
        node = LocalNode()
        spoken = dialect(bench.dialect_name)
        topic = spoken.topics(SIDE)[0]
        with contextlib.ExitStack() as power:
            device = power.enter_context(bench.device())
            service = HandService(bench.hand(), node=node, state_rate=100.0, soft_start=False)
            with service:
                for _ in range(count):
                    device = self._round(batch, bench, service, node, topic, device, power)
                    batch.units += 1
            if service.failure is not None:
                batch.failed(service.failure)

    def _round(
        self,
        batch: Batch,
        bench: Bench,
        service: HandService,
        node: LocalNode,
        topic: str,
        device: Any,
        power: contextlib.ExitStack,
    ) -> Any:
        """Move, take away, bring back, look on, move again; the device."""
        rng = batch.random
        core = service.cores[SIDE]
        goals = [bench.low, bench.high]
        rng.shuffle(goals)
        start = bench.position(device)
        self._drive(
            bench, node, topic, goals[0], lambda: abs(bench.position(device) - start) > bench.still
        )
        time.sleep(rng.uniform(0.0, 0.2))
        # the client goes on for some time after the device went, or stops before it
        after = rng.choice((0.0, 0.0, 0.05, 0.3))
        seconds = rng.choice(_PAUSES)
        opened = core.counters.reconnects
        if self._restart:
            power.close()
            last = self._send_for(bench, node, topic, goals[0], after, core, opened)
            time.sleep(seconds)
            device = power.enter_context(bench.device())
        else:
            bench.unplug(device, seconds)
            last = self._send_for(bench, node, topic, goals[0], after, core, opened)
        until(lambda: core.counters.reconnects > opened, "the reconnection")
        # a command that may have come after the reconnection is one that counts
        asked = time.monotonic() - last < 0.1
        # what the driver does when it opens (a brake) is done after a few exchanges
        done = core.counters.exchanges
        until(lambda: core.counters.exchanges > done + 3 and core.connected, "exchanges")
        before = bench.position(device)
        time.sleep(_WATCHED)
        moved = abs(bench.position(device) - before)
        if moved > bench.still + bench.coast and not asked:
            batch.found(
                "moved unasked",
                self.name,
                f"by {moved:.3f} after it was away for {seconds} s; the client stopped {after} s "
                f"after it went",
            )
        here = bench.position(device)
        self._drive(
            bench, node, topic, goals[1], lambda: abs(bench.position(device) - here) > bench.still
        )
        return device

    @staticmethod
    def _send_for(
        bench: Bench,
        node: LocalNode,
        topic: str,
        goal: float,
        seconds: float,
        core: HandCore,
        opened: int,
    ) -> float:
        """Go on commanding until the device is back; when the last command went out."""
        last = 0.0
        end = time.monotonic() + seconds
        while time.monotonic() < end and core.counters.reconnects == opened:
            last = time.monotonic()
            node.send(topic, bench.message(goal))
            time.sleep(0.005)
        return last

    @staticmethod
    def _drive(
        bench: Bench, node: LocalNode, topic: str, goal: float, moved: Callable[[], bool]
    ) -> None:
        """Command until the device has moved; it may be at the goal already, then the other way."""
        message, began, other = bench.message(goal), time.monotonic(), False

        def step() -> bool:
            nonlocal message, other
            if not other and time.monotonic() - began > 3.0:
                message, other = bench.message(bench.low + bench.high - goal), True
            node.send(topic, message)
            return moved()

        until(step, "the hand to obey a fresh command")


def cases() -> list[Case]:
    """Every device, unplugged and restarted."""
    found: list[Case] = []
    for name in ("mx64", "m4010", "dex3"):
        bench = bench_of(name)
        found.append(DeviceCase(name, bench, restart=False, aim=270))
        found.append(DeviceCase(name, bench, restart=True, aim=70))
    return found
