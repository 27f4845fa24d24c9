"""Test Modbus: frames, and the emulated hands behind a client that nobody here wrote."""

from __future__ import annotations

import contextlib
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from dexkit.child_processes import command_line
from dexkit.cli.emulate import command
from dexkit.emulators.revo2 import Revo2Hand
from dexkit.emulators.rh56 import Rh56TcpHand
from dexkit.errors import ChecksumError, EncodeError, TruncatedError, UsageError, WireError
from dexkit.hand import Side
from dexkit.wire import modbus
from dexkit.wire.modbus import Adu, Function, Refusal, Request, RtuParser, TcpParser
from dexkit.wire.rh56 import Error, Register
from tests.each import each
from tests.patience import PATIENCE

PATIENT = 5.0  # s; a busy machine answers late

# docs/sources/unitree-dex.md#j1: what BrainCo's library sends to a left hand
BRAINCO = {
    "7e03038500019e68": Request(Function.READ_HOLDING, 901),
    "7e0603a900005261": Request(Function.WRITE_ONE, 937, 1, (0,)),
    "7e0407d00018fb42": Request(Function.READ_INPUT, 2000, 24),
    "7e1003fe000c18000b0065001600ca0021012f002c0194003701f90042025e146e": Request.write(
        1022, [11, 101, 22, 202, 33, 303, 44, 404, 55, 505, 66, 606]
    ),
    "7e10040a00060c0065ff36012f019401f9025e18a7": Request.write(
        1034, [101, -202, 303, 404, 505, 606]
    ),
}


@each(("frame", "request_"), [(bytes.fromhex(text), r) for text, r in BRAINCO.items()])
def test_frames_are_those_of_braincos_library(frame: bytes, request_: Request) -> None:
    assert Adu(126, request_.pack()).pack_rtu() == frame
    (adu,) = RtuParser(answers=False).feed(frame)
    assert adu == Adu(126, request_.pack())
    found = modbus.parse_request(adu.pdu)
    assert (found.function, found.address, found.count) == (
        request_.function,
        request_.address,
        request_.count,
    )
    assert modbus.signed(found.values) == request_.values


WORDS = st.integers(0, 0xFFFF)
REQUESTS = st.one_of(
    st.builds(
        Request,
        st.sampled_from([Function.READ_HOLDING, Function.READ_INPUT]),
        WORDS,
        st.integers(1, modbus.MOST_READ),
    ),
    st.builds(Request.write, WORDS, st.lists(WORDS, min_size=1, max_size=modbus.MOST_WRITTEN)),
    st.builds(
        lambda at, value: Request(Function.WRITE_ONE, at, 1, (value,)),
        WORDS,
        WORDS,
    ),
)


@given(REQUESTS, st.integers(0, 255), WORDS, st.data())
@settings(max_examples=25, deadline=None)
def test_requests_and_answers_survive_both_framings(
    request_: Request, unit: int, number: int, data: st.DataObject
) -> None:
    count = request_.count if request_.function in (3, 4) else 0
    values = data.draw(st.lists(WORDS, min_size=count, max_size=count))
    cut = data.draw(st.integers(0, 12))
    assert modbus.parse_request(request_.pack()) == request_
    answer = modbus.answer(request_, values)
    assert modbus.parse_answer(answer, request_) == tuple(values)
    for pdu, answers in ((request_.pack(), False), (answer, True)):
        tcp, rtu = Adu(unit, pdu, number), Adu(unit, pdu)
        for parser, frame, adu in (
            (TcpParser(), tcp.pack_tcp(), tcp),
            (RtuParser(answers=answers), rtu.pack_rtu(), rtu),
        ):
            found = [*parser.feed(frame[:cut]), *parser.feed(frame[cut:] + frame)]
            assert found == [adu, adu]
            assert (parser.skipped, parser.pending) == (0, 0)


