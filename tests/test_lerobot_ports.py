"""LeRobot's ports in front of an emulated G1: JSON, which commands count, sockets, the command."""

from __future__ import annotations

import base64
import io
import json
import signal
import socket
from collections.abc import Iterator
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("zmq", reason="needs pyzmq: pip install 'dexkit[zmq]'")

from dexkit.cli import cli
from dexkit.clock import ManualClock
from dexkit.dds import DdsNode, Reader
from dexkit.emulators.lerobot import LerobotPorts, Ports
from dexkit.emulators.lerobot.camera import CAMERA, SIZE, camera_json, moving_cards
from dexkit.emulators.lerobot.freshness import CommandStream
from dexkit.emulators.lerobot.low_level_json import MOST, command_from, state_json
from dexkit.errors import EmulatorError, WireError
from dexkit.messages import message_type
from dexkit.messages.unitree_hg import IMUState_, LowState_, MotorState_
from dexkit.robots import G1
from dexkit.wire import low_level
from tests.cli_helpers import running
from tests.dds_helpers import dds_domain, dds_node, free_domain, take_until, wait_until
from tests.each import each
from tests.lerobot_client import LerobotClient, command_json
from tests.patience import PATIENCE
from tests.test_emulate_all import whole_robot

__all__ = ["dds_domain", "dds_node"]

ELBOW = G1.slot("right_elbow")
BYTE = st.integers(0, 255)
NUMBER = st.floats(width=32, allow_nan=False, allow_infinity=False)
MOTOR = st.fixed_dictionaries(
    {}, optional={"mode": BYTE, **dict.fromkeys(("q", "dq", "tau", "kp", "kd"), NUMBER)}
)

# ------------------------------------------------------------------------------------ JSON


def test_state_has_the_fields_that_lerobot_reads() -> None:
    state = LowState_(
        mode_machine=5,
        motor_state=[MotorState_(q=0.5, dq=-1.0, tau_est=2.0, temperature=(30, 41))] * G1.slots,
        imu_state=IMUState_(quaternion=(1.0, 0.0, 0.0, 0.0), temperature=36),
        wireless_remote=tuple(range(40)),
    )
    found = json.loads(state_json(state))
    assert found["topic"] == "rt/lowstate"
    data = found["data"]
    assert set(data) == {"motor_state", "imu_state", "wireless_remote", "mode_machine"}
    motor = {"q": 0.5, "dq": -1.0, "tau_est": 2.0, "temperature": 35.5}
    assert data["motor_state"] == [motor] * 35
    assert set(data["imu_state"]) == {
        *("quaternion", "gyroscope", "accelerometer", "rpy", "temperature")
    }
    assert base64.b64decode(data["wireless_remote"]) == bytes(range(40))
    assert data["mode_machine"] == 5


@settings(max_examples=10, deadline=None)
@given(st.lists(MOTOR, max_size=3), BYTE, BYTE)
def test_parsed_command_equals_the_written_one(
    motors: list[dict[str, float]], mode_pr: int, machine: int
) -> None:
    data = {"mode_pr": mode_pr, "mode_machine": machine, "motor_cmd": motors}
    command = command_from(json.dumps({"topic": "rt/lowcmd", "data": data}).encode())
    assert (command.mode_pr, command.mode_machine) == (mode_pr, machine)
    for motor, given_values in zip(command.motor_cmd, motors, strict=False):
        for name in ("mode", "q", "dq", "tau", "kp", "kd"):
            assert getattr(motor, name) == given_values.get(name, 0)
    encoded = low_level.encode_with_crc(command)
    assert low_level.verify_payload(G1.cmd_type, encoded)


