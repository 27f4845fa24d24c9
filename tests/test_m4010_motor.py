"""The emulated M4010 in virtual time, and its command."""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import time
from pathlib import Path

import pytest
import serial
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dexkit.cli.emulate import command
from dexkit.emulators.dex1_mechanics import Dex1Mechanics
from dexkit.emulators.faults import M4010_FAULTS, parse_fault
from dexkit.emulators.m4010 import Bus, Dex1Motors, Dex1Process, Firmware, Motor
from dexkit.emulators.m4010.motor import LOCKING
from dexkit.errors import DexkitError, EmulatorError, UsageError
from dexkit.hand import MotorError, Side
from dexkit.wire import m4010
from dexkit.wire.m4010 import (
    DATA,
    Calibration,
    FrameParser,
    MotorCmd,
    MotorData,
    Status,
    calibration_outcome,
)
from tests.dds_helpers import wait_until
from tests.each import each

ZEROS = MotorCmd.setpoint(0)


class Host:
    """The other end of a line, in virtual time."""

    def __init__(self, *motors: Motor, faults: tuple[str, ...] = (), **options: object) -> None:
        plan = [parse_fault(spec, M4010_FAULTS) for spec in faults]
        self.bus = Bus(motors or (Motor(0),), faults=plan, **options)  # type: ignore[arg-type]
        self.now = 0.0
        self.parser = FrameParser()

    def send(self, data: bytes, wait: float = 0.002) -> bytes:
        """Send, wait, and return what came."""
        self.bus.advance_to(self.now)
        if not self.bus.unplugged:
            self.bus.receive(data, self.now)
        return self.listen(wait)

    def listen(self, wait: float) -> bytes:
        end, out = self.now + wait, b""
        while (following := self.bus.next_time) is not None and following <= end:
            self.now = max(self.now, following)
            self.bus.advance_to(self.now)
            out += self.bus.due(self.now)
        self.now = end
        self.bus.advance_to(end)
        return out + self.bus.due(end)

    def ask(self, command: MotorCmd | Calibration) -> MotorData | None:
        found = self.parser.feed(self.send(command.pack()))
        return found[-1] if found else None  # type: ignore[return-value]

    def drive(self, seconds: float, number: int = 0, **setpoint: float) -> MotorData:
        """Send a setpoint at 500 Hz, with protection."""
        data = None
        for _ in range(round(seconds * 500)):
            data = self.ask(MotorCmd.setpoint(number, timeout=True, **setpoint))
        assert data is not None
        return data


def motor(
    number: int = 0, *, start: float = 20.0, touch: float | None = None, **options: object
) -> Motor:
    mechanics = Dex1Mechanics(start_pct=start, object_pct=touch, locking=LOCKING)
    return Motor(number, mechanics=mechanics, **options)  # type: ignore[arg-type]


# --- commands


def test_motor_answers_any_probe_with_its_measurements() -> None:
    """The vendor's probe has undefined fields but for id and mode
    (docs/sources/unitree-dex.md#g).
    """
    host = Host(motor())
    data = host.ask(MotorCmd(0, Status.FOC, res=0x5A))
    assert data is not None
    assert (data.id, data.status, data.timeout, data.merror) == (0, Status.FOC, False, 0)
    assert data.joint().q == pytest.approx(1.08, abs=1e-3)
    assert (data.temp, data.winding, data.voltage) == (25, 25, 24.0)


def test_motor_reaches_its_goal_and_reports_its_motion() -> None:
    host = Host(motor())
    seen = [host.drive(0.02, q=5.4, kp=5.0, kd=0.05) for _ in range(60)]
    assert seen[-1].joint().q == pytest.approx(5.4, abs=0.05)
    assert max(data.joint().dq for data in seen) > 5.0
    assert seen[0].status == Status.FOC


def test_zero_gains_make_no_torque() -> None:
    host = Host(motor())
    assert host.drive(0.3, q=5.0).joint().q == pytest.approx(1.08, abs=1e-3)


def test_gains_below_one_count_are_zero() -> None:
    """kd 0.0487 is 0 on the wire (docs/sources/unitree-dex.md#g): the resolution is part of the
    product.
    """
    assert MotorCmd.setpoint(0, kd=0.0487).k_spd == 0
    assert MotorCmd.setpoint(0, kd=0.05).k_spd == 1


def test_feed_forward_torque_opens_and_closes() -> None:
    host = Host(motor(start=50.0))
    assert host.drive(0.1, tau=0.3).joint().q > 2.8
    assert host.drive(0.3, tau=-0.3).joint().q < 2.6


