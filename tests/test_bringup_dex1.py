"""The bring-up of a Dex1-1 on virtual time: wirings, what ends it, what the driver makes of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dexkit.bringup import Effort, Findings
from dexkit.clock import ManualClock
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.drivers.dex1_serial import hand as dex1_hand
from dexkit.drivers.dex1_serial.bringup import Dex1Bench
from dexkit.drivers.dex1_serial.settings import default_path, with_stored
from dexkit.emulators.dex1_mechanics import Dex1Mechanics
from dexkit.emulators.m4010 import Dex1Motors, Motor, Wiring
from dexkit.errors import HandFault, HandNotFound, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandCommand, MotorError, Side
from dexkit.wire.m4010 import STROKE, MotorCmd, MotorData
from tests import hostile
from tests.each import each
from tests.gripper_bringup import Watched
from tests.patience import PATIENCE

FAST = Effort(torque=0.5, speed=2.0)


class Line:
    """Emulated motors on virtual time, without a serial port."""

    def __init__(self, wiring: Wiring, sides: tuple[Side, ...] = tuple(Side)) -> None:
        self.clock = ManualClock()
        self.motors = {
            side: Motor(
                wiring.ids[side],
                mechanics=Dex1Mechanics(start_pct=30.0, locking=1.0),
                mounting=wiring.mountings[side],
                now=self.clock.now(),
            )
            for side in sides
        }
        self.driven: list[tuple[float, int]] = []

    def exchange(self, command: MotorCmd) -> MotorData:
        for motor in self.motors.values():
            motor.advance_to(self.clock.now())
        for motor in self.motors.values():
            answer = motor.handle(command)
            if answer is not None:
                if command.status:
                    self.driven.append((self.clock.now(), command.id))
                return answer
        raise HandTimeout("no answer")

    def opening(self) -> dict[str, float]:
        return {str(m.number): m.mechanics.joint.q / STROKE for m in self.motors.values()}


def watched(
    tmp: Path,
    wiring: Wiring,
    side: Side = Side.LEFT,
    sides: tuple[Side, ...] = tuple(Side),
    effort: Effort = FAST,
) -> tuple[Line, Watched]:
    line = Line(wiring, sides)
    bench = Dex1Bench(side, Dex1Settings(config=tmp / "dex1.json"), line.exchange)
    belongs = {str(wiring.ids[each]): str(each) for each in sides}
    return line, Watched(bench, line.clock, line.opening, belongs, effort)


def check_wiring(seed: int, tmp: Path) -> None:
    wiring, side = Wiring.random(seed), (Side.LEFT, Side.RIGHT)[seed % 2]
    sides = tuple(Side) if seed % 3 else (side,)
    line, bring = watched(tmp, wiring, side, sides)
    bring.run()
    bring.bench.store(bring.session.findings)
    record = json.loads((tmp / "dex1.json").read_text())[str(side)]
    found = with_stored(Dex1Settings(), record["settings"])
    mounting = wiring.mountings[side]
    assert found.id == wiring.ids[side]
    assert (found.sign,) == mounting.signs
    assert found.ratio == pytest.approx(mounting.ratios[0], rel=0.011)
    # where the jaws are closed is what matters, whatever share the ratio has in it
    assert found.offset * found.ratio == pytest.approx(
        mounting.offsets[0] * mounting.ratios[0], abs=0.02 * 25
    )
    assert bring.session.findings.travel[str(side)].confirmed
    others = [m for m in line.motors.values() if m.number != wiring.ids[side]]
    assert all(m.mechanics.joint.q / STROKE == pytest.approx(0.30, abs=0.15) for m in others)
    times = [t for t, _ in line.driven]
    assert len(times) == len(set(times)), "one motor at a time"


@each("seed", [1, 2])
def test_bringup_finds_a_random_wiring(seed: int, tmp_path: Path) -> None:
    check_wiring(seed, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("part", range(10))
def test_bringup_finds_two_hundred_random_wirings(part: int, tmp_path: Path) -> None:
    for seed in range(20 * part, 20 * part + 20):
        (tmp_path / str(seed)).mkdir()
        check_wiring(seed, tmp_path / str(seed))


# ------------------------------------------------------------------------------ what ends it


def moving(tmp: Path) -> tuple[Line, Watched]:
    line, bring = watched(tmp, Wiring.random(1), effort=Effort())
    while not line.driven:
        bring.cycle()
    return line, bring


def test_release_brakes_within_a_cycle(tmp_path: Path) -> None:
    line, bring = moving(tmp_path)
    bring.cycle(held=False)
    assert bring.drive is None
    sent = len(line.driven)
    for _ in range(20):
        bring.cycle(held=False)
    assert len(line.driven) == sent
    at = line.opening()
    bring.cycle(held=False)
    assert line.opening() == pytest.approx(at, abs=1e-3)


def test_fault_of_any_motor_ends_the_bringup_for_good(tmp_path: Path) -> None:
    for index in range(2):
        line, bring = moving(tmp_path)
        list(line.motors.values())[index]._faults = MotorError.OVERCURRENT
        with pytest.raises(HandFault, match="overcurrent"):
            bring.until_question()
        bring.drive = None
        with pytest.raises(HandFault, match="overcurrent"):
            bring.cycle()


def test_blocked_jaws_end_the_bringup(tmp_path: Path) -> None:
    """An object between the jaws is not taken for the closed stop."""
    wiring = Wiring.assumed()
    line, bring = watched(tmp_path, wiring)
    motor = line.motors[Side.LEFT]
    motor.mechanics = Dex1Mechanics(start_pct=80.0, object_pct=60.0, locking=1.0)
    bring.begin(Findings())
    with pytest.raises(HandFault, match="of what its documents say"):
        bring.run()


def test_the_other_sides_gripper_alone_is_named(tmp_path: Path) -> None:
    _, bring = watched(tmp_path, Wiring.random(3), Side.LEFT, (Side.RIGHT,))
    with pytest.raises(HandFault, match="none of the motors moves left"):
        bring.run()


# ------------------------------------------------------------------------------ the driver


def test_the_driver_uses_the_findings(tmp_path: Path) -> None:
    """Behind a pseudo-terminal: ids, direction, zero and gearing of the file are obeyed."""
    wiring, config = Wiring.random(7), tmp_path / "dex1.json"
    mounting = wiring.mountings[Side.LEFT]
    texts = {
        "id": str(wiring.ids[Side.LEFT]),
        "sign": "+" if mounting.signs[0] > 0 else "-",
        "offset": str(mounting.offsets[0]),
        "ratio": str(mounting.ratios[0]),
    }
    config.write_text(json.dumps({"left": {"settings": texts}}))
    with Dex1Motors((Side.LEFT, Side.RIGHT), wiring=wiring) as motors:
        plain = Dex1Settings(device=motors.path, timeout=0.5)
        with Dex1Serial(Side.LEFT, replace(plain, config=config)) as hand:
            joint = motors.motors[Side.LEFT].mechanics.joint
            state = hand.exchange(HandCommand.brake(1))
            assert state.q[0] == pytest.approx(joint.q, abs=1e-3)
            for goal in (4.0, 1.0):
                for _ in range(round(PATIENCE * 100)):
                    # what was measured and where it is now differ while it moves
                    state = hand.exchange(HandCommand.position(goal))
                    if max(abs(joint.q - goal), abs(state.q[0] - goal)) < 0.05:
                        break
                assert joint.q == pytest.approx(goal, abs=0.05)
                assert state.q[0] == pytest.approx(goal, abs=0.05)
            assert motors.motors[Side.RIGHT].mechanics.joint.q == pytest.approx(0.2 * 5.4, abs=0.01)
            while abs(hand.exchange(HandCommand.brake(1)).dq[0]) > 0.0:
                pass
            assert hand.calibrate() == pytest.approx(0.0, abs=0.01)
            assert hand.exchange(HandCommand.brake(1)).q[0] == pytest.approx(0.0, abs=0.01)
        stored = json.loads(config.read_text())["left"]["settings"]
        assert stored == texts | {"offset": "0"}, "the motor itself has the zero now"
        with pytest.raises(HandNotFound):
            Dex1Serial(Side.LEFT, plain).open()


def test_settings_of_another_gripper_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "dex1.json"
    config.write_text(json.dumps({"left": {"settings": {"adapter": "SN1"}}}))
    with Dex1Motors() as motors:
        settings = Dex1Settings(device=motors.path, config=config, timeout=0.5)
        with pytest.raises(HandRefused, match="adapter SN1"):
            Dex1Serial(Side.LEFT, settings).open()
        with pytest.raises(HandNotFound, match="SN1"):  # and looked for, where none is named
            Dex1Serial(Side.LEFT, replace(settings, device=None)).open()
        config.write_text(json.dumps({"left": {"settings": {"sign": "x"}}}))
        with pytest.raises(UsageError, match=r"dex1\.json: left: sign=x"):
            Dex1Serial(Side.LEFT, settings).open()
        config.write_text(json.dumps({"left": {"settings": {"timeout": "1"}}}))
        with pytest.raises(UsageError, match="no setting of a single gripper"):
            Dex1Serial(Side.LEFT, settings).open()
    monkeypatch.setenv("DEXKIT_DEX1_CONFIG", str(config))
    assert default_path() == config
    assert dex1_hand.backend.bringup is not None


@pytest.mark.soak
def test_unattended_bringup_stores_settings_that_serve_uses(tmp_path: Path) -> None:
    """``--answers --unattended``, on the emulated line; and what is then served."""
    config, answers = tmp_path / "dex1.json", tmp_path / "answers.json"
    wiring = Wiring.assumed()
    answers.write_text(
        json.dumps(
            {
                "motor 1 gripper": "left",
                "motor 1 way": "opened",
                "left way free": "yes",
                "left zero": "yes",
            }
        )
    )
    with Dex1Motors((Side.LEFT,), wiring=wiring) as motors:
        code, out, err = hostile.run_command(
            [
                *("bringup", "dex1-serial", "--side", "left", "--device", motors.path),
                *("--set", f"config={config}", "--set", "timeout=0.5"),
                *("--answers", str(answers), "--unattended", "--speed", "2", "--torque", "0.5"),
            ]
        )
        assert code == 0, err
        assert "id=1" in out
        record = json.loads(config.read_text())["left"]
        assert record["settings"]["ratio"] == "25"
        assert float(record["settings"]["offset"]) == pytest.approx(0.0, abs=0.02)
        assert record["found"]["hand"]["port"] == motors.path
