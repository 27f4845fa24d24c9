"""The setting ``pose``: a simulated hand stands where the last process of its service left it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import ManualClock
from dexkit.emulators.sim_brainco import sim_brainco
from dexkit.emulators.sim_dex1 import sim_dex1
from dexkit.emulators.sim_dex3 import sim_dex3
from dexkit.emulators.sim_dex5 import SimDex5, sim_dex5
from dexkit.errors import UsageError
from dexkit.hand import Floats, HandCommand, JointMode, Side


def _options(file: Path) -> BackendOptions:
    return BackendOptions(Side.LEFT, settings={"pose": str(file)})


def _position(backend: Backend, file: Path) -> Floats:
    """Where the hand stands as its service starts and ends."""
    hand = backend.make(_options(file))
    hand.open()
    brake = HandCommand.brake(hand.spec.n_joints)
    q = np.array(hand.exchange(brake).q)
    hand.close()
    return q


@pytest.mark.parametrize("backend", [sim_dex1, sim_dex3, sim_dex5, sim_brainco])
def test_a_hand_starts_where_it_was_left(backend: Backend, tmp_path: Path) -> None:
    file = tmp_path / "pose.json"
    rest = _position(backend, file)
    left = rest + 0.01
    file.write_text(json.dumps(left.tolist()))
    assert np.allclose(_position(backend, file), left, atol=1e-3)
    assert np.allclose(json.loads(file.read_text()), left, atol=1e-3)
    assert [path.name for path in tmp_path.iterdir()] == ["pose.json"]


def test_the_pose_is_that_at_the_end_of_the_service(tmp_path: Path) -> None:
    clock = ManualClock()
    hand = SimDex5(Side.LEFT, clock=clock)
    hand.keep_pose(tmp_path / "pose.json")
    hand.open()
    n = hand.spec.n_joints
    goal = np.array([joint.q_min + 0.5 * joint.stroke for joint in hand.spec.joints])
    go = HandCommand(
        q=goal,
        dq=np.zeros(n),
        tau=np.zeros(n),
        kp=np.full(n, 2.0),
        kd=np.full(n, 0.2),
        mode=np.full(n, JointMode.FOC),
    )
    for _ in range(400):
        clock.advance(0.01)
        state = hand.exchange(go)
    hand.close()
    assert np.array_equal(json.loads((tmp_path / "pose.json").read_text()), state.q)


@pytest.mark.parametrize("text", ["", "{}", "[1.0]", "[NaN, 0, 0, 0, 0, 0, 0]", '["a"]', "\x00"])
def test_a_damaged_file_is_refused_and_kept(text: str, tmp_path: Path) -> None:
    file = tmp_path / "pose.json"
    file.write_text(text)
    with pytest.raises(UsageError, match="pose"):
        sim_dex3.make(_options(file))
    assert file.read_text() == text


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    hand = sim_dex3.make(_options(tmp_path / "none" / "pose.json"))
    hand.open()
    with pytest.raises(UsageError, match=r"cannot write .*none/pose\.json"):
        hand.close()
