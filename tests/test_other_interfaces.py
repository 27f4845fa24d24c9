"""Interfaces of public drivers and simulations are called by their name."""

from __future__ import annotations

import pytest

from dexkit.other_interfaces import is_two_fingers, other_interface


@pytest.mark.parametrize(
    "topic",
    [
        "rt/gripper/left/cmd_direct",
        "rt/gripper/right/state_direct",
        "rt/gripper/left/telemetry",
        "rt/ezgripper/right/admin",
    ],
)
def test_sakes_driver_of_2026(topic: str) -> None:
    assert "rt/dex1/{side}/cmd" in other_interface(topic)


@pytest.mark.parametrize("topic", ["rt/dex1/left/cmd", "rt/gripper/cmd_direct", "rt/lowstate"])
def test_other_topics_are_not(topic: str) -> None:
    assert other_interface(topic) == ""


def test_two_finger_motors_in_metres() -> None:
    none = [0.0] * 5
    assert is_two_fingers([0.02, 0.02, *none], [1000.0, 1000.0, *none])
    assert is_two_fingers([0.0, 0.0], [1000.0, 1000.0])
    assert not is_two_fingers([0.02] * 7, [1.5] * 7)  # a Dex3-1
    assert not is_two_fingers([0.0] * 7, [0.0] * 7)  # a stop
    assert not is_two_fingers([1.2, 0.5, *none], [1000.0, 1000.0, *none])  # radians
    assert not is_two_fingers([0.0], [1000.0])
