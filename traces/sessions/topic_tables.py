"""Convert recordings to and from tables: a folder with one CSV or Parquet file per topic, lossless.

Every member of a message is a column, named by its path (``motor_state[3].q``), in its own type; a
shorter sequence leaves its columns empty. Messages of types that dexkit does not know have their
payload as one column. ``session.json`` holds everything that belongs to no topic.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dexkit.documents import open_ordinary, read_bytes
from dexkit.errors import DexkitError, ExtraMissing, SessionError, UsageError
from dexkit.escaping import one_line
from dexkit.messages import MessageType, message_type
from dexkit.messages.columns import encode_columns
from dexkit.messages.layout import Primitive, Struct
from dexkit.staging import whole_folder
from dexkit.traces.clock_steps import refuse_clock_steps
from dexkit.traces.reader import (
    LATE_TIMES,
    LATEST_NS,
    ChannelInfo,
    Definition,
    SampleArray,
    Trace,
    TraceMessage,
    signed_times,
)
from dexkit.traces.sessions.lerobot_format import parquet_library, parquet_pieces
from dexkit.traces.sessions.model import Problems
from dexkit.traces.sessions.paths import below, file_name
from dexkit.traces.sessions.typed import parse_record, to_record
from dexkit.traces.writer import RecordingWriter, definition

__all__ = ["export_tables", "import_tables", "is_tables"]

_ABOUT = "session.json"
_KEY = "dexkit_tables"
_TIMES = ("log_time_ns", "publish_time_ns")
_PAYLOAD = "payload"
# Bytes of a CSV file, and of session.json.
_LARGEST = 1 << 30
_LARGEST_ABOUT = 64 * 2**20
# Largest number of sequence elements with columns.
_LONGEST = 256
_MOST_COLUMNS = 2**16
_VALUES_AT_ONCE = 2**20
# Values and bytes of payloads that an export holds at once, and messages while it counts elements.
_VALUES_WRITTEN = 2**22
_BYTES_WRITTEN = 2**24
_ROWS_MEASURED = 2**13
_LONGEST_LINE = 64 * 2**20  # characters


@dataclass(frozen=True)
class _Leaf:
    """A number in a message.

    :param steps: names of members and places in lists, from the message inward.
    """

    path: str
    steps: tuple[str | int, ...]
    dtype: str

    @property
    def whole(self) -> bool:
        """Whether it is an integer."""
        return self.dtype[0] != "f"


def is_tables(source: Path) -> bool:
    """Whether it looks like a folder of tables."""
    try:
        return _KEY in json.loads(read_bytes(source / _ABOUT, _LARGEST_ABOUT))
    except (UsageError, ValueError, TypeError, RecursionError):
        return False


def _leaves(kind: Struct, lengths: Mapping[str, int]) -> Iterator[_Leaf]:
    """The numbers of a message whose sequences have these lengths."""
    for member in kind.fields:
        count = lengths.get(member.name, 0) if member.sequence else member.array
        places: Sequence[tuple[str, tuple[str | int, ...]]]
        if count is None:
            places = [(member.name, (member.name,))]
        else:
            places = [(f"{member.name}[{i}]", (member.name, i)) for i in range(count)]
        for path, steps in places:
            if isinstance(member.type, Primitive):
                yield _Leaf(path, steps, member.type.dtype)
            else:
                for inner in _leaves(member.type, {}):
                    yield _Leaf(f"{path}.{inner.path}", (*steps, *inner.steps), inner.dtype)


# -- export
# -----------------------------------------------------------------------------------------


def export_tables(trace: Trace, out: Path, form: str) -> tuple[int, list[str]]:
    """Write a recording as tables.

    :param form: ``csv`` or ``parquet``.
    :returns: the number of messages written, and descriptions of data that the tables cannot hold.
    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: ``out`` exists or cannot be written, or the recording has a stretch of
        time twice.
    """
    refuse_clock_steps(trace.path, trace.clock_steps)
    lost = [
        "encapsulation and padding bytes of the payloads, and sequence numbers of the messages",
    ]
    with whole_folder(out, error=SessionError) as root:
        root.mkdir()
        topics, written = [], 0
        for number, ((topic, type_name), d) in enumerate(sorted(trace.definitions.items())):
            name = f"{number:03d}_{file_name(topic)}.{form}"
            entry = {
                "topic": d.topic,
                "type": type_name,
                "file": name,
                "message_encoding": d.message_encoding,
                "metadata": d.metadata,
                "schema": None
                if d.schema is None
                else [*d.schema[:2], base64.b64encode(d.schema[2]).decode()],
            }
            info = next(c for c in trace.channels if (c.topic, c.type_name) == (topic, type_name))
            written += _export_topic(trace, info, root / name, form, entry, lost)
            topics.append(entry)
        about = {_KEY: 1, "topics": topics, "metadata": trace.metadata, "lost": lost}
        text = json.dumps(about, indent=1, ensure_ascii=False) + "\n"
        (root / _ABOUT).write_bytes(text.encode("utf-8", "backslashreplace"))
    return written, lost


def _export_topic(
    trace: Trace, info: ChannelInfo, path: Path, form: str, entry: dict[str, Any], lost: list[str]
) -> int:
    """Write the table of a topic; return the number of its rows."""
    rows, late = 0, False
    if info.problem or trace.message_type(info.topic).name != info.type_name:
        entry["columns"] = _PAYLOAD
        with _TableFile(path, form, [*_TIMES, _PAYLOAD]) as file:
            for some in _payloads(trace, info):
                times = ([m.log_time_ns for m in some], [m.publish_time_ns for m in some])
                columns = [_Column(signed_times(np.array(t, dtype=np.uint64))) for t in times]
                file.write(columns, [m.data for m in some])
                rows += len(some)
                late = late or _is_late(columns)
        if late:
            lost.append(f"{info.topic}: {LATE_TIMES}")
        return rows
    layout = message_type(info.type_name).layout
    lengths = _longest(trace, info.topic, layout)
    if too_long := [s for s, n in lengths.items() if n > _LONGEST]:
        raise SessionError(
            f"{info.topic} has {lengths[too_long[0]]} elements of {too_long[0]} in a message: a "
            f"table holds {_LONGEST} at most"
        )
    entry["columns"] = "members"
    leaves = list(_leaves(layout, lengths))
    names = [*_TIMES, *(f"len({s})" for s in lengths), *(leaf.path for leaf in leaves)]
    bad = 0
    with _TableFile(path, form, names) as file:
        for samples in trace.pieces(info.topic, max(1, _VALUES_WRITTEN // len(names))):
            columns, left_out = _members(samples, lengths, leaves)
            file.write(columns)
            rows += len(samples) - left_out
            bad += left_out
            late = late or _is_late(columns[: len(_TIMES)])
    if bad:
        lost.append(f"{info.topic}: {bad} messages that cannot be decoded")
    if late:
        lost.append(f"{info.topic}: {LATE_TIMES}")
    return rows


def _payloads(trace: Trace, info: ChannelInfo) -> Iterator[list[TraceMessage]]:
    """The messages of one type of a topic, some at a time; at least one piece."""
    some: list[TraceMessage] = []
    size, given = 0, False
    for message in trace.messages([info.topic]):
        if message.type_name == info.type_name:
            some.append(message)
            size += len(message.data) + 1
            if size >= _BYTES_WRITTEN:
                yield some
                some, size, given = [], 0, True
    if some or not given:
        yield some


def _longest(trace: Trace, topic: str, layout: Struct) -> dict[str, int]:
    """The largest number of elements of each sequence in the messages that can be decoded."""
    lengths = {f.name: 0 for f in layout.fields if f.sequence}
    for samples in trace.pieces(topic, _ROWS_MEASURED) if lengths else ():
        decoded = samples.columns()
        lengths = {s: max(n, int(decoded.count(s).max(initial=0))) for s, n in lengths.items()}
    return lengths


def _members(
    samples: SampleArray, lengths: Mapping[str, int], leaves: Sequence[_Leaf]
) -> tuple[list[_Column], int]:
    """The columns of the messages that can be decoded, and how many cannot."""
    decoded = samples.columns()
    good = decoded.ok
    counts = {s: decoded.count(s)[good] for s in lengths}
    columns = [_Column(samples.log_time_ns[good]), _Column(samples.publish_time_ns[good])]
    columns += [_Column(n.astype(np.int32)) for n in counts.values()]
    for leaf in leaves:
        sequence, place = leaf.steps[0], leaf.steps[1] if len(leaf.steps) > 1 else 0
        there = None
        if sequence in counts and isinstance(place, int):
            there = counts[str(sequence)] > place
        if there is not None and not there.any():  # there may be no such column in this piece
            columns.append(_Column(np.zeros(len(there), leaf.dtype), there))
            continue
        values = decoded[leaf.path][good]
        if there is not None:
            values = np.where(there, values, 0.0)
        columns.append(_Column(values.astype(leaf.dtype), there))
    return columns, int(np.count_nonzero(~good))


def _is_late(times: Sequence[_Column]) -> bool:
    """Whether a time does not fit into the table."""
    return any(bool((c.values == LATEST_NS).any()) for c in times)


@dataclass(frozen=True, eq=False)
class _Column:
    """The values of a column.

    :param there: which rows have a value; None for all.
    """

    values: NDArray[Any]
    there: NDArray[np.bool_] | None = None

    def texts(self) -> list[str]:
        """For CSV: the shortest text that reads back as the same value."""
        # compared by their bits, because -0.0 == 0.0 and NaN != NaN
        bits = self.values.view(f"u{self.values.itemsize}")
        different, places = np.unique(bits, return_inverse=True)
        different = different.view(self.values.dtype)
        made = np.array([str(v) for v in different], dtype=object)[places]
        if self.there is not None:
            made = np.where(self.there, made, "")
        found: list[str] = made.tolist()
        return found


class _TableFile:
    """A table that is written some rows at a time; a context manager.

    :param form: ``csv`` or ``parquet``.
    :param names: of its columns; payloads are the last one.
    :raises ExtraMissing: pyarrow is not installed.
    """

    def __init__(self, path: Path, form: str, names: Sequence[str]) -> None:
        self._path, self._names = path, list(names)
        self._file: Any = None
        self._csv = form == "csv"
        if not self._csv:
            self._arrow, self._parquet = parquet_library()

    def __enter__(self) -> _TableFile:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._file is not None:
            self._file.close()

    def write(self, columns: Sequence[_Column], payloads: Sequence[bytes] | None = None) -> None:
        """Append rows."""
        if self._csv:
            self._write_csv(columns, payloads)
            return
        arrow = self._arrow
        arrays = [
            arrow.array(c.values, mask=None if c.there is None else ~c.there) for c in columns
        ]
        if payloads is not None:
            arrays.append(arrow.array(payloads, type=arrow.binary()))
        table = arrow.table(arrays, names=self._names)
        if self._file is None:
            self._file = self._parquet.ParquetWriter(
                str(self._path), table.schema, compression="zstd"
            )
        self._file.write_table(table)

    def _write_csv(self, columns: Sequence[_Column], payloads: Sequence[bytes] | None) -> None:
        texts = [c.texts() for c in columns]
        if payloads is not None:
            texts.append([base64.b64encode(p).decode() for p in payloads])
        first = self._file is None
        if first:
            self._file = self._path.open("w", newline="", encoding="utf-8")
        writer = csv.writer(self._file)
        if first:
            writer.writerow(self._names)
        writer.writerows(zip(*texts, strict=True))


# -- import
# ------------------------------------------------------------------------------------------


def import_tables(source: Path, out: Path, *, overwrite: bool = False) -> tuple[int, Problems]:
    """Convert tables to a recording.

    :returns: the number of messages, and what could not be imported.
    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: they cannot be read, or nothing in them can be used.
    """
    path = below(source, _ABOUT)
    data = read_bytes(path, _LARGEST_ABOUT, error=SessionError)
    about = parse_record(data.decode("utf-8-sig", "replace"), _About, path)
    problems = Problems()
    rows: list[tuple[int, int, int, int, bytes]] = []
    with RecordingWriter(out, overwrite=overwrite) as writer:
        for name, values in about.metadata.items():
            writer.add_metadata(name, values)
        for number, entry in enumerate(about.topics):
            try:
                topic = to_record(entry, _Topic, f"{path}, topics[{number}]")
                channel, found = _import_topic(source, topic, problems)
            except DexkitError as error:
                if isinstance(error, ExtraMissing):
                    raise
                problems.add(error.message)
                continue
            place = writer.add_channel(channel)
            rows += [(log, len(rows) + i, sent, place, d) for i, (log, sent, d) in enumerate(found)]
        for log, _, sent, place, data in sorted(rows, key=lambda r: r[:2]):
            writer.put(place, data, log, sent)
        if not writer.written:
            raise SessionError(
                f"{source} has no message that can be used",
                hint="; ".join(problems.sentences()[:3]),
            )
        return writer.written, problems


class _Topic(msgspec.Struct):
    """A topic in ``session.json``; its schema's text is base64."""

    topic: str
    file: str
    type: str = ""
    message_encoding: str = "cdr"
    metadata: dict[str, str] = {}
    schema: tuple[str, str, str] | None = None
    columns: str = "members"


