"""Find the episodes of an archive: recordings, bags, folders of xr_teleoperate, LeRobot datasets.

Of a folder all folders in it are looked into; links to folders are not followed. What is an episode
is told by its folder, so that an archive may hold anything beside.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby
from pathlib import Path
from typing import Any

from dexkit.conformance.audit.objects import file_system, tag_of
from dexkit.conformance.audit.records import EpisodeRecord
from dexkit.conformance.audit.sessions import is_url, problem_of
from dexkit.conformance.dataset.whole_set import WholeSet
from dexkit.errors import DexkitError, SessionError, UsageError
from dexkit.escaping import one_line
from dexkit.redaction import url_name
from dexkit.staging import PREFIX
from dexkit.temporary_folder import TemporaryFolder
from dexkit.traces.sessions.episodes import DATA
from dexkit.traces.sessions.lerobot_in import Dataset
from dexkit.traces.sessions.paths import below

__all__ = ["Form", "Unit", "fetch", "find", "tag_of_metadata", "together"]

_RECORDING, _BAG = ".mcap", ".db3"
_BAG_FILE = "metadata.yaml"
_INFO = "meta/info.json"
_NAME = 4096  # characters of a row's name
_AT_ONCE = 32
"""Episodes of a data file that are one task: they share the reading of it."""


class Form(str, Enum):
    """How an episode is stored."""

    RECORDING = "recording"
    BAG = "bag"
    FOLDER = "folder of xr_teleoperate"
    DATASET = "LeRobot dataset"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Unit:
    """An episode that is to be judged.

    :param name: how its row calls it, and by what it is found in the journal; without
        credentials. ``place`` is the path or URL itself: of the file, or of the folder.
    :param size: bytes of its own, about; ``tag`` changes whenever one of its files does.
    :param source: name of the set that it belongs to; empty for a recording of its own.
    :param number: of an episode of a dataset; -1 for anything else.
    :param data: of an episode of a dataset, its file; such episodes are read together.
    """

    name: str
    place: str
    size: int
    tag: str
    form: Form = Form.RECORDING
    source: str = ""
    number: int = -1
    data: str = ""

    @property
    def episode(self) -> str:
        """Its number or folder in its source."""
        if self.form is Form.DATASET:
            return str(self.number)
        return self.name[len(self.source) :].lstrip("/") if self.source else ""


def find(
    location: str, working_folder: Path | None = None
) -> Iterator[Unit | EpisodeRecord | WholeSet]:
    """The episodes at a location, by name; what the metadata of a dataset say of the whole; a
    record for each place that cannot be looked into.

    :param location: a file, a folder or a URL. A file given by its own path may have any name.
    :param working_folder: what a relative path is relative to; None for the process' own.
    :raises UsageError: an empty path; a URL without fsspec, or of a kind that is not installed.
    """
    if is_url(location):
        yield from _find_objects(location)
        return
    if not location:
        raise UsageError("'' is no path", hint="'.' is this folder")
    name = Path(location)
    base = Path(os.path.abspath((working_folder or Path()) / name))
    if base.name == DATA and base.is_file():
        name, base = name.parent, base.parent
    if not base.is_dir():
        yield _of_file(name, base, Form.BAG if base.suffix == _BAG else Form.RECORDING)
        return
    problems: list[OSError] = []
    for folder, folders, files in os.walk(base, onerror=problems.append):
        folders[:] = sorted(name for name in folders if not name.startswith(PREFIX))
        here = Path(folder)
        shown = name / here.relative_to(base)
        if _looks_like_dataset(here):
            folders.clear()
            yield from _of_dataset(shown.as_posix(), here)
        elif DATA in files:
            folders.clear()
            source = shown if here == base else shown.parent
            yield _of_folder(shown, here, source.as_posix())
        elif _BAG_FILE in files:
            folders.clear()
            yield _of_file(shown, here, Form.BAG)
        else:
            for file in sorted(files):
                suffix = Path(file).suffix.lower()
                if suffix in (_RECORDING, _BAG):
                    form = Form.BAG if suffix == _BAG else Form.RECORDING
                    yield _of_file(shown / file, here / file, form)
    for error in problems:
        yield problem_of(os.fsdecode(error.filename or location), error)


def together(units: Sequence[Unit]) -> Iterator[tuple[Unit, ...]]:
    """The units by what is read at once: episodes of a data file, some at a time, or one alone."""

    def key(unit: Unit) -> tuple[str, str, str]:
        return (unit.place, unit.data, "" if unit.data else unit.name)

    for _, some in groupby(sorted(units, key=lambda u: (*key(u), u.number)), key):
        listed = list(some)
        for i in range(0, len(listed), _AT_ONCE):
            yield tuple(listed[i : i + _AT_ONCE])


def _of_file(name: Path, path: Path, form: Form) -> Unit | EpisodeRecord:
    try:
        status = path.stat()
        size, tag = status.st_size, str(status.st_mtime_ns)
        if path.is_dir():
            files = sorted(p for p in path.iterdir() if p.is_file())
            size, tag = sum(p.stat().st_size for p in files), _tag(files)
    except OSError as error:
        return problem_of(str(name), error)
    return Unit(one_line(name.as_posix(), _NAME), str(path), size, tag, form)


def _of_folder(name: Path, folder: Path, source: str) -> Unit | EpisodeRecord:
    """An episode of xr_teleoperate. Its pictures are files that it writes once."""
    text = one_line(name.as_posix(), _NAME)
    try:
        status = (folder / DATA).stat()
    except OSError as error:
        return problem_of(text, error)
    tag = str(status.st_mtime_ns)
    return Unit(text, str(folder), status.st_size, tag, Form.FOLDER, one_line(source, _NAME))


def _looks_like_dataset(folder: Path) -> bool:
    """Whether it is a LeRobot dataset, or what is left of one."""
    if (folder / _INFO).is_file():
        return True
    has_data = any((folder / "data").glob("chunk-*/*.parquet"))
    return has_data or any((folder / "meta" / n).exists() for n in ("episodes", "episodes.jsonl"))


def _of_dataset(name: str, root: Path) -> Iterator[Unit | EpisodeRecord | WholeSet]:
    text = one_line(name, _NAME)
    try:
        dataset = Dataset(root)
    except (DexkitError, OSError, MemoryError) as error:
        yield problem_of(text, error, source=text)
        return
    yield WholeSet.of(dataset, text)
    for place, refused in dataset.refused.items():
        yield problem_of(f"{text}/{place}", refused, source=text)
    try:
        meta = tag_of_metadata(root)
    except OSError as error:
        yield problem_of(text, error, source=text)
        return
    episodes: dict[Path, list[int]] = {}
    for number in dataset.episodes:
        try:
            episodes.setdefault(dataset.data_file(number), []).append(number)
        except SessionError as error:
            problem = problem_of(f"{text}/episode_{number:06d}", error, source=text)
            problem.episode = str(number)
            yield problem
    for path, numbers in episodes.items():
        for number in numbers:
            files = [path, *_videos(dataset, number)]
            tag = hashlib.sha256(f"{meta} {_tag(files)}".encode()).hexdigest()[:32]
            size = path.stat().st_size // len(numbers) if path.is_file() else 0
            yield Unit(
                f"{text}/episode_{number:06d}",
                str(root),
                size,
                tag,
                Form.DATASET,
                text,
                number,
                str(path),
            )


def _videos(dataset: Dataset, number: int) -> list[Path]:
    try:
        return dataset.video_files(number)
    except SessionError:  # told when the episode is read
        return []


def tag_of_metadata(root: Path) -> str:
    """A digest that changes whenever a file in ``meta/`` of a dataset does."""
    return _tag(sorted(p for p in (root / "meta").rglob("*") if p.is_file()))


def _tag(files: Sequence[Path]) -> str:
    """A digest of names, sizes and times of files, those that are not there included."""
    digest = hashlib.sha256()
    for path in files:
        try:
            status = path.stat()
            digest.update(f"{path.name} {status.st_size} {status.st_mtime_ns};".encode())
        except OSError:
            digest.update(f"{path.name!r} is not there;".encode())
    return digest.hexdigest()


# -- behind URLs ----------------------------------------------------------------------------------


def _find_objects(url: str) -> Iterator[Unit | EpisodeRecord | WholeSet]:
    files, root = file_system(url)
    try:
        found: dict[str, dict[str, Any]] = files.find(root, detail=True)
        if not found and not files.exists(root):
            raise FileNotFoundError(2, "there is no such object or folder")
    except Exception as error:  # each storage has errors of its own
        yield problem_of(url_name(url), error, url)
        return
    datasets = [p.removesuffix(f"/{_INFO}") for p in found if p.endswith(f"/{_INFO}")]
    for dataset in sorted(datasets):
        yield from _dataset_of_objects(files, dataset, found)
    inside = tuple(f"{d}/" for d in datasets)
    for path, info in sorted(found.items()):
        if path.startswith(inside) and inside:
            continue
        place = files.unstrip_protocol(path)
        name = one_line(url_name(place), _NAME)
        is_folder = path.rpartition("/")[2] == DATA
        if path.lower().endswith(_BAG):
            problem = SessionError("a bag of SQLite behind a URL is not read", hint="copy it here")
            yield problem_of(name, problem, place)
            continue
        if not path.lower().endswith(_RECORDING) and not is_folder and path != root:
            continue
        try:
            if not tag_of(info) or not info.get("size"):  # a web server's list has only names
                info = files.info(path)
        except Exception as error:
            yield problem_of(name, error, place)
            continue
        size, tag = int(info.get("size") or 0), tag_of(info)
        if is_folder:
            folder = name.removesuffix(f"/{DATA}")
            source = folder.rpartition("/")[0]
            yield Unit(folder, place.removesuffix(f"/{DATA}"), size, tag, Form.FOLDER, source)
        else:
            yield Unit(name, place, size, tag)


def _dataset_of_objects(
    files: Any, root: str, found: dict[str, dict[str, Any]]
) -> Iterator[Unit | EpisodeRecord | WholeSet]:
    """The episodes of a dataset behind a URL, from its metadata, which are copied for that."""
    place = files.unstrip_protocol(root)
    text = one_line(url_name(place), _NAME)
    tags = {p.removeprefix(f"{root}/"): tag_of(i) for p, i in found.items() if p.startswith(root)}
    with TemporaryFolder("audit") as folder:
        try:
            fetch(place, [n for n in tags if n.startswith("meta/")], folder)
        except Exception as error:  # each storage has errors of its own
            yield problem_of(text, error, place, source=text)
            return
        for entry in _of_dataset(text, folder):
            if not isinstance(entry, Unit):
                yield entry
                continue
            data = Path(entry.data).relative_to(folder.resolve()).as_posix()
            meta = " ".join(f"{n} {tag}" for n, tag in sorted(tags.items()) if "meta/" in n)
            digest = hashlib.sha256(f"{meta} {data} {tags.get(data)}".encode()).hexdigest()[:32]
            size = int(found.get(f"{root}/{data}", {}).get("size") or 0)
            yield Unit(entry.name, place, size, digest, Form.DATASET, text, entry.number, data)


def fetch(url: str, names: Sequence[str], folder: Path) -> None:
    """Copy files below a URL to the same names below a folder.

    :raises SessionError: a name leads out of the folder.
    :raises Exception: whatever the storage's library raises.
    """
    files, root = file_system(url)
    for name in names:
        target = below(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        with files.open(f"{root}/{name}", "rb") as source, target.open("wb") as copy:
            while piece := source.read(1 << 20):
                copy.write(piece)
