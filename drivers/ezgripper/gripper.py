"""Implement :class:`dexkit.hand.Hand` for the EZGripper, as a Dex1-1, with recovery from faults."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.clock import Clock, RealClock
from dexkit.command_age import PAUSE, WriteDeadline
from dexkit.drivers.ezgripper import calibration
from dexkit.drivers.ezgripper.bus import BusStatistics, Ping, ServoBus, ServoSilent
from dexkit.drivers.ezgripper.calibrated_servo import Unit
from dexkit.drivers.ezgripper.calibration_file import CURRENT_UNIT, GripperRecord, Store, record_key
from dexkit.drivers.ezgripper.control import Control, Phase
from dexkit.drivers.ezgripper.discovery import (
    Device,
    find_device,
    find_servo,
    latency_timer,
    latency_warning,
)
from dexkit.drivers.ezgripper.force import DEFAULT_FORCE_TABLE
from dexkit.drivers.ezgripper.register_block import Goal, Sample
from dexkit.drivers.ezgripper.restart import GripperStatistics, Restart
from dexkit.drivers.ezgripper.scaling import STROKE, joint_of_ticks, joint_speed
from dexkit.drivers.ezgripper.servo import Servo, ServoGroup, ServoStatistics, line_time
from dexkit.drivers.ezgripper.settings import (
    PARSERS,
    Calibrate,
    GripperSettings,
    ZeroGains,
    settings_of,
    stored_device,
)
from dexkit.drivers.serial_port import exchange_period
from dexkit.errors import HandError, HandLost, HandRefused, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.lazy import Lazy
from dexkit.models import DEX1_1
from dexkit.wire import mx64

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


_LATENCY_TIMER = 1e-3
"""Seconds, assumed for an adapter whose timer the system does not show: a full-speed USB adapter is
polled once per frame of 1 ms."""
_SETUP_TIMEOUT = 0.25
"""Seconds to wait for each status packet while ``open`` configures the servo."""
_TURNAROUND = 0.5e-3
"""Seconds allowed from a status packet to the next request. An exchange takes CPython 0.1 ms of
processor time (benchmarks/bench_serial.py); the rest is for other load on the processor."""

_BEYOND = 0.1
"""Distance beyond the stroke, as a part of it, at which a servo's zero is rejected."""
_CLIENT_GAINS = DEX1_1.gains[0]


