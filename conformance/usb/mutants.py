"""Deliberately wrong devices: each does one thing wrong, and the checks must notice exactly that.

As :mod:`dexkit.conformance.mutants`, for USB: a mutant is a small change of
:class:`~dexkit.conformance.usb.virtual.ReferenceDevice`. ``kills`` is the requirement that must
catch it; ``also`` names what cannot but fail with it. No other may fail or warn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from dexkit.conformance.judge import judge_layer
from dexkit.conformance.layers.usb import LAYER as USB
from dexkit.conformance.requirements import Requirement
from dexkit.conformance.results import Result, Verdict
from dexkit.conformance.usb.frames import Motor, Scale
from dexkit.conformance.usb.virtual import FOC, ReferenceDevice, run_virtual
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID

__all__ = ["MUTANTS", "Mutant", "try_mutant"]


def _sizes(frame: bytes) -> list[int]:
    return [int.from_bytes(frame[at : at + 4], "little") for at in range(6, 26, 4)]


# ------------------------------------------------------------------------------- descriptors


class OtherSide(ReferenceDevice):
    """A left hand that says it is a right one."""

    @property
    def product(self) -> int:
        return PRODUCT_ID[Side.RIGHT if self.side is Side.LEFT else Side.LEFT]


class OtherRelease(ReferenceDevice):
    """Says it is release 2.00."""

    release = 0x0200


class NoSerial(ReferenceDevice):
    """Has no serial number."""

    def strings(self) -> dict[int, str]:
        return {**super().strings(), 3: ""}


class FullSpeed(ReferenceDevice):
    """Runs at full speed, with packets of 64 bytes."""

    speed = 2
    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


class TwoPairs(ReferenceDevice):
    """Has a second pair of bulk endpoints."""

    endpoints = (*ReferenceDevice.endpoints, (0x03, 2, 512), (0x84, 2, 512))


class SmallPackets(ReferenceDevice):
    """Declares packets of 64 bytes at high speed."""

    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


# ---------------------------------------------------------------------------------- exchange


class Deaf(ReferenceDevice):
    """Answers nothing."""

    def answer(self) -> None:
        pass


class DropsAnswers(ReferenceDevice):
    """Does not answer every 25th command."""

    count = 0

    def answer(self) -> None:
        self.count += 1
        if self.count % 25:
            super().answer()


class Echoes(ReferenceDevice):
    """Answers each command twice."""

    def answer(self) -> None:
        super().answer()
        super().answer()


class Streams(ReferenceDevice):
    """Sends a state every 50 ms from the start, until the first command."""

    commanded = False

    def receive(self, data: bytes) -> None:
        if not self.commanded:
            self.answers.clear()
        self.commanded = True
        super().receive(data)

    def read(self, timeout: float) -> tuple[int, bytes]:
        if not self.commanded and not self.answers:
            self.answers.append((self.now + 0.05, self.frame()))
        return super().read(timeout)


class OneAtATime(ReferenceDevice):
    """Throws both commands away when the second comes before the first is answered."""

    def answer(self) -> None:
        if self.answers and self.answers[0][0] > self.now:
            self.answers.clear()
        else:
            super().answer()


class Slow(ReferenceDevice):
    """Needs 1.5 ms for an answer."""

    latency = 0.0015


class Stumbles(ReferenceDevice):
    """Needs 4 ms for every 20th answer."""

    count = 0

    def answer(self) -> None:
        self.count += 1
        self.latency = 0.004 if self.count % 20 == 0 else 0.0004
        super().answer()


# ------------------------------------------------------------------------------------ frames


class Padded(ReferenceDevice):
    """Fills its answers up to whole packets of 512 bytes."""

    def frame(self) -> bytes:
        return super().frame().ljust(1536, b"\0")


class BigFramesOnly(ReferenceDevice):
    """Takes command frames of 1234 bytes only."""

    accepts = MappingProxyType({1234: 240})


class SmallFramesOnly(ReferenceDevice):
    """Takes command frames of 734 bytes only."""

    accepts = MappingProxyType({734: 140})


class OtherHead(ReferenceDevice):
    """Begins its states with the head of a command."""

    def frame(self) -> bytes:
        return b"\xfe\xfd" + super().frame()[2:]


class StaleCrc(ReferenceDevice):
    """Changes the frame after its CRC was made, now and then."""

    count = 0

    def frame(self) -> bytes:
        self.count += 1
        frame = super().frame()
        return frame if self.count % 50 else frame[:-20] + b"\1" + frame[-19:]


class MotorCrc(ReferenceDevice):
    """Sends motor packets with one wrong bit in the CRC."""

    def motor_packet(self, joint: int) -> bytes:
        packet = super().motor_packet(joint)
        return packet[:-1] + bytes([packet[-1] ^ 1])


class SensorCrc(ReferenceDevice):
    """Fills in a sensor's temperature after its CRC was made."""

    def sensor_packet(self, number: int, elements: int) -> bytes:
        packet = super().sensor_packet(number, elements)
        return packet[:30] + b"\x1e" + packet[31:]


