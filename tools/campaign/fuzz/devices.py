"""Hostile hosts: bytes for the emulated devices, most of them in frames with a valid checksum.

A finding is an exception, an answer that the wire format does not allow, or a buffer that grows.
Time is virtual, except in the USB/IP server.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct

from dexkit.clock import ManualClock
from dexkit.descriptors import wait_readable
from dexkit.emulators.dex3_mcu import Dex3Hands
from dexkit.emulators.dex3_mcu.device import Dex3Mcu
from dexkit.emulators.dex3_mcu.settings import Firmware as Dex3Firmware
from dexkit.emulators.dex3_mcu.usb import Dex3Usb
from dexkit.emulators.m4010.bus import Bus as MotorBus
from dexkit.emulators.m4010.motor import Motor
from dexkit.emulators.mx64 import Bus, Firmware, Servo
from dexkit.emulators.mx64.protocol1 import Protocol1Servo
from dexkit.emulators.robot.mechanics import RobotMechanics
from dexkit.emulators.robot.settings import Settings
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.robots import ROBOTS, RobotModel
from dexkit.wire import dynamixel as dxl
from dexkit.wire import low_level, m4010, mx64
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import COMMAND_LAYOUTS, MOTOR_CMD, N_BUSES
from dexkit.wire.dynamixel import Instruction
from tools.campaign.fuzz.case import Inputs, SeededCase

__all__ = ["cases", "packet"]

_BLOCK = 200  # inputs to one device, then there is a new one


# --- MX-64

_CODES = [int(i) for i in Instruction]
_ITEMS = list(mx64.TABLE.values())


def packet(packet_id: int, instruction: int, params: bytes) -> bytes:
    """An instruction packet with a true length and CRC, whatever its id and size."""
    body = dxl.stuff(bytes((instruction,)) + params)
    length = len(body) + 2
    data = dxl.HEADER + bytes((packet_id, length & 0xFF, length >> 8 & 0xFF)) + body
    return data + dxl.crc16(data).to_bytes(2, "little")


def _instruction(case: Inputs) -> bytes:
    rnd = case.random
    code = rnd.choice(_CODES) if rnd.random() < 0.95 else rnd.randrange(256)
    single = rnd.random() < 0.5
    target = rnd.choice((1, 2, 9)) if single else rnd.choice((1, 2, 252, 253, 254, 255, 0))

    def address() -> bytes:
        if rnd.random() < 0.7:
            return rnd.choice(_ITEMS).address.to_bytes(2, "little")
        return case.number_of(2).to_bytes(2, "little")

    def size() -> int:
        return rnd.choice((1, 2, 4, 10, 24, 100)) if rnd.random() < 0.7 else case.number_of(2)

    def ids() -> list[int]:
        found = [rnd.choice((1, 2, 3, 9, 252, 254, 255)) for _ in range(rnd.randrange(1, 5))]
        return list(dict.fromkeys(found)) if rnd.random() < 0.9 else found

    params = b""
    if code in (Instruction.READ,):
        params = address() + size().to_bytes(2, "little")
    elif code in (Instruction.WRITE, Instruction.REG_WRITE):
        if rnd.random() < 0.7:
            item = rnd.choice(_ITEMS)
            value = case.number_of(item.size) if rnd.random() < 0.7 else rnd.randrange(3)
            params = item.address.to_bytes(2, "little") + value.to_bytes(item.size, "little")
        else:
            params = address() + rnd.randbytes(min(size(), 700))
    elif code == Instruction.FACTORY_RESET:
        params = bytes((rnd.choice((0xFF, 1, 2, 3)),))
    elif code == Instruction.CLEAR:
        params = dxl.CLEAR_POSITION_KEY
    elif code == Instruction.CONTROL_TABLE_BACKUP:
        params = bytes((rnd.choice((1, 2, 3)),)) + dxl.BACKUP_KEY
    elif code in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        target = 254 if rnd.random() < 0.95 else target
        params = address() + size().to_bytes(2, "little") + bytes(ids())
    elif code in (Instruction.BULK_READ, Instruction.FAST_BULK_READ):
        target = 254 if rnd.random() < 0.95 else target
        params = b"".join(bytes((i,)) + address() + size().to_bytes(2, "little") for i in ids())
    elif code == Instruction.SYNC_WRITE:
        target = 254
        n = min(size(), 200)
        params = address() + n.to_bytes(2, "little")
        params += b"".join(bytes((i,)) + rnd.randbytes(n) for i in ids())
    elif code == Instruction.BULK_WRITE:
        target = 254
        for i in ids():
            n = min(size(), 100)
            params += bytes((i,)) + address() + n.to_bytes(2, "little") + rnd.randbytes(n)
    elif rnd.random() < 0.3:
        params = rnd.randbytes(rnd.randrange(20))
    if rnd.random() < 0.05:
        params = params[: rnd.randrange(len(params) + 1)]
    elif rnd.random() < 0.05:
        params += rnd.randbytes(rnd.randrange(1, 5))
    return packet(target, code, params)


def _protocol_1(case: Inputs) -> bytes:
    rnd = case.random
    params = rnd.randbytes(rnd.choice((0, 1, 2, 2, 2, 3, 20)))
    body = bytes((rnd.choice((3, 254, 1)), len(params) + 2, rnd.choice((1, 2, 3, 0x83)))) + params
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def _servos(case: Inputs, now: float) -> Bus:
    rnd = case.random

    def flip() -> bool:
        return rnd.random() < 0.5

    firmware = Firmware(
        fast_reads=rnd.random() < 0.8,
        backup=flip(),
        read_across_gaps=flip(),
        answer_bad_crc=flip(),
        sync_write_clamps=flip(),
        missing_id_stalls=flip(),
        level_0_answers_sync=flip(),
        watchdog_resumes=flip(),
        profile_velocity_limited=flip(),
        boot_time=0.001,
    )
    return Bus(
        [Servo(i, firmware=firmware, now=now) for i in (1, 2)],
        line_time=flip(),
        latency_timer=rnd.choice((0.0, 1e-3)),
        start=now,
        protocol_1=[Protocol1Servo(3)] if flip() else (),
    )


def mx64_line(case: Inputs, count: int) -> None:
    """Two MX-64 with Protocol 2.0 firmware, and at times one with 1.0, on one line."""
    now = 100.0
    for i in range(count):
        if i % _BLOCK == 0:
            bus = _servos(case, now)
        chance = case.random.random()
        data = _protocol_1(case) if chance < 0.05 else _instruction(case)
        data = case.spoil(data)
        now += case.random.choice((0.0, 1e-4, 1e-3, 2e-3, 5e-3, 0.02))
        case.begin(data)
        _exchange(bus, data, now)
        if (i + 1) % _BLOCK == 0:
            now += bus.behind(now) + 2.0  # 4 KiB at 9600 baud take 4 s
            case.begin()
            _answer_a_broadcast_ping(bus, now)


def _exchange(bus: Bus | MotorBus, data: bytes, now: float) -> None:
    bus.advance_to(now)
    bus.receive(data, now)
    assert bus._parser.pending <= dxl.MAX_PACKET, "the parser holds more than a packet"
    if bus.failure is not None:
        raise bus.failure
    late = 0.3  # all that was asked is out by then
    out = bus.due(now + late)
    assert len(out) <= 64 * (len(data) + dxl.MAX_PACKET), f"{len(out)} bytes of answers"


def _answer_a_broadcast_ping(bus: Bus, now: float) -> None:
    bus.due(now)
    for servo in bus.servos:  # a fuzzed id may be anybody's; a delay of 0.5 ms at most is not
        assert servo.id <= dxl.MAX_ID
    bus.advance_to(now)
    bus.receive(packet(dxl.BROADCAST_ID, Instruction.PING, b""), now)
    answers = bus.due(now + 1.0)
    found = dxl.PacketParser().feed(answers)
    assert any(p.is_status for p in found), "no servo answers a broadcast ping"


# --- M4010


def m4010_line(case: Inputs, count: int) -> None:
    """Both motors of a pair of Dex1-1 on one line."""
    now = 100.0
    for i in range(count):
        if i % _BLOCK == 0:
            bus = MotorBus(
                [Motor(0, now=now), Motor(1, now=now)],
                line_time=case.random.random() < 0.5,
                start=now,
            )
        data = case.spoil(_motor_frame(case))
        now += case.random.choice((0.0, 1e-4, 1e-3, 5e-3, 0.05))
        case.begin(data)
        _exchange(bus, data, now)
        if (i + 1) % _BLOCK == 0:
            now += 2.0
            case.begin()
            _motors_answer(bus, now)


def _motor_frame(case: Inputs) -> bytes:
    rnd = case.random
    number = rnd.choice((0, 1, 2, 15))
    mode = number | rnd.choice((0, 1, 1, 1, 2, 5, 6, 7)) << 4 | rnd.choice((0, 0x80))
    body = b"\xfe\xee" + bytes((mode, rnd.randrange(256)))
    if rnd.random() < 0.1:  # these select a calibration
        body += struct.pack("<h", -0x400)
    else:
        body += case.number_of(2).to_bytes(2, "little")
    body += case.number_of(2).to_bytes(2, "little") + case.number_of(4).to_bytes(4, "little")
    body += case.number_of(2).to_bytes(2, "little") + case.number_of(2).to_bytes(2, "little")
    return body + crc32_words(body).to_bytes(4, "little")


def _motors_answer(bus: MotorBus, now: float) -> None:
    bus.due(now)
    bus.advance_to(now)
    for number in (0, 1):
        bus.receive(m4010.MotorCmd(number, m4010.Status.BRAKE).pack(), now)
        answer = bus.due(now + 1.0)
        assert m4010.MotorData.parse(answer).id == number


# --- Dex3-1


def dex3(case: Inputs, count: int) -> None:
    """A Dex3-1's processor behind its USB endpoints."""
    clock = ManualClock(100.0)
    for i in range(count):
        if i % _BLOCK == 0:
            rnd = case.random
            firmware = Dex3Firmware(
                answer_bad_frame=rnd.random() < 0.8,
                queue=rnd.choice((1, 3)),
                other_status_brakes=rnd.random() < 0.5,
                unaddressed_motors_answer=rnd.random() < 0.5,
            )
            usb = Dex3Usb(Dex3Mcu(Side.LEFT, clock=clock, firmware=firmware), clock)
        data = case.spoil(_hand_frame(case))
        clock.advance(case.random.choice((0.0, 1e-4, 1e-3, 5e-3)))
        case.begin(data)
        _transfer(usb, data)


