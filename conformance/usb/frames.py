"""Read and write the Dex3-1's USB frames, independently of the drivers' codec.

This code follows the manual alone.

It is separate from :mod:`dexkit.wire.dex3_usb`, which drivers and emulators share: a mistake there
would be on both ends of the wire and would never show. The two are compared by the tests, and
with the vectors of docs/sources/unitree-dex.md#c8. This one is lenient: it reads as much as
possible of any bytes, and the checks judge the result.

Layouts and units: the Dex3-1 manual "Introduction to Send and Receive Structures",
docs/sources/unitree-dex.md#c. All little endian, one-byte alignment.
"""

from __future__ import annotations

import math
import struct
import zlib
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from dexkit.hand import JointSpec

__all__ = [
    "BUSES",
    "COMMAND_SIZES",
    "NO_VALUES",
    "STATE_SIZE",
    "Motor",
    "MotorReading",
    "Scale",
    "SensorReading",
    "StateReading",
    "crc",
    "motor_packet",
    "pack_command",
    "read_command",
    "read_state",
]

BUSES = 5
COMMAND_SIZES = {1234: 240, 734: 140}
"""Bytes of a command frame, and of each bus buffer in it: the manual's two versions."""
STATE_SIZE = 1270
STATE_BUS = 240
NO_VALUES = (3750, 30000)
"""Pressure counts of a slot without sensor element (the Dex3-1 manual "30000 represents no value",
which may be Pa, 3750 counts of 8, or counts)."""

_MOTOR_CMD = struct.Struct("<2sBBhhihh")
_MOTOR_STATE = struct.Struct("<2sBbBBhhiIHH")
_SENSOR = struct.Struct("<2sBB12H12b")
_SUPPLY = struct.Struct("<4H6hI4I")
_U32 = struct.Struct("<I")
_SIZES = struct.Struct("<5I")
_MIRRORED = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))
_LITTLE = array("I", [1]).tobytes()[0] == 1


