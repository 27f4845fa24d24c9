"""Check a ROS 2 bag before the library rosbags reads it.

The library trusts a bag: it unpacks whatever a file unpacks to, follows the aliases of its YAML,
and asks whatever a database calls a table. Here a bag is refused that would take more memory, disk
or time than its size accounts for.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import zstandard

from dexkit.documents import DEEPEST, open_ordinary, read_bytes
from dexkit.errors import SessionError, WireError
from dexkit.escaping import one_line
from dexkit.temporary_folder import TemporaryFolder
from dexkit.traces.clock_steps import LIMIT_NS, refuse_clock_steps
from dexkit.traces.container import MAX_CHUNK, MAX_RATIO, SPARE, Container
from dexkit.traces.mcap_records import MAGIC

__all__ = ["MOST_TOPICS", "Unpacker", "checked_bag", "is_packed", "parse_yaml"]

MOST_TOPICS = 4096
"""Topics of a bag; that of a whole robot has some hundred."""
_LARGEST_METADATA = 4 * 2**20
_MOST_EVENTS = 100_000  # names, values and lists in YAML, which take 100 µs each
_PIECE = 2**20
_FRAME = b"\x28\xb5\x2f\xfd"
_HEAD_OF_FRAME = 18  # most bytes of the header of a frame of zstd
_LARGEST_WINDOW = 2**27  # bytes that zstd --ultra looks back by default
_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")
_SETTINGS = ("trusted_schema=OFF", "ignore_check_constraints=ON", "cell_size_check=ON")
_SQLITE = b"SQLite format 3\x00"
_STEPS = 100_000
"""Steps of SQLite between two looks at its budget, which is so many steps for each byte:"""
_STEPS_PER_BYTE = 64
_UNPACK = "unpack the bag first: 'zstd -d', and compression_mode: '' in its metadata.yaml"


@contextlib.contextmanager
def checked_bag(source: Path) -> Iterator[tuple[Path, Unpacker]]:
    """What to give to the library for a bag, and what unpacks its messages, where they are packed.

    Files that are compressed as a whole are unpacked into a temporary folder, which is removed at
    the end.

    :raises SessionError: it is damaged, or could take more than its size accounts for.
    """
    if not source.is_dir():
        _check_storage(source)
        yield source, Unpacker()
        return
    metadata = source / "metadata.yaml"
    document = parse_yaml(
        read_bytes(metadata, _LARGEST_METADATA, error=SessionError), str(metadata)
    )
    about = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    if not isinstance(about, dict):
        raise SessionError(f"{metadata} is not the metadata of a bag")
    files = _files(source, about.get("relative_file_paths"), metadata)
    _check_topics(about.get("topics_with_message_count"), metadata)
    mode = str(about.get("compression_mode") or "none").lower()
    if mode == "none":
        for path in files:
            _check_storage(path)
        yield source, Unpacker()
        return
    if about.get("compression_format") != "zstd":
        form = one_line(about.get("compression_format"), 40)
        raise SessionError(f"{source} is compressed with {form!r}, which is not supported")
    with TemporaryFolder("bag") as folder:
        about["relative_file_paths"] = []
        for number, path in enumerate(files):
            if mode == "file":
                place = folder / f"{number}{PurePath(path.stem).suffix}"
                _unpack_file(path, place)
            else:
                place = folder / f"{number}{path.suffix}"
                place.symlink_to(path.resolve())
            _check_storage(place, path)
            about["relative_file_paths"].append(place.name)
        about["compression_mode"] = about["compression_format"] = ""
        _yaml().dump(document, folder / "metadata.yaml")
        yield folder, Unpacker(every=mode == "message")


def _files(source: Path, names: object, metadata: Path) -> list[Path]:
    """The files that a bag's metadata name, which are beside it."""
    if not isinstance(names, list) or not all(isinstance(n, str) and n for n in names):
        raise SessionError(f"{metadata} does not name the files of the bag")
    files = [source / PurePath(n).name for n in names]
    if len(set(files)) < len(files):
        raise SessionError(f"{metadata} names a file twice")
    return files


def _check_topics(topics: object, metadata: Path) -> None:
    if not isinstance(topics, list):
        raise SessionError(f"{metadata} does not name the topics of the bag")
    _limit(metadata, "topics", len(topics))
    for topic in topics:
        about = topic.get("topic_metadata") if isinstance(topic, dict) else None
        profiles = about.get("offered_qos_profiles") if isinstance(about, dict) else None
        if isinstance(profiles, str):
            parse_yaml(profiles, f"{metadata}: QoS")


def _limit(path: Path, what: str, count: int) -> None:
    if count > MOST_TOPICS:
        raise SessionError(f"{path} has {count} {what}, more than {MOST_TOPICS}")


# -- YAML ----------------------------------------------------------------------------------------


def _yaml() -> Any:
    from ruamel.yaml import YAML

    return YAML(typ="safe")


