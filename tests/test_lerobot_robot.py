"""``examples/lerobot-robot-dexkit``: hands as robots of LeRobot, and the local hand behind them."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from dexkit.backends import Backend, BackendOptions
from dexkit.errors import CommandRejected, HandFault, HandLost, HandTimeout
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.models import DEX1_1, MODELS
from dexkit.service.local import LocalHand, position_command
from tests import lerobot_stand_in
from tests.each import each
from tests.patience import PATIENCE
from tests.service_helpers import ScriptedHand

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "lerobot-robot-dexkit"
REAL = importlib.util.find_spec("lerobot") is not None


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def shows(seen: Callable[[], bool], send: Callable[[], object] = lambda: None) -> bool:
    """Send a command, and return whether the hand shows what it asks for.

    Called until it does: a hand whose program was paused raises :class:`HandTimeout` for a moment,
    and brakes until a command comes that was sent later.
    """
    with contextlib.suppress(HandTimeout):
        send()
        return seen()
    return False


# -------------------------------------------------------------------------------- a local hand


def test_local_hand_obeys_brakes_without_commands_and_at_the_end() -> None:
    device = ScriptedHand(io_rate=200.0)
    with LocalHand(device) as hand:
        assert device.last is not None
        assert device.last.is_brake
        assert hand.move_to([9.0]).tolist() == [5.4]

        def obeys() -> bool:
            last = device.last
            assert last is not None
            gains = last.kp.tolist(), last.kd.tolist()
            return hand.state().q.tolist() == [5.4] and gains == ([5.0], [0.05])

        until(lambda: shows(obeys, lambda: hand.move_to([9.0])))
        until(lambda: device.last is not None and device.last.is_brake)  # after a second
        pauses = hand._service.counters.pauses  # each of them may have braked the hand as well
        assert 1 <= hand.core.counters.brakes <= 1 + pauses
        hand.move_to([1.0])
    assert device.last.is_brake
    assert not device.is_open
    with pytest.raises(HandLost):
        hand.state()


def test_local_hand_raises_faults_and_does_not_obey_earlier_commands() -> None:
    device = ScriptedHand(io_rate=200.0, exchange_timeout=1.0)
    with LocalHand(device) as hand:
        for wrong in ([math.nan], [1.0, 2.0]):
            with pytest.raises(CommandRejected):
                hand.move_to(wrong)
        until(lambda: shows(lambda: device.q == 2.0, lambda: hand.move_to([2.0])))
        device.plugged = False
        until(lambda: isinstance(raised(hand.state), HandLost))
        with pytest.raises(HandLost):
            hand.move_to([3.0])
        device.q, device.plugged = 0.5, True
        until(lambda: raised(hand.state) is None)
        assert device.last is not None
        assert device.last.is_brake
        assert device.q == 0.5
        device.errors += [HandFault("too hot", bits=[int(MotorError.CASE_TEMPERATURE)])] * 200
        until(lambda: isinstance(raised(hand.state), HandFault))
        device.errors.clear()
        until(lambda: raised(hand.state) is None)
        device.hang.clear()
        until(lambda: isinstance(raised(hand.state), HandTimeout))
        device.hang.set()


def raised(call: Callable[[], object]) -> Exception | None:
    try:
        call()
    except Exception as error:
        return error
    return None


def test_command_of_every_model_moves_as_its_client_does() -> None:
    for hand in MODELS.values():
        command = position_command(hand, hand.rest_q[Side.LEFT])
        servo = hand.dialects[0].position_servo
        assert command.kp.any() != servo
        assert command.dq.all() == servo


LEFT_ALONE = """
from dexkit.service.local import LocalHand
from tests.service_helpers import ScriptedHand

class Told(ScriptedHand):
    def close(self):
        if self.is_open:
            print("closed, brake", self.last.is_brake, flush=True)
        super().close()

