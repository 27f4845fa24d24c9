"""The joint under every emulated hand: equilibrium, friction, walls, determinism."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.emulators.mechanics import Joint, Wall
from dexkit.errors import UsageError

DT = 1e-3


def settle(joint: Joint, torque: float, seconds: float = 2.0, dt: float = DT) -> None:
    for _ in range(int(seconds / dt)):
        joint.step(torque, dt)


def test_free_joint_accelerates_as_newton_says() -> None:
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


def test_wall_does_not_pull() -> None:
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
def test_any_torque_keeps_it_between_its_stops(
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


def test_nonsense_is_refused() -> None:
    with pytest.raises(UsageError):
        Joint(inertia=0.0)
    with pytest.raises(UsageError):
        Wall(0.0, 0, 1.0)
    with pytest.raises(UsageError):
        Wall(0.0, 1, 0.0)
    with pytest.raises(UsageError):
        Wall(0.0, 1, 1.0, -1.0)
