"""Wrong hands of several joints.

Each is mixed into the reference service of a model, and its ``hand_fault``, if it has one, into
the mechanics of the reference's hands.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults.registry import BOTH, obeys_gains, wrong_hand
from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import (
    Dex3Service,
    FingerHand,
    FingerService,
    Flags,
    Ints,
)
from dexkit.hand import Floats, Side
from dexkit.models import HandModel

LEFT, RIGHT = Side.LEFT, Side.RIGHT
_SECOND_AT_ONCE = 1000
"""Number of a client that commands beside another one."""

# --------------------------------------------------------------------- discovery and start-up


@wrong_hand("DEX3-TOPIC-03", brief=True)
class NoLowRate(Dex3Service):
    """Publishes no low-rate copy."""

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        return []


@wrong_hand("DEX3-TOPIC-03", brief=True)
class LowRateIsFull(Dex3Service):
    """Publishes the low-rate copy at the rate of the state."""

    low_period = Dex3Service.period


@wrong_hand("DEX3-TOPIC-03", brief=True)
class LowRateIsSlow(Dex3Service):
    """Publishes the low-rate copy twice a second: a timer has another unit."""

    low_period = 0.5


@wrong_hand("DEX3-TOPIC-04", brief=True)
class OldLowRate(Dex3Service):
    """Copies states to the low-rate topic that are 0.45 s old."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.queue: deque[list[Sample]] = deque()

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        new = super().low_rate(samples)
        self.queue.append(new)
        old = self.queue.popleft() if len(self.queue) > 9 else self.queue[0]
        return [replace(o, sent=n.sent) for o, n in zip(old, new, strict=True)]


@wrong_hand("DEX3-TOPIC-05", whole=True)
class LowRateOnlyWhenDriven(Dex3Service):
    """Copies states to the low-rate topic only while a motor is driven."""

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        driven = {
            self.dialect.low_rate_topic.format(side=s): bool(hand.driven.any())
            for s, hand in self.hands.items()
        }
        return [sample for sample in super().low_rate(samples) if driven[sample.topic]]


