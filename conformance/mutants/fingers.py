"""Wrong hands of several joints.

Each is mixed into the reference service of a model by :func:`zoo`, and its ``wrong``, if it has
one, into the reference hand.
"""

# ruff: noqa: D102  (each class says what it does wrong; its methods only override)

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.mutants import shared
from dexkit.conformance.mutants.shared import of
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.virtual import Sample, Service
from dexkit.conformance.virtual.fingers import (
    Dex3Service,
    Dex5Service,
    FingerHand,
    FingerService,
    Flags,
    Ints,
)
from dexkit.hand import Floats, Side
from dexkit.models import DEX3_1, DEX5_1

# --------------------------------------------------------------------- discovery and start-up


class NoLowRate(Dex3Service):
    """Publishes no low-rate copy."""

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        return []


class LowRateIsFull(Dex3Service):
    """Publishes the low-rate copy as often as the state."""

    low_period = Dex3Service.period


class _Zero(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.q = [0.0] * len(self.q)


class RestsAtZero(FingerService):
    """Rests with every joint at exactly 0."""

    wrong = _Zero


# ------------------------------------------------------------------------------------ fields


class NanVelocity(FingerService):
    """Divides by a time step of zero at rest, in one joint."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if len(motors) and not hand.dq[5]:
            motors["dq"][5] = math.nan


class Unmirrored(FingerService):
    """Has the left hand's signs on the right one, in both directions."""

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


class TurnedVelocity(FingerService):
    """Publishes dq with the wrong sign."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["dq"] = -motors["dq"]


class TurnedAcceleration(FingerService):
    """Publishes ddq with the wrong sign."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["ddq"] = -motors["ddq"]


class _Filled(FingerService):
    """Motors that say something else of themselves, or a hand that does."""

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


class Kelvin(_Filled):
    """Publishes its motors' temperatures in kelvins."""

    motor = ("temperature", (303, 313))


class RawSupply(_Filled):
    """Publishes the converter's count as the supply voltage."""

    whole = ("power_v", 22696.0)


class FaultForAStatus(_Filled):
    """Publishes a status of its own as the hand's faults."""

    whole = ("error", (7, 0))


class CountsInReserve(FingerService):
    """Counts its states in a reserved word of the first motor."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["reserve"][0] = hand.version


class HotSensors(_Filled):
    """Publishes the sensors' temperatures in hundredths of a degree."""

    packet = ("temperature", (2500.0,) * 12)


class UnsetLost(_Filled):
    """Publishes memory that was never set as the sensors' count of lost packets."""

    packet = ("lost", 0xCCCCCCCC)


class NanGyroscope(FingerService):
    """Publishes NaN for an angular velocity that it does not know."""

    def message(self, count: int) -> Any:
        message = super().message(count)
        message.imu_state.gyroscope = [math.nan] * 3
        return message


class IdsFromOne(FingerService):
    """Counts its motors from 1."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["mode"] += 1


class OddPackets(FingerService):
    """Publishes ten sensor packets."""

    sensors = 10

    def pressures(self, hand: FingerHand) -> Floats:
        felt = super().pressures(hand)
        return np.concatenate((felt, felt[:1]))


class NanPressure(FingerService):
    """Publishes NaN where there is no sensor."""

    def pressures(self, hand: FingerHand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, math.nan, felt)


class ZeroForNoValue(FingerService):
    """Publishes 0 where there is no sensor."""

    def pressures(self, hand: FingerHand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, 0.0, felt)


class SevenPackets(FingerService):
    """Publishes the SDK's default of seven packets."""

    sensors = 7


class Numb(FingerService):
    """Never feels a touch."""

    def pressures(self, hand: FingerHand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, felt, 0.0)


class LongQuaternion(FingerService):
    """Publishes the raw counts of its attitude."""

    def quaternion(self) -> list[float]:
        return [16384.0, 0.0, 0.0, 0.0]


# ------------------------------------------------------------------------------------ motion


def _reordered(order: tuple[int, ...]) -> Callable[[tuple[Motor, ...]], tuple[Motor, ...]]:
    def reorder(motors: tuple[Motor, ...]) -> tuple[Motor, ...]:
        return tuple(motors[i] for i in order)

    return reorder


class IndexFirst(FingerService):
    """Takes the commands of the right hand index finger first, as xr_teleoperate's enum says."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.RIGHT:
            motors = _reordered((0, 1, 2, 5, 6, 3, 4))(motors)
        super().motors(side, motors)


class ThumbFirst(FingerService):
    """Takes the commands thumb first, as the URDF numbers the fingers."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        super().motors(side, _reordered((*range(4, 20), *range(4)))(motors))


class CoupledFinger(FingerService):
    """Has the second joint of a finger follow the first a little."""

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


class OneJointBackwards(FingerService):
    """Turns the sign of one joint."""

    wrong = _Backwards


class OtherScale(FingerService):
    """Goes only part of the way from its rest."""

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


class Hunts(FingerService):
    """Shakes a joint about its target."""

    wrong = _Hunts


class _Weak(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = max(self.client_kp.min() / 15, 3 * self.viscous)


class Slow(FingerService):
    """Has stiff grease in its gears."""

    wrong = _Weak


class _Springy(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.viscous = 0.1 * self.viscous

    def take(self, rows: Floats, mode: Ints) -> None:
        undamped = rows.copy()
        undamped[4] = np.where(rows[3] > 0, 0.15 * rows[4], rows[4])
        super().take(undamped, mode)


class Undamped(FingerService):
    """Applies little of kd where there is a kp."""

    wrong = _Springy


class Coupled(FingerService):
    """The left hand's first finger leaks into the right one."""

    left = 0.0

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.LEFT and abs(motors[5].q) < 10:
            self.left = motors[5].q + 0.24
        elif side is Side.RIGHT:
            changed = list(motors)
            changed[5] = replace(motors[5], q=motors[5].q - 0.1 * self.left)
            motors = tuple(changed)
        super().motors(side, motors)


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


class Creeps(FingerService):
    """Creeps the last part of the way with one finger."""

    wrong = _Creeps


class _IgnoresZeroGains(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        unset = (rows[3] == 0) & (rows[4] == 0)
        own[3] = np.where(unset, self.client_kp, rows[3])
        own[4] = np.where(unset, self.client_kd, rows[4])
        super().take(own, mode)


class DefaultsForZeroGains(FingerService):
    """Takes zero gains for gains that were not set, and uses its own."""

    wrong = _IgnoresZeroGains


class _OwnStiffness(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3] = np.where(rows[3] > 0, self.client_kp, 0.0)
        own[4] = np.where(rows[3] > 0, self.client_kd, rows[4])
        super().take(own, mode)


class OwnStiffness(FingerService):
    """Uses its own stiffness whenever there is any."""

    wrong = _OwnStiffness


# --------------------------------------------------------------------------------- mode byte


class AlwaysDriven(FingerService):
    """Says that its motors are driven whatever it does."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["mode"] |= self.wire.mode(0)


class _IgnoresStatus(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        status, guarded = super().understood(mode)
        return np.ones_like(status), guarded


class IgnoresStatus(FingerService):
    """Drives whatever the mode byte says."""

    wrong = _IgnoresStatus


class _Ris(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        return (mode >> 4) & 7, mode >= 0x80


class DecodesRis(FingerService):
    """Takes the mode byte for a Dex3-1's: 1 is id 1 with status 0, which locks."""

    wrong = _Ris


class GoesById(FingerService):
    """Sorts a command's motors by the id in their mode byte."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if sorted(m.mode & 15 for m in motors) == list(range(len(motors))):
            motors = tuple(sorted(motors, key=lambda m: m.mode & 15))
        super().motors(side, motors)


# ------------------------------------------------------------------------------------- force


class TurnedForce(FingerService):
    """Publishes tau_est with the wrong sign."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] = -motors["tau_est"]


class FingersInNewtonMetres(FingerService):
    """Publishes all torques in N m, the fingers' too."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= self.torque_units[: len(motors)]


class MilliNewtonMetres(FingerService):
    """Publishes tau_est in mN m."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 1e3


# ------------------------------------------------------------------------------------ safety


class _NegativeGains(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.kp, self.kd = rows[3].copy(), np.abs(rows[4])


class NegativeGains(FingerService):
    """Takes a negative stiffness as it comes."""

    wrong = _NegativeGains


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


class RejectsOnlyTheBadJoint(FingerService):
    """Leaves out the joint with a NaN and moves the others."""

    wrong = _NanPerJoint


class _NanInTheLast(FingerHand):
    def command(self, motors: tuple[Motor, ...]) -> None:
        now = zip(self.goal.tolist(), motors[:-1], strict=False)
        kept = (m if all(map(math.isfinite, _values(m))) else Motor(q, mode=m.mode) for q, m in now)
        super().command((*kept, motors[-1]))


class LooksAtTheLastJoint(FingerService):
    """Tests the last joint alone for NaN, and lets any other that has one go limp."""

    wrong = _NanInTheLast


class _NoLimits(FingerHand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.low, self.high = self.low - 0.5, self.high + 0.5
        self.floor, self.ceiling = self.floor - 0.5, self.ceiling + 0.5


class NoLimits(FingerService):
    """Goes half a radian beyond the limits."""

    wrong = _NoLimits


class FillsUpWithZeros(FingerService):
    """Fills up a short command with zeros."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        super().receive(topic, payload, client)
        sequence = self.wire.command.decode(payload).motor_cmd
        for side in self.sides:
            mine = self.wire.command_topics[side] == topic
            if mine and 0 < len(sequence) < self.wire.joints:
                given = [Motor(m.q, m.dq, m.tau, m.kp, m.kd, m.mode) for m in sequence]
                missing = range(len(given), self.wire.joints)
                self.motors(side, (*given, *(Motor(mode=self.wire.mode(i)) for i in missing)))


class _KeepsSpeed(FingerHand):
    def expire(self) -> None:
        self.tripped = self.tripped | self.guarded


class KeepsDriving(FingerService):
    """Keeps the last velocity for ever, unless protected."""

    wrong = _KeepsSpeed


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


class LetsGo(FingerService):
    """Brakes in every silence, protected or not."""

    wrong = _AlwaysBrakes


class _LatchesWithoutGuard(FingerHand):
    stuck = False

    def expire(self) -> None:
        super().expire()
        self.stuck = not self.guarded.any()

    def take(self, rows: Floats, mode: Ints) -> None:
        if not self.stuck:
            super().take(rows, mode)


class StuckAfterSilence(FingerService):
    """Takes no command any more after a silence without protection."""

    wrong = _LatchesWithoutGuard


class _SleepsWithoutGuard(FingerHand):
    deaf_until = -math.inf

    def expire(self) -> None:
        super().expire()
        if not self.guarded.any():
            self.deaf_until = self.now + 2.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if self.now >= self.deaf_until:
            super().take(rows, mode)


class SleepsWithoutGuard(FingerService):
    """Takes a while after a silence without protection until it listens again."""

    wrong = _SleepsWithoutGuard


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


class HoldsWhenGuarded(FingerService):
    """Takes the time-out bit for news about the next command: keeps going to the position."""

    wrong = _HoldsOnly


class _Silent(FingerHand):
    def changed(self) -> None:
        super().changed()
        self.mode = self.mode & 0x7F


class TripsInSecret(FingerService):
    """Does not say that the protection has tripped."""

    wrong = _Silent


class _Unlatched(FingerHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.tripped = np.zeros_like(self.tripped)


class ClearsByItself(FingerService):
    """Goes on with the next command, bit 7 or not."""

    wrong = _Unlatched


class _ForEver(FingerHand):
    was = False

    def take(self, rows: Floats, mode: Ints) -> None:
        # a power cycle is what it wants; the kit's next stimulus finds it awake again
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


class SlowToClear(FingerService):
    """Stays tripped for two seconds after it was cleared."""

    wrong = _ForEver


class QuietWhenTripped(FingerService):
    """Publishes no state while its protection has tripped."""

    def publish(self) -> list[Sample]:
        tripped = any(hand.tripped.any() for hand in self.hands.values())
        return [] if tripped else super().publish()


_Entry: TypeAlias = tuple[type[Service], str, tuple[str, ...]]

_SHARED: dict[str, tuple[type[Service], ...]] = {
    "TOPIC-01": (shared.OldTopic, shared.OtherStateType),
    "TOPIC-02": (shared.OtherCommandType,),
    "QOS-01": (shared.DemandsHistory,),
    "QOS-02": (shared.BestEffortWriter,),
    "START-01": (shared.SilentUntilCommanded,),
    "RATE-01": (shared.SlowPublisher,),
    "RATE-02": (shared.HalfRate,),
    "RATE-03": (shared.Hiccup,),
    "RATE-04": (shared.Bursts,),
    "ORDER-01": (shared.RepeatsOldStates,),
    "FRESH-01": (shared.StaleState,),
    "FIELD-01": (shared.OneTooMany, shared.EmptyNowAndThen),
    "JOINT-01": (shared.Frozen,),
    "SAFE-01": (shared.NanIsZero,),
    "SAFE-03": (shared.EmptyIsZero, shared.DiesOfEmpty),
    "SAFE-05": (shared.TakesTheLast,),
    "SAFE-07": (shared.TakesAnyType, shared.DiesOfAnyType),
    "SAFE-08": (shared.QueuesCommands, shared.StopsInABurst),
    "SAFE-09": (shared.GivesUpOnTwo, shared.StaysWithTheNewest),
    "ORDER-02": (shared.DropsOldStamps,),
    "LOAD-01": (shared.StuttersUnderLoad, shared.WaitsForItsReaders),
    "FRESH-02": (shared.FreezesOnce,),
    "MOVE-06": (shared.KicksBack,),
    "WDOG-02": (shared.QuietInSilence,),
    "LIFE-01": (shared.ServesOnlyTheFirst,),
    "LIFE-02": (shared.BoundToOneClient,),
    "LIFE-03": (shared.DeafAfterRestart, shared.SilentAfterRestart),
    "LIFE-04": (shared.HangsAtTheEnd, shared.LeavesItsName),
    "LIFE-05": (shared.LeavesItDriven,),
    "TRACK-01": (shared.WaitsForRest,),
    "TRACK-02": (shared.Delayed,),
}

_OWN: tuple[_Entry, ...] = (
    (RestsAtZero, "START-02", ()),
    (NanVelocity, "FIELD-02", ()),
    (Unmirrored, "FIELD-03", ()),
    (TurnedVelocity, "FIELD-04", ()),
    (TurnedAcceleration, "FIELD-05", ()),
    (Kelvin, "FIELD-06", ()),
    (RawSupply, "FIELD-07", ()),
    (FaultForAStatus, "FIELD-08", ()),
    (CountsInReserve, "FIELD-09", ()),
    (NanGyroscope, "IMU-02", ()),
    (MilliNewtonMetres, "FORCE-02", ()),
    (Creeps, "MOVE-07", ("MOVE-04",)),
    (NegativeGains, "SAFE-06", ()),
    (CoupledFinger, "JOINT-01", ()),
    (OneJointBackwards, "MOVE-01", ()),
    (OtherScale, "MOVE-02", ()),
    (Hunts, "MOVE-03", ("SAFE-06",)),
    (Slow, "MOVE-04", ()),
    (Undamped, "MOVE-05", ()),
    (Coupled, "SIDE-01", ("MOVE-07",)),
    # a hand that answers to the other side's topic does not answer to its own
    (shared.Swapped, "SIDE-01", ("JOINT-01",)),
    (DefaultsForZeroGains, "GAIN-01", ()),
    (OwnStiffness, "GAIN-02", ()),
    (AlwaysDriven, "MODE-02", ("LIFE-05",)),
    (IgnoresStatus, "MODE-03", ("MODE-02",)),
    (LongQuaternion, "IMU-01", ()),
    (TurnedForce, "FORCE-01", ()),
    (RejectsOnlyTheBadJoint, "SAFE-01", ()),
    (LooksAtTheLastJoint, "SAFE-01", ()),
    (NoLimits, "SAFE-02", ()),
    (FillsUpWithZeros, "SAFE-04", ()),
    (KeepsDriving, "WDOG-01", ()),
    (StuckAfterSilence, "WDOG-03", ()),
    (SleepsWithoutGuard, "WDOG-03", ()),
)

_DEX3: tuple[_Entry, ...] = (
    (NoLowRate, "TOPIC-03", ()),
    (LowRateIsFull, "TOPIC-03", ()),
    (HotSensors, "SENS-05", ()),
    (UnsetLost, "SENS-06", ()),
    (IndexFirst, "JOINT-01", ()),
    (IdsFromOne, "MODE-01", ()),
    (GoesById, "MODE-04", ()),
    (OddPackets, "SENS-01", ()),
    (NanPressure, "SENS-02", ()),
    (ZeroForNoValue, "SENS-03", ()),
    (SevenPackets, "SENS-03", ()),
    (Numb, "SENS-04", ()),
    (QuietWhenTripped, "WDOG-02", ()),
    (LetsGo, "HOLD-01", ()),
    (HoldsWhenGuarded, "GUARD-01", ()),
    (TripsInSecret, "GUARD-02", ()),
    (ClearsByItself, "GUARD-03", ()),
    (SlowToClear, "GUARD-04", ()),
)

_DEX5: tuple[_Entry, ...] = (
    # what sees that nothing moves comes first
    (shared.Frozen, "MODE-01", ()),
    (DecodesRis, "MODE-01", ()),
    (ThumbFirst, "JOINT-01", ()),
    (FingersInNewtonMetres, "FORCE-03", ()),
)


_DEX5_ALSO: dict[str, tuple[str, ...]] = {
    # softer gains swing less, and come to rest more slowly
    "Creeps": (),
    "Hunts": (),
    "Slow": ("TRACK-01",),
    "Undamped": ("GAIN-02", "SAFE-02", "TRACK-01"),
    "Coupled": ("MOVE-02",),
    "TurnedForce": ("FORCE-03",),
}
"""What else fails with a wrong hand where it is another than of a Dex3-1."""


def _on(mixin: type[Service], reference: type[FingerService]) -> type[FingerService]:
    """The wrong hand that the reference becomes with ``mixin``, and with its ``wrong`` hand."""
    if issubclass(mixin, reference):
        return mixin
    made = of(mixin, reference)
    wrong: type[FingerHand] | None = getattr(mixin, "wrong", None)
    if wrong is not None:
        made.hand = type(wrong.__name__, (wrong, reference.hand), {})
    return made


def zoo(
    prefix: str,
    reference: type[FingerService],
    own: tuple[_Entry, ...],
    others: Mapping[str, tuple[str, ...]],
) -> tuple[tuple[type[FingerService], str, tuple[str, ...]], ...]:
    """The wrong hands of a model, for what its catalogue has.

    :param prefix: of its requirements' ids.
    :param own: those that only this model has.
    :param others: what else fails with some of them, by name, if not the same as usual.
    """
    named = {mixin.__name__ for mixin, _, _ in own}
    ids = {r.id for r in catalogue(reference.hand.model.name)}
    shares = [(mixin, kills, ()) for kills, mixins in _SHARED.items() for mixin in mixins]
    return tuple(
        (
            _on(mixin, reference),
            f"{prefix}-{kills}",
            tuple(
                f"{prefix}-{name}"
                for name in others.get(mixin.__name__, also)
                if f"{prefix}-{name}" in ids
            ),
        )
        for mixin, kills, also in (
            *(entry for entry in (*shares, *_OWN) if entry[0].__name__ not in named),
            *own,
        )
        if f"{prefix}-{kills}" in ids
    )


ZOOS = {
    DEX3_1.name: zoo("DEX3", Dex3Service, _DEX3, {}),
    DEX5_1.name: zoo("DEX5", Dex5Service, _DEX5, _DEX5_ALSO),
}
"""By model: (mutant, requirement that must catch it, requirements that cannot but fail with it)."""
BOTH = (
    *("Unmirrored", "IndexFirst", "Coupled", "Swapped", "Numb", "TurnedForce"),
    *("NanPressure", "ZeroForNoValue", "FingersInNewtonMetres"),
)
"""What is wrong of the right hand, of both together, or in touch; the others show it in the left
hand alone, in half the time."""
TOLD = (
    *("NoLowRate", "LowRateIsFull", "OddPackets", "SevenPackets", "NanPressure", "ZeroForNoValue"),
    *("LongQuaternion", "NanGyroscope", "TurnedAcceleration", "Kelvin", "RawSupply"),
    *("FaultForAStatus", "CountsInReserve", "HotSensors", "UnsetLost", "MilliNewtonMetres"),
)
"""What tells wrongly of a hand that does everything right."""
