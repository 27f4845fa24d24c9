"""Wrong hands of position servos."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults.any_model import ChokesOnThousands, finite_q, other
from dexkit.conformance.faults.registry import (
    BOTH,
    DQ,
    Call,
    Motors,
    Q,
    changes,
    commands,
    has_speeds,
    reports,
    takes_floats,
    wrong_hand,
)
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import FingerHand, Ints
from dexkit.conformance.virtual.inspire import FtpHand, FtpService
from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.hand import Floats, Side
from dexkit.models import HandModel, model

_FAR = 10.0  # full travels; a goal in 16 bits is 32.8 at most

# ----------------------------------------------------------------------------- state


@wrong_hand("BRAINCO-RATE-01")
class PublishesTooRarely(ServoService):
    """Publishes at five eighths of the least rate."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.period = 1.6 / model(self.dialect.model).min_state_rate


@wrong_hand("BRAINCO-FIELD-03")
class Thousandths(ServoService):
    """Publishes q as the device has it, in thousandths."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["q"] *= 1000.0

    def positions(self, side: Side) -> tuple[float, ...]:
        return tuple(1000.0 * q for q in super().positions(side))


# with an object in one hand, the other one shows that it is held back
@wrong_hand("BRAINCO-SIDE-01", sides=BOTH)
class StatesSwapped(ServoService):
    """Publishes each side's state as the other's."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, self.hands[other(hand.side)])

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():  # each state is made when either hand has moved
            hand.version += 1

    def positions(self, side: Side) -> tuple[float, ...]:
        return super().positions(other(side))


def _one_in_twelve_is_too_few(hand: HandModel) -> bool:
    return hand.min_state_rate > 1.0 / (12 * ChokesOnThousands.period)


@wrong_hand("BRAINCO-LOAD-01", where=_one_in_twelve_is_too_few)
class ChokesOnThousandsOfCommands(ChokesOnThousands, ServoService):
    """Publishes one state in twelve while more than 1000 commands a second arrive."""

    share = 12


# ----------------------------------------------------------------------------- motion