def test_a_held_object_stays_held_when_the_motor_brakes() -> None:
    host = Host(motor(start=60.0, touch=40.0))
    pressed = host.drive(1.0, q=1.98, kp=5.0, kd=0.05)
    assert -0.95 < pressed.joint().tau < -0.5  # less the deeper its swing took it
    assert pressed.joint().q < 2.16
    for _ in range(100):
        held = host.ask(MotorCmd(0))
    assert held is not None
    assert held.status == Status.BRAKE
    assert held.joint().tau == 0.0
    assert held.joint().q == pytest.approx(pressed.joint().q, abs=1e-3)
    assert host.bus.motors[0].mechanics.joint.contact > 0.3  # self-locking


def test_brake_stops_the_motor_at_once() -> None:
    host = Host(motor())
    host.drive(0.1, q=5.4, kp=5.0, kd=0.05)
    first = host.ask(MotorCmd(0))
    host.listen(0.1)
    last = host.ask(MotorCmd(0))
    assert first is not None
    assert last is not None
    assert first.joint().dq > 4
    assert last.joint().dq == 0.0
    assert last.joint().q - first.joint().q < 0.05


def test_a_broadcast_is_obeyed_and_not_answered() -> None:
    left, right = motor(1), motor(0)
    host = Host(left, right)
    assert host.send(MotorCmd.setpoint(m4010.BROADCAST_ID, q=5.0, kp=5.0, kd=0.05).pack()) == b""
    host.listen(0.2)
    assert left.q > 1.3
    assert right.q > 1.3
    assert host.bus.counters.broadcasts == 1


def test_two_motors_on_a_line_answer_for_themselves() -> None:
    host = Host(motor(1, start=80.0), motor(0, start=10.0))
    both = MotorCmd(1).pack() + MotorCmd(0).pack()
    answers = host.parser.feed(host.send(both))
    assert [data.id for data in answers] == [1, 0]
    assert [round(data.joint().q, 2) for data in answers] == [4.32, 0.54]
    assert host.ask(MotorCmd(2)) is None
    assert host.bus.counters.unknown_ids == 1
    with pytest.raises(UsageError, match="different ids"):
        Bus([Motor(0), Motor(0)])
    with pytest.raises(UsageError, match="0 to 14"):
        Motor(15)


def test_other_status_brakes_or_is_ignored() -> None:
    for brakes, status in ((True, Status.BRAKE), (False, Status.FOC)):
        host = Host(motor(firmware=Firmware(other_status_brakes=brakes)))
        host.drive(0.02, q=1.1, kp=5.0)
        data = host.ask(MotorCmd(0, 3))
        assert data is not None
        assert data.status == status


# --- the protection


@pytest.mark.parametrize("brakes", [True, False])
def test_the_protection_trips_after_a_second_and_waits_for_a_clear_bit(brakes: bool) -> None:
    one = motor(firmware=Firmware(tripped_brakes=brakes))
    host = Host(one)
    host.drive(0.05, q=5.4, kp=5.0, kd=0.05)
    host.listen(0.9)
    assert not one.tripped
    assert one.q > 5.2  # it keeps the last command meanwhile
    host.listen(0.2)
    assert one.tripped
    still = host.ask(MotorCmd.setpoint(0, q=0.0, kp=5.0, kd=0.05, timeout=True))
    assert still is not None
    assert still.timeout
    assert still.merror & MotorError.MOTOR_SAW_HOST_TIMEOUT
    assert still.status == (Status.BRAKE if brakes else Status.FOC)
    host.listen(0.3)
    assert one.q > 5.2
    assert one.trips == 1
    assert one.ignored == 1
    data = host.ask(MotorCmd(0))
    assert data is not None
    assert not data.timeout
    assert data.merror == 0
    assert host.drive(1.0, q=1.0, kp=5.0, kd=0.05).joint().q == pytest.approx(1.0, abs=0.05)


def test_motor_without_the_protection_bit_keeps_its_command() -> None:
    """What the vendor's service asks for while it drives (docs/sources/unitree-dex.md#b2)."""
    one = motor()
    host = Host(one)
    host.ask(MotorCmd.setpoint(0, q=5.4, kp=5.0, kd=0.05))
    host.listen(3.0)
    assert not one.tripped
    assert one.q > 5.3


# --- calibration


