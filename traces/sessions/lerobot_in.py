"""Read LeRobot datasets of v2.0, v2.1 and v3.0: every episode as a session.

A dataset has one vector of positions per frame with named elements; the names identify hands and
arms. unitree_lerobot names the right Dex3's columns thumb, index, middle, while the numbers
are in the order of the wire, thumb, middle, index (docs/sources/sessions.md#b2): there the index
counts instead of the name, and a note says so.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from dexkit.documents import read_bytes
from dexkit.errors import SessionError
from dexkit.escaping import one_line
from dexkit.hand import Floats, Side
from dexkit.models import DIALECTS, HandModel, model
from dexkit.traces.sessions.episodes import DEFAULT, Options, correct_sides
from dexkit.traces.sessions.imported import EPOCH_NS, NOMINAL
from dexkit.traces.sessions.lerobot_format import (
    COLUMNS,
    EXTENSION,
    PICTURES,
    PRESSURE,
    parquet_library,
    read_parquet,
)
from dexkit.traces.sessions.model import Camera, Part, Problems, Session
from dexkit.traces.sessions.paths import below, file_name
from dexkit.traces.sessions.ros_types import LAST_NS
from dexkit.traces.sessions.streams import HAND
from dexkit.traces.sessions.typed import MOST_JOINTS, Count, Rate, parse_record, to_record, typed

__all__ = ["Dataset", "as_numbers", "is_dataset", "read_metadata"]

_VERSIONS = ("v2.0", "v2.1", "v3.0")
_INDEXES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
MOST_FRAMES = 1_000_000
"""Frames of an episode: 9 hours at 30 a second."""
_MAX_JSON = 256 * 2**20
# Words in the names of the joints of a hand
_OF_HANDS = {"hand", "gripper", "thumb", "index", "middle", "ring", "pinky", "little", "finger"}
# A field of a path: {video_key}, {chunk_index:03d}
_FIELD = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}", re.ASCII)


def is_dataset(source: Path) -> bool:
    """Whether it looks like a LeRobot dataset."""
    return (source / "meta" / "info.json").is_file()


T = TypeVar("T")

_Seconds = Annotated[float, msgspec.Meta(ge=0, lt=10**9)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^\w{1,64}\Z")]


class _Feature(msgspec.Struct):
    dtype: str = ""
    names: Any = None


class _Stated(msgspec.Struct):
    """A part as dexkit's export states it: its joints, and the elements that they are."""

    part: _Name
    joints: list[str]
    features: list[str]
    model: str = ""


class _Origin(msgspec.Struct):
    """Where an episode of dexkit's export comes from; the time is a number in a text."""

    start_ns: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}\Z")]
    clock: Literal["nominal", "measured"] = "nominal"

    def __post_init__(self) -> None:
        if int(self.start_ns) >= LAST_NS:
            raise ValueError("a time after January 2038")


class _Extension(msgspec.Struct):
    parts: list[_Stated] | None = None
    sessions: dict[str, _Origin] = {}


class _Info(msgspec.Struct):
    """``meta/info.json``"""

    features: dict[str, _Feature]
    codebase_version: str = ""
    fps: Any = None
    robot_type: str | None = None
    chunks_size: Annotated[int, msgspec.Meta(ge=1, lt=10**9)] = 1000
    data_path: str = ""
    video_path: str | None = None
    dexkit: _Extension = msgspec.field(default_factory=_Extension, name=EXTENSION)


class _Version(msgspec.Struct):
    codebase_version: str = "unknown"


class _Task(msgspec.Struct):
    task_index: int
    task: str | None = None


class _EpisodeStatistics(msgspec.Struct):
    """A line of ``meta/episodes_stats.jsonl``"""

    episode_index: Count
    stats: dict[str, Any]


