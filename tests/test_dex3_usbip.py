"""The emulated Dex3-1 as USB clients see it: PyUSB, and two others, over USB/IP."""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import usb.core
import usb.util
import usbip
import usbip_backend.backend
from usbip import protocol
from usbip.core import IN, OUT

from dexkit.emulators.dex3_mcu import (
    SERIAL,
    Dex3Hands,
    Dex3Process,
    Firmware,
    emulated_dex3,
    server,
)
from dexkit.emulators.dex3_mcu.server import MAX_CONNECTIONS, MAX_PARKED
from dexkit.errors import EmulatorError, UsageError
from dexkit.hand import HandCommand, HandState, JointMode, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import PRODUCT, PRODUCT_ID, STATE, VENDOR_ID, HandCodec
from tests.each import each
from tests.patience import PATIENCE

OUT_EP, IN_EP = 0x02, 0x81
BOTH = (Side.LEFT, Side.RIGHT)
LONG = int(PATIENCE * 1000)
"""Milliseconds to wait for a transfer that should take far less."""
REST = np.array(DEX3_1.rest_q[Side.LEFT])


@pytest.fixture(autouse=True)
def _no_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    # this client adds two seconds to every time-out, for servers that have one of their own
    monkeypatch.setattr(usbip_backend.backend._UsbipConnection, "_SERVER_TIMEOUT_MARGIN_MS", 0)


class Host:
    """A host's view of a server: PyUSB, with the USB/IP client of ``pyusb-usbip-backend``."""

    def __init__(self, port: int) -> None:
        self.backend = usbip_backend.get_backend("127.0.0.1", port, PATIENCE)

    def find(self, side: Side = Side.LEFT) -> Any:
        device = usb.core.find(backend=self.backend, idVendor=VENDOR_ID, idProduct=PRODUCT_ID[side])
        assert device is not None
        device.default_timeout = LONG
        device.set_configuration()
        return device

    def close(self) -> None:
        for connection in self.backend._conns.values():
            connection.close()


@contextlib.contextmanager
def host(port: int) -> Iterator[Host]:
    opened = Host(port)
    try:
        yield opened
    finally:
        opened.close()


def brake(side: Side = Side.LEFT) -> bytes:
    return HandCodec(DEX3_1.joints[side]).encode(HandCommand.brake(7))


def exchange(device: Any, frame: bytes = b"", side: Side = Side.LEFT) -> HandState:
    frame = frame or brake(side)
    assert device.write(OUT_EP, frame, LONG) == len(frame)
    answer = bytes(device.read(IN_EP, STATE.size, LONG))
    return HandCodec(DEX3_1.joints[side]).decode(answer, 0.0)


def wait_for(what: object, seconds: float = PATIENCE) -> None:
    deadline = time.monotonic() + seconds
    assert callable(what)
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)


def inside(hands: Dex3Hands | Dex3Process) -> Dex3Hands:
    assert isinstance(hands, Dex3Hands)
    return hands


# --- in a process of its own: what the device is


@pytest.fixture(scope="module")
def both() -> Iterator[Dex3Process]:
    with emulated_dex3(BOTH, process=True) as hands:
        assert isinstance(hands, Dex3Process)
        yield hands


def test_descriptors_equal_those_of_the_manual(both: Dex3Process) -> None:
    with host(both.port) as computer:
        found = list(usb.core.find(backend=computer.backend, find_all=True))
        assert [(d.idVendor, d.idProduct) for d in found] == [(0x34B7, 0x1010), (0x34B7, 0x1011)]
        for device, side in zip(found, BOTH, strict=True):
            raw = device.ctrl_transfer(0x80, 6, 0x0100, 0, 18)
            assert bytes(raw[8:14]) == struct.pack(
                "<HHH", VENDOR_ID, PRODUCT_ID[side], 0x0100
            )  # bcdDevice 1.00
            assert list(raw[14:17]) == [1, 2, 3]  # Mfr=1, Product=2, SerialNumber=3
            assert [usb.util.get_string(device, i) for i in (1, 2, 3)] == [
                "UnitreeTC",
                PRODUCT[side],
                SERIAL[side],
            ]
            assert device.speed == usb.util.SPEED_HIGH
            assert device.bNumConfigurations == 1
            interface = device[0][(0, 0)]
            assert (interface.bInterfaceNumber, interface.bInterfaceClass) == (0, 0xFF)
            assert [
                (e.bEndpointAddress, usb.util.endpoint_type(e.bmAttributes), e.wMaxPacketSize)
                for e in interface
            ] == [
                (OUT_EP, usb.util.ENDPOINT_TYPE_BULK, 512),
                (IN_EP, usb.util.ENDPOINT_TYPE_BULK, 512),
            ]
        assert len({(d.bus, d.address) for d in found}) == 2