class _About(msgspec.Struct):
    """``session.json``; each topic is checked when it is read."""

    topics: list[Any]
    metadata: dict[str, dict[str, str]] = {}


def _import_topic(
    source: Path, entry: _Topic, problems: Problems
) -> tuple[Definition, list[tuple[int, int, bytes]]]:
    name = entry.file
    path = below(source, name)
    found: list[tuple[int, int, bytes]] = []

    def report(lines: list[int]) -> None:
        for line in sorted(lines):
            problems.add(f"{name}: rows that cannot be read are left out", f"row {line}")

    pieces = _pieces(path)
    if entry.columns == _PAYLOAD:
        schema = None
        if entry.schema is not None:
            try:
                schema = (*entry.schema[:2], base64.b64decode(entry.schema[2]))
            except ValueError as error:
                raise SessionError(f"{name}: its schema cannot be read: {error}") from error
        channel = Definition(entry.topic, entry.message_encoding, entry.metadata, schema)
        for piece in pieces:
            bad = list(piece.short)
            for line, row in zip(piece.lines, zip(*piece.columns, strict=True), strict=True):
                try:
                    data = row[2] if isinstance(row[2], bytes) else base64.b64decode(row[2])
                    found.append((int(row[0]), int(row[1]), data))
                except (ValueError, TypeError, LookupError):
                    bad.append(line)
            report(bad)
        return channel, found
    mt = message_type(entry.type)
    channel = definition(entry.topic, mt, entry.metadata)
    for piece in pieces:
        encoded, numbers = _encode(mt, piece.header, piece.columns, name)
        found += encoded
        report([*piece.short, *(piece.lines[number] for number in numbers)])
    return channel, found


