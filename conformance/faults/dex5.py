"""Wrong hands of the Dex5-1: what only it can have, and where shared faults have other effects.

The faults that it shares with the Dex3-1 are applied to it without a line here, because its
requirements are ``like`` that hand's. Those declared at the end break further requirements of this
hand: its gains are lower, and it oscillates less and comes to rest more slowly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dexkit.conformance.faults import any_model, fingers, operator
from dexkit.conformance.faults.registry import BOTH, wrong_hand
from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.virtual.dex5 import Dex5Service
from dexkit.conformance.virtual.fingers import FingerHand, FingerService, Flags, Ints
from dexkit.hand import Floats, Side


@wrong_hand("DEX5-JOINT-01")
class ThumbFirst(FingerService):
    """Obeys commands thumb first, as the URDF numbers the fingers."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        super().motors(side, fingers.reordered((*range(4, 20), *range(4)))(motors))


class _Ris(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        return (mode >> 4) & 7, mode >= 0x80


@wrong_hand("DEX5-MODE-01")
class DecodesRis(FingerService):
    """Decodes the mode byte as a Dex3-1's: 1 is id 1 with status 0, which locks."""

    hand_fault = _Ris


@wrong_hand("DEX5-WDOG-01")
class IndexGoesHome(FingerService):
    """Sends its first joint to one end after the time-out, whatever was commanded."""

    hand_fault = fingers.GoesHome


class _AnyModeDrives(FingerHand):
    def understood(self, mode: Ints) -> tuple[Ints, Flags]:
        _, guarded = super().understood(mode)
        return np.where(mode != 0, 1, 0), guarded


@wrong_hand("DEX5-MODE-07")
class AnyModeDrives(FingerService):
    """Drives a joint with any mode but 0."""

    hand_fault = _AnyModeDrives


@wrong_hand("DEX5-FORCE-02", sides=BOTH)
class ThumbInTheFingersUnit(FingerService):
    """Publishes the torques of the thumb in mN m, as those of the fingers."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"][16:] *= 1e3


@wrong_hand("DEX5-FORCE-03", sides=BOTH)
class FingersInNewtonMetres(FingerService):
    """Publishes the fingers' torques in N m, as the other joints'."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= self.torque_units[: len(motors)]


class _FadingGrip(FingerHand):
    pressed = 0.0

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)
        touches = self.touches and any(abs(c) > 0.005 for c in self.contact)
        self.pressed += dt if touches else 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        self.pressed = 0.0
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, [0.3 * p for p in pull] if self.pressed > 0.9 else pull)


@wrong_hand("DEX5-FORCE-06", sides=BOTH, whole=True)
class GripFades(Dex5Service):
    """Presses with a third of the torque after 0.9 s of contact: a limit of the mean current."""

    hand_fault = _FadingGrip


class _WeakThumb(FingerHand):
    part = 0.3

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, [self.part * p if i >= 16 else p for i, p in enumerate(pull)])


class _SoftThumb(_WeakThumb):
    part = 0.43


@wrong_hand("DEX5-FORCE-05", sides=BOTH)
class SoftThumb(Dex5Service):
    """Moves and presses with less than half of the torque in all joints of the thumb."""

    hand_fault = _SoftThumb


@wrong_hand("DEX5-FORCE-10", sides=BOTH)
class WeakThumb(Dex5Service):
    """Moves and presses with three tenths of the torque in all joints of the thumb."""

    hand_fault = _WeakThumb


class _BoostsLittle(fingers.Boosts):
    joints = (13, 14, 15)


@wrong_hand("DEX5-FORCE-08", sides=BOTH)
class LittleFingerBoosts(Dex5Service):
    """Its little finger presses with two and a half times the torque where it is blocked."""

    hand_fault = _BoostsLittle


class _WeakRing(fingers.OtherInContact):
    joints = (9, 10, 11)
    factor = 0.35


@wrong_hand("DEX5-FORCE-08", sides=BOTH)
class RingFingerGivesIn(Dex5Service):
    """Its ring finger presses with a third of the torque where it is blocked."""

    hand_fault = _WeakRing


