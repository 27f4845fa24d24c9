"""The Dex3-1's USB protocol, sans-IO (the Dex3-1 manual; docs/sources/unitree-dex.md#c;
docs/dex3-protocol.md).

- :mod:`.layout`: every structure as data, and the identity of the device;
- :mod:`.packets`: packets, bus buffers and frames as raw integers;
- :mod:`.units`: between those integers and SI units;
- :mod:`.codec`: :class:`HandCodec`, both at once for a whole hand, fast.
"""

from dexkit.wire.dex3_usb.codec import DEFAULT_BUS_MAP, BusMap, DecodedCommand, HandCodec
from dexkit.wire.dex3_usb.layout import (
    COMMAND_734,
    COMMAND_1234,
    COMMAND_HEAD,
    COMMAND_LAYOUTS,
    MANUFACTURER,
    MOTOR_CMD,
    MOTOR_STATE,
    N_BUSES,
    PRODUCT,
    PRODUCT_ID,
    SENSOR_CMD,
    SENSOR_STATE,
    STATE,
    STATE_BUS_SIZE,
    STATE_HEAD,
    VENDOR_ID,
    CommandLayout,
)
from dexkit.wire.dex3_usb.packets import (
    FROM_HAND,
    TO_HAND,
    CommandFrame,
    MotorCmd,
    MotorState,
    Problem,
    SensorCmd,
    SensorState,
    StateFrame,
    pack_command,
    pack_state,
    parse_bus,
    parse_command,
    parse_state,
    scan_bus,
)
from dexkit.wire.dex3_usb.units import NO_VALUE, SCALES, Scale
from dexkit.wire.mounting import Mounting
from dexkit.wire.ris import BROADCAST_ID, RIS_MODE, ris_mode

__all__ = [
    "BROADCAST_ID",
    "COMMAND_734",
    "COMMAND_1234",
    "COMMAND_HEAD",
    "COMMAND_LAYOUTS",
    "DEFAULT_BUS_MAP",
    "FROM_HAND",
    "MANUFACTURER",
    "MOTOR_CMD",
    "MOTOR_STATE",
    "NO_VALUE",
    "N_BUSES",
    "PRODUCT",
    "PRODUCT_ID",
    "RIS_MODE",
    "SCALES",
    "SENSOR_CMD",
    "SENSOR_STATE",
    "STATE",
    "STATE_BUS_SIZE",
    "STATE_HEAD",
    "TO_HAND",
    "VENDOR_ID",
    "BusMap",
    "CommandFrame",
    "CommandLayout",
    "DecodedCommand",
    "HandCodec",
    "MotorCmd",
    "MotorState",
    "Mounting",
    "Problem",
    "Scale",
    "SensorCmd",
    "SensorState",
    "StateFrame",
    "pack_command",
    "pack_state",
    "parse_bus",
    "parse_command",
    "parse_state",
    "ris_mode",
    "scan_bus",
]
