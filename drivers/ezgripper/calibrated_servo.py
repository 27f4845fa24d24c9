"""One servo of a gripper with its calibration, control and newest sample."""

from __future__ import annotations

from dataclasses import dataclass, field

from dexkit.drivers.ezgripper import servo_registers
from dexkit.drivers.ezgripper.bus import Ping
from dexkit.drivers.ezgripper.calibration_file import GripperRecord
from dexkit.drivers.ezgripper.control import Control
from dexkit.drivers.ezgripper.force import ForceTable
from dexkit.drivers.ezgripper.recovery import motor_error
from dexkit.drivers.ezgripper.register_block import Sample
from dexkit.drivers.ezgripper.servo import Servo
from dexkit.hand import MotorError
from dexkit.wire import mx64

__all__ = ["Unit"]


@dataclass
class Unit:
    """One servo of the gripper, and the fingers that it moves.

    :ivar error: bits of its hardware error, while it is in shutdown.
    :ivar overload_at: where it was at an overload of the gripper, ticks from the zero.
    """

    servo: Servo
    ping: Ping
    key: str
    record: GripperRecord
    force: ForceTable
    mirrored: bool
    stroke: int
    limits: servo_registers.ServoLimits = field(
        default_factory=lambda: servo_registers.ServoLimits(80, 9.5, 16.0)
    )
    control: Control | None = None
    last: Sample | None = None
    error: int = 0
    overload_at: float | None = None
    was_warm: bool = False

    @property
    def working(self) -> tuple[Control, Sample]:
        """Control and newest sample, of an open gripper."""
        assert self.control is not None
        assert self.last is not None
        return self.control, self.last

    def motor_error(self, sample: Sample) -> MotorError:
        """The motor error bits of a sample."""
        limits = self.limits
        voltage = sample.voltage * mx64.VOLTAGE_UNIT
        return motor_error(sample.error, voltage, limits.voltage_min, limits.voltage_max)
