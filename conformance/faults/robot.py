"""Wrong robots: each is made as an H1 and as a G1, where both have the requirement."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dexkit.conformance.faults.registry import wrong_hand
from dexkit.conformance.virtual import MemoryTrace, Sample
from dexkit.conformance.virtual.robot import Orders, ReferenceRobot
from dexkit.hand import Floats, RobotSubject, Subject
from dexkit.messages import decode, message_type
from dexkit.models import Dialect
from dexkit.robots import ROBOTS
from dexkit.traces import TraceEndpoint
from dexkit.wire.crc32 import crc32_words

_EARLY = 0.8  # s: while the kit only listens

# ------------------------------------------------------------------------------------ discovery


class _OtherFamily(ReferenceRobot):
    @property
    def others(self) -> tuple[str, str]:
        """Command and state type of the other family."""
        other = next(b for b in ROBOTS.values() if b.family != self.robot.family)
        return other.cmd_type, other.state_type


@wrong_hand("H1-TOPIC-01")
class OtherState(_OtherFamily):
    """Publishes the other family's LowState_."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[RobotSubject], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.state_type = self.others[1]

    def state_with_crc(self) -> bytes:
        kind = message_type(self.state_type)
        return kind.encode(kind.cls())


@wrong_hand("H1-TOPIC-02")
class OtherCommands(_OtherFamily):
    """Subscribes to the other family's LowCmd_."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[RobotSubject], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.command_type = self.others[0]


@wrong_hand("H1-TOPIC-03")
class TwoStatePublishers(ReferenceRobot):
    """Two publishers send its state."""

    def endpoints(self) -> list[TraceEndpoint]:
        every = super().endpoints()
        return every + [e for e in every if e.kind == "writer"]


@wrong_hand("H1-QOS-01")
class AsksForMore(ReferenceRobot):
    """Requests TRANSIENT_LOCAL commands, which no official client offers."""

    reader_durability = "TransientLocal"


@wrong_hand("H1-QOS-02")
class BestEffort(ReferenceRobot):
    """Publishes its state with best-effort reliability."""

    writer_reliability = "best_effort"


@wrong_hand("H1-START-01")
class WaitsForCommands(ReferenceRobot):
    """Publishes nothing before the first command."""

    def publish(self) -> list[Sample]:
        return super().publish() if self.orders is not None else []


# ------------------------------------------------------------------------------------ integrity


@wrong_hand("H1-FIELD-01")
class CutShort(ReferenceRobot):
    """Its first states lack their last four bytes."""

    def state_with_crc(self) -> bytes:
        payload = super().state_with_crc()
        return payload[:-4] if self.now < _EARLY else payload


@wrong_hand("H1-FIELD-02")
class NotANumber(ReferenceRobot):
    """Publishes NaN as ddq of one motor at first."""

    def message(self) -> Any:
        state = super().message()
        state.motor_state[0].ddq = math.nan if self.now < _EARLY else 0.0
        return state


@wrong_hand("H1-CRC-01")
class CdrCrc(ReferenceRobot):
    """Computes the CRC over the CDR bytes."""

    def state_with_crc(self) -> bytes:
        payload = super().state_with_crc()
        return payload[:-4] + crc32_words(payload[4:-4]).to_bytes(4, "little")


@wrong_hand("H1-CRC-01")
class NoCrc(ReferenceRobot):
    """Publishes a CRC of 0."""

    def state_with_crc(self) -> bytes:
        return super().state_with_crc()[:-4] + bytes(4)


# ----------------------------------------------------------------------------------------- rate


@wrong_hand("H1-RATE-01")
class Slow(ReferenceRobot):
    """Publishes at 100 Hz."""

    period = 0.01


@wrong_hand("H1-RATE-02")
class StateAt333Hz(ReferenceRobot):
    """Publishes at 333 Hz."""

    period = 0.003


@wrong_hand("H1-RATE-03")
class StateGap(ReferenceRobot):
    """Publishes nothing for 0.2 s once."""

    def publish(self) -> list[Sample]:
        return [] if 0.5 < self.now < 0.7 else super().publish()


@wrong_hand("H1-ORDER-01")
class Repeats(ReferenceRobot):
    """Publishes some states twice."""

    def publish(self) -> list[Sample]:
        found = super().publish()
        return found * 2 if self.now < _EARLY and self.ticks() % 50 == 0 else found


@wrong_hand("H1-TICK-01")
class NoTick(ReferenceRobot):
    """Publishes a tick of 0."""

    def ticks(self) -> int:
        return 0


@wrong_hand("H1-TICK-02")
class CountsStates(ReferenceRobot):
    """Counts states instead of milliseconds in tick."""

    def ticks(self) -> int:
        return super().ticks() // 2


# --------------------------------------------------------------------------------------- fields


@wrong_hand("H1-FIELD-03")
class TurnedOnce(ReferenceRobot):
    """Publishes one joint a full turn off."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[RobotSubject], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        slot = self.robot.slot("right_knee")
        for values in (self.q, self.low, self.high):
            values[slot] += 2 * math.pi


