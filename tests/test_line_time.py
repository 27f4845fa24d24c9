"""Time on an emulated serial line, in virtual time, against the formula of the drivers."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.clock import ManualClock, Rate
from dexkit.drivers.ezgripper import EZGripper, GripperSettings, gripper, register_block
from dexkit.drivers.ezgripper.servo import exchange_bytes, line_time
from dexkit.drivers.serial_port import exchange_period
from dexkit.emulators.mx64 import Bus, Firmware
from dexkit.hand import Side
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import Instruction
from tests.each import each
from tests.mx64_helpers import servo, write

BAUD_RATES = sorted(mx64.BAUD_RATES.values())
TIMERS = (0.0, 1e-3, 16e-3)
ENOUGH = 1e-9  # seconds of rounding


def _number(value: int, size: int = 2) -> bytes:
    return value.to_bytes(size, "little")


def _exchange() -> bytes:
    """The two packets of the driver's exchange, as bytes."""
    goal = register_block.encode(
        register_block.Goal(position=2000, current=100, profile_velocity=100)
    )
    write_one = _number(register_block.WRITE_ADDRESS) + _number(len(goal)) + b"\x01" + goal
    read_one = _number(register_block.READ_ADDRESS) + _number(register_block.READ_SIZE)
    return dxl.encode(dxl.BROADCAST_ID, Instruction.SYNC_WRITE, write_one) + dxl.encode(
        1, Instruction.READ, read_one
    )


EXCHANGE = _exchange()


class Line:
    """An emulated servo and its adapter, and a host that knows nothing but what it receives."""

    def __init__(self, baudrate: int, timer: float, delay: int) -> None:
        target = servo(baudrate=baudrate, firmware=Firmware(read_across_gaps=True))
        write(target, mx64.RETURN_DELAY_TIME, delay)
        self.bus = Bus([target], latency_timer=timer)
        self.bus.host_baudrate = baudrate

    def pieces(self, data: bytes, now: float) -> list[tuple[float, int]]:
        """What comes back, until no more does: (time, bytes)."""
        self.bus.advance_to(now)
        self.bus.receive(data, now)
        found = []
        while (at := self.bus.next_time) is not None:
            self.bus.advance_to(at)
            found.append((at, len(self.bus.due(at))))
        return found

    def exchange(self, now: float) -> float:
        """When the last byte of the answer is there."""
        found = self.pieces(EXCHANGE, now)
        assert sum(size for _, size in found) == exchange_bytes()[1]
        return found[-1][0]


def _near_a_tick(busy: float, timer: float) -> bool:
    """Whether rounding decides which tick it is."""
    return timer > 0 and abs(busy / timer - round(busy / timer)) * timer < ENOUGH


def test_the_driver_sends_these_bytes() -> None:
    assert (len(EXCHANGE), exchange_bytes()) == (39, (39, 35))


def test_the_formula_at_one_megabaud() -> None:
    busy = line_time(1_000_000)
    assert busy == pytest.approx(744e-6)
    period = exchange_period
    assert period(busy, 1e-3) == pytest.approx(1e-3)
    assert period(busy, 1e-3, 0.255e-3) == pytest.approx(1e-3)
    assert period(busy, 1e-3, 0.256e-3) == pytest.approx(1e-3)
    assert period(busy, 1e-3, 0.257e-3) == pytest.approx(2e-3)
    assert period(busy, 1e-3, 1.255e-3) == pytest.approx(2e-3)
    assert period(busy, 16e-3, 1.255e-3) == pytest.approx(16e-3)
    assert period(busy, 0.0) == busy
    assert period(0.0, 1e-3) == 1e-3


def _check(baudrate: int, timer: float, delay: int, host: float, phase: float) -> None:
    busy = line_time(baudrate, delay * mx64.RETURN_DELAY_UNIT)
    if _near_a_tick(busy + host, timer):
        return
    what = f"{baudrate} baud, timer {timer}, return delay {delay}, host {host}, phase {phase}"
    line = Line(baudrate, timer, delay)
    begin = phase
    end = line.exchange(begin)
    assert busy - ENOUGH <= end - begin <= busy + timer + ENOUGH, what
    first = end
    # one more does not show whether it is the same for ever, three do
    for count in range(1, 4):
        end = line.exchange(end + host)
        expected = first + count * exchange_period(busy, timer, host)
        assert end == pytest.approx(expected, abs=ENOUGH), what
    # what is claimed of n in a row, the first of them at any phase, on any host
    assert end - begin >= busy + 3 * exchange_period(busy, timer) - ENOUGH, what


