"""Test the BrainCo Revo2: profile, dialect, simulated hand, client, units and the doctor."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.conformance.behaviours.stillness import _repeats
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.registry import mix
from dexkit.conformance.faults.servos import StatesSwapped, Vibrates
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual.brainco import BrainCoService
from dexkit.conformance.virtual.fingers import FingerHand
from dexkit.doctor.motion_direction import Course, moves_against, swapped
from dexkit.emulators.sim_brainco import SimBrainCo
from dexkit.hand import Floats, HandCommand, HandState, Side
from dexkit.messages import message_type, unitree_go
from dexkit.models import BRAINCO_REVO2, dialect
from dexkit.service.dialects import DialectMap, Fill, StateView, dialect_map
from dexkit.teleop import Operator, client_for, profile
from tests.each import each

BRAINCO = dialect("brainco")
STATES = message_type(BRAINCO.state_type)
LEFT, RIGHT = Side.LEFT, Side.RIGHT
N = 6
FULL = np.array([j.dq_max for j in BRAINCO_REVO2.joints[LEFT]])
RADIANS = re.compile(r"\brad\b|\bradians\b|N m\b|_rad\b")


# --------------------------------------------------------------------------------------- the model


def test_joints_are_in_client_order_and_of_one_travel() -> None:
    for side in Side:
        joints = BRAINCO_REVO2.joints[side]
        names = ["thumb", "thumb_aux", "index", "middle", "ring", "pinky"]
        assert [j.name for j in joints] == names
        assert {(j.q_min, j.q_max, j.closing, j.straight) for j in joints} == {(0.0, 1.0, 1, 0.0)}
    # 130 degrees a second over 1.47 rad
    assert FULL[2] == pytest.approx(math.radians(130) / 1.47)


# --------------------------------------------------------------------------------- simulated hand


def opened(side: Side = LEFT, **options: float) -> tuple[SimBrainCo, ManualClock]:
    clock = ManualClock()
    hand = SimBrainCo(side, clock=clock, **options)
    hand.open()
    return hand, clock


def hold(
    hand: SimBrainCo, clock: ManualClock, q: float, seconds: float, part: float = 1.0
) -> HandState:
    command = HandCommand.position([q] * N, dq=part * FULL)
    state = hand.exchange(command)
    for _ in range(round(seconds * 100)):
        clock.advance(0.01)
        state = hand.exchange(command)
    return state


def test_speed_of_the_command_is_the_speed() -> None:
    for part in (1.0, 0.5, 0.1):
        hand, clock = opened(start=0.0)
        hold(hand, clock, 1.0, 0.1, part)
        before = hand.mechanics.q
        hold(hand, clock, 1.0, 0.1, part)
        assert np.allclose((hand.mechanics.q - before) / 0.1, part * FULL, rtol=0.02)
    hand, clock = opened()
    before = hand.mechanics.q
    hold(hand, clock, 1.0, 0.5, 0.0)
    assert (hand.mechanics.q == before).all()


# --------------------------------------------------------------------------------------- dialect


def mapping(fill: Fill = Fill.KNOWN, side: Side = LEFT) -> DialectMap:
    return dialect_map(BRAINCO, {side: BRAINCO_REVO2.spec(side, io_rate=500.0)}, fill)


def message(count: int = N, **fields: float) -> unitree_go.MotorCmds_:
    return unitree_go.MotorCmds_([unitree_go.MotorCmd_(**fields) for _ in range(count)])  # type: ignore[arg-type]


@each(("dq", "part"), [(1.0, 1.0), (0.25, 0.25), (0.0, 0.0), (-3.0, 0.0), (7.0, 1.0)])
def test_dq_is_a_part_of_the_full_speed(dq: float, part: float) -> None:
    command = mapping().command(message(q=0.5, dq=dq), LEFT)
    assert command is not None
    assert np.allclose(command.dq, part * FULL)
    assert not command.is_limp  # though the client sends no gains


def test_five_joints_hold_no_command_and_more_than_six_do() -> None:
    assert mapping().command(message(5), LEFT) is None
    assert mapping().command(message(12, dq=1.0), LEFT) is not None


@given(st.lists(st.floats(0, 1), min_size=N, max_size=N), st.sampled_from(Fill))
def test_state_has_six_motors_in_the_vendors_units(q: list[float], fill: Fill) -> None:
    state = HandState.from_values(q, dq=-0.5 * FULL, tau_est=0.3, stamp=0.0)
    sent = STATES.decode(mapping(fill).encode({LEFT: StateView(state, (0,) * N)}))
    assert [m.q for m in sent.states] == pytest.approx(q, abs=1e-6)
    assert [m.dq for m in sent.states] == pytest.approx([-0.5] * N)
    assert [m.tau_est for m in sent.states] == pytest.approx([0.3] * N)


# ----------------------------------------------------------------------------------------- client


def test_client_sends_q_and_full_speed_and_waits_for_no_pose() -> None:
    client = client_for("brainco")
    open_hands = dict.fromkeys(Side, (0.0,) * N)
    assert client.step(0.0, {LEFT: open_hands[LEFT]}, {}) == {}
    assert client.missing == {RIGHT: ""}
    commands = client.step(0.01, open_hands, {})
    for motors in commands.values():
        assert {tuple(m) for m in motors} == {(0, 0.0, 1.0, 0.0, 0.0, 0.0)}
    commands = client.step(0.02, open_hands, dict.fromkeys(Side, (0.7,) * N))
    assert {m.q for motors in commands.values() for m in motors} == {0.7}
    fist = Operator(profile("fist", "brainco-revo2"), BRAINCO)
    pose = fist.inputs(2.5, Side)[LEFT]
    assert pose is not None
    assert max(pose) > 0.6


# ------------------------------------------------------------------------------------ conformance


def test_vibration_and_swapped_states_are_found_and_reported_in_parts_of_the_travel() -> None:
    plan = replace(plan_for("brainco"), phases=frozenset(["listen", "joint", "step"]))
    for fault, wanted in ((Vibrates, "BRAINCO-STILL-02"), (StatesSwapped, "BRAINCO-SIDE-01")):
        result = run_mutant(mix(fault, BrainCoService), plan)
        failed = {r.requirement.id: r for r in result.results if r.verdict is Verdict.FAIL}
        assert wanted in failed
        assert all(not RADIANS.search(r.observed) for r in result.results)
        assert all(not RADIANS.search(name) for r in result.results for name in r.values)
    assert any("full travel" in r.observed for r in result.results)


@each("states_hz", [100.0, 500.0])
def test_noise_of_a_hundredth_is_no_vibration_and_a_small_oscillation_is(states_hz: float) -> None:
    draw = np.random.default_rng(8)
    t: Floats = np.arange(round(0.25 * states_hz)) / states_hz
    for _ in range(300):
        noise = draw.uniform(-0.01, 0.01, len(t))
        assert not _repeats(t, 0.5 + noise, 4.0)
        assert not _repeats(t, 0.5 + 0.02 * np.exp(-t / 0.05) + noise, 4.0)
    assert not _repeats(t, np.full(len(t), 0.5), 4.0)
    for hertz in (8.0, 12.0, 25.0):
        wave = 0.003 * np.sin(2 * np.pi * hertz * t)
        assert _repeats(t, 0.5 + wave + draw.uniform(-3e-4, 3e-4, len(t)), 4.0)


class _Noisy(BrainCoService):
    """Has noise of 0.9 % of the travel in each direction."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.draw = np.random.default_rng(9)

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        motors["q"] += self.draw.uniform(-0.009, 0.009, len(motors))

    def live(self, dt: float) -> None:
        super().live(dt)
        for hand in self.hands.values():
            hand.version += 1


