"""Wrong hands whose fault shows only in a closed loop, with a model of Unitree's client.

Each meets every MUST; the fault shows where commands depend on states.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from dexkit.conformance.faults.any_model import Delayed, finite
from dexkit.conformance.faults.registry import (
    Call,
    Motors,
    changes,
    has_speeds,
    obeys_gains,
    reports,
    wrong_hand,
)
from dexkit.conformance.virtual import Service
from dexkit.conformance.virtual.fingers import FingerService
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Side
from dexkit.models import model

Joint = tuple[Side, int]


class _PerJoint(Service):
    """Changes the goal of each joint, where it is finite."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.obeyed: dict[Joint, tuple[float, float]] = {}

    def motors(self, side: Side, motors: Motors) -> None:
        if finite(motors):
            here = self.positions(side)
            motors = tuple(
                replace(m, q=self.change((side, i), m.q, here[i])) for i, m in enumerate(motors)
            )
        super().motors(side, motors)

    def change(self, joint: Joint, q: float, here: float) -> float:
        """The goal that is obeyed in place of ``q``, rad."""
        raise AssertionError  # overridden

    def stroke(self, joint: Joint) -> float:
        """The joint's range, rad."""
        side, index = joint
        if self.dialect.is_gripper:
            return self.dialect.q_open
        return model(self.dialect.model).joints[side][index].stroke


class _DeadBand(_PerJoint):
    band = 0.0
    """Of the stroke."""

    def change(self, joint: Joint, q: float, here: float) -> float:
        if abs(q - here) >= self.band * self.stroke(joint):
            self.obeyed[joint] = (q, self.now)
        return self.obeyed.setdefault(joint, (here, self.now))[0]


# where the client's filter stays within the dead band, nothing moves any more
@wrong_hand("DEX1-OPER-01", whole=True)
class DeadBand(_DeadBand, ReferenceService):
    """Ignores a goal nearer than 0.16 rad: the client waits there and never moves on."""

    band = 0.16 / 5.4


@changes(ReferenceService, "motors", "DEX1-OPER-01")
def SaturatingGain(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Takes no kp above 2: with the client's small lead it has 40 % of the force."""
    command(side, tuple(replace(m, kp=2.0) if 2.0 < m.kp < math.inf else m for m in motors))


# what it leaves of each step shows in steps of every kind
@wrong_hand("DEX3-OPER-01", where=obeys_gains)
class FingerDeadBand(_DeadBand, FingerService):
    """Ignores a goal nearer than a fifteenth of the joint's range."""

    band = 1 / 15


class _Coarse(_PerJoint):
    grid = 0.0
    """Of the stroke."""

    def change(self, joint: Joint, q: float, here: float) -> float:
        grid = self.grid * self.stroke(joint)
        return round(q / grid) * grid


@wrong_hand("DEX1-OPER-01")
class CoarseTargets(_Coarse, ReferenceService):
    """Moves to the nearest of 19 positions."""

    grid = 1 / 18


@wrong_hand("DEX3-OPER-01", "BRAINCO-OPER-01")
class CoarseFingers(_Coarse, FingerService):
    """Moves to the nearest of 21 positions."""

    grid = 1 / 20


@reports(ReferenceService, "DEX1-OPER-01")
def LateState(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes the position of 60 ms ago in fresh messages."""
    past = self.memory.setdefault(hand, [])
    past.append((self.now, {name: state[name] for name in ("q", "dq", "ddq")}))
    while len(past) > 1 and past[1][0] <= self.now - 0.06:
        del past[0]
    state.update(past[0][1])


@wrong_hand("DEX1-OPER-01")
class RunsAhead(_PerJoint, ReferenceService):
    """Extrapolates moving goals by 70 ms, and overshoots when they stop."""

    lead, memory = 0.07, 0.1
    """Seconds ahead, and over which the targets' speed is smoothed."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.speed: dict[Joint, float] = {}

    def change(self, joint: Joint, q: float, here: float) -> float:
        before, since = self.obeyed.get(joint, (q, self.now))
        step, seconds = q - before, self.now - since
        if abs(step) > 0.04 * self.stroke(joint):  # a jump is not a velocity
            self.speed[joint] = 0.0
        elif seconds > 0.0:
            speed = self.speed.get(joint, 0.0)
            part = min(1.0, seconds / self.memory)
            self.speed[joint] = speed + part * (step / seconds - speed)
        self.obeyed[joint] = (q, self.now)
        return q + self.lead * self.speed.get(joint, 0.0)


# nothing wakes it but a second command
@wrong_hand("DEX1-CMD-01")
class SlowToWake(_PerJoint, ReferenceService):
    """Sleeps 0.3 s after its goal has stopped, and needs 0.2 s to wake."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.awake: dict[Joint, float] = {}

    def change(self, joint: Joint, q: float, here: float) -> float:
        before, since = self.obeyed.get(joint, (q, self.now))
        if abs(q - before) > 1e-4 * self.stroke(joint):
            if self.now - since > 0.3:
                self.awake[joint] = self.now + 0.2
            if self.now >= self.awake.get(joint, 0.0):
                self.obeyed[joint] = (q, self.now)
                return q
            self.obeyed[joint] = (before, self.now)
        elif joint not in self.obeyed:
            self.obeyed[joint] = (q, self.now)
        return before


class _OpenEnd(_PerJoint):
    """Obeys another goal near the open end of a joint."""

    near = 0.08
    """Part of the joint's closing that counts as that."""

    def change(self, joint: Joint, q: float, here: float) -> float:
        side, index = joint
        spec = model(self.dialect.model).joints[side][index]
        if not spec.closing:
            return q
        opened, span = spec.straight, spec.closed_by(1.0) - spec.straight
        return opened + span * self.close(joint, (q - opened) / span, (here - opened) / span)

    def close(self, joint: Joint, goal: float, here: float) -> float:
        """The obeyed closing in place of ``goal``, 0 to 1."""
        raise AssertionError  # overridden


@wrong_hand("DEX3-OPER-01")
class SlowToLeave(_OpenEnd, FingerService):
    """Leaves the open end of a joint at a tenth of its range per second."""

    near = speed = 0.1

    def close(self, joint: Joint, goal: float, here: float) -> float:
        taken = goal
        if here < self.near and goal > here:
            before, since = self.obeyed.get(joint, (here, self.now))
            taken = min(goal, max(before, 0.0) + self.speed * (self.now - since))
        self.obeyed[joint] = (taken, self.now)
        return taken


@wrong_hand("DEX3-OPER-01")
class Springs(_OpenEnd, FingerService):
    """Moves 25 % too far for 0.5 s when it leaves the open end of a joint."""

    def close(self, joint: Joint, goal: float, here: float) -> float:
        if here < self.near:
            self.obeyed[joint] = (here, self.now)
        _, left = self.obeyed.get(joint, (here, -1.0))
        return goal * 1.25 if 0.0 <= self.now - left < 0.5 else goal


@wrong_hand("BRAINCO-OPER-01", where=has_speeds)
@wrong_hand("DEX3-CMD-01")
class LateFingers(Delayed, FingerService):
    """Obeys each command 0.15 s late."""


@wrong_hand("DFX-OPER-01")
class LaggingFingers(Delayed, FingerService):
    """Obeys each command 0.38 s late, and shows it later still."""

    delay = 0.38


@wrong_hand("DFX-OPER-01")
class LaterFingers(Delayed, FingerService):
    """Obeys each command 0.39 s late."""

    delay = 0.39
