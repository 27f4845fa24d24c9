"""The mechanics of a Dex3-1: motors, stops, touch and heat, on steps instead of a clock."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.emulators.dex3_mechanics import F_1515_108, F_1515_214, Dex3Mechanics
from dexkit.emulators.finger_mechanics import AMBIENT, STEP, MotorModel
from dexkit.errors import UsageError
from dexkit.hand import Floats, HandCommand, JointMode, MotorError, Side
from dexkit.models import DEX3_1
from tests.each import each

KP, KD = DEX3_1.gains[0]
THUMB_0, THUMB_1, THUMB_2, MIDDLE_0, MIDDLE_1, INDEX_0, INDEX_1 = range(7)
FLEXING = (THUMB_1, THUMB_2, MIDDLE_0, MIDDLE_1, INDEX_0, INDEX_1)


def live(mechanics: Dex3Mechanics, seconds: float) -> Dex3Mechanics:
    mechanics.step(round(seconds / STEP))
    return mechanics


def goal(mechanics: Dex3Mechanics, joint: int, percent: float) -> float:
    """An angle, percent of the way from straight to closed."""
    spec = mechanics.specs[joint]
    return percent / 100 * (spec.q_max if spec.closing > 0 else spec.q_min)


def close_to(mechanics: Dex3Mechanics, percent: float, kp: float = KP, kd: float = KD) -> None:
    for joint in FLEXING:
        mechanics.command(joint, 1, goal(mechanics, joint, percent), kp=kp, kd=kd)


# -- motors ----------------------------------------------------------------------------------


def test_thumb_0_has_a_different_gear_ratio() -> None:
    assert [s.gear_ratio for s in Dex3Mechanics(Side.LEFT).specs] == [214.0] + 6 * [108.0]
    assert F_1515_108.driving_loss == pytest.approx(0.355, abs=1e-3)
    assert F_1515_108.holding_loss == pytest.approx(0.803, abs=1e-3)
    assert F_1515_214.driving_loss == pytest.approx(0.426, abs=1e-3)
    assert F_1515_214.holding_loss == pytest.approx(1.069, abs=1e-3)


@each("joint", range(7))
@each(("kp", "kd"), [(1.5, 0.2), (0.5, 0.1), (1.5, 0.1)])
def test_gains_of_the_clients_settle_at_the_goal(joint: int, kp: float, kd: float) -> None:
    """xr_teleoperate's, and both of the vendor's C++ example."""
    mechanics = Dex3Mechanics(Side.LEFT)
    spec = mechanics.specs[joint]
    target = spec.q_min + 0.6 * spec.stroke
    mechanics.command(joint, 1, target, kp=kp, kd=kd)
    start = mechanics.q[joint]
    live(mechanics, kd / kp)  # these gains are a first-order lag of kd / kp
    assert mechanics.q[joint] == pytest.approx(target + (start - target) / math.e, abs=0.03)
    live(mechanics, 2.0)
    # friction holds it where kp times the rest is below what the gearing takes
    assert mechanics.q[joint] == pytest.approx(target, abs=0.02)
    assert abs(mechanics.dq[joint]) < 1e-3
    assert abs(mechanics.tau[joint]) < 0.02


def test_reported_torque_follows_the_control_law() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=40)
    mechanics.command(INDEX_0, 1, goal(mechanics, INDEX_0, 60), dq=-0.5, tau=-0.05, kp=0.8, kd=0.1)
    for _ in range(400):
        mechanics.step()
        law = 0.8 * (goal(mechanics, INDEX_0, 60) - mechanics.q[INDEX_0]) + 0.1 * (
            -0.5 - mechanics.dq[INDEX_0]
        )
        assert mechanics.tau[INDEX_0] == pytest.approx(law - 0.05, abs=1e-9)


@pytest.mark.parametrize(("joint", "model"), [(MIDDLE_0, F_1515_108), (THUMB_0, F_1515_214)])
def test_torque_is_limited_and_falls_with_speed(joint: int, model: MotorModel) -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.command(joint, 1, -10.0, kp=100.0, kd=0.0)
    speeds = []
    for _ in range(400):
        before = abs(mechanics.dq[joint])
        mechanics.step()
        speeds.append(abs(mechanics.dq[joint]))
        most = model.tau_max * (1.0 - before / model.dq_max)
        if mechanics.dq[joint] < 0.0:
            assert abs(mechanics.tau[joint]) <= max(most, 0.0) + 1e-12
        assert abs(mechanics.tau[joint]) <= model.tau_max
    assert 0.5 * model.dq_max < max(speeds) < model.dq_max
    # blocked by the stop it gives all it has
    assert mechanics.tau[joint] == pytest.approx(-model.tau_max)


@pytest.mark.parametrize(("joint", "motor"), [(MIDDLE_0, F_1515_108), (THUMB_0, F_1515_214)])
def test_the_joint_pushes_less_and_holds_more_than_the_motor_makes(
    joint: int, motor: MotorModel
) -> None:
    """The manual's two "actual" maximum torques, found by turning the load up and down."""
    mechanics = Dex3Mechanics(Side.LEFT)
    pushed = mechanics.joints[joint]
    pushed.q, pushed.spring, pushed.spring_rest = -0.5, 10.0, -0.5
    for part in range(1, 101):  # slowly, so that it does not swing past
        mechanics.command(joint, 1, tau=-motor.tau_max * part / 100)
        live(mechanics, 0.02)
    assert 10.0 * (-0.5 - pushed.q) == pytest.approx(motor.tau_driving, rel=0.03)

    there = pushed.q
    for load, moves in ((0.95 * motor.tau_holding, False), (1.05 * motor.tau_holding, True)):
        mechanics.brake()
        pushed.dq, pushed.q, pushed.spring_rest = 0.0, there, there + load / pushed.spring
        mechanics.command(joint, 1, tau=-motor.tau_max)
        live(mechanics, 0.02)
        assert (pushed.q > there + 1e-6) == moves


