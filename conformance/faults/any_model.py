"""Wrong hands of every model: mixed into the reference service of each."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Any

from dexkit.conformance.faults.registry import (
    BOTH,
    Call,
    Motors,
    changes,
    obeys_gains,
    reports,
    takes_floats,
    wrong_hand,
)
from dexkit.conformance.kit.motor_messages import Motor, sequence_of
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.virtual import Sample, Service
from dexkit.hand import JointSpec, Side
from dexkit.messages import message_type
from dexkit.models import BRAINCO_REVO2, HandModel, model

Sides = tuple[Side, ...]


def finite(motors: Motors) -> bool:
    """Whether all values of a command are finite."""
    return all(math.isfinite(x) for m in motors for x in (m.q, m.dq, m.tau, m.kp, m.kd))


def finite_q(motors: Motors) -> bool:
    """Whether the goals of a command are finite."""
    return all(math.isfinite(m.q) for m in motors)


def other(side: Side) -> Side:
    """The other side."""
    return Side.LEFT if side is Side.RIGHT else Side.RIGHT


# -------------------------------------------------------------------------------- discovery


@changes(Service, "sample", "DEX1-TOPIC-01", "DEX3-TOPIC-01")
def OldTopic(self: Any, sample: Call, topic: str, sides: Sides) -> Any:
    """Publishes on the topic of an older stack."""
    return replace(sample(topic, sides), topic="rt/unitree_actuator/state")


@changes(Service, "sample", "DEX1-TOPIC-01", "DEX3-TOPIC-01")
def OtherStateType(self: Any, sample: Call, topic: str, sides: Sides) -> Sample:
    """Publishes another type of the Dex family on its state topic."""
    go, hg = "unitree_go::msg::dds_::MotorStates_", "unitree_hg::msg::dds_::HandState_"
    kind = message_type(hg if self.dialect.state_type == go else go)
    return Sample(topic, kind.name, kind.encode(kind.cls()), self.now)


@wrong_hand("DEX1-TOPIC-02", "DEX3-TOPIC-02")
class OtherCommandType(Service):
    """Subscribes to its command topic with another type."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        go, hg = "unitree_go::msg::dds_::MotorCmds_", "unitree_hg::msg::dds_::HandCmd_"
        self.command_type = hg if self.dialect.cmd_type == go else go


@wrong_hand("DEX1-QOS-01", "DEX3-QOS-01")
class DemandsHistory(Service):
    """Requests TRANSIENT_LOCAL commands, which no official client offers."""

    reader_durability = "TransientLocal"


@wrong_hand("DEX1-QOS-01", "DEX3-QOS-01")
class BestEffortWriter(Service):
    """Publishes its state with best-effort reliability."""

    writer_reliability = "best_effort"


# --------------------------------------------------------------------------------- start-up


@wrong_hand("DEX1-START-01", "DEX3-START-01")
class SilentUntilCommanded(Service):
    """Publishes nothing before the first command."""

    commanded = False

    def motors(self, side: Side, motors: Motors) -> None:
        self.commanded = True
        super().motors(side, motors)

    def publish(self) -> list[Sample]:
        return super().publish() if self.commanded else []


# --------------------------------------------------------------------------- rate and order


@wrong_hand("BRAINCO-RATE-01")
@wrong_hand("DEX1-RATE-01", "DEX3-RATE-01")
class SlowPublisher(Service):
    """Publishes at 125 Hz, or at 1.15 times the least rate where that is less."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.period = max(0.008, 1 / 1.15 / model(self.dialect.model).min_state_rate)


@wrong_hand("BRAINCO-RATE-01")
@wrong_hand("DEX1-RATE-01", "DEX3-RATE-01")
class SlowsDown(Service):
    """Publishes at 60 Hz or less from 6 s on, as if it is throttled when warm."""

    due = 6.0

    def publish(self) -> list[Sample]:
        samples = super().publish()
        if self.now < self.due:
            return samples if self.now < 6.0 else []
        self.due += max(1 / 60, 4 / 3 / model(self.dialect.model).min_state_rate)
        return samples

    def end(self) -> list[Sample]:
        self.due = 0.0
        return super().end()


def _needs_many_states(hand: HandModel) -> bool:
    return hand.min_state_rate >= 200.0


def _publishes_hundreds(hand: HandModel) -> bool:
    # the Revo2's guide says 100 Hz
    return hand.state_rate >= 400.0 and hand is not BRAINCO_REVO2


@wrong_hand("DEX1-RATE-01", "DEX3-RATE-01", where=_publishes_hundreds)
class HalfRate(Service):
    """Publishes at 222 Hz: enough for clients, but slower than the vendor's service."""

    period = 0.0045


@changes(Service, "publish", "DEX1-RATE-03", "DEX3-RATE-03")
def Hiccup(self: Any, publish: Call) -> Any:
    """Publishes nothing for 0.3 s once, as if its publishing thread waits for the device."""
    return [] if 2.0 < self.now < 2.3 else publish()


