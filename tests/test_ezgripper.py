"""Test the EZGripper driver with the emulated servo over a pseudo-terminal.

These run in real time, because a serial line does. Where a test waits, it waits for an event
with a generous deadline; only the last group has the time itself as its subject.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from dexkit.backends import BackendOptions
from dexkit.backends import backend as find_backend
from dexkit.cli.calibrate import command as calibrate_command
from dexkit.drivers.ezgripper import (
    Calibrate,
    EZGripper,
    GripperSettings,
    calibration,
    servo_registers,
)
from dexkit.drivers.ezgripper.bus import DevicePort, ServoBus
from dexkit.drivers.ezgripper.calibration import CalibrationFailed
from dexkit.drivers.ezgripper.control import Phase
from dexkit.drivers.ezgripper.discovery import (
    find_device,
    find_servo,
    latency_timer,
    latency_warning,
)
from dexkit.drivers.ezgripper.gripper import ZeroGains
from dexkit.emulators.mx64 import (
    Bus,
    Firmware,
    Port,
    Servo,
)
from dexkit.emulators.mx64.protocol1 import Protocol1Servo
from dexkit.errors import (
    DexkitError,
    HandError,
    HandFault,
    HandLost,
    HandNotFound,
    HandRefused,
    HandTimeout,
    UsageError,
)
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.wire import mx64
from tests.dds_helpers import wait_until
from tests.ezgripper_helpers import (
    BRAKE,
    CLOSE,
    HALF,
    LIMP,
    LONG,
    OPEN,
    QUICK,
    ZERO,
    at,
    configured,
    drive,
    drive_for,
    emulated,
    exchange,
    fault_of,
    gripper_on,
    travel,
    until_recovered,
)
from tests.patience import PATIENCE, waits_of


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's grippers get the time that :func:`configured` gives those of the tests."""
    monkeypatch.setattr(
        "dexkit.cli.calibrate.GripperSettings", partial(GripperSettings, timeout=1.0)
    )


@pytest.fixture
def _patient_servo(monkeypatch: pytest.MonkeyPatch) -> None:
    """The servo's bus watchdog outlasts a pause of the emulator's thread on a busy machine."""
    for module in ("servo_registers", "servo"):
        monkeypatch.setattr(f"dexkit.drivers.ezgripper.{module}.WATCHDOG_UNITS", 127)


# --- opening


def test_open_sets_registers_without_motion(tmp_path: Path) -> None:
    with emulated() as gripper:
        before = travel(gripper)
        with gripper_on(gripper.path, configured(tmp_path)) as hand:
            servo = gripper.servo
            for item, value in (*servo_registers.EEPROM, *servo_registers.RAM):
                assert servo.get(item) == value, item.name
            assert servo.get(mx64.BUS_WATCHDOG) == servo_registers.WATCHDOG_UNITS
            assert not servo.torque
            assert travel(gripper) == before
            assert hand.ping is not None
            assert hand.ping.model == mx64.MODEL
            bus = ServoBus(gripper.path, 1_000_000)
            with pytest.raises(HandRefused, match="another program"):
                bus.open()
        # a second time there is nothing to be written to the EEPROM
        with gripper_on(gripper.path, configured(tmp_path)) as hand:
            assert hand._servo is not None
            assert servo_registers.differences(hand._servo.bus, 1) == []


def test_open_without_calibration_is_refused(tmp_path: Path) -> None:
    with emulated() as gripper:
        hand = EZGripper(gripper.path, configuration=configured(tmp_path, zero=None))
        with pytest.raises(HandRefused, match="not been calibrated") as refused:
            hand.open()
        assert "dexkit calibrate" in refused.value.hint
        # nothing stays open
        with gripper_on(gripper.path, configured(tmp_path)):
            pass


