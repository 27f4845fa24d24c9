"""The bring-up of an EZGripper on virtual time: wirings, one servo and two, the driver after it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dexkit.bringup import Drive, Effort
from dexkit.clock import ManualClock, RealClock
from dexkit.drivers.ezgripper import GripperSettings
from dexkit.drivers.ezgripper.bringup import EZGripperBench, plan_of
from dexkit.drivers.ezgripper.bus import DevicePort, ServoBus
from dexkit.drivers.ezgripper.calibration_file import Store, record_key
from dexkit.emulators.mx64 import (
    Bus,
    EmulatedThread,
    GripperMechanics,
    Physics,
    Port,
    Servo,
    Wiring,
)
from dexkit.errors import HandFault, HandLost, UsageError
from dexkit.hand import HandCommand, Side
from dexkit.wire import mx64
from tests import hostile
from tests.each import each
from tests.ezgripper_helpers import HALF, OPEN, QUICK, at, drive, exchange, gripper_on
from tests.gripper_bringup import Watched

FAST = Effort(torque=plan_of(Side.LEFT).torque, speed=2.0, most_torque=9.0)


class VirtualPort(DevicePort):
    """A port whose line is emulated on the caller's clock."""

    def __init__(self, line: Bus, clock: ManualClock) -> None:
        super().__init__("/virtual", 0.1)
        self._line, self._manual = line, clock
        self._received = b""

    def open(self, baudrate: int) -> None:
        self._line.host_baudrate = baudrate

    def close(self) -> None:
        pass

    def clear(self) -> None:
        self._received = b""

    def write(self, data: bytes) -> bool:
        now = self._manual.now()
        self._line.advance_to(now)
        self._line.receive(data, now)
        self._received += self._line.due(now)
        return True

    def read(self, deadline: float) -> bytes:
        taken, self._received = self._received, b""
        return taken


def servos_of(wiring: Wiring, now: float) -> list[Servo]:
    return [
        Servo(number, physics=replace(Physics(), gripper=mechanics), baudrate=1_000_000, now=now)
        for servos in wiring.servos.values()
        for number, mechanics in servos.items()
    ]


class Grippers:
    """Emulated servos on virtual time."""

    def __init__(self, wiring: Wiring) -> None:
        self.clock = ManualClock()
        now = self.clock.now()
        self.belongs = {
            str(number): str(side) for side, each in wiring.servos.items() for number in each
        }
        self.servos = {servo.id: servo for servo in servos_of(wiring, now)}
        self.line = Bus(list(self.servos.values()), line_time=False, latency_timer=0, start=now)
        self.bus = ServoBus("/virtual", 1_000_000, retries=0)
        self.bus._port = VirtualPort(self.line, self.clock)

    def opening(self) -> dict[str, float]:
        self.line.advance_to(self.clock.now())
        return {str(number): s.drive.opening / 100 for number, s in self.servos.items()}


def watched(
    tmp: Path, wiring: Wiring, side: Side, effort: Effort = FAST
) -> tuple[Grippers, Watched]:
    grippers = Grippers(wiring)
    settings = GripperSettings(config=tmp / "ezgripper.json")
    bench = EZGripperBench("SN1", side, settings, bus=grippers.bus, clock=grippers.clock)
    return grippers, Watched(bench, grippers.clock, grippers.opening, grippers.belongs, effort)


def check_wiring(seed: int, tmp: Path) -> None:
    wiring = Wiring.random(seed)
    side = list(wiring.servos)[seed % len(wiring.servos)]
    grippers, bring = watched(tmp, wiring, side)
    bring.run()
    bring.bench.store(bring.session.findings)
    bring.bench.close()
    assert not any(servo.torque for servo in grippers.servos.values())
    store = Store(tmp / "ezgripper.json")
    assert store.device(side) == "SN1"
    assert set(store.servo_ids(side)) == set(wiring.servos[side])
    for number, mechanics in wiring.servos[side].items():
        record = store.read(record_key("SN1", number))
        assert record.mirrored is mechanics.mirrored
        assert record.stroke == pytest.approx(mechanics.stroke, rel=0.02)
        assert record.zero is not None
        closed = -mechanics.closed_at if mechanics.mirrored else mechanics.closed_at
        assert (record.zero - closed + 2048) % 4096 - 2048 == pytest.approx(0, abs=30)
    assert all(travel.confirmed for travel in bring.session.findings.travel.values())