@given(st.binary(max_size=60), st.booleans())
def test_garbage_is_skipped_and_a_frame_behind_it_is_found(noise: bytes, answers: bool) -> None:
    parser = RtuParser(answers=answers)
    found = parser.feed(noise)
    parser.reset()
    assert sum(len(f.pack_rtu()) for f in found) + parser.skipped == len(noise)
    tcp = TcpParser()
    tcp.feed(noise)
    assert tcp.pending < 260
    for parse in (modbus.parse_request, lambda pdu: modbus.parse_answer(pdu, ASKED)):
        with contextlib.suppress(WireError):
            parse(noise)


ASKED = Request(Function.READ_HOLDING, 5, 2)


def test_damaged_frames_are_refused() -> None:
    good = Adu(1, Request(Function.READ_HOLDING, 5, 2).pack()).pack_rtu()
    with pytest.raises(ChecksumError):
        Adu.parse_rtu(good[:-1] + bytes([good[-1] ^ 1]))
    with pytest.raises(TruncatedError):
        Adu.parse_rtu(good[:3])
    parser = RtuParser(answers=False)
    assert [a.pdu for a in parser.feed(good[:-1] + b"\0" + good)] == [good[1:-2]]
    assert parser.damaged >= 1
    tcp = TcpParser()
    assert tcp.feed(b"GET / HTTP/1.1\r\n\r\n") == []
    assert tcp.broken
    for bad in (
        Request.write(0, []),
        Request.write(0, [70000]),
        Request(Function.READ_INPUT, 0, 126),
        Request(Function.READ_INPUT, 70000),
        Request(Function.WRITE_ONE, 0),
    ):
        with pytest.raises(EncodeError):
            bad.pack()
    with pytest.raises(EncodeError):
        Adu(256, b"").pack_rtu()
    with pytest.raises(EncodeError):
        Adu(1, b"", 70000).pack_tcp()


def test_requests_that_a_device_refuses_and_answers_that_are_none() -> None:
    for pdu, code in ((b"\x2b\x0e\x01\x00", 1), (bytes.fromhex("0300050000"), 3)):
        with pytest.raises(Refusal) as refusal:
            modbus.parse_request(pdu)
        assert refusal.value.code == code
    with pytest.raises(Refusal, match="illegal address"):
        modbus.parse_answer(modbus.refuse(3, 2), ASKED)
    for pdu in (b"", b"\x03", b"\x04\x04\0\0\0\0", b"\x03\x02\0\0", b"\x03\x05\0\0\0\0"):
        with pytest.raises(WireError):
            modbus.parse_answer(pdu, ASKED)
    write = Request.write(5, [1, 2])
    with pytest.raises(WireError):
        modbus.parse_answer(modbus.answer(Request.write(6, [1, 2])), write)


# ---------------------------------------------------------------- the emulated hands, and pymodbus


def registers(answer: Any) -> list[int]:
    assert not answer.isError(), answer
    return list(answer.registers)


def test_pymodbus_drives_the_emulated_rh56() -> None:
    with Rh56TcpHand(Side.RIGHT, start_pct=0.0) as hand:
        host, port = hand.path.split(":")
        client = ModbusTcpClient(host, port=int(port), timeout=PATIENT)
        try:
            assert client.connect()
            assert (
                registers(client.read_holding_registers(Register.ANGLE_ACT, count=6)) == [1000] * 6
            )
            goals = [0, 100, 200, 300, 400, 0xFFFF]
            assert not client.write_registers(Register.ANGLE_SET, goals, device_id=255).isError()
            assert hand.device.goals == [0, 100, 200, 300, 400, None]
            # one register, of one joint
            assert not client.write_register(Register.ANGLE_SET + 2 * 5, 950).isError()
            assert hand.device.goals[5] == 950
            assert not client.write_registers(Register.SPEED_SET, [500] * 6).isError()
            read = registers(client.read_holding_registers(Register.SPEED_SET, count=6))
            assert read == [500] * 6
            hand.inject("locked")
            while registers(client.read_holding_registers(Register.ERROR, count=3)) != [0x0101] * 3:
                pass
            assert not client.write_register(Register.CLEAR_ERROR, 1).isError()
            assert hand.device.errors == [Error(0)] * 6
            assert client.read_coils(0).exception_code == 1
        finally:
            client.close()


