"""Sessions of other formats, damaged, as ``dexkit import`` and ``dexkit export`` read them.

Values are replaced by those of other types and texts by words of the format, files are damaged as
bytes, and paths lead to files beside the source, which nothing may read.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import zstandard

from dexkit.traces import open_trace
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.lerobot_out import export_dataset
from dexkit.traces.sessions.rosbag import export_bag
from dexkit.traces.sessions.sources import find
from dexkit.traces.sessions.topic_tables import export_tables
from dexkit.traces.writer import RecordingWriter
from tools.campaign.children import scratch_root
from tools.campaign.fuzz.case import FuzzCase, Target
from tools.campaign.fuzz.ground import ELSEWHERE, HERE, Files, Ground
from tools.campaign.fuzz.parquet import damaged_parquet, rows_of, written
from tools.campaign.fuzz.recordings import damage, small_recording
from tools.campaign.mutate import ODD, TextMutator, damaged_json, mutator

__all__ = ["cases"]

_HANG = 10.0
"""Seconds of processor time for one source: libraries are loaded with the first one."""
_FRAMES = 14
_SECRETS = ("secret.jpg", "data.parquet", "data.csv", "bag.db3", "data.json")
_PATHS = (
    *(f"../../{ELSEWHERE}/{name}" for name in _SECRETS),
    *(f"{HERE}/{ELSEWHERE}/{name}" for name in _SECRETS),
    f"colors/../../../{ELSEWHERE}/secret.jpg", "link/secret.jpg", "link/data.parquet",
    f"..\\..\\{ELSEWHERE}\\secret.jpg", "..", ".", "/", "", "/dev/zero", "/dev/null",
    "/proc/self/mem", "x" * 300, "a/" * 3000, "a\0b", "CON", "\u202egpj.exe", "\ud800", "~",
    "\x1b[31m", "colors",
)  # fmt: skip
_NAMES = (
    "left_hand", "right_hand", "left_ee", "right_ee", "left_arm", "body", "color_0", "qpos", "qvel",
    "idx", "timestamp", "timestamp_ns", "data", "info", "text", "states", "actions", "colors",
    "depths", "tactiles", "__class__", "..", "a/b", "/", "\u00b2", "rt/dex3/left/cmd",
)  # fmt: skip

Make = Callable[[], bytes]


# -- what is valid ---------------------------------------------------------------------------------


def _png(width: int = 4, height: int = 3, grey: int = 0) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    rows = b"".join(b"\0" + bytes((grey,)) * 3 * width for _ in range(height))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def _episode(end: str = "ee") -> dict[str, Any]:
    """A short episode of xr_teleoperate with two Dex3-1."""

    def entry(i: int, count: int, phase: float) -> dict[str, Any]:
        values = [0.2 + 0.1 * math.sin(0.7 * i + phase + j) for j in range(count)]
        return {"qpos": values, "qvel": [], "torque": []}

    items = []
    for i in range(_FRAMES):
        groups = {}
        for key, late in (("states", 1), ("actions", 0)):
            groups[key] = {
                f"{side}_{part}": entry(i - late, 7, 2.0 * n)
                for n, side in enumerate(("left", "right"))
                for part in ("arm", end)
            }
        pictures = {"color_0": f"colors/{i:06d}.png"}
        items.append({"idx": i, "colors": pictures, "depths": {}, **groups, "tactiles": None})
    info = {
        "version": "1.0.0", "date": "2025-07-08", "author": "a",
        "image": {"width": 4, "height": 3, "fps": 30.0}, "joint_names": {"left_arm": ["a"] * 7},
    }  # fmt: skip
    return {"info": info, "text": {"goal": "pick", "desc": "", "steps": ""}, "data": items}


def _streamed(found: Mapping[str, Any]) -> str:
    """As releases from v1.3 write it, item by item."""
    head = f'{{\n"info": {json.dumps(found["info"], indent=4)},\n"text": {{}},\n"data": [\n'
    return head + ",\n".join(json.dumps(item) for item in found["data"]) + "\n]\n}"


def _pictures(folder: str) -> Files:
    return {f"{folder}/colors/{i:06d}.png": _png(grey=i) for i in range(_FRAMES) if i != 3}


@cache
def _elsewhere() -> Files:
    """Files that would be taken for parts of a source."""
    import pyarrow as arrow

    rows = rows_of(_dataset_files()["v21/data/chunk-000/episode_000000.parquet"])
    return {
        "secret.jpg": b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 17, 8, 3, 4, 3) + bytes(9),
        "data.parquet": written(arrow.Table.from_pylist(rows)),
        "data.csv": b"log_time_ns,publish_time_ns,payload\n1,1,AAEAAA==\n",
        "bag.db3": _bag_files()["sqlite3/sqlite3.db3"],
        "data.json": json.dumps(_episode()).encode(),
    }


def _made(make: Callable[[Path], object]) -> Files:
    """The files that ``make`` writes into a folder."""
    with tempfile.TemporaryDirectory(dir=scratch_root()) as name:
        folder = Path(name)
        make(folder)
        return {
            p.relative_to(folder).as_posix(): p.read_bytes()
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        }


@cache
def _episode_files() -> Files:
    return {
        "whole/data.json": json.dumps(_episode(), indent=4).encode(),
        **_pictures("whole"),
        "streamed/data.json": _streamed(_episode()).encode(),
        "old/data.json": json.dumps(_episode("hand"), indent=4).encode(),
        "lines/session.jsonl": "\n".join(
            json.dumps({**item, "timestamp": 10.0 + i / 30})
            for i, item in enumerate(_episode()["data"])
        ).encode(),
    }


@cache
def _recordings() -> Files:
    """Recordings of the episode, its pictures embedded and referenced."""

    def make(folder: Path) -> None:
        for name, data in _episode_files().items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        (entry,) = find(folder / "whole")
        for embed in (True, False):
            entry.convert(folder / f"{embed}.mcap", embed, False)

    found = _made(make)
    return {"embedded": found["True.mcap"], "referenced": found["False.mcap"]}


@cache
def _dataset_files() -> Files:
    """Datasets of v3.0, as dexkit writes them, and of v2.1."""

    def make(folder: Path) -> None:
        (folder / "recording.mcap").write_bytes(_recordings()["embedded"])
        trace = open_trace(folder / "recording.mcap")
        export_dataset([trace], folder / "v30", fps=30, task="take it")

    import pyarrow as arrow

    found = {n: d for n, d in _made(make).items() if n.startswith("v30/")}
    info = json.loads(found["v30/meta/info.json"])
    rows = rows_of(next(d for n, d in found.items() if n.startswith("v30/data/")))
    rows = [{k: v for k, v in row.items() if "images" not in k} for row in rows]
    features = {k: v for k, v in info["features"].items() if "images" not in k}
    features["observation.images.top"] = {"dtype": "video", "shape": [3, 4, 3], "names": None}
    old = {
        "codebase_version": "v2.1", "robot_type": "Unitree_G1_Dex3", "fps": 30,
        "chunks_size": 1000, "features": features,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/{episode_index:06d}.mp4",
    }  # fmt: skip
    lines = [{"episode_index": 0, "tasks": ["take it"], "length": len(rows)}]
    return {
        **found,
        "v21/meta/info.json": json.dumps(old).encode(),
        "v21/meta/episodes.jsonl": "\n".join(map(json.dumps, lines)).encode(),
        "v21/meta/tasks.jsonl": b'{"task_index": 0, "task": "take it"}\n',
        "v21/data/chunk-000/episode_000000.parquet": written(arrow.Table.from_pylist(rows)),
        "v21/videos/chunk-000/observation.images.top/000000.mp4": bytes(64),
    }


@cache
def _bag_files() -> Files:
    """Bags of both storages, packed in both ways and not."""

    def make(folder: Path) -> None:
        (folder / "x.mcap").write_bytes(small_recording(random.Random(1)))
        for storage in ("sqlite3", "mcap"):
            export_bag(open_trace(folder / "x.mcap"), folder / storage, storage=storage)
        for mode in ("file", "message"):
            packed = folder / f"packed_{mode}"
            packed.mkdir()
            (data,) = (folder / "sqlite3").glob("*.db3")
            text = (folder / "sqlite3" / "metadata.yaml").read_text()
            text = text.replace("compression_format: ''", "compression_format: zstd")
            text = text.replace("compression_mode: ''", f"compression_mode: {mode.upper()}")
            if mode == "file":
                text = text.replace(data.name, f"{data.name}.zstd")
                (packed / f"{data.name}.zstd").write_bytes(zstandard.compress(data.read_bytes()))
            else:
                (packed / data.name).write_bytes(data.read_bytes())
                _sql(packed / data.name, "UPDATE messages SET data = pack(data)")
            (packed / "metadata.yaml").write_text(text)
        (folder / "x.mcap").unlink()

    return _made(make)


@cache
def _table_files() -> Files:
    def make(folder: Path) -> None:
        (folder / "x.mcap").write_bytes(_recordings()["embedded"])
        (folder / "y.mcap").write_bytes(small_recording(random.Random(2)))
        for form in ("csv", "parquet"):
            export_tables(open_trace(folder / "y.mcap"), folder / form, form)
            export_tables(open_trace(folder / "x.mcap"), folder / f"all_{form}", form)
        (folder / "x.mcap").unlink()
        (folder / "y.mcap").unlink()

    return _made(make)


# -- what is damaged -------------------------------------------------------------------------------


def _json_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    """JSON with values of other types; sometimes cut, or with odd bytes."""
    content = json.loads(data)
    bytewise = mutator([data], rng)
    streamed = data[:3] == b'{\n"'

    def make() -> bytes:
        if rng.random() < 0.1:
            return bytewise()
        text = damaged_json(content, rng, words)
        if streamed and rng.random() < 0.5:
            text = text.replace("{", "{\n", 1)
        if rng.random() < 0.05:  # numbers as only a text has them
            number = rng.choice(("1e999", "-0", "9" * 5000, "NaN", "-Infinity", "1" + "0" * 400))
            text = text.replace(": 0", f": {number}", rng.choice((1, -1)))
        return text.encode()

    return make


def _lines_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    """Lines of JSON, one of them damaged."""
    lines = data.splitlines()
    changed = [_json_of(line, rng, words) for line in lines]

    def make() -> bytes:
        at = rng.randrange(len(lines))
        return b"\n".join((*lines[:at], changed[at](), *lines[at + rng.getrandbits(1) :]))

    return make


def _bytes_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    return mutator([data], rng)


def _text_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    text = TextMutator([data.decode()], words, rng)
    return lambda: text().encode("utf-8", "surrogatepass")


def _sql(path: Path, *statements: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.create_function("pack", 1, zstandard.compress)
        for statement in statements:
            with contextlib.suppress(sqlite3.Error):
                database.execute(statement)
        database.commit()


_STATEMENTS = (
    "DROP TABLE topics", "DROP TABLE metadata", "DELETE FROM messages", "DELETE FROM topics",
    "INSERT INTO topics SELECT * FROM topics", "UPDATE messages SET topic_id = 99",
    "UPDATE messages SET data = NULL", "UPDATE messages SET data = 'text'",
    "UPDATE messages SET data = zeroblob(3000000) WHERE id = 1",
    "UPDATE messages SET data = X'00010000FFFFFFFF'", "UPDATE messages SET data = 5",
    "UPDATE messages SET timestamp = 'x'", "UPDATE messages SET timestamp = -1",
    "UPDATE messages SET timestamp = 9223372036854775807", "UPDATE messages SET timestamp = NULL",
    "UPDATE topics SET name = X'FFFE'", "UPDATE topics SET name = ''", "UPDATE topics SET name = 1",
    "UPDATE topics SET type = 'a/b'", "UPDATE topics SET type = NULL",
    "UPDATE topics SET type = 'std_msgs/msg/String'",
    "UPDATE topics SET serialization_format = 'json'", "UPDATE topics SET id = -1",
    "UPDATE topics SET offered_qos_profiles = '&a [*a, *a]'",
    "UPDATE topics SET offered_qos_profiles = '- history: x'",
    "UPDATE topics SET offered_qos_profiles = NULL", "UPDATE topics SET type_description_hash = 7",
    "UPDATE message_definitions SET encoded_message_definition = 'float32['",
    "UPDATE message_definitions SET encoded_message_definition = 'float32 a b c'",
    "UPDATE message_definitions SET encoded_message_definition = NULL",
    "UPDATE message_definitions SET encoding = 'ros2idl'",
    "UPDATE schema SET schema_version = 99", "UPDATE schema SET schema_version = 'x'",
    "DROP TABLE schema", "DROP TABLE message_definitions", "ALTER TABLE messages RENAME TO m",
    "ALTER TABLE messages ADD COLUMN extra TEXT DEFAULT 'x'",
    "ALTER TABLE topics RENAME COLUMN type TO kind",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
    "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, X'00010000' AS data FROM n",
    "PRAGMA encoding = 'UTF-16'", "PRAGMA user_version = -1", "VACUUM",
    "UPDATE metadata SET metadata = '{'", "UPDATE messages SET data = pack(zeroblob(5000000))",
)  # fmt: skip


def _database_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    """A database with other rows and tables, or damaged as bytes."""
    bytewise = mutator([data], rng)

    def make() -> bytes:
        if rng.random() < 0.4:
            return bytewise()
        with tempfile.NamedTemporaryFile(dir=scratch_root(), suffix=".db3") as file:
            file.write(data)
            file.flush()
            _sql(Path(file.name), *(rng.choice(_STATEMENTS) for _ in range(rng.randrange(1, 4))))
            return Path(file.name).read_bytes()

    return make


def _packed_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    """A packed database: damaged outside or inside, or one that unpacks to much."""
    bytewise = mutator([data], rng)
    inner = _database_of(zstandard.decompress(data), rng, words)

    def make() -> bytes:
        chance = rng.random()
        if chance < 0.4:
            return bytewise()
        if chance < 0.45:
            return zstandard.compress(bytes(rng.choice((1 << 20, 1 << 28))))
        unsized = zstandard.ZstdCompressor(write_content_size=rng.random() < 0.5)
        return unsized.compress(inner()) * rng.choice((1, 1, 1, 2))

    return make


def _mcap_of(data: bytes, rng: random.Random, words: tuple[str, ...]) -> Make:
    return lambda: damage(rng, data)


_SORTS: tuple[tuple[str, Callable[[bytes, random.Random, tuple[str, ...]], Make]], ...] = (
    (".json", _json_of),
    (".jsonl", _lines_of),
    (".parquet", damaged_parquet),
    (".yaml", _text_of),
    (".csv", _text_of),
    (".db3", _database_of),
    (".zstd", _packed_of),
    (".mcap", _mcap_of),
    ("", _bytes_of),
)


def _damaged(
    files: Files, rng: random.Random, words: tuple[str, ...], seldom: tuple[str, ...] = ()
) -> Make:
    """One file of a source, changed or absent, as :class:`Ground` takes it.

    :param seldom: suffixes of files that are damaged one time in twenty.
    """
    makers: dict[str, Make] = {}
    usual = [n for n in files if not n.endswith(seldom)] if seldom else list(files)

    def make() -> bytes:
        name = rng.choice(usual if rng.random() < 0.95 else list(files))
        if rng.random() < 0.01:
            return name.encode()
        if name not in makers:
            sort = next(sort for suffix, sort in _SORTS if name.endswith(suffix))
            makers[name] = sort(files[name], rng, words)
        return name.encode() + b"\n" + makers[name]()

    return make


# -- the fuzzers -----------------------------------------------------------------------------------


def _target(ground: Ground, make: Make, commands: Callable[[Ground, str, int], object]) -> Target:
    return Target(make, lambda data: ground.run(data, commands), close=ground.close)


def _import(ground: Ground, top: str, number: int) -> int:
    """Import a source; half of the time as several files."""
    source = ground.sources / top
    if top == "lines":
        source /= "session.jsonl"
    out = ground.out / ("a.mcap" if number & 1 else "a")
    options = ["--set", "embed-pictures=yes"] if number & 2 else []
    if number & 12 == 12:
        options += ["--set", ("hand=none", "keep-sides=yes", "rate=50")[number // 16 % 3]]
    code = ground.dexkit("import", source, out, *options)
    ground.read_outputs()
    return code


def _imported(
    files: Files, rng: random.Random, scratch: Path, words: tuple[str, ...],
    seldom: tuple[str, ...] = (), links: Mapping[str, str] | None = None,
) -> Target:  # fmt: skip
    ground = Ground(scratch, files, _elsewhere(), links)
    return _target(ground, _damaged(files, rng, words, seldom), _import)


def _episodes(rng: random.Random, scratch: Path) -> Target:
    up = f"../../../{ELSEWHERE}"
    links = {"whole/colors/000003.png": f"{up}/secret.jpg", "whole/link": f"../../{ELSEWHERE}"}
    words = (*_NAMES, *_PATHS, "2025-07-08", "9999-12-31", "1e999")
    return _imported(_episode_files(), rng, scratch, words, (".png",), links)


_FIELDS = (
    "{episode_index}", "{episode_chunk:03d}", "{episode_index:999999999d}", "{episode_index!r}",
    "{chunk_index.__class__}", "{file_index[0]}", "{0}", "{", "}", "{{}}", "{video_key}", "%s",
    "observation.state", "action", "timestamp", "frame_index", "episode_index", "task_index",
    "data/chunk_index", "data/file_index", "v2.0", "v2.1", "v3.0", "v4.0", "image", "video",
    "kLeftHandThumb0", "left_hand_thumb_0", "robot", "names", "dtype", "float32", "start_ns",
    "observation.images.color_0", "videos/observation.images.top/from_timestamp",
)  # fmt: skip


def _dataset(rng: random.Random, scratch: Path) -> Target:
    links = {"v21/link": f"../../{ELSEWHERE}", "v30/link": f"../../{ELSEWHERE}"}
    return _imported(_dataset_files(), rng, scratch, (*_FIELDS, *_PATHS), (".mp4", ".md"), links)


_YAML = (
    "!!python/object/apply:os.system", "&a", "*a", "<<: *a", "- ", ": ", "[", "{", "|", ">",
    "!!int", "!!binary", "!!timestamp", "0o17", "1_000", "1:30:00", "~", "null", "yes", ".nan",
    "-.inf",
    "zstd", "FILE", "MESSAGE", "none", "lz4", "sqlite3", "mcap", "cdr", "relative_file_paths:",
    "topics_with_message_count:", "compression_mode:", "version: 9", "storage_identifier:",
    "std_msgs/msg/String", "unitree_go/msg/MotorCmds", "a: &x [b, *x]", "---", "...", "%YAML 9.9",
)  # fmt: skip


def _bag(rng: random.Random, scratch: Path) -> Target:
    return _imported(_bag_files(), rng, scratch, (*_YAML, *_PATHS))


_TABLE_WORDS = (
    "log_time_ns", "publish_time_ns", "payload", "len(motor_cmd)", "motor_cmd[0].q",
    "motor_cmd[99999].q", "members", "cdr", "ros2msg", "dexkit_tables", RECORD, "a,b", ",", "\n",
    "\r\n", '"', "unitree_go::msg::dds_::MotorCmds_", "std_msgs/msg/String", "AAEAAA==", "=",
)  # fmt: skip


def _tables(rng: random.Random, scratch: Path) -> Target:
    return _imported(_table_files(), rng, scratch, (*_TABLE_WORDS, *_PATHS))


_RECORD_WORDS = (
    "colors", "depths", "nominal", "measured", "0", "-1", "1e400", "nan", "9" * 30, "inf", "{}",
    "[]", "[[]]", "null", "{", "color_0", "pictures_folder", "cameras", "names", "first_ns",
    "rate_hz", "clock", "info", "text", "task", "aligned", "absent rt/dex3/left/cmd", "format",
)  # fmt: skip
_TOPICS = ("rt/x", "rt/../../x", "/", "", "session/x/color", "x" * 300, "\u202e", "a\nb", "..")


class _Rewriter:
    """Writes a recording again with another record of its import, messages, topics and times."""

    def __init__(self, path: Path, rng: random.Random, words: tuple[str, ...]) -> None:
        trace = open_trace(path)
        self._definitions = dict(trace.definitions)
        self._messages = list(trace.messages())
        self._record = dict(trace.metadata[RECORD])
        self._rng = rng
        self._words = words
        self._damaged = mutator([m.data for m in self._messages[:64]], rng)

    def write(self, path: Path) -> bytes:
        """Another recording; ``path`` is used meanwhile."""
        rng = self._rng
        topics = {key: d.topic for key, d in self._definitions.items()}
        record = self._record
        kind = rng.randrange(8)
        if kind != 0:
            record = self._changed_record()
        if kind == 1:
            topics[rng.choice(list(topics))] = rng.choice((*_TOPICS, *topics.values()))
        chosen = rng.choice(list(self._definitions)) if kind < 5 else None
        with RecordingWriter(path, overwrite=True) as writer:
            numbers = {
                key: writer.add_channel(replace(d, topic=topics[key]))
                for key, d in self._definitions.items()
            }
            for m in self._messages:
                key, data, stamp = (m.topic, m.type_name), m.data, m.log_time_ns
                if key == chosen and rng.random() < 0.3:
                    data = self._changed_payload(m.type_name, data)
                elif key == chosen and rng.random() < 0.1:
                    stamp = rng.choice(
                        (0, stamp + 1, stamp + 10**10, 2**31 * 10**9, 2**63, 2**64 - 1)
                    )
                writer.put(numbers[key], data, stamp, stamp)
            writer.add_metadata(RECORD, record)
        return path.read_bytes()

    def _changed_record(self) -> dict[str, str]:
        rng, record = self._rng, dict(self._record)
        for _ in range(rng.randrange(1, 4)):
            key = rng.choice((*record, *_RECORD_WORDS))
            chance = rng.random()
            if chance < 0.1:
                record.pop(key, None)
            elif chance < 0.6 and record.get(key, "")[:1] in ("{", "["):
                with contextlib.suppress(ValueError):  # damaged already
                    record[key] = damaged_json(json.loads(record[key]), rng, self._words)
            else:
                record[key] = rng.choice(
                    (*_RECORD_WORDS, *self._words, json.dumps(rng.choice(ODD)))
                )
        return record

    def _changed_payload(self, type_name: str, data: bytes) -> bytes:
        rng = self._rng
        if type_name == ros_types.STRING.dds_name and rng.random() < 0.8:
            content = json.loads(ros_types.decode_string(data))
            text = damaged_json(content, rng, self._words)
            return ros_types.encode_string(text)
        return self._damaged()


_FORMS: tuple[tuple[str, ...], ...] = (
    ("lerobot",), ("episodes",), ("lerobot", "--set", "fps=30"), ("episodes", "--set", "fps=1000"),
    ("parquet",), ("csv",), ("rosbag2",), ("rosbag2", "--set", "storage=mcap"),
)  # fmt: skip


def _exported(rng: random.Random, scratch: Path) -> Target:
    """Recordings of imports: what they say of their source, their pictures and their topics."""
    up = f"../../../{ELSEWHERE}"
    links = {"whole/colors/000003.png": f"{up}/secret.jpg", "whole/link": f"../../{ELSEWHERE}"}
    files = {f"recordings/{name}.mcap": data for name, data in _recordings().items()}
    ground = Ground(scratch, {**_pictures("whole"), **files}, _elsewhere(), links)
    words = (*_NAMES, *(p for p in _PATHS if HERE not in p), f"../{ELSEWHERE}/secret.jpg")
    rewriters = {name: _Rewriter(ground.sources / name, rng, words) for name in files}
    folder = tempfile.TemporaryDirectory(dir=scratch_root())

    def make() -> bytes:
        name = rng.choice(list(files))
        return name.encode() + b"\n" + rewriters[name].write(Path(folder.name) / "x.mcap")

    def commands(ground: Ground, top: str, number: int) -> None:
        for name in files:
            path, out = ground.sources / name, ground.out / Path(name).stem
            if path.read_bytes() == files[name]:
                continue  # it was not changed
            form = _FORMS[number % len(_FORMS)]
            options = ["--pictures", ground.sources / "whole"] if number % len(_FORMS) < 4 else []
            ground.dexkit("export", path, "--to", *form, "--out", out, *options)
            if number // 64 % 8 == 0:
                ground.dexkit("info", path)

    def close() -> None:
        folder.cleanup()
        ground.close()

    return Target(make, lambda data: ground.run(data, commands), close=close)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    every: tuple[tuple[str, str, Callable[[random.Random, Path], Target]], ...] = (
        ("import.episodes", "episodes of xr_teleoperate and JSON lines, imported", _episodes),
        ("import.lerobot", "LeRobot datasets, imported", _dataset),
        ("import.rosbag", "ROS 2 bags, imported", _bag),
        ("import.tables", "CSV and Parquet tables, imported", _tables),
        ("export", "recordings whose record of an import is odd, exported", _exported),
    )
    return [FuzzCase(name, what, prepare, hang=_HANG) for name, what, prepare in every]
