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


def test_broadcast_ping_is_answered_in_order_of_ids() -> None:
    host = three()
    packets = host.send(254, Instruction.PING)
    assert [(p.id, p.data[:2]) for p in packets] == [(i, b"\x37\x01") for i in (1, 2, 3)]


def test_sync_read_is_answered_in_the_order_asked() -> None:
    host = three()
    packets = host.send(254, Instruction.SYNC_READ, READ_POSITION + bytes([2, 3, 1]))
    assert [p.id for p in packets] == [2, 3, 1]
    assert all(mx64.PRESENT_POSITION.decode(p.data) == 2760 for p in packets)


def test_bulk_read_gives_each_its_own_block() -> None:
    host = three()
    packets = host.send(
        254, Instruction.BULK_READ, bytes([3, 144, 0, 2, 0]) + bytes([1, 146, 0, 1, 0])
    )
    assert [(p.id, len(p.data)) for p in packets] == [(3, 2), (1, 1)]


def test_group_read_with_missing_servo_stops_or_continues() -> None:
    params = READ_POSITION + bytes([1, 9, 2])
    assert [p.id for p in three().send(254, Instruction.SYNC_READ, params)] == [1]
    skips = dataclasses.replace(QUIET, missing_id_stalls=False)
    host = Host(servo(1, firmware=skips), servo(2, firmware=skips))
    assert [p.id for p in host.send(254, Instruction.SYNC_READ, params)] == [1, 2]


def test_an_error_in_a_sync_read_does_not_stop_the_others() -> None:
    packets = three().send(254, Instruction.SYNC_READ, bytes([71, 0, 1, 0, 1, 2]))
    assert [(p.id, p.error, p.data) for p in packets] == [
        (1, ErrorNumber.ACCESS, b""),
        (2, ErrorNumber.ACCESS, b""),
    ]


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


def test_group_read_to_single_id_is_refused() -> None:
    (answer,) = three().send(1, Instruction.SYNC_READ, READ_POSITION + b"\1")
    assert answer.error == ErrorNumber.INSTRUCTION


def test_status_packets_are_not_executed() -> None:
    host = three()
    assert host.send_raw(dxl.status(1, 0, b"\1")) == []
    assert host.bus.counters.instructions == 0


def test_sync_write_reaches_each_with_its_own_value() -> None:
    host = three()
    host.send(254, Instruction.SYNC_WRITE, b"\x41\0\1\0" + bytes([1, 1, 2, 0, 3, 1]))
    assert [read(s, mx64.LED) for s in host.bus.servos] == [1, 1, 0]


def test_bulk_write_reaches_each_with_its_own_item() -> None:
    host = three()
    params = bytes([1, 65, 0, 1, 0, 1]) + bytes([2, 84, 0, 2, 0]) + (700).to_bytes(2, "little")
    host.send(254, Instruction.BULK_WRITE, params)
    by_id = {s.id: s for s in host.bus.servos}
    assert read(by_id[1], mx64.LED) == 1
    assert read(by_id[2], mx64.POSITION_P_GAIN) == 700


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


def test_out_of_limit_goals_in_a_sync_write_are_ignored_or_clamped() -> None:
    params = b"\x66\0\2\0\1" + (1800).to_bytes(2, "little")
    for clamps, expected in ((False, 1000), (True, 1600)):
        target = servo(firmware=dataclasses.replace(QUIET, sync_write_clamps=clamps))
        write(target, mx64.CURRENT_LIMIT, 1600)
        write(target, mx64.GOAL_CURRENT, 1000)
        Host(target).send(254, Instruction.SYNC_WRITE, params)
        assert read(target, mx64.GOAL_CURRENT) == expected


def test_secondary_id_takes_part_in_sync_write() -> None:
    target = servo(1)
    write(target, mx64.SECONDARY_ID, 20)
    host = Host(target)
    host.send(254, Instruction.SYNC_WRITE, bytes([65, 0, 1, 0, 20, 1]))
    assert read(target, mx64.LED) == 1
    host.send(254, Instruction.SYNC_WRITE, bytes([9, 0, 1, 0, 20, 1]))
    assert read(target, mx64.RETURN_DELAY_TIME) == 250
    assert host.send(20, Instruction.PING) == []


