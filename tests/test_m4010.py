"""The M4010's frames, against what the vendor's library was measured to send and to take."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import (
    ChecksumError,
    DexkitError,
    EncodeError,
    OversizeError,
    TruncatedError,
    WireError,
)
from dexkit.wire import m4010
from dexkit.wire.m4010 import (
    COMMAND,
    DATA,
    Calibration,
    CalibrationProblem,
    FrameParser,
    MotorCmd,
    MotorData,
    Status,
    calibration_outcome,
)
from tests.each import each


def _drive(number: int, q: float) -> MotorCmd:
    return MotorCmd.setpoint(number, q=q, kp=5.0, kd=0.05)


# docs/sources/unitree-dex.md#g: bytes read from the vendor's library
@each(
    ("command", "wire"),
    [
        (MotorCmd.setpoint(0), "feee1000 0000 0000 00000000 0000 0000 73d71398"),
        (MotorCmd.setpoint(1), "feee1100 0000 0000 00000000 0000 0000 01361c45"),
        (MotorCmd(0, timeout=True), "feee8000 0000 0000 00000000 0000 0000 1d99fb6e"),
        (MotorCmd(1, timeout=True), "feee8100 0000 0000 00000000 0000 0000 6f78f4b3"),
        (_drive(0, 0.0), "feee1000 0000 0000 00000000 6600 0100 d1f0e82f"),
        (_drive(0, 2.7), "feee1000 0000 0000 195f0500 6600 0100 99db492c"),
        (_drive(0, 3.0), "feee1000 0000 0000 e3f70500 6600 0100 0ec19a60"),
        (_drive(1, 5.4), "feee1100 0000 0000 32be0a00 6600 0100 3347a5f5"),
    ],
)
def test_commands_are_those_of_the_vendors_library(command: MotorCmd, wire: str) -> None:
    frame = bytes.fromhex(wire)
    assert command.pack() == frame
    assert MotorCmd.parse(frame) == command


def test_data_are_those_of_the_vendors_library() -> None:
    zero = bytes.fromhex("fcee1000000000000000000000000000000000000000685cd437")
    assert MotorData.parse(zero) == MotorData(0, Status.FOC)
    assert MotorData(0, Status.FOC).pack() == zero
    frame = bytes.fromhex("fcee10212c3085ffc801ecf5f3ff00000000000000004a43ae38")
    data = MotorData.parse(frame)
    assert data == MotorData(
        0, Status.FOC, temp=33, winding=44, vol=48, torque=-123, speed=456, pos=-789012
    )
    assert data.pack() == frame
    assert data.voltage == 24.0
    rotor = data.joint(ratio=1.0)
    assert rotor.tau == pytest.approx(-0.04805, abs=1e-5)
    assert rotor.dq == pytest.approx(11.1919, abs=1e-4)
    assert rotor.q == pytest.approx(-151.2912, abs=1e-4)
    joint = data.joint()
    assert joint == pytest.approx((rotor.q / 25, rotor.dq / 25, rotor.tau * 25))


def test_calibration_is_that_of_the_vendors_library() -> None:
    frame = bytes.fromhex("feee6000 00fc 7d72 0000 6c77 285a016b d145c0f7")
    calibration = Calibration(0, position=0.0, range=5.61996, time=0x6B015A28)
    assert calibration.pack() == frame
    assert Calibration(0, time=0x6B015A28).pack() == frame  # the service's 322 degrees
    parsed = Calibration.from_command(MotorCmd.parse(frame))
    assert parsed is not None
    assert parsed == dataclasses.replace(calibration, range=parsed.range)
    assert parsed.range == pytest.approx(5.61996, abs=2e-4)
    assert Calibration.from_command(MotorCmd(0, Status.CALIBRATE)) is None
    assert Calibration.from_command(MotorCmd.setpoint(0, tau=-10.0)) is None


# docs/sources/unitree-dex.md#g: codes that were read at single values, rotor side
@each(
    ("name", "value", "code"),
    [
        ("tau", 0.1, 256),
        ("kp", 7e-5, 0),
        ("kp", 5.0 / 625, 102),
        ("kd", 0.05 / 625, 1),
        ("kd", 0.0487 / 625, 0),
        ("q", 67.5, 0x055F19),
    ],
)
def test_codes_of_the_rotor(name: str, value: float, code: int) -> None:
    command = MotorCmd.setpoint(0, ratio=1.0, **{name: value})
    field = {"tau": "tor_des", "kp": "k_pos", "kd": "k_spd", "q": "pos_des"}[name]
    assert getattr(command, field) == code


def test_torque_of_fourteen_point_nine_saturates_where_the_vendors_wraps() -> None:
    assert MotorCmd.setpoint(0, tau=14.9, ratio=1.0).tor_des == 0x7FFF
    assert MotorCmd.setpoint(0, tau=-1.0, ratio=1.0).tor_des == -2560  # the vendor's sends 0


def test_values_beyond_the_wire_range_saturate() -> None:
    big = MotorCmd.setpoint(0, q=1e9, dq=1e9, tau=1e9, kp=1e9, kd=1e9)
    assert (big.pos_des, big.spd_des, big.tor_des) == (2**31 - 1, 0x7FFF, 0x7FFF)
    assert (big.k_pos, big.k_spd) == (0xFFFF, 0xFFFF)
    small = MotorCmd.setpoint(0, q=-1e9, dq=-1e9, tau=-1e9, kp=-1.0, kd=-1.0)
    assert (small.pos_des, small.spd_des, small.tor_des) == (-(2**31), -0x8000, -0x8000)
    assert (small.k_pos, small.k_spd) == (0, 0)


@each("value", [math.nan, math.inf, -math.inf])
@each("name", ["q", "dq", "tau", "kp", "kd"])
def test_not_a_number_cannot_be_sent(name: str, value: float) -> None:
    with pytest.raises(EncodeError, match=r"cannot be sent"):
        MotorCmd.setpoint(0, **{name: value})


@each(
    ("frame", "says"),
    [
        (MotorCmd(16), "id = 16"),
        (MotorCmd(0, status=8), "status = 8"),
        (MotorCmd(0, k_pos=-1), "k_pos"),
        (MotorData(0, temp=128), "temp"),
        (MotorData(0, merror=2**32), "MError"),
        (Calibration(0, position=-0.1), "position"),
        (Calibration(0, range=13.0), "range"),
        (Calibration(0, time=-1), "time"),
        (Calibration(0, user_id=0x10000), "user id"),
    ],
)
def test_value_that_does_not_fit_its_field_is_refused(
    frame: MotorCmd | MotorData | Calibration, says: str
) -> None:
    with pytest.raises(EncodeError, match=says):
        frame.pack()


def test_invalid_frames_are_refused() -> None:
    for kind, frame in ((MotorCmd, MotorCmd(1).pack()), (MotorData, MotorData(1).pack())):
        with pytest.raises(TruncatedError):
            kind.parse(frame[:-1])
        with pytest.raises(OversizeError):
            kind.parse(frame + b"\0")
        with pytest.raises(WireError, match="starts with"):
            kind.parse(b"\0" + frame[1:])
        with pytest.raises(ChecksumError):
            kind.parse(frame[:-1] + b"\0")


# --- properties

_i16 = st.integers(-0x8000, 0x7FFF)
_u16 = st.integers(0, 0xFFFF)
_i32 = st.integers(-(2**31), 2**31 - 1)
commands = st.builds(
    MotorCmd,
    id=st.integers(0, 15),
    status=st.integers(0, 7),
    timeout=st.booleans(),
    tor_des=_i16,
    spd_des=_i16,
    pos_des=_i32,
    k_pos=_u16,
    k_spd=_u16,
    res=st.integers(0, 255),
)
data = st.builds(
    MotorData,
    id=st.integers(0, 15),
    status=st.integers(0, 7),
    timeout=st.booleans(),
    temp=st.integers(-128, 127),
    winding=st.integers(0, 255),
    vol=st.integers(0, 255),
    torque=_i16,
    speed=_i16,
    pos=_i32,
    merror=st.integers(0, 2**32 - 1),
    ex_sensor1=_u16,
    ex_sensor2=_u16,
)
frames = st.one_of(commands, data)


@given(frames)
def test_parse_inverts_pack(frame: MotorCmd | MotorData) -> None:
    assert type(frame).parse(frame.pack()) == frame


@given(commands)
def test_units_invert_counts(command: MotorCmd) -> None:
    """What a count stands for is sent as that count, at any ratio."""
    again = MotorCmd.setpoint(command.id, **command.joint()._asdict(), timeout=command.timeout)
    assert again == dataclasses.replace(command, status=Status.FOC, res=0)


@given(data)
def test_units_invert_counts_of_data(one: MotorData) -> None:
    joint = one.joint()
    again = MotorData.measured(
        one.id,
        one.status,
        q=joint.q,
        dq=joint.dq,
        tau=joint.tau,
        temperature=one.temp,
        winding=one.winding,
        voltage=one.voltage,
        error=one.merror,
        timeout=one.timeout,
    )
    assert again == dataclasses.replace(one, ex_sensor1=0, ex_sensor2=0)


@given(frames)
@settings(max_examples=15, deadline=None)
def test_every_flipped_bit_is_rejected(frame: MotorCmd | MotorData) -> None:
    good = frame.pack()
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError):
            type(frame).parse(bytes(bad))


@given(
    st.integers(0, 14),
    st.floats(0, 12.5),
    st.floats(0, 12.5),
    st.integers(0, 2**32 - 1),
    _u16,
)
def test_calibration_round_trip(
    number: int, position: float, stroke: float, time: int, user: int
) -> None:
    sent = Calibration(number, position, stroke, time, user)
    found = Calibration.from_command(MotorCmd.parse(sent.pack()))
    assert found is not None
    assert (found.id, found.time, found.user_id) == (number, time, user)
    assert found.position == pytest.approx(position, abs=2e-4)
    assert found.range == pytest.approx(stroke, abs=2e-4)
    assert found.pack() == sent.pack()


def test_outcome_of_a_calibration() -> None:
    calibration = Calibration(1, time=1)
    assert calibration_outcome(calibration.answer()) == ""
    assert "not enabled" in calibration_outcome(calibration.answer(done=False))
    assert "does not know" in calibration_outcome(MotorData(1, Status.FOC))
    assert "does not know" in calibration_outcome(MotorData(1, Status.CALIBRATE))
    said = [
        calibration_outcome(calibration.answer(problem))
        for problem in CalibrationProblem
        if problem
    ]
    assert len(set(said)) == len(said) == 7
    assert all(said)
    both = CalibrationProblem.ALREADY_CALIBRATED | CalibrationProblem.FLASH_WRITE
    assert calibration_outcome(calibration.answer(both)) == said[0]  # bit 0 wins
    assert "0x80" in calibration_outcome(calibration.answer(0x80))


# --- the stream


def _cut(stream: bytes, draw: st.DataObject) -> list[bytes]:
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    return [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]


@given(st.lists(data, max_size=6), st.data())
def test_parser_does_not_care_how_bytes_are_cut(sent: list[MotorData], draw: st.DataObject) -> None:
    parser = FrameParser()
    found = [f for part in _cut(b"".join(d.pack() for d in sent), draw) for f in parser.feed(part)]
    assert found == sent
    assert (parser.frames, parser.skipped, parser.crc_errors, parser.pending) == (
        len(sent),
        0,
        0,
        0,
    )


@given(st.lists(frames, max_size=6), st.data())
def test_parser_separates_commands_and_data_of_all_motors(
    sent: list[MotorCmd | MotorData], draw: st.DataObject
) -> None:
    parser = FrameParser((COMMAND, DATA))
    found = [f for part in _cut(b"".join(f.pack() for f in sent), draw) for f in parser.feed(part)]
    assert found == sent


@given(st.binary(max_size=80), data)
def test_a_good_frame_is_found_behind_garbage(noise: bytes, frame: MotorData) -> None:
    parser = FrameParser()
    found = parser.feed(noise + frame.pack() + bytes(DATA.size))
    assert frame in found
    assert parser.pending < DATA.size


@given(st.lists(st.binary(max_size=60), max_size=10))
def test_parser_survives_anything_within_bounds(noise: list[bytes]) -> None:
    parser = FrameParser((COMMAND, DATA))
    for piece in noise:
        parser.feed(piece)
        assert parser.pending < DATA.size
    total = sum(map(len, noise))
    assert parser.skipped + parser.pending <= total
    parser.reset()
    assert parser.pending == 0


@given(data, data, st.integers(0, 8 * 26 - 1))
def test_a_spoilt_frame_does_not_cost_the_next(
    first: MotorData, second: MotorData, bit: int
) -> None:
    spoilt = bytearray(first.pack())
    spoilt[bit // 8] ^= 1 << bit % 8
    parser = FrameParser()
    assert second in parser.feed(bytes(spoilt) + second.pack() + bytes(DATA.size))


def test_constants_of_the_vendors_library() -> None:
    assert m4010.GEAR_RATIO == 25.0
    assert m4010.BAUD_RATE == 6_000_000
    assert {number: str(side) for number, side in m4010.SIDES.items()} == {0: "right", 1: "left"}
    assert math.degrees(m4010.STROKE) == pytest.approx(322)
    assert (COMMAND.size, DATA.size) == (20, 26)
    assert issubclass(WireError, DexkitError)
