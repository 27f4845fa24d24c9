"""Drivers with devices that never stop sending."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import tty
from collections.abc import Callable

import pytest
from usb.core import USBError, USBTimeoutError

from dexkit import usbip
from dexkit.drivers.dex1_serial.line import acquire
from dexkit.drivers.ezgripper.bus import ServoBus
from dexkit.errors import HandError, HandRefused, HandTimeout
from dexkit.usbip import Connection, UsbIpBackend
from dexkit.wire import m4010
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dynamixel import status

PATIENCE = 30.0  # seconds after which a call counts as hanging; each takes milliseconds


def ends(function: Callable[[], object]) -> BaseException | None:
    """What ``function`` raised; fails if it does not come back."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            function()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    assert not thread.is_alive(), "it hangs"
    return raised[0] if raised else None


@contextlib.contextmanager
def flooded(data: bytes):  # type: ignore[no-untyped-def]
    """A serial port whose device never stops sending ``data``."""
    master, slave = os.openpty()
    tty.setraw(slave)
    stop = threading.Event()
    os.set_blocking(master, False)

    def flood() -> None:
        while not stop.is_set():
            try:
                os.write(master, data * 50)
            except BlockingIOError:
                stop.wait(0.0005)
            with contextlib.suppress(BlockingIOError):
                os.read(master, 4096)

    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


def foreign_motor() -> bytes:
    mechanics = m4010.DATA.head + b"\x05" + bytes(19)
    return mechanics + crc32_words(mechanics[2:]).to_bytes(4, "little")


@pytest.mark.parametrize("data", [b"noise", foreign_motor()], ids=["noise", "another motor"])
def test_motor_line_times_out_under_a_flood(data: bytes) -> None:
    with flooded(data) as path:
        line = acquire(path, 115200)
        try:
            frame = m4010.MotorCmd(0, m4010.Status.BRAKE).pack()
            for _ in range(3):
                assert isinstance(ends(lambda: line.exchange(frame, 0, 0.01)), HandTimeout)
        finally:
            line.release()


@pytest.mark.parametrize("data", [b"noise", status(9, 0, b"abc")], ids=["noise", "another servo"])
def test_servo_bus_times_out_under_a_flood(data: bytes) -> None:
    with flooded(data) as path:
        bus = ServoBus(path, 115200, timeout=0.01, retries=1)
        bus.open()
        try:
            for _ in range(3):
                assert isinstance(ends(lambda: bus.ping(1)), HandTimeout)
        finally:
            bus.close()


def test_usbip_client_times_out_under_a_flood() -> None:
    near, far = socket.socketpair()
    stop = threading.Event()
    foreign = struct.pack(">II12xII20x", 3, 999, 0, 0) * 100

    def flood() -> None:
        with contextlib.suppress(OSError):
            while not stop.is_set():
                far.sendall(foreign)

    def drain() -> None:
        with contextlib.suppress(OSError):
            while far.recv(65536):
                pass

    threads = [threading.Thread(target=f, daemon=True) for f in (flood, drain)]
    connection = Connection(near, 2)
    for thread in threads:
        thread.start()
    try:
        for _ in range(3):
            error = ends(lambda: connection.exchange(2, bytes(10), 1, 1270, 20, 20))
            assert isinstance(error, USBTimeoutError)
    finally:
        stop.set()
        connection.close()
        far.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
        far.close()


def test_usbip_client_gives_up_on_a_server_that_sends_byte_by_byte(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(usbip, "_GREETING", 0.2)
    stop = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                with connection:
                    connection.sendall(struct.pack(">HHII", 0x111, 5, 0, 0xFFFFFFFF))
                    while not stop.wait(0.01):
                        connection.sendall(b"\0")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        backend = UsbIpBackend("127.0.0.1", listener.getsockname()[1])
        error = ends(backend.enumerate_devices)
        stop.set()
        thread.join()
    assert isinstance(error, USBError)
    assert "too slow" in str(error)


def test_a_serial_port_has_one_driver() -> None:
    frame = m4010.MotorCmd(0, m4010.Status.BRAKE).pack()
    with flooded(b"noise") as path:
        bus = ServoBus(path, 115200)
        bus.open()
        try:
            with pytest.raises(HandRefused, match="another program is using"):
                acquire(path, 115200)
            with pytest.raises(HandRefused, match="another program is using"):
                ServoBus(path, 115200).open()
        finally:
            bus.close()
        line = acquire(path, 115200)
        try:
            with pytest.raises(HandRefused, match="another program is using"):
                ServoBus(path, 115200).open()
            with pytest.raises(HandError):
                line.exchange(frame, 0, 0.001)
        finally:
            line.release()
