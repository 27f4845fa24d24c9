"""Implement :class:`dexkit.hand.Hand` for the EZGripper, as a Dex1-1, with recovery from faults."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import NoReturn

import numpy as np

from dexkit import documents
from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.command_age import PAUSE, WriteDeadline
from dexkit.drivers.ezgripper import calibration, settings
from dexkit.drivers.ezgripper.block import Goal, Sample
from dexkit.drivers.ezgripper.bus import BusStatistics, Ping, ServoBus
from dexkit.drivers.ezgripper.config import CURRENT_UNIT, GripperRecord, Store, record_key
from dexkit.drivers.ezgripper.control import Control, ControlSettings, Phase
from dexkit.drivers.ezgripper.discovery import (
    Device,
    find_device,
    find_servo,
    latency_timer,
    latency_warning,
)
from dexkit.drivers.ezgripper.force import DEFAULT_FORCE_TABLE, ForceTable
from dexkit.drivers.ezgripper.recovery import RebootPolicy, describe, motor_error
from dexkit.drivers.ezgripper.scaling import (
    TICKS_PER_PERCENT,
    joint_of_ticks,
    joint_speed,
)
from dexkit.drivers.ezgripper.servo import BOOT_TIME, Servo, ServoStatistics, line_time
from dexkit.drivers.serial_port import exchange_period
from dexkit.errors import HandError, HandFault, HandLost, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.models import DEX1_1
from dexkit.wire import mx64
from dexkit.wire.mx64 import HardwareError

__all__ = [
    "Calibrate",
    "EZGripper",
    "GripperSettings",
    "GripperStatistics",
    "ZeroGains",
    "backend",
    "stored_device",
]

log = logging.getLogger(__name__)


class ZeroGains(str, Enum):
    """What a command without gains (kp = kd = dq = tau = 0) does."""

    LIMP = "limp"
    POSITION = "position"

    def __str__(self) -> str:
        return self.value


class Calibrate(str, Enum):
    """Whether ``open`` may move the gripper to find its zero."""

    NO = "no"
    AUTO = "auto"
    YES = "yes"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class GripperSettings:
    """Settings of :class:`EZGripper`.

    :param id: servo id, or None for the only servo that answers.
    :param baudrate: bits a second, or None to try the known ones.
    :param control: limits and times of the control.
    :param calibrate: NO needs a stored zero, and opening never moves; AUTO closes and opens the
        gripper if there is no zero; YES does so always. AUTO and YES act at the first opening only:
        opening again, for example after a lost link, never moves the gripper.
    :param zero: zero in ticks, instead of the stored one.
    :param config: file of the stored calibration; None for the user's file.
    :param force_table: table instead of the stored one.
    :param zero_gains: LIMP: a command whose kp, kd, dq and tau are 0 lets go, as the vendor's
        gripper does. POSITION: it is a position command, for clients that send q alone (SAKE's).
    :param timeout: seconds to wait for a status packet.
    :param retries: how often an unanswered transaction is sent again within an exchange.
    """

    id: int | None = 1
    baudrate: int | None = 1_000_000
    control: ControlSettings = field(default_factory=ControlSettings)
    calibrate: Calibrate = Calibrate.NO
    zero: int | None = None
    config: Path | None = None
    force_table: ForceTable | None = None
    zero_gains: ZeroGains = ZeroGains.LIMP
    timeout: float = 0.03
    retries: int = 2

    def __post_init__(self) -> None:
        if self.id is not None and not 0 <= self.id <= 252:
            raise UsageError(f"id must be 0 to 252, not {self.id}")
        if self.baudrate is not None and self.baudrate not in mx64.BAUD_RATES.values():
            raise UsageError(
                f"an MX-64 has no baud rate {self.baudrate}",
                hint="known: " + ", ".join(str(b) for b in mx64.BAUD_RATES.values()),
            )
        if not 0 < self.timeout <= 1:
            raise UsageError(f"timeout must be within 0 and 1 s, not {self.timeout:g}")
        if not 0 <= self.retries <= 10:
            raise UsageError(f"retries must be 0 to 10, not {self.retries}")


@dataclass
class GripperStatistics:
    """Counters since the object was created.

    :ivar faults: hardware shutdowns of the servo.
    :ivar reboots: reboots to recover from them.
    :ivar resets: times that the servo restarted by itself (a supply dip).
    """

    faults: int = 0
    reboots: int = 0
    resets: int = 0


_LATENCY_TIMER = 1e-3
"""Seconds, assumed for an adapter whose timer the system does not show: a full-speed USB adapter is
polled once per frame of 1 ms."""
_SETUP_TIMEOUT = 0.25
"""Seconds to wait for each status packet while ``open`` configures the servo."""
_TURNAROUND = 0.5e-3
"""Seconds allowed from a status packet to the next request. An exchange takes CPython 0.1 ms of
processor time (benchmarks/bench_serial.py); the rest is for other load on the processor."""

_CLIENT_GAINS = DEX1_1.client_gains

_MAX_RESTART_WAIT = 2.0
"""Seconds that ``open`` waits at most for a reboot to be due; otherwise it raises."""


def _is_shutdown(error: int) -> bool:
    # by default an input voltage error leaves torque on (docs/sources/mx64-ezgripper.md#b6)
    return error > HardwareError.INPUT_VOLTAGE


class _Recovery(Enum):
    NONE = 0
    FAULT = 1
    BOOTING = 2


class EZGripper:
    """A SAKE EZGripper (dual, one MX-64 with Protocol 2.0 firmware) as a Dex1-1.

    :param device: path of the serial port, or USB serial number of the adapter.
    :param side: the side that it serves.
    :param configuration: servo, calibration and control settings.

    ``open`` finds the servo, sets its registers and loads the calibration, without motion (unless
    ``calibrate`` asks for it). Torque is switched on by the first FOC command with kp > 0, also
    after a reboot of the servo; a brake before that exerts no torque. ``close`` switches torque
    off. If the process dies, the servo's bus watchdog stops the motor within 0.5 s.
    """

    def __init__(
        self,
        device: str,
        side: Side = Side.RIGHT,
        configuration: GripperSettings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration if configuration is not None else GripperSettings()
        self.device_name = device
        self.statistics = GripperStatistics()
        self.record = GripperRecord()
        self.ping: Ping | None = None
        self.device: Device | None = None
        self._clock: Clock = clock if clock is not None else RealClock()
        self._servo: Servo | None = None
        self._control: Control | None = None
        self._last: Sample | None = None
        self._force = DEFAULT_FORCE_TABLE
        self._limits = settings.ServoLimits(80, 9.5, 16.0)
        self._policy = RebootPolicy()
        self._moved_for: str | None = None
        self._found: int | None = None
        self._recovery_state = _Recovery.NONE
        self._error = 0
        self._fault = MotorError.NONE
        self._message = ""
        self._since = 0.0
        self._commanded: HandCommand | None = None
        self._overload_at: float | None = None
        self._was_warm = False
        self._extrapolated = False
        self._spec = self._make_spec(side, self.configuration.baudrate or 1_000_000)

    def _make_spec(self, side: Side, baudrate: int, timer: float = _LATENCY_TIMER) -> HandSpec:
        attempts = 1 + self.configuration.retries
        busy = line_time(baudrate)
        return DEX1_1.spec(
            side,
            io_rate=1.0 / exchange_period(busy, timer, _TURNAROUND),
            # the first exchange also switches torque on: two transactions
            exchange_timeout=2 * attempts * (self.configuration.timeout + busy + timer),
        )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand.

        ``io_rate`` is the rate of a host that needs 0.5 ms between two exchanges, at the line's
        baud rate and, once the port is open, the latency timer of its adapter.
        """
        return self._spec

    @property
    def phase(self) -> Phase | None:
        """Phase of the control, or None while the gripper is not open."""
        return self._control.phase if self._control is not None else None

    @property
    def bus_statistics(self) -> BusStatistics:
        """Counters of the line since it was opened."""
        return self._servo.bus.statistics if self._servo is not None else BusStatistics()

    @property
    def servo_statistics(self) -> ServoStatistics:
        """Counters of the exchanges since it was opened."""
        return self._servo.statistics if self._servo is not None else ServoStatistics()

    @property
    def joint_speeds(self) -> tuple[tuple[float, float]]:
        """Speeds of the joint opening and closing, rad/s, for the service's state estimator.

        The calibrated speeds, or the speed limit where it is lower or none was measured.
        """
        limit = self.configuration.control.speed
        per_percent = self._spec.joints[0].stroke / 100
        opening, closing = (
            limit if measured is None else min(measured, limit)
            for measured in (self.record.opening, self.record.closing)
        )
        return ((opening * per_percent, closing * per_percent),)

    def adapt_command(self, command: HandCommand) -> HandCommand:
        """Give a command without gains those of Unitree's client, if ``zero_gains`` is POSITION."""
        if self.configuration.zero_gains is ZeroGains.LIMP or not command.is_limp:
            return command
        kp, kd = _CLIENT_GAINS
        return replace(command, kp=np.full(1, kp), kd=np.full(1, kd))

    @property
    def zero_gains_hint(self) -> str:
        """Advice for a client that sends q without gains."""
        return ", or serve this gripper with --set zero_gains=position"

    # --- opening and closing

    def open(self) -> None:
        """Find and configure the servo, load the calibration; no motion (see ``calibrate``).

        :raises HandNotFound: no such port, or no servo answers.
        :raises HandRefused: no MX-64(2.0), no calibration, a register that does not keep its
            value, or a port that another program uses.
        :raises HandFault: the servo is in shutdown and may not be rebooted yet.
        :raises HandLost, HandTimeout: the port goes away or the servo stops answering.
        """
        if self._servo is not None:
            return
        try:
            servo = self.connect()
            self._control = Control(self._zero(servo), self.configuration.control)
            self._last = servo.sample()
        except BaseException:
            self.close()
            raise
        log.info(
            "EZGripper on %s: servo %d, firmware %d, at %.1f %% of its stroke, %d degC, %.1f V",
            servo.bus.path,
            servo.id,
            self.ping.firmware if self.ping else 0,
            self._control.position(self._last) / TICKS_PER_PERCENT,
            self._last.temperature,
            self._last.voltage * mx64.VOLTAGE_UNIT,
        )

    def connect(self, progress: Callable[[str], None] = log.info) -> Servo:
        """Open the port and configure the servo, without a calibration; :meth:`close` ends it.

        For ``dexkit calibrate``. Raises as :meth:`open`.
        """
        configuration = self.configuration
        device = find_device(self.device_name)
        self.device = device
        warning = latency_warning(device.path)
        if warning:
            log.warning("%s", warning)
        bus = ServoBus(
            device.path,
            configuration.baudrate or 1_000_000,
            timeout=configuration.timeout,
            retries=configuration.retries,
        )
        try:
            self.ping = find_servo(bus, configuration.id, configuration.baudrate, progress)
            servo = Servo(bus, self.ping.id, self._clock)
            self._servo = servo
            timer = latency_timer(device.path)
            self._spec = self._make_spec(
                self._spec.side, bus.baudrate, _LATENCY_TIMER if timer is None else timer * 1e-3
            )
            # a longer time-out: nothing moves yet, and a busy machine may delay an answer
            bus.timeout = max(configuration.timeout, _SETUP_TIMEOUT)
            self._clear_shutdown(servo)
            self._limits = servo.configure()
            bus.timeout = configuration.timeout
        except BaseException:
            bus.close()
            self._servo = None
            raise
        self._recovery_state = _Recovery.NONE
        self.record = Store(configuration.config).read(self.key)
        self._force = configuration.force_table or self.record.force_table or DEFAULT_FORCE_TABLE
        if configuration.force_table is None and not self.record.force_unit_known:
            log.warning(
                "the force_lookup of %s has no unit and is read in units of %s; a table of SAKE's "
                "driver may be in units of register 40. tau_est is wrong then: measure it with "
                "'dexkit calibrate ezgripper --force', or set force_lookup_unit to %r",
                self.key,
                CURRENT_UNIT,
                CURRENT_UNIT,
            )
        return servo

    @property
    def key(self) -> str:
        """Key of this gripper in the calibration file; known once it is connected."""
        if self.device is None or self.ping is None:
            raise UsageError("the gripper has not been opened yet")
        return record_key(self.device.key, self.ping.id)

    def _zero(self, servo: Servo) -> int:
        configuration = self.configuration
        if configuration.zero is not None:
            return configuration.zero
        if self._moved_for == self.key and self._found is not None:
            return self._found
        if self._moved_for is not None:
            # opening again after a lost link must not move the gripper
            raise HandRefused(
                f"the gripper {self.key} has no zero: calibration is not repeated by itself",
                hint="see that it is empty and start again",
            )
        if configuration.calibrate is not Calibrate.YES and self.record.zero is not None:
            return self.record.zero
        if configuration.calibrate is Calibrate.NO:
            raise HandRefused(
                f"the gripper {self.key} has not been calibrated",
                hint=f"empty it and run: dexkit calibrate ezgripper --device {self.device_name}"
                " (or calibrate at every start with --set calibrate=yes)",
            )
        self._moved_for = self.key
        zero = self._found = calibration.find_zero(servo, progress=log.info)
        self.record = replace(self.record, zero=zero)
        if self.device is not None and self.device.serial_number:
            Store(configuration.config).write(self.key, GripperRecord(zero=zero))
        return zero

    def close(self) -> None:
        """Switch torque off and release the port. Failures are logged, not raised."""
        servo, self._servo = self._servo, None
        self._control = None
        self._last = None
        if servo is None:
            return
        try:
            servo.set_torque(False)
        except HandError as error:
            # the servo's bus watchdog stops the motor within 0.5 s
            log.warning("could not switch the motor off: %s", error)
        finally:
            servo.bus.close()
            log.info(
                "EZGripper on %s closed: %s, %s, %s",
                servo.bus.path,
                self.statistics,
                servo.statistics,
                servo.bus.statistics,
            )

    def __enter__(self) -> EZGripper:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Plan and send the goal for ``command``; return the measured state.

        :raises HandFault: the servo has shut down or is rebooting; each further call does one
            bounded step of the recovery.
        :raises HandLost: the port has gone away, or the gripper is not open.
        :raises HandTimeout: no intact answer to any attempt, or this program was paused before the
            goal was written.
        """
        deadline = WriteDeadline(self._clock)
        command = self.adapt_command(command)
        servo, control, last = self._servo, self._control, self._last
        if servo is None or control is None or last is None:
            raise HandLost("the gripper is not open", hint="call open() first")
        if self._recovery_state is not _Recovery.NONE:
            last = self._recovery_step(servo, control)
        if self._clock.now() - last.time > PAUSE:
            last = self._last = servo.sample()  # the fingers moved on during the pause
        goal = control.plan(command, last)
        if goal.current and not last.torque:
            servo.engage(Goal(last.position, goal.current, goal.profile_velocity), deadline)
        sample = servo.exchange(goal, deadline)
        self._check_sample(servo, control, command, sample, engaged=goal.current > 0)
        self._commanded = command
        self._last = sample
        return self._hand_state(control, sample)

    def _check_sample(
        self,
        servo: Servo,
        control: Control,
        command: HandCommand,
        sample: Sample,
        *,
        engaged: bool,
    ) -> None:
        if sample.voltage == 0:
            # voltage 0: the indirect addresses have their defaults, so the servo has restarted
            self.statistics.resets += 1
            self._begin_recovery(
                HardwareError.NONE,
                MotorError.ABNORMAL_RESET,
                command,
                "the servo has restarted by itself",
                hint="is the supply strong enough?",
            )
        if _is_shutdown(sample.error) or (sample.error and engaged and not sample.torque):
            self.statistics.faults += 1
            if sample.error & HardwareError.OVERLOAD:
                self._overload_at = float(control.position(sample))
            self._policy.fault(self._clock.now())
            self._begin_recovery(
                sample.error,
                self._motor_error(sample),
                command,
                f"the servo has shut down: {describe(sample.error)}",
            )
        if engaged and not sample.torque:
            # another program switched torque off: start over as after a reset
            self._begin_recovery(
                HardwareError.NONE,
                MotorError.ABNORMAL_RESET,
                command,
                "the servo's torque was switched off by something else",
            )
        if sample.watchdog == mx64.WATCHDOG_TRIPPED:
            log.warning("the servo's bus watchdog tripped for lack of instructions; clearing it")
            servo.rearm_watchdog()
        if sample.temperature >= control.settings.warm and not self._was_warm:
            log.warning("the servo is at %d degC: effort is reduced", sample.temperature)
        self._was_warm = sample.temperature >= control.settings.warm

    def _motor_error(self, sample: Sample) -> MotorError:
        limits = self._limits
        voltage = sample.voltage * mx64.VOLTAGE_UNIT
        return motor_error(sample.error, voltage, limits.voltage_min, limits.voltage_max)

    def _hand_state(self, control: Control, sample: Sample) -> HandState:
        contact = control.contact
        # sign of the joint: closing is toward smaller q, so gripping torque is negative, as in the
        # vendor's gripper (docs/sources/unitree-dex.md#b7)
        tau = contact.direction * self._force.tau(sample.current) if contact else 0.0
        if contact and not self._extrapolated and not self._force.covers(sample.current):
            self._extrapolated = True
            log.warning(
                "a current of %d units is beyond the force table, which ends at %g: tau_est is "
                "extrapolated (logged once)",
                abs(sample.current),
                self._force.points[-1][0],
            )
        mode = JointMode.BRAKE if control.phase is Phase.BRAKE else JointMode.FOC
        return HandState(
            q=np.array([joint_of_ticks(control.position(sample))]),
            dq=np.array([joint_speed(sample.velocity)]),
            ddq=np.zeros(1),
            tau_est=np.array([tau]),
            temperature=np.array([float(sample.temperature)]),
            voltage=np.array([sample.voltage * mx64.VOLTAGE_UNIT]),
            mode=np.array([mode], dtype=np.uint8),
            fault=np.array([self._motor_error(sample)], dtype=np.uint32),
            stamp=sample.time,
        )

    # --- faults

    def _begin_recovery(
        self,
        error: int,
        fault: MotorError,
        command: HandCommand,
        message: str,
        hint: str = "",
    ) -> NoReturn:
        self._error = error
        self._fault = fault
        self._commanded = command
        self._since = self._clock.now()
        # without an error bit the servo only needs its registers set again
        self._recovery_state = _Recovery.FAULT if error else _Recovery.BOOTING
        self._message = message
        log.error("%s", message)
        raise HandFault(message, bits=(fault,), hint=hint)

    def _recovery_step(self, servo: Servo, control: Control) -> Sample:
        """Do one bounded step of the recovery; return a sample once the servo works again.

        No motion: torque is off after the reboot, and stays off until a command differs from the
        last one.
        """
        now = self._clock.now()
        if self._recovery_state is _Recovery.FAULT:
            temperature = servo.temperature()
            if not self._policy.due(now, self._error, temperature, self._limits.temperature):
                raise self._pending_fault(f"waiting before the restart ({temperature} degC)")
            self._reboot(servo, now)
            raise self._pending_fault("restarting")
        if not servo.answers():
            if now - self._since > BOOT_TIME:
                raise HandTimeout(
                    f"servo {servo.id} on {servo.bus.path} does not come back after its restart",
                    hint="switch its supply off and on",
                )
            raise self._pending_fault("restarting")
        error = servo.hardware_error()
        if _is_shutdown(error):
            self._error = error
            self._recovery_state = _Recovery.FAULT
            self._policy.fault(now)
            raise self._pending_fault("the restart did not help")
        self._limits = servo.configure()
        sample = servo.sample()
        control.recovered(self._commanded, overload_at=self._overload_at)
        self._overload_at = None
        self._recovery_state = _Recovery.NONE
        self._fault = MotorError.NONE
        self._last = sample
        log.warning("the servo works again; its motor is off until a new command comes")
        return sample

    def _reboot(self, servo: Servo, now: float) -> None:
        self.statistics.reboots += 1
        log.warning("restarting the servo after: %s", describe(self._error))
        servo.reboot()
        self._since = now
        self._recovery_state = _Recovery.BOOTING

    def _pending_fault(self, what: str) -> HandFault:
        return HandFault(f"{self._message}; {what}", bits=(self._fault,))

    def _clear_shutdown(self, servo: Servo) -> None:
        """Reboot a servo that is in shutdown at opening, if a reboot is due soon enough."""
        error = servo.hardware_error()
        if not _is_shutdown(error):
            return
        # do not count the fault of the last exchange or opening again
        if self._recovery_state is not _Recovery.FAULT:
            self.statistics.faults += 1
            self._policy.fault(self._clock.now())
        self._error = error
        self._recovery_state = _Recovery.FAULT
        if self._policy.delay <= _MAX_RESTART_WAIT:
            self._clock.sleep_until(self._clock.now() + self._policy.delay)
        temperature = servo.temperature()
        limit = servo.bus.read_item(servo.id, mx64.TEMPERATURE_LIMIT)
        if not self._policy.due(self._clock.now(), error, temperature, limit):
            raise HandFault(
                f"the servo is in shutdown: {describe(error)} ({temperature} degC)",
                bits=(motor_error(error, 0.0, 0.0, 0.0),),
                hint="let it cool down, free the fingers, and try again",
            )
        self._reboot(servo, self._clock.now())
        deadline = self._clock.now() + BOOT_TIME
        while not servo.answers():
            if self._clock.now() > deadline:
                raise HandTimeout(f"servo {servo.id} does not come back after its restart")
        error = servo.hardware_error()
        if _is_shutdown(error):
            raise HandFault(
                f"the servo is in shutdown and a restart does not help: {describe(error)}",
                bits=(motor_error(error, 0.0, 0.0, 0.0),),
            )


# --- the backend


def _in_range(low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise ValueError(f"not within {low:g} and {high:g}")
        return value

    return parse


def _parse_or_auto(text: str) -> int | None:
    return None if text == "auto" else int(text)


def _read_force_table(text: str) -> ForceTable:
    if text == "default":
        return DEFAULT_FORCE_TABLE
    content = documents.read_json(Path(text))
    if not isinstance(content, dict):
        raise ValueError("the file must hold a JSON object")
    return ForceTable.from_mapping(content)


_CONTROL = {f.name for f in fields(ControlSettings)}

_SETTINGS: dict[str, tuple[Callable[[str], object], str]] = {
    "id": (_parse_or_auto, "servo id, or auto for the one that answers (default 1)"),
    "baudrate": (_parse_or_auto, "bits a second, or auto to try those known (default 1000000)"),
    "calibrate": (
        Calibrate,
        "no: needs a stored zero; auto: moves at the start to find one if needed; "
        "yes: always (default no)",
    ),
    "zero": (int, "zero in servo ticks, instead of the stored one"),
    "config": (Path, "calibration file (default the user's)"),
    "force_table": (
        _read_force_table,
        "JSON file {current units: force}, or default (default: as stored)",
    ),
    "zero_gains": (
        ZeroGains,
        "limp: kp = kd = 0 lets go; position: with dq = tau = 0, too, it goes to q (default limp)",
    ),
    "effort": (_in_range(0, 100), "force limit while moving, % (default 50)"),
    "hold_effort": (_in_range(0, 100), "force limit while holding and braking, % (default 15)"),
    "hold_after": (_in_range(0, 60), "seconds of contact until hold_effort (default 0.5)"),
    "speed": (_in_range(0, 1000), "speed limit, % of stroke a second (default 150)"),
    "startup_speed": (_in_range(0, 1000), "speed limit of the first motion, %/s (default 50)"),
    "startup_time": (_in_range(0, 60), "seconds after which that limit ends anyway (default 3)"),
    "warm": (_in_range(0, 80), "degC from which effort is reduced to hold_effort (default 70)"),
    "timeout": (_in_range(0, 1), "seconds to wait for a reply (default 0.03)"),
    "retries": (int, "times that an unanswered request is repeated (default 2)"),
}


def _parse_settings(options: BackendOptions) -> GripperSettings:
    values: dict[str, object] = {}
    for name, text in options.settings.items():
        parse, meaning = _SETTINGS[name]
        try:
            values[name] = parse(text)
        except (ValueError, OSError) as error:
            raise UsageError(f"{name}={text}: {error}", hint=f"{name} is {meaning}") from error
    control = ControlSettings(**{k: v for k, v in values.items() if k in _CONTROL})  # type: ignore[arg-type]
    rest = {k: v for k, v in values.items() if k not in _CONTROL}
    return GripperSettings(control=control, **rest)  # type: ignore[arg-type]


def stored_device(store: Store, side: Side) -> str:
    """USB serial number or path of the adapter that the calibration file names for a side.

    :raises UsageError: it names none.
    """
    device = store.device(side)
    if device is None:
        raise UsageError(
            f"no gripper is given, and {store.path} names none for the {side} hand",
            hint=f"give --device PATH or USB serial number, or {side}_serial in that file",
        )
    log.info("the %s gripper is on %s (%s)", side, device, store.path)
    return device


def _create_hand(options: BackendOptions) -> EZGripper:
    configuration = _parse_settings(options)
    device = options.device or stored_device(Store(configuration.config), options.side)
    return EZGripper(device, options.side, configuration)


backend = Backend(
    summary="SAKE EZGripper with an MX-64 servo (Protocol 2.0) on a serial port",
    model=DEX1_1.name,
    make=_create_hand,
    needs="--device PATH or USB serial number, or left_serial, right_serial, left or right in the "
    "calibration file",
    settings={name: meaning for name, (_, meaning) in _SETTINGS.items()},
)
