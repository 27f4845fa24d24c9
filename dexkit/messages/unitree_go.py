"""Messages of ``unitree_go``: dataclasses and their CDR codec.

Generated from idl/unitree_go.idl by ``python -m tools.generate``; do not edit.
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
    "BmsCmd_",
    "BmsState_",
    "IMUState_",
    "LowCmd_",
    "LowState_",
    "MotorCmd_",
    "MotorCmds_",
    "MotorState_",
    "MotorStates_",
    "WirelessController_",
]


@dataclass(slots=True)
class MotorCmd_:
    """Command of one motor.

    DDS type ``unitree_go::msg::dds_::MotorCmd_``.
    """

    mode: int = 0  # gripper: 0 brake, 1 FOC; robot: 1 or 10 by motor
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
    temperature: int = 0  # degrees Celsius; keep it at 127 or less (docs/sources/unitree-dex.md#a7)
    lost: int = 0  # packets lost
    reserve: tuple[int, ...] = (0,) * 2


@dataclass(slots=True)
class MotorStates_:
    """States of all motors of one topic.

    DDS type ``unitree_go::msg::dds_::MotorStates_``.
    """

    states: list[MotorState_] = field(default_factory=list)


@dataclass(slots=True)
class IMUState_:
    """Inertial unit.

    DDS type ``unitree_go::msg::dds_::IMUState_``.
    """

    quaternion: tuple[float, ...] = (0.0,) * 4  # w x y z
    gyroscope: tuple[float, ...] = (0.0,) * 3  # rad/s
    accelerometer: tuple[float, ...] = (0.0,) * 3  # m/s^2
    rpy: tuple[float, ...] = (0.0,) * 3  # rad
    temperature: int = 0  # degrees Celsius; keep it at 127 or less (docs/sources/unitree-dex.md#a7)


@dataclass(slots=True)
class BmsCmd_:
    """Command of the battery.

    DDS type ``unitree_go::msg::dds_::BmsCmd_``.
    """

    off: int = 0
    reserve: tuple[int, ...] = (0,) * 3


@dataclass(slots=True)
class BmsState_:
    """State of the battery.

    DDS type ``unitree_go::msg::dds_::BmsState_``.
    """

    version_high: int = 0
    version_low: int = 0
    status: int = 0
    soc: int = 0  # percent
    current: int = 0  # mA
    cycle: int = 0
    bq_ntc: tuple[int, ...] = (0,) * 2  # degrees Celsius; keep them at 127 or less
    mcu_ntc: tuple[int, ...] = (0,) * 2  # degrees Celsius; keep them at 127 or less
    cell_vol: tuple[int, ...] = (0,) * 15  # mV


@dataclass(slots=True)
class LowCmd_:
    """Command of a robot: all motors at once.

    DDS type ``unitree_go::msg::dds_::LowCmd_``.
    """

    head: tuple[int, ...] = (0,) * 2  # FE EF
    level_flag: int = 0  # FF: low level
    frame_reserve: int = 0
    sn: tuple[int, ...] = (0,) * 2
    version: tuple[int, ...] = (0,) * 2
    bandwidth: int = 0
    motor_cmd: list[MotorCmd_] = field(default_factory=lambda: [MotorCmd_() for _ in range(20)])
    bms_cmd: BmsCmd_ = field(default_factory=BmsCmd_)
    wireless_remote: tuple[int, ...] = (0,) * 40
    led: tuple[int, ...] = (0,) * 12
    fan: tuple[int, ...] = (0,) * 2
    gpio: int = 0
    reserve: int = 0
    crc: int = 0  # over the C struct (docs/sources/unitree-dex.md#a7)


@dataclass(slots=True)
class LowState_:
    """State of a robot.

    DDS type ``unitree_go::msg::dds_::LowState_``.
    """

    head: tuple[int, ...] = (0,) * 2  # FE EF
    level_flag: int = 0  # FF: low level
    frame_reserve: int = 0
    sn: tuple[int, ...] = (0,) * 2
    version: tuple[int, ...] = (0,) * 2
    bandwidth: int = 0
    imu_state: IMUState_ = field(default_factory=IMUState_)
    motor_state: list[MotorState_] = field(default_factory=lambda: [MotorState_() for _ in range(20)])
    bms_state: BmsState_ = field(default_factory=BmsState_)
    foot_force: tuple[int, ...] = (0,) * 4
    foot_force_est: tuple[int, ...] = (0,) * 4
    tick: int = 0  # ms
    wireless_remote: tuple[int, ...] = (0,) * 40
    bit_flag: int = 0
    adc_reel: float = 0.0
    temperature_ntc1: int = 0  # degrees Celsius; keep it at 127 or less
    temperature_ntc2: int = 0  # degrees Celsius; keep it at 127 or less
    power_v: float = 0.0  # V
    power_a: float = 0.0  # A
    fan_frequency: tuple[int, ...] = (0,) * 4
    reserve: int = 0
    crc: int = 0  # over the C struct (docs/sources/unitree-dex.md#a7)


@dataclass(slots=True)
class WirelessController_:
    """The wireless remote (unitree_sdk2 idl/go2/WirelessController_.hpp).

    DDS type ``unitree_go::msg::dds_::WirelessController_``.
    """

    lx: float = 0.0  # sticks, -1 to 1
    ly: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    keys: int = 0  # R1 L1 start select R2 L2 F1 F2 A B X Y up right down left, from bit 0


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


_IMUState_0 = (Struct("<13fB"), Struct(">13fB"))


def encode_IMUState_(m: IMUState_) -> bytes:
    """Encapsulation header and little-endian data of a IMUState_."""
    if len(m.quaternion) != 4 or len(m.gyroscope) != 3 or len(m.accelerometer) != 3 or len(m.rpy) != 3:
        raise ArrayLengthError
    return HEADER + _IMUState_0[0].pack(*m.quaternion, *m.gyroscope, *m.accelerometer, *m.rpy, m.temperature)


def decode_IMUState_(data: Buffer, big: bool) -> IMUState_:
    """The IMUState_ after the encapsulation header of ``data``."""
    if len(data) < 57:
        raise truncated("IMUState_", 57, len(data))
    v = _IMUState_0[big].unpack_from(data, 4)
    at = 57
    if at != len(data):
        check_end("IMUState_", data, at)
    return IMUState_(v[0:4], v[4:7], v[7:10], v[10:13], v[13])


_BmsCmd_0 = (Struct("<4B"), Struct(">4B"))


def encode_BmsCmd_(m: BmsCmd_) -> bytes:
    """Encapsulation header and little-endian data of a BmsCmd_."""
    if len(m.reserve) != 3:
        raise ArrayLengthError
    return HEADER + _BmsCmd_0[0].pack(m.off, *m.reserve)


def decode_BmsCmd_(data: Buffer, big: bool) -> BmsCmd_:
    """The BmsCmd_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("BmsCmd_", 8, len(data))
    v = _BmsCmd_0[big].unpack_from(data, 4)
    at = 8
    if at != len(data):
        check_end("BmsCmd_", data, at)
    return BmsCmd_(v[0], v[1:4])