@pytest.mark.slow
@each("seed", [0])
def test_bringup_finds_a_random_wiring(seed: int, tmp_path: Path) -> None:
    check_wiring(seed, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("part", range(10))
def test_bringup_finds_two_hundred_random_wirings(part: int, tmp_path: Path) -> None:
    for seed in range(20 * part, 20 * part + 20):
        (tmp_path / str(seed)).mkdir()
        check_wiring(seed, tmp_path / str(seed))


def test_released_key_or_fault_switches_torque_off(tmp_path: Path) -> None:
    grippers, bring = watched(
        tmp_path, Wiring.random(0), Side.RIGHT, Effort.from_plan(plan_of(Side.LEFT))
    )
    while not any(servo.torque for servo in grippers.servos.values()):
        bring.cycle()
    assert sum(servo.torque for servo in grippers.servos.values()) == 1
    for _ in range(10):
        bring.cycle()
    bring.cycle(held=False)
    assert bring.drive is None
    for _ in range(5):
        bring.cycle(held=False)
    rest = grippers.opening()
    for _ in range(20):
        bring.cycle(held=False)
    assert grippers.opening() == pytest.approx(rest, abs=0.003)
    moving = next(servo for servo in grippers.servos.values() if servo.torque)
    moving.raise_error(mx64.HardwareError.OVERLOAD)
    with pytest.raises(HandFault, match="overcurrent"):
        bring.until_question()
    with pytest.raises(HandFault, match="overcurrent"):
        bring.cycle()
    bring.bench.close()
    with pytest.raises(HandLost):
        bring.bench.exchange(None)


def test_a_gripper_without_an_open_stop_has_sakes_stroke(tmp_path: Path) -> None:
    """The tendon is not wound up the other way in search of a stop."""
    mechanics = GripperMechanics(open_stiffness=1e-6, start=40.0)
    grippers, bring = watched(tmp_path, Wiring({Side.LEFT: {1: mechanics}}), Side.LEFT)
    widest = 0.0
    while (question := bring.until_question()) is not None:
        widest = max(widest, *(seen["1"] for seen in bring.seen))
        bring.session.answer(bring.look(question))
    bring.bench.store(bring.session.findings)
    record = Store(tmp_path / "ezgripper.json").read("SN1")
    assert record.stroke == mx64.EZGRIPPER_STROKE
    assert record.zero == pytest.approx(mechanics.closed_at, abs=30)
    assert 1.1 < widest < 1.3
    assert len(grippers.servos) == 1


def test_torque_of_the_bringup_becomes_a_current_limit(tmp_path: Path) -> None:
    grippers, bring = watched(tmp_path, Wiring.random(0), Side.RIGHT)
    motor = bring.bench.motors[0]
    for torque, most in ((0.2, 64), (99.0, 1600)):
        q = bring.bench.exchange(None).motors[motor].q
        bring.bench.exchange(Drive(motor, q, 1.5, 0.05, torque))
        current = grippers.servos[int(motor)].get(mx64.GOAL_CURRENT)
        assert 0 < current <= most
    with pytest.raises(UsageError, match="torque"):
        Effort.from_plan(plan_of(Side.LEFT), torque=2.5)


@pytest.mark.soak
def test_quad_gripper_is_brought_up_unattended_and_served(tmp_path: Path) -> None:
    """A quad gripper with one mirrored servo: found without a person, then driven."""
    seed = next(
        seed
        for seed in range(100)
        if [len(s) for s in Wiring.random(seed).servos.values()] == [2]
        and len({m.mirrored for s in Wiring.random(seed).servos.values() for m in s.values()}) == 2
    )
    wiring = Wiring.random(seed)
    ((side, mechanics),) = wiring.servos.items()
    config, answers = tmp_path / "ezgripper.json", tmp_path / "answers.json"
    known: dict[str, str] = {}
    for number in mechanics:
        known |= {
            f"motor {number} gripper": str(side),
            f"motor {number} way": "opened",
            f"{side} {number} way free": "yes",
            f"{side} {number} zero": "yes",
        }
    # which way each goes first is what a person would see: up in ticks
    for number, each_one in mechanics.items():
        known[f"motor {number} way"] = "closed" if each_one.mirrored else "opened"
    answers.write_text(json.dumps(known))
    now = RealClock().now()
    line = Bus(servos_of(wiring, now), start=now)
    gripper = EmulatedThread(line, Port(line))
    try:
        code, out, err = hostile.run_command(
            [
                *("bringup", "ezgripper", "--side", str(side), "--device", gripper.path),
                *("--set", f"config={config}", "--set", "timeout=0.3"),
                *("--answers", str(answers), "--unattended", "--speed", "2"),
            ]
        )
        assert code == 0, err
        assert "ids=" in out
        assert "firmware" in out
        hand_settings = GripperSettings(
            ids=Store(config).servo_ids(side), config=config, control=QUICK, timeout=1.0
        )
        with gripper_on(gripper.path, hand_settings) as hand:
            state = drive(hand, HALF, at(2.7))
            assert state.q[0] == pytest.approx(2.7, abs=0.1)
            for servo in gripper.servos:
                assert servo.drive.opening == pytest.approx(50.0, abs=3)
            drive(hand, OPEN, at(5.4))
            exchange(hand, HandCommand.brake(1))
    finally:
        gripper.close()