def test_servo_with_factory_settings_is_found(tmp_path: Path) -> None:
    with emulated(baudrate=57_600, servo_id=7) as gripper:
        configuration = configured(tmp_path, id=None, baudrate=57_600)
        with gripper_on(gripper.path, configuration) as hand:
            assert hand.ping is not None
            assert hand.ping.id == 7
            assert hand.spec.io_rate == pytest.approx(1000 / 14)
            hand.exchange(BRAKE)
        hand = EZGripper(gripper.path, configuration=configured(tmp_path, baudrate=57_600))
        with pytest.raises(HandNotFound, match="tried id 1 at 57600 baud") as missing:
            hand.open()
        assert "id 7 (model 311) at 57600 baud" in missing.value.hint


def test_protocol_1_firmware_is_refused_with_hint(tmp_path: Path) -> None:
    with Port(Bus([], protocol_1=[Protocol1Servo(1)])) as port:
        port.start()
        hand = EZGripper(port.path, configuration=configured(tmp_path, timeout=0.5))
        with pytest.raises(HandRefused, match=r"Protocol 1\.0") as refused:
            hand.open()
        assert "Wizard" in refused.value.hint


def test_two_servos_on_one_line(tmp_path: Path) -> None:
    now = time.monotonic()
    servos = [Servo(i, baudrate=1_000_000, now=now) for i in (1, 2)]
    with Port(Bus(servos, start=now)) as port:
        port.start()
        bus = ServoBus(port.path, 1_000_000, timeout=0.2)
        try:
            with pytest.raises(HandNotFound, match="more than one servo") as found:
                find_servo(bus, None, 1_000_000)
            assert "id 1" in found.value.message
            assert "id 2" in found.value.message
            assert find_servo(bus, 2, 1_000_000).id == 2
        finally:
            bus.close()


def test_other_devices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(HandNotFound, match="no device"):
        EZGripper(str(tmp_path / "tty")).open()
    with pytest.raises(HandNotFound, match="serial number NOPE"):
        EZGripper("NOPE").open()
    with pytest.raises(HandNotFound, match="not a serial port"):
        EZGripper("/dev/null").open()
    with pytest.raises(HandLost, match="not connected"):
        EZGripper("/dev/null").exchange(BRAKE)
    assert find_device("/dev/null").serial_number is None


def test_port_without_permission_is_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object, **kwargs: object) -> int:
        raise PermissionError(13, "Permission denied")

    bus = ServoBus("/dev/null", 1_000_000)
    with monkeypatch.context() as patched:
        patched.setattr("serial.serialposix.os.open", refuse)
        with pytest.raises(HandNotFound, match="no permission") as denied:
            bus.open()
    assert "dialout" in denied.value.hint


def test_high_latency_timer_is_warned_about_and_not_changed(tmp_path: Path) -> None:
    timer = tmp_path / "bus/usb-serial/devices/ttyUSB7/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    assert latency_timer("/dev/ttyUSB7", tmp_path) == 16
    assert "at most 62 exchanges a second" in latency_warning("/dev/ttyUSB7", tmp_path)
    assert timer.read_text() == "16\n"
    timer.write_text("1\n")
    assert latency_warning("/dev/ttyUSB7", tmp_path) == ""
    assert latency_warning("/dev/ttyACM0", tmp_path) == ""


def test_backend_reads_its_settings(tmp_path: Path) -> None:
    backend = find_backend("ezgripper")
    with pytest.raises(UsageError, match="names none for the"):
        backend.create(BackendOptions(Side.LEFT))
    table = tmp_path / "table.json"
    table.write_text('{"0": 0, "100": 2}')
    hand = backend.create(
        BackendOptions(
            Side.LEFT,
            "/dev/null",
            {
                "id": "auto",
                "baudrate": "57600",
                "calibrate": "yes",
                "effort": "40",
                "force_table": str(table),
                "config": str(tmp_path / "c.json"),
            },
        )
    )
    assert isinstance(hand, EZGripper)
    assert hand.configuration.id is None
    assert hand.configuration.baudrate == 57_600
    assert hand.configuration.calibrate is Calibrate.YES
    assert hand.configuration.control.effort == 40
    assert hand.configuration.force_table is not None
    assert hand.configuration.force_table.force(50) == 1.0
    assert hand.spec.side is Side.LEFT


