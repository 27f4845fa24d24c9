"""``dex1-serial`` under the service: what it publishes, and a cable that is pulled."""

from __future__ import annotations

import time

import pytest

from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.hand import JointMode, MotorError, Side
from dexkit.messages import encode, message_type, unitree_go
from dexkit.models import dialect
from dexkit.service import HandService
from tests.service_helpers import FakeNode, deliver_until, wait_until

LOST = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
GO = dialect("unitree_go")
STATES = message_type(GO.state_type)


def message(q: float) -> bytes:
    return encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q, kp=5.0, kd=0.05)]))


def hand_at(path: str, side: Side) -> Dex1Serial:
    return Dex1Serial(side, Dex1Settings(device=path, timeout=0.15))


def newest(node: FakeNode, side: Side) -> unitree_go.MotorState_:
    topic = GO.topics(side)[1]
    payload = next(data for name, data in reversed(node.sent) if name == topic)
    return STATES.decode(payload).states[0]  # type: ignore[no-any-return]


def test_unplugged_hand_is_reported_and_ignores_stale_commands_on_return() -> None:
    node = FakeNode()
    side = Side.LEFT
    command = GO.topics(side)[0]
    with Dex1Motors() as motors:
        motor = motors.motor
        with HandService(hand_at(motors.path, side), node=node, state_rate=200.0) as service:  # type: ignore[arg-type]
            core = service.cores[side]
            wait_until(lambda: node.sent)
            state = newest(node, side)
            assert state.q == pytest.approx(1.08, abs=0.01)
            assert state.temperature == 25
            deliver_until(node, command, message(5.4), lambda: motor.q > 1.5)
            before = newest(node, side).lost  # a busy machine may already have lost some
            motors.inject("unplug:for=1500ms")
            wait_until(lambda: not core.connected, what="the loss")
            sent = len(node.sent)
            wait_until(lambda: len(node.sent) > sent + 10)
            state = newest(node, side)
            assert state.lost > before
            assert state.reserve[0] & LOST
            # the motor stops by itself; the last command does not count when the cable is back
            wait_until(lambda: motor.tripped, what="the protection")
            node.deliver(command, message(0.5))
            wait_until(lambda: core.connected, what="the reconnection")
            done = core.counters.exchanges
            wait_until(lambda: core.counters.exchanges > done + 20)
            assert not core.driving
            assert motor.mechanics.mode is JointMode.BRAKE
            assert not motor.tripped
            deliver_until(node, command, message(2.0), lambda: core.driving)
            assert core.counters.reconnects >= 1
        assert motor.mechanics.mode is JointMode.BRAKE


def test_commands_are_clamped_at_the_widest_clients_limit() -> None:
    node = FakeNode()
    side = Side.LEFT
    with Dex1Motors() as motors:
        hand = hand_at(motors.path, side)
        with HandService(hand, node=node, state_rate=200.0) as service:  # type: ignore[arg-type]
            wait_until(lambda: node.sent)
            core = service.cores[side]
            for asked, clamped in ((5.5, False), (5.62, True), (100.0, True)):
                before = core.counters.clamped

                def there(q: float = asked, before: int = before, more: bool = clamped) -> bool:
                    node.deliver(GO.topics(side)[0], message(q))
                    time.sleep(0.01)
                    counted = core.counters.clamped > before
                    return counted is more and abs(newest(node, side).q - 5.5) < 0.02

                wait_until(there)
