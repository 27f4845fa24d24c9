"""Wrong Dex3-1 hands."""

# ruff: noqa: D102  (each class says what it does wrong; its methods only override)

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.mutants import shared
from dexkit.conformance.mutants.shared import of
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.dex3 import Dex3Hand, Dex3Service, Ints
from dexkit.conformance.wire import Motor, mode_byte
from dexkit.hand import Floats, Side
from dexkit.models import DEX3_1

# --------------------------------------------------------------------- discovery and start-up


class NoLowRate(Dex3Service):
    """Publishes no low-rate copy."""

    def low_rate(self, samples: list[Sample]) -> list[Sample]:
        return []


class LowRateIsFull(Dex3Service):
    """Publishes the low-rate copy as often as the state."""

    low_period = Dex3Service.period


class _Zero(Dex3Hand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.q = [0.0] * len(self.q)


class RestsAtZero(Dex3Service):
    """Rests with every joint at exactly 0."""

    hand = _Zero


# ------------------------------------------------------------------------------------ fields


class NanVelocity(Dex3Service):
    """Divides by a time step of zero at rest, in one joint."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        if len(motors) and not hand.dq[5]:
            motors["dq"][5] = math.nan


class Unmirrored(Dex3Service):
    """Has the left hand's signs on the right one, in both directions."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.RIGHT:
            motors = tuple(replace(m, q=-m.q, dq=-m.dq, tau=-m.tau) for m in motors)
        super().motors(side, motors)

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        if hand.side is Side.RIGHT:
            for name in ("q", "dq", "tau_est"):
                motors[name] = -motors[name]

    def positions(self, side: Side) -> tuple[float, ...]:
        sign = -1.0 if side is Side.RIGHT else 1.0
        return tuple(sign * q for q in super().positions(side))


class TurnedVelocity(Dex3Service):
    """Publishes dq with the wrong sign."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["dq"] = -motors["dq"]


class TurnedAcceleration(Dex3Service):
    """Publishes ddq with the wrong sign."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["ddq"] = -motors["ddq"]


class _Filled(Dex3Service):
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


class CountsInReserve(Dex3Service):
    """Counts its states in a reserved word of the first motor."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["reserve"][0] = hand.version


class HotSensors(_Filled):
    """Publishes the sensors' temperatures in hundredths of a degree."""

    packet = ("temperature", (2500.0,) * 12)


class UnsetLost(_Filled):
    """Publishes memory that was never set as the sensors' count of lost packets."""

    packet = ("lost", 0xCCCCCCCC)


class NanGyroscope(Dex3Service):
    """Publishes NaN for an angular velocity that it does not know."""

    def message(self, count: int) -> Any:
        message = super().message(count)
        message.imu_state.gyroscope = [math.nan] * 3
        return message


class IdsFromOne(Dex3Service):
    """Counts its motors from 1."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["mode"] += 1


class OddPackets(Dex3Service):
    """Publishes ten sensor packets."""

    sensors = 10

    def pressures(self, hand: Dex3Hand) -> Floats:
        felt = super().pressures(hand)
        return np.concatenate((felt, felt[:1]))


class NanPressure(Dex3Service):
    """Publishes NaN where there is no sensor."""

    def pressures(self, hand: Dex3Hand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, math.nan, felt)


class ZeroForNoValue(Dex3Service):
    """Publishes 0 where there is no sensor."""

    def pressures(self, hand: Dex3Hand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, 0.0, felt)


class SevenPackets(Dex3Service):
    """Publishes the SDK's default of seven packets."""

    sensors = 7


class Numb(Dex3Service):
    """Never feels a touch."""

    def pressures(self, hand: Dex3Hand) -> Floats:
        felt = super().pressures(hand)
        return np.where(felt == 30000.0, felt, 0.0)


class LongQuaternion(Dex3Service):
    """Publishes the raw counts of its attitude."""

    def quaternion(self) -> list[float]:
        return [16384.0, 0.0, 0.0, 0.0]


# ------------------------------------------------------------------------------------ motion


def _reordered(order: tuple[int, ...]) -> Callable[[tuple[Motor, ...]], tuple[Motor, ...]]:
    def reorder(motors: tuple[Motor, ...]) -> tuple[Motor, ...]:
        return tuple(motors[i] for i in order)

    return reorder


class IndexFirst(Dex3Service):
    """Takes the commands of the right hand index finger first, as xr_teleoperate's enum says."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if side is Side.RIGHT:
            motors = _reordered((0, 1, 2, 5, 6, 3, 4))(motors)
        super().motors(side, motors)


class CoupledFinger(Dex3Service):
    """Has the second joint of a finger follow the first a little."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        coupled = list(motors)
        coupled[4] = replace(motors[4], q=motors[4].q + 0.2 * motors[3].q)
        super().motors(side, tuple(coupled))


class _Backwards(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        middle = 0.5 * (self.low + self.high)
        turned = rows.copy()
        turned[0] = np.where(self.index == 2, 2 * middle - rows[0], rows[0])
        turned[1] = np.where(self.index == 2, -rows[1], rows[1])
        super().take(turned, mode)


class OneJointBackwards(Dex3Service):
    """Turns the sign of the thumb's tip."""

    hand = _Backwards


class OtherScale(Dex3Service):
    """Goes only part of the way from its rest."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        rest = DEX3_1.rest_q[side]
        scaled = (replace(m, q=r + 0.75 * (m.q - r)) for m, r in zip(motors, rest, strict=True))
        super().motors(side, tuple(scaled))


class _Hunts(Dex3Hand):
    def move(self, dt: float, pull: list[float]) -> None:
        if self.law_kp[2] > 1.0:
            pull[2] += 0.25 * math.sin(2 * math.pi * 8.0 * self.now)
        super().move(dt, pull)

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


class Hunts(Dex3Service):
    """Shakes the thumb about its target."""

    hand = _Hunts


class _Weak(Dex3Hand):
    viscous = 0.1


class Slow(Dex3Service):
    """Has stiff grease in its gears."""

    hand = _Weak


class _Springy(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        undamped = rows.copy()
        undamped[4] = np.where(rows[3] > 0, 0.15 * rows[4], rows[4])
        super().take(undamped, mode)


class Undamped(Dex3Service):
    """Applies little of kd where there is a kp."""

    hand = _Springy


class Coupled(Dex3Service):
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


class _Creeps(Dex3Hand):
    since = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        if not np.array_equal(rows[0], self.goal):
            self.since = self.now
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        if self.now - self.since > 0.2 and self.law_on[6] and self.law_kp[6] > 1.0:
            left = self.law_q[6] - self.q[6]
            if 0.02 < abs(left) < 0.1:
                wanted = math.copysign(0.045, left)
                pull[6] = self.law_kd[6] * wanted + math.copysign(self.coulomb, left)
        super().move(dt, pull)

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


class Creeps(Dex3Service):
    """Creeps the last part of the way with one finger."""

    hand = _Creeps


class _IgnoresZeroGains(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        unset = (rows[3] == 0) & (rows[4] == 0)
        own[3], own[4] = np.where(unset, 1.5, rows[3]), np.where(unset, 0.2, rows[4])
        super().take(own, mode)


class DefaultsForZeroGains(Dex3Service):
    """Takes zero gains for gains that were not set, and uses its own."""

    hand = _IgnoresZeroGains


class _OwnStiffness(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        own = rows.copy()
        own[3], own[4] = np.where(rows[3] > 0, 1.5, 0.0), np.where(rows[3] > 0, 0.2, rows[4])
        super().take(own, mode)


class OwnStiffness(Dex3Service):
    """Uses its own stiffness whenever there is any."""

    hand = _OwnStiffness


# --------------------------------------------------------------------------------- mode byte


class AlwaysDriven(Dex3Service):
    """Reports status 1 whatever it does."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["mode"] |= 1 << 4


class _IgnoresStatus(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode & 0x8F | 1 << 4)

    def changed(self) -> None:
        super().changed()


class IgnoresStatus(Dex3Service):
    """Drives with status 0 as with 1."""

    hand = _IgnoresStatus


class GoesById(Dex3Service):
    """Sorts a command's motors by the id in their mode byte."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if sorted(m.mode & 15 for m in motors) == list(range(len(motors))):
            motors = tuple(sorted(motors, key=lambda m: m.mode & 15))
        super().motors(side, motors)


# ------------------------------------------------------------------------------------- force


class TurnedForce(Dex3Service):
    """Publishes tau_est with the wrong sign."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] = -motors["tau_est"]


class MilliNewtonMetres(Dex3Service):
    """Publishes tau_est in mN m."""

    def fill(self, motors: Any, hand: Dex3Hand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 1e3


# ------------------------------------------------------------------------------------ safety


class _NegativeGains(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.kp, self.kd = rows[3].copy(), np.abs(rows[4])


class NegativeGains(Dex3Service):
    """Takes a negative stiffness as it comes."""

    hand = _NegativeGains


class _NanPerJoint(Dex3Hand):
    def command(self, motors: tuple[Motor, ...]) -> None:
        now = zip(self.goal.tolist(), self.kp.tolist(), self.kd.tolist(), motors, strict=True)
        super().command(
            tuple(
                m
                if all(math.isfinite(v) for v in (m.q, m.dq, m.tau, m.kp, m.kd))
                else Motor(q, kp=kp, kd=kd, mode=m.mode)
                for q, kp, kd, m in now
            )
        )


class RejectsOnlyTheBadJoint(Dex3Service):
    """Leaves out the joint with a NaN and moves the others."""

    hand = _NanPerJoint


class _NoLimits(Dex3Hand):
    def __init__(self, side: Side, touch: float | None = None) -> None:
        super().__init__(side, touch)
        self.low, self.high = self.low - 0.5, self.high + 0.5
        self.floor, self.ceiling = self.floor - 0.5, self.ceiling + 0.5


class NoLimits(Dex3Service):
    """Goes half a radian beyond the limits."""

    hand = _NoLimits


class FillsUpWithZeros(Dex3Service):
    """Fills up a short command with zeros."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        super().receive(topic, payload, client)
        sequence = self.wire.command.decode(payload).motor_cmd
        for side in self.sides:
            mine = self.wire.command_topics[side] == topic
            if mine and 0 < len(sequence) < self.wire.joints:
                given = [Motor(m.q, m.dq, m.tau, m.kp, m.kd, m.mode) for m in sequence]
                missing = range(len(given), self.wire.joints)
                self.motors(side, (*given, *(Motor(mode=mode_byte(i)) for i in missing)))


class _KeepsSpeed(Dex3Hand):
    def expire(self) -> None:
        self.tripped = self.tripped | self.guarded


class KeepsDriving(Dex3Service):
    """Keeps the last velocity for ever, unless protected."""

    hand = _KeepsSpeed


class _AlwaysBrakes(Dex3Hand):
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


class LetsGo(Dex3Service):
    """Brakes in every silence, protected or not."""

    hand = _AlwaysBrakes


class _LatchesWithoutGuard(Dex3Hand):
    stuck = False

    def expire(self) -> None:
        super().expire()
        self.stuck = not self.guarded.any()

    def take(self, rows: Floats, mode: Ints) -> None:
        if not self.stuck:
            super().take(rows, mode)


class StuckAfterSilence(Dex3Service):
    """Takes no command any more after a silence without protection."""

    hand = _LatchesWithoutGuard


# ---------------------------------------------------------------------- time-out protection


class _HoldsOnly(Dex3Hand):
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


class HoldsWhenGuarded(Dex3Service):
    """Takes the time-out bit for news about the next command: keeps going to the position."""

    hand = _HoldsOnly


class _Silent(Dex3Hand):
    def changed(self) -> None:
        super().changed()
        self.mode = self.mode & 0x7F


class TripsInSecret(Dex3Service):
    """Does not say that the protection has tripped."""

    hand = _Silent


class _Unlatched(Dex3Hand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.tripped = np.zeros_like(self.tripped)


class ClearsByItself(Dex3Service):
    """Goes on with the next command, bit 7 or not."""

    hand = _Unlatched


class _ForEver(Dex3Hand):
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


class SlowToClear(Dex3Service):
    """Stays tripped for two seconds after it was cleared."""

    hand = _ForEver


class QuietWhenTripped(Dex3Service):
    """Publishes no state while its protection has tripped."""

    def publish(self) -> list[Sample]:
        tripped = any(hand.tripped.any() for hand in self.hands.values())
        return [] if tripped else super().publish()


_SHARED = {
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

# a velocity cannot be derived twice from states that come in bursts
_SHARED_ALSO: dict[type, tuple[str, ...]] = {shared.Bursts: ("DEX3-FIELD-05",)}

_OWN: tuple[tuple[type[Dex3Service], str, tuple[str, ...]], ...] = (
    (NoLowRate, "TOPIC-03", ()),
    (LowRateIsFull, "TOPIC-03", ()),
    (RestsAtZero, "START-02", ()),
    (NanVelocity, "FIELD-02", ()),
    (Unmirrored, "FIELD-03", ()),
    (TurnedVelocity, "FIELD-04", ()),
    (TurnedAcceleration, "FIELD-05", ()),
    (Kelvin, "FIELD-06", ()),
    (RawSupply, "FIELD-07", ()),
    (FaultForAStatus, "FIELD-08", ()),
    (CountsInReserve, "FIELD-09", ()),
    (HotSensors, "SENS-05", ()),
    (UnsetLost, "SENS-06", ()),
    (NanGyroscope, "IMU-02", ()),
    (MilliNewtonMetres, "FORCE-02", ()),
    (Creeps, "MOVE-07", ("MOVE-04",)),
    (NegativeGains, "SAFE-06", ()),
    (IndexFirst, "JOINT-01", ()),
    (CoupledFinger, "JOINT-01", ()),
    (OneJointBackwards, "MOVE-01", ()),
    (OtherScale, "MOVE-02", ()),
    (Hunts, "MOVE-03", ("SAFE-06",)),
    (Slow, "MOVE-04", ()),
    (Undamped, "MOVE-05", ()),
    (Coupled, "SIDE-01", ("MOVE-07",)),
    # a hand that answers to the other side's topic does not answer to its own
    (of(shared.Swapped, Dex3Service), "SIDE-01", ("JOINT-01",)),
    (DefaultsForZeroGains, "GAIN-01", ()),
    (OwnStiffness, "GAIN-02", ()),
    (IdsFromOne, "MODE-01", ()),
    (AlwaysDriven, "MODE-02", ("LIFE-05",)),
    (IgnoresStatus, "MODE-03", ("MODE-02",)),
    (GoesById, "MODE-04", ()),
    (OddPackets, "SENS-01", ()),
    (NanPressure, "SENS-02", ()),
    (ZeroForNoValue, "SENS-03", ()),
    (SevenPackets, "SENS-03", ()),
    (LongQuaternion, "IMU-01", ()),
    (Numb, "SENS-04", ()),
    (TurnedForce, "FORCE-01", ()),
    (RejectsOnlyTheBadJoint, "SAFE-01", ()),
    (NoLimits, "SAFE-02", ()),
    (FillsUpWithZeros, "SAFE-04", ()),
    (KeepsDriving, "WDOG-01", ()),
    (QuietWhenTripped, "WDOG-02", ()),
    (StuckAfterSilence, "WDOG-03", ()),
    (LetsGo, "HOLD-01", ()),
    (HoldsWhenGuarded, "GUARD-01", ()),
    (TripsInSecret, "GUARD-02", ()),
    (ClearsByItself, "GUARD-03", ()),
    (SlowToClear, "GUARD-04", ()),
)

ZOO: tuple[tuple[type[Dex3Service], str, tuple[str, ...]], ...] = (
    *(
        (of(mixin, Dex3Service), f"DEX3-{kills}", _SHARED_ALSO.get(mixin, ()))
        for kills, mixins in _SHARED.items()
        for mixin in mixins
    ),
    *(
        (service, f"DEX3-{kills}", tuple(f"DEX3-{name}" for name in also))
        for service, kills, also in _OWN
    ),
)
"""(mutant, requirement that must catch it, requirements that cannot but fail with it)."""
BOTH = (
    *("Unmirrored", "IndexFirst", "Coupled", "Swapped", "Numb", "TurnedForce"),
    *("NanPressure", "ZeroForNoValue"),
)
"""What is wrong of the right hand, of both together, or in touch; the others show it in the left
hand alone, in half the time."""
TOLD = (
    *("NoLowRate", "LowRateIsFull", "OddPackets", "SevenPackets", "NanPressure", "ZeroForNoValue"),
    *("LongQuaternion", "NanGyroscope", "TurnedAcceleration", "Kelvin", "RawSupply"),
    *("FaultForAStatus", "CountsInReserve", "HotSensors", "UnsetLost", "MilliNewtonMetres"),
)
"""What tells wrongly of a hand that does everything right."""
