"""ROS 2 bags, sqlite3 and mcap, in and out, with the library rosbags (the extra ``rosbag``).

A bag's topics are the DDS topics without ``rt/``, and its payloads are the samples, so they are
copied. Only payloads in an earlier layout of one of Unitree's types (unitree_ros2 before v0.3.0 had
that of 2024) are converted to the present one, with a note.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexkit import __version__
from dexkit.errors import DexkitError, ExtraMissing, SessionError, TraceUnsupported, WireError
from dexkit.messages import message_type
from dexkit.messages.layout import STRUCTS
from dexkit.staging import whole_folder
from dexkit.traces import schemas
from dexkit.traces.bag_metadata import custom_data, records_of
from dexkit.traces.clock_steps import refuse_clock_steps
from dexkit.traces.names import dds_topic, dds_type
from dexkit.traces.reader import LATE_TIMES, LATEST_NS, Definition, Trace
from dexkit.traces.sessions import old_layouts
from dexkit.traces.sessions.bag_checks import Unpacker, checked_bag
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.model import Problems
from dexkit.traces.writer import RecordingWriter, definition

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

__all__ = ["export_bag", "import_bag", "is_bag"]

# Payloads examined to detect the layout of a topic without a schema.
_TRIED = 50
# Key in the bag's custom data for everything that has no other place in a bag.
_LOSSES = "dexkit.lost"

Convert = Callable[[bytes], bytes]


def _library() -> Any:
    try:
        import rosbags.rosbag2 as library
    except ImportError as error:
        raise ExtraMissing(
            "ROS 2 bags need the library rosbags", hint="pip install 'dexkit[rosbag]'"
        ) from error
    return library


def is_bag(source: Path) -> bool:
    """Whether it looks like a bag: a folder with ``metadata.yaml``, a ``.db3``, or an ``.mcap``."""
    return (source / "metadata.yaml").is_file() or source.suffix in (".db3", ".mcap")


def import_bag(
    source: Path, out: Path, *, overwrite: bool = False
) -> tuple[int, list[str], Problems]:
    """Convert a bag to a recording.

    :returns: the number of messages, corrections, and data that could not be imported.
    :raises ExtraMissing: rosbags is not installed.
    :raises SessionError: it cannot be read, or nothing in it can be used.
    """
    library = _library()
    problems = Problems()
    corrections: list[str] = []
    with (
        checked_bag(source) as (bag, unpack),
        RecordingWriter(out, overwrite=overwrite) as writer,
    ):
        try:
            with library.Reader(bag) as reader:
                _ignore_qos(reader)
                channels = {}
                for connection in reader.connections:
                    messages = (data for _, _, data in reader.messages([connection]))
                    found = _channel(messages, connection, unpack, problems, corrections)
                    if found is not None:
                        channel, convert = found
                        channels[connection.id] = (writer.add_channel(channel), convert)
                wanted = [c for c in reader.connections if c.id in channels]
                if wanted:
                    _copy(wanted, reader.messages(wanted), channels, unpack, writer, problems)
                _write_metadata(writer, reader, source, problems, corrections)
        except (DexkitError, MemoryError):
            raise
        except Exception as error:  # the library raises many kinds for damaged files
            raise SessionError(f"{source} cannot be read as a ROS 2 bag: {error}") from error
        if not writer.written:
            raise SessionError(
                f"{source} has no message that can be used",
                hint="; ".join(problems.sentences()[:3]),
            )
        return writer.written, corrections, problems


def _ignore_qos(reader: Any) -> None:
    """Let a bag's metadata and its files differ in QoS, which is written in several spellings; the
    library takes what differs for other topics.
    """
    known = {(c.topic, c.msgtype): c.ext for c in reader.connections}
    for storage in getattr(reader.storage, "storages", ()):
        storage.connections = [
            c._replace(ext=known.get((c.topic, c.msgtype), c.ext)) for c in storage.connections
        ]


def _copy(
    wanted: Sequence[Connection],
    messages: Iterable[tuple[Connection, int, object]],
    channels: dict[int, tuple[int, Convert | None]],
    unpack: Unpacker,
    writer: RecordingWriter,
    problems: Problems,
) -> None:
    missing = {c.id: c.msgcount for c in wanted}
    for connection, time_ns, data in messages:
        missing[connection.id] -= 1
        number, convert = channels[connection.id]
        if not isinstance(data, bytes | bytearray | memoryview):  # SQLite gives what is there
            problems.add(
                f"{connection.topic}: messages that are no bytes are left out", f"at {time_ns} ns"
            )
            continue
        if not 0 <= time_ns < 2**63:
            problems.add(
                f"{connection.topic}: messages without a time are left out", f"at {time_ns} ns"
            )
            continue
        payload = bytes(data)
        try:
            payload = unpack(payload)
            if convert is not None:
                payload = convert(payload)
        except WireError as error:
            problems.add(
                f"{connection.topic}: messages that cannot be read are left out", error.message
            )
            continue
        writer.put(number, payload, time_ns)
    for connection in wanted:
        if missing[connection.id] > 0:
            problems.add(
                f"{connection.topic}: messages that its metadata counts are not in the bag",
                f"{missing[connection.id]} of {connection.msgcount}",
            )


def _channel(
    messages: Iterator[object],
    connection: Connection,
    unpack: Unpacker,
    problems: Problems,
    corrections: list[str],
) -> tuple[Definition, Convert | None] | None:
    """The channel for a connection; None if it is left out."""
    topic, type_name = dds_topic(connection.topic), dds_type(connection.msgtype)
    text = connection.msgdef.data if connection.msgdef else ""
    encoding = getattr(connection.msgdef.format, "name", "")
    encoding = {"MSG": "ros2msg", "IDL": "ros2idl"}.get(encoding, "")
    if getattr(connection.ext, "serialization_format", "cdr") != "cdr":
        problems.add(f"{connection.topic} is not CDR and is left out")
        return None
    if type_name not in STRUCTS:
        if not text:
            problems.add(
                f"{connection.topic} is left out: the bag has no definition of {connection.msgtype}"
            )
            return None
        return Definition(topic, "cdr", {}, (connection.msgtype, encoding, text.encode())), None
    ours = definition(topic, message_type(type_name))
    if text:
        try:
            recorded = schemas.parse(encoding, connection.msgtype, text)
            convert, differences = old_layouts.converter(type_name, recorded)
        except TraceUnsupported as error:
            problems.add(f"{connection.topic} is left out: {error.message}")
            return None
        if convert is not None:
            corrections.append(
                f"{connection.topic}: an earlier layout of {connection.msgtype} turned into the "
                f"present one ({'; '.join(differences)})"
            )
        return ours, convert
    some = []
    for data in islice(messages, _TRIED):
        payload = bytes(data) if isinstance(data, bytes | bytearray | memoryview) else b""
        with contextlib.suppress(WireError):
            some.append(unpack(payload))
    layout = old_layouts.matching_layout(type_name, some)
    if layout is None:
        problems.add(
            f"{connection.topic} is left out: the bag has no definition of {connection.msgtype}, "
            "and no known layout fits its messages"
        )
        return None
    when, structure = layout
    if structure is None:
        return ours, None
    corrections.append(
        f"{connection.topic}: the bag has no definition of {connection.msgtype}; its messages fit "
        f"the layout {when}, and are turned into the present one"
    )
    return ours, old_layouts.converter(type_name, structure)[0]


def _write_metadata(
    writer: RecordingWriter, reader: Any, source: Path, problems: Problems, corrections: list[str]
) -> None:
    """Write the bag's metadata, and how it was imported."""
    storage = getattr(reader.storage, "metadata", None)
    record = {
        "version": __version__,
        "format": "ROS 2 bag",
        "source": source.name,
        "clock": "measured",
    }
    kept, others = records_of(getattr(storage, "custom", None))
    record |= {f"custom {key}": value for key, value in others.items()}
    # a recording that was imported before keeps its own record
    for name, values in kept.items():
        writer.add_metadata(name, values)
    for number, text in enumerate(corrections, 1):
        record[f"correction {number}"] = text
    for number, text in enumerate(problems.sentences(), 1):
        record[f"problem {number}"] = text
    if RECORD not in kept:
        writer.add_metadata(RECORD, record)


