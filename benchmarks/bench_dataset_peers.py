"""The audit of a LeRobot dataset, and the programs that others have made for it: speed and memory.

``DOCTOR=.../lerobot-doctor LINT=.../lelint`` are their commands, each of an environment of its own;
without them the audit is measured alone. The set has ``EPISODES`` episodes of 18.5 s at 30 fps
without pictures: a Dex3-1's sample, each time with another slow motion added. Steady state is what
more episodes take, without the start of the program. For sets of your own, and for who finds which
fault, see ``python -m benchmarks.dataset_peers --help``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from benchmarks import Result
from benchmarks.dataset_peers.programs import (
    Program,
    dexkit_audit,
    lerobot_doctor,
    lerobot_lint,
    measured,
)

_EPISODES = int(os.environ.get("EPISODES", "60"))
_TARGET = 1000.0
_SAMPLE = Path(__file__).parent.parent / "traces" / "samples" / "dex3_pinch.mcap"
_ADDED_RAD = 0.05


@dataclass(frozen=True)
class _Cost:
    """What a program takes: times real time on a core, s to start, MiB at most."""

    tool: str
    speed: float
    start_s: float
    peak_mib: float


def run() -> list[Result]:
    programs: list[Program] = [dexkit_audit()]
    if doctor := os.environ.get("DOCTOR"):
        programs.append(lerobot_doctor(doctor)[0])
    if lint := os.environ.get("LINT"):
        programs.append(lerobot_lint(lint))
    with tempfile.TemporaryDirectory() as name:
        sets = [_dataset(Path(name) / str(count), count) for count in (1, _EPISODES)]
        costs = [_cost(program, *sets) for program in programs]
    mine, *others = costs
    speed, unit = "dexkit audit of a LeRobot dataset, a core in steady state", "times real time"
    about = f"{_EPISODES} episodes without pictures"
    found = [
        Result(
            speed, mine.speed, unit, f"{_TARGET:g} {unit}", _TARGET, mine.speed / _TARGET,
            f">= {_TARGET:g}", mine.speed >= _TARGET, about,
        )
    ]  # fmt: skip
    for peer in others:
        found += [
            Result(speed, mine.speed, unit, peer.tool, peer.speed, mine.speed / peer.speed),
            Result(
                "dexkit audit, start and one episode",
                mine.start_s,
                "s of a core",
                peer.tool,
                peer.start_s,
                peer.start_s / mine.start_s,
            ),
            Result(
                f"dexkit audit of {about}, memory",
                mine.peak_mib,
                "MiB",
                peer.tool,
                peer.peak_mib,
                peer.peak_mib / mine.peak_mib,
            ),
        ]
    return found


def _cost(program: Program, one: Path, many: Path) -> _Cost:
    measured(program, one)  # Python compiles what it has not yet compiled
    short, long = measured(program, one), measured(program, many)
    assert not short.trouble + long.trouble, (short, long)
    assert short.recorded_s is not None
    assert long.recorded_s is not None
    speed = (long.recorded_s - short.recorded_s) / (long.cpu_s - short.cpu_s)
    return _Cost(short.tool, speed, short.cpu_s, long.peak_mib)


def _dataset(folder: Path, episodes: int) -> Path:
    """A dataset of the sample, to each episode of which another motion is added."""
    command = [sys.executable, "-m", "dexkit", "export", *[str(_SAMPLE)] * episodes]
    options = ["--to", "lerobot", "--set", "fps=30", "--out", str(folder)]
    subprocess.run([*command, *options], check=True, capture_output=True)
    chance = np.random.default_rng(episodes)
    for path in sorted(folder.glob("data/*/*.parquet")):
        table = pyarrow.parquet.read_table(path)
        episode, t = (table[name].to_numpy() for name in ("episode_index", "timestamp"))
        joints = len(table["action"][0])
        shape = (1 + episode.max(), joints)
        hertz, phase = chance.uniform(0.05, 0.3, shape), chance.uniform(0.0, 6.28, shape)
        added = _ADDED_RAD * np.sin(6.28 * hertz[episode] * t[:, None] + phase[episode])
        for name in ("observation.state", "action"):
            values = np.stack(table[name].to_numpy(zero_copy_only=False)) + added
            place = table.schema.get_field_index(name)
            field = table.schema.field(place)
            table = table.set_column(place, field, pyarrow.array(values.tolist(), field.type))
        pyarrow.parquet.write_table(table, path)
    return folder
