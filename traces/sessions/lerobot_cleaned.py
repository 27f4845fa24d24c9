"""Write a LeRobot dataset again without some of its episodes, in its own version.

The episodes that stay are numbered from 0, as LeRobot's own ``delete_episodes`` numbers them
(docs/sources/sessions.md#c4); of the data the columns ``episode_index`` and ``index`` change, and
nothing else.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError
from dexkit.escaping import one_line
from dexkit.traces.sessions.lerobot_format import (
    EXTENSION,
    parquet_library,
    parquet_pieces,
    write_json,
)
from dexkit.traces.sessions.lerobot_in import Dataset, as_numbers, read_metadata
from dexkit.traces.sessions.lerobot_stats import Aggregate, statistics
from dexkit.traces.sessions.paths import below
from dexkit.traces.sessions.plain_files import OF_DOWNLOADS, copy_file, plain_files
from dexkit.traces.sessions.typed import parse_record

__all__ = ["Remarks", "write_cleaned"]

_EPISODE, _INDEX = "episode_index", "index"
_VALUES_AT_ONCE = 4 << 20  # of columns whose statistics are calculated
_ROW_GROUP = 256 << 20  # bytes of the rows of an episode that are written at once
_OWN = ("data", "videos", "meta/episodes")
"""Folders of which only what an episode names is written."""
_SPLIT = re.compile(r"(\d{1,9}):(\d{1,9})", re.ASCII)
_NAMED = 5  # files that a remark names


@dataclass
class Remarks:
    """What is to be known of what was written.

    :ivar notes: what is as it should be.
    :ivar problems: what is missing, or wrong in the source.
    """

    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Renumbered:
    """An episode that stays: its number, the index of its first frame, and its frames."""

    number: int
    first: int
    frames: int

    @property
    def columns(self) -> dict[str, NDArray[np.int64]]:
        """The numbers of its frames."""
        return {
            _EPISODE: np.full(self.frames, self.number),
            _INDEX: np.arange(self.first, self.first + self.frames),
        }


def write_cleaned(dataset: Dataset, dropped: Collection[int], out: Path) -> Remarks:
    """Write a dataset without some episodes. A row group is in memory, and never the whole of it.

    :param out: a new folder.
    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: a file of an episode that stays cannot be read, its metadata contradict
        themselves, or there is a link in the dataset.
    :raises OSError: it cannot be written.
    """
    return _Cleaner(dataset, frozenset(dropped), out).write()


class _Cleaner:
    def __init__(self, dataset: Dataset, dropped: frozenset[int], out: Path) -> None:
        self._dataset = dataset
        self._root = dataset.root.resolve()
        self._out = out
        self._numbers = {
            old: new for new, old in enumerate(n for n in dataset.episodes if n not in dropped)
        }
        self._episodes: dict[int, _Renumbered] = {}
        self._own: dict[str, Aggregate] = {}  # of features that cannot be measured
        self._sources: dict[str, str] = {}  # by file of the copy, the file of the dataset
        self._remarks = Remarks()

    def write(self) -> Remarks:
        dataset = self._dataset
        for error in dataset.refused.values():
            raise SessionError(
                f"the list of episodes cannot be read: {error.message}",
                hint="which episode it is, is not known; correct or remove that row in a copy",
            )
        others = self._others()  # first: links are refused before anything is read through one
        self._write_data()
        stats = self._read_stats()
        measured = self._measure(stats) if stats else {}
        self._own = {name: Aggregate() for name in stats.keys() - measured.keys()}
        self._write_lists()
        if stats:
            self._write_stats(stats, measured)
        self._write_info()
        self._copy_videos()
        for name in others:
            copy_file(self._root / name, self._out / name)
        return self._remarks

    # -- files that are copied -------------------------------------------------------------------

    def _others(self) -> list[str]:
        """The files that are copied as they are."""
        named = self._named()
        found: list[str] = []
        stray: list[str] = []
        for path, folder in plain_files(self._root, OF_DOWNLOADS):
            if not (folder or path in named or _is_rewritten(path)):
                own = any(path.startswith(f"{place}/") for place in _OWN)
                (stray if own else found).append(path)
        kinds = dict.fromkeys(
            path.partition("/")[0] + "/" if "/" in path and not path.startswith("meta/") else path
            for path in found
        )
        if told := [k for k in kinds if k not in ("meta/tasks.jsonl", "meta/tasks.parquet")]:
            self._remarks.notes.append(
                f"copied as it is, with whatever it says of dropped episodes: {_few(told)}"
            )
        if stray:
            self._remarks.problems.append(f"left out, as no episode names it: {_few(stray)}")
        if skipped := [name for name in sorted(OF_DOWNLOADS) if (self._root / name).is_dir()]:
            self._remarks.notes.append(f"left out, as it is of the original: {_few(skipped)}")
        return found

    def _named(self) -> set[str]:
        """The files of data and videos of all episodes, those that are dropped included."""
        dataset, found = self._dataset, set()
        for episode in dataset.episodes:
            try:
                found.add(self._name(dataset.data_file(episode)))
                found.update(self._name(dataset.video_file(k, episode)) for k in dataset.videos)
            except SessionError:  # told where it is written, if it stays
                continue
        return found

    def _name(self, path: Path) -> str:
        return path.relative_to(self._root).as_posix()

    def _placed(self, source: Path, target: Path) -> Path:
        """Where a file of the dataset is written.

        :raises SessionError: another one was written there.
        """
        old, new = self._name(source), self._name(target)
        if self._sources.setdefault(new, old) != old:
            raise SessionError(
                f"{self._root}: {old} and {self._sources[new]} would both become {new}",
                hint="do data_path and video_path in meta/info.json name the episode?",
            )
        return self._out / new

    def _copy_videos(self) -> None:
        dataset = self._dataset
        dropped = [n for n in dataset.episodes if n not in self._numbers]
        missing: list[str] = []
        shared: set[str] = set()
        for key in dataset.videos:
            try:
                files = {dataset.video_file(key, n, new): n for n, new in self._numbers.items()}
                gone = {dataset.video_file(key, n) for n in dropped}
            except SessionError as error:
                self._remarks.problems.append(f"{one_line(key)}: no video: {error.message}")
                continue
            for target, episode in files.items():
                source = dataset.video_file(key, episode)
                name = self._name(source)
                if not source.exists():
                    missing.append(name)
                    continue
                copy_file(source, self._placed(source, target))
                if source in gone:
                    shared.add(name)
        if missing:
            self._remarks.problems.append(f"videos that are missing: {_few(missing)}")
        if shared:
            self._remarks.notes.append(
                "videos that are copied whole, as they also hold episodes that stay; no episode "
                f"refers to the pictures of the dropped ones: {_few(sorted(shared))}"
            )

    # -- data --------------------------------------------------------------------------------

    def _write_data(self) -> None:
        """Write the files with frames, in the order in which LeRobot reads them."""
        dataset = self._dataset
        files: defaultdict[Path, list[int]] = defaultdict(list)
        for episode in self._numbers:
            files[dataset.data_file(episode)].append(episode)
        dropped: defaultdict[Path, set[int]] = defaultdict(set)
        for episode in dataset.episodes:
            if episode not in self._numbers:
                try:
                    dropped[dataset.data_file(episode)].add(episode)
                except SessionError:
                    continue
        for path in sorted(files) if dataset.version == "v3.0" else files:
            targets = {dataset.data_file(n, self._numbers[n]) for n in files[path]}
            if len(targets) > 1:
                raise SessionError(f"{path} would have to be several files in the copy")
            target = self._placed(path, targets.pop())
            try:
                unchanged = self._number(path, files[path], dropped[path])
            except SessionError as error:
                numbers = ",".join(map(str, files[path]))
                hint = error.hint or f"without its episodes: --drop {_few([numbers])}"
                raise SessionError(error.message, hint=hint) from error
            if unchanged:
                copy_file(path, target)
            else:
                self._rewrite(path, {*files[path], *dropped[path]}, target)

    def _number(self, path: Path, episodes: list[int], dropped: set[int]) -> bool:
        """Number the frames of a file.

        :returns: whether they have these numbers already, and all stay.
        """
        frames: dict[int, int] = {}
        unchanged, strange = True, 0
        last, total = None, sum(e.frames for e in self._episodes.values())
        wanted = (_EPISODE, _INDEX).__contains__
        for piece in parquet_pieces(path, wanted):
            for episode, rows in _runs(path, piece, {*episodes, *dropped}):
                if episode not in episodes:
                    unchanged = False
                    strange += rows.num_rows if episode not in dropped else 0
                elif episode != last and episode in frames:
                    raise SessionError(f"{path}: the frames of episode {episode} lie apart")
                else:
                    unchanged &= self._numbers[episode] == episode
                    if _INDEX in rows.column_names:
                        index = as_numbers(rows[_INDEX])
                        expected = np.arange(total, total + rows.num_rows)
                        unchanged &= index is not None and np.array_equal(index, expected)
                    frames[episode] = frames.get(episode, 0) + rows.num_rows
                    total += rows.num_rows
                last = episode
        if absent := [n for n in episodes if n not in frames]:
            raise SessionError(
                f"{path} has no frame of episode {absent[0]}", hint="drop that episode, too"
            )
        if strange:
            self._remarks.problems.append(
                f"{self._name(path)}: {strange} frames of episodes that are not in the list of "
                "episodes are left out"
            )
        first = total - sum(frames.values())
        for episode, count in frames.items():
            self._episodes[episode] = _Renumbered(self._numbers[episode], first, count)
            first += count
        return unchanged

    def _rewrite(self, path: Path, episodes: Collection[int], target: Path) -> None:
        """Write the frames of the episodes that stay, a row group for each, as LeRobot does."""
        arrow, parquet = parquet_library()
        target.parent.mkdir(parents=True, exist_ok=True)
        pieces = parquet_pieces(path)
        schema = next(pieces).schema
        done: defaultdict[int, int] = defaultdict(int)
        waiting: list[Any] = []
        current, size = None, 0
        try:
            with parquet.ParquetWriter(str(target), schema, compression="snappy") as writer:
                for piece in pieces:
                    for episode, rows in _runs(path, piece, episodes):
                        if episode not in episodes or episode not in self._numbers:
                            continue
                        if waiting and (episode != current or size > _ROW_GROUP):
                            writer.write_table(arrow.concat_tables(waiting))
                            waiting, size = [], 0
                        at = done[episode]
                        done[episode] = at + rows.num_rows
                        columns = self._episodes[episode].columns
                        part = {k: v[at : at + rows.num_rows] for k, v in columns.items()}
                        waiting.append(_replaced(path, rows, part))
                        current, size = episode, size + rows.nbytes
                if waiting:
                    writer.write_table(arrow.concat_tables(waiting))
        except (ValueError, arrow.lib.ArrowException) as error:
            raise SessionError(f"{path} cannot be written again: {one_line(error)}") from error

    # -- metadata --------------------------------------------------------------------------------

    def _write_lists(self) -> None:
        """Write what ``meta/`` says of each episode, and add up its statistics."""
        meta = self._root / "meta"
        for name in _LISTS:
            if (meta / name).is_file():
                target = self._out / "meta" / name
                target.parent.mkdir(exist_ok=True)
                with open(target, "w", encoding="utf-8", errors="backslashreplace") as file:
                    for row in _json_rows(below(self._root, f"meta/{name}")):
                        if (changed := self._json_row(row)) is not None:
                            file.write(json.dumps(changed, ensure_ascii=False) + "\n")
        single = meta / "episodes.parquet"
        for path in (
            [single] if single.is_file() else sorted((meta / "episodes").glob("*/*.parquet"))
        ):
            self._write_table(path)
        wrong = [
            str(old)
            for old, episode in self._episodes.items()
            if self._dataset.row(old).get("length", episode.frames) != episode.frames
        ]
        if wrong:
            self._remarks.problems.append(
                "the list of episodes has another length than the data, which the copy goes by: "
                f"episode {_few(wrong)}"
            )

    def _changed(self, old: int) -> dict[str, Any]:
        episode = self._episodes[old]
        return {
            _EPISODE: episode.number,
            "length": episode.frames,
            "dataset_from_index": episode.first,
            "dataset_to_index": episode.first + episode.frames,
        }

    def _json_row(self, row: dict[str, Any]) -> dict[str, Any] | None:
        """The row of an episode as it is now, without those that do not stay."""
        old = row.get(_EPISODE)
        if not isinstance(old, int) or old not in self._numbers:
            return None
        row.update({k: v for k, v in self._changed(old).items() if k in row})
        stats = row.get("stats")
        if isinstance(stats, dict):
            for name, values in self._episodes[old].columns.items():
                if isinstance(known := stats.get(name), dict):
                    known.update({k: v for k, v in statistics(values).items() if k in known})
            for name, known in stats.items():
                self._add(name, known)
        return row

    def _add(self, feature: str, found: object) -> None:
        if feature in self._own and isinstance(found, Mapping):
            # one that has none: those of the dataset stay
            with contextlib.suppress(ValueError):
                self._own[feature].add(found)

    def _write_table(self, path: Path) -> None:
        """Write the rows of the episodes that stay of a file of ``meta/episodes``."""
        arrow, parquet = parquet_library()
        writer = None
        target = self._out / self._name(path)
        try:
            for piece in parquet_pieces(below(self._root, self._name(path))):
                olds = piece[_EPISODE].to_pylist() if _EPISODE in piece.column_names else []
                where = [i for i, old in enumerate(olds) if old in self._numbers]
                if not where:
                    continue
                table = self._table(path, piece.take(where), [olds[i] for i in where])
                if writer is None:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    writer = parquet.ParquetWriter(str(target), table.schema, compression="snappy")
                writer.write_table(table)
        except (ValueError, TypeError, OverflowError, arrow.lib.ArrowException) as error:
            raise SessionError(f"{path} cannot be written again: {one_line(error)}") from error
        finally:
            if writer is not None:
                writer.close()

    def _table(self, path: Path, table: Any, olds: list[int]) -> Any:
        changed = [self._changed(old) for old in olds]
        values = {k: [row[k] for row in changed] for k in changed[0]}
        counted: dict[str, list[dict[str, Any]]] = {}
        stats: defaultdict[str, dict[str, list[Any]]] = defaultdict(dict)
        for column in table.column_names:
            feature, _, name = column.removeprefix("stats/").rpartition("/")
            if not column.startswith("stats/") or not feature:
                continue
            if feature in (_EPISODE, _INDEX) and name in _STATISTICS:
                if feature not in counted:
                    numbers = (self._episodes[old].columns[feature] for old in olds)
                    counted[feature] = [statistics(v) for v in numbers]
                values[column] = [found[name] for found in counted[feature]]
            if feature in self._own:
                stats[feature][name] = table[column].to_pylist()
        for feature, columns in stats.items():
            for i in range(len(olds)):
                self._add(feature, {k: v[i] for k, v in columns.items() if v[i] is not None})
        return _replaced(path, table, values)

    def _write_info(self) -> None:
        path = below(self._root, "meta/info.json")
        info = parse_record(read_metadata(path), dict[str, Any], path)
        count = len(self._numbers)
        videos, chunk = len(self._dataset.videos), self._dataset.info.chunks_size
        known = {"total_videos": count * videos, "total_chunks": -(-count // chunk)}
        info |= {k: v for k, v in known.items() if k in info}
        info["total_episodes"] = count
        info["total_frames"] = sum(e.frames for e in self._episodes.values())
        if "splits" in info:
            info["splits"] = self._splits(info["splits"])
        own = info.get(EXTENSION)
        if isinstance(own, dict) and isinstance(origins := own.get("sessions"), dict):
            own["sessions"] = {
                str(new): origins[str(old)]
                for old, new in self._numbers.items()
                if str(old) in origins
            }
        write_json(self._out / "meta" / "info.json", info)

    def _splits(self, splits: object) -> dict[str, str]:
        """The same parts of the dataset, by the new numbers; all as one part if they are no
        ranges of episodes.
        """
        found = {}
        for name, text in splits.items() if isinstance(splits, dict) else ():
            match = _SPLIT.fullmatch(text) if isinstance(text, str) else None
            if match is None:
                return {"train": f"0:{len(self._numbers)}"}
            begin, end = (
                sum(old < int(limit) for old in self._numbers) for limit in match.groups()
            )
            found[str(name)] = f"{begin}:{end}"
        return found

    def _read_stats(self) -> dict[str, Any]:
        """The statistics of the whole dataset, by feature; none if it has none."""
        path = self._root / "meta" / "stats.json"
        if not path.is_file():
            return {}
        return parse_record(
            read_metadata(below(self._root, "meta/stats.json")), dict[str, Any], path
        )

    def _write_stats(self, stats: dict[str, Any], measured: Mapping[str, dict[str, Any]]) -> None:
        """Write the statistics, of each feature those that it had: from the frames, and of
        pictures, which are not decoded, from those of the episodes.
        """
        kept = []
        for feature, known in stats.items():
            found = measured.get(feature)
            if feature in self._own and self._own[feature].episodes == len(self._numbers):
                found = self._own[feature].statistics()
            if isinstance(known, dict) and found is not None and known.keys() <= found.keys():
                stats[feature] = {k: _like(found[k], v) for k, v in known.items()}
            else:
                kept.append(feature)
        if kept:
            self._remarks.notes.append(
                f"statistics of the whole dataset, dropped episodes included: {_few(kept)}"
            )
        write_json(self._out / "meta" / "stats.json", stats)

    def _measure(self, features: Collection[str]) -> dict[str, dict[str, list[Any]]]:
        """The statistics of columns of numbers over the frames that were written; as quantiles
        need all of them, of some elements at a time.
        """
        files = dict.fromkeys(
            self._out / self._name(self._dataset.data_file(old, new))
            for old, new in self._numbers.items()
        )
        frames = sum(e.frames for e in self._episodes.values())
        widths: dict[str, int] = {}
        for piece in islice(parquet_pieces(next(iter(files)), features.__contains__), 1, 2):
            for name in piece.column_names:
                if (values := as_numbers(piece[name])) is not None:
                    widths[name] = values.reshape(len(values), -1).shape[1]
        most = max(1, _VALUES_AT_ONCE // frames)
        found: dict[str, dict[str, list[Any]]] = {}
        for part in _portions(widths, most):
            tables = {k: np.empty((frames, e.stop - e.start)) for k, e in part.items()}
            filled = dict.fromkeys(part, 0)
            for piece in (p for path in files for p in parquet_pieces(path, part.__contains__)):
                for name in piece.column_names:
                    values = as_numbers(piece[name]) if piece.num_rows else None
                    if values is None or values.size != len(values) * widths[name]:
                        continue
                    at = filled[name]
                    filled[name] = at + len(values)
                    rows = values.reshape(len(values), -1)[:, part[name]]
                    tables[name][at : filled[name]] = rows
            for name, table in tables.items():
                if filled[name] != frames:  # other vectors, or none, somewhere
                    continue
                with np.errstate(all="ignore"):  # NaN and infinity stay what they are
                    own = statistics(table)
                known = found.setdefault(name, {k: [] for k in own} | {"count": own["count"]})
                for k in own.keys() - {"count"}:
                    known[k] += own[k]
        whole = {k for k, width in widths.items() if len(found.get(k, {}).get("mean", ())) == width}
        return {k: v for k, v in found.items() if k in whole}


_LISTS = ("episodes.jsonl", "episodes_stats.jsonl")
_PICTURES = ("image", "video")
_STATISTICS = statistics(np.zeros(1)).keys()


def _portions(widths: Mapping[str, int], most: int) -> Iterator[dict[str, slice]]:
    """Elements of columns to be read at once, so many altogether."""
    part: dict[str, slice] = {}
    room = most
    for name, width in widths.items():
        begin = 0
        while begin < width:
            end = min(width, begin + room)
            part[name] = slice(begin, end)
            room -= end - begin
            begin = end
            if not room:
                yield part
                part, room = {}, most
    if part:
        yield part


def _like(values: list[Any], known: object) -> list[Any]:
    """Whole numbers where the dataset had them."""
    table = np.asarray(values)
    try:
        whole = np.asarray(known).dtype.kind in "iu" and bool((table == np.rint(table)).all())
    except ValueError:
        return values
    return table.astype(np.int64).tolist() if whole else values


def _is_rewritten(path: str) -> bool:
    """Whether it is metadata that say something of each episode, or of all."""
    known = {f"meta/{name}" for name in ("info.json", "stats.json", "episodes.parquet", *_LISTS)}
    return path in known or bool(re.fullmatch(r"meta/episodes/[^/]+/[^/]+\.parquet", path))


def _json_rows(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a file of JSON lines.

    :raises SessionError: one cannot be read.
    """
    for number, line in enumerate(read_metadata(path).split("\n"), 1):
        if line.strip():
            yield parse_record(line, dict[str, Any], f"{path}, line {number}")


