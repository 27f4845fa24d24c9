"""Simulate the mechanics of a hand with several joints: one motor per joint, stops and an object.

No clock, protocol or DDS: the caller calls :meth:`FingerMechanics.step` as time passes.
The module of each hand (:mod:`dexkit.emulators.dex3_mechanics`) defines its motors and sensors.

Stops, objects and heat are assumed. Not modelled: gravity on the fingers, links and their
collisions (every joint moves alone), the coupling of a finger's joints through an object,
backlash, encoder noise, motors that trip by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dexkit.emulators.joint_mechanics import Joint, Wall, check_closing
from dexkit.hand import (
    Floats,
    HandCommand,
    HandState,
    JointMode,
    JointSpec,
    MotorError,
    Side,
)
from dexkit.models import HandModel

__all__ = ["AMBIENT", "SETTINGS", "STEP", "FingerMechanics", "MotorModel"]

STEP = 0.5e-3
"""Integration step, seconds."""
SETTINGS = {
    "object": "percent of closing at which the fingers touch an object (default: no object)",
    "start": "percent of closing at first (default: relaxed, about 20)",
}
"""Settings of a backend made of such mechanics."""


@dataclass(frozen=True)
class MotorModel:
    """A motor with its gearing, SI units at the joint.

    ``tau_max`` is the motor's own largest torque; at the joint, gear friction reduces it while the
    motor drives and adds to it while the motor holds.

    :param gear_ratio: turns of the rotor for one of the joint.
    :param dq_max: rad/s, without load.
    :param tau_max: of the motor itself.
    :param tau_driving: at the joint, in the direction of the speed.
    :param tau_holding: at the joint, against the speed.
    :param inertia: of rotor and gearing, at the joint, kg m².
    :param brake: of the shorted windings, at the joint, N m s/rad.
    :param coulomb: friction at the joint, N m.
    :param viscous: friction at the joint, N m s/rad.
    :param copper_loss: W at full torque; assumed.
    """

    name: str
    gear_ratio: float
    dq_max: float
    tau_max: float
    tau_driving: float
    tau_holding: float
    inertia: float
    brake: float
    coulomb: float
    viscous: float
    copper_loss: float = 6.0

    @property
    def driving_loss(self) -> float:
        """Fraction of the motor's torque lost in the gearing while it drives."""
        return 1.0 - self.tau_driving / self.tau_max

    @property
    def holding_loss(self) -> float:
        """Fraction of the motor's torque that the gearing adds while it is driven back."""
        return self.tau_holding / self.tau_max - 1.0


_STOP_MARGIN = math.radians(2.0)  # hard stops beyond the limits of the model; assumed
_STOP_STIFFNESS, _STOP_DAMPING = 200.0, 0.1
_OBJECT_STIFFNESS, _OBJECT_DAMPING = 60.0, 0.1

# Heat, assumed: at full torque a winding reaches about 90 °C within minutes, its case about 70.
AMBIENT = 25.0
"""°C around the hand."""
_SLOW_STEPS = 20  # heat and fans are stepped once in so many steps
_WINDING_CAPACITY, _CASE_CAPACITY = 2.0, 20.0  # J/K
_WINDING_TO_CASE, _CASE_TO_AIR = 3.0, 8.0  # K/W
_CASE_LIMIT, _WINDING_LIMIT = 85.0, 120.0  # °C where a motor reports an error
_LIMIT_HYSTERESIS = 10.0


# plain integers, because an enum's attribute look-up is slow
_BRAKE, _FOC = int(JointMode.BRAKE), int(JointMode.FOC)


class _Motor:
    """One motor and its joint."""

    __slots__ = (
        "before",
        "case",
        "damping",
        "driving_loss",
        "droop",
        "error",
        "feedforward",
        "holding_loss",
        "joint",
        "kp",
        "mode",
        "model",
        "most",
        "object_wall",
        "q",
        "rests_at",
        "torque",
        "winding",
    )

    def __init__(
        self, spec: JointSpec, model: MotorModel, start: float, object_at: float | None
    ) -> None:
        self.model = model
        walls = [
            Wall(spec.q_min - _STOP_MARGIN, +1, _STOP_STIFFNESS, _STOP_DAMPING),
            Wall(spec.q_max + _STOP_MARGIN, -1, _STOP_STIFFNESS, _STOP_DAMPING),
        ]
        self.object_wall: Wall | None = None
        if object_at is not None and spec.closing:
            self.object_wall = Wall(
                spec.closed_by(object_at / 100), -spec.closing, _OBJECT_STIFFNESS, _OBJECT_DAMPING
            )
            walls.append(self.object_wall)
        self.joint = Joint(
            inertia=model.inertia,
            coulomb=model.coulomb,
            viscous=model.viscous,
            walls=tuple(walls),
            q=start,
        )
        self.driving_loss = self.model.driving_loss
        self.holding_loss = self.model.holding_loss
        self.power(True)
        self.error = 0
        self.case = self.winding = AMBIENT
        self.torque = 0.0
        self.before = 0.0  # rad/s, before the last call of FingerMechanics.step
        self.brake()

    def power(self, on: bool) -> None:
        """Switch the motor's power."""
        self.most = self.model.tau_max if on else 0.0
        self.droop = self.most / self.model.dq_max  # torque lost per rad/s
        self.rests_at = math.nan

    def follow(self, q: float, feedforward: float, kp: float, kd: float) -> None:
        """Set the gains and the setpoint of the control law."""
        self.mode = _FOC
        self.q = q
        self.feedforward = feedforward
        self.kp = kp
        self.damping = kd + kp * STEP
        self.rests_at = math.nan

    def brake(self) -> None:
        """Short the windings."""
        self.follow(0.0, 0.0, 0.0, self.model.brake)
        self.mode = _BRAKE

    def contact(self) -> float:
        """Torque on the object, N·m."""
        wall = self.object_wall
        if wall is None:
            return 0.0
        return max(0.0, wall.stiffness * (wall.q - self.joint.q) * wall.push)

    def heat(self, dt: float) -> None:
        """Warm up by the torque and cool down for ``dt`` seconds."""
        part = self.torque / self.model.tau_max
        to_case = (self.winding - self.case) / _WINDING_TO_CASE
        to_air = (self.case - AMBIENT) / _CASE_TO_AIR
        self.winding += dt * (self.model.copper_loss * part * part - to_case) / _WINDING_CAPACITY
        self.case += dt * (to_case - to_air) / _CASE_CAPACITY


