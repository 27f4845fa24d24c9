"""Messages of ``inspire``: dataclasses and their CDR codec.

Generated from idl/inspire.idl by ``python -m tools.generate``; do not edit.
Use the codec through :func:`dexkit.messages.message_type`: it checks the header and the
bounds and turns every failure into a :class:`dexkit.errors.WireError`.
"""

# ruff: noqa: E501
# fmt: off

from __future__ import annotations

from dataclasses import dataclass, field
from struct import Struct

from dexkit.messages.codec import (
    HEADER,
    Buffer,
    check_end,
    pack_numbers,
    take_numbers,
    truncated,
)

__all__ = [
    "inspire_hand_ctrl",
    "inspire_hand_state",
    "inspire_hand_touch",
]


@dataclass(slots=True)
class inspire_hand_ctrl:
    """Command: the bits of mode say which of the members count.

    DDS type ``inspire::inspire_hand_ctrl``.
    """

    pos_set: list[int] = field(default_factory=list)  # actuator, 0 to 2000
    angle_set: list[int] = field(default_factory=list)  # 0 closed to 1000 open; -1 leaves the joint alone
    force_set: list[int] = field(default_factory=list)  # limit, 0 to 1000
    speed_set: list[int] = field(default_factory=list)  # 0 to 1000
    mode: int = 0  # bits: 1 angle, 2 position, 4 force, 8 speed


@dataclass(slots=True)
class inspire_hand_state:
    """State of a hand.

    DDS type ``inspire::inspire_hand_state``.
    """

    pos_act: list[int] = field(default_factory=list)  # actuator, 0 to 2000
    angle_act: list[int] = field(default_factory=list)  # 0 closed to 1000 open
    force_act: list[int] = field(default_factory=list)
    current: list[int] = field(default_factory=list)  # mA
    err: list[int] = field(default_factory=list)  # bits: locked rotor, temperature, current, motor, communication
    status: list[int] = field(default_factory=list)
    temperature: list[int] = field(default_factory=list)  # degrees Celsius


@dataclass(slots=True)
class inspire_hand_touch:
    """Tactile areas of a hand; fingerone is the pinky, fingerfive the thumb.

    DDS type ``inspire::inspire_hand_touch``.
    """

    fingerone_tip_touch: list[int] = field(default_factory=list)
    fingerone_top_touch: list[int] = field(default_factory=list)
    fingerone_palm_touch: list[int] = field(default_factory=list)
    fingertwo_tip_touch: list[int] = field(default_factory=list)
    fingertwo_top_touch: list[int] = field(default_factory=list)
    fingertwo_palm_touch: list[int] = field(default_factory=list)
    fingerthree_tip_touch: list[int] = field(default_factory=list)
    fingerthree_top_touch: list[int] = field(default_factory=list)
    fingerthree_palm_touch: list[int] = field(default_factory=list)
    fingerfour_tip_touch: list[int] = field(default_factory=list)
    fingerfour_top_touch: list[int] = field(default_factory=list)
    fingerfour_palm_touch: list[int] = field(default_factory=list)
    fingerfive_tip_touch: list[int] = field(default_factory=list)
    fingerfive_top_touch: list[int] = field(default_factory=list)
    fingerfive_middle_touch: list[int] = field(default_factory=list)
    fingerfive_palm_touch: list[int] = field(default_factory=list)
    palm_touch: list[int] = field(default_factory=list)


_inspire_hand_ctrl_4 = (Struct("<b"), Struct(">b"))


def encode_inspire_hand_ctrl(m: inspire_hand_ctrl) -> bytes:
    """Encapsulation header and little-endian data of a inspire_hand_ctrl."""
    out = bytearray(HEADER)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.pos_set, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.angle_set, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.force_set, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.speed_set, 6)
    out += _inspire_hand_ctrl_4[0].pack(m.mode)
    return bytes(out)


def decode_inspire_hand_ctrl(data: Buffer, big: bool) -> inspire_hand_ctrl:
    """The inspire_hand_ctrl after the encapsulation header of ``data``."""
    at = 4
    x_pos_set, at = take_numbers("inspire_hand_ctrl.pos_set", "h", 6, data, at, big)
    x_angle_set, at = take_numbers("inspire_hand_ctrl.angle_set", "h", 6, data, at, big)
    x_force_set, at = take_numbers("inspire_hand_ctrl.force_set", "h", 6, data, at, big)
    x_speed_set, at = take_numbers("inspire_hand_ctrl.speed_set", "h", 6, data, at, big)
    if len(data) < at + 1:
        raise truncated("inspire_hand_ctrl", at + 1, len(data))
    x_mode = _inspire_hand_ctrl_4[big].unpack_from(data, at)[0]
    at += 1
    if at != len(data):
        check_end("inspire_hand_ctrl", data, at)
    return inspire_hand_ctrl(x_pos_set, x_angle_set, x_force_set, x_speed_set, x_mode)


