"""Test that habits of a hand are measured over a whole run, and that a good hand has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.conformance.kit.habits import habits, silences
from dexkit.conformance.kit.provenance import Provenance
from dexkit.conformance.kit.recording import Commands, Recording, SideView, States, joints_of
from dexkit.conformance.kit.state_faults import faults
from dexkit.conformance.kit.stimulus_record import Phase, Stimulus
from dexkit.hand import Floats, Side
from dexkit.models import dialect

SPOKEN = dialect("unitree_go")
RATE = 200
STEP_S = 1.0
Goals = Callable[[float], float]
Hand = Callable[[Goals, float, float], float]
"""The next q of a hand, by the goals at each time, the time and its q."""


def follower(speed: float = 15.0, delay: float = 0.02, stiff: float = 30.0) -> Hand:
    """A hand that goes to its goal with such a top speed, rad/s."""

    def step(goal: Goals, now: float, q: float) -> float:
        rate = float(np.clip(stiff * (goal(now - delay) - q), -speed, speed))
        return q + rate / RATE

    return step


def recorded(hand: Hand, goals: list[float], change: Callable[[Floats], Floats]) -> Recording:
    """Steps of a gripper to these goals."""
    t = np.arange(0.0, STEP_S * (len(goals) + 1), 1 / RATE)

    def goal(now: float) -> float:
        return ([2.7, *goals])[max(0, min(int(now / STEP_S + 1e-6), len(goals)))]

    q = [2.7]
    for now in t[:-1].tolist():
        q.append(hand(goal, now, q[-1]))
    column = change(np.array(q))[:, np.newaxis]
    zero = np.zeros_like(column)
    count = np.ones(len(t), dtype=np.intp)
    given = np.array([[goal(now)] for now in t.tolist()])
    states = States("state", t, t, count, column, zero, zero, zero, zero)
    commands = Commands("cmd", t, t, count, given, zero, zero, zero + 5.0, zero, zero)
    view = SideView(Side.LEFT, states, commands, joints_of(SPOKEN, Side.LEFT))
    second = 1_000_000_000
    phases = [
        Phase("step", (Side.LEFT,), i * second, (i + 1) * second, {Side.LEFT: {0: goal(i)}})
        for i in range(1, len(goals) + 1)
    ]
    return Recording(
        SPOKEN,
        0,
        float(t[-1]),
        {Side.LEFT: view},
        [],
        [],
        Stimulus(phases),
        (Side.LEFT,),
        provenance=Provenance(),
    )


GOALS = [4.8, 0.6, 3.0, 4.9, 1.2, 2.4, 4.4, 0.9, 3.3, 1.5, 4.0, 0.5, 2.2, 4.7]


def told(hand: Hand, change: Callable[[Floats], Floats] = np.copy) -> list[str]:
    recording = recorded(hand, GOALS, change)
    return [habit.sentence for habit in habits(recording, recording.sides[Side.LEFT])]


@settings(deadline=None, max_examples=25)
@given(
    speed=st.floats(4.5, 20.0),
    delay=st.floats(0.0, 0.1),
    stiff=st.floats(10.0, 60.0),
    goals=st.lists(st.floats(0.0, 5.4), min_size=6, max_size=14),
)
def test_a_good_hand_has_no_habit(
    speed: float, delay: float, stiff: float, goals: list[float]
) -> None:
    recording = recorded(follower(speed, delay, stiff), goals, np.copy)
    assert not list(habits(recording, recording.sides[Side.LEFT]))


def dead(goal: Goals, now: float, q: float) -> float:
    return q


def clamped(goal: Goals, now: float, q: float) -> float:
    return follower()(lambda at: min(goal(at), 2.7), now, q)


def dead_later(goal: Goals, now: float, q: float) -> float:
    return q if now > 6.0 else follower()(goal, now, q)


def halfway_short(goal: Goals, now: float, q: float) -> float:
    return follower()(lambda at: goal(at) if abs(goal(at) - q) > 0.3 else q, now, q)


def tired(goal: Goals, now: float, q: float) -> float:
    return follower(0.5 if 4.0 < now < 9.0 else 15.0)(goal, now, q)


@pytest.mark.parametrize(
    ("hand", "words"),
    [
        (dead, "no motion in 14 of 14 steps"),
        (dead_later, "no motion in 9 steps from 6.0 s to 14.0 s"),
        (follower(speed=0.8), "moves at 0.8 rad/s at most (median) in "),
        (tired, "in 5 steps from 4.0 s to 8.0 s, in hardly any of 9 others"),
        (follower(delay=0.4), "begins to move 0.4"),
        (clamped, "stops at 2.70 rad"),
        (halfway_short, "from its target (median) in 14 of 14 steps"),
    ],
)
def test_a_habit_is_told_with_its_figures(hand: Hand, words: str) -> None:
    assert words in told(hand)[0]


def test_a_lag_behind_a_stream_of_targets_is_told() -> None:
    def smooth(goal: Goals, now: float, q: float) -> float:
        return q + 1.6 * (goal(now) - q) / RATE

    def told_of(hand: Hand) -> list[str]:
        steps = recorded(hand, GOALS, np.copy)
        phase = Phase("operator", (Side.LEFT,), 1_000_000_000, 14_000_000_000)
        recording = replace(steps, stimulus=Stimulus([phase]))
        return [h.sentence for h in habits(recording, recording.sides[Side.LEFT])]

    assert "follows a moving target" in told_of(smooth)[0]
    assert not told_of(follower())


def test_swings_are_told() -> None:
    speed = [0.0]

    def undamped(goal: Goals, now: float, q: float) -> float:
        speed[0] = 0.995 * speed[0] + 400.0 * (goal(now) - q) / RATE
        return q + speed[0] / RATE

    assert "swings past its target" in told(undamped)[0]


def fault_kinds(change: Callable[[Floats], Floats]) -> dict[str, str]:
    recording = recorded(follower(), GOALS, change)
    found = faults(recording, recording.sides[Side.LEFT])
    return {fault.kind: fault.sentence for fault in found}


def test_a_position_that_wraps_is_told() -> None:
    sentence = fault_kinds(lambda q: (q + 4.0) % 8.0 - 4.0)["wraps"]
    assert "wraps around" in sentence
    assert "wraps" not in fault_kinds(np.copy)


def test_bursts_and_silences_at_rest_are_told() -> None:
    recording = recorded(follower(), GOALS, np.copy)
    view = recording.sides[Side.LEFT]
    assert not list(silences(recording, view))
    late = replace(view.states, t=np.ceil(view.states.t / 0.2) * 0.2)
    (burst,) = silences(recording, replace(view, states=late))
    assert "states come in bursts: 40 at once (median), 0.20 s apart" in burst.sentence
    moves = np.append(True, np.abs(np.diff(view.states.q[:, 0])) > 1e-4)
    some = States("state", *(part[moves] for part in parts_of(view.states)))
    (rest,) = silences(recording, replace(view, states=some))
    assert "no states while the hand rests" in rest.sentence


def parts_of(s: States) -> tuple[Any, ...]:
    return s.t, s.sent, s.length, s.q, s.dq, s.ddq, s.tau, s.mode