def test_both_hands_exchange_at_once(both: Dex3Process) -> None:
    with host(both.port) as computer:
        devices = {side: computer.find(side) for side in BOTH}
        for device in devices.values():
            usb.util.claim_interface(device, 0)
        for side in BOTH * 20:
            state = exchange(devices[side], side=side)
            assert state.q == pytest.approx(DEX3_1.rest_q[side], abs=1e-3)
        for device in devices.values():
            usb.util.release_interface(device, 0)


def test_another_client_library_sees_the_same(both: Dex3Process) -> None:
    transport = usbip.USBIP("127.0.0.1", both.port)
    listed = usbip.host.list_devices(transport)
    assert [(d["busid"], d["speed"], d["bNumInterfaces"]) for d in listed] == [
        ("1-1", 3, 1),  # 3 is high speed
        ("1-2", 3, 1),
    ]
    assert [d["interfaces"] for d in listed] == [[(0xFF, 0, 0)]] * 2
    with usbip.host.open(VENDOR_ID, PRODUCT_ID[Side.RIGHT], transport=transport) as handle:
        handle.bulk_out(OUT_EP, brake())
        assert len(handle.bulk_in(IN_EP, STATE.size)) == STATE.size


# --- transfers


def test_frames_in_without_reading_leave_the_newest_answer() -> None:
    with emulated_dex3() as hands, host(inside(hands).port) as computer:
        device = computer.find()
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        foc = codec.encode(HandCommand.position(REST, kp=1.5, kd=0.2))
        device.write(OUT_EP, brake(), LONG)
        device.write(OUT_EP, brake(), LONG)
        device.write(OUT_EP, foc, LONG)
        answer = codec.decode(bytes(device.read(IN_EP, STATE.size, LONG)), 0.0)
        assert answer.mode.tolist() == [JointMode.FOC] * 7
        with pytest.raises(usb.core.USBError):
            device.read(IN_EP, STATE.size, 50)
        assert inside(hands).device().counters.unread == 2


def test_a_transfer_ends_with_a_short_packet() -> None:
    with emulated_dex3() as hands, host(inside(hands).port) as computer:
        device = computer.find()
        frame = brake()
        for part in (frame[:512], frame[512:1024], frame[1024:]):
            device.write(OUT_EP, part, LONG)
        assert len(device.read(IN_EP, STATE.size, LONG)) == STATE.size
        counters = inside(hands).device().counters
        assert (counters.frames, counters.bad_size) == (1, 0)
        # what never ends is no frame, and does not pile up
        for _ in range(20):
            device.write(OUT_EP, bytes(4096), LONG)
        device.write(OUT_EP, b"", LONG)
        device.read(IN_EP, STATE.size, LONG)
        assert counters.bad_size == 1
        exchange(device)


@each(
    "wrong",
    [
        {"out_endpoint": 0x82},
        {"in_endpoint": 0x01},
        {"out_endpoint": 0},
        {"sides": ()},
        {"sides": (Side.LEFT, Side.LEFT)},
        {"serials": ["a", "b"]},
        {"faults": ["fire"]},
        {"object_pct": 100.0},
        {"firmware": Firmware(), "process": True},
    ],
)
def test_invalid_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError), emulated_dex3(**wrong):
        pass


# --- faults on the wire