@changes(Service, "publish", "DEX1-RATE-03", "DEX3-RATE-03")
def DeliversLate(self: Any, publish: Call) -> Any:
    """Holds its states back for 0.25 s once, with the source timestamps of when they were made."""
    waiting = [*self.memory.pop("waiting", []), *publish()]
    if not 2.0 < self.now < 2.25:
        return waiting
    self.memory["waiting"] = waiting
    return []


class BurstsWithGoodStamps(Service):
    """Delivers its states in bursts of ten, with the source timestamps of when they were made."""

    together = 10

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.waiting: list[list[Sample]] = []

    def publish(self) -> list[Sample]:
        self.waiting.append(super().publish())
        if len(self.waiting) < self.together:
            return []
        waiting, self.waiting = self.waiting, []
        return [sample for samples in waiting for sample in samples]

    def end(self) -> list[Sample]:
        self.together = 1
        return super().end()


@changes(BurstsWithGoodStamps, "publish", "DEX1-RATE-03", "DEX3-RATE-03")
def BurstsForTwoSeconds(self: Any, publish: Call) -> Any:
    """Delivers its states in bursts of twenty for two seconds, with the right timestamps."""
    self.together = 20 if 2.0 < self.now < 4.0 else 1
    return publish()


@changes(Service, "publish", "DEX1-ORDER-01", "DEX3-ORDER-01")
def RepeatsOldStates(self: Any, publish: Call) -> list[Sample]:
    """Publishes every hundredth state again after the next one."""
    samples = list(publish())
    self.memory["count"] = count = self.memory.get("count", 0) + 1
    if count % 100 == 0:
        self.memory["old"] = tuple(samples)
    elif count % 100 == 1:
        samples += self.memory.get("old", ())
    return samples


# ---------------------------------------------------------------------------- measured values


@changes(Service, "payload", "DEX1-FRESH-01", "DEX3-FRESH-01", whole=True)
def StaleState(self: Any, payload: Call, sides: Sides, length: int | None = None) -> Any:
    """Measures five times a second and publishes the same values in between."""
    at, _ = self.memory.get(sides, (-1.0, b""))
    if self.now - at >= 0.2:
        self.memory[sides] = (self.now, payload(sides, length))
    return self.memory[sides][1]


@changes(Service, "payload", "DEX1-FRESH-01", "DEX3-FRESH-01", "BRAINCO-FRESH-01", whole=True)
def StaleLater(self: Any, payload: Call, sides: Sides, length: int | None = None) -> Any:
    """Measures five times a second from 12 s on."""
    at, _ = self.memory.get(sides, (-1.0, b""))
    if self.now < 12.0 or self.now - at >= 0.2:
        self.memory[sides] = (self.now, payload(sides, length))
    return self.memory[sides][1]


@wrong_hand("DEX1-FRESH-02", "DEX3-FRESH-02", whole=True)
class FrozenAtFirst(Service):
    """Publishes its first measurement until 0.7 s after the first command."""

    until = math.inf

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.first: dict[Sides, bytes] = {}

    def motors(self, side: Side, motors: Motors) -> None:
        self.until = min(self.until, self.now + 0.7)
        super().motors(side, motors)

    def payload(self, sides: Sides, length: int | None = None) -> bytes:
        newest = super().payload(sides, length)
        frozen = self.now < self.until and not self.restarted
        return self.first.setdefault(sides, newest) if frozen else newest