def _encode(
    mt: MessageType, header: Sequence[str], columns: Sequence[Sequence[Any]], name: str
) -> tuple[list[tuple[int, int, bytes]], list[int]]:
    """The messages of a table, and the numbers of invalid rows."""
    table = dict(zip(header, columns, strict=True))
    sequences = [f.name for f in mt.layout.fields if f.sequence]
    lengths = dict.fromkeys(sequences, 0)
    indexed = {c.partition("]")[0] for c in header if "]" in c}
    for s in sequences:
        while f"{s}[{lengths[s]}" in indexed:
            lengths[s] += 1
            if lengths[s] > _LONGEST:
                raise SessionError(f"{name} has too many columns of {s}")
    leaves = list(_leaves(mt.layout, lengths))
    wanted = [*(f"len({s})" for s in sequences), *(leaf.path for leaf in leaves)]
    if missing := [p for p in wanted if p not in table]:
        raise SessionError(f"{name} lacks {len(missing)} columns, {missing[0]} for one")
    log, good = _numbers(table[_TIMES[0]], "i8")
    sent, there = _numbers(table[_TIMES[1]], "i8")
    good = good & there & (log >= 0) & (sent >= 0)
    counts = np.zeros((len(log), len(sequences)), dtype=np.int64)
    for i, s in enumerate(sequences):
        counts[:, i], there = _numbers(table[f"len({s})"], "i4")
        good &= there & (counts[:, i] >= 0) & (counts[:, i] <= lengths[s])
    values = {leaf.path: _numbers(table[leaf.path], leaf.dtype) for leaf in leaves}
    found: list[tuple[int, int, bytes] | None] = [None] * len(log)
    for shape in np.unique(counts[good], axis=0) if good.any() else ():
        sizes = dict(zip(sequences, shape.tolist(), strict=True))
        own = list(_leaves(mt.layout, sizes))
        rows = good & (counts == shape).all(axis=1)
        for leaf in own:
            rows &= values[leaf.path][1]
        if not rows.any():
            continue
        elements = {
            f.name: [
                message_type(f.type.dds_name).cls() if isinstance(f.type, Struct) else 0
                for _ in range(sizes[f.name])
            ]
            for f in mt.layout.fields
            if f.sequence
        }
        example = mt.encode(mt.cls(**elements))
        data = encode_columns(
            mt.layout,
            example,
            [(leaf.steps, values[leaf.path][0][rows]) for leaf in own],
            int(rows.sum()),
        )
        for i, payload in zip(np.flatnonzero(rows).tolist(), data, strict=True):
            found[i] = (int(log[i]), int(sent[i]), payload)
    return [f for f in found if f is not None], [i for i, f in enumerate(found) if f is None]