def test_fast_reads_when_switched_on() -> None:
    fast = dataclasses.replace(QUIET, fast_reads=True)
    host = Host(servo(3, firmware=fast), servo(7, firmware=fast), servo(4, firmware=fast))
    (packet,) = host.send(254, Instruction.FAST_SYNC_READ, READ_POSITION + bytes([3, 7, 4]))
    parts = dxl.split_fast_status(packet, [4, 4, 4])
    position = (2760).to_bytes(4, "little")
    assert parts == [(3, 0, position), (7, 0, position), (4, 0, position)]
    asked = [(3, 132, 4), (7, 124, 2), (4, 146, 1)]
    params = b"".join(bytes([i, a, 0, n, 0]) for i, a, n in asked)
    (packet,) = host.send(254, Instruction.FAST_BULK_READ, params)
    assert [(i, len(d)) for i, _, d in dxl.split_fast_status(packet, [4, 2, 1])] == [
        (3, 4),
        (7, 2),
        (4, 1),
    ]


def test_a_fast_read_with_a_missing_servo_is_never_complete() -> None:
    fast = dataclasses.replace(QUIET, fast_reads=True)
    host = Host(servo(3, firmware=fast), servo(4, firmware=fast))
    params = READ_POSITION + bytes([3, 7, 4])
    raw = host.exchange_raw(dxl.encode(254, Instruction.FAST_SYNC_READ, params))
    assert raw[5:7] == (25).to_bytes(2, "little")
    assert len(raw) == 8 + 8
    assert dxl.PacketParser().feed(raw) == []


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


def test_new_baud_rate_is_used_from_next_packet() -> None:
    host = Host(servo(1))
    host.bus.host_baudrate = 1_000_000
    assert [p.error for p in host.send(1, Instruction.WRITE, b"\x08\0\1")] == [0]
    assert host.send(1, Instruction.PING) == []
    host.bus.host_baudrate = 57_600
    assert [p.id for p in host.send(1, Instruction.PING)] == [1]


def test_booting_servo_does_not_answer_until_started() -> None:
    host = Host(servo(1))
    assert [p.error for p in host.send(1, Instruction.REBOOT)] == [0]
    assert host.send(1, Instruction.PING) == []
    host.wait(QUIET.boot_time)
    assert [p.id for p in host.send(1, Instruction.PING)] == [1]


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


def test_bytes_take_longer_at_57600() -> None:
    target = servo(baudrate=57_600)
    write(target, mx64.RETURN_DELAY_TIME, 0)
    host = Host(target, latency_timer=0.0)
    host.bus.host_baudrate = 57_600
    read_4 = dxl.encode(1, 2, READ_POSITION)
    assert transaction(host, read_4) == pytest.approx(5.03e-3, abs=0.01e-3)


def test_latency_timer_rounds_up_to_ticks() -> None:
    target = servo()
    write(target, mx64.RETURN_DELAY_TIME, 0)
    for timer, expected in ((1e-3, 1e-3), (16e-3, 16e-3)):
        host = Host(target, latency_timer=timer)
        for _ in range(5):
            # a host that sends again at once is synchronous with the timer
            assert transaction(host, PING) == pytest.approx(expected)
            host.now = host.at


def test_sixty_two_bytes_do_not_wait_for_the_timer() -> None:
    target = servo()
    write(target, mx64.RETURN_DELAY_TIME, 0)
    host = Host(target, latency_timer=16e-3)
    data = dxl.encode(1, 2, bytes([168, 0, 80, 0]))
    host.bus.receive(data, 0.0)
    first = host.bus.next_time
    assert first == pytest.approx((14 + 62) * 10e-6)
    assert len(host.bus.due(first)) == 62
    assert host.bus.next_time == pytest.approx(16e-3)


def test_rate_at_one_megabaud_with_a_millisecond_timer() -> None:
    """A write and a read of 21 bytes, each with its own answer, by a host that needs no time."""
    target = servo()
    write(target, mx64.RETURN_DELAY_TIME, 2)
    host = Host(target)
    n = 0
    while host.now < 1.0:
        for data in (dxl.encode(1, 3, b"\x74\0" + bytes(4)), dxl.encode(1, 2, b"\x7e\0\x15\0")):
            assert host.exchange_raw(data)
            host.now = host.at
        n += 1
    assert n == 500  # each of the two ends at the next tick