@wrong_hand("DEX1-FRESH-02", "DEX3-FRESH-02", whole=True)
class FreezesOnce(Service):
    """Publishes the same values for 0.3 s when it first begins to move."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.start: dict[Side, float] = {}
        self.kept: dict[Sides, tuple[float, bytes]] = {}

    def payload(self, sides: Sides, length: int | None = None) -> bytes:
        here = sum(self.positions(s)[-1] for s in sides)
        start = self.start.setdefault(sides[0], here)
        if sides not in self.kept and abs(here - start) > 0.02 and not self.restarted:
            self.kept[sides] = (self.now + 0.3, super().payload(sides, length))
        until, old = self.kept.get(sides, (0.0, b""))
        return old if self.now < until else super().payload(sides, length)


@wrong_hand("DEX5-FIELD-04", "BRAINCO-FIELD-04", whole=True)
@wrong_hand("DFX-WDOG-01", "FTP-WDOG-01", whole=True)
@wrong_hand("DEX1-FIELD-17", "DEX3-FIELD-15", whole=True)
class SwapsBuffers(Service):
    """Publishes every second time what it measured 0.06 s ago, until it ends."""

    ended = False
    turn = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.past: dict[Sides, deque[tuple[float, bytes]]] = {}

    def publish(self) -> list[Sample]:
        self.turn += 1
        return super().publish()

    def brake(self) -> None:
        self.ended = True
        super().brake()

    def payload(self, sides: Sides, length: int | None = None) -> bytes:
        newest = super().payload(sides, length)
        past = self.past.setdefault(sides, deque())
        past.append((self.now, newest))
        while past[0][0] < self.now - 0.06:
            past.popleft()
        return newest if self.turn % 2 or self.ended else past[0][1]


@changes(Service, "payload", "DEX1-MOVE-02", "DEX3-JOINT-01", "DEX5-MODE-01")
def Frozen(self: Any, payload: Call, sides: Sides, length: int | None = None) -> Any:
    """Publishes its first measurement forever, at full rate."""
    if sides not in self.memory:
        self.memory[sides] = payload(sides, length)
    return self.memory[sides]


# ----------------------------------------------------------------------------------- fields


@changes(Service, "payload", "DEX1-FIELD-01", "DEX3-FIELD-01", where=takes_floats)
def OneTooMany(self: Any, payload: Call, sides: Sides, length: int | None = None) -> Any:
    """Publishes a sequence with one motor too many."""
    return payload(sides, self.dialect.length + 1)


@changes(Service, "payload", "DEX1-FIELD-01", "DEX3-FIELD-01")
def EmptyNowAndThen(self: Any, payload: Call, sides: Sides, length: int | None = None) -> Any:
    """Publishes an empty sequence in every 500th state."""
    self.memory["count"] = count = self.memory.get("count", 0) + 1
    return payload(sides, 0 if count % 500 == 0 else length)


@wrong_hand("DEX3-FIELD-04")
@reports(Service, "DEX1-FIELD-04")
def TurnedVelocity(self: Any, state: Any, hand: Any) -> None:
    """Publishes dq with the wrong sign."""
    state["dq"] = -state["dq"]


@wrong_hand("BRAINCO-FORCE-01", sides=BOTH)
@reports(Service, "DEX1-FORCE-01")
def NoForce(self: Any, state: Any, hand: Any) -> None:
    """Publishes no force."""
    state["tau_est"] = 0.0


@reports(Service, "DEX1-FORCE-04", "DEX3-FORCE-02")
def MilliNewtonMetres(self: Any, state: Any, hand: Any) -> None:
    """Publishes tau_est in mN m."""
    state["tau_est"] *= 1e3


# ----------------------------------------------------------------------------------- motion


# both sides of a Revo2 do the same while one joint moves, so that only later steps show it
@wrong_hand("BRAINCO-SIDE-01", sides=BOTH)
@changes(Service, "motors", "DEX1-SIDE-01", "DEX3-SIDE-01", sides=BOTH)
def Swapped(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Each side obeys the other side's commands."""
    command(other(side), motors)


