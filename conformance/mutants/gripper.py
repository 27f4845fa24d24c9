"""Wrong grippers."""

# ruff: noqa: D102  (each class says what it does wrong; its methods only override)

from __future__ import annotations

import math
from dataclasses import replace

from dexkit.conformance.mutants import shared
from dexkit.conformance.mutants.shared import of
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.conformance.wire import Motor
from dexkit.hand import Side

# ----------------------------------------------------------------------------------- fields


class _Fields(ReferenceService):
    """A service whose state is changed on the way out."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        raise AssertionError("a mutant says what it changes")

    def fields(self, side: Side) -> dict[str, float]:
        return self.change(super().fields(side), side)


class NanVelocity(_Fields):
    """Divides by a time step of zero at rest."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return fields if fields["dq"] else {**fields, "dq": math.nan}


class Percent(_Fields):
    """Publishes percent of the stroke instead of radians."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return {**fields, "q": 100 * fields["q"] / self.dialect.q_open}


class TurnedVelocity(_Fields):
    """Publishes dq with the wrong sign."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return {**fields, "dq": -fields["dq"]}


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
        shake = 0.0 if self.braking else 0.8 * math.sin(2 * math.pi * 8.0 * self.now)
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

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return {**fields, "tau_est": 0.0}


class ForceAtRest(_Fields):
    """Reports the holding current as force, while it is driven."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        if self.hands[side].braking:
            return fields
        return {**fields, "tau_est": fields["tau_est"] - 0.4}


class UnsignedForce(_Fields):
    """Reports the size of the force."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return {**fields, "tau_est": abs(fields["tau_est"])}


# ----------------------------------------------------------------------------------- safety


class _NoLimits(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return motor

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


ZOO: tuple[tuple[type[ReferenceService], str, tuple[str, ...]], ...] = (
    (of(shared.OldTopic, ReferenceService), "DEX1-TOPIC-01", ()),
    (of(shared.OtherStateType, ReferenceService), "DEX1-TOPIC-01", ()),
    (of(shared.OtherCommandType, ReferenceService), "DEX1-TOPIC-02", ()),
    (of(shared.DemandsHistory, ReferenceService), "DEX1-QOS-01", ()),
    (of(shared.BestEffortWriter, ReferenceService), "DEX1-QOS-02", ()),
    (of(shared.SilentUntilCommanded, ReferenceService), "DEX1-START-01", ()),
    (of(shared.SlowPublisher, ReferenceService), "DEX1-RATE-01", ()),
    (of(shared.HalfRate, ReferenceService), "DEX1-RATE-02", ()),
    (of(shared.Hiccup, ReferenceService), "DEX1-RATE-03", ()),
    (of(shared.Bursts, ReferenceService), "DEX1-RATE-04", ()),
    (of(shared.RepeatsOldStates, ReferenceService), "DEX1-ORDER-01", ()),
    (of(shared.StaleState, ReferenceService), "DEX1-FRESH-01", ()),
    (of(shared.OneTooMany, ReferenceService), "DEX1-FIELD-01", ()),
    (of(shared.EmptyNowAndThen, ReferenceService), "DEX1-FIELD-01", ()),
    (NanVelocity, "DEX1-FIELD-02", ()),
    (Percent, "DEX1-FIELD-03", ()),
    (TurnedVelocity, "DEX1-FIELD-04", ()),
    (Inverted, "DEX1-MOVE-01", ()),
    (of(shared.Frozen, ReferenceService), "DEX1-MOVE-01", ()),
    (OtherScale, "DEX1-MOVE-02", ()),
    (Hunts, "DEX1-MOVE-03", ()),
    # a session is faster than this hand can go
    (Slow, "DEX1-MOVE-04", ("DEX1-TRACK-01",)),
    (Overshoots, "DEX1-MOVE-05", ()),
    (Coupled, "DEX1-SIDE-01", ()),
    # a hand that answers to the other side's topic does not answer to its own
    (of(shared.Swapped, ReferenceService), "DEX1-SIDE-01", ("DEX1-MOVE-01",)),
    (IgnoresGains, "DEX1-GAIN-01", ()),
    (NoForce, "DEX1-FORCE-01", ()),
    (ForceAtRest, "DEX1-FORCE-02", ()),
    (UnsignedForce, "DEX1-FORCE-03", ()),
    (of(shared.NanIsZero, ReferenceService), "DEX1-SAFE-01", ()),
    (NoLimits, "DEX1-SAFE-02", ()),
    (of(shared.EmptyIsZero, ReferenceService), "DEX1-SAFE-03", ()),
    (of(shared.DiesOfEmpty, ReferenceService), "DEX1-SAFE-03", ()),
    (NoWatchdog, "DEX1-WDOG-01", ()),
    (of(shared.QuietInSilence, ReferenceService), "DEX1-WDOG-02", ()),
    (LatchesTheBrake, "DEX1-WDOG-03", ()),
    (of(shared.ServesOnlyTheFirst, ReferenceService), "DEX1-LIFE-01", ()),
    (of(shared.BoundToOneClient, ReferenceService), "DEX1-LIFE-02", ()),
    (of(shared.WaitsForRest, ReferenceService), "DEX1-TRACK-01", ()),
    (of(shared.Delayed, ReferenceService), "DEX1-TRACK-02", ()),
)
"""(mutant, requirement that must catch it, requirements that cannot but fail with it)."""
