"""Test motor, profiles, heat and supply of the emulated servo against data sheet values."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.emulators.mx64 import Firmware, Physics, Servo
from dexkit.emulators.mx64.drive import PERIOD, Drive, Profile
from dexkit.wire import mx64
from dexkit.wire.mx64 import HardwareError, MovingStatus, OperatingMode
from tests.each import each
from tests.mx64_helpers import QUIET, read, ready, run, servo, write

EZ = OperatingMode.CURRENT_BASED_POSITION


def bare(mode: OperatingMode, **demand: float) -> Drive:
    """A servo without gripper: no stops, no tendon friction."""
    drive = Drive(Physics())
    drive.joint.walls = ()
    drive.joint.spring = 0.0
    drive.joint.coulomb = Physics().coulomb
    drive.joint.viscous = Physics().viscous
    drive.demand = dataclasses.replace(drive.demand, torque=True, mode=mode, **demand)
    drive.reset_control()
    return drive


def test_no_load_speed_matches_data_sheet() -> None:
    drive = bare(OperatingMode.PWM, pwm=mx64.PWM_MAX)
    for _ in range(1000):
        drive.step()
    assert drive.velocity * 60 / (2 * math.pi) == pytest.approx(63, rel=0.02)


def test_stall_torque_and_current_match_data_sheet() -> None:
    drive = bare(OperatingMode.PWM, pwm=mx64.PWM_MAX)
    drive.physics = dataclasses.replace(drive.physics, supply_resistance=0.0)
    drive.joint.locked = True
    for _ in range(100):
        drive.step()
    assert drive.current == pytest.approx(4.1, rel=0.02)
    p = drive.physics
    torque = p.kt * drive.current * (1 - p.gear_loss) - p.coulomb
    assert torque == pytest.approx(6.0, rel=0.02)


def test_full_stroke_time_follows_motor_speed() -> None:
    """No faster than the no-load bound of 0.58 s (docs/sources/mx64-ezgripper.md#d1), no slower
    than 0.75 s.
    """
    target = servo(start=0.0)
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, 800)
    start = read(target, mx64.PRESENT_POSITION)
    write(target, mx64.GOAL_POSITION, start + mx64.EZGRIPPER_STROKE)
    begin = target.now
    while target.drive.opening < 98.0:
        run(target, 0.005)
        assert target.now < begin + 2.0
    assert 0.57 < target.now - begin < 0.75


def test_free_motion_current_matches_logs() -> None:
    """8 to 106 units in free motion (docs/sources/mx64-ezgripper.md#b7)."""
    target = servo(start=0.0)
    ready(target, EZ)
    write(target, mx64.GOAL_POSITION, read(target, mx64.PRESENT_POSITION) + 2400)
    run(target, 0.35)
    assert 8 <= read(target, mx64.PRESENT_CURRENT) <= 106


def test_closing_decreases_ticks_and_stops_at_the_closed_end() -> None:
    target = servo()
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, 480)
    write(target, mx64.GOAL_POSITION, -15000)
    run(target, 0.1)
    assert read(target, mx64.PRESENT_VELOCITY) < 0
    run(target, 1.5)
    zero = read(target, mx64.PRESENT_POSITION)
    assert 1510 - 60 < zero <= 1510
    readings = set()
    for _ in range(10):
        run(target, 0.033)
        readings.add(read(target, mx64.PRESENT_POSITION))
    assert max(readings) - min(readings) <= 2  # the calibration's test for "stopped"
    assert read(target, mx64.PRESENT_CURRENT) == -480


@pytest.mark.parametrize("units", [160, 320, 640])
def test_object_is_touched_and_squeezed(units: int) -> None:
    target = servo(object_pct=40.0, start=80.0)
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, units)
    write(target, mx64.GOAL_POSITION, 1510)
    run(target, 1.5)
    opening = target.drive.opening
    assert 20 < opening < 40
    assert read(target, mx64.PRESENT_CURRENT) == -units
    # what friction lets through of the motor's torque, held by the object's spring
    p = target.physics
    torque = p.kt * units * mx64.CURRENT_UNIT
    least = torque * (1 - p.gear_loss) - p.coulomb - p.gripper.coulomb
    squeeze = (40.0 - opening) / 100 * mx64.EZGRIPPER_STROKE * mx64.TICK
    most = torque * (1 + p.gear_loss) + p.coulomb + p.gripper.coulomb
    assert least <= squeeze * p.gripper.object_stiffness * 1.05
    assert squeeze * p.gripper.object_stiffness <= most * 1.05 + 0.3