class Rubbish(ReferenceDevice):
    """Leaves two bytes of rubbish behind the packets of a bus."""

    def wrap(self, buses: list[bytes]) -> bytes:
        return super().wrap([*buses[:2], buses[2] + b"\xaa\x55", *buses[3:]])


class SixMotors(ReferenceDevice):
    """Leaves a motor out of the state now and then."""

    count = 0

    def motor_packet(self, joint: int) -> bytes:
        self.count += joint == 6
        return b"" if joint == 6 and self.count % 40 == 0 else super().motor_packet(joint)


class EightSensors(ReferenceDevice):
    """Has no sensor in one place of the palm."""

    sensors = ReferenceDevice.sensors[:-1]


class ZeroForNothing(ReferenceDevice):
    """Sends 0 where there is no sensor element."""

    def sensor_packet(self, number: int, elements: int) -> bytes:
        return super().sensor_packet(number, 12)


class OtherMap(ReferenceDevice):
    """Has the thumb on bus 2 and a finger on bus 0."""

    map = ((2, 0), (2, 1), (2, 2), (1, 0), (1, 1), (0, 0), (0, 1))


class Unpowered(ReferenceDevice):
    """Reports a supply of 12 V."""

    def supply(self) -> tuple[int, int, int, int]:
        return (11348, 11348, 11348, 596)


class Faulty(ReferenceDevice):
    """Reports a winding too hot from the start."""

    def error(self, joint: int) -> int:
        return 0x200 if joint == 2 else 0


# ------------------------------------------------------------------------------------ motion


class AlwaysFoc(ReferenceDevice):
    """Reports FOC whatever it was commanded."""

    def status(self, joint: int) -> int:
        return FOC


class LockFollows(ReferenceDevice):
    """Follows positions although it is locked."""

    def driven(self, joint: int) -> bool:
        return not self.tripped[joint]


class JointCounts(ReferenceDevice):
    """Takes positions for joint side, 108 times as far."""

    def order(self, joint: int, data: bytes) -> Motor:
        order = super().order(joint, data)
        return replace(order, q=order.q * self.joints[joint].gear_ratio)


class Backwards(ReferenceDevice):
    """Moves the first thumb joint the wrong way."""

    def move(self, joint: int, order: Motor, seconds: float) -> None:
        here = self.q[joint]
        super().move(joint, order, seconds)
        if joint == 0:
            spec = self.joints[joint]
            self.q[joint] = min(max(2 * here - self.q[joint], spec.q_min), spec.q_max)


class Coupled(ReferenceDevice):
    """Drags the index finger along while the middle one moves."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        if joint == 5:
            position += round(0.05 * self.dq[3] * Scale(self.joints[joint].gear_ratio).q)
        return torque, speed, position


class ZeroElsewhere(ReferenceDevice):
    """Reports a position 2.5 rad off, and takes commands likewise."""

    shift = 2.5

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque, speed, position + self.off(joint)

    def order(self, joint: int, data: bytes) -> Motor:
        order = super().order(joint, data)
        return replace(order, q=order.q - (self.shift if joint == 1 else 0.0))

    def off(self, joint: int) -> int:
        return round(self.shift * Scale(self.joints[joint].gear_ratio).q) if joint == 1 else 0


class RadiansASecond(ReferenceDevice):
    """Reports speed in units a hundred times as fine."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque, max(-32768, min(32767, speed * 100)), position


