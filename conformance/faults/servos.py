"""Wrong hands of position servos."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults.any_model import ChokesOnThousands
from dexkit.conformance.faults.registry import BOTH, has_speeds, takes_floats, wrong_hand
from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.virtual import Sample
from dexkit.conformance.virtual.fingers import FingerHand, Ints
from dexkit.conformance.virtual.inspire import FtpService
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


@wrong_hand("BRAINCO-SIDE-01", sides=BOTH)
class StatesSwapped(ServoService):
    """Publishes each side's state as the other's."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        other = Side.LEFT if hand.side is Side.RIGHT else Side.RIGHT
        super().fill(motors, self.hands[other])

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():  # each state is made when either hand has moved
            hand.version += 1

    def positions(self, side: Side) -> tuple[float, ...]:
        return super().positions(Side.LEFT if side is Side.RIGHT else Side.RIGHT)


def _one_in_twelve_is_too_few(hand: HandModel) -> bool:
    return hand.min_state_rate > 1.0 / (12 * ChokesOnThousands.period)


@wrong_hand("BRAINCO-LOAD-01", where=_one_in_twelve_is_too_few)
class ChokesOnThousandsOfCommands(ChokesOnThousands, ServoService):
    """Publishes one state in twelve while more than 1000 commands a second arrive."""

    share = 12


# ----------------------------------------------------------------------------- motion


@wrong_hand("BRAINCO-JOINT-01")
class OtherOrder(ServoService):
    """Obeys commands in the opposite order of joints, as another vendor's hand has them."""

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        super().motors(side, motors[::-1])


