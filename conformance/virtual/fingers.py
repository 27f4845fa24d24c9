"""Reference hands of several joints: common parts, and the Dex3-1."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.stimuli.script import Pose
from dexkit.conformance.virtual.service import Sample, Service, TopicDevice
from dexkit.hand import Floats, JointMode, Side, Subject
from dexkit.messages import message_type
from dexkit.models import DEX3_1, Dialect, HandModel
from dexkit.pressure import NO_VALUE

__all__ = ["GO_MOTOR", "Dex3Hand", "Dex3Service", "FingerHand", "FingerService", "Flags", "Ints"]

Flags: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.intp]
# the joint that presses each sensor packet, in the order of the model's sensors
_PRESSED_BY = {"thumb": (2, 1), "middle": (4, 3), "index": (6, 5)}


def _motor(size: int) -> np.dtype[Any]:
    """One motor of a state on the wire, in so many bytes."""
    return np.dtype(
        {
            "names": ["mode", "q", "dq", "ddq", "tau_est", "reserve", "values"],
            "formats": ["u1", "<f4", "<f4", "<f4", "<f4", "<u4", ("<f4", 4)],
            "offsets": [0, 4, 8, 12, 16, 40, 4],  # values are the four floats at once
            "itemsize": size,
        }
    )


# one motor and one sensor packet of a HandState_ on the wire, and one motor of a MotorStates_
# (docs/sources/unitree-dex.md#a2, docs/sources/unitree-dex.md#a4)
_MOTOR, GO_MOTOR = _motor(56), _motor(48)
_PACKET = np.dtype(
    {"names": ["pressure"], "formats": [("<f4", 12)], "offsets": [0], "itemsize": 104}
)


class FingerHand:
    """Joints that obey tau = kp (q - q_now) + kd (dq - dq_now) + tau.

    Each is one inertia with friction between two stops, and an object if there is one.

    :param touch: percent of closing at which the flexing joints touch an object, or None.
    """

    model: HandModel
    inertia: float  # kg m²
    viscous: float  # N m s/rad
    coulomb: float  # N m
    brake: float  # N m s/rad of shorted windings
    stiffness: float  # N m/rad of stops and object

    def __init__(self, side: Side, touch: float | None = None) -> None:
        self.side = side
        specs = self.model.joints[side]
        self.timeout = self.model.command_timeout
        self.low: Floats = np.array([j.q_min for j in specs])
        self.high: Floats = np.array([j.q_max for j in specs])
        self.most: Floats = np.array([j.tau_max for j in specs])
        # an object is an earlier stop; the stops are a little beyond the limits
        self.floor, self.ceiling = self.low - 0.03, self.high + 0.03
        if touch is not None:
            for i, j in enumerate(specs):
                if j.closing > 0:
                    self.ceiling[i] = j.closed_by(touch / 100)
                elif j.closing < 0:
                    self.floor[i] = j.closed_by(touch / 100)
        self.touches = touch is not None
        n = len(specs)
        self.index = np.arange(n)
        self.q = list(self.model.rest_q[side])
        self.dq = [0.0] * n
        self.tau = [0.0] * n
        self.contact = [0.0] * n
        self.goal, self.speed, self.push, self.kp, self.kd = np.zeros((5, n))
        self.client_kp, self.client_kd = np.array(self.model.gains).T
        self.status: Ints = np.zeros(n, dtype=np.intp)
        self.guarded: Flags = np.zeros(n, dtype=np.bool_)
        self.tripped: Flags = np.zeros(n, dtype=np.bool_)
        self.gained: tuple[list[float], float] = (self.dq, 1.0)
        """Velocities before the last step, and how long that was."""
        self.now = 0.0
        self.heard = math.inf
        self.newest: tuple[Motor, ...] = ()
        self.version = 0
        """Counts the changes of the visible state."""
        self.changed()

    def command(self, motors: tuple[Motor, ...]) -> None:
        """Take a command; one field that is not finite rejects all of it."""
        if motors is self.newest and self.heard != math.inf:
            self.heard = self.now
            return  # an equal command changes nothing
        rows: Floats = np.array([(m.q, m.dq, m.tau, m.kp, m.kd) for m in motors]).T
        if not np.isfinite(rows).all():
            return
        self.newest, self.heard = motors, self.now
        self.take(rows, np.array([m.mode for m in motors]))
        self.changed()

    def take(self, rows: Floats, mode: Ints) -> None:
        """Put a command in force: q within the limits, status and time-out bit of the mode byte."""
        self.goal = np.minimum(np.maximum(rows[0], self.low), self.high)
        self.speed, self.push = rows[1:3]
        self.kp, self.kd = np.maximum(rows[3:], 0.0)
        self.status, self.guarded = self.understood(mode)
        self.tripped = self.tripped & self.guarded

    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        """Each motor's status and whether its time-out protection is on, from the mode bytes."""
        raise AssertionError  # overridden

    def mode_bytes(self) -> Ints:
        """The mode bytes of a state."""
        raise AssertionError  # overridden

    def expire(self) -> None:
        """The time-out has passed without a command: no joint is driven by a velocity any more."""
        self.speed = np.zeros_like(self.speed)
        self.push = np.zeros_like(self.push)

    def release(self) -> None:
        """Forget the command: brake."""
        self.status = np.zeros_like(self.status)
        self.changed()

    def changed(self) -> None:
        """Compute the control law of the command in force."""
        self.driven: Flags = (self.status == JointMode.FOC) & ~self.tripped
        self.mode = self.mode_bytes()
        self.law_on = self.driven.tolist()
        self.law_q = self.goal.tolist()
        self.law_kp = np.where(self.driven, self.kp, 0.0).tolist()
        self.law_kd = np.where(self.driven, self.kd, self.brake).tolist()
        self.law_tau = np.where(self.driven, self.kd * self.speed + self.push, 0.0).tolist()
        self.stops = self.floor.tolist(), self.ceiling.tolist(), self.most.tolist()
        self.rests = False
        self.version += 1

    def step(self, dt: float) -> None:
        """Advance by one step."""
        self.now += dt
        if self.now - self.heard > self.timeout:
            self.heard = math.inf
            self.expire()
            self.changed()
        if self.rests:
            return  # at rest: the state does not change
        self.version += 1
        before = self.dq
        self.gained = before, dt
        pull = [
            kp * (goal - q) + tau
            for kp, goal, q, tau in zip(self.law_kp, self.law_q, self.q, self.law_tau, strict=True)
        ]
        self.move(dt, pull)
        self.rests = not any(before) and not any(self.dq)

    def move(self, dt: float, pull: list[float]) -> None:
        """One step of the mechanics under ``pull`` (N m) and the law's damping.

        Implicit in damping and stiffness, so that a stiff law is stable at this step. Plain
        numbers: there are too few joints for numpy to be quick.
        """
        coulomb, viscous = self.coulomb, self.viscous
        part = dt / self.inertia
        slip = part * coulomb
        law_kp, law_kd, law_on = self.law_kp, self.law_kd, self.law_on
        floor, ceiling, torque = self.stops
        # most joints stay at rest between their stops: for them, only the torque is new
        q_, dq_, tau_, contact_ = self.q.copy(), [0.0] * len(pull), pull.copy(), [0.0] * len(pull)
        for i, (q, dq, tau, low, high) in enumerate(
            zip(self.q, self.dq, pull, floor, ceiling, strict=True)
        ):
            contact = 0.0
            if not low <= q <= high:
                contact = self.stiffness * ((low if q < low else high if q > high else q) - q)
                contact_[i] = contact
            if dq == 0.0 and -coulomb < tau + contact < coulomb:
                continue
            damping = law_kd[i] + dt * law_kp[i]
            new = (dq + part * (tau + contact)) / (1.0 + part * (damping + viscous))
            tau -= damping * new
            most = torque[i]
            if tau > most or tau < -most:
                tau = most if tau > most else -most
                new = (dq + part * (tau + contact)) / (1.0 + part * viscous)
            new = new - slip if new > slip else new + slip if new < -slip else 0.0
            q_[i] = q + dt * new
            dq_[i] = new
            tau_[i] = tau
        self.q, self.dq, self.contact = q_, dq_, contact_
        if not all(law_on):
            tau_ = [t if on else 0.0 for t, on in zip(tau_, law_on, strict=True)]
        self.tau = tau_

    def pressures(self) -> Floats:
        """Shape (n_sensors, 12): the values of the sensor packets."""
        return self.untouched()

    def untouched(self) -> Floats:
        """The same at this time, if nothing touched the hand."""
        return np.zeros((0, 12))