class _Episode(msgspec.Struct):
    """A row of the list of episodes; ``videos`` are read as they are needed."""

    episode_index: Count
    tasks: list[str] | None = None
    length: Any = None
    chunk: Count = msgspec.field(default=0, name="data/chunk_index")
    file: Count = msgspec.field(default=0, name="data/file_index")


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

    ``refused`` has the errors of episodes that cannot be listed, by their place in the dataset.
    ``only`` may be set to the first and last number of the episodes that will be read; other parts
    of a file are skipped then.
    """

    def __init__(self, root: Path, options: Options = DEFAULT) -> None:
        parquet_library()  # told before anything is read
        self.root = root
        self.options = options
        path = below(root, "meta/info.json")
        text = read_metadata(path)
        self.version = parse_record(text, _Version, path).codebase_version
        if self.version not in _VERSIONS:
            raise SessionError(
                f"{root} is a LeRobot dataset of version {self.version}",
                hint=f"readable: {', '.join(_VERSIONS)}",
            )
        self.info = parse_record(text, _Info, path)
        fps = options.rate if options.rate is not None else typed(self.info.fps, Rate)
        if fps is None:
            raise SessionError(f"{path} has no rate (fps)", hint="state it: --set rate=HZ")
        self.fps = fps
        self.refused: dict[str, SessionError] = {}
        self._tables: dict[tuple[Path, bool, tuple[int, int] | None], Any] = {}
        self._statistics: dict[int, dict[str, dict[str, Floats]]] | None = None
        self.only: tuple[int, int] | None = None
        self._assigned: dict[tuple[str, ...], tuple[list[_Group], Problems, list[str]]] = {}
        self._problems: list[str] = []
        self._tasks = self._read_tasks()
        self._rows = self._read_episodes()

    @property
    def episodes(self) -> list[int]:
        """The episodes' numbers."""
        return sorted(self._rows)

    def read(self, episode: int, *, joints_only: bool = False) -> Session:
        """Read one episode.

        :param joints_only: without other columns, without looking for swapped hands, and pictures
            of the table are read only when they are asked for.
        :raises SessionError: its data are missing or of another form than the features declare.
        """
        problems = Problems()
        for text in self._problems:
            problems.add(text)
        row, _ = self._rows[episode]
        path, table = self._table(episode, row, joints_only=joints_only)
        missing = [c for c in ("timestamp", "frame_index") if c not in table.column_names]
        if missing:
            raise SessionError(f"{path} has no column {', '.join(missing)}")
        if not table.num_rows:
            raise SessionError(f"{path} has no frame")
        length = typed(row.length, Count)
        if length is not None and length != table.num_rows:
            problems.add(f"it has {table.num_rows} frames, and {length} by the list of episodes")
        times = self._times(path, table, problems)
        corrections: list[str] = []
        features = self._features(path, table, problems)
        parts = list(self._parts(features, problems, corrections))
        if not parts:
            raise SessionError(
                f"{path} has no joints: neither observation.state nor action can be used",
                hint="; ".join(
                    problems.sentences()[:3]
                    or ["it has: " + ", ".join(map(one_line, table.column_names[:20]))]
                ),
            )
        session = Session(
            source=path,
            form=f"LeRobot {self.version}",
            times_ns=times,
            clock=NOMINAL,
            rate=self.fps,
            parts=parts,
            folder=self.root,
            cameras=list(self._cameras(episode, path, table, problems, on_demand=joints_only)),
            problems=problems,
            corrections=list(dict.fromkeys(corrections)),
            name=f"episode_{episode:06d}",
        )
        session.stamps = _column(table, "timestamp")
        session.numbers = _column(table, "frame_index")
        session.features = features
        if joints_only:
            session.touches = self._touches(table)
        if not joints_only:
            session.rest = self._rest(path, table)
        if (origin := self.info.dexkit.sessions.get(str(episode))) is not None:
            session.times_ns = session.times_ns - times[0] + int(origin.start_ns)
            session.clock = origin.clock
        tasks = self._task_texts(row, path, table)
        session.about = {
            "episode": str(episode),
            "robot_type": str(self.info.robot_type),
            "task": tasks[0] if tasks else "",
            "tasks": json.dumps(tasks, ensure_ascii=False),
        }
        if len(tasks) > 1:
            session.about["note"] = "frames have different tasks: see the column task_index"
        if not joints_only:
            correct_sides(session, session.form, self.options)
        return session

    def row(self, episode: int) -> dict[str, Any]:
        """What the list of episodes says of one, without its statistics."""
        return self._rows[episode][1]

    def data_file(self, episode: int, number: int | None = None) -> Path:
        """The Parquet file with the frames of an episode.

        :param number: the episode's number, if it is to be another one.
        :raises SessionError: the path in ``meta/info.json`` cannot be used.
        """
        row, _ = self._rows[episode]
        number = episode if number is None else number
        values = {
            "episode_chunk": number // self.info.chunks_size,
            "episode_index": number,
            "chunk_index": row.chunk,
            "file_index": row.file,
        }
        return self._path("data_path", self.info.data_path, values)

    @property
    def videos(self) -> list[str]:
        """The features that are videos."""
        return [key for key, feature in self.info.features.items() if feature.dtype == "video"]

    def video_file(self, key: str, episode: int, number: int | None = None) -> Path:
        """The file with the video of an episode; as :meth:`data_file`.

        :param key: the feature.
        """
        _, row = self._rows[episode]
        number = episode if number is None else number
        values: dict[str, int | str] = {
            "video_key": key,
            "episode_chunk": number // self.info.chunks_size,
            "episode_index": number,
            "chunk_index": typed(row.get(f"videos/{key}/chunk_index"), Count) or 0,
            "file_index": typed(row.get(f"videos/{key}/file_index"), Count) or 0,
        }
        return self._path("video_path", self.info.video_path or "", values)

    def video_files(self, episode: int) -> list[Path]:
        """The video files of an episode, whether they are there or not."""
        problems = Problems()
        cameras = self._cameras(episode, self.root, None, problems)
        return [self.root / camera.paths[0] for camera in cameras if camera.seconds is not None]

    def statistics(self, episode: int) -> dict[str, dict[str, Floats]]:
        """What the metadata state of an episode's features, or of all episodes (v2.0).

        :returns: by feature and name (``min``, ``max``, ``mean``, ``std``, ``count``) the numbers;
            what is no list of numbers is left out.
        """
        if self._statistics is None:
            self._statistics = dict(self._read_statistics())
        return self._statistics.get(episode, {})

    def statistics_of_all(self) -> dict[str, dict[str, Floats]]:
        """What ``meta/stats.json`` states; empty without it.

        :raises SessionError: it cannot be read.
        """
        path = self.root / "meta/stats.json"
        if not path.is_file():
            return {}
        found = parse_record(
            read_metadata(below(self.root, "meta/stats.json")), dict[str, Any], path
        )
        return _numbers_of(found)

    def _read_statistics(self) -> Iterator[tuple[int, dict[str, dict[str, Floats]]]]:
        if self.version == "v2.1":
            for _, row, _ in self._listed("episodes_stats", _EpisodeStatistics):
                if not isinstance(row, SessionError):
                    yield row.episode_index, _numbers_of(row.stats)
            return
        for file in sorted((self.root / "meta" / "episodes").glob("*/*.parquet")):
            name = file.relative_to(self.root).as_posix()
            try:
                table = read_parquet(
                    below(self.root, name), lambda c: c == "episode_index" or _is_statistic(c)
                )
                rows = table.to_pylist()
            except (SessionError, ValueError):
                continue  # told where the list of episodes is read
            for row in rows:
                stated: dict[str, dict[str, Any]] = {}
                for column, value in row.items():
                    if _is_statistic(column):
                        _, _, rest = column.partition("/")
                        feature, _, what = rest.rpartition("/")
                        stated.setdefault(feature, {})[what] = value
                if isinstance(row.get("episode_index"), int):
                    yield row["episode_index"], _numbers_of(stated)

    # -- files ---------------------------------------------------------------------------------

    def _read_tasks(self) -> dict[int, str]:
        found = {}
        for _, task, row in self._listed("tasks", _Task):
            if isinstance(task, SessionError):
                self._problems.append(task.message)
                continue
            # pandas' index may have another name
            others = (v for v in row.values() if isinstance(v, str))
            found[task.task_index] = next(others, "") if task.task is None else task.task
        return found

    def _read_episodes(self) -> dict[int, tuple[_Episode, dict[str, Any]]]:
        """By number, the row of each episode, as it is used and as a whole."""
        found: dict[int, tuple[_Episode, dict[str, Any]]] = {}
        for place, episode, row in self._listed("episodes", _Episode):
            if isinstance(episode, SessionError):
                self.refused[place] = episode
            elif episode.episode_index in found:
                self.refused[place] = SessionError(
                    f"{self.root}/{place}: episode {episode.episode_index} occurs twice"
                )
            else:
                found[episode.episode_index] = episode, row
        if not found and not self.refused:
            raise SessionError(f"{self.root} has no list of its episodes in meta/")
        return found

    def _listed(
        self, what: str, kind: type[T]
    ) -> Iterator[tuple[str, T | SessionError, dict[str, Any]]]:
        """The rows of a list in ``meta/``, JSON lines or Parquet: place in the dataset, record or
        the error of reading it, and the whole row.
        """
        name = f"meta/{what}.jsonl"
        if (self.root / name).is_file():
            for number, line in enumerate(read_metadata(below(self.root, name)).split("\n"), 1):
                if line.strip():
                    place = f"{name}, line {number}"
                    try:
                        row = parse_record(line, dict[str, Any], self.root / place)
                        yield place, to_record(row, kind, self.root / place), row
                    except SessionError as error:
                        yield place, error, {}
            return
        single = self.root / "meta" / f"{what}.parquet"
        several = sorted((self.root / "meta" / what).glob("*/*.parquet"))
        for file in [single] if single.is_file() else several:
            name = file.relative_to(self.root).as_posix()
            try:
                table = read_parquet(below(self.root, name), lambda c: not c.startswith("stats/"))
                columns = {c: _values(file, table, c) for c in table.column_names}
            except SessionError as error:
                yield name, error, {}
                continue
            for i, values in enumerate(zip(*columns.values(), strict=True)):
                row = dict(zip(columns, values, strict=True))
                try:
                    yield f"{name}, row {i}", to_record(row, kind, f"{file}, row {i}"), row
                except SessionError as error:
                    yield f"{name}, row {i}", error, {}

    def _open(self, path: Path, joints_only: bool) -> Any:
        key = path, joints_only, self.only
        if key not in self._tables:
            self._tables.clear()  # before another one takes as much
            left_out = {"index"}
            if joints_only:
                left_out |= {k for k, f in self.info.features.items() if f.dtype == "image"}
            self._tables[key] = read_parquet(path, lambda n: n not in left_out, episodes=self.only)
        return self._tables[key]

    def _table(self, episode: int, row: _Episode, *, joints_only: bool = False) -> tuple[Path, Any]:
        path = self.data_file(episode)
        table = self._open(path, joints_only)
        if "episode_index" in table.column_names:
            column = table["episode_index"]
            if str(column.type) not in ("int64", "int32"):
                raise SessionError(f"{path}: episode_index holds {column.type}, not numbers")
            where = np.flatnonzero(column.to_numpy(zero_copy_only=False) == episode)
            if not len(where):
                raise SessionError(f"{path} has no frame of episode {episode}")
            if where[-1] - where[0] < len(where):
                table = table.slice(where[0], len(where))
            elif len(where) <= MOST_FRAMES:
                table = table.take(where)
        if table.num_rows > MOST_FRAMES:
            raise SessionError(f"{path} has more than {MOST_FRAMES} frames of episode {episode}")
        return path, table

    def _path(self, key: str, pattern: str, values: Mapping[str, int | str]) -> Path:
        """The file that a pattern of ``meta/info.json`` names.

        Only what LeRobot writes is understood, a name in braces with a width, and not all that
        Python's format could reach.
        """

        def insert(match: re.Match[str]) -> str:
            value, width = values.get(match[1]), int(match[2] or 0)
            if value is None or (match[2] and isinstance(value, str)):
                return match[0]  # refused below, with its braces
            return str(value).rjust(width, "0")

        name = _FIELD.sub(insert, pattern)
        if re.search(r"[{}]", name):
            raise SessionError(
                f"{self.root}/meta/info.json: $.{key} is no path that can be used: "
                f"{one_line(pattern, 100)!r}",
                hint=f"its fields are {', '.join(values)}, as in {{episode_index:06d}}",
            )
        return below(self.root, name)

    # -- columns -------------------------------------------------------------------------------

    def _times(self, path: Path, table: Any, problems: Problems) -> NDArray[np.int64]:
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
        times = np.rint(numbers * period).astype(np.int64)
        stamps = _column(table, "timestamp")
        if stamps is None or np.abs(stamps - times / 1e9).max(initial=0.0) > 0.5 / self.fps:
            problems.add("timestamp is not frame_index / fps; frame_index / fps is used")
        return times + EPOCH_NS

    def _features(self, path: Path, table: Any, problems: Problems) -> dict[str, Floats]:
        """The columns that hold joints, shape (frames, elements)."""
        found = {}
        for column in COLUMNS.values():
            if column not in table.column_names or column not in self.info.features:
                continue
            matrix = _matrix(table, column)
            if matrix is None:
                problems.add(f"{column} is no vector of numbers of one length", path.name)
                continue
            if not np.isfinite(matrix).all():
                problems.add(f"{column} has values that are not finite; these frames lack it")
            found[column] = matrix
        return found

    def _touches(self, table: Any) -> dict[str, Floats]:
        """The pressures of each hand, as dexkit's export names them."""
        if PRESSURE not in table.column_names or PRESSURE not in self.info.features:
            return {}
        matrix = _matrix(table, PRESSURE)
        names = None if matrix is None else _names(self.info.features[PRESSURE], matrix.shape[1])
        if matrix is None or names is None:
            return {}
        columns = {
            f"{side}{HAND}": [i for i, name in enumerate(names) if _side(name) is side]
            for side in Side
        }
        return {part: matrix[:, places] for part, places in columns.items() if places}

    def _parts(
        self, features: Mapping[str, Floats], problems: Problems, corrections: list[str]
    ) -> Iterator[Part]:
        found: dict[str, tuple[_Group, dict[str, dict[str, Floats]]]] = {}
        for (kind, field), column in COLUMNS.items():
            if column not in features:
                continue
            matrix = features[column]
            names = _names(self.info.features[column], matrix.shape[1])
            if names is None:
                problems.add(
                    f"{column} has {matrix.shape[1]} elements and another number of names; they "
                    "are numbered"
                )
                names = tuple(f"joint_{i}" for i in range(matrix.shape[1]))
            for group in self._groups(names, problems, corrections):
                known, values = found.setdefault(group.name, (group, {}))
                if known.joints != group.joints:
                    problems.add(f"{column}: {group.name} has other joints than elsewhere")
                    continue
                values.setdefault(kind, {})[field] = matrix[:, list(group.columns)]
        for group, values in found.values():
            good = {kind: columns for kind, columns in values.items() if "q" in columns}
            if good:
                yield Part(group.name, group.joints, good, group.model)

    def _groups(
        self, names: Sequence[str], problems: Problems, corrections: list[str]
    ) -> list[_Group]:
        """The parts of a vector with such elements; what is wrong with them is told each time."""
        key = tuple(names)
        if key not in self._assigned:
            own, corrected = Problems(), list[str]()
            self._assigned[key] = self._assign(names, own, corrected), own, corrected
        groups, own, corrected = self._assigned[key]
        for text in own.sentences():
            problems.add(text)
        corrections += corrected
        return groups

    def _assign(
        self, names: Sequence[str], problems: Problems, corrections: list[str]
    ) -> list[_Group]:
        """Assign a vector's elements to parts."""
        stated = self._stated_groups(names)
        if stated is not None:
            return stated
        groups: list[_Group] = []
        left = dict(enumerate(names))
        for side in Side:
            hand = self._hand(side, left, problems, corrections)
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
        """The assignment stored by dexkit's export; None if it is of other elements.

        :raises SessionError: it contradicts itself.
        """
        if self.info.dexkit.parts is None:
            return None
        groups: list[_Group] = []
        by_name = {name: i for i, name in enumerate(names)}
        for i, stated in enumerate(self.info.dexkit.parts):
            hand = model(stated.model) if stated.model else None
            columns = [by_name[n] for n in stated.features if n in by_name]
            if not columns or len(columns) != len(stated.joints):
                continue
            known = {f"{side}{HAND}": side for side in Side}
            if hand is not None and (
                stated.part not in known or len(hand.joints[known[stated.part]]) != len(columns)
            ):
                raise SessionError(
                    f"{self.root}/meta/info.json: {stated.part} with {len(columns)} joints is no "
                    f"{hand.name} - at `$.{EXTENSION}.parts[{i}]`"
                )
            groups.append(_Group(stated.part, tuple(stated.joints), tuple(columns), hand))
        taken = sorted(c for g in groups for c in g.columns)
        return groups if taken == list(range(len(names))) else None

    def _hand(
        self, side: Side, names: Mapping[int, str], problems: Problems, corrections: list[str]
    ) -> _Group | None:
        """The hand of a side: the columns whose names are those of a model's joints.

        None where they are those of several models, unless the options say which.
        """
        if self.options.hand == "none":
            return None
        own = {i: _bare(name, side) for i, name in names.items() if _side(name) is side}
        fitting: list[tuple[HandModel, tuple[int, ...]]] = []
        for name in dict.fromkeys(d.model for d in DIALECTS.values()):
            hand = model(name)
            if self.options.hand not in (None, name):
                continue
            wanted = [j.name.replace("_", "").lower() for j in hand.joints[side]]
            found = {bare: i for i, bare in own.items() if bare in wanted}
            if len(found) == len(wanted):
                fitting.append((hand, tuple(found[w] for w in wanted)))
        if len(fitting) > 1:
            models = ", ".join(hand.name for hand, _ in fitting)
            problems.add(
                f"{side}{HAND} may be one of {models}; it is kept as a group of joints, unless "
                f"--set hand=MODEL says which"
            )
        if len(fitting) != 1:
            return None
        hand, columns = fitting[0]
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

    # -- pictures and other columns
    # -----------------------------------------------------------------

    def _cameras(
        self, episode: int, path: Path, table: Any, problems: Problems, *, on_demand: bool = False
    ) -> Iterator[Camera]:
        """The cameras of an episode; of those with a video, without a table, the first frame.

        :param on_demand: the table has no pictures; they are read when they are asked for.
        """
        names: dict[str, str] = {}
        for key, feature in self.info.features.items():
            if feature.dtype not in ("video", "image"):
                continue
            name = file_name(key.removeprefix(PICTURES), 64)
            if names.setdefault(name, key) != key:
                problems.add(f"{key} is left out: its camera is called {name}, as {names[name]}'s")
            elif feature.dtype == "video":
                yield from self._video(name, key, episode, path, table, problems)
            elif table is None:
                continue
            elif on_demand:
                paths = tuple(f"frame {i}" for i in range(table.num_rows))
                yield Camera(name, paths, load=_Pictures(path, key, episode))
            elif (camera := _embedded(name, key, path, table)) is None:
                problems.add(f"{name}: its pictures are not in the Parquet file")
            else:
                yield camera

    def _video(
        self, name: str, key: str, episode: int, path: Path, table: Any, problems: Problems
    ) -> Iterator[Camera]:
        """The camera of a video, if its place is known."""
        _, row = self._rows[episode]
        try:
            file = self.video_file(key, episode)
        except SessionError as error:
            problems.add(f"{name}: {error.message}")
            return
        if not file.is_file():
            problems.add(f"{name}: its video is missing", file.name)
        first = typed(row.get(f"videos/{key}/from_timestamp"), _Seconds) or 0.0
        end = typed(row.get(f"videos/{key}/to_timestamp"), _Seconds)
        relative = file.relative_to(self.root.resolve()).as_posix()
        if table is None:
            yield Camera(name, (relative,), seconds=(first,), begin_s=first, end_s=end)
            return
        stamps = _column(table, "timestamp")
        if stamps is None:
            stamps = np.arange(table.num_rows) / self.fps
        seconds = tuple((first + stamps).tolist())
        paths = (relative,) * table.num_rows
        yield Camera(name, paths, seconds=seconds, begin_s=first, end_s=end)

    def _rest(self, path: Path, table: Any) -> list[str]:
        """The other columns, as JSON; empty where they do not change."""
        pictures = {k for k, f in self.info.features.items() if f.dtype in ("image", "video")}
        known = {*COLUMNS.values(), *_INDEXES[:4], *pictures}
        columns = {c: _values(path, table, c) for c in table.column_names if c not in known}
        if list(columns) == ["task_index"] and len(set(map(repr, columns["task_index"]))) == 1:
            return []
        found, before = [], None
        for row in zip(*columns.values(), strict=True):
            text = json.dumps(dict(zip(columns, row, strict=True)), ensure_ascii=False, default=str)
            found.append("" if text == before else text)
            before = text
        return found

    def _task_texts(self, row: _Episode, path: Path, table: Any) -> list[str]:
        if row.tasks:
            return row.tasks
        if "task_index" not in table.column_names:
            return []
        numbers = typed(_values(path, table, "task_index"), list[int]) or []
        return [self._tasks[n] for n in dict.fromkeys(numbers) if n in self._tasks]


