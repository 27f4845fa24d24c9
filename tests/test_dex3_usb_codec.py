"""Dex3-1: units, and the codec between a hand's commands and states and whole frames."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import (
    ChecksumError,
    EncodeError,
    OversizeError,
    TruncatedError,
    UsageError,
    WireError,
)
from dexkit.hand import (
    HandCommand,
    HandState,
    ImuState,
    MotorError,
    Side,
    SupplyState,
)
from dexkit.models import DEX3_1
from dexkit.wire import dex3_usb as d
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import units
from tests.dex3_worked_example import worked_example
from tests.each import each

JOINTS = DEX3_1.joints[Side.LEFT]
RATIOS = [j.gear_ratio for j in JOINTS]
ratios = st.sampled_from([1.0, 108.0, 214.0])
scales = st.sampled_from(d.SCALES)

# --- units


def test_factors_equal_the_documented_ones() -> None:
    # docs/sources/unitree-dex.md#c9, "Combined"
    for scale, direct, geared in (
        (units.POSITION, 563240.4, 1116050.5),
        (units.VELOCITY, 44.003, 87.191),
        (units.TORQUE, 2370.37, 1196.26),
        (units.STIFFNESS, 109.739, 27.950),
        (units.DAMPING, 10973.9, 2795.0),
    ):
        assert scale.factor(108) == pytest.approx(direct, rel=2e-5)
        assert scale.factor(214) == pytest.approx(geared, rel=2e-5)


def test_figures_equal_the_documented_ones() -> None:
    # docs/sources/unitree-dex.md#c6, docs/sources/unitree-dex.md#c9: 24 V and 58 V, full scales;
    # 0.76 N m of a joint
    assert round(24 * units.VOLTAGE.factor()) == 22696
    assert units.VOLTAGE.encode(58.0) in (54848, 54849)
    assert units.VOLTAGE.limits()[1] == pytest.approx(69.3, abs=0.01)
    assert units.CURRENT.limits()[1] == pytest.approx(33.0, abs=0.01)
    assert units.TORQUE.encode(0.76, 108) == 1801
    assert units.STIFFNESS.encode(1.5, 108) == 164
    assert units.MOTOR_VOLTAGE.decode(255) == 127.5
    assert units.PRESSURE.decode(1) == 8.0


@settings(deadline=None)
@given(scales, ratios, st.integers(-(2**31), 2**31 - 1))
def test_counts_survive_conversion(scale: d.Scale, ratio: float, count: int) -> None:
    count = min(max(count, scale.low), scale.high)
    assert scale.encode(scale.decode(count, ratio), ratio) == count


@settings(deadline=None)
@given(scales, ratios, st.floats(-1e7, 1e7))
def test_values_are_off_by_less_than_a_count(scale: d.Scale, ratio: float, value: float) -> None:
    count = scale.encode(value, ratio)
    assert scale.low <= count <= scale.high
    low, high = scale.limits(ratio)
    wanted = min(max(value, low), high)
    back = scale.decode(count, ratio)
    one = 1 / scale.factor(ratio)
    assert abs(back - wanted) <= one * (1 + 1e-6)
    assert abs(back) <= abs(wanted) + one * 1e-5, "away from zero"


@settings(deadline=None)
@given(scales, ratios, st.floats(allow_nan=True, allow_infinity=True))
def test_values_saturate_and_nan_is_refused(scale: d.Scale, ratio: float, value: float) -> None:
    if math.isfinite(value):
        assert scale.low <= scale.encode(value, ratio) <= scale.high
    else:
        with pytest.raises(EncodeError, match=scale.name):
            scale.encode(value, ratio)


def test_gains_are_never_negative() -> None:
    assert units.STIFFNESS.encode(-1.0, 108) == 0
    assert units.DAMPING.encode(-1e9, 108) == 0


def test_missing_pressure_has_its_own_code() -> None:
    # 30000 Pa, where the air is 12500 counts (docs/sources/unitree-dex.md#b4)
    assert units.PRESSURE.decode(d.NO_VALUE) == 30000.0
    assert units.PRESSURE.decode(12_500) == 100_000.0
    assert units.encode_pressure(math.nan) == 3750
    assert units.encode_pressure(30_000.0) == 3751, "a reading that looks like none"
    assert units.encode_pressure(240_000.0) == 30001, "the same, in counts"
    assert units.encode_pressure(240_008.0) == 30001
    assert units.encode_pressure(-5.0) == 0
    assert units.encode_pressure(1e9) == 65535


# --- commands


def command(**values: Any) -> HandCommand:
    q = [0.1, 0.2, 0.3, -0.1, -0.2, -0.3, -0.4]
    made = HandCommand.position(q, kp=1.5, kd=0.2)
    return dataclasses.replace(made, **values)


@pytest.mark.parametrize("layout", d.COMMAND_LAYOUTS)
def test_encode_is_the_worked_example(layout: d.CommandLayout) -> None:
    direct = [dataclasses.replace(j, gear_ratio=108.0) for j in JOINTS]
    codec = d.HandCodec(direct, layout=layout, head=b"\xfc\xfd")
    q = [0.0, 0.2, 0.5, -0.3, -0.6, -0.4, -0.8]
    made = codec.encode(HandCommand.position(q, kp=1.5, kd=0.2), False)
    assert made == worked_example(layout)


finite = st.floats(allow_nan=False, allow_infinity=False)
rows = st.lists(st.one_of(finite, st.floats(-20, 20)), min_size=7, max_size=7).map(np.array)
flags = st.lists(st.booleans(), min_size=7, max_size=7).map(lambda x: np.array(x, np.bool_))
modes = st.lists(st.integers(0, 7), min_size=7, max_size=7).map(lambda x: np.array(x, np.uint8))
motor_places = st.permutations([(b, i) for b in range(4) for i in range(4)]).map(lambda x: x[:7])


@given(
    st.builds(HandCommand, rows, rows, rows, rows, rows, modes),
    st.one_of(st.booleans(), flags),
    st.sampled_from(d.COMMAND_LAYOUTS),
    motor_places,
)
def test_encode_equals_packets(
    cmd: HandCommand, timeout: Any, layout: d.CommandLayout, places: Any
) -> None:
    """The fast path against the slow one, through any bus map."""
    codec = d.HandCodec(
        JOINTS, d.BusMap(tuple(places), d.DEFAULT_BUS_MAP.sensors), layout, head=b"\x12\x34"
    )
    buses: list[list[d.MotorCmd]] = [[] for _ in range(5)]
    protect = np.broadcast_to(timeout, 7)
    for i, (bus, number) in enumerate(places):
        ratio = RATIOS[i]
        buses[bus].append(
            d.MotorCmd(
                number,
                int(cmd.mode[i]),
                bool(protect[i]),
                units.TORQUE.encode(float(cmd.tau[i]), ratio),
                units.VELOCITY.encode(float(cmd.dq[i]), ratio),
                units.POSITION.encode(float(cmd.q[i]), ratio),
                units.STIFFNESS.encode(float(cmd.kp[i]), ratio),
                units.DAMPING.encode(float(cmd.kd[i]), ratio),
            )
        )
    expected = d.pack_command(d.CommandFrame(buses, head=b"\x12\x34"), layout)
    with np.errstate(over="ignore"):
        assert codec.encode(HandCommand.brake(7), True) != expected or cmd.is_brake
        assert codec.encode(cmd, timeout) == expected
    decoded = codec.decode_command(expected)
    assert decoded.present.all()
    assert not decoded.problems
    assert decoded.command.timeout is not None
    assert (decoded.command.timeout == protect).all()
    assert (decoded.command.mode == cmd.mode).all()
    for scale, name in (
        (units.POSITION, "q"),
        (units.VELOCITY, "dq"),
        (units.TORQUE, "tau"),
        (units.STIFFNESS, "kp"),
        (units.DAMPING, "kd"),
    ):
        for i, ratio in enumerate(RATIOS):
            wanted = min(max(getattr(cmd, name)[i], scale.limits(ratio)[0]), scale.limits(ratio)[1])
            error = abs(getattr(decoded.command, name)[i] - wanted)
            assert error <= (1 + 1e-6) / scale.factor(ratio)


@each("name", ["q", "dq", "tau", "kp", "kd"])
@each("value", [math.nan, math.inf, -math.inf])
def test_nan_is_never_sent(name: str, value: float) -> None:
    codec = d.HandCodec(JOINTS)
    good = codec.encode(command())
    bad = getattr(command(), name).copy()
    bad[4] = value
    with pytest.raises(EncodeError, match="NaN or infinity"):
        codec.encode(command(**{name: bad}))
    assert codec.encode(command()) == good, "nothing of the refused one stays"


def test_commands_that_do_not_fit_the_hand_are_refused() -> None:
    codec = d.HandCodec(JOINTS)
    good = codec.encode(command())
    with pytest.raises(EncodeError, match="7 joints"):
        codec.encode(HandCommand.position([0.0] * 6))
    for _ in range(2):
        with pytest.raises(EncodeError, match="status = 8"):
            codec.encode(command(mode=np.full(7, 8, np.uint8)))
    with pytest.raises(EncodeError, match="7 joints"):
        codec.encode(command(), np.ones(3, np.bool_))
    assert codec.encode(command()) == good


def test_a_broadcast_commands_a_bus_in_silence() -> None:
    every = d.MotorCmd(15, 1, True, 0, 0, 5000, 100, 10)
    own = d.MotorCmd(1, 0, False, 0, 0, 0, 0, 0)
    data = d.pack_command(d.CommandFrame([[every], [every, own], [], [every], []]))
    decoded = d.HandCodec(JOINTS).decode_command(data)
    assert decoded.present.tolist() == [True] * 5 + [False] * 2
    assert decoded.silent.tolist() == [True] * 4 + [False] * 3
    assert decoded.command.mode.tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert decoded.command.q[0] == pytest.approx(5000 / 5215.1892 / 214)
    assert decoded.command.q[1] == pytest.approx(5000 / 5215.1892 / 108)
    assert np.isnan(decoded.command.q[5:]).all()
    assert not decoded.problems


def test_packet_for_an_unknown_motor_is_reported_and_ignored() -> None:
    stray = d.MotorCmd(9, 1, False, 0, 0, 0, 0, 0)
    own = d.MotorCmd(1, 1, False, 0, 0, 0, 0, 0)
    later = d.MotorCmd(1, 0, False, 0, 0, 0, 0, 0)
    data = d.pack_command(d.CommandFrame([[stray, own, later], [], [], [], [stray]]))
    decoded = d.HandCodec(JOINTS).decode_command(data)
    assert [str(p) for p in decoded.problems] == [
        "bus 0: this hand has no motor 9 there",
        "bus 4: this hand has no motor 9 there",
    ]
    assert decoded.present.tolist() == [False, True] + [False] * 5
    assert decoded.command.mode[1] == 0, "the later one counts"


# --- states


def a_state(seed: int = 0, **values: Any) -> HandState:
    """A state of which every number survives the wire exactly."""
    rng = np.random.default_rng(seed)

    def joints(scale: d.Scale, reach: int) -> Any:
        low = max(-reach, scale.low)
        return np.array([scale.decode(int(rng.integers(low, reach)), r) for r in RATIOS])

    pressure = np.full((9, 12), math.nan)
    for i, sensor in enumerate(DEX3_1.sensors):
        pressure[i, list(sensor.slots)] = 8.0 * rng.integers(0, 29999, len(sensor.slots))
    made = HandState.from_values(
        joints(units.POSITION, 2**31 - 1),
        stamp=5.0,
        dq=joints(units.VELOCITY, 32767),
        tau_est=joints(units.TORQUE, 32767),
        temperature=rng.integers(-128, 128, 7).astype(float),
        winding_temperature=rng.integers(0, 256, 7).astype(float),
        voltage=0.5 * rng.integers(0, 256, 7),
        mode=[0, 1, 1, 1, 0, 1, 1],
        fault=[0, 1, 0x40, 0, 0x80000000, 0, 0],
        pressure=pressure,
        sensor_temperature=rng.integers(-128, 128, (9, 12)).astype(float),
        imu=ImuState(accelerometer=(0.1, -9.81, 327.67), gyroscope=(-327.68, 0.0, 2.5)),
        supply=SupplyState(
            *(
                scale.decode(int(rng.integers(0, 65536)))
                for scale in (units.VOLTAGE, units.CURRENT, units.VOLTAGE, units.VOLTAGE)
            )
        ),
        error=0x12345678,
    )
    return dataclasses.replace(made, **values)


NAMES = (
    "q", "dq", "tau_est", "temperature", "winding_temperature", "voltage", "mode", "fault",
    "pressure", "sensor_temperature",
)  # fmt: skip


def same(a: HandState, b: HandState, *, but: tuple[int, ...] = ()) -> None:
    joints = [i for i in range(7) if i not in but]
    for name in NAMES:
        left, right = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        if left.shape == (7,):
            left, right = left[joints], right[joints]
        np.testing.assert_allclose(left, right, rtol=1e-14, err_msg=name)


def test_states_survive_encoding_and_decoding() -> None:
    codec = d.HandCodec(JOINTS)
    for seed in range(5):  # the first is found, the others are read where it was
        state = a_state(seed)
        decoded = codec.decode(codec.encode_state(state), 7.5)
        same(decoded, state)
        assert decoded.stamp == 7.5
        assert decoded.error == state.error
        assert decoded.supply is not None
        assert dataclasses.astuple(decoded.supply) == pytest.approx(
            dataclasses.astuple(state.supply)  # type: ignore[call-overload]
        )
        assert decoded.imu is not None
        assert decoded.imu.accelerometer == pytest.approx((0.1, -9.81, 327.67))
        assert decoded.imu.gyroscope == pytest.approx((-327.68, 0.0, 2.5))
        assert np.isnan(decoded.imu.quaternion).all(), "no attitude on the wire"
        assert decoded.ddq.tolist() == [0.0] * 7
        assert decoded.sensor_lost is not None
        assert not decoded.sensor_lost.any()
        assert codec.problems == []
        assert codec.missing_motors == codec.missing_sensors == ()
    assert (codec.frames, codec.damaged) == (5, 0)


def test_states_do_not_share_memory() -> None:
    codec = d.HandCodec(JOINTS)
    first = codec.decode(codec.encode_state(a_state(1)), 0.0)
    copies = {name: np.array(getattr(first, name)) for name in (*NAMES, "sensor_lost", "ddq")}
    codec.decode(codec.encode_state(a_state(2)), 0.0)
    for name, kept in copies.items():
        np.testing.assert_array_equal(getattr(first, name), kept, err_msg=name)


def test_tripped_motor_has_its_timeout_bit() -> None:
    codec = d.HandCodec(JOINTS)
    tripped = np.zeros(7, np.uint32)
    tripped[2] = MotorError.MOTOR_SAW_HOST_TIMEOUT
    for fault in (np.zeros(7, np.uint32), tripped, np.zeros(7, np.uint32)):
        data = codec.encode_state(a_state(fault=fault))
        assert [m.timeout for _, m in d.parse_state(data).motors] == [bool(f) for f in fault]
        assert codec.decode(data, 0.0).fault.tolist() == fault.tolist()
    # the bit alone shows it, too
    frame = d.parse_state(codec.encode_state(a_state(fault=np.zeros(7, np.uint32))))
    frame.motors[0][1].timeout = True
    assert codec.decode(d.pack_state(frame), 0.0).fault[0] == MotorError.MOTOR_SAW_HOST_TIMEOUT


@given(
    st.sets(st.integers(0, 6)),
    st.sets(st.integers(0, 8)),
    st.permutations([(b, i) for b in range(5) for i in range(2)]),
    st.randoms(use_true_random=False),
)
def test_any_part_of_a_hand_in_any_order(
    motors: set[int], sensors: set[int], places: Any, random: Any
) -> None:
    bus_map = d.BusMap(tuple(places[:7]), tuple(places[:9]))
    codec = d.HandCodec(JOINTS, bus_map)
    state = a_state(3)
    for round_ in range(2):  # once found, once from the layout kept
        frame = d.parse_state(
            codec.encode_state(state, motors=sorted(motors), sensors=sorted(sensors))
        )
        if round_ == 0:
            order = [random.sample(list(bus), len(bus)) for bus in frame.buses]
            shuffled = d.pack_state(dataclasses.replace(frame, buses=order))
        decoded = codec.decode(shuffled, 0.0)
        assert codec.missing_motors == tuple(sorted(set(range(7)) - motors))
        assert codec.missing_sensors == tuple(sorted(set(range(9)) - sensors))
        gone = list(codec.missing_motors)
        assert np.isnan(decoded.q[gone]).all()
        assert np.isnan(decoded.voltage[gone]).all()
        assert not decoded.mode[gone].any()
        assert not decoded.fault[gone].any()
        expected = state.pressure.copy()  # type: ignore[union-attr]
        expected[list(codec.missing_sensors)] = math.nan
        heat = state.sensor_temperature.copy()  # type: ignore[union-attr]
        heat[list(codec.missing_sensors)] = math.nan
        same(
            decoded,
            dataclasses.replace(state, pressure=expected, sensor_temperature=heat),
            but=codec.missing_motors,
        )
        assert not codec.problems
    lost = [2 if i in codec.missing_sensors else 0 for i in range(9)]
    assert codec.sensor_lost.tolist() == lost


def reseal(data: bytes | bytearray) -> bytes:
    return bytes(data[:-4]) + crc32_words(bytes(data[2:-4])).to_bytes(4, "little")


@each("warm", [False, True])
@each(
    ("at", "motor", "sensor"),
    [(26 + 10, 0, None), (26 + 26, 1, None), (506 + 26 + 2, 6, None), (746 + 44 + 5, None, 7)],
)
def test_a_damaged_packet_is_lost_alone(
    warm: bool, at: int, motor: int | None, sensor: int | None
) -> None:
    codec = d.HandCodec(JOINTS)
    good = codec.encode_state(a_state())
    if warm:
        codec.decode(good, 0.0)
    for bit in range(8):
        data = bytearray(good)
        data[at] ^= 1 << bit
        decoded = codec.decode(reseal(data), 0.0)
        assert len(codec.problems) == 1
        assert codec.missing_motors == (() if motor is None else (motor,))
        assert codec.missing_sensors == (() if sensor is None else (sensor,))
        assert np.isnan(decoded.q).tolist() == [i == motor for i in range(7)]
        assert decoded.pressure is not None
        assert np.isnan(decoded.pressure).all(axis=1).tolist() == [i == sensor for i in range(9)]
    assert codec.damaged == 8
    assert codec.sensor_lost.tolist() == [8 if i == sensor else 0 for i in range(9)]
    same(codec.decode(good, 0.0), a_state())
    assert codec.problems == []


@pytest.mark.parametrize("warm", [False, True])
def test_damaged_frames_are_refused(warm: bool) -> None:
    codec = d.HandCodec(JOINTS)
    good = codec.encode_state(a_state())
    if warm:
        codec.decode(good, 0.0)
    data = bytearray(good)
    for bit in range(0, 8 * len(data), 7):
        data[bit >> 3] ^= 1 << (bit & 7)
        with pytest.raises(ChecksumError if bit >= 16 else WireError):
            codec.decode(bytes(data), 0.0)
        data[bit >> 3] ^= 1 << (bit & 7)
    with pytest.raises(TruncatedError):
        codec.decode(good[:-1], 0.0)
    with pytest.raises(OversizeError):
        codec.decode(good + b"\0", 0.0)
    assert codec.frames == warm
    assert codec.damaged == 0


def test_packets_that_are_not_this_hand_s() -> None:
    codec = d.HandCodec(JOINTS)
    frame = d.parse_state(codec.encode_state(a_state()))
    motor, sensor = frame.motors[0][1], frame.sensors[0][1]
    buses = [list(bus) for bus in frame.buses]
    buses[4] = [motor, dataclasses.replace(sensor, id=15)]
    buses[1].append(dataclasses.replace(frame.motors[4][1], pos=1))
    decoded = codec.decode(d.pack_state(dataclasses.replace(frame, buses=buses)), 0.0)
    same(decoded, a_state())
    assert [str(p) for p in codec.problems] == [
        "bus 1, offset 140: motor 1 once more",
        "bus 4, offset 0: this hand has no motor 0 there",
        "bus 4, offset 26: this hand has no sensor 15 there",
    ]


def test_motors_are_matched_by_id_and_not_by_order() -> None:
    """Same sizes, same heads: only the ids show that two motors are exchanged."""
    codec = d.HandCodec(JOINTS)
    data = codec.encode_state(a_state())
    codec.decode(data, 0.0)
    frame = d.parse_state(data)
    buses = [list(bus) for bus in frame.buses]
    buses[0][0], buses[0][1] = buses[0][1], buses[0][0]
    same(codec.decode(d.pack_state(dataclasses.replace(frame, buses=buses)), 0.0), a_state())
    assert not codec.problems


def test_nan_position_cannot_be_encoded_but_missing_sensors_can() -> None:
    codec = d.HandCodec(JOINTS)
    with pytest.raises(EncodeError, match="position"):
        codec.encode_state(a_state(q=np.full(7, math.nan)))
    bare = dataclasses.replace(
        a_state(), pressure=None, imu=None, supply=None, winding_temperature=None
    )
    decoded = codec.decode(codec.encode_state(bare), 0.0)
    assert codec.missing_sensors == tuple(range(9))
    assert decoded.supply == SupplyState(0.0, 0.0, 0.0, 0.0)


@given(st.binary(max_size=300), st.integers(2, 1266), st.booleans())
def test_any_bytes_decode_or_raise_a_typed_error(noise: bytes, at: int, sealed: bool) -> None:
    codec = d.HandCodec(JOINTS)
    good = codec.encode_state(a_state())
    codec.decode(good, 0.0)
    data = bytearray(good)
    data[at : at + len(noise)] = noise
    data = data[:1270]
    candidate = reseal(data) if sealed else bytes(data)
    with contextlib.suppress(WireError):
        decoded = codec.decode(candidate, 0.0)
        missing = np.zeros(7, np.bool_)
        missing[list(codec.missing_motors)] = True
        assert (np.isnan(decoded.q) == missing).all()
    with contextlib.suppress(WireError):
        codec.decode_command(noise)
    same(codec.decode(good, 0.0), a_state())


# --- configuration


@each(
    ("motors", "sensors", "what"),
    [
        (((5, 0),), (), "motor at bus 5"),
        (((0, 15),), (), "id 15"),
        (((-1, 0),), (), "bus -1"),
        (((0, 0), (0, 0)), (), "two motors at one address"),
        ((), ((0, 15),), "sensor at bus 0, id 15"),
    ],
)
def test_invalid_bus_maps_are_refused(motors: Any, sensors: Any, what: str) -> None:
    with pytest.raises(UsageError, match=what):
        d.BusMap(motors, sensors)


def test_bus_map_of_another_hand_is_refused() -> None:
    with pytest.raises(UsageError, match=r"6 joint\(s\), but the bus map has 7"):
        d.HandCodec(JOINTS[:6])
    assert len(d.DEFAULT_BUS_MAP.motors) == 7
    assert len(d.DEFAULT_BUS_MAP.sensors) == len(DEX3_1.sensors)


@each("code", [d.NO_VALUE, units.NO_VALUE_COUNTS])
def test_either_code_is_no_element_and_a_firm_press_is_none_of_them(code: int) -> None:
    """30000 Pa, or 30000 counts: the manual does not say which (docs/dex3-usb.md)."""

    def answer(first: int) -> HandState:
        frame = d.parse_state(codec.encode_state(a_state()))
        counts = [12_700 if slot in DEX3_1.sensors[0].slots else code for slot in range(12)]
        counts[0] = first
        buses = [
            [
                dataclasses.replace(packet, pressure=tuple(counts))
                if isinstance(packet, d.SensorState)
                else packet
                for packet in bus
            ]
            for bus in frame.buses
        ]
        return codec.decode(d.pack_state(dataclasses.replace(frame, buses=buses)), 0.0)

    codec = d.HandCodec(JOINTS)
    for count, pascal in ((12_700, 101_600.0), (30_000, 240_000.0), (30_001, 240_008.0)):
        state = answer(count)
        assert state.pressure is not None
        assert state.pressure[0, 0] == pascal
        assert np.isnan(state.pressure[0]).tolist() == [
            slot not in DEX3_1.sensors[0].slots for slot in range(12)
        ]
    pressed = answer(units.NO_VALUE)  # no reading: the air alone is 12500
    assert pressed.pressure is not None
    assert math.isnan(pressed.pressure[0, 0])
