"""Wrong grippers."""

# ruff: noqa: D102  (each class says what it does wrong; its methods only override)

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.mutants import shared
from dexkit.conformance.mutants.shared import of
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Side
from dexkit.messages import message_type

# ----------------------------------------------------------------------------------- fields


class _Fields(ReferenceService):
    """A service whose state is changed on the way out."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        raise AssertionError("a mutant says what it changes")

    def fields(self, side: Side) -> dict[str, Any]:
        return self.change(super().fields(side), side)


class NanVelocity(_Fields):
    """Divides by a time step of zero at rest."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return fields if fields["dq"] else {**fields, "dq": math.nan}


class _InUnit(_Fields):
    """Takes or publishes another unit than radians, ``full`` where it is open."""

    full = 100.0
    takes = publishes = True

    @property
    def scale(self) -> float:
        """Units in a radian."""
        return self.full / self.dialect.q_open

    def command(self, side: Side, motor: Motor) -> None:
        if self.takes and math.isfinite(motor.q):
            # its own controller is as stiff as the client asks for, in its own unit
            stiff = max(self.scale, 1.0)
            q, dq = motor.q / self.scale, motor.dq / self.scale
            motor = replace(motor, q=q, dq=dq, kp=stiff * motor.kp, kd=stiff * motor.kd)
        super().command(side, motor)

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if not self.publishes:
            return fields
        return {**fields, **{name: self.scale * fields[name] for name in ("q", "dq", "ddq")}}


class Percent(_InUnit):
    """Publishes percent of the stroke instead of radians."""

    takes = False


class PercentCommands(_InUnit):
    """Takes percent of the stroke instead of radians."""

    publishes = False


class Degrees(_InUnit):
    """Publishes degrees instead of radians."""

    full = math.degrees(5.4)
    takes = False


class _OtherScale(ReferenceHand):
    """Counts in another unit, and is as quick in it as a good hand is in radians."""

    full = 100.0
    tau_max = 120.0
    viscous = 0.06

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(self.full, touch)
        self.q = 3.0  # nearly closed: there it looks like radians

    def fields(self) -> dict[str, float]:
        return {**super().fields(), "tau_est": 0.1 * self.tau}


class PercentBothWays(ReferenceService):
    """Takes and publishes percent; begins nearly closed, where percent look like radians."""

    hand = _OtherScale


class PercentWithin(PercentBothWays):
    """Takes and publishes percent, of commands that it has clamped to 5.4."""

    def command(self, side: Side, motor: Motor) -> None:
        if math.isfinite(motor.q):
            motor = replace(motor, q=min(max(motor.q, 0.0), self.dialect.q_open))
        super().command(side, motor)


class _InDegrees(_OtherScale):
    full = math.degrees(5.4)


class DegreesBothWays(ReferenceService):
    """Takes and publishes degrees; begins nearly closed, where degrees look like radians."""

    hand = _InDegrees


class Normalised(_InUnit):
    """Publishes 0 to 1 instead of radians."""

    full = 1.0
    takes = False


class NormalisedCommands(_InUnit):
    """Takes 0 to 1 instead of radians."""

    full = 1.0
    publishes = False


class NormalisedBothWays(_InUnit):
    """Takes and publishes 0 to 1 instead of radians."""

    full = 1.0


class Metres(_InUnit):
    """Takes and publishes the opening in metres instead of radians."""

    full = 0.09


class TurnedVelocity(_Fields):
    """Publishes dq with the wrong sign."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "dq": -fields["dq"]}


class _Filled(_Fields):
    """One member of the state holds what it should not."""

    member = ""
    value: object = 0

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, self.member: self.value}


class OtherRobotsMode(_Filled):
    """Publishes the mode byte of an H1's motors."""

    member, value = "mode", 0x0A


class AlwaysDriven(_Filled):
    """Says all the time that the motor is driven."""

    member, value = "mode", 1


