"""Messages of ``unitree_go``: dataclasses and their CDR codec.

Generated from idl/unitree_go.idl by ``python -m dexkit.messages.generate``; do not edit.
Use the codec through :func:`dexkit.messages.message_type`: it checks the header and the
bounds and turns every failure into a :class:`dexkit.errors.WireError`.
"""

# ruff: noqa: E501, N802
# fmt: off

from __future__ import annotations

from dataclasses import dataclass, field
from struct import Struct

from dexkit.messages.codec import (
    HEADER,
    ArrayLengthError,
    Buffer,
    check_count,
    check_end,
    truncated,
)
from dexkit.messages.layout import MAX_ELEMENTS

# blank objects, filled by plain assignments: faster than calling the constructor
new = object.__new__

__all__ = [
    "MotorCmd_",
    "MotorCmds_",
    "MotorState_",
    "MotorStates_",
]


@dataclass(slots=True)
class MotorCmd_:
    """Command of one motor.

    DDS type ``unitree_go::msg::dds_::MotorCmd_``.
    """

    mode: int = 0  # 0 brake, 1 FOC
    q: float = 0.0  # rad
    dq: float = 0.0  # rad/s
    tau: float = 0.0  # N m
    kp: float = 0.0  # N m/rad
    kd: float = 0.0  # N m s/rad
    reserve: tuple[int, ...] = (0,) * 3


@dataclass(slots=True)
class MotorCmds_:
    """Commands of all motors of one topic.

    DDS type ``unitree_go::msg::dds_::MotorCmds_``.
    """

    cmds: list[MotorCmd_] = field(default_factory=list)


@dataclass(slots=True)
class MotorState_:
    """State of one motor.

    DDS type ``unitree_go::msg::dds_::MotorState_``.
    """

    mode: int = 0  # 0 brake, 1 FOC
    q: float = 0.0  # rad
    dq: float = 0.0  # rad/s
    ddq: float = 0.0  # rad/s^2
    tau_est: float = 0.0  # N m
    q_raw: float = 0.0
    dq_raw: float = 0.0
    ddq_raw: float = 0.0
    temperature: int = 0  # degrees Celsius; keep it at 127 or less (facts/unitree-dex A.7)
    lost: int = 0  # packets lost
    reserve: tuple[int, ...] = (0,) * 2


@dataclass(slots=True)
class MotorStates_:
    """States of all motors of one topic.

    DDS type ``unitree_go::msg::dds_::MotorStates_``.
    """

    states: list[MotorState_] = field(default_factory=list)


_MotorCmd_0 = (Struct("<B3x5f3I"), Struct(">B3x5f3I"))


def encode_MotorCmd_(m: MotorCmd_) -> bytes:
    """Encapsulation header and little-endian data of a MotorCmd_."""
    if len(m.reserve) != 3:
        raise ArrayLengthError
    return HEADER + _MotorCmd_0[0].pack(m.mode, m.q, m.dq, m.tau, m.kp, m.kd, *m.reserve)


def decode_MotorCmd_(data: Buffer, big: bool) -> MotorCmd_:
    """The MotorCmd_ after the encapsulation header of ``data``."""
    if len(data) < 40:
        raise truncated("MotorCmd_", 40, len(data))
    v = _MotorCmd_0[big].unpack_from(data, 4)
    at = 40
    if at != len(data):
        check_end("MotorCmd_", data, at)
    return MotorCmd_(v[0], v[1], v[2], v[3], v[4], v[5], v[6:9])


_MotorCmds_0 = (Struct("<I"), Struct(">I"))
_MotorCmds_cmds = (Struct("<B3x5f3I"), Struct(">B3x5f3I"))


