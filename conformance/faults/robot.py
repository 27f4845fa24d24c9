"""Wrong robots: each is made as an H1 and as a G1, where both have the requirement."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np

from dexkit.conformance.faults.registry import Call, changes, wrong_hand
from dexkit.conformance.virtual import MemoryTrace
from dexkit.conformance.virtual.robot import Orders, ReferenceRobot
from dexkit.messages import decode, message_type
from dexkit.robots import ROBOTS
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

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state_type = self.others[1]

    def state_with_crc(self) -> bytes:
        kind = message_type(self.state_type)
        return kind.encode(kind.cls())


@wrong_hand("H1-TOPIC-02")
class OtherCommands(_OtherFamily):
    """Subscribes to the other family's LowCmd_."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.command_type = self.others[0]


@changes(ReferenceRobot, "endpoints", "H1-TOPIC-03")
def TwoStatePublishers(self: Any, endpoints: Call) -> Any:
    """Two publishers send its state."""
    every = endpoints()
    return every + [e for e in every if e.kind == "writer"]


@wrong_hand("H1-QOS-01")
class AsksForMore(ReferenceRobot):
    """Requests TRANSIENT_LOCAL commands, which no official client offers."""

    reader_durability = "TransientLocal"


@wrong_hand("H1-QOS-01")
class BestEffort(ReferenceRobot):
    """Publishes its state with best-effort reliability."""

    writer_reliability = "best_effort"


@changes(ReferenceRobot, "publish", "H1-START-01")
def WaitsForCommands(self: Any, publish: Call) -> Any:
    """Publishes nothing before the first command."""
    return publish() if self.orders is not None else []


# ------------------------------------------------------------------------------------ integrity


@changes(ReferenceRobot, "state_with_crc", "H1-FIELD-01")
def CutShort(self: Any, state_with_crc: Call) -> Any:
    """Its first states lack their last four bytes."""
    payload = state_with_crc()
    return payload[:-4] if self.now < _EARLY else payload


@changes(ReferenceRobot, "message", "H1-FIELD-01")
def NotANumber(self: Any, message: Call) -> Any:
    """Publishes NaN as ddq of one motor at first."""
    state = message()
    state.motor_state[0].ddq = math.nan if self.now < _EARLY else 0.0
    return state


@changes(ReferenceRobot, "state_with_crc", "H1-CRC-01")
def CdrCrc(self: Any, state_with_crc: Call) -> Any:
    """Computes the CRC over the CDR bytes."""
    payload = state_with_crc()
    return payload[:-4] + crc32_words(payload[4:-4]).to_bytes(4, "little")


@changes(ReferenceRobot, "state_with_crc", "H1-CRC-01")
def NoCrc(self: Any, state_with_crc: Call) -> Any:
    """Publishes a CRC of 0."""
    return state_with_crc()[:-4] + bytes(4)


# ----------------------------------------------------------------------------------------- rate


@wrong_hand("H1-RATE-01")
class Slow(ReferenceRobot):
    """Publishes at 100 Hz."""

    period = 0.01


@wrong_hand("H1-RATE-01")
class StateAt333Hz(ReferenceRobot):
    """Publishes at 333 Hz."""

    period = 0.003


@changes(ReferenceRobot, "publish", "H1-RATE-03")
def StateGap(self: Any, publish: Call) -> Any:
    """Publishes nothing for 0.2 s once."""
    return [] if 0.5 < self.now < 0.7 else publish()


@changes(ReferenceRobot, "publish", "H1-ORDER-01")
def Repeats(self: Any, publish: Call) -> Any:
    """Publishes some states twice."""
    found = publish()
    return found * 2 if self.now < _EARLY and self.ticks() % 50 == 0 else found


@changes(ReferenceRobot, "ticks", "H1-TICK-01")
def NoTick(self: Any, ticks: Call) -> int:
    """Publishes a tick of 0."""
    return 0


@changes(ReferenceRobot, "ticks", "H1-TICK-01")
def CountsStates(self: Any, ticks: Call) -> Any:
    """Counts states instead of milliseconds in tick."""
    return ticks() // 2


# --------------------------------------------------------------------------------------- fields


