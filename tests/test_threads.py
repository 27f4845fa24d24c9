"""A thread that dies ends the program, with a message and an error exit code."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from dexkit import threads
from dexkit.bridge import bridge as bridge_module
from dexkit.cli import main
from dexkit.dds import DdsNode
from dexkit.emulators.robot.run import EmulatedRobot
from dexkit.errors import DexkitError, HandLost
from dexkit.service import HandService
from dexkit.service.publisher import Publisher
from dexkit.stop_signals import stop_on_signals
from dexkit.threads import Worker
from dexkit.traces import Recorder, open_trace
from dexkit.traces.dds_recording import DdsRecording
from tests.dds_helpers import free_domain, wait_until
from tests.trace_helpers import CMD, CMD_TYPE, STATE


class Injected(Exception):
    """What the tests make threads die of."""


def die(*args: object, **options: object) -> None:
    raise Injected("injected")


# -- the mechanism ---------------------------------------------------------------------------------


def test_dying_worker_raises_in_every_waiter(caplog: pytest.LogCaptureFixture) -> None:
    owner: list[Exception] = []
    dead: list[Worker] = []
    threads.forget()
    with threads.on_death(dead.append), threads.on_death(die), stop_on_signals() as stop:
        worker = Worker("test", die, 1, 2, failed=owner.append)
        worker.start()
        assert stop.wait(10)
    worker.join()
    assert isinstance(worker.failure, Injected)
    assert owner == [worker.failure]
    assert dead == [worker]
    assert "the test thread died" in caplog.text
    for check in (worker.check, threads.check):
        with pytest.raises(DexkitError, match="the test thread died: Injected: injected"):
            check()
    threads.forget()
    threads.check()
    assert worker.daemon


def test_dexkit_error_of_a_worker_is_raised_unchanged(caplog: pytest.LogCaptureFixture) -> None:
    def lose() -> None:
        raise HandLost("it is gone", hint="look for it")

    worker = Worker("test", lose)
    worker.start()
    worker.join()
    with pytest.raises(HandLost, match="it is gone"):
        worker.check()
    assert "Traceback" not in caplog.text
    threads.forget()


# -- each program ----------------------------------------------------------------------------------

SERVE = ("serve", "sim-dex1", "--side", "left", "--quiet", "--domain")
BRIDGE = ("bridge", "unitree_actuator", "unitree_go", "--domain")
RECORD = ("record", "OUT", "--topic", STATE, "--domain")
ROBOT = ("emulate", "g1", "--domain")

# (command, whose method dies, method)
PROGRAMS: list[tuple[tuple[str, ...], type, str]] = [
    (RECORD, DdsNode, "_dispatch"),
    (RECORD, DdsRecording, "_read_samples"),
    (RECORD, Recorder, "_write_all"),
    (SERVE, DdsNode, "_dispatch"),
    (SERVE, HandService, "_receive_loop"),
    (SERVE, HandService, "_exchange"),
    (SERVE, HandService, "_compose"),
    (SERVE, Publisher, "_run"),
    (BRIDGE, bridge_module._DirectionLoop, "_run_once"),
    (BRIDGE, DdsNode, "_dispatch"),
    (ROBOT, Publisher, "_run"),
    (ROBOT, EmulatedRobot, "_advance_robot"),
    (ROBOT, DdsNode, "_dispatch"),
]


@pytest.fixture
def undisturbed_logging(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands configure the root logger for as long as a process lives."""
    monkeypatch.setattr(logging, "basicConfig", lambda **options: None)


@pytest.mark.usefixtures("undisturbed_logging")
@pytest.mark.parametrize(
    ("command", "owner", "method"), PROGRAMS, ids=[f"{c[0]}-{m}" for c, _, m in PROGRAMS]
)
def test_a_program_that_loses_a_thread_ends_with_an_error(
    command: tuple[str, ...],
    owner: type,
    method: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(owner, method, die)
    arguments = [a.replace("OUT", str(tmp_path / "out.mcap")) for a in command]
    # it is started as a user does; it must end by itself
    with pytest.raises(SystemExit) as ended:
        main([*arguments, str(free_domain())])
    captured = capsys.readouterr()
    assert ended.value.code in (1, 2), captured
    assert "injected" in captured.err
    assert "error: " in captured.err


def test_recording_before_the_failure_is_kept(tmp_path: Path) -> None:
    domain = free_domain()
    path = tmp_path / "a.mcap"
    with DdsNode(domain) as hand, DdsNode(domain) as node:
        recorder = Recorder(path)
        recorder.open()
        recording = DdsRecording(node, recorder, [CMD], types={CMD: CMD_TYPE})
        recording.start()
        writer = hand.writer(CMD, CMD_TYPE)
        assert writer.wait_matched(10)
        writer.write_raw(bytes(16))
        wait_until(lambda: recorder.written)
        recording._discover = die  # type: ignore[method-assign, assignment]
        wait_until(lambda: recording.failure)
        with pytest.raises(DexkitError, match="the recording thread died: Injected"):
            recording.stop()
        recorder.close()
    assert len(open_trace(path).samples(CMD)) == 1
    threads.forget()
