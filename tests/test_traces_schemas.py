"""Schemas in recordings compared with dexkit's own."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.errors import TraceUnsupported
from dexkit.messages import message_type, message_types
from dexkit.traces import open_trace, schemas
from tests.each import each
from tests.trace_helpers import STATE_TYPE, T0, mcap_bytes, state, write

HAND_STATE = "unitree_hg::msg::dds_::HandState_"

# what rosidl writes: one file a type, arrays as typedefs
ROS2IDL = """\
================================================================================
IDL: unitree_go/msg/MotorCmds
// generated from rosidl_adapter/resource/msg.idl.em
#include "unitree_go/msg/MotorCmd.idl"
module unitree_go {
  module msg {
    struct MotorCmds {
      @verbatim (language="comment", text="the \\"commands\\" (of all) motors")
      sequence<unitree_go::msg::MotorCmd> cmds;
    };
  };
};
================================================================================
IDL: unitree_go/msg/MotorCmd
module unitree_go {
  module msg {
    typedef uint32 uint32__3[3];
    module MotorCmd_Constants {
      const uint8 BRAKE = 0;
      @verbatim (language="comment", text="x")
      const string NAME = "a;b";
    };
    struct MotorCmd {
      uint8 mode;
      /* several
         lines */
      @unit (value="rad") float q;
      float dq, tau;
      float kp;
      float kd;
      uint32__3 reserve;
    };
  };
};
"""

# unitree_ros2's package: signed temperature, a constant, comments, a bounded string elsewhere
ROS2MSG = """\
MotorState[] states  # all of them
===
MSG: unitree_go/MotorState
uint8 FOC=1
uint8 mode
float32 q
float32 dq
float32 ddq
float32 tau_est
float32 q_raw
float32 dq_raw
float32 ddq_raw
int8 temperature
uint32 lost 0
uint32[2] reserve
"""

# the layout of August 2024 (docs/sources/unitree-dex.md#a3): imu before pressure, two fields fewer
OLD_HAND_STATE = """\
module unitree_hg { module msg { module dds_ {
struct MotorState_ { octet mode; float q; float dq; float ddq; float tau_est;
  short temperature[2]; float vol; unsigned long sensor[2]; unsigned long motorstate;
  unsigned long reserve[4]; };
struct PressSensorState_ { float pressure[12]; float temperature[12]; };
struct IMUState_ { float quaternion[4]; float gyroscope[3]; float accelerometer[3]; float rpy[3];
  short temperature; };
struct HandState_ { sequence<unitree_hg::msg::dds_::MotorState_> motor_state;
  unitree_hg::msg::dds_::IMUState_ imu_state;
  sequence<unitree_hg::msg::dds_::PressSensorState_> press_sensor_state;
  float power_v; float power_a; unsigned long reserve[2]; };
}; }; };
"""


def ours(name: str) -> schemas.Struct:
    return schemas.parse("omgidl", name, message_type(name).omgidl)


@each("kind", message_types(), ids=lambda k: k.ros_name)
def test_ros2msg_and_omgidl_schemas_are_equivalent(kind: object) -> None:
    from dexkit.messages import MessageType

    assert isinstance(kind, MessageType)
    msg = schemas.parse("ros2msg", kind.ros_name, kind.ros2msg)
    idl = schemas.parse("omgidl", kind.name, kind.omgidl)
    assert msg == idl
    assert schemas.differences(msg, idl) == ([], [])


def test_ros2idl_is_read() -> None:
    parsed = schemas.parse("ros2idl", "unitree_go/msg/MotorCmds", ROS2IDL)
    assert schemas.differences(parsed, ours("unitree_go::msg::dds_::MotorCmds_")) == ([], [])


def test_different_signedness_is_reported_and_read(tmp_path: Path) -> None:
    data = mcap_bytes(
        [("/dex1/left/state", T0, 0, state(1.25))],
        types={"/dex1/left/state": STATE_TYPE},
        schema_text=ROS2MSG,
    )
    trace = open_trace(write(tmp_path / "a.mcap", data))
    assert trace.channels[0].supported
    assert trace.warnings == [f"{STATE_TYPE}: states[].temperature is i8, read as u8"]
    assert trace.samples("/dex1/left/state").columns()["states[0].q"].tolist() == [1.25]


@pytest.mark.parametrize("encoding", ["omgidl", "ros2idl"])
def test_an_old_layout_is_named_and_not_decoded(tmp_path: Path, encoding: str) -> None:
    topic = "rt/dex3/left/state"
    data = mcap_bytes(
        [(topic, T0, 0, bytes(100))],
        types={topic: HAND_STATE},
        encoding=encoding,
        schema_text=OLD_HAND_STATE,
        schema_name=HAND_STATE,
    )
    trace = open_trace(write(tmp_path / "a.mcap", data))
    (channel,) = trace.channels
    assert not channel.supported
    assert "another layout" in channel.problem
    assert "lacks system_v, device_v, error" in channel.problem
    assert any("another layout" in w for w in trace.warnings)
    for decode in (trace.message_type, lambda t: trace.samples(t).columns()):
        with pytest.raises(TraceUnsupported, match="another layout"):
            decode(topic)


@each(
    ("change", "said"),
    [
        (("float pressure[12]", "float pressure[10]"), "pressure has 10 elements, not 12"),
        (("float power_v", "double power_v"), "power_v is f64, not f32"),
        (("short temperature;", "short temperature[2];"), "is an array of i16, not i16"),
        (("  float power_v;\n  float power_a;", "  float power_a;\n  float power_v;"), "order"),
    ],
)
def test_each_breaking_difference_is_named(change: tuple[str, str], said: str) -> None:
    text = message_type(HAND_STATE).omgidl
    assert change[0] in text
    recorded = schemas.parse("omgidl", HAND_STATE, text.replace(*change))
    breaking, _ = schemas.differences(recorded, ours(HAND_STATE))
    assert len(breaking) == 1
    assert said in breaking[0]


BAD = {
    "no such type": ("ros2msg", "Other[] x"),
    "no name": ("ros2msg", "uint8"),
    "odd type": ("ros2msg", "uint8[x] a"),
    "itself": ("ros2msg", "pkg/T[] a"),
    "huge array": ("ros2msg", "uint8[" + "9" * 5000 + "] a"),
    "cut": ("omgidl", "module a { struct"),
    "union": ("omgidl", "union U switch (long) { case 1: long a; };"),
    "deep modules": ("omgidl", "module a {" * 10_000),
    "deep sequences": ("omgidl", "struct T { " + "sequence<" * 10_000),
    "deep typedefs": (
        "omgidl",
        "typedef octet t0[2];"
        + "".join(f"typedef t{i} t{i + 1}[2];" for i in range(3000))
        + "module pkg { module msg { module dds_ { struct T_ { t3000 a; }; }; }; };",
    ),
    "long": ("omgidl", " " * 2_000_000),
    "encoding": ("protobuf", ""),
}


@each("name", BAD)
def test_a_bad_schema_is_unsupported(name: str) -> None:
    encoding, text = BAD[name]
    with pytest.raises(TraceUnsupported):
        schemas.parse(encoding, "pkg/msg/T", text)


TOKENS = (
    *("struct", "module", "typedef", "const", "sequence", "long", "unsigned", "uint8", "T", "3"),
    *("{", "}", ";", "<", ">", "[", "]", "@", "(", ")", "=", ",", "::", "#", '"', "\n"),
    *("MSG:", "pkg/T", "float32[]"),
)


@given(
    st.sampled_from(schemas.ENCODINGS),
    st.lists(
        st.sampled_from(TOKENS),
        max_size=40,
    ).map(" ".join)
    | st.text(max_size=80),
)
def test_any_text_is_read_or_unsupported(encoding: str, text: str) -> None:
    try:
        schemas.parse(encoding, "pkg/msg/T", text)
    except TraceUnsupported:
        pass
