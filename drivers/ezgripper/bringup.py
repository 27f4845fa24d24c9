"""Bring up an EZGripper: servos, measurements and stored settings of ``dexkit bringup
ezgripper``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from dexkit.backends import BackendOptions
from dexkit.bringup.bench import Drive, Plan, Reading, Snapshot, gripper_choices
from dexkit.bringup.findings import Findings
from dexkit.bringup.script import travel_key
from dexkit.bringup.settings_file import SettingsFile
from dexkit.clock import Clock
from dexkit.drivers.ezgripper.bus import ServoBus
from dexkit.drivers.ezgripper.calibration_file import GripperRecord, Store, record_key
from dexkit.drivers.ezgripper.discovery import find_device, find_servos, latency_warning
from dexkit.drivers.ezgripper.recovery import motor_error
from dexkit.drivers.ezgripper.register_block import Goal, Sample
from dexkit.drivers.ezgripper.scaling import (
    CURRENT_LIMIT,
    JOINT_PER_TICK,
    STROKE,
    STROKES,
)
from dexkit.drivers.ezgripper.servo import Servo, ServoGroup
from dexkit.drivers.ezgripper.servo_registers import ServoLimits
from dexkit.drivers.ezgripper.settings import GripperSettings, settings_of, stored_device
from dexkit.drivers.serial_port import is_pseudo_terminal
from dexkit.errors import HandError, HandLost
from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.wire import mx64

__all__ = ["EZGripperBench", "bench", "plan_of"]

log = logging.getLogger(__name__)

_TORQUE_OF_AMPERE = 6.0 / 4.1
"""N·m of the servo's shaft per A: its stall at 12 V (docs/sources/mx64-ezgripper.md#b1)."""
_JOINT_TORQUE = _TORQUE_OF_AMPERE * mx64.CURRENT_UNIT * mx64.TICK / JOINT_PER_TICK
"""N·m at the joint of one unit of current."""
_WIDEST = 1.2
"""Largest opening, as a multiple of SAKE's stroke."""


def plan_of(side: Side) -> Plan:
    """Plan the bring-up: which servos move this side's gripper, and where it is closed."""
    return Plan(
        gripper_choices(
            DEX1_1,
            side,
            (STROKES[0] / STROKE, _WIDEST),
            # closed first: whether there is a stop at the open end is not documented, and a tendon
            # must not be wound up the other way
            first=-1,
            most_travel=_WIDEST * DEX1_1.joints[side][0].stroke,
            motors=2,
        ),
        1.0,
        part="gripper",
        nudge=0.5,
        # 15 and 30 % effort: what holds an object, and what SAKE closes with to find the zero
        torque=round(0.15 * CURRENT_LIMIT * _JOINT_TORQUE, 2),
        most_torque=round(0.30 * CURRENT_LIMIT * _JOINT_TORQUE, 2),
        speed=0.5,
    )


