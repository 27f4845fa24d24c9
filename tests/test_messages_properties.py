"""Properties of the codec for every message type and for any bytes."""

from __future__ import annotations

import math
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import TruncatedError, UsageError, WireError
from dexkit.messages import decode, encode, message_type
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.messages.layout import STRUCTS, Primitive, Struct
from tests.each import each
from tests.messages_helpers import NAMES, messages

any_message = st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), messages(name)))


def _swapped(name: str, data: bytes) -> bytes:
    """The same sample in big endian, by walking the layout number by number."""
    out = bytearray(b"\x00\x00\x00\x00")
    at = 0

    def number(size: int) -> int:
        nonlocal at
        pad = -at % size
        out.extend(data[4 + at : 4 + at + pad])
        at += pad
        raw = data[4 + at : 4 + at + size]
        out.extend(raw[::-1])
        at += size
        return int.from_bytes(raw, "little")

    def walk(kind: Struct | Primitive) -> None:
        if isinstance(kind, Primitive):
            number(kind.size)
            return
        for member in kind.fields:
            count = number(4) if member.sequence else (member.array or 1)
            for _ in range(count):
                walk(member.type)

    walk(STRUCTS[name])
    return bytes(out)


def _problem(name: str, data: bytes) -> WireError | None:
    try:
        decode(name, data)
    except WireError as error:
        return error
    return None


@given(any_message)
def test_decoding_gives_back_what_was_encoded(pair: tuple[str, Any]) -> None:
    name, message = pair
    data = message_type(name).encode(message)
    assert data[:4] == b"\x00\x01\x00\x00"
    assert decode(name, data) == message
    assert decode(name, bytearray(data)) == decode(name, memoryview(data)) == message


@given(any_message)
def test_big_endian_decodes_to_the_same_message(pair: tuple[str, Any]) -> None:
    name, message = pair
    assert decode(name, _swapped(name, encode(message))) == message


@given(any_message)
def test_every_shortened_sample_is_truncated(pair: tuple[str, Any]) -> None:
    name, message = pair
    data = encode(message)
    for size in range(0, len(data), max(1, len(data) // 64)):
        with pytest.raises(TruncatedError):
            decode(name, data[:size])


@given(st.sampled_from(NAMES), st.binary(max_size=300), st.booleans())
def test_random_bytes_raise_nothing_but_wire_errors(
    name: str, data: bytes, plausible: bool
) -> None:
    if plausible:  # a good header and a small length get further
        data = b"\x00\x01\x00\x00\x02\x00\x00\x00" + data
    try:
        decode(name, data)
    except WireError:
        pass


@given(any_message, st.data())
def test_damaged_samples_raise_nothing_but_wire_errors(
    pair: tuple[str, Any], data: st.DataObject
) -> None:
    name, message = pair
    sample = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(sample) - 1))
        sample[at] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(-3, 3))
    damaged = bytes(sample[:cut]) if cut < 0 else bytes(sample) + bytes(cut)
    problem = _problem(name, damaged)
    bulk = message_type(name).columns([damaged]).errors
    assert str(bulk.get(0, "")) == str(problem or "")


def test_a_hostile_length_costs_no_memory() -> None:
    mt = message_type("unitree_hg/msg/HandState")
    sample = b"\x00\x01\x00\x00\xff\xff\xff\x7f" + bytes(10_000)
    assert len(mt.columns([sample]).errors) == 1
    tracemalloc.start()
    try:
        for _ in range(100):
            with pytest.raises(WireError):
                mt.decode(sample)
            assert len(mt.columns([sample]).errors) == 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1_000_000  # the length asks for 120 GB


