"""A replay names states that stand still while their commands move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexkit.hand import Floats, Side
from dexkit.traces import sample_path
from dexkit.traces.replay.commands import RecordedCommands, read_session
from dexkit.traces.replay.frozen import frozen_joints
from dexkit.traces.replay.prepare import Finding, Level, ReplayOptions, prepare
from tests.test_dataset_profile import SAMPLES


def frozen(session: RecordedCommands, options: ReplayOptions | None = None) -> list[Finding]:
    return [
        f
        for f in prepare(session, options or ReplayOptions()).findings
        if f.name == "frozen-states"
    ]


@pytest.mark.parametrize("sample", SAMPLES)
def test_no_sample_is_frozen(sample: str) -> None:
    assert frozen(read_session(sample_path(sample))) == []


def spoiled(first: int, joints: slice) -> RecordedCommands:
    """The pinch, with some joints of the right hand that repeat a state from there on."""
    session = read_session(sample_path("dex3_pinch"))
    t, q = session.states[Side.RIGHT]
    q = q.copy()
    q[first:, joints] = q[first, joints]
    return replace(session, states={**session.states, Side.RIGHT: (t, q)})


@pytest.mark.parametrize("first", [0, 3000])
@pytest.mark.parametrize("joints", [slice(None), slice(3, 4)])
def test_a_frozen_hand_or_joint_is_a_note(first: int, joints: slice) -> None:
    (found,) = frozen(spoiled(first, joints))
    assert found.level is Level.NOTE
    assert found.where == "right"
    assert ("middle_0" in found.text) == (joints != slice(None))
    assert ("thumb_0, thumb_1, thumb_2" in found.text) == (joints == slice(None))


def test_frozen_states_are_not_played() -> None:
    session = spoiled(0, slice(None))
    (found,) = frozen(session, ReplayOptions(states=True))
    assert found.level is Level.REFUSED
    assert frozen(session, ReplayOptions(states=True, sides=(Side.LEFT,))) == []


def joint(q: Floats, goal: Floats, follows: bool = True) -> dict[int, tuple[float, float]]:
    """Of a joint with a range of 1, at 100 Hz."""
    t = np.arange(len(q)) / 100
    driven = np.full((len(q), 1), follows)
    return frozen_joints(t, q[:, None], t, goal[:, None], driven, np.ones(1))


def test_an_object_is_no_fault() -> None:
    goal = 0.5 - 0.5 * np.cos(np.arange(1000) / 100)
    held = np.minimum(goal, 0.4)
    assert joint(held, goal) == {}
    stuck = np.where(np.arange(1000) < 200, goal, goal[200])
    assert joint(stuck, goal) == {0: (2.0, 9.99)}
    assert joint(stuck, goal, follows=False) == {}, "nothing drives it"
    assert joint(np.zeros(1000), np.zeros(1000)) == {}, "nothing is asked"
    assert joint(np.zeros(1000), goal) == {0: (0.0, 9.99)}
