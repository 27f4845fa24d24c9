"""Wrong grippers.

Where a fault is in the left hand alone, the object would hold the right one away from 0.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from dexkit.conformance.faults.registry import BOTH, LEFT, wrong_hand
from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.virtual import TopicDevice
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Side
from dexkit.messages import message_type

# ----------------------------------------------------------------------------------- fields


class _Fields(ReferenceService):
    """A service whose state is changed before it is published."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        raise NotImplementedError

    def fields(self, side: Side) -> dict[str, Any]:
        return self.change(super().fields(side), side)


@wrong_hand("DEX1-FIELD-02")
class NanVelocity(_Fields):
    """Divides by a time step of zero at rest."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return fields if fields["dq"] else {**fields, "dq": math.nan}


@wrong_hand("DEX1-FIELD-21", whole=True)
class ShowsTheGoalNearIt(_Fields):
    """Publishes the commanded q within 3.5 % of the stroke from it."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        goal = self.hands[side].goal
        near = goal is not None and abs(goal.q - fields["q"]) < 0.035 * self.hands[side].stroke
        return {**fields, "q": goal.q} if goal is not None and near else fields


class _InUnit(_Fields):
    """Obeys or publishes another unit than radians: ``full`` when open."""

    full = 100.0
    takes = publishes = True

    @property
    def scale(self) -> float:
        """Units in a radian."""
        return self.full / self.dialect.q_open

    def command(self, side: Side, motor: Motor) -> None:
        if self.takes and math.isfinite(motor.q):
            # its controller has the client's stiffness in its own unit
            stiff = max(self.scale, 1.0)
            q, dq = motor.q / self.scale, motor.dq / self.scale
            motor = replace(motor, q=q, dq=dq, kp=stiff * motor.kp, kd=stiff * motor.kd)
        super().command(side, motor)

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if not self.publishes:
            return fields
        return {**fields, **{name: self.scale * fields[name] for name in ("q", "dq", "ddq")}}


@wrong_hand("DEX1-FIELD-03")
class Percent(_InUnit):
    """Publishes percent of the stroke instead of radians."""

    takes = False


@wrong_hand("DEX1-MOVE-01")
class PercentCommands(_InUnit):
    """Obeys q as percent of the stroke instead of radians."""

    publishes = False


@wrong_hand("DEX1-FIELD-03")
class Degrees(_InUnit):
    """Publishes degrees instead of radians."""

    full = math.degrees(5.4)
    takes = False


class _OtherScale(ReferenceHand):
    """Computes in another unit, and is as fast in it as a good hand is in radians."""

    full = 100.0
    tau_max = 120.0
    viscous = 0.06

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(self.full, touch)
        self.q = 3.0  # nearly closed, where percent are in the range of radians

    def fields(self) -> dict[str, float]:
        return {**super().fields(), "tau_est": 0.1 * self.tau}


@wrong_hand("DEX1-FIELD-03", sides=LEFT, whole=True)
class PercentBothWays(ReferenceService):
    """Obeys and publishes percent; starts nearly closed, in the range of radians."""

    hand = _OtherScale


@wrong_hand("DEX1-FIELD-14", sides=LEFT)
class PercentWithin(PercentBothWays):
    """Obeys and publishes percent, after it has clamped q to 0 to 5.4."""

    def command(self, side: Side, motor: Motor) -> None:
        if math.isfinite(motor.q):
            motor = replace(motor, q=min(max(motor.q, 0.0), self.dialect.q_open))
        super().command(side, motor)


class _InDegrees(_OtherScale):
    full = math.degrees(5.4)


@wrong_hand("DEX1-FIELD-03", sides=LEFT, whole=True)
class DegreesBothWays(ReferenceService):
    """Obeys and publishes degrees; starts nearly closed, in the range of radians."""

    hand = _InDegrees


@wrong_hand("DEX1-MOVE-01")
class Normalised(_InUnit):
    """Publishes 0 to 1 instead of radians."""

    full = 1.0
    takes = False


@wrong_hand("DEX1-MOVE-02")
class NormalisedCommands(_InUnit):
    """Obeys q as 0 to 1 instead of radians."""

    full = 1.0
    publishes = False


@wrong_hand("DEX1-MOVE-01")
class NormalisedBothWays(_InUnit):
    """Obeys and publishes 0 to 1 instead of radians."""

    full = 1.0


@wrong_hand("DEX1-MOVE-01")
class Metres(_InUnit):
    """Obeys and publishes the opening in metres instead of radians."""

    full = 0.09


