"""Simulate all joints of a robot as numpy arrays.

A robot has up to 29 joints and 500 steps a second, so they are numpy arrays here, while
:class:`~dexkit.emulators.joint_mechanics.Joint` is one joint with a richer mechanism. Each is an
inertia with Coulomb and viscous friction between two hard stops. Joints do not act upon
each other, and there is no gravity: the robot hangs in a rig, and its links weigh nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.emulators.robot.settings import STEP, Settings
from dexkit.robots import RobotModel

__all__ = ["Joints", "Law"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Law:
    """The law of the motors: each gives ``bias - kp q - kd dq``, up to its largest torque.

    :param bias: shape (n,), N·m: ``tau + kp q_des + kd dq_des``.
    :param kp: shape (n,), N·m/rad.
    :param kd: shape (n,), N·m·s/rad.

    Laws of this form can be blended: see :meth:`blend`.
    """

    bias: Array
    kp: Array
    kd: Array

    @classmethod
    def damping(cls, kd: Array) -> Law:
        """Damping only: torque against motion."""
        return cls(np.zeros_like(kd), np.zeros_like(kd), kd)

    def blend(self, other: Law, weight: Array) -> Law:
        """Weighted mean of ``other`` (``weight``, shape (n,), 0 to 1) and this law."""
        rest = 1.0 - weight
        return Law(
            rest * self.bias + weight * other.bias,
            rest * self.kp + weight * other.kp,
            rest * self.kd + weight * other.kd,
        )


class Joints:
    """The used joints of a robot, in the order of their slots; SI units, arrays of shape (n,).

    :ivar q: rad.
    :ivar dq: rad/s.
    :ivar ddq: rad/s².
    :ivar tau: torque of the motors in the last step, N·m.
    """

    def __init__(self, model: RobotModel, settings: Settings) -> None:
        joints = [model.joint(slot) for slot in model.used]
        self.q_min = np.array([j.q_min for j in joints])
        self.q_max = np.array([j.q_max for j in joints])
        self.dq_max = np.array([j.dq_max for j in joints])
        self.tau_max = np.array([j.tau_max for j in joints])
        self.inertia = self.tau_max / settings.acceleration
        self.coulomb = self.tau_max * settings.coulomb
        self.viscous = self.tau_max * settings.viscous
        self.q: Array = np.array([model.rest_q[slot] for slot in model.used])
        self.dq: Array = np.zeros(len(joints))
        self.ddq: Array = np.zeros(len(joints))
        self.tau: Array = np.zeros(len(joints))
        self._rate = STEP / self.inertia
        self._stick = self._rate * self.coulomb
        self._drag = 1.0 + self._rate * self.viscous

    def step(self, law: Law) -> None:
        """Advance by one step of :data:`~dexkit.emulators.robot.settings.STEP` seconds.

        Position and speed are taken at the end of the step in the motors' law, so that no gain is
        too high for it. A motor gives up to ``tau_max``; a joint turns at up to ``dq_max``, where
        its motor's torque is what friction takes, and stops dead at its hard stops, against which
        the motor goes on pushing.
        """
        damping = law.kd + law.kp * STEP
        push = law.bias - law.kp * self.q
        dq = self._speed_after_step(push, self._drag + self._rate * damping)
        tau = push - damping * dq
        most = self.tau_max
        if (np.abs(tau) > most).any():
            clipped = np.minimum(np.maximum(tau, -most), most)
            # full torque, whatever the speed: no damping is left
            dq = np.where(tau == clipped, dq, self._speed_after_step(clipped, self._drag))
            tau = clipped
        fast = np.abs(dq) > self.dq_max
        if fast.any():
            dq = np.minimum(np.maximum(dq, -self.dq_max), self.dq_max)
            friction = np.copysign(self.coulomb + self.viscous * self.dq_max, dq)
            tau = np.where(fast, friction, tau)
        q = self.q + STEP * dq
        stopped = np.minimum(np.maximum(q, self.q_min), self.q_max)
        if (stopped != q).any():
            held = stopped != q
            tau = np.where(
                held, np.minimum(np.maximum(law.bias - law.kp * stopped, -most), most), tau
            )
            dq = np.where(held, 0.0, dq)
        self.ddq = (dq - self.dq) / STEP
        self.q, self.dq, self.tau = stopped, dq, tau

    def _speed_after_step(self, push: Array, drag: Array) -> Array:
        """Speed after a step under ``push``; Coulomb friction can stop a joint, not turn it."""
        free = self.dq + self._rate * push
        speed: Array = np.copysign(np.maximum(np.abs(free) - self._stick, 0.0), free) / drag + 0.0
        return speed