hand = LocalHand(Told(io_rate=100.0))
hand.start()
hand.move_to([1.0])
"""


def test_hand_is_released_by_a_program_that_just_ends() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LEFT_ALONE],
        cwd=ROOT, capture_output=True, text=True, timeout=4 * PATIENCE, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "closed, brake True\n"), done.stderr


# -------------------------------------------------------------------------------- the robot


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The example's package, on LeRobot or on what stands in for it."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    if REAL:
        yield importlib.import_module("lerobot_robot_dexkit")
        return
    with lerobot_stand_in.lerobot_modules():
        yield importlib.import_module("lerobot_robot_dexkit")


def make(config: Any) -> Any:
    if REAL:
        return importlib.import_module("lerobot.robots").make_robot_from_config(config)
    return lerobot_stand_in.make_robot(config)


DEVICES: dict[Side, ScriptedHand] = {}


def _make(options: BackendOptions) -> ScriptedHand:
    return DEVICES.setdefault(options.side, ScriptedHand(options.side, io_rate=200.0))


SCRIPTED = Backend(
    summary="hands of this test", model=DEX1_1.name, make=_make, settings={"object": ""}
)


class Blind(ScriptedHand):
    """It does not measure forces."""

    def exchange(self, command: HandCommand) -> HandState:
        return replace(super().exchange(command), tau_est=np.array([math.nan]))


@pytest.fixture
def devices() -> Iterator[dict[Side, ScriptedHand]]:
    """Both hands behind ``tests.test_lerobot_robot:SCRIPTED``."""
    DEVICES.clear()
    for side in Side:
        DEVICES[side] = ScriptedHand(side, io_rate=200.0)
    yield DEVICES
    DEVICES.clear()


@pytest.fixture
def robot(package: ModuleType, devices: dict[Side, ScriptedHand], tmp_path: Path) -> Iterator[Any]:
    one = make(package.DexkitRobotConfig(backend=f"{__name__}:SCRIPTED", calibration_dir=tmp_path))
    yield one
    one.disconnect()


def test_package_is_one_that_lerobot_finds(package: ModuleType) -> None:
    text = (EXAMPLE / "pyproject.toml").read_text()
    assert 'name = "lerobot_robot_dexkit"' in text  # 0.4.4 and later go by this, earlier by the
    assert package.__name__.startswith("lerobot_robot_")  # module's
    assert package.DexkitRobotConfig(backend="sim-dex1").type == "dexkit"
    assert package.DexkitRobot.config_class is package.DexkitRobotConfig


def test_features_are_known_before_and_hold_after_connecting(
    robot: Any, devices: dict[Side, ScriptedHand]
) -> None:
    names = ["left_gripper.pos", "right_gripper.pos"]
    assert robot.action_features == robot.observation_features == dict.fromkeys(names, float)
    assert robot.limits == dict.fromkeys(names, (0.0, 5.4))
    assert not robot.is_connected
    assert robot.is_calibrated
    robot.connect()
    assert robot.is_connected
    until(lambda: shows(lambda: robot.get_observation() == dict.fromkeys(names, 0.0)))
    assert all(h.last is not None and h.last.is_brake for h in devices.values())
    sent = {"left_gripper.pos": 2.0, "right_gripper.pos": 0.0}

    def send() -> None:
        assert robot.send_action({"left_gripper.pos": 2.0, "right_gripper.pos": -1.0}) == sent

    until(lambda: shows(lambda: robot.get_observation() == sent, send))
    robot.disconnect()
    assert not robot.is_connected
    assert not any(hand.is_open for hand in devices.values())
    assert all(h.last is not None and h.last.is_brake for h in devices.values())
    robot.disconnect()
    robot.connect()  # LeRobot connects the same object again
    until(lambda: shows(lambda: robot.get_observation() == sent))


def test_actions_that_are_not_one_finite_number_a_joint_move_no_hand(
    package: ModuleType, robot: Any, devices: dict[Side, ScriptedHand]
) -> None:
    with pytest.raises(package.NotConnected):
        robot.send_action({})
    robot.connect()
    with pytest.raises(package.AlreadyConnected):
        robot.connect()
    good = {"left_gripper.pos": 2.0, "right_gripper.pos": 2.0}
    for change, text in (
        ({"right_gripper.pos": math.nan}, "not finite"),
        ({"right_gripper.pos": "open"}, "not a number"),
        ({"thumb.pos": 1.0}, "unknown: thumb.pos"),
    ):
        with pytest.raises(package.ActionRefused, match=text):
            robot.send_action(good | change)
    with pytest.raises(package.ActionRefused, match=r"missing: right_gripper\.pos"):
        robot.send_action({"left_gripper.pos": 2.0})
    devices[Side.RIGHT].plugged = False
    until(lambda: isinstance(raised(robot.get_observation), HandLost))
    with pytest.raises(HandLost):
        robot.send_action(good)
    assert devices[Side.LEFT].q == 0.0
    devices[Side.RIGHT].plugged = True
    until(lambda: raised(robot.get_observation) is None)


def test_errors_are_those_of_lerobot_and_of_python(package: ModuleType) -> None:
    from lerobot.utils.errors import (  # type: ignore[import-not-found,unused-ignore]
        DeviceAlreadyConnectedError,
        DeviceNotConnectedError,
    )

    for ours, theirs in (
        (package.NotConnected, DeviceNotConnectedError),
        (package.AlreadyConnected, DeviceAlreadyConnectedError),
        (package.ActionRefused, ValueError),
        (package.ConfigRefused, ValueError),
    ):
        error = ours("told", hint="do this")
        assert isinstance(error, theirs)
        assert (str(error), error.message, error.hint) == ("told", "told", "do this")


def test_no_hand_stays_open_when_the_other_one_cannot_be_opened(
    robot: Any, devices: dict[Side, ScriptedHand]
) -> None:
    devices[Side.RIGHT].plugged = False
    with pytest.raises(HandLost):
        robot.connect()
    assert not robot.is_connected
    assert not devices[Side.LEFT].is_open


@each(
    ("change", "text"),
    [
        ({"side": "middle"}, "side 'middle'"),
        ({"observe": ["force"]}, "observe"),
        ({"observe": []}, "observe"),
        ({"side": "left", "devices": {"right": "/dev/x"}}, "a device for 'right'"),
        ({"side": "left", "settings": {"right.object": "1"}}, "no right hand"),
        ({"settings": {"colour": "red"}}, "no setting 'colour'"),
    ],
)
def test_wrong_configurations_are_refused(
    package: ModuleType, tmp_path: Path, change: dict[str, Any], text: str
) -> None:
    config = package.DexkitRobotConfig(
        **{"backend": f"{__name__}:SCRIPTED", "calibration_dir": tmp_path, **change}
    )
    with pytest.raises(ValueError, match=text):
        make(config)


def test_dex3_observes_measured_values_and_gripper_without_force_is_refused(
    package: ModuleType, tmp_path: Path
) -> None:
    robot = make(
        package.DexkitRobotConfig(
            backend="sim-dex3",
            side="left",
            settings={"left.supply": "30"},
            observe=["pos", "vel", "torque"],
            calibration_dir=tmp_path,
        )
    )
    robot.connect()
    try:
        seen = robot.get_observation()
        assert list(seen) == list(robot.observation_features)
        assert len(seen) == 21
        assert all(type(value) is float for value in seen.values())
        goal = {key: (low + high) / 2 for key, (low, high) in robot.limits.items()}
        end = time.monotonic() + PATIENCE
        while any(abs(robot.get_observation()[key] - goal[key]) > 0.05 for key in goal):
            assert time.monotonic() < end
            assert robot.send_action(goal) == pytest.approx(goal)
            time.sleep(0.02)
    finally:
        robot.disconnect()
    blind = make(
        package.DexkitRobotConfig(
            backend=f"{__name__}:Blind", side="left", observe=["torque"], calibration_dir=tmp_path
        )
    )
    with pytest.raises(package.NotMeasured, match="does not measure torque"):
        blind.connect()
    assert not blind.is_connected
