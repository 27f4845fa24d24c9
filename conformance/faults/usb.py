"""Wrong Dex3-1 hands on USB."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

from dexkit.conformance.faults.registry import Call, changes, wrong_hand
from dexkit.conformance.usb.frames import Motor, Scale
from dexkit.conformance.virtual.usb import FOC, ReferenceDevice
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID


def _sizes(frame: bytes) -> list[int]:
    return [int.from_bytes(frame[at : at + 4], "little") for at in range(6, 26, 4)]


# ------------------------------------------------------------------------------- descriptors


@wrong_hand("DEX3USB-DESC-01")
class OtherSide(ReferenceDevice):
    """A left hand with the product id of a right one."""

    @property
    def product(self) -> int:
        return PRODUCT_ID[Side.RIGHT if self.side is Side.LEFT else Side.LEFT]


@wrong_hand("DEX3USB-DESC-02")
class OtherRelease(ReferenceDevice):
    """Reports release 2.00."""

    release = 0x0200


@changes(ReferenceDevice, "strings", "DEX3USB-DESC-02")
def NoSerial(self: Any, strings: Call) -> Any:
    """Has no serial number."""
    return {**strings(), 3: ""}


@wrong_hand("DEX3USB-DESC-04")
class FullSpeed(ReferenceDevice):
    """Runs at full speed, with packets of 64 bytes."""

    speed = 2
    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


@wrong_hand("DEX3USB-DESC-05")
class TwoPairs(ReferenceDevice):
    """Has a second pair of bulk endpoints."""

    endpoints = (*ReferenceDevice.endpoints, (0x03, 2, 512), (0x84, 2, 512))


@wrong_hand("DEX3USB-DESC-05")
class SmallPackets(ReferenceDevice):
    """Declares packets of 64 bytes at high speed."""

    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


# ---------------------------------------------------------------------------------- exchange


@changes(ReferenceDevice, "answer", "DEX3USB-XCHG-01")
def NoAnswers(self: Any, answer: Call) -> None:
    """Answers nothing."""


@changes(ReferenceDevice, "answer", "DEX3USB-XCHG-01")
def DropsAnswers(self: Any, answer: Call) -> None:
    """Does not answer every 25th command."""
    self.memory["count"] = count = self.memory.get("count", 0) + 1
    if count % 25:
        answer()


@changes(ReferenceDevice, "answer", "DEX3USB-XCHG-02")
def Echoes(self: Any, answer: Call) -> None:
    """Answers each command twice."""
    answer()
    answer()


@wrong_hand("DEX3USB-XCHG-02")
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


@changes(ReferenceDevice, "answer", "DEX3USB-XCHG-04")
def OneAtATime(self: Any, answer: Call) -> None:
    """Drops both commands when the second comes before the first is answered."""
    if self.answers and self.answers[0][0] > self.now:
        self.answers.clear()
    else:
        answer()


@wrong_hand("DEX3USB-RATE-01")
class Slow(ReferenceDevice):
    """Needs 1.5 ms for an answer."""

    latency = 0.0015


@changes(ReferenceDevice, "answer", "DEX3USB-RATE-01")
def LateAnswers(self: Any, answer: Call) -> None:
    """Needs 4 ms for every 20th answer."""
    self.memory["count"] = count = self.memory.get("count", 0) + 1
    self.latency = 0.004 if count % 20 == 0 else 0.0004
    answer()


# ------------------------------------------------------------------------------------ frames


@changes(ReferenceDevice, "frame", "DEX3USB-SIZE-01")
def AnswersPaddedTo512(self: Any, frame: Call) -> Any:
    """Fills its answers up to whole packets of 512 bytes."""
    return frame().ljust(1536, b"\0")


@wrong_hand("DEX3USB-SIZE-02")
class BigFramesOnly(ReferenceDevice):
    """Accepts only command frames of 1234 bytes."""

    accepts = MappingProxyType({1234: 240})


@wrong_hand("DEX3USB-SIZE-02")
class SmallFramesOnly(ReferenceDevice):
    """Accepts only command frames of 734 bytes."""

    accepts = MappingProxyType({734: 140})


@changes(ReferenceDevice, "frame", "DEX3USB-SIZE-01")
def OtherHead(self: Any, frame: Call) -> Any:
    """Sends states with the head of a command."""
    return b"\xfe\xfd" + frame()[2:]


@changes(ReferenceDevice, "frame", "DEX3USB-CRC-01")
def StaleCrc(self: Any, usual: Call) -> Any:
    """Changes some frames after their CRC was computed."""
    self.memory["count"] = count = self.memory.get("count", 0) + 1
    frame = usual()
    return frame if count % 50 else frame[:-20] + b"\1" + frame[-19:]


@changes(ReferenceDevice, "motor_packet", "DEX3USB-CRC-02")
def MotorCrc(self: Any, motor_packet: Call, joint: int) -> Any:
    """Sends motor packets with one wrong bit in the CRC."""
    packet = motor_packet(joint)
    return packet[:-1] + bytes([packet[-1] ^ 1])


@changes(ReferenceDevice, "sensor_packet", "DEX3USB-CRC-03")
def SensorCrc(self: Any, sensor_packet: Call, number: int, elements: int) -> Any:
    """Writes a sensor's temperature after the CRC was computed."""
    packet = sensor_packet(number, elements)
    return packet[:30] + b"\x1e" + packet[31:]


