"""Pack and parse Dex3-1 packets and frames with raw integer fields, without I/O.

A frame has five bus buffers, each with packets back to back. A damaged frame raises an error; a
damaged packet in an intact frame is left out and listed in ``problems``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from dexkit.errors import (
    ChecksumError,
    EncodeError,
    OversizeError,
    TruncatedError,
    WireError,
)
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb.layout import (
    COMMAND_1234,
    COMMAND_HEAD,
    COMMAND_LAYOUTS,
    MOTOR_CMD,
    MOTOR_STATE,
    N_BUSES,
    SENSOR_CMD,
    SENSOR_STATE,
    STATE,
    STATE_BUS_SIZE,
    CommandLayout,
)
from dexkit.wire.ris import Structure, ris_mode

__all__ = [
    "CommandFrame",
    "MotorCmd",
    "MotorState",
    "Problem",
    "SensorCmd",
    "SensorState",
    "StateFrame",
    "pack_command",
    "pack_state",
    "parse_bus",
    "parse_command",
    "parse_state",
    "scan_bus",
]

Bytes: TypeAlias = bytes | bytearray | memoryview


def _fill_crc(structure: Structure, packet: bytes) -> bytes:
    """``packet`` with its CRC, which is its last word, filled in."""
    start, end = structure.covered
    return packet[:-4] + crc32_words(packet[start:end]).to_bytes(4, "little")


def _check_crc(structure: Structure, data: Bytes) -> None:
    start, end = structure.covered
    stored = int.from_bytes(data[-4:], "little")
    computed = crc32_words(data[start:end])
    if stored != computed:
        raise ChecksumError(
            f"{structure.name}: CRC is 0x{stored:08X}, the data make it 0x{computed:08X}"
        )


def _check_length(structure: Structure, data: Bytes) -> None:
    if len(data) < structure.size:
        raise TruncatedError(f"{structure.name} is {structure.size} bytes, got {len(data)}")
    if len(data) > structure.size:
        raise OversizeError(f"{structure.name} is {structure.size} bytes, got {len(data)}")


def _unpack_checked(structure: Structure, data: Bytes) -> tuple[int, ...]:
    """Fields of a packet between head and CRC.

    :raises WireError: wrong length, head or CRC.
    """
    _check_length(structure, data)
    if bytes(data[:2]) != structure.head:
        raise WireError(
            f"{structure.name} starts with {structure.head.hex(' ')}, "
            f"these bytes with {bytes(data[:2]).hex(' ')}"
        )
    _check_crc(structure, data)
    return structure.struct.unpack(data)[1:-1]


@dataclass(slots=True)
class MotorCmd:
    """``MotorCmd_t``: raw integers, rotor side."""

    id: int
    status: int
    timeout: bool
    tor_des: int
    spd_des: int
    pos_des: int
    k_pos: int
    k_spd: int
    res: int = 0

    def pack(self) -> bytes:
        """Its 20 bytes.

        :raises EncodeError: a value does not fit.
        """
        mode = ris_mode(self.id, self.status, self.timeout)
        values = (self.tor_des, self.spd_des, self.pos_des, self.k_pos, self.k_spd)
        return _fill_crc(MOTOR_CMD, MOTOR_CMD.pack(MOTOR_CMD.head, mode, self.res, *values, 0))

    @classmethod
    def parse(cls, data: Bytes) -> MotorCmd:
        """One packet.

        :raises WireError: wrong length, head or CRC.
        """
        return cls._from_fields(*_unpack_checked(MOTOR_CMD, data))

    @classmethod
    def _from_fields(
        cls, mode: int, res: int, tor: int, spd: int, pos: int, k_pos: int, k_spd: int
    ) -> MotorCmd:
        return cls(mode & 15, mode >> 4 & 7, mode > 127, tor, spd, pos, k_pos, k_spd, res)


@dataclass(slots=True)
class SensorCmd:
    """``SensorCmd_t``, the assumed packet that asks a sensor for its state."""

    id: int
    status: int = 0

    def pack(self) -> bytes:
        """Its 20 bytes.

        :raises EncodeError: a value does not fit.
        """
        mode = self.id | self.status << 4
        return _fill_crc(SENSOR_CMD, SENSOR_CMD.pack(SENSOR_CMD.head, mode, bytes(13), 0))

    @classmethod
    def _from_fields(cls, mode: int, *rest: int) -> SensorCmd:
        return cls(mode & 15, mode >> 4)


@dataclass(slots=True)
class MotorState:
    """``MotorState_t``: raw integers, rotor side.

    :param timeout: the motor's time-out protection has tripped.
    :param sensor: temperature of the winding; the manual's name.
    """

    id: int
    status: int
    timeout: bool
    temp: int
    sensor: int
    vol: int
    torque: int
    speed: int
    pos: int
    merror: int = 0
    ex_sensor1: int = 0
    ex_sensor2: int = 0

    def pack(self) -> bytes:
        """Its 26 bytes.

        :raises EncodeError: a value does not fit.
        """
        return _fill_crc(
            MOTOR_STATE,
            MOTOR_STATE.pack(
                MOTOR_STATE.head,
                ris_mode(self.id, self.status, self.timeout),
                self.temp,
                self.sensor,
                self.vol,
                self.torque,
                self.speed,
                self.pos,
                self.merror,
                self.ex_sensor1,
                self.ex_sensor2,
                0,
            ),
        )

    @classmethod
    def parse(cls, data: Bytes) -> MotorState:
        """One packet.

        :raises WireError: wrong length, head or CRC.
        """
        return cls._from_fields(*_unpack_checked(MOTOR_STATE, data))

    @classmethod
    def _from_fields(cls, mode: int, *values: int) -> MotorState:
        return cls(mode & 15, mode >> 4 & 7, mode > 127, *values)


@dataclass(slots=True)
class SensorState:
    """``SensorState_t``: 12 pressures (counts of 8 Pa) and 12 temperatures (°C)."""

    id: int
    status: int
    pressure: tuple[int, ...]
    temperature: tuple[int, ...]
    reverse: int = 0

    def pack(self) -> bytes:
        """Its 44 bytes.

        :raises EncodeError: a value does not fit, or there are not 12.
        """
        for name in ("id", "status"):
            if not 0 <= getattr(self, name) <= 15:
                raise EncodeError(f"SensorState_t: {name} = {getattr(self, name)} is not 0 to 15")
        for name in ("pressure", "temperature"):
            if len(getattr(self, name)) != 12:
                raise EncodeError(f"SensorState_t: 12 of {name}, not {len(getattr(self, name))}")
        mode = self.id | self.status << 4
        values = (*self.pressure, *self.temperature)
        return _fill_crc(
            SENSOR_STATE, SENSOR_STATE.pack(SENSOR_STATE.head, mode, self.reverse, *values, 0)
        )

    @classmethod
    def parse(cls, data: Bytes) -> SensorState:
        """One packet.

        :raises WireError: wrong length, head or CRC.
        """
        return cls._from_fields(*_unpack_checked(SENSOR_STATE, data))

    @classmethod
    def _from_fields(cls, mode: int, reverse: int, *values: int) -> SensorState:
        return cls(mode & 15, mode >> 4, values[:12], values[12:], reverse)


Packet: TypeAlias = MotorCmd | SensorCmd | MotorState | SensorState

TO_HAND = (MOTOR_CMD, SENSOR_CMD)
"""What the buses of a command frame hold."""
FROM_HAND = (MOTOR_STATE, SENSOR_STATE)
"""What the buses of a state frame hold."""


@dataclass(frozen=True)
class Problem:
    """Damaged bytes of a bus buffer, or a packet with an unknown address.

    :param bus: which one.
    :param offset: of the first byte in that buffer; None where the packet itself is good.
    :param error: what is wrong with them.
    """

    bus: int
    offset: int | None
    error: WireError

    def __str__(self) -> str:
        where = "" if self.offset is None else f", offset {self.offset}"
        return f"bus {self.bus}{where}: {self.error}"


def scan_bus(
    data: Bytes, kinds: Sequence[Structure], bus: int = 0
) -> tuple[list[tuple[int, Structure]], list[Problem]]:
    """Find the packets of a bus buffer, by their heads and in any order.

    :param data: the used part of the buffer.
    :param kinds: structures that may occur; anything else counts as damaged.
    :return: (offset and structure of each good packet, what was lost).

    After damaged bytes the search continues at the next head. Bytes of a packet with a wrong CRC
    can only hide a packet whose CRC is right: what looks like a head in them is not reported
    once more.
    """
    data = bytes(data)
    heads = {kind.head: kind for kind in kinds}
    found: list[tuple[int, Structure]] = []
    problems: list[Problem] = []
    offset, damaged_until, garbage = 0, 0, -1

    def lost(start: int, error: WireError) -> None:
        problems.append(Problem(bus, start, error))

    def end_garbage(end: int) -> None:
        nonlocal garbage
        if garbage >= 0:
            start, garbage = garbage, -1
            text = data[start : min(end, start + 4)].hex(" ")
            lost(start, WireError(f"{end - start} byte(s) that start no packet: {text}"))

    while offset < len(data):
        kind = heads.get(data[offset : offset + 2])
        error: WireError | None = None
        if kind is not None:
            packet = data[offset : offset + kind.size]
            try:
                _unpack_checked(kind, packet)
            except WireError as problem:
                error = problem
            else:
                end_garbage(offset)
                found.append((offset, kind))
                offset += kind.size
                damaged_until = 0
                continue
        if offset >= damaged_until:
            if kind is None or error is None:
                if garbage < 0:
                    garbage = offset
            else:
                end_garbage(offset)
                lost(offset, error)
                damaged_until = offset + len(packet)
        offset += 1
    end_garbage(len(data))
    return found, problems


def parse_bus(
    data: Bytes, kinds: Sequence[Structure] = FROM_HAND, bus: int = 0
) -> tuple[list[Packet], list[Problem]]:
    """The packets of a bus buffer, and the losses. See :func:`scan_bus`."""
    data = bytes(data)
    found, problems = scan_bus(data, kinds, bus)
    return [_packet(kind, data, offset) for offset, kind in found], problems


def _packet(kind: Structure, data: bytes, offset: int) -> Packet:
    """One that :func:`scan_bus` has found, and checked."""
    values = kind.struct.unpack_from(data, offset)[1:-1]
    if kind is MOTOR_CMD:
        return MotorCmd._from_fields(*values)
    if kind is SENSOR_CMD:
        return SensorCmd._from_fields(*values)
    return (
        MotorState._from_fields(*values)
        if kind is MOTOR_STATE
        else SensorState._from_fields(*values)
    )


def bus_part(
    data: Bytes, bus: int, size: int, start: int, capacity: int
) -> tuple[Bytes, list[Problem]]:
    """The used part of a bus buffer in a frame; empty, with a problem, if it ends outside."""
    if size > capacity:
        error = OversizeError(f"{size} bytes are said to be used of a buffer of {capacity}")
        return b"", [Problem(bus, 0, error)]
    return data[start : start + size], []


def _empty_buses() -> list[list[Packet]]:
    return [[] for _ in range(N_BUSES)]


@dataclass(slots=True)
class CommandFrame:
    """``LinuxToMcuCmd_t``.

    :param buses: the packets of each of the five buses, in order.
    :param layout: as parsed.
    :param problems: damaged packets, which are not in ``buses``.
    """

    buses: Sequence[Sequence[Packet]] = field(default_factory=_empty_buses)
    head: bytes = COMMAND_HEAD
    mode: bytes = bytes(4)
    reserve: int = 0
    layout: CommandLayout = COMMAND_1234
    problems: list[Problem] = field(default_factory=list)

    @property
    def motors(self) -> list[tuple[int, MotorCmd]]:
        """(bus, packet) of every motor command."""
        return [(b, p) for b, ps in enumerate(self.buses) for p in ps if isinstance(p, MotorCmd)]

    @property
    def sensors(self) -> list[tuple[int, SensorCmd]]:
        """(bus, packet) of every sensor that is addressed."""
        return [(b, p) for b, ps in enumerate(self.buses) for p in ps if isinstance(p, SensorCmd)]


@dataclass(slots=True)
class StateFrame:
    """``McuToLinuxState_t``.

    :param buses: the packets of each of the five buses, in order.
    :param model: ``mode[0]``.
    :param timeout: ``mode[1]``.
    :param imu: ax ay az gx gy gz.
    :param problems: damaged packets, which are not in ``buses``.
    """

    buses: Sequence[Sequence[Packet]] = field(default_factory=_empty_buses)
    model: int = 0
    timeout: int = 0
    fans: bytes = bytes(2)
    pin_v: int = 0
    vin_v: int = 0
    vm_v: int = 0
    pin_a: int = 0
    imu: tuple[int, ...] = (0,) * 6
    error: int = 0
    reserve: tuple[int, ...] = (0,) * 4
    problems: list[Problem] = field(default_factory=list)

    @property
    def motors(self) -> list[tuple[int, MotorState]]:
        """(bus, packet) of every motor state."""
        return [(b, p) for b, ps in enumerate(self.buses) for p in ps if isinstance(p, MotorState)]

    @property
    def sensors(self) -> list[tuple[int, SensorState]]:
        """(bus, packet) of every sensor state."""
        return [(b, p) for b, ps in enumerate(self.buses) for p in ps if isinstance(p, SensorState)]


def _pack_buses(buses: Sequence[Sequence[Packet]], capacity: int) -> tuple[list[int], bytes]:
    """(bytes used of each bus buffer, the five buffers)."""
    if len(buses) != N_BUSES:
        raise EncodeError(f"a frame has {N_BUSES} buses, not {len(buses)}")
    parts = [b"".join(packet.pack() for packet in packets) for packets in buses]
    for bus, part in enumerate(parts):
        if len(part) > capacity:
            raise OversizeError(f"bus {bus}: {len(part)} bytes in a buffer of {capacity}")
    return [len(part) for part in parts], b"".join(part.ljust(capacity, b"\0") for part in parts)


def _check_count(name: str, value: Sequence[int] | bytes, length: int) -> None:
    if len(value) != length:
        raise EncodeError(f"{name} has {length} elements, not {len(value)}")


def pack_command(frame: CommandFrame, layout: CommandLayout | None = None) -> bytes:
    """Bytes of a frame to the hand.

    :param layout: the frame's own by default.
    :raises EncodeError: a value does not fit.
    :raises OversizeError: more packets on a bus than its buffer holds.
    """
    layout = layout or frame.layout
    _check_count("head", frame.head, 2)
    _check_count("mode", frame.mode, 4)
    sizes, buffers = _pack_buses(frame.buses, layout.bus_size)
    structure = layout.structure
    return _fill_crc(
        structure, structure.pack(frame.head, frame.mode, *sizes, buffers, frame.reserve, 0)
    )


def parse_command(data: Bytes) -> CommandFrame:
    """Parse a command frame; its length gives the layout. Any head is accepted.

    :raises TruncatedError: shorter than 1234 bytes, and not 734.
    :raises OversizeError: longer than 1234 bytes.
    :raises ChecksumError: the frame's CRC is wrong.
    """
    layout = next((x for x in COMMAND_LAYOUTS if x.size == len(data)), None)
    if layout is None:
        _check_length(COMMAND_1234.structure, data)
        raise AssertionError("a length that is neither of both is too short or too long")
    _check_crc(layout.structure, data)
    head, mode, *sizes, _, reserve, _ = layout.structure.struct.unpack(data)
    buses, problems = _parse_buses(data, sizes, layout.bus_offset(0), layout.bus_size, TO_HAND)
    return CommandFrame(buses, head, mode, reserve, layout, problems)


def _parse_buses(
    data: Bytes, sizes: Sequence[int], start: int, capacity: int, kinds: Sequence[Structure]
) -> tuple[list[list[Packet]], list[Problem]]:
    buses: list[list[Packet]] = []
    problems: list[Problem] = []
    for bus, size in enumerate(sizes):
        part, outside = bus_part(data, bus, size, start + bus * capacity, capacity)
        packets, lost = parse_bus(part, kinds, bus)
        buses.append(packets)
        problems += outside + lost
    return buses, problems


def pack_state(frame: StateFrame) -> bytes:
    """Bytes of a frame from the hand.

    :raises EncodeError: a value does not fit.
    :raises OversizeError: more packets on a bus than its buffer holds.
    """
    _check_count("fans", frame.fans, 2)
    _check_count("imu", frame.imu, 6)
    _check_count("reserve", frame.reserve, 4)
    sizes, buffers = _pack_buses(frame.buses, STATE_BUS_SIZE)
    return _fill_crc(
        STATE,
        STATE.pack(
            STATE.head,
            frame.model,
            frame.timeout,
            frame.fans,
            *sizes,
            buffers,
            frame.pin_v,
            frame.vin_v,
            frame.vm_v,
            frame.pin_a,
            *frame.imu,
            frame.error,
            *frame.reserve,
            0,
        ),
    )


def parse_state(data: Bytes) -> StateFrame:
    """A frame from the hand.

    :raises TruncatedError: shorter than 1270 bytes.
    :raises OversizeError: longer than 1270 bytes.
    :raises ChecksumError: the frame's CRC is wrong.
    :raises WireError: the head is not FC FD.
    """
    values = check_state(data)
    model, timeout, fans = values[1:4]
    buses, problems = _parse_buses(
        data, values[4:9], STATE.offsets["state"], STATE_BUS_SIZE, FROM_HAND
    )
    pin_v, vin_v, vm_v, pin_a, *imu, error = values[10:21]
    return StateFrame(
        buses=buses,
        model=model,
        timeout=timeout,
        fans=fans,
        pin_v=pin_v,
        vin_v=vin_v,
        vm_v=vm_v,
        pin_a=pin_a,
        imu=tuple(imu),
        error=error,
        reserve=values[21:25],
        problems=problems,
    )


def check_state(data: Bytes) -> tuple[Any, ...]:
    """Fields of a state frame whose length, head and CRC are right, else as parse_state."""
    _check_length(STATE, data)
    if bytes(data[:2]) != STATE.head:
        raise WireError(
            f"a state frame starts with {STATE.head.hex(' ')}, not {bytes(data[:2]).hex(' ')}"
        )
    _check_crc(STATE, data)
    return STATE.struct.unpack(data)