# --- moving


@pytest.mark.parametrize("where", ["write", "read"])
def test_ctrl_c_during_exchange_switches_torque_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def interrupt(*args: object) -> bytes:
        patched.undo()
        raise KeyboardInterrupt

    with emulated(start=100.0) as gripper:
        with gripper_on(gripper.path, configured(tmp_path)) as hand:
            drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
            with monkeypatch.context() as patched:
                patched.setattr(DevicePort, where, interrupt)
                with pytest.raises(KeyboardInterrupt):
                    hand.exchange(CLOSE)
            assert gripper.servo.torque
        assert not gripper.servo.torque


def test_zero_gains_apply_no_torque_and_brake_holds(tmp_path: Path) -> None:
    with emulated() as gripper, gripper_on(gripper.path, configured(tmp_path)) as hand:
        before = travel(gripper)
        for _ in range(100):
            exchange(hand, LIMP)
        assert not gripper.servo.torque, "limp needs no motor"
        assert travel(gripper) == pytest.approx(before, abs=2)
        drive(hand, OPEN, lambda s: float(s.dq[0]) > 1.0)
        # limp in motion: the motor lets go, nothing drives on to 5.4 rad
        drive(hand, LIMP, lambda s: abs(float(s.dq[0])) < 0.01)
        assert travel(gripper) < 2400
        assert gripper.servo.get(mx64.GOAL_CURRENT) == 0
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        braked = travel(gripper)
        at_rest = 0

        def stopped(state: HandState) -> bool:
            nonlocal at_rest
            at_rest = at_rest + 1 if abs(float(state.dq[0])) < 0.01 else 0
            return at_rest == 20

        held = drive(hand, BRAKE, stopped)
        assert travel(gripper) < braked, "it comes to a stop, it does not go back"
        later = drive_for(hand, BRAKE, 0.3)
        assert float(later.q[0]) == pytest.approx(float(held.q[0]), abs=0.02)
        assert hand.phase is Phase.BRAKE


def test_zero_gains_can_mean_a_position(tmp_path: Path) -> None:
    configuration = configured(tmp_path, zero_gains=ZeroGains.POSITION)
    with emulated() as gripper, gripper_on(gripper.path, configuration) as hand:
        q_only = replace(OPEN, kp=np.zeros(1), kd=np.zeros(1))
        drive(hand, q_only, lambda s: float(s.q[0]) > 5.0)
        damped = replace(q_only, kd=np.ones(1))
        drive(hand, damped, lambda s: abs(float(s.dq[0])) < 0.01)
        assert gripper.servo.get(mx64.GOAL_CURRENT) == 0, "kd alone is still limp"
        assert hand.adapt_command(BRAKE) is BRAKE


def test_object_is_detected_and_held_with_hold_effort(tmp_path: Path) -> None:
    control = replace(QUICK, hold_after=0.2)
    with (
        emulated(object_pct=40.0, start=80.0) as gripper,
        gripper_on(gripper.path, configured(tmp_path, control=control)) as hand,
    ):
        touched = drive(hand, CLOSE, lambda s: float(s.tau_est[0]) != 0.0)
        assert float(touched.tau_est[0]) < 0, "squeezing pushes toward smaller q"
        assert 0.25 * 5.4 < float(touched.q[0]) < 0.42 * 5.4
        drive(hand, CLOSE, lambda s: hand.phase is Phase.HOLDING)
        held = drive_for(hand, CLOSE, 0.3)
        assert gripper.servo.get(mx64.GOAL_CURRENT) == 240
        # 240 units by the default table: 1.2 + 0.4 * 0.8 = 1.52, a tenth of it as tau_est
        assert float(held.tau_est[0]) == pytest.approx(-0.152, abs=0.03)
        drive(hand, OPEN, lambda s: s.dq[0] > 1.0 and s.tau_est[0] == 0.0)
        assert float(drive(hand, OPEN, at(5.4)).tau_est[0]) == 0.0