def _hand_frame(case: Inputs) -> bytes:
    rnd = case.random
    layout = rnd.choice(COMMAND_LAYOUTS)
    buses = []
    sizes = []
    for _ in range(N_BUSES):
        packets = b""
        for _ in range(rnd.choice((0, 1, 2, 3, 7))):
            body = MOTOR_CMD.head + bytes((rnd.randrange(256), rnd.randrange(256)))
            body += b"".join(case.number_of(n).to_bytes(n, "little") for n in (2, 2, 4, 2, 2))
            packets += case.spoil(body + crc32_words(body).to_bytes(4, "little"))
        packets = packets[: layout.bus_size]
        sizes.append(len(packets) if rnd.random() < 0.9 else case.number_of(4))
        buses.append(packets.ljust(layout.bus_size, b"\0"))
    frame = rnd.choice((b"\xfe\xfd", rnd.randbytes(2))) + rnd.randbytes(4)
    frame += struct.pack(f"<{N_BUSES}I", *sizes) + b"".join(buses) + rnd.randbytes(4)
    return frame + crc32_words(frame[2:]).to_bytes(4, "little")


def _transfer(usb: Dex3Usb, data: bytes) -> None:
    usb._received(usb._out, data)
    usb.advance()
    assert len(usb._transfer) <= 3 * 4096
    assert len(usb._held) <= 64


