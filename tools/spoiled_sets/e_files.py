"""Files of LeRobot, xr_teleoperate and dexkit that :mod:`author_e` writes."""

from __future__ import annotations

import importlib
import io
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.traces import sample_path
from dexkit.traces.reader import Trace, open_trace
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.writer import RecordingWriter
from tools.spoiled_sets.e_faults import ALL, Fault
from tools.spoiled_sets.e_motion import ARM, HANDS, TOUCH, Label, Take
from tools.spoiled_sets.lerobot_files import SIZE, Author, row_of, write_lines

START_NS = 1_796_000_000_000_000_000


@dataclass(frozen=True)
class Entry:
    """One episode to be made.

    :param rate: frames a second that it truly has; 0 for the set's.
    :param seed: of the motion, to make two that are alike; -1 for its own.
    :param copied: the episode that it is a copy of; -1 for none.
    """

    label: Label
    style: dict[str, Any]
    do: Fault | None = None
    rate: float = 0
    seed: int = -1
    copied: int = -1
    task: int = 0


@dataclass(frozen=True)
class Set:
    """One dataset or task folder.

    :param form: LeRobot v2.0, v2.1, v3.0, export (by dexkit itself), or xr v0.5, v1.1, v1.4.
    :param names: unitree (unitree_lerobot's), dexkit, other.
    :param columns: of state, velocity, effort, pressure.
    :param stamp: frames a second that the stamps show; 0 for ``fps``.
    """

    name: str
    form: str
    model: str
    fps: float
    entries: tuple[Entry, ...]
    names: str = "unitree"
    cameras: tuple[str, ...] = ()
    columns: tuple[str, ...] = ("state",)
    parts: tuple[str, ...] = ALL
    base: dict[str, Any] = field(default_factory=dict)
    tasks: tuple[str, ...] = ("Pick up the object and put it on the plate.",)
    stamp: float = 0


# -- pictures ---------------------------------------------------------------------------------

