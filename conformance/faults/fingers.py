"""Wrong hands of several joints."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults.registry import (
    BOTH,
    DQ,
    KD,
    KP,
    TAU,
    Call,
    Motors,
    Q,
    changes,
    commands,
    obeys_gains,
    reports,
    takes_floats,
    wrong_hand,
)
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import (
    Dex3Hand,
    Dex3Service,
    FingerHand,
    FingerService,
    Flags,
    Ints,
)
from dexkit.hand import Floats, Side
from dexkit.models import DEX5_1, HandModel

LEFT, RIGHT = Side.LEFT, Side.RIGHT
_SECOND_AT_ONCE = 1000
"""Number of a client that commands beside another one."""

# --------------------------------------------------------------------- discovery and start-up


@changes(Dex3Service, "low_rate", "DEX3-TOPIC-03", brief=True)
def NoLowRate(self: Any, low_rate: Call, samples: list[Sample]) -> list[Sample]:
    """Publishes no low-rate copy."""
    return []


@wrong_hand("DEX3-TOPIC-03", brief=True)
class LowRateIsFull(Dex3Service):
    """Publishes the low-rate copy at the rate of the state."""

    low_period = Dex3Service.period


@wrong_hand("DEX3-TOPIC-03", brief=True)
class LowRateIsSlow(Dex3Service):
    """Publishes the low-rate copy twice a second: a timer has another unit."""

    low_period = 0.5


@changes(Dex3Service, "low_rate", "DEX3-TOPIC-03", brief=True)
def OldLowRate(self: Any, low_rate: Call, samples: list[Sample]) -> list[Sample]:
    """Copies states to the low-rate topic that are 0.45 s old."""
    new, queue = low_rate(samples), self.memory.setdefault("queue", deque())
    queue.append(new)
    old = queue.popleft() if len(queue) > 9 else queue[0]
    return [replace(o, sent=n.sent) for o, n in zip(old, new, strict=True)]


@wrong_hand("DEX3-START-01", where=lambda hand: hand.dialects[0].zero_is_no_state)
class RestsAtZero(FingerHand):
    """Rests with every joint at exactly 0."""

    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        # not inside an object: 0 is closed in some hands
        self.q = np.clip(0.0, self.floor, self.ceiling).tolist()


# ------------------------------------------------------------------------------------ fields


@reports(FingerService, "DEX3-FIELD-01", where=takes_floats)
def NanVelocity(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes NaN as dq of one joint at rest."""
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

    def motors(self, side: Side, motors: Motors) -> None:
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


def _limits(motors: Any, hand: FingerHand) -> tuple[Floats, Floats]:
    """Lower and upper limits of the joints in a state."""
    return np.array(hand.low)[: len(motors)], np.array(hand.high)[: len(motors)]


def _shift(motors: Any, hand: FingerHand, part: float) -> None:
    """Move each q by a part of its range, towards the middle."""
    low, high = _limits(motors, hand)
    up = motors["q"] < 0.5 * (low + high)
    motors["q"] += np.where(up, part, -part) * (high - low)


@reports(FingerService, "DEX3-FIELD-15", at_rest=True)
def JumpsOnce(self: Any, motors: Any, hand: FingerHand) -> None:
    """Has no dq, and publishes one pose that is half of each joint's range off."""
    motors["dq"] = motors["ddq"] = 0.0
    if 0.5 <= self.now < 0.5 + self.period:
        _shift(motors, hand, 0.5)


