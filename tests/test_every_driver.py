"""What holds for every driver on its emulated hand: opening, a lost cable, closing, settings.

What a driver does in its own way is in the test of that driver.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dexkit.backends import BackendOptions, backend
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.drivers.ezgripper import EZGripper
from dexkit.drivers.goal_hand import GoalHand
from dexkit.drivers.inspire_ftp_modbus import InspireFtpModbus, InspireFtpModbusSettings
from dexkit.drivers.inspire_modbus import InspireModbus, InspireModbusSettings
from dexkit.drivers.inspire_serial import InspireSerial, InspireSerialSettings
from dexkit.drivers.revo2_serial import Revo2Serial, Revo2Settings
from dexkit.emulators.dex3_mcu import Dex3Hands, emulated_dex3
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.emulators.revo2 import Revo2Hand
from dexkit.emulators.rh56 import Rh56Hand, Rh56TcpHand
from dexkit.errors import HandLost, HandNotFound, HandTimeout, UsageError
from dexkit.hand import Hand, HandCommand, HandState, JointMode, Side
from dexkit.wire import mx64
from tests import ezgripper_helpers
from tests.dds_helpers import wait_until
from tests.each import each
from tests.patience import PATIENCE

PATIENT = 1.0  # s, the longest that most drivers allow; a busy machine answers late


@dataclass
class Emulated:
    """An emulated hand.

    :ivar lets_go: whether it neither drives nor is on its way to a goal.
    :ivar stands: whether nothing moves.
    """

    place: str
    inject: Callable[[str], None]
    lets_go: Callable[[], bool]
    stands: Callable[[], bool]


@contextmanager
def ezgripper() -> Iterator[Emulated]:
    with ezgripper_helpers.emulated() as gripper:
        yield Emulated(
            gripper.path,
            gripper.inject,
            lambda: not gripper.servo.torque,
            lambda: gripper.servo.get(mx64.PRESENT_VELOCITY) == 0,
        )


@contextmanager
def dex1() -> Iterator[Emulated]:
    with Dex1Motors() as motors:
        mechanics = motors.motor.mechanics
        yield Emulated(
            motors.path,
            motors.inject,
            lambda: mechanics.mode is JointMode.BRAKE,
            lambda: mechanics.joint.dq == 0.0,
        )


@contextmanager
def dex3() -> Iterator[Emulated]:
    with emulated_dex3() as hands:
        assert isinstance(hands, Dex3Hands)
        mechanics = hands.device().mechanics
        yield Emulated(
            hands.url,
            hands.inject,
            lambda: mechanics.mode == [JointMode.BRAKE] * 7,
            lambda: not np.any(mechanics.dq),
        )


def served(make: Callable[[], Rh56Hand | Rh56TcpHand | Revo2Hand]) -> Callable[[], object]:
    """A hand with goals in its registers: it holds by a goal where it is."""

    @contextmanager
    def emulated() -> Iterator[Emulated]:
        with make() as hand:
            device = hand.device
            yield Emulated(hand.path, hand.inject, lambda: device.resting, lambda: device.resting)

    return emulated


@dataclass(frozen=True)
class Driver:
    """A driver and what it drives.

    :ivar goal: where its joints go in the test.
    :ivar wrong: settings that it has to refuse.
    """

    name: str
    emulated: Callable[[], object]
    make: Callable[[str, Path], Hand]
    goal: tuple[float, ...]
    wrong: tuple[dict[str, str], ...]
    place: str = "/dev/x"


def request_line(kind: type[GoalHand], settings: type) -> Callable[[str, Path], Hand]:
    return lambda place, _: kind(Side.RIGHT, settings(place, timeout=PATIENT))  # type: ignore[call-arg,arg-type]


DRIVERS = [
    Driver(
        "ezgripper",
        ezgripper,
        lambda place, folder: EZGripper(place, Side.LEFT, ezgripper_helpers.configured(folder)),
        (4.0,),
        (
            *({"id": "one"}, {"id": "253"}, {"baudrate": "12345"}, {"calibrate": "maybe"}),
            *({"effort": "101"}, {"effort": "nan"}, {"effort": "0"}, {"speed": "1"}),
            *({"force_table": "/does/not/exist"}, {"force_table": "/dev/null"}),
            *({"retries": "-1"}, {"colour": "red"}),
        ),
    ),
    Driver(
        "dex1-serial",
        dex1,
        lambda place, _: Dex1Serial(Side.LEFT, Dex1Settings(device=place, timeout=PATIENT)),
        (4.0,),
        (
            *({"ports": ""}, {"id": "15"}, {"id": "left"}, {"baudrate": "0"}),
            *({"protect": "yes"}, {"timeout": "0"}, {"speed": "1"}),
        ),
    ),
    Driver(
        "dex3-usb",
        dex3,
        lambda place, _: Dex3Usb(
            Side.LEFT,
            Dex3Settings(server=parse_server(place)[0], timeout=5.0, send_timeout=5.0),
        ),
        (0.3, 0.5, 0.8, -0.6, -0.7, -0.5, -0.9),
        (
            *({"timeout": "0"}, {"timeout": "x"}, {"timeout": "nan"}, {"protect": "yes"}),
            *({"frame": "1000"}, {"head": "f"}, {"head": "fcfdfe"}, {"motors": "0.0"}),
            *({"motors": "0.0,0.0,0.2,1.0,1.1,2.0,2.1"}, {"motors": "0/1"}),
            *({"motors": "0.15,0.1,0.2,1.0,1.1,2.0,2.1"}, {"sensors": "9.0"}),
            *({"sensors": "0.0"}, {"in_endpoint": "0x181"}, {"usb": "tcp://h"}, {"baud": "1"}),
        ),
        place="usbip://127.0.0.1:1",
    ),
    Driver(
        "inspire-serial",
        served(lambda: Rh56Hand(Side.RIGHT, start_pct=0.0)),
        request_line(InspireSerial, InspireSerialSettings),
        (0.5,) * 6,
        ({"id": "0"}, {"speed": "1001"}, {"force": "x"}, {"timeout": "2"}, {"baudrate": "1"}),
    ),
    Driver(
        "inspire-modbus",
        served(lambda: Rh56TcpHand(Side.RIGHT, start_pct=0.0)),
        request_line(InspireModbus, InspireModbusSettings),
        (0.5,) * 6,
        ({"id": "256"}, {"speed": "-1"}, {"timeout": "x"}),
        place="127.0.0.1:1",
    ),
    Driver(
        "inspire-ftp-modbus",
        served(lambda: Rh56TcpHand(Side.RIGHT, start_pct=0.0, tactile=True)),
        request_line(InspireFtpModbus, InspireFtpModbusSettings),
        (0.5,) * 6,
        ({"areas": "18"}, {"areas": "-1"}, {"speed": "0"}, {"id": "256"}),
        place="127.0.0.1:1",
    ),
    Driver(
        "revo2-serial",
        served(lambda: Revo2Hand(Side.RIGHT, start_pct=0.0)),
        request_line(Revo2Serial, Revo2Settings),
        (0.5,) * 6,
        ({"id": "0"}, {"speed": "0"}, {"speed": "nan"}, {"timeout": "2"}, {"baudrate": "1"}),
    ),
]

every_driver = pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
on_a_request_line = pytest.mark.parametrize("driver", DRIVERS[3:], ids=lambda driver: driver.name)


def exchange(hand: Hand, command: HandCommand) -> HandState:
    """Exchange, again where an answer was late."""
    ends = time.monotonic() + PATIENCE
    while True:
        try:
            return hand.exchange(command)
        except HandTimeout:
            assert time.monotonic() < ends


def towards(hand: Hand, goal: tuple[float, ...]) -> HandCommand:
    joints = hand.spec.joints
    gripper = len(joints) == 1
    kp, kd = (5.0, 0.05) if gripper else (1.5, 0.1)
    # only position servos take a speed
    dq = [joint.dq_max for joint in joints] if len(joints) == 6 else 0.0
    return HandCommand.position(goal, dq=dq, kp=kp, kd=kd)


def drive(hand: Hand, command: HandCommand, until: Callable[[HandState], object]) -> HandState:
    ends = time.monotonic() + PATIENCE
    while not until(state := exchange(hand, command)):
        assert time.monotonic() < ends, state
    return state


@every_driver
def test_a_hand_is_opened_without_motion_driven_and_let_go(driver: Driver, tmp_path: Path) -> None:
    with driver.emulated() as emulated:  # type: ignore[attr-defined]
        hand = driver.make(emulated.place, tmp_path)
        assert isinstance(hand, Hand)
        assert not hand.spec.simulated
        brake = HandCommand.brake(hand.spec.n_joints)
        with pytest.raises(HandLost):
            hand.exchange(brake)
        assert emulated.lets_go()
        for _ in range(2):
            hand.open()  # the second time it is open
        assert emulated.lets_go()
        goal = np.array(driver.goal)
        span = hand.spec.q_max - hand.spec.q_min
        started = exchange(hand, brake)
        assert (np.abs(started.q - goal) > 0.1 * span).any()
        if not isinstance(hand, GoalHand):  # which know no gains
            for _ in range(30):
                limp = exchange(hand, HandCommand.position(driver.goal, kp=0.0, kd=0.0))
            assert (np.abs(limp.q - started.q) < 0.01 * span).all()
        command = towards(hand, driver.goal)
        before = time.monotonic()
        state = drive(hand, command, lambda s: (np.abs(s.q - goal) < 0.03 * span).all())
        assert before <= state.stamp <= time.monotonic()
        assert not state.fault.any()
        assert state.measured
        hand.close()
        hand.close()
        with pytest.raises(HandLost):
            hand.exchange(brake)
        wait_until(emulated.lets_go)


@every_driver
def test_closing_stops_it_on_its_way(driver: Driver, tmp_path: Path) -> None:
    with driver.emulated() as emulated:  # type: ignore[attr-defined]
        hand = driver.make(emulated.place, tmp_path)
        hand.open()
        brake = HandCommand.brake(hand.spec.n_joints)
        start, goal = exchange(hand, brake).q, np.array(driver.goal)
        span = hand.spec.q_max - hand.spec.q_min
        for _ in range(5):  # a program that is paused may find it arrived
            drive(
                hand, towards(hand, driver.goal), lambda s: (np.abs(s.q - goal) < 0.03 * span).all()
            )
            exchange(hand, towards(hand, tuple(start)))
            hand.close()
            wait_until(emulated.stands)
            hand.open()
            left = np.abs(exchange(hand, brake).q - start)
            if (left > 0.3 * np.abs(goal - start))[np.abs(goal - start) > 0.1 * span].all():
                break
        else:
            raise AssertionError("it went on to its goal")
        hand.close()


@every_driver
def test_a_hand_that_lost_its_cable_in_motion_comes_back_without_motion(
    driver: Driver, tmp_path: Path
) -> None:
    with driver.emulated() as emulated:  # type: ignore[attr-defined]
        hand = driver.make(emulated.place, tmp_path)
        hand.open()
        command = towards(hand, driver.goal)
        exchange(hand, command)
        emulated.inject("unplug:for=300ms")
        with pytest.raises(HandLost):
            drive(hand, command, lambda state: False)
        with pytest.raises(HandLost):
            hand.exchange(command)  # it does not come back by itself
        hand.close()
        ends = time.monotonic() + PATIENCE
        while True:
            try:
                hand.open()
                break
            except (HandNotFound, HandLost):
                assert time.monotonic() < ends
                time.sleep(0.01)
        brake = HandCommand.brake(hand.spec.n_joints)
        drive(hand, brake, lambda state: emulated.stands())
        still = exchange(hand, brake).q
        for _ in range(20):
            moved = np.abs(exchange(hand, brake).q - still)
        assert (moved < 0.02 * (hand.spec.q_max - hand.spec.q_min)).all()
        hand.close()


@every_driver
def test_a_place_without_a_hand_is_not_found(driver: Driver, tmp_path: Path) -> None:
    hand = driver.make(driver.place, tmp_path)
    with pytest.raises(HandNotFound):
        hand.open()
    with pytest.raises(HandLost, match="not connected"):
        hand.exchange(HandCommand.brake(hand.spec.n_joints))


@on_a_request_line
@each("fault", ["drop:p=0.3", "delay:p=0.3,ms=70"])
def test_a_lost_or_late_answer_costs_its_own_exchange(
    driver: Driver, fault: str, tmp_path: Path
) -> None:
    with driver.emulated() as emulated:  # type: ignore[attr-defined]
        hand = driver.make(emulated.place, tmp_path)
        assert isinstance(hand, GoalHand)
        hand.open()
        hand._line.timeout = 0.05  # not of opening it, on a busy machine
        emulated.inject(fault)
        good = failed = 0
        ends = time.monotonic() + PATIENCE
        while good < 5 or failed < 2:
            assert time.monotonic() < ends
            try:
                hand.exchange(HandCommand.brake(6))
                good += 1
            except HandTimeout:
                failed += 1
        assert hand.statistics.timeouts >= failed
        hand.close()


@every_driver
def test_wrong_settings_are_refused(driver: Driver) -> None:
    made = backend(driver.name)
    for settings in driver.wrong:
        with pytest.raises(UsageError):
            made.create(BackendOptions(Side.LEFT, driver.place, settings))
