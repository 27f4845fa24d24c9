"""Codecs of serial and USB packets, and the emulated devices that take them."""

from __future__ import annotations

import itertools
import random
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import fastcrc

from dexkit.clock import ManualClock
from dexkit.emulators.dex3_mcu.device import Dex3Mcu
from dexkit.hand import HandCommand, HandState, Side
from dexkit.models import DEX3_1
from dexkit.wire import dex3_usb, dynamixel, low_level, m4010, ris
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import packets
from tools.campaign.fuzz.case import Difference, FuzzCase, Prepare, Target
from tools.campaign.mutate import Fix, mutator

__all__ = ["cases"]

_umts = fastcrc.crc16.umts


# --- corpora


def _read(address: int, size: int) -> bytes:
    return struct.pack("<HH", address, size)


def instruction_packets() -> list[bytes]:
    """Instruction packets of every kind, to one servo and to all."""
    code = dynamixel.Instruction
    one = [
        (code.PING, b""),
        (code.READ, _read(132, 4)),
        (code.READ, _read(0, 147)),
        (code.WRITE, struct.pack("<HB", 64, 1)),
        (code.WRITE, struct.pack("<Hi", 116, 2000)),
        (code.WRITE, struct.pack("<H", 168) + bytes(range(20))),
        (code.REG_WRITE, struct.pack("<Hi", 116, 2500)),
        (code.ACTION, b""),
        (code.FACTORY_RESET, b"\x02"),
        (code.REBOOT, b""),
        (code.CLEAR, dynamixel.CLEAR_POSITION_KEY),
        (code.CONTROL_TABLE_BACKUP, b"\x01" + dynamixel.BACKUP_KEY),
        (code.WRITE, b"\x40\x00\xff\xff\xfd\x01"),
    ]
    several = [
        (code.SYNC_READ, _read(132, 4) + b"\x01\x02"),
        (code.SYNC_WRITE, _read(116, 4) + b"\x01" + struct.pack("<i", 1800)),
        (code.FAST_SYNC_READ, _read(132, 4) + b"\x01\x02"),
        (code.BULK_READ, b"\x01" + _read(132, 4) + b"\x02" + _read(126, 2)),
        (code.BULK_WRITE, b"\x01" + _read(116, 4) + struct.pack("<i", 1700)),
        (code.FAST_BULK_READ, b"\x01" + _read(132, 4)),
        (code.PING, b""),
    ]
    return [dynamixel.encode(1, c, p) for c, p in one] + [
        dynamixel.encode(dynamixel.BROADCAST_ID, c, p) for c, p in several
    ]


def _status_packets() -> list[bytes]:
    return [
        dynamixel.status(1, 0, b"\x00\x08\x00\x00"),
        dynamixel.status(1, 0x80, b""),
        dynamixel.status(2, 3, b"\xff\xff\xfd\xfd"),
        dynamixel.fast_status([(1, 0, b"\x01\x02"), (2, 0x80, b"\x03\x04")]),
    ]


def fix_dynamixel(data: bytearray) -> None:
    """Make header, length and CRC of a Dynamixel packet right."""
    if len(data) < 10:
        return
    data[0:4] = dynamixel.HEADER
    if len(data) & 1:  # every other time the length stays wrong
        data[5:7] = (len(data) - 7).to_bytes(2, "little")
    data[-2:] = int(_umts(bytes(data[:-2]))).to_bytes(2, "little")


def fix_words(first: int, head: bytes = b"") -> Fix:
    """Make a word CRC right that covers everything from ``first`` on."""

    def fix(data: bytearray) -> None:
        if head:
            data[0 : len(head)] = head
        if len(data) >= first + 8 and (len(data) - first) % 4 == 0:
            data[-4:] = crc32_words(data[first:-4]).to_bytes(4, "little")

    return fix


def _motor_commands() -> list[bytes]:
    return [
        m4010.MotorCmd.setpoint(0, q=q, dq=0.5, tau=0.1, kp=5.0, kd=0.05).pack()
        for q in (0.0, 2.5, 5.4)
    ] + [
        m4010.MotorCmd(15, 0, False, 0, 0, 0, 0, 0).pack(),
        m4010.Calibration(0, 0.0, time=1).pack(),
    ]


def _motor_data() -> list[bytes]:
    plain = m4010.MotorData.measured(1, 1, q=1.0, dq=-2.0, tau=0.3, voltage=12.0)
    return [plain.pack(), m4010.Calibration(1).answer().pack()]


def _dex3_commands() -> list[bytes]:
    joints = DEX3_1.joints[Side.LEFT]
    found = []
    for layout in (dex3_usb.COMMAND_1234, dex3_usb.COMMAND_734):
        codec = dex3_usb.HandCodec(joints, layout=layout)
        found.append(codec.encode(HandCommand.position([0.1] * 7, kp=1.5, kd=0.2)))
        found.append(codec.encode(HandCommand.brake(7)))
    return found


