"""Driver of Inspire's RH56DFX on a serial port of its own (docs/inspire.md).

Each exchange writes the goals where they have changed and reads the angles; some exchanges read
errors and temperatures instead of writing. The frames are in :mod:`dexkit.wire.rh56`.

The device has no time-out: it goes to its last goal and stays there. A joint that is to hold gets
the angle at which it was measured last as its goal.
"""

from __future__ import annotations

import logging
import os
import termios
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import serial

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.descriptors import wait_readable
from dexkit.drivers.serial_port import find_device, open_failed, port_errors
from dexkit.errors import HandError, HandLost, HandNotFound, HandTimeout, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.models import INSPIRE_DFX
from dexkit.wire import rh56
from dexkit.wire.rh56 import Error, Frame, FrameParser, Operation, Register

__all__ = ["SETTINGS", "InspireSerial", "InspireSettings", "InspireStatistics", "backend"]

log = logging.getLogger(__name__)

_IO_RATE = INSPIRE_DFX.state_rate
_ATTEMPTS = 3  # to prepare a hand that is opened
_HEALTH_EVERY = 20
"""Exchanges of which one reads errors and temperatures."""
_HEALTH = int(Register.TEMPERATURE) + rh56.JOINTS - int(Register.ERROR)
"""Bytes from the errors to the end of the temperatures."""
_LATE = 0.01  # s to wait for a late answer before the next request
_CHUNK = 4096
_MOST_CHUNKS = 64  # read at most before a request, of a device that sends without end
_FAULTS: Mapping[Error, MotorError] = {
    Error.LOCKED_ROTOR: MotorError.LOCKED,
    Error.OVER_TEMPERATURE: MotorError.CASE_TEMPERATURE,
    Error.OVER_CURRENT: MotorError.OVERCURRENT,
    Error.MOTOR: MotorError.ABNORMAL_RESET,
    Error.COMMUNICATION: MotorError.COMMUNICATION_CHECK,
}


