"""The wrong hands themselves, in the catalogue's order."""

# ruff: noqa: D102  (each class says what it does wrong; its methods only override)

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from dexkit.conformance.virtual import ReferenceHand, ReferenceService, Sample
from dexkit.conformance.wire import Motor
from dexkit.hand import Side
from dexkit.messages import message_type

# -------------------------------------------------------------------------------- discovery


class OldTopic(ReferenceService):
    """Publishes on the topic of an older stack."""

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        return super().sample("rt/unitree_actuator/state", fields)


class OtherStateType(ReferenceService):
    """Publishes the type that a document names: HandState_ on the right topic."""

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        kind = message_type("unitree_hg::msg::dds_::HandState_")
        return Sample(topic, kind.name, kind.encode(kind.cls()), self.now)


class OtherCommandType(ReferenceService):
    """Subscribes to the right topic with the wrong type."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.command_type = "unitree_hg::msg::dds_::HandCmd_"


class DemandsHistory(ReferenceService):
    """Asks for TRANSIENT_LOCAL commands, which no official client offers."""

    reader_durability = "TransientLocal"


class BestEffortWriter(ReferenceService):
    """Publishes state best effort."""

    writer_reliability = "best_effort"


# --------------------------------------------------------------------------------- start-up


class SilentUntilCommanded(ReferenceService):
    """Publishes nothing before the first command."""

    spoken_to = False

    def command(self, side: Side, motor: Motor) -> None:
        self.spoken_to = True
        super().command(side, motor)

    def publish(self) -> list[Sample]:
        return super().publish() if self.spoken_to else []


# --------------------------------------------------------------------------- rate and order


class SlowPublisher(ReferenceService):
    """Publishes at 125 Hz."""

    period = 0.008


class HalfRate(ReferenceService):
    """Publishes at 222 Hz: enough, but not what the vendor does."""

    period = 0.0045


class Hiccup(ReferenceService):
    """Is silent for 0.3 s once, as when the device is waited for in the publishing thread."""

    def publish(self) -> list[Sample]:
        return [] if 2.0 < self.now < 2.3 else super().publish()


class Bursts(ReferenceService):
    """Publishes ten states at once."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.waiting: list[list[Sample]] = []

    def publish(self) -> list[Sample]:
        self.waiting.append(super().publish())
        if len(self.waiting) < 10:
            return []
        burst = [
            replace(sample, sent=self.now + i * 1e-6)
            for i, samples in enumerate(self.waiting)
            for sample in samples
        ]
        self.waiting = []
        return burst


class RepeatsOldStates(ReferenceService):
    """Sends every hundredth state a second time, after the next one."""

    count = 0
    old: tuple[Sample, ...] = ()

    def publish(self) -> list[Sample]:
        samples = super().publish()
        self.count += 1
        if self.count % 100 == 0:
            self.old = tuple(samples)
        elif self.count % 100 == 1:
            samples += self.old
        return samples


class StaleState(ReferenceService):
    """Measures five times a second and publishes the same values in between."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.measured: dict[Side, dict[str, float]] = {}
        self.measured_at = -1.0

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        if self.now - self.measured_at >= 0.2:
            self.measured = {s: h.fields() for s, h in self.hands.items()}
            self.measured_at = self.now
        return super().sample(topic, {s: self.measured[s] for s in fields})


# ----------------------------------------------------------------------------------- fields


class TwoMotors(ReferenceService):
    """Publishes a sequence of two motors on a topic for one."""

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        return replace(
            super().sample(topic, fields), payload=self.wire.state_payload(fields, length=2)
        )


class EmptyNowAndThen(ReferenceService):
    """Publishes an empty sequence when the device did not answer."""

    count = 0

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        self.count += 1
        length = 0 if self.count % 500 == 0 else None
        return replace(
            super().sample(topic, fields), payload=self.wire.state_payload(fields, length)
        )


class _Fields(ReferenceService):
    """A service whose state is changed on the way out."""

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        raise AssertionError("a mutant says what it changes")

    def sample(self, topic: str, fields: Mapping[Side, Mapping[str, float]]) -> Sample:
        return super().sample(topic, {s: self.change(dict(f), s) for s, f in fields.items()})


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


class Frozen(_Fields):
    """Publishes the first measurement for ever, at full rate."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.first: dict[Side, dict[str, float]] = {}

    def change(self, fields: dict[str, float], side: Side) -> dict[str, float]:
        return dict(self.first.setdefault(side, fields))


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


class Swapped(ReferenceService):
    """Left commands move the right hand."""

    def command(self, side: Side, motor: Motor) -> None:
        super().command(Side.LEFT if side is Side.RIGHT else Side.RIGHT, motor)


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