def test_calibration_makes_here_the_zero_once() -> None:
    one = motor(start=0.0, zero_error=2.0)
    host = Host(one)
    before = host.ask(ZEROS)
    assert before is not None
    assert before.joint().q == pytest.approx(2.0, abs=1e-3)
    answer = host.ask(Calibration(0, time=1))
    assert answer is not None
    assert (answer.status, answer.torque, answer.speed) == (6, -1024, 2)
    assert calibration_outcome(answer) == ""
    after = host.ask(ZEROS)
    assert after is not None
    assert after.joint().q == pytest.approx(0.0, abs=1e-3)
    assert host.drive(1.5, q=2.0, kp=5.0, kd=0.05).joint().q == pytest.approx(2.0, abs=0.05)
    again = host.ask(Calibration(0, time=1))
    assert again is not None
    assert "before since power-up" in calibration_outcome(again)


@each(
    ("calibration", "firmware", "faults", "says"),
    [
        (Calibration(0, range=0.0, time=1), Firmware(), (), "range"),
        (Calibration(0, position=6.0, time=1), Firmware(), (), "position"),
        (Calibration(0, time=0), Firmware(), (), "time is 0"),
        (Calibration(0, time=1, user_id=0), Firmware(), (), "user id"),
        (Calibration(0, time=1), Firmware(flash_works=False), (), "flash"),
        (Calibration(0, time=1), Firmware(calibration_enabled=False), (), "not enabled"),
        (Calibration(0, time=1), Firmware(), ("encoder",), "encoder"),
    ],
)
def test_calibration_that_fails_says_why_and_changes_nothing(
    calibration: Calibration, firmware: Firmware, faults: tuple[str, ...], says: str
) -> None:
    one = motor(zero_error=1.0, firmware=firmware)
    answer = Host(one, faults=faults).ask(calibration)
    assert answer is not None
    assert says in calibration_outcome(answer)
    assert one.zero_error == 1.0


# --- the line


def test_an_exchange_takes_the_wires_time() -> None:
    host = Host(motor(firmware=Firmware(answer_time=100e-6)))
    wire = (20 + 26) * 10 / 6e6 + 100e-6
    assert host.send(ZEROS.pack(), wire - 1e-6) == b""
    assert len(host.listen(2e-6)) == 26


def test_a_client_at_another_rate_is_not_understood() -> None:
    host = Host(motor())
    host.bus.host_baudrate = m4010.OPENING_BAUD_RATE
    assert host.ask(ZEROS) is None
    assert host.bus.counters.garbled == 20
    host.bus.host_baudrate = m4010.BAUD_RATE
    assert host.ask(ZEROS) is not None


def test_partial_frame_is_dropped_after_a_gap() -> None:
    host = Host(motor())
    frame = ZEROS.pack()
    host.send(frame[:11], 0.001)
    assert len(host.send(frame[11:])) == 26
    host.send(frame[:11], 0.01)
    assert host.send(frame[11:]) == b""
    assert len(host.send(frame)) == 26


def test_damaged_command_is_not_answered() -> None:
    host = Host(motor())
    frame = bytearray(ZEROS.pack())
    frame[9] ^= 4
    assert host.send(bytes(frame)) == b""
    assert host.bus.counters.crc_errors == 1


@given(st.lists(st.binary(max_size=40), max_size=6))
def test_a_command_after_anything_is_answered(pieces: list[bytes]) -> None:
    host = Host(motor())
    for piece in pieces:
        host.send(piece, 0.0005)
    host.listen(0.01)
    assert host.ask(MotorCmd(0)) is not None


@given(
    st.floats(-1e4, 1e4),
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 1e3),
    st.floats(0, 1e4),
    st.floats(0, 1e4),
)
def test_motor_stays_finite_and_within_its_stops_under_any_command(
    q: float, dq: float, tau: float, kp: float, kd: float
) -> None:
    host = Host(motor())
    host.ask(MotorCmd.setpoint(0, q=q, dq=dq, tau=tau, kp=kp, kd=kd))
    host.listen(0.2)
    data = host.ask(ZEROS)
    assert data is not None
    assert -0.5 < data.joint().q < 6.2


# --- faults


