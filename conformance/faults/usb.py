"""Wrong Dex3-1 hands on USB."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from dexkit.conformance.faults.registry import wrong_hand
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


@wrong_hand("DEX3USB-DESC-03")
class NoSerial(ReferenceDevice):
    """Has no serial number."""

    def strings(self) -> dict[int, str]:
        return {**super().strings(), 3: ""}


@wrong_hand("DEX3USB-DESC-04")
class FullSpeed(ReferenceDevice):
    """Runs at full speed, with packets of 64 bytes."""

    speed = 2
    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


@wrong_hand("DEX3USB-DESC-05")
class TwoPairs(ReferenceDevice):
    """Has a second pair of bulk endpoints."""

    endpoints = (*ReferenceDevice.endpoints, (0x03, 2, 512), (0x84, 2, 512))


@wrong_hand("DEX3USB-DESC-06")
class SmallPackets(ReferenceDevice):
    """Declares packets of 64 bytes at high speed."""

    endpoints = ((0x02, 2, 64), (0x81, 2, 64))


# ---------------------------------------------------------------------------------- exchange


@wrong_hand("DEX3USB-XCHG-01")
class NoAnswers(ReferenceDevice):
    """Answers nothing."""

    def answer(self) -> None:
        pass


@wrong_hand("DEX3USB-XCHG-01")
class DropsAnswers(ReferenceDevice):
    """Does not answer every 25th command."""

    count = 0

    def answer(self) -> None:
        self.count += 1
        if self.count % 25:
            super().answer()


@wrong_hand("DEX3USB-XCHG-02")
class Echoes(ReferenceDevice):
    """Answers each command twice."""

    def answer(self) -> None:
        super().answer()
        super().answer()


@wrong_hand("DEX3USB-XCHG-03")
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


@wrong_hand("DEX3USB-XCHG-04")
class OneAtATime(ReferenceDevice):
    """Drops both commands when the second comes before the first is answered."""

    def answer(self) -> None:
        if self.answers and self.answers[0][0] > self.now:
            self.answers.clear()
        else:
            super().answer()


@wrong_hand("DEX3USB-RATE-01")
class Slow(ReferenceDevice):
    """Needs 1.5 ms for an answer."""

    latency = 0.0015


@wrong_hand("DEX3USB-RATE-02")
class LateAnswers(ReferenceDevice):
    """Needs 4 ms for every 20th answer."""

    count = 0

    def answer(self) -> None:
        self.count += 1
        self.latency = 0.004 if self.count % 20 == 0 else 0.0004
        super().answer()


# ------------------------------------------------------------------------------------ frames


@wrong_hand("DEX3USB-SIZE-01")
class AnswersPaddedTo512(ReferenceDevice):
    """Fills its answers up to whole packets of 512 bytes."""

    def frame(self) -> bytes:
        return super().frame().ljust(1536, b"\0")


@wrong_hand("DEX3USB-SIZE-02")
class BigFramesOnly(ReferenceDevice):
    """Accepts only command frames of 1234 bytes."""

    accepts = MappingProxyType({1234: 240})


@wrong_hand("DEX3USB-SIZE-02")
class SmallFramesOnly(ReferenceDevice):
    """Accepts only command frames of 734 bytes."""

    accepts = MappingProxyType({734: 140})


@wrong_hand("DEX3USB-HEAD-01")
class OtherHead(ReferenceDevice):
    """Sends states with the head of a command."""

    def frame(self) -> bytes:
        return b"\xfe\xfd" + super().frame()[2:]


@wrong_hand("DEX3USB-CRC-01")
class StaleCrc(ReferenceDevice):
    """Changes some frames after their CRC was computed."""

    count = 0

    def frame(self) -> bytes:
        self.count += 1
        frame = super().frame()
        return frame if self.count % 50 else frame[:-20] + b"\1" + frame[-19:]


@wrong_hand("DEX3USB-CRC-02")
class MotorCrc(ReferenceDevice):
    """Sends motor packets with one wrong bit in the CRC."""

    def motor_packet(self, joint: int) -> bytes:
        packet = super().motor_packet(joint)
        return packet[:-1] + bytes([packet[-1] ^ 1])


@wrong_hand("DEX3USB-CRC-03")
class SensorCrc(ReferenceDevice):
    """Writes a sensor's temperature after the CRC was computed."""

    def sensor_packet(self, number: int, elements: int) -> bytes:
        packet = super().sensor_packet(number, elements)
        return packet[:30] + b"\x1e" + packet[31:]


@wrong_hand("DEX3USB-PACK-01")
class UndefinedTrailingBytes(ReferenceDevice):
    """Sends two undefined bytes after the packets of a bus."""

    def wrap(self, buses: list[bytes]) -> bytes:
        return super().wrap([*buses[:2], buses[2] + b"\xaa\x55", *buses[3:]])


@wrong_hand("DEX3USB-PACK-02")
class SixMotors(ReferenceDevice):
    """Leaves a motor out of some states."""

    count = 0

    def motor_packet(self, joint: int) -> bytes:
        self.count += joint == 6
        return b"" if joint == 6 and self.count % 40 == 0 else super().motor_packet(joint)


@wrong_hand("DEX3USB-PACK-04")
class EightSensors(ReferenceDevice):
    """Lacks one sensor packet of the palm."""

    sensors = ReferenceDevice.sensors[:-1]


@wrong_hand("DEX3USB-SENS-01")
class ZeroForNothing(ReferenceDevice):
    """Sends 0 where there is no sensor element."""

    def sensor_packet(self, number: int, elements: int) -> bytes:
        return super().sensor_packet(number, 12)