class EZGripper:
    """A SAKE EZGripper (MX-64 with Protocol 2.0 firmware) as a Dex1-1.

    The dual gripper has one servo; the quad gripper has two on one line, which are one joint here
    (docs/ezgripper.md).

    :param device: path of the serial port, or USB serial number of the adapter.
    :param side: the side that it serves.
    :param configuration: servo, calibration and control settings.

    ``open`` finds the servos, sets their registers and loads the calibration, without motion
    (unless ``calibrate`` asks for it). Torque is switched on by the first FOC command with kp > 0,
    also after a reboot of a servo; a brake before that exerts no torque. ``close`` switches torque
    off. If the process dies, each servo's bus watchdog stops its motor within 0.5 s.
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
        self.device: Device | None = None
        self._clock: Clock = clock if clock is not None else RealClock()
        self._units: list[Unit] = []
        self._known: list[Unit] = []
        """The servos of the last connection: their keys and records stay."""
        self._moved_for: set[str] = set()
        self._found: dict[str, int] = {}
        self._restart = Restart(self._clock)
        self._extrapolated = False
        self._spec = self._make_spec(side, self.configuration.baudrate or 1_000_000)

    def _make_spec(self, side: Side, baudrate: int, timer: float = _LATENCY_TIMER) -> HandSpec:
        attempts = 1 + self.configuration.retries
        servos = len(self.configuration.servo_ids)
        busy = line_time(baudrate, servos=servos)
        # the first exchange also switches each torque on; of two servos, a missing one is looked
        # for with a ping
        transactions = 2 if servos == 1 else (1 + servos) + servos
        return DEX1_1.spec(
            side,
            io_rate=1.0 / exchange_period(busy, timer, _TURNAROUND),
            exchange_timeout=transactions * attempts * (self.configuration.timeout + busy + timer),
        )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand.

        ``io_rate`` is the rate of a host that needs 0.5 ms between two exchanges, at the line's
        baud rate and, once the port is open, the latency timer of its adapter.
        """
        return self._spec

    @property
    def statistics(self) -> GripperStatistics:
        """Counters of faults since the object was created."""
        return self._restart.statistics

    @property
    def servos(self) -> tuple[Servo, ...]:
        """The servos, while the gripper is connected."""
        return tuple(unit.servo for unit in self._units)

    @property
    def _servo(self) -> Servo | None:
        return self._units[0].servo if self._units else None

    @property
    def ping(self) -> Ping | None:
        """Model and firmware of the first servo; None before it was connected."""
        return self._known[0].ping if self._known else None

    @property
    def record(self) -> GripperRecord:
        """Stored calibration of the first servo."""
        return self._known[0].record if self._known else GripperRecord()

    @property
    def phase(self) -> Phase | None:
        """Phase of the (first) servo's control, or None while the gripper is not open."""
        control = self._units[0].control if self._units else None
        return control.phase if control is not None else None

    @property
    def bus_statistics(self) -> BusStatistics:
        """Counters of the line since it was opened."""
        return self._servo.bus.statistics if self._servo is not None else BusStatistics()

    @property
    def servo_statistics(self) -> ServoStatistics:
        """Counters of the (first) servo's exchanges since it was opened."""
        return self._servo.statistics if self._servo is not None else ServoStatistics()

    @property
    def joint_speeds(self) -> tuple[tuple[float, float]]:
        """Speeds of the joint opening and closing, rad/s, for the service's state estimator.

        The calibrated speeds, or the speed limit where it is lower or none was measured; those of
        the slower servo.
        """
        limit = self.configuration.control.speed
        per_percent = self._spec.joints[0].stroke / 100
        records = [unit.record for unit in self._known]
        opening, closing = (
            min([limit, *(speed for speed in measured if speed is not None)])
            for measured in ([r.opening for r in records], [r.closing for r in records])
        )
        return ((opening * per_percent, closing * per_percent),)

    def adapt_command(self, command: HandCommand) -> HandCommand:
        """Add the gains of Unitree's client to a command without gains, if ``zero_gains`` is
        POSITION.
        """
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
        """Find and configure the servos, load the calibration; no motion (see ``calibrate``).

        :raises HandNotFound: no such port, or a servo does not answer.
        :raises HandRefused: no MX-64(2.0), no calibration, a register that does not keep its
            value, or a port that another program uses.
        :raises HandFault: a servo is in shutdown and may not be rebooted yet.
        :raises HandLost, HandTimeout: the port goes away or a servo stops answering.
        """
        if self._units:
            return
        try:
            may_move = not self._moved_for
            # no register is written to a servo that is refused
            self._connect(log.info, lambda unit: self._known_zero(unit, may_move=may_move))
            for unit in self._units:
                zero = self._known_zero(unit, may_move=may_move)
                if zero is None:
                    zero = self._find_zero(unit)
                unit.control = Control(zero, self.configuration.control, stroke=unit.stroke)
            for unit in self._units:
                unit.last = unit.servo.sample()
            self._check_places()
        except BaseException:
            self.close()
            raise
        for unit in self._units:
            control, sample = unit.working
            log.info(
                "EZGripper on %s: servo %d, firmware %d, at %.1f %% of its stroke, %d degC, %.1f V",
                unit.servo.bus.path,
                unit.servo.id,
                unit.ping.firmware,
                100 * control.position(sample) / unit.stroke,
                sample.temperature,
                sample.voltage * mx64.VOLTAGE_UNIT,
            )

    def connect(self, progress: Callable[[str], None] = log.info) -> Servo:
        """Open the port and configure the servos, without a calibration; :meth:`close` ends it.

        For ``dexkit calibrate``. Returns the first servo. Raises as :meth:`open`.
        """
        return self._connect(progress, lambda unit: None)

    def _connect(self, progress: Callable[[str], None], check: Callable[[Unit], object]) -> Servo:
        """:meth:`connect`.

        :param check: called with each servo that was found, before any register is written.
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
        units: list[Unit] = []
        try:
            rate = configuration.baudrate
            for number in configuration.servo_ids:
                units.append(self._find_unit(bus, device, number, rate, progress))
                rate = bus.baudrate
            for unit in units:
                check(unit)
            self._units, self._known = units, list(units)
            self._group = ServoGroup([unit.servo for unit in units], self._clock)
            timer = latency_timer(device.path)
            self._spec = self._make_spec(
                self._spec.side, bus.baudrate, _LATENCY_TIMER if timer is None else timer * 1e-3
            )
            # a longer time-out: nothing moves yet, and a busy machine may delay an answer
            bus.timeout = max(configuration.timeout, _SETUP_TIMEOUT)
            self._restart.connected(units, self._group)
            self._restart.clear_shutdown()
            for unit in units:
                unit.limits = unit.servo.configure(mirrored=unit.mirrored)
            bus.timeout = configuration.timeout
        except BaseException:
            bus.close()
            self._units = []
            raise
        self._restart.opened()
        return units[0].servo

    def _find_unit(
        self,
        bus: ServoBus,
        device: Device,
        number: int | None,
        baudrate: int | None,
        progress: Callable[[str], None],
    ) -> Unit:
        configuration = self.configuration
        ping = find_servo(bus, number, baudrate, progress)
        key = record_key(device.key, ping.id)
        record = Store(configuration.config).read(key)
        if configuration.force_table is None and not record.force_unit_known:
            log.warning(
                "the force_lookup of %s has no unit and is read in units of %s; a table of SAKE's "
                "driver may be in units of register 40. tau_est is wrong then: measure it with "
                "'dexkit calibrate ezgripper --measure force', or set force_lookup_unit to %r",
                key,
                CURRENT_UNIT,
                CURRENT_UNIT,
            )
        mirrored, stroke = configuration.mirrored, configuration.stroke
        return Unit(
            Servo(bus, ping.id, self._clock),
            ping,
            key,
            record,
            configuration.force_table or record.force_table or DEFAULT_FORCE_TABLE,
            bool(record.mirrored if mirrored is None else mirrored),
            stroke or record.stroke or STROKE,
        )

    @property
    def key(self) -> str:
        """Key of the (first) servo in the calibration file; known once it is connected."""
        if not self._known:
            raise UsageError("the gripper has not been opened yet")
        return self._known[0].key

    @property
    def units(self) -> Sequence[Unit]:
        """The servos with key, record, stroke; while the gripper is connected."""
        return tuple(self._units)

    def _known_zero(self, unit: Unit, *, may_move: bool) -> int | None:
        """Zero of a servo: given, stored, or found by an earlier motion; None to find it by one.

        :param may_move: no earlier opening has moved it; opening again after a lost link must not.
        :raises HandRefused: it has none, and may not be moved.
        """
        configuration = self.configuration
        if configuration.zero is not None:
            return configuration.zero
        if unit.key in self._found:
            return self._found[unit.key]
        if not may_move:
            raise HandRefused(
                f"the gripper {unit.key} has no zero: calibration is not repeated automatically",
                hint="check that it is empty, and start again",
            )
        if configuration.calibrate is not Calibrate.YES and unit.record.zero is not None:
            return unit.record.zero
        if configuration.calibrate is Calibrate.NO:
            number = f" --id {unit.servo.id}" if unit.servo.id != 1 else ""
            raise HandRefused(
                f"the gripper {unit.key} has not been calibrated",
                hint=f"empty it and run: dexkit calibrate ezgripper --device {self.device_name}"
                f"{number} (or calibrate at every start with --set calibrate=yes)",
            )
        return None

    def _find_zero(self, unit: Unit) -> int:
        """Zero of a servo, found by a motion."""
        configuration = self.configuration
        self._moved_for.add(unit.key)
        zero = calibration.find_zero(unit.servo, stroke=unit.stroke, progress=log.info)
        self._found[unit.key] = zero
        unit.record = replace(unit.record, zero=zero)
        if self.device is not None and self.device.serial_number:
            Store(configuration.config).write(unit.key, GripperRecord(zero=zero))
        return zero

    def _check_places(self) -> None:
        """Refuse two servos whose zeros do not fit them, as when their ids were exchanged.

        :raises HandRefused: one is where no fingers can be.
        """
        for unit in self._units if len(self._units) > 1 else ():
            control, sample = unit.working
            part = control.position(sample) / unit.stroke
            if not -_BEYOND <= part <= 1 + _BEYOND:
                raise HandRefused(
                    f"servo {unit.servo.id} is at {part:.0%} of its stroke: the stored zero is not "
                    "that of this servo",
                    hint="were the servos' ids exchanged? Calibrate each again: dexkit calibrate "
                    f"ezgripper --device {self.device_name} --id {unit.servo.id}",
                )

    def close(self) -> None:
        """Switch torque off and release the port. Failures are logged, not raised."""
        units, self._units = self._units, []
        if not units:
            return
        try:
            for unit in units:
                try:
                    unit.servo.set_torque(False)
                except HandError as error:
                    # the servo's bus watchdog stops the motor within 0.5 s
                    log.warning("could not switch motor %d off: %s", unit.servo.id, error)
        finally:
            bus = units[0].servo.bus
            bus.close()
            log.info(
                "EZGripper on %s closed: %s, %s, %s",
                bus.path,
                self.statistics,
                ", ".join(str(unit.servo.statistics) for unit in units),
                bus.statistics,
            )

    def __enter__(self) -> EZGripper:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Plan and send the goals for ``command``; return the measured state.

        :raises HandFault: a servo has shut down or is rebooting; each further call does one
            bounded step of the recovery.
        :raises HandLost: the port has gone away, or the gripper is not open.
        :raises HandTimeout: no intact answer to any attempt, or this program was paused before the
            goal was written.
        """
        deadline = WriteDeadline(self._clock)
        command = self.adapt_command(command)
        if not self._units or self._units[-1].last is None:
            raise HandLost("the driver is not connected to the gripper", hint="call open() first")
        if self._restart.active:
            self._restart.step()
        try:
            samples, engaged = self._exchange_goals(command, deadline)
            for unit, sample in zip(self._units, samples, strict=True):
                self._restart.check(unit, command, sample, engaged=engaged)
        except ServoSilent as error:
            if len(self._units) > 1:
                self._restart.lost_servo(command, error)
            raise
        self._restart.note_command(command)
        for unit, sample in zip(self._units, samples, strict=True):
            unit.last = sample
        return self._hand_state(samples)

    def _exchange_goals(
        self, command: HandCommand, deadline: WriteDeadline
    ) -> tuple[list[Sample], bool]:
        """Samples of all servos, and whether their motors are driven."""
        reduced = [unit.working[0].reduced for unit in self._units]
        goals = []
        for unit in self._units:
            control, last = unit.working
            if self._clock.now() - last.time > PAUSE:
                last = unit.last = unit.servo.sample()  # the fingers moved on during the pause
            control.partner_reduced = any(reduced)
            goals.append(control.plan(command, last))
        # the controls have the same commands, so that all of them drive or none
        engaged = any(goal.current > 0 for goal in goals)
        for unit, goal in zip(self._units, goals, strict=True):
            _, last = unit.working
            if goal.current and not last.torque:
                start = Goal(last.position, goal.current, goal.profile_velocity)
                unit.servo.engage(start, deadline)
        return self._group.exchange(goals, deadline), engaged

    def _tau(self, unit: Unit, sample: Sample) -> float:
        contact = unit.working[0].contact
        if not contact:
            return 0.0
        if not self._extrapolated and not unit.force.covers(sample.current):
            self._extrapolated = True
            log.warning(
                "a current of %d units is beyond the force table, which ends at %g: tau_est is "
                "extrapolated (logged once)",
                abs(sample.current),
                unit.force.points[-1][0],
            )
        # sign of the joint: closing is toward smaller q, so gripping torque is negative, as in the
        # vendor's gripper (docs/sources/unitree-dex.md#b7)
        return contact.direction * unit.force.tau(sample.current)

    def _hand_state(self, samples: Sequence[Sample]) -> HandState:
        """The state of the joint: of two servos the mean position and the sum of the forces."""
        q = dq = tau = 0.0
        fault = MotorError.NONE
        for unit, sample in zip(self._units, samples, strict=True):
            position = unit.working[0].position(sample)
            q += joint_of_ticks(position, unit.stroke) / len(samples)
            dq += joint_speed(sample.velocity, unit.stroke) / len(samples)
            tau += self._tau(unit, sample)
            if sample.error:
                fault |= unit.motor_error(sample)
        braking = self.phase is Phase.BRAKE
        mode = JointMode.BRAKE if braking else JointMode.FOC
        return HandState(
            q=np.array([q]),
            dq=np.array([dq]),
            ddq=np.zeros(1),
            tau_est=np.array([tau]),
            temperature=np.array([float(max(sample.temperature for sample in samples))]),
            voltage=np.array([min(sample.voltage for sample in samples) * mx64.VOLTAGE_UNIT]),
            mode=np.array([mode], dtype=np.uint8),
            fault=np.array([fault], dtype=np.uint32),
            stamp=min(sample.time for sample in samples),
        )


# --- the backend


def _create_hand(options: BackendOptions) -> EZGripper:
    configuration = settings_of(options)
    store = Store(configuration.config)
    device = options.device or stored_device(store, options.side)
    if not options.device and not {"id", "ids"} & options.settings.keys():
        configuration = replace(configuration, ids=store.servo_ids(options.side))
    return EZGripper(device, options.side, configuration)


_EMULATED_ZERO = "1510"
"""Encoder tick of an emulated servo's zero; the driver gets it as well, and need not calibrate."""

backend = Backend(
    summary="SAKE EZGripper with an MX-64 servo (Protocol 2.0) on a serial port",
    model=DEX1_1.name,
    make=_create_hand,
    needs="--device PATH or USB serial number, or left_serial, right_serial, left or right in the "
    "calibration file",
    settings={name: meaning for name, (_, meaning) in PARSERS.items()},
    bringup=Lazy("dexkit.drivers.ezgripper.bringup:bench"),
    settings_file=Lazy("dexkit.drivers.ezgripper.calibration_file:default_path"),
    emulator=Emulator(
        ("mx64", "--set", f"closed-at={_EMULATED_ZERO}"),
        linked=True,
        settings={**SHARED_MACHINE, "zero": _EMULATED_ZERO},
    ),
)