def test_the_hand_on_the_right_is_the_mirror_of_the_left() -> None:
    left, right = Dex3Mechanics(Side.LEFT, object_at=45), Dex3Mechanics(Side.RIGHT, object_at=45)
    sign = np.array([1.0] + 6 * [-1.0])
    rng = np.random.default_rng(7)
    for _ in range(60):
        q, dq, tau = rng.uniform(-2, 2, 7), rng.uniform(-3, 3, 7), rng.uniform(-0.4, 0.4, 7)
        for joint in range(7):
            mode = int(rng.random() < 0.9)
            left.command(joint, mode, q[joint], dq[joint], tau[joint], KP, KD)
            flip = sign[joint]
            right.command(joint, mode, flip * q[joint], flip * dq[joint], flip * tau[joint], KP, KD)
        live(left, 0.05)
        live(right, 0.05)
        assert np.array_equal(left.q, sign * right.q)
        assert np.array_equal(left.tau, sign * right.tau)
        np.testing.assert_allclose(change(left), change(right), atol=1e-6)
    assert left.current == right.current


# -- stops, brake, limp ----------------------------------------------------------------------


@each("side", Side)
@each("sign", [-1, 1])
def test_hard_stops_lie_a_little_beyond_the_limits(side: Side, sign: int) -> None:
    mechanics = Dex3Mechanics(side)
    for joint in range(7):
        mechanics.command(joint, 1, tau=sign * 5.0)
    live(mechanics, 1.0)
    for spec, q in zip(mechanics.specs, mechanics.q, strict=True):
        limit = spec.q_max if sign > 0 else spec.q_min
        assert math.radians(1.9) < sign * (q - limit) < math.radians(3.0)
    assert (mechanics.dq == 0.0).all()