@reports(FingerService, "DEX3-FIELD-17", at_rest=True)
def ShiftsForAWhile(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes q with an offset of 15 % of each range for 0.4 s; its dq stays true."""
    motors["ddq"] = 0.0
    if 0.4 <= self.now < 0.8:
        _shift(motors, hand, 0.15)


@reports(FingerService, "DEX3-FIELD-20", whole=True)
def ShowsTheGoalNearIt(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes the commanded q of one joint within 8 % of its range from it."""
    joint = 3
    if len(motors) > joint and hand.newest:
        goal = float(np.clip(hand.newest[joint].q, hand.low[joint], hand.high[joint]))
        if abs(goal - hand.q[joint]) < 0.08 * (hand.high[joint] - hand.low[joint]):
            motors["q"][joint] = goal


@changes(FingerService, "message", "DEX3-FIELD-06", brief=True)
def Kelvin(self: Any, message: Call, count: int) -> Any:
    """Publishes its motors' temperatures in kelvins."""
    found = message(count)
    for motor in found.motor_state:
        motor.temperature = (303, 313)
    return found


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

    def motors(self, side: Side, motors: Motors) -> None:
        super().motors(side, motors)
        if self.hot:
            self.hot = False
            self._blank.clear()
            self._sent.clear()


@changes(FingerService, "message", "DEX3-FIELD-07", brief=True)
def RawSupply(self: Any, message: Call, count: int) -> Any:
    """Publishes the converter's count as the supply voltage."""
    found = message(count)
    found.power_v = 22696.0
    return found


@changes(FingerService, "message", "DEX3-FIELD-08", brief=True)
def FaultForAStatus(self: Any, message: Call, count: int) -> Any:
    """Publishes a status word as the hand's faults."""
    found = message(count)
    found.error = (7, 0)
    return found


@reports(FingerService, "DEX3-MODE-01")
def IdsFromOne(self: Any, motors: Any, hand: FingerHand) -> None:
    """Counts its motors from 1."""
    motors["mode"] += 1


# ----------------------------------------------------------------------------- sensors and IMU


@changes(FingerService, "quaternion", "DEX3-IMU-01", brief=True)
def LongQuaternion(self: Any, quaternion: Call) -> list[float]:
    """Publishes raw counts as its quaternion."""
    return [16384.0, 0.0, 0.0, 0.0]


@wrong_hand("DEX3-SENS-01", brief=True)
class OddPackets(FingerService):
    """Publishes ten sensor packets."""

    sensors = 10

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        return np.concatenate((pressure, pressure[:1]))


@changes(FingerService, "pressures", "DEX3-SENS-01", sides=BOTH, brief=True)
def NanPressure(self: Any, pressures: Call, hand: FingerHand) -> Floats:
    """Publishes NaN where there is no sensor."""
    pressure = pressures(hand)
    return np.where(pressure == 30000.0, math.nan, pressure)


@changes(FingerService, "pressures", "DEX3-SENS-03", sides=BOTH, brief=True)
def ZeroForNoValue(self: Any, pressures: Call, hand: FingerHand) -> Floats:
    """Publishes 0 where there is no sensor."""
    pressure = pressures(hand)
    return np.where(pressure == 30000.0, 0.0, pressure)


@wrong_hand("DEX3-SENS-03", brief=True)
class SevenPackets(FingerService):
    """Publishes the SDK's default of seven packets."""

    sensors = 7


@changes(FingerService, "pressures", "DEX3-SENS-04", sides=BOTH)
def Numb(self: Any, pressures: Call, hand: FingerHand) -> Floats:
    """Publishes the pressure of an untouched hand at every contact."""
    return hand.untouched()


@changes(Dex3Service, "pressures", "DEX3-SENS-04", sides=BOTH)
def CrossedCables(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Publishes the index finger's pressures as the middle finger's, and the other way round."""
    return pressures(hand)[[0, 1, 4, 5, 2, 3, 6, 7, 8]]


@changes(FingerService, "pressures", "DEX3-SENS-01", sides=BOTH)
def SaturatesToNothing(self: Any, pressures: Call, hand: FingerHand) -> Floats:
    """Publishes a pressure at the end of the converter's range as a slot without a sensor."""
    pressure = pressures(hand)
    return np.where(pressure > hand.untouched() + 25_000.0, 30000.0, pressure)


class _PressureWithTime(FingerService):
    """Publishes pressures that change while the hand rests."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.pressure: dict[Side, tuple[float, Floats]] = {}

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():
            hand.version += 1


@wrong_hand("DEX3-SENS-08", sides=BOTH, whole=True)
class SlowFoam(_PressureWithTime):
    """Its pressures fall with a time constant of 2 s."""

    def pressures(self, hand: FingerHand) -> Floats:
        rest = hand.untouched()
        change = super().pressures(hand) - rest
        at, before = self.pressure.get(hand.side, (self.now, change))
        change = np.maximum(change, before * math.exp((at - self.now) / 2.0))
        self.pressure[hand.side] = self.now, change
        return rest + change


@changes(Dex3Service, "pressures", "DEX3-SENS-08", sides=BOTH)
def FeelsMotionOnly(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Reads its sensors in the task that moves the joints: at rest the pressures are constant."""
    if hand.side not in self.memory or max(map(abs, hand.dq)) > 0.5:
        self.memory[hand.side] = np.array(pressures(hand))
    return self.memory[hand.side]


@changes(Dex3Service, "pressures", "DEX3-SENS-08", sides=BOTH)
def KeepsTheMost(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Publishes the largest pressure of each element since it was last untouched."""
    pressure = np.array(pressures(hand))
    kept = np.maximum(self.memory.get(hand.side, pressure), pressure)
    self.memory[hand.side] = np.where(pressure > hand.untouched(), kept, pressure)
    return self.memory[hand.side]


@changes(FingerService, "pressures", "DEX3-SENS-11", sides=BOTH, whole=True)
def OneSensorBuffer(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Publishes the right hand's pressures as those of both."""
    right = self.hands.get(Side.RIGHT, hand)
    hand.version += right is not hand
    return pressures(right)


@wrong_hand("DEX3-SENS-08", sides=BOTH)
class TaresInAGrip(_PressureWithTime):
    """Treats a pressure that is constant for a second as drift, and takes it as the new zero."""

    def pressures(self, hand: FingerHand) -> Floats:
        rest = hand.untouched()
        change = super().pressures(hand) - rest
        at, drift = self.pressure.get(hand.side, (self.now, np.zeros_like(change)))
        drift = change + (drift - change) * math.exp((at - self.now) / 0.7)
        self.pressure[hand.side] = self.now, drift
        return np.asarray(rest + np.maximum(change - drift, 0.0))


# ------------------------------------------------------------------------------------ motion


@changes(Dex3Service, "motors", "DEX3-JOINT-01", sides=BOTH)
def IndexFirst(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys the right hand's commands index finger first, as xr_teleoperate's enum lists them."""
    if side is Side.RIGHT:
        motors = tuple(motors[i] for i in (0, 1, 2, 5, 6, 3, 4))
    command(side, motors)


@changes(FingerService, "motors", "DEX3-JOINT-01")
def CoupledFinger(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """The second joint of a finger follows the first a little."""
    coupled = replace(motors[4], q=motors[4].q + 0.2 * motors[3].q)
    command(side, (*motors[:4], coupled, *motors[5:]))


@commands(FingerHand, "DEX3-MOVE-02", where=obeys_gains)
def OneJointBackwards(hand: Any, rows: Floats) -> None:
    """Moves one joint backwards."""
    rows[Q, 2] = 2 * hand.model.rest_q[hand.side][2] - rows[Q, 2]
    rows[DQ, 2] = -rows[DQ, 2]


@changes(FingerService, "motors", "DEX3-MOVE-02")
def OtherScale(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Moves only 60 % of the way from its rest pose."""
    rest = self.hand.model.rest_q[side]
    scaled = (replace(m, q=r + 0.6 * (m.q - r)) for m, r in zip(motors, rest, strict=True))
    command(side, tuple(scaled))


class NeverRests(FingerHand):
    """Its mechanics are computed at rest, too."""

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@changes(NeverRests, "move", "DEX3-MOVE-03", whole=True, where=obeys_gains)
def Hunts(hand: Any, move: Call, dt: float, pull: list[float]) -> None:
    """One joint oscillates about its goal."""
    if hand.law_kp[2] > 0.67 * hand.client_kp[2]:
        pull[2] += hand.law_kp[2] / 4 * math.sin(2 * math.pi * 8.0 * hand.now)
    move(dt, pull)


@wrong_hand("DEX3-MOVE-04", where=obeys_gains)
class Slow(FingerHand):
    """Has high friction: it moves slowly."""

    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = max(self.client_kp.min() / 15, 3 * self.viscous)


@wrong_hand("DEX3-PATH-01", where=obeys_gains)
class Undamped(FingerHand):
    """Applies 15 % of kd where kp is not 0."""

    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = 0.1 * self.viscous

    def take(self, rows: Floats, mode: Ints) -> None:
        undamped = rows.copy()
        undamped[KD] = np.where(rows[KP] > 0, 0.15 * rows[KD], rows[KD])
        super().take(undamped, mode)


@wrong_hand("BRAINCO-SIDE-01", sides=BOTH)
@changes(FingerService, "motors", "DEX3-SIDE-01", sides=BOTH)
def Coupled(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """The goal of the left hand's first finger leaks into the right one's."""
    if side is Side.LEFT and abs(motors[5].q) < 10:
        self.memory["left"] = motors[5].q + 0.24
    elif side is Side.RIGHT:
        coupled = replace(motors[5], q=motors[5].q - 0.1 * self.memory.get("left", 0.0))
        motors = (*motors[:5], coupled, *motors[6:])
    command(side, motors)


@changes(Dex3Hand, "take", "DEX3-MOVE-09")
def LimitsOfTheJointBefore(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Limits a finger's second joint to the range of its first."""
    take(rows, mode)
    hand.goal[4] = min(max(hand.goal[4], hand.low[3]), hand.high[3])


@wrong_hand("DEX3-MOVE-04", where=lambda hand: hand is not DEX5_1)
class Creeps(NeverRests):
    """One joint moves the last part of the way to its goal slowly."""

    since = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if not np.array_equal(rows[Q], self.goal):
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


# ------------------------------------------------------------------------------------- gains


@commands(FingerHand, "DEX3-GAIN-01")
def DefaultsForZeroGains(hand: Any, rows: Floats) -> None:
    """Uses its own gains where kp and kd are 0."""
    unset = (rows[KP] == 0) & (rows[KD] == 0)
    rows[KP] = np.where(unset, hand.client_kp, rows[KP])
    rows[KD] = np.where(unset, hand.client_kd, rows[KD])


@commands(FingerHand, "DEX3-GAIN-02")
def OwnStiffness(hand: Any, rows: Floats) -> None:
    """Uses its own gains wherever kp is not 0."""
    stiff = rows[KP] > 0
    rows[KP] = np.where(stiff, hand.client_kp, 0.0)
    rows[KD] = np.where(stiff, hand.client_kd, rows[KD])


@commands(FingerHand, "DEX3-GAIN-02")
def GainsOfFirstMotor(hand: Any, rows: Floats) -> None:
    """Uses the gains of its first motor for all."""
    rows[KP:] = rows[KP:, :1].copy()


@commands(FingerHand, "DEX3-GAIN-02")
def GainsOfTheMotorBefore(hand: Any, rows: Floats) -> None:
    """Uses the gains of the motor before in each."""
    rows[KP:] = np.roll(rows[KP:], 1, axis=1)


@commands(FingerHand, "DEX3-GAIN-03")
def DeafToVelocity(hand: Any, rows: Floats) -> None:
    """Ignores dq without a position gain."""
    rows[DQ] = np.where(rows[KP] > 0, rows[DQ], 0.0)


@commands(FingerHand, "DEX3-GAIN-02")
def StuckWhenSoft(hand: Any, rows: Floats) -> None:
    """Does not move with less than half of the client's stiffness."""
    rows[KP] = np.where(rows[KP] < 0.5 * hand.client_kp, 0.0, rows[KP])


@commands(FingerHand, "DEX3-GAIN-04")
def DeafToTorque(hand: Any, rows: Floats) -> None:
    """Ignores the torque of a command."""
    rows[TAU] = 0.0


@commands(FingerHand, "DEX3-GAIN-04")
def TurnedTorque(hand: Any, rows: Floats) -> None:
    """Obeys the torque of a command with the wrong sign."""
    rows[TAU] = -rows[TAU]


@commands(FingerHand, "DEX3-GAIN-04")
def TorqueOfTheMotorBefore(hand: Any, rows: Floats) -> None:
    """Adds the torque that is commanded to the motor before, in each."""
    rows[TAU] = np.roll(rows[TAU], 1)


@commands(Dex3Hand, "DEX3-GAIN-04")
def SwappedTorque(hand: Any, rows: Floats) -> None:
    """Adds the torques of index and middle finger to each other's."""
    rows[TAU] = rows[TAU][[0, 1, 2, 5, 6, 3, 4]]


@commands(FingerHand, "DEX3-GAIN-04")
def TorqueOfAnotherGear(hand: Any, rows: Floats) -> None:
    """Drives its last joint with five times the commanded torque."""
    rows[TAU, -1] *= 5.0


@commands(FingerHand, "DEX3-GAIN-03")
def TurnedVelocityCommand(hand: Any, rows: Floats) -> None:
    """Obeys the velocity of a command with the wrong sign."""
    rows[DQ] = -rows[DQ]


@commands(FingerHand, "DEX3-GAIN-02")
def TwoGrades(hand: Any, rows: Floats) -> None:
    """Has only a soft and a firm stiffness: from a quarter of the client's on, the full one."""
    between = (rows[KP] > 0.25 * hand.client_kp) & (rows[KP] < hand.client_kp)
    rows[KP] = np.where(between, hand.client_kp, rows[KP])


@commands(FingerHand, "DEX3-GAIN-02")
def LeastStiffness(hand: Any, rows: Floats) -> None:
    """Raises each kp above 0 to 35 % of the client's at least: soft joints are not soft."""
    least = np.maximum(rows[KP], 0.35 * hand.client_kp)
    rows[KP] = np.where(rows[KP] > 0, least, rows[KP])


# --------------------------------------------------------------------------------- mode byte


@reports(FingerService, "DEX3-MODE-01", "DEX5-MODE-03")
def AlwaysDriven(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes that its motors are driven, whatever their state."""
    motors["mode"] |= self.codec.mode(0)


@changes(FingerHand, "understood", "DEX3-MODE-03")
def IgnoresStatus(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Drives its motors whatever the mode byte of the command is."""
    status, guarded = understood(mode)
    return np.ones_like(status), guarded


@changes(FingerHand, "understood", "DEX3-MODE-03")
def ZeroIsNoChange(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Keeps a joint driven that is switched off: takes 0 for "as before"."""
    status, guarded = understood(mode)
    return np.where(status == 0, hand.status, status), guarded


@changes(FingerHand, "understood", "DEX3-MODE-03")
def LastJointStaysOn(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Keeps its last joint driven when it is switched off."""
    status, guarded = understood(mode)
    last = np.arange(len(status)) == len(status) - 1
    return np.where(last & (status == 0), hand.status, status), guarded


@wrong_hand("DEX3-MODE-03", whole=True)
class StaysOnForALaterClient(FingerService):
    """Switches its motors off for its first client only."""

    later = False

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.seen: dict[Side, tuple[Motors, Motors]] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.later = 0 < client < _SECOND_AT_ONCE
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: Motors) -> None:
        if not self.later:
            super().motors(side, motors)
            return
        if self.seen.get(side, ((), ()))[0] is not motors:
            driven = tuple(replace(m, mode=m.mode | self.codec.mode(0)) for m in motors)
            self.seen[side] = motors, driven
        super().motors(side, self.seen[side][1])


@changes(FingerHand, "understood", "DEX3-MODE-05")
def StatusOfOneJoint(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Applies the status of one joint to all."""
    status, guarded = understood(mode)
    return np.full_like(status, status[2]), guarded


@changes(Dex3Hand, "changed", "DEX3-MODE-03")
def LimpLock(hand: Any, changed: Call) -> None:
    """Switches the driver of one joint off where it should lock."""
    changed()
    if hand.status[5] == 0:
        hand.law_kd[5] = 0.0


@changes(FingerService, "motors", "DEX3-MODE-04")
def GoesById(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Sorts a command's motors by the id in their mode byte."""
    if sorted(m.mode & 15 for m in motors) == list(range(len(motors))):
        motors = tuple(sorted(motors, key=lambda m: m.mode & 15))
    command(side, motors)


# ------------------------------------------------------------------------------------- force


@reports(FingerService, "DEX3-FORCE-01", sides=BOTH)
def TurnedForce(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes tau_est with the wrong sign."""
    motors["tau_est"] = -motors["tau_est"]


@reports(Dex3Service, "DEX3-FORCE-05", sides=BOTH)
def ForceOfOtherGear(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes 40 % of the torque, as if it had another gear."""
    motors["tau_est"] *= 0.4


@changes(Dex3Hand, "changed", "DEX3-FORCE-05", sides=BOTH, whole=True)
def GearOfTheThumb(hand: Any, changed: Call) -> None:
    """Divides the gains of all joints by the square of the thumb's gear but for the thumb's own."""
    changed()
    hand.law_kp = [k / 1.75**2 if i else k for i, k in enumerate(hand.law_kp)]
    hand.law_kd = [k / 1.75**2 if i else k for i, k in enumerate(hand.law_kd)]


@reports(Dex3Service, "DEX3-FIELD-17")
def ThumbWithoutVelocity(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes no dq of the thumb."""
    motors["dq"][:3] = 0.0


@wrong_hand("DEX3-FORCE-06", sides=BOTH, whole=True)
class Tires(Dex3Hand):
    """Limits the torque of one joint after a second and a half of a firm grip."""

    loaded = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if rows[Q, 6] != self.goal[6]:
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


@reports(Dex3Service, "DEX3-FORCE-05", sides=BOTH)
def ForceOfLargerMotor(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes 1.9 times the torque: the torque constant is that of another motor."""
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


@wrong_hand("DEX3-FORCE-05", sides=BOTH, whole=True)
class OneFingerBoosts(Boosts, Dex3Hand):
    """Its index finger presses with two and a half times the torque where it is blocked."""

    joints = (5, 6)


@wrong_hand("DEX3-FORCE-05", sides=BOTH)
class ThumbGivesIn(OtherInContact, Dex3Hand):
    """Its thumb presses with a third of the torque where it is blocked."""

    joints = (1, 2)
    factor = 0.35


@wrong_hand("DEX3-FORCE-11", "BRAINCO-FORCE-11", sides=BOTH)
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


@reports(Dex3Service, "DEX3-FORCE-01", sides=BOTH)
def TorqueInMillis(self: Any, motors: Any, hand: FingerHand) -> None:
    """Publishes a thousandth of the torque: a conversion from mN m is made twice."""
    motors["tau_est"] *= 1e-3


# ------------------------------------------------------------------------------------ safety


@changes(FingerHand, "take", "DEX3-SAFE-11")
def NegativeGains(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Applies a negative kp."""
    take(rows, mode)
    # weak enough to stay within the range
    hand.kp = np.where(rows[KP] < 0.0, 0.3 * rows[KP], rows[KP])
    hand.kd = np.abs(rows[KD])


@changes(FingerHand, "take", "DEX3-SAFE-11")
def ChecksTheGainsOfTheFirst(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Rejects negative gains in its first joint, and applies them in the others."""
    take(rows, mode)
    if rows[KP, 0] >= 0.0:
        hand.kp = np.where(rows[KP] < 0.0, 0.3 * rows[KP], rows[KP])


def _finite(motor: Motor) -> bool:
    return all(map(math.isfinite, (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)))


@changes(FingerHand, "command", "DEX3-SAFE-01", "BRAINCO-SAFE-01")
def RejectsOnlyTheBadJoint(hand: Any, command: Call, motors: Motors) -> None:
    """Ignores only the joint whose command is NaN, and moves the others."""
    now = zip(hand.goal.tolist(), hand.kp.tolist(), hand.kd.tolist(), motors, strict=True)
    command(tuple(m if _finite(m) else Motor(q, kp=kp, kd=kd, mode=m.mode) for q, kp, kd, m in now))


@changes(FingerHand, "command", "DEX3-SAFE-01")
def LooksAtTheLastJoint(hand: Any, command: Call, motors: Motors) -> None:
    """Checks only the last joint for NaN; any other joint with a NaN goes limp."""
    now = zip(hand.goal.tolist(), motors[:-1], strict=False)
    command((*(m if _finite(m) else Motor(q, mode=m.mode) for q, m in now), motors[-1]))


@wrong_hand("DEX3-SAFE-02", whole=True)
class NoLimits(FingerHand):
    """Follows goals up to 0.5 rad beyond its limits."""

    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.low, self.high = self.low - 0.5, self.high + 0.5
        self.floor, self.ceiling = self.floor - 0.5, self.ceiling + 0.5


@changes(FingerService, "receive", "DEX3-SAFE-03")
def FillsUpWithZeros(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Fills a command that is too short with zeros."""
    receive(topic, payload, client)
    sequence = self.codec.commanded(payload)
    dq = self.hand.model.client_command.dq
    for side in self.sides:
        mine = self.codec.command_topics[side] == topic
        first = self.dialect.index[side]
        if mine and 0 < len(sequence) < first + self.codec.joints:
            given = [Motor(m.q, m.dq, m.tau, m.kp, m.kd, m.mode) for m in sequence[first:]]
            missing = range(len(given), self.codec.joints)
            zeros = (Motor(dq=dq, mode=self.codec.mode(i)) for i in missing)
            self.motors(side, (*given, *zeros))


# ---------------------------------------------------------------------------------- time-out


@changes(FingerHand, "expire", "DEX3-WDOG-01")
def KeepsDriving(hand: Any, expire: Call) -> None:
    """Keeps driving by the last velocity after the time-out, unless protected."""
    hand.tripped = hand.tripped | hand.guarded


@changes(Dex3Hand, "expire", "DEX3-WDOG-01")
def KeepsPushing(hand: Any, expire: Call) -> None:
    """Keeps a commanded torque after the time-out, and drops the velocity."""
    push = hand.push
    expire()
    hand.push = push


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
class FirstJointGoesHome(GoesHome, Dex3Hand):
    """Sends its first joint to one end after the time-out, whatever was commanded."""


@wrong_hand("DEX3-HOLD-01", sides=BOTH)
class HoldsForTwoSeconds(Dex3Hand):
    """Lets go two seconds after the time-out, without protection too."""

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


@wrong_hand("DEX3-HOLD-01")
class LetsGo(FingerHand):
    """Brakes after the time-out even without protection."""

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


@wrong_hand("DEX3-WDOG-03", "BRAINCO-WDOG-03", "DFX-WDOG-03", "FTP-WDOG-03")
class StuckAfterSilence(FingerHand):
    """Obeys no command after a silence without protection."""

    stuck = False

    def expire(self) -> None:
        super().expire()
        self.stuck = not self.guarded.any()

    def take(self, rows: Floats, mode: Ints) -> None:
        if not self.stuck:
            super().take(rows, mode)


@wrong_hand("DEX3-PATH-01")
class BeginsAtZero(FingerHand):
    """Goes towards 0 for 0.15 s when the commands come again after a silence."""

    expired = False
    until = -math.inf

    def expire(self) -> None:
        super().expire()
        self.expired = True

    def command(self, motors: Motors) -> None:
        if self.now < self.until + 0.1:
            self.newest = ()  # an equal command counts again
        super().command(motors)

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.expired:
            self.expired, self.until = False, self.now + 0.15
        if self.now < self.until:
            self.goal = np.minimum(np.maximum(0.0, self.low), self.high)


@wrong_hand("DEX3-WDOG-03")
class SleepsWithoutGuard(FingerHand):
    """Ignores commands for 2 s after a silence without protection."""

    deaf_until = -math.inf

    def expire(self) -> None:
        super().expire()
        if not self.guarded.any():
            self.deaf_until = self.now + 2.0

    def take(self, rows: Floats, mode: Ints) -> None:
        # it sleeps through the step after the bad commands as well
        if self.now >= self.deaf_until:
            super().take(rows, mode)


# ---------------------------------------------------------------------- time-out protection


@wrong_hand("DEX3-GUARD-01")
class HoldsWhenGuarded(FingerHand):
    """Applies the time-out protection only when the next command comes: it moves on to its goal."""

    late: Flags | None = None

    def expire(self) -> None:
        self.speed = np.zeros_like(self.speed)
        self.push = np.zeros_like(self.push)
        self.late = self.guarded.copy()

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.late is not None:
            self.tripped = self.late & self.guarded
            self.late = None


@changes(FingerHand, "changed", "DEX3-GUARD-01")
def TripsInSecret(hand: Any, changed: Call) -> None:
    """Does not publish that the protection has tripped."""
    changed()
    hand.mode = hand.mode & 0x7F


@changes(Dex3Hand, "understood", "DEX3-GUARD-01")
def GuardOfTheLast(hand: Any, understood: Call, mode: Ints) -> tuple[Ints, Flags]:
    """Applies the last motor's time-out bit to all."""
    status, guarded = understood(mode)
    return status, np.full_like(guarded, guarded[-1])


@wrong_hand("DEX3-GUARD-01")
class HealsByItself(Dex3Hand):
    """Clears its protection two seconds after it has tripped."""

    tripped_for = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        self.tripped_for = self.tripped_for + dt if self.tripped.any() else 0.0
        if self.tripped_for > 2.0:
            self.tripped = np.zeros_like(self.tripped)
            self.changed()


@wrong_hand("DEX3-GUARD-01", whole=True)
class TripsOnce(Dex3Hand):
    """Its protection trips the first time only: what it counts with is never set back."""

    trips = 0

    def expire(self) -> None:
        before = self.tripped
        super().expire()
        self.trips += bool(self.guarded.any())
        if self.trips > 1:
            self.tripped = before


@changes(Dex3Hand, "command", "DEX3-GUARD-01", sides=BOTH)
def DropsEqualCommands(hand: Any, command: Call, motors: Motors) -> None:
    """Drops commands that equal the last, before they feed the time-out."""
    if motors != hand.newest:
        command(motors)


@changes(FingerHand, "take", "DEX3-GUARD-01")
def ClearsByItself(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Obeys the next command after a trip, whether or not bit 7 is set."""
    take(rows, mode)
    hand.tripped = np.zeros_like(hand.tripped)


@changes(Dex3Hand, "take", "DEX3-MODE-05")
def ProtectedIsNotDriven(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Locks a motor whose time-out bit is set: its status is looked up by the whole byte."""
    take(rows, mode)
    hand.status = np.where(hand.guarded, 0, hand.status)


@changes(Dex3Hand, "take", "DEX3-MODE-05")
def ProtectedKeepsItsGoal(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Keeps the goal that a motor had when its time-out bit was set."""
    before = hand.goal.copy()
    take(rows, mode)
    hand.goal = np.where(hand.guarded, before, hand.goal)


@wrong_hand("DEX3-GUARD-01", whole=True)
class NeverClears(FingerHand):
    """A motor whose protection has tripped never reacts again."""

    dead: Flags | None = None

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.tripped = self.tripped if self.dead is None else self.dead.copy()

    def expire(self) -> None:
        super().expire()
        tripped = self.tripped.copy()
        self.dead = tripped if self.dead is None else self.dead | tripped


@wrong_hand("DEX3-GUARD-01", whole=True)
class SlowToClear(FingerHand):
    """Stays tripped for 2 s after it was cleared."""

    was = False
    tripped_at = -math.inf

    def take(self, rows: Floats, mode: Ints) -> None:
        # it would need a power cycle; it obeys again in the kit's next stimulus
        self.was = self.was or bool(self.tripped.any())
        tripped = self.tripped
        super().take(rows, mode)
        if self.was and self.now - self.tripped_at < 2.5:
            self.tripped = tripped

    def expire(self) -> None:
        super().expire()
        if self.tripped.any():
            self.tripped_at = self.now


@changes(Dex3Service, "publish", "DEX3-WDOG-02")
def QuietWhenTripped(self: Any, publish: Call) -> Any:
    """Publishes no state while its protection has tripped."""
    return [] if any(hand.tripped.any() for hand in self.hands.values()) else publish()
