"""Simulate a hand of position servos: each joint goes to its goal with at most a given speed.

Quantities are in the model's own unit of q, which need not be rad: such a hand takes goals in parts
of its travel, and its forces are not documented. A joint has a speed, an acceleration and a motor
current; it comes to rest at its goal without overshoot, and stands still at an object while the
current rises to its limit. Without a goal it holds where it is.

Not modelled: gravity, play, a hand that gives way, heat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.emulators.finger_mechanics import SETTINGS
from dexkit.emulators.joint_mechanics import check_closing
from dexkit.hand import Floats, HandCommand, HandState, JointMode, JointSpec, Side
from dexkit.models import HandModel

__all__ = ["SETTINGS", "STEP", "ServoMechanics"]

STEP = 1e-3
"""Integration step, seconds."""

# assumed
_ACCELERATION = 30.0  # full speeds per second: full speed within 33 ms
_APPROACH = 0.02  # s; near its goal a joint's speed is the remaining distance divided by this
_IDLE, _MOVING = 0.02, 0.15  # of the current limit: holding still, and moving at full speed
_STALL = 0.02  # s in which the current rises to its limit at an object


@dataclass
class _Servo:
    """One joint."""

    spec: JointSpec
    q: float
    wall: float | None
    """Where it touches the object."""
    goal: float = math.nan
    """NaN: it holds where it is."""
    speed: float = 0.0
    dq: float = 0.0
    ddq: float = 0.0
    current: float = 0.0
    still: bool = False
    contact: float = 0.0
    """Current with which it presses on the object, as a part of the limit."""

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        full = self.spec.dq_max
        speed = min(self.speed, full)
        want = 0.0
        if not math.isnan(self.goal):
            way = self.goal - self.q
            # snap to the goal instead of approaching it without end
            want = way / max(_APPROACH, dt) if abs(way) > 1e-5 else way / dt
            want = min(max(want, -speed), speed)
        most = _ACCELERATION * full * dt
        before = self.dq
        self.dq += min(max(want - self.dq, -most), most)
        # never past its goal
        if want and abs(self.dq) > abs(want) and self.dq * want > 0 and abs(want) < speed:
            self.dq = want
        q = self.q + dt * self.dq
        blocked = 0.0
        low, high = self.spec.q_min, self.spec.q_max
        if self.wall is not None and self.spec.closing > 0:
            high = max(self.wall, self.q)
        elif self.wall is not None:
            low = min(self.wall, self.q)
        if not low <= q <= high:
            blocked = 1.0 if q > high else -1.0
            q, self.dq = min(max(q, low), high), 0.0
        self.ddq = (self.dq - before) / dt
        self.q = q
        limit = self.spec.tau_max
        presses = blocked == self.spec.closing != 0 and q == self.wall
        if blocked and abs(want) > 0:
            aim = blocked * limit
        else:
            idle = _IDLE if self.goal > self.q else 0.0
            aim = limit * (_MOVING * self.dq / full + idle)
        self.current += (aim - self.current) * min(1.0, dt / _STALL)
        self.contact = max(0.0, self.current * blocked / limit) if presses else 0.0
        self.still = want == 0.0 == self.dq and abs(aim - self.current) < 1e-4


class ServoMechanics:
    """A hand of position servos without its electronics.

    It obeys q (the goal) and dq (the largest speed) of a command.

    :param model: which hand.
    :param side: which of the two.
    :param object_at: how far the joints close before they touch an object, percent; None for
        none. Joints that rest beyond it start where they touch it.
    :param start: how far they are closed at first, percent; None for the model's rest pose.
    :param resolution: steps of the reported q; 0 for none.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        model: HandModel,
        side: Side,
        *,
        object_at: float | None = None,
        start: float | None = None,
        resolution: float = 0.0,
    ) -> None:
        check_closing(object_at, start)
        self.side = side
        self._resolution = resolution
        self._servos: list[_Servo] = []
        for spec, rest in zip(model.joints[side], model.rest_q[side], strict=True):
            q = rest if start is None else spec.closed_by(start / 100)
            wall = None if object_at is None else spec.closed_by(object_at / 100)
            if wall is not None:
                q = min(q, wall) if spec.closing > 0 else max(q, wall)
            self._servos.append(_Servo(spec, q, wall))

    @property
    def q(self) -> Floats:
        """True positions, before rounding to the reported resolution, shape (n_joints,)."""
        return np.array([servo.q for servo in self._servos])

    @property
    def contacts(self) -> list[float]:
        """Current with which each joint presses on the object, as a part of its limit."""
        return [servo.contact for servo in self._servos]

    def apply(self, command: HandCommand) -> None:
        """Apply ``command`` until the next one; a joint that is not driven holds where it is."""
        rows = zip(
            self._servos,
            command.mode.tolist(),
            command.q.tolist(),
            command.dq.tolist(),
            strict=True,
        )
        for servo, mode, q, speed in rows:
            goal = q if mode == JointMode.FOC else math.nan
            if servo.goal != goal or servo.speed != speed:
                servo.goal, servo.speed, servo.still = goal, speed, False

    def place(self, q: Sequence[float]) -> None:
        """Put the joints at ``q``, shape (n_joints,), at rest."""
        for servo, at in zip(self._servos, q, strict=True):
            servo.q, servo.dq, servo.still = at, 0.0, False

    def brake(self) -> None:
        """Hold every joint where it is."""
        for servo in self._servos:
            servo.goal, servo.still = math.nan, False

    def stop(self) -> None:
        """Hold every joint and set its speed to 0."""
        self.brake()
        for servo in self._servos:
            servo.dq = 0.0

    def step(self, n: int = 1) -> None:
        """Advance by ``n`` times :data:`STEP`."""
        for servo in self._servos:
            for _ in range(n):
                if servo.still:
                    break
                servo.step(STEP)

    def state(self, stamp: float) -> HandState:
        """The state of the hand at ``stamp``; its torques are currents."""
        q = self.q
        if self._resolution:
            q = np.round(q / self._resolution) * self._resolution
        return HandState.from_values(
            q,
            stamp=stamp,
            dq=[servo.dq for servo in self._servos],
            ddq=[servo.ddq for servo in self._servos],
            tau_est=[servo.current for servo in self._servos],
            mode=[int(not math.isnan(servo.goal)) for servo in self._servos],
        )
