"""Encode and decode serial frames of the M4010, the Dex1-1's motor, without I/O
(docs/sources/unitree-dex.md#g, measured from the vendor's library).

A command is 20 bytes, the data that answer it 26: the structures of the Dex3-1's motors (the Dex3-1
manual) with other units. Several motors on a line are told apart by the id in the mode byte; id 15
addresses all of them, and none answers.

:class:`MotorCmd`, :class:`MotorData` and :class:`Calibration` are frames as raw integers with ways
from and to SI units at the *joint*; :class:`FrameParser` finds frames in a stream.

Defects of the vendor's library that are not copied: it sends every negative feed-forward torque as
0, velocities and gains beyond the wire's range wrap around (here they saturate), and neither head
nor id of an answer is checked.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cache
from typing import NamedTuple, TypeAlias

from dexkit.errors import ChecksumError, EncodeError, OversizeError, TruncatedError, WireError
from dexkit.models import DEX1_1
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.frame_buffer import FrameBuffer
from dexkit.wire.ris import (
    BROADCAST_ID,
    MOTOR_VOLTAGE,
    NUDGE,
    POSITION,
    TEMPERATURE,
    WINDING_TEMPERATURE,
    Field,
    Scale,
    Structure,
    ris_mode,
)

__all__ = [
    "BAUD_RATE",
    "BROADCAST_ID",
    "COMMAND",
    "DAMPING",
    "DATA",
    "GEAR_RATIO",
    "OPENING_BAUD_RATE",
    "POSITION",
    "REPLY_TIMEOUT",
    "SIDES",
    "STIFFNESS",
    "STROKE",
    "TORQUE",
    "USER_ID",
    "VELOCITY",
    "Calibration",
    "CalibrationProblem",
    "Feedback",
    "Frame",
    "FrameParser",
    "MotorCmd",
    "MotorData",
    "Setpoint",
    "Status",
    "calibration_outcome",
]

GEAR_RATIO = 25.0
"""Turns of the rotor for one of the gripper's joint (docs/sources/unitree-dex.md#g "Constants")."""
BAUD_RATE = 6_000_000
OPENING_BAUD_RATE = 4_000_000
"""The vendor's library opens the port at this rate; its first exchange with an M4010 switches to
:data:`BAUD_RATE` (docs/sources/unitree-dex.md#g "Serial")."""
REPLY_TIMEOUT = 0.02
"""Seconds that the vendor's library waits for an answer
(docs/sources/unitree-dex.md#g "Serial")."""
STROKE = math.radians(322.0)
"""Range that the vendor's service writes into the motor, rad at the joint
(docs/sources/unitree-dex.md#b2)."""
USER_ID = 0x776C
"""User id of the vendor's calibration frame (docs/sources/unitree-dex.md#g "Calibration")."""
SIDES = {number: side for side, number in DEX1_1.vendor_ids.items()}
"""Which hand the motor with an id is: 0 right, 1 left (docs/sources/unitree-dex.md#b2)."""

VELOCITY = Scale(
    "velocity", ("spd_des", "speed"), "rad/s", 256 / (2 * math.pi), -0x8000, 0x7FFF, power=1
)
TORQUE = Scale("torque", ("tor_des", "torque"), "N·m", 2560.0, -0x8000, 0x7FFF, power=-1)
STIFFNESS = Scale("stiffness", ("k_pos",), "N·m/rad", 12800.0, 0, 0xFFFF, power=-2)
DAMPING = Scale("damping", ("k_spd",), "N·m·s/rad", 12800.0, 0, 0xFFFF, power=-2)
_COMMAND_SCALES = (TORQUE, VELOCITY, POSITION, STIFFNESS, DAMPING)
_CALIBRATION_ANGLE = Scale("angle", ("position", "range"), "rad", POSITION.counts, 0, 0xFFFF)