class TurnedAcceleration(_Fields):
    """Publishes ddq with the wrong sign."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "ddq": -fields["ddq"]}


class AccelerationPerSample(_Fields):
    """Publishes the change of dq from sample to sample as ddq."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "ddq": fields["ddq"] * self.period}


class NanRaw(_Filled):
    """Publishes NaN for a raw value that it does not know."""

    member, value = "q_raw", math.nan


class HotByte(_Filled):
    """Publishes the raw register of its thermometer."""

    member, value = "temperature", 200


class UnsetLost(_Filled):
    """Publishes memory that was never set as a count of lost packets."""

    member, value = "lost", 0xCCCCCCCC


class CountsInReserve(_Fields):
    """Counts its samples in a reserved word."""

    count = 0

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        self.count += 1
        reserve = (self.count, *(0,) * (3 if self.dialect.name == "unitree_hg" else 1))
        return {**fields, "reserve": reserve}


class Millivolts(_Filled):
    """Publishes vol in millivolts."""

    member, value = "vol", 12000.0


class StatusInMotorstate(_Filled):
    """Publishes a status of its own as the motor's faults."""

    member, value = "motorstate", 3


class NanAttitude(ReferenceService):
    """Publishes NaN for an attitude that it does not know."""

    def rest(self) -> dict[str, Any]:
        attitude = message_type("unitree_hg::msg::dds_::IMUState_").cls(rpy=(math.nan,) * 3)
        return {**super().rest(), "imu_state": attitude}


class _AtZero(ReferenceHand):
    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(stroke, touch)
        self.q = 0.0


class RestsAtZero(ReferenceService):
    """Rests exactly at 0, in both hands."""

    hand = _AtZero


# ----------------------------------------------------------------------------------- motion


class Inverted(ReferenceService):
    """Takes 0 for open."""

    def command(self, side: Side, motor: Motor) -> None:
        super().command(side, replace(motor, q=self.dialect.q_open - motor.q, dq=-motor.dq))


class OtherScale(ReferenceService):
    """Scales commands as if fully open were 2 pi."""

    def command(self, side: Side, motor: Motor) -> None:
        super().command(side, replace(motor, q=motor.q * 5.4 / (2 * math.pi)))


class _Hunts(ReferenceHand):
    def motor_torque(self) -> float:
        held = self.goal is not None and self.goal.kp > 0 and not self.braking
        shake = 0.8 * math.sin(2 * math.pi * 8.0 * self.now) if held else 0.0
        return super().motor_torque() + shake


class Hunts(ReferenceService):
    """Shakes about its target."""

    hand = _Hunts


class _Slow(ReferenceHand):
    def motor_torque(self) -> float:
        goal = self.goal
        if goal is not None and goal.kp > 0:  # a velocity loop below the position loop
            top = 2.6
            wanted = min(max(12.0 * (goal.q - self.q), -top), top)
            return min(max(0.5 * (wanted - self.dq) + self.viscous * wanted, -2.0), 2.0) * (
                not self.braking
            )
        return super().motor_torque()


class Slow(ReferenceService):
    """Moves at 2.6 rad/s at most."""

    hand = _Slow


class _Springy(ReferenceHand):
    inertia = 0.02
    viscous = 0.15


class Overshoots(ReferenceService):
    """Has too little damping."""

    hand = _Springy


class _Creeps(ReferenceHand):
    since = 0.0

    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        if self.goal is None or accepted.q != self.goal.q:
            self.since = self.now
        return accepted

    def motor_torque(self) -> float:
        goal = self.goal
        if goal is None or goal.kp <= 0 or self.braking or self.now - self.since < 0.15:
            return super().motor_torque()
        left = goal.q - self.q
        if abs(left) > 0.045 * self.stroke:
            return super().motor_torque()
        # a velocity loop with hardly any velocity left
        wanted = min(max(3.0 * left, -0.05), 0.05)
        friction = math.copysign(self.coulomb, wanted) + self.viscous * wanted
        return 0.5 * (wanted - self.dq) + friction


class Creeps(ReferenceService):
    """Creeps the last three millimetres."""

    hand = _Creeps