@wrong_hand("DEX3USB-PACK-03")
class OtherMap(ReferenceDevice):
    """Has the thumb on bus 2 and a finger on bus 0."""

    map = ((2, 0), (2, 1), (2, 2), (1, 0), (1, 1), (0, 0), (0, 1))


@wrong_hand("DEX3USB-VALUE-01")
class Unpowered(ReferenceDevice):
    """Reports a supply of 12 V."""

    def supply(self) -> tuple[int, int, int, int]:
        return (11348, 11348, 11348, 596)


@wrong_hand("DEX3USB-VALUE-02")
class Faulty(ReferenceDevice):
    """Reports an overheated winding from the start."""

    def error(self, joint: int) -> int:
        return 0x200 if joint == 2 else 0


# ------------------------------------------------------------------------------------ motion


@wrong_hand("DEX3USB-MODE-01")
class AlwaysFoc(ReferenceDevice):
    """Reports FOC whatever status was commanded."""

    def status(self, joint: int) -> int:
        return FOC


@wrong_hand("DEX3USB-MODE-02")
class LockFollows(ReferenceDevice):
    """Follows positions although it is locked."""

    def driven(self, joint: int) -> bool:
        return not self.tripped[joint]


@wrong_hand("DEX3USB-MOVE-01")
class JointCounts(ReferenceDevice):
    """Obeys positions as if they were on the joint side of the gears: 108 times as far."""

    def order(self, joint: int, data: bytes) -> Motor:
        order = super().order(joint, data)
        return replace(order, q=order.q * self.joints[joint].gear_ratio)


@wrong_hand("DEX3USB-MOVE-01")
class Backwards(ReferenceDevice):
    """Moves the first thumb joint the wrong way."""

    def move(self, joint: int, order: Motor, seconds: float) -> None:
        here = self.q[joint]
        super().move(joint, order, seconds)
        if joint == 0:
            spec = self.joints[joint]
            self.q[joint] = min(max(2 * here - self.q[joint], spec.q_min), spec.q_max)


@wrong_hand("DEX3USB-MOVE-02")
class Coupled(ReferenceDevice):
    """The index finger moves along with the middle one."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
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


@wrong_hand("DEX3USB-UNIT-01")
class RadiansASecond(ReferenceDevice):
    """Reports speed in a unit a hundred times finer."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque, max(-32768, min(32767, speed * 100)), position


@wrong_hand("DEX3USB-UNIT-02")
class TenthTorque(ReferenceDevice):
    """Reports torque in the sibling motor's unit, a hundredth of this one."""

    def counts(self, joint: int) -> tuple[int, int, int]:
        torque, speed, position = super().counts(joint)
        return torque // 100, speed, position


# -------------------------------------------------------------------------------- protection


@wrong_hand("DEX3USB-PROT-01")
class SilentTrip(ReferenceDevice):
    """Stops after the time-out but does not report it."""

    def motor_packet(self, joint: int) -> bytes:
        kept, self.tripped[joint] = self.tripped[joint], False
        packet = super().motor_packet(joint)
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


@wrong_hand("DEX3USB-PROT-03")
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


@wrong_hand("DEX3USB-PROT-04")
class TripCannotBeCleared(ReferenceDevice):
    """Stays tripped without end."""

    def command(self, joint: int, order: Motor) -> None:
        kept = self.tripped[joint]
        super().command(joint, order)
        self.tripped[joint] = kept


@wrong_hand("DEX3USB-PROT-05")
class AlwaysProtected(ReferenceDevice):
    """Trips even without protection."""

    def protected(self, joint: int) -> bool:
        return True


@wrong_hand("DEX3USB-PROT-06")
class EarlyTrip(ReferenceDevice):
    """Trips after 0.3 s."""

    timeout = 0.3


# ----------------------------------------------------------------------------------- damaged


@wrong_hand("DEX3USB-BAD-01")
class FrameCrcNotChecked(ReferenceDevice):
    """Does not check the frame's CRC."""

    def good_frame(self, data: bytes) -> bool:
        return len(data) in self.accepts and max(_sizes(data)) <= self.accepts[len(data)]


@wrong_hand("DEX3USB-BAD-02")
class PacketCrcNotChecked(ReferenceDevice):
    """Does not check the packets."""

    def good_packet(self, data: bytes) -> bool:
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


@wrong_hand("DEX3USB-BAD-04")
class CutsOff(ReferenceDevice):
    """Obeys the beginning of a frame that is too long."""

    def receive(self, data: bytes) -> None:
        super().receive(data[:1234])


@wrong_hand("DEX3USB-BAD-05")
class BusSizeNotChecked(ReferenceDevice):
    """Obeys a frame whose bus size is larger than its buffer."""

    def good_frame(self, data: bytes) -> bool:
        past = len(data) in self.accepts and max(_sizes(data)) > self.accepts[len(data)]
        return past or super().good_frame(data)


@wrong_hand("DEX3USB-BAD-06")
class IdModulo(ReferenceDevice):
    """Obeys motor ids modulo the number of a finger's motors."""

    def packet(self, bus: int, data: bytes) -> None:
        number = data[2] & 15
        if bus == 1 and 2 <= number < 15 and self.good_packet(data):
            joint = self.places[bus, number % 2]
            self.command(joint, self.order(joint, data))
        super().packet(bus, data)


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


@wrong_hand("DEX3USB-BAD-08")
class NoBroadcast(ReferenceDevice):
    """Ignores packets with id 15, the broadcast."""

    def is_for(self, number: int, own: int) -> bool:
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
