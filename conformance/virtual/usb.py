"""The reference Dex3-1 on USB, in memory on a virtual clock: it meets every requirement.

It shares no code with the emulated device that dexkit ships, so that neither is judged by itself.
Its mechanics are the simplest that show every requirement: joints without mass that creep against
friction. The wrong devices in :mod:`dexkit.conformance.faults.usb` override its methods.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Mapping
from functools import cache

from dexkit.conformance.kit.phased_script import play
from dexkit.conformance.layers import layer
from dexkit.conformance.stimuli.usb import BUSES as MAP
from dexkit.conformance.stimuli.usb import (
    Action,
    Alone,
    In,
    Observation,
    Out,
    Plan,
    Reopen,
    UsbScript,
    Wait,
)
from dexkit.conformance.usb.frames import (
    BUSES,
    COMMAND_SIZES,
    NO_VALUES,
    STATE_BUS,
    STATE_SIZE,
    Motor,
    Scale,
    crc,
)
from dexkit.conformance.usb.record import (
    RECORD,
    SCHEMA_NAME,
    TIMED_OUT,
    Descriptors,
    SideRecord,
    Transfer,
    UsbRecord,
    topic,
)
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.topic_run import log_time_ns
from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import MANUFACTURER, PRODUCT, PRODUCT_ID, VENDOR_ID

__all__ = ["FOC", "ReferenceDevice", "run_virtual_usb"]

FOC = 1
_FRICTION = 0.05  # N·m·s/rad
_MOTOR_CMD = struct.Struct("<2sBBhhihhI")
_MOTOR_STATE = struct.Struct("<BbBBhhiIHH")
_OUT, _IN = 0x02, 0x81


class ReferenceDevice:
    """One hand on USB.

    :ivar now: s.
    :ivar q: joint positions, rad; ``tau`` and ``dq`` likewise.
    :ivar orders: the last command to each joint's motor, SI units.
    """

    fault_sides = (Side.LEFT,)
    """The hand that is needed to see a fault of a wrong device."""

    latency = 0.0004  # s from command to answer
    timeout = 1.0  # s without a command after which an enabled protection trips
    # bytes of a frame, and of a bus in it
    accepts: Mapping[int, int] = COMMAND_SIZES
    vendor = VENDOR_ID
    release = 0x0100
    speed = 3  # high
    endpoints: tuple[tuple[int, int, int], ...] = ((_OUT, 2, 512), (_IN, 2, 512))
    map: tuple[tuple[int, int], ...] = MAP
    # (bus, id, elements) of each sensor packet: two for a finger, three for the palm
    sensors: tuple[tuple[int, int, int], ...] = (
        *((bus, i, n) for bus in range(3) for i, n in enumerate((3, 4))),
        *((3, i, 4) for i in range(3)),
    )

    def __init__(self, side: Side) -> None:
        self.side = side
        self.joints = DEX3_1.joints[side]
        self.now = 0.0
        self.q = list(DEX3_1.rest_q[side])
        self.dq = [0.0] * len(self.q)
        self.tau = [0.0] * len(self.q)
        self.orders = [Motor() for _ in self.q]
        self.heard = [0.0] * len(self.q)
        self.tripped = [False] * len(self.q)
        self.answers: deque[tuple[float, bytes]] = deque()
        self.places = {place: joint for joint, place in enumerate(self.map)}

    # -- what the host sees ---------------------------------------------------------------------

    @property
    def product(self) -> int:
        """The product id."""
        return PRODUCT_ID[self.side]

    def strings(self) -> dict[int, str]:
        """String descriptors."""
        return {1: MANUFACTURER, 2: PRODUCT[self.side], 3: f"20240618{PRODUCT_ID[self.side]:x}"}

    def descriptors(self) -> Descriptors:
        """Device, configuration and string descriptors."""
        device = struct.pack(
            "<BBHBBBBHHHBBBB",
            *(18, 1, 0x0200, 0, 0, 0, 64, self.vendor, self.product, self.release, 1, 2, 3, 1),
        )
        interface = bytes((9, 4, 0, 0, len(self.endpoints), 0xFF, 0, 0, 0)) + b"".join(
            struct.pack("<BBBBHB", 7, 5, address, kind, size, 0)
            for address, kind, size in self.endpoints
        )
        head = struct.pack("<BBHBBBBB", 9, 2, 9 + len(interface), 1, 1, 0, 0x80, 50)
        return Descriptors(device, head + interface, self.strings(), self.speed)

    def write(self, data: bytes) -> int:
        """A bulk OUT transfer; its status."""
        self.receive(data)
        return 0

    def read(self, timeout: float) -> tuple[int, bytes]:
        """A bulk IN transfer: status and data."""
        end = self.now + timeout
        if self.answers and self.answers[0][0] <= end:
            ready, data = self.answers.popleft()
            self.advance(ready - self.now)
            return 0, data
        self.advance(end - self.now)
        return TIMED_OUT, b""

    def reopen(self) -> None:
        """The host releases the interface and claims it again."""

    # -- commands -------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Take a bulk OUT transfer: a command frame, or something else."""
        if self.good_frame(data):
            self.carry_out(data)
            self.answer()

    def good_frame(self, data: bytes) -> bool:
        """Whether a command frame is intact."""
        buffer = self.accepts.get(len(data))
        if buffer is None or crc(data[2:-4]) != int.from_bytes(data[-4:], "little"):
            return False
        return all(size <= buffer for size in struct.unpack_from(f"<{BUSES}I", data, 6))

    def carry_out(self, data: bytes) -> None:
        """Carry out every packet of an intact frame."""
        buffer = self.accepts[len(data)]
        for bus, size in enumerate(struct.unpack_from(f"<{BUSES}I", data, 6)):
            start = 26 + bus * buffer
            end = start + min(size, buffer)
            for at in range(start, end - 19, 20):
                self.packet(bus, data[at : at + 20])

    def packet(self, bus: int, data: bytes) -> None:
        """Carry out one motor packet."""
        if not self.good_packet(data):
            return
        number = data[2] & 15
        for joint, (there, own) in enumerate(self.map):
            if there == bus and self.is_for(number, own):
                self.command(joint, self.order(joint, data))

    def good_packet(self, data: bytes) -> bool:
        """Whether a motor packet is intact."""
        return data[:2] == b"\xfe\xee" and crc(data[:16]) == int.from_bytes(data[16:], "little")

    def is_for(self, number: int, own: int) -> bool:
        """Whether a packet with the id ``number`` is for the motor with the id ``own``."""
        return number in (own, 15)

    def order(self, joint: int, data: bytes) -> Motor:
        """The packet in SI units."""
        _, mode, _, tau, dq, q, kp, kd, _ = _MOTOR_CMD.unpack(data)
        scale = Scale(self.joints[joint].gear_ratio)
        return Motor(
            status=mode >> 4 & 7,
            q=q / scale.q,
            dq=dq / scale.dq,
            tau=tau / scale.tau,
            kp=kp / scale.kp,
            kd=kd / scale.kd,
            protect=bool(mode & 0x80),
        )

    def command(self, joint: int, order: Motor) -> None:
        """Take a command for one motor."""
        self.orders[joint] = order
        self.heard[joint] = self.now
        if not order.protect:
            self.tripped[joint] = False

    # -- time and mechanics ---------------------------------------------------------------------

    def advance(self, seconds: float) -> None:
        """Advance mechanics and time-out protection."""
        if seconds <= 0:
            return
        begin, self.now = self.now, self.now + seconds
        for joint, order in enumerate(self.orders):
            left = self.heard[joint] + self.timeout - begin
            if self.protected(joint) and not self.tripped[joint] and left < seconds:
                self.move(joint, order, max(0.0, left))
                self.tripped[joint] = True
                self.move(joint, order, seconds - max(0.0, left))
            else:
                self.move(joint, order, seconds)

    def protected(self, joint: int) -> bool:
        """Whether the motor's time-out protection is enabled."""
        return self.orders[joint].protect

    def driven(self, joint: int) -> bool:
        """Whether the motor is driven."""
        return self.orders[joint].status == FOC and not self.tripped[joint]

    def move(self, joint: int, order: Motor, seconds: float) -> None:
        """One joint: tau = kp (q_des - q) + kd (dq_des - dq) + tau_ff = friction * dq, solved."""
        self.dq[joint] = self.tau[joint] = 0.0
        if not self.driven(joint):
            return
        spec = self.joints[joint]
        drag = _FRICTION + order.kd
        push = order.kd * order.dq + order.tau
        here = self.q[joint]
        if order.kp:
            goal = order.q + push / order.kp
            there = goal + (here - goal) * math.exp(-order.kp / drag * seconds)
        else:
            there = here + push / drag * seconds
        reach = spec.dq_max * seconds
        there = min(max(there, here - reach), here + reach)
        stopped = min(max(there, spec.q_min), spec.q_max)
        self.q[joint] = stopped
        if stopped == there:
            self.dq[joint] = (order.kp * (order.q - there) + push) / drag
            self.tau[joint] = _FRICTION * self.dq[joint]

    # -- answers --------------------------------------------------------------------------------

    def answer(self) -> None:
        """Answer a command."""
        self.answers.append((self.now + self.latency, self.frame()))

    def frame(self) -> bytes:
        """The state frame."""
        buses = [b""] * BUSES
        for joint, (bus, _) in enumerate(self.map):
            buses[bus] += self.motor_packet(joint)
        for bus, number, elements in self.sensors:
            buses[bus] += self.sensor_packet(number, elements)
        return self.wrap(buses)

    def wrap(self, buses: list[bytes]) -> bytes:
        """``McuToLinuxState_t`` around the buses."""
        body = struct.pack(f"<4x{BUSES}I", *map(len, buses))
        body += b"".join(data.ljust(STATE_BUS, b"\0") for data in buses)
        body += struct.pack("<4H6hI16x", *self.supply(), *(0, 0, 981, 0, 0, 0), 0)
        assert len(body) == STATE_SIZE - 6
        return b"\xfc\xfd" + body + crc(body).to_bytes(4, "little")

    def supply(self) -> tuple[int, int, int, int]:
        """pin_v, vin_v, vm_v, pin_a: 48 V, 24 V for the motors, 0.3 A."""
        return (45391, 45391, 22696, 596)

    def status(self, joint: int) -> int:
        """The mode's status bits."""
        return self.orders[joint].status

    def motor_id(self, joint: int) -> int:
        """The id that the motor's state carries."""
        return self.map[joint][1]

    def counts(self, joint: int) -> tuple[int, int, int]:
        """Torque, speed and position."""
        scale = Scale(self.joints[joint].gear_ratio)
        torque, speed = self.tau[joint] * scale.tau, self.dq[joint] * scale.dq
        return _short(torque), _short(speed), int(self.q[joint] * scale.q)

    def error(self, joint: int) -> int:
        """MError."""
        return 0

    def motor_packet(self, joint: int) -> bytes:
        """``MotorState_t``."""
        mode = self.motor_id(joint) | self.status(joint) << 4 | self.tripped[joint] << 7
        body = _MOTOR_STATE.pack(mode, 30, 35, 48, *self.counts(joint), self.error(joint), 0, 0)
        return b"\xfc\xee" + body + crc(body).to_bytes(4, "little")

    def sensor_packet(self, number: int, elements: int) -> bytes:
        """``SensorState_t``."""
        return _sensor_packet(number, elements)