# --- robots


def robots(case: Inputs, count: int) -> None:
    """An H1 and a G1: samples of their command topics, most of them with a good CRC."""
    now = 100.0
    for i in range(count):
        rnd = case.random
        if i % _BLOCK == 0:
            model = rnd.choice(list(ROBOTS.values()))
            robot = RobotMechanics(model, Settings(lenient=rnd.random() < 0.3), now=now)
            image = _robot_command(case, model)
        data = bytearray(image)
        for _ in range(rnd.choice((0, 0, 3, 40, 400))):
            at = rnd.randrange(4, len(data) - 4)
            if rnd.random() < 0.3:
                data[at] = rnd.randrange(256)
            else:
                at -= at % 4
                data[at : at + 4] = struct.pack("<f", rnd.choice(_FLOATS))
        payload = _sealed(model.cmd_type, bytes(data)) if rnd.random() < 0.8 else bytes(data)
        payload = case.spoil(payload)
        now += rnd.choice((0.0, 1e-3, 2e-3, 0.01))
        case.begin(payload)
        (robot.command if len(payload) % 3 else robot.arm_command)(payload, now)
        robot.advance(now)
        robot.state(now)


_FLOATS = (0.0, 1.0, -1.0, 1e3, 1e-30, 2.1e9, 3.4e38, -3.4e38, math.inf, math.nan, 16000.0)


def _robot_command(case: Inputs, model: RobotModel) -> bytes:
    """A command that is obeyed, of gains that may be monstrous."""
    rnd = case.random
    kind = message_type(model.cmd_type)
    message = kind.cls()
    for slot in model.used:
        motor = message.motor_cmd[slot]
        motor.mode = model.enable[slot]
        motor.q, motor.dq, motor.tau = (rnd.choice(_FLOATS[:-2]) for _ in range(3))
        motor.kp, motor.kd = rnd.choice((60.0, 3.4e38)), rnd.choice((1.5, 3.4e38))
    if model.mode_machine is not None:
        message.mode_machine = model.mode_machine
    return kind.encode(message)


