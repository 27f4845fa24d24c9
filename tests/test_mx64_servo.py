"""Test registers and instructions of one emulated servo (docs/sources/mx64-ezgripper.md#a4,
docs/sources/mx64-ezgripper.md#a5, docs/sources/mx64-ezgripper.md#b).
"""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.emulators.mx64 import Firmware, Servo
from dexkit.errors import UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import ErrorNumber, Instruction, Packet
from dexkit.wire.mx64 import HardwareError, Item, MovingStatus, OperatingMode
from tests.each import each
from tests.mx64_helpers import QUIET, error_of, read, ready, run, servo, write


def send(target: Servo, code: int, params: bytes = b"", packet_id: int | None = None) -> Packet:
    status = target.handle(Packet(target.id if packet_id is None else packet_id, code, params))
    assert status is not None
    return dxl.decode(status)


def with_firmware(**changes: object) -> Firmware:
    return dataclasses.replace(QUIET, **changes)  # type: ignore[arg-type]


# --- identity and reads


def test_ping_is_byte_exact() -> None:
    status = servo().handle(Packet(1, Instruction.PING))
    assert status == bytes.fromhex("FFFFFD00010700550037012D8B40")


def test_every_item_reads_with_its_initial_value() -> None:
    target = servo()
    delivered = {mx64.BAUD_RATE: 3, mx64.GOAL_PWM: 885, mx64.GOAL_CURRENT: 1941}
    for item in mx64.TABLE.values():
        value = read(target, item)
        expected = delivered.get(item, item.initial)
        if item is mx64.GOAL_POSITION:
            expected = read(target, mx64.PRESENT_POSITION)
        assert value == expected or expected is None, item.name


@given(st.integers(0, 700), st.integers(0, 700))
def test_read_answers_data_or_access_error(address: int, length: int) -> None:
    error, data = servo().read_block(address, length)
    covered = {a for i in mx64.TABLE.values() for a in range(i.address, i.end)}
    if length == 0:
        assert (error, data) == (ErrorNumber.DATA_LENGTH, b"")
    elif set(range(address, address + length)) <= covered:
        assert (error, len(data)) == (0, length)
    else:
        assert (error, data) == (ErrorNumber.ACCESS, b"")


def test_reading_across_a_gap_can_be_allowed() -> None:
    # what SAKE's driver does: 70 with length 2, where 71 is nothing
    assert servo().read_block(70, 2) == (ErrorNumber.ACCESS, b"")
    lenient = servo(firmware=with_firmware(read_across_gaps=True))
    assert lenient.read_block(70, 2) == (0, b"\0\0")


def test_part_of_an_item_can_be_read_but_not_written() -> None:
    target = servo()
    assert target.read_block(mx64.VELOCITY_LIMIT.address, 2) == (0, (435).to_bytes(2, "little"))
    assert target.write_block(mx64.VELOCITY_LIMIT.address, b"\0\1") == ErrorNumber.DATA_LENGTH
    assert target.write_block(mx64.GOAL_POSITION.address + 2, b"\0\0") == ErrorNumber.DATA_LENGTH


# --- writes


@given(st.integers(0, 700), st.binary(max_size=30), st.booleans())
def test_write_changes_all_or_no_bytes(address: int, data: bytes, torque: bool) -> None:
    target = servo()
    if torque:
        assert write(target, mx64.TORQUE_ENABLE, 1) == 0
    before = target._table[:]
    error = target.write_block(address, data)
    if error:
        assert target._table == before
        return
    assert not (torque and target.eeprom != bytes(before[:64]))
    if not any(mx64.TABLE[a].name.startswith("Indirect") for a in mx64.TABLE if a == address):
        assert target.read_block(address, len(data)) == (0, data)


def test_read_only_items_refuse() -> None:
    target = servo()
    for item in mx64.TABLE.values():
        if not item.writable:
            refused = target.write_block(item.address, bytes(item.size))
            assert refused == ErrorNumber.ACCESS, item.name


def test_eeprom_is_locked_while_torque_is_on() -> None:
    for item in mx64.TABLE.values():
        if item.address >= 64 or not item.writable:
            continue
        target = servo()
        value = read(target, item)
        assert write(target, mx64.TORQUE_ENABLE, 1) == 0
        assert write(target, item, value) == ErrorNumber.ACCESS, item.name
        assert write(target, mx64.TORQUE_ENABLE, 0) == 0
        assert write(target, item, value) == 0, item.name


