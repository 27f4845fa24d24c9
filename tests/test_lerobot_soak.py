"""LeRobot itself: its commands on the plug-in, its unitree_g1 on ``emulate all --for lerobot``.

It needs the Python of docs/lerobot.md in ``.tools/lerobot``: LeRobot with torch takes 6 GB. All of
it runs in a network of its own, because LeRobot's ports and its DDS domain are fixed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexkit.child_processes import Tool
from dexkit.hand import Side
from dexkit.models import DEX1_1, DEX3_1
from tests.namespaces import Host, Link, network, unavailable

pytestmark = pytest.mark.soak

ROOT = Path(__file__).parent.parent
PYTHON = ROOT / ".tools" / "lerobot" / "bin" / "python"
LEFT = 900.0  # seconds for a command of LeRobot's

if not PYTHON.exists():
    pytest.skip(f"no LeRobot in {PYTHON.parent.parent}: docs/lerobot.md", allow_module_level=True)
if why := unavailable():
    pytest.skip(why, allow_module_level=True)

TELEOPERATOR = '''
import time
from dataclasses import dataclass, field

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig


@TeleoperatorConfig.register_subclass("sweep")
@dataclass
class SweepConfig(TeleoperatorConfig):
    """From one position to another and back, each joint alike."""

    keys: list[str] = field(default_factory=list)
    low: float = 0.0
    high: float = 1.0
    seconds: float = 2.0


class Sweep(Teleoperator):
    config_class, name = SweepConfig, "sweep"
    feedback_features = {}
    is_connected = is_calibrated = False

    def __init__(self, config):
        super().__init__(config)
        self.config, self.began = config, None

    @property
    def action_features(self):
        return dict.fromkeys(self.config.keys, float)

    def connect(self, calibrate=True):
        self.is_connected = True

    def calibrate(self): ...
    def configure(self): ...
    def send_feedback(self, feedback): ...

    def disconnect(self):
        self.is_connected = False

    def get_action(self):
        now = time.monotonic()
        self.began = self.began or now
        part = (now - self.began) / self.config.seconds % 2
        part = min(part, 2 - part)
        q = self.config.low + part * (self.config.high - self.config.low)
        return dict.fromkeys(self.config.keys, q)
'''


@pytest.fixture(scope="module")
def host() -> Iterator[Host]:
    with network(Link("here", "net0", "10.9.8.1", "there", "port0", "10.9.8.2")) as hosts:
        yield hosts["here"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Where LeRobot finds the teleoperator, and keeps its files."""
    folder = tmp_path_factory.mktemp("lerobot")
    package = folder / "lerobot_teleoperator_sweep"
    package.mkdir()
    (package / "__init__.py").write_text(TELEOPERATOR)
    told = folder / "lerobot_teleoperator_sweep-1.0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_teleoperator_sweep\nVersion: 1.0\n"
    )
    return {
        "PATH": os.environ["PATH"],
        "HOME": str(folder),
        "HF_HOME": str(folder / "hf"),
        "HF_HUB_OFFLINE": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "PYTHONPATH": str(folder),
        "CUDA_VISIBLE_DEVICES": "",
    }


def lerobot(host: Host, environment: dict[str, str], *arguments: object) -> str:
    """Run LeRobot's Python to its end; what it printed."""
    process = host.popen(
        PYTHON, *arguments, env=environment, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
    )
    out, _ = process.communicate(timeout=LEFT)
    assert process.returncode == 0, out[-6000:]
    return str(out)


def test_the_tests_of_the_plug_in_pass_on_lerobot(host: Host, environment: dict[str, str]) -> None:
    out = lerobot(
        host,
        {**environment, "PYTHONPATH": ""},
        *("-m", "pytest", "-q", "--noconftest", "-p", "no:cacheprovider"),
        "tests/test_lerobot_robot.py",
    )
    assert " passed" in out
    assert "skipped" not in out


READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
found = LeRobotDataset("me/sweep", root=sys.argv[1])
rows = [found[i] for i in range(len(found))]
print("FOUND " + json.dumps({
    "names": {k: found.features[k]["names"] for k in ("observation.state", "action")},
    "episodes": found.num_episodes,
    "state": [r["observation.state"].tolist() for r in rows],
    "action": [r["action"].tolist() for r in rows],
    "pictures": sorted({str(v.shape) for r in rows for k, v in r.items() if "images" in k}),
}))
"""


def record(
    host: Host,
    environment: dict[str, str],
    root: Path,
    keys: list[str],
    high: float,
    *robot: str,
    seconds: int = 8,
) -> Any:
    """Two episodes by lerobot-record, as the dataset's reader has them."""
    lerobot(
        host,
        environment,
        *("-m", "lerobot.scripts.lerobot_record", *robot),
        *("--teleop.type=sweep", f"--teleop.keys={json.dumps(keys)}", f"--teleop.high={high}"),
        *("--dataset.repo_id=me/sweep", f"--dataset.root={root}", "--dataset.no_stamp=true"),
        *("--dataset.single_task=sweep", "--dataset.num_episodes=2", "--dataset.push_to_hub=false"),
        *(f"--dataset.episode_time_s={seconds}", "--dataset.reset_time_s=1"),
        *("--dataset.video=false", "--play_sounds=false"),
    )
    out = lerobot(host, environment, "-c", READ, root)
    line = next(line for line in out.splitlines() if line.startswith("FOUND "))
    found = json.loads(line.removeprefix("FOUND "))
    assert found["names"] == {"observation.state": keys, "action": keys}
    assert found["episodes"] == 2
    return found


