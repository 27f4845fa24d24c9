"""Bring up a Dex1-1: motors, measurements and stored settings of ``dexkit bringup dex1-serial``."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from dexkit.backends import BackendOptions
from dexkit.bringup.bench import Drive, Plan, Reading, Snapshot, gripper_choices
from dexkit.bringup.findings import Findings
from dexkit.bringup.settings_file import SettingsFile
from dexkit.drivers.dex1_serial.discovery import list_ports
from dexkit.drivers.dex1_serial.line import MotorLine, acquire
from dexkit.drivers.dex1_serial.settings import Dex1Settings, default_path, from_options
from dexkit.drivers.serial_port import find_device, is_pseudo_terminal
from dexkit.errors import HandError, HandLost, HandNotFound, HandRefused, HandTimeout
from dexkit.hand import MotorError, Side
from dexkit.models import DEX1_1
from dexkit.wire.m4010 import BROADCAST_ID, GEAR_RATIO, STROKE, MotorCmd, MotorData

__all__ = ["Dex1Bench", "Exchange", "bench", "plan_of"]

log = logging.getLogger(__name__)

_RATIOS = (15.0, 40.0)
"""Plausible gear ratios. The vendor's library uses 25; no document says that every motor has it
(docs/sources/unitree-dex.md#g)."""
_SCAN_TIMEOUT = 0.1
"""Seconds to wait for an id: a busy machine must not hide a motor."""
_TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)

Exchange = Callable[[MotorCmd], MotorData]
"""Sends a command and returns the answer.

:raises HandTimeout: there is none.
"""


def plan_of(side: Side) -> Plan:
    """Plan the bring-up of a Dex1-1: which motor on the line belongs to this side."""
    return Plan(
        gripper_choices(DEX1_1, side, _RATIOS, travel=STROKE, first=1),
        GEAR_RATIO,
        part="gripper",
        nudge=0.5,
        speed=0.5,
    )


