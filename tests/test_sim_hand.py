"""sim-dex1: the motor's law, and motion like that of the recorded teleoperation sessions."""

from __future__ import annotations

import math
from collections import deque

import pytest

from dexkit.clock import ManualClock
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.hand import HandCommand, HandState


def opened(**options: float) -> tuple[SimHand, ManualClock]:
    clock = ManualClock()
    hand = SimHand(clock=clock, **options)  # type: ignore[arg-type]
    hand.open()
    return hand, clock


def hold(
    hand: SimHand, clock: ManualClock, command: HandCommand, seconds: float, hz: float = 500
) -> HandState:
    state = hand.exchange(command)
    for _ in range(int(seconds * hz)):
        clock.advance(1 / hz)
        state = hand.exchange(command)
    return state


def teleoperate(hand: SimHand, clock: ManualClock, target: float) -> list[tuple[float, ...]]:
    """The rule of the genuine client: 0.18 rad lead on the last state, three-value filter."""
    goals: deque[float] = deque(maxlen=3)
    start = clock.now()
    q = float(hand.joint.q)
    goal = q
    rows = []
    for tick in range(3000):
        clock.advance(1e-3)
        if tick % 2 == 0:
            state = hand.exchange(HandCommand.position(goal))
            q = float(state.q[0])
            rows.append((clock.now() - start, q, float(state.dq[0]), float(state.tau_est[0])))
        if tick % 5 == 0:
            clipped = min(max(target, q - 0.18), q + 0.18)
            if not goals or goals[-1] != clipped:
                goals.append(clipped)
            weights = (0.2, 0.3, 0.5)[-len(goals) :]
            goal = sum(w * g for w, g in zip(weights, goals, strict=True)) / sum(weights)
    return rows


def test_moves_like_the_recorded_sessions() -> None:
    """10 to 90 % of the stroke in 0.68 s at 6.5 rad/s (traces/README)."""
    hand, clock = opened(start_pct=0.0)
    rows = teleoperate(hand, clock, 5.4)
    t10 = next(t for t, q, *_ in rows if q > 0.54)
    t90 = next(t for t, q, *_ in rows if q > 4.86)
    assert t90 - t10 == pytest.approx(0.68, rel=0.05)
    assert max(dq for _, _, dq, _ in rows) == pytest.approx(6.5, rel=0.05)
    assert max(q for _, q, *_ in rows) < 5.5


def test_blocked_hand_has_the_torque_of_the_recorded_sessions() -> None:
    """About -0.9 N m against an object, which gives way by torque over its stiffness."""
    hand, clock = opened(start_pct=100.0, object_pct=40.0)
    rows = teleoperate(hand, clock, 0.0)
    _, q, dq, tau = rows[-1]
    assert tau == pytest.approx(-0.9, abs=0.03)
    assert q == pytest.approx(0.4 * 5.4 - 0.9 / 60, abs=0.01)
    assert dq == pytest.approx(0.0, abs=1e-3)


def test_no_gain_is_limp() -> None:
    hand, clock = opened()
    limp = HandCommand.position(5.0, kp=0.0, kd=0.0)
    state = hold(hand, clock, limp, 0.5)
    assert state.q[0] == pytest.approx(1.08)
    assert state.tau_est[0] == 0.0
    hand.joint.dq = 3.0
    clock.advance(0.1)
    # nothing but its own friction stops it
    assert hand.exchange(limp).q[0] - 1.08 == pytest.approx(0.5 * 0.002 * 9 / 0.08, rel=0.5)


def test_brake_stops_a_moving_hand_at_once() -> None:
    hand, clock = opened()
    hold(hand, clock, HandCommand.position(5.4), 0.1)
    clock.advance(0.002)
    moving = hand.exchange(HandCommand.brake(1))
    assert moving.dq[0] > 5
    clock.advance(0.05)
    state = hand.exchange(HandCommand.brake(1))
    assert state.dq[0] == pytest.approx(0.0, abs=1e-3)
    assert state.q[0] - moving.q[0] < 0.05


def test_hard_stops_hold() -> None:
    hand, clock = opened()
    state = hold(hand, clock, HandCommand.position(0.0, kp=0.0, kd=0.0, tau=5.0), 1.0)
    assert state.q[0] == pytest.approx(math.radians(322) + 5.0 / 200, abs=0.01)
    state = hold(hand, clock, HandCommand.position(0.0, kp=0.0, kd=0.0, tau=-5.0), 1.0)
    assert state.q[0] == pytest.approx(-5.0 / 200, abs=0.01)
