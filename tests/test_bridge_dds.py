"""``dexkit bridge`` between processes over DDS: client here, bridge and grippers elsewhere."""

from __future__ import annotations

import json
import math
import re
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from dexkit.bridge import Bridge, BridgeEnd
from dexkit.bridge.translate import PartCodec, translator
from dexkit.cli import cli
from dexkit.dds import DdsNode
from dexkit.errors import TopicConflict, UsageError
from dexkit.hand import Side
from dexkit.messages import unitree_go
from dexkit.models import DEX1_1, Dialect, dialect
from tests.cli_helpers import Process, running
from tests.dds_helpers import dds_domain, dds_node, free_domain, wait_until
from tests.slow_hand import SLOW

__all__ = ["dds_domain", "dds_node"]

LEFT, RIGHT = Side.LEFT, Side.RIGHT
GO, HG, ACTUATOR = (dialect(n) for n in ("unitree_go", "unitree_hg", "unitree_actuator"))


class Client:
    """A client of one dialect: commands both grippers 200 times a second, reads their states."""

    def __init__(self, node: DdsNode, spoken: Dialect) -> None:
        self._spoken = spoken
        self._cmd, self._state = PartCodec(spoken, "cmd"), PartCodec(spoken, "state")
        self._translate = translator(GO, spoken, "cmd")
        topics = {s: spoken.topics(s) for s in Side}
        self._writers = {
            t: node.writer(t, spoken.cmd_type) for t in dict.fromkeys(c for c, _ in topics.values())
        }
        self._readers = {
            t: node.reader(t, spoken.state_type)
            for t in dict.fromkeys(s for _, s in topics.values())
        }
        self._scale = spoken.q_open / GO.q_open
        self.states: dict[Side, Any] = {}
        for writer in self._writers.values():
            writer.wait_matched(60)

    def read(self) -> dict[Side, Any]:
        """The newest motor of each side."""
        for topic, reader in self._readers.items():
            for sample in reader.take():
                for side in Side:
                    if self._spoken.topics(side)[1] == topic:
                        part = self._state.take(sample.message, side)
                        self.states[side] = self._state.motor(part)
        return self.states

    def q(self) -> dict[Side, float]:
        """Of 0 .. 5.4."""
        return {side: motor.q / self._scale for side, motor in self.states.items()}

    def command(self, q: Mapping[Side, float]) -> None:
        parts = {
            side: self._translate(unitree_go.MotorCmd_(q=goal, kp=5.0, kd=0.05))
            for side, goal in q.items()
        }
        for topic, writer in self._writers.items():
            mine = {s: p for s, p in parts.items() if self._spoken.topics(s)[0] == topic}
            writer.write(self._cmd.put(mine))

    def drive(self, q: Mapping[Side, float]) -> None:
        """Until both are there."""
        deadline = time.monotonic() + 60
        while True:
            self.command(q)
            time.sleep(0.005)
            self.read()
            if all(abs(self.q().get(s, math.nan) - goal) < 0.1 for s, goal in q.items()):
                return
            assert time.monotonic() < deadline, f"at {self.q()}, not {q}"


@pytest.fixture
def domains() -> tuple[int, int]:
    return free_domain(), free_domain()


def counters(log: str) -> dict[str, dict[str, int]]:
    (line,) = (text for text in log.splitlines() if '"commands"' in text)
    found: dict[str, dict[str, int]] = json.loads(line.split("counters ", 1)[1])
    return found


def bridging(client: Dialect, gripper: Dialect, *arguments: object) -> Any:
    return running("bridge", client.name, gripper.name, *arguments)


@pytest.mark.parametrize(
    ("spoken", "served"), [(ACTUATOR, GO), (GO, ACTUATOR)], ids=lambda d: d.name
)
def test_a_client_drives_grippers_of_another_dialect(
    spoken: Dialect, served: Dialect, domains: tuple[int, int]
) -> None:
    near, far = domains
    serve = ("serve", *SLOW, "--side", "both", "--dialect", served.name, "--domain", far)
    with (
        running(*serve, "--quiet") as grippers,
        bridging(spoken, served, "--domain", near, "--to-domain", far) as bridge,
        DdsNode(near) as node,
    ):
        grippers.ready()
        assert f"{spoken.name} on domain {near}, lo -> {served.name}" in bridge.ready()
        client = Client(node, spoken)
        wait_until(lambda: len(client.read()) == 2)  # before any command
        client.drive({LEFT: 1.0, RIGHT: 4.0})
        client.drive({LEFT: 4.0, RIGHT: 1.5})
        # the client stops: the grippers' watchdog brakes, and the states go on
        stopped = time.monotonic()
        wait_until(lambda: all(m.mode == 0 for m in client.read().values()))
        assert time.monotonic() - stopped > 0.9 * DEX1_1.command_timeout
        # the grippers end: nothing more comes
        assert grippers.end(signal.SIGTERM)[0] == 0
        client.read()
        client.states.clear()
        time.sleep(0.2)
        assert client.read() == {}
        code, _, log = bridge.end(signal.SIGINT)
        assert code == 0
        assert counters(log)["commands"]["rejected"] == 0


