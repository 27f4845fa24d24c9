"""Test several emulated servos on a line: order, line time, invalid bytes and faults
(docs/sources/mx64-ezgripper.md#a5,
docs/sources/mx64-ezgripper.md#c1, docs/sources/mx64-ezgripper.md#c2).
"""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.emulators.faults import MX64_FAULTS, FaultSchedule, grammar, parse_fault
from dexkit.emulators.mx64 import Bus
from dexkit.emulators.mx64.protocol1 import Protocol1Servo
from dexkit.errors import UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import ErrorNumber, Instruction
from dexkit.wire.mx64 import HardwareError
from tests.each import each
from tests.mx64_helpers import QUIET, Host, read, servo, write

READ_POSITION = bytes([132, 0, 4, 0])
PING = dxl.encode(1, Instruction.PING)


def three(**options: object) -> Host:
    return Host(servo(3), servo(1), servo(2), **options)


# --- order of answers


@each(
    ("code", "params"),
    [
        (Instruction.READ, READ_POSITION),
        (Instruction.WRITE, b"\x41\0\1"),
        (Instruction.ACTION, b""),
        (Instruction.REBOOT, b""),
        (0x77, b""),
        (Instruction.SYNC_WRITE, b"\x41\0\1\0\1\1"),
        (Instruction.SYNC_READ, b"\x84\0\4\0"),  # no ids
        (Instruction.SYNC_READ, READ_POSITION + b"\1\1"),  # an id twice
        (Instruction.BULK_READ, b"\1\x84\0\4"),
        (Instruction.BULK_READ, b"\1\x84\0\4\0\1\x84\0\4\0"),
        (Instruction.FAST_SYNC_READ, READ_POSITION + b"\1"),
        (Instruction.FAST_BULK_READ, b"\1\x84\0\4\0"),
        (Instruction.CONTROL_TABLE_BACKUP, b"\1CTRL"),
    ],
)
def test_broadcasts_without_answer(code: int, params: bytes) -> None:
    assert three().send(254, code, params) == []


@each(
    ("code", "params"),
    [
        (Instruction.SYNC_WRITE, b"\x41\0\1"),
        (Instruction.SYNC_WRITE, b"\x41\0\0\0\1"),
        (Instruction.SYNC_WRITE, b"\x41\0\1\0\1"),
        (Instruction.SYNC_WRITE, b"\x41\0\1\0\1\1\1\1"),
        (Instruction.BULK_WRITE, b"\1\x41\0\1\0"),
        (Instruction.BULK_WRITE, b"\1\x41\0\1\0\1\2"),
        (Instruction.BULK_WRITE, b"\1\x41\0\1\0\1\1\x41\0\1\0\1"),
    ],
)
def test_malformed_group_writes_change_nothing(code: int, params: bytes) -> None:
    host = three()
    host.send(254, code, params)
    host.send(1, code, b"\x41\0\1\0\1\1")
    assert [read(s, mx64.LED) for s in host.bus.servos] == [0, 0, 0]


def test_two_servos_with_one_id_answer_at_the_same_time() -> None:
    host = Host(servo(1), servo(2, closed_at=1000))
    host.send(2, Instruction.WRITE, b"\x07\0\1")
    raw = host.exchange_raw(dxl.encode(1, Instruction.READ, READ_POSITION))
    assert raw
    assert dxl.PacketParser().feed(raw) == []
    # equal answers collide unnoticed, as on a real bus
    assert [p.id for p in host.send(1, Instruction.PING)] == [1]


def test_one_bus_refuses_one_id_twice() -> None:
    with pytest.raises(UsageError):
        Bus([servo(1), servo(1)])
    with pytest.raises(UsageError):
        Bus([])
    with pytest.raises(UsageError):
        Bus([servo(1)], latency_timer=-1.0)


def test_servo_receives_only_at_its_baud_rate() -> None:
    host = Host(servo(1, baudrate=57_600), servo(2))
    host.bus.host_baudrate = 1_000_000
    assert host.send(1, Instruction.PING) == []
    assert [p.id for p in host.send(254, Instruction.PING)] == [2]
    host.bus.host_baudrate = 57_600
    assert [p.id for p in host.send(254, Instruction.PING)] == [1]
    host.bus.host_baudrate = 115_200
    assert host.send(254, Instruction.PING) == []
    assert host.bus.counters.garbled == 10