def test_closing_without_object_reports_no_force(tmp_path: Path) -> None:
    # the zero that calibration finds lies where the fingers press on each other
    configuration = configured(tmp_path, zero=ZERO - 25)
    with emulated(start=30.0) as gripper, gripper_on(gripper.path, configuration) as hand:
        drive(hand, CLOSE, at(0.05))
        rest = drive_for(hand, CLOSE, 0.5)
        assert float(rest.tau_est[0]) == 0.0
        assert hand.phase is Phase.MOVING


def test_position_is_independent_of_the_servos_turn(tmp_path: Path) -> None:
    # closed at 3010: fully open is 5510, which a reboot folds to 1414
    # (docs/sources/mx64-ezgripper.md#d4)
    with emulated(start=10.0, closed_at=3010) as gripper:
        configuration = configured(tmp_path, zero=3010)
        with gripper_on(gripper.path, configuration) as hand:
            opened = drive(hand, OPEN, at(5.4))
            assert gripper.servo.get(mx64.PRESENT_POSITION) > 4095
            assert hand._servo is not None
            hand.close()
            bus = ServoBus(gripper.path, 1_000_000, timeout=0.2)
            bus.open()
            bus.reboot(1)
            bus.close()
            deadline = time.monotonic() + LONG
            while True:
                try:
                    hand.open()
                    break
                except HandNotFound:
                    assert time.monotonic() < deadline
            assert gripper.servo.get(mx64.PRESENT_POSITION) < 4096
            again = exchange(hand, BRAKE)
            assert float(again.q[0]) == pytest.approx(float(opened.q[0]), abs=0.05)
            drive(hand, HALF, at(2.7))


# --- faults


def test_recovery_from_overload_starts_no_motion(tmp_path: Path) -> None:
    with (
        emulated(start=90.0) as gripper,
        gripper_on(gripper.path, configured(tmp_path)) as hand,
    ):
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        gripper.inject("overload")
        fault = fault_of(hand, CLOSE)
        assert fault.bits == (MotorError.OVERCURRENT,)
        assert "overload" in fault.message
        until_recovered(hand, CLOSE)
        assert hand.statistics.reboots == 1
        stopped = travel(gripper)
        assert stopped > 300, "it was stopped on the way"
        # the same command as before, and a brake of the service: it stays
        for command in (CLOSE, BRAKE, CLOSE):
            drive_for(hand, command, 0.15)
        assert travel(gripper) == pytest.approx(stopped, abs=10)
        assert not gripper.servo.torque, "no command has asked for torque since"
        drive(hand, OPEN, at(5.4))


def test_hot_servo_is_not_driven_until_cool(tmp_path: Path) -> None:
    with (
        emulated() as gripper,
        gripper_on(gripper.path, configured(tmp_path)) as hand,
    ):
        drive(hand, HALF, at(2.7))
        gripper.inject("overheat:c=85")
        fault = fault_of(hand, HALF)
        assert fault.bits == (MotorError.WINDING_OVERTEMPERATURE,)
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            with pytest.raises(HandFault, match="waiting"):
                hand.exchange(OPEN)
        assert hand.statistics.reboots == 0
        hand.close()
        with pytest.raises(HandFault) as still:
            hand.open()
        assert "cool" in still.value.hint
        gripper.inject("overheat:c=30")
        deadline = time.monotonic() + LONG
        while True:
            try:
                hand.open()
                break
            except HandFault:
                assert time.monotonic() < deadline
        hand.exchange(BRAKE)


def test_servo_in_shutdown_is_rebooted_at_open(tmp_path: Path) -> None:
    with emulated() as gripper:
        gripper.inject("shock")
        deadline = time.monotonic() + LONG
        while not gripper.servo.hardware_error:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        with gripper_on(gripper.path, configured(tmp_path)) as hand:
            assert hand.statistics.reboots == 1
            assert exchange(hand, BRAKE).fault[0] == 0