@changes(ReferenceDevice, "wrap", "DEX3USB-PACK-01")
def UndefinedTrailingBytes(self: Any, wrap: Call, buses: list[bytes]) -> Any:
    """Sends two undefined bytes after the packets of a bus."""
    return wrap([*buses[:2], buses[2] + b"\xaa\x55", *buses[3:]])


@changes(ReferenceDevice, "motor_packet", "DEX3USB-PACK-02")
def SixMotors(self: Any, motor_packet: Call, joint: int) -> Any:
    """Leaves a motor out of some states."""
    self.memory["count"] = count = self.memory.get("count", 0) + (joint == 6)
    return b"" if joint == 6 and count % 40 == 0 else motor_packet(joint)


@wrong_hand("DEX3USB-PACK-04")
class EightSensors(ReferenceDevice):
    """Lacks one sensor packet of the palm."""

    sensors = ReferenceDevice.sensors[:-1]


@changes(ReferenceDevice, "sensor_packet", "DEX3USB-PACK-04")
def ZeroForNothing(self: Any, sensor_packet: Call, number: int, elements: int) -> Any:
    """Sends 0 where there is no sensor element."""
    return sensor_packet(number, 12)


@wrong_hand("DEX3USB-PACK-02")
class OtherMap(ReferenceDevice):
    """Has the thumb on bus 2 and a finger on bus 0."""

    map = ((2, 0), (2, 1), (2, 2), (1, 0), (1, 1), (0, 0), (0, 1))


@changes(ReferenceDevice, "supply", "DEX3USB-VALUE-01")
def Unpowered(self: Any, supply: Call) -> tuple[int, int, int, int]:
    """Reports a supply of 12 V."""
    return (11348, 11348, 11348, 596)


@changes(ReferenceDevice, "error", "DEX3USB-VALUE-02")
def Faulty(self: Any, error: Call, joint: int) -> int:
    """Reports an overheated winding from the start."""
    return 0x200 if joint == 2 else 0


# ------------------------------------------------------------------------------------ motion


@changes(ReferenceDevice, "status", "DEX3USB-MODE-01")
def AlwaysFoc(self: Any, status: Call, joint: int) -> int:
    """Reports FOC whatever status was commanded."""
    return FOC


@changes(ReferenceDevice, "driven", "DEX3USB-MODE-02")
def LockFollows(self: Any, driven: Call, joint: int) -> bool:
    """Follows positions although it is locked."""
    return not self.tripped[joint]


@changes(ReferenceDevice, "order", "DEX3USB-MOVE-01")
def JointCounts(self: Any, usual: Call, joint: int, data: bytes) -> Any:
    """Obeys positions as if they were on the joint side of the gears: 108 times as far."""
    order = usual(joint, data)
    return replace(order, q=order.q * self.joints[joint].gear_ratio)


@changes(ReferenceDevice, "move", "DEX3USB-MOVE-01")
def Backwards(self: Any, move: Call, joint: int, order: Motor, seconds: float) -> None:
    """Moves the first thumb joint the wrong way."""
    here = self.q[joint]
    move(joint, order, seconds)
    if joint == 0:
        spec = self.joints[joint]
        self.q[joint] = min(max(2 * here - self.q[joint], spec.q_min), spec.q_max)


@changes(ReferenceDevice, "counts", "DEX3USB-MOVE-02")
def Coupled(self: Any, counts: Call, joint: int) -> Any:
    """The index finger moves along with the middle one."""
    torque, speed, position = counts(joint)
    if joint == 5:
        position += round(0.05 * self.dq[3] * Scale(self.joints[joint].gear_ratio).q)
    return torque, speed, position


@wrong_hand("DEX3USB-MOVE-03")
class ZeroElsewhere(ReferenceDevice):
    """Reports a position 2.5 rad off, and obeys commands likewise."""

    shift = 2.5

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque, speed, position + self.off(joint)

    def order(self, joint: int, data: bytes) -> Motor:
        order = super().order(joint, data)
        return replace(order, q=order.q - (self.shift if joint == 1 else 0.0))

    def off(self, joint: int) -> int:
        return round(self.shift * Scale(self.joints[joint].gear_ratio).q) if joint == 1 else 0


@changes(ReferenceDevice, "counts", "DEX3USB-UNIT-01")
def RadiansASecond(self: Any, counts: Call, joint: int) -> Any:
    """Reports speed in a unit a hundred times finer."""
    torque, speed, position = counts(joint)
    return torque, max(-32768, min(32767, speed * 100)), position


@changes(ReferenceDevice, "counts", "DEX3USB-UNIT-02")
def TenthTorque(self: Any, counts: Call, joint: int) -> Any:
    """Reports torque in the sibling motor's unit, a hundredth of this one."""
    torque, speed, position = counts(joint)
    return torque // 100, speed, position


