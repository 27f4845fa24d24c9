"""Run emulated Dex1-1 motors in threads or in a child process."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from dexkit.clock import RealClock
from dexkit.emulators.dex1_mechanics import Dex1Mechanics
from dexkit.emulators.faults import M4010_FAULTS, parse_fault
from dexkit.emulators.line_port import SCHEME, line_port
from dexkit.emulators.m4010.bus import Bus
from dexkit.emulators.m4010.motor import LOCKING, Motor
from dexkit.emulators.m4010.settings import Firmware
from dexkit.emulators.m4010.wiring import Wiring
from dexkit.emulators.process import EmulatorProcess
from dexkit.emulators.serial_port import Port
from dexkit.hand import Side
from dexkit.temporary_folder import TemporaryFolder

if TYPE_CHECKING:
    from dexkit.emulators.ftdi import FtdiPort

__all__ = ["Dex1Motors", "Dex1Process"]


class Dex1Motors:
    """The motors of one gripper or of both, on one line or on two, served in threads.

    :param sides: whose motors.
    :param links: where each side's line is put; one path for both sides makes one line. None for
        a name in a temporary directory, and one line. ``usbip://HOST:PORT`` puts it behind an
        emulated FT232H on a USB/IP server of its own.
    :param object_pct: opening at which an object is touched, percent; None for none.
    :param start_pct: opening at first, percent.
    :param zero_error: rad by which the position is reported too large, until calibrated.
    :param wiring: ids and mounting of the motors.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`. Those of the line strike
        every line.
    :param check_baudrate: a client at another baud rate is not understood.
    :raises EmulatorError: a link cannot be made.
    :raises UsageError: a fault or a value is invalid.

    Reading ``motors`` while a client talks to them gives a snapshot only.
    """

    def __init__(
        self,
        sides: Sequence[Side] = (Side.LEFT,),
        *,
        links: Mapping[Side, str | os.PathLike[str]] | None = None,
        object_pct: float | None = None,
        start_pct: float = 20.0,
        zero_error: float = 0.0,
        wiring: Wiring | None = None,
        firmware: Firmware | None = None,
        line_time: bool = True,
        latency_timer: float = 0.0,
        faults: Sequence[str] = (),
        seed: int = 0,
        check_baudrate: bool = True,
    ) -> None:
        plan = [parse_fault(spec, M4010_FAULTS) for spec in faults]
        now = RealClock().now()
        wiring = wiring or Wiring.assumed()
        self.motors: dict[Side, Motor] = {}
        for side in sides:
            mechanics = Dex1Mechanics(object_pct=object_pct, start_pct=start_pct, locking=LOCKING)
            self.motors[side] = Motor(
                wiring.ids[side],
                mechanics=mechanics,
                firmware=firmware,
                zero_error=zero_error,
                mounting=wiring.mountings[side],
                now=now,
            )
        lines: dict[str | None, list[Side]] = {}
        for side in sides:
            link = None if links is None else os.fspath(links[side])
            if link is not None and not link.startswith(SCHEME):
                link = os.path.abspath(link)
            lines.setdefault(link, []).append(side)
        self.ports: dict[Side, Port | FtdiPort] = {}
        try:
            for link, together in lines.items():
                bus = Bus(
                    [self.motors[side] for side in together],
                    line_time=line_time,
                    latency_timer=latency_timer,
                    faults=plan,
                    start=now,
                    seed=seed,
                )
                # 6 Mbaud is beyond an FT232R
                port = line_port(
                    bus,
                    link,
                    serial=f"DKM4010{together[0].value[0].upper()}",
                    fast=True,
                    check_baudrate=check_baudrate,
                )
                self.ports |= dict.fromkeys(together, port)
        except BaseException:
            self.close()
            raise
        for port in self._lines:
            port.start()

    @property
    def _lines(self) -> list[Port | FtdiPort]:
        return list({id(port): port for port in self.ports.values()}.values())

    @property
    def path(self) -> str:
        """Path of the first line, for a client to open."""
        return self._lines[0].path

    @property
    def motor(self) -> Motor:
        """The only or first motor."""
        return next(iter(self.motors.values()))

    @property
    def error(self) -> BaseException | None:
        """The error that ended the service of a line, or None."""
        return next((port.error for port in self._lines if port.error is not None), None)

    @property
    def failure(self) -> Exception | None:
        """The first exception on a message, which a line has survived, if any."""
        return next((p.line.failure for p in self._lines if p.line.failure is not None), None)

    @property
    def ready_lines(self) -> list[str]:
        """For each line: its path and the motors on it."""
        lines = []
        for port in self._lines:
            here = [side for side in self.ports if self.ports[side] is port]
            ids = ",".join(str(self.motors[side].number) for side in here)
            names = ",".join(str(side) for side in here)
            rate = self.motors[here[0]].firmware.baudrate
            lines.append(f"ready: {port.path} {names} id={ids} baudrate={rate} {port.place}")
        return lines

    def bus(self, side: Side) -> Bus:
        """The line of a side."""
        line = self.ports[side].line
        assert isinstance(line, Bus)
        return line

    def inject(self, spec: str) -> None:
        """Inject a fault into every line, now (or at its ``@TIME`` from now)."""
        fault = parse_fault(spec, M4010_FAULTS)
        for port in self._lines:
            port.inject(fault)

    def summaries(self) -> list[str]:
        """For each line: its counters."""
        found = []
        for port in self._lines:
            bus = port.line
            assert isinstance(bus, Bus)
            text = bus.counters.summary() or "nothing was sent"
            trips = sum(motor.trips for motor in bus.motors)
            if trips:
                text += f", {trips} trips"
            if port.overruns:
                text += f", {port.overruns} bytes not read by the client"
            found.append(f"{port.path}: {text}")
        return found

    def close(self) -> None:
        """Stop, and remove the paths. May be called twice."""
        for port in self._lines:
            port.close()

    def __enter__(self) -> Dex1Motors:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Dex1Process(EmulatorProcess):
    """Motors in a process of their own: ``dexkit emulate dex1-motor``.

    :param arguments: of that command, without ``--link``.
    :param link: where to put the link; None for a name in a temporary directory.
    :raises EmulatorError: it did not become ready.
    """

    def __init__(
        self,
        arguments: Sequence[str] = (),
        link: str | os.PathLike[str] | None = None,
        *,
        timeout: float = 20.0,
    ) -> None:
        self._directory: TemporaryFolder | None = None
        if link is None:
            self._directory = TemporaryFolder("dex1")
            link = self._directory.path / "tty"
        self.path = os.path.abspath(os.fspath(link))
        try:
            super().__init__(
                "dex1-motor", ["--link", self.path, *arguments], M4010_FAULTS, timeout=timeout
            )
        except BaseException:
            self._cleanup()
            raise

    def close(self) -> None:
        """Stop it; ``output`` and ``errors`` then hold what it printed after the ready line."""
        super().close()
        self._cleanup()

    def _cleanup(self) -> None:
        if self._directory is not None:
            self._directory.close()
            self._directory = None