def _short(counts: float) -> int:
    return max(-32768, min(32767, int(counts)))


@cache
def _sensor_packet(number: int, elements: int) -> bytes:
    # the air's pressure, in counts of 8 Pa
    values = [12_700] * elements + [NO_VALUES[0]] * (12 - elements)
    body = struct.pack("<2sBB12H12b", b"\x7e\xe7", number, 0, *values, *([25] * 12))
    return body + crc(body).to_bytes(4, "little")


class _Player:
    """Carries out a script's actions with a device in memory."""

    def __init__(self, device: ReferenceDevice) -> None:
        self._device = device
        self.trace = MemoryTrace()

    def carry_out(self, action: Action) -> Observation:
        """Carry out an action; the device's clock goes on by its duration."""
        device = self._device
        begin, status, data = log_time_ns(device.now), 0, b""
        match action:
            case Out(data=sent):
                status = device.write(sent)
                device.advance(2e-5)  # a bus carries 1234 bytes in some microframes
                self._put(begin, _OUT, status, len(sent), sent)
            case In(timeout=timeout, length=length):
                status, data = device.read(timeout)
                device.advance(1e-5)
                self._put(begin, _IN, status, length, data)
            case Wait(until_ns=until):
                device.advance((until - begin) / 1e9)
            case Reopen():
                device.reopen()
                device.advance(0.01)
            case Alone():
                pass  # there is only one hand
        return Observation(log_time_ns(device.now), status, data)

    def _put(self, begin: int, endpoint: int, status: int, requested: int, data: bytes) -> None:
        done = log_time_ns(self._device.now)
        transfer = Transfer(begin, done, endpoint, status, requested, data)
        name = topic(self._device.side, inward=transfer.inward)
        self.trace.put(name, SCHEMA_NAME, done, begin, transfer.payload())


def run_virtual_usb(device: ReferenceDevice, plan: Plan | None = None) -> MemoryTrace:
    """Play the script to a device in memory; the recording.

    :param plan: by default one with fewer commands than a live run: there is no noise here.
    """
    plan = plan or Plan(device.side, burst=25, period=0.02)
    descriptors = device.descriptors()
    script: UsbScript = layer("usb").script(DEX3_1.name)(plan)
    player = _Player(device)
    play(script, player.carry_out)
    side = SideRecord(descriptors, list(plan.buses), script.phases, script.trouble)
    player.trace.metadata[RECORD] = UsbRecord({plan.side: side}).to_metadata()
    return player.trace