@each(
    "payload",
    [
        b"",
        b"\xff\x00",
        b"[" * 50_000,
        b"17",
        b'{"data": []}',
        b'{"topic": "rt/arm_sdk", "data": {}}',
        b'{"topic": "rt/lowcmd", "data": []}',
        b'{"topic": "rt/lowcmd", "data": {"motor_cmd": {}}}',
        b'{"topic": "rt/lowcmd", "data": {"motor_cmd": [7]}}',
        b'{"topic": "rt/lowcmd", "data": {"motor_cmd": [' + b"{}," * 35 + b"{}]}}",
        *(
            json.dumps({"topic": "rt/lowcmd", "data": {"motor_cmd": [motor]}}).encode()
            for motor in (
                *({"q": wrong} for wrong in (float("nan"), float("inf"), 1e39, 10**400, "1", True)),
                *({"mode": wrong} for wrong in (-1, 256, 1.0, True, None)),
            )
        ),
        b'{"topic": "rt/lowcmd", "data": {"mode_machine": 999}}',
        command_json({}) + b" " * MOST,
    ],
)
def test_invalid_commands_are_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        command_from(payload)


def test_pictures_can_be_read() -> None:
    from PIL import Image

    cards = moving_cards()
    first, second = next(cards), next(cards)
    assert first != second
    message = json.loads(camera_json((CAMERA,), first, 12.5))
    assert message["timestamps"] == {"head_camera": 12.5}
    picture = Image.open(io.BytesIO(base64.b64decode(message["images"]["head_camera"])))
    assert (picture.format, picture.size) == ("JPEG", SIZE)


# ----------------------------------------------------------------- which commands count


def spaced(stream: CommandStream, clock: ManualClock, period: float, count: int) -> list[bool]:
    """Whether each of so many commands counts, one after the other."""
    found = []
    for _ in range(count):
        clock.advance(period)
        stream.detect_pause()
        found.append(stream.counts())
    return found


def test_commands_count_after_a_second_without_a_gap() -> None:
    clock = ManualClock()
    stream = CommandStream(clock)
    stream.detect_pause()
    stream.connected(7)
    assert spaced(stream, clock, 0.125, 12) == [False] * 9 + [True] * 3
    assert spaced(stream, clock, 0.375, 3) == [False] * 3
    assert spaced(stream, clock, 0.125, 10)[-3:] == [False, True, True]
    # a burst of what has waited somewhere
    clock.advance(0.3)
    assert spaced(stream, clock, 0.0, 500) == [False] * 500
    # suspended with the machine
    assert spaced(stream, clock, 0.125, 10)[-1]
    clock.suspend(3600.0)
    assert not any(spaced(stream, clock, 0.0, 3))


def test_no_command_counts_beside_a_second_client_nor_right_after_one_has_come_or_gone() -> None:
    clock = ManualClock()
    stream = CommandStream(clock)
    stream.connected(7)
    assert spaced(stream, clock, 0.125, 10)[-1]
    stream.connected(8)
    assert not any(spaced(stream, clock, 0.125, 20))
    stream.disconnected(8)
    assert spaced(stream, clock, 0.125, 10)[-2:] == [False, True]
    stream.disconnected(7)
    assert not any(spaced(stream, clock, 0.125, 20))  # nobody is there


# ---------------------------------------------------------------------------- sockets


class Bench:
    """Ports on a clock that the test moves, and what comes out of them on DDS."""

    def __init__(self, node: DdsNode, ports: Ports) -> None:
        self.clock = ManualClock()
        self.served = LerobotPorts(node, ports=ports, camera=False, clock=self.clock)
        self.orders: Reader = node.reader(G1.cmd_topic, G1.cmd_type, depth=100)

    def send(self, client: LerobotClient, payload: bytes, count: int = 1) -> int:
        """Send so many, 0.2 s apart; how many have been forwarded."""
        counters = self.served.counters
        before = counters.forwarded
        for _ in range(count):
            self.clock.advance(0.2)
            pauses, received = counters.pauses, counters.commands
            client.send(payload)
            wait_until(lambda n=received: counters.commands > n)  # type: ignore[misc]
            assert counters.pauses == pauses
        return counters.forwarded - before


@pytest.fixture
def bench(dds_node: DdsNode) -> Iterator[Bench]:
    one = Bench(dds_node, Ports(0, 0, 0))
    with one.served:
        yield one