def _dex3_states() -> list[bytes]:
    codec = dex3_usb.HandCodec(DEX3_1.joints[Side.LEFT])
    clock = ManualClock()
    device = Dex3Mcu(Side.LEFT, clock=clock)
    command = codec.encode(HandCommand.brake(7))
    found = []
    for _ in range(3):
        clock.advance(0.01)
        answer = device.exchange(command)
        assert answer is not None
        found.append(answer)
    found.append(device.state([0, 1, 2]))
    return found


def _fix_frame(structure: ris.Structure) -> Fix:
    start, end = structure.covered

    def fix(data: bytearray) -> None:
        if len(data) == structure.size:
            data[end : end + 4] = crc32_words(data[start:end]).to_bytes(4, "little")

    return fix


# --- targets


def _same(a: Any, b: Any, what: str) -> None:
    if a != b:
        raise Difference(f"{what}: {a!r} and {b!r}")


def _bytes(corpus: Sequence[bytes], fix: Fix | None, run: Callable[[bytes], object]) -> Prepare:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        return Target(mutator(corpus, rng, fix), run)

    return prepare


def _decode_dynamixel(data: bytes) -> None:
    packet = dynamixel.decode(data)
    if packet.id <= dynamixel.MAX_ID:
        again = dynamixel.decode(dynamixel.encode(packet.id, packet.instruction, packet.params))
        _same(again, packet, "encoded again")


def _stream(make: Callable[[], Any], most: int) -> Callable[[random.Random, bytes], None]:
    """Feed a stream parser in pieces; it must find what it finds in one piece."""

    def run(rng: random.Random, data: bytes) -> None:
        whole, pieces = make(), make()
        found = whole.feed(data)
        cut = rng.getrandbits(8) % (len(data) + 1)
        _same(pieces.feed(data[:cut]) + pieces.feed(data[cut:]), found, "cut in two")
        _same(pieces.pending, whole.pending, "bytes held")
        if whole.pending > most:
            raise Difference(f"{whole.pending} bytes are held, at most {most} should be")

    return run


def _streams(corpus: Sequence[bytes], fix: Fix, make: Callable[[], Any], most: int) -> Prepare:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        damaged = mutator(corpus, rng, fix)
        feed = _stream(make, most)
        good = list(corpus)

        def stream() -> bytes:
            r = rng.getrandbits(8)
            return damaged() + good[r % len(good)] if r & 128 else damaged()

        return Target(stream, lambda data: feed(rng, data))

    return prepare


def _split(data: bytes) -> None:
    packet = dynamixel.Packet(254, 0x55, data[2:])
    sizes = [data[0] & 15, data[1] & 15] if len(data) > 1 else [2]
    for _, _, part in dynamixel.split_fast_status(packet, sizes):
        _same(len(part) in sizes, True, "size of a part")


def _status_fields(data: bytes) -> None:
    packet = dynamixel.decode(data)
    assert packet.error_number | packet.alert << 7 == packet.error
    assert len(packet.data) + 1 == len(packet.params)


def _pack_again(kind: Any) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        _same(kind.parse(data).pack(), data, "packed again")

    return run


def _m4010_motor(data: bytes) -> None:
    command = m4010.MotorCmd.parse(data)
    _same(command.pack(), data, "packed again")
    command.joint()
    calibration = m4010.Calibration.from_command(command)
    if calibration is not None:
        calibration.answer().pack()


def _m4010_data(data: bytes) -> None:
    found = m4010.MotorData.parse(data)
    _same(found.pack(), data, "packed again")
    found.joint()
    m4010.calibration_outcome(found)
    assert found.voltage >= 0


def _scan(data: bytes) -> None:
    kinds = packets.FROM_HAND if data[-1:] > b"\x7f" else packets.TO_HAND
    found, lost = packets.scan_bus(data, kinds)
    for (at, kind), (then, _) in itertools.pairwise(found):
        _same(at + kind.size <= then, True, "packets overlap")
    for problem in lost:
        str(problem)


def _parsed_command(data: bytes) -> None:
    frame = packets.parse_command(data)
    str(frame.problems)
    list(frame.motors)


def _parsed_state(data: bytes) -> None:
    frame = packets.parse_state(data)
    str(frame.problems)
    list(frame.motors)
    list(frame.sensors)


def _dex3_codec(rng: random.Random, scratch: Path) -> Target:
    codec = dex3_usb.HandCodec(DEX3_1.joints[Side.LEFT])
    states = _dex3_states()

    def run(data: bytes) -> None:
        state: HandState = codec.decode(data, 0.0)
        if not codec.problems and not codec.missing_motors:
            fresh = dex3_usb.HandCodec(DEX3_1.joints[Side.LEFT]).decode(data, 0.0)
            _same(fresh.q.tobytes(), state.q.tobytes(), "remembered and fresh plan")

    return Target(mutator(states, rng, _fix_deep_state), run)