@each(
    ("spec", "first"),
    [
        ("short", lambda data, frame: data == frame[:20]),
        ("stray:before=1", lambda data, frame: data[1:] == frame),
        ("stray:before=0,after=2", lambda data, frame: data[:-2] == frame and len(data) == 28),
        ("corrupt", lambda data, frame: len(data) == 26 and data != frame),
        ("drop", lambda data, frame: data == b""),
        ("silent", lambda data, frame: data == b""),
        ("delay:ms=25", lambda data, frame: data == b""),
        ("pause:ms=30,bytes=13", lambda data, frame: data == frame[:13]),
    ],
)
def test_each_fault_alters_the_answer_as_specified(spec: str, first: object) -> None:
    """Those that put the vendor's library out of step are among them
    (docs/sources/unitree-dex.md#g).
    """
    host = Host(
        motor(), faults=(f"{spec}@10ms" if ":" not in spec else spec.replace(":", "@10ms:"),)
    )
    frame = host.send(ZEROS.pack())
    assert len(frame) == 26
    host.listen(0.01)
    got = host.send(ZEROS.pack())
    assert first(got, frame)  # type: ignore[operator]
    rest = host.listen(0.05)
    if spec.startswith("pause"):
        assert got + rest == frame
    if spec.startswith("delay"):
        assert rest == frame


@each(
    ("spec", "bit"),
    [
        ("overcurrent:for=20ms", MotorError.OVERCURRENT),
        ("encoder:for=20ms", MotorError.OUTPUT_ENCODER),
        ("brown-out:for=20ms", MotorError.UNDERVOLTAGE),
        ("overheat:for=20ms", MotorError.WINDING_OVERTEMPERATURE),
    ],
)
def test_error_brakes_the_motor_until_it_ends(spec: str, bit: MotorError) -> None:
    host = Host(motor(), faults=(spec.replace(":", "@10ms:"),))
    assert host.drive(0.008, q=1.1, kp=5.0).merror == 0
    data = host.drive(0.01, q=5.0, kp=5.0)
    assert data.merror == bit
    assert data.status == Status.BRAKE
    if bit is MotorError.UNDERVOLTAGE:
        assert data.voltage == 10.0
    host.listen(30.0 if bit is MotorError.WINDING_OVERTEMPERATURE else 0.05)
    host.ask(MotorCmd(0))
    assert host.drive(0.02, q=1.1, kp=5.0).merror == 0


def test_fault_applies_to_the_motor_with_its_id() -> None:
    left, right = motor(1), motor(0)
    host = Host(left, right, faults=("overcurrent:id=1", "stuck:id=0"))
    host.listen(0.001)
    assert left.error == MotorError.OVERCURRENT
    assert right.error == 0
    host.drive(0.3, q=5.0, kp=5.0)
    assert right.q == pytest.approx(1.08)


def test_holding_with_force_heats_the_motor() -> None:
    one = motor(start=60.0, touch=40.0)
    host = Host(one)
    host.drive(0.5, q=0.5, kp=5.0)
    host.ask(MotorCmd.setpoint(0, q=0.0, kp=5.0))
    host.listen(8.0)
    assert one.winding > one.case > 25.5


def test_unplugging_loses_bytes_in_transit_but_not_the_motor_state() -> None:
    one = motor()
    host = Host(one, faults=("unplug@10ms:for=20ms",))
    host.ask(MotorCmd.setpoint(0, q=5.4, kp=5.0, kd=0.05))
    host.listen(0.01)
    assert host.bus.unplugged
    assert host.send(ZEROS.pack()) == b""
    host.listen(0.3)
    assert not host.bus.unplugged
    assert one.q > 2.0  # it went on