def test_pymodbus_drives_the_emulated_revo2() -> None:
    with Revo2Hand(Side.LEFT, start_pct=0.0) as hand:
        client = ModbusSerialClient(
            hand.path, framer=FramerType.RTU, baudrate=460800, timeout=PATIENT
        )
        try:
            assert client.connect()
            unit = {"device_id": 126}
            assert registers(client.read_holding_registers(901, **unit)) == [2]
            assert registers(client.read_input_registers(2000, count=24, **unit))[:6] == [0] * 6
            pairs = [100, 500, 200, 500, 300, 500, 400, 500, 500, 500, 600, 0]
            assert not client.write_registers(1022, pairs, **unit).isError()
            assert hand.device.goals == pairs[::2]
            assert hand.device.speeds == [500] * 5 + [1000]  # 0 is the highest
            while True:
                read = registers(client.read_input_registers(2000, count=24, **unit))
                if read[:6] == pairs[::2] and not any(read[6:12]):
                    break
            assert read[18:] == [0] * 6
            text = registers(client.read_input_registers(3000, count=10, **unit))
            assert b"".join(v.to_bytes(2, "big") for v in text).startswith(b"1.0.14.U")
            for refused in (
                client.write_register(937, 1, **unit),
                client.write_registers(1022, [1001] * 12, **unit),
                client.write_registers(1040, [0] * 6, **unit),
                client.read_input_registers(2022, count=3, **unit),
            ):
                assert refused.isError()
                assert refused.exception_code in (2, 3)
        finally:
            client.close()


def test_commands_serve_until_they_are_stopped(tmp_path: Path) -> None:
    link = tmp_path / "hand"
    arguments = (
        ("rh56", "--link", "tcp://127.0.0.1:0"),
        ("revo2", "--side", "left", "--link", str(link)),
    )
    started = [
        subprocess.Popen(
            command_line("emulate", *each_), stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for each_ in arguments
    ]
    ready = [process.stdout.readline().decode() for process in started if process.stdout]
    assert ready[0].startswith("ready: 127.0.0.1:")
    assert ready[0].endswith(" right modbus-tcp\n")
    assert ready[1] == f"ready: {link} left id=126 baudrate=460800\n"
    host, port = ready[0].split()[1].split(":")
    client = ModbusTcpClient(host, port=int(port), timeout=PATIENT)
    assert client.connect()
    assert len(registers(client.read_holding_registers(Register.ANGLE_ACT, count=6))) == 6
    client.close()
    for process in started:
        process.send_signal(signal.SIGTERM)
    for process, seen in zip(
        started, ("12 bytes in, 21 bytes out", "nothing was sent"), strict=True
    ):
        out, err = process.communicate(timeout=PATIENCE)
        assert (process.returncode, err) == (0, b"")
        assert f": {seen}" in out.decode()
    assert list(tmp_path.iterdir()) == []


@each(
    "arguments",
    [
        ("--link", "x", "--link", "tcp://127.0.0.1:0"),
        ("--link", "tcp://127.0.0.1:0", "--set", "baudrate=9600"),
        ("--link", "tcp://127.0.0.1:0", "--set", "id=2"),
        ("--link", "tcp://127.0.0.1:0", "--fault", "corrupt"),
        ("--link", "tcp://127.0.0.1:0", "--side", "both"),
        ("--link", "tcp://0.0.0.0:0"),
    ],
)
def test_options_that_do_not_go_together(arguments: tuple[str, ...]) -> None:
    result = CliRunner().invoke(command, ["rh56", *arguments])
    assert isinstance(result.exception, UsageError)