_BmsState_0 = (Struct("<4BiH4B15H"), Struct(">4BiH4B15H"))


def encode_BmsState_(m: BmsState_) -> bytes:
    """Encapsulation header and little-endian data of a BmsState_."""
    if len(m.bq_ntc) != 2 or len(m.mcu_ntc) != 2 or len(m.cell_vol) != 15:
        raise ArrayLengthError
    return HEADER + _BmsState_0[0].pack(m.version_high, m.version_low, m.status, m.soc, m.current, m.cycle, *m.bq_ntc, *m.mcu_ntc, *m.cell_vol)


def decode_BmsState_(data: Buffer, big: bool) -> BmsState_:
    """The BmsState_ after the encapsulation header of ``data``."""
    if len(data) < 48:
        raise truncated("BmsState_", 48, len(data))
    v = _BmsState_0[big].unpack_from(data, 4)
    at = 48
    if at != len(data):
        check_end("BmsState_", data, at)
    return BmsState_(v[0], v[1], v[2], v[3], v[4], v[5], v[6:8], v[8:10], v[10:25])


_LowCmd_0 = (Struct("<4B4IHBx5f3I"), Struct(">4B4IHBx5f3I"))
_LowCmd_motor_cmd = (Struct("<B3x5f3I"), Struct(">B3x5f3I"))
_LowCmd_1 = (Struct("<59Bx2I"), Struct(">59Bx2I"))