def _fix_deep_state(data: bytearray) -> None:
    """The frame's CRC, and that of one packet in it, so that its values are reached."""
    for at in range(0, len(data) - 60, 2):
        if data[at : at + 2] == dex3_usb.MOTOR_STATE.head:
            size = dex3_usb.MOTOR_STATE.size
            start, end = dex3_usb.MOTOR_STATE.covered
            data[at + end : at + size] = crc32_words(data[at + start : at + end]).to_bytes(
                4, "little"
            )
            break
    _fix_frame(dex3_usb.STATE)(data)


def _dex3_decode_command(rng: random.Random, scratch: Path) -> Target:
    codec = dex3_usb.HandCodec(DEX3_1.joints[Side.LEFT])
    return Target(
        mutator(_dex3_commands(), rng, _fix_command), lambda data: codec.decode_command(data)
    )


def _fix_command(data: bytearray) -> None:
    for layout in dex3_usb.COMMAND_LAYOUTS:
        _fix_frame(layout.structure)(data)


def _low(name: str) -> Prepare:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        from dexkit.messages import message_type

        good = low_level.encode_with_crc(message_type(name).cls())

        def run(data: bytes) -> None:
            low_level.verify_payload(name, data)
            image = low_level.struct_of_payload(name, data)
            back = low_level.payload_of_struct(name, image)
            _same(low_level.struct_of_payload(name, back), image, "image and back")

        return Target(mutator([good], rng), run)

    return prepare


# --- emulated devices, without a line


_LOW = (
    "unitree_go::msg::dds_::LowCmd_",
    "unitree_hg::msg::dds_::LowCmd_",
    "unitree_hg::msg::dds_::LowState_",
)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    statuses = _status_packets()
    both = instruction_packets() + statuses
    commands, answers = _motor_commands(), _motor_data()
    to_motor, from_motor = fix_words(0, m4010.COMMAND.head), fix_words(0, m4010.DATA.head)
    drive = packets.MotorCmd(1, 1, True, 5, -6, 7, 8, 9).pack()
    motor = packets.MotorState(1, 1, False, 25, 30, 120, 1, 2, 3).pack()
    touch = packets.SensorState(1, 0, tuple(range(12)), tuple(range(12))).pack()
    to_joint = fix_words(0, dex3_usb.MOTOR_CMD.head)
    from_joint = fix_words(0, dex3_usb.MOTOR_STATE.head)
    from_sensor = fix_words(0, dex3_usb.SENSOR_STATE.head)

    def parser() -> Any:
        return dynamixel.PacketParser(keep_bad=True)

    def frames() -> Any:
        return m4010.FrameParser((m4010.COMMAND, m4010.DATA))

    table: list[tuple[str, str, Prepare]] = [
        ("dynamixel.decode", "a Dynamixel packet", _bytes(both, fix_dynamixel, _decode_dynamixel)),
        ("dynamixel.parser", "a stream of Dynamixel packets, cut anywhere",
         _streams(both, fix_dynamixel, parser, 1024)),
        ("dynamixel.status", "fields of a status packet",
         _bytes(statuses, fix_dynamixel, _status_fields)),
        ("dynamixel.fast", "a combined status", _bytes(statuses, None, _split)),
        ("m4010.command", "a command frame of the M4010", _bytes(commands, to_motor, _m4010_motor)),
        ("m4010.data", "a data frame of the M4010", _bytes(answers, from_motor, _m4010_data)),
        ("m4010.parser", "a stream of M4010 frames, cut anywhere",
         _streams(commands + answers, to_motor, frames, 26)),
        ("dex3.MotorCmd", "a MotorCmd packet of the Dex3-1",
         _bytes([drive], to_joint, _pack_again(packets.MotorCmd))),
        ("dex3.MotorState", "a MotorState packet of the Dex3-1",
         _bytes([motor], from_joint, _pack_again(packets.MotorState))),
        ("dex3.SensorState", "a SensorState packet of the Dex3-1",
         _bytes([touch], from_sensor, _pack_again(packets.SensorState))),
        ("dex3.bus", "a bus buffer of the Dex3-1",
         _bytes([drive * 2, motor + touch], to_joint, _scan)),
        ("dex3.command-frame", "a frame to the Dex3-1",
         _bytes(_dex3_commands(), _fix_command, _parsed_command)),
        ("dex3.state-frame", "a frame from the Dex3-1",
         _bytes(_dex3_states(), _fix_frame(dex3_usb.STATE), _parsed_state)),
        ("dex3.codec", "the driver's reading of a state frame", _dex3_codec),
        ("dex3.codec-command", "the hand's reading of a command frame", _dex3_decode_command),
        *((f"low_level.{n.replace('::msg::dds_::', '.')}", f"image and CRC of {n}", _low(n))
          for n in _LOW),
    ]  # fmt: skip
    return [FuzzCase(*row) for row in table]