def parse_yaml(text: str | bytes, origin: str) -> Any:
    """The document in a YAML text.

    :raises SessionError: it is no YAML, has tags of programs or aliases (by which a short text
        becomes an endless one), is nested more than :data:`~dexkit.documents.DEEPEST` levels, or
        has a number of many digits.
    """
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import (
        AliasEvent,
        CollectionEndEvent,
        CollectionStartEvent,
        ScalarEvent,
    )

    depth, problem = 0, ""
    try:
        for number, event in enumerate(_yaml().parse(text)):
            if isinstance(event, CollectionStartEvent):
                depth += 1
            elif isinstance(event, CollectionEndEvent):
                depth -= 1
            if isinstance(event, AliasEvent):
                problem = "it has aliases"
            elif number > _MOST_EVENTS:
                problem = "it is too long"
            elif depth > DEEPEST:
                problem = f"nested more than {DEEPEST} levels"
            elif isinstance(event, ScalarEvent) and not event.style and _is_huge(event.value):
                problem = "a number has too many digits"
            if problem:
                line = event.start_mark.line + 1
                raise SessionError(
                    f"{origin} cannot be read: {problem}, at line {line}",
                    hint="'ros2 bag reindex' writes a bag's metadata.yaml anew",
                )
        return _yaml().load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, SessionError):
            raise
        raise SessionError(f"{origin} is not valid YAML: {one_line(error)}") from error


def _is_huge(scalar: str) -> bool:
    """Whether it may be read as a number of so many digits that this takes long."""
    return len(scalar) > 80 and set(scalar) <= set("0123456789_:+-.")


# -- compression -----------------------------------------------------------------------------------


def _unpack_file(path: Path, place: Path) -> None:
    """Unpack a file of zstd.

    :raises SessionError: it is none, unpacks to more than its size accounts for, or the disk has
        too little space.
    """
    with open_ordinary(path, error=SessionError) as packed:
        most = MAX_RATIO * path.stat().st_size + SPARE
        too_large = SessionError(
            f"{path} unpacks to more than {MAX_RATIO} times its size", hint=_UNPACK
        )
        try:
            stated = zstandard.frame_content_size(packed.read(_HEAD_OF_FRAME))
            packed.seek(0)
            if stated > most:
                raise too_large
            if stated > (free := shutil.disk_usage(place.parent).free):
                raise SessionError(
                    f"{path} unpacks to {stated} bytes, and {place.parent} has {free} free",
                    hint="name another folder in the environment variable TMPDIR",
                )
            unpacker = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW)
            with place.open("xb") as out:
                for piece in unpacker.read_to_iter(packed, read_size=_PIECE, write_size=_PIECE):
                    most -= len(piece)
                    if most < 0:
                        raise too_large
                    out.write(piece)
        except zstandard.ZstdError as error:
            raise SessionError(f"{path} cannot be unpacked: {one_line(error)}") from error
        except OSError as error:
            raise SessionError(
                f"cannot unpack {path}: {error.strerror or error}",
                hint="name another folder in the environment variable TMPDIR",
            ) from error


def is_packed(data: bytes) -> bool:
    """Whether it is a frame of zstd; nothing in CDR begins like one."""
    return data.startswith(_FRAME)


class Unpacker:
    """Unpacks the messages of a bag, all of them to no more than their size accounts for.

    :param every: each message must be packed, as the bag's metadata say. A file of a bag by itself
        does not say so: there, those that are packed are unpacked.
    """

    def __init__(self, *, every: bool = False) -> None:
        self._every = every
        self._left = SPARE
        self._unpacker = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW)

    def __call__(self, data: bytes) -> bytes:
        """Unpack one, if it is packed.

        :raises SessionError: the messages unpack to more than they may.
        :raises WireError: it cannot be unpacked.
        """
        if not (self._every or is_packed(data)):
            return data
        self._left += MAX_RATIO * len(data)
        most = min(self._left, MAX_CHUNK)
        try:
            stated = zstandard.frame_content_size(data)
            if 0 <= stated <= most:
                found = self._unpacker.decompress(data)
            else:
                found = b""
                for piece in () if stated > most else self._unpacker.read_to_iter(data):
                    found += piece
                    if len(found) > most:
                        break
        except zstandard.ZstdError as error:
            raise WireError(one_line(error)) from error
        if stated > most or len(found) > most:
            raise SessionError(
                f"its messages unpack to more than {MAX_RATIO} times their size", hint=_UNPACK
            )
        self._left -= len(found)
        return found


# -- storage -------------------------------------------------------------------------------------


def _check_storage(path: Path, name: Path | None = None) -> None:
    """Check a file with messages.

    :param name: what to call it.
    """
    name = name or path
    with open_ordinary(path, error=SessionError) as file:
        magic = file.read(len(_SQLITE))
    if magic == _SQLITE:
        _check_database(path, name)
    elif magic.startswith(MAGIC):
        _check_mcap(path, name)
    else:
        raise SessionError(f"{name} cannot be read as a ROS 2 bag: it is neither SQLite nor mcap")