def test_error_of_write_to_unused_address_is_configurable() -> None:
    target = servo()
    other = servo(firmware=with_firmware(undefined_address_error=ErrorNumber.DATA_RANGE))
    for address in (14, 28, 56, 66, 71, 86, 92, 99, 147, 252, 662, 700):
        assert target.write_block(address, b"\0") == ErrorNumber.ACCESS, address
        assert other.write_block(address, b"\0") == ErrorNumber.DATA_RANGE, address


@each(
    ("item", "value"),
    [
        (mx64.ID, 253),
        (mx64.BAUD_RATE, 8),
        (mx64.RETURN_DELAY_TIME, 255),
        (mx64.DRIVE_MODE, 2),
        (mx64.DRIVE_MODE, 8),
        (mx64.OPERATING_MODE, 2),
        (mx64.OPERATING_MODE, 15),
        (mx64.SHUTDOWN, 0x02),
        (mx64.HOMING_OFFSET, 1_044_480),
        (mx64.MIN_VOLTAGE_LIMIT, 94),
        (mx64.TORQUE_ENABLE, 2),
        (mx64.STATUS_RETURN_LEVEL, 3),
        (mx64.BUS_WATCHDOG, -1),
        (mx64.GOAL_POSITION, mx64.POSITION_SPAN + 1),
        (mx64.GOAL_CURRENT, 1942),
        (mx64.indirect_address(1), 63),
        (mx64.indirect_address(1), 662),
    ],
    ids=lambda v: v.name if isinstance(v, Item) else str(v),
)
def test_value_out_of_range_is_refused(item: Item, value: int) -> None:
    assert write(servo(), item, value) == ErrorNumber.DATA_RANGE


@each(
    ("limit", "at", "goal", "most"),
    [
        (mx64.PWM_LIMIT, 500, mx64.GOAL_PWM, 500),
        (mx64.CURRENT_LIMIT, 1600, mx64.GOAL_CURRENT, 1600),
        (mx64.VELOCITY_LIMIT, 285, mx64.GOAL_VELOCITY, 285),
        (mx64.VELOCITY_LIMIT, 285, mx64.PROFILE_VELOCITY, 285),
        (mx64.ACCELERATION_LIMIT, 100, mx64.PROFILE_ACCELERATION, 100),
        (mx64.MAX_POSITION_LIMIT, 3000, mx64.GOAL_POSITION, 3000),
    ],
    ids=lambda v: v.name if isinstance(v, Item) else "",
)
def test_goal_beyond_limit_is_refused(limit: Item, at: int, goal: Item, most: int) -> None:
    target = servo()
    assert write(target, limit, at) == 0
    assert write(target, goal, most) == 0
    assert write(target, goal, most + 1) == ErrorNumber.DATA_LIMIT
    assert read(target, goal) == most
    if goal.limit is not None:
        assert write(target, goal, -most) == 0
        assert write(target, goal, -most - 1) == ErrorNumber.DATA_LIMIT


def test_position_limits_count_in_mode_3_only() -> None:
    target = servo()
    assert write(target, mx64.GOAL_POSITION, -1) == ErrorNumber.DATA_LIMIT
    assert write(target, mx64.GOAL_POSITION, 4096) == ErrorNumber.DATA_LIMIT
    assert write(target, mx64.OPERATING_MODE, OperatingMode.CURRENT_BASED_POSITION) == 0
    assert write(target, mx64.GOAL_POSITION, -15000) == 0


def test_profile_velocity_above_the_limit_can_be_allowed() -> None:
    target = servo(firmware=with_firmware(profile_velocity_limited=False))
    assert write(target, mx64.PROFILE_VELOCITY, 500) == 0


def test_profile_times_have_their_own_limit() -> None:
    target = servo()
    write(target, mx64.DRIVE_MODE, mx64.DriveMode.TIME_BASED_PROFILE)
    for item in (mx64.PROFILE_VELOCITY, mx64.PROFILE_ACCELERATION):
        assert write(target, item, mx64.PROFILE_TIME_MAX) == 0
        assert write(target, item, mx64.PROFILE_TIME_MAX + 1) == ErrorNumber.DATA_LIMIT