def export_bag(trace: Trace, out: Path, *, storage: str = "sqlite3") -> tuple[int, list[str]]:
    """Convert a recording to a bag (a folder).

    :param storage: ``sqlite3`` or ``mcap``.
    :returns: the number of messages written, and descriptions of data that the bag cannot hold.
    :raises ExtraMissing: rosbags is not installed.
    :raises SessionError: ``out`` exists or cannot be written, or the recording has a stretch of
        time twice.
    """
    refuse_clock_steps(trace.path, trace.clock_steps)
    library = _library()
    plugin = library.StoragePlugin.MCAP if storage == "mcap" else library.StoragePlugin.SQLITE3
    lost = ["source timestamps of the samples (publish time): a bag has one time a message"]
    with whole_folder(out, error=SessionError) as root, _named_errors(library, out):
        written = 0
        writer = library.Writer(root, version=9, storage_plugin=plugin)
        with writer:
            connections = {}
            for key, d in trace.definitions.items():
                ros_name, text = _schema(key[1], d)
                if not text or d.message_encoding != "cdr":
                    lost.append(f"{key[0]}: it has no definition in ROS form")
                    continue
                try:
                    digest = _type_hash(ros_name, text)
                except MemoryError:
                    raise
                # raised by the library for a definition that it cannot read
                except Exception as error:
                    lost.append(f"{key[0]}: its definition cannot be read: {error}")
                    continue
                connections[key] = writer.add_connection(
                    f"/{key[0].removeprefix('rt/')}", ros_name, msgdef=text, rihs01=digest
                )
            late = dict[str, None]()
            for m in trace.messages():
                connection = connections.get((m.topic, m.type_name))
                if connection is not None:
                    if m.log_time_ns >= LATEST_NS:
                        late[f"{m.topic}: {LATE_TIMES}"] = None
                    writer.write(connection, min(m.log_time_ns, LATEST_NS), m.data)
                    written += 1
            lost += late
            for name, text in custom_data(trace.metadata).items():
                writer.set_custom_data(name, text)
            writer.set_custom_data(_LOSSES, json.dumps(lost))
        if not written:
            raise SessionError(
                f"{trace.path} has no message that a bag can hold", hint="; ".join(lost[1:4])
            )
    return written, lost


@contextlib.contextmanager
def _named_errors(library: Any, out: Path) -> Iterator[None]:
    try:
        yield
    except (library.WriterError, sqlite3.Error) as error:
        raise SessionError(f"cannot write {out}: {error}") from error


def _type_hash(ros_name: str, text: str) -> str:
    """The hash of a type's description, which readers of bags compare."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    is_idl = text.startswith("=" * 80)
    store.register(get_types_from_idl(text) if is_idl else get_types_from_msg(text, ros_name))
    return store.hash_rihs01(ros_name)


def _schema(type_name: str, d: Definition) -> tuple[str, str]:
    """(name of the ROS 2 type, its definition)"""
    if type_name in STRUCTS:
        mt = message_type(type_name)
        if d.schema is not None and d.schema[1] == "ros2msg":
            return mt.ros_name, d.schema[2].decode("utf-8", "replace")
        return mt.ros_name, mt.ros2msg
    if d.schema is not None and d.schema[1] in ("ros2msg", "ros2idl"):
        return d.schema[0], d.schema[2].decode("utf-8", "replace")
    return "", ""