def test_brake_stops_at_once_and_limp_coasts() -> None:
    slid = {}
    for name, mode in (("brake", 0), ("unknown", 3), ("limp", 1)):
        mechanics = Dex3Mechanics(Side.LEFT, start=0)
        mechanics.command(MIDDLE_0, 1, tau=-0.3)
        live(mechanics, 0.02)
        before = mechanics.q[MIDDLE_0]
        assert mechanics.dq[MIDDLE_0] < -5.0
        mechanics.command(MIDDLE_0, mode, q=-1.5, kp=0.0 if mode == 1 else KP)
        live(mechanics, 0.05)
        slid[name] = before - mechanics.q[MIDDLE_0]
        assert mechanics.mode[MIDDLE_0] == (JointMode.FOC if mode == 1 else JointMode.BRAKE)
    assert slid["brake"] == slid["unknown"] < 0.03
    assert slid["limp"] > 0.2


def test_a_braked_hand_is_harder_to_move_than_a_limp_one() -> None:
    moved = []
    for mode in (0, 1):
        mechanics = Dex3Mechanics(Side.LEFT)
        mechanics.command(INDEX_0, mode)
        pushed = mechanics.joints[INDEX_0]
        pushed.spring, pushed.spring_rest = 0.05, -1.5  # something pulls with up to 0.06 N m
        live(mechanics, 0.1)
        moved.append(-0.3 - pushed.q)
    assert 0.0 < moved[0] < 0.1 * moved[1]


def test_negative_gain_does_not_destabilise_the_joint() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.command(INDEX_0, 1, -1.0, kp=-5.0, kd=-1.0)
    assert live(mechanics, 1.0).q[INDEX_0] == pytest.approx(-0.3)


def test_a_repeated_command_changes_nothing() -> None:
    """Neither does the short-cut for joints at rest."""
    once, often = Dex3Mechanics(Side.LEFT, object_at=40), Dex3Mechanics(Side.LEFT, object_at=40)
    close_to(once, 80)
    for _ in range(300):
        close_to(often, 80)
        once.step(5)
        often.step(5)
    assert (once.dq == 0.0).all()
    assert np.array_equal(once.q, often.q)
    assert np.array_equal(once.tau, often.tau)
    once.joints[INDEX_0].q -= 0.1  # moved by hand at rest: noticed
    live(once, 2.0)
    assert once.q[INDEX_0] == pytest.approx(often.q[INDEX_0], abs=0.01)


command = st.tuples(
    st.integers(0, 6),
    st.integers(0, 7),
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 1e3),
    st.floats(-10, 1e4),
    st.floats(-10, 1e3),
)


@given(
    st.sampled_from(Side),
    st.lists(st.tuples(command, st.integers(0, 40)), min_size=1, max_size=40),
    st.sampled_from([None, 25.0, 60.0]),
)
def test_any_command_keeps_the_state_finite(
    side: Side,
    moves: list[tuple[tuple[int, int, float, float, float, float, float], int]],
    object_at: float | None,
) -> None:
    mechanics = Dex3Mechanics(side, object_at=object_at)
    low = np.array([s.q_min for s in mechanics.specs]) - 0.1
    high = np.array([s.q_max for s in mechanics.specs]) + 0.1
    most = np.array([F_1515_214.tau_max] + 6 * [F_1515_108.tau_max])
    for (joint, mode, q, dq, tau, kp, kd), steps in moves:
        mechanics.command(joint, mode, q, dq, tau, kp, kd)
        mechanics.step(steps)
        state = mechanics.state(0.0)
        assert ((state.q > low) & (state.q < high)).all()
        assert (np.abs(state.tau_est) <= most).all()
        assert np.isfinite(state.dq).all()
        assert np.isfinite(state.ddq).all()
        assert state.pressure is not None
        assert np.isfinite(state.pressure[~np.isnan(mechanics.sensor_temperature)]).all()


# -- an object -------------------------------------------------------------------------------


def test_grip_force_grows_with_the_gain() -> None:
    torques = []
    for kp in (0.5, 1.5):
        mechanics = Dex3Mechanics(Side.LEFT, object_at=40)
        close_to(mechanics, 65, kp=kp)
        live(mechanics, 2.0)
        for joint in FLEXING:
            behind = goal(mechanics, joint, 65) - mechanics.q[joint]
            assert mechanics.tau[joint] == pytest.approx(kp * behind)
            assert abs(mechanics.q[joint]) > abs(goal(mechanics, joint, 40))
            # the gearing takes its part of it
            assert 0.5 < mechanics.contact[joint] / abs(mechanics.tau[joint]) < 1.0
        torques.append(abs(mechanics.tau))
    assert (torques[1][1:] > 2.5 * torques[0][1:]).all()


