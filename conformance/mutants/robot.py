"""Bodies that are wrong in one way each; see :mod:`dexkit.conformance.mutants`.

Each is tried as an H1 and as a G1, where the requirement that it breaks is about both.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dexkit.conformance.judge import judge
from dexkit.conformance.requirements import catalogue, select
from dexkit.conformance.results import Verdict
from dexkit.conformance.robot import robot_dialect, robot_recording
from dexkit.conformance.stimuli import Plan, phases_for
from dexkit.conformance.stimulus_record import ROBOT
from dexkit.conformance.virtual import MemoryTrace, Sample, run_virtual
from dexkit.conformance.virtual.robot import Orders, ReferenceRobot
from dexkit.hand import Floats, Side
from dexkit.messages import decode, message_type
from dexkit.models import Dialect
from dexkit.robots import ROBOTS
from dexkit.traces import TraceEndpoint
from dexkit.wire.crc32 import crc32_words

__all__ = ["MUTANTS", "RobotMutant", "run_robot_mutant"]

_EARLY = 0.8  # s: while the kit only listens

# ------------------------------------------------------------------------------------ discovery


class _OtherFamily(ReferenceRobot):
    @property
    def others(self) -> tuple[str, str]:
        """Command and state type of the other family."""
        other = next(b for b in ROBOTS.values() if b.family != self.robot.family)
        return other.cmd_type, other.state_type


class OtherState(_OtherFamily):
    """Publishes the other family's LowState_."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Side, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.state_type = self.others[1]

    def sealed(self) -> bytes:
        kind = message_type(self.state_type)
        return kind.encode(kind.cls())


class OtherCommands(_OtherFamily):
    """Listens for the other family's LowCmd_."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Side, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        self.command_type = self.others[0]


class Twins(ReferenceRobot):
    """Two of them publish."""

    def endpoints(self) -> list[TraceEndpoint]:
        every = super().endpoints()
        return every + [e for e in every if e.kind == "writer"]


class AsksForMore(ReferenceRobot):
    """Asks for the commands from before it came."""

    reader_durability = "TransientLocal"


class BestEffort(ReferenceRobot):
    """Offers its state without reliability."""

    writer_reliability = "best_effort"


class WaitsForCommands(ReferenceRobot):
    """Says nothing until it is commanded."""

    def publish(self) -> list[Sample]:
        return super().publish() if self.orders is not None else []


# ------------------------------------------------------------------------------------ integrity


class CutShort(ReferenceRobot):
    """Its first states lack the last word."""

    def sealed(self) -> bytes:
        payload = super().sealed()
        return payload[:-4] if self.now < _EARLY else payload


class NotANumber(ReferenceRobot):
    """Divides by a time of zero at first."""

    def message(self) -> Any:
        state = super().message()
        state.motor_state[0].ddq = math.nan if self.now < _EARLY else 0.0
        return state


class CdrCrc(ReferenceRobot):
    """Computes the CRC over the CDR bytes."""

    def sealed(self) -> bytes:
        payload = super().sealed()
        return payload[:-4] + crc32_words(payload[4:-4]).to_bytes(4, "little")


class NoCrc(ReferenceRobot):
    """Leaves the CRC 0."""

    def sealed(self) -> bytes:
        return super().sealed()[:-4] + bytes(4)


# ----------------------------------------------------------------------------------------- rate


class Slow(ReferenceRobot):
    """Publishes 100 times a second."""

    period = 0.01


class Leisurely(ReferenceRobot):
    """Publishes 333 times a second."""

    period = 0.003


class Stumbles(ReferenceRobot):
    """Says nothing for a fifth of a second."""

    def publish(self) -> list[Sample]:
        return [] if 0.5 < self.now < 0.7 else super().publish()


class Repeats(ReferenceRobot):
    """Sends some states twice."""

    def publish(self) -> list[Sample]:
        found = super().publish()
        return found * 2 if self.now < _EARLY and self.ticks() % 50 == 0 else found


class NoTick(ReferenceRobot):
    """Leaves tick 0."""

    def ticks(self) -> int:
        return 0


class CountsStates(ReferenceRobot):
    """Counts states instead of milliseconds."""

    def ticks(self) -> int:
        return super().ticks() // 2


# --------------------------------------------------------------------------------------- fields


class TurnedOnce(ReferenceRobot):
    """One encoder counts from a turn further."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Side, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        slot = self.robot.slot("right_knee")
        for values in (self.q, self.low, self.high):
            values[slot] += 2 * math.pi