def encode_inspire_hand_state(m: inspire_hand_state) -> bytes:
    """Encapsulation header and little-endian data of a inspire_hand_state."""
    out = bytearray(HEADER)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.pos_act, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.angle_act, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.force_act, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.current, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("B", m.err, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("B", m.status, 6)
    out += bytes(-len(out) % 4)
    out += pack_numbers("B", m.temperature, 6)
    return bytes(out)


def decode_inspire_hand_state(data: Buffer, big: bool) -> inspire_hand_state:
    """The inspire_hand_state after the encapsulation header of ``data``."""
    at = 4
    x_pos_act, at = take_numbers("inspire_hand_state.pos_act", "h", 6, data, at, big)
    x_angle_act, at = take_numbers("inspire_hand_state.angle_act", "h", 6, data, at, big)
    x_force_act, at = take_numbers("inspire_hand_state.force_act", "h", 6, data, at, big)
    x_current, at = take_numbers("inspire_hand_state.current", "h", 6, data, at, big)
    x_err, at = take_numbers("inspire_hand_state.err", "B", 6, data, at, big)
    x_status, at = take_numbers("inspire_hand_state.status", "B", 6, data, at, big)
    x_temperature, at = take_numbers("inspire_hand_state.temperature", "B", 6, data, at, big)
    if at != len(data):
        check_end("inspire_hand_state", data, at)
    return inspire_hand_state(x_pos_act, x_angle_act, x_force_act, x_current, x_err, x_status, x_temperature)


def encode_inspire_hand_touch(m: inspire_hand_touch) -> bytes:
    """Encapsulation header and little-endian data of a inspire_hand_touch."""
    out = bytearray(HEADER)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerone_tip_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerone_top_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerone_palm_touch, 80)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingertwo_tip_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingertwo_top_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingertwo_palm_touch, 80)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerthree_tip_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerthree_top_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerthree_palm_touch, 80)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfour_tip_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfour_top_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfour_palm_touch, 80)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfive_tip_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfive_top_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfive_middle_touch, 9)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.fingerfive_palm_touch, 96)
    out += bytes(-len(out) % 4)
    out += pack_numbers("h", m.palm_touch, 112)
    return bytes(out)


def decode_inspire_hand_touch(data: Buffer, big: bool) -> inspire_hand_touch:
    """The inspire_hand_touch after the encapsulation header of ``data``."""
    at = 4
    x_fingerone_tip_touch, at = take_numbers("inspire_hand_touch.fingerone_tip_touch", "h", 9, data, at, big)
    x_fingerone_top_touch, at = take_numbers("inspire_hand_touch.fingerone_top_touch", "h", 96, data, at, big)
    x_fingerone_palm_touch, at = take_numbers("inspire_hand_touch.fingerone_palm_touch", "h", 80, data, at, big)
    x_fingertwo_tip_touch, at = take_numbers("inspire_hand_touch.fingertwo_tip_touch", "h", 9, data, at, big)
    x_fingertwo_top_touch, at = take_numbers("inspire_hand_touch.fingertwo_top_touch", "h", 96, data, at, big)
    x_fingertwo_palm_touch, at = take_numbers("inspire_hand_touch.fingertwo_palm_touch", "h", 80, data, at, big)
    x_fingerthree_tip_touch, at = take_numbers("inspire_hand_touch.fingerthree_tip_touch", "h", 9, data, at, big)
    x_fingerthree_top_touch, at = take_numbers("inspire_hand_touch.fingerthree_top_touch", "h", 96, data, at, big)
    x_fingerthree_palm_touch, at = take_numbers("inspire_hand_touch.fingerthree_palm_touch", "h", 80, data, at, big)
    x_fingerfour_tip_touch, at = take_numbers("inspire_hand_touch.fingerfour_tip_touch", "h", 9, data, at, big)
    x_fingerfour_top_touch, at = take_numbers("inspire_hand_touch.fingerfour_top_touch", "h", 96, data, at, big)
    x_fingerfour_palm_touch, at = take_numbers("inspire_hand_touch.fingerfour_palm_touch", "h", 80, data, at, big)
    x_fingerfive_tip_touch, at = take_numbers("inspire_hand_touch.fingerfive_tip_touch", "h", 9, data, at, big)
    x_fingerfive_top_touch, at = take_numbers("inspire_hand_touch.fingerfive_top_touch", "h", 96, data, at, big)
    x_fingerfive_middle_touch, at = take_numbers("inspire_hand_touch.fingerfive_middle_touch", "h", 9, data, at, big)
    x_fingerfive_palm_touch, at = take_numbers("inspire_hand_touch.fingerfive_palm_touch", "h", 96, data, at, big)
    x_palm_touch, at = take_numbers("inspire_hand_touch.palm_touch", "h", 112, data, at, big)
    if at != len(data):
        check_end("inspire_hand_touch", data, at)
    return inspire_hand_touch(x_fingerone_tip_touch, x_fingerone_top_touch, x_fingerone_palm_touch, x_fingertwo_tip_touch, x_fingertwo_top_touch, x_fingertwo_palm_touch, x_fingerthree_tip_touch, x_fingerthree_top_touch, x_fingerthree_palm_touch, x_fingerfour_tip_touch, x_fingerfour_top_touch, x_fingerfour_palm_touch, x_fingerfive_tip_touch, x_fingerfive_top_touch, x_fingerfive_middle_touch, x_fingerfive_palm_touch, x_palm_touch)