class TenthTorque(ReferenceDevice):
    """Reports torque in the sibling motor's unit, a hundredth of this one."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque // 100, speed, position


# -------------------------------------------------------------------------------- protection


class SilentTrip(ReferenceDevice):
    """Stops in silence but does not report it."""

    def motor_packet(self, joint: int) -> bytes:
        kept, self.tripped[joint] = self.tripped[joint], False
        packet = super().motor_packet(joint)
        self.tripped[joint] = kept
        return packet


class FlagOnly(ReferenceDevice):
    """Reports the time-out and goes on driving, until the next command."""

    def advance(self, seconds: float) -> None:
        self.quiet = seconds > 1
        super().advance(seconds)

    def driven(self, joint: int) -> bool:
        return self.orders[joint].status == FOC and (self.quiet or not self.tripped[joint])

    quiet = False


class SlowTrip(ReferenceDevice):
    """Trips after 1.4 s."""

    timeout = 1.4


class ForgivesItself(ReferenceDevice):
    """Clears the time-out on any command, once it has been told."""

    def __init__(self, side: Side) -> None:
        super().__init__(side)
        self.lapsed = [False] * len(self.q)

    def command(self, joint: int, order: Motor) -> None:
        self.lapsed[joint] = self.tripped[joint] and order.protect
        super().command(joint, order)
        self.tripped[joint] = False

    def answer(self) -> None:
        self.tripped = self.lapsed
        super().answer()
        self.tripped = [False] * len(self.q)
        self.lapsed = [False] * len(self.q)


class NeverForgives(ReferenceDevice):
    """Stays tripped for good."""

    def command(self, joint: int, order: Motor) -> None:
        kept = self.tripped[joint]
        super().command(joint, order)
        self.tripped[joint] = kept


class AlwaysProtected(ReferenceDevice):
    """Trips whether or not the protection was enabled."""

    def protected(self, joint: int) -> bool:
        return True


class EarlyTrip(ReferenceDevice):
    """Trips after 0.3 s."""

    timeout = 0.3


# ----------------------------------------------------------------------------------- damaged


class TrustsFrames(ReferenceDevice):
    """Does not check the frame's CRC."""

    def good_frame(self, data: bytes) -> bool:
        return len(data) in self.accepts and max(_sizes(data)) <= self.accepts[len(data)]


class TrustsPackets(ReferenceDevice):
    """Does not check the packets."""

    def good_packet(self, data: bytes) -> bool:
        return data[:1] == b"\xfe"


class FillsUp(ReferenceDevice):
    """Takes the rest of a short frame from the one before."""

    last = b""

    def receive(self, data: bytes) -> None:
        if 734 < len(data) < 1234 and self.last:
            self.carry_out(data + self.last[len(data) :])
            return
        if len(data) == 1234:
            self.last = data
        super().receive(data)


class CutsOff(ReferenceDevice):
    """Takes the beginning of a frame that is too long."""

    def receive(self, data: bytes) -> None:
        super().receive(data[:1234])


class BelievesSizes(ReferenceDevice):
    """Takes a size past the buffer for a full one."""

    def good_frame(self, data: bytes) -> bool:
        past = len(data) in self.accepts and max(_sizes(data)) > self.accepts[len(data)]
        return past or super().good_frame(data)


class IdModulo(ReferenceDevice):
    """Takes ids modulo the number of a finger's motors."""

    def packet(self, bus: int, data: bytes) -> None:
        number = data[2] & 15
        if bus == 1 and 2 <= number < 15 and self.good_packet(data):
            joint = self.places[bus, number % 2]
            self.command(joint, self.order(joint, data))
        super().packet(bus, data)


class Sulks(ReferenceDevice):
    """Answers nothing for half a second after a damaged frame."""

    until = 0.0

    def receive(self, data: bytes) -> None:
        if not self.good_frame(data):
            self.until = self.now + 0.5
        super().receive(data)

    def answer(self) -> None:
        if self.now >= self.until:
            super().answer()


class NoBroadcast(ReferenceDevice):
    """Takes id 15 for a motor that it does not have."""

    def is_for(self, number: int, own: int) -> bool:
        return number == own