class ShortStroke(ReferenceService):
    """Keeps a margin of 5 % from its stops."""

    def command(self, side: Side, motor: Motor) -> None:
        low, high = 0.05 * self.dialect.q_open, 0.95 * self.dialect.q_open
        q = min(max(motor.q, low), high) if math.isfinite(motor.q) else motor.q
        super().command(side, replace(motor, q=q))


class Coupled(ReferenceService):
    """The left hand's target leaks into the right hand."""

    left = 0.0

    def command(self, side: Side, motor: Motor) -> None:
        if side is Side.LEFT and math.isfinite(motor.q) and abs(motor.q) < 10:
            self.left = motor.q
        elif side is Side.RIGHT:
            motor = replace(motor, q=motor.q + 0.05 * (self.left - 2.7))
        super().command(side, motor)


class _IgnoresGains(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return super().accept(Motor(q=motor.q))


class IgnoresGains(ReferenceService):
    """Goes to q whatever the gains are."""

    hand = _IgnoresGains


# ------------------------------------------------------------------------------------ force


class NoForce(_Fields):
    """Does not fill tau_est."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": 0.0}


class ForceAtRest(_Fields):
    """Reports the holding current as force, while it is driven."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if self.hands[side].braking:
            return fields
        return {**fields, "tau_est": fields["tau_est"] - 0.4}


class UnsignedForce(_Fields):
    """Reports the size of the force."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": abs(fields["tau_est"])}


class MilliNewtonMetres(_Fields):
    """Publishes tau_est in mN m."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": 1e3 * fields["tau_est"]}


