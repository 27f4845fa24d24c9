"""The CRC of LowCmd_ and LowState_ against foreign vectors and packers."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import EncodeError, OversizeError, TruncatedError, UsageError, WireError
from dexkit.messages import decode, encode, message_type
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.messages.layout import Struct
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.low_level import (
    LOW_LEVEL_TYPES,
    crc_of,
    crc_of_payload,
    encode_with_crc,
    struct_of_payload,
    verify,
    verify_payload,
)
from tests.each import each
from tests.messages_helpers import messages

GO_CMD, GO_STATE, HG_CMD, HG_STATE = LOW_LEVEL_TYPES

# docs/sources/unitree-dex.md#a7: how Unitree's Python SDK packs the struct (its signed go
# temperatures as the unsigned numbers that the IDL makes of them)
FORMATS = {
    GO_CMD: "<4B4IH2x" + "B3x5f3I" * 20 + "4B55Bx2I",
    GO_STATE: "<4B4IH2x13fB3x" + "B3x7fB3x3I" * 20 + "4BiH4B15H8hI41B3xf2B2x2f4H2I",
    HG_CMD: "<2B2x" + "B3x5fI" * 35 + "5I",
    HG_STATE: "<2I2B2xI13fh2x" + "B3x4f2hf7I" * 35 + "40B5I",
}

# in the samples: after bandwidth, the IMU's temperature, mode_machine
FIRST_GAP = {GO_CMD: 4 + 23, GO_STATE: 4 + 22, HG_CMD: 4 + 3, HG_STATE: 4 + 10}


def _go_cmd(**members: Any) -> go.LowCmd_:
    return go.LowCmd_(head=(0xFE, 0xEF), level_flag=0xFF, **members)


def _states(motor: Any, count: int) -> list[Any]:
    return [motor if i == 3 else type(motor)() for i in range(count)]


VECTORS = [
    (go.LowCmd_(), 0x4B5A4880),
    (go.LowState_(), 0x85F11EA6),
    (hg.LowCmd_(), 0xFE172F9F),
    (hg.LowState_(), 0xD64BB04A),
    (_go_cmd(), 0x322AC991),
    (
        _go_cmd(motor_cmd=[go.MotorCmd_(1, 0.1 * i, kp=60.0, kd=1.5) for i in range(20)]),
        0x8EBE83F8,
    ),
    (
        hg.LowCmd_(
            mode_machine=5,
            motor_cmd=[hg.MotorCmd_(1, 0.1 * i, kp=40.0, kd=1.0) for i in range(35)],
        ),
        0x81EB09A2,
    ),
    (
        hg.LowState_(
            tick=1000,
            imu_state=hg.IMUState_(quaternion=(1.0, 0.0, 0.0, 0.0)),
            motor_state=_states(hg.MotorState_(q=0.5, temperature=(31, -5)), 35),
        ),
        0xB91422B5,
    ),
    (
        go.LowState_(
            tick=1000,
            imu_state=go.IMUState_(quaternion=(1.0, 0.0, 0.0, 0.0)),
            motor_state=_states(go.MotorState_(q=0.5, temperature=31), 20),
        ),
        0x54958ED1,
    ),
]


def test_low_level_messages_have_a_crc() -> None:
    assert [name.rsplit(":", 1)[1] for name in LOW_LEVEL_TYPES] == ["LowCmd_", "LowState_"] * 2


@each(("message", "crc"), VECTORS)
def test_crc_equals_measured_values(message: Any, crc: int) -> None:
    assert crc_of(message) == crc
    package = type(message).__module__.rsplit(".", 1)[1]
    name = f"{package}::msg::dds_::{type(message).__name__}"
    assert crc_of_payload(name, encode(message)) == crc
    assert not verify(message)
    assert not verify_payload(name, encode(message))
    sealed = encode_with_crc(message)
    assert verify_payload(name, sealed)
    assert decode(name, sealed).crc == crc
    assert verify(decode(name, sealed))
    assert message.crc == 0


def _numbers(kind: Struct, message: Any) -> list[Any]:
    found: list[Any] = []
    for member in kind.fields:
        value = getattr(message, member.name)
        for item in value if member.array is not None else [value]:
            found += _numbers(member.type, item) if isinstance(member.type, Struct) else [item]
    return found


@pytest.mark.parametrize("name", LOW_LEVEL_TYPES)
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_the_struct_is_the_one_that_the_sdk_packs(name: str, data: st.DataObject) -> None:
    mt = message_type(name)
    message = data.draw(messages(name))
    packed = struct.pack(FORMATS[name], *_numbers(mt.layout, message))
    payload = mt.encode(message)
    assert struct_of_payload(name, payload) == packed
    assert crc_of(message) == crc32_words(packed[:-4])
    # what lies in the gaps of a sample, or in its own CRC, does not matter
    dirty = bytearray(payload)
    dirty[FIRST_GAP[name]] ^= 0x55
    assert mt.decode(dirty) == message
    dirty[-1] ^= 0xFF
    assert crc_of_payload(name, memoryview(dirty)) == crc_of(message)


@pytest.mark.parametrize("name", LOW_LEVEL_TYPES)
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_any_flipped_bit_is_noticed(name: str, data: st.DataObject) -> None:
    message = data.draw(messages(name))
    sealed = bytearray(encode_with_crc(message))
    before = decode(name, sealed)
    bit = data.draw(st.integers(4 * 8, len(sealed) * 8 - 1))
    sealed[bit // 8] ^= 1 << bit % 8
    changed = encode(before) != encode(decode(name, sealed))  # not if the bit lies in a gap
    assert verify_payload(name, sealed) is not changed


def test_big_endian_samples() -> None:
    """Nobody is known to send one, and its CRC is still that of the little-endian struct."""
    body = struct.pack(
        ">2B" + "Bx5fI" + "B3x5fI" * 34 + "5I", *(0, 5), *([1, 0.5, 0, 0, 0, 0, 0] * 35), *[0] * 5
    )
    message = hg.LowCmd_(mode_machine=5, motor_cmd=[hg.MotorCmd_(1, 0.5) for _ in range(35)])
    sample = b"\0\0\0\0" + body
    assert decode(HG_CMD, sample) == message
    assert crc_of_payload(HG_CMD, sample) == crc_of(message)
    sealed = sample[:-4] + crc_of(message).to_bytes(4, "big")
    assert verify_payload(HG_CMD, sealed)


def test_invalid_settings_are_refused() -> None:
    with pytest.raises(UsageError, match="HandCmd_ carries no CRC"):
        crc_of(hg.HandCmd_())
    with pytest.raises(UsageError, match="carries no CRC"):
        verify_payload("unitree_go::msg::dds_::MotorCmds_", b"")
    with pytest.raises(EncodeError, match="tick"):
        crc_of(go.LowState_(tick=-1))
    payload = encode(go.LowCmd_())
    with pytest.raises(TruncatedError):
        crc_of_payload(GO_CMD, payload[:-1])
    with pytest.raises(OversizeError):
        crc_of_payload(GO_CMD, payload + b"\0")
    with pytest.raises(WireError, match="XCDR2"):
        verify_payload(GO_CMD, b"\0\x07" + payload[2:])


def test_temperatures_above_127() -> None:
    """Legal in the IDL; Unitree's Python SDK raises on them, the CRC itself does not mind."""
    state = go.LowState_(motor_state=_states(go.MotorState_(temperature=200), 20))
    assert verify_payload(GO_STATE, encode_with_crc(state))
