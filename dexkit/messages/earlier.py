"""Layouts that Unitree's hand messages had before, under the same type names.

Peers with different layouts either do not match or read each other's values shifted
(docs/sources/unitree-dex.md#a3, docs/sources/sessions.md#d2, docs/ros2.md). Plain CDR does not say
which layout a sample has, but its length fits one of them only.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from dexkit.messages.layout import MAX_ELEMENTS, STRUCTS, Struct

__all__ = ["EARLIER", "Layout", "earlier_by_hash", "layout_of"]


@dataclass(frozen=True)
class Layout:
    """One earlier layout of a type.

    :param when: month of the revision of unitree_sdk2 that introduced it, ``2024-08``.
    :param type_hash: of the complete type, as CycloneDDS 0.10 announces it.
    :param packages: which releases have it.
    """

    when: str
    struct: Struct
    type_hash: str
    packages: str


def _struct(
    type_name: str, names: Sequence[str], inner: Mapping[str, Struct] | None = None
) -> Struct:
    """The present type with these members only, in this order."""
    present = STRUCTS[type_name]
    members = {member.name: member for member in present.fields}
    fields = [
        replace(members[name], type=(inner or {}).get(name, members[name].type)) for name in names
    ]
    return replace(present, fields=tuple(fields))


_HG = "unitree_hg::msg::dds_::"
_SENSOR = {"press_sensor_state": _struct(_HG + "PressSensorState_", ("pressure", "temperature"))}
_FIRST = (
    "unitree_sdk2 before 2024-12-18, unitree_sdk2_python before 2024-10-23, unitree_ros2 before "
    "v0.3.0"
)
_SECOND = "unitree_sdk2 from 2024-12-18 to 2025-02-27"
_BEGIN, _POWER = ("motor_state", "press_sensor_state", "imu_state"), ("power_v", "power_a")

EARLIER: dict[str, tuple[Layout, ...]] = {
    _HG + "HandCmd_": (
        Layout(
            "2024-08",
            _struct(_HG + "HandCmd_", ("motor_cmd",)),
            "99a6748ede49d3451404fb82339a",
            _FIRST,
        ),
    ),
    _HG + "HandState_": (
        Layout(
            "2024-08",
            _struct(
                _HG + "HandState_",
                ("motor_state", "imu_state", "press_sensor_state", *_POWER, "reserve"),
                _SENSOR,
            ),
            "551bcadec7760e989554bd91ed56",
            _FIRST,
        ),
        Layout(
            "2024-12",
            _struct(
                _HG + "HandState_",
                (*_BEGIN, *_POWER, "system_v", "device_v", "error", "reserve"),
                _SENSOR,
            ),
            "7e71e084196c08f02b07f6b26c51",
            _SECOND,
        ),
    ),
}
"""Earlier layouts by DDS name of the type, oldest first."""


def earlier_by_hash(type_name: str, type_hash: str) -> Layout | None:
    """The earlier layout that a peer announces by a hash; None where it is none of them."""
    layouts = EARLIER.get(type_name, ())
    return next((one for one in layouts if type_hash and one.type_hash == type_hash), None)


def layout_of(type_name: str, data: bytes) -> Layout | None:
    """The earlier layout whose length a payload has; None where it has that of none."""
    return next((one for one in EARLIER.get(type_name, ()) if _fits(one.struct, data)), None)


def _fits(kind: Struct, data: bytes) -> bool:
    """Whether a payload ends where this type ends; writers may fill up to a multiple of four."""
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        return False
    body, at = data[4:], 0
    count = struct.Struct("<I" if data[1] else ">I")
    for member in kind.fields:
        if not member.sequence:
            at = Struct((), "", (member,)).end(at)
            continue
        at += -at % 4
        if at + 4 > len(body):
            return False
        elements = count.unpack_from(body, at)[0]
        if elements > MAX_ELEMENTS:
            return False
        assert isinstance(member.type, Struct)
        at += 4 + elements * member.type.end(0)
    return at <= len(body) < at + 4