def encode_LowCmd_(m: LowCmd_) -> bytes:
    """Encapsulation header and little-endian data of a LowCmd_."""
    if len(m.motor_cmd) != 20:
        raise ArrayLengthError
    if len(m.head) != 2 or len(m.sn) != 2 or len(m.version) != 2 or len(m.motor_cmd[0].reserve) != 3:
        raise ArrayLengthError
    pack = _LowCmd_motor_cmd[0].pack
    motor_cmd = []
    for e0 in m.motor_cmd[1:]:
        if len(e0.reserve) != 3:
            raise ArrayLengthError
        motor_cmd.append(pack(e0.mode, e0.q, e0.dq, e0.tau, e0.kp, e0.kd, *e0.reserve))
    if len(m.bms_cmd.reserve) != 3 or len(m.wireless_remote) != 40 or len(m.led) != 12 or len(m.fan) != 2:
        raise ArrayLengthError
    return b"".join((HEADER, _LowCmd_0[0].pack(*m.head, m.level_flag, m.frame_reserve, *m.sn, *m.version, m.bandwidth, m.motor_cmd[0].mode, m.motor_cmd[0].q, m.motor_cmd[0].dq, m.motor_cmd[0].tau, m.motor_cmd[0].kp, m.motor_cmd[0].kd, *m.motor_cmd[0].reserve), *motor_cmd, _LowCmd_1[0].pack(m.bms_cmd.off, *m.bms_cmd.reserve, *m.wireless_remote, *m.led, *m.fan, m.gpio, m.reserve, m.crc)))