@given(st.data())
def test_columns_agree_with_decoding_one_by_one(data: st.DataObject) -> None:
    name = "unitree_hg::msg::dds_::HandState_"
    mt = message_type(name)
    payloads: list[bytes] = []
    for message in data.draw(st.lists(messages(name, 3), max_size=4)):
        sample = mt.encode(message)
        payloads += data.draw(
            st.lists(
                st.sampled_from([sample, _swapped(name, sample), sample[:-1], b""]), max_size=3
            )
        )
    columns = mt.columns(payloads)
    q = columns["motor_state[].q"]
    second = columns["motor_state[1].temperature[1]"]
    pressure = columns["press_sensor_state[0].pressure"]
    rpy, error = columns["imu_state.rpy"], columns["error[1]"]
    assert len(columns) == len(payloads)
    for row, payload in enumerate(payloads):
        problem = _problem(name, payload)
        if problem is not None:
            assert not columns.ok[row]
            assert str(columns.errors[row]) == str(problem)
            assert columns.count("motor_state")[row] == -1
            assert np.isnan(rpy[row]).all()
            assert np.isnan(q[row]).all()
            continue
        message = mt.decode(payload)
        motors, sensors = message.motor_state, message.press_sensor_state
        assert columns.ok[row]
        assert columns.count("motor_state")[row] == len(motors)
        assert q[row, : len(motors)].tolist() == [m.q for m in motors]
        assert np.isnan(q[row, len(motors) :]).all()
        if len(motors) > 1:
            assert second[row] == motors[1].temperature[1]
        else:
            assert math.isnan(second[row])
        if sensors:
            assert tuple(pressure[row]) == sensors[0].pressure
        else:
            assert np.isnan(pressure[row]).all()
        assert tuple(rpy[row]) == message.imu_state.rpy
        assert error[row] == message.error[1]


@settings(max_examples=20)
@given(st.data())
def test_columns_of_fixed_arrays_of_structs(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["unitree_go/msg/LowState", "unitree_hg/msg/LowState"]))
    mt = message_type(name)
    samples = [mt.encode(m) for m in data.draw(st.lists(messages(mt.name), max_size=2))]
    samples += [_swapped(mt.name, sample) for sample in samples]
    payloads = [*samples, *(sample[:-1] for sample in samples), *samples]
    columns = mt.columns(payloads)
    temperature = "temperature" if name.startswith("unitree_go") else "temperature[1]"
    q, third = columns["motor_state[].q"], columns[f"motor_state[2].{temperature}"]
    first, every = columns["motor_state[0].reserve"], columns[f"motor_state[].{temperature}"]
    assert len(q) == len(payloads)
    for row, payload in enumerate(payloads):
        problem = _problem(name, payload)
        if problem is not None:
            assert str(columns.errors[row]) == str(problem)
            assert np.isnan(q[row]).all()
            continue
        message = mt.decode(payload)
        motors = message.motor_state
        warmth = [np.atleast_1d(m.temperature)[-1] for m in motors]
        assert columns.ok[row]
        assert q[row].tolist() == [m.q for m in motors]
        assert every[row].tolist() == warmth
        assert third[row] == warmth[2]
        assert tuple(first[row]) == motors[0].reserve
        assert columns["crc"][row] == message.crc
    with pytest.raises(UsageError, match="elements"):
        columns[f"motor_state[{35 if mt.layout.scope[0] == 'unitree_hg' else 20}].q"]
    with pytest.raises(UsageError, match="two open dimensions"):
        columns["motor_state[].reserve"]


def test_columns_of_equal_length_but_other_shape() -> None:
    # 13 motors without a sensor are as long as none with 7 sensors: 13 x 56 = 7 x 104
    mt = message_type("unitree_hg/msg/HandState")
    one = mt.encode(hg.HandState_([hg.MotorState_(q=1.0)] * 13))
    other = mt.encode(hg.HandState_([], [hg.PressSensorState_(lost=3)] * 7))
    wrong = bytearray(one)
    wrong[4] = 12
    assert len(one) == len(other)
    columns = mt.columns([one, other, bytes(wrong), one, other])
    assert columns.count("motor_state").tolist() == [13, 0, -1, 13, 0]
    assert list(columns.errors) == [2]
    assert np.nan_to_num(columns["motor_state[12].q"], nan=-1).tolist() == [1, -1, -1, 1, -1]
    assert np.nan_to_num(columns["press_sensor_state[6].lost"], nan=-1).tolist() == [
        *(-1, 3, -1, -1, 3)
    ]


def test_columns_of_no_samples_are_empty() -> None:
    columns = message_type("unitree_go/msg/MotorStates").columns([])
    assert columns["states[0].q"].shape == (0,)
    assert columns["states[].q"].shape == (0, 0)
    assert columns.ok.shape == (0,)


@each(
    "path",
    [
        "",
        "q",
        "states",
        "states[0]",
        "states[0].nothing",
        "states[0].q[0]",
        "states[].reserve",
        "states[0].reserve[2]",
        "states[0].q.x",
        "states[-1].q",
    ],
)
def test_invalid_column_paths_are_refused(path: str) -> None:
    columns = message_type("unitree_go/msg/MotorStates").columns(
        [encode(go.MotorStates_([go.MotorState_()]))]
    )
    with pytest.raises(UsageError):
        columns[path]
    with pytest.raises(UsageError):
        columns.count("q")
