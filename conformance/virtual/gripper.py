"""A gripper that meets every requirement."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.stimuli.script import Pose
from dexkit.conformance.virtual.service import Service, TopicDevice
from dexkit.hand import Side, Subject
from dexkit.models import DEX1_1, Dialect

__all__ = ["ReferenceHand", "ReferenceService"]


class ReferenceHand:
    """A gripper that obeys tau = kp (q - q_now) + kd (dq - dq_now) + tau, as the vendor's does.

    One inertia with friction between two stops, and an object if there is one. Brakes a second
    after the last command, clamps what is out of range, drops what is not finite.

    :param stroke: fully open, rad.
    :param touch: q at which it touches an object, or None.
    """

    inertia = 0.001  # kg m²
    viscous = 0.13  # N m s/rad: with a lead of 0.18 rad this moves at some 6.5 rad/s, as recorded
    coulomb = 0.02  # N m
    tau_max = 2.0  # N m
    stiffness = 40.0  # N m/rad of stops and object
    brake = 1.0  # N m s/rad of a motor with its windings shorted
    timeout = DEX1_1.command_timeout

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        self.stroke = stroke
        self.touch = touch
        self.q = 0.3 * stroke if touch is None else touch + 0.15 * stroke
        self.dq = 0.0
        self.ddq = 0.0
        self.tau = 0.0
        self.now = 0.0
        self.goal: Motor | None = None
        self.heard = -math.inf
        self._shown = 0.0, 0.0
        """When a state was made last, and dq in it."""

    def command(self, motor: Motor) -> None:
        """Take a command; one field that is not finite rejects it."""
        fields = (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        if all(map(math.isfinite, fields)):
            self.goal = self.accept(motor)
            self.heard = self.now

    def accept(self, motor: Motor) -> Motor:
        """The command that is put in force: within the limits."""
        q = min(max(motor.q, 0.0), self.stroke)
        return Motor(q, motor.dq, motor.tau, max(motor.kp, 0.0), max(motor.kd, 0.0))

    @property
    def braking(self) -> bool:
        """Whether no command is in force."""
        return self.goal is None or self.now - self.heard > self.timeout

    def motor_torque(self) -> float:
        """The motor's torque, N m."""
        goal, most = self.goal, self.tau_max
        if goal is None or self.braking:
            return 0.0
        tau = goal.kp * (goal.q - self.q) + goal.kd * (goal.dq - self.dq) + goal.tau
        return -most if tau < -most else most if tau > most else tau

    def step(self, dt: float) -> None:
        """Advance by one step."""
        self.now += dt
        self.tau = self.motor_torque()
        braking = self.braking
        kd = 0.0 if braking or self.goal is None or abs(self.tau) >= self.tau_max else self.goal.kd
        # implicit in the damping, so that a stiff brake and a high kd are stable at this step
        force = self.tau + kd * self.dq + self.contact()
        damping = self.viscous + kd + (self.brake if braking else 0.0)
        inertia = self.inertia
        dq = (self.dq + dt * force / inertia) / (1.0 + dt * damping / inertia)
        slip = dt * self.coulomb / inertia
        self.dq = 0.0 if abs(dq) < slip else dq - math.copysign(slip, dq)
        self.q += dt * self.dq

    def release(self) -> None:
        """Forget the command: brake."""
        self.goal = None

    def contact(self) -> float:
        """Torque of stops and object, N m."""
        floor = 0.0 if self.touch is None else self.touch
        if self.q < floor:
            return self.stiffness * (floor - self.q)
        if self.q > self.stroke:
            return self.stiffness * (self.stroke - self.q)
        return 0.0

    def fields(self) -> dict[str, float]:
        """The state's fields.

        ddq, rad/s², is the change of dq since the state before: what happened between two states
        is in it, also where a subclass changes dq after a step.
        """
        then, was = self._shown
        if self.now > then:
            self.ddq = (self.dq - was) / (self.now - then)
            self._shown = self.now, self.dq
        return {
            "mode": int(not self.braking),
            "q": self.q,
            "dq": self.dq,
            "ddq": self.ddq,
            "tau_est": self.tau,
        }


class ReferenceService(Service):
    """Grippers on their topics.

    Its period is the slowest of the vendor's service, 333 Hz (docs/sources/unitree-dex.md#b2).
    """

    hand: type[ReferenceHand] = ReferenceHand

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.hands = {s: self.hand(dialect.q_open, touch.get(s)) for s in self.sides}

    def take_over(self, before: TopicDevice) -> None:
        """Find the grippers where the service before it has left them."""
        assert isinstance(before, ReferenceService)
        for side, hand in self.hands.items():
            hand.q = before.hands[side].q

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        """Take one side's part of a command message."""
        self.command(side, motors[0])

    def command(self, side: Side, motor: Motor) -> None:
        """Command a gripper's motor."""
        if self.dialect.interface_specification and math.isfinite(motor.q):
            # the interface specification: gains and feed-forward of a command are not used, the
            # ends snap
            q = 0.0 if motor.q <= 0.1 else self.dialect.q_open if motor.q >= 6.0 else motor.q
            motor = Motor(q=q)
        self.hands[side].command(motor)

    def positions(self, side: Side) -> Pose:
        """The pose of a gripper."""
        return (self.hands[side].q,)

    def live(self, dt: float) -> None:
        """Advance the grippers."""
        for hand in self.hands.values():
            hand.step(dt)

    def brake(self) -> None:
        """Brake the grippers."""
        for hand in self.hands.values():
            hand.release()

    def fields(self, side: Side) -> dict[str, Any]:
        """The state of a side's motor, by member."""
        found: dict[str, Any] = {**self.hands[side].fields(), "temperature": 35}
        # the interface specification: mode 0, 25 degrees, 12 V, no sign
        if self.dialect.interface_specification:
            grip = abs(found["tau_est"])
            found |= {"mode": 0, "tau_est": grip, "temperature": (25, 25), "vol": 12.0}
        return found

    def rest(self) -> dict[str, Any]:
        """The other members of the message."""
        return {}

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of these grippers on the wire."""
        return self.codec.state_payload({s: [self.fields(s)] for s in sides}, length, **self.rest())