def test_one_write_can_span_items() -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    data = b"".join(
        item.encode(value)
        for item, value in (
            (mx64.GOAL_CURRENT, 320),
            (mx64.GOAL_VELOCITY, 0),
            (mx64.PROFILE_ACCELERATION, 800),
            (mx64.PROFILE_VELOCITY, 500),
            (mx64.GOAL_POSITION, 3000),
        )
    )
    assert target.write_block(mx64.GOAL_CURRENT.address, data) == 0
    assert read(target, mx64.GOAL_POSITION) == 3000
    run(target, 0.02)
    assert target.drive.profile.running


# --- mode changes, folding


def test_mode_change_resets_documented_registers() -> None:
    target = servo()
    write(target, mx64.CURRENT_LIMIT, 1600)
    for item, value in (
        (mx64.POSITION_P_GAIN, 1),
        (mx64.PROFILE_VELOCITY, 100),
        (mx64.PROFILE_ACCELERATION, 100),
        (mx64.GOAL_PWM, 1),
        (mx64.GOAL_CURRENT, 1),
    ):
        assert write(target, item, value) == 0
    assert write(target, mx64.OPERATING_MODE, 5) == 0
    assert read(target, mx64.POSITION_P_GAIN) == 850
    assert read(target, mx64.PROFILE_VELOCITY) == 0
    assert read(target, mx64.PROFILE_ACCELERATION) == 0
    assert read(target, mx64.GOAL_PWM) == 885
    assert read(target, mx64.GOAL_CURRENT) == 1600
    # the same mode again changes nothing
    write(target, mx64.GOAL_CURRENT, 7)
    assert write(target, mx64.OPERATING_MODE, 5) == 0
    assert read(target, mx64.GOAL_CURRENT) == 7


def test_reboot_folds_the_position_into_one_turn() -> None:
    """Zero at 3010: open is 5510, which reads 1414 after a reboot
    (docs/sources/mx64-ezgripper.md#d4).
    """
    target = servo(closed_at=3010, start=0.0)
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(3010, abs=1)
    write(target, mx64.GOAL_POSITION, 5510)
    run(target, 2.0)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(5510, abs=25)
    position = read(target, mx64.PRESENT_POSITION)
    send(target, Instruction.REBOOT)
    run(target, 1.0)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(position - 4096, abs=2)


def test_torque_on_in_mode_3_folds_but_not_in_mode_4() -> None:
    target = servo(closed_at=3010, start=100.0)
    write(target, mx64.OPERATING_MODE, OperatingMode.EXTENDED_POSITION)
    target.drive.counter -= 4096  # as after a full turn
    before = read(target, mx64.PRESENT_POSITION)
    write(target, mx64.TORQUE_ENABLE, 1)
    assert read(target, mx64.PRESENT_POSITION) == before > 4095
    write(target, mx64.TORQUE_ENABLE, 0)
    write(target, mx64.OPERATING_MODE, OperatingMode.POSITION)
    assert 0 <= read(target, mx64.PRESENT_POSITION) <= 4095


def test_goal_follows_the_position_at_torque_on() -> None:
    target = servo()
    write(target, mx64.GOAL_POSITION, 100)
    assert write(target, mx64.TORQUE_ENABLE, 1) == 0
    assert read(target, mx64.GOAL_POSITION) == read(target, mx64.PRESENT_POSITION)
    keeps = servo(firmware=with_firmware(goal_starts_at_present=False))
    write(keeps, mx64.GOAL_POSITION, 2000)
    write(keeps, mx64.TORQUE_ENABLE, 1)
    run(keeps, 1.5)
    assert read(keeps, mx64.PRESENT_POSITION) == pytest.approx(2000, abs=20)


def test_homing_offset_is_added_and_limited_in_mode_3() -> None:
    target = servo()
    at = read(target, mx64.PRESENT_POSITION)
    write(target, mx64.HOMING_OFFSET, -2000)
    assert read(target, mx64.PRESENT_POSITION) == at - 1024
    write(target, mx64.OPERATING_MODE, OperatingMode.EXTENDED_POSITION)
    assert read(target, mx64.PRESENT_POSITION) == at - 2000
    ready(target, OperatingMode.EXTENDED_POSITION)
    write(target, mx64.GOAL_POSITION, at - 2000 + 500)
    run(target, 1.0)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(at - 1500, abs=10)