@dataclass(frozen=True)
class InspireSettings:
    """Settings of :class:`InspireSerial`.

    :param device: path of the serial port or USB serial number of its adapter.
    :param id: of the hand on the line; 1 of both hands of a G1, which have a line each.
    :param baudrate: bits a second.
    :param speed: of every joint, 0 to 1000; None leaves what the device has.
    :param force: limit of every joint, 0 to 1000; None leaves what the device has.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    id: int = 1
    baudrate: int = rh56.BAUD_RATE
    speed: int | None = rh56.FULL
    force: int | None = None
    timeout: float = 0.03

    def __post_init__(self) -> None:
        if self.id not in rh56.IDS:
            raise UsageError(f"id must be 1 to {rh56.IDS[-1]}, not {self.id}")
        for name, value in (("speed", self.speed), ("force", self.force)):
            if value is not None and not 0 <= value <= rh56.FULL:
                raise UsageError(f"{name} must be 0 to {rh56.FULL}, not {value}")
        if not 1e-3 <= self.timeout <= 1:
            raise UsageError(f"timeout must be 0.001 to 1 s, not {self.timeout:g}")
        if not 9600 <= self.baudrate <= 1_000_000:
            raise UsageError(f"baudrate must be 9600 to 1000000, not {self.baudrate}")


@dataclass
class InspireStatistics:
    """Counters since the object was created.

    :ivar exchanges: requests with an answer; ``timeouts`` without.
    :ivar damaged: answers that could not be read.
    :ivar stray: bytes that belonged to no answer, or came when none was expected.
    """

    exchanges: int = 0
    timeouts: int = 0
    damaged: int = 0
    stray: int = 0


class InspireSerial:
    """An RH56DFX.

    :param side: which hand.
    :param configuration: port, id, speed, limit of force and time-out.

    ``open`` clears errors, sets speed and limit of force, and reads the angles. No motion.
    ``close`` has every joint hold where it is.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds."""

    def __init__(
        self,
        side: Side,
        configuration: InspireSettings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration or InspireSettings()
        self.statistics = InspireStatistics()
        self._clock: Clock = clock or RealClock()
        self._port: serial.Serial | None = None
        self._path = ""
        self._parser = FrameParser(answers=True)
        self._late = False
        self._turn = 0
        self._written: list[int] | None = None
        """The goals that the device has acknowledged."""
        self._angles = [0] * rh56.JOINTS
        self._held: list[int | None] = [None] * rh56.JOINTS
        """Where joints hold, while they do."""
        self._errors = [Error(0)] * rh56.JOINTS
        self._celsius = [float("nan")] * rh56.JOINTS
        self._spec = INSPIRE_DFX.spec(
            side,
            io_rate=_IO_RATE,
            exchange_timeout=2 * (self.configuration.timeout + _LATE),
        )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    # --- opening and closing

    def open(self) -> None:
        """Open the port, clear errors, set speed and limit of force, read the angles. No motion.

        :raises HandNotFound: no port was named or there is none, or the hand does not answer.
        :raises HandRefused: another program uses the port.
        :raises HandLost: the port goes away.
        """
        if self._port is not None:
            return
        settings = self.configuration
        if settings.device is None:
            raise HandNotFound(
                "which serial port is the hand on?", hint="--device PATH or USB serial number"
            )
        self._path = find_device(settings.device).path
        try:
            self._port = serial.Serial(self._path, settings.baudrate, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            raise open_failed(self._path, error) from error
        self._late, self._turn, self._written = True, 0, None
        self._held = [None] * rh56.JOINTS
        try:
            self._prepare()
        except HandTimeout as error:
            self._close_port()
            raise HandNotFound(
                f"no hand with id {settings.id} answers on {self._path} at {settings.baudrate} "
                "baud",
                hint="is its 24 V supply on, and is it the serial (DFX) model?",
            ) from error
        except BaseException:
            self._close_port()
            raise
        log.info("RH56DFX on %s: id %d, at %s", self._path, settings.id, self._angles)

    def _prepare(self) -> None:
        """Clear errors, set speed and limit of force, and read the angles; an answer may be lost.

        :raises HandTimeout: several were.
        """
        settings = self.configuration
        clear = Frame(settings.id, Operation.WRITE, Register.CLEAR_ERROR, b"\x01")
        for left in reversed(range(_ATTEMPTS)):
            try:
                self._request(clear, 1)
                for register, value in (
                    (Register.SPEED_SET, settings.speed),
                    (Register.FORCE_SET, settings.force),
                ):
                    if value is not None:
                        self._write(register, [value] * rh56.JOINTS)
                self._read_angles()
                return
            except HandTimeout:
                if not left:
                    raise

    def close(self) -> None:
        """Hold every joint and release the port. Failures are logged, not raised."""
        if self._port is None:
            return
        try:
            self._read_angles()
            self._write(Register.ANGLE_SET, self._angles)
        except HandError as error:
            log.warning("could not hold: %s; the hand goes to its last goal", error)
        finally:
            self._close_port()
            log.info("RH56DFX on %s closed: %s", self._path, self.statistics)

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except (OSError, termios.error) as error:  # a device that is gone
                log.debug("closing %s: %s", self._path, error)

    def __enter__(self) -> InspireSerial:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Write the goals if they have changed, and read the angles.

        :raises HandLost: the port has gone away, or the hand is not open.
        :raises HandTimeout: no intact answer in time, or this program was paused before the goals
            were written.
        """
        deadline = WriteDeadline(self._clock)
        if self._port is None:
            raise HandLost("the hand is not open", hint="call open() first")
        goals = self._goals(command)
        if goals != self._written:
            self._written = None
            self._write(Register.ANGLE_SET, goals, deadline)
            self._written = goals
        self._turn += 1
        if self._turn % _HEALTH_EVERY == 1:
            self._read_health()
        self._read_angles()
        driven = command.mode == JointMode.FOC
        return HandState.from_values(
            np.array(self._angles) / rh56.FULL,
            stamp=self._clock.now(),
            temperature=self._celsius,
            mode=driven.astype(int).tolist(),
            fault=[self._fault(error) for error in self._errors],
        )

    def _goals(self, command: HandCommand) -> list[int]:
        """The goal of each joint, of one that holds where it was when that began."""
        found = []
        for i, (mode, q) in enumerate(zip(command.mode.tolist(), command.q.tolist(), strict=True)):
            if mode == JointMode.FOC:
                self._held[i] = None
                found.append(round(min(max(q, 0.0), 1.0) * rh56.FULL))
                continue
            held = self._held[i]
            if held is None:
                held = self._held[i] = self._angles[i]
            found.append(held)
        return found

    @staticmethod
    def _fault(error: Error) -> int:
        found = MotorError.NONE
        for bit, meaning in _FAULTS.items():
            if error & bit:
                found |= meaning
        return int(found)

    def _read_angles(self) -> None:
        data = self._read(Register.ANGLE_ACT, 2 * rh56.JOINTS)
        self._angles = [min(max(angle, 0), rh56.FULL) for angle in rh56.numbers(data)]

    def _read_health(self) -> None:
        data = self._read(Register.ERROR, _HEALTH)
        errors = [Error(value) for value in data[: rh56.JOINTS]]
        if errors != self._errors:
            names = {
                joint.name: error.name or f"bits {int(error):#x}"
                for joint, error in zip(self._spec.joints, errors, strict=True)
                if error
            }
            if names:
                log.error("the hand reports: %s", names)
            else:
                log.warning("the hand reports no error any more")
        self._errors = errors
        self._celsius = [float(value) for value in data[-rh56.JOINTS :]]

    # --- the line

    def _write(
        self, register: Register, values: list[int], before: WriteDeadline | None = None
    ) -> None:
        self._request(rh56.write(self.configuration.id, register, values), 1, before)

    def _read(self, register: Register, count: int) -> bytes:
        return self._request(rh56.read(self.configuration.id, register, count), count)

    def _request(self, frame: Frame, count: int, before: WriteDeadline | None = None) -> bytes:
        """Send a request, and return the data of its answer, so many bytes."""
        port = self._port
        if port is None:
            raise HandLost("the hand is not open", hint="call open() first")
        try:
            with port_errors(self._path):
                return self._transact(port.fileno(), frame, count, before)
        except HandTimeout:
            raise
        except HandError:
            self._close_port()
            raise

    def _transact(self, fd: int, frame: Frame, count: int, before: WriteDeadline | None) -> bytes:
        statistics, parser = self.statistics, self._parser
        if self._late:  # an answer that comes late would be taken for this one's
            self._late = bool(wait_readable([fd], _LATE))
        for _ in range(_MOST_CHUNKS):
            if not (data := self._receive(fd)):
                break
            statistics.stray += len(data)
        parser.reset()
        if before is not None:
            before.check()
        request = frame.pack()
        if os.write(fd, request) != len(request):
            raise HandLost(f"the port {self._path} takes no more bytes")
        ends = time.monotonic() + self.configuration.timeout
        skipped, damaged = parser.skipped, parser.damaged
        try:
            while wait_readable([fd], max(0.0, ends - time.monotonic())):
                data = self._receive(fd)
                if not data:
                    raise HandLost(f"the port {self._path} has gone away: no data")
                for answer in parser.feed(data):
                    if self._answers(answer, frame, count):
                        statistics.exchanges += 1
                        return answer.data
                    statistics.stray += len(answer.pack())
        finally:
            statistics.stray += parser.skipped - skipped
            statistics.damaged += parser.damaged - damaged
        statistics.timeouts += 1
        self._late = True
        raise HandTimeout(
            f"the hand with id {frame.device} on {self._path} does not answer",
            hint="check its supply, the cable and the id",
        )

    @staticmethod
    def _answers(answer: Frame, request: Frame, count: int) -> bool:
        """Whether a frame is the answer to a request, with so many bytes."""
        same = (answer.device, answer.operation, answer.address) == (
            request.device,
            request.operation,
            request.address,
        )
        return same and len(answer.data) == count

    @staticmethod
    def _receive(fd: int) -> bytes:
        try:
            return os.read(fd, _CHUNK)
        except BlockingIOError:
            return b""


_PARSERS: dict[str, tuple[Callable[[str], object], str]] = {
    "id": (int, "of the hand on its line (default 1)"),
    "baudrate": (int, f"bits a second (default {rh56.BAUD_RATE})"),
    "speed": (int, f"of every joint, 0 to {rh56.FULL} (default {rh56.FULL})"),
    "force": (int, f"limit of every joint, 0 to {rh56.FULL} (default: what the hand has)"),
    "timeout": (float, "seconds to wait for an answer (default 0.03)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> InspireSerial:
    values: dict[str, object] = {}
    for name, text in options.settings.items():
        parse, meaning = _PARSERS[name]
        try:
            values[name] = parse(text)
        except ValueError as error:
            raise UsageError(f"{name}={text}: {error}", hint=f"{name} is {meaning}") from error
    settings = InspireSettings(device=options.device, **values)  # type: ignore[arg-type]
    return InspireSerial(options.side, settings)


backend = Backend(
    summary="Inspire RH56DFX hand on a serial port",
    model=INSPIRE_DFX.name,
    make=_make,
    needs="--device left=PATH --device right=PATH",
    settings=SETTINGS,
)