def test_bad_crc_gives_no_answer_or_an_error() -> None:
    bad = PING[:-1] + bytes([PING[-1] ^ 1])
    host = Host(servo(1))
    assert host.send_raw(bad) == []
    assert host.bus.counters.crc_errors == 1
    answers = Host(servo(1, firmware=dataclasses.replace(QUIET, answer_bad_crc=True)))
    assert [p.error for p in answers.send_raw(bad)] == [ErrorNumber.CRC]


# --- recovery after invalid bytes


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.integers(1, 9).map(lambda n: PING[:n]),
            st.integers(0, 1023).map(lambda n: dxl.HEADER + b"\1" + n.to_bytes(2, "little")),
            st.sampled_from([0x01, 0x02, 0x03, 0x04, 0x82, 0x92]).flatmap(
                lambda code: st.binary(max_size=20).map(lambda p: dxl.encode(254, code, p))
            ),
        ),
        max_size=8,
    )
)
def test_ping_after_any_bytes_is_answered(pieces: list[bytes]) -> None:
    """Given only a pause of more than 1.5 ms, in which a packet begun is dropped."""
    host = Host(servo(1))
    for piece in pieces:
        host.exchange_raw(piece)
    for _ in range(2):
        # at the first ping the servo may reboot, or have a new id from a random broadcast write
        host.wait(0.5)
        packets = host.send(254, Instruction.PING)
    assert len(packets) == 1


def test_a_half_packet_is_dropped_after_the_gap() -> None:
    host = Host(servo(1))
    assert host.exchange_raw(PING[:6]) == b""
    host.wait(0.001)
    assert len(host.exchange_raw(PING[6:])) == 14  # within the gap the rest still counts
    assert host.exchange_raw(PING[:6]) == b""
    host.wait(0.002)
    assert host.exchange_raw(PING[6:]) == b""
    host.wait(0.002)
    assert len(host.exchange_raw(PING)) == 14


# --- line time


def transaction(host: Host, data: bytes) -> float:
    begin = host.now
    assert host.exchange_raw(data)
    return host.at - begin


@each(
    ("what", "data", "wire_us"),
    [
        # the manual's table at 1 Mbaud without return delay (docs/sources/mx64-ezgripper.md#c1)
        ("ping", PING, 240),
        ("read 4", dxl.encode(1, 2, READ_POSITION), 290),
        ("read 10", dxl.encode(1, 2, bytes([126, 0, 10, 0])), 350),
        ("sync read 21", dxl.encode(254, 0x82, bytes([126, 0, 21, 0, 1])), 470),
        ("write 4", dxl.encode(1, 3, b"\x74\0" + bytes(4)), 270),
    ],
)
@each("delay", [0, 2, 250])
def test_transactions_take_line_time(what: str, data: bytes, wire_us: int, delay: int) -> None:
    target = servo()
    write(target, mx64.RETURN_DELAY_TIME, delay)
    host = Host(target, latency_timer=0.0)
    expected = wire_us * 1e-6 + delay * 2e-6
    assert transaction(host, data) == pytest.approx(expected, abs=1e-9)


# --- faults


@each(
    ("text", "kind", "at", "duration", "params", "device"),
    [
        ("overload@3s", "overload", 3.0, None, {}, None),
        ("overload@3:id=2", "overload", 3.0, None, {}, 2),
        ("drop:p=0.05", "drop", 0.0, None, {"p": 0.05}, None),
        ("drop", "drop", 0.0, None, {"p": 1.0}, None),
        ("corrupt@1.5s:p=.5,for=250ms", "corrupt", 1.5, 0.25, {"p": 0.5}, None),
        ("delay:ms=30", "delay", 0.0, None, {"ms": 30.0, "p": 1.0}, None),
        ("unplug@5s:for=2s", "unplug", 5.0, 2.0, {}, None),
        ("brown-out@4s:volts=7,for=1s,id=1", "brown-out", 4.0, 1.0, {"volts": 7.0}, 1),
        ("overheat:c=90", "overheat", 0.0, None, {"c": 90.0}, None),
        ("stuck@500ms", "stuck", 0.5, None, {}, None),
        (" shock ", "shock", 0.0, None, {}, None),
        ("encoder", "encoder", 0.0, None, {}, None),
    ],
)
def test_faults_of_the_bus_are_parsed(
    text: str,
    kind: str,
    at: float,
    duration: float | None,
    params: dict[str, float],
    device: int | None,
) -> None:
    fault = parse_fault(text)
    assert (fault.kind, fault.at, fault.duration) == (kind, at, duration)
    assert (fault.params, fault.device) == (params, device)