COMMAND = Structure(
    "MotorCmd",
    "Command to a motor",
    b"\xfe\xee",
    (
        Field("head", "u8", 2, "FE EE"),
        Field("mode", "u8", 1, "id, status, time-out bit"),
        Field("res", "u8", 1, "reserved; passed through"),
        Field("tor_des", "i16", 1, "torque to add, of the rotor", "1/2560 N·m"),
        Field("spd_des", "i16", 1, "velocity wanted, of the rotor", "2π/256 rad/s"),
        Field("pos_des", "i32", 1, "position wanted, of the rotor", "2π/32768 rad"),
        Field("k_pos", "u16", 1, "stiffness, of the rotor", "1/12800 N·m/rad"),
        Field("k_spd", "u16", 1, "damping, of the rotor", "1/12800 N·m·s/rad"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 16),
)
DATA = Structure(
    "MotorData",
    "State of a motor",
    b"\xfc\xee",
    (
        Field("head", "u8", 2, "FC EE"),
        Field("mode", "u8", 1, "id, status, time-out bit: the protection has tripped"),
        Field("temp", "i8", 1, "temperature of the case", "1 °C"),
        Field("winding", "u8", 1, "temperature of the winding", "1 °C"),
        Field("vol", "u8", 1, "voltage at the terminals", "0.5 V"),
        Field("torque", "i16", 1, "torque, of the rotor", "1/2560 N·m"),
        Field("speed", "i16", 1, "velocity, of the rotor", "2π/256 rad/s"),
        Field("pos", "i32", 1, "position, of the rotor", "2π/32768 rad"),
        Field("MError", "u32", 1, "error bits"),
        Field("ExSensor1", "u16", 1, "extended sensor data"),
        Field("ExSensor2", "u16", 1, "extended sensor data"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (2, 22),
)

Bytes: TypeAlias = bytes | bytearray | memoryview
_U32 = struct.Struct("<I")
_CALIBRATION = struct.Struct("<2sBBhHHHI")
_CALIBRATION_TORQUE = -0x400  # 0xFC00, in command and answer
_CALIBRATED = 2  # speed field of the answer


class Status(IntEnum):
    """Commanded status, bits 4 to 6 of the mode byte (docs/sources/unitree-dex.md#g,
    docs/sources/unitree-dex.md#d28).
    """

    BRAKE = 0
    FOC = 1
    CALIBRATE = 6


_FOC = int(Status.FOC)


class CalibrationProblem(IntFlag):
    """MError bits of the answer to a calibration (docs/sources/unitree-dex.md#g "Calibration"); the
    lowest wins.
    """

    NONE = 0
    ALREADY_CALIBRATED = 0x01  # since power-up
    OUTPUT_ENCODER = 0x02
    ANGLE_OUT_OF_RANGE = 0x04
    RANGE_INVALID = 0x08
    USER_ID_ZERO = 0x10
    TIME_ZERO = 0x20
    FLASH_WRITE = 0x40


class Setpoint(NamedTuple):
    """Setpoint of the joint: rad, rad/s, N·m, N·m/rad, N·m·s/rad."""

    q: float
    dq: float
    tau: float
    kp: float
    kd: float


class Feedback(NamedTuple):
    """Measurements of a motor, at the joint: rad, rad/s, N·m."""

    q: float
    dq: float
    tau: float


@cache
def _command_factors(ratio: float) -> tuple[float, float, float, float, float]:
    """Counts per SI unit of tau, dq, q, kp and kd at the joint."""
    tau, dq, q, kp, kd = (scale.factor(ratio) * NUDGE for scale in _COMMAND_SCALES)
    return tau, dq, q, kp, kd


def _mode(number: int, status: int, timeout: bool) -> int:
    if 0 <= number <= 15 and 0 <= status <= 7:
        return number | status << 4 | (0x80 if timeout else 0)
    return ris_mode(number, status, timeout)  # which says what is wrong


def _pack_with_crc(structure: Structure, *values: int | bytes) -> bytes:
    start, end = structure.covered
    packet = structure.pack(structure.head, *values, 0)
    return packet[:end] + _U32.pack(crc32_words(packet[start:end]))


def _unpack_checked(structure: Structure, data: Bytes) -> tuple[int, ...]:
    """Fields between head and CRC."""
    if len(data) < structure.size:
        raise TruncatedError(f"{structure.name} is {structure.size} bytes, got {len(data)}")
    if len(data) > structure.size:
        raise OversizeError(f"{structure.name} is {structure.size} bytes, got {len(data)}")
    if data[:2] != structure.head:
        raise WireError(
            f"{structure.name} starts with {structure.head.hex(' ')}, "
            f"these bytes with {bytes(data[:2]).hex(' ')}"
        )
    start, end = structure.covered
    stored, computed = _U32.unpack_from(data, end)[0], crc32_words(data[start:end])
    if stored != computed:
        raise ChecksumError(
            f"{structure.name}: CRC is 0x{stored:08X}, the data make it 0x{computed:08X}"
        )
    return structure.struct.unpack(data)[1:-1]


@dataclass(slots=True)
class MotorCmd:
    """A command: raw integers, rotor side.

    :param timeout: asks for the motor's protection, which stops it when commands stop.
    """

    id: int
    status: int = Status.BRAKE
    timeout: bool = False
    tor_des: int = 0
    spd_des: int = 0
    pos_des: int = 0
    k_pos: int = 0
    k_spd: int = 0
    res: int = 0

    @classmethod
    def setpoint(
        cls,
        number: int,
        *,
        q: float = 0.0,
        dq: float = 0.0,
        tau: float = 0.0,
        kp: float = 0.0,
        kd: float = 0.0,
        timeout: bool = False,
        ratio: float = GEAR_RATIO,
    ) -> MotorCmd:
        """Drive the joint: ``tau_motor = kp (q - q_now) + kd (dq - dq_now) + tau``.

        SI units at the joint; rounded toward zero as in the vendor's library, and saturated.

        :param number: id of the motor.
        :raises EncodeError: NaN or infinity.
        """
        if not math.isfinite(q + dq + tau + kp + kd):
            for value, scale in zip((tau, dq, q, kp, kd), _COMMAND_SCALES, strict=True):
                scale.encode(value, ratio)  # which says what is wrong
        # what Scale.encode does, for all five at once
        per_tau, per_dq, per_q, per_kp, per_kd = _command_factors(ratio)
        return cls(
            number,
            _FOC,
            timeout,
            int(min(max(tau * per_tau, -0x8000), 0x7FFF)),
            int(min(max(dq * per_dq, -0x8000), 0x7FFF)),
            int(min(max(q * per_q, -0x80000000), 0x7FFFFFFF)),
            int(min(max(kp * per_kp, 0), 0xFFFF)),
            int(min(max(kd * per_kd, 0), 0xFFFF)),
        )

    def joint(self, ratio: float = GEAR_RATIO) -> Setpoint:
        """The setpoint in SI units at the joint."""
        return Setpoint(
            POSITION.decode(self.pos_des, ratio),
            VELOCITY.decode(self.spd_des, ratio),
            TORQUE.decode(self.tor_des, ratio),
            STIFFNESS.decode(self.k_pos, ratio),
            DAMPING.decode(self.k_spd, ratio),
        )

    def pack(self) -> bytes:
        """Its 20 bytes.

        :raises EncodeError: a value does not fit.
        """
        mode = _mode(self.id, self.status, self.timeout)
        values = (self.tor_des, self.spd_des, self.pos_des, self.k_pos, self.k_spd)
        return _pack_with_crc(COMMAND, mode, self.res, *values)

    @classmethod
    def parse(cls, data: Bytes) -> MotorCmd:
        """One frame.

        :raises WireError: wrong length, head or CRC.
        """
        mode, res, tor, spd, pos, k_pos, k_spd = _unpack_checked(COMMAND, data)
        return cls(mode & 15, mode >> 4 & 7, mode > 127, tor, spd, pos, k_pos, k_spd, res)


@dataclass(slots=True)
class MotorData:
    """The state that answers a command: raw integers, rotor side.

    :param timeout: the motor's protection has tripped; cleared by a command without the bit.
    :param temp: of the case, °C.
    :param winding: °C.
    :param vol: counts of 0.5 V.
    :param merror: :class:`dexkit.hand.MotorError` bits; in the answer to a calibration
        :class:`CalibrationProblem`.
    """

    id: int
    status: int = Status.BRAKE
    timeout: bool = False
    temp: int = 0
    winding: int = 0
    vol: int = 0
    torque: int = 0
    speed: int = 0
    pos: int = 0
    merror: int = 0
    ex_sensor1: int = 0
    ex_sensor2: int = 0

    @classmethod
    def measured(
        cls,
        number: int,
        status: int,
        *,
        q: float,
        dq: float = 0.0,
        tau: float = 0.0,
        temperature: float = 0.0,
        winding: float = 0.0,
        voltage: float = 0.0,
        error: int = 0,
        timeout: bool = False,
        ratio: float = GEAR_RATIO,
    ) -> MotorData:
        """From SI units at the joint.

        :param number: id of the motor.
        :raises EncodeError: NaN or infinity.
        """
        return cls(
            number,
            status,
            timeout,
            TEMPERATURE.encode(temperature),
            WINDING_TEMPERATURE.encode(winding),
            MOTOR_VOLTAGE.encode(voltage),
            TORQUE.encode(tau, ratio),
            VELOCITY.encode(dq, ratio),
            POSITION.encode(q, ratio),
            error,
        )

    def joint(self, ratio: float = GEAR_RATIO) -> Feedback:
        """The measured values in SI units at the joint."""
        return Feedback(
            POSITION.decode(self.pos, ratio),
            VELOCITY.decode(self.speed, ratio),
            TORQUE.decode(self.torque, ratio),
        )

    @property
    def voltage(self) -> float:
        """V."""
        return MOTOR_VOLTAGE.decode(self.vol)

    def pack(self) -> bytes:
        """Its 26 bytes.

        :raises EncodeError: a value does not fit.
        """
        mode = _mode(self.id, self.status, self.timeout)
        heat = (self.temp, self.winding, self.vol)
        motion = (self.torque, self.speed, self.pos)
        rest = (self.merror, self.ex_sensor1, self.ex_sensor2)
        return _pack_with_crc(DATA, mode, *heat, *motion, *rest)

    @classmethod
    def parse(cls, data: Bytes) -> MotorData:
        """One frame.

        :raises WireError: wrong length, head or CRC.
        """
        mode, *values = _unpack_checked(DATA, data)
        return cls(mode & 15, mode >> 4 & 7, mode > 127, *values)


@dataclass(frozen=True)
class Calibration:
    """The command frame that declares the motor's present position.

    :param position: what the joint is at now, rad, 0 to 4 pi. The vendor's library also takes
        negative ones, and then spoils the user id.
    :param range: stroke of the joint, rad, likewise; at the joint, unlike all other fields.
    :param time: Unix time, seconds.
    """

    id: int
    position: float = 0.0
    range: float = STROKE
    time: int = 0
    user_id: int = USER_ID

    def pack(self) -> bytes:
        """Its 20 bytes.

        :raises EncodeError: a value does not fit.
        """
        for name in ("position", "range"):
            if not 0.0 <= getattr(self, name) <= _CALIBRATION_ANGLE.limits()[1]:
                raise EncodeError(f"{name} = {getattr(self, name)} rad is not 0 to 4 pi")
        if not 0 <= self.time <= 0xFFFFFFFF or not 0 <= self.user_id <= 0xFFFF:
            raise EncodeError(f"time {self.time} or user id {self.user_id} does not fit")
        packet = _CALIBRATION.pack(
            COMMAND.head,
            ris_mode(self.id, Status.CALIBRATE, False),
            0,
            _CALIBRATION_TORQUE,
            _CALIBRATION_ANGLE.encode(self.range),
            _CALIBRATION_ANGLE.encode(self.position),
            self.user_id,
            self.time,
        )
        return packet + _U32.pack(crc32_words(packet))

    @classmethod
    def from_command(cls, command: MotorCmd) -> Calibration | None:
        """The calibration in a command with status 6, or None."""
        if command.status != Status.CALIBRATE or command.tor_des != _CALIBRATION_TORQUE:
            return None
        position = command.pos_des & 0xFFFF
        return cls(
            command.id,
            _CALIBRATION_ANGLE.decode(position),
            _CALIBRATION_ANGLE.decode(command.spd_des & 0xFFFF),
            command.k_pos | command.k_spd << 16,
            command.pos_des >> 16 & 0xFFFF,
        )

    def answer(self, problem: int = CalibrationProblem.NONE, *, done: bool = True) -> MotorData:
        """The frame that a motor answers it with.

        :param problem: error bits.
        :param done: False where calibrating is not enabled.
        """
        return MotorData(
            self.id,
            Status.CALIBRATE,
            torque=_CALIBRATION_TORQUE,
            speed=_CALIBRATED if done else 0,
            merror=problem,
        )


def calibration_outcome(data: MotorData) -> str:
    """Explain an answer to a calibration: empty when it succeeded, else the reason of the failure.

    The vendor's library takes anything else than an answer to a calibration, even silence, for
    success (docs/sources/unitree-dex.md#g).
    """
    if data.status != Status.CALIBRATE or data.torque != _CALIBRATION_TORQUE:
        return "the motor does not know the command (firmware without calibration?)"
    if data.speed != _CALIBRATED:
        return "the motor's calibration mode is not enabled"
    for problem in CalibrationProblem:
        if problem and data.merror & problem:
            return _PROBLEMS[problem]
    return f"error bits 0x{data.merror:X}" if data.merror else ""


_PROBLEMS = {
    CalibrationProblem.ALREADY_CALIBRATED: (
        "it was calibrated before since power-up: switch its supply off and on first"
    ),
    CalibrationProblem.OUTPUT_ENCODER: "the encoder on the output reports an error",
    CalibrationProblem.ANGLE_OUT_OF_RANGE: "the position is out of range",
    CalibrationProblem.RANGE_INVALID: "the range is not one that the motor takes",
    CalibrationProblem.USER_ID_ZERO: "the user id is 0",
    CalibrationProblem.TIME_ZERO: "the time is 0",
    CalibrationProblem.FLASH_WRITE: "the motor could not write its flash memory",
}

Frame: TypeAlias = MotorCmd | MotorData
_KINDS: dict[str, type[MotorCmd] | type[MotorData]] = {
    COMMAND.name: MotorCmd,
    DATA.name: MotorData,
}


class FrameParser(FrameBuffer):
    """Finds frames in a stream of bytes that may arrive in any pieces, with garbage between them.

    :param kinds: of frames that may come: :data:`COMMAND` at the motor's end, :data:`DATA` at the
        host's, both for a listener.

    After a frame with a wrong CRC the search continues at the next byte, so frames within it are
    still found. Less than one frame is buffered.

    :ivar frames: found so far.
    :ivar skipped: bytes that belonged to no frame.
    :ivar crc_errors: heads whose frame had a wrong CRC.
    """

    def __init__(self, kinds: Iterable[Structure] = (DATA,)) -> None:
        super().__init__()
        self.kinds = tuple(kinds)
        self.frames = 0
        self.crc_errors = 0
        self._firsts = bytes(kind.head[0] for kind in self.kinds)

    def feed(self, data: Bytes) -> list[Frame]:
        """Take ``data`` and return the frames that are now complete."""
        buffer = self._buffer
        frames: list[Frame] = []
        if not buffer and len(data) == self.kinds[0].size:  # a whole frame: the usual case
            try:
                frames.append(_KINDS[self.kinds[0].name].parse(data))
                self.frames += 1
                return frames
            except WireError:
                pass  # other data, or damaged: search byte by byte
        buffer += data
        start = 0  # of what is not yet consumed
        while len(buffer) - start >= 2:
            places = [
                (at, kind) for kind in self.kinds if (at := buffer.find(kind.head, start)) >= 0
            ]
            if not places:
                keep = 1 if buffer[-1] in self._firsts else 0
                self.skipped += len(buffer) - keep - start
                start = len(buffer) - keep
                break
            at, kind = min(places, key=_frame_offset)
            self.skipped += at - start
            start = at
            if len(buffer) - start < kind.size:
                break
            try:
                frames.append(_KINDS[kind.name].parse(bytes(buffer[start : start + kind.size])))
                start += kind.size
            except ChecksumError:
                self.crc_errors += 1
                self.skipped += 1
                start += 1
        if len(buffer) - start == 1 and buffer[start] not in self._firsts:
            self.skipped += 1
            start += 1
        del buffer[:start]
        self.frames += len(frames)
        return frames


def _frame_offset(found: tuple[int, Structure]) -> int:
    return found[0]
