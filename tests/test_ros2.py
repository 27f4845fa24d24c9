"""Unitree's messages as ROS 2 has them: definitions of unitree_ros2, bytes, earlier layouts."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dexkit.errors import WireError
from dexkit.messages import layout, message_type
from dexkit.messages.earlier import EARLIER, earlier_by_hash, layout_of
from dexkit.messages.layout import Primitive, Struct
from dexkit.messages.schemas import ros2msg
from tests.each import each
from tools import ros2_layouts

V0_3_0 = "6a57b74fdcd57ec59f06077b264c9295404e9f0cbcca8d6615ed04609d65212c"
"""``python -m tools.ros2_layouts unitree_ros2 v0.3.0``, of the tag; master of 2026-06-15 has it,
too."""
SIGNED = {  # int8 there, uint8 in unitree_sdk2: the same bytes
    "unitree_api::msg::dds_::Response_": ("binary",),
    "unitree_go::msg::dds_::MotorState_": ("temperature",),
    "unitree_go::msg::dds_::IMUState_": ("temperature",),
    "unitree_go::msg::dds_::BmsState_": ("bq_ntc", "mcu_ntc"),
    "unitree_go::msg::dds_::LowState_": ("temperature_ntc1", "temperature_ntc2"),
}
OLD = [(name, one) for name, layouts in EARLIER.items() for one in layouts]


def signed(name: str, members: str) -> str:
    """The members of a message as unitree_ros2 has them."""
    lines = []
    for line in members.splitlines():
        kind, member = line.split()
        lines.append(f"{kind.replace('uint8', 'int8')} {member}" if member in SIGNED.get(name, ())
                     else line)  # fmt: skip
    return "".join(f"{line}\n" for line in lines)


def test_messages_are_those_of_unitree_ros2_v0_3_0() -> None:
    own = {
        name: ros2_layouts.own_members(kind)
        for name, kind in layout.ALL.items()
        if not name.startswith("inspire::")  # Inspire's own package
    }
    assert ros2_layouts.digest({n: signed(n, text) for n, text in own.items()}) == V0_3_0


def store_of(kind: Struct) -> Any:
    """A type store of rosbags with this type and those that it needs."""
    store = get_typestore(Stores.EMPTY)
    head, *rest = ros2msg(kind).split("=" * 80 + "\n")
    store.register(get_types_from_msg(head, kind.ros_name))
    for part in rest:
        name, text = part.split("\n", 1)
        store.register(get_types_from_msg(text, name.removeprefix("MSG: ").replace("/", "/msg/")))
    return store


def made(store: Any, kind: Struct, seed: list[int]) -> Any:
    """A message of rosbags with other numbers in every member; sequences have three elements."""

    def value(member: layout.Field) -> Any:
        if isinstance(member.type, Struct):
            inner = member.type
            if member.sequence or member.is_structs:
                return [made(store, inner, seed) for _ in range(member.array or 3)]
            return made(store, inner, seed)
        seed[0] += 1
        primitive: Primitive = member.type
        if member.array is not None or member.sequence:
            count = member.array or min(3, member.bound or 3)
            return np.arange(seed[0], seed[0] + count).astype(primitive.dtype)
        return np.array(seed[0]).astype(primitive.dtype).item()

    return store.types[kind.ros_name](**{m.name: value(m) for m in kind.fields})


@each("kind", list(layout.STRUCTS.values()), ids=lambda kind: kind.name)
def test_bytes_of_a_ros_2_writer_are_ours(kind: Struct) -> None:
    store = store_of(kind)
    theirs = bytes(store.serialize_cdr(made(store, kind, [0]), kind.ros_name))
    ours = message_type(kind.dds_name)
    assert ours.encode(ours.decode(theirs)) == theirs
    assert layout_of(kind.dds_name, theirs) is None


@each(("name", "old"), OLD, ids=lambda name: name)
def test_earlier_layout_is_detected_by_its_length_and_by_its_hash(name: str, old: Any) -> None:
    store = store_of(old.struct)
    data = bytes(store.serialize_cdr(made(store, old.struct, [0]), old.struct.ros_name))
    assert layout_of(name, data) is old
    with pytest.raises(WireError):
        message_type(name).decode(data)
    for wrong in (b"", data[:3], data[:-4], data + bytes(4), b"\0\7" + data[2:], data[:6]):
        assert layout_of(name, wrong) is None
    assert earlier_by_hash(name, old.type_hash) is old
    assert earlier_by_hash(name, "") is None


def test_hashes_of_earlier_layouts_are_those_of_cyclonedds(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10: dexkit setup-dds")
    from dexkit import dds

    for name, old in OLD:
        changed = {kind.dds_name: kind for kind in (*old.struct.depends(), old.struct)}
        with monkeypatch.context() as patched:
            patched.setattr(layout, "ALL", {**layout.ALL, **changed})
            for cached in (dds.cyclone_type, dds.type_hash):
                cached.cache_clear()
            try:
                assert dds.type_hash(name) == old.type_hash
            finally:
                for cached in (dds.cyclone_type, dds.type_hash):
                    cached.cache_clear()


def test_tool_names_the_layouts_of_a_checkout(tmp_path: Path) -> None:
    folder = tmp_path / "cyclonedds_ws" / "src" / "unitree" / "unitree_hg" / "msg"
    folder.mkdir(parents=True)
    (folder / "HandCmd.msg").write_text("# a command\n\nMotorCmd[] motor_cmd\n")
    (folder / "IMUState.msg").write_text("float32[4] quaternion\n")
    (folder / "MotorCmd.msg").write_text(
        ros2_layouts.own_members(layout.ALL["unitree_hg::msg::dds_::MotorCmd_"])
    )
    person = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "messages"]):
        subprocess.run(["git", "-C", tmp_path, *person, *command], check=True)
    found = ros2_layouts.layout_names(ros2_layouts.definitions(tmp_path, "HEAD"))
    hg = "unitree_hg::msg::dds_::"
    assert found[hg + "HandCmd_"] == "2024-08"
    assert found[hg + "IMUState_"] == "other"
    assert found[hg + "MotorCmd_"] == "present"
    assert found[hg + "HandState_"] == "absent"