@pytest.mark.parametrize("spec", ["stall", "stall-out"])
def test_stalled_endpoint_works_again_when_the_host_clears_it(spec: str) -> None:
    endpoint = IN_EP if spec == "stall" else OUT_EP
    with emulated_dex3() as hands, host(inside(hands).port) as computer:
        device = computer.find()
        exchange(device)
        hands.inject(spec)
        halted = lambda: device.ctrl_transfer(0x82, 0, 0, endpoint, 2)[0]  # noqa: E731
        wait_for(lambda: halted() == 1)
        with pytest.raises(usb.core.USBError) as caught:
            exchange(device)
        assert caught.value.errno == errno.EPIPE
        device.clear_halt(endpoint)
        assert halted() == 0
        exchange(device)


def test_unplug_disconnects_the_client_and_removes_the_hand() -> None:
    with emulated_dex3(BOTH) as hands:
        port = inside(hands).port
        with host(port) as computer, host(port) as later:
            device, other = computer.find(), computer.find(Side.RIGHT)
            exchange(device)
            hands.inject("unplug:side=left,for=300ms")
            wait_for(lambda: not inside(hands).device().plugged)
            wait_for(lambda: _lost(device))
            exchange(other, side=Side.RIGHT)
            listed = list(usb.core.find(backend=later.backend, find_all=True))
            assert [d.idProduct for d in listed] == [PRODUCT_ID[Side.RIGHT]]
            wait_for(lambda: inside(hands).device().plugged)
        with host(port) as again:
            assert exchange(again.find()).q == pytest.approx(REST, abs=1e-3)


def _lost(device: Any) -> bool:
    try:
        device.write(OUT_EP, brake(), 200)
    except usb.core.USBError:
        return True
    return False


def test_delayed_answers_keep_their_order() -> None:
    with (
        emulated_dex3(faults=["delay:ms=80"], firmware=Firmware(queue=3)) as hands,
        host(inside(hands).port) as computer,
    ):
        device = computer.find()
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        started = time.monotonic()
        device.write(OUT_EP, brake(), LONG)
        first = codec.decode(bytes(device.read(IN_EP, STATE.size, LONG)), 0.0)
        assert time.monotonic() - started > 0.075
        device.write(OUT_EP, brake(), LONG)
        device.write(OUT_EP, codec.encode(HandCommand.position(REST, kp=1.5, kd=0.2)), LONG)
        second, third = (
            codec.decode(bytes(device.read(IN_EP, STATE.size, LONG)), 0.0) for _ in range(2)
        )
        assert [s.mode[0] for s in (first, second, third)] == [0, 0, 1]


def test_a_dropped_answer_is_a_time_out_and_nothing_stale_follows() -> None:
    with emulated_dex3(faults=["drop:for=10s"]) as hands, host(inside(hands).port) as computer:
        device = computer.find()
        device.write(OUT_EP, brake(), LONG)
        with pytest.raises(usb.core.USBError) as caught:
            device.read(IN_EP, STATE.size, 100)
        assert caught.value.errno == errno.ETIMEDOUT
        assert inside(hands).device().counters.dropped == 1


# --- the protocol below PyUSB


@contextlib.contextmanager
def imported(port: int, busid: bytes = b"1-1") -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as sock:
        protocol.client_import(sock, busid)
        yield sock


def submit(sock: socket.socket, seqnum: int, direction: int, ep: int, data: bytes) -> None:
    length = len(data) if direction == OUT else STATE.size
    command = (protocol.CMD_SUBMIT, seqnum, 0x10002, direction, ep, 0, length, 0, 0, 0)
    sock.sendall(struct.pack(">IIIIIIiiii8s", *command, bytes(8)) + data)


def unlink(sock: socket.socket, seqnum: int, transfer: int) -> None:
    sock.sendall(struct.pack(">IIIIII24x", protocol.CMD_UNLINK, seqnum, 0x10002, 0, 0, transfer))


def reply(sock: socket.socket) -> tuple[int, int, int, int]:
    """(command, seqnum, status, length) of the next reply's header."""
    raw = protocol._recvall(sock, 48)
    assert raw is not None, "the connection was closed"
    command, seqnum, _, _, _, status, actual = struct.unpack(">IIIIIii", raw[:28])
    return command, seqnum, status, actual


