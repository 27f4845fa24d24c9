"""Layouts, golden bytes and hostile input; the comparison with CycloneDDS is in test_dds_types."""

from __future__ import annotations

import pytest

from dexkit.errors import EncodeError, OversizeError, TruncatedError, UsageError, WireError
from dexkit.messages import decode, encode, message_type, message_types
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.messages.layout import MAX_ELEMENTS
from tests.each import each

# docs/sources/unitree-dex.md#a4, measured there on Unitree's SDK classes
GOLDEN_CMDS = bytes.fromhex(
    "00010000 01000000 01000000 0000c03f 00000000 00000000"
    "0000a040 cdcc4c3d 00000000 00000000 00000000"
)
GOLDEN_STATES = bytes.fromhex(
    "00010000 01000000 00000000 0000c03f 0000803e 00000000 000000bf"
    "00000000 00000000 00000000 00000000 00000000 00000000 00000000"
)


def _hand_state(motors: int, sensors: int) -> hg.HandState_:
    return hg.HandState_(
        [hg.MotorState_() for _ in range(motors)],
        [hg.PressSensorState_() for _ in range(sensors)],
    )


def test_the_sequence_of_motors_follows_from_the_layout() -> None:
    found = {
        kind.name: (kind.motor_sequence, kind.motor_type.cls)
        for kind in message_types()
        if kind.layout.name
        in ("MotorCmds_", "MotorStates_", "HandCmd_", "HandState_", "LowCmd_", "LowState_")
    }
    assert found == {
        "unitree_go::msg::dds_::MotorCmds_": ("cmds", go.MotorCmd_),
        "unitree_go::msg::dds_::MotorStates_": ("states", go.MotorState_),
        "unitree_hg::msg::dds_::HandCmd_": ("motor_cmd", hg.MotorCmd_),
        "unitree_hg::msg::dds_::HandState_": ("motor_state", hg.MotorState_),
        "unitree_go::msg::dds_::LowCmd_": ("motor_cmd", go.MotorCmd_),
        "unitree_go::msg::dds_::LowState_": ("motor_state", go.MotorState_),
        "unitree_hg::msg::dds_::LowCmd_": ("motor_cmd", hg.MotorCmd_),
        "unitree_hg::msg::dds_::LowState_": ("motor_state", hg.MotorState_),
    }
    with pytest.raises(UsageError, match="no sequence of motors"):
        _ = message_type("unitree_go::msg::dds_::MotorCmd_").motor_sequence


def test_encoded_commands_equal_those_of_unitrees_sdk() -> None:
    message = go.MotorCmds_([go.MotorCmd_(mode=1, q=1.5, kp=5.0, kd=0.05)])
    assert encode(message) == GOLDEN_CMDS
    back = decode("unitree_go/msg/MotorCmds", GOLDEN_CMDS)
    assert back.cmds[0].q == 1.5
    assert back.cmds[0].kd == pytest.approx(0.05)
    assert back.cmds[0].reserve == (0, 0, 0)


def test_encoded_states_equal_those_of_unitrees_sdk() -> None:
    message = go.MotorStates_([go.MotorState_(q=1.5, dq=0.25, tau_est=-0.5)])
    assert encode(message) == GOLDEN_STATES
    assert decode("unitree_go.msg.dds_.MotorStates_", GOLDEN_STATES) == message


@each(
    ("message", "size"),
    [
        (go.MotorCmds_([go.MotorCmd_()]), 44),
        (go.MotorStates_([go.MotorState_()]), 56),
        (hg.HandCmd_([hg.MotorCmd_() for _ in range(7)]), 220),
        (hg.HandCmd_([hg.MotorCmd_() for _ in range(20)]), 584),
        (_hand_state(7, 0), 492),
        (_hand_state(7, 7), 1220),
        (_hand_state(7, 9), 1428),
        (_hand_state(20, 0), 1220),
        (go.LowCmd_(), 812),
        (go.LowState_(), 1180),
        (hg.LowCmd_(), 1004),
        (hg.LowState_(), 2092),
    ],
    ids=lambda v: type(v).__name__ if not isinstance(v, int) else str(v),
)
def test_message_has_its_size(message: object, size: int) -> None:
    # docs/sources/unitree-dex.md#a4
    assert len(encode(message)) == size


