"""Hostile devices: replies to the drivers, most of them in frames with a valid checksum.

A finding is an exception that is not dexkit's own, or a hand that close() leaves driven.
"""

from __future__ import annotations

import contextlib
import errno
import random
import select
import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from usb.core import USBError

from dexkit.clock import ManualClock
from dexkit.drivers.dex1_serial.line import MotorLine
from dexkit.drivers.dex3_usb import hand as dex3_hand
from dexkit.drivers.dex3_usb.discovery import Candidate
from dexkit.drivers.dex3_usb.hand import Dex3Usb
from dexkit.drivers.ezgripper import bus as ezgripper_bus
from dexkit.drivers.ezgripper import gripper
from dexkit.drivers.ezgripper.gripper import EZGripper, GripperSettings
from dexkit.emulators.dex3_mcu.device import Dex3Mcu
from dexkit.emulators.mx64 import Bus, Servo
from dexkit.errors import DexkitError
from dexkit.hand import HandCommand, Side
from dexkit.tcp_listener import listen
from dexkit.usbip import Connection, UsbIpBackend
from dexkit.wire import dynamixel as dxl
from dexkit.wire import m4010
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import STATE
from tools.campaign.fuzz.case import Inputs, SeededCase

__all__ = ["cases"]

_BLOCK = 100


def _spoilt(rnd: random.Random, data: bytes, seal: Callable[[bytes], bytes]) -> bytes:
    """A valid reply; often with other content, sometimes damaged, cut or with other bytes around
    it.
    """
    chance = rnd.random()
    if chance < 0.3 or len(data) < 12:
        return data
    if chance < 0.7:
        changed = bytearray(data)
        for _ in range(rnd.choice((1, 3, 30))):
            changed[rnd.randrange(2, len(changed))] = rnd.choice(
                (0, 0x7F, 0x80, 0xFF, rnd.randrange(256))
            )
        return seal(bytes(changed))
    if chance < 0.8:
        return data[: rnd.randrange(len(data))]
    if chance < 0.9:
        return rnd.randbytes(rnd.choice((1, 7, 100, 5000))) + data
    return rnd.choice((b"", data * 3, rnd.randbytes(3000)))


# --- EZGripper


class _HostilePort(ezgripper_bus.DevicePort):
    """The driver's port with an emulated servo on it, whose answers are tampered with."""

    def __init__(self, case: Inputs, line: Bus, clock: ManualClock) -> None:
        super().__init__("fuzz", 0.03)
        self._case, self._bus, self._time = case, line, clock
        self._received = b""
        self.honest = True
        self._is_open = False

    @property
    def is_open(self) -> bool:
        return self._is_open

    def open(self, baudrate: int) -> None:
        self._is_open = True
        self._received = b""

    def close(self) -> None:
        self._is_open = False

    def clear(self) -> None:
        self._received = b""

    def flush(self) -> None:
        pass

    def read(self, deadline: float) -> bytes:
        taken, self._received = self._received, b""
        return taken

    def write(self, data: bytes) -> bool:
        now = self._time.advance(0.002)
        self._bus.advance_to(now)
        self._bus.receive(data, now)
        answer = self._bus.due(now + 1.0)
        if answer and not self.honest:
            answer = _spoilt(self._case.random, answer, _sealed_status)
        self._received += answer
        return True


def _sealed_status(data: bytes) -> bytes:
    data = dxl.HEADER + data[4:-2]
    return data + dxl.crc16(data).to_bytes(2, "little")


def ezgripper(case: Inputs, count: int) -> None:
    """The EZGripper driver with a servo that answers anything."""
    rnd = case.random
    clock = ManualClock(100.0)
    commands = [HandCommand.brake(1), HandCommand.position(0.0), HandCommand.position(5.4)]
    for i in range(count):
        if i % _BLOCK == 0:
            line = Bus([Servo(1, now=clock.now())], line_time=False, start=clock.now())
            port = _HostilePort(case, line, clock)
            hand = EZGripper(
                "fuzz",
                configuration=GripperSettings(
                    zero=1510, retries=rnd.choice((0, 2)), config=Path("/nowhere/x")
                ),
                clock=clock,
            )
            device = SimpleNamespace(path="fuzz", key="fuzz", serial_number=None)
            with (
                mock.patch.object(ezgripper_bus, "DevicePort", return_value=port),
                mock.patch.object(gripper, "find_device", return_value=device),
                mock.patch.object(gripper, "latency_warning", return_value=None),
            ):
                port.honest = rnd.random() < 0.7
                case.begin()
                with contextlib.suppress(DexkitError):
                    hand.open()
            port.honest = False
        case.begin()
        with contextlib.suppress(DexkitError):
            hand.exchange(rnd.choice(commands))
        if (i + 1) % _BLOCK == 0:
            port.honest = True
            case.begin()
            hand.close()
            line.due(clock.advance(2.0))
            line.advance_to(clock.now())
            for servo in line.servos:
                still = abs(servo.drive.velocity) < 1.0
                stopped = not servo.torque or servo.drive.demand.stopped
                assert stopped or still, "close() left the servo driven"