def test_more_current_squeezes_harder() -> None:
    openings = []
    for units in (160, 320, 640):
        target = servo(object_pct=40.0, start=80.0)
        ready(target, EZ)
        write(target, mx64.GOAL_CURRENT, units)
        write(target, mx64.GOAL_POSITION, 1510)
        run(target, 1.5)
        openings.append(target.drive.opening)
    assert openings[0] > openings[1] > openings[2]


def test_squeezed_object_pushes_back_when_torque_goes() -> None:
    target = servo(object_pct=40.0, start=80.0)
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, 640)
    write(target, mx64.GOAL_POSITION, 1510)
    run(target, 1.5)
    squeezed = target.drive.opening
    write(target, mx64.TORQUE_ENABLE, 0)
    run(target, 5.0)
    # until friction holds what is left
    assert squeezed + 2 < target.drive.opening < 42
    assert target.drive.resting


def test_springs_do_not_back_drive_the_gears() -> None:
    target = servo(start=10.0)
    run(target, 5.0)
    assert target.drive.opening == pytest.approx(10.0, abs=0.1)


# --- modes


def test_position_mode_reaches_its_goal() -> None:
    target = servo()
    ready(target, OperatingMode.POSITION)
    for goal in (2000, 3600, 1600):
        write(target, mx64.GOAL_POSITION, goal)
        run(target, 1.5)
        assert read(target, mx64.PRESENT_POSITION) == pytest.approx(goal, abs=25)


def test_integral_gain_removes_steady_error() -> None:
    target = servo()
    ready(target, OperatingMode.POSITION)
    write(target, mx64.POSITION_I_GAIN, 2000)
    write(target, mx64.GOAL_POSITION, 3600)
    run(target, 4.0)
    assert read(target, mx64.PRESENT_POSITION) == pytest.approx(3600, abs=4)


def test_velocity_mode_holds_its_speed() -> None:
    target = servo(start=0.0)
    ready(target, OperatingMode.VELOCITY)
    write(target, mx64.GOAL_VELOCITY, 100)
    run(target, 0.8)
    assert read(target, mx64.PRESENT_VELOCITY) == pytest.approx(100, abs=5)
    assert read(target, mx64.VELOCITY_TRAJECTORY) == 100
    write(target, mx64.GOAL_VELOCITY, 0)
    run(target, 0.5)
    assert read(target, mx64.PRESENT_VELOCITY) == pytest.approx(0, abs=5)


def test_velocity_mode_ramps_with_profile_acceleration() -> None:
    target = servo(start=0.0)
    ready(target, OperatingMode.VELOCITY)
    write(target, mx64.PROFILE_ACCELERATION, 10)  # 2146 rev/min2: 20 rpm take 0.56 s
    write(target, mx64.GOAL_VELOCITY, round(20 / 0.229))
    run(target, 0.28)
    half = read(target, mx64.VELOCITY_TRAJECTORY) * 0.229
    assert half == pytest.approx(10, abs=0.5)


def test_current_mode_moves_until_blocked() -> None:
    target = servo()
    ready(target, OperatingMode.CURRENT)
    write(target, mx64.GOAL_CURRENT, -200)
    run(target, 1.5)
    assert target.drive.opening == pytest.approx(0.0, abs=2)
    assert read(target, mx64.PRESENT_CURRENT) == -200
    # too little current does not even overcome friction
    weak = servo()
    ready(weak, OperatingMode.CURRENT)
    write(weak, mx64.GOAL_CURRENT, -20)
    run(weak, 0.5)
    assert weak.drive.opening == pytest.approx(50.0, abs=0.1)


def test_pwm_mode_sets_the_duty() -> None:
    target = servo(start=0.0)
    ready(target, OperatingMode.PWM)
    write(target, mx64.GOAL_PWM, 300)
    run(target, 0.3)
    assert read(target, mx64.PRESENT_PWM) == pytest.approx(300, abs=1)
    assert read(target, mx64.PRESENT_VELOCITY) > 50
    limited = servo(start=0.0)
    write(limited, mx64.PWM_LIMIT, 100)
    ready(limited, OperatingMode.POSITION)
    write(limited, mx64.GOAL_POSITION, 4000)
    run(limited, 0.3)
    assert read(limited, mx64.PRESENT_PWM) == 100


def test_goal_pwm_limits_the_current_mode_too() -> None:
    target = servo(object_pct=45.0)
    ready(target, EZ)
    write(target, mx64.GOAL_PWM, 100)
    write(target, mx64.GOAL_POSITION, 1510)
    run(target, 1.0)
    assert read(target, mx64.PRESENT_PWM) == -100
    assert abs(read(target, mx64.PRESENT_CURRENT)) < 150