def decode_LowCmd_(data: Buffer, big: bool) -> LowCmd_:
    """The LowCmd_ after the encapsulation header of ``data``."""
    if len(data) < 812:
        raise truncated("LowCmd_", 812, len(data))
    v = _LowCmd_0[big].unpack_from(data, 4)
    head = v[0:2]
    level_flag = v[2]
    frame_reserve = v[3]
    sn = v[4:6]
    version = v[6:8]
    bandwidth = v[8]
    motor_cmd = [MotorCmd_(v[9], v[10], v[11], v[12], v[13], v[14], v[15:18])]
    at = 60
    end = at + 684
    for x0, x1, x2, x3, x4, x5, x6, x7, x8 in _LowCmd_motor_cmd[big].iter_unpack(data[at:end]):
        e0 = new(MotorCmd_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.tau = x3
        e0.kp = x4
        e0.kd = x5
        e0.reserve = (x6, x7, x8)
        motor_cmd.append(e0)
    at = end
    v = _LowCmd_1[big].unpack_from(data, at)
    at += 68
    if at != len(data):
        check_end("LowCmd_", data, at)
    return LowCmd_(head, level_flag, frame_reserve, sn, version, bandwidth, motor_cmd, BmsCmd_(v[0], v[1:4]), v[4:44], v[44:56], v[56:58], v[58], v[59], v[60])


_LowState_0 = (Struct("<4B4IH2x13f2B2x7fB3x3I"), Struct(">4B4IH2x13f2B2x7fB3x3I"))
_LowState_motor_state = (Struct("<B3x7fB3x3I"), Struct(">B3x7fB3x3I"))
_LowState_1 = (Struct("<4BiH4B15H8hI41B3xf2B2x2f4H2I"), Struct(">4BiH4B15H8hI41B3xf2B2x2f4H2I"))


def encode_LowState_(m: LowState_) -> bytes:
    """Encapsulation header and little-endian data of a LowState_."""
    if len(m.motor_state) != 20:
        raise ArrayLengthError
    if len(m.head) != 2 or len(m.sn) != 2 or len(m.version) != 2 or len(m.imu_state.quaternion) != 4 or len(m.imu_state.gyroscope) != 3 or len(m.imu_state.accelerometer) != 3 or len(m.imu_state.rpy) != 3 or len(m.motor_state[0].reserve) != 2:
        raise ArrayLengthError
    pack = _LowState_motor_state[0].pack
    motor_state = []
    for e0 in m.motor_state[1:]:
        if len(e0.reserve) != 2:
            raise ArrayLengthError
        motor_state.append(pack(e0.mode, e0.q, e0.dq, e0.ddq, e0.tau_est, e0.q_raw, e0.dq_raw, e0.ddq_raw, e0.temperature, e0.lost, *e0.reserve))
    if len(m.bms_state.bq_ntc) != 2 or len(m.bms_state.mcu_ntc) != 2 or len(m.bms_state.cell_vol) != 15 or len(m.foot_force) != 4 or len(m.foot_force_est) != 4 or len(m.wireless_remote) != 40 or len(m.fan_frequency) != 4:
        raise ArrayLengthError
    return b"".join((HEADER, _LowState_0[0].pack(*m.head, m.level_flag, m.frame_reserve, *m.sn, *m.version, m.bandwidth, *m.imu_state.quaternion, *m.imu_state.gyroscope, *m.imu_state.accelerometer, *m.imu_state.rpy, m.imu_state.temperature, m.motor_state[0].mode, m.motor_state[0].q, m.motor_state[0].dq, m.motor_state[0].ddq, m.motor_state[0].tau_est, m.motor_state[0].q_raw, m.motor_state[0].dq_raw, m.motor_state[0].ddq_raw, m.motor_state[0].temperature, m.motor_state[0].lost, *m.motor_state[0].reserve), *motor_state, _LowState_1[0].pack(m.bms_state.version_high, m.bms_state.version_low, m.bms_state.status, m.bms_state.soc, m.bms_state.current, m.bms_state.cycle, *m.bms_state.bq_ntc, *m.bms_state.mcu_ntc, *m.bms_state.cell_vol, *m.foot_force, *m.foot_force_est, m.tick, *m.wireless_remote, m.bit_flag, m.adc_reel, m.temperature_ntc1, m.temperature_ntc2, m.power_v, m.power_a, *m.fan_frequency, m.reserve, m.crc)))


def decode_LowState_(data: Buffer, big: bool) -> LowState_:
    """The LowState_ after the encapsulation header of ``data``."""
    if len(data) < 1180:
        raise truncated("LowState_", 1180, len(data))
    v = _LowState_0[big].unpack_from(data, 4)
    head = v[0:2]
    level_flag = v[2]
    frame_reserve = v[3]
    sn = v[4:6]
    version = v[6:8]
    bandwidth = v[8]
    imu_state = IMUState_(v[9:13], v[13:16], v[16:19], v[19:22], v[22])
    motor_state = [MotorState_(v[23], v[24], v[25], v[26], v[27], v[28], v[29], v[30], v[31], v[32], v[33:35])]
    at = 128
    end = at + 912
    for x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11 in _LowState_motor_state[big].iter_unpack(data[at:end]):
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
        motor_state.append(e0)
    at = end
    v = _LowState_1[big].unpack_from(data, at)
    at += 140
    if at != len(data):
        check_end("LowState_", data, at)
    return LowState_(head, level_flag, frame_reserve, sn, version, bandwidth, imu_state, motor_state, BmsState_(v[0], v[1], v[2], v[3], v[4], v[5], v[6:8], v[8:10], v[10:25]), v[25:29], v[29:33], v[33], v[34:74], v[74], v[75], v[76], v[77], v[78], v[79], v[80:84], v[84], v[85])


_WirelessController_0 = (Struct("<4fH"), Struct(">4fH"))


def encode_WirelessController_(m: WirelessController_) -> bytes:
    """Encapsulation header and little-endian data of a WirelessController_."""
    return HEADER + _WirelessController_0[0].pack(m.lx, m.ly, m.rx, m.ry, m.keys)


def decode_WirelessController_(data: Buffer, big: bool) -> WirelessController_:
    """The WirelessController_ after the encapsulation header of ``data``."""
    if len(data) < 22:
        raise truncated("WirelessController_", 22, len(data))
    v = _WirelessController_0[big].unpack_from(data, 4)
    at = 22
    if at != len(data):
        check_end("WirelessController_", data, at)
    return WirelessController_(v[0], v[1], v[2], v[3], v[4])
