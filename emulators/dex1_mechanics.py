"""Simulate the mechanics of a Dex1-1: jaws, friction, stops, an object, and the motor's control
law.

``sim-dex1`` uses it without a protocol, the emulated M4010 behind its serial protocol.

The motor applies ``tau = kp (q_des - q) + kd (dq_des - dq) + tau_ff``, as Unitree's motors do,
within its torque and speed limits, and brakes (shorted windings) in mode BRAKE.

Inertia and friction are tuned, not measured: with the genuine xr_teleoperate rule (0.18 rad lead,
kp 5, kd 0.05, 500 Hz state) the gripper reaches 6.5 rad/s, moves from 10 to 90 % of the stroke in
0.68 s, and reports -0.9 N·m when an object blocks it, as in the recordings.
"""

from __future__ import annotations

from collections.abc import Sequence

from dexkit.emulators.joint_mechanics import Joint, Wall
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, JointMode, Side
from dexkit.models import DEX1_1
from dexkit.wire.m4010 import STROKE

__all__ = ["STEP", "Dex1Mechanics"]

STEP = 0.5e-3
"""Integration step, seconds."""
_INERTIA = 0.002
_COULOMB = 0.08
_VISCOUS = 0.041
_BRAKE_DAMPING = 1.0
_STOP_STIFFNESS, _STOP_DAMPING = 200.0, 1.0
_OBJECT_STIFFNESS, _OBJECT_DAMPING = 60.0, 0.5
_STIFF = 0.2  # beyond this part of a step, gains are applied implicitly


class Dex1Mechanics:
    """A Dex1-1 gripper without its electronics.

    :param object_pct: opening at which the jaws touch an object, percent of 5.4 rad; None for
        no object.
    :param start_pct: initial opening, percent.
    :param locking: friction as a fraction of the contact torque. At 1 and above the mechanism is
        self-locking: the jaws hold an object without motor torque. 0 for none.
    :raises UsageError: a parameter is out of range.

    :ivar torque: of the motor in the last step, N·m.
    :ivar mode: mode of the motor.
    """

    def __init__(
        self,
        *,
        object_pct: float | None = None,
        start_pct: float = 20.0,
        locking: float = 0.0,
    ) -> None:
        if object_pct is not None and not 0 < object_pct < 100:
            raise UsageError(f"an object is touched between 0 and 100 % open, not {object_pct}")
        if not 0 <= start_pct <= 100:
            raise UsageError(f"start is a percentage of opening, not {start_pct}")
        if locking < 0:
            raise UsageError(f"friction cannot be negative, got {locking}")
        self.limits = DEX1_1.joints[Side.LEFT][0]  # the same on both sides
        self.locking = locking
        walls = [
            Wall(0.0, +1, _STOP_STIFFNESS, _STOP_DAMPING),
            # the vendor's calibrated stroke, beyond the 5.4 rad of clients
            Wall(STROKE, -1, _STOP_STIFFNESS, _STOP_DAMPING),
        ]
        if object_pct is not None:
            at = self.limits.stroke * object_pct / 100
            walls.append(Wall(at, +1, _OBJECT_STIFFNESS, _OBJECT_DAMPING))
        self.joint = Joint(
            inertia=_INERTIA,
            coulomb=_COULOMB,
            viscous=_VISCOUS,
            walls=tuple(walls),
            q=self.limits.q_min + self.limits.stroke * start_pct / 100,
        )
        self.torque = 0.0
        self.brake()

    def brake(self) -> None:
        """Short the windings."""
        self.mode = JointMode.BRAKE
        self._q = self._dq = self._tau = self._kp = 0.0
        self._kd = _BRAKE_DAMPING

    def drive(self, q: float, dq: float, tau: float, kp: float, kd: float) -> None:
        """Set the setpoint and gains of the control law; SI units."""
        self.mode = JointMode.FOC
        self._q, self._dq, self._tau, self._kp, self._kd = q, dq, tau, kp, kd

    def place(self, q: Sequence[float]) -> None:
        """Put the joint at ``q[0]``, rad, at rest."""
        (self.joint.q,) = q
        self.joint.dq = 0.0

    def stop(self) -> None:
        """Set the speed to 0."""
        self.joint.dq = 0.0

    def apply(self, command: HandCommand) -> None:
        """Apply a command for the one joint."""
        if not command.mode[0]:
            self.brake()
            return
        self.drive(
            float(command.q[0]),
            float(command.dq[0]),
            float(command.tau[0]),
            float(command.kp[0]),
            float(command.kd[0]),
        )

    def state(self, stamp: float) -> HandState:
        """Return the state at ``stamp``; temperature and voltage are not modelled: NaN."""
        return HandState.from_values(
            self.joint.q,
            dq=self.joint.dq,
            tau_est=self.torque,
            mode=self.mode,
            stamp=stamp,
        )

    def step(self, n: int = 1) -> None:
        """Advance by ``n`` steps."""
        joint = self.joint
        for _ in range(n):
            self.torque = self._motor()
            joint.step(self.torque, STEP, self.locking * abs(joint.contact))

    def _motor(self) -> float:
        """Torque of the motor, N·m."""
        joint = self.joint
        stiffness, damping = self._kp, self._kd
        torque = stiffness * (self._q - joint.q) + damping * (self._dq - joint.dq) + self._tau
        implicit = (STEP * damping + STEP * STEP * stiffness) / _INERTIA
        if implicit > _STIFF:
            # stiff gains are evaluated at the end of the step, which keeps it stable
            torque = (torque - stiffness * STEP * joint.dq) / (1.0 + implicit)
        most = self.limits.tau_max
        if torque * joint.dq > 0.0:
            # the available torque falls with speed, to 0 at the top speed
            most *= max(0.0, 1.0 - abs(joint.dq) / self.limits.dq_max)
        return max(-most, min(most, torque))
