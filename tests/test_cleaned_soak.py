"""LeRobot itself reads a set that ``dexkit export --drop`` has cleaned, as it read the whole set.

It needs the Python of docs/lerobot.md in ``.tools/lerobot``, as test_lerobot_soak does.
"""

from __future__ import annotations

import json
import os
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexkit.child_processes import command_line

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.soak

ROOT = Path(__file__).parent.parent
PYTHON = ROOT / ".tools" / "lerobot" / "bin" / "python"
DROPPED = (1, 3)

if not PYTHON.exists():
    pytest.skip(f"no LeRobot in {PYTHON.parent.parent}: docs/lerobot.md", allow_module_level=True)

RECORD = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

joints = [f"{side}_thumb_{i}" for side in ("left", "right") for i in range(3)]
number = {"dtype": "float32", "shape": (6,), "names": joints}
camera = {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
found = LeRobotDataset.create(
    "me/whole", 30, root=sys.argv[1], robot_type="g1",
    features={"observation.state": number, "action": number, "observation.images.head": camera})
chance = np.random.default_rng(5)
for episode in range(5):
    for frame in range(30 + 7 * episode):
        picture = np.full((48, 64, 3), 20 + 40 * episode, np.uint8)
        picture[:, frame % 64 : frame % 64 + 9] = 255
        state = chance.normal(size=6).astype(np.float32)
        found.add_frame({"observation.state": state, "action": state + np.float32(0.1),
                         "observation.images.head": picture, "task": f"task {episode % 3}"})
    found.save_episode()
found.finalize()
"""

READ = """
import hashlib, json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

def row(values):
    return {k: v if isinstance(v, str)
            else hashlib.sha256(v.numpy().tobytes()).hexdigest() if "images" in k
            else v.tolist() for k, v in values.items()}

def dataset(**more):
    return LeRobotDataset("me/any", root=sys.argv[1], **more)

found = dataset()
ahead = dataset(delta_timestamps={"action": [0.0, 1 / found.fps]})
print("FOUND " + json.dumps({
    "fps": found.fps,
    "features": {k: {**v, "info": None} for k, v in found.features.items()},
    "episodes": found.num_episodes,
    "frames": found.num_frames,
    "rows": [row(found[i]) for i in range(len(found))],
    "last": [bool(ahead[i]["action_is_pad"][-1]) for i in range(len(ahead))],
    "each": [[row(r) for r in dataset(episodes=[n])] for n in range(found.num_episodes)],
    "stats": {k: {s: np.asarray(v).tolist() for s, v in stats.items()}
              for k, stats in found.meta.stats.items()},
}))
"""

DELETE = """
import json, os, sys
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.lerobot_dataset import LeRobotDataset

whole = LeRobotDataset("me/whole", root=sys.argv[1])
delete_episodes(whole, json.loads(sys.argv[3]), output_dir=sys.argv[2], repo_id="me/less")
os._exit(0)  # its encoder may abort the end of the interpreter
"""


def lerobot(home: Path, code: str, *arguments: object) -> str:
    """Run LeRobot's Python to its end, without network; what it printed."""
    done = subprocess.run(
        [PYTHON, "-c", code, *map(str, arguments)],
        env={
            "PATH": os.environ["PATH"],
            "HOME": str(home),
            "HF_HOME": str(home / "hf"),
            "HF_HUB_OFFLINE": "1",
            "CUDA_VISIBLE_DEVICES": "",
        },
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-6000:]
    return done.stdout


def read(folder: Path) -> Any:
    out = lerobot(folder.parent, READ, folder)
    line = next(line for line in out.splitlines() if line.startswith("FOUND "))
    return json.loads(line.removeprefix("FOUND "))


def dexkit(*arguments: object) -> None:
    command = command_line(*map(str, arguments))
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode in (0, 1), done.stderr


def recorded(folder: Path) -> None:
    """Five episodes by LeRobot, with a camera's video."""
    lerobot(folder.parent, RECORD, folder)


def exported(folder: Path) -> None:
    """Five episodes by dexkit, of the samples of the Dex1-1."""
    names = ("hand_dropout", "idle_then_startle", "legacy_v1_1", "pick_place")
    samples = [f"traces/samples/dex1_{name}.mcap" for name in names]
    dexkit("export", *samples, "--to", "lerobot", "--out", folder, "--set", "fps=10")


def without(found: Any, dropped: tuple[int, ...]) -> list[dict[str, Any]]:
    """The rows of the other episodes, numbered as if these had never been."""
    kept = [row for row in found["rows"] if row["episode_index"] not in dropped]
    numbers = sorted({row["episode_index"] for row in kept})
    return [
        {**row, "index": i, "episode_index": numbers.index(row["episode_index"])}
        for i, row in enumerate(kept)
    ]


def verdicts(folder: Path, path: Path) -> Path:
    episodes = [
        {"source": folder.name, "place": str(folder), "episode": n, "verdict": v, "reasons": ["so"]}
        for n in range(5)
        for v in ["drop" if n in DROPPED else "keep"]
    ]
    head = {"format": "dexkit-episodes", "version": 1}
    path.write_text(json.dumps({**head, "episodes": episodes}))
    return path


@pytest.mark.parametrize("made", [recorded, exported])
def test_lerobot_reads_every_kept_frame_as_it_was(tmp_path: Path, made: Any) -> None:
    whole, less, by_lerobot = (tmp_path / name for name in ("whole", "less", "by_lerobot"))
    made(whole)
    dexkit("export", whole, "--out", less, "--drop", verdicts(whole, tmp_path / "episodes.json"))
    before, after = read(whole), read(less)
    assert (before["episodes"], after["episodes"]) == (5, 3)
    rows = without(before, DROPPED)
    assert after["rows"] == rows
    assert after["frames"] == len(rows)
    assert [after[k] for k in ("fps", "features")] == [before[k] for k in ("fps", "features")]
    ends = [a["episode_index"] != b["episode_index"] for a, b in pairwise(rows)]
    assert after["last"] == [*ends, True]
    for number, episode in enumerate(after["each"]):
        assert episode == [row for row in rows if row["episode_index"] == number]
    for feature in ("observation.state", "action"):
        values = np.array([row[feature] for row in rows])
        for name, of in (("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0))):
            assert after["stats"][feature][name] == pytest.approx(of, abs=1e-5)
        assert after["stats"][feature]["std"] == pytest.approx(values.std(0), abs=1e-5)
        assert after["stats"][feature]["count"] == [len(rows)]
    # LeRobot's own tool encodes its videos anew, and leaves the numbers as they were, except those
    # of the tasks
    lerobot(tmp_path, DELETE, whole, by_lerobot, json.dumps(DROPPED))
    own = read(by_lerobot)
    assert own["episodes"] == 3
    for row, theirs in zip(after["rows"], own["rows"], strict=True):
        numbers = {k: v for k, v in row.items() if "images" not in k and k != "task_index"}
        assert numbers == {k: theirs[k] for k in numbers}