def encode_MotorCmds_(m: MotorCmds_) -> bytes:
    """Encapsulation header and little-endian data of a MotorCmds_."""
    if len(m.cmds) > MAX_ELEMENTS:
        raise ArrayLengthError
    pack = _MotorCmds_cmds[0].pack
    cmds = []
    for e0 in m.cmds:
        if len(e0.reserve) != 3:
            raise ArrayLengthError
        cmds.append(pack(e0.mode, e0.q, e0.dq, e0.tau, e0.kp, e0.kd, *e0.reserve))
    return b"".join((HEADER, _MotorCmds_0[0].pack(len(m.cmds)), *cmds))


def decode_MotorCmds_(data: Buffer, big: bool) -> MotorCmds_:
    """The MotorCmds_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("MotorCmds_", 8, len(data))
    v = _MotorCmds_0[big].unpack_from(data, 4)
    at = 8
    end = at + 36 * v[0]
    if end > len(data) or v[0] > MAX_ELEMENTS:
        check_count("MotorCmds_.cmds", v[0], end, len(data))
    cmds = []
    for x0, x1, x2, x3, x4, x5, x6, x7, x8 in _MotorCmds_cmds[big].iter_unpack(data[at:end]):
        e0 = new(MotorCmd_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.tau = x3
        e0.kp = x4
        e0.kd = x5
        e0.reserve = (x6, x7, x8)
        cmds.append(e0)
    at = end
    if at != len(data):
        check_end("MotorCmds_", data, at)
    return MotorCmds_(cmds)


_MotorState_0 = (Struct("<B3x7fB3x3I"), Struct(">B3x7fB3x3I"))


def encode_MotorState_(m: MotorState_) -> bytes:
    """Encapsulation header and little-endian data of a MotorState_."""
    if len(m.reserve) != 2:
        raise ArrayLengthError
    return HEADER + _MotorState_0[0].pack(m.mode, m.q, m.dq, m.ddq, m.tau_est, m.q_raw, m.dq_raw, m.ddq_raw, m.temperature, m.lost, *m.reserve)


def decode_MotorState_(data: Buffer, big: bool) -> MotorState_:
    """The MotorState_ after the encapsulation header of ``data``."""
    if len(data) < 52:
        raise truncated("MotorState_", 52, len(data))
    v = _MotorState_0[big].unpack_from(data, 4)
    at = 52
    if at != len(data):
        check_end("MotorState_", data, at)
    return MotorState_(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10:12])


_MotorStates_0 = (Struct("<I"), Struct(">I"))
_MotorStates_states = (Struct("<B3x7fB3x3I"), Struct(">B3x7fB3x3I"))


def encode_MotorStates_(m: MotorStates_) -> bytes:
    """Encapsulation header and little-endian data of a MotorStates_."""
    if len(m.states) > MAX_ELEMENTS:
        raise ArrayLengthError
    pack = _MotorStates_states[0].pack
    states = []
    for e0 in m.states:
        if len(e0.reserve) != 2:
            raise ArrayLengthError
        states.append(pack(e0.mode, e0.q, e0.dq, e0.ddq, e0.tau_est, e0.q_raw, e0.dq_raw, e0.ddq_raw, e0.temperature, e0.lost, *e0.reserve))
    return b"".join((HEADER, _MotorStates_0[0].pack(len(m.states)), *states))


def decode_MotorStates_(data: Buffer, big: bool) -> MotorStates_:
    """The MotorStates_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("MotorStates_", 8, len(data))
    v = _MotorStates_0[big].unpack_from(data, 4)
    at = 8
    end = at + 48 * v[0]
    if end > len(data) or v[0] > MAX_ELEMENTS:
        check_count("MotorStates_.states", v[0], end, len(data))
    states = []
    for x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11 in _MotorStates_states[big].iter_unpack(data[at:end]):
        e0 = new(MotorState_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.ddq = x3
        e0.tau_est = x4
        e0.q_raw = x5
        e0.dq_raw = x6
        e0.ddq_raw = x7
        e0.temperature = x8
        e0.lost = x9
        e0.reserve = (x10, x11)
        states.append(e0)
    at = end
    if at != len(data):
        check_end("MotorStates_", data, at)
    return MotorStates_(states)