@wrong_hand("H1-FIELD-04")
class NoSpeed(ReferenceRobot):
    """Publishes dq as 0."""

    def shown(self) -> tuple[Floats, Floats, Floats]:
        q, dq, tau = super().shown()
        return q, np.zeros_like(dq), tau


@wrong_hand("H1-FIELD-05")
class PositionInUnusedSlot(ReferenceRobot):
    """Publishes a position in a slot without a motor."""

    def message(self) -> Any:
        state = super().message()
        unused = next(s for s in range(self.robot.slots) if s not in self.robot.used)
        state.motor_state[unused].q = 0.5
        return state


@wrong_hand("H1-TEMP-01")
class NoSensor(ReferenceRobot):
    """Publishes a temperature of 255 where it has none."""

    def warmth(self) -> Any:
        return 255


@wrong_hand("H1-TEMP-02")
class TemperaturesZero(ReferenceRobot):
    """Publishes motor temperatures of 0."""

    def warmth(self) -> Any:
        return 0 if self.robot.motor_temperatures == 1 else (0, 0)


@wrong_hand("H1-IMU-01")
class NoAttitude(ReferenceRobot):
    """Publishes a quaternion of zeros."""

    def attitude(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (0.0,) * 4, (0.0,) * 3


@wrong_hand("H1-IMU-02")
class WLast(ReferenceRobot):
    """Publishes the quaternion with w last."""

    def attitude(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        (w, x, y, z), rpy = super().attitude()
        return (x, y, z, w), rpy


@wrong_hand("H1-IMU-03")
class InG(ReferenceRobot):
    """Publishes accelerations in g."""

    def gravity(self) -> tuple[float, float, float]:
        return (0.0, 0.0, 1.0)


@wrong_hand("H1-HEAD-01")
class NoHead(ReferenceRobot):
    """Publishes a head of 0."""

    def message(self) -> Any:
        state = super().message()
        state.head = (0, 0)
        return state


@wrong_hand("H1-BMS-01")
class BatteryChargeZero(ReferenceRobot):
    """Publishes a battery charge of 0 %."""

    def message(self) -> Any:
        state = super().message()
        state.bms_state.soc = 0
        return state


@wrong_hand("H1-FOOT-01")
class NegativeFootForce(ReferenceRobot):
    """Publishes a negative foot force."""

    def message(self) -> Any:
        state = super().message()
        state.foot_force = (-100, 0, 0, 0)
        return state


@wrong_hand("H1-REMOTE-01")
class RemoteRubbish(ReferenceRobot):
    """Publishes uninitialised bytes of the remote control."""

    def remote(self) -> bytes:
        return b"\xaa\x55" * 20


@wrong_hand("H1-REMOTE-01")
class ShiftedRemote(ReferenceRobot):
    """Publishes the remote control's sticks two bytes too early."""

    def remote(self) -> bytes:
        return struct.pack("<H5f18x", 0, 0.5, 0.7, -0.3, 0.9, -0.25)


@wrong_hand("G1-MACH-01")
class NoMachine(ReferenceRobot):
    """Publishes a mode_machine of 0."""

    def message(self) -> Any:
        state = super().message()
        state.mode_machine = 0
        return state


@wrong_hand("H1-MODE-01")
class NoMode(ReferenceRobot):
    """Publishes mode bytes of 0."""

    def modes(self) -> list[int]:
        return [0] * self.robot.slots


# --------------------------------------------------------------------------------------- motion


@wrong_hand("H1-MOVE-01")
class Halfway(ReferenceRobot):
    """Moves only half of the way to its goals."""

    def obey(self, orders: Orders) -> None:
        if orders is not self.orders:
            rest = np.array(self.robot.rest_q)
            orders.q = rest + (orders.q - rest) / 2
        super().obey(orders)


@wrong_hand("H1-MOVE-02")
class Coupled(ReferenceRobot):
    """Its hip moves along with the elbow."""

    def live(self, dt: float) -> None:
        elbow, hip = self.robot.slot("right_elbow"), self.robot.slot("right_hip_pitch")
        before = self.q[elbow]
        super().live(dt)
        if self.driven:
            self.q[hip] += 3.0 * (self.q[elbow] - before)


@wrong_hand("H1-GAIN-01")
class OwnGains(ReferenceRobot):
    """Uses its own kp wherever kp is not 0."""

    def obey(self, orders: Orders) -> None:
        own = np.array(self.robot.client_gains)[:, 0]
        orders.kp = np.where(orders.kp > 0, own, 0.0)
        super().obey(orders)


@wrong_hand("H1-GAIN-02")
class NoVelocity(ReferenceRobot):
    """Ignores dq."""

    def obey(self, orders: Orders) -> None:
        orders.dq = np.zeros_like(orders.dq)
        super().obey(orders)


@wrong_hand("H1-GAIN-03")
class NoTorque(ReferenceRobot):
    """Ignores tau."""

    def obey(self, orders: Orders) -> None:
        orders.tau = np.zeros_like(orders.tau)
        super().obey(orders)


@wrong_hand("H1-GAIN-04")
class DefaultGains(ReferenceRobot):
    """Uses its own kp where kp is 0."""

    def obey(self, orders: Orders) -> None:
        own = np.array(self.robot.client_gains)[:, 0]
        idle = (orders.kp == 0) & (orders.dq == 0) & (orders.tau == 0)
        orders.kp = np.where(idle, own, orders.kp)
        super().obey(orders)


@wrong_hand("H1-FORCE-01")
class NoForce(ReferenceRobot):
    """Publishes tau_est as 0."""

    def shown(self) -> tuple[Floats, Floats, Floats]:
        q, dq, tau = super().shown()
        return q, dq, np.zeros_like(tau)


# --------------------------------------------------------------------------------------- safety


@wrong_hand("H1-MODE-02")
class NoModes(ReferenceRobot):
    """Ignores the mode byte of commands."""

    def follows(self, orders: Orders) -> Any:
        return np.ones(self.robot.slots, dtype=np.bool_)


@wrong_hand("H1-CRC-02")
class CommandCrcNotChecked(ReferenceRobot):
    """Does not check the CRC of commands."""

    def intact(self, payload: bytes) -> bool:
        return True


@wrong_hand("H1-SAFE-01")
class Sanitises(ReferenceRobot):
    """Replaces NaN and infinity by 0, and obeys the rest."""

    def accepts(self, orders: Orders) -> bool:
        for name in ("q", "dq", "tau", "kp", "kd"):
            values = getattr(orders, name)
            setattr(orders, name, np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0))
        return super().accepts(orders)


@wrong_hand("H1-SAFE-02")
class Packed(ReferenceRobot):
    """Obeys the slot without a motor as a joint's."""

    def obey(self, orders: Orders) -> None:
        unused = [s for s in range(self.robot.slots) if s not in self.robot.used]
        if orders is not self.orders and orders.kp[unused].any():
            orders.q[0] = orders.q[unused[0]]
        super().obey(orders)


@wrong_hand("H1-SAFE-03")
class Untyped(_OtherFamily):
    """Decodes and obeys any type that is published on its command topic."""

    def foreign(self, topic: str, type_name: str, payload: bytes) -> None:
        message = decode(type_name, payload)
        orders = Orders(message)
        slots = self.robot.slots
        for name in ("mode", "q", "dq", "tau", "kp", "kd"):
            values = np.zeros(slots)
            given = getattr(orders, name)[:slots]
            values[: len(given)] = given
            setattr(orders, name, values)
        self.obey(orders)


@wrong_hand("H1-SAFE-04")
class IgnoresCommandsAfterNan(ReferenceRobot):
    """Ignores commands for about 2 s after a NaN."""

    until = -math.inf

    def accepts(self, orders: Orders) -> bool:
        if not self.finite(orders):
            self.until = self.now + (1.8 if self.robot.mode_machine is None else 2.3)
        return super().accepts(orders) and self.now >= self.until


@wrong_hand("G1-SAFE-05")
class AnyMachine(ReferenceRobot):
    """Obeys commands for another machine."""

    def accepts(self, orders: Orders) -> bool:
        return self.finite(orders)


# ------------------------------------------------------------------------------------- watchdog


@wrong_hand("H1-WDOG-01")
class GoesOn(ReferenceRobot):
    """Has no time-out."""

    timeout = math.inf


@wrong_hand("H1-WDOG-02")
class AnswersOnly(ReferenceRobot):
    """Publishes nothing 0.5 s after the last command."""

    def publish(self) -> list[Sample]:
        waited = self.now - self.heard
        return [] if 0.5 < waited < math.inf else super().publish()


@wrong_hand("H1-WDOG-03")
class Latches(ReferenceRobot):
    """Obeys no command after a time-out."""

    def obey(self, orders: Orders) -> None:
        if self.now - self.heard <= self.timeout or self.orders is None:
            super().obey(orders)


@wrong_hand("H1-WDOG-04")
class TimeoutTooShort(ReferenceRobot):
    """Times out after 0.15 s."""

    timeout = 0.15


# ----------------------------------------------------------------------------------- life cycle


@wrong_hand("H1-LIFE-01")
class NoStateForLateSubscribers(ReferenceRobot):
    """Its states reach only subscribers that were there when it started."""

    serves_late_readers = False


@wrong_hand("H1-LIFE-02")
class ObeysFirstClientOnly(ReferenceRobot):
    """Obeys only the first client."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client == 0:
            super().receive(topic, payload, client)


@wrong_hand("H1-CLIENT-01")
class ForgetfulClient(ReferenceRobot):
    """Its client sends some commands without a CRC."""

    @classmethod
    def recorded(cls, trace: MemoryTrace) -> None:
        for (topic, _), rows in trace.rows.items():
            if topic == "rt/lowcmd":
                rows[::100] = [(a, b, data[:-4] + bytes(4)) for a, b, data in rows[::100]]


@wrong_hand("H1-CLIENT-02")
class SlowClient(ReferenceRobot):
    """Its client sends only every fourth command."""

    @classmethod
    def recorded(cls, trace: MemoryTrace) -> None:
        for (topic, _), rows in trace.rows.items():
            if topic == "rt/lowcmd":
                del rows[1::4], rows[1::3], rows[1::2]
