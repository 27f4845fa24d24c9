"""``dexkit emulate h1`` and ``g1``, and robots on topics of their own."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from dexkit.child_processes import command_line
from dexkit.cli.emulate import command
from dexkit.dds import DdsNode, Sample
from dexkit.emulators.robot import EmulatedRobot, run_robot
from dexkit.errors import EmulatorError, TopicConflict
from dexkit.messages import encode
from dexkit.robots import G1, H1
from dexkit.wire.low_level import encode_with_crc, verify_payload
from tests.cli_helpers import running
from tests.dds_helpers import free_domain, take_until, wait_until
from tests.robot_helpers import low_cmd


@pytest.fixture
def node() -> Iterator[DdsNode]:
    """On a domain that no other test has."""
    with DdsNode(free_domain()) as node:
        yield node


def test_emulated_robot_serves_until_it_is_stopped(node: DdsNode) -> None:
    """Ready, state, commands good and bad, the remote, JSON, a clean end."""
    process = subprocess.Popen(
        [
            *command_line("emulate", "g1", "--set", "real-time=no"),
            *("--domain", str(node.domain), "--remote", "-", "--json"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        ready = process.stdout.readline()
        assert "ready: g1 on rt/lowcmd and rt/lowstate (unitree_hg, 29 joints in 35 slots)" in ready
        assert f"500 Hz, domain {node.domain}, lo" in ready
        states = node.reader(G1.state_topic, G1.state_type, depth=100)
        commands = node.writer(G1.cmd_topic, G1.cmd_type)
        first = take_until(states, bool)[0]
        assert verify_payload(G1.state_type, first.data)
        assert first.message.mode_machine == 5

        elbow = G1.slot("left_elbow")
        order = low_cmd(G1, {elbow: 1.0})
        assert commands.wait_matched(60)

        def there(samples: list[Sample]) -> bool:
            # again and again: the other side may not know this writer yet
            commands.write_raw(encode(order))  # no CRC
            commands.write_raw(encode_with_crc(order))
            return any(abs(s.message.motor_state[elbow].q - 1) < 0.01 for s in samples)

        take_until(states, there)

        process.stdin.write("X,lx=-1\nnonsense\n")
        process.stdin.flush()
        take_until(states, lambda s: any(x.message.wireless_remote[3] == 1 << 2 for x in s))
        line = json.loads(process.stdout.readline())
        assert line["robot"] == "g1"
        assert line["states"] > 0
        process.stdin.write("release\n")
        process.stdin.flush()
        take_until(states, lambda s: any(not any(x.message.wireless_remote) for x in s))
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0  # with its input open: the end of that would stop it, too
        rest, errors = process.communicate()
        lines = [json.loads(text) for text in rest.splitlines()]
        assert lines[-1]["bad_crc"] > 0
        assert lines[-1]["commands"] > 0
        assert "the CRC is 0x00000000 and should be" in errors
        assert "no key 'nonsense'" in errors
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_two_robots_on_one_domain(node: DdsNode) -> None:
    arguments = ["h1", "--domain", str(node.domain), "--set", "real-time=no"]
    stop, ready = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=run_robot, args=(H1,), kwargs={"domain": node.domain, "stop": stop, "ready": ready}
    )
    thread.start()
    try:
        assert ready.wait(60)
        refused = CliRunner().invoke(command, arguments, standalone_mode=False)
        assert isinstance(refused.exception, TopicConflict)
        assert f"already publishes rt/lowstate on domain {node.domain}" in str(refused.exception)
        assert "--force" in str(refused.exception.hint)
        with pytest.raises(TopicConflict):
            EmulatedRobot(G1, node=node).start()  # another robot, on the same topics
        with running("emulate", *arguments, "--force", "--json") as forced:
            forced.ready()
            assert json.loads(forced.line_out())["states"] > 0
            code, _, errors = forced.end(signal.SIGTERM)
        assert code == 0, errors
    finally:
        stop.set()
        thread.join()


def test_client_of_another_robot_is_reported(node: DdsNode) -> None:
    with EmulatedRobot(G1, domain=node.domain) as robot, node.writer(H1.cmd_topic, H1.cmd_type):
        wait_until(robot.mismatches)
        (text,) = robot.mismatches()
        assert "rt/lowcmd: a peer uses unitree_go::msg::dds_::LowCmd_, the g1 unitree_hg" in text
        assert text.endswith("Try dexkit emulate h1")
        with pytest.raises(EmulatorError, match="started already"):
            robot.start()
    assert robot.mismatches() == []


def test_failure_is_reported(node: DdsNode, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = EmulatedRobot(H1, node=node)

    def fail(now: float) -> bytes:
        raise RuntimeError("out of joint")

    monkeypatch.setattr(robot.robot, "state", fail)
    with robot:
        wait_until(lambda: robot.failure)
        assert str(robot.failure) == "out of joint"
