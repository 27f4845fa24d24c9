"""Unitree's own Python SDK, in another process, as the client of a served hand."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import pytest

from dexkit.emulators.sim_dex1 import SimHand
from dexkit.hand import Side
from dexkit.messages import unitree_go, unitree_hg
from dexkit.models import dialect
from dexkit.service import HandService
from tests.dds_helpers import dds_domain
from tests.unitree_sdk import SdkClient

__all__ = ["dds_domain"]

if find_spec("unitree_sdk2py") is None:
    pytest.skip("needs the unitree-sdk2 package", allow_module_level=True)


@pytest.fixture
def sdk(dds_domain: int) -> Iterator[SdkClient]:
    with SdkClient(dds_domain) as client:
        yield client


def go(*q: float) -> Any:
    motors = [unitree_go.MotorCmd_(mode=1, q=x, kp=5.0, kd=0.05) for x in q]
    return unitree_go.MotorCmds_(motors)


def hg(q: float) -> Any:
    """As a client by the interface specification sends it: gains and all else 0."""
    return unitree_hg.HandCmd_([unitree_hg.MotorCmd_(q=q)])


def until(sdk: SdkClient, topic: str, arrived: Callable[[Any], bool], timeout: float = 60.0) -> Any:
    """The first state that ``arrived`` accepts."""
    deadline = time.monotonic() + timeout
    while True:
        for sample in sdk.wait(topic):
            if arrived(sample.message):
                return sample.message
        assert time.monotonic() < deadline, f"the state never got there: {sample.message}"


@pytest.mark.parametrize("side", list(Side))
def test_unitree_sdk_moves_a_hand_in_unitree_go(
    sdk: SdkClient, dds_domain: int, side: Side
) -> None:
    d = dialect("unitree_go")
    cmd, state = d.topics(side)
    with HandService(SimHand(side), domain=dds_domain):
        sdk.subscribe(state, d.state_type)
        first = sdk.wait(state)[0].message.states
        assert [m.q for m in first] == [pytest.approx(0.2 * 5.4, abs=1e-3)]
        for goal in (4.5, 0.5):
            sdk.stream(cmd, d.cmd_type, go(goal), hz=200)
            message = until(sdk, state, lambda m, goal=goal: abs(m.states[0].q - goal) < 0.1)
            assert message.states[0].mode == 1
        sdk.stop(cmd)
        until(sdk, state, lambda m: m.states[0].mode == 0)  # silence: it brakes


@pytest.mark.slow
def test_unitree_sdk_moves_a_hand_in_unitree_hg(sdk: SdkClient, dds_domain: int) -> None:
    d = dialect("unitree_hg")
    cmd, state = d.topics(Side.LEFT)
    with HandService(SimHand(Side.LEFT), domain=dds_domain, dialect="unitree_hg"):
        sdk.subscribe(state, d.state_type)
        first = sdk.wait(state)[0].message
        assert first.motor_state[0].q == pytest.approx(0.2 * math.tau, abs=1e-3)
        assert tuple(first.motor_state[0].temperature) == (25, 25)
        assert first.motor_state[0].vol == 12.0
        assert first.press_sensor_state == []
        for sent, expected in ((6.0, math.tau), (math.pi, math.pi), (0.1, 0.0)):
            sdk.stream(cmd, d.cmd_type, hg(sent), hz=200)
            until(sdk, state, lambda m, q=expected: abs(m.motor_state[0].q - q) < 0.1)
        sdk.stop(cmd)


@pytest.mark.slow
def test_unitree_sdk_moves_hands_in_unitree_actuator(sdk: SdkClient, dds_domain: int) -> None:
    d = dialect("unitree_actuator")
    cmd, state = d.topics(Side.LEFT)
    hands = [SimHand(Side.LEFT), SimHand(Side.RIGHT)]
    with HandService(hands, domain=dds_domain, dialect="unitree_actuator"):
        sdk.subscribe(state, d.state_type)
        assert len(sdk.wait(state)[0].message.states) == 2
        sdk.stream(cmd, d.cmd_type, go(4.0, 2.0), hz=200)  # right, left
        until(
            sdk,
            state,
            lambda m: all(
                abs(s.q - q) < 0.1 and abs(s.dq) < 0.1
                for s, q in zip(m.states, (4.0, 2.0), strict=True)
            ),
        )
        assert hands[0].joint.q == pytest.approx(2.0, abs=0.1)
        assert hands[1].joint.q == pytest.approx(4.0, abs=0.1)
        sdk.stop(cmd)