def test_feedforward_reduces_following_error() -> None:
    """With the profile's speed fed forward the servo lags its trajectory less."""
    lags = []
    for gain in (0, 800):
        target = servo(start=0.0)
        ready(target, OperatingMode.EXTENDED_POSITION)
        write(target, mx64.FEEDFORWARD_1ST_GAIN, gain)
        write(target, mx64.FEEDFORWARD_2ND_GAIN, gain)
        write(target, mx64.PROFILE_ACCELERATION, 100)
        write(target, mx64.PROFILE_VELOCITY, 100)
        write(target, mx64.GOAL_POSITION, 3500)
        run(target, 0.6)
        lags.append(read(target, mx64.POSITION_TRAJECTORY) - read(target, mx64.PRESENT_POSITION))
    assert lags[1] < lags[0] / 1.2


def test_present_current_option_follows_goal() -> None:
    follows = dataclasses.replace(QUIET, current_follows_goal=True)
    target = servo(object_pct=45.0, firmware=follows)
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, 300)
    write(target, mx64.GOAL_POSITION, 1510)
    run(target, 1.0)
    assert read(target, mx64.PRESENT_CURRENT) == -300


def test_noise_on_current_is_seeded() -> None:
    def readings(seed: int) -> list[int]:
        target = Servo(firmware=Firmware(current_noise=5.0), seed=seed)
        return [read(target, mx64.PRESENT_CURRENT) for _ in range(20)]

    assert readings(1) == readings(1) != readings(2)


# --- profiles


@given(
    st.floats(-5000, 5000),
    st.integers(1, 1000),
    st.integers(0, 2000),
)
def test_profile_arrives_exactly_and_keeps_its_limits(
    goal: float, velocity: int, acceleration: int
) -> None:
    profile = Profile()
    profile.hold(0.0)
    profile.start(goal, velocity, acceleration)
    speed = velocity * mx64.VELOCITY_UNIT / mx64.TICK
    ramp = acceleration * mx64.ACCELERATION_UNIT / mx64.TICK or math.inf
    limit = abs(goal) / speed + (speed / ramp if ramp < math.inf else 0.0) * 2 + 0.1
    before = 0.0
    for _ in range(int(min(limit, 60.0) / PERIOD) + 1):
        profile.step(PERIOD)
        assert abs(profile.velocity) <= speed * 1.0001
        # the last period closes a rest smaller than one period's motion
        assert not profile.running or abs(profile.velocity - before) <= ramp * PERIOD * 1.01
        assert min(0.0, goal) - 1e-6 <= profile.position <= max(0.0, goal) + 1e-6
        before = profile.velocity
        if not profile.running:
            break
    else:
        assert limit > 60.0, "did not arrive"
        return
    assert profile.position == goal


@each(
    ("velocity", "acceleration", "seconds"),
    # t = 64 dPos / V + 64 V / A ms (docs/sources/mx64-ezgripper.md#b5)
    [(100, 0, 0.64 * 1), (100, 100, 0.64 + 0.064), (50, 100, 1.28 + 0.032)],
)
def test_profile_time_matches_manual(velocity: int, acceleration: int, seconds: float) -> None:
    profile = Profile()
    profile.hold(0.0)
    profile.start(1000.0, velocity, acceleration)
    time = 0.0
    while profile.running:
        profile.step(PERIOD)
        time += PERIOD
        assert time < 10
    assert time == pytest.approx(seconds, rel=0.02)


@each(("total", "ramp"), [(1000, 0), (1000, 250), (500, 400)])
def test_time_based_profile_ends_on_time(total: int, ramp: int) -> None:
    profile = Profile()
    profile.hold(100.0)
    profile.start(900.0, total, ramp, timed=True)
    time = 0.0
    while profile.running:
        profile.step(PERIOD)
        time += PERIOD
        assert time < 10
    assert time == pytest.approx(total * 1e-3, abs=0.012)


def test_new_goal_keeps_the_speed() -> None:
    profile = Profile()
    profile.hold(0.0)
    profile.start(2000.0, 200, 50)
    for _ in range(150):
        profile.step(PERIOD)
    before = profile.velocity
    profile.start(-2000.0, 200, 50)
    profile.step(PERIOD)
    assert 0 < profile.velocity < before
    assert before - profile.velocity < 50 * mx64.ACCELERATION_UNIT / mx64.TICK * PERIOD * 1.01


def test_step_without_profile_has_no_shape() -> None:
    profile = Profile()
    profile.start(100.0, 0, 10)
    assert (profile.shape, profile.position, profile.running) == (MovingStatus.NONE, 100.0, False)


# --- heat and supply