class Dex3Hand(FingerHand):
    """Seven joints and RIS_Mode (docs/sources/unitree-dex.md#b4)."""

    model = DEX3_1
    inertia = 0.001
    viscous = 0.002
    coulomb = 0.005
    brake = 0.2
    stiffness = 60.0
    noise = 0

    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        """Status in bits 4 to 6, protection in bit 7."""
        return (mode >> 4) & 7, mode >= 0x80

    def mode_bytes(self) -> Ints:
        """The same, and the motor's index."""
        return np.asarray(self.index | self.driven << 4 | self.tripped << 7)

    def expire(self) -> None:
        """Protected motors trip; the others keep their position."""
        self.tripped = self.tripped | self.guarded
        super().expire()

    def pressures(self) -> Floats:
        """Values of the sensor packets, shape (9, 12)."""
        rest = self.untouched()
        if not self.touches or not any(self.contact):
            return rest
        pressure = np.array(rest)
        pressure[_PRESSED] += _PER_TORQUE * np.abs(self.contact)[_PRESSING]
        return pressure

    def untouched(self) -> Floats:
        """The air's pressure, with the offset and the noise of each element."""
        return _UNTOUCHED[self.side][self.noise % len(_UNTOUCHED[self.side])]

    def step(self, dt: float) -> None:
        """Advance by one step, also with the noise of the sensors."""
        super().step(dt)
        noise = int(self.now / _NOISE_S)
        if noise != self.noise:
            self.noise = noise
            self.version += 1