@wrong_hand("DEX1-FIELD-04")
class TurnedVelocity(_Fields):
    """Publishes dq with the wrong sign."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "dq": -fields["dq"]}


@wrong_hand("DEX1-FIELD-22")
class VelocityWhileOpening(_Fields):
    """Fills dq only while it opens."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "dq": max(fields["dq"], 0.0)}


# --------------------------------------------------------------------- consistency of the state


@wrong_hand("DEX1-FIELD-15")
class JumpsOnce(_Fields):
    """Has no dq, and publishes one q that is 30 % of the stroke off."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        off = 0.3 * self.dialect.q_open if 0.5 <= self.now < 0.5 + self.period else 0.0
        return {**fields, "q": fields["q"] + off, "dq": 0.0, "ddq": 0.0}


@wrong_hand("DEX1-FIELD-16")
class ShakenVelocity(_Fields):
    """For some seconds has an oscillation on dq that q does not make."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if not 3.5 <= self.now < 5.5:
            return fields
        shaken = 5.0 * self.dialect.q_open * math.sin(2 * math.pi * 13.0 * self.now)
        return {**fields, "dq": fields["dq"] + shaken}


@wrong_hand("DEX1-FRESH-04")
class RepeatsItsStates(_Fields):
    """Measures 67 times a second, and publishes each measurement five times."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.turns = dict.fromkeys(self.sides, 0)
        self.measured: dict[Side, dict[str, Any]] = {}

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if self.turns[side] % 5 == 0:
            self.measured[side] = fields
        self.turns[side] += 1
        return dict(self.measured[side])


@wrong_hand("DEX1-FIELD-19")
class VelocityByTurns(_Fields):
    """Measures every second state, with dq over one period: alternately twice the speed and 0."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.turns = dict.fromkeys(self.sides, 0)
        self.measured: dict[Side, float] = {}

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        self.turns[side] += 1
        if self.turns[side] % 2 and side in self.measured:
            return {**fields, "q": self.measured[side], "dq": 0.0}
        self.measured[side] = fields["q"]
        return {**fields, "dq": 2.0 * fields["dq"]}


@wrong_hand("DEX1-FIELD-20")
class VelocityOfTheLastDrive(_Fields):
    """Keeps the dq of the last motion that it drove while it brakes."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.last = dict.fromkeys(self.sides, 0.0)

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if self.hands[side].braking:
            return {**fields, "dq": self.last[side]}
        if abs(fields["dq"]) > 0.1 * self.dialect.q_open:
            self.last[side] = fields["dq"]
        return fields


@wrong_hand("DEX1-FIELD-17")
class ShiftsForAWhile(_Fields):
    """Publishes q with an offset of 8 % of the stroke for 0.4 s; its dq stays true."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        off = 0.08 * self.dialect.q_open if 0.4 <= self.now < 0.8 else 0.0
        return {**fields, "q": fields["q"] + off, "ddq": 0.0}


@wrong_hand("DEX1-FIELD-18", whole=True)
class GoesThroughTheObject(_Fields):
    """In contact the published q, and dq with it, continues to the command."""

    speed = 0.4  # rad/s

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.off = dict.fromkeys(self.sides, 0.0)
        self.rate = dict.fromkeys(self.sides, 0.0)

    def live(self, dt: float) -> None:
        super().live(dt)
        for side, hand in self.hands.items():
            inside = hand.touch is not None and hand.q < hand.touch
            if hand.braking:
                self.rate[side] = 0.0
                continue
            wanted = hand.goal.q - hand.q if inside and hand.goal is not None else 0.0
            step = min(max(wanted - self.off[side], -self.speed * dt), self.speed * dt)
            self.off[side] += step
            self.rate[side] = step / dt

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        q, dq = fields["q"] + self.off[side], fields["dq"] + self.rate[side]
        return {**fields, "q": q, "dq": dq, "ddq": 0.0}


class _Filled(_Fields):
    """One member of the state has a fixed wrong value."""

    member = ""
    value: object = 0

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, self.member: self.value}


@wrong_hand("DEX1-FIELD-05")
class OtherRobotsMode(_Filled):
    """Publishes the mode byte of an H1's motors, 0x0A."""

    member, value = "mode", 0x0A


@wrong_hand("DEX1-FIELD-05")
class AlwaysDriven(_Filled):
    """Publishes mode 1, driven, all the time."""

    member, value = "mode", 1


@wrong_hand("DEX1-FIELD-06")
class TurnedAcceleration(_Fields):
    """Publishes ddq with the wrong sign."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "ddq": -fields["ddq"]}


@wrong_hand("DEX1-FIELD-06")
class AccelerationPerSample(_Fields):
    """Publishes the change of dq from sample to sample as ddq."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "ddq": fields["ddq"] * self.period}