# -------------------------------------------------------------------------------- connection


class OnceOnly(ReferenceDevice):
    """Answers no more once the interface was released."""

    gone = False

    def reopen(self) -> None:
        self.gone = True

    def answer(self) -> None:
        if not self.gone:
            super().answer()


@dataclass(frozen=True)
class Mutant:
    """One wrong device.

    :param kills: the requirement that must catch it.
    :param also: requirements that fail or warn with it.
    """

    device: type[ReferenceDevice]
    kills: str
    also: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its class's name."""
        return self.device.__name__

    @property
    def summary(self) -> str:
        """What it does wrong, in a line."""
        return (self.device.__doc__ or "").strip().splitlines()[0]


def _mutant(device: type[ReferenceDevice], kills: str, *also: str) -> Mutant:
    return Mutant(device, f"DEX3USB-{kills}", tuple(f"DEX3USB-{name}" for name in also))


MUTANTS: tuple[Mutant, ...] = (
    _mutant(OtherSide, "DESC-01"),
    _mutant(OtherRelease, "DESC-02"),
    _mutant(NoSerial, "DESC-03"),
    _mutant(FullSpeed, "DESC-04"),
    _mutant(TwoPairs, "DESC-05"),
    _mutant(SmallPackets, "DESC-06"),
    _mutant(Deaf, "XCHG-01"),
    _mutant(DropsAnswers, "XCHG-01"),
    _mutant(Echoes, "XCHG-02"),
    _mutant(Streams, "XCHG-03"),
    _mutant(OneAtATime, "XCHG-04"),
    _mutant(Slow, "RATE-01"),
    _mutant(Stumbles, "RATE-02"),
    _mutant(Padded, "SIZE-01"),
    _mutant(BigFramesOnly, "SIZE-02"),
    _mutant(SmallFramesOnly, "SIZE-02"),
    _mutant(OtherHead, "HEAD-01"),
    _mutant(StaleCrc, "CRC-01"),
    _mutant(MotorCrc, "CRC-02"),
    _mutant(SensorCrc, "CRC-03"),
    _mutant(Rubbish, "PACK-01"),
    _mutant(SixMotors, "PACK-02"),
    _mutant(OtherMap, "PACK-03"),
    _mutant(EightSensors, "PACK-04", "SENS-01"),
    _mutant(ZeroForNothing, "SENS-01"),
    _mutant(Unpowered, "VALUE-01"),
    _mutant(Faulty, "VALUE-02"),
    _mutant(AlwaysFoc, "MODE-01"),
    _mutant(LockFollows, "MODE-02"),
    _mutant(JointCounts, "MOVE-01"),
    _mutant(Backwards, "MOVE-01"),
    _mutant(Coupled, "MOVE-02"),
    _mutant(ZeroElsewhere, "MOVE-03"),
    _mutant(RadiansASecond, "UNIT-01", "UNIT-02"),
    _mutant(TenthTorque, "UNIT-02"),
    _mutant(SilentTrip, "PROT-01"),
    _mutant(FlagOnly, "PROT-02"),
    _mutant(SlowTrip, "PROT-02"),
    _mutant(ForgivesItself, "PROT-03"),
    _mutant(NeverForgives, "PROT-04"),
    _mutant(AlwaysProtected, "PROT-05"),
    _mutant(EarlyTrip, "PROT-06"),
    _mutant(TrustsFrames, "BAD-01"),
    _mutant(TrustsPackets, "BAD-02"),
    _mutant(FillsUp, "BAD-03"),
    _mutant(CutsOff, "BAD-04"),
    _mutant(BelievesSizes, "BAD-05"),
    _mutant(IdModulo, "BAD-06"),
    _mutant(Sulks, "BAD-07"),
    _mutant(NoBroadcast, "BAD-08"),
    _mutant(OnceOnly, "CONN-01"),
)


def try_mutant(
    device: type[ReferenceDevice], requirements: Sequence[Requirement], side: Side = Side.LEFT
) -> tuple[list[Result], set[str]]:
    """Judge one device; the results, and the requirements that found fault with it."""
    results = judge_layer(USB, run_virtual(device(side)), requirements)
    bad = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
    return results, {r.requirement.id for r in results if r.verdict in bad}