@each(
    "text",
    [
        "",
        "fire",
        "Overload",
        "overload@",
        "overload@soon",
        "overload@-1s",
        "overload@3m",
        "overload:for=2s",  # does not end by itself
        "drop:p=2",
        "drop:p",
        "drop:p=x",
        "drop:p=nan",
        "drop:id=1",  # the line has no id
        "drop:",
        "stuck:id=300",
        "delay:ms=-1",
        "delay:ms=1e9",
        "unplug@5s:for=ever",
    ],
)
def test_invalid_fault_error_lists_allowed_faults(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_fault(text)
    assert all(kind.name in caught.value.hint for kind in MX64_FAULTS.kinds)
    assert caught.value.hint == grammar()


def test_schedule_begins_and_ends_in_order() -> None:
    faults = [parse_fault(t) for t in ("drop@1s:for=2s", "stuck@2s:for=500ms", "overload@4s")]
    schedule = FaultSchedule(faults, start=10.0)
    assert schedule.next_time == 11.0
    assert schedule.poll(10.9) == []
    assert [(f.kind, b) for f, b in schedule.poll(11.0)] == [("drop", True)]
    assert [f.kind for f in schedule.active] == ["drop"]
    assert [(f.kind, b) for f, b in schedule.poll(20.0)] == [
        ("stuck", True),
        ("stuck", False),
        ("drop", False),
        ("overload", True),
    ]
    assert schedule.active == []
    assert schedule.next_time is None


@each(
    ("spec", "error"),
    [
        ("overload", HardwareError.OVERLOAD),
        ("encoder", HardwareError.ENCODER),
        ("shock", HardwareError.ELECTRICAL_SHOCK),
        ("overheat:c=90", HardwareError.OVERHEATING),
        ("brown-out:volts=9", HardwareError.INPUT_VOLTAGE),
    ],
)
def test_fault_sets_hardware_error(spec: str, error: HardwareError) -> None:
    name, _, args = spec.partition(":")
    host = Host(servo(1), servo(2), faults=(f"{name}@1s:id=2" + ("," + args if args else ""),))
    host.wait(0.9)
    assert host.bus.servos[1].hardware_error == 0
    host.wait(0.2)
    assert host.bus.servos[1].hardware_error == error
    assert host.bus.servos[0].hardware_error == 0
    (packet,) = host.send(2, Instruction.PING)
    assert packet.alert


def test_drop_loses_given_part_of_answers() -> None:
    host = Host(servo(), faults=("drop:p=0.3",), line_time=False)
    answered = sum(bool(host.exchange_raw(PING)) for _ in range(1000))
    assert 640 < answered < 760
    assert host.bus.counters.dropped == 1000 - answered


def test_corrupt_damages_given_part_of_answers() -> None:
    host = Host(servo(), faults=("corrupt:p=0.2",), line_time=False)
    good = Host(servo(), line_time=False).exchange_raw(PING)
    raws = [host.exchange_raw(PING) for _ in range(500)]
    spoilt = sum(raw != good for raw in raws)
    assert 70 < spoilt < 130
    assert all(not dxl.PacketParser().feed(raw) for raw in raws if raw != good)


def test_random_faults_repeat_with_same_seed() -> None:
    def answers(seed: int) -> list[bytes]:
        host = Host(servo(), faults=("drop:p=0.5", "corrupt:p=0.5"), seed=seed)
        return [host.exchange_raw(PING) for _ in range(40)]

    assert answers(1) == answers(1) != answers(2)


def test_deep_brown_out_restarts_the_servo() -> None:
    target = servo()
    host = Host(target, faults=("brown-out@1s:volts=3,for=500ms",))
    write(target, mx64.LED, 1)
    host.wait(1.2)
    assert host.send(1, Instruction.PING) == []
    host.wait(1.0)
    assert [p.id for p in host.send(1, Instruction.PING)] == [1]
    assert read(target, mx64.LED) == 0


def test_unplugged_bus_loses_pending_bytes() -> None:
    host = Host(servo(), faults=("unplug@1s:for=1s",))
    host.wait(0.9995)
    host.bus.receive(PING, host.now)
    host.wait(0.1)
    assert host.bus.unplugged
    assert host.bus.due(host.now + 1) == b""
    host.wait(1.0)
    assert not host.bus.unplugged


# --- Protocol 1.0 firmware


@given(st.binary(max_size=200))
@settings(deadline=None)
def test_protocol_1_servo_accepts_any_bytes(noise: bytes) -> None:
    old = Protocol1Servo(1)
    old.feed(noise)
    for _ in range(3):
        old.feed(bytes(150))
    assert old.feed(bytes.fromhex("ffff010201fb")) == [bytes.fromhex("ffff010200fc")]
