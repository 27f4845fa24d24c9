"""Files of LeRobot datasets, as several authors write them."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dexkit.traces.sessions.lerobot_out import TASKS_METADATA
from dexkit.traces.sessions.lerobot_stats import statistics

__all__ = ["SIDES", "SIZE", "Author", "row_of", "write_json", "write_lerobot", "write_lines"]

SIDES = ("left", "right")
SIZE = (96, 72)
"""Width and height of pictures."""


class Take(Protocol):
    """An episode.

    ``tracks`` by part have ``state``, ``action``, ``velocity`` and ``effort``, shape (frames,
    joints); ``touch`` by hand, left first, shape (frames, elements). ``shown`` is, by camera, the
    frame that each picture shows, and ``number`` what the frames say of their number. ``done`` is
    what is done to the files: ``no camera``, ``stats`` (factor, offset), ``rows`` fewer, ``half``.
    """

    @property
    def tracks(self) -> Mapping[str, Any]: ...
    @property
    def touch(self) -> Mapping[str, NDArray[np.float64]]: ...
    @property
    def shown(self) -> Mapping[str, NDArray[np.int64]]: ...
    @property
    def number(self) -> NDArray[np.int64]: ...
    @property
    def task(self) -> str: ...
    @property
    def done(self) -> Mapping[str, Any]: ...
    def __len__(self) -> int: ...


class Set(Protocol):
    """A dataset; ``stamp`` is the rate that its stamps show, 0 for ``fps``."""

    @property
    def form(self) -> str: ...
    @property
    def model(self) -> str: ...
    @property
    def fps(self) -> float: ...
    @property
    def names(self) -> str: ...
    @property
    def cameras(self) -> tuple[str, ...]: ...
    @property
    def columns(self) -> tuple[str, ...]: ...
    @property
    def parts(self) -> tuple[str, ...]: ...
    @property
    def stamp(self) -> float: ...


@dataclass(frozen=True)
class Author:
    """What differs between authors.

    :param joints: of a hand's model, the words of its joints.
    :param arm: words of the joints of an arm.
    :param touch: names of the elements of a hand's sensors.
    :param draw: the picture of an episode's frame, by a camera's place.
    :param video: options of the codec.
    :param pictures: of an episode that the statistics are of.
    :param robot: its type where neither unitree's nor dexkit's names are used.
    """

    joints: Callable[[str], Sequence[str]]
    arm: Sequence[str]
    touch: Sequence[str]
    draw: Callable[[Any, int, int], NDArray[np.uint8]]
    video: Mapping[str, str]
    pictures: int
    robot: str


def _column_names(author: Author, made: Set) -> list[str]:
    """The joints' names in the order of the columns."""
    found = []
    for part in made.parts:
        side, kind = part.split("_")
        for joint in author.arm if kind == "arm" else author.joints(made.model):
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


class _Film:
    """A video; pictures are drawn as they are added."""

    def __init__(self, path: Path, fps: float, author: Author) -> None:
        self._av: Any = importlib.import_module("av")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._av.open(str(path), "w")
        self._stream = self._file.add_stream("libx264", rate=round(fps))
        self._stream.width, self._stream.height = SIZE
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"preset": "ultrafast", "threads": "1", **author.video}
        self._draw, self.count = author.draw, 0

    def add(self, take: Take, name: str, which: int) -> None:
        """Add the pictures of an episode, as far as it has them."""
        for i in take.shown[name].tolist():
            picture = self._draw(take, i, which)
            frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
            for packet in self._stream.encode(frame):
                self._file.mux(packet)
            self.count += 1

    def close(self) -> None:
        """Finish the file."""
        for packet in self._stream.encode():
            self._file.mux(packet)
        self._file.close()


def _picture_statistics(
    author: Author, takes: Sequence[Take], name: str, which: int
) -> dict[str, list[Any]]:
    """Statistics of some pictures of each episode, by channel."""
    pictures = [
        author.draw(take, int(take.shown[name][i]), which).reshape(-1, 3)
        for take in takes
        for i in np.unique(
            np.linspace(0, len(take.shown[name]) - 1, author.pictures).astype(int)
        ).tolist()
    ]
    found = statistics(np.concatenate(pictures) / 255.0)
    shaped = {k: [[[x]] for x in v] for k, v in found.items() if k != "count"}
    return {**shaped, "count": [len(pictures)]}