def test_reverse_mode_mirrors_everything() -> None:
    target = servo()
    normal = read(target, mx64.PRESENT_POSITION)
    write(target, mx64.DRIVE_MODE, mx64.DriveMode.REVERSE)
    send(target, Instruction.REBOOT)
    run(target, 0.5)
    at = read(target, mx64.PRESENT_POSITION)
    assert at == 4096 - normal
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    opening = target.drive.opening
    write(target, mx64.GOAL_POSITION, at + 500)
    run(target, 0.1)
    assert read(target, mx64.PRESENT_VELOCITY) > 0
    assert read(target, mx64.PRESENT_CURRENT) > 0
    run(target, 1.0)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(at + 500, abs=10)
    assert target.drive.opening == pytest.approx(opening - 20, abs=1)


# --- status policy


@each(
    ("level", "ping", "reads", "writes"),
    [(0, True, False, False), (1, True, True, False), (2, True, True, True)],
)
def test_status_return_level(level: int, ping: bool, reads: bool, writes: bool) -> None:
    target = servo()
    target.write_block(mx64.STATUS_RETURN_LEVEL.address, bytes([level]))
    read_params = bytes([132, 0, 4, 0])
    assert (target.handle(Packet(1, Instruction.PING)) is not None) == ping
    assert (target.handle(Packet(1, Instruction.READ, read_params)) is not None) == reads
    assert (target.handle(Packet(1, Instruction.WRITE, b"\x41\0\1")) is not None) == writes
    assert (target.handle(Packet(1, 0x77)) is not None) == writes
    assert target.answers_reads(sync=True) == reads
    assert read(servo(), mx64.LED) == 0


def test_broadcast_write_acts_without_answer() -> None:
    target = servo()
    assert target.handle(Packet(254, Instruction.WRITE, b"\x41\0\1")) is None
    assert read(target, mx64.LED) == 1


def test_secondary_id_acts_without_answer_and_never_on_eeprom() -> None:
    target = servo()
    write(target, mx64.SECONDARY_ID, 9)
    assert target.secondary_id == 9
    assert target.handle(Packet(9, Instruction.WRITE, b"\x41\0\1")) is None
    assert read(target, mx64.LED) == 1
    assert target.handle(Packet(9, Instruction.WRITE, b"\x09\0\0")) is None
    assert read(target, mx64.RETURN_DELAY_TIME) == 250
    assert target.handle(Packet(9, Instruction.READ, bytes([132, 0, 4, 0]))) is None
    write(target, mx64.SECONDARY_ID, 1)
    assert target.secondary_id is None
    write(target, mx64.SECONDARY_ID, 253)
    assert target.secondary_id is None


def test_new_id_is_used_from_next_packet() -> None:
    target = servo()
    status = target.handle(Packet(1, Instruction.WRITE, bytes([7, 0, 5])))
    assert status is not None
    assert dxl.decode(status).id == 1
    assert target.id == 5


@each(
    ("code", "params", "error"),
    [
        (0x77, b"", ErrorNumber.INSTRUCTION),
        (Instruction.ACTION, b"", ErrorNumber.INSTRUCTION),
        (Instruction.CONTROL_TABLE_BACKUP, b"\x01CTRL", ErrorNumber.INSTRUCTION),
        (Instruction.READ, b"\x84\0\4", ErrorNumber.DATA_LENGTH),
        (Instruction.WRITE, b"\x41\0", ErrorNumber.DATA_LENGTH),
        (Instruction.FACTORY_RESET, b"", ErrorNumber.DATA_LENGTH),
        (Instruction.FACTORY_RESET, b"\3", ErrorNumber.DATA_RANGE),
        (Instruction.CLEAR, b"\1", ErrorNumber.DATA_LENGTH),
        (Instruction.CLEAR, b"\x02\x45\x52\x43\x4c", ErrorNumber.DATA_RANGE),
    ],
)
def test_invalid_instructions_return_error(code: int, params: bytes, error: int) -> None:
    assert error_of(servo().handle(Packet(1, code, params))) == error


# --- registered writes, clear, factory reset, backup


