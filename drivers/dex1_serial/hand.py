"""Implement :class:`dexkit.hand.Hand` for the Dex1-1 on its serial line."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.bringup.settings_file import SettingsFile
from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.dex1_serial.discovery import find_motor
from dexkit.drivers.dex1_serial.line import LATE, LineStatistics, MotorLine
from dexkit.drivers.dex1_serial.settings import SETTINGS, Dex1Settings, from_options, with_stored
from dexkit.drivers.serial_port import find_device
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.lazy import Lazy
from dexkit.models import DEX1_1
from dexkit.wire.m4010 import (
    Calibration,
    Feedback,
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
_BRAKE_ATTEMPTS = 3
"""Brake commands that ``close`` sends at most to a motor that does not answer."""
_FLASH_TIME = 1.0
"""Seconds that a motor may take to store a calibration; assumed."""
_CALIBRATION_TOLERANCE = 0.1  # rad, between the calibrated position and the next one reported


@dataclass
class Dex1Statistics:
    """Counters since the object was created.

    :ivar trips: times that the motor's time-out protection had stopped it.
    :ivar faults: times that the motor began to report an error.
    """

    trips: int = 0
    faults: int = 0


class Dex1Serial:
    """A Dex1-1 gripper (Unitree M4010 motor) on a serial port.

    :param side: which hand; the right hand's motor has id 0, the left hand's id 1.
    :param configuration: port, baud rate, id, protection and time-out.

    ``open`` finds the motor and brakes it; ``close`` brakes it. Commands enable the motor's own
    time-out protection (unless ``protect`` is off): the motor stops one second after the last
    command, even if this process dies or the cable is pulled.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds."""

    def __init__(
        self,
        side: Side,
        configuration: Dex1Settings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration if configuration is not None else Dex1Settings()
        self.statistics = Dex1Statistics()
        self._side = side
        self._apply(self.configuration)
        self._clock: Clock = clock if clock is not None else RealClock()
        self._line: MotorLine | None = None
        self._tripped = False
        self._error = 0
        spec = DEX1_1.spec(
            side,
            io_rate=_IO_RATE,
            # an exchange with the other motor on the line may come first
            exchange_timeout=2 * (self.configuration.timeout + LATE) + LATE,
        )
        self._spec = replace(
            spec, joints=tuple(replace(joint, q_max=_FURTHEST) for joint in spec.joints)
        )

    def _apply(self, settings: Dex1Settings) -> None:
        self._settings = settings
        self.id = DEX1_1.vendor_ids[self._side] if settings.id is None else settings.id
        self._mounting = settings.mounting

    def _load_stored(self) -> None:
        """Apply the settings that a bring-up has stored for this side's gripper.

        :raises UsageError: the file cannot be read, or holds an invalid setting.
        """
        if self.configuration.config is None:
            return
        store = SettingsFile(self.configuration.config, "dex1-serial")
        texts = store.section(str(self._side), "settings")
        try:
            self._apply(with_stored(self.configuration, texts))
        except UsageError as error:
            raise UsageError(
                f"{store.path}: {self._side}: {error.message}",
                hint=error.hint or "dexkit bringup dex1-serial",
            ) from error
        if texts:
            log.info("settings of the %s gripper: %s", self._side, store.path)

    def _check_adapter(self, path: str) -> None:
        """Refuse a gripper that is on another adapter than the stored settings.

        :raises HandRefused: it is on another one.
        """
        wanted, found = self._settings.adapter, find_device(path).serial_number
        if wanted is not None and found != wanted:
            raise HandRefused(
                f"the settings of the {self._side} gripper are of the one on adapter {wanted}, and "
                f"this is on {found or 'an adapter without serial number'}",
                hint="bring this gripper up: dexkit bringup dex1-serial",
            )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    @property
    def path(self) -> str:
        """Path of the serial port; empty while the hand is not open."""
        return self._line.path if self._line is not None else ""

    @property
    def line_statistics(self) -> LineStatistics:
        """Counters of the line since it was opened."""
        return self._line.statistics if self._line is not None else LineStatistics()

    # --- opening and closing

    def open(self) -> None:
        """Find the motor and brake it. No motion.

        :raises HandNotFound: no such port, or the motor does not answer; the hint lists what does.
        :raises HandRefused: another program uses the port, or more than one port has such a motor.
        :raises HandLost: the port goes away during the search.
        """
        if self._line is not None:
            return
        self._tripped = False
        self._error = 0
        self._load_stored()
        line, data = find_motor(self._settings, self.id)
        try:
            self._check_adapter(line.path)
        except BaseException:
            line.release()
            raise
        self._line = line
        log.info(
            "Dex1-1 on %s: motor %d, at %.2f rad, %d degC, %.1f V",
            self._line.path,
            self.id,
            self._joint(data)[0],
            data.temp,
            data.voltage,
        )
        self._report_status(data)

    def close(self) -> None:
        """Brake the motor and release the port. Failures are logged, not raised."""
        line, self._line = self._line, None
        if line is None:
            return
        try:
            self._brake_motor(line)
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

    def _brake_motor(self, line: MotorLine) -> None:
        # without the time-out bit: otherwise the protection would trip a second after this
        frame = MotorCmd(self.id).pack()
        for left in reversed(range(_BRAKE_ATTEMPTS)):
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
        """Send one command frame and return the state in the motor's answer.

        :raises HandLost: the port has gone away, or the hand is not open.
        :raises HandTimeout: no intact answer in time, or this program was paused before the
            command was written.
        """
        deadline = WriteDeadline(self._clock)
        line = self._line
        if line is None:
            raise HandLost("the driver is not connected to the gripper", hint="call open() first")
        frame = self._encode_command(command)
        data = line.exchange(frame, self.id, self.configuration.timeout, deadline)
        stamp = self._clock.now()
        self._report_status(data)
        return _decode_state(data, self._joint(data), stamp)

    def _joint(self, data: MotorData) -> Feedback:
        """Joint state in the motor's answer."""
        q, dq, tau = data.joint(self._mounting.ratios[0])
        sign = self._mounting.signs[0]
        return Feedback(self._mounting.joint(0, q), sign * dq, sign * tau)

    def _encode_command(self, command: HandCommand) -> bytes:
        if self._tripped:
            # one brake without the time-out bit clears the trip; the next command is obeyed
            return MotorCmd(self.id).pack()
        protect = self.configuration.protect
        if not command.mode[0]:
            return MotorCmd(self.id, Status.BRAKE, protect).pack()
        mounting = self._mounting
        sign = mounting.signs[0]
        return MotorCmd.setpoint(
            self.id,
            q=mounting.motor(0, float(command.q[0])),
            dq=sign * float(command.dq[0]),
            tau=sign * float(command.tau[0]),
            kp=float(command.kp[0]),
            kd=float(command.kd[0]),
            timeout=protect,
            ratio=mounting.ratios[0],
        ).pack()

    def _report_status(self, data: MotorData) -> None:
        if data.timeout and not self._tripped:
            self.statistics.trips += 1
            log.warning(
                "motor %d received no command for 1 s and its protection stopped it; driving it "
                "again",
                self.id,
            )
        self._tripped = data.timeout
        error = data.merror & ~MotorError.MOTOR_SAW_HOST_TIMEOUT
        if error != self._error:
            if error:
                self.statistics.faults += 1
                log.error("motor %d reports: %s", self.id, _describe_error(error))
            else:
                log.warning("motor %d reports no error any more", self.id)
            self._error = error

    # --- calibration

    def calibrate(
        self,
        position: float = 0.0,
        *,
        time: Callable[[], float] = time.time,
    ) -> float:
        """Set the motor's present position to ``position``; return the position reported next, rad.

        The vendor's procedure holds the jaws closed and sets 0 (docs/sources/unitree-dex.md#b2,
        docs/sources/unitree-dex.md#g). The motor stores the calibration in flash memory and accepts
        one per power-up. No motion. Unlike the vendor's library, this method fails unless the motor
        reports success.

        :param position: rad, 0 or more.
        :raises HandRefused: the motor refuses, or reports another position; the message says why.
        :raises HandTimeout: no answer; the motor may or may not be calibrated.
        :raises HandLost: the port has gone away, or the hand is not open.
        """
        line = self._line
        if line is None:
            raise HandLost("the driver is not connected to the gripper", hint="call open() first")
        frame = Calibration(self.id, position, time=int(time())).pack()
        problem = calibration_outcome(line.exchange(frame, self.id, _FLASH_TIME))
        if problem:
            raise HandRefused(f"motor {self.id} was not calibrated: {problem}")
        data = line.exchange(MotorCmd(self.id).pack(), self.id, self.configuration.timeout)
        q = data.joint().q
        if self._mounting.offsets[0]:
            self._forget_offset()
        if abs(q - position) > _CALIBRATION_TOLERANCE:
            raise HandRefused(
                f"motor {self.id} reports that it is calibrated, but is at {q:.2f} rad",
                hint="hold the jaws still, switch its supply off and on, and try again",
            )
        return q

    def _forget_offset(self) -> None:
        """Set the offset to 0, also in the settings file: the motor itself has the zero now."""
        self._apply(replace(self._settings, offset=0.0))
        if self.configuration.config is not None:
            store = SettingsFile(self.configuration.config, "dex1-serial")
            texts = store.section(str(self._side), "settings")
            store.write(str(self._side), {"settings": texts | {"offset": "0"}})


_FOC, _BRAKE = int(JointMode.FOC), int(JointMode.BRAKE)


def _decode_state(data: MotorData, joint: Feedback, stamp: float) -> HandState:
    q, dq, tau = joint
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


def _describe_error(error: int) -> str:
    known = [bit.name.lower().replace("_", " ") for bit in MotorError if bit & error and bit.name]
    return " and ".join(known) or f"error bits 0x{error:X}"


def _create_hand(options: BackendOptions) -> Dex1Serial:
    return Dex1Serial(options.side, from_options(options))


backend = Backend(
    summary="Dex1-1 gripper with an M4010 motor on a serial port",
    model=DEX1_1.name,
    make=_create_hand,
    needs="--device PATH or USB serial number, if the port is not to be looked for",
    settings=SETTINGS,
    bringup=Lazy("dexkit.drivers.dex1_serial.bringup:bench"),
    settings_file=Lazy("dexkit.drivers.dex1_serial.settings:default_path"),
    emulator=Emulator(("dex1-motor", "--side", "{side}"), linked=True, settings=SHARED_MACHINE),
)