def test_other_publishers_are_refused(dds_domain: int, dds_node: DdsNode) -> None:
    with DdsNode(dds_domain) as other:
        bridge = Bridge(BridgeEnd(other, ACTUATOR), BridgeEnd(other, GO))
        for taken, kind in (
            (ACTUATOR.state_topic, ACTUATOR.state_type),
            (GO.topics(LEFT)[0], GO.cmd_type),
        ):
            with (
                dds_node.writer(taken, kind),
                pytest.raises(TopicConflict, match=f"already publishes {taken}"),
            ):
                bridge.start()
            wait_until(lambda: bridge.rival() is None)  # that its end is known, too
        # the other way round that would be a client, which is no rival
        with (
            dds_node.writer(GO.topics(LEFT)[0], GO.cmd_type),
            Bridge(BridgeEnd(other, GO), BridgeEnd(other, ACTUATOR)),
        ):
            pass


def test_bridge_in_the_opposite_direction_is_refused_and_ends_the_first(dds_domain: int) -> None:
    with bridging(ACTUATOR, GO, "--domain", dds_domain) as bridge, DdsNode(dds_domain) as node:
        bridge.ready()
        back = BridgeEnd(node, GO), BridgeEnd(node, ACTUATOR)
        with pytest.raises(TopicConflict, match="answer each other"):
            Bridge(*back).start()
        with Bridge(*back, force=True):
            code, _, log = bridge.end()
        assert code == 1
        assert "answer each other" in log


def test_refused_bridge_has_an_error_exit_code(dds_domain: int, dds_node: DdsNode) -> None:
    arguments = ("bridge", "unitree_go", "unitree_actuator")
    with dds_node.writer(GO.topics(LEFT)[1], GO.state_type):
        code, _, log = Process(*arguments, "--domain", dds_domain).end()
    assert code == 1
    assert "stop it, choose another domain for one end, or add --force" in log


def test_both_types_of_one_topic_on_one_domain(dds_domain: int, dds_node: DdsNode) -> None:
    """unitree_go and unitree_hg share topic names: types keep them apart."""
    with bridging(GO, HG, "--domain", dds_domain) as bridge:
        bridge.ready()
        states = dds_node.writer(HG.topics(LEFT)[1], HG.state_type)
        reader = dds_node.reader(GO.topics(LEFT)[1], GO.state_type)
        state = translator(GO, HG, "state")(unitree_go.MotorState_(q=2.7))

        def carried() -> bool:
            states.write(state)  # again: what comes before a match is lost
            return reader.wait(0.05)

        wait_until(carried)
        assert reader.take()[-1].message.states[0].q == pytest.approx(2.7)
        assert bridge.end(signal.SIGTERM)[0] == 0


def test_bridge_ends_when_it_is_told_to(dds_domain: int) -> None:
    with bridging(GO, ACTUATOR, "--domain", dds_domain) as bridge:
        bridge.ready()
        code, _, log = bridge.end(signal.SIGTERM)
    assert code == 0
    assert counters(log)["states"]["sent"] == 0


def test_bridge_between_equal_ends_is_refused(dds_node: DdsNode) -> None:
    with pytest.raises(UsageError, match="would answer itself"):
        Bridge(BridgeEnd(dds_node, GO), BridgeEnd(dds_node, GO))
    with pytest.raises(UsageError, match="of a dex3-1"):
        Bridge(BridgeEnd(dds_node, GO), BridgeEnd(dds_node, dialect("dex3")))
    with pytest.raises(UsageError, match="grippers are bridged"):
        Bridge(*(BridgeEnd(dds_node, dialect("dex3")),) * 2)


def test_bridge_can_be_used_from_python(dds_node: DdsNode) -> None:
    client, gripper = BridgeEnd(dds_node, ACTUATOR), BridgeEnd(dds_node, GO)
    with Bridge(client, gripper, sides=[RIGHT]) as bridge:
        assert (bridge.clients, bridge.grippers) == (0, 0)
        with DdsNode(dds_node.domain) as other:
            with pytest.raises(TopicConflict, match="already publishes"):
                Bridge(BridgeEnd(other, ACTUATOR), BridgeEnd(other, GO)).start()
            states = other.reader(ACTUATOR.state_topic, ACTUATOR.state_type)
            hand = other.writer(GO.topics(RIGHT)[1], GO.state_type)
            assert hand.wait_matched(60)
            wait_until(lambda: bridge.clients == 1)
            message = unitree_go.MotorStates_([unitree_go.MotorState_(q=1.25)])
            wait_until(lambda: hand.write(message) and states.wait(0.05))
            right, left = states.take()[-1].message.states
            assert (right.q, left.q) == (1.25, 0.0)
    bridge.stop()  # twice does no harm


def test_example_of_the_document_runs(
    dds_node: DdsNode, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).parents[1] / "docs" / "bridge.md"
    (example,) = re.findall(r"(?ms)^```python\n(.*?)^```$", page.read_text(encoding="utf-8"))
    for shown, domain in (("DdsNode(1)", dds_node.domain), ('DdsNode(0, "eth0")', free_domain())):
        assert shown in example
        example = example.replace(shown, f"DdsNode({domain})")
    exec(compile(example, str(page), "exec"), {})
    assert "'commands'" in capsys.readouterr().out


def test_help_has_examples() -> None:
    text = CliRunner().invoke(cli, ["bridge", "--help"]).output
    assert text.count("dexkit bridge unitree") == 2