def test_reg_write_waits_for_action() -> None:
    target = servo()
    assert write(target, mx64.LED, 1, Instruction.REG_WRITE) == 0
    assert (read(target, mx64.LED), read(target, mx64.REGISTERED_INSTRUCTION)) == (0, 1)
    assert send(target, Instruction.ACTION).error == 0
    assert (read(target, mx64.LED), read(target, mx64.REGISTERED_INSTRUCTION)) == (1, 0)
    assert send(target, Instruction.ACTION).error == ErrorNumber.INSTRUCTION


def test_reg_write_is_checked_at_once() -> None:
    target = servo()
    assert write(target, mx64.LED, 2, Instruction.REG_WRITE) == ErrorNumber.DATA_RANGE
    assert read(target, mx64.REGISTERED_INSTRUCTION) == 0


def test_clear_folds_position_only_at_rest() -> None:
    target = servo(closed_at=3010, start=90.0)
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    target.drive.counter -= 8192
    target.drive.reset_control()
    write(target, mx64.GOAL_POSITION, read(target, mx64.PRESENT_POSITION) - 1000)
    run(target, 0.1)
    assert send(target, Instruction.CLEAR, dxl.CLEAR_POSITION_KEY).error == ErrorNumber.RESULT_FAIL
    run(target, 1.5)
    assert send(target, Instruction.CLEAR, dxl.CLEAR_POSITION_KEY).error == 0
    at = read(target, mx64.PRESENT_POSITION)
    assert 0 <= at <= 4095
    run(target, 0.5)  # and it stays there
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(at, abs=3)


@each(("option", "servo_id", "baud"), [(0xFF, 1, 57_600), (0x01, 7, 57_600), (0x02, 7, 2_000_000)])
def test_factory_reset_keeps_what_its_option_says(option: int, servo_id: int, baud: int) -> None:
    target = servo(7, baudrate=2_000_000)
    write(target, mx64.CURRENT_LIMIT, 100)
    status = send(target, Instruction.FACTORY_RESET, bytes([option]))
    assert (status.id, status.error) == (7, 0)
    assert target.silent
    run(target, 0.5)
    assert (target.id, target.baudrate) == (servo_id, baud)
    assert read(target, mx64.CURRENT_LIMIT) == 1941


def test_broadcast_factory_reset_of_everything_is_ignored() -> None:
    target = servo(7)
    assert target.handle(Packet(254, Instruction.FACTORY_RESET, b"\xff")) is None
    assert (target.id, target.silent) == (7, False)
    assert target.handle(Packet(254, Instruction.FACTORY_RESET, b"\x01")) is None
    assert target.silent


def test_backup_and_restore_when_switched_on() -> None:
    target = servo(firmware=with_firmware(backup=True))
    write(target, mx64.CURRENT_LIMIT, 111)
    backup = Instruction.CONTROL_TABLE_BACKUP
    assert send(target, backup, b"\x02CTRL").error == ErrorNumber.RESULT_FAIL
    write(target, mx64.TORQUE_ENABLE, 1)
    assert send(target, backup, b"\x01CTRL").error == ErrorNumber.RESULT_FAIL
    write(target, mx64.TORQUE_ENABLE, 0)
    assert send(target, backup, b"\x01CTRX").error == ErrorNumber.DATA_RANGE
    assert send(target, backup, b"\x01").error == ErrorNumber.DATA_LENGTH
    assert send(target, backup, b"\x01CTRL").error == 0
    write(target, mx64.CURRENT_LIMIT, 222)
    assert send(target, backup, b"\x02CTRL").error == 0
    run(target, 0.5)
    assert read(target, mx64.CURRENT_LIMIT) == 111


# --- reboot


def test_reboot_keeps_eeprom_resets_ram_and_takes_time() -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    for item, value in (
        (mx64.PROFILE_VELOCITY, 300),
        (mx64.GOAL_CURRENT, 300),
        (mx64.STATUS_RETURN_LEVEL, 2),
        (mx64.indirect_address(1), 126),
        (mx64.LED, 1),
    ):
        assert write(target, item, value) == 0
    assert send(target, Instruction.REBOOT).error == 0
    assert target.silent
    run(target, QUIET.boot_time + 0.01)
    assert not target.silent
    assert read(target, mx64.OPERATING_MODE) == 5
    assert read(target, mx64.VELOCITY_LIMIT) == 1023
    for item, value in (
        (mx64.TORQUE_ENABLE, 0),
        (mx64.PROFILE_VELOCITY, 0),
        (mx64.GOAL_CURRENT, 1941),
        (mx64.indirect_address(1), 224),
        (mx64.LED, 0),
    ):
        assert read(target, item) == value, item