@wrong_hand("DEX1-FIELD-07")
class NanRaw(_Filled):
    """Publishes NaN for a raw value that it does not know."""

    member, value = "q_raw", math.nan


@wrong_hand("DEX1-FIELD-08")
class HotByte(_Filled):
    """Publishes 200 degrees Celsius: a raw register as the temperature."""

    member, value = "temperature", 200


@wrong_hand("DEX1-FIELD-08")
class HotAtStart(_Fields):
    """Publishes 90 degrees Celsius until it gets its first command."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return fields if self.hands[side].goal else {**fields, "temperature": 90}


@wrong_hand("DEX1-FIELD-09")
class UnsetLost(_Filled):
    """Publishes uninitialised memory as the count of lost packets."""

    member, value = "lost", 0xCCCCCCCC


@wrong_hand("DEX1-FIELD-10")
class CountsInReserve(_Fields):
    """Counts its states in a reserved word."""

    count = 0

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        self.count += 1
        reserve = (self.count, *(0,) * (3 if self.dialect.interface_specification else 1))
        return {**fields, "reserve": reserve}


@wrong_hand("DEX1-FIELD-11", dialect="unitree_hg")
class Millivolts(_Filled):
    """Publishes vol in millivolts."""

    member, value = "vol", 12000.0


@wrong_hand("DEX1-FIELD-12", dialect="unitree_hg")
class StatusInMotorstate(_Filled):
    """Publishes a status word as the motor's faults."""

    member, value = "motorstate", 3


@wrong_hand("DEX1-FIELD-13", dialect="unitree_hg")
class NanAttitude(ReferenceService):
    """Publishes NaN for an attitude that it does not know."""

    def rest(self) -> dict[str, Any]:
        attitude = message_type("unitree_hg::msg::dds_::IMUState_").cls(rpy=(math.nan,) * 3)
        return {**super().rest(), "imu_state": attitude}


class _AtZero(ReferenceHand):
    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(stroke, touch)
        self.q = 0.0


@wrong_hand("DEX1-START-02", sides=LEFT, dialect="unitree_actuator")
class RestsAtZero(ReferenceService):
    """Rests exactly at 0, in both hands."""

    hand = _AtZero


# ----------------------------------------------------------------------------------- motion


@wrong_hand("DEX1-MOVE-01")
class Inverted(ReferenceService):
    """Uses 0 as open."""

    def command(self, side: Side, motor: Motor) -> None:
        super().command(side, replace(motor, q=self.dialect.q_open - motor.q, dq=-motor.dq))


@wrong_hand("DEX1-MOVE-02")
class OtherScale(ReferenceService):
    """Scales commands as if fully open were 2 pi."""

    def command(self, side: Side, motor: Motor) -> None:
        super().command(side, replace(motor, q=motor.q * 5.4 / (2 * math.pi)))


class _Hunts(ReferenceHand):
    def motor_torque(self) -> float:
        held = self.goal is not None and self.goal.kp > 0 and not self.braking
        shake = 0.8 * math.sin(2 * math.pi * 8.0 * self.now) if held else 0.0
        return super().motor_torque() + shake


@wrong_hand("DEX1-MOVE-03", whole=True)
class Hunts(ReferenceService):
    """Oscillates about its goal."""

    hand = _Hunts


class _Slow(ReferenceHand):
    top = 2.6  # rad/s

    def motor_torque(self) -> float:
        goal = self.goal
        if goal is not None and goal.kp > 0:  # a velocity loop below the position loop
            wanted = min(max(12.0 * (goal.q - self.q), -self.top), self.top)
            return min(max(0.5 * (wanted - self.dq) + self.viscous * wanted, -2.0), 2.0) * (
                not self.braking
            )
        return super().motor_torque()


# it lags in a session that is judged with the speed that DEX1-MOVE-04 asks
@wrong_hand("DEX1-MOVE-04")
class Slow(ReferenceService):
    """Moves at 2.6 rad/s at most."""

    hand = _Slow


class _Springy(ReferenceHand):
    inertia = 0.02
    viscous = 0.15


@wrong_hand("DEX1-MOVE-05")
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


@wrong_hand("DEX1-MOVE-07")
class Creeps(ReferenceService):
    """Moves the last 3 mm to its goal slowly."""

    hand = _Creeps


@wrong_hand("DEX1-MOVE-08")
class ShortStroke(ReferenceService):
    """Stays 5 % of the stroke away from its stops."""

    def command(self, side: Side, motor: Motor) -> None:
        low, high = 0.05 * self.dialect.q_open, 0.95 * self.dialect.q_open
        q = min(max(motor.q, low), high) if math.isfinite(motor.q) else motor.q
        super().command(side, replace(motor, q=q))