def _runs(path: Path, table: Any, episodes: Collection[int]) -> Iterator[tuple[int, Any]]:
    """The frames of each episode of a piece of a file, in order.

    :param episodes: whose file it is; without a column of numbers it is that of the only one.
    :raises SessionError: the numbers are none, or missing.
    """
    if not table.num_rows:
        return
    if _EPISODE not in table.column_names:
        if len(episodes) != 1:
            raise SessionError(f"{path} has several episodes and no column {_EPISODE}")
        yield next(iter(episodes)), table
        return
    column = table[_EPISODE]
    if str(column.type) not in ("int64", "int32") or column.null_count:
        raise SessionError(f"{path}: {_EPISODE} holds {column.type}, not numbers")
    numbers = column.to_numpy(zero_copy_only=False)
    ends = [*(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    begin = 0
    for end in ends:
        yield int(numbers[begin]), table.slice(begin, end - begin)
        begin = end


def _replaced(path: Path, table: Any, values: Mapping[str, Any]) -> Any:
    """A table with other values in those of the columns that it has; their types stay.

    :raises SessionError: a column is of a type that cannot hold them.
    """
    arrow, _ = parquet_library()
    for name, new in values.items():
        if name not in table.column_names:
            continue
        at = table.column_names.index(name)
        try:
            column = arrow.array(new, type=table.schema.field(at).type)
        except (ValueError, TypeError, OverflowError, arrow.lib.ArrowException) as error:
            raise SessionError(f"{path}: {name} cannot be numbered: {one_line(error)}") from error
        table = table.set_column(at, table.schema.field(at), column)
    return table


def _few(names: Collection[str]) -> str:
    """The first names."""
    more = len(names) - _NAMED
    shown = ", ".join(one_line(name, 100) for name in islice(names, _NAMED))
    return f"{shown} and {more} more" if more > 0 else shown
