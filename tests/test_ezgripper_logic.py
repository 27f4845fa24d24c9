"""Test the EZGripper driver's control logic without device and with a simulated clock."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.drivers.ezgripper import calibration, calibration_file, register_block, scaling
from dexkit.drivers.ezgripper.contact import MIN_FREE_SPEED, ContactDetector
from dexkit.drivers.ezgripper.control import Control, ControlSettings, Phase
from dexkit.drivers.ezgripper.force import DEFAULT_FORCE_TABLE, ForceTable
from dexkit.drivers.ezgripper.recovery import RebootPolicy, describe, motor_error
from dexkit.drivers.ezgripper.register_block import Goal, Sample
from dexkit.errors import TruncatedError, UsageError
from dexkit.hand import HandCommand, MotorError, Side
from dexkit.wire import mx64
from dexkit.wire.mx64 import HardwareError
from tests.each import each

# --- scaling


@given(
    relative=st.integers(-798, 2500 + 797),
    zero=st.integers(0, 4095),
    turns_then=st.integers(-3, 3),
    turns_now=st.integers(-3, 3),
)
def test_relative_position_does_not_depend_on_the_turn(
    relative: int, zero: int, turns_then: int, turns_now: int
) -> None:
    present = zero + relative + 4096 * turns_now
    assert scaling.relative_position(present, zero + 4096 * turns_then) == relative


def test_documented_example_of_folded_position() -> None:
    # zero 3010, fully open: 5510, reads 1414 after a reboot (docs/sources/mx64-ezgripper.md#d4)
    assert scaling.relative_position(5510, 3010) == 2500
    assert scaling.relative_position(1414, 3010) == 2500


def test_joint_angles_convert_to_ticks_and_back() -> None:
    assert scaling.ticks_of_joint(0.0) == 0
    assert scaling.ticks_of_joint(5.4) == 2500
    assert scaling.ticks_of_joint(2.7) == 1250
    assert scaling.ticks_of_joint(6.28) == 2500
    assert scaling.ticks_of_joint(-1.0) == 0
    assert scaling.joint_of_ticks(2500) == pytest.approx(5.4)
    # 0.229 rpm is 15.63 ticks/s; positive velocity opens
    assert scaling.joint_speed(1) == pytest.approx(0.229 / 60 * 4096 * 5.4 / 2500)


@each(("effort", "units"), [(10, 160), (15, 240), (30, 480), (50, 800), (100, 1600), (150, 1600)])
def test_effort_gives_documented_current(effort: float, units: int) -> None:
    assert scaling.current_of_effort(effort) == units


def test_profile_velocity_is_never_zero() -> None:
    assert scaling.profile_velocity(0.0) == 1
    assert scaling.profile_velocity(312.7) == 500


# --- force


def test_default_force_table_equals_sakes() -> None:
    assert DEFAULT_FORCE_TABLE.force(0) == 0
    assert DEFAULT_FORCE_TABLE.force(100) == 0.5
    assert DEFAULT_FORCE_TABLE.force(-150) == pytest.approx(0.85)
    assert DEFAULT_FORCE_TABLE.force(1941) == pytest.approx(10.0 + 918 * 8.0 / 723)
    assert DEFAULT_FORCE_TABLE.tau(1023) == pytest.approx(1.0)


_tables = st.dictionaries(
    st.integers(0, 1941), st.floats(0, 100, allow_nan=False), min_size=1, max_size=12
).map(lambda d: dict(zip(sorted(d), sorted(d.values()), strict=True)))


@given(table=_tables, a=st.floats(0, 2000), b=st.floats(0, 2000))
def test_force_never_falls_and_stays_within_the_table(
    table: dict[int, float], a: float, b: float
) -> None:
    force = ForceTable.from_mapping({str(k): v for k, v in table.items()})
    low, high = force.force(min(a, b)), force.force(max(a, b))
    assert min(table.values()) <= low <= high + 1e-9
    if force.covers(max(a, b)):
        assert high <= max(table.values())
    for current, value in table.items():
        assert force.force(current) == pytest.approx(value)
    assert ForceTable.from_mapping(force.to_mapping()) == force


@each(
    "table",
    [
        {},
        {"x": 1.0},
        {"0": "1"},
        {"0": True},
        {"0": -1.0},
        {"-1": 1.0},
        {"0": math.nan},
        {"nan": 0.0},
        {"0": 2.0, "100": 1.0},
        {"0": 0.0, "0.0": 1.0},
    ],
)
def test_invalid_force_table_is_refused(table: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        ForceTable.from_mapping(table)


# --- block


_samples = st.builds(
    Sample,
    time=st.just(1.5),
    goal_current=st.integers(-1941, 1941),
    goal_position=st.integers(-1_048_575, 1_048_575),
    torque=st.booleans(),
    error=st.sampled_from([0, 1, 4, 0x24, 0x3D]),
    watchdog=st.integers(-1, 127),
    tick=st.integers(0, 32767),
    current=st.integers(-1941, 1941),
    velocity=st.integers(-1023, 1023),
    position=st.integers(-(2**31), 2**31 - 1),
    voltage=st.integers(0, 255),
    temperature=st.integers(0, 100),
)


@given(sample=_samples)
def test_a_sample_is_read_as_the_table_encodes_it(sample: Sample) -> None:
    values = {
        mx64.GOAL_CURRENT: sample.goal_current,
        mx64.GOAL_POSITION: sample.goal_position,
        mx64.TORQUE_ENABLE: int(sample.torque),
        mx64.HARDWARE_ERROR_STATUS: int(sample.error),
        mx64.BUS_WATCHDOG: sample.watchdog,
        mx64.REALTIME_TICK: sample.tick,
        mx64.PRESENT_CURRENT: sample.current,
        mx64.PRESENT_VELOCITY: sample.velocity,
        mx64.PRESENT_POSITION: sample.position,
        mx64.PRESENT_INPUT_VOLTAGE: sample.voltage,
        mx64.PRESENT_TEMPERATURE: sample.temperature,
    }
    data = b"".join(item.encode(values[item]) for item in register_block.MAPPED[1:])
    assert register_block.decode(data, sample.time, sample.received) == sample
    with pytest.raises(TruncatedError):
        register_block.decode(data[:-1], 1.5, 1.6)


def test_mapping_lists_every_byte_once_in_order() -> None:
    addresses = register_block.mapping()
    listed = [int.from_bytes(addresses[i : i + 2], "little") for i in range(0, len(addresses), 2)]
    assert listed[:4] == [112, 113, 114, 115]
    assert listed[4:10] == [102, 103, 116, 117, 118, 119]
    assert len(listed) == len(set(listed)) == 28
    assert all(a >= 64 for a in listed), "EEPROM cannot be mapped"
    goal = register_block.encode(Goal(position=-12000, current=320, profile_velocity=500))
    assert goal == b"\xf4\x01\x00\x00" + b"\x40\x01" + b"\x20\xd1\xff\xff"


# --- contact


def _run(
    detector: ContactDetector,
    position_at: object,
    goal: float,
    *,
    start: float = 0.0,
    duration: float = 2.0,
    rate: float = 500.0,
    noise: tuple[int, ...] = (0,),
) -> float | None:
    """Time of the first contact, or None."""
    assert callable(position_at)
    for i in range(int(duration * rate)):
        now = start + i / rate
        position = round(position_at(now)) + noise[i % len(noise)]
        if detector.update(now, position, goal):
            return now
    return None


@given(
    speed=st.floats(MIN_FREE_SPEED, 220.0),
    closing=st.booleans(),
    rate=st.sampled_from([60.0, 200.0, 500.0, 1000.0]),
    noise=st.lists(st.sampled_from([-1, 0, 1]), min_size=1, max_size=7),
)
def test_free_motion_is_never_contact(
    speed: float, closing: bool, rate: float, noise: list[int]
) -> None:
    ticks = speed * 25
    start, goal, sign = (2500, 0, -1) if closing else (0, 2500, 1)

    def position_at(now: float) -> float:
        # 30 ms until it moves, then straight to the goal
        travelled = min(max(now - 0.03, 0.0) * ticks, 2500.0)
        return start + sign * travelled

    duration = min(2500 / ticks + 0.5, 6.0)
    found = _run(
        ContactDetector(), position_at, goal, duration=duration, rate=rate, noise=tuple(noise)
    )
    assert found is None


def test_pause_before_the_goal_is_written_is_not_contact() -> None:
    """The sample that a goal is planned on is older than the goal by such a pause."""
    for pause in (0.1, 0.15, 0.25):
        detector = ContactDetector()
        assert detector.update(0.0, 2000, 0) is None
        # the goal was written a moment ago; the fingers begin to move
        assert detector.update(pause, 2000, 0) is None
        assert detector.update(pause + 0.02, 1999, 0) is None
        assert detector.update(pause + 0.06, 1980, 0) is None
        # the other way, and the same pause
        assert detector.update(pause + 0.07, 1975, 2500) is None
        assert detector.update(2 * pause + 0.07, 1975, 2500) is None


@given(
    speed=st.floats(MIN_FREE_SPEED, 220.0),
    exchanges=st.lists(
        st.tuples(st.sampled_from([0.002, 0.002, 0.02, 0.15, 0.4]), st.floats(0.0, 1.0)),
        min_size=1,
        max_size=9,
    ),
)
def test_late_answers_in_free_motion_are_never_contact(
    speed: float, exchanges: list[tuple[float, float]]
) -> None:
    """Each exchange takes its time, and the position is of any moment in it."""
    detector = ContactDetector()
    now = 0.05
    while now * speed * 25 < 2400:
        for duration, share in exchanges:
            position = round(min((now + share * duration) * speed * 25, 2500.0))
            received = now + duration
            assert detector.update(now, position, 2500, received=received) is None
            now = received


@given(
    speed=st.floats(5.0, 220.0),
    stop=st.integers(100, 2300),
    closing=st.booleans(),
    rate=st.sampled_from([100.0, 200.0, 500.0]),
)
def test_contact_is_found_within_150_ms(
    speed: float, stop: int, closing: bool, rate: float
) -> None:
    ticks = speed * 25
    start, goal, sign = (2500, 0, -1) if closing else (0, 2500, 1)
    stops_at = abs(stop - start) / ticks

    def position_at(now: float) -> float:
        return start + sign * min(now * ticks, abs(stop - start))

    detector = ContactDetector()
    found = _run(detector, position_at, goal, duration=stops_at + 0.2, rate=rate)
    assert found is not None
    # nothing before the stop, except what the last two ticks of a slow motion are worth
    assert stops_at - 2 / ticks <= found <= stops_at + 0.15
    assert detector.contact is not None
    assert detector.contact.direction == sign
    assert detector.contact.position == pytest.approx(stop, abs=2)


def _in_contact(position: int = 1000, goal: int = 0) -> tuple[ContactDetector, float]:
    detector = ContactDetector()
    found = _run(detector, lambda now: position, goal)
    assert found is not None
    return detector, found


def test_contact_ends_at_command_to_open() -> None:
    detector, now = _in_contact()
    assert detector.update(now + 0.002, 1000, 2500) is None


def test_contact_ends_when_the_object_slips_out() -> None:
    detector, now = _in_contact()
    assert detector.update(now + 0.002, 970, 0) is None


def test_contact_persists_when_object_pushes_back() -> None:
    detector, now = _in_contact()
    for i in range(300):
        # pushed out by 90 ticks, swinging by 40 at first
        swing = 40 * math.exp(-i / 30) * math.cos(i / 5)
        assert detector.update(now + i * 0.002, 1000 + min(i, 90) + swing, 0) is not None
    # and what counts from then on is where the fingers came to rest
    assert detector.update(now + 0.7, 1090 - 30, 0) is None


def test_contact_persists_during_slow_creep() -> None:
    detector, now = _in_contact()
    for i in range(3600 * 2):
        t = now + i * 0.5
        assert detector.update(t, round(1000 - i / 10), 0) is not None


def test_new_motion_starts_a_new_contact_window() -> None:
    detector = ContactDetector()
    for i in range(500):
        assert detector.update(i * 0.002, 1000, 1000) is None
    assert _run(detector, lambda now: 1000, 0, start=1.0, duration=0.098) is None


# --- control


def _sample(now: float, position: int, **changes: object) -> Sample:
    base = Sample(
        time=now,
        received=now,
        goal_current=0,
        goal_position=0,
        torque=True,
        error=0,
        watchdog=25,
        tick=0,
        current=0,
        velocity=0,
        position=position,
        voltage=120,
        temperature=40,
    )
    return replace(base, **changes)  # type: ignore[arg-type]


ZERO = 3010
CLOSE, OPEN = HandCommand.position(0.0), HandCommand.position(5.4)
LIMP = HandCommand.position(5.4, kp=0.0, kd=0.0)
BRAKE = HandCommand.brake(1)
FULL = scaling.profile_velocity(150.0)
SLOW = scaling.profile_velocity(50.0)


def test_zero_gains_never_move() -> None:
    control = Control(ZERO)
    for position in (ZERO, ZERO + 1000, ZERO + 2500 - 4096):
        goal = control.plan(LIMP, _sample(0.0, position))
        assert goal.current == 0
        assert goal.position == position
        assert control.phase is Phase.LIMP


def test_position_goal_is_in_servos_present_turn() -> None:
    # the same gripper before and after a reboot that folds 5510 to 1414
    for position in (5510, 1414):
        goal = Control(ZERO).plan(CLOSE, _sample(0.0, position))
        assert goal.position == position - 2500
        assert goal.current == scaling.current_of_effort(50)


def test_brake_holds_where_it_began_at_rest() -> None:
    control = Control(ZERO)
    control.plan(LIMP, _sample(-0.1, ZERO + 600))
    held = control.plan(BRAKE, _sample(0.0, ZERO + 600))
    assert (held.position, held.current) == (ZERO + 600, 240)
    # it drifts, is pushed, gets another brake command: the goal stays
    for i, velocity in enumerate((0, 20, -20, 0)):
        sample = _sample(0.02 + i * 0.01, ZERO + 650, velocity=velocity)
        assert control.plan(BRAKE, sample).position == ZERO + 600
    control.plan(OPEN, _sample(0.1, ZERO + 650))
    assert control.plan(BRAKE, _sample(0.12, ZERO + 800)).position == ZERO + 800


def test_no_torque_before_first_command() -> None:
    for control in (Control(ZERO), Control(ZERO)):
        for i, position in enumerate((600, 650, 700)):  # the springs open the fingers
            goal = control.plan(BRAKE, _sample(0.01 * i, ZERO + position, velocity=50))
            assert (goal.position, goal.current) == (ZERO + position, 0)
            assert control.phase is Phase.BRAKE
        # no more commands: the service brakes, and the fingers are held
        assert control.plan(CLOSE, _sample(1.0, ZERO + 700)).current == 800
        assert control.plan(BRAKE, _sample(1.1, ZERO + 600)).current == 240
        # a restart of the servo: it begins anew
        control.recovered(CLOSE)
        assert control.plan(BRAKE, _sample(2.0, ZERO + 600)).current == 0
        assert control.plan(CLOSE, _sample(2.1, ZERO + 600)).current == 0
        assert control.plan(OPEN, _sample(2.2, ZERO + 600)).current == 800


def test_brake_in_motion_stops_and_does_not_come_back() -> None:
    control = Control(ZERO)
    control.plan(CLOSE, _sample(0.0, ZERO + 700, velocity=-200))
    first = control.plan(BRAKE, _sample(0.01, ZERO + 600, velocity=-200))
    assert (first.position, first.current) == (ZERO + 600, 800), "all force while it moves"
    assert control.plan(BRAKE, _sample(0.02, ZERO + 560, velocity=-60)) == first
    stopped = control.plan(BRAKE, _sample(0.03, ZERO + 550, velocity=-1))
    assert stopped == Goal(ZERO + 550, 800, 0)
    assert control.plan(BRAKE, _sample(0.04, ZERO + 549)).position == ZERO + 550
    assert control.plan(BRAKE, _sample(0.05, ZERO + 549)).current == 240


def test_startup_is_slow_until_the_goal_was_reached_once() -> None:
    control = Control(ZERO)
    assert control.plan(OPEN, _sample(0.0, ZERO)).profile_velocity == SLOW
    assert control.plan(OPEN, _sample(1.9, ZERO + 2490)).profile_velocity == SLOW
    assert control.plan(OPEN, _sample(2.0, ZERO + 2499)).profile_velocity == SLOW
    assert control.plan(OPEN, _sample(2.15, ZERO + 2500)).profile_velocity == FULL
    assert control.plan(CLOSE, _sample(2.2, ZERO + 2500)).profile_velocity == FULL


def test_startup_limit_ends_in_any_case_and_does_not_count_time_braked() -> None:
    control = Control(ZERO)
    for t in range(100):
        control.plan(BRAKE, _sample(float(t), ZERO))
    assert control.plan(OPEN, _sample(100.0, ZERO)).profile_velocity == SLOW
    assert control.plan(OPEN, _sample(102.9, ZERO + 900)).profile_velocity == SLOW
    assert control.plan(OPEN, _sample(103.1, ZERO + 1000)).profile_velocity == FULL


def _squeeze(control: Control, start: float, seconds: float, position: int) -> Goal:
    steps = int(seconds / 0.005)
    for i in range(steps + 1):
        goal = control.plan(CLOSE, _sample(start + i * 0.005, position))
    return goal


def test_contact_holds_with_less_effort_and_opens_with_full() -> None:
    control = Control(ZERO)
    assert _squeeze(control, 0.0, 0.3, ZERO + 1000).current == 800
    assert control.phase is Phase.CONTACT
    assert _squeeze(control, 0.3, 0.6, ZERO + 1000).current == 240
    assert control.phase is Phase.HOLDING
    assert control.contact is not None
    assert control.contact.direction == -1
    # first the servo's trajectory, which has run on to 0, is brought back to the fingers
    assert control.plan(OPEN, _sample(1.0, ZERO + 1000)) == Goal(ZERO + 1000, 800, 0)
    assert control.contact is None
    assert control.plan(OPEN, _sample(1.01, ZERO + 1001)).position == ZERO + 2500


def test_a_hot_servo_gets_the_hold_effort_until_it_has_cooled() -> None:
    control = Control(ZERO)

    def current(temperature: int, now: float) -> int:
        return control.plan(OPEN, _sample(now, ZERO, temperature=temperature)).current

    assert [current(t, i * 0.01) for i, t in enumerate((69, 70, 69, 66, 64))] == [
        800,
        240,
        240,
        240,
        800,
    ]


def test_after_a_recovery_nothing_moves_until_the_command_changes() -> None:
    control = Control(ZERO)
    control.plan(CLOSE, _sample(0.0, ZERO + 1000))
    control.recovered(CLOSE, overload_at=1000.0)
    folded = (ZERO + 1000) % 4096
    for i in range(100):
        # a brake of the service in between does not make the old command new
        command = BRAKE if i % 10 == 5 else CLOSE
        goal = control.plan(command, _sample(1.0 + i * 0.01, folded))
        assert goal.position == folded
        assert goal.current == 0
        assert control.phase is Phase.BRAKE
    # a new command acts, but with no more than the hold effort against the same load
    squeeze = control.plan(HandCommand.position(0.1), _sample(3.0, folded))
    assert squeeze.position < folded
    assert squeeze.current == 240
    assert squeeze.profile_velocity == SLOW
    assert control.plan(OPEN, _sample(3.1, folded)).current == 800
    assert control.plan(CLOSE, _sample(3.2, folded)).current == 800


_commands = st.one_of(
    st.floats(0.0, 5.4).map(HandCommand.position),
    st.just(LIMP),
    st.just(BRAKE),
    st.builds(
        HandCommand.position,
        st.floats(0, 5.4),
        kp=st.sampled_from([0.0, 0.01, 5.0]),
        kd=st.floats(0, 1),
        tau=st.floats(-15, 15),
        dq=st.floats(-24, 24),
    ),
)


@given(
    steps=st.lists(
        st.tuples(_commands, st.integers(-50, 2550), st.floats(0, 0.3), st.integers(20, 85)),
        min_size=1,
        max_size=40,
    ),
    zero=st.integers(0, 4095),
    fold=st.booleans(),
)
def test_goals_stay_within_stroke_and_effort(
    steps: list[tuple[HandCommand, int, float, int]], zero: int, fold: bool
) -> None:
    control = Control(zero, ControlSettings(effort=40, hold_effort=20))
    now = 0.0
    commanded = False
    for command, relative, dt, temperature in steps:
        now += dt
        position = (zero + relative) % 4096 if fold else zero + relative
        goal = control.plan(command, _sample(now, position, temperature=temperature))
        assert 0 <= goal.current <= 640
        if goal.profile_velocity == 0:
            assert goal.position == position
            continue
        assert goal.profile_velocity in (FULL, SLOW)
        target = scaling.relative_position(goal.position, zero)
        commanded = commanded or not command.is_brake
        if command.is_brake:
            assert goal.current in ((320, 640) if commanded else (0,))
        elif command.kp[0] == 0:
            assert goal.current == 0
            assert goal.position == position
        else:
            assert goal.position - position == scaling.ticks_of_joint(float(command.q[0])) - (
                relative
            )
            assert 0 <= target <= 2500


@each(
    "wrong",
    [
        {"effort": 0},
        {"effort": 101},
        {"hold_effort": math.nan},
        {"speed": 1.0},
        {"speed": math.inf},
        {"hold_after": -1},
        {"warm": 90},
        {"startup_time": math.inf},
    ],
)
def test_invalid_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        ControlSettings(**wrong)


# --- recovery


def test_hardware_errors_map_to_text_and_motor_errors() -> None:
    assert describe(HardwareError(0x24)) == "overheating and overload"

    def bits(error: int, voltage: float = 12.0) -> MotorError:
        return motor_error(error, voltage, 9.5, 16.0)

    assert bits(HardwareError.OVERLOAD) == MotorError.OVERCURRENT
    assert bits(HardwareError.INPUT_VOLTAGE, 9.0) == MotorError.UNDERVOLTAGE
    assert bits(HardwareError.INPUT_VOLTAGE, 17.0) == MotorError.OVERVOLTAGE
    assert bits(HardwareError.INPUT_VOLTAGE, 12.0) == 0, "over, though the servo remembers it"
    assert bits(0x0C) == MotorError.WINDING_OVERTEMPERATURE | MotorError.OUTPUT_ENCODER
    for bit in HardwareError:
        assert (bits(bit, 9.0) != 0) == (bit != 0)


def test_reboot_delay_grows_and_resets() -> None:
    policy = RebootPolicy(first=0.5, factor=2, longest=3, forget=60)
    now, delays = 0.0, []
    for _ in range(5):
        policy.fault(now)
        assert not policy.due(now + policy.delay - 0.01, HardwareError.OVERLOAD, 40, 80)
        assert policy.due(now + policy.delay + 0.01, HardwareError.OVERLOAD, 40, 80)
        delays.append(policy.delay)
        now += policy.delay + 1
    assert delays == [0.5, 1, 2, 3, 3]
    policy.fault(now + 100)
    assert policy.delay == 0.5


def test_a_hot_servo_is_not_rebooted() -> None:
    policy = RebootPolicy()
    policy.fault(0.0)
    assert not policy.due(1000.0, HardwareError.OVERHEATING, 75, 80)
    assert policy.due(1000.0, HardwareError.OVERHEATING, 70, 80)
    assert policy.due(1000.0, HardwareError.OVERLOAD, 75, 80)


# --- configuration


def test_calibration_store_keeps_unknown_keys(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.json"
    store = calibration_file.Store(path)
    assert store.read("A") == calibration_file.GripperRecord()
    assert store.keys() == []
    store.write("A", calibration_file.GripperRecord(zero=3010))
    store.write("A", calibration_file.GripperRecord(opening=130.123, closing=120.0))
    store.write("B#2", calibration_file.GripperRecord(zero=-10, force_table=DEFAULT_FORCE_TABLE))
    content = json.loads(path.read_text())
    content["left"] = "/dev/ttyUSB0"
    path.write_text(json.dumps(content))
    store.write("A", calibration_file.GripperRecord(zero=3011))
    record = store.read("A")
    assert (record.zero, record.opening, record.closing) == (3011, 130.12, 120.0)
    assert store.read("B#2").zero == 4086
    assert store.read("B#2").force_table == DEFAULT_FORCE_TABLE
    assert json.loads(path.read_text())["left"] == "/dev/ttyUSB0"
    assert store.keys() == ["A", "B#2"]
    there = sorted(p.name for p in path.parent.iterdir())
    assert there == [".file.json.lock", "file.json"], "no temporary file stays"


def test_calibration_file_of_sakes_driver_is_read(tmp_path: Path) -> None:
    path = tmp_path / "ezgripper_device_config.json"
    path.write_text(
        '{"left": "/dev/ttyUSB0", "left_serial": "DA1Z9T40", "calibration": {"DA1Z9T40": 3010},'
        '"movement_speed": {"DA1Z9T40": 50.0}, "force_lookup": {"DA1Z9T40": {"0": 0, "9": 1}}}'
    )
    record = calibration_file.Store(path).read("DA1Z9T40")
    assert record.zero == 3010
    assert record.opening == record.closing == 50.0
    assert record.force_table is not None
    assert record.force_table.force(4.5) == 0.5
    assert not record.force_unit_known, "SAKE's file does not say what the currents are"


def test_the_file_names_the_adapter_of_a_side(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    store = calibration_file.Store(path)
    assert store.device(Side.LEFT) is None
    path.write_text('{"left": "/dev/ttyUSB0", "left_serial": "DA1Z9T40", "right": "/dev/ttyUSB1"}')
    assert store.device(Side.LEFT) == "DA1Z9T40"
    assert store.device(Side.RIGHT) == "/dev/ttyUSB1"
    path.write_text('{"left_serial": 3}')
    with pytest.raises(UsageError, match="left_serial must be text"):
        store.device(Side.LEFT)


def test_a_file_that_is_written_back_keeps_the_types_of_its_readers(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    before = {
        "left": "/dev/ttyUSB0",
        "left_serial": "A",
        "calibration": {"A": 3010, "B": -7},
        "movement_speed": {"A": 50.0, "B": 60},
        "force_lookup": {"A": {"0": 0, "9": 1.5}},
    }
    path.write_text(json.dumps(before))
    store = calibration_file.Store(path)
    table = ForceTable(((0.0, 0.0), (480.0, 3.5)))
    store.write(
        "A", calibration_file.GripperRecord(1, opening=130.0, closing=120.0, force_table=table)
    )
    after = json.loads(path.read_text())
    assert after["movement_speed"] == {"A": 120.0, "B": 60}
    assert after["calibration"] == {"A": 1, "B": -7}
    assert after["force_lookup"] == {"A": {"0": 0.0, "480": 3.5}}
    assert (after["left"], after["left_serial"]) == ("/dev/ttyUSB0", "A")
    record = store.read("A")
    assert (record.opening, record.closing, record.force_unit_known) == (130.0, 120.0, True)
    after["movement_speed"]["A"] = 55.0  # measured again by a program that knows one speed
    path.write_text(json.dumps(after))
    record = store.read("A")
    assert (record.opening, record.closing) == (55.0, 55.0)
    path.write_text('{"movement_speed": {"A": {"opening": 131.0, "closing": 127.5}}}')
    record = store.read("A")
    assert (record.opening, record.closing) == (131.0, 127.5), "as it was stored before"


def test_force_is_extrapolated_beyond_the_table() -> None:
    table = ForceTable(((0.0, 0.0), (320.0, 2.0), (640.0, 4.0)))
    assert [table.force(c) for c in (640, 800, -1216)] == pytest.approx([4.0, 5.0, 7.6])
    assert [table.covers(c) for c in (-640, 641)] == [True, False]
    assert ForceTable(((0.0, 1.0),)).force(100) == 1.0


@each(
    "text",
    [
        "",
        "{",
        "[]",
        '{"calibration": 3}',
        '{"calibration": {"A": "3010"}}',
        '{"calibration": {"A": 1.5}}',
        '{"calibration": {"A": true}}',
        '{"calibration": {"A": 99999999}}',
        '{"movement_speed": {"A": 0}}',
        '{"movement_speed": {"A": NaN}}',
        '{"movement_speed": {"A": {"opening": "fast"}}}',
        '{"force_lookup": {"A": []}}',
        '{"force_lookup": {"A": {"0": -1}}}',
        '{"force_lookup": {"A": {"0": 1}}, "force_lookup_unit": {"A": "mA"}}',
        "[" * 100_000,
        "\x00\xff",
    ],
)
def test_a_damaged_file_is_a_clear_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError):
        calibration_file.Store(path).read("A")


def test_environment_variable_sets_calibration_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(calibration_file.ENVIRONMENT, str(tmp_path / "x.json"))
    assert calibration_file.Store().path == tmp_path / "x.json"
    monkeypatch.delenv(calibration_file.ENVIRONMENT)
    assert calibration_file.default_path().name == "ezgripper.json"
    assert calibration_file.record_key("DA1Z9T40", 1) == "DA1Z9T40"
    assert calibration_file.record_key("DA1Z9T40", 3) == "DA1Z9T40#3"


# --- calibration


class _Answering:
    """A servo that moves with ``speed`` percent a second, ``late`` seconds after each new goal."""

    def __init__(self, speed: float, late: float) -> None:
        self.speed, self.late = speed, late
        self.now, self.position, self.goal, self.since = 0.0, float(ZERO), ZERO, 0.0

    def sample(self) -> Sample:
        return _sample(self.now, round(self.position))

    def exchange(self, goal: Goal) -> Sample:
        if goal.position != self.goal:
            self.goal, self.since = goal.position, self.now
        self.now += 0.005
        if self.now - self.since > self.late:
            way = self.goal - self.position
            step = self.speed * scaling.TICKS_PER_PERCENT * 0.005
            self.position += math.copysign(min(abs(way), step), way)
        return self.sample()

    def engage(self, goal: Goal) -> None:
        self.exchange(goal)

    def rearm_watchdog(self) -> None:
        raise AssertionError


def test_the_overhead_of_a_move_is_not_its_distance_over_the_speed() -> None:
    for way in calibration.measure_distances(_Answering(150.0, 0.05), ZERO):
        assert way.speed == pytest.approx(150.0, rel=0.03)
        # less the last percent, from which on a move counts as done
        assert way.overhead == pytest.approx(0.05 - 1 / 150, abs=0.01)
        assert [percent for percent, _ in way.times] == list(calibration.DISTANCES)