@wrong_hand("DEX1-SIDE-01")
class Coupled(ReferenceService):
    """The left hand's goal leaks into the right hand's."""

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


@wrong_hand("DEX1-GAIN-01", whole=True)
class IgnoresGains(ReferenceService):
    """Moves to q with any gains."""

    hand = _IgnoresGains


class _Deaf(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return accepted if accepted.kp > 0 else replace(accepted, dq=0.0)


@wrong_hand("DEX1-GAIN-02")
class DeafToVelocity(ReferenceService):
    """Ignores dq without a position gain."""

    hand = _Deaf


class _TurnedVelocityCommand(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return accepted if accepted.kp > 0 else replace(accepted, dq=-accepted.dq)


@wrong_hand("DEX1-GAIN-06")
class TurnedVelocityCommand(ReferenceService):
    """Obeys dq with the wrong sign where there is no position gain."""

    hand = _TurnedVelocityCommand


class _SpeedMode(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, kp=0.0) if accepted.dq else accepted


@wrong_hand("DEX1-GAIN-08")
class SpeedModeByDq(ReferenceService):
    """Selects its speed mode by a dq other than 0: q is not used then."""

    hand = _SpeedMode


class _TorqueLimit(ReferenceHand):
    def motor_torque(self) -> float:
        goal = self.goal
        if goal is None or not goal.tau:
            return super().motor_torque()
        most, self.goal = abs(goal.tau), replace(goal, tau=0.0)
        tau = super().motor_torque()
        self.goal = goal
        return min(max(tau, -most), most)


@wrong_hand("DEX1-GAIN-08")
class LimitsByTau(ReferenceService):
    """Takes tau of a command for the limit of its torque."""

    hand = _TorqueLimit


class _KeepsGains(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        before = self.goal
        if before is not None and accepted.kp == 0.0 and accepted.q == before.q:
            return replace(accepted, kp=before.kp, kd=before.kd)
        return accepted


@wrong_hand("DEX1-FORCE-15", sides=BOTH, whole=True)
class KeepsGainsAtTheSamePlace(ReferenceService):
    """Ignores gains of 0 if q has not changed."""

    hand = _KeepsGains


# ------------------------------------------------------------------------------------ force


class _HardReflex(ReferenceHand):
    gripped = False

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        soft = self.goal is not None and 0.0 < self.goal.kp < 5.0
        self.gripped = self.contact() != 0.0 and (self.gripped or soft)
        return max(min((2.0 if self.gripped else 1.0) * tau, self.tau_max), -self.tau_max)


@wrong_hand("DEX1-FORCE-14", sides=BOTH)
class GripsHarderWhenSoft(ReferenceService):
    """Mistakes a softer grip for slip, and doubles its force until it lets go."""

    hand = _HardReflex


class _DeafToTorque(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), tau=0.0)


@wrong_hand("DEX1-GAIN-03")
class DeafToTorque(ReferenceService):
    """Ignores the torque of a command."""

    hand = _DeafToTorque


class _UnsignedTorque(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), tau=abs(motor.tau))


@wrong_hand("DEX1-GAIN-03")
class UnsignedTorque(ReferenceService):
    """Opens with the torque of a command, whatever its sign is."""

    hand = _UnsignedTorque


class _TurnedTorque(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, tau=-accepted.tau)


@wrong_hand("DEX1-GAIN-07", dialect="unitree_actuator")
class TurnedTorque(ReferenceService):
    """Obeys the torque of a command with the wrong sign, in one dialect."""

    hand = _TurnedTorque


class _TurnedWhileHeld(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, tau=-accepted.tau) if accepted.kp > 0 else accepted


@wrong_hand("DEX1-GAIN-07")
class TurnedTorqueWhileHeld(ReferenceService):
    """Obeys the torque of a command with the wrong sign where a position gain holds it."""

    hand = _TurnedWhileHeld


@wrong_hand("DEX1-GAIN-07", sides=BOTH)
class TorqueOfTheOtherSide(ReferenceService):
    """Adds the torque that the other gripper is commanded."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.asked = dict.fromkeys(self.sides, 0.0)

    def command(self, side: Side, motor: Motor) -> None:
        if math.isfinite(motor.tau):
            self.asked[side] = motor.tau
            other = [tau for s, tau in self.asked.items() if s != side]
            motor = replace(motor, tau=other[0])
        super().command(side, motor)


@wrong_hand("DEX1-FORCE-01")
class NoForce(_Fields):
    """Does not fill tau_est."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": 0.0}


@wrong_hand("DEX1-FORCE-02")
class ForceAtRest(_Fields):
    """Reports the holding current as force, while it is driven."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        if self.hands[side].braking:
            return fields
        return {**fields, "tau_est": fields["tau_est"] - 0.4}


@wrong_hand("DEX1-FORCE-03")
class UnsignedForce(_Fields):
    """Reports the magnitude of the force."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": abs(fields["tau_est"])}


