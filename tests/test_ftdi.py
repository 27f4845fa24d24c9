"""The emulated FTDI adapter: its chip in virtual time, and its USB side."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.clock import ManualClock, RealClock
from dexkit.drivers.serial_port import exchange_period
from dexkit.emulators.ftdi import (
    FT232H,
    FT232R,
    ChipModel,
    FtdiChip,
    FtdiPort,
    FtdiUsb,
    Request,
    baudrate_of,
)
from dexkit.emulators.line_port import line_port
from dexkit.emulators.mx64 import Bus, Servo
from dexkit.errors import UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire.dynamixel import Instruction
from tests.each import each
from tests.patience import PATIENCE

# FTDI AN232B-05, table of divisors for a 48 MHz chip: rate, value of the request
_DIVISORS = [
    (300, 0x2710),
    (1200, 0x09C4),
    (9600, 0x4138),
    (19200, 0x809C),
    (38400, 0xC04E),
    (57600, 0x0034),
    (115200, 0x001A),
    (230400, 0x000D),
    (460800, 0x4006),
    (921600, 0x8003),
    (1_000_000, 0x0003),
    (2_000_000, 0x0001),
    (3_000_000, 0x0000),
]


@each("rate,value", _DIVISORS)
def test_divisors_of_the_application_note(rate: int, value: int) -> None:
    assert abs(baudrate_of(FT232R, value, 0) / rate - 1) < 0.0025


@each(
    "rate,value,index",
    [
        (12_000_000, 0, 0x0200),
        (8_000_000, 1, 0x0200),
        (6_000_000, 2, 0x0200),
        (1_000_000, 12, 0x0201),  # the channel is in the low byte
        (3_000_000, 0, 0x0001),  # without the fast clock
    ],
)
def test_divisors_of_a_high_speed_chip(rate: int, value: int, index: int) -> None:
    assert baudrate_of(FT232H, value, index) == rate


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.sampled_from([FT232R, FT232H]))
def test_any_divisor_is_a_rate_of_the_chip(value: int, index: int, model: ChipModel) -> None:
    assert 180 < baudrate_of(model, value, index) <= (12_000_000 if model is FT232H else 3_000_000)


def ready(chip: FtdiChip, now: float) -> list[bytes]:
    """The packets that are due."""
    out = []
    while (packet := chip.packet(now)) is not None:
        out.append(packet)
    return out


@given(
    st.lists(st.tuples(st.binary(max_size=200), st.floats(0, 0.05)), max_size=20),
    st.sampled_from([FT232R, FT232H]),
    st.integers(1, 255),
)
def test_every_byte_comes_once_in_order_and_no_later_than_the_timer(
    pieces: list[tuple[bytes, float]], model: ChipModel, latency: int
) -> None:
    chip = FtdiChip(model)
    assert chip.control(Request.SET_LATENCY, latency, 0, 0.0) == b""
    now, sent, got = 0.0, b"", b""
    for data, pause in pieces:
        chip.receive(data)
        sent += data
        packets = ready(chip, now)
        now += pause
        packets += ready(chip, now)
        assert all(2 <= len(packet) <= model.packet for packet in packets)
        got += b"".join(packet[2:] for packet in packets)
    assert not chip.overruns
    got += b"".join(packet[2:] for packet in ready(chip, now + latency * 1e-3 + 1e-9))
    assert got == sent


def test_a_short_answer_waits_for_the_timer_and_a_full_packet_does_not() -> None:
    chip = FtdiChip(FT232R)
    chip.control(Request.SET_LATENCY, 16, 0, 0.0)
    chip.receive(b"answer")
    assert ready(chip, 0.0159) == []
    assert ready(chip, 0.0161) == [b"\xb1\x60answer"]
    assert ready(chip, 0.0319) == []
    assert ready(chip, 0.0321) == [b"\xb1\x60"]  # the status comes without data, too
    chip.receive(bytes(100))
    assert ready(chip, 0.033) == [b"\xb1\x60" + bytes(62)]
    assert ready(chip, 0.0481) == [b"\xb1\x60" + bytes(38)]


def test_unread_bytes_overrun_and_are_reported_once() -> None:
    chip = FtdiChip(FT232R)
    chip.receive(bytes(300))
    assert chip.overruns == 44
    first, second, *_ = ready(chip, 0.1)
    assert (first[1], second[1]) == (0x62, 0x60)
    chip.receive(bytes(10))
    assert chip.control(Request.RESET, 1, 0, 0.2) == b""
    assert ready(chip, 0.5) == [b"\xb1\x60"]


def test_requests_of_a_driver() -> None:
    chip = FtdiChip(FT232H)
    assert chip.control(Request.GET_LATENCY, 0, 0, 0.0) == b"\x10"
    assert chip.control(Request.SET_LATENCY, 0, 0, 0.0) is None
    assert chip.control(Request.SET_LATENCY, 1, 0, 0.0) == b""
    assert chip.control(Request.GET_LATENCY, 0, 0, 0.0) == b"\x01"
    assert chip.control(Request.SET_MODEM, 0x0303, 0, 0.0) == b""
    assert (chip.dtr, chip.rts) == (True, True)
    assert chip.control(Request.SET_MODEM, 0x0100, 0, 0.0) == b""
    assert (chip.dtr, chip.rts) == (False, True)
    assert chip.control(Request.SET_DATA, 8 | 1 << 14, 0, 0.0) == b""
    assert chip.breaking
    assert chip.control(Request.GET_MODEM, 0, 0, 0.0) == b"\xb2\x60"
    assert chip.control(Request.READ_EEPROM, 0, 0, 0.0) == b"\xff\xff"
    assert chip.control(0x55, 0, 0, 0.0) is None


class _Setup:
    """A vendor request, as the USB/IP package hands it over."""

    def __init__(self, request: int, value: int = 0, index: int = 0, *, into: bool = False) -> None:
        self.bRequest, self.wValue, self.wIndex = request, value, index
        self.direction = int(into)


@pytest.fixture
def adapter() -> tuple[FtdiUsb, ManualClock]:
    """An MX-64 at 1 Mbaud behind an FT232R."""
    clock = ManualClock()
    bus = Bus([Servo(1, baudrate=1_000_000)])
    return FtdiUsb(bus, "DK1", clock=clock), clock


def _pass_time(usb: FtdiUsb, clock: ManualClock, seconds: float) -> None:
    end = clock.now() + seconds
    while (due := usb.advance()) is not None and due < end:
        clock.advance(max(0.0, due - clock.now()) + 1e-9)
    clock.advance(max(0.0, end - clock.now()))
    usb.advance()


def test_an_answer_of_a_servo_takes_the_line_and_the_timer(
    adapter: tuple[FtdiUsb, ManualClock],
) -> None:
    usb, clock = adapter
    read: list[tuple[float, bytes]] = []

    def park(number: int) -> None:
        usb._in.take_or_park(512, lambda data, status=0: read.append((clock.now(), data)), number)

    usb._control(_Setup(Request.SET_BAUDRATE, 3))
    ping = dxl.encode(1, Instruction.PING)
    park(1)
    usb._out.on_out(usb._out, ping)
    _pass_time(usb, clock, 0.02)
    ((at, data),) = read
    assert 0.015 < at < 0.0165
    assert data[:2] == b"\xb1\x60"
    assert dxl.PacketParser().feed(data[2:])[0].is_status
    # at another baud rate it hears nothing
    usb._control(_Setup(Request.SET_BAUDRATE, 0x001A))
    park(2)
    usb._out.on_out(usb._out, ping)
    _pass_time(usb, clock, 0.02)
    assert read[1][1] == b"\xb1\x60"


@each("timer,rate", [(16, 1_000_000), (1, 1_000_000), (1, 57600), (5, 115_200)])
def test_exchanges_take_the_period_of_the_formula(timer: int, rate: int) -> None:
    # tests/test_line_time.py compares the line on a pseudo-terminal with the same formula
    clock = ManualClock()
    servo = Servo(1, baudrate=rate)
    usb = FtdiUsb(Bus([servo]), "DK1", clock=clock)
    usb._control(_Setup(Request.SET_BAUDRATE, {1_000_000: 3, 115_200: 0x1A, 57600: 0x34}[rate]))
    usb._control(_Setup(Request.SET_LATENCY, timer))
    ping, answer = dxl.encode(1, Instruction.PING), dxl.status(1, 0, servo.ping_data)
    line_time = 10 * (len(ping) + len(answer)) / rate + servo.return_delay
    times: list[float] = []
    number = 0

    def done(data: bytes, status: int = 0) -> None:
        if len(data) > 2:
            times.append(clock.now())

    while len(times) < 8:
        known = len(times)
        usb._out.on_out(usb._out, ping)
        while len(times) == known:
            while len(usb._in._pending) < 2:  # as Linux's usb-serial has
                number += 1
                usb._in.take_or_park(512, done, number)
            due = usb.advance()
            if len(times) == known and due is not None:
                clock.sleep_until(due)
    periods = [later - earlier for earlier, later in itertools.pairwise(times)]
    expected = exchange_period(line_time, timer * 1e-3)
    assert [round(period, 6) for period in periods[1:]] == [round(expected, 6)] * 6


def test_a_client_finds_the_adapter_on_the_server() -> None:
    import usb.core
    import usb.util
    import usbip_backend

    now = RealClock().now()
    lines = [Bus([Servo(number, now=now)], start=now) for number in (1, 2)]
    with FtdiPort([FtdiUsb(lines[0], "DK1"), FtdiUsb(lines[1], "DK2", model=FT232H)]) as port:
        port.start()
        backend: Any = usbip_backend.get_backend("127.0.0.1", port.port, PATIENCE)
        found = usb.core.find(idVendor=0x0403, idProduct=0x6014, backend=backend)
        assert found is not None
        found.default_timeout = int(PATIENCE * 1000)
        found.set_configuration()
        assert usb.util.get_string(found, 3) == "DK2"
        assert bytes(found.ctrl_transfer(0xC0, Request.GET_LATENCY, 0, 0, 1)) == b"\x10"
        found.ctrl_transfer(0x40, Request.SET_BAUDRATE, 2, 0x0200)
        found.ctrl_transfer(0x40, Request.SET_LATENCY, 1, 0)
        data = bytes(found.read(0x81, 512, timeout=int(PATIENCE * 1000)))
        assert data == b"\xb2\x60"
        usb.util.dispose_resources(found)
        assert port.adapters[1].chip.baudrate == 6_000_000
        assert port.failure is None


def test_line_is_served_at_its_link(tmp_path: Path) -> None:
    now = RealClock().now()
    bus = Bus([Servo(1, now=now)], start=now)
    with line_port(bus, "usbip://127.0.0.1:0", serial="DK3") as port:
        assert isinstance(port, FtdiPort)
        assert port.path == f"usbip://127.0.0.1:{port.port}"
        assert port.place == "busid=1-1 adapter=FT232R serial=DK3"
    link = tmp_path / "gripper"
    with line_port(bus, link, serial="DK3") as pty:
        assert pty.place.startswith("pty=/dev/pts/")
        assert link.is_symlink()


@each(
    "link",
    ["usbip://", "usbip://:1", "usbip://a:x", "usbip://a:99999", "usbip://a/b", "usbip://u@a"],
)
def test_other_addresses_are_refused(link: str) -> None:
    with pytest.raises(UsageError, match="no address of a server"):
        line_port(Bus([Servo(1)]), link, serial="DK3")
