"""The Dex1-1 on its serial line behind the common interface."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.dex1_serial.discovery import find_motor
from dexkit.drivers.dex1_serial.line import LATE, LineStatistics, MotorLine
from dexkit.drivers.dex1_serial.settings import SETTINGS, Dex1Settings, from_options
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.models import DEX1_1
from dexkit.wire.m4010 import (
    Calibration,
    MotorCmd,
    MotorData,
    Status,
    calibration_outcome,
)

__all__ = ["Dex1Serial", "Dex1Statistics", "backend"]

log = logging.getLogger(__name__)

_FURTHEST = 5.5
"""rad: the furthest that a client of Unitree's commands, its test_gripper
(docs/sources/unitree-dex.md#d2). The jaws meet their stop at 5.62."""
_IO_RATE = 500.0  # docs/sources/unitree-dex.md#b2: 2000 us loop
_GOODBYES = 3
"""Times that closing tries to brake a motor which is there and does not answer."""
_FLASH_TIME = 1.0
"""Seconds that a motor may take to store a calibration; assumed."""
_CLOSE_ENOUGH = 0.1  # rad between what was calibrated and what is reported behind it


@dataclass
class Dex1Statistics:
    """Counters since the hand was made.

    :ivar trips: times that the motor was found stopped by its own time-out protection.
    :ivar faults: times that it began to report an error.
    """

    trips: int = 0
    faults: int = 0


class Dex1Serial:
    """A Dex1-1 gripper (Unitree M4010 motor) on a serial port.

    :param side: which hand; motor 0 is the right one, 1 the left.
    :param configuration: how to reach it and how to talk to it.

    ``open`` finds the motor and brakes it; ``close`` brakes it. While it is driven, the motor's own
    protection is on (unless ``protect`` is off): it stops a second after the last command, whatever
    becomes of this process or the cable.
    """

    reconnect_interval = 0.5
    """Seconds at most between attempts of the service to open a lost hand again."""

    def __init__(
        self,
        side: Side,
        configuration: Dex1Settings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration if configuration is not None else Dex1Settings()
        self.statistics = Dex1Statistics()
        number = self.configuration.id
        self.id = DEX1_1.vendor_ids[side] if number is None else number
        self._clock: Clock = clock if clock is not None else RealClock()
        self._line: MotorLine | None = None
        self._tripped = False
        self._error = 0
        spec = DEX1_1.spec(
            side,
            io_rate=_IO_RATE,
            # the other motor on the line may have its turn first
            exchange_timeout=2 * (self.configuration.timeout + LATE) + LATE,
        )
        self._spec = replace(
            spec, joints=tuple(replace(joint, q_max=_FURTHEST) for joint in spec.joints)
        )

    @property
    def spec(self) -> HandSpec:
        """What this hand is."""
        return self._spec

    @property
    def path(self) -> str:
        """The port that it is on; empty while it is not open."""
        return self._line.path if self._line is not None else ""

    @property
    def line_statistics(self) -> LineStatistics:
        """Counters of the line since it was opened."""
        return self._line.statistics if self._line is not None else LineStatistics()

    # --- opening and closing

    def open(self) -> None:
        """Find the motor and brake it. Nothing moves.

        :raises HandNotFound: no such port, or the motor does not answer; says what does.
        :raises HandRefused: another program has the port, or more than one has such a motor.
        :raises HandLost: it goes away meanwhile.
        """
        if self._line is not None:
            return
        self._tripped = False
        self._error = 0
        self._line, data = find_motor(self.configuration, self.id)
        log.info(
            "Dex1-1 on %s: motor %d, at %.2f rad, %d degC, %.1f V",
            self._line.path,
            self.id,
            data.joint().q,
            data.temp,
            data.voltage,
        )
        self._look_at(data)

    def close(self) -> None:
        """Brake the motor and release the port, as far as it is still there."""
        line, self._line = self._line, None
        if line is None:
            return
        try:
            self._let_go(line)
        except HandError as error:
            rest = (
                "the motor stops by itself within a second"
                if self.configuration.protect
                else "the motor is without protection and may go on: cut its power"
            )
            log.warning("could not brake: %s; %s", error, rest)
        finally:
            line.release()
            log.info("Dex1-1 on %s closed: %s, %s", line.path, self.statistics, line.statistics)

    def _let_go(self, line: MotorLine) -> None:
        # without the bit: a brake needs no protection, and a trip would only be left behind
        frame = MotorCmd(self.id).pack()
        for left in reversed(range(_GOODBYES)):
            try:
                line.exchange(frame, self.id, self.configuration.timeout)
                return
            except HandTimeout:  # the command may have been lost
                if not left:
                    raise

    def __enter__(self) -> Dex1Serial:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Send one command frame, return what the motor answers.

        :raises HandLost: the port has gone, or the hand is not open.
        :raises HandTimeout: no intact answer in time, or this program stood still before the
            command was written.
        """
        deadline = WriteDeadline(self._clock)
        line = self._line
        if line is None:
            raise HandLost("the gripper is not open", hint="call open() first")
        frame = self._frame(command)
        data = line.exchange(frame, self.id, self.configuration.timeout, deadline)
        stamp = self._clock.now()
        self._look_at(data)
        return _state(data, stamp)

    def _frame(self, command: HandCommand) -> bytes:
        if self._tripped:
            # one brake without the bit clears the protection; the command after it is obeyed
            return MotorCmd(self.id).pack()
        protect = self.configuration.protect
        if not command.mode[0]:
            return MotorCmd(self.id, Status.BRAKE, protect).pack()
        return MotorCmd.setpoint(
            self.id,
            q=float(command.q[0]),
            dq=float(command.dq[0]),
            tau=float(command.tau[0]),
            kp=float(command.kp[0]),
            kd=float(command.kd[0]),
            timeout=protect,
        ).pack()

    def _look_at(self, data: MotorData) -> None:
        if data.timeout and not self._tripped:
            self.statistics.trips += 1
            log.warning("motor %d heard nothing for a second and stopped; going on", self.id)
        self._tripped = data.timeout
        error = data.merror & ~MotorError.MOTOR_SAW_HOST_TIMEOUT
        if error != self._error:
            if error:
                self.statistics.faults += 1
                log.error("motor %d reports: %s", self.id, _names(error))
            else:
                log.warning("motor %d reports no error any more", self.id)
            self._error = error

    # --- calibrating

    def calibrate(
        self,
        position: float = 0.0,
        *,
        time: Callable[[], float] = time.time,
    ) -> float:
        """Make the motor take the place where it is for ``position``; what it reports then, rad.

        The vendor's way: the jaws are held closed and that is zero (docs/sources/unitree-dex.md#b2,
        docs/sources/unitree-dex.md#g). The motor stores it, once between two power-ups. Nothing
        moves. Unlike the vendor's library it fails unless the motor has said that it succeeded.

        :param position: rad, 0 or more.
        :raises HandRefused: the motor does not do it; says why.
        :raises HandTimeout: no answer: perhaps it did it, perhaps not.
        :raises HandLost: the port has gone, or the hand is not open.
        """
        line = self._line
        if line is None:
            raise HandLost("the gripper is not open", hint="call open() first")
        frame = Calibration(self.id, position, time=int(time())).pack()
        problem = calibration_outcome(line.exchange(frame, self.id, _FLASH_TIME))
        if problem:
            raise HandRefused(f"motor {self.id} was not calibrated: {problem}")
        data = line.exchange(MotorCmd(self.id).pack(), self.id, self.configuration.timeout)
        q = data.joint().q
        if abs(q - position) > _CLOSE_ENOUGH:
            raise HandRefused(
                f"motor {self.id} says that it is calibrated, but is at {q:.2f} rad",
                hint="hold the jaws still, switch its supply off and on, and try again",
            )
        return q


_FOC, _BRAKE = int(JointMode.FOC), int(JointMode.BRAKE)


def _state(data: MotorData, stamp: float) -> HandState:
    q, dq, tau = data.joint()
    fault = data.merror
    if data.timeout:
        fault |= MotorError.MOTOR_SAW_HOST_TIMEOUT
    return HandState(
        q=np.array([q]),
        dq=np.array([dq]),
        ddq=np.zeros(1),
        tau_est=np.array([tau]),
        temperature=np.array([float(data.temp)]),
        winding_temperature=np.array([float(data.winding)]),
        voltage=np.array([data.voltage]),
        mode=np.array([_FOC if data.status == Status.FOC else _BRAKE], np.uint8),
        fault=np.array([fault], np.uint32),
        stamp=stamp,
    )


def _names(error: int) -> str:
    known = [bit.name.lower().replace("_", " ") for bit in MotorError if bit & error and bit.name]
    return " and ".join(known) or f"error bits 0x{error:X}"


def _make(options: BackendOptions) -> Dex1Serial:
    return Dex1Serial(options.side, from_options(options))


backend = Backend(
    summary="Dex1-1 gripper with an M4010 motor on a serial port",
    model=DEX1_1.name,
    make=_make,
    needs="--device PATH or USB serial number, if the port is not to be looked for",
    settings=SETTINGS,
)