@changes(Service, "motors", "DEX1-SIDE-01", "DEX3-SIDE-01", sides=BOTH, whole=True)
def SwappedWhenRestarted(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Each side obeys the other side's commands since the service was restarted: it found the two
    devices in another order.
    """
    command(other(side) if self.restarted else side, motors)


@wrong_hand("DEX1-WDOG-03", "DEX3-WDOG-03", whole=True)
class KicksBack(Service):
    """Moves the wrong way for 60 ms when its goal jumps."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.kicks: dict[Side, tuple[float, Motors]] = {}
        self.newest: dict[Side, Motors] = {}

    def motors(self, side: Side, motors: Motors) -> None:
        if not finite(motors):
            super().motors(side, motors)
            return
        here = self.positions(side)
        before = self.newest.get(side, motors)
        self.newest[side] = motors
        jumps = [b.q - a.q for a, b in zip(before, motors, strict=True)]
        drives = self.dialect.position_servo or all(m.kp > 0 for m in motors)
        if any(0.25 < abs(j) < 6.0 for j in jumps) and drives:
            back = tuple(
                replace(m, q=q - math.copysign(0.35, j) if abs(j) > 0.25 else m.q)
                for m, q, j in zip(motors, here, jumps, strict=True)
            )
            self.kicks[side] = (self.now + 0.06, back)
        until, back = self.kicks.get(side, (0.0, motors))
        super().motors(side, back if self.now < until else motors)


class _Moves(Service):
    """Sometimes goes to a place of its own."""

    def go(self, side: Side, part: float) -> None:
        """Command a part of each joint's range from here, towards the middle."""
        hand = model(self.dialect.model)
        every = zip(self.positions(side), joints_of(self.dialect, side), hand.gains, strict=True)
        super().motors(
            side,
            tuple(
                Motor(
                    q + math.copysign(part * j.stroke, 0.5 * (j.q_min + j.q_max) - q),
                    dq=hand.client_command.dq,
                    kp=kp,
                    kd=kd,
                    mode=self.codec.mode(i),
                )
                for i, (q, j, (kp, kd)) in enumerate(every)
            ),
        )


@changes(Service, "motors", "DEX1-SAFE-01", "DEX5-SAFE-01", sides=BOTH, whole=True)
def CrossesSidesAfterBadCommands(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Gives each side the other's commands for 2 s after one that is not finite."""
    if not finite_q(motors):
        self.memory["until"] = self.now + 2.0
    command(other(side) if self.now < self.memory.get("until", -math.inf) else side, motors)


@wrong_hand("DEX1-STILL-01", "DEX3-STILL-01")
class HomesAtTheStart(_Moves):
    """Moves by a tenth of its range before the first command."""

    homed = commanded = False

    def motors(self, side: Side, motors: Motors) -> None:
        self.commanded = True
        super().motors(side, motors)

    def live(self, dt: float) -> None:
        if not self.homed and not self.commanded and not self.restarted and self.now > 0.5:
            self.homed = True
            for side in self.sides:
                self.go(side, 0.1)
        super().live(dt)


@wrong_hand("DEX1-STILL-01", "DEX3-STILL-01", whole=True)
class HomesWhenRestarted(_Moves):
    """Moves by a tenth of its range after a restart of its service, before any command."""

    due = math.inf
    delay = 0.2

    def begin(self, now: float) -> None:
        super().begin(now)
        self.due = now + self.delay

    def live(self, dt: float) -> None:
        if self.now >= self.due:
            self.due = math.inf
            for side in self.sides:
                self.go(side, 0.1)
        super().live(dt)


@wrong_hand("DEX1-LIFE-06", "DEX3-LIFE-06", whole=True)
class HomesAtOnceWhenRestarted(HomesWhenRestarted):
    """Moves by a tenth of its range with its first state after a restart: it is never at rest."""

    delay = 0.0


@wrong_hand("DEX1-STILL-01", "DEX3-STILL-01", sides=BOTH, whole=True, where=obeys_gains)
class KicksTheOtherSide(_Moves):
    """Moves the other hand when one gets a command with a negative gain."""

    def motors(self, side: Side, motors: Motors) -> None:
        super().motors(side, motors)
        if any(m.kp < 0 for m in motors):
            for each in self.sides:
                if each is not side:
                    self.go(each, 0.07)


class _Snaps(Service):
    """Goes to the other end for a quarter of a second when it gets its first command."""

    when_restarted = False

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.other: dict[Side, tuple[float, list[float]]] = {}

    def motors(self, side: Side, motors: Motors) -> None:
        if side not in self.other:
            ends = [
                j.q_min if q > 0.5 * (j.q_min + j.q_max) else j.q_max
                for q, j in zip(self.positions(side), joints_of(self.dialect, side), strict=True)
            ]
            self.other[side] = self.now + 0.25, ends
        until, ends = self.other[side]
        if self.restarted is self.when_restarted and self.now < until:
            motors = tuple(replace(m, q=q) for m, q in zip(motors, ends, strict=True))
        super().motors(side, motors)


@wrong_hand("DEX1-PATH-01", "DEX3-PATH-01")
class SnapsAtFirst(_Snaps):
    """Goes to the other end for a quarter of a second when it gets its first command."""


@wrong_hand("DEX1-PATH-01", "DEX3-PATH-01", whole=True)
class SnapsWhenRestarted(_Snaps):
    """After a restart of its service, first goes to the other end for a quarter of a second."""

    when_restarted = True


@changes(Service, "motors", "DEX1-CMD-01", "DEX3-CMD-01")
def DropsEverySecond(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys every second command to a side."""
    self.memory[side] = self.memory.get(side, 0) + 1
    if self.memory[side] % 2:
        command(side, motors)


@changes(Service, "motors", "DEX1-CMD-01", "DEX3-CMD-01")
def OneBehind(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys each command when the next one arrives."""
    before = self.memory.get(side, motors)
    self.memory[side] = motors
    command(side, before)


@changes(Service, "motors", "DEX1-SIDE-02", "DEX3-SIDE-02", sides=BOTH, where=takes_floats)
def BadCommandsStopBoth(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Drops the commands to both hands for half a second after a bad one."""
    if not finite(motors):
        self.memory["deaf_until"] = self.now + 0.5
    if self.now >= self.memory.get("deaf_until", -math.inf):
        command(side, motors)


@changes(Service, "motors", "DEX1-SIDE-02", "DEX3-SIDE-02", sides=BOTH, whole=True)
def OneWatchdogForBoth(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Drops the commands to one hand while the other has got none for a second."""
    if finite_q(motors):
        self.memory[side] = self.now
    if all(self.now - self.memory.get(s, self.now) < 1.0 for s in self.sides):
        command(side, motors)


@changes(Service, "motors", "DEX3-SIDE-03", sides=BOTH, whole=True)
def WaitsForTheOtherGrip(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Drops the commands to one hand while the other one presses on an object."""
    others = [hand for s, hand in self.hands.items() if s is not side and hand.touches]
    if not any(abs(x) > 0.005 for hand in others for x in hand.contact):
        command(side, motors)


@changes(Service, "motors", "DEX1-ABUSE-01", "DEX3-ABUSE-01", where=obeys_gains)
def WeakAfterNan(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Uses a quarter of the stiffness since it has got a command that is not finite."""
    if not finite_q(motors):
        self.memory["weak"] = True
    if self.memory:
        motors = tuple(replace(m, kp=0.25 * m.kp) for m in motors)
    command(side, motors)


@wrong_hand("DEX1-ABUSE-01", "DEX3-ABUSE-01", sides=BOTH, whole=True)
class SlowForASecondClient(Service):
    """Moves by 20 % of the range in a second for 4 s when a second client has come."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.known: set[int] = set()
        self.slow_until = -math.inf
        self.goals: dict[Side, tuple[float, tuple[float, ...]]] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client not in self.known:
            self.known.add(client)
            if len(self.known) == 2:
                self.slow_until = self.now + 4.0
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: Motors) -> None:
        if self.now < self.slow_until and finite_q(motors):
            at, goals = self.goals.get(side, (self.now, self.positions(side)))
            steps = [0.2 * j.stroke * (self.now - at) for j in joints_of(self.dialect, side)]
            goals = tuple(
                q + min(max(m.q - q, -step), step)
                for m, q, step in zip(motors, goals, steps, strict=False)
            )
            self.goals[side] = self.now, goals
            motors = tuple(replace(m, q=q) for m, q in zip(motors, goals, strict=False))
        else:
            self.goals.pop(side, None)
        super().motors(side, motors)


@changes(Service, "motors", "DEX3-ABUSE-01", where=obeys_gains, whole=True)
def WeakWhenRestarted(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Uses two fifths of the stiffness after a restart of its service, as settings are lost."""
    if self.restarted:
        motors = tuple(replace(m, kp=0.4 * m.kp) for m in motors)
    command(side, motors)


# ----------------------------------------------------------------------------------- safety


@changes(Service, "motors", "DEX1-SAFE-01", "DEX3-SAFE-01")
def NanIsZero(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Replaces NaN and infinity by 0."""

    def zero(x: float) -> float:
        return x if math.isfinite(x) else 0.0

    command(
        side,
        tuple(
            Motor(zero(m.q), zero(m.dq), zero(m.tau), zero(m.kp), zero(m.kd), m.mode)
            for m in motors
        ),
    )


def _zeroed(motors: Motors) -> Motors:
    """The motors with 0 for each q that is not finite."""
    return tuple(replace(m, q=m.q if math.isfinite(m.q) else 0.0) for m in motors)


# a hand without gains gets fewer of them
@changes(Service, "motors", "DEX1-SAFE-01", "DEX3-SAFE-01", whole=True, where=obeys_gains)
def TiresOfNan(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Rejects a hundred commands that are not finite, and obeys later ones as 0."""
    self.memory["count"] = count = self.memory.get("count", 0) + (not finite(motors))
    command(side, motors if count <= 100 else _zeroed(motors))


@wrong_hand("DEX1-SAFE-01", "DEX3-SAFE-01", whole=True)
class TrustsTheNextClient(Service):
    """Checks only the commands of the first client; of others, it replaces NaN by 0."""

    client = 0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.client = client
        super().receive(topic, payload, client)

    def motors(self, side: Side, motors: Motors) -> None:
        super().motors(side, _zeroed(motors) if self.client else motors)


@changes(Service, "receive", "DEX1-SAFE-03", "DEX3-SAFE-03")
def EmptyIsZero(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys an empty command as goals of 0 with its default gains."""
    receive(topic, payload, client)
    if self.codec.commanded(payload):
        return
    for side in self.sides:
        if self.codec.command_topics[side] == topic:
            dq = model(self.dialect.model).client_command.dq
            motors = (Motor(dq=dq, mode=self.codec.mode(i)) for i in range(self.codec.joints))
            self.motors(side, tuple(motors))


class _Dies(Service):
    """Publishes nothing for 0.4 s when it has crashed."""

    dead_until = 0.0

    def publish(self) -> list[Sample]:
        return [] if self.now < self.dead_until else super().publish()


@changes(_Dies, "receive", "DEX1-SAFE-03", "DEX3-SAFE-03")
def DiesOfEmpty(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Crashes on a command without motors, and is restarted 0.4 s later."""
    sequence = self.codec.commanded(payload)
    if not sequence and any(self.codec.command_topics[s] == topic for s in self.sides):
        self.dead_until = self.now + 0.4
    receive(topic, payload, client)


@changes(Service, "receive", "DEX1-SAFE-03", "DEX3-SAFE-03", where=takes_floats)
def TakesTheLast(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys the last motors of an over-long command."""
    message = self.codec.command.decode(payload)
    motors = getattr(message, self.codec.command_sequence)
    if len(motors) > self.dialect.length:
        setattr(message, self.codec.command_sequence, motors[-self.dialect.length :])
        payload = self.codec.command.encode(message)
    receive(topic, payload, client)


@changes(Service, "foreign", "DEX1-SAFE-06", "DEX3-SAFE-07")
def TakesAnyType(self: Any, foreign: Call, topic: str, type_name: str, payload: bytes) -> None:
    """Decodes and obeys any type that is published on its command topic."""
    motors = getattr(message_type(type_name).decode(payload), sequence_of(type_name))
    for side in self.sides:
        if self.codec.command_topics[side] == topic:
            first = self.dialect.index[side]
            mine = motors[first : first + self.codec.joints]
            self.motors(side, tuple(Motor(m.q, m.dq, m.tau, m.kp, m.kd, m.mode) for m in mine))


@changes(_Dies, "foreign", "DEX1-SAFE-06", "DEX3-SAFE-07")
def DiesOfAnyType(self: Any, foreign: Call, topic: str, type_name: str, payload: bytes) -> None:
    """Crashes on a message of another type, and is restarted 0.4 s later."""
    self.dead_until = self.now + 0.4


@wrong_hand("DEX3-SAFE-08", brief=True)
@wrong_hand("DEX1-SAFE-07", whole=True)
class QueuesCommands(Service):
    """Queues up to 600 commands and carries out at most two of them in each cycle."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.queues: dict[Side, list[Motors]] = {s: [] for s in self.sides}

    def motors(self, side: Side, motors: Motors) -> None:
        self.queues[side] = [*self.queues[side][-599:], motors]

    def live(self, dt: float) -> None:
        for side, queue in self.queues.items():
            for _ in range(min(len(queue), 2 if dt > 0.0025 else 1)):
                super().motors(side, queue.pop(0))
        super().live(dt)


@wrong_hand("DEX1-SAFE-07", "DEX3-SAFE-08")
class StopsInABurst(Service):
    """Receives in its publishing thread: each waiting command delays the next state."""

    busy_until = 0.0

    def motors(self, side: Side, motors: Motors) -> None:
        busy = max(self.busy_until, self.now) + 0.001 / len(self.sides)
        self.busy_until = min(busy, self.now + 0.6)  # the socket's buffer drops the others
        super().motors(side, motors)

    def publish(self) -> list[Sample]:
        return [] if self.busy_until > self.now + 0.02 else super().publish()


# ---------------------------------------------------------------------------------- clients


@changes(_Dies, "receive", "DEX1-SAFE-09", "DEX3-SAFE-10")
def GivesUpOnTwo(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Ends when a second client commands it, and is restarted 0.4 s later."""
    before, at = self.memory.get("newest", (0, -math.inf))
    if client != before and self.now - at < 0.05:
        self.dead_until = self.now + 0.4
    self.memory["newest"] = client, self.now
    receive(topic, payload, client)


@changes(Service, "receive", "DEX1-LIFE-02", "DEX3-LIFE-02")
def StaysWithTheNewest(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys only the newest client, even when that one has gone."""
    self.memory.setdefault(client, len(self.memory))
    if client == max(self.memory, key=self.memory.__getitem__):
        receive(topic, payload, client)


@changes(Service, "receive", "DEX1-SAFE-09", "DEX3-SAFE-10")
def IgnoresTwo(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys nobody while two clients command it."""
    self.memory[client] = self.now
    if all(each == client or self.now - at > 0.05 for each, at in self.memory.items()):
        receive(topic, payload, client)


@changes(Service, "motors", "DEX1-MOVE-09", "DEX3-MOVE-08", whole=True, where=takes_floats)
def DeafAfterFar(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Ignores commands for 0.8 s after one that is far out of range."""
    if any(100.0 < abs(m.q) < math.inf for m in motors):
        self.memory[side] = self.now + 0.8
    if self.now >= self.memory.get(side, 0.0):
        command(side, motors)


@changes(Service, "motors", "DEX1-SAFE-02")
def WrapsFarGoals(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Takes a q that is far out of range modulo its range."""

    def wrapped(q: float, joint: JointSpec) -> float:
        far = 100.0 < abs(q) < math.inf
        return joint.q_min + (q - joint.q_min) % joint.stroke if far else q

    joints = joints_of(self.dialect, side)
    command(side, tuple(replace(m, q=wrapped(m.q, j)) for m, j in zip(motors, joints, strict=True)))


@changes(Service, "receive", "DEX1-ORDER-02", "DEX3-ORDER-02")
def DropsOldStamps(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Ignores commands whose source timestamps are more than a second old."""
    if self.now - self.stamp < 1.0:
        receive(topic, payload, client)


# ------------------------------------------------------------------------------------- load


def _too_slow(service: Service) -> int:
    """One state of how many is fewer than clients need: of three for most hands."""
    return int(1.2 / (service.period * model(service.dialect.model).min_state_rate) + 1e-6)


@wrong_hand("DEX1-LOAD-01", "DEX3-LOAD-01", whole=True)
class StuttersUnderLoad(Service):
    """Publishes too few states while four commands of one client come within 11 ms."""

    tick = period = 0.002
    cycle = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.came: dict[tuple[str, int], list[float]] = {}

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        key = topic, client
        self.came[key] = [*self.came.get(key, [])[-3:], self.now]
        super().receive(topic, payload, client)

    def publish(self) -> list[Sample]:
        self.cycle += 1
        busy = any(
            len(times) == 4 and times[-1] - times[0] < 0.011 and self.now - times[-1] < 0.01
            for times in self.came.values()
        )
        return [] if busy and self.cycle % _too_slow(self) else super().publish()


@changes(Service, "motors", "DEX1-LOAD-01", "DEX3-LOAD-01")
def DeafToThousands(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Takes no command while more than 700 a second arrive, as its inbox overflows."""
    came = self.memory.setdefault(side, deque(maxlen=70))
    full = len(came) == 70 and self.now - came[0] < 0.1
    came.append(self.now)
    if not full:
        command(side, motors)


@wrong_hand("DEX1-LOAD-01", "DEX3-LOAD-01", where=_needs_many_states)
class ChokesOnThousands(Service):
    """Publishes one state in three while more than 1000 commands a second arrive."""

    tick = period = 0.002
    share = 3
    """One state of how many it publishes then."""
    busy_until = second = 0.0
    cycle = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.came: dict[Side, int] = dict.fromkeys(self.sides, 0)

    def motors(self, side: Side, motors: Motors) -> None:
        if self.now >= self.second + 0.1:
            self.second, self.came = self.now, dict.fromkeys(self.sides, 0)
        self.came[side] += 1
        if self.loaded and self.came[side] > 100:
            self.busy_until = self.now + 0.1
        super().motors(side, motors)

    def publish(self) -> list[Sample]:
        self.cycle += 1
        held = self.now < self.busy_until and self.cycle % self.share
        return [] if held else super().publish()


@changes(Service, "publish", "DEX1-LOAD-01", "DEX3-LOAD-01")
def WaitsForItsReaders(self: Any, publish: Call) -> Any:
    """Keeps all samples for a slow reliable reader: its writer blocks when the history is full."""
    return [] if self.loaded and self.now % 0.5 < 0.2 else publish()


@wrong_hand("DEX1-LOAD-01", "DEX3-LOAD-01", where=obeys_gains)
class OldUnderLoad(Service):
    """Queues its states for a slow reliable reader: they are 0.3 s old when they leave."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.queue: deque[tuple[float, list[Sample]]] = deque()

    def is_late(self) -> bool:
        """Whether they wait now."""
        return self.loaded

    def publish(self) -> list[Sample]:
        self.queue.append((self.now, super().publish()))
        late = 0.3 if self.is_late() else 0.0
        while len(self.queue) > 1 and self.queue[1][0] <= self.now - late:
            self.queue.popleft()
        return [replace(s, sent=self.now) for s in self.queue[0][1]]


@wrong_hand("DEX1-LOAD-01", "DEX3-LOAD-01", where=obeys_gains)
class OldUnderThousands(OldUnderLoad):
    """Its states wait behind its commands: 0.3 s from 1000 commands a second on."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.came: deque[float] = deque(maxlen=200)

    def is_late(self) -> bool:
        return len(self.came) == self.came.maxlen and self.now - self.came[0] < 0.1

    def motors(self, side: Side, motors: Motors) -> None:
        if side is self.sides[0]:
            self.came.append(self.now)
        super().motors(side, motors)


@wrong_hand("DEX1-LOAD-01", "DEX3-LOAD-01", where=obeys_gains)
class LateUnderLoad(Service):
    """Puts commands in force 0.3 s late while a slow reader is there."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.mail: deque[tuple[float, Side, Motors]] = deque()

    def motors(self, side: Side, motors: Motors) -> None:
        self.mail.append((self.now + (0.3 if self.loaded else 0.0), side, motors))
        self.deliver()

    def deliver(self) -> None:
        while self.mail and self.mail[0][0] <= self.now:
            _, side, motors = self.mail.popleft()
            super().motors(side, motors)

    def live(self, dt: float) -> None:
        self.deliver()
        super().live(dt)


@wrong_hand("DEX1-WDOG-02", "DEX3-WDOG-02")
class QuietInSilence(Service):
    """Publishes only while it is commanded."""

    heard = math.inf

    def motors(self, side: Side, motors: Motors) -> None:
        self.heard = self.now
        super().motors(side, motors)

    def publish(self) -> list[Sample]:
        return [] if self.now - self.heard > 0.6 else super().publish()


# ------------------------------------------------------------------------------- life cycle


@wrong_hand("DEX1-LIFE-01", "DEX3-LIFE-01")
class ServesOnlyTheFirst(Service):
    """Its states reach only subscribers that were there when it started."""

    serves_late_readers = False


@changes(Service, "receive", "DEX1-LIFE-02", "DEX3-LIFE-02")
def BoundToOneClient(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys only the first client that ever commanded it."""
    if client == self.memory.setdefault("first", client):
        receive(topic, payload, client)


@changes(Service, "receive", "DEX1-LIFE-03", "DEX3-LIFE-03")
def DeafAfterRestart(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """After a restart, it gets no commands from clients that were there before."""
    if not self.restarted:
        receive(topic, payload, client)


@wrong_hand("DEX1-LIFE-03", "DEX3-LIFE-03")
class WaitsAfterRestart(Service):
    """Publishes nothing after a restart until a command arrives, for which clients wait."""

    heard = False

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.heard = True
        super().receive(topic, payload, client)

    def publish(self) -> list[Sample]:
        return [] if self.restarted and not self.heard else super().publish()


@wrong_hand("DEX1-LIFE-03", "DEX3-LIFE-03")
class SilentAfterRestart(Service):
    """Publishes nothing for 2 s after a restart."""

    began = 0.0

    def begin(self, now: float) -> None:
        super().begin(now)
        self.began = now

    def publish(self) -> list[Sample]:
        return [] if self.restarted and self.now - self.began < 2.0 else super().publish()


@wrong_hand("DEX1-LIFE-04", "DEX3-LIFE-04")
class HangsAtTheEnd(Service):
    """Does not end on SIGTERM."""

    exit_s = None


@wrong_hand("DEX1-LIFE-04", "DEX3-LIFE-04")
class LeavesItsName(Service):
    """Ends without closing DDS: its publisher stays in discovery for another 10 s."""

    gone_s = 10.0


@changes(Service, "brake", "DEX1-LIFE-04", "DEX3-LIFE-04", where=obeys_gains)
def LeavesItDriven(self: Any, brake: Call) -> None:
    """Ends without braking, and took the time-out with it."""
    for hand in self.hands.values():
        hand.timeout = math.inf


@wrong_hand("DEX1-LIFE-06", "DEX3-LIFE-06")
class ParksWhenItEnds(Service):
    """Commands each motor to its farther end when its service ends, and nothing stops it."""

    def brake(self) -> None:
        profile = model(self.dialect.model)
        kp, kd = profile.gains[0]
        for side, hand in self.hands.items():  # type: ignore[attr-defined]
            hand.timeout = math.inf
            here = [hand.q] if self.codec.joints == 1 else hand.q
            joints = joints_of(self.dialect, side)
            places = [self.place(q, j) for q, j in zip(here, joints, strict=True)]
            goals = [
                Motor(q=q, dq=profile.client_command.dq, kp=kp, kd=kd, mode=self.codec.mode(i))
                for i, q in enumerate(places)
            ]
            self.motors(side, tuple(goals))

    def place(self, q: float, joint: JointSpec) -> float:
        """Where a joint that is at q is sent."""
        return joint.q_min if q > 0.5 * (joint.q_min + joint.q_max) else joint.q_max


@changes(ParksWhenItEnds, "place", "BRAINCO-LIFE-06", sides=BOTH, whole=True)
def ParksAtAThird(self: Any, place: Call, q: float, joint: JointSpec) -> float:
    """Commands both hands to a pose of a third of the way when its service ends."""
    return joint.closed_by(0.33)


# --------------------------------------------------------------------------------- tracking


@changes(Service, "motors", "DEX1-TRACK-01", "DEX3-TRACK-01")
def WaitsForRest(self: Any, command: Call, side: Side, motors: Motors) -> None:
    """Obeys a new goal only when the goal has not changed for 0.1 s."""
    if not finite_q(motors):
        command(side, motors)
        return
    goals = []
    for joint, (motor, here) in enumerate(zip(motors, self.positions(side), strict=True)):
        q, since, taken = self.memory.get((side, joint), (math.inf, self.now, None))
        if not abs(motor.q - q) < 0.002:
            q, since = motor.q, self.now
        elif self.now - since >= 0.1:
            taken = motor.q
        self.memory[side, joint] = q, since, taken
        goals.append(here if taken is None else taken)
    command(side, tuple(replace(m, q=q) for m, q in zip(motors, goals, strict=True)))


@wrong_hand("DEX1-TRACK-01", "DEX3-TRACK-01")
class Delayed(Service):
    """Obeys each command 0.15 s late."""

    delay = 0.15

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.queue: list[tuple[float, Side, Motors]] = []

    def motors(self, side: Side, motors: Motors) -> None:
        self.queue.append((self.now + self.delay, side, motors))

    def live(self, dt: float) -> None:
        while self.queue and self.queue[0][0] <= self.now:
            _, side, motors = self.queue.pop(0)
            super().motors(side, motors)
        super().live(dt)