@pytest.mark.soak
def test_hand_with_noisy_positions_passes() -> None:
    result = run_mutant(_Noisy, plan_for("brainco"))
    assert {r.verdict for r in result.results} == {Verdict.PASS, Verdict.NOT_APPLICABLE}


# ----------------------------------------------------------------------------------------- doctor

UNIT = [(0.0, 1.0)] * N


def course(began: float, now: float, first: float, asked: float) -> Course:
    return Course((began,) * N, (now,) * N, (first,) * N, (asked,) * N)


@each(
    ("seen", "against"),
    [
        (course(0.9, 0.1, 0.1, 0.9), 6),  # a reversed scale
        (course(0.1, 0.9, 0.1, 0.9), 0),
        (course(0.9, 0.6, 0.1, 0.9), 0),  # on its way: nobody knows
        (course(0.85, 0.45, 0.1, 0.45), 0),  # has come to its goal from the other end
        (course(0.85, 0.55, 0.1, 0.45), 0),  # a little late
        (course(0.0, 0.0, 0.0, 1.0), 0),  # does not move
    ],
)
def test_reversed_scale_is_recognised(seen: Course, against: int) -> None:
    assert moves_against(seen, UNIT) == against


def test_swapped_sides_are_recognised() -> None:
    left, right = course(0.1, 0.1, 0.1, 0.9), course(0.5, 0.9, 0.5, 0.1)
    assert not swapped(left, right)  # the left one has not moved
    left = course(0.5, 0.1, 0.5, 0.9)
    assert swapped(left, right)
    assert not swapped(course(0.5, 0.9, 0.5, 0.9), course(0.5, 0.1, 0.5, 0.1))
