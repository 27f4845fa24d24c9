"""Drive an Inspire RH56, however it is reached (docs/inspire.md).

Each exchange writes the goals where they have changed and reads the angles; some exchanges read
errors and temperatures as well. :mod:`dexkit.drivers.inspire_serial` and
:mod:`dexkit.drivers.inspire_modbus` access the registers.

The device has no time-out: it goes to its last goal and stays there. A joint that is to hold gets
the angle at which it was measured last as its goal.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel
from dexkit.drivers.request_line import LATE, RequestLine, RequestStatistics
from dexkit.drivers.setting_parsers import Parsers
from dexkit.errors import HandError, HandLost, HandNotFound, HandTimeout, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.models import INSPIRE_DFX
from dexkit.wire import rh56
from dexkit.wire.rh56 import Error, Register

__all__ = ["COMMON_SETTINGS", "InspireHand", "InspireSettings"]

log = logging.getLogger(__name__)

_IO_RATE = INSPIRE_DFX.state_rate
_ATTEMPTS = 3  # to prepare a hand that is opened
_HEALTH_EVERY = 20
"""Exchanges of which one reads errors and temperatures."""
_HEALTH = int(Register.TEMPERATURE) + rh56.JOINTS - int(Register.ERROR)
"""Bytes from the errors to the end of the temperatures."""


FoundT = TypeVar("FoundT")


@dataclass(frozen=True)
class InspireSettings:
    """Settings of an :class:`InspireHand`.

    :param device: where it is; see the driver.
    :param id: of the hand on the line, or Modbus' unit.
    :param speed: of every joint, 0 to 1000; None leaves what the device has.
    :param force: limit of every joint, 0 to 1000; None leaves what the device has.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    id: int = 1
    speed: int | None = rh56.FULL
    force: int | None = None
    timeout: float = 0.03

    def __post_init__(self) -> None:
        if self.id not in self.ids:
            raise UsageError(f"id must be {self.ids[0]} to {self.ids[-1]}, not {self.id}")
        for name, value in (("speed", self.speed), ("force", self.force)):
            if value is not None and not 0 <= value <= rh56.FULL:
                raise UsageError(f"{name} must be 0 to {rh56.FULL}, not {value}")
        if not 1e-3 <= self.timeout <= 1:
            raise UsageError(f"timeout must be 0.001 to 1 s, not {self.timeout:g}")

    @property
    def ids(self) -> range:
        """The ids that there are."""
        return rh56.IDS


class InspireHand(ABC):
    """An Inspire RH56, however it is reached.

    :param side: which hand.
    :param configuration: place, id, speed, limit of force and time-out.

    ``open`` clears errors, sets speed and limit of force, and reads the angles. No motion.
    ``close`` has every joint hold where it is.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds."""

    def __init__(
        self,
        side: Side,
        configuration: InspireSettings,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration
        self.statistics = RequestStatistics()
        self._line = RequestLine(self.statistics, configuration.timeout)
        self._clock: Clock = clock or RealClock()
        self._channel: Channel | None = None
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
            exchange_timeout=2 * (configuration.timeout + LATE),
        )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    # --- access to the registers

    @abstractmethod
    def _connect(self) -> Channel:
        """Open the connection to the device.

        :raises HandError: it cannot be.
        """

    @abstractmethod
    def _write(
        self, channel: Channel, register: Register, data: bytes, before: WriteDeadline | None
    ) -> None:
        """Write bytes to the registers from one on.

        :raises HandError: they were not, or nobody knows.
        """

    @abstractmethod
    def _read(self, channel: Channel, register: Register, count: int) -> bytes:
        """So many bytes of the registers from one on.

        :raises HandError: there are none.
        """

    @abstractmethod
    def _absent(self, place: str) -> HandNotFound:
        """What to say of a place where no hand answers."""

    # --- opening and closing

    def open(self) -> None:
        """Open the way, clear errors, set speed and limit of force, read the angles. No motion.

        :raises HandNotFound: no place was named or there is none, or the hand does not answer.
        :raises HandRefused: another program uses the port.
        :raises HandLost: the way goes away.
        """
        if self._channel is not None:
            return
        self._channel = self._connect()
        self._line.restart()
        self._turn, self._written = 0, None
        self._held = [None] * rh56.JOINTS
        place = self._channel.place
        try:
            self._prepare()
        except HandTimeout as error:
            self._close_channel()
            raise self._absent(place) from error
        except BaseException:
            self._close_channel()
            raise
        log.info("RH56 on %s: id %d, at %s", place, self.configuration.id, self._angles)

    def _prepare(self) -> None:
        """Set speed and limit of force, read the angles, clear errors; an answer may be lost.

        :raises HandTimeout: several were.
        """
        settings = self.configuration
        for left in reversed(range(_ATTEMPTS)):
            try:
                for register, value in (
                    (Register.SPEED_SET, settings.speed),
                    (Register.FORCE_SET, settings.force),
                ):
                    if value is not None:
                        self._put(register, [value] * rh56.JOINTS)
                self._read_angles()
                self._read_health()
                if any(self._errors):
                    # a joint that has its power again must not go on to a goal of before
                    self._put(Register.ANGLE_SET, self._angles)
                    self._ask(lambda to: self._write(to, Register.CLEAR_ERROR, b"\x01\x00", None))
                    self._read_health()
                return
            except HandTimeout:
                if not left:
                    raise

    def close(self) -> None:
        """Hold every joint and close the connection. Failures are logged, not raised."""
        channel = self._channel
        if channel is None:
            return
        try:
            self._read_angles()
            self._put(Register.ANGLE_SET, self._angles)
        except HandError as error:
            log.warning("could not hold: %s; the hand goes to its last goal", error)
        finally:
            self._close_channel()
            log.info("RH56 on %s closed: %s", channel.place, self.statistics)

    def _close_channel(self) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def __enter__(self) -> InspireHand:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Write the goals if they have changed, and read the angles.

        :raises HandLost: the device has gone away, or is not open.
        :raises HandTimeout: no intact answer in time, or this program was paused before the goals
            were written.
        """
        deadline = WriteDeadline(self._clock)
        if self._channel is None:
            raise HandLost("the hand is not open", hint="call open() first")
        goals = self._goals(command)
        if goals != self._written:
            self._written = None
            self._put(Register.ANGLE_SET, goals, deadline)
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
        for bit, meaning in rh56.FAULTS.items():
            if error & bit:
                found |= meaning
        return int(found)

    def _read_angles(self) -> None:
        data = self._ask(lambda to: self._read(to, Register.ANGLE_ACT, 2 * rh56.JOINTS))
        self._angles = [min(max(angle, 0), rh56.FULL) for angle in rh56.numbers(data)]

    def _read_health(self) -> None:
        data = self._ask(lambda to: self._read(to, Register.ERROR, _HEALTH))
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

    def _put(
        self, register: Register, values: list[int], before: WriteDeadline | None = None
    ) -> None:
        data = np.array(values, "<i2").tobytes()
        self._ask(lambda to: self._write(to, register, data, before))

    def _ask(self, request: Callable[[Channel], FoundT]) -> FoundT:
        """Do one request; a device that has gone is closed."""
        channel = self._channel
        if channel is None:
            raise HandLost("the hand is not open", hint="call open() first")
        try:
            return request(channel)
        except HandTimeout:
            raise
        except HandError:
            self._close_channel()
            raise


COMMON_SETTINGS: Parsers = {
    "speed": (int, f"of every joint, 0 to {rh56.FULL} (default {rh56.FULL})"),
    "force": (int, f"limit of every joint, 0 to {rh56.FULL} (default: what the hand has)"),
}