# -------------------------------------------------------------------------------- protection


@changes(ReferenceDevice, "motor_packet", "DEX3USB-PROT-01")
def SilentTrip(self: Any, motor_packet: Call, joint: int) -> Any:
    """Stops after the time-out but does not report it."""
    kept, self.tripped[joint] = self.tripped[joint], False
    packet = motor_packet(joint)
    self.tripped[joint] = kept
    return packet


@wrong_hand("DEX3USB-PROT-02")
class FlagOnly(ReferenceDevice):
    """Reports the time-out but drives on until the next command."""

    def advance(self, seconds: float) -> None:
        self.quiet = seconds > 1
        super().advance(seconds)

    def driven(self, joint: int) -> bool:
        return self.orders[joint].status == FOC and (self.quiet or not self.tripped[joint])

    quiet = False


@wrong_hand("DEX3USB-PROT-02")
class SlowTrip(ReferenceDevice):
    """Trips after 1.4 s."""

    timeout = 1.4


@wrong_hand("DEX3USB-PROT-01")
class ClearsTripByAnyCommand(ReferenceDevice):
    """Clears the time-out on any command, once it was reported."""

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


@changes(ReferenceDevice, "command", "DEX3USB-PROT-04")
def TripCannotBeCleared(self: Any, command: Call, joint: int, order: Motor) -> None:
    """Stays tripped without end."""
    kept = self.tripped[joint]
    command(joint, order)
    self.tripped[joint] = kept


@changes(ReferenceDevice, "protected", "DEX3USB-PROT-05")
def AlwaysProtected(self: Any, protected: Call, joint: int) -> bool:
    """Trips even without protection."""
    return True


@wrong_hand("DEX3USB-PROT-06")
class EarlyTrip(ReferenceDevice):
    """Trips after 0.3 s."""

    timeout = 0.3


# ----------------------------------------------------------------------------------- damaged


@changes(ReferenceDevice, "good_frame", "DEX3USB-BAD-01")
def FrameCrcNotChecked(self: Any, good_frame: Call, data: bytes) -> bool:
    """Does not check the frame's CRC."""
    return len(data) in self.accepts and max(_sizes(data)) <= self.accepts[len(data)]


@changes(ReferenceDevice, "good_packet", "DEX3USB-BAD-02")
def PacketCrcNotChecked(self: Any, good_packet: Call, data: bytes) -> bool:
    """Does not check the packets."""
    return data[:1] == b"\xfe"


@wrong_hand("DEX3USB-BAD-03")
class FillsUp(ReferenceDevice):
    """Completes a short frame with bytes of the one before."""

    last = b""

    def receive(self, data: bytes) -> None:
        if 734 < len(data) < 1234 and self.last:
            self.carry_out(data + self.last[len(data) :])
            return
        if len(data) == 1234:
            self.last = data
        super().receive(data)


@changes(ReferenceDevice, "receive", "DEX3USB-BAD-04")
def CutsOff(self: Any, receive: Call, data: bytes) -> None:
    """Obeys the beginning of a frame that is too long."""
    receive(data[:1234])


@changes(ReferenceDevice, "good_frame", "DEX3USB-BAD-05")
def BusSizeNotChecked(self: Any, good_frame: Call, data: bytes) -> Any:
    """Obeys a frame whose bus size is larger than its buffer."""
    past = len(data) in self.accepts and max(_sizes(data)) > self.accepts[len(data)]
    return past or good_frame(data)


@changes(ReferenceDevice, "packet", "DEX3USB-BAD-06")
def IdModulo(self: Any, packet: Call, bus: int, data: bytes) -> None:
    """Obeys motor ids modulo the number of a finger's motors."""
    number = data[2] & 15
    if bus == 1 and 2 <= number < 15 and self.good_packet(data):
        joint = self.places[bus, number % 2]
        self.command(joint, self.order(joint, data))
    packet(bus, data)


@wrong_hand("DEX3USB-BAD-07")
class SilentAfterDamagedFrame(ReferenceDevice):
    """Answers nothing for 0.5 s after a damaged frame."""

    until = 0.0

    def receive(self, data: bytes) -> None:
        if not self.good_frame(data):
            self.until = self.now + 0.5
        super().receive(data)

    def answer(self) -> None:
        if self.now >= self.until:
            super().answer()


@changes(ReferenceDevice, "is_for", "DEX3USB-BAD-08")
def NoBroadcast(self: Any, is_for: Call, number: int, own: int) -> bool:
    """Ignores packets with id 15, the broadcast."""
    return number == own


# -------------------------------------------------------------------------------- connection


@wrong_hand("DEX3USB-CONN-01")
class SilentAfterInterfaceRelease(ReferenceDevice):
    """Answers nothing after the interface was released once."""

    gone = False

    def reopen(self) -> None:
        self.gone = True

    def answer(self) -> None:
        if not self.gone:
            super().answer()
