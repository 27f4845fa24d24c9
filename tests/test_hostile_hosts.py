"""Emulated devices with hosts that send invalid or far too much data."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import termios
import threading
import tty
from pathlib import Path

import pytest

from dexkit.clock import ManualClock
from dexkit.emulators.m4010.bus import Bus as MotorBus
from dexkit.emulators.m4010.motor import Motor
from dexkit.emulators.mx64 import Bus, Firmware, Port, Servo
from dexkit.wire import dynamixel as dxl
from dexkit.wire import m4010
from dexkit.wire.dynamixel import Instruction
from tests.cli_helpers import running
from tools.campaign.fuzz.devices import packet


def broken(*_: object) -> None:
    raise IndexError("a mistake")


def fast_bus(n: int = 2) -> Bus:
    servos = [Servo(i + 1, firmware=Firmware(fast_reads=True)) for i in range(n)]
    return Bus(servos, line_time=False)


def ask(bus: Bus, data: bytes) -> list[dxl.Packet]:
    bus.receive(data, 0.0)
    return dxl.PacketParser().feed(bus.due(1.0))


PING = dxl.encode(1, Instruction.PING)


def test_oversized_fast_read_is_not_answered() -> None:
    for asked in (
        bytes.fromhex("fffffd00fe08008a0000f50301c034"),  # 1013 bytes of servo 1
        packet(254, Instruction.FAST_SYNC_READ, b"\0\0\xff\xff\1"),
        packet(254, Instruction.FAST_SYNC_READ, b"\0\0\xff\xff\1\2\3"),
        packet(254, Instruction.FAST_BULK_READ, b"\1\0\0\4\0\2\0\0\xf5\3"),
        # servo 9 is not there: the first would announce a length for it all the same
        packet(254, Instruction.FAST_BULK_READ, b"\1\0\0\4\0\x09\0\0\xff\xff"),
    ):
        bus = fast_bus()
        assert ask(bus, asked) == [], asked.hex()
        assert bus.failure is None
        assert len(ask(bus, PING)) == 1


def test_exception_in_one_device_is_logged_and_the_line_continues(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bus = fast_bus()
    good = bus._single
    monkeypatch.setattr(bus, "_single", broken)
    for _ in range(3):
        assert ask(bus, PING) == []
    assert isinstance(bus.failure, IndexError)
    assert bus.counters.failures == 3
    assert "3 failures" in bus.counters.summary()
    assert len(caplog.records) == 1
    monkeypatch.setattr(bus, "_single", good)
    assert len(ask(bus, PING)) == 1

    motors = MotorBus([Motor(0)], line_time=False)
    monkeypatch.setattr(motors.motors[0], "handle", broken)
    motors.receive(m4010.MotorCmd(0, m4010.Status.BRAKE).pack(), 0.0)
    assert motors.due(1.0) == b""
    assert isinstance(motors.failure, IndexError)


def test_emulator_process_survives_an_oversized_fast_read(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    with running("emulate", "mx64", "--link", link, "--set", "fast-reads=yes") as emulator:
        emulator.ready()
        fd = os.open(link, os.O_RDWR | os.O_NOCTTY)
        try:
            tty.setraw(fd)
            attributes = termios.tcgetattr(fd)
            attributes[4] = attributes[5] = termios.B1000000
            termios.tcsetattr(fd, termios.TCSANOW, attributes)
            os.write(fd, bytes.fromhex("fffffd00fe08008a0000f50301c034"))
            os.write(fd, PING)
            assert select.select([fd], [], [], 20.0)[0], "it no longer answers"
        finally:
            os.close(fd)
        code, _, errors = emulator.end(signal.SIGTERM)
        assert code == 0, errors


def test_flood_is_limited_by_the_line_speed() -> None:
    # at 9600 baud a ping and its answer take 25 ms of line time
    bus = Bus([Servo(1, baudrate=9600)], line_time=True)
    clock = ManualClock()
    with Port(bus, clock=clock, check_baudrate=False) as port:
        fd = os.open(port.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            tty.setraw(fd)
            stuck = threading.Event()
            port.start()
            for _ in range(1000):
                if not select.select([], [fd], [], 0.2)[1]:
                    stuck.set()  # as a real adapter's buffers: the client waits
                    break
                os.write(fd, PING * 100)
            assert stuck.is_set(), "everything was taken, as if the line had no speed"
            assert bus.counters.bytes_in <= 3 * 4096
            assert len(bus._out) <= 6000  # answers to a chunk
        finally:
            os.close(fd)


def test_invalid_standard_input_is_reported(tmp_path: Path) -> None:
    lines = b"overheat:id=" + b"9" * 5000 + b"\n\xff\xfe\n" + b"x" * 100_000 + b"\nfoo\n"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "dexkit",
            "emulate",
            "mx64",
            "--link",
            str(tmp_path / "tty"),
            "--fault=-",
        ],
        input=lines,
        capture_output=True,
        timeout=60,
        check=False,
    )
    errors = done.stderr.decode()
    assert done.returncode == 0, errors
    assert errors.count("error: ") >= 4
    assert "Traceback" not in errors