def change(mechanics: Dex3Mechanics) -> Floats:
    """What touches change in the pressures, Pa, shape (9, 12)."""
    return mechanics.pressure - mechanics.untouched


def elements(mechanics: Dex3Mechanics) -> dict[str, bool]:
    """Which sensors feel something."""
    return {
        sensor.place: bool((change(mechanics)[i][list(sensor.slots)] > 0).any())
        for i, sensor in enumerate(DEX3_1.sensors)
    }


def test_no_pressure_without_an_object() -> None:
    mechanics = Dex3Mechanics(Side.RIGHT)
    close_to(mechanics, 90)
    live(mechanics, 1.0)
    for values in (mechanics.pressure, mechanics.sensor_temperature):
        assert values.shape == (9, 12)
        assert np.isfinite(values).sum() == 33
    assert np.nansum(change(mechanics)) == 0.0
    assert (
        np.nanmax(mechanics.sensor_temperature)
        == np.nanmin(mechanics.sensor_temperature)
        == AMBIENT
    )


@each("side", Side)
@each(
    ("joint", "place"),
    [
        (THUMB_1, "thumb pad"),
        (THUMB_2, "thumb tip"),
        (MIDDLE_0, "middle pad"),
        (MIDDLE_1, "middle tip"),
        (INDEX_0, "index pad"),
        (INDEX_1, "index tip"),
    ],
)
def test_only_the_touching_link_has_pressure(side: Side, joint: int, place: str) -> None:
    mechanics = Dex3Mechanics(side, object_at=50)
    mechanics.command(joint, 1, goal(mechanics, joint, 70), kp=KP, kd=KD)
    live(mechanics, 1.0)
    assert [name for name, felt in elements(mechanics).items() if felt] == [place]


def test_a_strong_grip_presses_the_object_into_the_palm() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=50)
    close_to(mechanics, 58)
    live(mechanics, 1.0)
    felt = elements(mechanics)
    assert felt["index pad"]
    assert not felt["palm 0"]
    gentle = change(mechanics)
    close_to(mechanics, 100)
    live(mechanics, 1.0)
    assert all(elements(mechanics).values())
    assert np.nanmax(change(mechanics)) > 2 * np.nanmax(gentle)
    # 10 g to 2500 g
    assert 0.098 / 0.9e-4 < np.nanmin(change(mechanics)) < np.nanmax(change(mechanics)) < 2.8e5


def test_pressure_is_limited_to_2500_g_an_element() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=50)
    mechanics.joints[THUMB_2].locked = True
    mechanics.joints[THUMB_2].q = 1.7  # squeezed far beyond what the motor can do
    assert np.nanmax(change(mechanics)) == pytest.approx(2.5 * 9.81 / 0.9e-4)


@each("side", Side)
def test_untouched_elements_rest_near_the_pressure_of_the_air(side: Side) -> None:
    # docs/sources/unitree-dex.md#b4: 101,000 to 103,300 were reported of a real hand
    mechanics, twin = Dex3Mechanics(side), Dex3Mechanics(side)
    found = np.array([live(mechanics, 0.05).pressure for _ in range(100)])
    assert 101_000 <= np.nanmin(found) <= np.nanmax(found) <= 103_300
    assert len(np.unique(found[0][np.isfinite(found[0])])) == 33, "each has its own offset"
    assert 20 < np.nanmin(np.ptp(found, axis=0)) <= np.nanmax(np.ptp(found, axis=0)) < 100
    np.testing.assert_array_equal(live(twin, 5.0).pressure, found[-1])
    # equal for a while, so that what encodes it need not do so 1000 times a second
    changes = [not np.array_equal(live(twin, 0.01).pressure, found[-1], equal_nan=True)]
    before = twin.pressure
    for _ in range(99):
        now = live(twin, 0.01).pressure
        changes.append(not np.array_equal(now, before, equal_nan=True))
        before = now
    assert sum(changes) == 20


