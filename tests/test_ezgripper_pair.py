"""The quad EZGripper: two servos on one line, driven as one joint."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.backends import BackendOptions
from dexkit.backends import backend as find_backend
from dexkit.cli.calibrate import command as calibrate_command
from dexkit.clock import RealClock
from dexkit.drivers.ezgripper import Calibrate, EZGripper, GripperSettings
from dexkit.drivers.ezgripper.calibration_file import GripperRecord, Store, record_key
from dexkit.drivers.ezgripper.control import ControlSettings
from dexkit.drivers.ezgripper.scaling import current_of_effort
from dexkit.drivers.ezgripper.servo import exchange_bytes
from dexkit.emulators.mx64 import (
    Bus,
    EmulatedThread,
    GripperMechanics,
    Physics,
    Port,
    Servo,
)
from dexkit.errors import HandNotFound, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandState, JointMode, MotorError, Side
from dexkit.wire import mx64
from tests.each import each
from tests.ezgripper_helpers import (
    BRAKE,
    CLOSE,
    HALF,
    LONG,
    OPEN,
    QUICK,
    at,
    drive,
    drive_for,
    exchange,
    fault_of,
    gripper_on,
    until_recovered,
)

ZEROS = {1: 1510, 2: 2900}


@contextmanager
def pair(*changes: dict[str, object], ids: tuple[int, ...] = (1, 2)) -> Iterator[EmulatedThread]:
    """Two servos with fingers of their own; ``changes`` of each one's mechanics."""
    now = RealClock().now()
    servos = []
    for index, number in enumerate(ids):
        options = {"closed_at": ZEROS[number], **(changes[index] if changes else {})}
        mechanics = GripperMechanics(**options)  # type: ignore[arg-type]
        physics = dataclasses.replace(Physics(), gripper=mechanics)
        servos.append(Servo(number, physics=physics, baudrate=1_000_000, now=now))
    bus = Bus(servos, start=now)
    gripper = EmulatedThread(bus, Port(bus))
    try:
        yield gripper
    finally:
        gripper.close()


def configured(tmp: Path, path: str, **changes: object) -> GripperSettings:
    """Settings of the pair on a port, with both zeros stored."""
    store = Store(tmp / "ezgripper.json")
    for number, zero in ZEROS.items():
        store.write(record_key(path, number), GripperRecord(zero=zero))
    values: dict[str, object] = {
        "ids": (1, 2),
        "config": store.path,
        "control": QUICK,
        "timeout": 1.0,
        **changes,
    }
    return GripperSettings(**values)  # type: ignore[arg-type]


@contextmanager
def opened(
    tmp: Path, *mechanics: dict[str, object], **changes: object
) -> Iterator[tuple[EmulatedThread, EZGripper]]:
    with (
        pair(*mechanics) as gripper,
        gripper_on(gripper.path, configured(tmp, gripper.path, **changes)) as hand,
    ):
        yield gripper, hand


def opening(servo: Servo) -> float:
    """Rad of the joint, by one servo's fingers."""
    return servo.drive.opening * 5.4 / 100


def wait(condition: object) -> None:
    deadline = time.monotonic() + LONG
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.002)


def off(gripper: EmulatedThread) -> bool:
    return not any(servo.torque for servo in gripper.servos)


def test_both_servos_follow_as_one_joint(tmp_path: Path) -> None:
    with opened(tmp_path) as (gripper, hand):
        assert off(gripper), "opening drives nothing"
        for command, q in ((OPEN, 5.4), (HALF, 2.7), (CLOSE, 0.0), (OPEN, 5.4)):
            state = drive(hand, command, at(q))
            assert [opening(s) for s in gripper.servos] == pytest.approx([q, q], abs=0.1)
        assert state.mode[0] == JointMode.FOC
        assert state.fault[0] == 0
        sent, received = exchange_bytes(2)
        before = gripper.bus.counters.bytes_in
        count = hand.servo_statistics.exchanges
        exchange(hand, BRAKE)
        if hand.servo_statistics.exchanges == count + 1 and not hand.bus_statistics.retries:
            assert gripper.bus.counters.bytes_in - before == sent
        assert received == 2 * 35
        assert sum(len(unit.servo.bus.path) for unit in hand.units)
    assert off(gripper)


