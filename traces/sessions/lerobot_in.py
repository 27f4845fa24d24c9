"""Read LeRobot datasets of v2.0, v2.1 and v3.0: every episode as a session.

A dataset has one vector of positions per frame with named elements; the names identify hands and
arms. unitree_lerobot names the right Dex3's columns thumb, index, middle, while the numbers
are in the order of the wire, thumb, middle, index (docs/sources/sessions.md#b2): there the index
counts instead of the name, and a note says so.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.documents import read_bytes
from dexkit.errors import SessionError
from dexkit.hand import Floats, Side
from dexkit.models import DIALECTS, HandModel, model
from dexkit.traces.sessions.episodes import DEFAULT, Options, correct_sides
from dexkit.traces.sessions.imported import EPOCH_NS, NOMINAL
from dexkit.traces.sessions.lerobot_format import (
    COLUMNS,
    EXTENSION,
    PICTURES,
    parquet_library,
    read_parquet,
)
from dexkit.traces.sessions.model import Camera, Part, Problems, Session
from dexkit.traces.sessions.pictures import safe_path
from dexkit.traces.sessions.ros_types import LAST_NS
from dexkit.traces.sessions.streams import HAND

__all__ = ["Dataset", "is_dataset"]

_VERSIONS = ("v2.0", "v2.1", "v3.0")
_INDEXES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
MOST_FRAMES = 1_000_000
"""Frames of an episode: 9 hours at 30 a second."""
_MAX_JSON = 256 * 2**20


def is_dataset(source: Path) -> bool:
    """Whether it looks like a LeRobot dataset."""
    return (source / "meta" / "info.json").is_file()


@dataclass(frozen=True)
class _Group:
    """A part and the columns of the vector that are its joints."""

    name: str
    joints: tuple[str, ...]
    columns: tuple[int, ...]
    model: HandModel | None = None


class Dataset:
    """A LeRobot dataset on the disk.

    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: it cannot be read, or is of another version.
    """

    def __init__(self, root: Path, options: Options = DEFAULT) -> None:
        parquet_library()  # told before anything is read
        self.root = root
        self.options = options
        info = _read_json(root / "meta" / "info.json")
        if not isinstance(info, dict):
            raise SessionError(f"{root}/meta/info.json is no object")
        self.info: dict[str, Any] = info
        self.version = str(info.get("codebase_version", ""))
        if self.version not in _VERSIONS:
            raise SessionError(
                f"{root} is a LeRobot dataset of version {self.version or 'unknown'}",
                hint=f"readable: {', '.join(_VERSIONS)}",
            )
        fps = options.rate if options.rate is not None else info.get("fps")
        if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0.1 <= fps <= 2000:
            raise SessionError(f"{root}/meta/info.json has no rate (fps)", hint="state it: --rate")
        self.fps = float(fps)
        features = info.get("features")
        if not isinstance(features, dict):
            raise SessionError(f"{root}/meta/info.json has no features")
        self.features: dict[str, Any] = features
        extension = info.get(EXTENSION)
        self._extension = extension if isinstance(extension, dict) else {}
        self._tables: dict[Path, Any] = {}
        self._tasks = self._read_tasks()
        self._rows = self._read_episodes()

    @property
    def episodes(self) -> list[int]:
        """The episodes' numbers."""
        return sorted(self._rows)

    def read(self, episode: int) -> Session:
        """Read one episode.

        :raises SessionError: its data are missing or of another form than the features declare.
        """
        problems = Problems()
        row = self._rows[episode]
        path, table = self._table(episode, row)
        missing = [c for c in ("timestamp", "frame_index") if c not in table.column_names]
        if missing:
            raise SessionError(f"{path} has no column {', '.join(missing)}")
        times = self._times(table, problems)
        corrections: list[str] = []
        parts = list(self._parts(path, table, problems, corrections))
        if not parts:
            raise SessionError(
                f"{path} has no joints: neither observation.state nor action can be used",
                hint="; ".join(problems.sentences()[:3]),
            )
        session = Session(
            source=path,
            form=f"LeRobot {self.version}",
            times_ns=times,
            clock=NOMINAL,
            rate=self.fps,
            parts=parts,
            folder=self.root,
            cameras=list(self._cameras(episode, row, table, problems)),
            problems=problems,
            corrections=list(dict.fromkeys(corrections)),
            name=f"episode_{episode:06d}",
        )
        session.rest = self._rest(table, len(times))
        kept = self._extension.get("sessions")
        origin = kept.get(str(episode), {}) if isinstance(kept, dict) else {}
        start = str(origin.get("start_ns", "")) if isinstance(origin, dict) else ""
        if start.isdigit() and len(start) < 20 and int(start) < 2**62:
            session.times_ns = session.times_ns - times[0] + int(start)
            session.clock = str(origin.get("clock", NOMINAL))
        tasks = self._task_texts(row, table)
        session.about = {
            "episode": str(episode),
            "robot_type": str(self.info.get("robot_type")),
            "task": tasks[0] if tasks else "",
            "tasks": json.dumps(tasks, ensure_ascii=False),
        }
        if len(tasks) > 1:
            session.about["note"] = "frames have different tasks: see the column task_index"
        correct_sides(session, session.form, self.options)
        return session

    # -- files ---------------------------------------------------------------------------------

    def _read_tasks(self) -> dict[int, str]:
        lines = self.root / "meta" / "tasks.jsonl"
        if lines.is_file():
            return {
                row["task_index"]: str(row.get("task", ""))
                for row in _read_lines(lines)
                if isinstance(row.get("task_index"), int)
            }
        path = self.root / "meta" / "tasks.parquet"
        if not path.is_file():
            return {}
        found = {}
        for row in _table_rows(path, read_parquet(path)):
            texts = [v for v in row.values() if isinstance(v, str)]
            if isinstance(row.get("task_index"), int) and texts:
                found[row["task_index"]] = texts[0]
        return found

    def _read_episodes(self) -> dict[int, dict[str, Any]]:
        lines = self.root / "meta" / "episodes.jsonl"
        rows: Iterable[dict[str, Any]]
        if lines.is_file():
            rows = _read_lines(lines)
        else:
            rows = []
            for path in sorted((self.root / "meta" / "episodes").glob("*/*.parquet")):
                table = read_parquet(path, lambda name: not name.startswith("stats/"))
                rows += _table_rows(path, table)
        found = {
            row["episode_index"]: row for row in rows if isinstance(row.get("episode_index"), int)
        }
        if not found:
            raise SessionError(f"{self.root} has no list of its episodes in meta/")
        return found

    def _open(self, path: Path) -> Any:
        if path not in self._tables:
            self._tables.clear()  # before another one takes as much
            self._tables[path] = read_parquet(path, lambda name: name != "index")
        return self._tables[path]

    def _table(self, episode: int, row: Mapping[str, Any]) -> tuple[Path, Any]:
        pattern = str(self.info.get("data_path") or "")
        chunks = self.info.get("chunks_size")
        values = {
            "episode_chunk": episode
            // (chunks if isinstance(chunks, int) and chunks > 0 else 1000),
            "episode_index": episode,
            "chunk_index": row.get("data/chunk_index", 0),
            "file_index": row.get("data/file_index", 0),
        }
        path = self._path(pattern, values)
        table = self._open(path)
        if "episode_index" in table.column_names:
            column = np.asarray(table["episode_index"].to_numpy(zero_copy_only=False))
            where = np.flatnonzero(column == episode)
            if not len(where):
                raise SessionError(f"{path} has no frame of episode {episode}")
            if len(where) <= MOST_FRAMES:
                table = table.take(where)
        if table.num_rows > MOST_FRAMES:
            raise SessionError(f"{path} has more than {MOST_FRAMES} frames of episode {episode}")
        return path, table

    def _path(self, pattern: str, values: Mapping[str, Any]) -> Path:
        try:
            # a field may be a few digits wide, as LeRobot has them, and not a gigabyte
            if re.search(r":[^}]{5}", pattern):
                raise ValueError(pattern)
            name = pattern.format(**values)
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise SessionError(
                f"{self.root}/meta/info.json has a path that cannot be used: {pattern!r}"
            ) from error
        found = safe_path(self.root, name)
        if found is None:
            raise SessionError(f"{self.root}/meta/info.json points outside the dataset: {name!r}")
        return found

    # -- columns -------------------------------------------------------------------------------

    def _times(self, table: Any, problems: Problems) -> NDArray[np.int64]:
        numbers = _column(table, "frame_index")
        period = 1e9 / self.fps
        if (
            numbers is None
            or len(numbers) != table.num_rows
            or (np.diff(numbers) <= 0).any()
            or (numbers < 0).any()
            or (numbers * period >= LAST_NS - EPOCH_NS).any()
        ):
            problems.add("frame_index does not ascend from 0; frames are counted instead")
            numbers = np.arange(table.num_rows, dtype=np.float64)
        times = np.array([round(n * period) for n in numbers.tolist()], dtype=np.int64)
        stamps = _column(table, "timestamp")
        if stamps is None or np.abs(stamps - times / 1e9).max(initial=0.0) > 0.5 / self.fps:
            problems.add("timestamp is not frame_index / fps; frame_index / fps is used")
        return times + EPOCH_NS

    def _parts(
        self, path: Path, table: Any, problems: Problems, corrections: list[str]
    ) -> Iterator[Part]:
        found: dict[str, tuple[_Group, dict[str, dict[str, Floats]]]] = {}
        for (kind, field), column in COLUMNS.items():
            feature = self.features.get(column)
            if column not in table.column_names or not isinstance(feature, dict):
                continue
            matrix = _matrix(table, column)
            if matrix is None:
                problems.add(f"{column} is no vector of numbers of one length", path.name)
                continue
            names = _names(feature, matrix.shape[1])
            if names is None:
                problems.add(
                    f"{column} has {matrix.shape[1]} elements and another number of names; they "
                    "are numbered"
                )
                names = tuple(f"joint_{i}" for i in range(matrix.shape[1]))
            if not np.isfinite(matrix).all():
                problems.add(f"{column} has values that are not finite; these frames lack it")
            for group in self._groups(names, corrections):
                known, values = found.setdefault(group.name, (group, {}))
                if known.joints != group.joints:
                    problems.add(f"{column}: {group.name} has other joints than elsewhere")
                    continue
                values.setdefault(kind, {})[field] = matrix[:, list(group.columns)]
        for group, values in found.values():
            good = {kind: columns for kind, columns in values.items() if "q" in columns}
            if good:
                yield Part(group.name, group.joints, good, group.model)

    def _groups(self, names: Sequence[str], corrections: list[str]) -> list[_Group]:
        """Assign a vector's elements to parts."""
        stated = self._stated_groups(names)
        if stated is not None:
            return stated
        groups: list[_Group] = []
        left = dict(enumerate(names))
        for side in Side:
            hand = self._hand(side, left, corrections)
            if hand is not None:
                groups.append(hand)
                for i in hand.columns:
                    del left[i]
        rest: dict[str, list[int]] = {}
        for i, name in left.items():
            rest.setdefault(_part_of(name), []).append(i)
        groups += [_Group(n, tuple(left[i] for i in c), tuple(c)) for n, c in rest.items()]
        return groups

    def _stated_groups(self, names: Sequence[str]) -> list[_Group] | None:
        """The assignment stored by dexkit's export."""
        stated = self._extension.get("parts")
        if not isinstance(stated, list):
            return None
        groups, at = [], 0
        by_name = {name: i for i, name in enumerate(names)}
        for entry in stated:
            try:
                part, joints, features = entry["part"], entry["joints"], entry["features"]
                hand = model(entry["model"]) if entry.get("model") else None
                columns = [by_name[n] for n in features if n in by_name]
            except (TypeError, KeyError, SessionError):
                return None
            if columns and len(columns) == len(joints):
                groups.append(_Group(part, tuple(joints), tuple(columns), hand))
                at += len(columns)
        return groups if at == len(names) else None

    def _hand(self, side: Side, names: Mapping[int, str], corrections: list[str]) -> _Group | None:
        """The hand of a side: the columns whose names are those of a model's joints."""
        if self.options.hand == "none":
            return None
        own = {i: _bare(name, side) for i, name in names.items() if _side(name) is side}
        for name in dict.fromkeys(d.model for d in DIALECTS.values()):
            hand = model(name)
            if self.options.hand not in (None, name):
                continue
            wanted = [j.name.replace("_", "").lower() for j in hand.joints[side]]
            found = {bare: i for i, bare in own.items() if bare in wanted}
            if len(found) != len(wanted):
                continue
            columns = tuple(found[w] for w in wanted)
            if list(columns) != sorted(columns) and _is_unitree(names[columns[0]]):
                given = ", ".join(names[i] for i in sorted(columns))
                corrections.append(
                    f"{side} hand: the columns are taken by their place, as "
                    f"{', '.join(j.name for j in hand.joints[side])}; the names that "
                    f"unitree_lerobot gives them ({given}) are not the order of the numbers, "
                    "which is that of the wire"
                )
                columns = tuple(sorted(columns))
            return _Group(f"{side}{HAND}", tuple(j.name for j in hand.joints[side]), columns, hand)
        return None

    # -- pictures and other columns
    # -----------------------------------------------------------------

    def _cameras(
        self, episode: int, row: Mapping[str, Any], table: Any, problems: Problems
    ) -> Iterator[Camera]:
        for key, feature in self.features.items():
            kind = feature.get("dtype") if isinstance(feature, dict) else None
            if kind not in ("video", "image"):
                continue
            name = key.removeprefix(PICTURES)
            if kind == "image":
                if (camera := _embedded(name, key, table)) is None:
                    problems.add(f"{name}: its pictures are not in the Parquet file")
                else:
                    yield camera
                continue
            chunks = self.info.get("chunks_size")
            size = chunks if isinstance(chunks, int) and chunks > 0 else 1000
            values = {
                "video_key": key,
                "episode_chunk": episode // size,
                "episode_index": episode,
                "chunk_index": row.get(f"videos/{key}/chunk_index", 0),
                "file_index": row.get(f"videos/{key}/file_index", 0),
            }
            try:
                path = self._path(str(self.info.get("video_path") or ""), values)
            except SessionError as error:
                problems.add(f"{name}: {error.message}")
                continue
            if not path.is_file():
                problems.add(f"{name}: its video is missing", path.name)
            start = row.get(f"videos/{key}/from_timestamp", 0.0)
            first = float(start) if isinstance(start, (int, float)) else 0.0
            stamps = _column(table, "timestamp")
            if stamps is None:
                stamps = np.arange(table.num_rows) / self.fps
            relative = path.relative_to(Path(self.root).resolve()).as_posix()
            yield Camera(
                name,
                (relative,) * table.num_rows,
                seconds=tuple((first + stamps).tolist()),
            )

    def _rest(self, table: Any, count: int) -> list[str]:
        """The other columns, as JSON; empty where they do not change."""
        known = {*COLUMNS.values(), *_INDEXES[:4]}
        others = [
            c
            for c in table.column_names
            if c not in known
            and (self.features.get(c) or {}).get("dtype") not in ("image", "video")
        ]
        if others == ["task_index"] and len(set(table["task_index"].to_pylist())) == 1:
            return []
        rows = table.select(others).to_pylist() if others else []
        found, before = [], None
        for row in rows:
            text = json.dumps(row, ensure_ascii=False, default=str)
            found.append("" if text == before else text)
            before = text
        return found if len(found) == count else []

    def _task_texts(self, row: Mapping[str, Any], table: Any) -> list[str]:
        given = row.get("tasks")
        if isinstance(given, list) and all(isinstance(t, str) for t in given) and given:
            return list(given)
        if "task_index" not in table.column_names:
            return []
        numbers = dict.fromkeys(table["task_index"].to_pylist())
        return [self._tasks[n] for n in numbers if n in self._tasks]