class Dex1Bench:
    """The motors on one line, one of which moves the gripper that is being brought up.

    :param configuration: port, baud rate and time-outs; what describes the gripper is found.
    :param wire: exchanges frames with motors that are on no serial port, for tests.
    """

    def __init__(
        self, side: Side, configuration: Dex1Settings, wire: Exchange | None = None
    ) -> None:
        self.side = side
        self.plan = plan_of(side)
        self.configuration = configuration
        self._file = SettingsFile(configuration.config or default_path(), "dex1-serial")
        self._wire = wire
        self._line: MotorLine | None = None
        self._tripped: set[int] = set()
        self._motors: tuple[int, ...] = ()
        self._facts: dict[str, Any] = {"side": str(side)}

    @property
    def motors(self) -> tuple[str, ...]:
        """Ids of the motors that answer."""
        return tuple(map(str, self._motors))

    @property
    def facts(self) -> Mapping[str, Any]:
        """The adapter and the motors; the protocol has neither serial number nor version."""
        return self._facts

    @property
    def where(self) -> str:
        """Path of the settings file."""
        return str(self._file.path)

    @property
    def emulated(self) -> bool:
        """Whether the line is a pseudo-terminal."""
        return self._line is not None and is_pseudo_terminal(self._line.path)

    def open(self) -> None:
        """Find the line and the motors on it. They are braked; no motion.

        :raises HandNotFound: no port, or no motor on any.
        :raises HandRefused: more than one port has motors.
        :raises HandError: as :func:`~dexkit.drivers.dex1_serial.line.acquire`.
        """
        if self._wire is None:
            self._wire = self._connect()
        else:
            self._motors = self._scan(self._wire)
        self._facts |= {"motors": list(self.motors)}

    def _connect(self) -> Exchange:
        configuration = self.configuration
        named = configuration.device
        ports = list_ports(configuration.ports) if named is None else [find_device(named).path]
        found: list[tuple[MotorLine, tuple[int, ...]]] = []
        try:
            for port in ports:
                line = acquire(port, configuration.baudrate)
                found.append((line, ()))
                patient = max(configuration.timeout, _SCAN_TIMEOUT)
                found[-1] = line, self._scan(self._exchange_on(line, patient))
            answering = [entry for entry in found if entry[1]]
            if not answering:
                raise HandNotFound(
                    f"no motor answers at {configuration.baudrate} baud on "
                    f"{', '.join(ports) or 'any port: there is none'}",
                    hint="is its 24 V supply on, and the adapter plugged in? --device PATH",
                )
            if len(answering) > 1:
                raise HandRefused(
                    f"motors answer on {', '.join(line.path for line, _ in answering)}",
                    hint="say which line: --device PATH",
                )
        except BaseException:
            for line, _ in found:
                line.release()
            raise
        for line, motors in found:
            if not motors:
                line.release()
        self._line, self._motors = answering[0]
        device = find_device(self._line.path)
        self._facts |= {
            "adapter": device.serial_number or "without serial number",
            "port": device.path,
            "baudrate": configuration.baudrate,
        }
        return self._exchange_on(self._line)

    def _exchange_on(self, line: MotorLine, timeout: float | None = None) -> Exchange:
        timeout = timeout or self.configuration.timeout
        return lambda command: line.exchange(command.pack(), command.id, timeout)

    @staticmethod
    def _scan(wire: Exchange) -> tuple[int, ...]:
        """Ids that answer a brake, each asked twice at most."""
        found = []
        for number in range(BROADCAST_ID):
            for _ in range(2):
                try:
                    wire(MotorCmd(number))
                except HandTimeout:
                    continue
                found.append(number)
                break
        return tuple(found)

    def close(self) -> None:
        """Brake every motor and release the line. Failures are logged, not raised."""
        try:
            if self._motors:
                self.exchange(None)
        except HandError as error:
            log.warning("could not brake the motors: %s; they stop within a second", error)
        finally:
            self._motors = ()
            if self._line is not None:
                self._line.release()
                self._line = self._wire = None

    def exchange(self, drive: Drive | None) -> Snapshot:
        """Drive one motor, with its own protection, and brake all others.

        :raises HandLost: the port has gone away, or is not open.
        """
        if self._wire is None or not self._motors:
            raise HandLost("the driver is not connected to the gripper", hint="call open() first")
        readings = {}
        # the driven one last: another that does not answer must not delay its lock
        driven = None if drive is None else int(drive.motor)
        for number in sorted(self._motors, key=lambda n: n == driven):
            command = MotorCmd(number)  # without the time-out bit, which clears a trip
            if drive is not None and number == driven and number not in self._tripped:
                command = MotorCmd.setpoint(
                    number, q=drive.q, kp=drive.kp, kd=drive.kd, timeout=True
                )
            try:
                data = self._wire(command)
            except HandTimeout:
                continue
            self._tripped ^= {number} & self._tripped
            if data.timeout:
                self._tripped.add(number)
            readings[str(number)] = Reading(
                data.joint().q,
                data.merror & ~_TRIPPED,
                float(max(data.temp, data.winding)),
            )
        return Snapshot(readings)

    # --- results

    def settings(self, findings: Findings) -> dict[str, str]:
        """Settings that follow from the findings; the mounting only once the travel is known."""
        name = str(self.side)
        texts: dict[str, str] = {}
        adapter = None if self._line is None else find_device(self._line.path).serial_number
        if adapter:
            texts["adapter"] = adapter
        for motor in findings.motors_of(name):
            texts["id"] = motor
            texts["sign"] = "+" if findings.motors[motor].sign > 0 else "-"
        if name in findings.travel:
            travel = findings.travel[name]
            texts |= {"ratio": f"{travel.ratio:g}", "offset": f"{travel.offset:.4f}"}
            return texts
        return {}

    def load(self) -> Findings:
        """Load the stored findings of this side's gripper."""
        return self._file.load(str(self.side))

    def store(self, findings: Findings) -> None:
        """Write settings, findings and answers under the side."""
        self._file.store(str(self.side), self.settings(findings), self._facts, findings)


def bench(options: BackendOptions) -> Dex1Bench:
    """The bench of ``dexkit bringup dex1-serial``."""
    return Dex1Bench(options.side, from_options(options))
