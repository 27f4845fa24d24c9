"""Detect the format of a source to be imported, and list its sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.errors import SessionError, UsageError
from dexkit.traces.reader import Trace
from dexkit.traces.sessions import episodes, jsonl, lerobot_in, rosbag, topic_tables
from dexkit.traces.sessions.episode_times import write_beside
from dexkit.traces.sessions.episodes import DEFAULT, Options
from dexkit.traces.sessions.imported import NOMINAL
from dexkit.traces.sessions.model import Session, write

__all__ = ["FORMATS", "Entry", "Report", "beside", "choose", "find"]

FORMATS = ("episodes", "jsonl", "lerobot", "rosbag2", "tables")


@dataclass(frozen=True)
class Report:
    """Result of an import.

    :param corrections: what was changed and why.
    :param problems: what could not be imported.
    """

    form: str
    messages: int
    corrections: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Entry:
    """One session of a source.

    :param name: of its recording, without a suffix; folders between it and the source included.
    :param convert: writes the recording; takes the file, whether pictures are embedded, and
        whether an existing file is replaced.
    """

    name: str
    convert: Callable[[Path, bool, bool], Report]


def beside(folder: Path, wire: Trace, options: Options = DEFAULT, *, source: Path) -> Entry:
    """An episode with times from a DDS recording of the same session.

    :param source: the folder of episodes that was named.
    """

    def convert(out: Path, embed: bool, overwrite: bool) -> Report:
        session = episodes.read_episode(folder, options)
        session.below = _below(folder, source)
        if session.clock != NOMINAL:
            raise SessionError(f"{folder} has times of its own")
        written, times = write_beside(session, wire, out, embed=embed, overwrite=overwrite)
        return Report(
            f"{session.form}, {times}", written, session.corrections, session.problems.sentences()
        )

    return Entry(folder.name, convert)


def find(source: Path, form: str | None = None, options: Options = DEFAULT) -> list[Entry]:
    """The sessions of a source.

    :param form: one of :data:`FORMATS`; None to detect it.
    :raises SessionError: it is of no known format, or there is no session in it.
    :raises ExtraMissing: a library is missing.
    """
    if not source.exists():
        raise SessionError(f"{source} does not exist")
    form = form or _format(source)
    if form == "tables":
        return [Entry(source.name, lambda out, embed, force: _tables(source, out, force))]
    if form == "rosbag2":
        return [Entry(source.stem, lambda out, embed, force: _bag(source, out, force))]
    if form == "jsonl":
        return [_entry(source.stem, lambda: jsonl.read_lines(source, options))]
    if form == "lerobot":
        dataset = lerobot_in.Dataset(source, options)
        return [
            _entry(f"episode_{n:06d}", lambda n=n: dataset.read(n))  # type: ignore[misc]
            for n in dataset.episodes
        ] + [_refused(Path(place).name, error) for place, error in dataset.refused.items()]
    folders = episodes.episode_folders(source)
    if not folders:
        raise SessionError(
            f"{source} holds no session that dexkit knows",
            hint="an episode has a data.json, a LeRobot dataset meta/info.json, a bag "
            "metadata.yaml",
        )
    found = {f: _below(f, source) for f in folders}
    return [
        _entry(
            folder.name if place == "." else place,
            lambda folder=folder: episodes.read_episode(folder, options),  # type: ignore[misc]
            place,
        )
        for folder, place in found.items()
    ]


def choose(
    source: Path, entries: Sequence[Entry], names: Sequence[str], *, one: bool = False
) -> list[Entry]:
    """The sessions of these names, with or without their folders; without names, all.

    :param one: there must be a single one.
    :raises UsageError: a name is missing, or there are several.
    """
    chosen = list(entries)
    if names:
        known = {e.name: e for e in entries} | {e.name.rpartition("/")[2]: e for e in entries}
        if missing := [name for name in names if name not in known]:
            raise UsageError(
                f"{source} has no session {', '.join(missing)}",
                hint=f"it has: {', '.join(e.name for e in entries[:20])}"
                + (f" and {len(entries) - 20} more" if len(entries) > 20 else ""),
            )
        chosen = list(dict.fromkeys(known[name] for name in names))
    if one and len(chosen) > 1:
        raise UsageError(
            f"{source} has {len(chosen)} sessions",
            hint="make a recording of one: "
            f"dexkit import {source} one.mcap --episode {chosen[0].name}",
        )
    return chosen


def _format(source: Path) -> str:
    if topic_tables.is_tables(source):
        return "tables"
    if lerobot_in.is_dataset(source):
        return "lerobot"
    if rosbag.is_bag(source):
        return "rosbag2"
    if source.suffix in (".jsonl", ".ndjson"):
        return "jsonl"
    if _is_plotjuggler(source):
        raise SessionError(
            f"{source} is a table of curves, as PlotJuggler writes it, which holds no messages",
            hint="import the recording or the bag from which the curves were drawn",
        )
    return "episodes"


def _is_plotjuggler(source: Path) -> bool:
    """Whether it is a CSV file whose first column is PlotJuggler's time."""
    if source.suffix.lower() != ".csv" or not source.is_file():
        return False
    with source.open("rb") as file:
        return file.read(16).lstrip(b'\xef\xbb\xbf"').startswith(b"__time")


def _below(folder: Path, source: Path) -> str:
    """An episode's folder, relative to the source that was named."""
    return folder.relative_to(source).as_posix() if folder.is_relative_to(source) else "."


def _entry(name: str, read: Callable[[], Session], place: str = ".") -> Entry:
    def convert(out: Path, embed: bool, overwrite: bool) -> Report:
        session = read()
        session.below = place
        written = write(session, out, embed=embed, overwrite=overwrite)
        return Report(session.form, written, session.corrections, session.problems.sentences())

    return Entry(name, convert)


def _refused(name: str, error: SessionError) -> Entry:
    """A session that cannot be read."""

    def convert(out: Path, embed: bool, overwrite: bool) -> Report:
        raise error

    return Entry(name, convert)


def _bag(source: Path, out: Path, overwrite: bool) -> Report:
    written, corrections, problems = rosbag.import_bag(source, out, overwrite=overwrite)
    return Report("ROS 2 bag", written, corrections, problems.sentences())


def _tables(source: Path, out: Path, overwrite: bool) -> Report:
    written, problems = topic_tables.import_tables(source, out, overwrite=overwrite)
    return Report("tables", written, [], problems.sentences())