@each(
    ("spec", "says"),
    [("stall", "no kind 'stall'"), ("silent:id=2", "not an id"), ("drop:side=left", "no key")],
)
def test_faults_of_other_devices_are_refused(spec: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        parse_fault(spec, M4010_FAULTS)


# --- the command


def exchange(port: serial.Serial, command: MotorCmd, timeout: float = 60.0) -> MotorData | None:
    parser = FrameParser((DATA,))
    port.write(command.pack())
    end = time.monotonic() + timeout
    while (left := end - time.monotonic()) > 0:
        if select.select([port.fileno()], [], [], left)[0]:
            found = parser.feed(os.read(port.fileno(), 4096))
            if found:
                assert isinstance(found[0], MotorData)
                return found[0]
    return None


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_both_on_one_line_answer_and_leave_nothing(tmp_path: Path, signum: signal.Signals) -> None:
    link = tmp_path / "tty"
    motors = Dex1Process(["--side", "both"], link)
    try:
        assert re.fullmatch(
            rf"ready: {link} left,right id=1,0 baudrate=6000000 pty=/dev/pts/\d+", motors.ready_line
        )
        with serial.Serial(str(link), m4010.BAUD_RATE, timeout=0) as port:
            for number in (0, 1):
                data = exchange(port, MotorCmd(number))
                assert data is not None
                assert data.id == number
        motors.process.send_signal(signum)
        assert motors.process.wait(60) == 0
        output, errors = motors.process.communicate()
    finally:
        motors.close()
    assert b"2 commands" in output
    assert errors == b""
    assert not link.is_symlink()


def test_motor_answers_only_at_its_baud_rate(tmp_path: Path) -> None:
    """The vendor's service opens the port at another rate, too, and then changes it."""
    with Dex1Motors((Side.LEFT,), links={Side.LEFT: tmp_path / "l"}) as motors:
        counters = motors.bus(Side.LEFT).counters
        with serial.Serial(motors.path, m4010.OPENING_BAUD_RATE, timeout=0) as port:
            assert exchange(port, ZEROS, 0.01) is None
            wait_until(lambda: counters.garbled == 20)
            port.baudrate = m4010.BAUD_RATE
            assert exchange(port, MotorCmd(1)) is not None
        assert counters.garbled == 20


def test_each_motor_can_have_its_own_line(tmp_path: Path) -> None:
    links = {Side.LEFT: tmp_path / "l", Side.RIGHT: tmp_path / "r"}
    with Dex1Motors(tuple(Side), links=links) as motors:
        assert len(motors.ready_lines) == 2
        for side, link in links.items():
            with serial.Serial(str(link), m4010.BAUD_RATE, timeout=0) as port:
                mine, other = (1, 0) if side is Side.LEFT else (0, 1)
                assert exchange(port, MotorCmd(mine)) is not None
                assert exchange(port, MotorCmd(other), 0.05) is None
    assert list(tmp_path.iterdir()) == []


def test_faults_are_read_from_input_until_its_end(tmp_path: Path) -> None:
    with contextlib.closing(Dex1Process(["--side=left"])) as motors:
        with serial.Serial(motors.path, m4010.BAUD_RATE, timeout=0) as port:
            assert exchange(port, MotorCmd(1)) is not None
            motors.inject("silent")
            end = time.monotonic() + 60
            while exchange(port, MotorCmd(1), 0.05) is not None:
                assert time.monotonic() < end
        assert motors.process.stdin is not None
        motors.process.stdin.close()
        assert motors.process.wait(60) == 0


@each(
    ("arguments", "says"),
    [
        (["--link", "left=a", "--link", "left=b"], "is not left=PATH"),
        (["--side", "both", "--link", "left=a"], "for each side"),
        (["--side", "left", "--link", "right=a"], "is not left=PATH"),
        (["--link", "{dir}/t", "--fault", "melt"], "no kind 'melt'"),
        (["--link", "{dir}/none/t"], "cannot make the link"),
        ([], "Missing option"),
    ],
)
def test_wrong_options_of_dex1_motor_are_refused(
    tmp_path: Path, arguments: list[str], says: str
) -> None:
    result = CliRunner().invoke(
        command, ["dex1-motor", *(a.format(dir=tmp_path) for a in arguments)]
    )
    assert says in f"{result.output}{result.exception}"
    assert isinstance(result.exception, (DexkitError, SystemExit))
    assert getattr(result.exception, "exit_code", result.exit_code) == 2
    assert list(tmp_path.iterdir()) == []


def test_invalid_settings_are_refused() -> None:
    for wrong in (
        lambda: Firmware(command_timeout=0.0),
        lambda: Firmware(baudrate=0),
        lambda: Dex1Mechanics(start_pct=101.0),
        lambda: Dex1Mechanics(object_pct=0.0),
        lambda: Dex1Mechanics(locking=-1.0),
        lambda: Bus([]),
        lambda: Bus([Motor(0)], latency_timer=-1.0),
    ):
        with pytest.raises(UsageError):
            wrong()
    with pytest.raises(EmulatorError):
        Dex1Process(["--side=up"])


def test_a_link_left_by_a_killed_emulator_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the next emulator mostly gets the same terminal again: the link names its own
    ours, other = os.openpty(), os.openpty()
    link = tmp_path / "tty"
    link.symlink_to(os.ttyname(ours[1]))
    monkeypatch.setattr(os, "openpty", lambda: ours)
    with Dex1Motors(links={Side.LEFT: link}) as motors:
        assert motors.path == str(link)
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(other[1]))
    monkeypatch.undo()
    with pytest.raises(EmulatorError, match="which exists"), Dex1Motors(links={Side.LEFT: link}):
        pass
    for fd in other:
        os.close(fd)