def _untouched(side: Side) -> list[Floats]:
    """Readings of an untouched hand, one after the other: about 100,000, as on real ones
    (docs/sources/real-hands.md#touch-rest). Offsets and noise of the elements are made up.
    """
    places = 12 * np.arange(len(DEX3_1.sensors))[:, np.newaxis] + np.arange(12)
    offsets = 101_000.0 + (577.0 * places + (311.0 if side is Side.RIGHT else 0.0)) % 2300.0
    rows = []
    for k in range(_NOISE_ROWS):
        row = np.full(offsets.shape, NO_VALUE)
        for i, sensor in enumerate(DEX3_1.sensors):
            slots = list(sensor.slots)
            row[i, slots] = (offsets + (37.0 * (k + 1) * (places + 3)) % 61.0)[i, slots]
        row.setflags(write=False)  # so that equal ones are known by identity
        rows.append(row)
    return rows


def _pressed() -> tuple[tuple[Ints, Ints], Ints]:
    """Rows and columns of the values that a joint presses, and the joint of each."""
    found = []
    for row, sensor in enumerate(DEX3_1.sensors):
        finger, _, part = sensor.place.partition(" ")
        if finger in _PRESSED_BY:
            joint = _PRESSED_BY[finger][part == "pad"]
            found += [(row, column, joint) for column in sensor.slots]
    rows, columns, joints = np.array(found).T
    return (rows, columns), joints


_PER_TORQUE = 5e4  # Pa per N m; made up, so that a grip is above 150,000
_NOISE_S, _NOISE_ROWS = 0.05, 16
_UNTOUCHED = {side: _untouched(side) for side in Side}
_PRESSED, _PRESSING = _pressed()


class _Message:
    """The bytes of a state, and views of each hand's motors and of the sensor packets in it."""

    def __init__(self, data: bytearray, motors: Sequence[Any], packets: Any) -> None:
        self.data, self.motors, self.packets = data, motors, packets
        self._pressure: Floats | None = None

    def set_pressures(self, pressure: Floats) -> None:
        """Fill in the values of the packets, shape (n_sensors, 12)."""
        # those of a hand that touches nothing are arrays that cannot change
        if pressure is not self._pressure or pressure.flags.writeable:
            self.packets["pressure"] = pressure[: len(self.packets)]
            self._pressure = pressure


