"""The Dex1-1's driver against its emulated motor on a pseudo-terminal."""

from __future__ import annotations

import logging
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.backends import BackendOptions
from dexkit.backends import backend as find_backend
from dexkit.cli.calibrate import command as calibrate_command
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings, find_motor
from dexkit.drivers.dex1_serial import line as line_module
from dexkit.drivers.dex1_serial.line import MotorLine, acquire, is_shared
from dexkit.emulators.m4010 import Dex1Motors, Dex1Process, Firmware
from dexkit.errors import HandLost, HandNotFound, HandRefused, HandTimeout, UsageError
from dexkit.hand import Hand, HandCommand, HandState, JointMode, MotorError, Side
from dexkit.wire.m4010 import MotorCmd
from tests.each import each
from tests.patience import PATIENCE, waits_of

BRAKE = HandCommand.brake(1)
OPEN = HandCommand.position(5.4)
CLOSE = HandCommand.position(0.3)
TIMEOUT = 1.0  # s, the longest; this machine may be busy with other tests
SEARCH_TIMEOUT = 0.3  # s, where most ids and ports do not answer


@contextmanager
def opened(
    motors: Dex1Motors | Dex1Process, side: Side = Side.LEFT, **configuration: object
) -> Iterator[Dex1Serial]:
    values: dict[str, object] = {"device": motors.path, "timeout": TIMEOUT, **configuration}
    with Dex1Serial(side, Dex1Settings(**values)) as hand:  # type: ignore[arg-type]
        yield hand


def exchange(hand: Dex1Serial, command: HandCommand) -> HandState:
    """As the hand's, and again where a busy machine has paused this program."""
    while True:
        try:
            return hand.exchange(command)
        except HandTimeout as error:
            if "this program was paused" not in error.message:
                raise


def drive(
    hand: Dex1Serial,
    command: HandCommand,
    until: Callable[[HandState], bool],
    timeout: float = PATIENCE,
) -> HandState:
    end = time.monotonic() + timeout
    while True:
        state = exchange(hand, command)
        if until(state):
            return state
        assert time.monotonic() < end, f"{hand.spec.side} does not get there with {command}"
        time.sleep(0.002)


def drive_until_moving(hand: Dex1Serial, command: HandCommand) -> HandState:
    """Drive to OPEN or CLOSE until the hand is seen in motion.

    Where the machine is so busy that the whole motion passes between two exchanges, drive back and
    try again.
    """
    there, back = float(command.q[0]), CLOSE if command is OPEN else OPEN
    while True:
        state = drive(hand, command, lambda s: moving(s) or abs(float(s.q[0]) - there) < 0.05)
        if moving(state):
            return state
        drive(hand, back, lambda s: abs(float(s.q[0]) - float(back.q[0])) < 0.05)


def wait_for(condition: Callable[[], object], timeout: float = PATIENCE) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def arrived(state: HandState) -> bool:
    return abs(float(state.q[0]) - 5.4) < 0.05


def moving(state: HandState) -> bool:
    return abs(float(state.dq[0])) > 1.0


# --- driving


def test_driver_moves_measures_and_brakes_on_close() -> None:
    with Dex1Motors() as motors:
        with opened(motors) as hand:
            assert isinstance(hand, Hand)
            assert motors.motor.mechanics.mode is JointMode.BRAKE
            start = exchange(hand, BRAKE)
            assert float(start.q[0]) == pytest.approx(1.08, abs=1e-3)
            assert start.mode[0] == JointMode.BRAKE
            way = drive_until_moving(hand, OPEN)
            assert way.mode[0] == JointMode.FOC
            assert float(way.tau_est[0]) > 0
            before = time.monotonic()
            end = drive(hand, OPEN, lambda s: arrived(s) and abs(float(s.dq[0])) < 0.01)
            assert float(end.temperature[0]) == pytest.approx(25, abs=5)
            assert end.winding_temperature is not None
            assert float(end.voltage[0]) == 24.0
            assert end.fault[0] == 0
            assert before <= end.stamp <= time.monotonic()
            assert motors.motor.mechanics.joint.q == pytest.approx(float(end.q[0]), abs=0.05)
            drive_until_moving(hand, CLOSE)
        assert motors.motor.mechanics.mode is JointMode.BRAKE
        hand.close()
        with pytest.raises(HandLost, match="not connected"):
            hand.exchange(BRAKE)


