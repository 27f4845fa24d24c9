"""Run an emulated EZGripper in a thread or in a child process."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Sequence

from dexkit.clock import Clock, RealClock
from dexkit.emulators.faults import MX64_FAULTS, parse_fault
from dexkit.emulators.mx64.bus import Bus
from dexkit.emulators.mx64.servo import Servo
from dexkit.emulators.mx64.settings import Firmware, Physics
from dexkit.emulators.process import EmulatorProcess
from dexkit.emulators.serial_port import Port
from dexkit.errors import UsageError
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["EmulatedProcess", "EmulatedThread", "emulated_ezgripper"]


class EmulatedThread:
    """A gripper in a thread of this process, whose servos can be inspected.

    Reading ``servos`` while a client talks to them gives a snapshot only.

    :ivar bus: the line.
    """

    def __init__(self, bus: Bus, port: Port) -> None:
        self.bus = bus
        self.port = port
        port.start()

    @property
    def path(self) -> str:
        """Path that a client opens."""
        return self.port.path

    @property
    def servos(self) -> list[Servo]:
        """The servos on it."""
        return self.bus.servos

    @property
    def servo(self) -> Servo:
        """The only or first servo."""
        return self.bus.servos[0]

    def inject(self, spec: str) -> None:
        """Inject a fault now (or at its ``@TIME`` from now)."""
        self.port.inject(parse_fault(spec))

    def close(self) -> None:
        """Stop it and remove the path."""
        self.port.close()


class EmulatedProcess(EmulatorProcess):
    """A gripper in its own process: ``dexkit emulate mx64``.

    :param arguments: of that command, without ``--link``.
    :param link: where to put the link; None for a name in a temporary directory.
    :raises EmulatorError: it did not become ready.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        link: str | os.PathLike[str] | None = None,
        *,
        timeout: float = 20.0,
    ) -> None:
        self._directory: TemporaryFolder | None = None
        if link is None:
            self._directory = TemporaryFolder("mx64")
            link = self._directory.path / "tty"
        self.path = os.path.abspath(os.fspath(link))
        super().__init__("mx64", ["--link", self.path, *arguments], MX64_FAULTS, timeout=timeout)

    def close(self) -> None:
        """Stop it; ``output`` and ``errors`` then hold what it printed after the ready line."""
        super().close()
        if self._directory is not None:
            self._directory.close()
            self._directory = None


@contextlib.contextmanager
def emulated_ezgripper(
    object_pct: float | None = None,
    *,
    process: bool = False,
    baudrate: int = 1_000_000,
    servo_id: int = 1,
    servo_ids: Sequence[int] = (),
    line_time: bool = True,
    latency_timer: float = 1e-3,
    faults: Sequence[str] = (),
    start: float = 50.0,
    closed_at: int | None = None,
    link: str | os.PathLike[str] | None = None,
    check_baudrate: bool = True,
    seed: int = 0,
    firmware: Firmware | None = None,
    physics: Physics | None = None,
    clock: Clock | None = None,
    extra: Sequence[str] = (),
) -> Iterator[EmulatedThread | EmulatedProcess]:
    """An emulated EZGripper that answers at ``.path``, and takes faults by ``.inject``.

    :param object_pct: opening at which an object is touched, percent; None for none.
    :param process: run it as ``dexkit emulate mx64`` in a process of its own instead of a
        thread of this one. A client in the same process competes with the thread for the
        interpreter, so rates are measured against a process; the servos of a thread can be
        inspected (``.servo``).
    :param servo_ids: of several servos on the line, each with fingers of its own, instead of one.
    :param latency_timer: of the USB-serial adapter, seconds.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`.
    :param start: opening at power-on, percent.
    :param closed_at: encoder tick at which it is closed.
    :param firmware: and ``physics`` and ``clock``: only in a thread.
    :param extra: more arguments of the command: only for a process.
    :raises EmulatorError: it did not become ready.
    :raises UsageError: an option is invalid.
    """
    gripper: EmulatedThread | EmulatedProcess
    ids = tuple(servo_ids) or (servo_id,)
    if process:
        if firmware is not None or physics is not None or clock is not None:
            raise UsageError("firmware, physics and a clock can be given to a thread only")
        gripper = EmulatedProcess(
            [
                f"--set=baudrate={baudrate}",
                f"--set=id={','.join(map(str, ids))}",
                f"--set=latency-timer={latency_timer * 1e3:g}",
                f"--set=start={start:g}",
                f"--set=seed={seed}",
                *(f"--fault={spec}" for spec in faults),
                *([] if line_time else ["--set=line-time=no"]),
                *([] if check_baudrate else ["--set=any-baudrate=yes"]),
                *([] if object_pct is None else [f"--set=object={object_pct:g}"]),
                *([] if closed_at is None else [f"--set=closed-at={closed_at}"]),
                *extra,
            ],
            link,
        )
    else:
        if extra:
            raise UsageError("extra arguments can be given to a process only")
        physics = physics or Physics()
        mechanics = dataclasses.replace(physics.gripper, start=start)
        if object_pct is not None:
            mechanics = dataclasses.replace(mechanics, object_pct=object_pct)
        if closed_at is not None:
            mechanics = dataclasses.replace(mechanics, closed_at=closed_at)
        clock = clock or RealClock()
        now = clock.now()
        servos = [
            Servo(
                number,
                baudrate=baudrate,
                physics=dataclasses.replace(physics, gripper=mechanics),
                firmware=firmware,
                now=now,
                seed=seed + index,
            )
            for index, number in enumerate(ids)
        ]
        bus = Bus(
            servos,
            line_time=line_time,
            latency_timer=latency_timer,
            faults=[parse_fault(spec) for spec in faults],
            start=now,
            seed=seed,
        )
        gripper = EmulatedThread(bus, Port(bus, link, clock=clock, check_baudrate=check_baudrate))
    try:
        yield gripper
    finally:
        gripper.close()
