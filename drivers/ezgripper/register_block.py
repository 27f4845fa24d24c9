"""Layout of the registers written and read in each exchange: one write and one contiguous read.

The items are scattered over the control table (64, 70, 98, 102, 112 to 120, 126 to 146), so
Indirect Address 1 to 28 map their bytes side by side
(docs/sources/mx64-ezgripper.md#b2)::

    Indirect Data   1..4    5..6    7..10      11    12     13       14..15 16.. ..28
                    profile goal    goal       torque error watchdog tick   present current,
                    speed   current position                                velocity, position,
                    |------ written -------|                                voltage, temperature
                            |--------------------- read ----------------------------------|

- The write (10 bytes, 25 on the line) is a Sync Write, which has no status packet. A status
  packet would take 110 µs on the line and one more period of the USB adapter's latency timer.
- Goal current and goal position are read back in the same block, so the next sample shows a write
  that was lost or refused (bus watchdog tripped). Every sample also has torque, hardware error and
  watchdog.
- At 1 Mbaud: 250 µs write, 140 µs read instruction, 4 µs return delay, 350 µs answer: 744 µs.
  With a latency timer of 1 ms that is 1000 exchanges a second for a host that sends the next one
  within 256 µs, 500 for one that needs up to 1.256 ms (serial_port.exchange_period).

A spanning write of 102..119 would be 18 bytes and would touch Goal Velocity, a read of 102..146
45 bytes, without torque and error (docs/sources/mx64-ezgripper.md#c1).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from dexkit.errors import TruncatedError
from dexkit.wire import mx64

__all__ = [
    "MAPPED",
    "READ_ADDRESS",
    "READ_SIZE",
    "WRITE_ADDRESS",
    "WRITE_SIZE",
    "Goal",
    "Sample",
    "decode",
    "encode",
    "mapping",
]

_WRITTEN = (mx64.PROFILE_VELOCITY, mx64.GOAL_CURRENT, mx64.GOAL_POSITION)
_READ = (
    mx64.GOAL_CURRENT,
    mx64.GOAL_POSITION,
    mx64.TORQUE_ENABLE,
    mx64.HARDWARE_ERROR_STATUS,
    mx64.BUS_WATCHDOG,
    mx64.REALTIME_TICK,
    mx64.PRESENT_CURRENT,
    mx64.PRESENT_VELOCITY,
    mx64.PRESENT_POSITION,
    mx64.PRESENT_INPUT_VOLTAGE,
    mx64.PRESENT_TEMPERATURE,
)
MAPPED = (mx64.PROFILE_VELOCITY, *_READ)
"""The items behind Indirect Data 1 and up, in order."""

_BLOCK = mx64.INDIRECT_BLOCKS[0]
WRITE_ADDRESS = _BLOCK.data
WRITE_SIZE = sum(item.size for item in _WRITTEN)
READ_ADDRESS = _BLOCK.data + mx64.PROFILE_VELOCITY.size
READ_SIZE = sum(item.size for item in _READ)
assert mx64.PROFILE_VELOCITY.size + READ_SIZE <= _BLOCK.count


@dataclass(frozen=True, slots=True)
class Goal:
    """Registers written in one exchange.

    :param position: ticks, in the servo's present multi-turn count.
    :param current: units of 3.36 mA; 0 leaves the fingers limp.
    :param profile_velocity: units of 0.229 rpm; 0 means no limit.
    """

    position: int
    current: int
    profile_velocity: int


@dataclass(frozen=True, slots=True)
class Sample:
    """Registers read in one exchange, in register units; positions in the multi-turn count.

    :param time: monotonic time of the measurement, seconds: the earliest that it can be.
    :param received: monotonic time at which the answer was there, seconds: the latest.
    :param error: bits of :class:`~dexkit.wire.mx64.HardwareError`.
    """

    time: float
    received: float
    goal_current: int
    goal_position: int
    torque: bool
    error: int
    watchdog: int
    tick: int
    current: int
    velocity: int
    position: int
    voltage: int
    temperature: int


def mapping() -> bytes:
    """Return the bytes for Indirect Address 1 and up that map :data:`MAPPED`."""
    return b"".join(
        address.to_bytes(2, "little")
        for item in MAPPED
        for address in range(item.address, item.end)
    )


_CODES = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h"}
_CODES |= {(4, False): "I", (4, True): "i"}


def _layout(items: tuple[mx64.Item, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(_CODES[item.size, item.signed] for item in items))


_WRITE_LAYOUT = _layout(_WRITTEN)
_READ_LAYOUT = _layout(_READ)


def encode(goal: Goal) -> bytes:
    """Return the bytes to write at :data:`WRITE_ADDRESS`."""
    return _WRITE_LAYOUT.pack(goal.profile_velocity, goal.current, goal.position)


def decode(data: bytes, time: float, received: float) -> Sample:
    """Decode the bytes read at :data:`READ_ADDRESS`.

    :param time: and ``received``: bounds of the time of measurement, as in :class:`Sample`.
    :raises TruncatedError: there are not :data:`READ_SIZE` bytes.
    """
    if len(data) != READ_SIZE:
        raise TruncatedError(f"a sample has {READ_SIZE} bytes, not {len(data)}")
    goal_current, goal_position, torque, error, *rest = _READ_LAYOUT.unpack(data)
    error_bits = mx64.HardwareError(error)
    return Sample(time, received, goal_current, goal_position, bool(torque), error_bits, *rest)