def test_position_is_the_mean_and_force_the_sum(tmp_path: Path) -> None:
    """An object between one pair of fingers only."""
    control = ControlSettings(startup_speed=150.0, hold_after=60.0)
    with opened(tmp_path, {}, {"object_pct": 50.0}, control=control) as (gripper, hand):
        drive(hand, OPEN, at(5.4))
        state = drive(hand, CLOSE, lambda s: s.tau_est[0] < 0 and abs(s.dq[0]) < 0.02)
        one, two = (opening(servo) for servo in gripper.servos)
        assert one == pytest.approx(0.0, abs=0.2)
        assert two == pytest.approx(2.7, abs=0.4)
        assert state.q[0] == pytest.approx((one + two) / 2, abs=0.05)
        limit = current_of_effort(control.effort)
        assert [s.get(mx64.GOAL_CURRENT) for s in gripper.servos] == [limit, limit]
    with opened(tmp_path, {"object_pct": 50.0}, {"object_pct": 50.0}, control=control) as (
        gripper,
        hand,
    ):
        drive(hand, OPEN, at(5.4))

        def pressed(s: HandState) -> bool:
            return abs(float(s.dq[0])) < 0.02 and float(s.tau_est[0]) < 1.5 * float(
                state.tau_est[0]
            )

        drive(hand, CLOSE, pressed)


def test_a_missing_servo_is_named_and_nothing_driven(tmp_path: Path) -> None:
    with pair(ids=(1,)) as gripper:
        hand = EZGripper(
            gripper.path, Side.LEFT, configured(tmp_path, gripper.path, timeout=0.5, retries=0)
        )
        with pytest.raises(HandNotFound, match="id 2") as missing:
            hand.open()
        assert "id 1" in missing.value.hint
        assert off(gripper)


def test_a_servo_that_is_unplugged_in_motion_stops_the_other(tmp_path: Path) -> None:
    with opened(tmp_path) as (gripper, hand):
        drive(hand, OPEN, at(5.4))
        drive(hand, CLOSE, lambda s: float(s.dq[0]) < -1.0)
        gripper.inject("brown-out:volts=0,id=2")
        with pytest.raises(HandTimeout, match=r"servo 2 .*does not answer"):
            drive(hand, CLOSE, lambda s: False)
        wait(lambda: not gripper.servos[0].torque)
        wait(lambda: gripper.servos[0].drive.velocity == 0.0)
        stopped = opening(gripper.servos[0])
        assert stopped > 0.3, "stopped on its way"
        fault = fault_of(hand, CLOSE)
        assert fault.bits == (MotorError.HOST_SAW_MOTOR_TIMEOUT,)
        # the supply returns, and the servo boots
        gripper.inject("brown-out:volts=12,id=2")
        until_recovered(hand, CLOSE)
        drive_for(hand, CLOSE, 0.15)
        assert off(gripper), "no command has asked for torque since"
        assert opening(gripper.servos[0]) == pytest.approx(stopped, abs=0.1)
        drive(hand, OPEN, at(5.4))


@each("kind, bit", [("overheat:c=85", 0x200), ("overload", 0x1)])
def test_a_fault_of_either_is_one_of_the_gripper(kind: str, bit: int, tmp_path: Path) -> None:
    for number in (1, 2):
        with opened(tmp_path) as (gripper, hand):
            drive(hand, HALF, at(2.7))
            separator = "," if ":" in kind else ":"
            gripper.inject(f"{kind}{separator}id={number}")
            fault = fault_of(hand, HALF)
            assert fault.bits == (MotorError(bit),)
            assert f"servo {number}" in fault.message
            wait(lambda: off(gripper))
            if bit != MotorError.OVERCURRENT:
                continue
            until_recovered(hand, HALF)
            assert hand.statistics.reboots == 1
            assert exchange(hand, HALF).fault[0] == 0
            assert off(gripper)
            # after an overload of either, both push with the hold effort until it is opened
            drive(hand, CLOSE, at(0.0))
            low = current_of_effort(QUICK.hold_effort)
            assert [s.get(mx64.GOAL_CURRENT) for s in gripper.servos] == [low, low]


def test_a_warm_servo_reduces_the_effort_of_both(tmp_path: Path) -> None:
    with opened(tmp_path) as (gripper, hand):
        drive(hand, HALF, at(2.7))
        gripper.inject("overheat:c=72,id=1")
        low = current_of_effort(QUICK.hold_effort)
        drive(hand, HALF, lambda s: all(v.get(mx64.GOAL_CURRENT) == low for v in gripper.servos))
        assert exchange(hand, HALF).temperature[0] >= 71