@each("kp", [0.05, 1.5])
def test_a_light_touch_and_a_squeeze_are_seen_by_programs_of_real_hands(kp: float) -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=50)
    before = mechanics.pressure
    close_to(mechanics, 100, kp=kp)
    live(mechanics, 2.0)
    assert np.nanmax(mechanics.pressure - before) > 1000
    assert (np.nanmax(mechanics.pressure) > 150_000) == (kp > 1)


def test_the_least_force_that_is_felt_is_a_contact_for_programs_of_real_hands() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.press(0, 4 * 0.0099 * 9.81)  # 0.3 of it on one element
    assert np.nanmax(change(mechanics)) > 1000


def test_fingers_that_rest_beyond_the_object_start_on_it() -> None:
    mechanics = Dex3Mechanics(Side.RIGHT, object_at=10)
    for joint in FLEXING:
        assert mechanics.q[joint] == goal(mechanics, joint, 10)
    live(mechanics, 0.5)
    assert np.nansum(change(mechanics)) == 0.0


# -- heat, supply, faults --------------------------------------------------------------------


def test_a_stalled_motor_warms_up_and_cools_down() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=40)
    assert (mechanics.temperature == AMBIENT).all()
    mechanics.command(INDEX_0, 1, goal(mechanics, INDEX_0, 100), kp=KP, kd=KD)
    live(mechanics, 20.0)
    warm = mechanics.winding_temperature[INDEX_0]
    assert warm > 35.0
    assert AMBIENT < mechanics.temperature[INDEX_0] < warm
    assert mechanics.winding_temperature[MIDDLE_0] == AMBIENT
    live(mechanics, 130.0)
    hot = mechanics.temperature[INDEX_0]
    assert 45.0 < hot < 80.0
    assert mechanics.errors == [0] * 7  # a grip is no fault
    assert mechanics.fans
    mechanics.command(INDEX_0, 0)
    live(mechanics, 150.0)
    assert AMBIENT < mechanics.temperature[INDEX_0] < 0.5 * (hot + AMBIENT)
    assert not mechanics.fans


def test_supply_current_follows_the_motors() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, supply_v=58.0)
    live(mechanics, 0.1)
    assert mechanics.current == pytest.approx(0.2)  # the manual's static current
    assert mechanics.supply.power_v == 58.0
    assert mechanics.supply.device_v == 24.0
    mechanics = Dex3Mechanics(Side.LEFT, object_at=40)
    live(mechanics, 0.1)
    idle = mechanics.current
    close_to(mechanics, 100)
    live(mechanics, 1.0)
    assert idle < mechanics.current < 10.0
    assert mechanics.supply.power_a == mechanics.current


def test_imu_measures_gravity() -> None:
    assert Dex3Mechanics(Side.LEFT).imu.accelerometer == (0.0, 0.0, 9.81)


def test_an_overheated_motor_brakes_until_it_has_cooled() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.command(INDEX_0, 1, -1.2, kp=KP, kd=KD)
    live(mechanics, 0.05)
    mechanics.heat(INDEX_0, 125.0)
    assert MotorError(mechanics.errors[INDEX_0]) == (
        MotorError.CASE_TEMPERATURE | MotorError.WINDING_OVERTEMPERATURE
    )
    mechanics.command(INDEX_0, 1, -1.2, kp=KP, kd=KD)
    assert mechanics.mode[INDEX_0] == JointMode.BRAKE
    live(mechanics, 0.5)
    assert mechanics.q[INDEX_0] > -1.0
    assert mechanics.fans
    live(mechanics, 150.0)
    assert mechanics.errors[INDEX_0] == 0
    mechanics.command(INDEX_0, 1, -1.2, kp=KP, kd=KD)
    assert live(mechanics, 2.0).q[INDEX_0] == pytest.approx(-1.2, abs=0.02)


