"""The reference robot, in memory: it meets every requirement.

It shares no code with the emulated robots that dexkit ships, so that neither is judged by itself.
Its mechanics are the simplest that show every requirement: joints without mass that creep against
friction. The wrong robots in :mod:`dexkit.conformance.faults.robot` override its methods.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dexkit.conformance.virtual.service import Sample, TopicDevice
from dexkit.errors import WireError
from dexkit.hand import ROBOT, Floats, RobotSubject, Subject
from dexkit.messages import decode, message_type
from dexkit.models import Dialect
from dexkit.robots import RobotModel, robot
from dexkit.wire.low_level import encode_with_crc, verify_payload

__all__ = ["Orders", "ReferenceRobot"]

_FRICTION = 0.05  # of the joint's torque, per rad/s
_CELLS = 15


class Orders:
    """A command in numbers: arrays of shape (slots,)."""

    def __init__(self, message: Any) -> None:
        rows = [(m.mode, m.q, m.dq, m.tau, m.kp, m.kd) for m in message.motor_cmd]
        self.mode, self.q, self.dq, self.tau, self.kp, self.kd = np.array(rows).T
        self.machine = getattr(message, "mode_machine", None)


class ReferenceRobot(TopicDevice):
    """An H1 or a G1 that meets every requirement.

    :ivar q: of all slots, rad; ``dq`` and ``tau`` likewise.
    """

    fault_sides = (ROBOT,)

    tick = 0.002
    period = 0.002
    timeout = 1.0
    machine = 5

    def __init__(
        self, dialect: Dialect, sides: Iterable[RobotSubject], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.robot: RobotModel = robot(dialect.model)
        self.used = np.array(self.robot.used)
        self.enable = np.array(self.robot.enable)
        slots = self.robot.slots
        self.low, self.high = np.zeros(slots), np.zeros(slots)
        self.dq_max, self.tau_max = np.ones(slots), np.ones(slots)
        for slot in self.robot.used:
            joint = self.robot.joint(slot)
            self.low[slot], self.high[slot] = joint.q_min, joint.q_max
            self.dq_max[slot], self.tau_max[slot] = joint.dq_max, joint.tau_max
        self.q = np.array(self.robot.rest_q)
        self.dq, self.tau = np.zeros(slots), np.zeros(slots)
        self.orders: Orders | None = None
        self.heard = -math.inf
        self._law: Any = (None,)
        self._last: tuple[bytes, Orders | None] = (b"", None)
        self._state: Any = message_type(dialect.state_type).cls()

    # -- commands ---------------------------------------------------------------------------

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message."""
        if payload != self._last[0]:  # most commands repeat, so they are decoded once
            self._last = (payload, self.read(payload))
        orders = self._last[1]
        if orders is not None and self.accepts(orders):
            self.obey(orders)

    def read(self, payload: bytes) -> Orders | None:
        """The numbers of a command; None where its CRC is wrong."""
        return Orders(decode(self.dialect.cmd_type, payload)) if self.intact(payload) else None

    def intact(self, payload: bytes) -> bool:
        """Whether a command's CRC is right."""
        try:
            return verify_payload(self.dialect.cmd_type, payload)
        except WireError:
            return False

    def accepts(self, orders: Orders) -> bool:
        """Whether a command is put in force."""
        return self.finite(orders) and orders.machine in (None, self.machine)

    def finite(self, orders: Orders) -> bool:
        """Whether all numbers of a command are finite."""
        every = (orders.q, orders.dq, orders.tau, orders.kp, orders.kd)
        return bool(np.isfinite(every).all())

    def obey(self, orders: Orders) -> None:
        """Put a command in force."""
        self.orders, self.heard = orders, self.now

    # -- mechanics --------------------------------------------------------------------------

    @property
    def driven(self) -> bool:
        """Whether a command is in force."""
        return self.orders is not None and self.now - self.heard <= self.timeout

    def follows(self, orders: Orders) -> Any:
        """Which motors follow a command, shape (slots,)."""
        return orders.mode == self.enable

    def live(self, dt: float) -> None:
        """Advance by one step: kp (q_des - q) + kd (dq_des - dq) + tau = friction * dq, solved."""
        before = self.q
        if self.driven and self.orders is not None:
            self.move(self.orders, dt)
        else:
            self.tau = np.zeros(self.robot.slots)
        self.dq = (self.q - before) / dt

    def move(self, orders: Orders, dt: float) -> None:
        """One step of the mechanics under a command."""
        if orders is not self._law[0]:
            self._law = (orders, *self.law(orders, dt))
        _, goal, decay, drift = self._law
        way = (goal - self.q) * decay + drift
        reach = self.dq_max * dt
        there = self.q + np.minimum(np.maximum(way, -reach), reach)
        there = np.minimum(np.maximum(there, self.low), self.high)
        self.tau = _FRICTION * self.tau_max * (there - self.q) / dt
        self.q = there

    def law(self, orders: Orders, dt: float) -> tuple[Floats, Floats, Floats]:
        """Equilibrium of the springs, the part of the way there in ``dt``, and the drift of the
        joints.
        """
        on = self.follows(orders)
        kp, kd = orders.kp * on, orders.kd * on
        push = kd * orders.dq * on + orders.tau * on
        drag = _FRICTION * self.tau_max + kd
        stiff = kp > 0
        goal = np.where(stiff, orders.q + push / np.where(stiff, kp, 1.0), 0.0)
        return goal, 1.0 - np.exp(-kp / drag * dt), np.where(stiff, 0.0, push / drag * dt)

    # -- states -----------------------------------------------------------------------------

    def publish(self) -> list[Sample]:
        """A state."""
        return [Sample(self.dialect.state_topic, self.state_type, self.state_with_crc(), self.now)]

    def state_with_crc(self) -> bytes:
        """A state with its CRC."""
        return encode_with_crc(self.message())

    def modes(self) -> list[int]:
        """Mode bytes of all slots."""
        if not self.driven or self.orders is None:
            return [0] * self.robot.slots
        found: list[int] = np.where(self.follows(self.orders), self.enable, 0).astype(int).tolist()
        return found

    def shown(self) -> tuple[Floats, Floats, Floats]:
        """q, dq and tau of the state, shape (slots,) each."""
        return self.q, self.dq, self.tau

    def ticks(self) -> int:
        """The state's tick."""
        return round(self.now * 1000)

    def message(self) -> Any:
        """The state message."""
        state, warmth = self._state, self.warmth()
        q, dq, tau = (values.tolist() for values in self.shown())
        modes = self.modes()
        for slot in self.robot.used:
            motor = state.motor_state[slot]
            motor.mode, motor.temperature = modes[slot], warmth
            motor.q, motor.dq, motor.tau_est = q[slot], dq[slot], tau[slot]
        state.tick = self.ticks()
        state.imu_state.quaternion, state.imu_state.rpy = self.attitude()
        state.imu_state.accelerometer = self.gravity()
        state.wireless_remote = tuple(self.remote())
        if self.robot.has_battery:
            state.head, state.level_flag = (0xFE, 0xEF), 0xFF
            state.bms_state.soc = 80
            state.bms_state.cell_vol = (4000,) * _CELLS
            state.power_v, state.power_a = 60.0, 2.0
        else:
            state.mode_machine = self.machine
        return state

    def warmth(self) -> Any:
        """A motor's temperature."""
        return 35 if self.robot.motor_temperatures == 1 else (35, 36)

    def attitude(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Quaternion (w first) and roll, pitch, yaw, rad: pitched by 0.1 rad."""
        half = 0.05
        return (math.cos(half), 0.0, math.sin(half), 0.0), (0.0, 2 * half, 0.0)

    def gravity(self) -> tuple[float, float, float]:
        """The accelerometer, m/s²."""
        return (-0.98, 0.0, 9.76)

    def remote(self) -> bytes:
        """The remote's bytes: sticks are held."""
        return struct.pack("<2xH5f16x", 0, 0.5, 0.0, 0.0, 0.0, -0.25)
