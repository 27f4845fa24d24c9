"""Schema texts read by foreign libraries, and the IDL reader."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dexkit.messages import message_type, message_types
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.messages.layout import IdlError, Primitive, Struct, parse
from dexkit.traces import open_trace
from tests.each import each

SAMPLES = sorted((Path(__file__).parent.parent / "traces" / "samples").glob("*.mcap"))

MESSAGES = [
    go.MotorCmds_([go.MotorCmd_(1, 1.5, 0.25, -0.5, 5.0, 0.0625, (1, 2, 2**32 - 1))] * 2),
    go.MotorStates_([go.MotorState_(1, 1.5, 0.5, 0.25, -0.5, 1, 2, 3, 255, 7, (8, 9))] * 2),
    hg.HandCmd_([hg.MotorCmd_(16, 1.5, reserve=3)] * 7, (1, 2, 3, 4)),
    hg.HandState_(
        [hg.MotorState_(1, 1.5, temperature=(31, -5), vol=12.0, reserve=(1, 2, 3, 4))] * 7,
        [hg.PressSensorState_((0.5,) * 12, (30.0,) * 12, 3, 4)] * 9,
        hg.IMUState_((1.0, 0.0, 0.5, 0.0), rpy=(0.5, 0.25, 0.125), temperature=-7),
        *(24.0, 0.5, 23.5, 12.0),
        error=(1, 2),
        reserve=(3, 4),
    ),
    go.LowCmd_(motor_cmd=[go.MotorCmd_(mode=1, q=float(i)) for i in range(20)], crc=5),
    go.LowState_(
        imu_state=go.IMUState_((1.0, 2.0, 3.0, 4.0), temperature=5),
        motor_state=[go.MotorState_(mode=1, q=float(i), lost=i) for i in range(20)],
        bms_state=go.BmsState_(soc=6, current=-7, cell_vol=tuple(range(15))),
        foot_force=(-1, 2, 3, 4),
        tick=8,
        crc=9,
    ),
    hg.LowCmd_(1, 2, [hg.MotorCmd_(mode=1, q=float(i)) for i in range(35)], crc=5),
    hg.LowState_(
        mode_machine=3,
        imu_state=hg.IMUState_((1.0, 2.0, 3.0, 4.0), temperature=-5),
        motor_state=[hg.MotorState_(mode=1, q=float(i), vol=i) for i in range(35)],
        wireless_remote=tuple(range(40)),
        crc=9,
    ),
]


def _same(kind: Struct, mine: Any, theirs: Any) -> None:
    """Every number of the two messages is equal."""
    for member in kind.fields:
        a, b = getattr(mine, member.name), getattr(theirs, member.name)
        if isinstance(member.type, Primitive):
            b = list(b) if isinstance(b, bytes) else b  # what mcap_ros2 makes of uint8[n]
            assert np.array_equal(np.asarray(a), np.asarray(b)), member.name
        elif member.sequence or member.is_structs:
            assert len(a) == len(b) > 0
            for x, y in zip(a, b, strict=True):
                _same(member.type, x, y)
        else:
            _same(member.type, a, b)


@each("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_rosbags_reads_our_bytes_with_our_schema(message: Any) -> None:
    package = type(message).__module__.rsplit(".", 1)[1]
    mt = message_type(f"{package}::msg::dds_::{type(message).__name__}")
    store = get_typestore(Stores.EMPTY)
    head, *rest = mt.ros2msg.split("=" * 80 + "\n")
    store.register(get_types_from_msg(head, mt.ros_name))
    for part in rest:
        name, text = part.split("\n", 1)
        store.register(get_types_from_msg(text, name.removeprefix("MSG: ").replace("/", "/msg/")))
    decoded = store.deserialize_cdr(mt.encode(message), mt.ros_name)
    _same(mt.layout, message, decoded)
    assert bytes(store.serialize_cdr(decoded, mt.ros_name)) == mt.encode(message)


@each("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_mcap_ros2_reads_our_bytes_with_our_schema(message: Any) -> None:
    package = type(message).__module__.rsplit(".", 1)[1]
    mt = message_type(f"{package}::msg::dds_::{type(message).__name__}")
    schema = Schema(id=1, name=mt.ros_name, encoding="ros2msg", data=mt.ros2msg.encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    _same(mt.layout, message, decode(mt.encode(message)))


def test_omgidl_equals_recorded_schemas() -> None:
    """The shipped recordings carry schemas that dexkit did not write."""
    seen = set()
    for path in SAMPLES:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        for schema in summary.schemas.values():
            if schema.encoding == "omgidl":
                assert schema.data.decode().split() == message_type(schema.name).omgidl.split()
                seen.add(schema.name.rsplit(":", 1)[1])
    assert seen >= {"MotorCmds_", "MotorStates_", "HandCmd_", "HandState_"}


def test_recorded_payloads_survive_decoding_and_encoding() -> None:
    checked = 0
    for path in SAMPLES:
        for message in islice(open_trace(path).messages(), 0, None, 50):
            mt = message_type(message.type_name)
            encoded = mt.encode(mt.decode(message.data))
            # CycloneDDS fills up to a multiple of four
            assert encoded + bytes(-len(encoded) % 4) == message.data
            checked += 1
    assert checked > 500


def test_our_omgidl_reads_back_as_the_same_layout() -> None:
    classic = {
        "octet": "uint8",
        "unsigned short": "uint16",
        "long": "int32",
        "unsigned long": "uint32",
        "short": "int16",
    }
    for mt in message_types():
        text = mt.omgidl.replace("::".join(mt.layout.scope) + "::", "")
        for old, new in classic.items():
            text = text.replace(f"  {old} ", f"  {new} ").replace(f"<{old}, ", f"<{new}, ")
        (*_, struct) = parse(text).values()
        assert [(f.name, f.array, f.sequence) for f in struct.fields] == [
            (f.name, f.array, f.sequence) for f in mt.layout.fields
        ]


HEAD, TAIL = "module a { module msg { module dds_ { ", " }; }; };"


@each(
    ("text", "problem"),
    [
        ("struct X { uint8 a; };", "expected @"),
        ("@final struct X { };", "no members"),
        ("@final struct X { double a; };", "unknown type 'double'"),
        ("@final struct X { sequence<uint16> a; };", "sequences of structs or bytes"),
        ("@final struct E { uint8 a; }; @final struct X { E a[2]; };", "uneven layout"),
        (
            "@final struct E { uint8 a[4]; }; @final struct X { uint8 z; E a[2]; };",
            "uneven layout",
        ),
        (
            "@final struct E { uint32 a; }; @final struct F { E a[2]; };@final struct X { F a; };",
            "nested arrays of structs",
        ),
        ("@final struct E { uint8 a; }; @final struct X { sequence<E> a; };", "uneven layout"),
        (
            "@final struct E { uint32 a; }; @final struct F { sequence<E> a; };"
            "@final struct X { F a; };",
            "nested sequences",
        ),
        ("@final struct X { uint8 a }", "expected ;"),
        ("@final struct X { uint8 $; };", "cannot read"),
        ("@final struct X { uint8 a[x]; };", "no length"),
        ("@final struct X { uint8 a; }", "expected ;"),
    ],
)
def test_idl_outside_the_subset_is_refused(text: str, problem: str) -> None:
    with pytest.raises(IdlError, match=problem):
        parse(HEAD + text + TAIL)


def test_idl_needs_its_modules() -> None:
    with pytest.raises(IdlError, match="outside"):
        parse("@final struct X { uint8 a; };")
    with pytest.raises(IdlError, match="unexpected"):
        parse("};")
    with pytest.raises(IdlError, match="found 'end'"):
        parse(HEAD)