def test_commands_reach_dds_with_a_crc_and_states_reach_the_client(
    bench: Bench, dds_node: DdsNode
) -> None:
    ports = bench.served.ports
    with LerobotClient(ports.commands, ports.states) as client:
        order = command_json({ELBOW: 1.25}, machine=5)
        assert bench.send(client, order, 5) == 0
        assert bench.send(client, order, 3) >= 1
        sample = take_until(bench.orders, bool)[-1]
        assert low_level.verify_payload(G1.cmd_type, sample.data)
        motor = sample.message.motor_cmd[ELBOW]
        assert (motor.mode, motor.q, sample.message.mode_machine) == (1, 1.25, 5)
        assert bench.send(client, b"nonsense") == 0
        assert bench.served.counters.refused == 1
        with dds_node.writer(G1.state_topic, G1.state_type) as writer:
            data = message_type(G1.state_type).encode(LowState_(mode_machine=9))

            def heard() -> Any:
                writer.write_raw(data)
                assert client.sub is not None
                return client.sub.poll(20)

            wait_until(heard)
            assert client.state()["mode_machine"] == 9


def test_command_that_a_client_kept_for_a_server_that_was_away_does_not_count(
    bench: Bench, dds_node: DdsNode
) -> None:
    with LerobotClient(bench.served.ports.commands) as client:
        assert bench.send(client, command_json({ELBOW: 1.0}), 8) >= 1
        bench.served.stop()
        client.send(command_json({ELBOW: -1.0}))  # kept: nobody is there
        again = Bench(dds_node, Ports(bench.served.ports.commands, 0, 0))
        with again.served:
            counters = again.served.counters
            wait_until(lambda: counters.commands == 1)
            assert again.send(client, command_json({ELBOW: 1.0}), 4) == 0
            assert again.send(client, command_json({ELBOW: 1.0}), 4) >= 1
        assert {s.message.motor_cmd[ELBOW].q for s in again.orders.take()} == {1.0}