@wrong_hand("H1-FIELD-03")
class TurnedOnce(ReferenceRobot):
    """Publishes one joint a full turn off."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        slot = self.robot.slot("right_knee")
        for values in (self.q, self.low, self.high):
            values[slot] += 2 * math.pi


@changes(ReferenceRobot, "shown", "H1-FIELD-04")
def NoSpeed(self: Any, shown: Call) -> Any:
    """Publishes dq as 0."""
    q, dq, tau = shown()
    return q, np.zeros_like(dq), tau


@changes(ReferenceRobot, "message", "H1-FIELD-05")
def PositionInUnusedSlot(self: Any, message: Call) -> Any:
    """Publishes a position in a slot without a motor."""
    state = message()
    unused = next(s for s in range(self.robot.slots) if s not in self.robot.used)
    state.motor_state[unused].q = 0.5
    return state


@changes(ReferenceRobot, "warmth", "H1-TEMP-01")
def NoSensor(self: Any, warmth: Call) -> Any:
    """Publishes a temperature of 255 where it has none."""
    return 255


@changes(ReferenceRobot, "warmth", "H1-TEMP-02")
def TemperaturesZero(self: Any, warmth: Call) -> Any:
    """Publishes motor temperatures of 0."""
    return 0 if self.robot.motor_temperatures == 1 else (0, 0)


@changes(ReferenceRobot, "attitude", "H1-IMU-01")
def NoAttitude(self: Any, attitude: Call) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Publishes a quaternion of zeros."""
    return (0.0,) * 4, (0.0,) * 3


@changes(ReferenceRobot, "attitude", "H1-IMU-02")
def WLast(self: Any, attitude: Call) -> Any:
    """Publishes the quaternion with w last."""
    (w, x, y, z), rpy = attitude()
    return (x, y, z, w), rpy


@changes(ReferenceRobot, "gravity", "H1-IMU-03")
def InG(self: Any, gravity: Call) -> tuple[float, float, float]:
    """Publishes accelerations in g."""
    return (0.0, 0.0, 1.0)


@changes(ReferenceRobot, "message", "H1-HEAD-01")
def NoHead(self: Any, message: Call) -> Any:
    """Publishes a head of 0."""
    state = message()
    state.head = (0, 0)
    return state


@changes(ReferenceRobot, "message", "H1-BMS-01")
def BatteryChargeZero(self: Any, message: Call) -> Any:
    """Publishes a battery charge of 0 %."""
    state = message()
    state.bms_state.soc = 0
    return state


@changes(ReferenceRobot, "message", "H1-FOOT-01")
def NegativeFootForce(self: Any, message: Call) -> Any:
    """Publishes a negative foot force."""
    state = message()
    state.foot_force = (-100, 0, 0, 0)
    return state


@changes(ReferenceRobot, "remote", "H1-REMOTE-01")
def RemoteRubbish(self: Any, remote: Call) -> bytes:
    """Publishes uninitialised bytes of the remote control."""
    return b"\xaa\x55" * 20


@changes(ReferenceRobot, "remote", "H1-REMOTE-01")
def ShiftedRemote(self: Any, remote: Call) -> bytes:
    """Publishes the remote control's sticks two bytes too early."""
    return struct.pack("<H5f18x", 0, 0.5, 0.7, -0.3, 0.9, -0.25)


@changes(ReferenceRobot, "message", "G1-MACH-01")
def NoMachine(self: Any, message: Call) -> Any:
    """Publishes a mode_machine of 0."""
    state = message()
    state.mode_machine = 0
    return state


@changes(ReferenceRobot, "modes", "H1-MODE-01")
def NoMode(self: Any, modes: Call) -> list[int]:
    """Publishes mode bytes of 0."""
    return [0] * self.robot.slots


# --------------------------------------------------------------------------------------- motion


@changes(ReferenceRobot, "obey", "H1-MOVE-01")
def Halfway(self: Any, obey: Call, orders: Orders) -> None:
    """Moves only half of the way to its goals."""
    if orders is not self.orders:
        rest = np.array(self.robot.rest_q)
        orders.q = rest + (orders.q - rest) / 2
    obey(orders)


@changes(ReferenceRobot, "live", "H1-MOVE-02")
def Coupled(self: Any, live: Call, dt: float) -> None:
    """Its hip moves along with the elbow."""
    elbow, hip = self.robot.slot("right_elbow"), self.robot.slot("right_hip_pitch")
    before = self.q[elbow]
    live(dt)
    if self.driven:
        self.q[hip] += 3.0 * (self.q[elbow] - before)


@changes(ReferenceRobot, "obey", "H1-GAIN-01")
def OwnGains(self: Any, obey: Call, orders: Orders) -> None:
    """Uses its own kp wherever kp is not 0."""
    own = np.array(self.robot.client_gains)[:, 0]
    orders.kp = np.where(orders.kp > 0, own, 0.0)
    obey(orders)