def _check_mcap(path: Path, name: Path) -> None:
    container = Container(path)
    container.open()
    with container.open_file() as file:
        for segment in container.segments:
            container.read(file, segment)
    if container.damage or container.truncated:
        what = container.damage[0] if container.damage else "it is unfinished"
        raise SessionError(
            f"{name} cannot be read as a ROS 2 bag: {what}",
            hint="'dexkit info' shows what is wrong, 'dexkit cut' copies what can be read",
        )
    refuse_clock_steps(name, container.clock_steps)
    _limit(name, "topics", len(container.channels))
    channels = container.channels.values()
    for profiles in {c.metadata.get("offered_qos_profiles", "") for c in channels}:
        parse_yaml(profiles, f"{name}: QoS")


def _check_database(path: Path, name: Path) -> None:
    """Check that the tables of a database are tables, each of whose pages is used once.

    :raises SessionError: they are not.
    """
    if set(str(path)) & set("%?#"):  # the library does not escape them in the URI
        raise SessionError(
            f"{name} cannot be opened by the library rosbags: its path has one of the characters "
            "%, ? and #",
            hint="rename it",
        )
    size = path.stat().st_size
    try:
        with contextlib.closing(
            sqlite3.connect(f"file:{path.absolute()}?mode=ro&immutable=1", uri=True)
        ) as database:
            looks = iter(range(100 + _STEPS_PER_BYTE * size // _STEPS))
            database.set_progress_handler(lambda: next(looks, None) is None, _STEPS)
            for setting in _SETTINGS:
                database.execute(f"PRAGMA {setting}")
            _check_tables(database, name, size)
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
        raise SessionError(
            f"{name} cannot be read as a ROS 2 bag: {one_line(error)}",
            hint="a database that is damaged may be repaired: sqlite3 FILE .recover",
        ) from error


def _check_tables(database: sqlite3.Connection, name: Path, size: int) -> None:
    def refuse(why: str) -> SessionError:
        return SessionError(f"{name} cannot be read as a ROS 2 bag: {why}")

    marks = ",".join("?" * len(_TABLES))
    rows = database.execute(
        "SELECT lower(name), type, rootpage FROM sqlite_master "
        f"WHERE type IN ('table', 'view') AND lower(name) IN ({marks}) LIMIT 100",
        _TABLES,
    ).fetchall()
    there = [row[0] for row in rows]
    if not {"messages", "topics"} <= set(there):
        raise refuse("it has no tables of messages and topics")
    for table, kind, root in rows:
        # a virtual table has no pages of its own
        if kind != "table" or not root or there.count(table) > 1:
            raise refuse(f"{table} is not a table of its own data")
    found = database.execute("PRAGMA quick_check(1)").fetchone()
    # a row without a value is left out when the messages are copied
    if found is None or not (found[0] == "ok" or str(found[0]).startswith("NULL value in")):
        raise refuse(one_line(found and found[0], 200))
    for table in there:
        columns = database.execute(f"PRAGMA table_xinfo({table})").fetchmany(100)
        if any(column[6] for column in columns) or len(columns) == 100:
            raise refuse(f"{table} has columns that are computed")
        lengths = "+".join(f"ifnull(length({_quoted(c[1])}),0)" for c in columns)
        count, total, most = database.execute(
            f"SELECT count(*), total({lengths}), max({lengths}) FROM {table}"
        ).fetchone()
        # a number has up to 4 digits a byte; defaults of a column are in no row
        if total > 4 * size + 1000:
            raise refuse(f"{table} has more data than the file")
        if count and most > MAX_CHUNK:
            raise refuse(f"a row of {table} has more than {MAX_CHUNK >> 20} MB")
        if table in ("topics", "message_definitions"):
            _limit(name, table.replace("_", " "), count)
    (back,) = database.execute(
        "SELECT max(before - timestamp) FROM (SELECT timestamp, lag(timestamp) OVER "
        "(PARTITION BY topic_id ORDER BY id) AS before FROM messages "
        # others are no times, and are left out when the messages are copied
        "WHERE typeof(timestamp) = 'integer' AND timestamp >= 0)"
    ).fetchone()
    if isinstance(back, int) and back > LIMIT_NS:
        raise refuse(f"its clock steps back by {back / 1e9:.3f} s: it has a stretch of time twice")
    (twice,) = database.execute("SELECT count(*) - count(DISTINCT id) FROM topics").fetchone()
    if twice:
        raise refuse("two topics have one number")
    names = [c[1] for c in database.execute("PRAGMA table_xinfo(topics)")]
    if "offered_qos_profiles" in names:
        for (text,) in database.execute("SELECT DISTINCT offered_qos_profiles FROM topics"):
            if isinstance(text, str):
                parse_yaml(text, f"{name}: QoS")


def _quoted(column: str) -> str:
    return '"' + column.replace('"', '""') + '"'
