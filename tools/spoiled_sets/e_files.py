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
from dexkit.traces.sessions.lerobot_out import TASKS_METADATA
from dexkit.traces.sessions.lerobot_stats import statistics
from dexkit.traces.writer import RecordingWriter
from tools.spoiled_sets.e_faults import ALL, Fault
from tools.spoiled_sets.e_motion import ARM, HANDS, SIDES, TOUCH, Floats, Label, Take

SIZE = (96, 72)  # width and height of pictures
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


def column_names(made: Set) -> list[str]:
    """The joints' names in the order of the columns."""
    found = []
    for part in made.parts:
        side, kind = part.split("_")
        joints = ARM if kind == "arm" else HANDS[made.model].motors
        for joint in joints:
            if made.names == "unitree":
                word = "" if kind == "arm" or joint == "Gripper" else "Hand"
                found.append(f"k{side.capitalize()}{word}{joint}")
            else:
                snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in joint).lstrip("_")
                if made.model == "dex5-1" and kind == "hand":
                    snake = joint
                elif snake[-1].isdigit():
                    snake = f"{snake[:-1]}_{snake[-1]}"
                found.append(f"{side}_{snake}" + (".pos" if made.names == "other" else ""))
    if made.names == "unitree" and made.model == "dex3-1" and len(found) == 28:
        found[24:] = [f"kRightHand{j}" for j in ("Index0", "Index1", "Middle0", "Middle1")]
    return found


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


class Film:
    """A video; pictures are drawn as they are added."""

    def __init__(self, path: Path, fps: float) -> None:
        self._av: Any = importlib.import_module("av")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._av.open(str(path), "w")
        self._stream = self._file.add_stream("libx264", rate=round(fps))
        self._stream.width, self._stream.height = SIZE
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"preset": "ultrafast", "crf": "28", "threads": "1", "g": "15"}
        self.count = 0

    def add(self, take: Take, name: str, which: int) -> None:
        """Add the pictures of an episode, as far as it has them."""
        for i in take.shown[name].tolist():
            picture = draw(take, i, which)
            frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
            for packet in self._stream.encode(frame):
                self._file.mux(packet)
            self.count += 1

    def close(self) -> None:
        """Finish the file."""
        for packet in self._stream.encode():
            self._file.mux(packet)
        self._file.close()


def picture_statistics(takes: Sequence[Take], name: str, which: int) -> dict[str, list[Any]]:
    """Statistics of ten pictures of each episode, by channel."""
    pictures = [
        draw(take, int(take.shown[name][i]), which).reshape(-1, 3)
        for take in takes
        for i in np.unique(np.linspace(0, len(take.shown[name]) - 1, 10).astype(int)).tolist()
    ]
    pixels = np.concatenate(pictures)
    found = statistics(pixels / 255.0)
    shaped = {k: [[[x]] for x in v] for k, v in found.items() if k != "count"}
    return {**shaped, "count": [len(pictures)]}


# -- LeRobot ----------------------------------------------------------------------------------


