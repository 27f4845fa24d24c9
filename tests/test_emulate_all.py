"""``dexkit emulate all`` as a process with its parts: topics, motion, and how it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.child_processes import Tool
from dexkit.cli import cli
from dexkit.cli.emulate import command as emulate
from dexkit.dds import DdsNode
from dexkit.hand import Side
from dexkit.messages import unitree_hg
from dexkit.models import DEX3_1, dialect
from dexkit.robots import G1
from dexkit.wire import low_level
from tests.dds_helpers import dds_domain, dds_node, free_domain, take_until, wait_until
from tests.each import each

__all__ = ["dds_domain", "dds_node"]

DEX3 = dialect("dex3")


def children(pid: int) -> list[int]:
    """Processes that ``pid`` has started, whichever thread did."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(p) for p in (task / "children").read_text().split()]
    return found


def gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


class Robot:
    """A running ``dexkit emulate all``."""

    def __init__(self, *arguments: object) -> None:
        self.lines: list[str] = []
        self.tool = Tool("emulate", "all", *map(str, arguments), on_line=self.lines.append)
        self.pid = self.tool._process.pid

    def end(self, number: int, pid: int | None = None) -> int:
        """Signal it, or a part of it; its exit code."""
        os.kill(pid or self.pid, number)
        code = self.tool._process.wait(60)
        self.tool.stop()
        return code

    def part(self, word: str) -> int:
        """The process of the part whose arguments contain ``word``."""
        (pid,) = (p for p in children(self.pid) if word in Path(f"/proc/{p}/cmdline").read_text())
        return pid


@contextmanager
def whole_robot(*arguments: object) -> Iterator[Robot]:
    one = Robot(*arguments)
    try:
        one.tool.ready.wait(60)
        yield one
    finally:
        one.tool.stop()


def test_g1_with_two_dex3_moves_and_stops_cleanly(dds_domain: int, dds_node: DdsNode) -> None:
    states = dds_node.reader(G1.state_topic, G1.state_type)
    hands = {s: dds_node.reader(DEX3.topics(s)[1], DEX3.state_type) for s in Side}
    orders = dds_node.writer(G1.cmd_topic, G1.cmd_type)
    grips = {s: dds_node.writer(DEX3.topics(s)[0], DEX3.cmd_type) for s in Side}
    elbow = G1.slot("right_elbow")
    with whole_robot("--domain", dds_domain) as whole:
        assert any(line.startswith("ready: G1 robot") for line in whole.lines), whole.lines
        robot = unitree_hg.LowCmd_(mode_machine=take_until(states, bool)[-1].message.mode_machine)
        for slot in G1.used:
            motor = robot.motor_cmd[slot]
            motor.mode, motor.q = G1.enable[slot], G1.rest_q[slot]
            motor.kp, motor.kd = G1.client_gains[slot]
        robot.motor_cmd[elbow].q = 1.2
        order = low_level.encode_with_crc(robot)
        grip = {
            side: unitree_hg.HandCmd_(
                [unitree_hg.MotorCmd_(mode=0x10 | i, q=j.q_max if j.closing > 0 else j.q_min,
                                      kp=1.5, kd=0.2) if j.closing
                 else unitree_hg.MotorCmd_(mode=0x10 | i, kp=1.5, kd=0.2)
                 for i, j in enumerate(DEX3_1.joints[side])]
            )
            for side in Side
        }  # fmt: skip

        def moved() -> bool:
            orders.write_raw(order)
            for side in Side:
                grips[side].write(grip[side])
            time.sleep(0.005)
            closed = {s: take_until(hands[s], bool)[-1].message.motor_state for s in Side}
            bent = take_until(states, bool)[-1].message.motor_state[elbow].q
            fingers = closed[Side.LEFT][5].q < -1.3 and closed[Side.RIGHT][5].q > 1.3
            return fingers and abs(bent - 1.2) < 0.1

        wait_until(moved)
        parts = children(whole.pid)
        assert len(parts) == 2
        assert whole.end(signal.SIGINT) == 0
    wait_until(lambda: all(gone(pid) for pid in parts))
    assert any(line.startswith("g1: stopped: ") for line in whole.lines)
    assert not any("Traceback" in line for line in whole.lines)


@pytest.mark.slow
def test_program_ends_when_one_of_its_processes_dies() -> None:
    with whole_robot("--robot", "h1", "--hands", "dex1", "--domain", free_domain()) as whole:
        parts = children(whole.pid)
        assert whole.end(signal.SIGKILL, whole.part("sim-dex1")) == 1
        assert "error: hands: killed by signal 9" in whole.lines
        wait_until(lambda: all(gone(pid) for pid in parts))


def test_no_process_outlives_the_program() -> None:
    with whole_robot("--hands", "none", "--domain", free_domain(), "--quiet") as whole:
        parts = children(whole.pid)
        assert whole.end(signal.SIGKILL) == -signal.SIGKILL
        wait_until(lambda: all(gone(pid) for pid in parts), 10.0)


@pytest.mark.slow
def test_topics_with_another_publisher_are_refused(dds_domain: int, dds_node: DdsNode) -> None:
    topic = "rt/dex1/right/state"
    with (
        dds_node.writer(topic, dialect("unitree_go").state_type),
        whole_robot("--robot", "h1", "--hands", "dex1", "--domain", dds_domain) as whole,
    ):
        assert whole.tool._process.wait(60) == 1
        whole.tool.stop()
        (error,) = (line for line in whole.lines if line.startswith("error: "))
        assert f"already publishes {topic}" in error
        assert "another --domain" in whole.lines[whole.lines.index(error) + 1]


@pytest.mark.slow
def test_program_ends_after_its_duration_with_a_hint() -> None:
    domain = str(free_domain())
    result = CliRunner().invoke(
        cli, ["emulate", "all", "--hands", "none", "--domain", domain, "--duration", "0.1"]
    )
    assert result.exit_code == 0, result.output
    assert f'with Unitree\'s SDK: ChannelFactoryInitialize({domain}, "lo")' in result.output
    assert "hands" not in result.output


class TestArguments:
    @each(
        ("domain", "hands", "text"),
        [
            (1, "dex3", "--arm=G1_29 --ee=dex3 --sim"),
            (0, "none", "--arm=G1_29"),
            (1, "dex5", "321"),
        ],
    )
    def test_command_for_xr_teleoperate_is_printed(
        self, domain: int, hands: str, text: str
    ) -> None:
        from dexkit.cli.emulate.all import _for_xr

        assert text in "\n".join(_for_xr("g1", hands, domain))

    def test_hand_settings_without_hands_are_refused(self) -> None:
        result = CliRunner().invoke(cli, ["emulate", "all", "--hands", "none", "--set", "a=b"])
        assert result.exit_code == 2
        assert "need hands" in result.output

    def test_emulate_all_is_listed_with_the_robots(self) -> None:
        listed = CliRunner().invoke(emulate, ["--help"]).output
        for name in ("all", "g1", "h1"):
            assert f"  {name} " in listed
