"""The Dex3-1's USB structures as data, from which struct formats and offsets are derived.

All structures are little-endian and packed to one byte (the Dex3-1 manual "Introduction to Send and
Receive Structures"; docs/sources/unitree-dex.md#c).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from dexkit.hand import Side
from dexkit.wire.ris import Field, Structure

__all__ = [
    "COMMAND_734",
    "COMMAND_1234",
    "COMMAND_HEAD",
    "COMMAND_LAYOUTS",
    "MANUFACTURER",
    "MOTOR_CMD",
    "MOTOR_STATE",
    "N_BUSES",
    "PRODUCT",
    "PRODUCT_ID",
    "SENSOR_CMD",
    "SENSOR_STATE",
    "STATE",
    "STATE_BUS_SIZE",
    "STATE_HEAD",
    "VENDOR_ID",
    "CommandLayout",
]

# --- identity (docs/sources/unitree-dex.md#c1)
VENDOR_ID = 0x34B7
PRODUCT_ID = {Side.LEFT: 0x1010, Side.RIGHT: 0x1011}
MANUFACTURER = "UnitreeTC"
# the manual shows the left hand's only; the right one's is assumed
PRODUCT = {Side.LEFT: "Dexthree LeftHand", Side.RIGHT: "Dexthree RightHand"}

N_BUSES = 5
"""SUPPORTED_FINGER_NUM of the manual."""

MOTOR_CMD = Structure(
    "MotorCmd_t",
    "Command to one motor",
    b"\xfe\xee",
    (
        Field("head", "u8", 2, "FE EE"),
        Field("mode", "u8", 1, "RIS_Mode_t"),
        # the manual's second listing moves this byte to the end, which would break the words of
        # the CRC (docs/sources/unitree-dex.md#d23)
        Field("res", "u8", 1, "reserved"),
        Field("tor_des", "i16", 1, "torque to add, of the rotor", "1/256 mN·m"),
        Field("spd_des", "i16", 1, "velocity wanted, of the rotor", "100 · 2π/256 rad/s"),
        Field("pos_des", "i32", 1, "position wanted, of the rotor", "2π/32768 rad"),
        Field("k_pos", "i16", 1, "stiffness, of the rotor", "1/1280 mN·m/rad"),
        Field("k_spd", "i16", 1, "damping, of the rotor", "1/1280 mN·m per 100 rad/s"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 16),
)

SENSOR_CMD = Structure(
    "SensorCmd_t",
    "Command to one sensor, assumed",
    b"\x7e\xe7",
    (
        Field("head", "u8", 2, "7E E7"),
        Field("mode", "u8", 1, "bits 0-3 id, bits 4-7 status; 0"),
        Field("reverse", "u8", 13, "reserved; 0"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 16),
)
"""Not in the manual, which gives only the sizes of a reading in which the host addresses sensors:
packets of 20 bytes, three motors and four sensors a bus ("140 // 20*7 3+4"). Head and mode byte are
those of the sensor's answer."""