def test_second_client_stops_the_commands_until_it_leaves(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    port = bench.served.ports.commands
    with LerobotClient(port) as client:
        assert bench.send(client, command_json({}), 8) >= 1
        with LerobotClient(port):
            wait_until(lambda: bench.served.clients == 2)
            assert bench.send(client, command_json({}), 10) == 0
        wait_until(lambda: bench.served.clients == 1)
        assert bench.send(client, command_json({}), 8) >= 1
    assert "two clients are connected" in caplog.text


def _post_of_frames(payload: bytes) -> bytes:
    """What a web page can make a browser send: to ZMTP 1.0 they are frames, the last its own.

    The first byte of a frame is the length of what follows. "P" of POST is one, and the page's path
    has the next: "~", 126 bytes, which end with the head.
    """
    start = b"POST /".ljust(1 + ord("P"), b"a") + b"~b"
    more = b" HTTP/1.1\r\nHost: 127.0.0.1\r\nX: "
    head = start + more.ljust(126 - 1 - 4, b"x") + b"\r\n\r\n"
    return head + b"\xff" + (1 + len(payload)).to_bytes(8, "big") + b"\0" + payload


def test_web_page_cannot_command_the_robot(bench: Bench) -> None:
    """It could where ZMTP 1.0 is taken, at a port that browsers do not block, as they do 6000."""
    counters = bench.served.counters
    with socket.create_connection(("127.0.0.1", bench.served.ports.commands), PATIENCE) as sock:
        sock.setblocking(False)
        sock.sendall(_post_of_frames(command_json({ELBOW: 1.0})))

        def ended() -> bool:
            try:
                return sock.recv(100) == b""
            except BlockingIOError:
                return False
            except ConnectionResetError:
                return True

        wait_until(lambda: ended() or counters.commands)
    assert counters.commands == 0
    with LerobotClient(bench.served.ports.commands) as client:
        assert bench.send(client, command_json({}), 12) >= 1


def test_port_that_is_taken_is_an_error_and_all_are_released(bench: Bench) -> None:
    taken = bench.served.ports.states
    with pytest.raises(EmulatorError, match=f"cannot listen on 127.0.0.1:{taken}"):
        LerobotPorts(bench.served._node, ports=Ports(0, taken, 0), camera=False)


# ------------------------------------------------------------------------ the command


class NoProcesses:
    """Stands for the processes of ``emulate all``: their command lines only."""

    commands: dict[str, tuple[str, ...]]

    def __init__(self, parts: dict[str, tuple[str, ...]], quiet: bool) -> None:
        type(self).commands = parts

    def __enter__(self) -> NoProcesses:
        return self

    def __exit__(self, *exc: object) -> None: ...
    def wait_ready(self, stop: object) -> None: ...
    def watch(self, stop: object, duration: float | None) -> None: ...


def test_emulate_all_for_lerobot_starts_robot_hands_and_ports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dexkit.cli.emulate.all._Processes", NoProcesses)
    result = CliRunner().invoke(cli, ["emulate", "all", "--for", "lerobot"])
    assert result.exit_code == 0, result.output
    assert NoProcesses.commands == {
        "g1": ("emulate", "g1", "--domain", "0", "--interface", "lo"),
        "hands": (*("serve", "sim-dex1", "--side", "both", "--domain", "0", "--interface", "lo"),),
        "lerobot": ("emulate", "lerobot-g1", "--domain", "0"),
    }
    assert "--robot.type=unitree_g1" in result.output


def test_command_serves_the_ports_until_it_is_told_to_end() -> None:
    domain = str(free_domain())
    with running("emulate", "lerobot-g1", "--domain", domain, "--ports", "0,0,0") as process:
        ready = process.ready()
        code, rest, errors = process.end(signal.SIGINT)
    assert code == 0, errors
    assert ready.startswith("ready: LeRobot's g1 on 127.0.0.1: commands ")
    assert ready.endswith(f"; domain {domain}, lo")
    assert rest.startswith("stopped: 0 states, 0 commands, 0 forwarded, 0 refused, ")


@pytest.mark.soak
def test_g1_moves_by_commands_of_lerobot_and_stops_cleanly() -> None:
    with whole_robot(
        *("--for", "lerobot", "--hands", "none", "--ports", "0,0,0", "--domain", free_domain())
    ) as whole:
        (ready,) = (line for line in whole.lines if line.startswith("LeRobot's g1 on 127.0.0.1"))
        words = ready.replace(",", " ").replace(";", " ").split()
        commands, states, pictures = (
            int(words[words.index(w) + 1]) for w in ("commands", "states", "pictures")
        )
        wait_until(lambda: any("--robot.type=unitree_g1" in line for line in whole.lines))
        with LerobotClient(commands, states) as client, LerobotClient(0, pictures) as camera:
            machine = client.state()["mode_machine"]
            order = command_json({**dict.fromkeys(G1.used, 0.0), ELBOW: 0.8}, machine=machine)

            def bent() -> bool:
                client.send(order)
                return abs(client.state()["motor_state"][ELBOW]["q"] - 0.8) < 0.1

            wait_until(bent)
            assert camera.sub is not None
            assert list(json.loads(camera.sub.recv())["images"]) == ["head_camera"]
        assert whole.end(signal.SIGINT) == 0
    assert any(line.startswith("lerobot: stopped: ") for line in whole.lines)
    assert not any("Traceback" in line for line in whole.lines)


@each(
    ("arguments", "text"),
    [
        (["all", "--for", "lerobot", "--robot", "h1"], "does not support the h1"),
        (["lerobot-g1", "--ports", "1,2"], "three of them"),
        (["lerobot-g1", "--ports", "1,2,70000"], "three of them"),
    ],
)
def test_options_that_make_no_sense_are_refused(arguments: list[str], text: str) -> None:
    result = CliRunner().invoke(cli, ["emulate", *arguments])
    assert result.exit_code != 0
    told = f"{result.output} {result.exception} {getattr(result.exception, 'hint', '')}"
    assert text in " ".join(told.split())