def test_two_hands_share_one_line() -> None:
    with Dex1Motors(tuple(Side)) as motors:
        with opened(motors, Side.LEFT) as left, opened(motors, Side.RIGHT) as right:
            targets = {left: 4.0, right: 2.0}

            def run(hand: Dex1Serial) -> None:
                for _ in range(300):
                    exchange(hand, HandCommand.position(targets[hand]))
                    time.sleep(0.001)
                drive(
                    hand,
                    HandCommand.position(targets[hand]),
                    lambda s: abs(float(s.q[0]) - targets[hand]) < 0.1,
                )

            threads = [threading.Thread(target=run, args=(hand,)) for hand in targets]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60)
            assert motors.motors[Side.LEFT].q == pytest.approx(4.0, abs=0.1)
            assert motors.motors[Side.RIGHT].q == pytest.approx(2.0, abs=0.1)
            assert left.line_statistics is right.line_statistics
            assert left.line_statistics.foreign == 0
            left.close()
            exchange(right, BRAKE)  # the line stays for the other one
            with pytest.raises(HandRefused, match="6000000 baud already"):
                acquire(motors.path, 4_000_000)
        assert line_module._lines == {}


def test_without_protection_its_frames_are_those_of_the_vendors_service() -> None:
    """docs/sources/unitree-dex.md#g, the table of frames; the protection is one bit more while it
    drives.
    """
    right = Dex1Serial(Side.RIGHT, Dex1Settings(protect=False))
    frame = right._encode_command(HandCommand.position(2.7))
    assert frame.hex() == "feee100000000000195f05006600010099db492c"
    protected = Dex1Serial(Side.RIGHT)
    assert MotorCmd.parse(protected._encode_command(HandCommand.position(2.7))) == replace(
        MotorCmd.parse(frame), timeout=True
    )
    assert protected._encode_command(BRAKE).hex() == "feee8000000000000000000000000000" + "1d99fb6e"


# --- finding it


def test_auto_device_searches_every_port(tmp_path: Path) -> None:
    links = {Side.LEFT: tmp_path / "ttyB", Side.RIGHT: tmp_path / "ttyA"}
    (tmp_path / "ttyC").write_text("no port")
    ports = (str(tmp_path / "tty*"), str(tmp_path / "none*"))
    with Dex1Motors(tuple(Side), links=links):
        for side, link in links.items():
            with Dex1Serial(side, Dex1Settings(ports=ports, timeout=SEARCH_TIMEOUT)) as hand:
                assert hand.path == str(link)
        assert line_module._lines == {}


def test_missing_motor_error_lists_what_was_tried(tmp_path: Path) -> None:
    nothing = Dex1Settings(ports=(str(tmp_path / "tty*"),), timeout=0.05)
    with pytest.raises(HandNotFound, match="nothing matches"):
        Dex1Serial(Side.LEFT, nothing).open()
    with pytest.raises(HandNotFound, match="there is no device"):
        Dex1Serial(Side.LEFT, Dex1Settings(device=str(tmp_path / "tty"))).open()
    links = {Side.RIGHT: tmp_path / "tty1"}
    with Dex1Motors((Side.RIGHT,), links=links) as motors:
        with pytest.raises(HandNotFound, match=r"motor 1 \(the left one\) does not") as found:
            Dex1Serial(Side.LEFT, nothing).open()
        assert "motor 0 answers, which is the right one" in found.value.hint
        with pytest.raises(HandNotFound):
            Dex1Serial(Side.RIGHT, Dex1Settings(device=motors.path, id=7, timeout=0.02)).open()
        with Dex1Serial(Side.LEFT, Dex1Settings(device=motors.path, id=0, timeout=SEARCH_TIMEOUT)):
            pass  # the user may allow it
        motors.inject("stray:before=3")
        wait_for(lambda: motors.bus(Side.RIGHT).schedule.active)
        with Dex1Serial(Side.RIGHT, Dex1Settings(device=motors.path, timeout=TIMEOUT)) as hand:
            exchange(hand, BRAKE)
            assert hand.line_statistics.stray >= 6
        motors.inject("corrupt")
        wait_for(lambda: len(motors.bus(Side.RIGHT).schedule.active) == 2)
        with pytest.raises(HandNotFound) as garbled:
            Dex1Serial(Side.LEFT, Dex1Settings(device=motors.path, timeout=SEARCH_TIMEOUT)).open()
        assert "no intact frames" in garbled.value.hint