class EZGripperBench:
    """The servos on one line, of which one or two move the gripper that is being brought up.

    :param configuration: baud rate, time-outs and file; what describes the gripper is found.
    :param bus: a line that is no serial port, for tests.
    """

    def __init__(
        self,
        device: str,
        side: Side,
        configuration: GripperSettings,
        *,
        bus: ServoBus | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.side = side
        self.plan = plan_of(side)
        self.configuration = configuration
        self._device_name = device
        self._store = Store(configuration.config)
        self._file = SettingsFile(self._store.path, "ezgripper")
        self._given_bus = bus
        self._clock = clock
        self._servos: dict[str, Servo] = {}
        self._limits: dict[str, ServoLimits] = {}
        self._last: dict[str, Sample] = {}
        self._held: dict[str, Goal] = {}
        """Goals of the servos that have been driven: where they are held."""
        self._key = device
        self._path = ""
        self._facts: dict[str, Any] = {"side": str(side)}

    @property
    def motors(self) -> tuple[str, ...]:
        """Ids of the servos that answer."""
        return tuple(self._servos)

    @property
    def facts(self) -> Mapping[str, Any]:
        """The adapter, and model and firmware of each servo."""
        return self._facts

    @property
    def where(self) -> str:
        """Path of the calibration file."""
        return str(self._store.path)

    @property
    def emulated(self) -> bool:
        """Whether the line is a pseudo-terminal."""
        return bool(self._path) and is_pseudo_terminal(self._path)

    def open(self) -> None:
        """Find the servos, switch them off and set their registers; no motion.

        :raises HandNotFound: no such port, or no servo on it.
        :raises HandRefused: one is no MX-64(2.0), or another program uses the port.
        :raises HandError: as :meth:`~dexkit.drivers.ezgripper.servo.Servo.configure`.
        """
        bus = self._given_bus
        if bus is None:
            device = find_device(self._device_name)
            self._key, self._path = device.key, device.path
            warning = latency_warning(device.path)
            if warning:
                log.warning("%s", warning)
            configuration = self.configuration
            bus = ServoBus(
                device.path,
                configuration.baudrate or 1_000_000,
                timeout=configuration.timeout,
                retries=configuration.retries,
            )
        try:
            pings = find_servos(bus, self.configuration.baudrate)
            for ping in pings:
                servo = Servo(bus, ping.id, self._clock)
                servo.set_torque(False)
                # the encoder's own direction: which way it counts is what is to be found
                self._limits[str(ping.id)] = servo.configure()
                self._servos[str(ping.id)] = servo
                self._last[str(ping.id)] = servo.sample()
        except BaseException:
            bus.close()
            raise
        self._group = ServoGroup(list(self._servos.values()), self._clock)
        self._facts |= {
            "adapter": self._key,
            "baudrate": bus.baudrate,
            "servos": [f"id {p.id}: MX-64(2.0), firmware {p.firmware}" for p in pings],
        }

    def close(self) -> None:
        """Switch every motor off and release the line. Failures are logged, not raised."""
        servos, self._servos = self._servos, {}
        for servo in servos.values():
            try:
                servo.set_torque(False)
            except HandError as error:
                log.warning(
                    "could not switch motor %d off: %s; it stops by itself", servo.id, error
                )
        for servo in servos.values():
            servo.bus.close()

    def exchange(self, drive: Drive | None) -> Snapshot:
        """Drive one servo and hold the others that were driven; those that were not stay off.

        :raises HandLost: the port has gone away, or is not open.
        :raises HandTimeout: a servo does not answer.
        """
        if not self._servos:
            raise HandLost("the driver is not connected to the gripper", hint="call open() first")
        for motor, sample in self._last.items():
            if drive is not None and motor == drive.motor:
                current = min(round(drive.torque / _JOINT_TORQUE), CURRENT_LIMIT)
                # without a profile: the goal is never far ahead of the servo
                self._held[motor] = Goal(round(drive.q / JOINT_PER_TICK), current, 0)
                if not sample.torque:
                    self._servos[motor].engage(Goal(sample.position, current, 0))
            elif motor in self._held and self._driven == motor:
                # hold it where it is now
                self._held[motor] = Goal(sample.position, self._held[motor].current, 0)
        self._driven = None if drive is None else drive.motor
        goals = [self._held.get(m) or Goal(s.position, 0, 0) for m, s in self._last.items()]
        samples = self._group.exchange(goals)
        self._last = dict(zip(self._last, samples, strict=True))
        for motor, sample in self._last.items():
            if sample.watchdog == mx64.WATCHDOG_TRIPPED:
                self._servos[motor].rearm_watchdog()
        return Snapshot({motor: self._reading(motor, s) for motor, s in self._last.items()})

    _driven: str | None = None

    def _reading(self, motor: str, sample: Sample) -> Reading:
        limits = self._limits[motor]
        voltage = sample.voltage * mx64.VOLTAGE_UNIT
        fault = motor_error(sample.error, voltage, limits.voltage_min, limits.voltage_max)
        return Reading(sample.position * JOINT_PER_TICK, int(fault), float(sample.temperature))

    # --- results

    def records(self, findings: Findings) -> dict[int, GripperRecord]:
        """Calibration records of this side's servos, once all of them are known."""
        joint = next(j for j in self.plan.joints if j.wanted)
        found: dict[int, GripperRecord] = {}
        for motor in findings.motors_of(joint.name):
            travel = findings.travel.get(travel_key(joint, motor))
            if travel is None:
                return {}
            mirrored = findings.motors[motor].sign < 0
            closed = round(travel.offset * travel.ratio / JOINT_PER_TICK)
            found[int(motor)] = GripperRecord(
                zero=(-closed if mirrored else closed) % mx64.TICKS_PER_TURN,
                mirrored=mirrored,
                stroke=round(travel.ratio * STROKE),
            )
        return found

    def settings(self, findings: Findings) -> dict[str, str]:
        """Settings that follow from the findings; for two servos only the ids; the others are in
        the file.
        """
        records = self.records(findings)
        if not records:
            return {}
        if len(records) > 1:
            return {"ids": ",".join(map(str, records))}
        ((number, record),) = records.items()
        return {
            "id": str(number),
            "sign": "-" if record.mirrored else "+",
            "zero": str(record.zero),
            "stroke": str(record.stroke),
        }

    @property
    def _findings_key(self) -> str:
        return f"{self.side}_bringup"

    def load(self) -> Findings:
        """Load the stored findings of this side's gripper."""
        return self._file.load(self._findings_key)

    def store(self, findings: Findings) -> None:
        """Write findings and answers; once complete, also zeros and ids in the format of SAKE's
        file.
        """
        self._file.store(self._findings_key, self.settings(findings), self._facts, findings)
        records = self.records(findings)
        for number, record in records.items():
            self._store.write(record_key(self._key, number), record)
        if records:
            self._store.write_side(self.side, self._key, list(records))


def bench(options: BackendOptions) -> EZGripperBench:
    """The bench of ``dexkit bringup ezgripper``."""
    configuration = settings_of(options)
    device = options.device or stored_device(Store(configuration.config), options.side)
    return EZGripperBench(device, options.side, configuration)
