"""Reference hands of position servos, in ``MotorCmds_`` and ``MotorStates_``."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual.fingers import GO_MOTOR, FingerHand, FingerService, Flags, Ints
from dexkit.hand import Floats, JointMode, Side, Subject
from dexkit.messages import message_type
from dexkit.models import Dialect

__all__ = ["ServoHand", "ServoService"]

_KP, _KD = 10.0, 0.4  # A per travel, A s per travel: a servo's own, whatever a command has
_LEAD = 0.12  # of the travel by which its goal may be ahead of it: more than the current can use


class ServoHand(FingerHand):
    """Position servos: the goal of each moves to q with the speed that a command allows.

    When commands end it holds what it has: its grip, too.
    """

    inertia = 0.004  # A s² per travel
    viscous = 0.02
    coulomb = 0.01
    brake = 0.6
    stiffness = 60.0
    speed_is_used = True
    """Whether dq of a command limits the speed, in parts of the full one."""

    def __init__(self, side: Side, touch: float | None = None) -> None:
        self.full: Floats = np.array([j.dq_max for j in self.model.joints[side]])
        self.reach: list[float] = [0.0] * len(self.full)
        self.heeded: tuple[tuple[Motor, ...], tuple[Motor, ...]] = ((), ())
        super().__init__(side, touch)

    def command(self, motors: tuple[Motor, ...]) -> None:
        """Take a command; a q or a used dq that is not finite rejects all of it."""
        if motors is not self.heeded[0]:  # a repetition is known by its identity
            self.heeded = motors, tuple(self.seen(m) for m in motors)
        super().command(self.heeded[1])

    def seen(self, motor: Motor) -> Motor:
        """The part of a motor's command that counts."""
        return Motor(motor.q, motor.dq if self.speed_is_used else 0.0, 0.0, 0.0, 0.0)

    def take(self, rows: Floats, mode: Ints) -> None:
        """Put a command in force."""
        part = np.clip(rows[1], 0.0, 1.0) if self.speed_is_used else np.ones(len(self.full))
        self.reach = (part * self.full).tolist()
        servo = np.zeros_like(rows)
        servo[0], servo[3], servo[4] = rows[0], _KP, _KD
        super().take(servo, mode)

    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        """Every motor is driven, whatever its mode byte."""
        return np.full_like(mode, JointMode.FOC), np.zeros_like(self.tripped)

    def mode_bytes(self) -> Ints:
        """Not used."""
        return np.zeros_like(self.status)

    def expire(self) -> None:
        """Every joint holds where its goal has come to."""
        self.goal = np.array(self.place)

    def changed(self) -> None:
        """Compute the control law; a hand that has no command begins where it is."""
        super().changed()
        if not self.driven.any():
            self.place = list(self.q)
        self.law_q = list(self.place)

    def step(self, dt: float) -> None:
        """Advance by one step."""
        if any(self.driven.tolist()):
            here = self.place
            self.place = self.lead(dt)
            if self.place != here:
                self.law_q = self.place
                self.rests = False
        super().step(dt)

    def lead(self, dt: float) -> list[float]:
        """The goal that each servo follows: toward q with its speed, not far from where it is."""
        found = []
        for place, goal, speed, q in zip(
            self.place, self.goal.tolist(), self.reach, self.q, strict=True
        ):
            # comparisons, for min() and max() take several times as long
            way, most = goal - place, speed * dt
            if way < -most:
                way = -most
            if way > most:
                way = most
            to, low, high = place + way, q - _LEAD, q + _LEAD
            found.append(low if to < low else high if to > high else to)
        return found


class ServoService(FingerService):
    """Such hands on their topics."""

    motor_layout = GO_MOTOR

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.speed_units = dialect.speed_units

    def rates(self, hand: FingerHand) -> tuple[list[float], list[float]]:
        """(dq, ddq) of a state's motors, in the dialect's units."""
        dq, ddq = super().rates(hand)
        units = self.speed_units
        if not units:
            return dq, ddq
        # measured as numbers of 32 bits
        dq, ddq = array("f", dq).tolist(), array("f", ddq).tolist()
        return (
            [speed / unit for speed, unit in zip(dq, units, strict=True)],
            [change / unit for change, unit in zip(ddq, units, strict=True)],
        )

    def message(self, count: int) -> Any:
        """A state with its constant members."""
        motor = message_type("unitree_go::msg::dds_::MotorState_").cls
        message = self.codec.state.cls()
        message.states = [motor() for _ in range(count)]
        return message