def test_message_types_are_found_by_each_of_their_names() -> None:
    mt = message_type("unitree_hg/msg/HandState")
    assert mt.name == "unitree_hg::msg::dds_::HandState_"
    assert mt.ros_name == "unitree_hg/msg/HandState"
    assert message_type(mt.name) is mt
    assert mt.cls is hg.HandState_
    with pytest.raises(UsageError, match="unknown message type"):
        message_type("unitree_hg::msg::dds_::Nothing_")
    assert len(message_types()) == 21


def test_other_representations_are_refused_by_name() -> None:
    mt = message_type("unitree_go/msg/MotorCmds")
    with pytest.raises(WireError, match="XCDR2"):
        mt.decode(b"\x00\x07" + GOLDEN_CMDS[2:])
    with pytest.raises(WireError, match="0x1234"):
        mt.decode(b"\x12\x34" + GOLDEN_CMDS[2:])
    with pytest.raises(TruncatedError):
        mt.decode(b"\x00\x01")


def test_trailing_bytes_are_refused() -> None:
    mt = message_type("unitree_go/msg/MotorCmds")
    with pytest.raises(OversizeError):
        mt.decode(GOLDEN_CMDS + b"\0")
    # the data of an IMUState_ end on an odd multiple of 2: padded to 4 on the wire
    imu = message_type("unitree_hg/msg/IMUState")
    data = imu.encode(hg.IMUState_(temperature=-5))
    assert imu.decode(data) == imu.decode(data + b"\0\0") == hg.IMUState_(temperature=-5)
    for rest in (1, 3, 4):
        with pytest.raises(OversizeError):
            imu.decode(data + bytes(rest))


@each(
    ("message", "text"),
    [
        (go.MotorCmds_([go.MotorCmd_(mode=300)]), r"cmds\[0\].mode = 300 does not fit uint8"),
        (go.MotorCmds_([go.MotorCmd_(mode=-1)]), "does not fit uint8"),
        (go.MotorCmds_([go.MotorCmd_(q=1e39)]), r"cmds\[0\].q = 1e\+39 does not fit float"),
        (go.MotorCmds_([go.MotorCmd_(q="1")]), "is not a float"),  # type: ignore[arg-type]
        (go.MotorCmds_([go.MotorCmd_(mode=1.5)]), "is not a uint8"),  # type: ignore[arg-type]
        (go.MotorCmds_([go.MotorCmd_(reserve=(1, 2))]), "reserve has 2 elements, not 3"),
        (go.MotorCmds_([go.MotorCmd_(reserve=(1, 2, 2**32))]), r"reserve\[2\] = 4294967296"),
        (go.MotorCmds_([object()]), "is a object without mode"),  # type: ignore[list-item]
        (go.MotorCmds_(None), "not a sequence"),  # type: ignore[arg-type]
        (go.MotorCmds_([go.MotorCmd_()] * (MAX_ELEMENTS + 1)), "at most 1024"),
        (hg.HandState_(imu_state=hg.IMUState_(rpy=(0.0,))), r"imu_state.rpy has 1 elements"),
        (go.LowCmd_(motor_cmd=[]), "motor_cmd has 0 elements, not 20"),
        (go.LowCmd_(motor_cmd=None), "not a sequence"),  # type: ignore[arg-type]
        (hg.LowState_(motor_state=[hg.MotorState_()] * 34), "motor_state has 34 elements, not 35"),
        (
            hg.LowState_(motor_state=[hg.MotorState_()] * 34 + [hg.MotorState_(sensor=(0,))]),
            r"motor_state\[34\].sensor has 1 elements, not 2",
        ),
        (
            hg.LowState_(motor_state=[hg.MotorState_(sensor=(0,))] * 35),
            r"motor_state\[0\].sensor has 1 elements, not 2",
        ),
        (3, "is not a message"),
    ],
)
def test_values_that_do_not_fit_their_type_are_refused(message: object, text: str) -> None:
    with pytest.raises(EncodeError, match=text):
        encode(message)
