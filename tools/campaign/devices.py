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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexkit.backends import backend as find_backend
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import Server
from dexkit.drivers.ezgripper.gripper import EZGripper, GripperSettings
from dexkit.emulators.dex3_mcu import emulated_dex3
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.emulators.mx64 import emulated_ezgripper
from dexkit.hand import JointMode, Side
from dexkit.models import Dialect, model
from dexkit.service import HandService
from dexkit.service.hand_core import HandCore
from dexkit.service.local import NoTopics, position_command
from dexkit.teleop.client import JointCommand
from dexkit.teleop.client_codec import ClientCodec
from tools.campaign.case import Batch, Case, Lane
from tools.campaign.waiting import WaitTimeout, open_files, until

__all__ = ["DEVICES", "M4010", "Bench", "DeviceBench", "Dex3", "Mx64", "cases", "command"]

SIDE = Side.LEFT
_PAUSES = (0.02, 0.06, 0.15, 0.4, 0.9)
"""Seconds that a device is away."""
_WATCHED = 0.4
"""Seconds after the return in which nothing may move."""


def command(dialect: Dialect, part: float) -> bytes:
    """A client's command for the left hand.

    :param part: of each joint's range, from its lower limit.
    """
    hand = model(dialect.model)
    motors = [
        JointCommand(
            dialect.mode(i, JointMode.FOC),
            j.q_min + part * j.stroke,
            hand.client_command.dq,
            0.0,
            kp,
            kd,
        )
        for i, (j, (kp, kd)) in enumerate(zip(hand.joints[SIDE], hand.gains, strict=True))
    ]
    ((_, payload),) = ClientCodec(dialect).encode({SIDE: motors})
    return payload


class Bench:
    """A backend that is served, and a client's commands for its hand.

    :param backend: its name; by default the class's own.
    :ivar low: and ``high``: goals, parts of each joint's range.
    :ivar still: what counts as not moved, in units of :meth:`DeviceBench.position`.
    """

    backend = ""
    low, high = 0.2, 0.75
    still = 0.05

    def __init__(self, scratch: Path, backend: str = "") -> None:
        self.scratch = scratch
        self.backend = backend or self.backend
        self.dialect = model(find_backend(self.backend).model).dialects[0]

    def message(self, part: float) -> bytes:
        """A command."""
        return command(self.dialect, part)


class DeviceBench(Bench):
    """One whose device is emulated in this process, and whose driver can be asked for.

    :cvar name: of the device, and of its link in the scratch folder.
    :cvar coast: how far it may run on after it was found again, in units of :meth:`position`.
    """

    name = ""
    coast = 0.0

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The emulated device, powered."""
        raise NotImplementedError

    def hand(self) -> Any:
        """A driver for it."""
        raise NotImplementedError

    def options(self, device: Any) -> list[str]:
        """The options with which ``dexkit serve`` finds it."""
        return ["--device", str(self.scratch / self.name)]

    def position(self, device: Any) -> float:
        """The position of the device itself."""
        raise NotImplementedError

    def unplug(self, device: Any, seconds: float) -> None:
        """Pull the cable, and put it back."""
        device.inject(f"unplug:for={seconds * 1000:.0f}ms")


_ZERO = 1510  # encoder tick
_STROKE = 2520  # ticks


class Mx64(DeviceBench):
    """An EZGripper."""

    name, backend = "mx64", "ezgripper"
    still = 0.02 * _STROKE
    # The driver switches the torque off when it opens the servo again; the fingers run on for some
    # 0.2 s. A command from before would take them through the other half of the stroke.
    coast = 0.08 * _STROKE

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The emulated servo with its fingers."""
        with emulated_ezgripper(
            link=self.scratch / self.name,
            closed_at=_ZERO,
            latency_timer=0.0,
            check_baudrate=False,
        ) as gripper:
            yield gripper

    def hand(self) -> Any:
        """Its driver."""
        settings = GripperSettings(zero=_ZERO, config=self.scratch / "ezgripper.json")
        return EZGripper(str(self.scratch / self.name), SIDE, settings)

    def options(self, device: Any) -> list[str]:
        """Its link and its zero."""
        return [*super().options(device), "--set", f"zero={_ZERO}"]

    def position(self, device: Any) -> float:
        """Position of the encoder, ticks."""
        return float(device.servo.drive.encoder)