def _numbers(column: Sequence[Any], dtype: str) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The values of a column, and which rows have a valid one."""
    kind = np.dtype(dtype)
    if kind.kind == "f" and {type(v) for v in column} <= {float, type(None)}:
        # one by one, because 0.0 == -0.0
        doubles = np.array([0.0 if v is None else v for v in column], dtype=np.float64)
        with np.errstate(over="ignore"):
            values = doubles.astype(kind)
        there = np.array([v is not None for v in column], dtype=np.bool_)
        return values, there & (np.isinf(values) == np.isinf(doubles))
    known: dict[Any, Any] = {}
    for value in set(column):
        known[value] = _number(value, kind)
    found = [known[value] for value in column]
    there = np.array([v is not None for v in found], dtype=np.bool_)
    return np.array([0 if v is None else v for v in found], dtype=kind), there


def _number(value: Any, kind: np.dtype[Any]) -> Any:
    """Parse a value of that type; None if it is invalid."""
    if value is None or value == "" or isinstance(value, bytes):
        return None
    try:
        if kind.kind == "f":
            number = np.float64(value)
            with np.errstate(over="ignore"):
                single = kind.type(number)
            return None if np.isinf(single) and not np.isinf(number) else single
        if isinstance(value, float) and not value.is_integer():
            return None
        whole = int(value)
    except (ValueError, TypeError, OverflowError):
        return None
    limits = np.iinfo(kind) if kind.kind in "iu" else None
    return whole if limits is None or limits.min <= whole <= limits.max else None


@dataclass(frozen=True)
class _Piece:
    """Some rows of a table, by columns.

    :param lines: the number of each row in a CSV file.
    :param short: those of rows between them that are left out, for they lack values.
    """

    header: Sequence[str]
    columns: Sequence[Sequence[Any]]
    lines: Sequence[int]
    short: Sequence[int] = ()


def _pieces(path: Path) -> Iterator[_Piece]:
    """A table, some rows at a time; at least one piece, which may be empty.

    :raises SessionError: it cannot be read, or has not the columns of times.
    """
    pieces = _parquet_pieces(path) if path.suffix == ".parquet" else _csv_pieces(path)
    for piece in pieces:
        if list(piece.header[:2]) != list(_TIMES):
            raise SessionError(f"{path.name} does not begin with the columns {', '.join(_TIMES)}")
        yield piece


def _csv_pieces(path: Path) -> Iterator[_Piece]:
    with open_ordinary(path, error=SessionError) as file:
        if os.fstat(file.fileno()).st_size > _LARGEST:
            raise SessionError(f"cannot read {path}: it is larger than {_LARGEST >> 20} MB")
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        try:
            reader = csv.reader(_lines(text, path))
            header = next(reader, [])
            width = len(header)
            if width > _MOST_COLUMNS:
                raise SessionError(f"{path} has {width} columns, more than {_MOST_COLUMNS}")
            at_once = max(1, _VALUES_AT_ONCE // max(1, width))
            rows: list[list[str]] = []
            lines: list[int] = []
            short: list[int] = []
            for line, row in enumerate(reader, 2):
                # one that is short is not filled up: it may be a byte for each of many columns
                if len(row) < width:
                    short.append(line)
                    continue
                rows.append(row[:width])
                lines.append(line)
                if len(rows) == at_once:
                    yield _Piece(header, list(zip(*rows, strict=True)), lines, short)
                    rows, lines, short = [], [], []
            columns = list(zip(*rows, strict=True)) if rows else [()] * width
            yield _Piece(header, columns, lines, short)
        except UnicodeDecodeError as error:
            raise SessionError(f"{path} is not UTF-8 text") from error
        except OSError as error:
            raise SessionError(f"cannot read {path}: {error.strerror}") from error
        except csv.Error as error:
            raise SessionError(f"{path} cannot be read as CSV: {error}") from error


def _lines(text: io.TextIOBase, path: Path) -> Iterator[str]:
    while line := text.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise SessionError(f"{path} has a line of more than {_LONGEST_LINE >> 20} MB")
        yield line


def _is_plain(kind: Any) -> bool:
    """Whether a type of Arrow has values that are numbers, texts, bytes or none."""
    arrow, _ = parquet_library()
    types = arrow.types
    if types.is_dictionary(kind):
        kind = kind.value_type
    plain = (
        *(types.is_integer, types.is_floating, types.is_boolean, types.is_null),
        *(types.is_decimal, types.is_string, types.is_large_string),
        *(types.is_binary, types.is_large_binary, types.is_fixed_size_binary),
    )
    return any(is_a(kind) for is_a in plain)


def _parquet_pieces(path: Path) -> Iterator[_Piece]:
    line = 2
    for table in parquet_pieces(path):
        if table.num_columns > _MOST_COLUMNS:
            raise SessionError(f"{path} has more than {_MOST_COLUMNS} columns")
        for field in table.schema:
            if not _is_plain(field.type):
                raise SessionError(
                    f"{path}: column {one_line(field.name, 60)} has values of type "
                    f"{one_line(field.type, 60)}, not numbers, texts or bytes"
                )
        try:
            header, columns = list(table.column_names), [c.to_pylist() for c in table.columns]
        except UnicodeDecodeError as error:
            raise SessionError(f"{path} has a text that is not UTF-8") from error
        yield _Piece(header, columns, range(line, line + table.num_rows))
        line += table.num_rows