def test_an_untuned_adapter_gives_sixty_reads_a_second() -> None:
    host = Host(servo(), latency_timer=16e-3)
    n = 0
    while host.now < 1.0:
        assert host.exchange_raw(dxl.encode(1, 2, READ_POSITION))
        host.now = host.at
        n += 1
    assert n == 63  # one at each tick of the first second; docs/sources/mx64-ezgripper.md#c2


def test_without_line_time_answers_are_immediate() -> None:
    host = Host(servo(), line_time=False)
    assert transaction(host, PING) == 0.0


def test_answers_queue_on_the_line() -> None:
    host = three(latency_timer=0.0)
    for target in host.bus.servos:
        write(target, mx64.RETURN_DELAY_TIME, 0)
    data = dxl.encode(254, Instruction.SYNC_READ, READ_POSITION + bytes([1, 2, 3]))
    assert transaction(host, data) == pytest.approx((len(data) + 3 * 15) * 10e-6)


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


def test_delay_fault_delays_answers_until_it_ends() -> None:
    host = Host(servo(), faults=("delay:ms=30,for=1s",), latency_timer=0.0)
    assert transaction(host, PING) == pytest.approx(0.03, abs=0.002)
    host.wait(1.0)
    assert transaction(host, PING) < 0.002


def test_random_faults_repeat_with_same_seed() -> None:
    def answers(seed: int) -> list[bytes]:
        host = Host(servo(), faults=("drop:p=0.5", "corrupt:p=0.5"), seed=seed)
        return [host.exchange_raw(PING) for _ in range(40)]

    assert answers(1) == answers(1) != answers(2)


def test_stuck_fault_holds_for_its_duration() -> None:
    target = servo()
    host = Host(target, faults=("stuck:for=1s",))
    write(target, mx64.OPERATING_MODE, 5)
    write(target, mx64.TORQUE_ENABLE, 1)
    write(target, mx64.GOAL_POSITION, 3500)
    host.wait(0.9)
    assert read(target, mx64.PRESENT_POSITION) == 2760
    host.wait(1.5)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(3500, abs=20)


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


def test_counters_count_packets_and_errors() -> None:
    host = Host(servo())
    host.send_raw(b"junk" + PING)
    counters = host.bus.counters
    assert (counters.bytes_in, counters.bytes_out) == (14, 14)
    assert (counters.instructions, counters.statuses, counters.skipped) == (1, 1, 4)
    assert "1 instructions" in counters.summary()


# --- Protocol 1.0 firmware


def test_protocol_1_servo_answers_its_own_protocol_only() -> None:
    host = Host.__new__(Host)
    host.bus = Bus([], protocol_1=[Protocol1Servo(1)])
    host.now = host.at = 0.0
    assert host.exchange_raw(PING) == b""
    host.wait(0.01)
    ping_1 = bytes.fromhex("ffff010201fb")
    assert host.exchange_raw(b"\0\xff" + ping_1) == bytes.fromhex("ffff010200fc")
    read_model = bytes.fromhex("ffff0104020002f6")
    assert host.exchange_raw(read_model)[5:7] == b"\x36\x01"
    assert host.exchange_raw(bytes.fromhex("fffffe0201fe")) == bytes.fromhex("ffff010200fc")
    assert host.exchange_raw(bytes.fromhex("ffff010201fa")) == b""  # wrong checksum
    write_led = bytes.fromhex("ffff01040319 01 dd".replace(" ", ""))
    assert host.exchange_raw(write_led)[4] == 0x40


@given(st.binary(max_size=200))
@settings(deadline=None)
def test_protocol_1_servo_accepts_any_bytes(noise: bytes) -> None:
    old = Protocol1Servo(1)
    old.feed(noise)
    for _ in range(3):
        old.feed(bytes(150))
    assert old.feed(bytes.fromhex("ffff010201fb")) == [bytes.fromhex("ffff010200fc")]


def test_bus_sends_nothing_without_instruction() -> None:
    host = three()
    host.wait(5.0)
    assert host.bus.next_time is None
    assert host.bus.due(host.now) == b""
