"""Dex3-1 packets, bus buffers and frames as raw integers."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import (
    EncodeError,
    OversizeError,
    WireError,
)
from dexkit.wire import dex3_usb as d
from dexkit.wire.crc32 import crc32_words
from tests.dex3_worked_example import worked_example
from tests.each import each

# --- layouts, against the numbers of docs/sources/unitree-dex.md#c


def test_structs_have_the_sizes_and_offsets_of_the_manual() -> None:
    assert d.MOTOR_CMD.size == 20
    assert d.MOTOR_STATE.size == 26
    assert d.SENSOR_STATE.size == 44
    assert (d.COMMAND_1234.size, d.COMMAND_734.size, d.STATE.size) == (1234, 734, 1270)
    assert d.MOTOR_CMD.offsets == {
        "head": 0, "mode": 2, "res": 3, "tor_des": 4, "spd_des": 6, "pos_des": 8, "k_pos": 12,
        "k_spd": 14, "CRC32": 16,
    }  # fmt: skip
    assert d.MOTOR_STATE.offsets == {
        "head": 0, "mode": 2, "temp": 3, "sensor": 4, "vol": 5, "torque": 6, "speed": 8, "pos": 10,
        "MError": 14, "ExSensor1": 18, "ExSensor2": 20, "CRC32": 22,
    }  # fmt: skip
    assert d.SENSOR_STATE.offsets == {
        "head": 0, "mode": 2, "reverse": 3, "pressure": 4, "temperature": 28, "CRC32": 40,
    }  # fmt: skip
    assert d.STATE.offsets == {
        "head": 0, "model": 2, "timeout": 3, "fans": 4, "state_size": 6, "state": 26,
        "pin_v": 1226, "vin_v": 1228, "vm_v": 1230, "pin_a": 1232, "imu_data": 1234, "error": 1246,
        "reserve": 1250, "crc": 1266,
    }  # fmt: skip
    assert d.COMMAND_1234.structure.offsets["crc"] == 1230
    assert d.COMMAND_734.structure.offsets["crc"] == 730


def test_crc_covers_the_words_that_the_manual_names() -> None:
    assert [
        (s.covered[1] - s.covered[0]) // 4
        for s in (
            d.MOTOR_CMD,
            d.MOTOR_STATE,
            d.SENSOR_STATE,
            d.COMMAND_1234.structure,
            d.COMMAND_734.structure,
            d.STATE,
        )
    ] == [4, 5, 10, 307, 182, 316]


# --- vectors

MOTOR = d.MotorState(0, 1, False, 30, 40, 48, 0, 0, 11000)
SENSOR = d.SensorState(1, 0, tuple(range(1000, 1012)), (25,) * 12)


def test_packets_equal_the_documented_ones() -> None:
    # docs/sources/unitree-dex.md#c10
    motor = bytes.fromhex("fcee101e283000000000f82a0000000000000000000044998d9c")
    sensor = bytes.fromhex(
        "7ee70100e803e903ea03eb03ec03ed03ee03ef03f003f103f203f30319191919191919191919191995ba86b6"
    )
    assert MOTOR.pack() == motor
    assert d.MotorState.parse(motor) == MOTOR
    assert SENSOR.pack() == sensor
    assert d.SensorState.parse(sensor) == SENSOR


@each(
    ("packet", "expected"),
    [
        # measured from the vendor's library for the M4010 motor, which has the same frame
        # (docs/sources/unitree-dex.md#g)
        (d.MotorCmd(0, 1, False, 0, 0, 0, 0, 0), "feee1000000000000000000000000000" "73d71398"),
        (d.MotorCmd(1, 0, True, 0, 0, 0, 0, 0), "feee8100000000000000000000000000" "6f78f4b3"),
        (d.MotorCmd(0, 1, False, 0, 0, 0x55F19, 0x66, 1),
         "feee10000000000019 5f050066000100" "99db492c"),
        (d.MotorState(0, 1, False, 33, 44, 48, -123, 456, -789012),
         "fcee10212c3085ffc801ecf5f3ff0000000000000000" "4a43ae38"),
    ],
)  # fmt: skip
def test_packets_equal_those_of_the_m4010_library(packet: Any, expected: str) -> None:
    data = bytes.fromhex(expected)
    assert packet.pack() == data
    assert type(packet).parse(data) == packet


@pytest.mark.parametrize(
    ("layout", "crc", "digest"),
    [
        (
            d.COMMAND_1234,
            0x913D00A2,
            "7e6116795fb72853c669e09ad65bccda42e5b7e371b74592de359914a4f95a73",
        ),
        (
            d.COMMAND_734,
            0x0515EA46,
            "137a6b6cd39b4feab32257d221c0e1c21544c54166254bd73c81dc2f753f21e5",
        ),
    ],
)
def test_frame_equals_the_worked_example(layout: d.CommandLayout, crc: int, digest: str) -> None:
    data = worked_example(layout)
    assert len(data) == layout.size
    assert int.from_bytes(data[-4:], "little") == crc
    assert hashlib.sha256(data).hexdigest() == digest
    frame = d.parse_command(data)
    assert frame.layout is layout
    assert frame.head == b"\xfc\xfd"
    assert [(bus, cmd.id, cmd.pos_des) for bus, cmd in frame.motors] == [
        (0, 0, 0), (0, 1, 112648), (0, 2, 281620), (1, 0, -168972), (1, 1, -337944),
        (2, 0, -225296), (2, 1, -450592),
    ]  # fmt: skip


# --- single packets


def integers(structure: Any, name: str) -> st.SearchStrategy[int]:
    field = structure.field(name)
    return st.integers(field.low, field.high)


def built(cls: type, structure: Any, *names: str) -> st.SearchStrategy[Any]:
    return st.builds(
        cls,
        st.integers(0, 15),
        st.integers(0, 7),
        st.booleans(),
        *(integers(structure, name) for name in names),
    )


motor_cmds = built(
    d.MotorCmd, d.MOTOR_CMD, "tor_des", "spd_des", "pos_des", "k_pos", "k_spd", "res"
)
motor_states = built(
    d.MotorState, d.MOTOR_STATE,
    "temp", "sensor", "vol", "torque", "speed", "pos", "MError", "ExSensor1", "ExSensor2",
)  # fmt: skip
sensor_states = st.builds(
    d.SensorState,
    st.integers(0, 15),
    st.integers(0, 15),
    st.tuples(*[integers(d.SENSOR_STATE, "pressure")] * 12),
    st.tuples(*[integers(d.SENSOR_STATE, "temperature")] * 12),
    st.integers(0, 255),
)
packets = st.one_of(motor_cmds, motor_states, sensor_states)


@each(
    ("packet", "what"),
    [
        (d.MotorCmd(16, 1, False, 0, 0, 0, 0, 0), "id = 16"),
        (d.MotorCmd(0, 8, False, 0, 0, 0, 0, 0), "status = 8"),
        (d.MotorCmd(0, 1, False, 0x8000, 0, 0, 0, 0), "tor_des = 32768 does not fit i16"),
        (d.MotorCmd(0, 1, False, 0, 0, 2**31, 0, 0), "pos_des = 2147483648 does not fit i32"),
        (dataclasses.replace(MOTOR, temp=-129), "temp = -129"),
        (dataclasses.replace(MOTOR, merror=-1), "MError = -1"),
        (dataclasses.replace(SENSOR, id=16), "id = 16"),
        (dataclasses.replace(SENSOR, pressure=(0,) * 11), "12 of pressure, not 11"),
        (dataclasses.replace(SENSOR, pressure=(0,) * 11 + (65536,)), r"pressure\[11\] = 65536"),
    ],
)
def test_value_that_does_not_fit_its_field_is_refused(packet: Any, what: str) -> None:
    with pytest.raises(EncodeError, match=what):
        packet.pack()


# --- bus buffers


def test_packets_of_a_bus_are_read_in_any_order() -> None:
    other = dataclasses.replace(MOTOR, id=1)
    found, problems = d.parse_bus(SENSOR.pack() + MOTOR.pack() + SENSOR.pack() + other.pack())
    assert found == [SENSOR, MOTOR, SENSOR, other]
    assert not problems


@given(st.lists(st.one_of(motor_states, sensor_states), max_size=5), st.data())
def test_one_damaged_packet_is_lost_alone(packets: list[Any], data: st.DataObject) -> None:
    parts = [p.pack() for p in packets]
    if not parts:
        return
    which = data.draw(st.integers(0, len(parts) - 1))
    bit = data.draw(st.integers(0, 8 * len(parts[which]) - 1))
    damaged = bytearray(parts[which])
    damaged[bit >> 3] ^= 1 << (bit & 7)
    parts[which] = bytes(damaged)
    found, problems = d.parse_bus(b"".join(parts), bus=3)
    assert found == packets[:which] + packets[which + 1 :]
    assert len(problems) >= 1
    assert all(p.bus == 3 for p in problems)
    assert problems[0].offset == sum(map(len, parts[:which]))


@settings(deadline=None)
@given(st.binary(max_size=60), motor_states, st.binary(max_size=60), sensor_states)
def test_packets_are_found_between_garbage(a: bytes, motor: Any, b: bytes, sensor: Any) -> None:
    found, problems = d.parse_bus(a + motor.pack() + b + sensor.pack())
    assert found[-1] == sensor
    assert motor in found
    assert bool(problems) == bool(a or b)


def test_a_command_is_no_state() -> None:
    command = d.MotorCmd(0, 1, False, 0, 0, 0, 0, 0)
    assert d.parse_bus(command.pack())[0] == []
    assert d.parse_bus(command.pack(), d.TO_HAND) == ([command], [])


# --- frames


def a_state() -> d.StateFrame:
    motors = [dataclasses.replace(MOTOR, id=i, pos=i - 1) for i in range(3)]
    sensors = [dataclasses.replace(SENSOR, id=i) for i in range(3)]
    return d.StateFrame(
        buses=[[*motors, *sensors[:2]], motors[:2], [], sensors, []],
        model=3,
        timeout=1,
        fans=b"\x01\x02",
        pin_v=22696,
        vin_v=2,
        vm_v=3,
        pin_a=4,
        imu=(1, -2, 3, -4, 5, -32768),
        error=0xDEADBEEF,
        reserve=(1, 2, 3, 0xFFFFFFFF),
    )


def reseal(data: bytearray) -> bytes:
    data[-4:] = crc32_words(data[2:-4]).to_bytes(4, "little")
    return bytes(data)


def test_more_packets_than_a_bus_holds_are_refused() -> None:
    cmd = d.MotorCmd(0, 0, False, 0, 0, 0, 0, 0)
    buses = [[], [cmd] * 8, [], [], []]
    assert len(d.parse_command(d.pack_command(d.CommandFrame(buses))).motors) == 8
    with pytest.raises(OversizeError, match="bus 1: 160 bytes in a buffer of 140"):
        d.pack_command(d.CommandFrame(buses), d.COMMAND_734)
    with pytest.raises(EncodeError, match="5 buses, not 4"):
        d.pack_command(d.CommandFrame(buses[:4]))


def test_bus_size_beyond_its_buffer_is_reported() -> None:
    data = bytearray(d.pack_state(a_state()))
    data[10:14] = (241).to_bytes(4, "little")
    frame = d.parse_state(reseal(data))
    assert frame.buses[1] == []
    assert len(frame.motors) == 3
    (problem,) = frame.problems
    assert (problem.bus, type(problem.error)) == (1, OversizeError)
    data[10:14] = b"\xff" * 4
    assert len(d.parse_state(reseal(data)).problems) == 1


@given(
    st.binary(max_size=400),
    st.lists(st.integers(0, 2**32 - 1), min_size=5, max_size=5),
    st.integers(26, 1226),
    st.sampled_from(["state", "1234", "734"]),
)
def test_any_bytes_parse_or_raise_a_typed_error(
    noise: bytes, sizes: list[int], at: int, kind: str
) -> None:
    good = {
        "state": d.pack_state(a_state()),
        "1234": worked_example(d.COMMAND_1234),
        "734": worked_example(d.COMMAND_734),
    }[kind]
    parse = d.parse_state if kind == "state" else d.parse_command
    data = bytearray(good)
    data[6:26] = b"".join((s % 300 if i else s).to_bytes(4, "little") for i, s in enumerate(sizes))
    data[at : at + len(noise)] = noise
    data = data[: len(good)]
    for candidate in (noise, bytes(data), reseal(data)):
        with contextlib.suppress(WireError):
            parse(candidate)
