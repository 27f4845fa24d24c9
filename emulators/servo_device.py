"""The joints of an emulated hand of position servos, behind the registers of its protocol."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexkit.emulators.joint_mechanics import FixedSteps
from dexkit.emulators.servo_mechanics import STEP, ServoMechanics
from dexkit.hand import HandCommand, JointMode, JointSpec

__all__ = ["ServoDevice"]

_NEAR = 0.01  # of the travel within which a joint that stands has arrived
_DRIVEN, _RESTING = int(JointMode.FOC), int(JointMode.BRAKE)


class ServoDevice:
    """Joints with goals in register units, advanced to given times.

    :param joints: its joints.
    :param full: register value of the whole travel and of the full speed.
    :param now: time of the start, seconds.
    :ivar goals: the goal of each joint; None before its first command.
    """

    def __init__(
        self, mechanics: ServoMechanics, joints: Sequence[JointSpec], full: int, now: float
    ) -> None:
        self.mechanics = mechanics
        self.full_speed = np.array([joint.dq_max for joint in joints])
        self.goals: list[int | None] = [None] * len(joints)
        self.now = now
        self._full = full
        self._steps = FixedSteps(STEP)
        self._steps.restart(now)

    def advance_to(self, now: float) -> None:
        """Advance the joints to ``now``."""
        self.mechanics.step(self._steps.due(now))
        self.now = now

    @property
    def resting(self) -> bool:
        """Whether no joint moves."""
        return not self.mechanics.state(self.now).dq.any()

    def arrived(self, goal: int | None, position: int) -> bool:
        """Whether a joint that stands is at its goal, or has none."""
        return goal is None or abs(goal - position) <= _NEAR * self._full

    def drive(self, speeds: Sequence[int], driven: Sequence[bool]) -> None:
        """Command the mechanics to the goals.

        :param speeds: of each joint, in register units.
        :param driven: whether the joint has power; it rests otherwise.
        """
        dq = np.array(speeds) / self._full * self.full_speed
        command = HandCommand.position([(goal or 0) / self._full for goal in self.goals], dq=dq)
        command.mode[:] = [_DRIVEN if on else _RESTING for on in driven]
        self.mechanics.apply(command)