def _finite_statistics(table: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics over the rows without NaN and infinity."""
    rows = np.isfinite(table.reshape(len(table), -1)).all(axis=1)
    return statistics(table[rows])


def _vectors(made: Set, take: Take) -> dict[str, NDArray[np.float32]]:
    """The vectors of an episode by the name of their feature."""
    fields = {"state": "observation.state", "velocity": "observation.velocity",
              "effort": "observation.effort"}  # fmt: skip
    found = {
        key: np.concatenate([getattr(take.tracks[p], c) for p in made.parts], axis=1)
        for c, key in fields.items()
        if c in made.columns
    }
    found["action"] = np.concatenate([take.tracks[p].action for p in made.parts], axis=1)
    if "pressure" in made.columns:
        found["observation.pressure"] = np.concatenate(list(take.touch.values()), axis=1)
    return {k: v.astype(np.float32) for k, v in found.items()}


def _features(author: Author, made: Set, found: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
    """The features as ``info.json`` has them."""
    names = _column_names(author, made)
    table: dict[str, Any] = {}
    for key, value in found.items():
        own = [f"{s}_hand_{p}" for s in SIDES for p in author.touch] if "pressure" in key else names
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


def write_lerobot(author: Author, root: Path, made: Set, takes: Sequence[Take]) -> None:
    """Write a dataset as LeRobot of this version does."""
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    new = made.form == "v3.0"
    (root / "meta").mkdir(parents=True)
    tasks: dict[str, int] = {}
    rows, per_episode, every, tables = [], [], [], []
    films: dict[str, _Film] = {}
    first = 0
    for e, take in enumerate(takes):
        n = len(take)
        task = tasks.setdefault(take.task, len(tasks))
        found = _vectors(made, take)
        plain: dict[str, NDArray[Any]] = {
            "timestamp": (take.number / (made.stamp or made.fps)).astype(np.float32),
            "frame_index": take.number,
            "episode_index": np.full(n, e),
            "index": np.arange(first, first + n),
            "task_index": np.full(n, task),
        }
        stats = {k: _finite_statistics(v) for k, v in (found | plain).items()}
        every.append(found | plain)
        row: dict[str, Any] = {"episode_index": e, "tasks": [take.task], "length": n}
        for which, name in enumerate(made.cameras):
            key = f"observation.images.{name}"
            stats[key] = _picture_statistics(author, [take], name, which)
            if new:
                film = films.get(name) or films.setdefault(
                    name, _Film(root / f"videos/{key}/chunk-000/file-000.mp4", made.fps, author)
                )
                begin = film.count
                film.add(take, name, which)
                row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0,
                        f"videos/{key}/from_timestamp": begin / made.fps,
                        f"videos/{key}/to_timestamp": film.count / made.fps}  # fmt: skip
            elif take.done.get("no camera") != name:
                path = root / f"videos/chunk-000/{key}/episode_{e:06d}.mp4"
                film = _Film(path, made.fps, author)
                film.add(take, name, which)
                film.close()
        if "stats" in take.done:  # those of other data
            factor, offset = take.done["stats"]
            for key in ("observation.state", "action"):
                stats[key] = _finite_statistics(found[key] * factor + offset)
        columns = {
            k: arrow.FixedSizeListArray.from_arrays(
                arrow.array(v.reshape(-1), type=arrow.float32()), v.shape[1]
            )
            if v.shape[1] > 1
            else arrow.array(v[:, 0])
            for k, v in found.items()
        }
        columns |= {k: arrow.array(v) for k, v in plain.items()}
        table = arrow.table(columns).slice(0, n - take.done.get("rows", 0))
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
            if "half" in take.done:
                data = path.read_bytes()
                path.write_bytes(data[: int(len(data) * take.done["half"])])
        per_episode.append({"episode_index": e, "stats": _old_statistics(stats)})
        rows.append(row)
        first += n
    whole = {k: _finite_statistics(np.concatenate([v[k] for v in every])) for k in every[0]}
    info: dict[str, Any] = {
        "codebase_version": made.form,
        "robot_type": {"unitree": "Unitree_G1", "dexkit": made.model}.get(made.names, author.robot),
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
            whole[f"observation.images.{name}"] = _picture_statistics(author, takes, name, which)
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
    info["features"] = _features(author, made, _vectors(made, takes[0]))
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


def row_of(table: NDArray[np.float64], i: int) -> list[float]:
    """A frame's values, rounded as in a document."""
    return [round(float(x), 7) for x in table[i]]