# --- Dex1-1's motor


class _Peer:
    """The other end of a socket pair, which answers every message by a function."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self.near, self._far = socket.socketpair()
        self.near.setblocking(False)
        self._answer = answer
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._far.recv(1 << 16):
                if answer := self._answer(data):
                    self._far.sendall(answer)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._far.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(OSError):
            self.near.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._far.close()
        self.near.close()


def motor_line(case: Inputs, count: int) -> None:
    """A serial line whose motor answers anything."""
    rnd = case.random

    def seal(data: bytes) -> bytes:
        frame = m4010.DATA.head + data[2:22]
        return frame + crc32_words(frame[2:]).to_bytes(4, "little")

    def reply(command: bytes) -> bytes:
        number = rnd.choice((0, 0, 0, 1, 15))
        data = m4010.MotorData.measured(
            number,
            m4010.Status.BRAKE,
            q=1.0,
            dq=0.0,
            tau=0.0,
            temperature=30,
            winding=30,
            voltage=24.0,
            error=0,
            timeout=False,
        )
        return _spoilt(rnd, data.pack(), seal)

    peer = _Peer(reply)
    try:
        line = MotorLine.__new__(MotorLine)
        line.__dict__.update(
            path="fuzz",
            baudrate=0,
            statistics=_statistics(),
            users=1,
            _lock=threading.Lock(),
            _parser=m4010.FrameParser((m4010.DATA,)),
            _quiet_needed=0,
            _port=peer.near,
            before=None,
        )
        frame = m4010.MotorCmd(0, m4010.Status.BRAKE).pack()
        for _ in range(count):
            with mock.patch("dexkit.drivers.dex1_serial.line.LATE", 0.001):
                case.begin()
                with contextlib.suppress(DexkitError):
                    line.exchange(frame, 0, 0.0005)
            assert line._parser.pending < 100, "the parser holds more than a frame"
    finally:
        peer.close()


def _statistics() -> Any:
    from dexkit.drivers.dex1_serial.line import LineStatistics

    return LineStatistics()


# --- Dex3-1 on USB


class _HostileBackend:
    """A PyUSB backend with one hand, which answers anything."""

    def __init__(self, case: Inputs, mcu: Dex3Mcu) -> None:
        self._case, self._mcu = case, mcu
        self.honest = True

    def exchange(
        self, handle: Any, out: int, data: bytes, into: int, limit: int, *ms: int
    ) -> bytes:
        rnd = self._case.random
        answer = self._mcu.exchange(data)
        if not self.honest and rnd.random() < 0.1:
            raise USBError(
                "fuzz", errno=rnd.choice((errno.EPIPE, errno.ETIMEDOUT, errno.EIO, 1, 75))
            )
        if answer is None:
            raise USBError("fuzz", errno=errno.ETIMEDOUT)
        return answer if self.honest else _spoilt(rnd, answer, _sealed_state)[:limit]

    def bulk_read(self, *arguments: Any) -> int:
        raise USBError("fuzz", errno=errno.ETIMEDOUT)

    def ctrl_transfer(
        self, handle: Any, kind: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        rnd = self._case.random
        size = rnd.randrange(len(data) + 1)
        for i in range(size):
            data[i] = rnd.randrange(256)
        return size

    def get_interface_descriptor(self, *arguments: Any) -> Any:
        return SimpleNamespace(bNumEndpoints=2)

    def get_endpoint_descriptor(self, device: Any, index: int, *arguments: Any) -> Any:
        return SimpleNamespace(bEndpointAddress=(0x02, 0x81)[index], bmAttributes=2)

    def get_configuration(self, handle: Any) -> int:
        return 1

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: None


def _sealed_state(data: bytes) -> bytes:
    data = data[: STATE.size - 4]
    return data + crc32_words(data[2:]).to_bytes(4, "little")


def dex3_usb(case: Inputs, count: int) -> None:
    """The Dex3-1 driver with a hand that answers anything."""
    rnd = case.random
    clock = ManualClock(100.0)
    for i in range(count):
        if i % _BLOCK == 0:
            mcu = Dex3Mcu(Side.LEFT, clock=clock)
            backend = _HostileBackend(case, mcu)
            hand = Dex3Usb(Side.LEFT)
            hand._clock = clock
            candidate = Candidate(backend, None, Side.LEFT, "fuzz")
            backend.honest = rnd.random() < 0.8
            with mock.patch.object(dex3_hand, "find_hand", lambda *a, c=candidate, **k: c):
                case.begin()
                with contextlib.suppress(DexkitError):
                    hand.open()
            backend.honest = False
        clock.advance(0.001)
        with mock.patch("dexkit.drivers.dex3_usb.link._LATE_ANSWER_WAIT", 0.0):
            command = rnd.choice((HandCommand.brake(7), HandCommand.position([0.1] * 7)))
            case.begin()
            with contextlib.suppress(DexkitError):
                hand.exchange(command)
        if (i + 1) % _BLOCK == 0:
            backend.honest = True
            case.begin()
            hand.close()
            clock.advance(2.0)
            mcu.advance()
            assert not any(mcu.mechanics.mode), "close() left a motor driven"


# --- USB/IP client


def usbip_client(case: Inputs, count: int) -> None:
    """The client's transfers, and its list and import, with a server that answers anything."""
    rnd = case.random
    for i in range(count):
        if i % 20 == 0:
            peer = _Peer(lambda data: _replies(case, data))
            connection = Connection(peer.near, 2)
        case.begin()
        with contextlib.suppress(USBError):
            if rnd.random() < 0.5:
                connection.exchange(2, bytes(10), 1, 1270, 2, 2)
            else:
                connection.submit(
                    direction=1, ep=0, setup=bytes(8), transfer_buffer_length=255, timeout_ms=2
                )
        if (i + 1) % 20 == 0 or i + 1 == count:
            connection.close()
            peer.close()
    listener = listen("127.0.0.1", 0)
    try:
        for _ in range(max(1, count // 20)):
            stream = _greeting(case)
            case.begin(stream)
            _list(listener, stream)
    finally:
        listener.close()


def _replies(case: Inputs, data: bytes) -> bytes:
    rnd = case.random
    out = b""
    for at in range(0, len(data) - 47, 48):
        seq = int.from_bytes(data[at + 4 : at + 8], "big")
        for _ in range(rnd.choice((0, 1, 1, 1, 2))):
            command = rnd.choice((3, 3, 3, 4, 1, case.number_of(4)))
            number = seq if rnd.random() < 0.8 else case.number_of(4)
            actual = rnd.choice((0, 0, 18, 255, 1270, case.number_of(4)))
            status = rnd.choice((0, 0, 0, -32, -104, case.number_of(4))) & 0xFFFFFFFF
            out += struct.pack(">II12xII20x", command, number, status, actual)
            out += rnd.randbytes(min(actual, rnd.choice((0, 18, 255, 1270, 3000))))
    return case.spoil(out)


def _greeting(case: Inputs) -> bytes:
    rnd = case.random
    device = struct.pack(
        ">256s32sIIIHHHBBBBBB",
        rnd.randbytes(256),
        rnd.choice((b"1-1", rnd.randbytes(32))),
        *(case.number_of(4) for _ in range(3)),
        0x34B7,
        rnd.choice((0x1010, 0x1011, 0)),
        1,
        *(rnd.randrange(256) for _ in range(5)),
        rnd.choice((0, 1, 3)),
    )
    count = rnd.choice((0, 1, 2, case.number_of(4)))
    code = rnd.choice((5, 5, 5, 3, case.number_of(2)))
    header = struct.pack(">HHII", 0x111, code, rnd.choice((0, 0, 0, 1)), count)
    return case.spoil(header + (device + bytes(4)) * rnd.choice((0, 1, 3)))


def _list(listener: socket.socket, stream: bytes) -> None:
    def serve() -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            with connection:
                select.select([connection], [], [], 5.0)
                connection.recv(100)
                connection.sendall(stream)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        with contextlib.suppress(OSError):
            UsbIpBackend("127.0.0.1", listener.getsockname()[1]).enumerate_devices()
    finally:
        thread.join()


def cases() -> list[SeededCase]:
    """Every fuzzer of this module."""
    return [
        SeededCase("driver.ezgripper", "answers to the EZGripper driver", ezgripper, size=500),
        SeededCase("driver.m4010", "answers to the serial line of Dex1-1", motor_line, size=300),
        SeededCase("driver.dex3-usb", "answers to the Dex3-1 driver", dex3_usb, size=1_000),
        SeededCase("usbip.client", "answers of a USB/IP server", usbip_client, size=300),
    ]