def _values(path: Path, table: Any, name: str) -> list[Any]:
    """The values of a column.

    :raises SessionError: one is nothing that Python has: a text that is not UTF-8, a late date.
    """
    try:
        found: list[Any] = table[name].to_pylist()
    except (ValueError, OverflowError) as error:
        raise SessionError(f"{path}: {one_line(name)} cannot be read: {one_line(error)}") from error
    return found


def _embedded(name: str, key: str, path: Path, table: Any) -> Camera | None:
    """A camera whose pictures are in the table; None if they are not."""
    if key not in table.column_names:
        return None
    rows = _values(path, table, key)
    data = [r.get("bytes") if isinstance(r, dict) else None for r in rows]
    if not any(isinstance(d, bytes) for d in data):
        return None
    paths = tuple(f"frame {i}" for i in range(len(data)))
    return Camera(name, paths, load=lambda i: data[i] if isinstance(data[i], bytes) else None)


class _Pictures:
    """The pictures of an episode in a Parquet file, read when the first of them is asked for."""

    def __init__(self, path: Path, key: str, episode: int) -> None:
        self._path = path
        self._key = key
        self._episode = episode
        self._data: list[bytes | None] | None = None

    def __call__(self, frame: int) -> bytes | None:
        """The picture of a frame, by its place in the episode.

        :raises SessionError: the file cannot be read.
        """
        if self._data is None:
            self._data = self._read()
        return self._data[frame] if frame < len(self._data) else None

    def _read(self) -> list[bytes | None]:
        wanted = (self._key, "episode_index")
        number = self._episode
        table = read_parquet(self._path, lambda n: n in wanted, episodes=(number, number))
        if self._key not in table.column_names:
            return []
        if "episode_index" in table.column_names:
            numbers = table["episode_index"].to_numpy(zero_copy_only=False)
            table = table.take(np.flatnonzero(numbers == number))
        rows = _values(self._path, table, self._key)
        data = (r.get("bytes") if isinstance(r, dict) else None for r in rows)
        return [d if isinstance(d, bytes) else None for d in data]