def _sealed(name: str, payload: bytes) -> bytes:
    try:
        crc = low_level.crc_of_payload(name, payload)
    except DexkitError:
        return payload
    return payload[:-4] + crc.to_bytes(4, "little")


# --- the USB/IP server

_SUBMIT = struct.Struct(">IIIIIIiiii8s")
_REQUESTS = (
    bytes((0x80, 6, 0, 1, 0, 0, 18, 0)),  # device descriptor
    bytes((0x80, 6, 0, 2, 0, 0, 255, 255)),
    bytes((0x80, 6, 2, 3, 9, 4, 255, 0)),
    bytes((0x00, 9, 1, 0, 0, 0, 0, 0)),  # set configuration
    bytes((0x02, 1, 0, 0, 0x81, 0, 0, 0)),  # clear halt
    bytes((0x02, 3, 0, 0, 0x81, 0, 0, 0)),  # set halt
    bytes((0x02, 3, 0, 0, 0x02, 0, 0, 0)),
    bytes((0x40, 1, 0, 0, 0, 0, 255, 255)),
)


def usbip_server(case: Inputs, count: int) -> None:
    """Clients of the USB/IP server: valid, hostile and broken messages, in any pieces."""
    with Dex3Hands((Side.LEFT, Side.RIGHT), seed=case.random.getrandbits(32)) as hands:
        made = 0
        while made < count:
            stream = b"".join(_message(case) for _ in range(min(40, count - made)))
            made += min(40, count - made)
            case.begin(stream)
            _client(case, hands, stream)


def _message(case: Inputs) -> bytes:
    rnd = case.random
    number = rnd.choice((1, 2, rnd.randrange(1, 1000), case.number_of(4)))
    endpoint = rnd.choice((0, 1, 2, 2, 1, 15, case.number_of(4)))
    direction = rnd.choice((0, 1)) if rnd.random() < 0.99 else case.number_of(4)
    if rnd.random() < 0.2:
        return struct.pack(">IIIIII24x", 2, number, 2, direction, endpoint, rnd.randrange(1000))
    length = rnd.choice((0, 8, 512, 1234, 2048)) if rnd.random() < 0.97 else case.number_of(4)
    setup = rnd.choice(_REQUESTS) if rnd.random() < 0.8 else rnd.randbytes(8)
    data = b""
    if direction == 0 and length < 5000:
        data = _hand_frame(case)[:length].ljust(length, b"\0")
    signed = length - (1 << 32) if length >> 31 else length
    command = 1 if rnd.random() < 0.99 else case.number_of(4)
    some = (rnd.choice((0, -1, 3)), rnd.choice((0, -1, 5)), 0)
    header = _SUBMIT.pack(command, number, 2, direction, endpoint, 0, signed, *some, setup)
    return case.spoil(header + data) if rnd.random() < 0.1 else header + data


def _client(case: Inputs, hands: Dex3Hands, stream: bytes) -> None:
    rnd = case.random
    address = ("127.0.0.1", hands.port)
    with contextlib.suppress(OSError), socket.create_connection(address, 5.0) as sock:
        greeting = struct.pack(">HHI32s", 0x111, 0x8003, 0, rnd.choice((b"1-1", b"1-2", b"1-3")))
        sock.sendall(case.spoil(greeting))
        pieces = rnd.choice((1, 1, 3, 10))
        for i in range(pieces):
            sock.sendall(stream[len(stream) * i // pieces : len(stream) * (i + 1) // pieces])
        sock.setblocking(False)
        for _ in range(rnd.choice((0, 1, 5))):
            if not wait_readable([sock.fileno()], 0.01) or not sock.recv(1 << 16):
                break
    for problem in (hands.error, hands.failure):
        if problem is not None:
            raise AssertionError(f"the server failed: {problem!r}") from problem
    with socket.create_connection(address, 5.0) as polite:
        polite.sendall(struct.pack(">HHI", 0x111, 0x8005, 0))
        answer = b""
        while piece := polite.recv(4096):
            answer += piece
        assert answer[:12] == struct.pack(">HHII", 0x111, 5, 0, 2), answer[:12]


def cases() -> list[SeededCase]:
    """Every fuzzer of this module."""
    return [
        SeededCase("device.mx64", "two emulated MX-64 on a line", mx64_line, size=3_000),
        SeededCase("device.m4010", "two emulated M4010 on a line", m4010_line, size=2_500),
        SeededCase("device.dex3", "the emulated Dex3-1 behind its USB endpoints", dex3, size=1_000),
        SeededCase("device.robots", "the emulated H1 and G1", robots, size=1_000),
        SeededCase("usbip.server", "clients of the USB/IP server", usbip_server, size=2_000),
    ]
