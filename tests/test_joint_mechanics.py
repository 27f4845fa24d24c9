"""The joint under every emulated hand: equilibrium, friction, walls, determinism."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.emulators.joint_mechanics import FixedSteps, Joint, Wall
from dexkit.errors import UsageError
from tests.each import each

DT = 1e-3


def settle(joint: Joint, torque: float, seconds: float = 2.0, dt: float = DT) -> None:
    for _ in range(int(seconds / dt)):
        joint.step(torque, dt)


def test_free_joint_accelerates_by_torque_over_inertia() -> None:
    joint = Joint(inertia=0.01)
    settle(joint, 0.5, 1.0)
    assert joint.dq == pytest.approx(0.5 / 0.01)
    assert joint.q == pytest.approx(0.5 * 50, rel=2e-3)


def test_viscous_friction_sets_the_top_speed() -> None:
    joint = Joint(inertia=0.01, viscous=0.1, coulomb=0.2)
    settle(joint, 0.7, 3.0)
    assert joint.dq == pytest.approx((0.7 - 0.2) / 0.1, rel=1e-6)


def test_coulomb_friction_holds_and_stops_exactly() -> None:
    joint = Joint(inertia=0.01, coulomb=0.2)
    settle(joint, 0.19)
    assert (joint.q, joint.dq) == (0.0, 0.0)
    settle(joint, -0.19)
    assert (joint.q, joint.dq) == (0.0, 0.0)
    joint.dq = 1.0
    settle(joint, 0.0)
    assert joint.dq == 0.0
    # it slid as far as friction took its energy
    assert joint.q == pytest.approx(0.5 * 0.01 / 0.2, rel=0.05)


def test_load_friction_adds_up() -> None:
    joint = Joint(inertia=0.01, coulomb=0.2)
    for _ in range(100):
        joint.step(0.5, DT, friction=0.31)
    assert joint.dq == 0.0


@pytest.mark.parametrize("push", [-1, 1])
def test_wall_gives_way_by_force_over_stiffness(push: int) -> None:
    joint = Joint(inertia=0.01, walls=(Wall(1.0, push, 100.0, 1.0),), q=1.0)
    settle(joint, -push * 5.0)
    assert joint.q == pytest.approx(1.0 - push * 5.0 / 100.0)
    assert joint.contact == pytest.approx(push * 5.0)


def test_wall_exerts_no_pull_on_a_leaving_joint() -> None:
    joint = Joint(inertia=0.01, walls=(Wall(0.0, 1, 1000.0, 10.0),), q=-0.001)
    settle(joint, 0.1, 0.5)
    assert joint.q > 0.5
    assert joint.contact == 0.0


def test_spring_returns_to_rest() -> None:
    joint = Joint(inertia=0.01, viscous=0.1, spring=1.0, spring_rest=0.7)
    settle(joint, 0.0, 10.0)
    assert joint.q == pytest.approx(0.7, abs=1e-3)


def test_locked_joint_does_not_move() -> None:
    joint = Joint(inertia=0.01, q=0.3, dq=2.0, locked=True)
    settle(joint, 100.0)
    assert (joint.q, joint.dq) == (0.3, 0.0)


@given(
    st.lists(st.floats(-8, 8), min_size=1, max_size=40),
    st.floats(0.0, 0.5),
    st.floats(0.0, 0.2),
    st.sampled_from([2e-4, 5e-4, 1e-3]),
)
@settings(deadline=None)
def test_joint_stays_between_its_stops_under_any_torque(
    torques: list[float], coulomb: float, viscous: float, dt: float
) -> None:
    """And two runs of the same are the same to the last bit."""
    runs = []
    for _ in range(2):
        joint = Joint(
            inertia=0.0125,
            coulomb=coulomb,
            viscous=viscous,
            walls=(Wall(0.0, 1, 60.0, 0.6), Wall(3.8, -1, 120.0, 1.0)),
            q=1.9,
        )
        trace = []
        for torque in torques:
            for _ in range(20):
                joint.step(torque, dt)
            trace.append(joint.q)
            # at most the static deflection plus what the impact at top speed can add
            assert -1.5 < joint.q < 5.3
            assert math.isfinite(joint.dq)
        runs.append(trace)
    assert runs[0] == runs[1]


@given(st.floats(0.05, 3.0), st.floats(-3.0, 3.0))
@settings(deadline=None)
def test_friction_never_adds_energy(coulomb: float, speed: float) -> None:
    joint = Joint(inertia=0.01, coulomb=coulomb, dq=speed)
    before = abs(speed)
    for _ in range(200):
        joint.step(0.0, DT)
        assert abs(joint.dq) <= before
        assert joint.dq * speed >= 0
        before = abs(joint.dq)


def test_invalid_parameters_are_refused() -> None:
    with pytest.raises(UsageError):
        Joint(inertia=0.0)
    with pytest.raises(UsageError):
        Wall(0.0, 0, 1.0)
    with pytest.raises(UsageError):
        Wall(0.0, 1, 0.0)
    with pytest.raises(UsageError):
        Wall(0.0, 1, 1.0, -1.0)


# -- under a motor ---------------------------------------------------------------------------


def test_motor_with_soft_gains_is_integrated_as_torque() -> None:
    driven, pushed = Joint(inertia=0.01, viscous=0.1), Joint(inertia=0.01, viscous=0.1)
    for _ in range(500):
        driven.drive(0.3, 0.0, 1.0, 1.0, DT)
        pushed.step(0.3, DT)
    assert driven.dq == pytest.approx(pushed.dq)
    assert driven.q == pytest.approx(pushed.q)


@each("damping", [0.1, 10.0, 1e4])
def test_stiff_gains_are_stable(damping: float) -> None:
    """Taken explicitly, the stiffest of these would grow by a factor of 50000 a step."""
    joint = Joint(inertia=2e-4, coulomb=0.002, dq=5.0)
    for _ in range(200):
        before = abs(joint.dq)
        torque = joint.drive(0.0, damping, 1e9, 1e9, DT)
        assert 0.0 <= joint.dq <= before
        assert torque == pytest.approx(-damping * joint.dq)
    assert joint.dq == 0.0


@each("damping", [0.1, 1.0, 10.0])
def test_blocked_motor_makes_its_full_torque(damping: float) -> None:
    joint = Joint(inertia=2e-4, coulomb=0.002, walls=(Wall(0.0, -1, 60.0, 0.1),))
    torque = 0.0
    for _ in range(5000):
        torque = joint.drive(0.4, damping, 0.7, 0.7, DT)
    assert torque == pytest.approx(0.4, rel=1e-3)
    assert joint.contact == pytest.approx(-0.4, abs=0.003)


def test_motor_torque_is_limited() -> None:
    joint = Joint(inertia=0.01)
    assert joint.drive(5.0, 0.0, 0.7, 0.3, DT) == pytest.approx(0.7)  # from rest
    assert joint.drive(5.0, 0.0, 0.7, 0.3, DT) == pytest.approx(0.3)  # along
    assert joint.drive(-5.0, 0.0, 0.7, 0.3, DT) == pytest.approx(-0.7)  # against
    joint.locked = True
    assert joint.drive(-5.0, 0.0, 0.7, 0.3, DT) == pytest.approx(-0.7)
    assert joint.dq == 0.0


def test_gear_friction_reduces_driving_and_adds_holding_torque() -> None:
    def at_rest(load: float) -> bool:
        joint = Joint(inertia=0.01, spring=1.0, spring_rest=-load)  # pulls with -load
        joint.drive(1.0, 0.0, 2.0, 2.0, DT, 0.4, 0.5)
        return joint.dq == 0.0

    assert [at_rest(load) for load in (0.55, 0.65, 1.45, 1.55)] == [False, True, True, False]


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(0, 1e5)), min_size=1, max_size=40),
    st.floats(0.0, 0.9),
    st.floats(0.0, 2.0),
)
@settings(deadline=None)
def test_no_control_law_passes_the_hard_stops(
    laws: list[tuple[float, float]], driving_loss: float, holding_loss: float
) -> None:
    joint = Joint(
        inertia=2e-4,
        coulomb=0.002,
        walls=(Wall(-1.0, 1, 200.0, 0.1), Wall(1.0, -1, 200.0, 0.1)),
    )
    for torque, damping in laws:
        for _ in range(20):
            given_torque = joint.drive(torque, damping, 0.76, 0.76, DT, driving_loss, holding_loss)
            assert abs(given_torque) <= 0.76
            assert abs(joint.q) < 1.2


# -- time ------------------------------------------------------------------------------------


def test_steps_follow_the_clock_without_drift() -> None:
    steps = FixedSteps(0.5e-3)
    steps.restart(100.0)
    lived = 0
    for i in range(1, 1001):
        lived += steps.due(100.0 + i * 0.0013)
        assert abs(lived - i * 2.6) < 1.001
    assert steps.due(100.0 + 1.3) == 0
    assert steps.due(99.0) == 0  # a clock that goes back costs nothing
    assert steps.done == lived == 2600


def test_long_pause_is_not_simulated() -> None:
    steps = FixedSteps(1e-3, most=0.5)
    steps.restart(0.0)
    assert steps.due(3600.0) == 500
    assert steps.due(3600.001) == 1
    assert steps.done == 3_600_001
    steps.restart(7.0)
    assert steps.due(7.25) == 250