class NoSpeed(ReferenceRobot):
    """Leaves dq 0."""

    def shown(self) -> tuple[Floats, Floats, Floats]:
        q, dq, tau = super().shown()
        return q, np.zeros_like(dq), tau


class Ghost(ReferenceRobot):
    """Tells of a motor where none is."""

    def message(self) -> Any:
        state = super().message()
        unused = next(s for s in range(self.robot.slots) if s not in self.robot.used)
        state.motor_state[unused].q = 0.5
        return state


class NoSensor(ReferenceRobot):
    """Takes 255 for "no temperature"."""

    def warmth(self) -> Any:
        return 255


class Frozen(ReferenceRobot):
    """Leaves the motors' temperatures 0."""

    def warmth(self) -> Any:
        return 0 if self.robot.family == "unitree_go" else (0, 0)


class NoAttitude(ReferenceRobot):
    """Leaves the quaternion 0."""

    def attitude(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (0.0,) * 4, (0.0,) * 3


class WLast(ReferenceRobot):
    """Writes the quaternion with w last."""

    def attitude(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        (w, x, y, z), rpy = super().attitude()
        return (x, y, z, w), rpy


class InG(ReferenceRobot):
    """Tells accelerations in g."""

    def gravity(self) -> tuple[float, float, float]:
        return (0.0, 0.0, 1.0)


class NoHead(ReferenceRobot):
    """Leaves the head 0."""

    def message(self) -> Any:
        state = super().message()
        state.head = (0, 0)
        return state


class Empty(ReferenceRobot):
    """Has an empty battery."""

    def message(self) -> Any:
        state = super().message()
        state.bms_state.soc = 0
        return state


class Hangs(ReferenceRobot):
    """Its feet pull."""

    def message(self) -> Any:
        state = super().message()
        state.foot_force = (-100, 0, 0, 0)
        return state


class RemoteRubbish(ReferenceRobot):
    """Does not clear the remote's bytes."""

    def remote(self) -> bytes:
        return b"\xaa\x55" * 20


class ShiftedRemote(ReferenceRobot):
    """Writes the sticks without the two bytes before them."""

    def remote(self) -> bytes:
        return struct.pack("<H5f18x", 0, 0.5, 0.7, -0.3, 0.9, -0.25)


class NoMachine(ReferenceRobot):
    """Leaves mode_machine 0."""

    def message(self) -> Any:
        state = super().message()
        state.mode_machine = 0
        return state


class NoMode(ReferenceRobot):
    """Leaves the mode bytes 0."""

    def modes(self) -> list[int]:
        return [0] * self.robot.slots


# --------------------------------------------------------------------------------------- motion


class Halfway(ReferenceRobot):
    """Goes half of each way."""

    def obey(self, orders: Orders) -> None:
        if orders is not self.orders:
            rest = np.array(self.robot.rest_q)
            orders.q = rest + (orders.q - rest) / 2
        super().obey(orders)


class Coupled(ReferenceRobot):
    """Its hip gives way while the elbow moves."""

    def live(self, dt: float) -> None:
        elbow, hip = self.robot.slot("right_elbow"), self.robot.slot("right_hip_pitch")
        before = self.q[elbow]
        super().live(dt)
        if self.driven:
            self.q[hip] += 3.0 * (self.q[elbow] - before)


class OwnGains(ReferenceRobot):
    """Puts in its own stiffness."""

    def obey(self, orders: Orders) -> None:
        own = np.array(self.robot.client_gains)[:, 0]
        orders.kp = np.where(orders.kp > 0, own, 0.0)
        super().obey(orders)


class NoVelocity(ReferenceRobot):
    """Ignores dq."""

    def obey(self, orders: Orders) -> None:
        orders.dq = np.zeros_like(orders.dq)
        super().obey(orders)


class NoTorque(ReferenceRobot):
    """Ignores tau."""

    def obey(self, orders: Orders) -> None:
        orders.tau = np.zeros_like(orders.tau)
        super().obey(orders)


class DefaultGains(ReferenceRobot):
    """Takes kp 0 for "as usual"."""

    def obey(self, orders: Orders) -> None:
        own = np.array(self.robot.client_gains)[:, 0]
        idle = (orders.kp == 0) & (orders.dq == 0) & (orders.tau == 0)
        orders.kp = np.where(idle, own, orders.kp)
        super().obey(orders)


class NoForce(ReferenceRobot):
    """Leaves tau_est 0."""

    def shown(self) -> tuple[Floats, Floats, Floats]:
        q, dq, tau = super().shown()
        return q, dq, np.zeros_like(tau)


# --------------------------------------------------------------------------------------- safety


class NoModes(ReferenceRobot):
    """Does not look at the mode byte."""

    def follows(self, orders: Orders) -> Any:
        return np.ones(self.robot.slots, dtype=np.bool_)


class TrustsAll(ReferenceRobot):
    """Does not check the CRC."""

    def intact(self, payload: bytes) -> bool:
        return True


class Sanitises(ReferenceRobot):
    """Takes 0 for what is no number, and obeys the rest."""

    def accepts(self, orders: Orders) -> bool:
        for name in ("q", "dq", "tau", "kp", "kd"):
            values = getattr(orders, name)
            setattr(orders, name, np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0))
        return super().accepts(orders)


class Packed(ReferenceRobot):
    """Has a joint in the slot without a motor."""

    def obey(self, orders: Orders) -> None:
        unused = [s for s in range(self.robot.slots) if s not in self.robot.used]
        if orders is not self.orders and orders.kp[unused].any():
            orders.q[0] = orders.q[unused[0]]
        super().obey(orders)


class Untyped(_OtherFamily):
    """Takes whatever is on its command topic."""

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


class Sulks(ReferenceRobot):
    """Follows nothing for a while after a NaN."""

    until = -math.inf

    def accepts(self, orders: Orders) -> bool:
        if not self.finite(orders):
            self.until = self.now + (1.8 if self.robot.mode_machine is None else 2.3)
        return super().accepts(orders) and self.now >= self.until


class AnyMachine(ReferenceRobot):
    """Obeys commands for another machine."""

    def accepts(self, orders: Orders) -> bool:
        return self.finite(orders)


# ------------------------------------------------------------------------------------- watchdog


class GoesOn(ReferenceRobot):
    """Has no time-out."""

    timeout = math.inf


class AnswersOnly(ReferenceRobot):
    """Says nothing while it is told nothing."""

    def publish(self) -> list[Sample]:
        waited = self.now - self.heard
        return [] if 0.5 < waited < math.inf else super().publish()


class Latches(ReferenceRobot):
    """Follows nothing any more after a time-out."""

    def obey(self, orders: Orders) -> None:
        if self.now - self.heard <= self.timeout or self.orders is None:
            super().obey(orders)


class Nervous(ReferenceRobot):
    """Times out after a seventh of a second."""

    timeout = 0.15


# ----------------------------------------------------------------------------------- life cycle


class KnowsItsReaders(ReferenceRobot):
    """Serves only those who were there at first."""

    serves_late_readers = False


class Loyal(ReferenceRobot):
    """Follows the first client only."""

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        if client == 0:
            super().receive(topic, payload, client)


class ForgetfulClient(ReferenceRobot):
    """Its client does not set the CRC now and then."""

    @classmethod
    def recorded(cls, trace: MemoryTrace) -> None:
        for (topic, _), rows in trace.rows.items():
            if topic == "rt/lowcmd":
                rows[::100] = [(a, b, data[:-4] + bytes(4)) for a, b, data in rows[::100]]


class SlowClient(ReferenceRobot):
    """Its client sends every fourth command only."""

    @classmethod
    def recorded(cls, trace: MemoryTrace) -> None:
        for (topic, _), rows in trace.rows.items():
            if topic == "rt/lowcmd":
                del rows[1::4], rows[1::3], rows[1::2]


# ---------------------------------------------------------------------------------------- the zoo


@dataclass(frozen=True)
class RobotMutant:
    """One wrong robot.

    :param model: the robot that it is a bad copy of.
    :param kills: the requirement that must catch it.
    :param also: requirements that fail or warn with it.
    """

    model: str
    service: type[ReferenceRobot]
    kills: str
    also: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its class's name."""
        return self.service.__name__

    @property
    def summary(self) -> str:
        """What it does wrong, in a line."""
        return (self.service.__doc__ or "").strip().splitlines()[0]

    def blamed(self, *, short: bool = False) -> set[str]:
        """The requirements that find fault with it.

        :param short: go through no more phases than show it.
        """
        every = catalogue(self.model, "robot")
        if not short:
            return run_robot_mutant(self.service, self.model, phases_for(every))
        needed = select(every, prefixes=[self.kills, *self.also])
        phases = phases_for(needed)
        if not any(r.phase == "joint" for r in needed):
            phases -= {"joint"}  # by far the longest: all of them were moved for the others
        return run_robot_mutant(self.service, self.model, phases)


def run_robot_mutant(service: type[ReferenceRobot], model: str, phases: frozenset[str]) -> set[str]:
    """The requirements that find fault with a robot on the virtual clock."""
    trace = run_virtual(Plan(robot_dialect(model), (ROBOT,), phases=phases), service)
    service.recorded(trace)
    bad = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
    results = judge(robot_recording(trace, model)).results
    return {r.requirement.id for r in results if r.verdict in bad}


_DEAF = ("MOVE-01", "MODE-01", "WDOG-03")
_ZOO: tuple[tuple[type[ReferenceRobot], str, tuple[str, ...]], ...] = (
    (OtherState, "TOPIC-01", ()),
    (OtherCommands, "TOPIC-02", _DEAF),
    (Twins, "TOPIC-03", ()),
    (AsksForMore, "QOS-01", _DEAF),
    (BestEffort, "QOS-02", ()),
    (WaitsForCommands, "START-01", ()),
    (CutShort, "FIELD-01", ()),
    (NotANumber, "FIELD-02", ()),
    (CdrCrc, "CRC-01", ()),
    (NoCrc, "CRC-01", ()),
    (Slow, "RATE-01", ()),
    (Leisurely, "RATE-02", ()),
    (Stumbles, "RATE-03", ()),
    (Repeats, "ORDER-01", ()),
    (NoTick, "TICK-01", ()),
    (CountsStates, "TICK-02", ()),
    (TurnedOnce, "FIELD-03", ()),
    (NoSpeed, "FIELD-04", ()),
    (Ghost, "FIELD-05", ()),
    (NoSensor, "TEMP-01", ()),
    (Frozen, "TEMP-02", ()),
    (NoAttitude, "IMU-01", ()),
    (WLast, "IMU-02", ()),
    (InG, "IMU-03", ()),
    (NoHead, "HEAD-01", ()),
    (Empty, "BMS-01", ()),
    (Hangs, "FOOT-01", ()),
    (RemoteRubbish, "REMOTE-01", ()),
    (ShiftedRemote, "REMOTE-01", ()),
    (NoMachine, "MACH-01", ()),
    (NoMode, "MODE-01", ()),
    (Halfway, "MOVE-01", ("WDOG-03",)),
    (Coupled, "MOVE-02", ()),
    (OwnGains, "GAIN-01", ()),
    (NoVelocity, "GAIN-02", ()),
    (NoTorque, "GAIN-03", ("GAIN-01",)),
    (DefaultGains, "GAIN-04", ()),
    (NoForce, "FORCE-01", ()),
    (NoModes, "MODE-02", ("MODE-01",)),
    (TrustsAll, "CRC-02", ()),
    (Sanitises, "SAFE-01", ()),
    (Packed, "SAFE-02", ()),
    (Untyped, "SAFE-03", ()),
    (Sulks, "SAFE-04", ()),
    (AnyMachine, "SAFE-05", ()),
    (GoesOn, "WDOG-01", ()),
    (AnswersOnly, "WDOG-02", ()),
    (Latches, "WDOG-03", ("LIFE-02",)),
    (Nervous, "WDOG-04", ()),
    (KnowsItsReaders, "LIFE-01", ()),
    (Loyal, "LIFE-02", ()),
    (ForgetfulClient, "CLIENT-01", ()),
    (SlowClient, "CLIENT-02", ()),
)


def _mutants() -> Iterator[RobotMutant]:
    for model in ROBOTS:
        known = {r.id for r in catalogue(model, "robot")}
        prefix = model.upper()
        for service, kills, also in _ZOO:
            if f"{prefix}-{kills}" in known:
                names = tuple(f"{prefix}-{name}" for name in also)
                yield RobotMutant(model, service, f"{prefix}-{kills}", names)


MUTANTS: tuple[RobotMutant, ...] = tuple(_mutants())
