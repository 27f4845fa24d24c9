"""Measure exchanges a second with a gripper on a serial line, and their processor time.

The gripper is emulated in a process of its own, with the time that bytes take at 1 Mbaud, 4 us
return delay and a USB adapter's latency timer of 1 ms. Compared with

- the limit of the line: the latency timer runs freely, so a host that needed no time would get an
  answer at every tick that the line leaves time for (:func:`exchange_period`), and no faster,
- a driver that reads and writes item by item with the SDK's own calls, as one would at first,
- the same exchange on the SDK's own port, for the processor time of its receive loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from dynamixel_sdk import PacketHandler, PortHandler

from benchmarks import Result
from dexkit.drivers.ezgripper import EZGripper, GripperSettings, register_block
from dexkit.drivers.ezgripper.servo import exchange_bytes, line_time
from dexkit.drivers.serial_port import exchange_period
from dexkit.emulators.mx64 import emulated_ezgripper
from dexkit.hand import HandCommand
from dexkit.wire import mx64

_ZERO = 1510
_SECONDS = 3.0
_LATENCY = 1e-3


def _rate(exchange: Callable[[], object]) -> tuple[float, float]:
    """Calls a second, and processor seconds of this thread a second."""
    for _ in range(50):
        exchange()
    count = 0
    used = time.thread_time()
    start = time.perf_counter()
    while time.perf_counter() - start < _SECONDS:
        exchange()
        count += 1
    elapsed = time.perf_counter() - start
    # of the first one the line guarantees a part of its period only: it does not count
    return (count - 1) / elapsed, (time.thread_time() - used) / elapsed


def _open(path: str) -> tuple[PortHandler, PacketHandler]:
    port = PortHandler(path)
    port.openPort()
    port.setBaudRate(1_000_000)
    return port, PacketHandler(2.0)


def _one_call_a_register(path: str) -> tuple[float, float]:
    """Force, position, then each measurement: seven SDK calls, each with its own answer."""
    port, packets = _open(path)
    measured = (
        mx64.PRESENT_POSITION,
        mx64.PRESENT_VELOCITY,
        mx64.PRESENT_CURRENT,
        mx64.PRESENT_INPUT_VOLTAGE,
        mx64.PRESENT_TEMPERATURE,
    )

    def exchange() -> None:
        packets.write2ByteTxRx(port, 1, mx64.GOAL_CURRENT.address, 240)
        packets.write4ByteTxRx(port, 1, mx64.GOAL_POSITION.address, 2760)
        # not read4ByteTxRx: it raises IndexError when a late answer comes to the wrong request
        for item in measured:
            packets.readTxRx(port, 1, item.address, item.size)

    try:
        return _rate(exchange)
    finally:
        port.closePort()


def _sdk_port(path: str) -> tuple[float, float]:
    """The driver's own two packets through the SDK's own port."""
    port, packets = _open(path)
    goal = register_block.encode(register_block.Goal(2760, 240, 100))

    def exchange() -> None:
        packets.syncWriteTxOnly(
            port,
            register_block.WRITE_ADDRESS,
            register_block.WRITE_SIZE,
            [1, *goal],
            1 + register_block.WRITE_SIZE,
        )
        packets.readTxRx(port, 1, register_block.READ_ADDRESS, register_block.READ_SIZE)

    try:
        return _rate(exchange)
    finally:
        port.closePort()


def run() -> list[Result]:
    """Measure; about 10 seconds."""
    busy = line_time(1_000_000)
    limit = 1 / exchange_period(busy, _LATENCY)
    spare = 1 / limit - busy
    with emulated_ezgripper(process=True, latency_timer=_LATENCY) as gripper:
        hand = EZGripper(gripper.path, configuration=GripperSettings(zero=_ZERO, timeout=0.2))
        command = HandCommand.position(2.7)
        with hand:
            rate, cost = _rate(lambda: hand.exchange(command))
            lost = hand.bus_statistics.retries
        naive, _ = _one_call_a_register(gripper.path)
        sdk_rate, sdk_cost = _sdk_port(gripper.path)
    sent, received = exchange_bytes()
    return [
        Result(
            name="exchanges, 1 Mbaud, 1 ms latency timer",
            value=rate,
            unit="1/s",
            peer="limit of the line",
            peer_value=limit,
            ratio=rate / limit,
            target="at least 200 a second",
            met=rate >= 200,
            note=f"{sent} bytes out, {received} back; one tick unless the host needs more than "
            f"{1e6 * spare:.0f} us; {lost} retries",
        ),
        Result(
            name="exchanges, 1 Mbaud, 1 ms latency timer",
            value=rate,
            unit="1/s",
            peer="item by item with the SDK",
            peer_value=naive,
            ratio=rate / naive,
        ),
        Result(
            name="processor time of an exchange",
            value=1e6 * cost / rate,
            unit="us",
            peer="same packets, SDK's port",
            peer_value=1e6 * sdk_cost / sdk_rate,
            ratio=(sdk_cost / sdk_rate) / (cost / rate),
            note=f"one core is used {cost:.0%} here, {sdk_cost:.0%} by the SDK's receive loop",
        ),
    ]