@wrong_hand("DEX1-FORCE-16", sides=BOTH)
class MirroredForce(_Fields):
    """Publishes the left gripper's tau_est with the sign of a mirrored motor."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": -fields["tau_est"]} if side is Side.LEFT else fields


@wrong_hand("DEX1-FORCE-20", whole=True)
class SignTurns(_Fields):
    """Publishes tau_est with the other sign from 5 s on: its motor was enabled again."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": -fields["tau_est"]} if self.now > 5.0 else fields


class _Chatters(ReferenceHand):
    load = 0.0

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return 0.1 * tau if self.load > 1.5 and int(self.now / 0.03) % 3 == 0 else tau

    def step(self, dt: float) -> None:
        super().step(dt)
        pressing = self.touch is not None and self.q < self.touch + 0.1
        self.load = self.load + dt if pressing else 0.0


@wrong_hand("DEX1-FORCE-10", sides=BOTH)
class ChatteringLimit(ReferenceService):
    """After 1.5 s of a grip its thermal limit takes the force away for a third of the time."""

    hand = _Chatters


class _LimitsLater(ReferenceHand):
    held, let_go = 0.0, False

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return max(tau, -0.4) if self.let_go else tau

    def step(self, dt: float) -> None:
        super().step(dt)
        pressing = self.touch is not None and self.q < self.touch and self.tau < -0.5
        self.let_go |= self.held > 2.0 and not pressing
        self.held = self.held + dt if pressing else 0.0


@wrong_hand("DEX1-FORCE-17", sides=BOTH, whole=True)
class SecondGripWeak(ReferenceService):
    """Pushes with 0.4 N m at most towards closing after the first long grip has ended."""

    hand = _LimitsLater


@wrong_hand("DEX1-FORCE-04")
class MilliNewtonMetres(_Fields):
    """Publishes tau_est in mN m."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": 1e3 * fields["tau_est"]}


@wrong_hand("DEX1-MOVE-10", dialect="unitree_hg")
class NoDeadZones(ReferenceService):
    """Goes to every q as it is, without the zones that mean fully open and closed."""

    def command(self, side: Side, motor: Motor) -> None:
        self.hands[side].command(Motor(q=motor.q) if math.isfinite(motor.q) else motor)


@wrong_hand("DEX1-FORCE-05", dialect="unitree_hg")
class SignedForce(_Fields):
    """Publishes the signed torque where the strength of the grip is expected."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": self.hands[side].tau}


@wrong_hand("DEX1-FORCE-06")
class FeelsLate(_Fields):
    """Reports the force of a contact only when it has lasted for 0.9 s."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.since = dict.fromkeys(self.sides, 0.0)

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        hand = self.hands[side]
        if hand.touch is None or hand.q > hand.touch:
            self.since[side] = self.now
        late = self.now - self.since[side] > 0.9
        return fields if late else {**fields, "tau_est": 0.0}


@wrong_hand("DEX1-FORCE-07")
class ForceBeforeCommands(_Fields):
    """Reports a force until it gets its first command."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return fields if self.hands[side].goal else {**fields, "tau_est": -0.6}


@wrong_hand("DEX1-FORCE-08")
class AlwaysClosing(_Fields):
    """Has an unsigned sensor of the current: its torque is always that of closing."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": -abs(fields["tau_est"])}


@wrong_hand("DEX1-FORCE-08")
class FeelsClosingOnly(_Fields):
    """Publishes no torque towards open."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": min(fields["tau_est"], 0.0)}


class _Saturates(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, kp=min(accepted.kp, 2.0))


@wrong_hand("DEX1-FORCE-09")
class StiffnessSaturates(ReferenceService):
    """Has a kp of 2 N m/rad at most."""

    hand = _Saturates


class _Boosts(ReferenceHand):
    def motor_torque(self) -> float:
        tau = super().motor_torque()
        if self.contact() > 0.0 and not self.braking:
            return min(max(2.0 * tau, -self.tau_max), self.tau_max)
        return tau


@wrong_hand("DEX1-FORCE-18")
class BoostsWhereItIsBlocked(ReferenceService):
    """Presses with twice the torque that it was commanded."""

    hand = _Boosts


class _BoostsMore(ReferenceHand):
    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return 2.6 * tau if self.contact() > 0.0 else tau


@wrong_hand("DEX1-FORCE-19", dialect="unitree_hg", sides=BOTH, whole=True)
class BoostsByItsOwnGains(ReferenceService):
    """Presses with two and a half times the torque of its own gains where it is blocked."""

    hand = _BoostsMore