def test_reset_by_supply_dip_is_recovered(tmp_path: Path) -> None:
    with (
        emulated(start=80.0) as gripper,
        gripper_on(gripper.path, configured(tmp_path, timeout=0.1)) as hand,
    ):
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        gripper.inject("brown-out:volts=5,for=200ms")
        deadline = time.monotonic() + LONG
        seen: set[type[DexkitError]] = set()
        bits: tuple[int, ...] = ()
        while hand.statistics.resets == 0:
            assert time.monotonic() < deadline
            try:
                hand.exchange(CLOSE)
            except HandError as error:
                seen.add(type(error))
                if isinstance(error, HandFault):
                    bits = error.bits
        assert any(issubclass(kind, HandTimeout) for kind in seen), "while it boots"
        assert bits == (MotorError.ABNORMAL_RESET,)
        state = until_recovered(hand, CLOSE)
        stopped = travel(gripper)
        for command in (BRAKE, CLOSE, BRAKE):
            drive_for(hand, command, 0.05)
            assert not gripper.servo.torque, "no command has asked for torque since"
        assert float(state.q[0]) == pytest.approx(stopped * 5.4 / 2500, abs=0.05)
        drive_for(hand, CLOSE, 0.3)
        assert travel(gripper) == pytest.approx(stopped, abs=10)
        drive(hand, OPEN, at(5.4))


def test_low_voltage_is_reported_and_exchange_continues(tmp_path: Path) -> None:
    with (
        emulated() as gripper,
        gripper_on(gripper.path, configured(tmp_path)) as hand,
    ):
        drive(hand, HALF, at(2.7))
        gripper.inject("brown-out:volts=8,for=300ms")
        low = drive(hand, HALF, lambda s: bool(s.fault[0]))
        assert low.fault[0] == MotorError.UNDERVOLTAGE
        assert float(low.voltage[0]) < 9.5
        drive(hand, HALF, lambda s: not s.fault[0])
        drive(hand, HandCommand.position(3.5), at(3.5))


_DRIVER = """
import signal
import sys
from dexkit.drivers.ezgripper import EZGripper, GripperSettings
from dexkit.hand import HandCommand
settings = GripperSettings(zero=int(sys.argv[2]), timeout=1.0)
with EZGripper(sys.argv[1], configuration=settings) as hand:
    while hand.exchange(HandCommand.position(0.0)).dq[0] > -0.5:
        pass
    print("moving", flush=True)
    signal.pause()
"""