class FingerService(Service):
    """The hands on their topics."""

    fault_sides = (Side.LEFT,)  # several joints take long
    tick = 0.002
    period = 0.002
    hand: type[FingerHand]
    hand_fault: type[FingerHand] | None = None
    """Mixed into the hands of a wrong hand's reference."""
    motor_layout = _MOTOR
    sensors = 0
    """Sensor packets in a state."""
    attitude: Sequence[float] = (0.0, 0.0, 0.0, 0.0)
    """The quaternion: there is no IMU."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        fault, hand = cls.hand_fault, getattr(cls, "hand", None)
        if fault is not None and hand is not None and not issubclass(hand, fault):
            cls.hand = type(fault.__name__, (fault, hand), {})

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.hands = {s: self.hand(s, touch.get(s)) for s in self.sides}
        self._blank: dict[tuple[tuple[Side, ...], int], _Message] = {}
        self._sent: dict[tuple[Side, ...], tuple[object, bytes]] = {}
        units = dialect.torque_units or (1.0,) * self.codec.joints
        self.torque_units: Floats = np.array(units)
        self.scaled = any(unit != 1.0 for unit in units)

    def take_over(self, before: TopicDevice) -> None:
        """Find the hands where the service before it has left them."""
        assert isinstance(before, FingerService)
        for side, hand in self.hands.items():
            hand.q = list(before.hands[side].q)
            hand.changed()

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        """Take one side's part of a command message."""
        self.hands[side].command(motors)

    def positions(self, side: Side) -> Pose:
        """The pose of a hand."""
        return tuple(self.hands[side].q)

    def brake(self) -> None:
        """Brake the hands."""
        for hand in self.hands.values():
            hand.release()

    def live(self, dt: float) -> None:
        """Advance the hands."""
        for hand in self.hands.values():
            hand.step(dt)

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of these hands on the wire."""
        count = self.dialect.length if length is None else length
        hands = [self.hands[s] for s in sides]
        key = (count, *[hand.version for hand in hands])
        sent = self._sent.get(sides)
        if sent is not None and sent[0] == key:
            return sent[1]
        message = self._message(sides, count)
        for hand, mine in zip(hands, message.motors, strict=True):
            if len(mine):
                self.fill(mine, hand)
            if self.sensors:
                message.set_pressures(self.pressures(hand))
        payload = bytes(message.data)
        self._sent[sides] = (key, payload)
        return payload

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """Fill in the motors of a state."""
        n = len(motors)
        motors["mode"] = hand.mode if n == len(hand.mode) else hand.mode[:n]
        tau = hand.tau
        if self.scaled:
            tau = [t / unit for t, unit in zip(tau, self.torque_units.tolist(), strict=True)]
        values = hand.q, *self.rates(hand), tau
        # numpy is quicker with the lists themselves than with an array of them
        motors["values"].T[...] = values if n == len(tau) else [row[:n] for row in values]

    def rates(self, hand: FingerHand) -> tuple[list[float], list[float]]:
        """(dq, ddq) of a state's motors."""
        before, dt = hand.gained
        return hand.dq, [(a - b) / dt for a, b in zip(hand.dq, before, strict=True)]

    def pressures(self, hand: FingerHand) -> Floats:
        """Shape (n_sensors, 12): the values of its sensor packets."""
        return hand.pressures()

    def quaternion(self) -> Sequence[float]:
        """The hand's attitude."""
        return self.attitude

    def message(self, count: int) -> Any:
        """A state with its constant members: number of motors, sensor packets, attitude."""
        motor = message_type("unitree_hg::msg::dds_::MotorState_").cls
        packet = message_type("unitree_hg::msg::dds_::PressSensorState_").cls
        message = self.codec.state.cls()
        message.motor_state = [motor(temperature=(30, 40), vol=24.0) for _ in range(count)]
        message.press_sensor_state = [packet(temperature=(25.0,) * 12) for _ in range(self.sensors)]
        message.imu_state.quaternion = list(self.quaternion())
        return message

    def _message(self, sides: tuple[Side, ...], count: int) -> _Message:
        """A message of these hands with so many motors; made once."""
        if (sides, count) not in self._blank:
            data = bytearray(self.codec.state.encode(self.message(count)))
            at = 8  # header and length
            every = np.frombuffer(data, self.motor_layout, count, at)
            firsts = [self.dialect.index[s] for s in sides]
            motors = [every[first : first + self.codec.joints] for first in firsts]
            at += count * self.motor_layout.itemsize + 4
            packets = np.frombuffer(data, _PACKET, self.sensors, at if self.sensors else 0)
            self._blank[sides, count] = _Message(data, motors, packets)
        return self._blank[sides, count]


class Dex3Service(FingerService):
    """Dex3-1 hands on their topics, at half of the real one's rate."""

    hand = Dex3Hand
    sensors = len(DEX3_1.sensors)
    attitude = (1.0, 0.0, 0.0, 0.0)
    low_period = 1.0 / DEX3_1.dialects[0].low_rate
    low_due = 0.0

    def publish(self) -> list[Sample]:
        """One state of every hand, at the low rate on the low-rate topic as well."""
        samples = super().publish()
        if self.now + 1e-9 < self.low_due:
            return samples
        self.low_due = self.now + self.low_period
        return samples + self.low_rate(samples)

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        """Copies of the states on the low-rate topics."""
        topics = {
            self.codec.state_topics[s]: self.dialect.low_rate_topic.format(side=s)
            for s in self.sides
        }
        return [
            Sample(topics[x.topic], x.type_name, x.payload, x.sent)
            for x in samples
            if x.topic in topics
        ]

    def message(self, count: int) -> Any:
        """The same with a supply."""
        message = super().message(count)
        message.power_v, message.power_a = 24.0, 0.3
        message.system_v, message.device_v = 12.0, 12.0
        return message
