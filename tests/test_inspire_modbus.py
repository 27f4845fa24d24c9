"""Test the driver of an Inspire RH56 on TCP, with the emulated one and with pymodbus' server."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from pymodbus.simulator import DataType, SimData, SimDevice

from dexkit.backends import BackendOptions, backend
from dexkit.drivers import inspire_modbus
from dexkit.drivers.channel import TcpChannel, tcp_address
from dexkit.drivers.inspire_modbus import InspireModbus, InspireModbusSettings
from dexkit.drivers.request_line import RequestLine, RequestStatistics
from dexkit.emulators.faults import RH56_TCP_FAULTS, parse_fault
from dexkit.emulators.rh56 import Rh56TcpHand
from dexkit.emulators.tcp_port import TcpPort
from dexkit.errors import (
    EmulatorError,
    HandLost,
    HandNotFound,
    HandTimeout,
    UsageError,
)
from dexkit.hand import HandCommand, MotorError, Side
from dexkit.wire.modbus import TcpParser
from tests.dds_helpers import wait_until
from tests.each import each
from tests.patience import PATIENCE

N = 6
PATIENT = 1.0  # s; a busy machine answers late


def driver(place: str, **change: object) -> InspireModbus:
    values: dict[str, object] = {"device": place, "timeout": PATIENT, **change}
    return InspireModbus(Side.RIGHT, InspireModbusSettings(**values))  # type: ignore[arg-type]


@pytest.fixture
def emulated() -> Iterator[Rh56TcpHand]:
    with Rh56TcpHand(Side.RIGHT, start_pct=0.0) as hand:
        yield hand


def until_lost(hand: InspireModbus) -> None:
    ends = time.monotonic() + 60.0
    while time.monotonic() < ends:
        hand.exchange(HandCommand.position([0.0] * N))


def test_locked_hand_is_cleared_and_does_not_continue_to_its_old_goal(
    emulated: Rh56TcpHand,
) -> None:
    with driver(emulated.path) as hand:
        hand.exchange(HandCommand.position([0.0] * N))
        emulated.inject("locked")
        ends = time.monotonic() + 60.0
        while not (state := hand.exchange(HandCommand.position([0.0] * N))).fault.any():
            assert time.monotonic() < ends
        assert set(state.fault) == {MotorError.LOCKED}
        emulated.inject("unplug:for=100ms")
        with pytest.raises(HandLost):
            until_lost(hand)
        stood = state.q
        while True:
            try:
                hand.open()
                break
            except (HandNotFound, HandLost):
                assert time.monotonic() < ends
        assert not emulated.device.errors[0]
        assert np.allclose([(goal or 0) / 1000 for goal in emulated.device.goals], stood, atol=0.3)
        wait_until(lambda: emulated.device.resting)  # each joint ends at its own angle


@contextmanager
def answering(answer: bytes | None) -> Iterator[str]:
    """A server that answers everything by these bytes, or closes."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(20.0)

    def serve() -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            with client:
                while answer is not None and client.recv(4096):
                    client.sendall(answer)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join()


@each(
    ("answer", "error"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", HandLost),
        (None, HandLost),
        # refused; another transaction's; another function
        (bytes.fromhex("000100000003019002"), HandNotFound),
        (bytes.fromhex("7777000000060110 05f2 0006"), HandNotFound),
        (bytes.fromhex("000100000003010302"), HandNotFound),
    ],
)
def test_another_server_is_not_taken_for_a_hand(
    answer: bytes | None, error: type[Exception]
) -> None:
    with answering(answer) as place:
        hand = driver(place, timeout=0.05)
        with pytest.raises(error):
            hand.open()
        with pytest.raises(HandLost, match="not connected"):
            hand.exchange(HandCommand.brake(N))