class SignedForce(_Fields):
    """Publishes the signed torque where the strength of the grip is expected."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": self.hands[side].tau}


# ----------------------------------------------------------------------------------- safety


class _NegativeGains(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), kp=motor.kp, kd=motor.kd)


class NegativeGains(ReferenceService):
    """Takes negative gains as they come."""

    hand = _NegativeGains


class _NoLimits(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), q=motor.q)

    def contact(self) -> float:
        return super().contact() if abs(self.dq) < 2.0 and -0.5 < self.q < 6.0 else 0.0


class NoLimits(ReferenceService):
    """Follows a q far outside the stroke, through its stops."""

    hand = _NoLimits


class _NoWatchdog(ReferenceHand):
    timeout = math.inf


class NoWatchdog(ReferenceService):
    """Follows the last command for ever."""

    hand = _NoWatchdog


class _SnapsOpen(ReferenceHand):
    timeout = ReferenceHand.timeout + 0.15

    def motor_torque(self) -> float:
        if self.now - self.heard > ReferenceHand.timeout and not self.braking:
            return self.tau_max
        return super().motor_torque()


class SnapsOpenAtTheTimeOut(ReferenceService):
    """Opens when commands end, and then brakes: drops what it holds."""

    hand = _SnapsOpen


class _Sleeps(ReferenceHand):
    deaf_until = -math.inf

    def command(self, motor: Motor) -> None:
        if self.goal is not None and self.braking:
            self.deaf_until = max(self.deaf_until, self.heard + 3.0)
        if self.now >= self.deaf_until:
            super().command(motor)


class SleepsAfterSilence(ReferenceService):
    """Takes a while after a silence until it listens again."""

    hand = _Sleeps


class _InfiniteGains(ReferenceHand):
    def command(self, motor: Motor) -> None:
        super().command(replace(motor, kp=min(motor.kp, 1e3)))


class InfiniteGains(ReferenceService):
    """Caps the stiffness before it looks whether it is finite."""

    hand = _InfiniteGains


class _Latches(ReferenceHand):
    tripped = False

    @property
    def braking(self) -> bool:
        if self.goal is not None and self.now - self.heard > self.timeout:
            self.tripped = True
        return self.tripped or super().braking


class LatchesTheBrake(ReferenceService):
    """Brakes in silence, and never lets go again."""

    hand = _Latches


DIALECTS = {
    **dict.fromkeys(
        ("Millivolts", "StatusInMotorstate", "NanAttitude", "SignedForce"), "unitree_hg"
    ),
    "RestsAtZero": "unitree_actuator",
}
"""The dialect of those that are wrong in one dialect only."""
ALONE = ("RestsAtZero", "PercentBothWays", "PercentWithin", "DegreesBothWays")
"""Those that are seen in a left hand alone: an object would hold the right one away from 0."""
ZOO: tuple[tuple[type[ReferenceService], str, tuple[str, ...]], ...] = (
    (of(shared.OldTopic, ReferenceService), "DEX1-TOPIC-01", ()),
    (of(shared.OtherStateType, ReferenceService), "DEX1-TOPIC-01", ()),
    (of(shared.OtherCommandType, ReferenceService), "DEX1-TOPIC-02", ()),
    (of(shared.DemandsHistory, ReferenceService), "DEX1-QOS-01", ()),
    (of(shared.BestEffortWriter, ReferenceService), "DEX1-QOS-02", ()),
    (of(shared.SilentUntilCommanded, ReferenceService), "DEX1-START-01", ()),
    (RestsAtZero, "DEX1-START-02", ()),
    (of(shared.SlowPublisher, ReferenceService), "DEX1-RATE-01", ()),
    (of(shared.HalfRate, ReferenceService), "DEX1-RATE-02", ()),
    (of(shared.Hiccup, ReferenceService), "DEX1-RATE-03", ()),
    (of(shared.Bursts, ReferenceService), "DEX1-RATE-04", ()),
    (of(shared.RepeatsOldStates, ReferenceService), "DEX1-ORDER-01", ()),
    (of(shared.StaleState, ReferenceService), "DEX1-FRESH-01", ()),
    (of(shared.FreezesOnce, ReferenceService), "DEX1-FRESH-02", ()),
    (of(shared.OneTooMany, ReferenceService), "DEX1-FIELD-01", ()),
    (of(shared.EmptyNowAndThen, ReferenceService), "DEX1-FIELD-01", ()),
    (NanVelocity, "DEX1-FIELD-02", ()),
    (Percent, "DEX1-FIELD-03", ()),
    (PercentBothWays, "DEX1-FIELD-03", ()),
    (Degrees, "DEX1-FIELD-03", ()),
    (DegreesBothWays, "DEX1-FIELD-03", ()),
    (PercentWithin, "DEX1-FIELD-14", ()),
    (TurnedVelocity, "DEX1-FIELD-04", ()),
    (OtherRobotsMode, "DEX1-FIELD-05", ()),
    (AlwaysDriven, "DEX1-FIELD-05", ("DEX1-LIFE-05",)),
    (TurnedAcceleration, "DEX1-FIELD-06", ()),
    (AccelerationPerSample, "DEX1-FIELD-06", ()),
    (NanRaw, "DEX1-FIELD-07", ()),
    (HotByte, "DEX1-FIELD-08", ()),
    (UnsetLost, "DEX1-FIELD-09", ()),
    (CountsInReserve, "DEX1-FIELD-10", ()),
    (Millivolts, "DEX1-FIELD-11", ()),
    (StatusInMotorstate, "DEX1-FIELD-12", ()),
    (NanAttitude, "DEX1-FIELD-13", ()),
    (Inverted, "DEX1-MOVE-01", ()),
    (PercentCommands, "DEX1-MOVE-01", ()),
    (Normalised, "DEX1-MOVE-01", ()),
    (NormalisedBothWays, "DEX1-MOVE-01", ()),
    (Metres, "DEX1-MOVE-01", ()),
    (NormalisedCommands, "DEX1-MOVE-02", ("DEX1-MOVE-01",)),
    (of(shared.Frozen, ReferenceService), "DEX1-MOVE-01", ()),
    (OtherScale, "DEX1-MOVE-02", ()),
    (Hunts, "DEX1-MOVE-03", ()),
    # a session is faster than this hand can go
    (Slow, "DEX1-MOVE-04", ("DEX1-TRACK-01",)),
    (Overshoots, "DEX1-MOVE-05", ()),
    (of(shared.KicksBack, ReferenceService), "DEX1-MOVE-06", ()),
    (Creeps, "DEX1-MOVE-07", ()),
    (ShortStroke, "DEX1-MOVE-08", ()),
    (Coupled, "DEX1-SIDE-01", ()),
    # a hand that answers to the other side's topic does not answer to its own
    (of(shared.Swapped, ReferenceService), "DEX1-SIDE-01", ("DEX1-MOVE-01",)),
    (IgnoresGains, "DEX1-GAIN-01", ("DEX1-SAFE-05",)),
    (NoForce, "DEX1-FORCE-01", ()),
    (ForceAtRest, "DEX1-FORCE-02", ()),
    (UnsignedForce, "DEX1-FORCE-03", ()),
    (MilliNewtonMetres, "DEX1-FORCE-04", ("DEX1-FORCE-02",)),
    (SignedForce, "DEX1-FORCE-05", ()),
    (of(shared.NanIsZero, ReferenceService), "DEX1-SAFE-01", ()),
    (InfiniteGains, "DEX1-SAFE-01", ()),
    (NoLimits, "DEX1-SAFE-02", ()),
    (of(shared.EmptyIsZero, ReferenceService), "DEX1-SAFE-03", ()),
    (of(shared.DiesOfEmpty, ReferenceService), "DEX1-SAFE-03", ()),
    (of(shared.TakesTheLast, ReferenceService), "DEX1-SAFE-04", ()),
    (NegativeGains, "DEX1-SAFE-05", ()),
    (of(shared.TakesAnyType, ReferenceService), "DEX1-SAFE-06", ()),
    (of(shared.DiesOfAnyType, ReferenceService), "DEX1-SAFE-06", ()),
    (of(shared.QueuesCommands, ReferenceService), "DEX1-SAFE-07", ()),
    (of(shared.StopsInABurst, ReferenceService), "DEX1-SAFE-07", ()),
    (of(shared.GivesUpOnTwo, ReferenceService), "DEX1-SAFE-08", ()),
    (of(shared.StaysWithTheNewest, ReferenceService), "DEX1-SAFE-08", ()),
    (of(shared.DropsOldStamps, ReferenceService), "DEX1-ORDER-02", ()),
    (of(shared.StuttersUnderLoad, ReferenceService), "DEX1-LOAD-01", ()),
    (of(shared.WaitsForItsReaders, ReferenceService), "DEX1-LOAD-01", ()),
    # it says the truth, which a client cannot tell from a stuck byte
    (NoWatchdog, "DEX1-WDOG-01", ("DEX1-FIELD-05",)),
    (SnapsOpenAtTheTimeOut, "DEX1-WDOG-01", ()),
    (of(shared.QuietInSilence, ReferenceService), "DEX1-WDOG-02", ()),
    (LatchesTheBrake, "DEX1-WDOG-03", ()),
    (SleepsAfterSilence, "DEX1-WDOG-03", ()),
    (of(shared.ServesOnlyTheFirst, ReferenceService), "DEX1-LIFE-01", ()),
    (of(shared.BoundToOneClient, ReferenceService), "DEX1-LIFE-02", ()),
    (of(shared.DeafAfterRestart, ReferenceService), "DEX1-LIFE-03", ()),
    (of(shared.SilentAfterRestart, ReferenceService), "DEX1-LIFE-03", ()),
    (of(shared.HangsAtTheEnd, ReferenceService), "DEX1-LIFE-04", ()),
    (of(shared.LeavesItsName, ReferenceService), "DEX1-LIFE-04", ()),
    (of(shared.LeavesItDriven, ReferenceService), "DEX1-LIFE-05", ()),
    (of(shared.WaitsForRest, ReferenceService), "DEX1-TRACK-01", ()),
    (of(shared.Delayed, ReferenceService), "DEX1-TRACK-02", ()),
)
"""(mutant, requirement that must catch it, requirements that cannot but fail with it)."""