MOTOR_STATE = Structure(
    "MotorState_t",
    "State of one motor",
    b"\xfc\xee",
    (
        Field("head", "u8", 2, "FC EE"),
        Field("mode", "u8", 1, "RIS_Mode_t; timeout = 1: the protection has tripped"),
        Field("temp", "i8", 1, "temperature of the case", "1 °C"),
        Field("sensor", "u8", 1, "temperature of the winding", "1 °C"),
        Field("vol", "u8", 1, "voltage at the terminals", "0.5 V"),
        Field("torque", "i16", 1, "torque, of the rotor", "1/256 mN·m"),
        Field("speed", "i16", 1, "velocity, of the rotor", "100 · 2π/256 rad/s"),
        Field("pos", "i32", 1, "position, of the rotor", "2π/32768 rad"),
        Field("MError", "u32", 1, "error bits; bit 0 is overcurrent"),
        Field("ExSensor1", "u16", 1, "extended sensor data"),
        Field("ExSensor2", "u16", 1, "extended sensor data"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (2, 22),
)

SENSOR_STATE = Structure(
    "SensorState_t",
    "State of one pressure sensor packet",
    b"\x7e\xe7",
    (
        Field("head", "u8", 2, "7E E7"),
        Field("mode", "u8", 1, "bits 0-3 id, bits 4-7 status"),
        Field("reverse", "u8", 1, "reserved"),
        Field("pressure", "u16", 12, "pressure; 3750 where there is no element", "8 Pa"),
        Field("temperature", "i8", 12, "temperature", "1 °C"),
        Field("CRC32", "u32", 1, "checksum"),
    ),
    (0, 40),
)


@dataclass(frozen=True)
class CommandLayout:
    """The frame to the hand, for one size of its bus buffers.

    :param bus_size: bytes of one bus buffer.
    """

    name: str
    bus_size: int

    @cached_property
    def structure(self) -> Structure:
        """``LinuxToMcuCmd_t``."""
        end = 26 + N_BUSES * self.bus_size + 4
        return Structure(
            "LinuxToMcuCmd_t",
            f"Frame to the hand, {self.name} bytes",
            b"",
            (
                Field("head", "u8", 2, "not given by the manual"),
                Field("mode", "u8", 4, "not explained by the manual; 0"),
                Field("cmd_size", "u32", N_BUSES, "bytes used of each bus buffer"),
                Field("cmd", "u8", N_BUSES * self.bus_size, f"5 buffers of {self.bus_size} bytes"),
                Field("reserve", "u32", 1, "reserved; 0"),
                Field("crc", "u32", 1, "checksum"),
            ),
            (2, end),
        )

    @cached_property
    def size(self) -> int:
        """Bytes of a frame."""
        return self.structure.size

    def bus_offset(self, bus: int) -> int:
        """First byte of a bus buffer in the frame."""
        return self.structure.offsets["cmd"] + bus * self.bus_size


# the Dex3-1 manual: the specification table says 1234 bytes, SUPPORTED_SEND_BUFFER_SIZE says 140 a
# bus (docs/sources/unitree-dex.md#c5, docs/sources/unitree-dex.md#d22)
COMMAND_1234 = CommandLayout("1234", 240)
COMMAND_734 = CommandLayout("734", 140)
COMMAND_LAYOUTS = (COMMAND_1234, COMMAND_734)

COMMAND_HEAD = b"\xfe\xfd"
"""Head of the command frame. The manual does not give it; by analogy: the motors' heads are FE EE
to and FC EE from the motor, the state frame's is FC FD. Outside the CRC."""

STATE_BUS_SIZE = 240
STATE_HEAD = b"\xfc\xfd"

STATE = Structure(
    "McuToLinuxState_t",
    "Frame from the hand",
    STATE_HEAD,
    (
        Field("head", "u8", 2, "FC FD"),
        Field("model", "u8", 1, "mode[0]: model of the hand; its values are not given"),
        Field("timeout", "u8", 1, "mode[1]: time-out protection; its values are not given"),
        Field("fans", "u8", 2, "not explained by the manual"),
        Field("state_size", "u32", N_BUSES, "bytes used of each bus buffer"),
        Field("state", "u8", N_BUSES * STATE_BUS_SIZE, f"5 buffers of {STATE_BUS_SIZE} bytes"),
        Field("pin_v", "u16", 1, "voltage of the supply", "3.3 · 21 / 65536 V"),
        Field("vin_v", "u16", 1, "internal supply voltage", "3.3 · 21 / 65536 V"),
        Field("vm_v", "u16", 1, "voltage of the motors", "3.3 · 21 / 65536 V"),
        Field("pin_a", "u16", 1, "current of the supply", "3.3 · 10 / 65536 A"),
        Field("imu_data", "i16", 6, "acceleration x y z, rotation x y z", "0.01 m/s², rad/s"),
        Field("error", "u32", 1, "error bits of the hand"),
        Field("reserve", "u32", 4, "reserved; 0"),
        Field("crc", "u32", 1, "checksum"),
    ),
    (2, 1266),
)