def test_realtime_tick_counts_and_wraps() -> None:
    target = servo()
    run(target, 0.25)
    assert read(target, mx64.REALTIME_TICK) == 250
    run(target, 32.767 - 0.25 + 0.002)
    assert read(target, mx64.REALTIME_TICK) == 1


# --- indirect addressing


def map_bytes(target: Servo, first: int, addresses: list[int]) -> None:
    for k, address in enumerate(addresses):
        assert write(target, mx64.indirect_address(first + k), address) == 0


@each("first", [1, 20, 29, 51])
def test_indirect_data_read_and_write_their_targets(first: int) -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    addresses = [102, 103, 116, 117, 118, 119]
    map_bytes(target, first, addresses)
    at = mx64.indirect_data(first).address
    block = mx64.GOAL_CURRENT.encode(320) + mx64.GOAL_POSITION.encode(-777)
    assert target.write_block(at, block) == 0
    assert read(target, mx64.GOAL_CURRENT) == 320
    assert read(target, mx64.GOAL_POSITION) == -777
    assert target.read_block(at, 6) == (0, block)


def test_indirect_inherits_size_range_and_access() -> None:
    target = servo()
    at = mx64.indirect_data(1).address
    map_bytes(target, 1, [102, 103])
    assert target.write_block(at, b"\0") == ErrorNumber.DATA_LENGTH
    assert target.write_block(at, mx64.GOAL_CURRENT.encode(2000)) == ErrorNumber.DATA_RANGE
    map_bytes(target, 1, [103, 102])
    assert target.write_block(at, b"\0\0") == ErrorNumber.DATA_LENGTH
    map_bytes(target, 1, [126, 127])
    assert target.write_block(at, b"\0\0") == ErrorNumber.ACCESS
    map_bytes(target, 1, [71, 72])
    assert target.write_block(at, b"\0\0") == ErrorNumber.ACCESS
    assert target.read_block(at, 2) == (ErrorNumber.ACCESS, b"")


def test_indirect_cannot_reach_eeprom() -> None:
    assert write(servo(), mx64.indirect_address(1), 38) == ErrorNumber.DATA_RANGE


def test_unmapped_indirect_data_is_plain_memory() -> None:
    target = servo()
    at = mx64.indirect_data(1).address
    assert target.write_block(at, b"\1\2\3") == 0
    assert target.read_block(at, 3) == (0, b"\1\2\3")


def test_indirect_cycle_is_harmless() -> None:
    target = servo()
    map_bytes(target, 1, [225, 224])
    assert target.write_block(224, b"\x05\x06") == 0
    assert target.read_block(224, 2) == (0, b"\x05\x06")


# --- bus watchdog


def test_bus_watchdog_stops_and_locks_the_goals() -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    write(target, mx64.PROFILE_VELOCITY, 50)
    write(target, mx64.BUS_WATCHDOG, 5)  # 100 ms
    write(target, mx64.GOAL_POSITION, read(target, mx64.PRESENT_POSITION) + 1000)
    for _ in range(4):
        target.note_packet()
        run(target, 0.09)
    assert read(target, mx64.BUS_WATCHDOG) == 5
    target.note_packet()
    run(target, 0.12)
    assert read(target, mx64.BUS_WATCHDOG) == mx64.WATCHDOG_TRIPPED
    run(target, 0.2)
    at = read(target, mx64.PRESENT_POSITION)
    run(target, 0.5)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(at, abs=2)
    for goal in (mx64.GOAL_PWM, mx64.GOAL_CURRENT, mx64.GOAL_VELOCITY, mx64.GOAL_POSITION):
        assert write(target, goal, 0) == ErrorNumber.DATA_RANGE
    assert write(target, mx64.BUS_WATCHDOG, 0) == 0
    assert write(target, mx64.GOAL_POSITION, at) == 0


