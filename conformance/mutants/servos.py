"""Wrong hands of position servos."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dexkit.conformance.motor_messages import Motor
from dexkit.conformance.mutants.any_model import ChokesOnThousands
from dexkit.conformance.mutants.registry import BOTH, takes_floats, wrong_hand
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


# with an object in one hand, the other one shows that it is held back
@wrong_hand(
    "BRAINCO-SIDE-01",
    also=("BRAINCO-MOVE-09", "BRAINCO-SAFE-01", "BRAINCO-WDOG-01"),
    sides=BOTH,
)
@wrong_hand("DFX-SIDE-01", also=("DFX-MOVE-09", "DFX-WDOG-03"), sides=BOTH)
@wrong_hand(
    "FTP-SIDE-01",
    also=("FTP-MOVE-09", "FTP-SIDE-02", "FTP-WDOG-01", "FTP-WDOG-03"),
    sides=BOTH,
)
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


@wrong_hand("BRAINCO-LOAD-01", also=("BRAINCO-RATE-04",), where=_one_in_twelve_is_too_few)
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


@wrong_hand("BRAINCO-MOVE-01", also=("DFX-JOINT-01",))
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


@wrong_hand("BRAINCO-MOVE-03", also=("BRAINCO-STILL-02",), whole=True)
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


@wrong_hand("BRAINCO-MOVE-05", also=("BRAINCO-SAFE-08", "DFX-WDOG-01", "FTP-WDOG-01"))
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


@wrong_hand(
    "BRAINCO-GRIP-01",
    also=("BRAINCO-PATH-01", "BRAINCO-STILL-01", "FTP-SENS-09", "FTP-FORCE-06"),
    sides=BOTH,
    whole=True,
)
class LetsGo(ServoService):
    """Opens after a second of full current, like a protection that trips."""

    hand_fault = _LetsGo


@wrong_hand("BRAINCO-GRIP-01", also=("BRAINCO-RATE-03",), sides=BOTH, whole=True)
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


@wrong_hand("FTP-FORCE-06", also=("FTP-SENS-09",), sides=BOTH, whole=True)
class ForceVanishes(FtpService):
    """Presses with a twentieth of the force after a second of contact, and does not open."""

    hand_fault = _Vanishes


# --------------------------------------------------------------------------- silence


class _Opens(ServoHand):
    def expire(self) -> None:
        super().expire()
        self.goal = np.array([j.straight for j in self.model.joints[self.side]])


@wrong_hand("BRAINCO-WDOG-01", also=("DFX-PATH-01", "FTP-PATH-01"))
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


@wrong_hand("BRAINCO-OPER-02")
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


@wrong_hand("BRAINCO-ABUSE-01", also=("DFX-MOVE-08",), where=takes_floats)
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