class _Reversed(ServoHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        turned = rows.copy()
        turned[0] = self.low + self.high - rows[0]
        super().take(turned, mode)


@wrong_hand("BRAINCO-MOVE-01")
class ReversedScale(ServoService):
    """Takes the q of commands the other way round: 0 closed, 1 open."""

    hand_fault = _Reversed


class _Shy(ServoHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        away = 0.08 * (self.high - self.low)
        self.goal = np.clip(self.goal, self.low + away, self.high - away)


@wrong_hand("BRAINCO-MOVE-09")
class KeepsFromTheEnds(ServoService):
    """Stays clear of both ends of each joint's range."""

    hand_fault = _Shy


class _Shakes(ServoHand):
    def move(self, dt: float, pull: list[float]) -> None:
        shake = 0.2 * math.sin(2 * math.pi * 12.0 * self.now)
        super().move(dt, [p + shake if on else p for p, on in zip(pull, self.law_on, strict=True)])

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@wrong_hand("BRAINCO-STILL-02")
class Vibrates(ServoService):
    """Shakes all joints a little, at rest as well."""

    hand_fault = _Shakes


class _Wobbles(ServoHand):
    def move(self, dt: float, pull: list[float]) -> None:
        if self.law_on[2]:
            pull[2] += 0.27 * math.sin(2 * math.pi * 8.0 * self.now)
        super().move(dt, pull)

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)


@wrong_hand("BRAINCO-MOVE-03", whole=True)
class Wobbles(ServoService):
    """One joint oscillates about its goal."""

    hand_fault = _Wobbles


class _Lazy(ServoHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.reach = [0.4 * r for r in self.reach]


@wrong_hand("BRAINCO-MOVE-04")
class SlowServos(ServoService):
    """Takes 0.4 of each speed that is commanded."""

    hand_fault = _Lazy


class _Overshoots(ServoHand):
    asked: Floats | None = None
    true_goal: Floats | None = None
    until = 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        before = rows[0] if self.asked is None else self.asked
        jump = np.clip(rows[0], self.low, self.high) - np.clip(before, self.low, self.high)
        self.asked = rows[0]
        super().take(rows, mode)
        if (np.abs(jump) > 0.1).any():
            self.true_goal, self.until = self.goal, self.now + 0.4
            beyond = self.goal + np.where(np.abs(jump) > 0.1, 0.08 * np.sign(jump), 0.0)
            self.goal = np.clip(beyond, self.low, self.high)

    def step(self, dt: float) -> None:
        if self.true_goal is not None and self.now > self.until:
            self.goal, self.true_goal = self.true_goal, None
        super().step(dt)


@wrong_hand("BRAINCO-MOVE-05")
class Overshoots(ServoService):
    """Overshoots a large step by 8 % of the travel, and returns after 0.4 s."""

    hand_fault = _Overshoots


class _Fast(ServoHand):
    def take(self, rows: Floats, mode: Ints) -> None:
        fast = rows.copy()
        fast[1] = 1.0
        super().take(fast, mode)


@wrong_hand("BRAINCO-SPEED-01")
class AlwaysFast(ServoService):
    """Moves at full speed, whatever dq is."""

    hand_fault = _Fast


# ------------------------------------------------------------------------------ grip


class _LetsGo(ServoHand):
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
class LetsGo(ServoService):
    """Opens after a second of full current, like a protection that trips."""

    hand_fault = _LetsGo


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


class _Vanishes(ServoHand):
    pressed = 0.0

    def step(self, dt: float) -> None:
        self.rests = False
        super().step(dt)
        touches = self.touches and any(abs(c) > 0.01 for c in self.contact)
        self.pressed += dt if touches else 0.0

    def take(self, rows: Floats, mode: Ints) -> None:
        self.pressed = 0.0
        super().take(rows, mode)

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, [0.05 * p for p in pull] if self.pressed > 1.0 else pull)


@wrong_hand("FTP-FORCE-06", sides=BOTH, whole=True)
class ForceVanishes(FtpService):
    """Presses with a twentieth of the force after a second of contact, and does not open."""

    hand_fault = _Vanishes


# --------------------------------------------------------------------------- silence


class _Opens(ServoHand):
    def expire(self) -> None:
        super().expire()
        self.goal = np.array([j.straight for j in self.model.joints[self.side]])


@wrong_hand("BRAINCO-WDOG-01")
class OpensInSilence(ServoService):
    """Opens a second after the last command."""

    hand_fault = _Opens


class _GoesOn(ServoHand):
    def expire(self) -> None:
        return


@wrong_hand("BRAINCO-WDOG-04")
class GoesOnForEver(ServoService):
    """Continues to its last goal without commands."""

    hand_fault = _GoesOn


# -------------------------------------------------------------------------- operator


class _Smooths(ServoHand):
    seconds = 0.15
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
            self.goal = self.goal + (self.wanted - self.goal) * dt / self.seconds
        super().step(dt)


@wrong_hand("BRAINCO-OPER-02", where=has_speeds)
class SmoothsGoals(ServoService):
    """Smooths its goals over 0.15 s."""

    hand_fault = _Smooths


# ----------------------------------------------------------------------- bad commands


class _SlowAfterNan(ServoHand):
    slow = False

    def command(self, motors: tuple[Motor, ...]) -> None:
        self.slow = self.slow or not all(math.isfinite(m.q) for m in motors)
        super().command(motors)

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        if self.slow:
            self.reach = [0.33 * r for r in self.reach]


@wrong_hand("BRAINCO-ABUSE-01", where=takes_floats)
class SlowAfterNan(ServoService):
    """Moves with a third of each speed since it has got a command that is not finite."""

    hand_fault = _SlowAfterNan


class _SlowAfterFar(_SlowAfterNan):
    def command(self, motors: tuple[Motor, ...]) -> None:
        self.slow = self.slow or any(abs(m.q) > _FAR for m in motors)
        super().command(motors)


@wrong_hand("FTP-ABUSE-01")
class SlowAfterFar(ServoService):
    """Moves with a third of its speed since it has got a goal that is far out of range."""

    hand_fault = _SlowAfterFar


@wrong_hand("FTP-MOVE-08", whole=True)
class DeafAfterOutOfRange(ServoService):
    """Ignores commands for 0.8 s after one whose goal is far out of range."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.deaf_until: dict[Side, float] = {}

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if any(abs(m.q) > _FAR for m in motors):
            self.deaf_until[side] = self.now + 0.8
        if self.now >= self.deaf_until.get(side, 0.0):
            super().motors(side, motors)


# -------------------------------------------------------------------- forces that are reported


class _Feels(ServoHand):
    """Counts the seconds in which it touches the object, and its grips."""

    grip = 0.0
    off = 9.0
    grips = 0

    def step(self, dt: float) -> None:
        super().step(dt)
        if self.touches and max(map(abs, self.contact)) > 0.02 and not self.free():
            self.grips += self.grip == 0.0
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


@wrong_hand("BRAINCO-FORCE-01", sides=BOTH)
class ForceAgainstClosing(_FeelingService):
    """Reports the force of a grip with the other sign."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if hand.grip > 0.0:  # type: ignore[attr-defined]
            motors["tau_est"] *= -1.0


@wrong_hand("BRAINCO-FIELD-19", sides=BOTH)
class FullSpeedInContact(ServoService):
    """Reports the full speed of a finger that presses on an object."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if hand.touches:
            motors["dq"][np.abs(hand.contact[: len(motors)]) > 0.05] = 1.0


@wrong_hand("BRAINCO-FORCE-01", sides=BOTH)
class ForceZeroedInGrip(_FeelingService):
    """Sets its forces to zero half a second after it has touched."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        if hand.grip > 0.5:  # type: ignore[attr-defined]
            motors["tau_est"] = 0.0


@wrong_hand("BRAINCO-FORCE-01", sides=BOTH)
class ForceOfNextJoint(ServoService):
    """Reports each force as its neighbour's."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["tau_est"] = np.roll(motors["tau_est"], 1)


@wrong_hand("BRAINCO-FORCE-04", sides=BOTH, whole=True)
class ForceKept(ServoService):
    """Keeps the largest force of each joint for ever."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.most = {s: np.zeros(len(h.q)) for s, h in self.hands.items()}

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        tau, kept = np.array(motors["tau_est"]), self.most[hand.side]
        kept[:] = np.where(np.abs(tau) > np.abs(kept), tau, kept)
        motors["tau_est"] = kept


class _BacksOff(_Feels):
    def step(self, dt: float) -> None:
        super().step(dt)
        if self.grip > 0.2:
            closing = [j.closing for j in self.model.joints[self.side]]
            ahead = zip(self.place, self.q, closing, strict=True)
            self.place = [q + c * min(c * (p - q), 0.015) for p, q, c in ahead]
            self.law_q = list(self.place)
            self.rests = False


@wrong_hand("BRAINCO-FORCE-05", sides=BOTH)
class ForceBacksOff(_FeelingService):
    """Takes its goals back to a seventh of the force as soon as it touches."""

    hand_fault = _BacksOff


class _WeakAgain(_Feels):
    weak = False
    part = 0.15

    def is_weak(self) -> bool:
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


class _GivesUp(_WeakAgain):
    def is_weak(self) -> bool:
        return self.grip > 1.0


@wrong_hand("BRAINCO-FORCE-05", sides=BOTH)
@wrong_hand("FTP-FORCE-05", sides=BOTH, whole=True)
class ForceGivesUp(_FeelingService):
    """Presses with a seventh of its force after a second of a grip."""

    hand_fault = _GivesUp


@wrong_hand("BRAINCO-FORCE-05", sides=BOTH, whole=True)
class WeakAfterRestart(_FeelingService):
    """Presses with a seventh of its force after a restart of the service."""

    hand_fault = _WeakAgain

    def take_over(self, before: Any) -> None:
        super().take_over(before)
        for hand in self.hands.values():
            hand.is_weak = lambda hand=hand: hand.grip > 0.0  # type: ignore[attr-defined]


class _ThirdOfItsForce(_WeakAgain):
    part = 0.3
    other_client = False

    def is_weak(self) -> bool:
        return self.other_client


@wrong_hand("FTP-FORCE-07", sides=BOTH, whole=True)
class WeakForNewClients(_FeelingService):
    """Presses with less than half of its force since a second program has commanded it."""

    hand_fault = _ThirdOfItsForce

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client:
            for hand in self.hands.values():
                hand.other_client = True  # type: ignore[attr-defined]
        super().receive(topic, payload, client)


# ----------------------------------------------------------------------------- tactile areas


class _FeelingFtp(FtpService):
    hand_fault = _Feels

    def gripping(self, side: Side, seconds: float) -> bool:
        hand = self.hands[side]
        assert isinstance(hand, _Feels)
        return hand.grip > seconds


@wrong_hand("FTP-TOUCH-05", sides=BOTH)
class TouchStopsInGrip(_FeelingFtp):
    """Publishes no touch from 0.4 s of a grip on."""

    def touch(self) -> list[Sample]:
        quiet = [self.touch_topic(s) for s in self.sides if self.gripping(s, 0.4)]
        return [sample for sample in super().touch() if sample.topic not in quiet]


@wrong_hand("FTP-TOUCH-05", sides=BOTH)
class TouchZeroedInGrip(_FeelingFtp):
    """Sets its tactile areas to zero 0.3 s after it has touched."""

    def touched(self, side: Side) -> bytes:
        hand = self.hands[side]
        contact = hand.contact
        if self.gripping(side, 0.3):
            hand.contact = [0.0] * len(contact)
        message = super().touched(side)
        hand.contact = contact
        return message


@wrong_hand("FTP-TOUCH-05", sides=BOTH)
class TouchKept(FtpService):
    """Keeps the largest reading of each element for ever."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.most: dict[Side, Floats] = {}

    def pressures(self, hand: FingerHand) -> Floats:
        pressure = super().pressures(hand)
        self.most[hand.side] = np.maximum(self.most.get(hand.side, pressure), pressure)
        return self.most[hand.side]


# ------------------------------------------------------------------------------- speeds


def _speed_fault(change: Any) -> type[ServoHand]:
    """A hand that takes other speeds than those of a command."""

    class _Hand(ServoHand):
        def take(self, rows: Floats, mode: Ints) -> None:
            other = rows.copy()
            other[1] = change(rows[1])
            super().take(other, mode)

    return _Hand


@wrong_hand("BRAINCO-SPEED-02")
class ZeroIsFullSpeed(ServoService):
    """Moves at full speed where dq is 0."""

    hand_fault = _speed_fault(lambda dq: np.where(dq == 0.0, 1.0, dq))


@wrong_hand("BRAINCO-SPEED-03")
class SpeedOfTheFirst(ServoService):
    """Moves all joints with the speed of the first one."""

    hand_fault = _speed_fault(lambda dq: np.full_like(dq, dq[0]))


@wrong_hand("BRAINCO-SPEED-03")
class HalfSpeeds(ServoService):
    """Takes half of each speed below the full one."""

    hand_fault = _speed_fault(lambda dq: np.where(dq < 0.9, 0.5 * dq, dq))


# ---------------------------------------------------------------- after silences and restarts


@wrong_hand("BRAINCO-WDOG-03")
class LateAfterSilence(ServoService):
    """Obeys commands 0.55 s late for half a second after a silence."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.mail: list[tuple[float, Side, tuple[Motor, ...]]] = []
        self.heard = self.slow_until = 0.0

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
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


class _SwapsSome(ServoService):
    """Takes the goals of its third and fifth joint for each other, at times."""

    def swaps(self) -> bool:
        return False

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if self.swaps():
            order = (0, 1, 4, 3, 2, *range(5, len(motors)))
            motors = tuple(motors[i] for i in order)
        super().motors(side, motors)


@wrong_hand("BRAINCO-LIFE-02", whole=True)
class SwapsForNewClients(_SwapsSome):
    """Mixes two joints up in the commands of a restarted client."""

    client = 0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.client = client
        super().receive(topic, payload, client)

    def swaps(self) -> bool:
        return 0 < self.client < 1000 and not self.restarted


@wrong_hand("BRAINCO-STILL-01", sides=BOTH, whole=True)
class OldClientReturns(ServoService):
    """Obeys the earlier client's last goals on the left for a quarter of each second."""

    client = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.last: dict[Side, tuple[Motor, ...]] = {}
        self.earlier: dict[Side, tuple[Motor, ...]] = {}
        self.since = 0.0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client < 1000 and client != self.client:
            self.client, self.earlier, self.since = client, dict(self.last), self.now
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        self.last[side] = motors
        if side is Side.LEFT and (self.now - self.since) % 1.0 > 0.75:
            motors = self.earlier.get(side, motors)
        super().motors(side, motors)


@wrong_hand("BRAINCO-SPEED-03", whole=True)
class OneSpeedForNewClients(ServoService):
    """Moves all joints with the largest speed of a restarted client's command."""

    client = 0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.client = client
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        if 0 < self.client < 1000:
            most = max(m.dq for m in motors)
            motors = tuple(replace(m, dq=most) for m in motors)
        super().motors(side, motors)


@wrong_hand("BRAINCO-LIFE-03", whole=True)
class SwapsAfterRestart(_SwapsSome):
    """Mixes two joints up in commands after a restart of the service."""

    def swaps(self) -> bool:
        return self.restarted


@wrong_hand("BRAINCO-WDOG-03", whole=True)
class SwapsAfterSilence(_SwapsSome):
    """Mixes two joints up in commands for three seconds after a silence."""

    heard = until = 0.0

    def swaps(self) -> bool:
        if self.heard and self.now - self.heard > 0.5:
            self.until = self.now + 3.0
        self.heard = self.now
        return self.now < self.until