def test_exchanged_ids_are_refused(tmp_path: Path) -> None:
    with opened(tmp_path) as (_, hand):  # their order means nothing
        q = exchange(hand, BRAKE).q[0]
        hand.close()
        hand.configuration = dataclasses.replace(hand.configuration, ids=(2, 1))
        hand.open()
        assert exchange(hand, BRAKE).q[0] == pytest.approx(q, abs=0.02)
    exchanged: list[dict[str, object]] = [
        {"closed_at": ZEROS[number], "start": 80.0} for number in (2, 1)
    ]
    with pair(*exchanged) as gripper:
        hand = EZGripper(gripper.path, Side.LEFT, configured(tmp_path, gripper.path))
        with pytest.raises(HandRefused, match="not that of this servo"):
            hand.open()
        assert off(gripper)


@pytest.mark.soak  # a pause of the machine ends it, as it must: the servo's bus watchdog
def test_both_servos_of_a_pair_are_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "dexkit.cli.calibrate.GripperSettings", partial(GripperSettings, timeout=0.2)
    )
    config = tmp_path / "config.json"
    arguments = ["--id", "2,1", "--config", str(config), "--yes"]
    with pair() as gripper:
        found = CliRunner().invoke(calibrate_command, ["--device", gripper.path, *arguments])
        assert found.exit_code == 0, found.output
        zeros = json.loads(config.read_text())["calibration"]
        keys = [record_key(gripper.path, number) for number in ZEROS]
        assert [zeros[key] for key in keys] == pytest.approx(list(ZEROS.values()), abs=40)
        assert off(gripper)


def test_a_pair_that_is_not_calibrated_is_refused(tmp_path: Path) -> None:
    arguments = ["--id", "2,1", "--config", str(tmp_path / "config.json"), "--yes"]
    with pair() as gripper:
        for extra in (["--measure", "force"], ["--set-baudrate", "57600"]):
            refused = CliRunner().invoke(
                calibrate_command, ["--device", gripper.path, *arguments, *extra]
            )
            assert refused.exit_code != 0
        settings = configured(tmp_path, gripper.path, config=tmp_path / "other.json")
        before = [bytes(servo._table) for servo in gripper.servos]
        with pytest.raises(HandRefused, match="has not been calibrated"):
            EZGripper(gripper.path, Side.LEFT, settings).open()
        assert [bytes(servo._table) for servo in gripper.servos] == before  # nothing was written


@pytest.mark.soak
def test_both_are_calibrated_at_the_start(tmp_path: Path) -> None:
    with pair() as gripper:
        settings = configured(
            tmp_path, gripper.path, config=tmp_path / "other.json", calibrate=Calibrate.AUTO
        )
        with gripper_on(gripper.path, settings) as hand:
            drive(hand, HALF, at(2.7))
            hand.close()
            hand.open()  # without a motion
            drive(hand, CLOSE, at(0.0))


def test_the_settings_name_two_servos(tmp_path: Path) -> None:
    def made(texts: dict[str, str], device: str | None = "/dev/ttyUSB0") -> EZGripper:
        options = BackendOptions(Side.LEFT, device, texts)
        hand = find_backend("ezgripper").create(options)
        assert isinstance(hand, EZGripper)
        return hand

    assert made({"ids": "1,2"}).configuration.servo_ids == (1, 2)
    slow, fast = made({"ids": "1,2"}).spec, made({"id": "1"}).spec
    assert slow.io_rate <= fast.io_rate
    for wrong in (
        {"ids": "1,1"},
        {"ids": "1,2,3"},
        {"ids": "1,300"},
        {"ids": "1,2", "id": "1"},
        {"ids": "1,2", "zero": "5"},
        {"ids": "x"},
        {"stroke": "10"},
        {"sign": "x"},
    ):
        with pytest.raises(UsageError):
            made(wrong)
    config = tmp_path / "c.json"
    Store(config).write_side(Side.LEFT, "DA1Z9T40", (1, 2))
    named = made({"config": str(config)}, None)
    assert named.device_name == "DA1Z9T40"
    assert named.configuration.servo_ids == (1, 2)
    config.write_text('{"left_serial": "X", "left_ids": ["1"]}')
    with pytest.raises(UsageError, match="left_ids"):
        made({"config": str(config)}, None)