@pytest.mark.parametrize(("percent", "rate"), [(15, 0.0149), (30, 0.0326), (45, 0.0647)])
def test_holding_heats_as_measured(percent: int, rate: float) -> None:
    """SAKE's three holds: time for the first 5 degC, within 20 %
    (docs/sources/mx64-ezgripper.md#d6).
    """
    target = servo(start=1.0, firmware=dataclasses.replace(QUIET, overload_level=9.0))
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, 1600 * percent // 100)
    write(target, mx64.GOAL_POSITION, -15000)
    run(target, 2.0)
    start, begin = target.drive.temperature, target.now
    run(target, 20.0)
    assert (target.drive.temperature - start) / (target.now - begin) == pytest.approx(rate, rel=0.2)


def test_overheating_shuts_down() -> None:
    target = servo()
    ready(target, EZ)
    target.drive.temperature = 80.9
    run(target, 0.05)
    assert target.hardware_error == HardwareError.NONE
    target.drive.temperature = 82.0
    run(target, 0.05)
    assert target.hardware_error == HardwareError.OVERHEATING
    assert not target.torque


def test_motor_cools_to_ambient_temperature() -> None:
    target = servo()
    target.drive.temperature = 75.0
    run(target, 20 * 60.0)
    standby = 25.0 + 1.2 * 1200 / 296
    assert target.drive.temperature == pytest.approx(
        standby + (75 - standby) * math.exp(-1), abs=0.2
    )


@pytest.mark.parametrize(("units", "trips"), [(720, False), (800, True)])
def test_overload_needs_load_and_time(units: int, trips: bool) -> None:
    """45 % of 1600 holds for minutes, 50 % does not (docs/sources/mx64-ezgripper.md#d6,
    docs/sources/mx64-ezgripper.md#e).
    """
    target = servo(start=1.0)
    ready(target, EZ)
    write(target, mx64.GOAL_CURRENT, units)
    write(target, mx64.GOAL_POSITION, -15000)
    run(target, 4.5)
    assert target.hardware_error == HardwareError.NONE
    run(target, 6.0)
    assert target.hardware_error == (HardwareError.OVERLOAD if trips else HardwareError.NONE)
    assert target.torque is not trips


def test_overload_can_be_masked() -> None:
    target = servo(start=1.0)
    write(target, mx64.SHUTDOWN, HardwareError.OVERHEATING)
    ready(target, EZ)
    write(target, mx64.GOAL_POSITION, -15000)
    run(target, 8.0)
    assert target.hardware_error == HardwareError.OVERLOAD
    assert target.torque


def test_supply_sags_under_load() -> None:
    target = servo(start=1.0)
    assert read(target, mx64.PRESENT_INPUT_VOLTAGE) == 120
    ready(target, EZ)
    write(target, mx64.GOAL_POSITION, -15000)
    run(target, 1.0)
    assert 110 <= read(target, mx64.PRESENT_INPUT_VOLTAGE) < 118


def test_servo_is_slower_at_a_low_supply_voltage() -> None:
    times = []
    for volts in (11.1, 14.8):
        target = servo(start=0.0, supply_voltage=volts)
        ready(target, EZ)
        write(target, mx64.GOAL_POSITION, 4000)
        begin = target.now
        while target.drive.opening < 95:
            run(target, 0.005)
        times.append(target.now - begin)
    # ROBOTIS: 58 and 78 rpm without load
    assert times[0] / times[1] == pytest.approx(78 / 58, rel=0.1)


def test_jammed_gear_overloads() -> None:
    target = servo()
    ready(target, EZ)
    target.drive.joint.locked = True
    write(target, mx64.GOAL_POSITION, 1600)
    at = read(target, mx64.PRESENT_POSITION)
    run(target, 6.0)
    assert read(target, mx64.PRESENT_POSITION) == at
    assert target.hardware_error == HardwareError.OVERLOAD


def test_two_runs_are_the_same_to_the_last_bit() -> None:
    traces = []
    for _ in range(2):
        target = servo(object_pct=30.0, firmware=Firmware())
        ready(target, EZ)
        trace = []
        for goal in (1510, 4000, 2000, 1510):
            write(target, mx64.GOAL_POSITION, goal)
            for _ in range(20):
                run(target, 0.0173)
                trace.append((target.drive.joint.q, read(target, mx64.PRESENT_CURRENT)))
        traces.append(trace)
    assert traces[0] == traces[1]


def test_result_is_independent_of_step_length() -> None:
    ends = []
    for step in (0.001, 0.0037, 0.5):
        target = servo(object_pct=30.0)
        ready(target, EZ)
        write(target, mx64.GOAL_POSITION, 1510)
        for k in range(1, int(1.0 / step) + 1):
            target.advance_to(k * step)
        target.advance_to(1.0)
        ends.append(target.drive.joint.q)
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)
    assert ends[0] == pytest.approx(ends[2], abs=1e-4)