def test_watchdog_stops_servo_after_driver_is_killed() -> None:
    with emulated(start=100.0) as gripper:
        command = [sys.executable, "-c", _DRIVER, gripper.path, str(ZERO)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as driver:
            assert driver.stdout is not None
            try:
                assert driver.stdout.readline() == b"moving\n"
            finally:
                driver.kill()
        deadline = time.monotonic() + LONG
        while gripper.servo.get(mx64.BUS_WATCHDOG) != mx64.WATCHDOG_TRIPPED:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        while gripper.servo.get(mx64.PRESENT_VELOCITY) != 0:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert travel(gripper) > 1000, "far from its goal"


def test_driver_recovers_after_pause_trips_watchdog(tmp_path: Path) -> None:
    with (
        emulated(start=90.0) as gripper,
        gripper_on(gripper.path, configured(tmp_path)) as hand,
    ):
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        deadline = time.monotonic() + LONG
        while gripper.servo.get(mx64.BUS_WATCHDOG) != mx64.WATCHDOG_TRIPPED:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        drive(hand, HALF, at(2.7))
        # on a busy machine it may trip again, and once more when the driving has ended
        cleared, trips = hand.servo_statistics.watchdog_trips, gripper.servo.watchdog_trips
        assert 1 <= cleared <= trips <= cleared + 1


def test_servo_stopped_by_watchdog_is_opened_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the least kind reading of the manual: once cleared, it goes on to its old goal
    firmware = Firmware(watchdog_resumes=True)
    with emulated(start=100.0, latency_timer=16e-3, firmware=firmware) as gripper:
        hand = EZGripper(gripper.path, configuration=configured(tmp_path))
        hand.open()
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        assert hand._servo is not None
        hand._servo.bus.close()  # killed, or unplugged
        deadline = time.monotonic() + LONG
        stopped, since = travel(gripper), gripper.servo.now
        while (
            gripper.servo.get(mx64.BUS_WATCHDOG) != mx64.WATCHDOG_TRIPPED
            or gripper.servo.now - since < 0.3  # it swings once before it rests
        ):
            assert time.monotonic() < deadline
            time.sleep(0.01)
            if travel(gripper) != stopped:
                stopped, since = travel(gripper), gripper.servo.now
        assert gripper.servo.torque
        written: list[tuple[int, bytes]] = []
        write_block = Servo.write_block

        def noted(servo: Servo, address: int, data: bytes, **options: bool) -> int:
            written.append((address, data))
            return write_block(servo, address, data, **options)

        monkeypatch.setattr(Servo, "write_block", noted)
        with gripper_on(gripper.path, configured(tmp_path)) as after:
            drive_for(after, BRAKE, 0.3)
        # one answer's time at the speed that it begins to take up, and no longer
        cleared = written.index((mx64.BUS_WATCHDOG.address, b"\0"))
        goal = mx64.GOAL_POSITION.encode(ZERO + stopped)
        assert written[cleared + 1] == (mx64.GOAL_POSITION.address, goal)


def test_damaged_and_lost_answers_are_retried_and_counted(tmp_path: Path) -> None:
    with emulated() as gripper:
        configuration = configured(tmp_path, retries=10, timeout=0.1)
        with gripper_on(gripper.path, configuration) as hand:
            gripper.inject("corrupt:p=0.08")
            gripper.inject("drop:p=0.06")
            statistics = hand.bus_statistics
            end = time.monotonic() + PATIENCE
            # chance says when; a busy machine has few transactions in a motion
            while not (statistics.corrupt and statistics.timeouts) and time.monotonic() < end:
                drive(hand, OPEN, at(5.4), timeout=30.0)
                drive(hand, HALF, at(2.7), timeout=30.0)
                statistics = hand.bus_statistics
            assert statistics.corrupt > 0
            assert statistics.timeouts > 0
            assert statistics.retries == statistics.corrupt + statistics.timeouts


def test_missing_answer_times_out_within_documented_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with emulated() as gripper:
        with gripper_on(gripper.path, configured(tmp_path, timeout=0.1)) as hand:
            hand.exchange(BRAKE)
            gripper.inject("drop:for=1500ms")
            deadline = time.monotonic() + LONG
            waits = waits_of(monkeypatch, select, "select", lambda *given: given[3])
            while True:
                waits.clear()
                try:
                    hand.exchange(BRAKE)
                except HandTimeout:
                    break
                assert time.monotonic() < deadline
            monkeypatch.undo()
            assert 0 < sum(waits) <= hand.spec.exchange_timeout
            assert hand.bus_statistics.timeouts >= 3
            while True:
                try:
                    hand.exchange(BRAKE)
                    break
                except HandTimeout:
                    assert time.monotonic() < deadline
        # torque is also switched off when answers are missing
        hand.open()
        hand.exchange(BRAKE)
        gripper.inject("drop")
        hand.close()


# --- calibration


@pytest.mark.usefixtures("_patient_servo")
def test_calibration_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sub" / "ezgripper.json"
    with emulated(start=60.0, closed_at=3900) as gripper:
        common = ["--device", gripper.path, "--config", str(path)]
        before = gripper.servo.eeprom
        looked = CliRunner().invoke(calibrate_command, [*common, "--dry-run"])
        assert looked.exit_code == 0, looked.output
        assert "Operating Mode(11) is 3, would be set to 5" in looked.output
        assert gripper.servo.eeprom == before
        assert not path.exists()

        asked = CliRunner().invoke(calibrate_command, common)
        assert isinstance(asked.exception, UsageError)

        monkeypatch.setattr("dexkit.cli.calibrate._RUNS", 1)
        done = CliRunner().invoke(calibrate_command, [*common, "--yes", "--measure", "speed"])
        assert done.exit_code == 0, (done.output, done.exception)
        assert not gripper.servo.torque
        content = json.loads(path.read_text())
        (key,) = content["calibration"]
        zero = content["calibration"][key]
        # closing squeezes the fingers together a little: at most 2 %
        assert (3900 - zero) % 4096 <= 50
        speeds = content["direction_speeds"][key]
        assert content["movement_speed"][key] == min(speeds.values())
        # 172 %/s is what the motor could do without load at 12 V
        # (docs/sources/mx64-ezgripper.md#d1); a busy machine sees the end of a move late
        assert 0 < speeds["opening"] < 175
        assert 0 < speeds["closing"] < 175

        shown = CliRunner().invoke(calibrate_command, ["--show", "--config", str(path)])
        assert str(zero) in shown.output

        # and it serves from then on, without moving at the start
        with gripper_on(gripper.path, configured(tmp_path, zero=None, config=path)) as hand:
            assert hand.record.zero == zero
            ((opening, closing),) = hand.joint_speeds
            assert opening == pytest.approx(min(speeds["opening"], 150) * 0.054)
            assert closing == pytest.approx(min(speeds["closing"], 150) * 0.054)
            assert float(exchange(hand, BRAKE).q[0]) >= -0.05


@pytest.mark.usefixtures("_patient_servo")
def test_calibration_follows_usb_serial_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def plug_in(path: str) -> None:
        ports = [
            SimpleNamespace(device="/dev/ttyS0", serial_number=None),
            SimpleNamespace(device=path, serial_number="DA1Z9T40"),
        ]
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)

    configuration = configured(tmp_path, zero=None, calibrate=Calibrate.AUTO)
    with emulated(start=20.0) as gripper:
        plug_in(gripper.path)
        with gripper_on("DA1Z9T40", configuration) as hand:
            assert hand.key == "DA1Z9T40"
            zero = hand.record.zero
    content = json.loads((tmp_path / "ezgripper.json").read_text())
    assert content == {"calibration": {"DA1Z9T40": zero}}
    # another port, opened by its path, and nothing moves
    with emulated(start=70.0) as gripper:
        plug_in(gripper.path)
        before = travel(gripper)
        configuration = replace(configuration, calibrate=Calibrate.NO)
        with gripper_on(gripper.path, configuration) as hand:
            assert hand.record.zero == zero
            assert travel(gripper) == before
    with pytest.raises(HandNotFound, match="DA1Z9T41") as missing:
        find_device("DA1Z9T41")
    assert "DA1Z9T40" in missing.value.hint


