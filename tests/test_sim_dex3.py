"""sim-dex3: a Hand on a clock, and motion like that of the recorded teleoperation session."""

from __future__ import annotations

import numpy as np
import pytest

from dexkit.backends import BackendOptions
from dexkit.clock import ManualClock
from dexkit.emulators.sim_dex3 import SimDex3, sim_dex3
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, Side
from dexkit.models import DEX3_1
from dexkit.traces import open_trace, sample_path
from tests.each import each

KP, KD = DEX3_1.gains[0]


def opened(side: Side = Side.LEFT, **options: float) -> tuple[SimDex3, ManualClock]:
    clock = ManualClock()
    hand = SimDex3(side, clock=clock, **options)
    hand.open()
    return hand, clock


def hold(
    hand: SimDex3, clock: ManualClock, command: HandCommand, seconds: float, hz: float = 200
) -> HandState:
    state = hand.exchange(command)
    for _ in range(int(seconds * hz)):
        clock.advance(1 / hz)
        state = hand.exchange(command)
    return state


def test_each_joint_has_its_own_mode_gains_and_feed_forward() -> None:
    hand, clock = opened()
    rest = np.array(DEX3_1.rest_q[Side.LEFT])
    command = HandCommand(
        q=np.array([0.5, 0.5, 0.5, -1.0, 0.0, -1.0, 0.0]),
        dq=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]),
        tau=np.array([0.0, 0.0, 0.0, 0.0, -0.1, 0.0, 0.0]),
        kp=np.array([1.5, 0.0, 1.5, 1.5, 0.0, 1.5, 0.0]),
        kd=np.array([0.2, 0.0, 0.2, 0.2, 0.2, 0.2, 0.2]),
        mode=np.array([1, 1, 0, 1, 1, 0, 1], dtype=np.uint8),
    )
    state = hold(hand, clock, command, 1.0)
    moved = np.abs(state.q - rest)
    assert state.q[[0, 3]] == pytest.approx([0.5, -1.0], abs=0.02)
    assert moved[[1, 2, 5]].max() == 0.0  # limp, braked, braked
    assert -0.6 < state.dq[4] < -0.4  # feed-forward against its own damping
    assert -1.05 < state.dq[6] < -0.9  # a speed to keep
    assert state.mode.tolist() == command.mode.tolist()


def test_state_has_every_field() -> None:
    hand, clock = opened(object_at=40, supply_v=48)
    closed = np.array([j.q_max if j.closing > 0 else j.q_min for j in hand.spec.joints])
    state = hold(hand, clock, HandCommand.position(closed, kp=KP, kd=KD), 5.0)
    assert state.winding_temperature is not None
    assert state.sensor_temperature is not None
    assert (state.winding_temperature[1:] > state.temperature[1:]).all()
    assert (state.temperature[1:] > 25.0).all()
    assert np.isfinite(state.ddq).all()
    assert state.voltage.tolist() == [24.0] * 7
    assert state.pressure is not None
    assert state.pressure.shape == state.sensor_temperature.shape == (9, 12)
    assert np.isfinite(state.pressure).sum() == 33
    assert (state.pressure[np.isfinite(state.pressure)] > 0).all()
    assert state.imu is not None
    assert state.imu.accelerometer[2] == 9.81
    assert state.supply is not None
    assert state.supply.power_v == 48.0
    assert 0.2 < state.supply.power_a < 2.0


@pytest.mark.parametrize("side", Side)
def test_follows_the_recorded_session_as_the_recorded_hand_did(side: Side) -> None:
    trace = open_trace(sample_path("dex3_pinch.mcap"))
    states, commands = (trace.samples(f"rt/dex3/{side}/{what}") for what in ("state", "cmd"))
    recorded = states.columns()["motor_state[].q"]
    goals = commands.columns()["motor_cmd[].q"]
    start = trace.first_ns
    hand, clock = opened(side)
    for joint, q in zip(hand.mechanics.joints, recorded[0], strict=True):
        joint.q = float(q)
    # the right hand closes on an object from 11 s on
    last = int(np.searchsorted(states.log_time_ns - start, 11e9 if side is Side.RIGHT else 20e9))
    command, sent = HandCommand.brake(7), 0
    error = []
    for i in range(0, last, 2):
        clock.sleep_until((states.log_time_ns[i] - start) / 1e9)
        while sent < len(goals) and commands.log_time_ns[sent] <= states.log_time_ns[i]:
            command = HandCommand.position(goals[sent], kp=KP, kd=KD)
            sent += 1
        error.append(hand.exchange(command).q - recorded[i])
    assert sent > 900
    assert np.abs(error).max() < 0.03
    assert np.sqrt(np.mean(np.square(error))) < 0.01


def test_backend_sim_dex3_reads_its_settings() -> None:
    hand = sim_dex3.create(
        BackendOptions(Side.RIGHT, settings={"object": "60", "start": "50", "supply": "36"})
    )
    assert isinstance(hand, SimDex3)
    assert hand.mechanics.q[6] == pytest.approx(0.5 * 1.7453)
    assert hand.mechanics.supply_v == 36.0


@each(
    "settings",
    [
        {"supply": "5"},
        {"supply": "much"},
    ],
)
def test_bad_settings_are_refused(settings: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        sim_dex3.create(BackendOptions(Side.LEFT, settings=settings))