@settings(max_examples=40)
@given(
    baudrate=st.sampled_from(BAUD_RATES),
    timer=st.integers(0, 20).map(lambda ms: ms * 1e-3),
    delay=st.integers(0, 254),
    host=st.floats(0.0, 20e-3),
    phase=st.floats(0.0, 20e-3),
)
def test_the_formula_at_any_point(
    baudrate: int, timer: float, delay: int, host: float, phase: float
) -> None:
    _check(baudrate, timer, delay, host, phase)


@given(
    baudrate=st.sampled_from(BAUD_RATES),
    timer=st.integers(0, 20).map(lambda ms: ms * 1e-3),
    delay=st.integers(0, 254),
    size=st.integers(1, 300),
    begin=st.floats(0.0, 20e-3),
)
def test_no_byte_comes_early_and_none_late(
    baudrate: int, timer: float, delay: int, size: int, begin: float
) -> None:
    """Each byte has been on the line before it is handed over, which is at the next tick of the
    timer, or as soon as a USB packet is full.
    """
    byte_time = 10 / baudrate
    read = dxl.encode(1, Instruction.READ, _number(0) + _number(size))
    answer = begin + len(read) * byte_time + delay * mx64.RETURN_DELAY_UNIT
    came = 0
    for at, count in Line(baudrate, timer, delay).pieces(read, begin):
        first, last = answer + (came + 1) * byte_time, answer + (came + count) * byte_time
        came += count
        what = f"bytes to {came} of a read of {size}"
        assert at >= last - ENOUGH, f"{what} came early"
        if not timer:
            assert at <= last + ENOUGH, f"{what} came late"
        elif count == 62 and at <= last + ENOUGH:
            continue  # a full packet
        else:
            assert at / timer == pytest.approx(round(at / timer), abs=1e-6), f"{what}: no tick"
            assert at - first <= timer + ENOUGH, f"{what} came late"
    assert came == size + 11


@each("baudrate", BAUD_RATES)
def test_the_driver_claims_a_rate_that_a_paced_loop_keeps(baudrate: int) -> None:
    """At every phase of the timer, for a host as slow as the driver assumes one to be."""
    spec = EZGripper("/dev/null", Side.LEFT, GripperSettings(baudrate=baudrate)).spec
    busy = line_time(baudrate)
    for phase, host in itertools.product((0.0, 0.2e-3, 0.5e-3, 0.9e-3), (0.1e-3, 0.5e-3)):
        line = Line(baudrate, 1e-3, 2)
        clock = ManualClock(phase)
        rate = Rate(spec.io_rate, clock)
        for _ in range(20):
            rate.wait()
            clock.sleep_until(line.exchange(clock.now()) + host)
        assert rate.misses == 0
        took = clock.now() - phase
        assert took <= 20 / spec.io_rate + busy + 1e-3 + host + ENOUGH, f"{phase=} {host=}"


def test_the_rate_that_the_driver_claims() -> None:
    def rate(baudrate: int, timer: float = 1e-3) -> float:
        hand = EZGripper("/dev/null")
        return hand._make_spec(Side.LEFT, baudrate, timer).io_rate

    assert EZGripper("/dev/null").spec.io_rate == pytest.approx(500.0)
    assert rate(1_000_000) == pytest.approx(500.0)
    assert rate(1_000_000, 16e-3) == pytest.approx(62.5)
    assert rate(57_600) == pytest.approx(1000 / 14)
    for baudrate, timer in itertools.product(BAUD_RATES, TIMERS):
        claimed = rate(baudrate, timer)
        busy = line_time(baudrate)
        assert claimed <= 1 / exchange_period(busy, timer) * (1 + ENOUGH), "above what can be"
        assert claimed >= 1 / (busy + timer + gripper._TURNAROUND), "below what is certain"