class NanIsZero(ReferenceService):
    """Takes NaN and infinity for 0."""

    def command(self, side: Side, motor: Motor) -> None:
        q, dq, tau, kp, kd = (
            value if math.isfinite(value) else 0.0
            for value in (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        )
        super().command(side, Motor(q, dq, tau, kp, kd))


class _NoLimits(ReferenceHand):
    def accept(self, motor: Motor) -> Motor:
        return motor

    def contact(self) -> float:
        return super().contact() if abs(self.dq) < 2.0 and -0.5 < self.q < 6.0 else 0.0


class NoLimits(ReferenceService):
    """Follows a q far outside the stroke, through its stops."""

    hand = _NoLimits


class EmptyIsZero(ReferenceService):
    """Takes an empty command for one of zeros, with its default gains."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        super().receive(topic, payload, client)
        for side in self.sides:
            mine = self.wire.command_topics[side] == topic
            if mine and self.wire.read_command(payload, side) is None:
                self.command(side, Motor(q=0.0))


class DiesOfEmpty(ReferenceService):
    """Crashes on an empty command, and is restarted a second later."""

    dead_until = 0.0

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if any(
            self.wire.command_topics[s] == topic and self.wire.read_command(payload, s) is None
            for s in self.sides
        ):
            self.dead_until = self.now + 0.4
        super().receive(topic, payload, client)

    def publish(self) -> list[Sample]:
        return [] if self.now < self.dead_until else super().publish()


class _NoWatchdog(ReferenceHand):
    timeout = math.inf


class NoWatchdog(ReferenceService):
    """Follows the last command for ever."""

    hand = _NoWatchdog


class QuietInSilence(ReferenceService):
    """Publishes only while it is commanded."""

    heard = math.inf

    def command(self, side: Side, motor: Motor) -> None:
        self.heard = self.now
        super().command(side, motor)

    def publish(self) -> list[Sample]:
        return [] if self.now - self.heard > 0.6 else super().publish()


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


# ------------------------------------------------------------------------------- life cycle


class ServesOnlyTheFirst(ReferenceService):
    """Serves only the subscribers that were there when it started."""

    serves_late_readers = False


class BoundToOneClient(ReferenceService):
    """Obeys only the first client that it ever heard."""

    master: int | None = None

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if self.master is None:
            self.master = client
        if client == self.master:
            super().receive(topic, payload, client)


# --------------------------------------------------------------------------------- tracking


class WaitsForRest(ReferenceService):
    """Takes a new target only when it has stood still for a tenth of a second."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.seen: dict[Side, tuple[float, float]] = {}
        self.taken: dict[Side, float] = {}

    def command(self, side: Side, motor: Motor) -> None:
        q, since = self.seen.get(side, (math.inf, self.now))
        if not abs(motor.q - q) < 0.002:
            self.seen[side] = (motor.q, self.now)
        elif self.now - since >= 0.1:
            self.taken[side] = motor.q
        super().command(side, replace(motor, q=self.taken.get(side, self.hands[side].q)))


class Delayed(ReferenceService):
    """Carries out each command 0.15 s late."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.queue: list[tuple[float, Side, Motor]] = []

    def command(self, side: Side, motor: Motor) -> None:
        self.queue.append((self.now + 0.15, side, motor))

    def advance(self, dt: float) -> list[Sample]:
        while self.queue and self.queue[0][0] <= self.now:
            _, side, motor = self.queue.pop(0)
            super().command(side, motor)
        return super().advance(dt)


ZOO: tuple[tuple[type[ReferenceService], str, tuple[str, ...]], ...] = (
    (OldTopic, "DEX1-TOPIC-01", ()),
    (OtherStateType, "DEX1-TOPIC-01", ()),
    (OtherCommandType, "DEX1-TOPIC-02", ()),
    (DemandsHistory, "DEX1-QOS-01", ()),
    (BestEffortWriter, "DEX1-QOS-02", ()),
    (SilentUntilCommanded, "DEX1-START-01", ()),
    (SlowPublisher, "DEX1-RATE-01", ()),
    (HalfRate, "DEX1-RATE-02", ()),
    (Hiccup, "DEX1-RATE-03", ()),
    (Bursts, "DEX1-RATE-04", ()),
    (RepeatsOldStates, "DEX1-ORDER-01", ()),
    (StaleState, "DEX1-FRESH-01", ()),
    (TwoMotors, "DEX1-FIELD-01", ()),
    (EmptyNowAndThen, "DEX1-FIELD-01", ()),
    (NanVelocity, "DEX1-FIELD-02", ()),
    (Percent, "DEX1-FIELD-03", ()),
    (TurnedVelocity, "DEX1-FIELD-04", ()),
    (Inverted, "DEX1-MOVE-01", ()),
    (Frozen, "DEX1-MOVE-01", ()),
    (OtherScale, "DEX1-MOVE-02", ()),
    (Hunts, "DEX1-MOVE-03", ()),
    # a session is faster than this hand can go
    (Slow, "DEX1-MOVE-04", ("DEX1-TRACK-01",)),
    (Overshoots, "DEX1-MOVE-05", ()),
    (Coupled, "DEX1-SIDE-01", ()),
    # a hand that answers to the other side's topic does not answer to its own
    (Swapped, "DEX1-SIDE-01", ("DEX1-MOVE-01",)),
    (IgnoresGains, "DEX1-GAIN-01", ()),
    (NoForce, "DEX1-FORCE-01", ()),
    (ForceAtRest, "DEX1-FORCE-02", ()),
    (UnsignedForce, "DEX1-FORCE-03", ()),
    (NanIsZero, "DEX1-SAFE-01", ()),
    (NoLimits, "DEX1-SAFE-02", ()),
    (EmptyIsZero, "DEX1-SAFE-03", ()),
    (DiesOfEmpty, "DEX1-SAFE-03", ()),
    (NoWatchdog, "DEX1-WDOG-01", ()),
    (QuietInSilence, "DEX1-WDOG-02", ()),
    (LatchesTheBrake, "DEX1-WDOG-03", ()),
    (ServesOnlyTheFirst, "DEX1-LIFE-01", ()),
    (BoundToOneClient, "DEX1-LIFE-02", ()),
    (WaitsForRest, "DEX1-TRACK-01", ()),
    (Delayed, "DEX1-TRACK-02", ()),
)
"""(mutant, requirement that must catch it, requirements that cannot but fail with it)."""
