"""Test Inspire's serial line: frames, the emulated RH56DFX, and the driver on it."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from dexkit.backends import BackendOptions, backend
from dexkit.drivers import inspire_serial
from dexkit.drivers.inspire_serial import InspireSerial, InspireSerialSettings
from dexkit.emulators.faults import RH56_FAULTS, parse_fault
from dexkit.emulators.rh56 import Rh56, Rh56Hand, rh56_bus
from dexkit.errors import (
    EncodeError,
    HandNotFound,
    UsageError,
    WireError,
)
from dexkit.hand import HandCommand, MotorError, Side
from dexkit.wire import rh56
from dexkit.wire.rh56 import Error, Frame, Operation, Register, Status

N = rh56.JOINTS
PATIENT = 1.0  # s; a busy machine answers late

# docs/sources/unitree-dex.md#j2: the bytes that Unitree's service sends, and asks for
READ_ANGLES = bytes.fromhex("eb900104110a060c32")
HALF_OPEN = bytes.fromhex("eb90010f12ce05" + "f401" * 6 + "b3")
CLEAR = bytes.fromhex("eb90010412ec030107")


# -------------------------------------------------------------------------------------- the frames


def test_frames_are_those_of_unitrees_service() -> None:
    assert rh56.read(1, Register.ANGLE_ACT, 12).pack() == READ_ANGLES
    assert rh56.write(1, Register.ANGLE_SET, [500] * N).pack() == HALF_OPEN
    assert Frame(1, Operation.WRITE, Register.CLEAR_ERROR, b"\x01").pack() == CLEAR
    answer = Frame(1, Operation.READ, Register.ANGLE_ACT, bytes(12), answer=True).pack()
    assert len(answer) == 20  # what the service waits for
    assert answer[7:9] == bytes(2)


def test_values_that_do_not_fit_are_refused() -> None:
    for frame in (lambda: rh56.write(1, 0, [40000]), Frame(256, Operation.READ, 0, b"").pack):
        with pytest.raises(EncodeError):
            frame()
    with pytest.raises(WireError):
        rh56.numbers(b"abc")


# ------------------------------------------------------------------------------------ the device


def asked(device: Rh56, register: int, count: int) -> bytes:
    answer = device.handle(rh56.read(device.number, register, count))
    assert answer is not None
    assert answer.answer
    return answer.data


def angles(device: Rh56) -> tuple[int, ...]:
    return rh56.numbers(asked(device, Register.ANGLE_ACT, 12))


def lived(device: Rh56, seconds: float, since: float = 0.0) -> None:
    for i in range(round(seconds * 100)):
        device.advance_to(since + (i + 1) / 100)


def test_device_moves_to_its_register_and_1_is_open() -> None:
    device = Rh56(start=100.0)
    assert angles(device) == (0,) * N
    device.handle(rh56.write(1, Register.ANGLE_SET, [1000, -1, 500, 2000, 0, 250]))
    lived(device, 1.5)
    assert angles(device) == (1000, 0, 500, 1000, 0, 250)
    assert set(asked(device, Register.STATUS, N)) == {Status.ARRIVED}
    assert rh56.numbers(asked(device, Register.ANGLE_SET, 12))[:2] == (1000, -1)
    assert device.resting


def test_speed_register_limits_the_speed() -> None:
    device = Rh56(start=100.0)
    device.handle(rh56.write(1, Register.SPEED_SET, [500] * N))
    device.handle(rh56.write(1, Register.ANGLE_SET, [1000] * N))
    lived(device, 0.8)
    assert all(abs(angle - 480) < 30 for angle in angles(device))
    assert set(asked(device, Register.STATUS, N)) == {Status.OPENING}


def test_locked_rotor_stops_a_joint_until_it_is_cleared() -> None:
    device = Rh56(start=0.0)
    device.handle(rh56.write(1, Register.ANGLE_SET, [0] * N))
    lived(device, 0.2)
    device.lock()
    lived(device, 0.5, 0.2)
    stopped = angles(device)
    assert min(stopped) > 500
    assert set(asked(device, Register.ERROR, N)) == {Error.LOCKED_ROTOR}
    device.handle(Frame(1, Operation.WRITE, Register.CLEAR_ERROR, b"\x01"))
    lived(device, 1.5, 0.7)
    assert angles(device) == (0,) * N


def test_frames_for_other_ids_are_ignored_and_unknown_registers_read_0() -> None:
    device = Rh56(number=2)
    assert device.handle(rh56.read(1, Register.ANGLE_ACT, 12)) is None
    assert device.handle(Frame(2, Operation.READ, 1000, b"")) is None
    assert asked(device, 4000, 4) == bytes(4)
    assert asked(device, Register.ID, 1) == b"\x02"
    answer = device.handle(rh56.write(2, 4000, [1]))
    assert answer is not None
    assert answer.data == b"\x01"


def test_line_takes_its_time_and_needs_the_right_rate() -> None:
    bus = rh56_bus(Rh56())
    bus.host_baudrate = 9600
    bus.receive(READ_ANGLES, 0.0)
    assert bus.counters.garbled == len(READ_ANGLES)
    bus.host_baudrate = rh56.BAUD_RATE
    bus.receive(READ_ANGLES, 1.0)
    at = bus.next_time
    assert at == pytest.approx(1.0 + 29 * 10 / rh56.BAUD_RATE)
    bus.advance_to(at)
    assert len(bus.due(at)) == 20
    assert bus.counters.answers == 1


# ------------------------------------------------------------------------------------ the driver


@pytest.fixture
def emulated() -> Iterator[Rh56Hand]:
    with Rh56Hand(Side.RIGHT, start_pct=0.0, object_pct=60.0) as hand:
        yield hand


def driver(hand: Rh56Hand, **change: object) -> InspireSerial:
    values: dict[str, object] = {"device": hand.path, "timeout": PATIENT, **change}
    return InspireSerial(Side.RIGHT, InspireSerialSettings(**values))  # type: ignore[arg-type]


def test_driver_reports_errors_and_clears_them_when_it_opens(emulated: Rh56Hand) -> None:
    with driver(emulated) as hand:
        emulated.inject("locked")
        ends = time.monotonic() + 60.0
        while not hand.exchange(HandCommand.brake(N)).fault.any():
            assert time.monotonic() < ends
        assert set(hand.exchange(HandCommand.brake(N)).fault) == {MotorError.LOCKED}
    with driver(emulated, speed=300, force=200) as hand:
        assert not hand.exchange(HandCommand.brake(N)).fault.any()
        assert emulated.device.words[Register.SPEED_SET] == [300] * N
        assert emulated.device.words[Register.FORCE_SET] == [200] * N


def test_missing_hand_is_reported() -> None:
    with pytest.raises(HandNotFound, match="no serial port is given"):
        InspireSerial(Side.LEFT).open()
    with Rh56Hand(Side.LEFT, number=2) as other:
        with pytest.raises(HandNotFound, match="no hand with id 1"):
            driver(other, timeout=0.02).open()
        with driver(other, id=2) as hand:
            assert hand.exchange(HandCommand.brake(N)).q.any()


def test_backend_inspire_serial_reads_its_settings() -> None:
    assert backend("inspire-serial") is inspire_serial.backend
    options = BackendOptions(Side.LEFT, "/dev/x", {"id": "2", "speed": "500", "timeout": "0.1"})
    made = inspire_serial.backend.make(options)
    assert isinstance(made, InspireSerial)
    assert made.configuration == InspireSerialSettings("/dev/x", id=2, speed=500, timeout=0.1)
    for bad in (
        {"id": "0"},
        {"speed": "1001"},
        {"force": "x"},
        {"timeout": "2"},
        {"baudrate": "1"},
    ):
        with pytest.raises(UsageError):
            inspire_serial.backend.make(BackendOptions(Side.LEFT, "/dev/x", bad))
    with pytest.raises(UsageError):
        parse_fault("stuck", RH56_FAULTS)