class _HoldingCurrent(ReferenceHand):
    still = 0.0

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return 0.3 * tau if self.still > 0.3 else tau

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.touch is None or self.q > self.touch + 0.3:
            self.still = 0.0
        elif self.contact() > 0.0:
            self.still += dt


@wrong_hand("DEX1-FORCE-19", dialect="unitree_hg", sides=BOTH, whole=True)
class HoldingCurrent(ReferenceService):
    """Holds an object with a third of the torque from 0.3 s on, as the driver of a stepper does."""

    hand = _HoldingCurrent


class _WeakAgain(ReferenceHand):
    contacts = 0
    touching = False

    def motor_torque(self) -> float:
        tau, touches = super().motor_torque(), self.contact() > 0.0
        self.contacts += touches and not self.touching
        self.touching = touches
        return 0.4 * tau if touches and self.contacts > 1 else tau


@wrong_hand("DEX1-FORCE-09")
class WeakAgain(ReferenceService):
    """Presses with 40 % of the force from its second contact on."""

    hand = _WeakAgain


# ----------------------------------------------------------------------------------- safety


class _NegativeGains(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), kp=motor.kp, kd=motor.kd)


@wrong_hand("DEX1-SAFE-05")
class NegativeGains(ReferenceService):
    """Applies negative gains."""

    hand = _NegativeGains


class _NegativeStiffness(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, kp=motor.kp) if motor.kd >= 0.0 else accepted


@wrong_hand("DEX1-SAFE-10")
class NegativeStiffnessAlone(ReferenceService):
    """Clamps gains that are both negative, and applies a negative kp beside a good kd."""

    hand = _NegativeStiffness


class _GainsWithoutSign(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), kp=abs(motor.kp), kd=abs(motor.kd))


@wrong_hand("DEX1-SAFE-05")
class GainsWithoutSign(ReferenceService):
    """Drops the sign of negative gains, and goes to q."""

    hand = _GainsWithoutSign


class _NoLimits(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), q=motor.q)

    def contact(self) -> float:
        return super().contact() if abs(self.dq) < 2.0 and -0.5 < self.q < 6.0 else 0.0


@wrong_hand("DEX1-SAFE-02", whole=True)
class NoLimits(ReferenceService):
    """Follows a q far outside the stroke."""

    hand = _NoLimits


class _NoWatchdog(ReferenceHand):
    timeout = math.inf


# its mode byte is correct, but equals a constant one
@wrong_hand("DEX1-WDOG-01")
class NoWatchdog(ReferenceService):
    """Follows the last command without end."""

    hand = _NoWatchdog


class _Tardy(ReferenceHand):
    timeout = 1.38 * ReferenceHand.timeout


@wrong_hand("DEX1-WDOG-01", sides=BOTH)
class BrakesLate(ReferenceService):
    """Brakes 1.38 s after the last command: its watchdog counts a slower clock's ticks."""

    hand = _Tardy


class _Hasty(ReferenceHand):
    timeout = 0.6 * ReferenceHand.timeout


@wrong_hand("DEX1-WDOG-06")
class BrakesEarly(ReferenceService):
    """Brakes 0.6 s after the last command."""

    hand = _Hasty


class _FedByAnything(ReferenceHand):
    def command(self, motor: Motor) -> None:
        super().command(motor)
        self.heard = self.now


@wrong_hand("DEX1-WDOG-04")
class FedByRejected(ReferenceService):
    """Does not brake while commands arrive that it rejects."""

    hand = _FedByAnything


class _BrakesOnce(ReferenceHand):
    braked = 0.0

    @property
    def braking(self) -> bool:
        if self.goal is None or self.now - self.heard <= self.timeout:
            return self.goal is None
        self.braked = self.braked or self.now
        return self.now - self.braked < 2.0


@wrong_hand("DEX1-WDOG-01")
class BrakesOnce(ReferenceService):
    """Brakes at the first time-out and at none after it."""

    hand = _BrakesOnce


@wrong_hand("DEX1-WDOG-01")
class NoWatchdogWhenRestarted(ReferenceService):
    """Follows the last command without end after a restart of its service."""

    def begin(self, now: float) -> None:
        super().begin(now)
        for hand in self.hands.values():
            hand.timeout = math.inf


class _SnapsOpen(ReferenceHand):
    timeout = ReferenceHand.timeout + 0.15

    def motor_torque(self) -> float:
        if self.now - self.heard > ReferenceHand.timeout and not self.braking:
            return self.tau_max
        return super().motor_torque()


