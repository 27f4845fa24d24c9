"""Messages of ``unitree_hg``: dataclasses and their CDR codec.

Generated from idl/unitree_hg.idl by ``python -m tools.generate``; do not edit.
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
    "HandCmd_",
    "HandState_",
    "IMUState_",
    "LowCmd_",
    "LowState_",
    "MotorCmd_",
    "MotorState_",
    "PressSensorState_",
]


@dataclass(slots=True)
class MotorCmd_:
    """Command of one motor.

    DDS type ``unitree_hg::msg::dds_::MotorCmd_``.
    """

    mode: int = 0  # Dex3-1: id | status << 4 | timeout << 7
    q: float = 0.0  # rad
    dq: float = 0.0  # rad/s
    tau: float = 0.0  # N m
    kp: float = 0.0  # N m/rad
    kd: float = 0.0  # N m s/rad
    reserve: int = 0


@dataclass(slots=True)
class HandCmd_:
    """Command of a hand.

    DDS type ``unitree_hg::msg::dds_::HandCmd_``.
    """

    motor_cmd: list[MotorCmd_] = field(default_factory=list)
    reserve: tuple[int, ...] = (0,) * 4


@dataclass(slots=True)
class MotorState_:
    """State of one motor.

    DDS type ``unitree_hg::msg::dds_::MotorState_``.
    """

    mode: int = 0  # Dex3-1: id | status << 4 | timeout << 7
    q: float = 0.0  # rad
    dq: float = 0.0  # rad/s
    ddq: float = 0.0  # rad/s^2
    tau_est: float = 0.0  # N m
    temperature: tuple[int, ...] = (0,) * 2  # degrees Celsius: case, winding
    vol: float = 0.0  # V
    sensor: tuple[int, ...] = (0,) * 2
    motorstate: int = 0  # error bits
    reserve: tuple[int, ...] = (0,) * 4


@dataclass(slots=True)
class PressSensorState_:
    """One pressure sensor of a hand.

    DDS type ``unitree_hg::msg::dds_::PressSensorState_``.
    """

    pressure: tuple[float, ...] = (0.0,) * 12
    temperature: tuple[float, ...] = (0.0,) * 12  # degrees Celsius
    lost: int = 0  # packets lost
    reserve: int = 0


@dataclass(slots=True)
class IMUState_:
    """Inertial unit.

    DDS type ``unitree_hg::msg::dds_::IMUState_``.
    """

    quaternion: tuple[float, ...] = (0.0,) * 4  # w x y z
    gyroscope: tuple[float, ...] = (0.0,) * 3  # rad/s
    accelerometer: tuple[float, ...] = (0.0,) * 3  # m/s^2
    rpy: tuple[float, ...] = (0.0,) * 3  # rad
    temperature: int = 0  # degrees Celsius


@dataclass(slots=True)
class HandState_:
    """State of a hand.

    DDS type ``unitree_hg::msg::dds_::HandState_``.
    """

    motor_state: list[MotorState_] = field(default_factory=list)
    press_sensor_state: list[PressSensorState_] = field(default_factory=list)
    imu_state: IMUState_ = field(default_factory=IMUState_)
    power_v: float = 0.0  # V
    power_a: float = 0.0  # A
    system_v: float = 0.0  # V
    device_v: float = 0.0  # V
    error: tuple[int, ...] = (0,) * 2
    reserve: tuple[int, ...] = (0,) * 2


@dataclass(slots=True)
class LowCmd_:
    """Command of a robot: all motors at once.

    DDS type ``unitree_hg::msg::dds_::LowCmd_``.
    """

    mode_pr: int = 0  # ankles: 0 pitch and roll, 1 motors A and B
    mode_machine: int = 0  # as the state says
    motor_cmd: list[MotorCmd_] = field(default_factory=lambda: [MotorCmd_() for _ in range(35)])
    reserve: tuple[int, ...] = (0,) * 4
    crc: int = 0  # over the C struct (docs/sources/unitree-dex.md#a7)


@dataclass(slots=True)
class LowState_:
    """State of a robot.

    DDS type ``unitree_hg::msg::dds_::LowState_``.
    """

    version: tuple[int, ...] = (0,) * 2
    mode_pr: int = 0  # ankles: 0 pitch and roll, 1 motors A and B
    mode_machine: int = 0  # which machine this is
    tick: int = 0  # ms
    imu_state: IMUState_ = field(default_factory=IMUState_)
    motor_state: list[MotorState_] = field(default_factory=lambda: [MotorState_() for _ in range(35)])
    wireless_remote: tuple[int, ...] = (0,) * 40
    reserve: tuple[int, ...] = (0,) * 4
    crc: int = 0  # over the C struct (docs/sources/unitree-dex.md#a7)


_MotorCmd_0 = (Struct("<B3x5fI"), Struct(">B3x5fI"))


def encode_MotorCmd_(m: MotorCmd_) -> bytes:
    """Encapsulation header and little-endian data of a MotorCmd_."""
    return HEADER + _MotorCmd_0[0].pack(m.mode, m.q, m.dq, m.tau, m.kp, m.kd, m.reserve)


def decode_MotorCmd_(data: Buffer, big: bool) -> MotorCmd_:
    """The MotorCmd_ after the encapsulation header of ``data``."""
    if len(data) < 32:
        raise truncated("MotorCmd_", 32, len(data))
    v = _MotorCmd_0[big].unpack_from(data, 4)
    at = 32
    if at != len(data):
        check_end("MotorCmd_", data, at)
    return MotorCmd_(v[0], v[1], v[2], v[3], v[4], v[5], v[6])


_HandCmd_0 = (Struct("<I"), Struct(">I"))
_HandCmd_motor_cmd = (Struct("<B3x5fI"), Struct(">B3x5fI"))
_HandCmd_1 = (Struct("<4I"), Struct(">4I"))


def encode_HandCmd_(m: HandCmd_) -> bytes:
    """Encapsulation header and little-endian data of a HandCmd_."""
    if len(m.motor_cmd) > MAX_ELEMENTS:
        raise ArrayLengthError
    pack = _HandCmd_motor_cmd[0].pack
    motor_cmd = []
    for e0 in m.motor_cmd:
        motor_cmd.append(pack(e0.mode, e0.q, e0.dq, e0.tau, e0.kp, e0.kd, e0.reserve))
    if len(m.reserve) != 4:
        raise ArrayLengthError
    return b"".join((HEADER, _HandCmd_0[0].pack(len(m.motor_cmd)), *motor_cmd, _HandCmd_1[0].pack(*m.reserve)))


def decode_HandCmd_(data: Buffer, big: bool) -> HandCmd_:
    """The HandCmd_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("HandCmd_", 8, len(data))
    v = _HandCmd_0[big].unpack_from(data, 4)
    at = 8
    end = at + 28 * v[0]
    if end > len(data) or v[0] > MAX_ELEMENTS:
        check_count("HandCmd_.motor_cmd", v[0], end, len(data))
    motor_cmd = []
    for x0, x1, x2, x3, x4, x5, x6 in _HandCmd_motor_cmd[big].iter_unpack(data[at:end]):
        e0 = new(MotorCmd_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.tau = x3
        e0.kp = x4
        e0.kd = x5
        e0.reserve = x6
        motor_cmd.append(e0)
    at = end
    if len(data) < at + 16:
        raise truncated("HandCmd_", at + 16, len(data))
    v = _HandCmd_1[big].unpack_from(data, at)
    at += 16
    if at != len(data):
        check_end("HandCmd_", data, at)
    return HandCmd_(motor_cmd, v[0:4])


_MotorState_0 = (Struct("<B3x4f2hf7I"), Struct(">B3x4f2hf7I"))


def encode_MotorState_(m: MotorState_) -> bytes:
    """Encapsulation header and little-endian data of a MotorState_."""
    if len(m.temperature) != 2 or len(m.sensor) != 2 or len(m.reserve) != 4:
        raise ArrayLengthError
    return HEADER + _MotorState_0[0].pack(m.mode, m.q, m.dq, m.ddq, m.tau_est, *m.temperature, m.vol, *m.sensor, m.motorstate, *m.reserve)


def decode_MotorState_(data: Buffer, big: bool) -> MotorState_:
    """The MotorState_ after the encapsulation header of ``data``."""
    if len(data) < 60:
        raise truncated("MotorState_", 60, len(data))
    v = _MotorState_0[big].unpack_from(data, 4)
    at = 60
    if at != len(data):
        check_end("MotorState_", data, at)
    return MotorState_(v[0], v[1], v[2], v[3], v[4], v[5:7], v[7], v[8:10], v[10], v[11:15])


_PressSensorState_0 = (Struct("<24f2I"), Struct(">24f2I"))


def encode_PressSensorState_(m: PressSensorState_) -> bytes:
    """Encapsulation header and little-endian data of a PressSensorState_."""
    if len(m.pressure) != 12 or len(m.temperature) != 12:
        raise ArrayLengthError
    return HEADER + _PressSensorState_0[0].pack(*m.pressure, *m.temperature, m.lost, m.reserve)


def decode_PressSensorState_(data: Buffer, big: bool) -> PressSensorState_:
    """The PressSensorState_ after the encapsulation header of ``data``."""
    if len(data) < 108:
        raise truncated("PressSensorState_", 108, len(data))
    v = _PressSensorState_0[big].unpack_from(data, 4)
    at = 108
    if at != len(data):
        check_end("PressSensorState_", data, at)
    return PressSensorState_(v[0:12], v[12:24], v[24], v[25])


_IMUState_0 = (Struct("<13fh"), Struct(">13fh"))


def encode_IMUState_(m: IMUState_) -> bytes:
    """Encapsulation header and little-endian data of a IMUState_."""
    if len(m.quaternion) != 4 or len(m.gyroscope) != 3 or len(m.accelerometer) != 3 or len(m.rpy) != 3:
        raise ArrayLengthError
    return HEADER + _IMUState_0[0].pack(*m.quaternion, *m.gyroscope, *m.accelerometer, *m.rpy, m.temperature)


def decode_IMUState_(data: Buffer, big: bool) -> IMUState_:
    """The IMUState_ after the encapsulation header of ``data``."""
    if len(data) < 58:
        raise truncated("IMUState_", 58, len(data))
    v = _IMUState_0[big].unpack_from(data, 4)
    at = 58
    if at != len(data):
        check_end("IMUState_", data, at)
    return IMUState_(v[0:4], v[4:7], v[7:10], v[10:13], v[13])


_HandState_0 = (Struct("<I"), Struct(">I"))
_HandState_motor_state = (Struct("<B3x4f2hf7I"), Struct(">B3x4f2hf7I"))
_HandState_1 = (Struct("<I"), Struct(">I"))
_HandState_press_sensor_state = (Struct("<24f2I"), Struct(">24f2I"))
_HandState_2 = (Struct("<13fh2x4f4I"), Struct(">13fh2x4f4I"))


def encode_HandState_(m: HandState_) -> bytes:
    """Encapsulation header and little-endian data of a HandState_."""
    if len(m.motor_state) > MAX_ELEMENTS:
        raise ArrayLengthError
    pack = _HandState_motor_state[0].pack
    motor_state = []
    for e0 in m.motor_state:
        if len(e0.temperature) != 2 or len(e0.sensor) != 2 or len(e0.reserve) != 4:
            raise ArrayLengthError
        motor_state.append(pack(e0.mode, e0.q, e0.dq, e0.ddq, e0.tau_est, *e0.temperature, e0.vol, *e0.sensor, e0.motorstate, *e0.reserve))
    if len(m.press_sensor_state) > MAX_ELEMENTS:
        raise ArrayLengthError
    pack = _HandState_press_sensor_state[0].pack
    press_sensor_state = []
    for e1 in m.press_sensor_state:
        if len(e1.pressure) != 12 or len(e1.temperature) != 12:
            raise ArrayLengthError
        press_sensor_state.append(pack(*e1.pressure, *e1.temperature, e1.lost, e1.reserve))
    if len(m.imu_state.quaternion) != 4 or len(m.imu_state.gyroscope) != 3 or len(m.imu_state.accelerometer) != 3 or len(m.imu_state.rpy) != 3 or len(m.error) != 2 or len(m.reserve) != 2:
        raise ArrayLengthError
    return b"".join((HEADER, _HandState_0[0].pack(len(m.motor_state)), *motor_state, _HandState_1[0].pack(len(m.press_sensor_state)), *press_sensor_state, _HandState_2[0].pack(*m.imu_state.quaternion, *m.imu_state.gyroscope, *m.imu_state.accelerometer, *m.imu_state.rpy, m.imu_state.temperature, m.power_v, m.power_a, m.system_v, m.device_v, *m.error, *m.reserve)))


def decode_HandState_(data: Buffer, big: bool) -> HandState_:
    """The HandState_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("HandState_", 8, len(data))
    v = _HandState_0[big].unpack_from(data, 4)
    at = 8
    end = at + 56 * v[0]
    if end > len(data) or v[0] > MAX_ELEMENTS:
        check_count("HandState_.motor_state", v[0], end, len(data))
    motor_state = []
    for x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11, x12, x13, x14 in _HandState_motor_state[big].iter_unpack(data[at:end]):
        e0 = new(MotorState_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.ddq = x3
        e0.tau_est = x4
        e0.temperature = (x5, x6)
        e0.vol = x7
        e0.sensor = (x8, x9)
        e0.motorstate = x10
        e0.reserve = (x11, x12, x13, x14)
        motor_state.append(e0)
    at = end
    if len(data) < at + 4:
        raise truncated("HandState_", at + 4, len(data))
    v = _HandState_1[big].unpack_from(data, at)
    at += 4
    end = at + 104 * v[0]
    if end > len(data) or v[0] > MAX_ELEMENTS:
        check_count("HandState_.press_sensor_state", v[0], end, len(data))
    press_sensor_state = []
    for x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11, x12, x13, x14, x15, x16, x17, x18, x19, x20, x21, x22, x23, x24, x25 in _HandState_press_sensor_state[big].iter_unpack(data[at:end]):
        e1 = new(PressSensorState_)
        e1.pressure = (x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11)
        e1.temperature = (x12, x13, x14, x15, x16, x17, x18, x19, x20, x21, x22, x23)
        e1.lost = x24
        e1.reserve = x25
        press_sensor_state.append(e1)
    at = end
    if len(data) < at + 88:
        raise truncated("HandState_", at + 88, len(data))
    v = _HandState_2[big].unpack_from(data, at)
    at += 88
    if at != len(data):
        check_end("HandState_", data, at)
    return HandState_(motor_state, press_sensor_state, IMUState_(v[0:4], v[4:7], v[7:10], v[10:13], v[13]), v[14], v[15], v[16], v[17], v[18:20], v[20:22])


_LowCmd_0 = (Struct("<3Bx5fI"), Struct(">3Bx5fI"))
_LowCmd_motor_cmd = (Struct("<B3x5fI"), Struct(">B3x5fI"))
_LowCmd_1 = (Struct("<5I"), Struct(">5I"))


def encode_LowCmd_(m: LowCmd_) -> bytes:
    """Encapsulation header and little-endian data of a LowCmd_."""
    if len(m.motor_cmd) != 35:
        raise ArrayLengthError
    pack = _LowCmd_motor_cmd[0].pack
    motor_cmd = []
    for e0 in m.motor_cmd[1:]:
        motor_cmd.append(pack(e0.mode, e0.q, e0.dq, e0.tau, e0.kp, e0.kd, e0.reserve))
    if len(m.reserve) != 4:
        raise ArrayLengthError
    return b"".join((HEADER, _LowCmd_0[0].pack(m.mode_pr, m.mode_machine, m.motor_cmd[0].mode, m.motor_cmd[0].q, m.motor_cmd[0].dq, m.motor_cmd[0].tau, m.motor_cmd[0].kp, m.motor_cmd[0].kd, m.motor_cmd[0].reserve), *motor_cmd, _LowCmd_1[0].pack(*m.reserve, m.crc)))


def decode_LowCmd_(data: Buffer, big: bool) -> LowCmd_:
    """The LowCmd_ after the encapsulation header of ``data``."""
    if len(data) < 1004:
        raise truncated("LowCmd_", 1004, len(data))
    v = _LowCmd_0[big].unpack_from(data, 4)
    mode_pr = v[0]
    mode_machine = v[1]
    motor_cmd = [MotorCmd_(v[2], v[3], v[4], v[5], v[6], v[7], v[8])]
    at = 32
    end = at + 952
    for x0, x1, x2, x3, x4, x5, x6 in _LowCmd_motor_cmd[big].iter_unpack(data[at:end]):
        e0 = new(MotorCmd_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.tau = x3
        e0.kp = x4
        e0.kd = x5
        e0.reserve = x6
        motor_cmd.append(e0)
    at = end
    v = _LowCmd_1[big].unpack_from(data, at)
    at += 20
    if at != len(data):
        check_end("LowCmd_", data, at)
    return LowCmd_(mode_pr, mode_machine, motor_cmd, v[0:4], v[4])


_LowState_0 = (Struct("<2I2B2xI13fhBx4f2hf7I"), Struct(">2I2B2xI13fhBx4f2hf7I"))
_LowState_motor_state = (Struct("<B3x4f2hf7I"), Struct(">B3x4f2hf7I"))
_LowState_1 = (Struct("<40B5I"), Struct(">40B5I"))


def encode_LowState_(m: LowState_) -> bytes:
    """Encapsulation header and little-endian data of a LowState_."""
    if len(m.motor_state) != 35:
        raise ArrayLengthError
    if len(m.version) != 2 or len(m.imu_state.quaternion) != 4 or len(m.imu_state.gyroscope) != 3 or len(m.imu_state.accelerometer) != 3 or len(m.imu_state.rpy) != 3 or len(m.motor_state[0].temperature) != 2 or len(m.motor_state[0].sensor) != 2 or len(m.motor_state[0].reserve) != 4:
        raise ArrayLengthError
    pack = _LowState_motor_state[0].pack
    motor_state = []
    for e0 in m.motor_state[1:]:
        if len(e0.temperature) != 2 or len(e0.sensor) != 2 or len(e0.reserve) != 4:
            raise ArrayLengthError
        motor_state.append(pack(e0.mode, e0.q, e0.dq, e0.ddq, e0.tau_est, *e0.temperature, e0.vol, *e0.sensor, e0.motorstate, *e0.reserve))
    if len(m.wireless_remote) != 40 or len(m.reserve) != 4:
        raise ArrayLengthError
    return b"".join((HEADER, _LowState_0[0].pack(*m.version, m.mode_pr, m.mode_machine, m.tick, *m.imu_state.quaternion, *m.imu_state.gyroscope, *m.imu_state.accelerometer, *m.imu_state.rpy, m.imu_state.temperature, m.motor_state[0].mode, m.motor_state[0].q, m.motor_state[0].dq, m.motor_state[0].ddq, m.motor_state[0].tau_est, *m.motor_state[0].temperature, m.motor_state[0].vol, *m.motor_state[0].sensor, m.motor_state[0].motorstate, *m.motor_state[0].reserve), *motor_state, _LowState_1[0].pack(*m.wireless_remote, *m.reserve, m.crc)))


def decode_LowState_(data: Buffer, big: bool) -> LowState_:
    """The LowState_ after the encapsulation header of ``data``."""
    if len(data) < 2092:
        raise truncated("LowState_", 2092, len(data))
    v = _LowState_0[big].unpack_from(data, 4)
    version = v[0:2]
    mode_pr = v[2]
    mode_machine = v[3]
    tick = v[4]
    imu_state = IMUState_(v[5:9], v[9:12], v[12:15], v[15:18], v[18])
    motor_state = [MotorState_(v[19], v[20], v[21], v[22], v[23], v[24:26], v[26], v[27:29], v[29], v[30:34])]
    at = 128
    end = at + 1904
    for x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11, x12, x13, x14 in _LowState_motor_state[big].iter_unpack(data[at:end]):
        e0 = new(MotorState_)
        e0.mode = x0
        e0.q = x1
        e0.dq = x2
        e0.ddq = x3
        e0.tau_est = x4
        e0.temperature = (x5, x6)
        e0.vol = x7
        e0.sensor = (x8, x9)
        e0.motorstate = x10
        e0.reserve = (x11, x12, x13, x14)
        motor_state.append(e0)
    at = end
    v = _LowState_1[big].unpack_from(data, at)
    at += 60
    if at != len(data):
        check_end("LowState_", data, at)
    return LowState_(version, mode_pr, mode_machine, tick, imu_state, motor_state, v[0:40], v[40:44], v[44])