_ROWS, _COLUMNS = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float32)
_WALLS = [
    np.repeat((90 + 50 * ((_COLUMNS // 12 + _ROWS // 12 + i) % 2) + 0.4 * _ROWS)[..., None], 3, 2)
    for i in range(4)
]


_GRAIN = np.random.default_rng(9).normal(0, 2.5, (16, SIZE[1], SIZE[0], 1)).astype(np.float32)


def draw(take: Take, frame: int, which: int) -> NDArray[np.uint8]:
    """A picture of two hands on a table as they were at a frame, (72, 96, 3)."""
    picture = _WALLS[which].copy()
    tints = ((200, 60, 50), (50, 90, 210))
    for tint, (x, y, r) in zip(tints, take.seen[frame].reshape(2, 3), strict=True):
        x, y = (x, y) if which == 0 else (SIZE[0] - x * 0.8, y * 0.8 + 8)
        box = (
            slice(max(0, int(y - r - 5)), max(0, int(y + r + 6))),
            slice(max(0, int(x - r - 5)), max(0, int(x + r + 6))),
        )
        away = np.hypot(_COLUMNS[box] - np.float32(x), _ROWS[box] - np.float32(y))
        near = np.clip(np.float32(r) + 4 - away, 0, 1)[..., None]
        picture[box] = picture[box] * (1 - near) + np.array(tint, dtype=np.float32) * near
    found: NDArray[np.uint8] = np.clip(picture + _GRAIN[frame % 16], 0, 255).astype(np.uint8)
    return found


AUTHOR = Author(
    joints=lambda model: HANDS[model].motors,
    arm=ARM,
    touch=TOUCH,
    draw=draw,
    video={"crf": "28", "g": "15"},
    pictures=10,
    robot="bi_dexkit",
)


# -- xr_teleoperate, and what dexkit makes of it ----------------------------------------------


def write_xr(root: Path, made: Set, takes: Sequence[Take], full: bool = False) -> None:
    """Write a task folder as xr_teleoperate of this release does; ``full`` with velocities."""
    images: Any = importlib.import_module("PIL.Image")
    old = made.form.endswith("v0.5")
    named = {p: p if old else p.replace("hand", "ee") for p in made.parts}
    jitter = np.random.default_rng(len(takes))
    for e, take in enumerate(takes):
        folder = root / f"episode_{e:04d}"
        for kind in ("colors", "depths", "audios"):
            (folder / kind).mkdir(parents=True)
        items: list[dict[str, Any]] = []
        for i in range(len(take)):
            number = int(take.number[i])
            item: dict[str, Any] = {"idx": number, "colors": {}, "depths": {}}
            if full:
                item["timestamp_ns"] = START_NS + round(
                    (number * 1e9 + float(jitter.uniform(0, 2e6))) / take.done.get("hz", made.fps)
                )
            for which, name in enumerate(made.cameras):
                shown = take.shown[name]
                path = f"colors/{number:06d}_{name}.jpg"
                item["colors"][name] = path
                if i >= len(shown) or take.done.get("no camera") == name:
                    continue
                data = io.BytesIO()
                images.fromarray(draw(take, int(shown[i]), which)).save(data, "JPEG", quality=80)
                (folder / path).write_bytes(data.getvalue())
            for key in ("states", "actions"):
                item[key] = {}
                for part, t in take.tracks.items():
                    more = full and key == "states"
                    item[key][named[part]] = {
                        "qpos": row_of(t.state if key == "states" else t.action, i),
                        "qvel": row_of(t.velocity, i) if more else [],
                        "torque": row_of(t.effort, i) if more else [],
                    }
                item[key]["body"] = None if old else {"qpos": []}
            item |= {"tactiles": None, "audios": None}
            if not old:
                item["sim_state"] = None
            items.append(item)
        arms = [f"k{s}{j}" for s in ("Left", "Right") for j in ARM]
        lists = {"left_arm": arms[:7], "right_arm": arms[7:]} if made.form[-3:] != "1.4" else {}
        joints = {name: lists.get(name, []) for name in (*named.values(), "body")}
        info = {
            "version": "1.0.0", "date": "2026-11-20", "author": "unitree",
            "image": {"width": SIZE[0], "height": SIZE[1], "fps": int(made.fps)},
            "depth": {"width": SIZE[0], "height": SIZE[1], "fps": int(made.fps)},
            "audio": {"sample_rate": 16000, "channels": 1, "format": "PCM", "bits": 16},
            "joint_names": joints,
            "tactile_names": {"left_ee": [], "right_ee": []},
        }  # fmt: skip
        text = {"goal": take.task, "desc": "", "steps": ""}
        if "goal" in take.done:
            text["goal"] = take.done["goal"]
        if made.form.endswith("1.4"):
            head = [json.dumps(x, indent=4) for x in (info, text)]
            lines = ",\n".join(json.dumps(item) for item in items)
            written = f'{{\n"info": {head[0]},\n"text": {head[1]},\n"data": [\n{lines}\n]\n}}'
        else:
            whole = {"info": info, "text": text, "data": items}
            written = json.dumps(whole, indent=4, ensure_ascii=False)
        data_bytes = written.encode()
        if "latin" in take.done:  # as an editor with another encoding saved it
            data_bytes = data_bytes.replace(take.task.encode(), b"Pos\xe9 la tasse \xe0 droite")
        if "cut" in take.done:
            data_bytes = data_bytes[: round(len(data_bytes) * take.done["cut"])]
        (folder / "data.json").write_bytes(data_bytes)


def dexkit(*words: str | Path) -> None:
    """Run a command of dexkit that leaves nothing out but what is named in its documents."""
    found = subprocess.run(
        [sys.executable, "-m", "dexkit", *map(str, words)], capture_output=True, text=True
    )
    if found.returncode not in (0, 1):
        raise RuntimeError(f"dexkit {' '.join(map(str, words))}: {found.stderr or found.stdout}")


def write_export(root: Path, made: Set, takes: Sequence[Take]) -> None:
    """By dexkit's own import and export."""
    work = root.with_name(f"{root.name}.work")
    write_xr(work / "task", made, takes, full=True)
    dexkit("import", work / "task", work / "recordings", "--set", "keep-sides=yes")
    recordings = sorted((work / "recordings").rglob("*.mcap"))
    dexkit("export", *recordings, "--to", "lerobot", "--out", root, "--set", f"fps={made.fps:.0f}")
    shutil.rmtree(work)


# -- recordings -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Wire:
    """A piece of a sample as it was on the wire, with at most one fault in it.

    :param frozen: topics whose payload stays the same in ``window``.
    :param lost: topics without messages in ``window``.
    :param late: topics whose messages come later by ``by`` seconds.
    """

    name: str
    source: str
    begin: float
    end: float
    label: Label
    frozen: str = "-"
    lost: str = "-"
    late: str = "-"
    by: float = 0.0
    window: tuple[float, float] = (0, 0)


def write_wire(path: Path, wire: Wire) -> None:
    """Write a piece of a sample."""
    trace: Trace = open_trace(sample_path(wire.source))
    first = trace.first_ns + round(wire.begin * 1e9)
    last = trace.first_ns + round(wire.end * 1e9)
    if not (wire.label.fault and max(wire.frozen, wire.lost, wire.late) > "-"):
        cut(trace, path, spans=[Span(first, last)], metadata={})
        return
    a, b = (first + round(x * 1e9) for x in wire.window)
    held: dict[str, bytes] = {}
    with RecordingWriter(path) as writer:
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        for m in trace.messages():
            time_ns, sent_ns, data = m.log_time_ns, m.publish_time_ns, m.data
            if wire.late in m.topic:
                time_ns, sent_ns = time_ns + round(wire.by * 1e9), sent_ns + round(wire.by * 1e9)
            if not first <= time_ns < last:
                continue
            if a <= time_ns < b:
                if wire.lost in m.topic:
                    continue
                if wire.frozen in m.topic:
                    data = held.setdefault(m.topic, data)
            writer.put(numbers[m.topic, m.type_name], data, time_ns, sent_ns)


def write_session(path: Path, made: Set, take: Take) -> None:
    """A recording of arms and hands at the rate of frames, with their times."""
    work = path.with_name(f"{path.stem}.work")
    write_xr(work / "task", made, [take], full=True)
    document = json.loads((work / "task/episode_0000/data.json").read_text())
    lines = [{"info": document["info"], "text": document["text"]}, *document["data"]]
    write_lines(work / f"{path.stem}.jsonl", lines)
    dexkit(
        "import", work / f"{path.stem}.jsonl", path,
        "--set", "keep-sides=yes", "--set", f"hand={made.model}",
    )  # fmt: skip
    shutil.rmtree(work)