def test_a_failed_motor_brakes_until_it_recovers() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.fail(INDEX_0, MotorError.OVERCURRENT)
    for joint in (INDEX_0, INDEX_1):
        mechanics.command(joint, 1, -1.2, kp=KP, kd=KD)
    live(mechanics, 1.0)
    assert mechanics.errors[INDEX_0] == MotorError.OVERCURRENT
    assert mechanics.q[INDEX_0] == pytest.approx(-0.3)
    assert mechanics.q[INDEX_1] == pytest.approx(-1.2, abs=0.02)
    mechanics.recover(INDEX_0, MotorError.OVERCURRENT)
    assert live(mechanics, 1.0).q[INDEX_0] == pytest.approx(-0.3)
    mechanics.command(INDEX_0, 1, -1.2, kp=KP, kd=KD)
    assert live(mechanics, 2.0).q[INDEX_0] == pytest.approx(-1.2, abs=0.02)


def test_a_motor_without_power_makes_no_torque() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.power(INDEX_0, False)
    mechanics.command(INDEX_0, 1, -1.2, tau=-0.5, kp=KP, kd=KD)
    live(mechanics, 0.5)
    assert (mechanics.q[INDEX_0], mechanics.tau[INDEX_0]) == (-0.3, 0.0)
    mechanics.power(INDEX_0, True)
    assert live(mechanics, 0.5).q[INDEX_0] == -0.3  # it waits for a command
    mechanics.command(INDEX_0, 1, -1.2, kp=KP, kd=KD)
    assert live(mechanics, 2.0).q[INDEX_0] == pytest.approx(-1.2, abs=0.02)


def test_jammed_joint_makes_torque_without_motion() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.jam(INDEX_0, True)
    mechanics.command(INDEX_0, 1, -0.5, kp=KP, kd=KD)
    live(mechanics, 0.5)
    assert mechanics.q[INDEX_0] == pytest.approx(-0.3)
    assert mechanics.tau[INDEX_0] == pytest.approx(-0.2 * KP)
    mechanics.jam(INDEX_0, False)
    assert live(mechanics, 2.0).q[INDEX_0] == pytest.approx(-0.5, abs=0.02)


def test_state_holds_every_quantity_of_the_mechanics() -> None:
    mechanics = Dex3Mechanics(Side.LEFT, object_at=40)
    mechanics.apply(HandCommand.position(DEX3_1.rest_q[Side.LEFT], kp=KP, kd=KD))
    state = live(mechanics, 0.1).state(3.5)
    assert state.stamp == 3.5
    for name in ("q", "dq", "ddq", "tau", "temperature", "winding_temperature"):
        value = getattr(state, "tau_est" if name == "tau" else name)
        assert np.array_equal(value, getattr(mechanics, name))
        assert value.flags.c_contiguous
    assert state.mode.tolist() == [1] * 7
    assert state.fault.tolist() == [0] * 7
    assert state.voltage.tolist() == [24.0] * 7
    assert state.sensor_lost is not None
    assert state.sensor_lost.tolist() == [0] * 9
    assert state.imu is mechanics.imu
    assert state.supply == mechanics.supply
    state.q[0] = 9.0  # states are copies
    assert state.pressure is not None
    state.pressure[:] = 9.0
    assert mechanics.q[0] != 9.0
    assert np.nanmin(mechanics.pressure) > 1e5


def test_acceleration_is_the_mean_over_the_last_steps() -> None:
    mechanics = Dex3Mechanics(Side.LEFT)
    mechanics.command(INDEX_0, 1, tau=-0.05)
    before = mechanics.dq[INDEX_0]
    mechanics.step(4)
    assert mechanics.ddq[INDEX_0] == pytest.approx((mechanics.dq[INDEX_0] - before) / (4 * STEP))
    mechanics.step(0)
    assert mechanics.ddq[INDEX_0] < 0.0


@each(
    "wrong",
    [
        {"object_at": 0.0},
        {"object_at": 100.0},
        {"start": -1.0},
        {"start": 50.0, "object_at": 40.0},
        {"supply_v": 12.0},
        {"supply_v": math.nan},
    ],
)
def test_invalid_values_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        Dex3Mechanics(Side.LEFT, **wrong)
