"""Test the driver of BrainCo's Revo2 on the emulated hand."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from dexkit.backends import BackendOptions, backend
from dexkit.clock import ManualClock
from dexkit.drivers import revo2_serial
from dexkit.drivers.revo2_serial import Revo2Serial, Revo2Settings
from dexkit.emulators.revo2 import Revo2, Revo2Hand
from dexkit.errors import HandNotFound, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandCommand, Side
from dexkit.models import BRAINCO_REVO2
from dexkit.wire.modbus import Function
from dexkit.wire.revo2 import Holding, Input, MotorStatus

N = 6
PATIENT = 1.0  # s; a busy machine answers late
FULL_SPEED = [joint.dq_max for joint in BRAINCO_REVO2.joints[Side.RIGHT]]


@pytest.fixture
def emulated() -> Iterator[Revo2Hand]:
    with Revo2Hand(Side.RIGHT, start_pct=0.0, object_pct=60.0) as hand:
        yield hand


def driver(hand: Revo2Hand, side: Side = Side.RIGHT, **change: object) -> Revo2Serial:
    values: dict[str, object] = {"device": hand.path, "timeout": PATIENT, **change}
    return Revo2Serial(side, Revo2Settings(**values))  # type: ignore[arg-type]


def to(q: float, part: float = 1.0) -> HandCommand:
    return HandCommand.position([q] * N, dq=[part * speed for speed in FULL_SPEED])


def test_device_reports_a_joint_that_is_held_back() -> None:
    device = Revo2(Side.LEFT, start=0.0, object_at=60.0)
    device.write_registers(Holding.POSITION_AND_SPEED, (1000, 500) * N)
    for i in range(300):
        device.advance_to((i + 1) / 100)
        if i == 20:
            speeds = device.read_registers(Function.READ_INPUT, Input.SPEED, N)
            assert all(450 <= speed <= 550 for speed in speeds)
    assert device.read_registers(Function.READ_INPUT, Input.POSITION, N) == [600] * N
    assert device.read_registers(Function.READ_INPUT, Input.CURRENT, N) == [1000] * N
    status = device.read_registers(Function.READ_INPUT, Input.STATUS, N)
    assert status == [MotorStatus.STALLED] * N


def test_speed_of_a_command_is_the_devices_and_0_is_no_motion(emulated: Revo2Hand) -> None:
    with driver(emulated, speed=0.5) as hand:
        hand.exchange(to(0.5))
        assert emulated.device.speeds == [500] * N
        while not all(hand.exchange(to(0.5)).q):  # until each joint moves
            pass
        hand.exchange(to(0.5, part=0.1))
        assert emulated.device.speeds == [100] * N
        hand.exchange(to(0.0, part=0.0))  # and not the device's highest
        assert emulated.device.goals != [0] * N
        for _ in range(2):
            hand.exchange(HandCommand.brake(N))
        before = hand.statistics.exchanges
        hand.exchange(HandCommand.brake(N))
        assert hand.statistics.exchanges - before == 1  # goals that stay are not written again


def test_wrong_hand_is_refused_and_missing_hand_is_not_found(emulated: Revo2Hand) -> None:
    with pytest.raises(HandRefused, match="is a right one"):
        driver(emulated, Side.LEFT, id=127).open()
    with pytest.raises(HandNotFound, match="no hand with id 126"):
        driver(emulated, Side.LEFT, timeout=0.02).open()
    with pytest.raises(HandNotFound, match="no serial port is given"):
        Revo2Serial(Side.LEFT).open()
    with driver(emulated) as hand:
        assert hand.spec.side is Side.RIGHT


def test_nothing_is_written_after_a_pause(emulated: Revo2Hand) -> None:
    clock = ManualClock()
    settings = Revo2Settings(emulated.path, timeout=PATIENT)
    hand = Revo2Serial(Side.RIGHT, settings, clock=clock)
    hand.open()
    try:
        write = hand._line.ask

        def paused(*arguments: object) -> object:
            clock.advance(1.0)
            return write(*arguments)  # type: ignore[arg-type]

        hand._line.ask = paused  # type: ignore[method-assign,assignment]
        with pytest.raises(HandTimeout, match="paused"):
            hand.exchange(to(0.5))
        assert emulated.device.goals == [None] * N
    finally:
        hand.close()


def test_backend_revo2_serial_reads_its_settings() -> None:
    assert backend("revo2-serial") is revo2_serial.backend
    options = BackendOptions(Side.LEFT, "/dev/x", {"id": "2", "speed": "0.5", "timeout": "0.1"})
    made = revo2_serial.backend.make(options)
    assert isinstance(made, Revo2Serial)
    assert made.configuration == Revo2Settings("/dev/x", id=2, speed=0.5, timeout=0.1)
    for bad in ({"id": "0"}, {"speed": "0"}, {"speed": "nan"}, {"timeout": "2"}, {"baudrate": "1"}):
        with pytest.raises(UsageError):
            revo2_serial.backend.make(BackendOptions(Side.LEFT, "/dev/x", bad))