@changes(ServoService, "motors", "BRAINCO-JOINT-01")
def OtherOrder(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys commands in the opposite order of joints, as another vendor's hand has them."""
    command(side, motors[::-1])


@commands(ServoHand, "BRAINCO-MOVE-02")
def ReversedScale(hand: Any, rows: Floats) -> None:
    """Takes the q of commands the other way round: 0 closed, 1 open."""
    rows[Q] = hand.low + hand.high - rows[Q]


@changes(ServoHand, "take", "BRAINCO-MOVE-09")
def KeepsFromTheEnds(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Stays clear of both ends of each joint's range."""
    take(rows, mode)
    away = 0.08 * (hand.high - hand.low)
    hand.goal = np.clip(hand.goal, hand.low + away, hand.high - away)


class _NeverRests(ServoHand):
    """Its mechanics are computed at rest, too."""

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@changes(_NeverRests, "move", "BRAINCO-STILL-02")
def Vibrates(hand: Any, move: Call, dt: float, pull: list[float]) -> None:
    """Shakes all joints a little, at rest as well."""
    shake = 0.2 * math.sin(2 * math.pi * 12.0 * hand.now)
    move(dt, [p + shake if on else p for p, on in zip(pull, hand.law_on, strict=True)])


@changes(_NeverRests, "move", "BRAINCO-MOVE-03", whole=True)
def Wobbles(hand: Any, move: Call, dt: float, pull: list[float]) -> None:
    """One joint oscillates about its goal."""
    if hand.law_on[2]:
        pull[2] += 0.27 * math.sin(2 * math.pi * 8.0 * hand.now)
    move(dt, pull)


@changes(ServoHand, "take", "BRAINCO-MOVE-04")
def SlowServos(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
    """Takes 0.4 of each speed that is commanded."""
    take(rows, mode)
    hand.reach = [0.4 * r for r in hand.reach]


@wrong_hand("BRAINCO-SAFE-08")
class Overshoots(ServoHand):
    """Overshoots a large step by 8 % of the travel, and returns after 0.4 s."""

    asked: Floats | None = None
    true_goal: Floats | None = None
    until = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        before = rows[Q] if self.asked is None else self.asked
        jump = np.clip(rows[Q], self.low, self.high) - np.clip(before, self.low, self.high)
        self.asked = rows[Q]
        super().take(rows, mode)
        if (np.abs(jump) > 0.1).any():
            self.true_goal, self.until = self.goal, self.now + 0.4
            beyond = self.goal + np.where(np.abs(jump) > 0.1, 0.08 * np.sign(jump), 0.0)
            self.goal = np.clip(beyond, self.low, self.high)

    def step(self, dt: float) -> None:
        if self.true_goal is not None and self.now > self.until:
            self.goal, self.true_goal = self.true_goal, None
        super().step(dt)


# ------------------------------------------------------------------------------- speeds


@commands(ServoHand, "BRAINCO-SPEED-01")
def AlwaysFast(hand: Any, rows: Floats) -> None:
    """Moves at full speed, whatever dq is."""
    rows[DQ] = 1.0


@commands(ServoHand, "BRAINCO-SPEED-02")
def ZeroIsFullSpeed(hand: Any, rows: Floats) -> None:
    """Moves at full speed where dq is 0."""
    rows[DQ] = np.where(rows[DQ] == 0.0, 1.0, rows[DQ])


@commands(ServoHand, "BRAINCO-SPEED-03")
def SpeedOfTheFirst(hand: Any, rows: Floats) -> None:
    """Moves all joints with the speed of the first one."""
    rows[DQ] = rows[DQ, 0]


@commands(ServoHand, "BRAINCO-SPEED-03")
def HalfSpeeds(hand: Any, rows: Floats) -> None:
    """Takes half of each speed below the full one."""
    rows[DQ] = np.where(rows[DQ] < 0.9, 0.5 * rows[DQ], rows[DQ])


# ------------------------------------------------------------------------------ grip


@wrong_hand("BRAINCO-GRIP-01", sides=BOTH, whole=True)
class LetsGo(ServoHand):
    """Opens after a second of full current, like a protection that trips."""

    pressed = 0.0

    def step(self, dt: float) -> None:
        closing = np.array([j.closing for j in self.model.joints[self.side]])
        stands = float((np.array(self.dq) * closing).max()) < 0.05
        presses = max(map(abs, self.tau)) > 0.8 * float(self.most.max()) and stands
        self.pressed = self.pressed + dt if presses else 0.0
        if self.pressed > 1.0:
            self.goal = np.clip(self.goal - 0.4 * closing, self.low, self.high)
            self.pressed = 0.0
            self.changed()
        super().step(dt)


@wrong_hand("BRAINCO-GRIP-01", sides=BOTH, whole=True)
class SilentUnderLoad(ServoService):
    """Publishes nothing for half a second while it grips: its device does not answer."""

    quiet = (math.inf, 0.0)
    free = 0.0

    def publish(self) -> list[Sample]:
        loaded = any(
            hand.touches and min(map(abs, hand.tau)) > 0.5 * float(hand.most.max())
            for hand in self.hands.values()
        )
        if not loaded:
            self.free = self.now
        if self.now > self.free + 1.2 and self.now > self.quiet[1] + 5.0:
            self.quiet = self.now, self.now + 0.5
        return [] if self.quiet[0] <= self.now < self.quiet[1] else super().publish()


@wrong_hand("FTP-FORCE-06", sides=BOTH, whole=True)
class ForceVanishes(_NeverRests, FtpHand):
    """Presses with a twentieth of the force after a second of contact, and does not open."""

    pressed = 0.0

    def step(self, dt: float) -> None:
        super().step(dt)
        touches = self.touches and any(abs(c) > 0.01 for c in self.contact)
        self.pressed += dt if touches else 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        self.pressed = 0.0
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, [0.05 * p for p in pull] if self.pressed > 1.0 else pull)


# --------------------------------------------------------------------------- silence


@changes(ServoHand, "expire", "BRAINCO-WDOG-01")
def OpensInSilence(hand: Any, expire: Call) -> None:
    """Opens a second after the last command."""
    expire()
    hand.goal = np.array([j.straight for j in hand.model.joints[hand.side]])


@changes(ServoHand, "expire", "BRAINCO-WDOG-04")
def GoesOnForEver(hand: Any, expire: Call) -> None:
    """Continues to its last goal without commands."""


# -------------------------------------------------------------------------- operator


@wrong_hand("BRAINCO-OPER-01", where=has_speeds)
class SmoothsGoals(ServoHand):
    """Smooths its goals over 0.15 s."""

    wanted: Floats | None = None

    def take(self, rows: Floats, mode: Ints) -> None:
        before = np.array(self.q) if self.wanted is None else self.goal
        super().take(rows, mode)
        self.wanted, self.goal = self.goal, before

    def release(self) -> None:
        self.wanted = None
        super().release()

    def expire(self) -> None:
        self.wanted = None
        super().expire()

    def step(self, dt: float) -> None:
        if self.wanted is not None:
            self.goal = self.goal + (self.wanted - self.goal) * dt / 0.15
        super().step(dt)


# ----------------------------------------------------------------------- bad commands


class _Slows(ServoHand):
    """Moves with a third of each speed since a bad command."""

    slow = False

    def bad(self, motors: Motors) -> bool:
        """Whether a command is one."""
        raise AssertionError  # overridden

    def command(self, motors: Motors) -> None:
        self.slow = self.slow or self.bad(motors)
        super().command(motors)

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.slow:
            self.reach = [0.33 * r for r in self.reach]


@changes(_Slows, "bad", "BRAINCO-ABUSE-01", where=takes_floats)
def SlowAfterNan(hand: Any, bad: Call, motors: Motors) -> bool:
    """Moves with a third of each speed since it has got a command that is not finite."""
    return not finite_q(motors)


@changes(_Slows, "bad", "FTP-ABUSE-01")
def SlowAfterFar(hand: Any, bad: Call, motors: Motors) -> bool:
    """Moves with a third of its speed since it has got a goal that is far out of range."""
    return not finite_q(motors) or any(abs(m.q) > _FAR for m in motors)


@changes(ServoService, "motors", "FTP-MOVE-08", whole=True)
def DeafAfterOutOfRange(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Ignores commands for 1.2 s after one whose goal is far out of range."""
    if any(abs(m.q) > _FAR for m in motors):
        self.memory[side] = self.now + 1.2
    if self.now >= self.memory.get(side, 0.0):
        command(side, motors)


# -------------------------------------------------------------------- forces that are reported


class _Feels(ServoHand):
    """Counts the seconds in which it touches the object."""

    grip = 0.0
    off = 9.0

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.touches and max(map(abs, self.contact)) > 0.02 and not self.free():
            self.grip, self.off = self.grip + dt, 0.0
            self.version += 1  # a fault depends on the time
            return
        self.off += dt
        if self.off > 0.3:
            self.grip = 0.0

    def free(self) -> bool:
        """Whether no joint is where the object is."""
        pairs = zip(self.q, self.floor, self.ceiling, self.low, self.high, strict=True)
        return not any((lo > a and q < lo) or (hi < b and q > hi) for q, lo, hi, a, b in pairs)


class _FeelingService(ServoService):
    hand_fault: Any = _Feels


@reports(_FeelingService, "BRAINCO-FORCE-01", sides=BOTH)
def ForceAgainstClosing(self: Any, motors: Any, hand: Any) -> None:
    """Reports the force of a grip with the other sign."""
    if hand.grip > 0.0:
        motors["tau_est"] *= -1.0


@reports(_FeelingService, "BRAINCO-FORCE-01", sides=BOTH)
def ForceZeroedInGrip(self: Any, motors: Any, hand: Any) -> None:
    """Sets its forces to zero half a second after it has touched."""
    if hand.grip > 0.5:
        motors["tau_est"] = 0.0


@reports(ServoService, "BRAINCO-FORCE-01", sides=BOTH)
def ForceOfNextJoint(self: Any, motors: Any, hand: Any) -> None:
    """Reports each force as its neighbour's."""
    motors["tau_est"] = np.roll(motors["tau_est"], 1)


@reports(ServoService, "BRAINCO-FORCE-04", sides=BOTH, whole=True)
def ForceKept(self: Any, motors: Any, hand: Any) -> None:
    """Keeps the largest force of each joint for ever."""
    tau = np.array(motors["tau_est"])
    kept = self.memory.setdefault(hand.side, np.zeros(len(hand.q)))
    kept[:] = np.where(np.abs(tau) > np.abs(kept), tau, kept)
    motors["tau_est"] = kept


@wrong_hand("BRAINCO-FORCE-05", sides=BOTH)
class ForceBacksOff(_Feels):
    """Takes its goals back to a seventh of the force as soon as it touches."""

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.grip > 0.2:
            closing = [j.closing for j in self.model.joints[self.side]]
            ahead = zip(self.place, self.q, closing, strict=True)
            self.place = [q + c * min(c * (p - q), 0.015) for p, q, c in ahead]
            self.law_q = list(self.place)
            self.rests = False


class _Weak(_Feels):
    """Presses with a part of its force, at times."""

    weak = False
    part = 0.15

    def is_weak(self) -> bool:
        """Whether it does so now."""
        return False

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.is_weak() != self.weak:
            self.weak = not self.weak
            self.changed()

    def changed(self) -> None:
        super().changed()
        if self.weak:
            self.law_kp = [self.part * k for k in self.law_kp]


@wrong_hand("FTP-FORCE-05", sides=BOTH, whole=True)
@changes(_Weak, "is_weak", "BRAINCO-FORCE-05", sides=BOTH)
def ForceGivesUp(hand: Any, is_weak: Call) -> bool:
    """Presses with a seventh of its force after a second of a grip."""
    return bool(hand.grip > 1.0)


@wrong_hand("BRAINCO-FORCE-05", sides=BOTH, whole=True)
class WeakAfterRestart(_FeelingService):
    """Presses with a seventh of its force after a restart of the service."""

    hand_fault = _Weak

    def take_over(self, before: Any) -> None:
        super().take_over(before)
        for hand in self.hands.values():
            hand.is_weak = lambda hand=hand: hand.grip > 0.0  # type: ignore[attr-defined]


class _WeakForOthers(_Weak):
    part = 0.3
    other_client = False

    def is_weak(self) -> bool:
        return self.other_client


@wrong_hand("FTP-FORCE-05", sides=BOTH, whole=True)
class WeakForNewClients(_FeelingService):
    """Presses with less than half of its force since a second program has commanded it."""

    hand_fault = _WeakForOthers

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client:
            for hand in self.hands.values():
                hand.other_client = True  # type: ignore[attr-defined]
        super().receive(topic, payload, client)


# ----------------------------------------------------------------------------- tactile areas


class _FeelingFtp(FtpService):
    hand_fault = _Feels


@changes(_FeelingFtp, "touch", "FTP-TOUCH-05", sides=BOTH)
def TouchStopsInGrip(self: Any, touch: Call) -> list[Sample]:
    """Publishes no touch from 0.4 s of a grip on."""
    quiet = [self.touch_topic(s) for s in self.sides if self.hands[s].grip > 0.4]
    return [sample for sample in touch() if sample.topic not in quiet]


@changes(_FeelingFtp, "touched", "FTP-TOUCH-05", sides=BOTH)
def TouchZeroedInGrip(self: Any, touched: Call, side: Side) -> Any:
    """Sets its tactile areas to zero 0.3 s after it has touched."""
    hand = self.hands[side]
    contact = hand.contact
    if hand.grip > 0.3:
        hand.contact = [0.0] * len(contact)
    message = touched(side)
    hand.contact = contact
    return message


@changes(FtpService, "pressures", "FTP-TOUCH-05", sides=BOTH)
def TouchKept(self: Any, pressures: Call, hand: FingerHand) -> Any:
    """Keeps the largest reading of each element for ever."""
    pressure = pressures(hand)
    self.memory[hand.side] = np.maximum(self.memory.get(hand.side, pressure), pressure)
    return self.memory[hand.side]


# ---------------------------------------------------------------- after silences and restarts


@wrong_hand("BRAINCO-WDOG-03")
class LateAfterSilence(ServoService):
    """Obeys commands 0.55 s late for half a second after a silence."""

    heard = slow_until = 0.0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.mail: list[tuple[float, Side, Motors]] = []

    def motors(self, side: Side, motors: Motors) -> None:
        if self.heard and self.now - self.heard > 1.0:
            self.slow_until = self.now + 0.5
        self.heard = self.now
        late = 0.55 if self.now < self.slow_until else 0.0
        self.mail.append((self.now + late, side, motors))

    def live(self, dt: float) -> None:
        while self.mail and self.mail[0][0] <= self.now:
            super().motors(*self.mail.pop(0)[1:])
        super().live(dt)

    def brake(self) -> None:
        self.mail.clear()
        super().brake()


class _OfClient(ServoService):
    """Knows whose command it takes."""

    client = 0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.client = client
        super().receive(topic, payload, client)


class _SwapsSome(_OfClient):
    """Takes the goals of its third and fifth joint for each other, at times."""

    def swaps(self) -> bool:
        """Whether it does so now."""
        raise AssertionError  # overridden

    def motors(self, side: Side, motors: Motors) -> None:
        if self.swaps():
            order = (0, 1, 4, 3, 2, *range(5, len(motors)))
            motors = tuple(motors[i] for i in order)
        super().motors(side, motors)


@changes(_SwapsSome, "swaps", "BRAINCO-LIFE-02", whole=True)
def SwapsForNewClients(self: Any, swaps: Call) -> bool:
    """Mixes two joints up in the commands of a restarted client."""
    return 0 < self.client < 1000 and not self.restarted


@changes(_SwapsSome, "swaps", "BRAINCO-LIFE-03", whole=True)
def SwapsAfterRestart(self: Any, swaps: Call) -> bool:
    """Mixes two joints up in commands after a restart of the service."""
    return bool(self.restarted)


@changes(_SwapsSome, "swaps", "BRAINCO-WDOG-03", whole=True)
def SwapsAfterSilence(self: Any, swaps: Call) -> bool:
    """Mixes two joints up in commands for three seconds after a silence."""
    heard, until = self.memory.get("heard", 0.0), self.memory.get("until", 0.0)
    if heard and self.now - heard > 0.5:
        until = self.now + 3.0
    self.memory.update(heard=self.now, until=until)
    return bool(self.now < until)


@wrong_hand("BRAINCO-STILL-01", sides=BOTH, whole=True)
class OldClientReturns(ServoService):
    """Obeys the earlier client's last goals on the left for a quarter of each second."""

    client = 0
    since = 0.0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.last: dict[Side, Motors] = {}
        self.earlier: dict[Side, Motors] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client < 1000 and client != self.client:
            self.client, self.earlier, self.since = client, dict(self.last), self.now
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: Motors) -> None:
        self.last[side] = motors
        if side is Side.LEFT and (self.now - self.since) % 1.0 > 0.75:
            motors = self.earlier.get(side, motors)
        super().motors(side, motors)


@changes(_OfClient, "motors", "BRAINCO-SPEED-03", whole=True)
def OneSpeedForNewClients(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Moves all joints with the largest speed of a restarted client's command."""
    if 0 < self.client < 1000:
        most = max(m.dq for m in motors)
        motors = tuple(replace(m, dq=most) for m in motors)
    command(side, motors)
