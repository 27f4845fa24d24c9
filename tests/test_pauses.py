"""No command from before a pause moves a hand: service, drivers, bridge, emulated robots."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexkit.bridge import Bridge, BridgeEnd
from dexkit.bridge.forwarding import PATIENCE, Commands, States
from dexkit.clock import RealClock
from dexkit.command_age import PAUSE
from dexkit.dds import DdsNode
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.drivers.ezgripper import EZGripper, GripperSettings
from dexkit.emulators.dex3_mcu import Dex3Hands
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.emulators.mx64 import EmulatedThread, emulated_ezgripper
from dexkit.emulators.robot import EmulatedRobot
from dexkit.errors import HandTimeout
from dexkit.hand import Hand, HandCommand, HandState, JointMode, Side
from dexkit.messages import encode, message_type, unitree_go
from dexkit.models import dialect
from dexkit.robots import G1
from dexkit.service import HandService
from dexkit.wire import mx64
from dexkit.wire.low_level import encode_with_crc
from tests.dds_helpers import free_domain, wait_until
from tests.patience import PATIENCE as LONGEST
from tests.pause_live import BACKENDS
from tests.robot_helpers import low_cmd
from tests.service_helpers import FakeNode, FakeSample, ScriptedHand

LEFT, RIGHT = Side.LEFT, Side.RIGHT
GO, ACTUATOR = dialect("unitree_go"), dialect("unitree_actuator")
CMD, STATE = GO.topics(LEFT)


class Suspendable(RealClock):
    """The real clock of a machine that can be suspended."""

    def __init__(self) -> None:
        self.away = 0.0

    def since_boot(self) -> float:
        return super().since_boot() + self.away


class Slow(RealClock):
    """Once armed, a second passes between two looks."""

    def __init__(self) -> None:
        self.armed = False
        self._away = 0.0

    def since_boot(self) -> float:
        self._away += self.armed
        return super().since_boot() + self._away


def cmd(q: float, kp: float = 5.0) -> bytes:
    return encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q, kp=kp, kd=0.05)]))


class Client:
    """Of a :class:`FakeNode`, on a clock of its own."""

    def __init__(self, node: FakeNode, clock: Suspendable, ahead: float = 0.0) -> None:
        self._node, self._clock, self._ahead = node, clock, ahead

    def send(self, q: float, *, ago: float = 0.0) -> None:
        """What was sent ``ago`` seconds before."""
        stamp = time.time() + self._clock.away + self._ahead - ago
        sample = FakeSample(cmd(q), round(stamp * 1e9))
        self._node.inbox.setdefault(CMD, []).append(sample)
        self._node.wake[CMD]()

    def until(self, condition: Callable[[], object], q: float) -> None:
        """Send until then."""
        wait_until(lambda: self.send(q) or condition())  # type: ignore[func-returns-value]


# -- the service ------------------------------------------------------------------------------


def test_suspended_service_obeys_only_later_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    hand, node, clock = ScriptedHand(), FakeNode(), Suspendable()
    client = Client(node, clock, ahead=-86_400.0)
    with HandService(hand, node=node, clock=clock) as service:
        core, counters = service.cores[LEFT], service.counters
        client.until(lambda: hand.q == 2.0, 2.0)
        began = time.monotonic()
        client.until(lambda: time.monotonic() - began > 0.4, 2.0)  # its clock is known
        with caplog.at_level(logging.WARNING, "dexkit.service"):
            for round_ in (1, 2):
                clock.away += 3600.0
                wait_until(lambda: counters.pauses >= round_)  # noqa: B023
                wait_until(lambda: not core.driving)
                stale = core.counters.stale
                for ago in (3600.0, 100.0, 0.3):
                    client.send(5.0, ago=ago)
                    wait_until(lambda: core.counters.stale > stale)  # noqa: B023
                    stale = core.counters.stale
                assert not core.driving
                assert hand.q == 2.0
                client.until(lambda: core.driving, 2.0)
        assert core.counters.brakes >= 2
        assert service.snapshot()["pauses"] == counters.pauses
    assert sum("was paused" in record.message for record in caplog.records) == 1


def test_hanging_exchange_is_a_pause_of_that_hand_only() -> None:
    hands = {side: ScriptedHand(side, exchange_timeout=0.05) for side in Side}
    node, clock = FakeNode(), Suspendable()
    topic = ACTUATOR.cmd_topic
    both = encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=2.0, kp=5.0)] * 2))
    with HandService(list(hands.values()), node=node, clock=clock, dialect=ACTUATOR) as service:
        cores = service.cores

        def send() -> None:
            node.deliver(topic, both)

        wait_until(lambda: send() or all(core.driving for core in cores.values()))  # type: ignore[func-returns-value]
        hands[LEFT].hang.clear()
        brakes = cores[LEFT].counters.brakes
        began = time.monotonic()
        wait_until(lambda: send() or time.monotonic() - began > 0.6)  # type: ignore[func-returns-value]
        hands[LEFT].hang.set()
        wait_until(lambda: cores[LEFT].counters.brakes > brakes)
        wait_until(lambda: send() or cores[LEFT].driving)  # type: ignore[func-returns-value]
        assert service.counters.pauses >= 1


# -- drivers: what was stopped between a command and its bytes --------------------------------


def test_goal_from_before_a_pause_is_not_written_to_the_mx64() -> None:
    clock = Slow()
    with emulated_ezgripper(start=20.0, closed_at=1510) as gripper:
        assert isinstance(gripper, EmulatedThread)
        servo = gripper.servo
        settings = GripperSettings(zero=1510, timeout=1.0)
        with EZGripper(gripper.path, LEFT, settings, clock=clock) as hand:
            _obeys(hand, HandCommand.position(1.1))
            goal = servo.get(mx64.GOAL_POSITION)
            _refuses(hand, clock, HandCommand.position(5.0))
            assert servo.get(mx64.GOAL_POSITION) == goal
            _obeys(hand, HandCommand.position(5.0))
            assert servo.get(mx64.GOAL_POSITION) != goal


def test_brake_after_a_pause_holds_the_present_position() -> None:
    with emulated_ezgripper(start=10.0, closed_at=1510) as gripper:
        assert isinstance(gripper, EmulatedThread)
        servo = gripper.servo
        with EZGripper(gripper.path, LEFT, GripperSettings(zero=1510, timeout=1.0)) as hand:
            wait_until(lambda: _obeys(hand, HandCommand.position(5.0)).dq[0] > 1.0)
            time.sleep(1.2 * PAUSE)  # the servo goes on; its own watchdog acts later
            here = servo.get(mx64.PRESENT_POSITION)
            _obeys(hand, HandCommand.brake(1))
            assert servo.get(mx64.GOAL_POSITION) >= here - 5


def test_command_from_before_a_pause_is_not_written_to_the_m4010() -> None:
    clock = Slow()
    with Dex1Motors((LEFT,)) as motors:
        settings = Dex1Settings(device=motors.path, timeout=1.0)
        with Dex1Serial(LEFT, settings, clock=clock) as hand:
            _obeys(hand, HandCommand.brake(1))
            _refuses(hand, clock, HandCommand.position(5.0))
            assert motors.motor.mechanics.mode is JointMode.BRAKE
            _obeys(hand, HandCommand.position(5.0))
            assert motors.motor.mechanics.mode is JointMode.FOC


def test_command_from_before_a_pause_is_not_sent_to_the_dex3() -> None:
    clock = Slow()
    with Dex3Hands((LEFT,)) as hands:
        device = hands.device(LEFT)
        settings = Dex3Settings(server=parse_server(hands.url)[0], timeout=5.0, send_timeout=5.0)
        with Dex3Usb(LEFT, settings, clock=clock) as hand:
            frames = device.counters.frames
            _refuses(hand, clock, HandCommand.position(np.zeros(7)))
            assert device.counters.frames == frames
            _obeys(hand, HandCommand.position(np.zeros(7)))
            assert device.counters.frames == frames + 1


def _obeys(hand: Hand, command: HandCommand) -> HandState:
    """Exchange; again where the machine itself paused this program."""
    end = time.monotonic() + LONGEST
    while True:
        try:
            return hand.exchange(command)
        except HandTimeout:
            if time.monotonic() > end:
                raise


def _refuses(hand: Hand, clock: Slow, command: HandCommand) -> None:
    clock.armed = True
    try:
        with pytest.raises(HandTimeout, match="was paused"):
            hand.exchange(command)
    finally:
        clock.armed = False


# -- the bridge -------------------------------------------------------------------------------


class TestBridge:
    def test_pause_drops_a_command_that_waits_for_the_other_side(self) -> None:
        states = States(ACTUATOR, GO, tuple(Side))
        commands = Commands(GO, ACTUATOR, tuple(Side), states)
        self._seen(states, 2.0)
        assert commands.receive(GO.topics(LEFT)[0], cmd(1.0), 0.0) == []
        assert commands.due == PATIENCE
        commands.paused()
        assert commands.due is None
        assert commands.flush(10.0) == []

    def test_pause_does_not_repeat_the_last_command_of_the_other_side(self) -> None:
        states = States(ACTUATOR, GO, tuple(Side))
        commands = Commands(GO, ACTUATOR, tuple(Side), states)
        self._seen(states, 2.0)
        commands.receive(GO.topics(RIGHT)[0], cmd(5.0), 0.0)
        assert commands.receive(GO.topics(LEFT)[0], cmd(1.0), 0.0)
        commands.paused()
        # nor where it was before
        assert commands.receive(GO.topics(LEFT)[0], cmd(1.0), 0.3) == []
        assert commands.flush(0.3 + PATIENCE) == []
        assert commands.counts.held == 1
        self._seen(states, 3.0)
        (sent,) = commands.receive(GO.topics(LEFT)[0], cmd(1.0), 0.31) or commands.flush(0.32)
        motors = message_type(ACTUATOR.cmd_type).decode(sent.payload).cmds
        assert [(m.q, m.kp) for m in motors] == [(3.0, 0.0), (1.0, 5.0)]
        assert commands.counts.pauses == 1

    @staticmethod
    def _seen(states: States, q: float) -> None:
        both = unitree_go.MotorStates_([unitree_go.MotorState_(q=q)] * 2)
        states.receive(ACTUATOR.state_topic, encode(both), 0.0)

    def test_suspended_bridge_forwards_only_later_commands(self) -> None:
        clock = Suspendable()
        near, far = free_domain(), free_domain()
        with (
            DdsNode(near) as client_node,
            DdsNode(far) as gripper_node,
            DdsNode(near) as client,
            DdsNode(far) as gripper,
            Bridge(
                BridgeEnd(client_node, GO),
                BridgeEnd(gripper_node, ACTUATOR),
                sides=(LEFT,),
                clock=clock,
            ) as bridge,
        ):
            writer = client.writer(CMD, GO.cmd_type)
            arrived = gripper.reader(ACTUATOR.cmd_topic, ACTUATOR.cmd_type)
            states = gripper.writer(ACTUATOR.state_topic, ACTUATOR.state_type)
            assert writer.wait_matched(10)
            assert arrived.wait_matched(10)

            def send(q: float, ago: float = 0.0) -> None:
                both = unitree_go.MotorStates_([unitree_go.MotorState_(q=2.0)] * 2)
                states.write(both, time.time_ns() + round(clock.away * 1e9))
                stamp = time.time_ns() + round((clock.away - ago) * 1e9)
                writer.write_raw(cmd(q), stamp)
                time.sleep(0.002)

            counts = bridge.commands.counts
            began = time.monotonic()
            wait_until(lambda: send(1.0) or (arrived.take() and time.monotonic() - began > 0.4))  # type: ignore[func-returns-value]
            pauses = counts.pauses  # a busy machine may have paused it before
            clock.away += 100.0
            wait_until(lambda: counts.pauses > pauses)
            arrived.take()
            stale = counts.stale
            send(5.0, ago=50.0)
            wait_until(lambda: counts.stale > stale)
            assert not arrived.take()
            wait_until(lambda: send(1.5) or arrived.take())  # type: ignore[func-returns-value]


# -- emulated robots --------------------------------------------------------------------------


def test_suspended_robot_obeys_only_later_commands() -> None:
    clock = Suspendable()
    domain = free_domain()
    with EmulatedRobot(G1, domain=domain, clock=clock) as robot, DdsNode(domain) as client:
        writer = client.writer(G1.cmd_topic, G1.cmd_type)
        assert writer.wait_matched(10)

        def send(ago: float = 0.0) -> None:
            writer.write_raw(command, time.time_ns() + round((clock.away - ago) * 1e9))
            time.sleep(0.005)

        command, counters = encode_with_crc(low_cmd(G1)), robot.robot.counters
        began = time.monotonic()
        wait_until(lambda: send() or (robot.robot.driven and time.monotonic() - began > 0.4))  # type: ignore[func-returns-value]
        pauses = counters.pauses  # a busy machine may have paused it before
        clock.away += 100.0
        wait_until(lambda: counters.pauses > pauses)
        assert not robot.robot.driven
        stale = counters.stale
        send(ago=50.0)
        wait_until(lambda: counters.stale > stale)
        assert not robot.robot.driven
        wait_until(lambda: send() or robot.robot.driven)  # type: ignore[func-returns-value]


# -- stopped processes ------------------------------------------------------------------------


def stop_live(tries: int, *backends: str) -> None:
    chosen: list[Any] = [word for name in backends for word in ("--backend", name)]
    for _ in backends:
        chosen += ["--domain", str(free_domain()), "--domain", str(free_domain())]
    script = Path(__file__).with_name("pause_live.py")
    done = subprocess.run(
        [sys.executable, script, "--tries", str(tries), *chosen],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_sigstop_in_motion_and_sigcont_do_not_move_the_hand_back() -> None:
    stop_live(1, "ezgripper", "sim-dex3")


@pytest.mark.soak
def test_fifty_stops_of_every_backend_do_not_move_the_hand_back() -> None:
    stop_live(50, *BACKENDS)