def _is_statistic(column: str) -> bool:
    """Whether it is a column of the list of episodes with a statistic of their joints."""
    return column.startswith("stats/") and not column.startswith(f"stats/{PICTURES}")


def _numbers_of(stats: Mapping[str, Any]) -> dict[str, dict[str, Floats]]:
    found: dict[str, dict[str, Floats]] = {}
    for feature, values in stats.items():
        for name, value in (values if isinstance(values, dict) else {}).items():
            numbers = typed(value, list[float]) if isinstance(value, list) else None
            if numbers is not None and len(numbers) <= MOST_JOINTS:
                found.setdefault(feature, {})[name] = np.array(numbers)
    return found


def read_metadata(path: Path) -> str:
    """The text of a JSON file of a dataset.

    :raises SessionError: it cannot be read, is too large, or no UTF-8.
    """
    try:
        return read_bytes(path, _MAX_JSON, error=SessionError).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SessionError(f"{path} is not UTF-8 text (at byte {error.start})") from error


def _column(table: Any, name: str) -> Floats | None:
    """A column of numbers; None if it is not one."""
    if name not in table.column_names:
        return None
    values = as_numbers(table[name])
    return values if values is not None and values.ndim == 1 and np.isfinite(values).all() else None


def _matrix(table: Any, name: str) -> Floats | None:
    """A column of vectors (or of single numbers) as a table; None if it is anything else."""
    values = as_numbers(table[name])
    if values is None:
        return None
    if values.ndim == 1:
        values = values[:, None]
    return values if values.ndim == 2 and 0 < values.shape[1] <= MOST_JOINTS else None


def as_numbers(column: Any) -> Floats | None:
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


def _names(feature: _Feature, count: int) -> tuple[str, ...] | None:
    """The names of a vector's elements; datasets have them in several forms."""
    names = feature.names
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    found = typed(names, list[str])
    if found is None or len(found) != count or len(set(found)) != count:
        return None
    return tuple(found)


@lru_cache(maxsize=4096)
def _words(name: str) -> list[str]:
    """``kLeftHandThumb0`` and ``left_hand_thumb_0`` as words."""
    bare = name.removeprefix("k") if _is_unitree(name) else name
    bare = bare.removesuffix(".q").removesuffix(".pos")  # as LeRobot's robots name positions
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
    is_hand = bool(_OF_HANDS & set(words))
    if side is None:
        return f"robot{HAND}" if is_hand else "robot"
    return f"{side}{HAND}" if is_hand else f"{side}_arm"