@wrong_hand("DEX1-WDOG-01")
class SnapsOpenAtTheTimeOut(ReferenceService):
    """Opens after the time-out and then brakes: it drops its object."""

    hand = _SnapsOpen


class _Sleeps(ReferenceHand):
    deaf_until = -math.inf

    def command(self, motor: Motor) -> None:
        if self.goal is not None and self.braking:
            self.deaf_until = max(self.deaf_until, self.heard + 3.0)
        if self.now >= self.deaf_until:
            super().command(motor)


@wrong_hand("DEX1-WDOG-03", whole=True)
class SleepsAfterSilence(ReferenceService):
    """Ignores commands for a while after a silence."""

    hand = _Sleeps


class _InfiniteGains(ReferenceHand):
    def command(self, motor: Motor) -> None:
        super().command(replace(motor, kp=min(motor.kp, 1e3)))


@wrong_hand("DEX1-SAFE-01")
class InfiniteGains(ReferenceService):
    """Clamps kp before it checks that it is finite."""

    hand = _InfiniteGains


class _Latches(ReferenceHand):
    tripped = False

    @property
    def braking(self) -> bool:
        if self.goal is not None and self.now - self.heard > self.timeout:
            self.tripped = True
        return self.tripped or super().braking


@wrong_hand("DEX1-WDOG-03")
class LatchesTheBrake(ReferenceService):
    """Brakes after a silence and never releases."""

    hand = _Latches


# ------------------------------------------------------- for long, softly, and after a silence


class _Tires(ReferenceHand):
    """Loses force while the same command presses."""

    seconds = 0.0
    begins, ends, rest = 2.0, 3.0, 0.5

    def motor_torque(self) -> float:
        part = (self.seconds - self.begins) / (self.ends - self.begins)
        return super().motor_torque() * (1.0 - (1.0 - self.rest) * min(max(part, 0.0), 1.0))

    def step(self, dt: float) -> None:
        super().step(dt)
        self.seconds = self.seconds + dt if self.contact() > 0.0 and not self.braking else 0.0


@wrong_hand("DEX1-FORCE-10")
class GripFades(ReferenceService):
    """Presses with half of the force after three seconds of contact."""

    hand = _Tires


class _Winds(ReferenceHand):
    seconds = 0.0

    def motor_torque(self) -> float:
        tau = super().motor_torque() * (1.0 + 0.5 * min(self.seconds, 2.0))
        return min(max(tau, -self.tau_max), self.tau_max)

    def step(self, dt: float) -> None:
        super().step(dt)
        self.seconds = self.seconds + dt if self.contact() > 0.0 and not self.braking else 0.0


@wrong_hand("DEX1-FORCE-10")
class GripGrows(ReferenceService):
    """Presses harder and harder, up to twice what was commanded."""

    hand = _Winds


class _Sleepy(ReferenceHand):
    seconds = 0.0
    last: Motor | None = None

    def command(self, motor: Motor) -> None:
        if self.last is None or motor.q != self.last.q or motor.kp != self.last.kp:
            self.seconds = 0.0
        self.last = motor
        super().command(motor)

    def motor_torque(self) -> float:
        return 0.0 if self.seconds > 3.0 and self.touch is None else super().motor_torque()

    def step(self, dt: float) -> None:
        super().step(dt)
        self.seconds += dt


@wrong_hand("DEX1-HOLD-01")
class SleepsWhileHeld(ReferenceService):
    """Switches its motor off when the goal has been the same for three seconds."""

    hand = _Sleepy