def test_two_motors_with_one_id_are_refused(tmp_path: Path) -> None:
    link, other = {Side.LEFT: tmp_path / "tty1"}, {Side.LEFT: tmp_path / "tty2"}
    with Dex1Motors(links=link), Dex1Motors(links=other):
        settings = Dex1Settings(ports=(str(tmp_path / "tty*"),), timeout=SEARCH_TIMEOUT)
        with pytest.raises(HandRefused, match="more than one port") as found:
            Dex1Serial(Side.LEFT, settings).open()
        assert "tty1, " in found.value.message
        with Dex1Motors((Side.RIGHT,), links={Side.RIGHT: tmp_path / "tty3"}):
            line, _ = find_motor(settings, 0)
            line.release()
    assert line_module._lines == {}


def test_port_used_by_another_program_is_refused(tmp_path: Path) -> None:
    links = {Side.LEFT: tmp_path / "tty1"}
    with Dex1Motors(links=links) as motors:
        code = (
            "import serial, sys; p = serial.Serial(sys.argv[1], 6000000, exclusive=True);"
            "print('ready', flush=True); sys.stdin.read()"
        )
        holder = subprocess.Popen(
            [sys.executable, "-c", code, motors.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"ready\n"
            with pytest.raises(HandRefused, match="another program"), opened(motors):
                pass
            settings = Dex1Settings(ports=(str(tmp_path / "tty*"),))
            with pytest.raises(HandNotFound) as found:
                Dex1Serial(Side.LEFT, settings).open()
            assert "another program" in found.value.hint
        finally:
            holder.communicate()


# --- what goes wrong on the line


@each(
    ("spec", "fails"),
    [
        ("short:for=400ms", True),
        ("drop:for=400ms", True),
        ("corrupt:for=400ms", True),
        ("delay:ms=60,for=400ms", True),
        ("pause:ms=60,for=400ms", True),
        ("pause:ms=5,for=150ms", False),
        ("stray:before=1,for=150ms", False),
        ("stray:before=0,after=2,for=150ms", False),
    ],
)
def test_a_damaged_answer_costs_its_own_exchange_only(
    spec: str, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What puts the vendor's library out of step for good (docs/sources/unitree-dex.md#g) passes
    without trace.
    """
    # the emulator is as late as a busy machine makes it, beyond its fault
    monkeypatch.setattr("dexkit.drivers.dex1_serial.line.LATE", 0.1)
    with Dex1Motors(start_pct=50.0) as motors, opened(motors) as hand:
        exchange(hand, BRAKE)
        patient = hand.configuration
        if fails:
            hand.configuration = replace(patient, timeout=0.04)
        motors.inject(spec)
        schedule = motors.bus(Side.LEFT).schedule
        wait_for(lambda: schedule.active)
        failed = 0
        while schedule.active:
            try:
                state = exchange(hand, OPEN)
                assert 2.6 < float(state.q[0]) < 5.6
            except HandTimeout:
                failed += 1
        assert bool(failed) == fails
        hand.configuration = patient
        # at once, or after what is still late
        for left in reversed(range(4)):
            try:
                exchange(hand, BRAKE)
                break
            except HandTimeout:
                assert left
        # and in step: each answer belongs to its own command
        drive(hand, OPEN, arrived)
        for command, mode in ((BRAKE, 0), (OPEN, 1)) * 5:
            assert exchange(hand, command).mode[0] == mode


def test_an_exchange_is_bounded_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with Dex1Motors() as motors, opened(motors, timeout=0.1) as hand:
        motors.inject("silent")
        wait_for(lambda: motors.motor.silent)
        waits = waits_of(monkeypatch, select, "select", lambda *given: given[3])
        for _ in range(5):
            waits.clear()
            with pytest.raises(HandTimeout):
                hand.exchange(BRAKE)
            assert 0 < sum(waits) <= hand.spec.exchange_timeout
        monkeypatch.undo()
        assert hand.line_statistics.timeouts >= 5


# --- errors, protection


def test_motor_errors_are_in_the_state_until_they_end(caplog: pytest.LogCaptureFixture) -> None:
    with Dex1Motors() as motors, opened(motors) as hand:
        with caplog.at_level(logging.WARNING):
            motors.inject("overcurrent:for=100ms")
            drive(hand, OPEN, lambda s: s.fault[0] == MotorError.OVERCURRENT)
            state = drive(hand, OPEN, lambda s: s.fault[0] == 0)
        motors.inject("overheat:c=130,for=50ms")
        hot = drive(hand, BRAKE, lambda s: s.fault[0] == MotorError.WINDING_OVERTEMPERATURE)
        assert hot.winding_temperature is not None
        assert hot.winding_temperature[0] == 130
        assert state.q.shape == (1,)
        assert hand.statistics.faults == 2
        assert "reports: overcurrent" in caplog.text
        assert "no error any more" in caplog.text


def test_timeout_protection_trips_in_a_pause_and_is_cleared() -> None:
    quick = Firmware(command_timeout=0.2)
    with Dex1Motors(firmware=quick) as motors, opened(motors) as hand:
        drive_until_moving(hand, OPEN)
        wait_for(lambda: motors.motor.tripped)
        assert motors.motor.mechanics.mode is JointMode.BRAKE
        found = exchange(hand, CLOSE)
        assert found.fault[0] & MotorError.MOTOR_SAW_HOST_TIMEOUT
        cleared = exchange(hand, CLOSE)
        assert cleared.fault[0] == 0
        drive(hand, CLOSE, lambda s: float(s.q[0]) < 0.5)
        assert hand.statistics.trips >= 1


def test_protection_can_be_left_off() -> None:
    quick = Firmware(command_timeout=0.1)
    with Dex1Motors(firmware=quick) as motors, opened(motors, protect=False) as hand:
        exchange(hand, OPEN)
        time.sleep(0.3)
        assert not motors.motor.tripped
        assert motors.motor.mechanics.mode is JointMode.FOC


@pytest.mark.parametrize("where", ["write", "read"])
def test_sigint_during_an_exchange_brakes(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    with Dex1Motors(start_pct=100.0) as motors:
        with opened(motors) as hand:
            drive_until_moving(hand, CLOSE)
            real = os.write

            def interrupt(fd: int, data: bytes) -> int:
                patched.undo()
                if where == "read":
                    real(fd, data)  # the command is out, its answer on its way
                raise KeyboardInterrupt

            with monkeypatch.context() as patched:
                patched.setattr(line_module.os, "write", interrupt)
                with pytest.raises(KeyboardInterrupt):
                    hand.exchange(CLOSE)
            assert motors.motor.mechanics.mode is JointMode.FOC
        assert motors.motor.mechanics.mode is JointMode.BRAKE


def test_motor_stops_after_the_driver_is_killed() -> None:
    code = (
        "import sys, time\n"
        "from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings\n"
        "from dexkit.hand import HandCommand, Side\n"
        "hand = Dex1Serial(Side.LEFT, Dex1Settings(device=sys.argv[1], timeout=0.3))\n"
        "hand.open()\n"
        "while True:\n"
        "    hand.exchange(HandCommand.position(5.4, kp=0.0, kd=0.5, dq=0.5))\n"
        "    print(flush=True)\n"
        "    time.sleep(0.002)\n"
    )
    with Dex1Motors() as motors:
        driver = subprocess.Popen([sys.executable, "-c", code, motors.path], stdout=subprocess.PIPE)
        assert driver.stdout is not None
        driver.stdout.readline()
        wait_for(lambda: motors.motor.mechanics.joint.dq > 0.2)
        driver.send_signal(signal.SIGKILL)
        driver.communicate()
        wait_for(lambda: motors.motor.tripped, 3.0)
        wait_for(lambda: motors.motor.mechanics.joint.dq == 0.0)
        with opened(motors) as hand:  # and the next driver works
            drive_until_moving(hand, OPEN)


# --- the cable


def test_both_hands_recover_a_lost_shared_line() -> None:
    with Dex1Motors(tuple(Side)) as motors:
        hands = [
            Dex1Serial(side, Dex1Settings(device=motors.path, timeout=TIMEOUT)) for side in Side
        ]
        for hand in hands:
            hand.open()
        motors.inject("unplug:for=100ms")
        with pytest.raises(HandLost):
            drive(hands[0], BRAKE, lambda s: False)
        hands[0].close()
        wait_for(lambda: os.path.exists(motors.path))
        hands[0].open()  # a new line, while the other still has the old one
        with pytest.raises(HandLost):
            hands[1].exchange(BRAKE)
        hands[1].close()
        hands[1].open()
        assert hands[0].line_statistics is hands[1].line_statistics
        for hand in hands:
            exchange(hand, BRAKE)
            hand.close()
    assert line_module._lines == {}


def test_close_of_a_lost_hand_reports_it(caplog: pytest.LogCaptureFixture) -> None:
    for protect, expected in ((True, "stops by itself"), (False, "cut its power")):
        with Dex1Motors() as motors:
            hand = Dex1Serial(
                Side.LEFT, Dex1Settings(device=motors.path, timeout=TIMEOUT, protect=protect)
            )
            hand.open()
        hand.close()
        assert expected in caplog.text


# --- calibrating


def test_calibration_makes_closed_the_zero_once() -> None:
    with Dex1Motors(start_pct=0.0, zero_error=1.5) as motors, opened(motors) as hand:
        assert float(exchange(hand, BRAKE).q[0]) == pytest.approx(1.5, abs=1e-3)
        assert hand.calibrate() == pytest.approx(0.0, abs=1e-3)
        assert float(exchange(hand, BRAKE).q[0]) == pytest.approx(0.0, abs=1e-3)
        with pytest.raises(HandRefused, match="before since power-up"):
            hand.calibrate()
        hand.close()
        with pytest.raises(HandLost, match="not connected"):
            hand.calibrate()


def test_calibration_without_an_answer_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vendor's library reports "successful" (docs/sources/unitree-dex.md#g)."""
    monkeypatch.setattr("dexkit.drivers.dex1_serial.hand._FLASH_TIME", 0.05)
    with Dex1Motors() as motors, opened(motors) as hand:
        motors.inject("silent:for=100ms")
        wait_for(lambda: motors.motor.silent)
        with pytest.raises(HandTimeout):
            hand.calibrate()
        wait_for(lambda: not motors.motor.silent)
        monkeypatch.undo()
        with pytest.raises(HandRefused, match="time is 0"):
            hand.calibrate(time=lambda: 0.0)
    with (
        Dex1Motors(firmware=Firmware(calibration_enabled=False)) as motors,
        opened(motors) as hand,
        pytest.raises(HandRefused, match="not enabled"),
    ):
        hand.calibrate()


# --- the backend


def test_the_backend_reads_its_settings() -> None:
    backend = find_backend("dex1-serial")
    assert backend.model == "dex1-1"
    settings = {
        "ports": "/dev/a*, /dev/b",
        "id": "3",
        "sign": "-",
        "offset": "0.5",
        "ratio": "32",
        "adapter": "SN1",
        "config": "/dev/c.json",
        "baudrate": "4000000",
        "protect": "off",
        "timeout": "0.05",
    }
    assert set(settings) == set(backend.settings)
    hand = backend.create(BackendOptions(Side.RIGHT, "/dev/x", settings))
    assert isinstance(hand, Dex1Serial)
    assert hand.configuration == Dex1Settings(
        device="/dev/x",
        ports=("/dev/a*", "/dev/b"),
        id=3,
        sign=-1,
        offset=0.5,
        ratio=32.0,
        adapter="SN1",
        config=Path("/dev/c.json"),
        given=frozenset(settings),
        baudrate=4_000_000,
        protect=False,
        timeout=0.05,
    )
    assert hand.id == 3
    assert Dex1Serial(Side.RIGHT).id == 0
    assert Dex1Serial(Side.LEFT).id == 1
    spec = Dex1Serial(Side.LEFT).spec
    assert (spec.io_rate, spec.simulated) == (500.0, False)
    assert spec.exchange_timeout <= 0.1


def test_unusable_serial_port_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(HandNotFound, match="not a serial port"):
        MotorLine(str(tmp_path / "file"), 6_000_000)

    def refuse(*args: object, **options: object) -> None:
        raise ValueError("Failed to set custom baud rate (6000000): [Errno 22] Invalid argument")

    monkeypatch.setattr(line_module.serial, "Serial", refuse)
    with pytest.raises(HandRefused, match="does not do 6000000 baud"):
        MotorLine("/dev/null", 6_000_000)


def test_search_does_not_disturb_a_driven_hand() -> None:
    with Dex1Motors(tuple(Side)) as motors, opened(motors, Side.RIGHT) as right:
        drive_until_moving(right, OPEN)
        motors.inject("silent:id=1")
        wait_for(lambda: motors.motors[Side.LEFT].silent)
        with pytest.raises(HandNotFound), opened(motors, timeout=0.01):
            pass
        assert motors.motors[Side.RIGHT].mechanics.mode is JointMode.FOC
        line = acquire(motors.path, 6_000_000)
        assert is_shared(line)
        assert line.exchange(MotorCmd(0).pack(), 0, TIMEOUT).id == 0
        line.release()


# --- the command line


def calibrate(*arguments: str) -> tuple[object, str]:
    """(what was raised, or None; what was said)"""
    result = CliRunner().invoke(calibrate_command, arguments)
    return (
        result.exception,
        f"{result.output}{result.exception}{getattr(result.exception, 'hint', '')}",
    )


def test_calibration_on_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    patient = partial(Dex1Settings, timeout=TIMEOUT)
    monkeypatch.setattr("dexkit.cli.calibrate_dex1.Dex1Settings", patient)
    with Dex1Motors((Side.RIGHT,), start_pct=0.0, zero_error=1.5) as motors:
        where = ("dex1-serial", "--side", "right", "--device", motors.path)
        error, said = calibrate(*where, "--dry-run")
        assert error is None
        assert "jaws are at 1.500 rad" in said
        error, said = calibrate(*where)
        assert isinstance(error, UsageError)
        assert "give --yes" in said
        assert motors.motor.zero_error == 1.5
        error, said = calibrate(*where, "--yes")
        assert error is None
        assert "stored in the motor" in said
        assert motors.motor.q == pytest.approx(0.0, abs=1e-3)
        error, said = calibrate(*where, "--yes")
        assert isinstance(error, HandRefused)
        assert "before since power-up" in said


@each(
    ("arguments", "expected"),
    [
        (["dex1-serial"], "no hand is given"),
        (
            ["dex1-serial", "--side", "left", "--measure", "speed"],
            "--measure does not apply to dex1-serial",
        ),
        (
            ["ezgripper", "--side", "left", "--device", "x"],
            "--side cannot be combined with --device",
        ),
    ],
)
def test_options_of_the_other_gripper_are_refused(arguments: list[str], expected: str) -> None:
    error, said = calibrate(*arguments)
    assert isinstance(error, UsageError)
    assert expected in said
