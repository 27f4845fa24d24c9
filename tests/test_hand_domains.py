"""Commands without ``--domain`` look where hands are, or say on which domain one is."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dexkit.child_processes import command_line
from dexkit.doctor import hand_domains
from dexkit.doctor.hand_domains import HandsElsewhere, elsewhere_hint, listening_domain, states_on
from dexkit.messages import unitree_go as go
from tests.dds_helpers import DdsNode, free_domain, wait_until
from tests.patience import PATIENCE

STATES = "unitree_go::msg::dds_::MotorStates_"


@pytest.fixture
def domains(monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """Two domains of the test's own in the place of the robot's and the simulation's."""
    robot, simulation = free_domain(), free_domain()
    monkeypatch.setattr(hand_domains, "_CUSTOMARY", (robot, simulation))
    monkeypatch.setattr(hand_domains, "DEFAULT_DOMAIN", simulation)
    return robot, simulation


@contextmanager
def hand(domain: int, topic: str = "rt/dex1/left/state") -> Iterator[None]:
    """A hand's state on a domain."""
    with DdsNode(domain, "lo") as node:
        writer, over = node.writer(topic, STATES), threading.Event()
        payload = writer.type.encode(go.MotorStates_([go.MotorState_()]))

        def publish() -> None:
            while not over.wait(0.01):
                writer.write_raw(payload)

        thread = threading.Thread(target=publish, daemon=True)
        thread.start()
        yield
        over.set()
        thread.join()


def test_a_listener_goes_where_the_hand_is(domains: tuple[int, int]) -> None:
    robot, simulation = domains
    chosen, why = listening_domain(None, "lo")
    assert (chosen, "no hand or robot is on" in why) == (simulation, True)
    with hand(robot):
        assert listening_domain(None, "lo") == (robot, "")
        assert listening_domain(simulation, "lo") == (simulation, "")  # as it was told
        with hand(simulation, "rt/dex1/right/state"):
            chosen, why = listening_domain(None, "lo")
            assert chosen == simulation
            assert why == f"rt/dex1/left/state on domain {robot}: --domain {robot}"


def test_one_that_publishes_says_where_the_hand_is(domains: tuple[int, int]) -> None:
    robot, simulation = domains
    with DdsNode(simulation, "lo") as node:
        assert elsewhere_hint(node) == ""
        with hand(robot):
            assert elsewhere_hint(node).endswith(f"on domain {robot}: --domain {robot}")


def test_it_is_told_once_and_found_in_the_background(
    domains: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, simulation = domains
    monkeypatch.setattr(hand_domains, "_PATIENCE", 0.0)
    with hand(robot):
        elsewhere = HandsElsewhere(simulation, "lo")
        told: list[str] = []
        wait_until(lambda: bool(told.append(elsewhere.look()) or told[-1]))  # type: ignore[func-returns-value]
        assert f"--domain {robot}" in told[-1]
        assert elsewhere.look() == ""


def test_commands_are_no_hand(domains: tuple[int, int]) -> None:
    """A client alone is not where to look."""
    robot, _ = domains
    with DdsNode(robot, "lo") as node:
        node.writer("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
        assert states_on((robot,), "lo") == {}


def test_the_monitor_finds_a_hand_on_domain_1_or_0() -> None:
    """The command itself, on the customary domains; other programs may be there, too."""
    with hand(0):
        there = states_on((0, 1), "lo")
        done = subprocess.run(
            command_line("monitor", "--json", "--period", "0.2", "--duration", "2"),
            capture_output=True, text=True, check=True, timeout=PATIENCE,
        )  # fmt: skip
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    if 1 not in there:
        assert any(t["topic"] == "rt/dex1/left/state" for t in lines[-1]["topics"])
    else:
        told = [event["text"] for line in lines for event in line["events"]]
        assert any("--domain 0" in text for text in told)


def test_a_recorder_that_got_nothing_says_where_the_hand_is(tmp_path: object) -> None:
    with hand(0):
        there = states_on((0, 1), "lo")
        done = subprocess.run(
            command_line(
                *("record", f"{tmp_path}/a.mcap", "--duration", "0.5"),
                *("--domain", str(free_domain())),
            ),
            capture_output=True, text=True, timeout=PATIENCE,
        )  # fmt: skip
    assert done.returncode == 1
    assert f"--domain {min(there)}" in done.stderr