def _table_rows(path: Path, table: Any) -> list[dict[str, Any]]:
    """The rows of a table.

    :raises SessionError: a text in it is not UTF-8.
    """
    try:
        found: list[dict[str, Any]] = table.to_pylist()
    except ValueError as error:
        raise SessionError(f"{path} cannot be read: {error}") from error
    return found


def _embedded(name: str, key: str, table: Any) -> Camera | None:
    """A camera whose pictures are in the table; None if they are not."""
    if key not in table.column_names:
        return None
    rows = table[key].to_pylist()
    data = [r.get("bytes") if isinstance(r, dict) else None for r in rows]
    if not any(isinstance(d, bytes) for d in data):
        return None
    paths = tuple(f"frame {i}" for i in range(len(data)))
    return Camera(name, paths, load=lambda i: data[i] if isinstance(data[i], bytes) else None)


def _read_json(path: Path) -> Any:
    data = read_bytes(path, _MAX_JSON, error=SessionError)
    try:
        return json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise SessionError(f"{path} is not valid JSON: {error}") from error


def _read_lines(path: Path) -> list[dict[str, Any]]:
    found = []
    data = read_bytes(path, _MAX_JSON, error=SessionError)
    try:
        for line in data.decode("utf-8").splitlines():
            if line.strip():
                row = json.loads(line)
                if isinstance(row, dict):
                    found.append(row)
    except (ValueError, RecursionError) as error:
        raise SessionError(f"{path} is not valid JSON lines: {error}") from error
    return found