def finite_statistics(table: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics over the rows without NaN and infinity."""
    rows = np.isfinite(table.reshape(len(table), -1)).all(axis=1)
    return statistics(table[rows])


def vectors(made: Set, take: Take) -> dict[str, NDArray[np.float32]]:
    """The vectors of an episode by the name of their feature."""
    fields = {"state": "observation.state", "velocity": "observation.velocity",
              "effort": "observation.effort"}  # fmt: skip
    found = {
        key: np.concatenate([getattr(t, c) for t in take.tracks.values()], axis=1)
        for c, key in fields.items()
        if c in made.columns
    }
    found["action"] = np.concatenate([t.action for t in take.tracks.values()], axis=1)
    if "pressure" in made.columns:
        found["observation.pressure"] = np.concatenate(list(take.touch.values()), axis=1)
    return {k: v.astype(np.float32) for k, v in found.items()}


def features(made: Set, found: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
    """The features as ``info.json`` has them."""
    names = column_names(made)
    table: dict[str, Any] = {}
    for key, value in found.items():
        own = [f"{s}_hand_{p}" for s in SIDES for p in TOUCH] if "pressure" in key else names
        boxed: Any = [own] if made.names == "unitree" else own
        table[key] = {"dtype": "float32", "shape": [value.shape[1]], "names": boxed}
    for name in made.cameras:
        table[f"observation.images.{name}"] = {
            "dtype": "video", "shape": [SIZE[1], SIZE[0], 3],
            "names": ["height", "width", "channels"],
            "info": {"video.fps": made.fps, "video.height": SIZE[1], "video.width": SIZE[0],
                     "video.channels": 3, "video.codec": "h264", "video.pix_fmt": "yuv420p",
                     "video.is_depth_map": False, "has_audio": False},
        }  # fmt: skip
    for key in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        dtype = "float32" if key == "timestamp" else "int64"
        table[key] = {"dtype": dtype, "shape": [1], "names": None}
    return table


def write_lerobot(root: Path, made: Set, takes: Sequence[Take]) -> None:
    """Write a dataset as LeRobot of this version does."""
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    new = made.form == "v3.0"
    (root / "meta").mkdir(parents=True)
    tasks: dict[str, int] = {}
    rows, per_episode, every, tables = [], [], [], []
    films: dict[str, Film] = {}
    first = 0
    for e, take in enumerate(takes):
        n = len(take)
        task = tasks.setdefault(take.task, len(tasks))
        found = vectors(made, take)
        plain: dict[str, NDArray[Any]] = {
            "timestamp": (take.number / (made.stamp or made.fps)).astype(np.float32),
            "frame_index": take.number,
            "episode_index": np.full(n, e),
            "index": np.arange(first, first + n),
            "task_index": np.full(n, task),
        }
        stats = {k: finite_statistics(v) for k, v in (found | plain).items()}
        every.append(found | plain)
        row: dict[str, Any] = {"episode_index": e, "tasks": [take.task], "length": n}
        for which, name in enumerate(made.cameras):
            key = f"observation.images.{name}"
            stats[key] = picture_statistics([take], name, which)
            if new:
                film = films.get(name) or films.setdefault(
                    name, Film(root / f"videos/{key}/chunk-000/file-000.mp4", made.fps)
                )
                begin = film.count
                film.add(take, name, which)
                row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0,
                        f"videos/{key}/from_timestamp": begin / made.fps,
                        f"videos/{key}/to_timestamp": film.count / made.fps}  # fmt: skip
            elif take.done.get("no camera") != name:
                film = Film(root / f"videos/chunk-000/{key}/episode_{e:06d}.mp4", made.fps)
                film.add(take, name, which)
                film.close()
        if "wrong stats" in take.done:  # those of the data before they were converted
            for key in ("observation.state", "action"):
                stats[key] = finite_statistics(found[key] * take.done["wrong stats"] + 0.4)
        columns = {
            k: arrow.FixedSizeListArray.from_arrays(
                arrow.array(v.reshape(-1), type=arrow.float32()), v.shape[1]
            )
            if v.shape[1] > 1
            else arrow.array(v[:, 0])
            for k, v in found.items()
        }
        columns |= {k: arrow.array(v) for k, v in plain.items()}
        table = arrow.table(columns)
        if take.done.get("rows"):
            table = table.slice(0, n - take.done["rows"])
        if new:
            row |= {"data/chunk_index": 0, "data/file_index": 0, "dataset_from_index": first,
                    "dataset_to_index": first + n, "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0}  # fmt: skip
            row |= {f"stats/{k}/{s}": v for k, d in stats.items() for s, v in d.items()}
            tables.append(table)
        else:
            path = root / f"data/chunk-000/episode_{e:06d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(table, str(path))
            if take.done.get("half file"):
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        per_episode.append({"episode_index": e, "stats": _old_statistics(stats)})
        rows.append(row)
        first += n
    whole = {
        k: finite_statistics(np.concatenate([v[k] for v in every])) for k in every[0]
    }  # fmt: skip
    info: dict[str, Any] = {
        "codebase_version": made.form,
        "robot_type": {"unitree": "Unitree_G1", "dexkit": made.model}.get(made.names, "bi_dexkit"),
        "total_episodes": len(takes), "total_frames": first, "total_tasks": len(tasks),
        "chunks_size": 1000, "fps": made.fps if made.fps % 1 else int(made.fps),
        "splits": {"train": f"0:{len(takes)}"},
    }  # fmt: skip
    if new:
        for film in films.values():
            film.close()
        path = root / "data/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        with parquet.ParquetWriter(str(path), tables[0].schema) as writer:
            for table in tables:
                writer.write_table(table)
        (root / "meta/episodes/chunk-000").mkdir(parents=True)
        parquet.write_table(
            arrow.Table.from_pylist(rows), str(root / "meta/episodes/chunk-000/file-000.parquet")
        )
        listed = arrow.table({"task_index": list(tasks.values()), "task": list(tasks)})
        listed = listed.replace_schema_metadata(TASKS_METADATA)
        parquet.write_table(listed, str(root / "meta/tasks.parquet"))
        info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
                 "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                 "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-"
                 "{file_index:03d}.mp4" if made.cameras else None}  # fmt: skip
        for which, name in enumerate(made.cameras):
            whole[f"observation.images.{name}"] = picture_statistics(takes, name, which)
        write_json(root / "meta/stats.json", whole)
    else:
        info |= {"total_videos": len(takes) * len(made.cameras), "total_chunks": 1,
                 "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
                 "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_"
                 "{episode_index:06d}.mp4" if made.cameras else None}  # fmt: skip
        write_lines(root / "meta/episodes.jsonl", rows)
        write_lines(
            root / "meta/tasks.jsonl", [{"task_index": i, "task": t} for t, i in tasks.items()]
        )
        if made.form == "v2.1":
            write_lines(root / "meta/episodes_stats.jsonl", per_episode)
        else:
            write_json(root / "meta/stats.json", _old_statistics(whole))
    info["features"] = features(made, vectors(made, takes[0]))
    write_json(root / "meta/info.json", info)


def _old_statistics(stats: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {k: {s: x for s, x in d.items() if s[0] != "q"} for k, d in stats.items()}


def write_json(path: Path, value: Any) -> None:
    """Write a document."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False) + "\n")


def write_lines(path: Path, rows: Sequence[Any]) -> None:
    """Write JSON lines."""
    path.write_text("".join(json.dumps(r, ensure_ascii=False) + "\n" for r in rows))


# -- xr_teleoperate, and what dexkit makes of it ----------------------------------------------


def _row(table: Floats, i: int) -> list[float]:
    return [round(float(x), 7) for x in table[i]]


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
                        "qpos": _row(t.state if key == "states" else t.action, i),
                        "qvel": _row(t.velocity, i) if more else [],
                        "torque": _row(t.effort, i) if more else [],
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