class _OwnTimeouts(FingerHand):
    joints: tuple[int, ...]
    """Those without a time-out."""

    def expire(self) -> None:
        status = self.status.copy()
        super().expire()
        self.status[list(self.joints)] = status[list(self.joints)]


class _FingersGoOn(_OwnTimeouts):
    joints = tuple(range(16))


@wrong_hand("DEX5-WDOG-04", sides=BOTH, whole=True)
class FingersGoOn(Dex5Service):
    """Only its thumb releases without commands; the fingers press on."""

    hand_fault = _FingersGoOn


class _OneGoesOn(_OwnTimeouts):
    joints = (15,)


@wrong_hand("DEX5-WDOG-04", sides=BOTH, whole=True)
class OneJointGoesOn(Dex5Service):
    """The last joint of its little finger presses on without commands."""

    hand_fault = _OneGoesOn


# Faults that other hands have as well

wrong_hand("DEX5-FRESH-01", whole=True)(any_model.StaleState)
wrong_hand("DEX5-FRESH-01", whole=True)(any_model.StaleLater)
wrong_hand("DEX5-FRESH-02", whole=True)(any_model.FreezesOnce)
wrong_hand("DEX5-FRESH-03", whole=True)(any_model.SwapsBuffers)
# the first requirement that finds that nothing moves is about the mode byte
wrong_hand("DEX5-MODE-01", brief=True)(any_model.Frozen)
wrong_hand("DEX5-MOVE-06")(any_model.KicksBack)
wrong_hand("DEX5-STILL-01", sides=BOTH, whole=True)(any_model.KicksTheOtherSide)
wrong_hand("DEX5-FIELD-16")(fingers.ShakenVelocity)
wrong_hand("DEX5-FIELD-20", whole=True)(fingers.ShowsTheGoalNearIt)
wrong_hand("DEX5-PATH-01")(fingers.BeginsAtZero)
wrong_hand("DEX5-MOVE-02")(fingers.OtherScale)
wrong_hand("DEX5-MOVE-03", whole=True)(fingers.Hunts)
wrong_hand("DEX5-MOVE-04")(fingers.Slow)
wrong_hand("DEX5-GAIN-02")(fingers.OwnStiffness)
wrong_hand("DEX5-MOVE-05")(fingers.Undamped)
wrong_hand("DEX5-SIDE-01", sides=BOTH)(fingers.Coupled)
wrong_hand("DEX5-SIDE-03", sides=BOTH, whole=True)(any_model.WaitsForTheOtherGrip)
wrong_hand("DEX5-MOVE-07")(fingers.Creeps)
wrong_hand("DEX5-GAIN-02")(fingers.GainsOfFirstMotor)
wrong_hand("DEX5-GAIN-02")(fingers.GainsOfTheMotorBefore)
wrong_hand("DEX5-GAIN-07")(fingers.TorqueOfTheMotorBefore)
wrong_hand("DEX5-MODE-03")(fingers.ZeroIsNoChange)
wrong_hand("DEX5-MODE-03")(fingers.LastJointStaysOn)
wrong_hand("DEX5-FORCE-01", sides=BOTH)(fingers.TurnedForce)
wrong_hand("DEX5-SAFE-01")(fingers.RejectsOnlyTheBadJoint)
wrong_hand("DEX5-WDOG-03")(fingers.StuckAfterSilence)
wrong_hand("DEX5-WDOG-03")(fingers.SleepsWithoutGuard)
wrong_hand("DEX5-OPER-02")(operator.FingerDeadBand)
wrong_hand("DEX5-OPER-04")(operator.CoarseFingers)
# its session begins at the open end
wrong_hand("DEX5-OPER-01")(operator.SlowToLeave)
# its delay is long compared with the steps of the light joints
wrong_hand("DEX5-OPER-05")(operator.LateFingers)
# the hands are not mirrored
wrong_hand("DEX5-SAFE-01", sides=BOTH, whole=True)(any_model.CrossesSidesAfterBadCommands)
wrong_hand("DEX5-SIDE-01", sides=BOTH, whole=True)(any_model.SwappedWhenRestarted)
wrong_hand("DEX5-FORCE-11", sides=BOTH)(fingers.ReportsGoalsWhenStalled)