class FingerMechanics:
    """A hand without its electronics.

    :param model: which hand.
    :param side: which of the two.
    :param motors: the motor of each joint.
    :param object_at: how far the flexing joints close before they touch an object, percent
        of the way from straight to closed; None for no object. Not more than can be reached,
        and joints that rest beyond it start where they touch it.
    :param start: how far they are closed at first, percent; None for the model's rest pose,
        which is about 20 %.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        model: HandModel,
        side: Side,
        motors: Sequence[MotorModel],
        *,
        object_at: float | None = None,
        start: float | None = None,
    ) -> None:
        check_closing(object_at, start)
        self.side = side
        self.specs = model.joints[side]
        self._motors = tuple(
            _Motor(spec, motor, _start_angle(spec, rest, start, object_at), object_at)
            for spec, motor, rest in zip(self.specs, motors, model.rest_q[side], strict=True)
        )
        self.joints = tuple(motor.joint for motor in self._motors)
        self._lived = STEP
        self._to_slow = _SLOW_STEPS

    def place(self, q: Sequence[float]) -> None:
        """Put the joints at ``q``, shape (n_joints,), at rest."""
        for joint, at in zip(self.joints, q, strict=True):
            joint.q, joint.dq = at, 0.0

    # -- commands ------------------------------------------------------------------------------

    def command(
        self,
        joint: int,
        mode: int,
        q: float = 0.0,
        dq: float = 0.0,
        tau: float = 0.0,
        kp: float = 0.0,
        kd: float = 0.0,
    ) -> None:
        """Command one motor: ``tau = kp (q - q_now) + kd (dq - dq_now) + tau``.

        :param mode: FOC (1) drives; everything else brakes.
        :param kp: gains below zero count as zero.
        """
        motor = self._motors[joint]
        if mode != _FOC or motor.error:
            if motor.mode != _BRAKE:
                motor.brake()
            return
        kp = kp if kp > 0.0 else 0.0
        kd = kd if kd > 0.0 else 0.0
        feedforward = kd * dq + tau
        if (
            motor.q != q
            or motor.feedforward != feedforward
            or motor.kp != kp
            or motor.damping != kd + kp * STEP
            or motor.mode != _FOC
        ):
            motor.follow(q, feedforward, kp, kd)

    def apply(self, command: HandCommand) -> None:
        """Apply ``command`` to every motor."""
        for i, row in enumerate(
            zip(
                command.mode.tolist(),
                command.q.tolist(),
                command.dq.tolist(),
                command.tau.tolist(),
                command.kp.tolist(),
                command.kd.tolist(),
                strict=True,
            )
        ):
            self.command(i, *row)

    def brake(self) -> None:
        """Brake every joint."""
        for motor in self._motors:
            motor.brake()

    def stop(self) -> None:
        """Brake and set all speeds to 0."""
        self.brake()
        for joint in self.joints:
            joint.dq = 0.0

    # -- time ----------------------------------------------------------------------------------

    def step(self, steps: int = 1) -> None:
        """Advance by ``steps`` times :data:`STEP`."""
        if steps <= 0:
            return
        motors = self._motors
        for motor in motors:
            motor.before = motor.joint.dq
        self._lived = steps * STEP
        for _ in range(steps):
            for motor in motors:
                joint = motor.joint
                speed = joint.dq
                if speed == 0.0 and joint.q == motor.rests_at:
                    continue  # at rest: this step would not change anything
                most = motor.most
                # the available torque falls with speed, to 0 at the top speed
                along = most - motor.droop * (speed if speed > 0.0 else -speed)
                motor.torque = joint.drive(
                    motor.kp * (motor.q - joint.q) + motor.feedforward,
                    motor.damping,
                    most,
                    along if along > 0.0 else 0.0,
                    STEP,
                    motor.driving_loss,
                    motor.holding_loss,
                )
                motor.rests_at = joint.q if speed == 0.0 == joint.dq else math.nan
            self._to_slow -= 1
            if self._to_slow == 0:
                self._to_slow = _SLOW_STEPS
                self._step_slowly(_SLOW_STEPS * STEP)

    def _step_slowly(self, dt: float) -> None:
        for motor in self._motors:
            motor.heat(dt)
            self._check_temperature(motor)

    def _check_temperature(self, motor: _Motor) -> None:
        for value, limit, bit in (
            (motor.case, _CASE_LIMIT, MotorError.CASE_TEMPERATURE),
            (motor.winding, _WINDING_LIMIT, MotorError.WINDING_OVERTEMPERATURE),
        ):
            if value > limit:
                motor.error |= bit
                motor.brake()
            elif value < limit - _LIMIT_HYSTERESIS:
                motor.error &= ~bit

    # -- faults --------------------------------------------------------------------------------

    def power(self, joint: int, on: bool) -> None:
        """Switch a motor's power; without power it is limp and does not answer."""
        self._motors[joint].power(on)
        self._motors[joint].brake()

    def heat(self, joint: int, celsius: float) -> None:
        """Set the temperature of a motor's case and winding; they cool from there."""
        motor = self._motors[joint]
        motor.case = motor.winding = celsius
        self._check_temperature(motor)

    def fail(self, joint: int, error: MotorError) -> None:
        """Set an error of a motor: it brakes until :meth:`recover`."""
        self._motors[joint].error |= error
        self._motors[joint].brake()

    def recover(self, joint: int, error: MotorError) -> None:
        """Clear an error; the motor brakes until its next command."""
        self._motors[joint].error &= ~error

    def jam(self, joint: int, stuck: bool) -> None:
        """Lock a joint where it is, or free it."""
        self.joints[joint].locked = stuck
        self._motors[joint].rests_at = math.nan

    # -- measured values ----------------------------------------------------------------------

    @property
    def q(self) -> Floats:
        """Joint positions, rad, shape (n_joints,)."""
        return np.array([joint.q for joint in self.joints])

    @property
    def dq(self) -> Floats:
        """Joint speeds, rad/s, shape (n_joints,)."""
        return np.array([joint.dq for joint in self.joints])

    @property
    def ddq(self) -> Floats:
        """Mean accelerations during the last :meth:`step`, rad/s², shape (n_joints,)."""
        return np.array([(m.joint.dq - m.before) / self._lived for m in self._motors])

    @property
    def tau(self) -> Floats:
        """Motor torques by their current, N·m, shape (n_joints,)."""
        return np.array([motor.torque for motor in self._motors])

    @property
    def mode(self) -> list[int]:
        """Mode of each motor: :class:`JointMode` values."""
        return [motor.mode for motor in self._motors]

    @property
    def errors(self) -> list[int]:
        """:class:`MotorError` bits of each motor."""
        return [motor.error for motor in self._motors]

    @property
    def temperature(self) -> Floats:
        """Temperature of the motors' cases, °C, shape (n_joints,)."""
        return np.array([motor.case for motor in self._motors])

    @property
    def winding_temperature(self) -> Floats:
        """Temperature of the motors' windings, °C, shape (n_joints,)."""
        return np.array([motor.winding for motor in self._motors])

    @property
    def contact(self) -> Floats:
        """Torques that the object takes from the joints, N·m, shape (n_joints,)."""
        return np.array([motor.contact() for motor in self._motors])

    @property
    def motor_v(self) -> float:
        """Voltage at the motors, V; NaN where it is not modelled."""
        return math.nan

    def _extra_state(self) -> dict[str, Any]:
        """Further fields of this hand's state."""
        return {}

    def state(self, stamp: float) -> HandState:
        """Return the state of the hand at ``stamp``."""
        lived = self._lived
        table = np.array(
            [
                (
                    m.joint.q,
                    m.joint.dq,
                    (m.joint.dq - m.before) / lived,
                    m.torque,
                    m.case,
                    m.winding,
                    self.motor_v,
                )
                for m in self._motors
            ]
        ).T.copy()
        return HandState(
            q=table[0],
            dq=table[1],
            ddq=table[2],
            tau_est=table[3],
            temperature=table[4],
            winding_temperature=table[5],
            voltage=table[6],
            mode=np.array(self.mode, dtype=np.uint8),
            fault=np.array(self.errors, dtype=np.uint32),
            stamp=stamp,
            **self._extra_state(),
        )


def _start_angle(
    spec: JointSpec, rest: float, start: float | None, object_at: float | None
) -> float:
    if not spec.closing:
        return rest
    q = rest if start is None else spec.closed_by(start / 100)
    if object_at is not None:
        touch = spec.closed_by(object_at / 100)
        q = min(q, touch) if spec.closing > 0 else max(q, touch)
    return q