def test_pending_read_can_be_unlinked() -> None:
    with emulated_dex3() as hands, imported(inside(hands).port) as sock:
        submit(sock, 1, IN, 1, b"")
        unlink(sock, 2, 1)
        assert reply(sock)[:3] == (protocol.RET_UNLINK, 2, -errno.ECONNRESET)
        # its answer goes to the next read
        submit(sock, 3, OUT, 2, brake())
        assert reply(sock)[:3] == (protocol.RET_SUBMIT, 3, 0)
        submit(sock, 4, IN, 1, b"")
        assert reply(sock) == (protocol.RET_SUBMIT, 4, 0, STATE.size)
        protocol._recvall(sock, STATE.size)
        # too late for one that is done
        unlink(sock, 5, 4)
        assert reply(sock)[:3] == (protocol.RET_UNLINK, 5, 0)


@pytest.mark.parametrize("newest", [1, 0x7FFFFFFF, 0xFFFFFFFF])
def test_transfer_that_comes_after_its_unlink(newest: int) -> None:
    read, early, write, last = ((newest + k) & 0xFFFFFFFF for k in range(1, 5))
    with emulated_dex3() as hands, imported(inside(hands).port) as sock:
        submit(sock, newest, OUT, 2, brake())
        assert reply(sock)[:3] == (protocol.RET_SUBMIT, newest, 0)
        # vhci_hcd gives a transfer back at this reply, if it has sent it meanwhile
        unlink(sock, early, read)
        submit(sock, read, IN, 1, b"")  # an answer waits for it
        assert reply(sock) == (protocol.RET_UNLINK, early, -errno.ECONNRESET, 0)
        unlink(sock, last, write)
        submit(sock, write, OUT, 2, brake())
        assert reply(sock) == (protocol.RET_UNLINK, last, -errno.ECONNRESET, 0)
        assert inside(hands).device().counters.frames == 1
        submit(sock, last + 1 & 0xFFFFFFFF, IN, 1, b"")  # nothing else came for either
        assert reply(sock) == (protocol.RET_SUBMIT, last + 1 & 0xFFFFFFFF, 0, STATE.size)


def test_hand_has_one_client_at_a_time() -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with imported(port) as first:
            with pytest.raises(usbip.core.NotFound, match="status 2"), imported(port):  # busy
                pass
            submit(first, 1, OUT, 2, brake())
            reply(first)
        with imported(port) as second:
            submit(second, 1, IN, 1, b"")
            second.settimeout(0.1)
            with pytest.raises(TimeoutError):
                reply(second)  # the first one's answer is not for the second


# --- what a client can make it hold


def held(hands: Dex3Hands) -> int:
    return sum(len(c.parked) for c in hands._server._connections.values())


def test_pending_reads_are_limited() -> None:
    with emulated_dex3(BOTH) as hands:
        port = inside(hands).port
        with imported(port) as hog:
            many = MAX_PARKED + 500
            for seqnum in range(1, many + 1):
                submit(hog, seqnum, IN, 1, b"")
            for seqnum in range(MAX_PARKED + 1, many + 1):
                assert reply(hog) == (protocol.RET_SUBMIT, seqnum, -errno.ENOMEM, 0)
            assert held(inside(hands)) == MAX_PARKED
            # control transfers and writes are served all the same, and an answer frees a place
            submit(hog, many + 1, OUT, 2, brake())
            assert {reply(hog)[1] for _ in range(1)} == {1}
            protocol._recvall(hog, STATE.size)
            assert reply(hog)[:3] == (protocol.RET_SUBMIT, many + 1, 0)
            with host(port) as computer:
                exchange(computer.find(Side.RIGHT), side=Side.RIGHT)
        wait_for(lambda: not inside(hands)._server._connections)
        assert held(inside(hands)) == 0
        with host(port) as computer:
            exchange(computer.find())