@each("resumes", [False, True])
def test_cleared_watchdog_stays_stopped_or_resumes(resumes: bool) -> None:
    target = servo(firmware=dataclasses.replace(QUIET, watchdog_resumes=resumes))
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    write(target, mx64.PROFILE_VELOCITY, 50)
    write(target, mx64.BUS_WATCHDOG, 5)
    goal = read(target, mx64.PRESENT_POSITION) + 1000
    write(target, mx64.GOAL_POSITION, goal)
    run(target, 0.5)
    at = read(target, mx64.PRESENT_POSITION)
    write(target, mx64.BUS_WATCHDOG, 0)
    run(target, 3.0)
    expected = goal if resumes else at
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(expected, abs=20)


@each("mode", [OperatingMode.CURRENT, OperatingMode.VELOCITY, OperatingMode.PWM])
def test_bus_watchdog_stops_every_mode(mode: OperatingMode) -> None:
    target = servo()
    write(target, mx64.OPERATING_MODE, mode)
    for goal, value in ((mx64.GOAL_PWM, 200), (mx64.GOAL_CURRENT, 150), (mx64.GOAL_VELOCITY, 30)):
        write(target, goal, value)
    write(target, mx64.BUS_WATCHDOG, 10)
    write(target, mx64.TORQUE_ENABLE, 1)
    run(target, 0.19)
    assert target.drive.velocity > 0.1
    run(target, 0.5)
    assert read(target, mx64.BUS_WATCHDOG) == mx64.WATCHDOG_TRIPPED
    assert target.drive.velocity == pytest.approx(0.0, abs=0.02)


def test_bus_watchdog_needs_torque() -> None:
    target = servo()
    write(target, mx64.BUS_WATCHDOG, 1)
    run(target, 1.0)
    assert read(target, mx64.BUS_WATCHDOG) == 1


# --- errors and shutdown


def test_shutdown_drops_torque_until_reboot_and_alerts() -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    target.raise_error(HardwareError.OVERLOAD)
    status = send(target, Instruction.READ, bytes([70, 0, 1, 0]))
    assert (status.alert, status.error_number, status.data) == (True, 0, b"\x20")
    assert read(target, mx64.TORQUE_ENABLE) == 0
    assert write(target, mx64.TORQUE_ENABLE, 1) == dxl.ALERT
    assert read(target, mx64.TORQUE_ENABLE) == 0
    assert write(target, mx64.HARDWARE_ERROR_STATUS, 0) == dxl.ALERT | ErrorNumber.ACCESS
    lit = set()
    for _ in range(4):
        run(target, 0.25)
        lit.add(target.led)
    assert lit == {True, False}
    send(target, Instruction.REBOOT)
    run(target, 1.0)
    assert read(target, mx64.HARDWARE_ERROR_STATUS) == 0
    assert write(target, mx64.TORQUE_ENABLE, 1) == 0
    assert read(target, mx64.TORQUE_ENABLE) == 1


def test_an_error_outside_the_mask_only_alerts() -> None:
    target = servo()
    write(target, mx64.TORQUE_ENABLE, 1)
    target.raise_error(HardwareError.INPUT_VOLTAGE)
    assert write(target, mx64.LED, 1) == dxl.ALERT
    assert read(target, mx64.TORQUE_ENABLE) == 1


def test_torque_in_shutdown_can_be_an_error() -> None:
    target = servo(firmware=with_firmware(refuse_torque_in_shutdown=ErrorNumber.RESULT_FAIL))
    target.raise_error(HardwareError.ELECTRICAL_SHOCK)
    assert write(target, mx64.TORQUE_ENABLE, 1) == dxl.ALERT | ErrorNumber.RESULT_FAIL


def test_brown_out_resets_ram() -> None:
    target = servo()
    write(target, mx64.LED, 1)
    target.drive.supply = 5.0
    run(target, 0.05)
    assert target.silent
    target.drive.supply = 12.0
    run(target, 0.05)
    assert target.silent  # it boots
    run(target, 0.5)
    assert not target.silent
    assert read(target, mx64.LED) == 0


def test_voltage_error_follows_the_limits() -> None:
    target = servo()
    target.drive.supply = 9.0
    run(target, 0.05)
    assert target.hardware_error == HardwareError.INPUT_VOLTAGE
    assert read(target, mx64.PRESENT_INPUT_VOLTAGE) == 90