class _SoftInTheFree(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        return replace(accepted, kp=min(accepted.kp, 2.5)) if self.touch is None else accepted


@wrong_hand("DEX1-GAIN-05")
class StiffnessSaturatesInTheFree(ReferenceService):
    """Has a kp of 2.5 N m/rad at most without an object between the jaws."""

    hand = _SoftInTheFree


class _LeastStiffness(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        limp = accepted.kp < 1.0 and self.touch is None
        return replace(accepted, kp=0.0) if limp else accepted


@wrong_hand("DEX1-GAIN-04")
class SoftIsLimp(ReferenceService):
    """Treats a kp below 1 N m/rad as 0 without an object between the jaws."""

    hand = _LeastStiffness


class _SoftGripIsLimp(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        limp = accepted.kp < 1.0 and self.touch is not None
        return replace(accepted, kp=0.1 * accepted.kp) if limp else accepted


@wrong_hand("DEX1-FORCE-11")
class SoftGripIsLimp(ReferenceService):
    """Scales a kp below 1 N m/rad down, in the hand with an object."""

    hand = _SoftGripIsLimp


class _WholeStiffness(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        accepted = super().accept(motor)
        if not 1.0 < accepted.kp < 3.0:
            return accepted
        return replace(accepted, kp=math.floor(accepted.kp))


@wrong_hand("DEX1-FORCE-12")
class WholeStiffness(ReferenceService):
    """Rounds a kp between 1 and 3 N m/rad down to a whole number."""

    hand = _WholeStiffness


@wrong_hand("DEX1-FORCE-13")
class OffsetOfTheForce(_Fields):
    """Has an offset of 0.15 N m on tau_est."""

    def change(self, fields: dict[str, Any], side: Side) -> dict[str, Any]:
        return {**fields, "tau_est": fields["tau_est"] + 0.15}


@wrong_hand("DEX1-START-03")
class KeepsItsGoal(ReferenceService):
    """Applies the last command of the previous service when it starts."""

    kept: dict[Side, Motor]

    def brake(self) -> None:
        self.kept = {side: hand.goal for side, hand in self.hands.items() if hand.goal}
        super().brake()

    def take_over(self, before: TopicDevice) -> None:
        super().take_over(before)
        assert isinstance(before, KeepsItsGoal)
        self.kept = before.kept

    def begin(self, now: float) -> None:
        super().begin(now)
        for side, motor in self.kept.items():
            self.hands[side].command(motor)


class _Wraps(ReferenceHand):
    wraps = 3.0

    @property
    def braking(self) -> bool:
        if self.goal is None:
            return True
        return (self.now - self.heard) % self.wraps > self.timeout


@wrong_hand("DEX1-WDOG-01")
class WatchdogWraps(ReferenceService):
    """Releases the brake for a second every three seconds: its counter wraps."""

    hand = _Wraps


class _LetsGo(ReferenceHand):
    pressed = False

    def motor_torque(self) -> float:
        since = self.now - self.heard - self.timeout
        if self.goal is not None and self.pressed and 0.0 < since < 0.4:
            return 0.4
        return super().motor_torque()

    def step(self, dt: float) -> None:
        if not self.braking:
            self.pressed = self.contact() > 0.0
        super().step(dt)


@wrong_hand("DEX1-WDOG-01")
class LetsGoAtTheTimeOut(ReferenceService):
    """Opens a little after the time-out where it pressed on an object."""

    hand = _LetsGo


class _OldGoalFirst(ReferenceHand):
    old: Motor | None = None
    until = -math.inf

    def command(self, motor: Motor) -> None:
        if not math.isfinite(motor.q):
            return
        if self.goal is not None and self.braking:
            self.old, self.until = self.goal, self.now + 0.3
        super().command(self.old if self.old and self.now < self.until else motor)


@wrong_hand("DEX1-WDOG-03")
class OldGoalFirst(ReferenceService):
    """Carries out the command from before a silence for 0.3 s when the next ones come."""

    hand = _OldGoalFirst


class _BeginsAtZero(ReferenceHand):
    until = -math.inf

    def command(self, motor: Motor) -> None:
        if math.isfinite(motor.q) and self.goal is not None and self.braking:
            self.until = self.now + 0.2
        if self.now < self.until:
            motor = replace(motor, q=0.0 * motor.q)
        super().command(motor)


@wrong_hand("DEX1-PATH-01")
class BeginsAtZero(ReferenceService):
    """Goes towards 0 for 0.2 s when the commands come again after a silence."""

    hand = _BeginsAtZero


class _LosesTheFirst(ReferenceHand):
    until = -math.inf

    def command(self, motor: Motor) -> None:
        if self.goal is not None and self.braking and self.now > self.until + 0.5:
            self.until = self.now + 0.2
        if self.now >= self.until:
            super().command(motor)


@wrong_hand("DEX1-WDOG-05")
class LosesTheFirstAfterSilence(ReferenceService):
    """Drops commands for 0.2 s after a time-out, while the motor is switched on."""

    hand = _LosesTheFirst


@wrong_hand("DEX1-SIDE-03", dialect="unitree_actuator")
class GainsOfTheOtherSide(ReferenceService):
    """Drives the left hand by the gains of the right one."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        super().receive(topic, payload, client)
        left, right = (self.hands.get(side) for side in Side)
        if left is not None and right is not None and left.goal and right.goal:
            left.goal = replace(left.goal, kp=right.goal.kp, kd=right.goal.kd)


@wrong_hand("DEX1-STILL-01")
class TakesTheOtherSides(ReferenceService):
    """When commands arrive together, the left hand sometimes gets the right hand's command."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.turns = 0

    def command(self, side: Side, motor: Motor) -> None:
        super().command(side, motor)
        left = self.hands.get(Side.LEFT)
        if side is Side.RIGHT and left is not None and left.heard == left.now:
            self.turns += 1
            if self.turns % 50 == 0:
                super().command(Side.LEFT, motor)