def crc(data: bytes) -> int:
    """The manual's CRC32 of whole 32-bit little-endian words; bytes beyond the last are left out.

    Polynomial 0x04C11DB7 from 0xFFFFFFFF, most significant bit first, nothing inverted at the end
    (the Dex3-1 manual "CRC32 Function Calculation Method"). zlib computes the same polynomial with
    all bits in mirrored order, so the bits are mirrored before and after.
    """
    words = array("I", data[: len(data) // 4 * 4])
    if _LITTLE:
        words.byteswap()
    mirrored = zlib.crc32(words.tobytes().translate(_MIRRORED)) ^ 0xFFFFFFFF
    return int.from_bytes(mirrored.to_bytes(4, "little").translate(_MIRRORED), "big")


@dataclass(frozen=True)
class Scale:
    """Counts on the wire per SI unit of one joint (docs/sources/unitree-dex.md#c9).

    The rotor turns ``ratio`` times as fast as the joint. 32768/2pi counts are a radian, 256/2pi
    are 100 rad/s, 256 are 1 mN·m, 1280 are 1 mN·m/rad and 1 mN·m per 100 rad/s.
    """

    ratio: float

    @property
    def q(self) -> float:
        """Counts per rad."""
        return self.ratio * 32768 / (2 * math.pi)

    @property
    def dq(self) -> float:
        """Counts per rad/s."""
        return self.ratio / 100 * 256 / (2 * math.pi)

    @property
    def tau(self) -> float:
        """Counts per N·m."""
        return 1000 / self.ratio * 256

    @property
    def kp(self) -> float:
        """Counts per N·m/rad."""
        return 1000 / self.ratio**2 * 1280

    @property
    def kd(self) -> float:
        """Counts per N·m·s/rad."""
        return 1000 * 100 / self.ratio**2 * 1280


@dataclass(frozen=True)
class Motor:
    """A command to one motor, joint side, SI units.

    :param status: 0 lock, 1 FOC.
    :param protect: bit 7: enable the time-out protection.
    """

    status: int = 0
    q: float = 0.0
    dq: float = 0.0
    tau: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    protect: bool = False


def motor_packet(
    number: int, motor: Motor, joint: JointSpec, *, head: bytes = b"\xfe\xee", spoil: bool = False
) -> bytes:
    """``MotorCmd_t``, 20 bytes.

    :param number: motor id on its bus, 0 to 15.
    :param spoil: write a wrong CRC.
    """
    scale = Scale(joint.gear_ratio)

    def counts(value: float, bits: int) -> int:
        return max(-(1 << bits - 1), min((1 << bits - 1) - 1, int(value)))

    body = _MOTOR_CMD.pack(
        head,
        number & 15 | (motor.status & 7) << 4 | motor.protect << 7,
        0,
        counts(motor.tau * scale.tau, 16),
        counts(motor.dq * scale.dq, 16),
        counts(motor.q * scale.q, 32),
        counts(motor.kp * scale.kp, 16),
        counts(motor.kd * scale.kd, 16),
    )
    return body + _U32.pack(crc(body) ^ (0x5A5A5A5A if spoil else 0))


def pack_command(
    buses: Mapping[int, Sequence[bytes]],
    size: int = 1234,
    *,
    sizes: Mapping[int, int] | None = None,
    spoil: bool = False,
) -> bytes:
    """``LinuxToMcuCmd_t``, ``size`` bytes: 1234, or 734.

    The manual gives the head no value and leaves it out of the CRC; FE FD stands there, as the
    motor packets' head differs from their state's (docs/sources/unitree-dex.md#c5).

    :param buses: packets by bus.
    :param sizes: a bus's ``cmd_size`` that is not its true one.
    :param spoil: write a wrong CRC into the frame.
    """
    buffer = COMMAND_SIZES[size]
    data = {bus: b"".join(packets) for bus, packets in buses.items()}
    declared = [(sizes or {}).get(bus, len(data.get(bus, b""))) for bus in range(BUSES)]
    body = b"".join(
        (
            bytes(4),
            _SIZES.pack(*declared),
            *(data.get(bus, b"").ljust(buffer, b"\0") for bus in range(BUSES)),
            bytes(4),
        )
    )
    return b"\xfe\xfd" + body + _U32.pack(crc(body) ^ (0x5A5A5A5A if spoil else 0))


@dataclass(frozen=True)
class MotorReading:
    """One received ``MotorState_t`` in raw counts.

    :param intact: head and CRC are right.
    """

    bus: int
    id: int
    status: int
    tripped: bool
    temperature: int
    winding: int
    voltage: float
    torque: int
    speed: int
    position: int
    error: int
    intact: bool


@dataclass(frozen=True)
class SensorReading:
    """One ``SensorState_t``."""

    bus: int
    id: int
    pressure: tuple[int, ...]
    temperature: tuple[int, ...]
    intact: bool


@dataclass(frozen=True)
class StateReading:
    """A state frame as far as it could be read.

    :param crc_right: the frame's CRC.
    :param strange: description of bytes on a bus that are neither a motor's nor a sensor's packet.
    :param pin_v: supply, V; pin_a: supply current, A.
    """

    length: int
    head: bytes
    crc_right: bool = False
    motors: tuple[MotorReading, ...] = ()
    sensors: tuple[SensorReading, ...] = ()
    strange: tuple[str, ...] = ()
    pin_v: float = math.nan
    pin_a: float = math.nan
    error: int = 0


_MOTOR_SIZE, _SENSOR_SIZE = 26, 44


@lru_cache(maxsize=2048)
def read_state(data: bytes) -> StateReading:
    """Read ``McuToLinuxState_t``, or the part of it that is present."""
    if len(data) < STATE_SIZE:
        return StateReading(len(data), data[:2])
    frame = data[:STATE_SIZE]
    motors: list[MotorReading] = []
    sensors: list[SensorReading] = []
    strange: list[str] = []
    for bus, size in enumerate(_SIZES.unpack_from(frame, 6)):
        if size > STATE_BUS:
            strange.append(f"bus {bus}: state_size {size} of {STATE_BUS}")
            continue
        start = 26 + bus * STATE_BUS
        strange += _read_bus(motors, sensors, bus, frame[start : start + size])
    pin_v, _vin_v, _vm_v, pin_a, *rest = _SUPPLY.unpack_from(frame, 1226)
    return StateReading(
        length=len(data),
        head=data[:2],
        crc_right=crc(frame[2:1266]) == _U32.unpack_from(frame, 1266)[0],
        motors=tuple(motors),
        sensors=tuple(sensors),
        strange=tuple(strange),
        pin_v=pin_v / 65536 * 3.3 * 21.0,
        pin_a=pin_a / 65536 * 3.3 * 10.0,
        error=rest[6],
    )


def _read_bus(
    motors: list[MotorReading], sensors: list[SensorReading], bus: int, data: bytes
) -> list[str]:
    """Add a bus's packets to the reading; return a description of unknown bytes."""
    at = 0
    while at < len(data):
        rest = len(data) - at
        head = data[at : at + 2]
        # a packet with only a wrong head is recognised by its length and CRC
        if head != b"\x7e\xe7" and rest >= _MOTOR_SIZE:
            right = crc(data[at + 2 : at + 22]) == _U32.unpack_from(data, at + 22)[0]
            if head == b"\xfc\xee" or right:
                v = _MOTOR_STATE.unpack_from(data, at)
                motors.append(
                    MotorReading(
                        bus=bus,
                        id=v[1] & 15,
                        status=v[1] >> 4 & 7,
                        tripped=bool(v[1] & 0x80),
                        temperature=v[2],
                        winding=v[3],
                        voltage=v[4] / 2,
                        torque=v[5],
                        speed=v[6],
                        position=v[7],
                        error=v[8],
                        intact=right and head == b"\xfc\xee",
                    )
                )
                at += _MOTOR_SIZE
                continue
        if rest >= _SENSOR_SIZE:
            right = crc(data[at : at + 40]) == _U32.unpack_from(data, at + 40)[0]
            if head == b"\x7e\xe7" or right:
                v = _SENSOR.unpack_from(data, at)
                sensors.append(
                    SensorReading(
                        bus=bus,
                        id=v[1] & 15,
                        pressure=v[3:15],
                        temperature=v[15:27],
                        intact=right and head == b"\x7e\xe7",
                    )
                )
                at += _SENSOR_SIZE
                continue
        return [f"bus {bus}, byte {at}: {head.hex(' ')} begins no packet"]
    return []


def read_command(data: bytes) -> list[tuple[int, int, Motor]] | None:
    """The motors' commands in a good command frame as (bus, id, command in raw counts).

    None for an invalid frame: wrong length, wrong CRC, or a size larger than the buffer. Packets
    with a wrong head or CRC are left out.
    """
    buffer = COMMAND_SIZES.get(len(data))
    if buffer is None or crc(data[2:-4]) != _U32.unpack_from(data, len(data) - 4)[0]:
        return None
    sizes = _SIZES.unpack_from(data, 6)
    if max(sizes) > buffer:
        return None
    found = []
    for bus, size in enumerate(sizes):
        start = 26 + bus * buffer
        for at in range(start, start + size - 19, 20):
            head, mode, _, tau, dq, q, kp, kd = _MOTOR_CMD.unpack_from(data, at)
            right = crc(data[at : at + 16]) == _U32.unpack_from(data, at + 16)[0]
            if head == b"\xfe\xee" and right:
                motor = Motor(mode >> 4 & 7, q, dq, tau, kp, kd, protect=bool(mode & 0x80))
                found.append((bus, mode & 15, motor))
    return found