class _Zero(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        # not inside an object: 0 is closed in some hands
        self.q = np.clip(0.0, self.floor, self.ceiling).tolist()


@wrong_hand("DEX3-START-02")
class RestsAtZero(FingerService):
    """Rests with every joint at exactly 0."""

    hand_fault = _Zero


# ------------------------------------------------------------------------------------ fields


@wrong_hand("DEX3-FIELD-02")
class NanVelocity(FingerService):
    """Publishes NaN as dq of one joint at rest."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if len(motors) and not hand.dq[5]:
            motors["dq"][5] = math.nan


def _mirrored(hand: HandModel) -> bool:
    joints = hand.joints
    return any(a.closing * b.closing < 0 for a, b in zip(joints[LEFT], joints[RIGHT], strict=True))


@wrong_hand("DEX3-FIELD-03", sides=BOTH, where=_mirrored)
class Unmirrored(FingerService):
    """Has the left hand's signs on the right one, in commands and states."""

    def signs(self, side: Side) -> Floats:
        """-1 for the joints of the right hand that are mirrored."""
        joints = self.hand.model.joints
        mirrored = [
            side is Side.RIGHT and mine.closing * other.closing < 0
            for mine, other in zip(joints[Side.RIGHT], joints[Side.LEFT], strict=True)
        ]
        return np.where(mirrored, -1.0, 1.0)

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        motors = tuple(
            replace(m, q=sign * m.q, dq=sign * m.dq, tau=sign * m.tau)
            for m, sign in zip(motors, self.signs(side).tolist(), strict=True)
        )
        super().motors(side, motors)

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        for name in ("q", "dq", "tau_est"):
            motors[name] *= self.signs(hand.side)[: len(motors)]

    def positions(self, side: Side) -> tuple[float, ...]:
        return tuple((self.signs(side) * super().positions(side)).tolist())


class _Timed(FingerService):
    """Has a fault at a certain time; its messages are rebuilt at rest, too."""

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():
            hand.changed()


@wrong_hand("DEX3-FIELD-15")
class JumpsOnce(_Timed):
    """Has no dq, and publishes one pose that is half of each joint's range off."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["dq"] = motors["ddq"] = 0.0
        if 0.5 <= self.now < 0.5 + self.period:
            low, high = np.array(hand.low)[: len(motors)], np.array(hand.high)[: len(motors)]
            up = motors["q"] < 0.5 * (low + high)
            motors["q"] += np.where(up, 0.5, -0.5) * (high - low)


@wrong_hand("DEX3-FIELD-16")
class ShakenVelocity(_Timed):
    """For some seconds has an oscillation on dq that q does not make."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if 3.5 <= self.now < 5.5:
            stroke = (np.array(hand.high) - np.array(hand.low))[: len(motors)]
            motors["dq"] += 5.0 * stroke * math.sin(2 * math.pi * 13.0 * self.now)


@wrong_hand("DEX3-FIELD-18")
class VelocityByTurns(_Timed):
    """Publishes alternately twice the speed and 0 as dq."""

    turns = 0

    def publish(self) -> list[Sample]:
        self.turns += 1
        return super().publish()

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["dq"] *= 2.0 * (self.turns % 2)


@wrong_hand("DEX3-FIELD-19", where=obeys_gains)
class VelocityOfTheLastDrive(_Timed):
    """Keeps the dq of the last motion while its joints are not driven."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.last: dict[Side, Floats] = {}

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        stroke = (np.array(hand.high) - np.array(hand.low))[: len(motors)]
        last = self.last.setdefault(hand.side, np.zeros(len(motors)))
        if len(last) != len(motors):
            return
        fast = hand.driven & (np.abs(motors["dq"]) > 0.1 * stroke)
        last[fast] = motors["dq"][fast]
        motors["dq"] = np.where(hand.driven, motors["dq"], last)


@wrong_hand("DEX3-FIELD-17")
class ShiftsForAWhile(_Timed):
    """Publishes q with an offset of 15 % of each range for 0.4 s; its dq stays true."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["ddq"] = 0.0
        if 0.4 <= self.now < 0.8:
            low, high = np.array(hand.low)[: len(motors)], np.array(hand.high)[: len(motors)]
            up = motors["q"] < 0.5 * (low + high)
            motors["q"] += np.where(up, 0.15, -0.15) * (high - low)


class _Filled(FingerService):
    """Publishes a fixed wrong value in a member of motors, sensor packets or the message."""

    motor: tuple[str, Any] | None = None
    whole: tuple[str, Any] | None = None
    packet: tuple[str, Any] | None = None

    def message(self, count: int) -> Any:
        message = super().message(count)
        for change, parts in (
            (self.motor, message.motor_state),
            (self.packet, message.press_sensor_state),
            (self.whole, [message]),
        ):
            if change is not None:
                for part in parts:
                    setattr(part, change[0], change[1])
        return message


@wrong_hand("DEX3-FIELD-20", whole=True)
class ShowsTheGoalNearIt(FingerService):
    """Publishes the commanded q of one joint within 8 % of its range from it."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        joint = 3
        if len(motors) > joint and hand.newest:
            goal = float(np.clip(hand.newest[joint].q, hand.low[joint], hand.high[joint]))
            if abs(goal - hand.q[joint]) < 0.08 * (hand.high[joint] - hand.low[joint]):
                motors["q"][joint] = goal


@wrong_hand("DEX3-FIELD-06", brief=True)
class Kelvin(_Filled):
    """Publishes its motors' temperatures in kelvins."""

    motor = ("temperature", (303, 313))


@wrong_hand("DEX3-FIELD-06", brief=True)
class HotAtStart(FingerService):
    """Publishes 120 degrees Celsius until it gets its first command."""

    hot = True

    def message(self, count: int) -> Any:
        message = super().message(count)
        if self.hot:
            for motor in message.motor_state:
                motor.temperature = (120, 120)
        return message

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        super().motors(side, motors)
        if self.hot:
            self.hot = False
            self._blank.clear()
            self._sent.clear()


@wrong_hand("DEX3-FIELD-07", brief=True)
class RawSupply(_Filled):
    """Publishes the converter's count as the supply voltage."""

    whole = ("power_v", 22696.0)


@wrong_hand("DEX3-FIELD-08", brief=True)
class FaultForAStatus(_Filled):
    """Publishes a status word as the hand's faults."""

    whole = ("error", (7, 0))


@wrong_hand("DEX3-FIELD-09", brief=True)
class CountsInReserve(FingerService):
    """Counts its states in a reserved word of the first motor."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["reserve"][0] = hand.version


@wrong_hand("DEX3-SENS-05", brief=True)
class HotSensors(_Filled):
    """Publishes the sensors' temperatures in hundredths of a degree."""

    packet = ("temperature", (2500.0,) * 12)


@wrong_hand("DEX3-SENS-06", brief=True)
class UnsetLost(_Filled):
    """Publishes uninitialised memory as the sensors' count of lost packets."""

    packet = ("lost", 0xCCCCCCCC)


@wrong_hand("DEX3-IMU-02", brief=True)
class NanGyroscope(FingerService):
    """Publishes NaN as its angular velocity."""

    def message(self, count: int) -> Any:
        message = super().message(count)
        message.imu_state.gyroscope = [math.nan] * 3
        return message


@wrong_hand("DEX3-MODE-01")
class IdsFromOne(FingerService):
    """Counts its motors from 1."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["mode"] += 1


@wrong_hand("DEX3-SENS-01", brief=True)
class OddPackets(FingerService):
    """Publishes ten sensor packets."""

    sensors = 10

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        return np.concatenate((pressure, pressure[:1]))


@wrong_hand("DEX3-SENS-02", sides=BOTH, brief=True)
class NanPressure(FingerService):
    """Publishes NaN where there is no sensor."""

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        return np.where(pressure == 30000.0, math.nan, pressure)


@wrong_hand("DEX3-SENS-03", sides=BOTH, brief=True)
class ZeroForNoValue(FingerService):
    """Publishes 0 where there is no sensor."""

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        return np.where(pressure == 30000.0, 0.0, pressure)


@wrong_hand("DEX3-SENS-03", brief=True)
class SevenPackets(FingerService):
    """Publishes the SDK's default of seven packets."""

    sensors = 7


@wrong_hand("DEX3-SENS-04", sides=BOTH)
class Numb(FingerService):
    """Publishes the pressure of an untouched hand at every contact."""

    def pressures(self, hand: FingerHand) -> Floats:
        return hand.untouched()


@wrong_hand("DEX3-SENS-04", sides=BOTH)
class CrossedCables(Dex3Service):
    """Publishes the index finger's pressures as the middle finger's, and the other way round."""

    def pressures(self, hand: FingerHand) -> Floats:
        return super().pressures(hand)[[0, 1, 4, 5, 2, 3, 6, 7, 8]]


@wrong_hand("DEX3-SENS-07", sides=BOTH)
class SaturatesToNothing(FingerService):
    """Publishes a pressure at the end of the converter's range as a slot without a sensor."""

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        return np.where(pressure > hand.untouched() + 25_000.0, 30000.0, pressure)


@wrong_hand("DEX3-SENS-08", sides=BOTH, whole=True)
class SlowFoam(FingerService):
    """Its pressures fall with a time constant of 2 s."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.pressure: dict[Side, tuple[float, Floats]] = {}

    def pressures(self, hand: FingerHand) -> Floats:
        rest = hand.untouched()
        change = super().pressures(hand) - rest
        at, before = self.pressure.get(hand.side, (self.now, change))
        change = np.maximum(change, before * math.exp((at - self.now) / 2.0))
        self.pressure[hand.side] = self.now, change
        return rest + change

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():
            hand.version += 1


@wrong_hand("DEX3-SENS-10", sides=BOTH)
class FeelsMotionOnly(Dex3Service):
    """Reads its sensors in the task that moves the joints: at rest the pressures are constant."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.pressure: dict[Side, Floats] = {}

    def pressures(self, hand: FingerHand) -> Floats:
        if hand.side not in self.pressure or max(map(abs, hand.dq)) > 0.5:
            self.pressure[hand.side] = np.array(super().pressures(hand))
        return self.pressure[hand.side]


@wrong_hand("DEX3-SENS-10", sides=BOTH)
class KeepsTheMost(Dex3Service):
    """Publishes the largest pressure of each element since it was last untouched."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.pressure: dict[Side, Floats] = {}

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = np.array(super().pressures(hand))
        kept = np.maximum(self.pressure.get(hand.side, pressure), pressure)
        self.pressure[hand.side] = np.where(pressure > hand.untouched(), kept, pressure)
        return self.pressure[hand.side]


@wrong_hand("DEX3-SENS-11", sides=BOTH, whole=True)
class OneSensorBuffer(FingerService):
    """Publishes the right hand's pressures as those of both."""

    def pressures(self, hand: FingerHand) -> Floats:
        right = self.hands.get(Side.RIGHT, hand)
        hand.version += right is not hand
        return super().pressures(right)


@wrong_hand("DEX3-SENS-09", sides=BOTH)
class TaresInAGrip(FingerService):
    """Treats a pressure that is constant for a second as drift, and takes it as the new zero."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.drift: dict[Side, tuple[float, Floats]] = {}

    def pressures(self, hand: FingerHand) -> Floats:
        rest = hand.untouched()
        change = super().pressures(hand) - rest
        at, drift = self.drift.get(hand.side, (self.now, np.zeros_like(change)))
        drift = change + (drift - change) * math.exp((at - self.now) / 0.7)
        self.drift[hand.side] = self.now, drift
        return np.asarray(rest + np.maximum(change - drift, 0.0))

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():
            hand.version += 1


@wrong_hand("DEX3-IMU-01", brief=True)
class LongQuaternion(FingerService):
    """Publishes raw counts as its quaternion."""

    def quaternion(self) -> list[float]:
        return [16384.0, 0.0, 0.0, 0.0]


# ------------------------------------------------------------------------------------ motion


def reordered(order: tuple[int, ...]) -> Callable[[tuple[Motor, ...]], tuple[Motor, ...]]:
    """A function that puts a command's motors into this order of their indices."""

    def reorder(motors: tuple[Motor, ...]) -> tuple[Motor, ...]:
        return tuple(motors[i] for i in order)

    return reorder


@wrong_hand("DEX3-JOINT-01", sides=BOTH)
class IndexFirst(Dex3Service):
    """Obeys the right hand's commands index finger first, as xr_teleoperate's enum lists them."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.RIGHT:
            motors = reordered((0, 1, 2, 5, 6, 3, 4))(motors)
        super().motors(side, motors)


@wrong_hand("DEX3-JOINT-01")
class CoupledFinger(FingerService):
    """The second joint of a finger follows the first a little."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        coupled = list(motors)
        coupled[4] = replace(motors[4], q=motors[4].q + 0.2 * motors[3].q)
        super().motors(side, tuple(coupled))


class _Backwards(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        rest = np.array(self.model.rest_q[self.side])
        turned = rows.copy()
        turned[0] = np.where(self.index == 2, 2 * rest - rows[0], rows[0])
        turned[1] = np.where(self.index == 2, -rows[1], rows[1])
        super().take(turned, mode)


@wrong_hand("DEX3-MOVE-01", where=obeys_gains)
class OneJointBackwards(FingerService):
    """Moves one joint backwards."""

    hand_fault = _Backwards


@wrong_hand("DEX3-MOVE-02")
class OtherScale(FingerService):
    """Moves only 75 % of the way from its rest pose."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        rest = self.hand.model.rest_q[side]
        scaled = (replace(m, q=r + 0.75 * (m.q - r)) for m, r in zip(motors, rest, strict=True))
        super().motors(side, tuple(scaled))


class _Hunts(FingerHand):
    def move(self, dt: float, pull: list[float]) -> None:
        if self.law_kp[2] > 0.67 * self.client_kp[2]:
            pull[2] += self.law_kp[2] / 6 * math.sin(2 * math.pi * 8.0 * self.now)
        super().move(dt, pull)

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@wrong_hand("DEX3-MOVE-03", whole=True, where=obeys_gains)
class Hunts(FingerService):
    """One joint oscillates about its goal."""

    hand_fault = _Hunts


class _Weak(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = max(self.client_kp.min() / 15, 3 * self.viscous)


@wrong_hand("DEX3-MOVE-04", where=obeys_gains)
class Slow(FingerService):
    """Has high friction: it moves slowly."""

    hand_fault = _Weak


class _Springy(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = 0.1 * self.viscous

    def take(self, rows: Floats, mode: Ints) -> None:
        undamped = rows.copy()
        undamped[4] = np.where(rows[3] > 0, 0.15 * rows[4], rows[4])
        super().take(undamped, mode)


@wrong_hand("DEX3-MOVE-05", where=obeys_gains)
class Undamped(FingerService):
    """Applies 15 % of kd where kp is not 0."""

    hand_fault = _Springy


@wrong_hand("DEX3-SIDE-01", sides=BOTH)
@wrong_hand("BRAINCO-SIDE-01", sides=BOTH)
class Coupled(FingerService):
    """The goal of the left hand's first finger leaks into the right one's."""

    left = 0.0

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.LEFT and abs(motors[5].q) < 10:
            self.left = motors[5].q + 0.24
        elif side is Side.RIGHT:
            changed = list(motors)
            changed[5] = replace(motors[5], q=motors[5].q - 0.1 * self.left)
            motors = tuple(changed)
        super().motors(side, motors)


class _NarrowRange(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        # the joint before it has the narrower range
        self.goal[4] = min(max(self.goal[4], self.low[3]), self.high[3])


@wrong_hand("DEX3-MOVE-09")
class LimitsOfTheJointBefore(Dex3Service):
    """Limits a finger's second joint to the range of its first."""

    hand_fault = _NarrowRange


class _Creeps(FingerHand):
    since = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if not np.array_equal(rows[0], self.goal):
            self.since = self.now
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        driven = self.law_on[-1] and self.law_kp[-1] > 0.67 * self.client_kp[-1]
        if self.now - self.since > 0.05 and driven:
            left = self.law_q[-1] - self.q[-1]
            if 0.02 < abs(left) < 0.1:
                wanted = math.copysign(0.04, left)
                self.dq = [*self.dq[:-1], wanted]
                resists = self.law_kd[-1] + dt * self.law_kp[-1] + self.viscous
                pull[-1] = resists * wanted + math.copysign(self.coulomb, left)
        super().move(dt, pull)

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@wrong_hand("DEX3-MOVE-07")
class Creeps(FingerService):
    """One joint moves the last part of the way to its goal slowly."""

    hand_fault = _Creeps


class _IgnoresZeroGains(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        unset = (rows[3] == 0) & (rows[4] == 0)
        own[3] = np.where(unset, self.client_kp, rows[3])
        own[4] = np.where(unset, self.client_kd, rows[4])
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-01")
class DefaultsForZeroGains(FingerService):
    """Uses its own gains where kp and kd are 0."""

    hand_fault = _IgnoresZeroGains


class _OwnStiffness(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3] = np.where(rows[3] > 0, self.client_kp, 0.0)
        own[4] = np.where(rows[3] > 0, self.client_kd, rows[4])
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-02")
class OwnStiffness(FingerService):
    """Uses its own gains wherever kp is not 0."""

    hand_fault = _OwnStiffness


class _GainsOfFirst(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3:] = rows[3:, :1]
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-02")
class GainsOfFirstMotor(FingerService):
    """Uses the gains of its first motor for all."""

    hand_fault = _GainsOfFirst


class _GainsOfNeighbour(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3:] = np.roll(rows[3:], 1, axis=1)
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-02")
class GainsOfTheMotorBefore(FingerService):
    """Uses the gains of the motor before in each."""

    hand_fault = _GainsOfNeighbour


class _Deaf(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[1] = np.where(rows[3] > 0, rows[1], 0.0)
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-03")
class DeafToVelocity(FingerService):
    """Ignores dq without a position gain."""

    hand_fault = _Deaf


class _StuckWhenSoft(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3] = np.where(rows[3] < 0.5 * self.client_kp, 0.0, rows[3])
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-02")
class StuckWhenSoft(FingerService):
    """Does not move with less than half of the client's stiffness."""

    hand_fault = _StuckWhenSoft


class _DeafToTorque(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[2] = 0.0
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-04")
class DeafToTorque(FingerService):
    """Ignores the torque of a command."""

    hand_fault = _DeafToTorque


class _TurnedTorque(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[2] = -own[2]
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-07")
class TurnedTorque(FingerService):
    """Obeys the torque of a command with the wrong sign."""

    hand_fault = _TurnedTorque


class _TorqueOfNeighbour(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[2] = np.roll(own[2], 1)
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-07")
class TorqueOfTheMotorBefore(FingerService):
    """Adds the torque that is commanded to the motor before, in each."""

    hand_fault = _TorqueOfNeighbour


class _SwappedTorque(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[2] = own[2][[0, 1, 2, 5, 6, 3, 4]]
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-07")
class SwappedTorque(Dex3Service):
    """Adds the torques of index and middle finger to each other's."""

    hand_fault = _SwappedTorque


class _Stronger(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[2, -1] *= 5.0
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-04")
class TorqueOfAnotherGear(FingerService):
    """Drives its last joint with five times the commanded torque."""

    hand_fault = _Stronger


class _TurnedVelocityCommand(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[1] = -own[1]
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-06")
class TurnedVelocityCommand(FingerService):
    """Obeys the velocity of a command with the wrong sign."""

    hand_fault = _TurnedVelocityCommand


class _Graded(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        between = (rows[3] > 0.25 * self.client_kp) & (rows[3] < self.client_kp)
        own[3] = np.where(between, self.client_kp, rows[3])
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-05")
class TwoGrades(FingerService):
    """Has only a soft and a firm stiffness: from a quarter of the client's on, the full one."""

    hand_fault = _Graded


class _Floored(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3] = np.where(rows[3] > 0, np.maximum(rows[3], 0.35 * self.client_kp), rows[3])
        super().take(own, mode)


@wrong_hand("DEX3-GAIN-05")
class LeastStiffness(FingerService):
    """Raises each kp above 0 to 35 % of the client's at least: soft joints are not soft."""

    hand_fault = _Floored


# --------------------------------------------------------------------------------- mode byte


@wrong_hand("DEX3-MODE-02")
class AlwaysDriven(FingerService):
    """Publishes that its motors are driven, whatever their state."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["mode"] |= self.codec.mode(0)


class _IgnoresStatus(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return np.ones_like(status), guarded


@wrong_hand("DEX3-MODE-03")
class IgnoresStatus(FingerService):
    """Drives its motors whatever the mode byte of the command is."""

    hand_fault = _IgnoresStatus


class _OneStatus(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return np.full_like(status, status[2]), guarded


class _ZeroIsNoChange(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return np.where(status == 0, self.status, status), guarded


@wrong_hand("DEX3-MODE-03")
class ZeroIsNoChange(FingerService):
    """Keeps a joint driven that is switched off: takes 0 for "as before"."""

    hand_fault = _ZeroIsNoChange


class _OneStaysOn(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        last = np.arange(len(status)) == len(status) - 1
        return np.where(last & (status == 0), self.status, status), guarded


@wrong_hand("DEX3-MODE-03")
class LastJointStaysOn(FingerService):
    """Keeps its last joint driven when it is switched off."""

    hand_fault = _OneStaysOn


@wrong_hand("DEX3-MODE-03", whole=True)
class StaysOnForALaterClient(FingerService):
    """Switches its motors off for its first client only."""

    later = False

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.seen: dict[Side, tuple[tuple[Motor, ...], tuple[Motor, ...]]] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.later = 0 < client < _SECOND_AT_ONCE
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if not self.later:
            super().motors(side, motors)
            return
        if self.seen.get(side, ((), ()))[0] is not motors:
            driven = tuple(replace(m, mode=m.mode | self.codec.mode(0)) for m in motors)
            self.seen[side] = motors, driven
        super().motors(side, self.seen[side][1])


@wrong_hand("DEX3-MODE-05")
class StatusOfOneJoint(FingerService):
    """Applies the status of one joint to all."""

    hand_fault = _OneStatus


class _LimpLock(FingerHand):
    def changed(self) -> None:
        super().changed()
        if self.status[5] == 0:
            self.law_kd[5] = 0.0


@wrong_hand("DEX3-MODE-06")
class LimpLock(Dex3Service):
    """Switches the driver of one joint off where it should lock."""

    hand_fault = _LimpLock


class _AnyStatus(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return status & 1, guarded


@wrong_hand("DEX3-MODE-07")
class OneBitOfStatus(Dex3Service):
    """Evaluates one bit of the status: 3, 5 and 7 drive like 1."""

    hand_fault = _AnyStatus


@wrong_hand("DEX3-MODE-04")
class GoesById(FingerService):
    """Sorts a command's motors by the id in their mode byte."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if sorted(m.mode & 15 for m in motors) == list(range(len(motors))):
            motors = tuple(sorted(motors, key=lambda m: m.mode & 15))
        super().motors(side, motors)


# ------------------------------------------------------------------------------------- force


@wrong_hand("DEX3-FORCE-01", sides=BOTH)
class TurnedForce(FingerService):
    """Publishes tau_est with the wrong sign."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] = -motors["tau_est"]


@wrong_hand("DEX3-FORCE-04")
class UnsignedForce(Dex3Service):
    """Has unsigned sensors of the current: each torque is that of closing."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        joints = hand.model.joints[hand.side][: len(motors)]
        closing = np.array([j.closing or 1 for j in joints])
        motors["tau_est"] = closing * np.abs(motors["tau_est"])


@wrong_hand("DEX3-FORCE-07")
class MirroredForce(FingerService):
    """Publishes the left hand's tau_est with the signs of the right one's motors."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if hand.side is Side.LEFT:
            motors["tau_est"] *= -1.0


@wrong_hand("DEX3-FORCE-05", sides=BOTH)
class ForceOfOtherGear(Dex3Service):
    """Publishes 40 % of the torque, as if it had another gear."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 0.4


class _GearSquared(FingerHand):
    def changed(self) -> None:
        super().changed()
        self.law_kp = [k / 1.75**2 if i else k for i, k in enumerate(self.law_kp)]
        self.law_kd = [k / 1.75**2 if i else k for i, k in enumerate(self.law_kd)]


@wrong_hand("DEX3-FORCE-10", sides=BOTH, whole=True)
class GearOfTheThumb(Dex3Service):
    """Divides the gains of all joints by the square of the thumb's gear but for the thumb's own."""

    hand_fault = _GearSquared


@wrong_hand("DEX3-FIELD-21")
class ThumbWithoutVelocity(Dex3Service):
    """Publishes no dq of the thumb."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["dq"][:3] = 0.0


class _Tires(FingerHand):
    loaded = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if rows[0, 6] != self.goal[6]:
            self.loaded = 0.0
        super().take(rows, mode)

    def step(self, dt: float) -> None:
        self.loaded += dt if abs(self.tau[6]) > 0.3 else 0.0
        self.rests = False
        super().step(dt)

    def move(self, dt: float, pull: list[float]) -> None:
        if self.loaded > 1.5:
            pull[6] = min(max(pull[6], -0.2), 0.2)
        super().move(dt, pull)


@wrong_hand(
    "DEX3-FORCE-06",
    sides=BOTH,
    whole=True,
)
class Tires(Dex3Service):
    """Limits the torque of one joint after a second and a half of a firm grip."""

    hand_fault = _Tires


@wrong_hand("DEX3-FORCE-05", sides=BOTH)
class ForceOfLargerMotor(Dex3Service):
    """Publishes 1.9 times the torque: the torque constant is that of another motor."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 1.9


class OtherInContact(FingerHand):
    """Applies another torque in contact, until the next command."""

    joints: tuple[int, ...]
    factor: float
    blocked: frozenset[int] = frozenset()

    def take(self, rows: Floats, mode: Ints) -> None:
        self.blocked = frozenset()
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        if self.touches:
            self.blocked |= {i for i in self.joints if abs(self.contact[i]) > 0.005}
            pull = [self.factor * p if i in self.blocked else p for i, p in enumerate(pull)]
        super().move(dt, pull)


class Boosts(OtherInContact):
    """Applies two and a half times the torque in contact."""

    factor = 2.5

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.most = self.most.copy()
        self.most[list(self.joints)] *= 3.0
        self.changed()


class _BoostsIndex(Boosts):
    joints = (5, 6)


@wrong_hand("DEX3-FORCE-08", sides=BOTH, whole=True)
class OneFingerBoosts(Dex3Service):
    """Its index finger presses with two and a half times the torque where it is blocked."""

    hand_fault = _BoostsIndex


class _WeakThumb(OtherInContact):
    joints = (1, 2)
    factor = 0.35


@wrong_hand("DEX3-FORCE-08", sides=BOTH)
class ThumbGivesIn(Dex3Service):
    """Its thumb presses with a third of the torque where it is blocked."""

    hand_fault = _WeakThumb


@wrong_hand(("DEX3-FORCE-11", "BRAINCO-FORCE-11"), sides=BOTH)
class ReportsGoalsWhenStalled(FingerService):
    """Reports that a stalled joint moves on to its goal: q is predicted, and not measured."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.shown: dict[Side, list[float]] = {}

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        shown = self.shown.get(hand.side, list(hand.q))
        for i, push in enumerate(hand.contact):
            aim = float(hand.goal[i]) if hand.touches and abs(push) > 0.005 else hand.q[i]
            shown[i] += 0.03 * (aim - shown[i]) if aim != hand.q[i] else 0.3 * (aim - shown[i])
            motors["q"][i] = shown[i]
        self.shown[hand.side] = shown

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():  # q changes while the hand rests
            hand.version += 1


@wrong_hand("DEX3-FORCE-01", sides=BOTH)
class TorqueInMillis(Dex3Service):
    """Publishes a thousandth of the torque: a conversion from mN m is made twice."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 1e-3


@wrong_hand("DEX3-FORCE-09")
class OneJointOnTheRotorsSide(FingerService):
    """Publishes the rotor's torque of its last joint: without the gear."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"][-1:] /= 214.0


# ------------------------------------------------------------------------------------ safety


class _NegativeGains(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        # weak enough to stay within the range
        self.kp = np.where(rows[3] < 0.0, 0.3 * rows[3], rows[3])
        self.kd = np.abs(rows[4])


@wrong_hand("DEX3-SAFE-06")
class NegativeGains(FingerService):
    """Applies a negative kp."""

    hand_fault = _NegativeGains


class _ChecksTheFirst(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if rows[3, 0] >= 0.0:
            self.kp = np.where(rows[3] < 0.0, 0.3 * rows[3], rows[3])


@wrong_hand("DEX3-SAFE-11")
class ChecksTheGainsOfTheFirst(FingerService):
    """Rejects negative gains in its first joint, and applies them in the others."""

    hand_fault = _ChecksTheFirst


class _GainsWithoutSign(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3:] = np.abs(own[3:])
        super().take(own, mode)


@wrong_hand("DEX3-SAFE-06")
class GainsWithoutSign(FingerService):
    """Drops the sign of negative gains, and goes to q."""

    hand_fault = _GainsWithoutSign


def _values(motor: Motor) -> tuple[float, ...]:
    return motor.q, motor.dq, motor.tau, motor.kp, motor.kd


class _NanPerJoint(FingerHand):
    def command(self, motors: tuple[Motor, ...]) -> None:
        now = zip(self.goal.tolist(), self.kp.tolist(), self.kd.tolist(), motors, strict=True)
        super().command(
            tuple(
                m if all(map(math.isfinite, _values(m))) else Motor(q, kp=kp, kd=kd, mode=m.mode)
                for q, kp, kd, m in now
            )
        )


@wrong_hand("DEX3-SAFE-01")
@wrong_hand("BRAINCO-SAFE-01", brief=True)
class RejectsOnlyTheBadJoint(FingerService):
    """Ignores only the joint whose command is NaN, and moves the others."""

    hand_fault = _NanPerJoint


class _NanInTheLast(FingerHand):
    def command(self, motors: tuple[Motor, ...]) -> None:
        now = zip(self.goal.tolist(), motors[:-1], strict=False)
        kept = (m if all(map(math.isfinite, _values(m))) else Motor(q, mode=m.mode) for q, m in now)
        super().command((*kept, motors[-1]))


@wrong_hand("DEX3-SAFE-01")
class LooksAtTheLastJoint(FingerService):
    """Checks only the last joint for NaN; any other joint with a NaN goes limp."""

    hand_fault = _NanInTheLast


class _NoLimits(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.low, self.high = self.low - 0.5, self.high + 0.5
        self.floor, self.ceiling = self.floor - 0.5, self.ceiling + 0.5


@wrong_hand("DEX3-SAFE-02", whole=True)
# its goal is so far that it presses through the object
@wrong_hand("DFX-SAFE-02", whole=True)
@wrong_hand("FTP-SAFE-02", whole=True)
class NoLimits(FingerService):
    """Follows goals up to 0.5 rad beyond its limits."""

    hand_fault = _NoLimits


@wrong_hand("DEX3-SAFE-04")
class FillsUpWithZeros(FingerService):
    """Fills a command that is too short with zeros."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        super().receive(topic, payload, client)
        sequence = self.codec.commanded(payload)
        dq = self.hand.model.client_command.dq
        for side in self.sides:
            mine = self.codec.command_topics[side] == topic
            first = self.dialect.index[side]
            if mine and 0 < len(sequence) < first + self.codec.joints:
                given = [Motor(m.q, m.dq, m.tau, m.kp, m.kd, m.mode) for m in sequence[first:]]
                missing = range(len(given), self.codec.joints)
                self.motors(
                    side, (*given, *(Motor(dq=dq, mode=self.codec.mode(i)) for i in missing))
                )


class _KeepsSpeed(FingerHand):
    def expire(self) -> None:
        self.tripped = self.tripped | self.guarded


@wrong_hand("DEX3-WDOG-01")
class KeepsDriving(FingerService):
    """Keeps driving by the last velocity after the time-out, unless protected."""

    hand_fault = _KeepsSpeed


class _KeepsTorque(FingerHand):
    def expire(self) -> None:
        push = self.push
        super().expire()
        self.push = push


@wrong_hand("DEX3-WDOG-01")
class KeepsPushing(Dex3Service):
    """Keeps a commanded torque after the time-out, and drops the velocity."""

    hand_fault = _KeepsTorque


class GoesHome(FingerHand):
    """Sends its first joint to one end after the time-out."""

    lost = False

    def expire(self) -> None:
        super().expire()
        self.lost = True
        self.changed()

    def take(self, rows: Floats, mode: Ints) -> None:
        self.lost = False
        super().take(rows, mode)

    def changed(self) -> None:
        super().changed()
        if self.lost:
            self.law_on[0], self.law_q[0], self.law_kp[0] = True, self.floor[0], 1.5


@wrong_hand("DEX3-WDOG-01")
class FirstJointGoesHome(Dex3Service):
    """Sends its first joint to one end after the time-out, whatever was commanded."""

    hand_fault = GoesHome


class _TiresOfHolding(FingerHand):
    expired_at = math.inf

    def expire(self) -> None:
        super().expire()
        self.expired_at = self.now

    def take(self, rows: Floats, mode: Ints) -> None:
        self.expired_at = math.inf
        super().take(rows, mode)

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.now - self.expired_at > 2.0:
            self.expired_at = math.inf
            self.kp = np.zeros_like(self.kp)
            self.changed()


@wrong_hand("DEX3-HOLD-01", sides=BOTH)
class HoldsForTwoSeconds(Dex3Service):
    """Lets go two seconds after the time-out, without protection too."""

    hand_fault = _TiresOfHolding


class _AlwaysBrakes(FingerHand):
    brakes = False

    def expire(self) -> None:
        super().expire()
        self.brakes = True

    def take(self, rows: Floats, mode: Ints) -> None:
        self.brakes = False
        super().take(rows, mode)

    def changed(self) -> None:
        super().changed()
        if self.brakes:
            self.driven = np.zeros_like(self.driven)
            n = len(self.q)
            self.law_on, self.law_kp, self.law_tau = [False] * n, [0.0] * n, [0.0] * n
            self.law_kd = [self.brake] * n


@wrong_hand("DEX3-HOLD-01")
class LetsGo(FingerService):
    """Brakes after the time-out even without protection."""

    hand_fault = _AlwaysBrakes


class _LatchesWithoutGuard(FingerHand):
    stuck = False

    def expire(self) -> None:
        super().expire()
        self.stuck = not self.guarded.any()

    def take(self, rows: Floats, mode: Ints) -> None:
        if not self.stuck:
            super().take(rows, mode)


@wrong_hand("DEX3-WDOG-03")
@wrong_hand(("BRAINCO-WDOG-03", "DFX-WDOG-03", "FTP-WDOG-03"), brief=True)
class StuckAfterSilence(FingerService):
    """Obeys no command after a silence without protection."""

    hand_fault = _LatchesWithoutGuard


class _BeginsAtZero(FingerHand):
    expired = False
    until = -math.inf

    def expire(self) -> None:
        super().expire()
        self.expired = True

    def command(self, motors: tuple[Motor, ...]) -> None:
        if self.now < self.until + 0.1:
            self.newest = ()  # an equal command counts again
        super().command(motors)

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.expired:
            self.expired, self.until = False, self.now + 0.15
        if self.now < self.until:
            self.goal = np.minimum(np.maximum(0.0, self.low), self.high)


@wrong_hand("DEX3-PATH-01")
class BeginsAtZero(FingerService):
    """Goes towards 0 for 0.15 s when the commands come again after a silence."""

    hand_fault = _BeginsAtZero


class _SleepsWithoutGuard(FingerHand):
    deaf_until = -math.inf

    def expire(self) -> None:
        super().expire()
        if not self.guarded.any():
            self.deaf_until = self.now + 2.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if self.now >= self.deaf_until:
            super().take(rows, mode)


# it sleeps through the step after the bad commands as well
@wrong_hand("DEX3-WDOG-03")
class SleepsWithoutGuard(FingerService):
    """Ignores commands for 2 s after a silence without protection."""

    hand_fault = _SleepsWithoutGuard


# ---------------------------------------------------------------------- time-out protection


class _HoldsOnly(FingerHand):
    def expire(self) -> None:
        self.speed = np.zeros_like(self.speed)
        self.push = np.zeros_like(self.push)
        self.late = self.guarded.copy()

    late: Any = None

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.late is not None:
            self.tripped = self.late & self.guarded
            self.late = None


@wrong_hand("DEX3-GUARD-01")
class HoldsWhenGuarded(FingerService):
    """Applies the time-out protection only when the next command comes: it moves on to its goal."""

    hand_fault = _HoldsOnly


class _Silent(FingerHand):
    def changed(self) -> None:
        super().changed()
        self.mode = self.mode & 0x7F


@wrong_hand("DEX3-GUARD-02")
class TripsInSecret(FingerService):
    """Does not publish that the protection has tripped."""

    hand_fault = _Silent


class _OneGuard(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return status, np.full_like(guarded, guarded[-1])


@wrong_hand("DEX3-GUARD-01")
class GuardOfTheLast(Dex3Service):
    """Applies the last motor's time-out bit to all."""

    hand_fault = _OneGuard


class _Heals(FingerHand):
    tripped_for = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        self.tripped_for = self.tripped_for + dt if self.tripped.any() else 0.0
        if self.tripped_for > 2.0:
            self.tripped = np.zeros_like(self.tripped)
            self.changed()


@wrong_hand("DEX3-GUARD-01")
class HealsByItself(Dex3Service):
    """Clears its protection two seconds after it has tripped."""

    hand_fault = _Heals


class _TripsOnce(FingerHand):
    trips = 0

    def expire(self) -> None:
        before = self.tripped
        super().expire()
        self.trips += bool(self.guarded.any())
        if self.trips > 1:
            self.tripped = before


@wrong_hand("DEX3-GUARD-01", whole=True)
class TripsOnce(Dex3Service):
    """Its protection trips the first time only: what it counts with is never set back."""

    hand_fault = _TripsOnce


class _FedByNews(FingerHand):
    def command(self, motors: tuple[Motor, ...]) -> None:
        if motors != self.newest:
            super().command(motors)


@wrong_hand("DEX3-GUARD-02", sides=BOTH)
class DropsEqualCommands(Dex3Service):
    """Drops commands that equal the last, before they feed the time-out."""

    hand_fault = _FedByNews


class _Unlatched(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.tripped = np.zeros_like(self.tripped)


@wrong_hand("DEX3-GUARD-03")
class ClearsByItself(FingerService):
    """Obeys the next command after a trip, whether or not bit 7 is set."""

    hand_fault = _Unlatched


class _NotDriven(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.status = np.where(self.guarded, 0, self.status)


@wrong_hand("DEX3-MODE-05")
class ProtectedIsNotDriven(Dex3Service):
    """Locks a motor whose time-out bit is set: its status is looked up by the whole byte."""

    hand_fault = _NotDriven


class _KeepsUnderGuard(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        before = self.goal.copy()
        super().take(rows, mode)
        self.goal = np.where(self.guarded, before, self.goal)


@wrong_hand("DEX3-MODE-05")
class ProtectedKeepsItsGoal(Dex3Service):
    """Keeps the goal that a motor had when its time-out bit was set."""

    hand_fault = _KeepsUnderGuard


class _Dead(FingerHand):
    dead: Flags | None = None

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.tripped = self.tripped if self.dead is None else self.dead.copy()

    def expire(self) -> None:
        super().expire()
        tripped = self.tripped.copy()
        self.dead = tripped if self.dead is None else self.dead | tripped


@wrong_hand("DEX3-GUARD-04", whole=True)
class NeverClears(FingerService):
    """A motor whose protection has tripped never reacts again."""

    hand_fault = _Dead


class _ForEver(FingerHand):
    was = False

    def take(self, rows: Floats, mode: Ints) -> None:
        # it would need a power cycle; it obeys again in the kit's next stimulus
        self.was = self.was or bool(self.tripped.any())
        tripped = self.tripped
        super().take(rows, mode)
        if self.was and self.now - self.tripped_at < 2.5:
            self.tripped = tripped

    tripped_at = -math.inf

    def expire(self) -> None:
        super().expire()
        if self.tripped.any():
            self.tripped_at = self.now


# what it ignores in that time is not driven in the silence that follows
@wrong_hand("DEX3-GUARD-04", whole=True)
class SlowToClear(FingerService):
    """Stays tripped for 2 s after it was cleared."""

    hand_fault = _ForEver


@wrong_hand("DEX3-WDOG-02")
class QuietWhenTripped(Dex3Service):
    """Publishes no state while its protection has tripped."""

    def publish(self) -> list[Sample]:
        tripped = any(hand.tripped.any() for hand in self.hands.values())
        return [] if tripped else super().publish()
