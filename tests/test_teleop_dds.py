"""``dexkit teleop`` with served hands: start, wait, refusal, end."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from dexkit.child_processes import command_line
from dexkit.cli import cli
from dexkit.command_age import PAUSE
from dexkit.conformance.kit.recording import Recording
from dexkit.dds import DdsNode, Sample
from dexkit.errors import DexkitError, UsageError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_
from dexkit.models import DIALECTS
from dexkit.teleop import profile
from dexkit.traces import open_trace
from tests.dds_helpers import free_domain, take_until
from tests.process_helpers import started
from tests.slow_hand import SLOW, SLOW_DEX3

LEFT, RIGHT = Side.LEFT, Side.RIGHT
TELEOP = command_line("teleop")


@contextmanager
def served(backend: tuple[str, ...], side: str) -> Iterator[int]:
    """A domain on which ``dexkit serve`` serves a simulated hand."""
    domain = free_domain()
    arguments = command_line("serve", *backend, "--side", side, "--quiet")
    with started([*arguments, "--domain", domain], stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        yield domain
        process.terminate()


@pytest.fixture(scope="module")
def server() -> Iterator[Callable[[tuple[str, ...]], int]]:
    """Serves a Dex1-1 pair or a left Dex3-1, one at a time; returns its domain."""
    running: dict[tuple[str, ...], int] = {}
    with ExitStack() as stack:

        def serve(backend: tuple[str, ...]) -> int:
            if backend not in running:
                stack.close()
                running.clear()
                side = "both" if backend is SLOW else "left"
                running[backend] = stack.enter_context(served(backend, side))
            return running[backend]

        yield serve


@pytest.fixture
def dex1(server: Callable[[tuple[str, ...]], int]) -> int:
    return server(SLOW)


@pytest.fixture
def dex3(server: Callable[[tuple[str, ...]], int]) -> int:
    return server(SLOW_DEX3)


def teleop(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["teleop", *map(str, arguments)])


def test_missing_side_is_named_with_a_hint() -> None:
    with served(SLOW, "left") as domain:
        result = teleop("steps", "--domain", domain, "--wait", 1.5)
        assert "waiting for state of right ..." in result.stderr
        assert isinstance(result.exception, DexkitError)
        assert result.exception.exit_code == 1
        assert f"dexkit doctor --domain {domain}" in str(result.exception.hint)
        alone = teleop("steps", "--domain", domain, "--side", "left", "--duration", 0.5)
        assert alone.exit_code == 0, alone.output


def test_profiles_are_listed_without_a_hand() -> None:
    result = teleop()
    assert result.exit_code == 0
    for name in ("full-stroke", "pick-place", "startle", "pinch", "fist"):
        assert f"  {name} " in result.stdout
    unknown = teleop("juggle")
    assert unknown.exit_code != 0
    assert unknown.exception is not None
    with pytest.raises(UsageError) as caught:
        profile("pinch", "dex1-1")
    assert str(caught.value.hint).startswith("--dialect dex3 has it; there are: full-stroke, ")


def test_a_stroke_of_both_grippers_is_measured_and_recorded(dex1: int, tmp_path: Path) -> None:
    path = tmp_path / "stroke.mcap"
    result = teleop(
        *("full-stroke", "--domain", dex1, "--duration", 4.0, "--record", path, "--json")
    )
    assert result.exit_code == 0, result.output
    assert "ready: full-stroke on unitree_go" in result.stderr
    data = json.loads(result.stdout)
    for side in ("left", "right"):
        found = data["sides"][side]
        assert found["client_hz"] < 201  # what it is above 0 depends on the machine
        assert found["joints"]["gripper"]["stroke_s"] > 0.5  # the lead of 0.18 rad limits it
    recording = Recording.decode(open_trace(path))
    for side in Side:
        commands, states = recording.sides[side].commands, recording.sides[side].states
        assert set(commands.kp[:, 0]) == {5.0}
        assert set(commands.mode[:, 0]) == {0.0}
        # how far it gets in 4 s depends on the machine
        assert float(np.ptp(states.q[:, 0])) > 1.0
        # each command is a short lead on a state, but for states that came meanwhile
        at = np.clip(np.searchsorted(states.t, commands.t) - 1, 0, None)
        assert np.median(np.abs(commands.q[:, 0] - states.q[at, 0])) < 0.3


def test_other_publisher_is_refused_unless_forced(dex1: int) -> None:
    topic = DIALECTS["unitree_go"].topics(LEFT)[0]
    with DdsNode(domain=dex1, interface="lo") as other:
        other.writer(topic, DIALECTS["unitree_go"].cmd_type)
        script = [*TELEOP, "steps", "--domain", str(dex1)]
        refused = subprocess.run(script, capture_output=True, text=True, timeout=60)
        assert refused.returncode == 1
        assert f"already commands {topic} on domain {dex1}" in refused.stderr
        assert "--force" in refused.stderr
        forced = subprocess.run(
            [*script, "--force", "--duration", "0.5"], capture_output=True, text=True, timeout=60
        )
        assert forced.returncode == 0, forced.stderr


def test_after_a_pause_teleoperation_starts_at_the_present_position(
    dex1: int, tmp_path: Path
) -> None:
    spoken = DIALECTS["unitree_go"]
    cmd, state = spoken.topics(LEFT)
    with DdsNode(domain=dex1, interface="lo") as node:
        reader = node.reader(cmd, spoken.cmd_type)
        states = node.reader(state, spoken.state_type)
        with (
            (tmp_path / "said").open("w+") as said,
            subprocess.Popen(
                [
                    *TELEOP,
                    "full-stroke",
                    "--side",
                    "left",
                    "--domain",
                    str(dex1),
                    "--duration",
                    "90",
                ],
                stdout=subprocess.DEVNULL,
                stderr=said,
            ) as process,
            ExitStack() as stack,
        ):
            stack.callback(process.kill)
            take_until(reader, lambda samples: len(samples) > 3, 60)
            process.send_signal(signal.SIGSTOP)
            writer = node.writer(cmd, spoken.cmd_type)
            writer.wait_matched(8)
            there = message_type(spoken.cmd_type).cls([MotorCmd_(q=5.2, kp=5.0, kd=0.05)])
            q, end = 0.0, time.monotonic() + 2 * PAUSE
            while (
                q < 5.0 or time.monotonic() < end
            ):  # another program moves the hand meanwhile, and goes again
                writer.write(there)
                newest = take_until(states, bool, 8)
                q = newest[-1].message.states[0].q
            writer.close()
            reader.take()
            resumed = time.time_ns()
            process.send_signal(signal.SIGCONT)

            def fresh(samples: list[Sample]) -> list[Sample]:
                # one whose write was stopped half-way comes with its old time: no hand obeys it
                return [s for s in samples if s.source_timestamp_ns >= resumed]

            first = fresh(take_until(reader, lambda samples: bool(fresh(samples)), 60))[0]
            after = (first.source_timestamp_ns - resumed) / 1e6
            assert first.message.cmds[0].q > 4.5, f"written {after:.1f} ms after SIGCONT"
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
            said.seek(0)
            assert "was paused for" in said.read()


def test_recording_can_be_played_as_operator_input(dex1: int) -> None:
    from dexkit.traces import sample_path

    result = teleop(sample_path("dex1_pick_place"), "--domain", dex1, "--duration", 1.0)
    assert result.exit_code == 0, result.output
    assert "ready: dex1_pick_place on unitree_go" in result.stderr


@pytest.mark.soak
def test_fist_profile_moves_a_dex3(dex3: int) -> None:
    arguments = ("--dialect", "dex3", "--side", "left", "--domain", dex3, "--duration", 2.0)
    result = teleop("fist", *arguments)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert any(line.startswith("left: the client ran at") for line in lines)
    assert any("middle_0: " in line for line in lines)


def test_hands_of_another_dialect_are_named(dex3: int) -> None:
    result = teleop("full-stroke", "--domain", dex3, "--wait", 1.0)
    assert isinstance(result.exception, DexkitError)
    assert result.exception.exit_code == 1
    assert result.exception.hint == "there are hands with the dialect dex3: --dialect dex3"


def test_interrupt_locks_a_dex3_at_its_position(dex3: int) -> None:
    spoken = DIALECTS["dex3"]
    topic = spoken.topics(LEFT)[0]
    with DdsNode(domain=dex3, interface="lo") as node:
        reader = node.reader(topic, spoken.cmd_type)
        with subprocess.Popen(
            [
                *(*TELEOP, "sine", "--dialect", "dex3", "--side", "left"),
                *("--domain", str(dex3), "--duration", "90"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            driven = take_until(reader, lambda samples: len(samples) > 3, 60)
            modes = {m.mode for s in driven for m in s.message.motor_cmd}
            assert modes == set(range(0x10, 0x17))
            process.send_signal(signal.SIGINT)
            locked = take_until(
                reader,
                lambda samples: any(s.message.motor_cmd[0].mode == 0 for s in samples),
                10,
            )
            assert [m.mode for m in locked[-1].message.motor_cmd] == list(range(7))
            assert process.wait(60) == 130
            assert process.stderr is not None
            assert "Traceback" not in process.stderr.read()