# --- persistence and set-up


def test_eeprom_survives_into_another_run() -> None:
    target = servo()
    saved: list[bytes] = []
    target.on_eeprom = lambda: saved.append(target.eeprom)
    write(target, mx64.LED, 1)
    assert saved == []
    write(target, mx64.CURRENT_LIMIT, 1600)
    write(target, mx64.CURRENT_LIMIT, 1600)
    assert len(saved) == 1
    again = servo(eeprom=saved[-1])
    assert read(again, mx64.CURRENT_LIMIT) == 1600
    assert read(again, mx64.LED) == 0


@each("eeprom", [b"", bytes(64)])
def test_wrong_eeprom_is_refused(eeprom: bytes) -> None:
    with pytest.raises(UsageError):
        servo(eeprom=eeprom)


def test_wrong_values_in_eeprom_are_refused() -> None:
    good = bytearray(servo().eeprom)
    for item, value in ((mx64.BAUD_RATE, 9), (mx64.OPERATING_MODE, 2)):
        bad = good[:]
        bad[item.address] = value
        with pytest.raises(UsageError):
            servo(eeprom=bytes(bad))


def test_invalid_servo_options_are_refused() -> None:
    with pytest.raises(UsageError):
        Servo(253)
    with pytest.raises(UsageError):
        Servo(1, baudrate=123)


# --- moving status


def test_moving_status_reports_profile_type() -> None:
    target = servo(start=10.0)
    ready(target, OperatingMode.EXTENDED_POSITION)
    at = read(target, mx64.PRESENT_POSITION)
    shapes = {}
    for name, velocity, acceleration, distance in (
        ("rectangle", 50, 0, 500),
        ("trapezoid", 50, 50, 500),
        ("triangle", 400, 20, 300),
    ):
        write(target, mx64.PROFILE_VELOCITY, velocity)
        write(target, mx64.PROFILE_ACCELERATION, acceleration)
        at += distance
        write(target, mx64.GOAL_POSITION, at)
        run(target, 0.1)
        assert read(target, mx64.MOVING) == 1
        status = MovingStatus(read(target, mx64.MOVING_STATUS))
        assert status & MovingStatus.PROFILE_ONGOING
        shapes[name] = int(status) & 0x30
        run(target, 4.0)
        status = MovingStatus(read(target, mx64.MOVING_STATUS))
        assert status == MovingStatus.IN_POSITION
        assert read(target, mx64.MOVING) == 0
    assert shapes == {"rectangle": 0x10, "trapezoid": 0x30, "triangle": 0x20}


def test_following_error_shows_when_blocked() -> None:
    target = servo(object_pct=40.0)
    ready(target, OperatingMode.CURRENT_BASED_POSITION)
    write(target, mx64.GOAL_CURRENT, 100)
    write(target, mx64.GOAL_POSITION, read(target, mx64.PRESENT_POSITION) - 1250)
    run(target, 2.0)
    assert read(target, mx64.MOVING_STATUS) & MovingStatus.FOLLOWING_ERROR


# --- any instructions keep registers within limits


class_items = st.sampled_from([i for i in mx64.TABLE.values() if i.writable and i.address < 168])


@given(
    st.lists(
        st.one_of(
            st.tuples(class_items, st.integers(-(2**31), 2**31 - 1)),
            st.tuples(class_items, st.integers(0, 20)),
            st.just((None, 0)),
        ),
        max_size=25,
    )
)
def test_any_instructions_keep_registers_within_table_limits(
    steps: list[tuple[Item | None, int]],
) -> None:
    target = servo()
    for item, value in steps:
        if item is None:
            target.handle(Packet(target.id, Instruction.REBOOT))
            run(target, 0.4)
            continue
        data = (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")
        target.write_block(item.address, data)
        run(target, 0.02)
        for other in mx64.TABLE.values():
            if other.minimum is not None and other.maximum is not None:
                now = target.get(other)
                if other is mx64.BUS_WATCHDOG and now == mx64.WATCHDOG_TRIPPED:
                    continue
                assert other.minimum <= now <= other.maximum, other
        assert math.isfinite(target.drive.joint.q)
        assert -20 < target.drive.opening < 120