def test_connections_are_bounded_and_the_newest_is_served() -> None:
    with emulated_dex3(BOTH) as hands, contextlib.ExitStack() as opened:
        port = inside(hands).port
        with imported(port, b"1-2") as other:
            for _ in range(3 * MAX_CONNECTIONS):
                sock = opened.enter_context(socket.create_connection(("127.0.0.1", port), 5.0))
                sock.sendall(b"\x01")  # half a header, for ever
            with host(port) as computer:
                exchange(computer.find())
            assert len(inside(hands)._server._connections) <= MAX_CONNECTIONS
            submit(other, 1, OUT, 2, brake(Side.RIGHT))  # who has a hand keeps it
            assert reply(other)[:3] == (protocol.RET_SUBMIT, 1, 0)


def test_client_that_sends_no_request_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "IMPORT_TIMEOUT", 0.05)
    with emulated_dex3() as hands:
        port = inside(hands).port
        with imported(port) as quiet, socket.create_connection(("127.0.0.1", port), 5.0) as half:
            half.sendall(b"\x01\x11")
            assert half.recv(1) == b""
            submit(quiet, 1, OUT, 2, brake())  # who has a hand may be silent
            assert reply(quiet)[:3] == (protocol.RET_SUBMIT, 1, 0)


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(8),
        bytes(100),
        struct.pack(">HHI", protocol.VERSION, 0x8099, 0),
        b"\xff" * 5000,
    ],
)
def test_client_of_another_protocol_is_disconnected(garbage: bytes) -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with socket.create_connection(("127.0.0.1", port), timeout=60.0) as sock:
            sock.sendall(garbage)
            with contextlib.suppress(ConnectionResetError):
                assert sock.recv(100) == b""
        with host(port) as computer:
            exchange(computer.find())


@pytest.mark.parametrize(
    "command",
    [
        struct.pack(">IIIIIIiiii8s", 9, 1, 0, 0, 2, 0, 0, 0, 0, 0, bytes(8)),
        struct.pack(">IIIIIIiiii8s", 1, 1, 0, 0, 2, 0, 2**31 - 1, 0, 0, 0, bytes(8)),
        struct.pack(">IIIIIIiiii8s", 1, 1, 0, 0, 2, 0, -1, 0, 0, 0, bytes(8)),
    ],
    ids=["unknown command", "two gigabytes", "less than nothing"],
)
def test_invalid_data_after_the_import_disconnects_the_client(command: bytes) -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with imported(port) as sock, contextlib.suppress(ConnectionResetError):
            sock.sendall(command)
            assert sock.recv(100) == b""
        with host(port) as computer:
            exchange(computer.find())


def test_a_client_that_dies_in_the_middle_of_a_frame() -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with imported(port) as sock:
            sock.sendall(struct.pack(">IIIIIIiiii8s", 1, 1, 0, 0, 2, 0, 1234, 0, 0, 0, bytes(8)))
            sock.sendall(bytes(700))
        with host(port) as computer:
            assert exchange(computer.find()).mode.tolist() == [0] * 7
        assert inside(hands).device().counters.frames == 1


def keep_asking(sock: socket.socket) -> None:
    for seqnum in range(10**6):
        submit(sock, seqnum, IN, 0, b"")  # a control transfer without a request: refused


def test_client_that_reads_nothing_is_disconnected() -> None:
    with emulated_dex3(BOTH) as hands, socket.socket() as deaf:
        port = inside(hands).port
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.settimeout(60.0)
        deaf.connect(("127.0.0.1", port))
        protocol.client_import(deaf, b"1-1")
        with pytest.raises(ConnectionError):
            keep_asking(deaf)
        with host(port) as computer:
            exchange(computer.find(Side.RIGHT), side=Side.RIGHT)
            exchange(computer.find())


# --- the server's own


def test_the_port_is_in_use() -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with pytest.raises(EmulatorError) as caught, emulated_dex3(port=port):
            pass
        assert str(port) in caught.value.message
        assert "another port" in caught.value.hint
        with pytest.raises(EmulatorError) as caught, emulated_dex3(port=port, process=True):
            pass
        assert "another port" in caught.value.hint


def test_close_disconnects_clients_and_frees_the_port() -> None:
    with emulated_dex3() as hands:
        port = inside(hands).port
        with host(port) as computer:
            device = computer.find()
            exchange(device)
            hands.close()
            assert _lost(device)
    with emulated_dex3(port=port), host(port) as computer:
        exchange(computer.find())
