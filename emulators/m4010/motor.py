"""Emulate one M4010 with the gripper on its shaft, without I/O: a command in, a data frame out.

It keeps its last command until the next one and runs its own time-out protection: a pulled cable
does not stop it, the protection does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from dexkit.emulators.dex1_mechanics import STEP, Dex1Mechanics
from dexkit.emulators.faults import Fault
from dexkit.emulators.joint_mechanics import FixedSteps
from dexkit.emulators.m4010.settings import Firmware, Heat
from dexkit.errors import UsageError
from dexkit.hand import JointMode, MotorError
from dexkit.wire.m4010 import (
    BROADCAST_ID,
    GEAR_RATIO,
    Calibration,
    CalibrationProblem,
    MotorCmd,
    MotorData,
    Status,
)
from dexkit.wire.mounting import Mounting

__all__ = ["LOCKING", "Motor"]

LOCKING = 1.0
"""Self-locking: the jaws hold an object without motor torque."""
_MAX_CATCH_UP = 10.0  # seconds; of a longer pause of the caller only the end is simulated
_HEAT_STEPS = 20  # heat is stepped once in so many steps
_OVERHEATED = MotorError.WINDING_OVERTEMPERATURE | MotorError.CASE_TEMPERATURE


class Motor:
    """The motor of one gripper.

    :param number: its id, 0 to 14.
    :param mechanics: the gripper; a new one by default.
    :param zero_error: rad by which the position that it reports is too large, until it is
        calibrated.
    :param mounting: direction, zero and gearing of the motor in the gripper.
    :param now: time on the caller's clock.
    :raises UsageError: there is no such id.

    :ivar tripped: the time-out protection has stopped it.
    :ivar silent: it is off the line.
    :ivar trips: times that the protection stopped it; ``ignored``: commands not obeyed.
    """

    def __init__(
        self,
        number: int,
        *,
        mechanics: Dex1Mechanics | None = None,
        firmware: Firmware | None = None,
        heat: Heat | None = None,
        zero_error: float = 0.0,
        mounting: Mounting | None = None,
        now: float = 0.0,
    ) -> None:
        if not 0 <= number < BROADCAST_ID:
            raise UsageError(f"an id is 0 to {BROADCAST_ID - 1}, not {number}")
        self.number = number
        self.mechanics = mechanics or Dex1Mechanics(locking=LOCKING)
        self.firmware = firmware or Firmware()
        self.heat = heat or Heat()
        self.zero_error = zero_error
        self.mounting = mounting or Mounting((1,), (0.0,), (GEAR_RATIO,))
        self.tripped = False
        self.silent = False
        self.trips = self.ignored = 0
        self.calibrated = False  # since power-up
        self.case = self.winding = self.heat.ambient
        self.supply = self.heat.supply
        self._held_hot: float | None = None
        self._own_errors = MotorError.NONE
        self._faults = MotorError.NONE
        self._deadline = math.inf  # when the protection trips
        self._steps = FixedSteps(STEP, most=_MAX_CATCH_UP)
        self._steps.restart(now)
        self._to_heat = _HEAT_STEPS
        self._now = now

    @property
    def error(self) -> MotorError:
        """MError as reported, with the trip of the time-out protection."""
        tripped = MotorError.MOTOR_SAW_HOST_TIMEOUT if self.tripped else MotorError.NONE
        return self._own_errors | self._faults | tripped

    @property
    def resting(self) -> bool:
        """Whether nothing changes for now."""
        return self.mechanics.mode is JointMode.BRAKE and self.mechanics.joint.dq == 0.0

    @property
    def q(self) -> float:
        """Position that it reports, divided by its ratio, rad."""
        return self.mounting.motor(0, self.mechanics.joint.q) + self.zero_error

    # --- time and faults

    def advance_to(self, now: float) -> None:
        """Advance to ``now``."""
        if self._deadline <= now:
            self._step_mechanics(max(self._deadline, self._now))
            self._deadline = math.inf
            self.tripped = True
            self.trips += 1
            if self.firmware.tripped_brakes:
                self.mechanics.brake()
            else:
                self.mechanics.drive(0.0, 0.0, 0.0, 0.0, 0.0)
        self._step_mechanics(now)

    def _step_mechanics(self, now: float) -> None:
        self._now = max(self._now, now)
        left = self._steps.due(now)
        while left:
            part = min(left, self._to_heat)
            self.mechanics.step(part)
            left -= part
            self._to_heat -= part
            if not self._to_heat:
                self._to_heat = _HEAT_STEPS
                self._step_heat(_HEAT_STEPS * STEP)

    def _step_heat(self, dt: float) -> None:
        heat = self.heat
        to_case = (self.winding - self.case) / heat.winding_to_case
        to_air = (self.case - heat.ambient) / heat.case_to_air
        loss = heat.copper_loss * self.mechanics.torque**2
        self.winding += dt * (loss - to_case) / heat.winding_capacity
        self.case += dt * (to_case - to_air) / heat.case_capacity
        if self._held_hot is not None:
            self.winding = self._held_hot
        self._check_limits()

    def _check_limits(self) -> None:
        """Set the errors that the motor detects itself; it brakes on any."""
        heat = self.heat
        errors = self._own_errors & ~_OVERHEATED & ~MotorError.UNDERVOLTAGE
        for bit, value, limit in (
            (MotorError.WINDING_OVERTEMPERATURE, self.winding, heat.winding_limit),
            (MotorError.CASE_TEMPERATURE, self.case, heat.case_limit),
        ):
            still = self._own_errors & bit and value > limit - heat.hysteresis
            if value > limit or still:
                errors |= bit
        if self.supply < heat.voltage_min:
            errors |= MotorError.UNDERVOLTAGE
        self._own_errors = errors
        self._stop_on_error()

    def _stop_on_error(self) -> None:
        if (self._own_errors | self._faults) and self.mechanics.mode is not JointMode.BRAKE:
            self.mechanics.brake()

    def apply_faults(self, faults: Iterable[Fault]) -> None:
        """Apply the active faults for this motor or for all."""
        mine = [fault for fault in faults if fault.device in (None, self.number)]
        kinds = {fault.kind: fault for fault in mine}
        self.silent = "silent" in kinds
        self.mechanics.joint.locked = "stuck" in kinds
        hot = kinds.get("overheat")
        self._held_hot = None if hot is None else hot["c"]
        if self._held_hot is not None:
            self.winding = self._held_hot
        dip = kinds.get("brown-out")
        self.supply = self.heat.supply if dip is None else dip["volts"]
        self._faults = MotorError.NONE
        if "overcurrent" in kinds:
            self._faults |= MotorError.OVERCURRENT
        if "encoder" in kinds:
            self._faults |= MotorError.OUTPUT_ENCODER
        self._check_limits()

    # --- the line

    def handle(self, command: MotorCmd) -> MotorData | None:
        """Execute a command; return the data frame, or None if the motor is silent or not
        addressed.

        Call it after :meth:`advance_to`.
        """
        if self.silent or command.id not in (self.number, BROADCAST_ID):
            return None
        calibration = Calibration.from_command(command)
        if calibration is not None:
            answer = self._calibrate(calibration)
        else:
            self._apply_command(command)
            answer = self.data()
        return None if command.id == BROADCAST_ID else answer

    def _apply_command(self, command: MotorCmd) -> None:
        known = command.status in (Status.BRAKE, Status.FOC)
        if not known and not self.firmware.other_status_brakes:
            self.ignored += 1
            return
        if not command.timeout:
            self.tripped = False
            self._deadline = math.inf
        elif self.tripped:
            # stays stopped until the host acknowledges the trip with the time-out bit at 0
            self.ignored += 1
            return
        else:
            self._deadline = self._now + self.firmware.command_timeout
        if command.status != Status.FOC or self._own_errors | self._faults:
            self.mechanics.brake()
            return
        mounting = self.mounting
        sign = mounting.signs[0]
        q, dq, tau, kp, kd = command.joint(mounting.ratios[0])
        at = mounting.joint(0, q - self.zero_error)
        self.mechanics.drive(at, sign * dq, sign * tau, kp, kd)

    def _calibrate(self, calibration: Calibration) -> MotorData:
        self.mechanics.brake()
        if not self.firmware.calibration_enabled:
            return calibration.answer(done=False)
        problem = CalibrationProblem.NONE
        for bit, wrong in (
            (CalibrationProblem.ALREADY_CALIBRATED, self.calibrated),
            (CalibrationProblem.OUTPUT_ENCODER, self._faults & MotorError.OUTPUT_ENCODER),
            (CalibrationProblem.ANGLE_OUT_OF_RANGE, calibration.position > calibration.range),
            (CalibrationProblem.RANGE_INVALID, calibration.range == 0.0),
            (CalibrationProblem.USER_ID_ZERO, calibration.user_id == 0),
            (CalibrationProblem.TIME_ZERO, calibration.time == 0),
            (CalibrationProblem.FLASH_WRITE, not self.firmware.flash_works),
        ):
            if wrong:
                problem |= bit
        if not problem:
            self.zero_error += calibration.position - self.q
            self.calibrated = True
        return calibration.answer(problem)

    def data(self) -> MotorData:
        """The data frame of the present state."""
        status = Status.FOC if self.mechanics.mode is JointMode.FOC else Status.BRAKE
        sign = self.mounting.signs[0]
        return MotorData.measured(
            self.number,
            status,
            q=self.q,
            dq=sign * self.mechanics.joint.dq,
            # braking, its windings are shorted: no current is controlled, none reported
            tau=sign * self.mechanics.torque if status is Status.FOC else 0.0,
            temperature=self.case,
            winding=self.winding,
            voltage=self.supply,
            error=int(self.error),
            timeout=self.tripped,
            ratio=self.mounting.ratios[0],
        )