@changes(ReferenceRobot, "obey", "H1-GAIN-02")
def NoVelocity(self: Any, obey: Call, orders: Orders) -> None:
    """Ignores dq."""
    orders.dq = np.zeros_like(orders.dq)
    obey(orders)


@changes(ReferenceRobot, "obey", "H1-GAIN-03")
def NoTorque(self: Any, obey: Call, orders: Orders) -> None:
    """Ignores tau."""
    orders.tau = np.zeros_like(orders.tau)
    obey(orders)


@changes(ReferenceRobot, "obey", "H1-GAIN-04")
def DefaultGains(self: Any, obey: Call, orders: Orders) -> None:
    """Uses its own kp where kp is 0."""
    own = np.array(self.robot.client_gains)[:, 0]
    idle = (orders.kp == 0) & (orders.dq == 0) & (orders.tau == 0)
    orders.kp = np.where(idle, own, orders.kp)
    obey(orders)


@changes(ReferenceRobot, "shown", "H1-FORCE-01")
def NoForce(self: Any, shown: Call) -> Any:
    """Publishes tau_est as 0."""
    q, dq, tau = shown()
    return q, dq, np.zeros_like(tau)


# --------------------------------------------------------------------------------------- safety


@changes(ReferenceRobot, "follows", "H1-MODE-02")
def NoModes(self: Any, usual: Call, orders: Orders) -> Any:
    """Ignores the mode byte of commands."""
    return np.ones(self.robot.slots, dtype=np.bool_)


@changes(ReferenceRobot, "intact", "H1-CRC-02")
def CommandCrcNotChecked(self: Any, intact: Call, payload: bytes) -> bool:
    """Does not check the CRC of commands."""
    return True


@changes(ReferenceRobot, "accepts", "H1-SAFE-01")
def Sanitises(self: Any, accepts: Call, orders: Orders) -> Any:
    """Replaces NaN and infinity by 0, and obeys the rest."""
    for name in ("q", "dq", "tau", "kp", "kd"):
        values = getattr(orders, name)
        setattr(orders, name, np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0))
    return accepts(orders)


@changes(ReferenceRobot, "obey", "H1-SAFE-02")
def Packed(self: Any, obey: Call, orders: Orders) -> None:
    """Obeys the slot without a motor as a joint's."""
    unused = [s for s in range(self.robot.slots) if s not in self.robot.used]
    if orders is not self.orders and orders.kp[unused].any():
        orders.q[0] = orders.q[unused[0]]
    obey(orders)


@changes(_OtherFamily, "foreign", "H1-SAFE-03")
def Untyped(self: Any, foreign: Call, topic: str, type_name: str, payload: bytes) -> None:
    """Decodes and obeys any type that is published on its command topic."""
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


@changes(ReferenceRobot, "accepts", "G1-SAFE-05")
def AnyMachine(self: Any, accepts: Call, orders: Orders) -> Any:
    """Obeys commands for another machine."""
    return self.finite(orders)


# ------------------------------------------------------------------------------------- watchdog


@wrong_hand("H1-WDOG-01")
class GoesOn(ReferenceRobot):
    """Has no time-out."""

    timeout = math.inf


@changes(ReferenceRobot, "publish", "H1-WDOG-02")
def AnswersOnly(self: Any, publish: Call) -> Any:
    """Publishes nothing 0.5 s after the last command."""
    waited = self.now - self.heard
    return [] if 0.5 < waited < math.inf else publish()


@changes(ReferenceRobot, "obey", "H1-WDOG-03")
def Latches(self: Any, obey: Call, orders: Orders) -> None:
    """Obeys no command after a time-out."""
    if self.now - self.heard <= self.timeout or self.orders is None:
        obey(orders)


@wrong_hand("H1-WDOG-04")
class TimeoutTooShort(ReferenceRobot):
    """Times out after 0.15 s."""

    timeout = 0.15


# ----------------------------------------------------------------------------------- life cycle


@wrong_hand("H1-LIFE-01")
class NoStateForLateSubscribers(ReferenceRobot):
    """Its states reach only subscribers that were there when it started."""

    serves_late_readers = False


@changes(ReferenceRobot, "receive", "H1-LIFE-02")
def ObeysFirstClientOnly(self: Any, receive: Call, topic: str, payload: bytes, client: int) -> None:
    """Obeys only the first client."""
    if client == 0:
        receive(topic, payload, client)


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