@pytest.mark.usefixtures("_patient_servo")
def test_calibration_refuses_an_object_between_the_fingers(tmp_path: Path) -> None:
    with emulated(start=90.0, object_pct=50.0) as gripper:
        hand = EZGripper(
            gripper.path, configuration=configured(tmp_path, zero=None, calibrate=Calibrate.AUTO)
        )
        with pytest.raises(CalibrationFailed, match="of its stroke"):
            hand.open()
        assert not gripper.servo.torque


@pytest.mark.usefixtures("_patient_servo")
def test_lost_link_does_not_repeat_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    original = calibration.find_zero

    def counted(*args: object, **kwargs: object) -> int:
        calls.append(1)
        return original(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(calibration, "find_zero", counted)
    with emulated(start=20.0) as gripper:
        configuration = configured(tmp_path, zero=None, calibrate=Calibrate.YES)
        with gripper_on(gripper.path, configuration) as hand:
            before = exchange(hand, BRAKE)
            hand.close()  # as the service does with a link that it has lost
            hand.open()
            again = exchange(hand, BRAKE)
            assert float(again.q[0]) == pytest.approx(float(before.q[0]), abs=0.05)
        assert len(calls) == 1

    # nor does it try again where an object was in the way
    with emulated(start=90.0, object_pct=50.0) as gripper:
        hand = EZGripper(gripper.path, configuration=configuration)
        with pytest.raises(CalibrationFailed):
            hand.open()
        left = travel(gripper)
        with pytest.raises(HandRefused, match="not repeated"):
            hand.open()
        # what was squeezed at the end of the attempt gives a little
        assert travel(gripper) == pytest.approx(left, abs=40)
        assert not gripper.servo.torque
    assert len(calls) == 2


def test_interrupted_calibration_switches_torque_off(tmp_path: Path) -> None:
    with emulated(start=90.0) as gripper:
        hand = EZGripper(gripper.path, configuration=configured(tmp_path))
        servo = hand.connect()
        calls = iter([False] * 50)
        with pytest.raises(CalibrationFailed, match="interrupted"):
            calibration.find_zero(servo, cancelled=lambda: next(calls, True))
        assert gripper.servo.get(mx64.GOAL_CURRENT) == 0
        hand.close()


def test_calibration_is_not_misled_by_a_pause_of_the_machine(tmp_path: Path) -> None:
    """A servo that its bus watchdog has stopped stands still, but not at an end of the stroke."""
    with emulated(start=90.0) as gripper:
        hand = EZGripper(gripper.path, configuration=configured(tmp_path))
        servo = hand.connect()
        calls = iter(range(10**6))

        def paused() -> bool:
            if next(calls) == 20:
                wait_until(lambda: gripper.servo.get(mx64.BUS_WATCHDOG) == mx64.WATCHDOG_TRIPPED)
            return False

        with pytest.raises(CalibrationFailed, match="bus watchdog stopped it"):
            calibration.find_zero(servo, cancelled=paused)
        assert gripper.servo.get(mx64.GOAL_CURRENT) == 0
        hand.close()


@pytest.mark.usefixtures("_patient_servo")
def test_the_force_table_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dexkit.cli.calibrate._FORCE_EFFORTS", (10.0, 40.0))
    path = tmp_path / "ezgripper.json"
    with emulated(start=80.0, object_pct=50.0) as gripper:
        key = os.path.abspath(gripper.path)
        path.write_text(json.dumps({"calibration": {key: ZERO}}))
        result = CliRunner().invoke(
            calibrate_command,
            [
                *("--device", gripper.path, "--config", str(path)),
                *("--measure", "force", "--effort", "30", "--yes"),
            ],
            input="2\n6\n",
        )
        assert result.exit_code == 0, (result.output, result.exception)
        table = json.loads(path.read_text())["force_lookup"][key]
        currents = [float(k) for k in table]
        assert sorted(table.values()) == [0, 2, 6]
        for current, effort in zip(sorted(currents)[1:], (10, 30), strict=True):
            assert current == pytest.approx(effort * 16, rel=0.1)


@pytest.mark.usefixtures("_patient_servo")
def test_the_baud_rate_is_changed(tmp_path: Path) -> None:
    with emulated(baudrate=57_600, start=10.0) as gripper:
        hand = EZGripper(
            gripper.path, configuration=configured(tmp_path, baudrate=57_600, zero=None)
        )
        result = CliRunner().invoke(
            calibrate_command,
            [
                *("--device", gripper.path, "--config", str(tmp_path / "c.json"), "--yes"),
                *("--baudrate", "auto", "--set-baudrate", "1000000"),
            ],
        )
        assert result.exit_code == 0, (result.output, result.exception)
        assert gripper.servo.get(mx64.BAUD_RATE) == 3
        assert hand.spec.io_rate < 100
