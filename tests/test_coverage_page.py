"""Test the grids of what the requirements cover."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dexkit.models import dialect
from tools.coverage.measure import Measured, measure
from tools.coverage.page import page


@pytest.fixture(scope="module")
def gripper() -> Measured:
    return measure(dialect("unitree_go"))


def test_what_a_check_reads_and_what_it_is_sent_is_noted(gripper: Measured) -> None:
    by_id = {each.requirement.id: each for each in gripper.covered}
    assert {"q", "t"} <= by_id["DEX1-MOVE-02"].members
    assert "step" in by_id["DEX1-MOVE-02"].phases
    assert by_id["DEX1-RATE-01"].members <= {"t", "sent"}
    assert gripper.sent["step"].filled == {"q", "kp", "kd"}
    assert gripper.sent["listen"].filled == set()


def test_a_member_and_a_client_that_nothing_covers_are_named(gripper: Measured) -> None:
    assert not {f"states[].{name}" for name in ("q", "mode", "temperature")} & set(gripper.unread)
    sent = {name: each for name, each in gripper.sent.items() if name != "operator"}
    text = page([replace(gripper, unread=["states[].lost"], sent=sent)])
    assert "read by no requirement: `states[].lost`" in text
    assert "Unitree's client, closed loop never drives it" in text