def _column(table: Any, name: str) -> Floats | None:
    """A column of numbers; None if it is not one."""
    if name not in table.column_names:
        return None
    values = _as_numbers(table[name])
    return values if values is not None and values.ndim == 1 and np.isfinite(values).all() else None


def _matrix(table: Any, name: str) -> Floats | None:
    """A column of vectors (or of single numbers) as a table; None if it is anything else."""
    values = _as_numbers(table[name])
    if values is None:
        return None
    if values.ndim == 1:
        values = values[:, None]
    return values if values.ndim == 2 and values.shape[1] else None


def _as_numbers(column: Any) -> Floats | None:
    """A column of numbers, or of lists of them, as an array; None if lists differ in length, a
    value is missing, or it is of another kind.
    """
    arrow, _ = parquet_library()
    kinds = arrow.types
    values, shape = column.combine_chunks(), [len(column)]
    if values.null_count:
        return None
    kind = values.type
    if kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind):
        # a few different lengths only: those of all rows would be as many as the values
        lengths = values.value_lengths().unique().to_pylist()
        if len(lengths) > 1:
            return None
        shape += lengths
        values = values.flatten()
        kind = values.type
    if not (kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind)):
        return None
    if values.null_count:
        return None
    found: Floats = np.asarray(values.to_numpy(zero_copy_only=False), np.float64).reshape(shape)
    return found


def _names(feature: Mapping[str, Any], count: int) -> tuple[str, ...] | None:
    """The names of a vector's elements; datasets have them in several forms."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if not isinstance(names, list) or len(names) != count or len(set(map(str, names))) != count:
        return None
    return tuple(str(n) for n in names)


def _words(name: str) -> list[str]:
    """``kLeftHandThumb0`` and ``left_hand_thumb_0`` as words."""
    bare = name.removeprefix("k") if _is_unitree(name) else name
    return [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", bare)]


def _is_unitree(name: str) -> bool:
    """Whether it is named as unitree_lerobot does."""
    return re.match(r"k[A-Z]", name) is not None


def _side(name: str) -> Side | None:
    words = _words(name)
    return Side(words[0]) if words and words[0] in (Side.LEFT, Side.RIGHT) else None


def _bare(name: str, side: Side) -> str:
    words = _words(name)[1:]
    return "".join(words[1:] if words[:1] == ["hand"] else words)


def _part_of(name: str) -> str:
    side, words = _side(name), _words(name)
    if side is None:
        return "robot"
    return f"{side}{HAND}" if "hand" in words or "gripper" in words else f"{side}_arm"
