"""Wrong grippers.

Where a fault is in the left hand alone, the object would hold the right one away from 0.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from dexkit.conformance.faults.registry import BOTH, LEFT, Call, changes, reports, wrong_hand
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual import TopicDevice
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Side

# ----------------------------------------------------------------------------------- fields


@reports(ReferenceService, "DEX1-FIELD-01")
def NanVelocity(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Divides by a time step of zero at rest."""
    state["dq"] = state["dq"] or math.nan


@reports(ReferenceService, "DEX1-FIELD-21", whole=True)
def ShowsTheGoalNearIt(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes the commanded q within 3.5 % of the stroke from it."""
    if hand.goal is not None and abs(hand.goal.q - state["q"]) < 0.035 * hand.stroke:
        state["q"] = hand.goal.q


class _InUnit(ReferenceService):
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

    def fields(self, side: Side) -> dict[str, Any]:
        found = super().fields(side)
        if self.publishes:
            found.update({name: self.scale * found[name] for name in ("q", "dq", "ddq")})
        return found


@wrong_hand("DEX1-FIELD-03")
class Percent(_InUnit):
    """Publishes percent of the stroke instead of radians."""

    takes = False


@wrong_hand("DEX1-MOVE-02")
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


@changes(PercentBothWays, "command", "DEX1-FIELD-15", sides=LEFT)
def PercentWithin(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Obeys and publishes percent, after it has clamped q to 0 to 5.4."""
    q = min(max(motor.q, 0.0), self.dialect.q_open) if math.isfinite(motor.q) else motor.q
    command(side, replace(motor, q=q))


@wrong_hand("DEX1-FIELD-03", sides=LEFT, whole=True)
class DegreesBothWays(_OtherScale):
    """Obeys and publishes degrees; starts nearly closed, in the range of radians."""

    full = math.degrees(5.4)


@wrong_hand("DEX1-MOVE-02")
class Normalised(_InUnit):
    """Publishes 0 to 1 instead of radians."""

    full = 1.0
    takes = False


@wrong_hand("DEX1-MOVE-02")
class NormalisedCommands(_InUnit):
    """Obeys q as 0 to 1 instead of radians."""

    full = 1.0
    publishes = False


@wrong_hand("DEX1-MOVE-02")
class NormalisedBothWays(_InUnit):
    """Obeys and publishes 0 to 1 instead of radians."""

    full = 1.0


@wrong_hand("DEX1-MOVE-02")
class Metres(_InUnit):
    """Obeys and publishes the opening in metres instead of radians."""

    full = 0.09


@reports(ReferenceService, "DEX1-FIELD-17")
def VelocityWhileOpening(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Fills dq only while it opens."""
    state["dq"] = max(state["dq"], 0.0)


# --------------------------------------------------------------------- consistency of the state


@reports(ReferenceService, "DEX1-FIELD-15")
def JumpsOnce(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Has no dq, and publishes one q that is 30 % of the stroke off."""
    state["dq"] = state["ddq"] = 0.0
    if 0.5 <= self.now < 0.5 + self.period:
        state["q"] += 0.3 * self.dialect.q_open


@reports(ReferenceService, "DEX1-FIELD-17")
def ShiftsForAWhile(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes q with an offset of 8 % of the stroke for 0.4 s; its dq stays true."""
    state["q"] += 0.08 * self.dialect.q_open if 0.4 <= self.now < 0.8 else 0.0
    state["ddq"] = 0.0


@wrong_hand("DEX1-SIDE-02", whole=True)
class GoesThroughTheObject(ReferenceHand):
    """In contact the published q, and dq with it, continues to the command."""

    speed = 0.4  # rad/s
    off = rate = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.braking:
            self.rate = 0.0
            return
        inside = self.touch is not None and self.q < self.touch
        wanted = self.goal.q - self.q if inside and self.goal is not None else 0.0
        step = min(max(wanted - self.off, -self.speed * dt), self.speed * dt)
        self.off += step
        self.rate = step / dt

    def fields(self) -> dict[str, float]:
        found = super().fields()
        q, dq = found["q"] + self.off, found["dq"] + self.rate
        return {**found, "q": q, "dq": dq, "ddq": 0.0}


@reports(ReferenceService, "DEX1-FIELD-05")
def OtherRobotsMode(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes the mode byte of an H1's motors, 0x0A."""
    state["mode"] = 0x0A


@reports(ReferenceService, "DEX1-FIELD-05")
def AlwaysDriven(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes mode 1, driven, all the time."""
    state["mode"] = 1


@reports(ReferenceService, "DEX1-FIELD-08")
def HotByte(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes 200 degrees Celsius: a raw register as the temperature."""
    state["temperature"] = 200


@reports(ReferenceService, "DEX1-FIELD-08")
def HotAtStart(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes 90 degrees Celsius until it gets its first command."""
    if not hand.goal:
        state["temperature"] = 90


@reports(ReferenceService, "DEX1-FIELD-11", dialect="unitree_hg")
def Millivolts(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes vol in millivolts."""
    state["vol"] = 12000.0


@reports(ReferenceService, "DEX1-FIELD-12", dialect="unitree_hg")
def StatusInMotorstate(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes a status word as the motor's faults."""
    state["motorstate"] = 3


@wrong_hand("DEX1-START-01", sides=LEFT, dialect="unitree_actuator")
class RestsAtZero(ReferenceHand):
    """Rests exactly at 0, in both hands."""

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(stroke, touch)
        self.q = 0.0


# ----------------------------------------------------------------------------------- motion


@changes(ReferenceService, "command", "DEX1-MOVE-02")
def Inverted(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Uses 0 as open."""
    command(side, replace(motor, q=self.dialect.q_open - motor.q, dq=-motor.dq))


@changes(ReferenceService, "command", "DEX1-MOVE-02")
def OtherScale(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Scales commands as if fully open were 2 pi."""
    command(side, replace(motor, q=motor.q * 5.4 / (2 * math.pi)))


@changes(ReferenceHand, "motor_torque", "DEX1-MOVE-03", whole=True)
def Hunts(hand: Any, torque: Call) -> float:
    """Oscillates about its goal."""
    held = hand.goal is not None and hand.goal.kp > 0 and not hand.braking
    shake = 0.8 * math.sin(2 * math.pi * 8.0 * hand.now) if held else 0.0
    return float(torque() + shake)


@wrong_hand("DEX1-MOVE-04")
class Slow(ReferenceHand):
    """Moves at 2.6 rad/s at most."""

    top = 2.6

    def motor_torque(self) -> float:
        goal = self.goal
        if goal is None or goal.kp <= 0:
            return super().motor_torque()
        # a velocity loop below the position loop
        wanted = min(max(12.0 * (goal.q - self.q), -self.top), self.top)
        tau = min(max(0.5 * (wanted - self.dq) + self.viscous * wanted, -2.0), 2.0)
        return tau * (not self.braking)


@wrong_hand("DEX1-FORCE-11")
class Creeps(ReferenceHand):
    """Moves the last 3 mm to its goal slowly."""

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


@changes(ReferenceService, "command", "DEX1-MOVE-08")
def ShortStroke(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Stays 5 % of the stroke away from its stops."""
    low, high = 0.05 * self.dialect.q_open, 0.95 * self.dialect.q_open
    q = min(max(motor.q, low), high) if math.isfinite(motor.q) else motor.q
    command(side, replace(motor, q=q))


@changes(ReferenceService, "command", "DEX1-SIDE-01")
def Coupled(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """The left hand's goal leaks into the right hand's."""
    if side is Side.LEFT and math.isfinite(motor.q) and abs(motor.q) < 10:
        self.memory["left"] = motor.q
    elif side is Side.RIGHT:
        motor = replace(motor, q=motor.q + 0.05 * (self.memory.get("left", 0.0) - 2.7))
    command(side, motor)


@changes(ReferenceHand, "accept", "DEX1-GAIN-01", whole=True)
def IgnoresGains(hand: Any, accept: Call, motor: Motor) -> Any:
    """Moves to q with any gains."""
    return accept(Motor(q=motor.q))


@changes(ReferenceHand, "accept", "DEX1-GAIN-02")
def DeafToVelocity(hand: Any, accept: Call, motor: Motor) -> Any:
    """Ignores dq without a position gain."""
    accepted = accept(motor)
    return accepted if accepted.kp > 0 else replace(accepted, dq=0.0)


@changes(ReferenceHand, "accept", "DEX1-GAIN-02")
def TurnedVelocityCommand(hand: Any, accept: Call, motor: Motor) -> Any:
    """Obeys dq with the wrong sign where there is no position gain."""
    accepted = accept(motor)
    return accepted if accepted.kp > 0 else replace(accepted, dq=-accepted.dq)


@changes(ReferenceHand, "accept", "DEX1-GAIN-08")
def SpeedModeByDq(hand: Any, accept: Call, motor: Motor) -> Any:
    """Selects its speed mode by a dq other than 0: q is not used then."""
    accepted = accept(motor)
    return replace(accepted, kp=0.0) if accepted.dq else accepted


@changes(ReferenceHand, "motor_torque", "DEX1-GAIN-08")
def LimitsByTau(hand: Any, torque: Call) -> float:
    """Takes tau of a command for the limit of its torque."""
    goal = hand.goal
    if goal is None or not goal.tau:
        return float(torque())
    most, hand.goal = abs(goal.tau), replace(goal, tau=0.0)
    tau = torque()
    hand.goal = goal
    return float(min(max(tau, -most), most))


@changes(ReferenceHand, "accept", "DEX1-FORCE-15", sides=BOTH, whole=True)
def KeepsGainsAtTheSamePlace(hand: Any, accept: Call, motor: Motor) -> Any:
    """Ignores gains of 0 if q has not changed."""
    accepted, before = accept(motor), hand.goal
    if before is not None and accepted.kp == 0.0 and accepted.q == before.q:
        return replace(accepted, kp=before.kp, kd=before.kd)
    return accepted


# ------------------------------------------------------------------------------------ force


@wrong_hand("DEX1-FORCE-11", sides=BOTH)
class GripsHarderWhenSoft(ReferenceHand):
    """Mistakes a softer grip for slip, and doubles its force until it lets go."""

    gripped = False

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        soft = self.goal is not None and 0.0 < self.goal.kp < 5.0
        self.gripped = self.contact() != 0.0 and (self.gripped or soft)
        return max(min((2.0 if self.gripped else 1.0) * tau, self.tau_max), -self.tau_max)


@changes(ReferenceHand, "accept", "DEX1-GAIN-03")
def DeafToTorque(hand: Any, accept: Call, motor: Motor) -> Any:
    """Ignores the torque of a command."""
    return replace(accept(motor), tau=0.0)


@changes(ReferenceHand, "accept", "DEX1-GAIN-03")
def UnsignedTorque(hand: Any, accept: Call, motor: Motor) -> Any:
    """Opens with the torque of a command, whatever its sign is."""
    return replace(accept(motor), tau=abs(motor.tau))


@changes(ReferenceHand, "accept", "DEX1-GAIN-03", dialect="unitree_actuator")
def TurnedTorque(hand: Any, accept: Call, motor: Motor) -> Any:
    """Obeys the torque of a command with the wrong sign, in one dialect."""
    accepted = accept(motor)
    return replace(accepted, tau=-accepted.tau)


@changes(ReferenceHand, "accept", "DEX1-GAIN-03")
def TurnedTorqueWhileHeld(hand: Any, accept: Call, motor: Motor) -> Any:
    """Obeys the torque of a command with the wrong sign where a position gain holds it."""
    accepted = accept(motor)
    return replace(accepted, tau=-accepted.tau) if accepted.kp > 0 else accepted


@changes(ReferenceService, "command", "DEX1-GAIN-03", sides=BOTH)
def TorqueOfTheOtherSide(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Adds the torque that the other gripper is commanded."""
    if math.isfinite(motor.tau):
        self.memory[side] = motor.tau
        (other,) = (s for s in self.sides if s != side)
        motor = replace(motor, tau=self.memory.get(other, 0.0))
    command(side, motor)


@reports(ReferenceService, "DEX1-FORCE-02")
def ForceAtRest(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Reports the holding current as force, while it is driven."""
    if not hand.braking:
        state["tau_est"] -= 0.4


@reports(ReferenceService, "DEX1-FORCE-03")
def UnsignedForce(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Reports the magnitude of the force."""
    state["tau_est"] = abs(state["tau_est"])


@reports(ReferenceService, "DEX1-FORCE-03", whole=True)
def SignTurns(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes tau_est with the other sign from 5 s on: its motor was enabled again."""
    if self.now > 5.0:
        state["tau_est"] = -state["tau_est"]


@wrong_hand("DEX1-FORCE-10", sides=BOTH)
class ChatteringLimit(ReferenceHand):
    """After 1.5 s of a grip its thermal limit takes the force away for a third of the time."""

    load = 0.0

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return 0.1 * tau if self.load > 1.5 and int(self.now / 0.03) % 3 == 0 else tau

    def step(self, dt: float) -> None:
        super().step(dt)
        pressing = self.touch is not None and self.q < self.touch + 0.1
        self.load = self.load + dt if pressing else 0.0


@wrong_hand("DEX1-FORCE-10", sides=BOTH, whole=True)
class SecondGripWeak(ReferenceHand):
    """Pushes with 0.4 N m at most towards closing after the first long grip has ended."""

    held, let_go = 0.0, False

    def motor_torque(self) -> float:
        tau = super().motor_torque()
        return max(tau, -0.4) if self.let_go else tau

    def step(self, dt: float) -> None:
        super().step(dt)
        pressing = self.touch is not None and self.q < self.touch and self.tau < -0.5
        self.let_go |= self.held > 2.0 and not pressing
        self.held = self.held + dt if pressing else 0.0


@changes(ReferenceService, "command", "DEX1-MOVE-08", dialect="unitree_hg")
def NoDeadZones(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """Goes to every q as it is, without the zones that mean fully open and closed."""
    self.hands[side].command(Motor(q=motor.q) if math.isfinite(motor.q) else motor)


@reports(ReferenceService, "DEX1-FORCE-04", dialect="unitree_hg")
def SignedForce(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Publishes the signed torque where the strength of the grip is expected."""
    state["tau_est"] = hand.tau


@reports(ReferenceService, "DEX1-FORCE-10")
def FeelsLate(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Reports the force of a contact only when it has lasted for 0.9 s."""
    if hand.touch is None or hand.q > hand.touch:
        self.memory[hand] = self.now
    if self.now - self.memory.get(hand, 0.0) <= 0.9:
        state["tau_est"] = 0.0


@reports(ReferenceService, "DEX1-LIFE-06")
def ForceBeforeCommands(self: Any, state: Any, hand: ReferenceHand) -> None:
    """Reports a force until it gets its first command."""
    if not hand.goal:
        state["tau_est"] = -0.6


@changes(ReferenceHand, "accept", "DEX1-FORCE-09")
def StiffnessSaturates(hand: Any, accept: Call, motor: Motor) -> Any:
    """Has a kp of 2 N m/rad at most."""
    accepted = accept(motor)
    return replace(accepted, kp=min(accepted.kp, 2.0))


@changes(ReferenceHand, "motor_torque", "DEX1-FORCE-18")
def BoostsWhereItIsBlocked(hand: Any, torque: Call) -> float:
    """Presses with twice the torque that it was commanded."""
    tau = float(torque())
    if hand.contact() > 0.0 and not hand.braking:
        return float(min(max(2.0 * tau, -hand.tau_max), hand.tau_max))
    return tau


@changes(
    ReferenceHand, "motor_torque", "DEX1-FORCE-18", dialect="unitree_hg", sides=BOTH, whole=True
)
def BoostsByItsOwnGains(hand: Any, torque: Call) -> float:
    """Presses with two and a half times the torque of its own gains where it is blocked."""
    return float(torque()) * (2.6 if hand.contact() > 0.0 else 1.0)


@wrong_hand("DEX1-FORCE-18", dialect="unitree_hg", sides=BOTH, whole=True)
class HoldingCurrent(ReferenceHand):
    """Holds an object with a third of the torque from 0.3 s on, as the driver of a stepper does."""

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


@wrong_hand("DEX1-FORCE-09")
class WeakAgain(ReferenceHand):
    """Presses with 40 % of the force from its second contact on."""

    contacts = 0
    touching = False

    def motor_torque(self) -> float:
        tau, touches = super().motor_torque(), self.contact() > 0.0
        self.contacts += touches and not self.touching
        self.touching = touches
        return 0.4 * tau if touches and self.contacts > 1 else tau


# ----------------------------------------------------------------------------------- safety


@changes(ReferenceHand, "accept", "DEX1-SAFE-10")
def NegativeGains(hand: Any, accept: Call, motor: Motor) -> Any:
    """Applies negative gains."""
    return replace(accept(motor), kp=motor.kp, kd=motor.kd)


@changes(ReferenceHand, "accept", "DEX1-SAFE-10")
def NegativeStiffnessAlone(hand: Any, accept: Call, motor: Motor) -> Any:
    """Clamps gains that are both negative, and applies a negative kp beside a good kd."""
    accepted = accept(motor)
    return replace(accepted, kp=motor.kp) if motor.kd >= 0.0 else accepted


@wrong_hand("DEX1-SAFE-02", whole=True)
class NoLimits(ReferenceHand):
    """Follows a q far outside the stroke."""

    def accept(self, motor: Motor) -> Motor:
        return replace(super().accept(motor), q=motor.q)

    def contact(self) -> float:
        return super().contact() if abs(self.dq) < 2.0 and -0.5 < self.q < 6.0 else 0.0


@changes(ReferenceHand, "command", "DEX1-SAFE-01")
def InfiniteGains(hand: Any, command: Call, motor: Motor) -> None:
    """Clamps kp before it checks that it is finite."""
    command(replace(motor, kp=min(motor.kp, 1e3)))


# ---------------------------------------------------------------------------------- time-out


@wrong_hand("DEX1-WDOG-01")
class NoWatchdog(ReferenceHand):
    """Follows the last command without end."""

    timeout = math.inf


@wrong_hand("DEX1-WDOG-01", sides=BOTH)
class BrakesLate(ReferenceHand):
    """Brakes 1.38 s after the last command: its watchdog counts a slower clock's ticks."""

    timeout = 1.38 * ReferenceHand.timeout


@wrong_hand("DEX1-WDOG-01")
class BrakesEarly(ReferenceHand):
    """Brakes 0.6 s after the last command."""

    timeout = 0.6 * ReferenceHand.timeout


@changes(ReferenceHand, "command", "DEX1-WDOG-04")
def FedByRejected(hand: Any, command: Call, motor: Motor) -> None:
    """Does not brake while commands arrive that it rejects."""
    command(motor)
    hand.heard = hand.now


@wrong_hand("DEX1-WDOG-01")
class BrakesOnce(ReferenceHand):
    """Brakes at the first time-out and at none after it."""

    braked = 0.0

    @property
    def braking(self) -> bool:
        if self.goal is None or self.now - self.heard <= self.timeout:
            return self.goal is None
        self.braked = self.braked or self.now
        return self.now - self.braked < 2.0


@changes(ReferenceService, "begin", "DEX1-WDOG-01")
def NoWatchdogWhenRestarted(self: Any, begin: Call, now: float) -> None:
    """Follows the last command without end after a restart of its service."""
    begin(now)
    for hand in self.hands.values():
        hand.timeout = math.inf


@wrong_hand("DEX1-WDOG-01")
class SnapsOpenAtTheTimeOut(ReferenceHand):
    """Opens after the time-out and then brakes: it drops its object."""

    timeout = ReferenceHand.timeout + 0.15

    def motor_torque(self) -> float:
        if self.now - self.heard > ReferenceHand.timeout and not self.braking:
            return self.tau_max
        return super().motor_torque()


@changes(ReferenceHand, "command", "DEX1-WDOG-03", whole=True)
def SleepsAfterSilence(hand: Any, command: Call, motor: Motor) -> None:
    """Ignores commands for a while after a silence."""
    until = hand.memory.get("deaf", -math.inf)
    if hand.goal is not None and hand.braking:
        until = hand.memory["deaf"] = max(until, hand.heard + 3.0)
    if hand.now >= until:
        command(motor)


@wrong_hand("DEX1-WDOG-03")
class LatchesTheBrake(ReferenceHand):
    """Brakes after a silence and never releases."""

    tripped = False

    @property
    def braking(self) -> bool:
        if self.goal is not None and self.now - self.heard > self.timeout:
            self.tripped = True
        return self.tripped or super().braking


# ------------------------------------------------------- for long, softly, and after a silence


class _Presses(ReferenceHand):
    """Counts the seconds in which it presses."""

    seconds = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        self.seconds = self.seconds + dt if self.contact() > 0.0 and not self.braking else 0.0


@changes(_Presses, "motor_torque", "DEX1-FORCE-10")
def GripFades(hand: Any, torque: Call) -> float:
    """Presses with half of the force after three seconds of contact."""
    return float(torque() * (1.0 - 0.5 * min(max(hand.seconds - 2.0, 0.0), 1.0)))


@changes(_Presses, "motor_torque", "DEX1-FORCE-10")
def GripGrows(hand: Any, torque: Call) -> float:
    """Presses harder and harder, up to twice what was commanded."""
    tau = torque() * (1.0 + 0.5 * min(hand.seconds, 2.0))
    return float(min(max(tau, -hand.tau_max), hand.tau_max))


@wrong_hand("DEX1-GAIN-05")
class SleepsWhileHeld(ReferenceHand):
    """Switches its motor off when the goal has been the same for three seconds."""

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


@changes(ReferenceHand, "accept", "DEX1-GAIN-05")
def StiffnessSaturatesInTheFree(hand: Any, accept: Call, motor: Motor) -> Any:
    """Has a kp of 2.5 N m/rad at most without an object between the jaws."""
    accepted = accept(motor)
    return replace(accepted, kp=min(accepted.kp, 2.5)) if hand.touch is None else accepted


@changes(ReferenceHand, "accept", "DEX1-GAIN-04")
def SoftIsLimp(hand: Any, accept: Call, motor: Motor) -> Any:
    """Treats a kp below 1 N m/rad as 0 without an object between the jaws."""
    accepted = accept(motor)
    return replace(accepted, kp=0.0) if accepted.kp < 1.0 and hand.touch is None else accepted


@changes(ReferenceHand, "accept", "DEX1-FORCE-11")
def SoftGripIsLimp(hand: Any, accept: Call, motor: Motor) -> Any:
    """Scales a kp below 1 N m/rad down, in the hand with an object."""
    accepted = accept(motor)
    limp = accepted.kp < 1.0 and hand.touch is not None
    return replace(accepted, kp=0.1 * accepted.kp) if limp else accepted


@wrong_hand("DEX1-LIFE-06")
class KeepsItsGoal(ReferenceService):
    """Applies the last command of the previous service when it starts."""

    kept: dict[Side, Motor]

    def brake(self) -> None:
        self.kept = {side: hand.goal for side, hand in self.hands.items() if hand.goal}
        super().brake()

    def take_over(self, before: TopicDevice) -> None:
        super().take_over(before)
        self.kept = before.kept  # type: ignore[attr-defined]

    def begin(self, now: float) -> None:
        super().begin(now)
        for side, motor in self.kept.items():
            self.hands[side].command(motor)


@wrong_hand("DEX1-WDOG-01")
class WatchdogWraps(ReferenceHand):
    """Releases the brake for a second every three seconds: its counter wraps."""

    wraps = 3.0

    @property
    def braking(self) -> bool:
        return self.goal is None or (self.now - self.heard) % self.wraps > self.timeout


@wrong_hand("DEX1-WDOG-01")
class LetsGoAtTheTimeOut(ReferenceHand):
    """Opens a little after the time-out where it pressed on an object."""

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


@wrong_hand("DEX1-WDOG-03")
class OldGoalFirst(ReferenceHand):
    """Carries out the command from before a silence for 0.3 s when the next ones come."""

    old: Motor | None = None
    until = -math.inf

    def command(self, motor: Motor) -> None:
        if not math.isfinite(motor.q):
            return
        if self.goal is not None and self.braking:
            self.old, self.until = self.goal, self.now + 0.3
        super().command(self.old if self.old and self.now < self.until else motor)


@wrong_hand("DEX1-PATH-01")
class BeginsAtZero(ReferenceHand):
    """Goes towards 0 for 0.2 s when the commands come again after a silence."""

    until = -math.inf

    def command(self, motor: Motor) -> None:
        if math.isfinite(motor.q) and self.goal is not None and self.braking:
            self.until = self.now + 0.2
        if self.now < self.until:
            motor = replace(motor, q=0.0 * motor.q)
        super().command(motor)


@changes(ReferenceService, "receive", "DEX1-SIDE-03", dialect="unitree_actuator")
def GainsOfTheOtherSide(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Drives the left hand by the gains of the right one."""
    receive(topic, payload, client)
    left, right = (self.hands.get(side) for side in Side)
    if left is not None and right is not None and left.goal and right.goal:
        left.goal = replace(left.goal, kp=right.goal.kp, kd=right.goal.kd)


@changes(ReferenceService, "command", "DEX1-STILL-01")
def TakesTheOtherSides(self: Any, command: Call, side: Side, motor: Motor) -> None:
    """When commands arrive together, the left hand sometimes gets the right hand's command."""
    command(side, motor)
    left = self.hands.get(Side.LEFT)
    if side is Side.RIGHT and left is not None and left.heard == left.now:
        self.memory["turns"] = turns = self.memory.get("turns", 0) + 1
        if turns % 50 == 0:
            command(Side.LEFT, motor)