def test_refused_connection_and_missing_address() -> None:
    with pytest.raises(HandNotFound, match="no address of the hand"):
        InspireModbus(Side.LEFT).open()
    with TcpPort(Rh56TcpHand().port.line) as port:
        place = port.path
        with pytest.raises(EmulatorError, match="cannot listen"):
            TcpPort(port.line, port.port)
    with pytest.raises(HandNotFound, match="no connection"):
        driver(place).open()
    assert tcp_address("192.168.11.210", 6000) == ("192.168.11.210", 6000)
    assert tcp_address("[::1]:7", 6000) == ("::1", 7)
    for bad in ("", "a b:x", "host:0", "host:70000", "http://host", "u@host", "host/x"):
        with pytest.raises(UsageError):
            tcp_address(bad, 6000)


def test_a_connection_that_takes_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the system would still send when the network is back must not move the hand."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        channel = TcpChannel("127.0.0.1", listener.getsockname()[1], 5.0)
        peer, _ = listener.accept()
        line = RequestLine(RequestStatistics(), 0.01)
        with pytest.raises(HandTimeout):
            line.ask(channel, b"goal", TcpParser(), lambda adu: None)
        monkeypatch.setattr(TcpChannel, "unsent", property(lambda self: 4))
        with pytest.raises(HandLost, match="no old goal"):
            line.ask(channel, b"goal", TcpParser(), lambda adu: None)
        channel.close()
        with peer, pytest.raises(ConnectionResetError):
            [*iter(lambda: peer.recv(100), b"")]


def test_driver_speaks_to_pymodbus_server() -> None:
    # not above: it brings a web server, which every worker of a run would import
    from pymodbus.server import ModbusTcpServer

    written: list[tuple[int, list[int]]] = []

    def trace(sending: bool, pdu: object) -> object:
        values = getattr(pdu, "registers", [])
        if not sending and values:
            written.append((pdu.address, list(values)))  # type: ignore[attr-defined]
        return pdu

    memory = [
        SimData(1004, count=1, values=0, datatype=DataType.REGISTERS),
        SimData(1486, count=60, values=0, datatype=DataType.REGISTERS),
        SimData(1546, count=6, values=700, datatype=DataType.REGISTERS),
        SimData(1552, count=100, values=0, datatype=DataType.REGISTERS),
    ]
    place: list[str] = []
    stops: list[asyncio.Event] = []
    ready, loop = threading.Event(), asyncio.new_event_loop()

    async def serve() -> None:
        stops.append(asyncio.Event())
        device = SimDevice(id=1, simdata=memory)
        server = ModbusTcpServer(device, address=("127.0.0.1", 0), trace_pdu=trace)  # type: ignore[arg-type]
        await server.serve_forever(background=True)
        port = server.transport.sockets[0].getsockname()[1]  # type: ignore[union-attr]
        place.append(f"127.0.0.1:{port}")
        ready.set()
        await stops[0].wait()
        await server.shutdown()

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    try:
        assert ready.wait(PATIENCE)
        with driver(place[0], force=300) as hand:
            state = hand.exchange(HandCommand.position([0.25] * N))
            assert np.allclose(state.q, 0.7)
    finally:
        loop.call_soon_threadsafe(lambda: stops[0].set())
        thread.join()
        loop.close()
    assert written == [
        (1522, [1000] * N),
        (1498, [300] * N),
        (1486, [250] * N),
        (1486, [700] * N),  # it holds when it is closed
    ]


def test_backend_inspire_modbus_reads_its_settings() -> None:
    assert backend("inspire-modbus") is inspire_modbus.backend
    options = BackendOptions(Side.LEFT, "10.0.0.2:7000", {"id": "255", "speed": "500"})
    made = inspire_modbus.backend.make(options)
    assert isinstance(made, InspireModbus)
    assert made.configuration == InspireModbusSettings("10.0.0.2:7000", id=255, speed=500)
    for bad in ({"id": "256"}, {"speed": "-1"}, {"timeout": "x"}):
        with pytest.raises(UsageError):
            inspire_modbus.backend.make(BackendOptions(Side.LEFT, "10.0.0.2", bad))
    with pytest.raises(UsageError):
        inspire_modbus.backend.make(BackendOptions(Side.LEFT, "http://x/", {}))
    with pytest.raises(UsageError):
        parse_fault("corrupt", RH56_TCP_FAULTS)