class M4010(DeviceBench):
    """The motor of a Dex1-1."""

    name, backend = "m4010", "dex1-serial"

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The emulated motor with its jaws."""
        with Dex1Motors((SIDE,), links={SIDE: self.scratch / self.name}) as motors:
            yield motors

    def hand(self) -> Any:
        """Its driver."""
        return Dex1Serial(SIDE, Dex1Settings(device=str(self.scratch / self.name), timeout=0.1))

    def position(self, device: Any) -> float:
        """Opening of the jaws, rad."""
        return float(device.motors[SIDE].q)


class Dex3(DeviceBench):
    """A Dex3-1 behind a USB/IP server, on the same port after a restart."""

    name, backend = "dex3", "dex3-usb"

    def __init__(self, scratch: Path) -> None:
        super().__init__(scratch)
        self._port = 0

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The emulated hand."""
        with emulated_dex3(port=self._port) as hands:
            self._port = hands.port
            yield hands

    def hand(self) -> Any:
        """Its driver."""
        return Dex3Usb(SIDE, Dex3Settings(server=Server("127.0.0.1", self._port)))

    def options(self, device: Any) -> list[str]:
        """Its server; nobody has brought up an emulated hand, whose wiring is dexkit's guess."""
        return ["--set", f"usb={device.url}", "--set", "guesses=accept"]

    def position(self, device: Any) -> float:
        """Sum of the joints' positions without sign, rad."""
        return float(np.abs(device.device(SIDE).mechanics.q).sum())


DEVICES: tuple[type[DeviceBench], ...] = (Mx64, M4010, Dex3)
"""Every device that is unplugged, and whose driver is served."""


class DeviceCase(Case):
    """A device that goes away and comes back, by its cable or by its power.

    :param bench: which.
    :param restart: take its power and give it back, instead of its cable.
    """

    lane = Lane.LIVE
    limit = 400.0

    def __init__(self, bench: type[DeviceBench], *, restart: bool) -> None:
        self.unit = "restarts" if restart else "unplugs"  # type: ignore[misc]
        what = "started again" if restart else "unplugged and put back"
        self.name = f"{'restart' if restart else 'unplug'}:{bench.name}"
        self.what = f"the emulated {bench.name}, {what} in motion"
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

    def _rounds(self, batch: Batch, bench: DeviceBench, count: int) -> None:
        with contextlib.ExitStack() as power:
            device = power.enter_context(bench.device())
            hand = bench.hand()
            service = HandService(hand, node=NoTopics(), state_rate=100.0, soft_start=False)
            with service:
                driven = _Driven(bench, service.cores[SIDE], device, power)
                for _ in range(count):
                    self._round(batch, driven)
                    batch.units += 1
            if service.failure is not None:
                batch.failed(service.failure)

    def _round(self, batch: Batch, hand: _Driven) -> None:
        """Move, take away, bring back, look on, move again."""
        rng, bench, counters = batch.random, hand.bench, hand.core.counters
        goals = [bench.low, bench.high]
        rng.shuffle(goals)
        hand.drive(goals[0])
        time.sleep(rng.uniform(0.0, 0.2))
        # the client goes on for some time after the device went, or stops before it
        after = rng.choice((0.0, 0.0, 0.05, 0.3))
        seconds = rng.choice(_PAUSES)
        opened = counters.reconnects
        if self._restart:
            hand.power.close()
            last = hand.command_until_back(goals[0], after, opened)
            time.sleep(seconds)
            hand.device = hand.power.enter_context(bench.device())
        else:
            bench.unplug(hand.device, seconds)
            last = hand.command_until_back(goals[0], after, opened)
        until(lambda: counters.reconnects > opened, "the reconnection")
        # a command that may have come after the reconnection is one that counts
        asked = time.monotonic() - last < 0.1
        # what the driver does when it opens (a brake) is done after a few exchanges
        done = counters.exchanges
        until(lambda: counters.exchanges > done + 3 and hand.core.connected, "exchanges")
        before = hand.position
        time.sleep(_WATCHED)
        moved = abs(hand.position - before)
        if moved > bench.still + bench.coast and not asked:
            batch.found(
                "moved unasked",
                self.name,
                f"by {moved:.3f} after it was away for {seconds} s; the client stopped {after} s "
                f"after it went",
            )
        hand.drive(goals[1])


@dataclass
class _Driven:
    """A hand that is served, its emulated device, and what keeps that powered."""

    bench: DeviceBench
    core: HandCore
    device: Any
    power: contextlib.ExitStack

    @property
    def position(self) -> float:
        """The position of the device itself."""
        return self.bench.position(self.device)

    def _submit(self, part: float) -> None:
        spec = self.core.spec
        goal = spec.q_min + part * (spec.q_max - spec.q_min)
        self.core.submit(position_command(model(spec.model), goal))

    def command_until_back(self, goal: float, seconds: float, opened: int) -> float:
        """Go on commanding until the device is back; when the last command went out."""
        last = 0.0
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.core.counters.reconnects == opened:
            last = time.monotonic()
            self._submit(goal)
            time.sleep(0.005)
        return last

    def drive(self, goal: float) -> None:
        """Command until the device has moved; it may be at the goal already, then the other way."""
        start, began = self.position, time.monotonic()
        other = self.bench.low + self.bench.high - goal

        def moved() -> bool:
            self._submit(goal if time.monotonic() < began + 3.0 else other)
            return abs(self.position - start) > self.bench.still

        until(moved, "the hand to obey a fresh command")


def cases() -> list[Case]:
    """Every device, unplugged and restarted."""
    return [DeviceCase(bench, restart=restart) for bench in DEVICES for restart in (False, True)]