def follows(found: Any, joint: int, high: float) -> float:
    """How well a joint's state follows its action in the first episode, at the best delay.

    The median does not count the first second: a real hand moves slowly then, and the commands for
    an emulated G1 do not count yet.

    :returns: median error, of the range.
    """
    columns = (np.array(found[name]) for name in ("state", "action"))
    state, action = (values[: len(values) // 2, joint] for values in columns)
    errors = [
        float(np.median(np.abs(state[delay:] - action[: len(action) - delay]))) / high
        for delay in range(20)
    ]
    print(
        f"\n{len(state)} frames, {np.ptp(state):.2f} of {high}, median error {min(errors):.4f} at "
        f"{np.argmin(errors)} frames of delay"
    )
    assert np.ptp(state) > 0.7 * high
    return min(errors)


@pytest.mark.parametrize("backend", ["sim-dex1", "sim-dex3", "ezgripper"])
def test_lerobot_records_and_replays_hands(
    host: Host, environment: dict[str, str], tmp_path: Path, backend: str
) -> None:
    hand = DEX3_1 if backend == "sim-dex3" else DEX1_1
    keys = [f"{side}_{joint.name}.pos" for side in Side for joint in hand.joints[side]]
    high = 0.8 if backend == "sim-dex3" else 4.0
    robot = ["--robot.type=dexkit", f"--robot.backend={backend}"]
    servos: list[Tool] = []
    try:
        if backend == "ezgripper":
            links = {str(side): str(tmp_path / f"tty-{side}") for side in Side}
            for link in links.values():
                servos.append(Tool("emulate", "mx64", "--link", link))
                servos[-1].wait_ready(threading.Event())
            config = {"calibrate": "yes", "config": str(tmp_path / "calibration.yaml")}
            robot += [f"--robot.devices={json.dumps(links)}"]
            robot += [f"--robot.settings={json.dumps(config)}"]
        found = record(host, environment, tmp_path / "data", keys, high, *robot)
        assert follows(found, 0, high) < 0.1
        lerobot(
            host,
            environment,
            *("-m", "lerobot.scripts.lerobot_replay", *robot, "--play_sounds=false"),
            *("--dataset.repo_id=me/sweep", f"--dataset.root={tmp_path / 'data'}"),
            "--dataset.episode=0",
        )
    finally:
        for servo in servos:
            servo.stop()


@contextmanager
def whole_robot(host: Host) -> Iterator[subprocess.Popen[str]]:
    """``dexkit emulate all --for lerobot``, ended by Ctrl-C."""
    process = host.popen(
        *(sys.executable, "-m", "dexkit", "emulate", "all", "--for", "lerobot"),
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("ready: "):
            break
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
        print(out)
    assert process.returncode == 0, out
    assert "Traceback" not in out


JOINTS = """
from lerobot.robots.unitree_g1.g1_utils import G1_29_JointIndex
print("FOUND " + " ".join(f"{j.name}.q" for j in G1_29_JointIndex))
"""
G1 = """
import sys, time, types
import lerobot.envs
from lerobot.robots.unitree_g1 import UnitreeG1, UnitreeG1Config

class Nothing:
    def step(self): ...
    def reset(self): ...
    def close(self): ...

if sys.argv[1] == "simulation":  # LeRobot fetches a simulator; the robot is dexkit's here
    lerobot.envs.make_env = lambda *a, **k: {"hub_env": [types.SimpleNamespace(envs=[Nothing()])]}
robot = UnitreeG1(UnitreeG1Config(
    is_simulation=sys.argv[1] == "simulation", robot_ip="127.0.0.1", id=sys.argv[1]))
robot.connect()
first = robot.get_observation()
goal = {k: first[k] for k in robot.action_features} | {"kRightElbow.q": 0.7, "kLeftElbow.q": -0.4}
end = time.monotonic() + 8
while time.monotonic() < end:
    robot.send_action(goal)
    time.sleep(0.02)
seen = robot.get_observation()
robot.disconnect()
print("FOUND", seen["kRightElbow.q"], seen["kLeftElbow.q"], sorted(seen)[-3:], flush=True)
import os; os._exit(0)  # its threads wait for states for ever
"""


@pytest.mark.parametrize("mode", ["hardware", "simulation"])
def test_unitree_g1_of_lerobot_moves_the_emulated_robot(
    host: Host, environment: dict[str, str], mode: str
) -> None:
    with whole_robot(host):
        out = lerobot(host, environment, "-c", G1, mode)
    found = next(line for line in out.splitlines() if line.startswith("FOUND ")).split()
    assert float(found[1]) == pytest.approx(0.7, abs=0.1)
    assert float(found[2]) == pytest.approx(-0.4, abs=0.1)


def test_lerobot_records_the_emulated_g1_with_its_camera(
    host: Host, environment: dict[str, str], tmp_path: Path
) -> None:
    out = lerobot(host, environment, "-c", JOINTS)
    keys = next(line for line in out.splitlines() if line.startswith("FOUND ")).split()[1:]
    camera = {
        "head": {
            **{"type": "zmq", "server_address": "127.0.0.1", "port": 5555},
            **{"camera_name": "head_camera", "width": 640, "height": 480, "fps": 30},
        }
    }
    with whole_robot(host):
        found = record(
            *(host, environment, tmp_path / "data", keys, 0.3),
            *("--robot.type=unitree_g1", "--robot.is_simulation=false"),
            *("--robot.robot_ip=127.0.0.1", f"--robot.cameras={json.dumps(camera)}"),
        )
    assert follows(found, keys.index("kRightElbow.q"), 0.3) < 0.15
    assert found["pictures"] == ["torch.Size([3, 480, 640])"]
