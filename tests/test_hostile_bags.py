"""Bags that would take more memory, disk or time than their size accounts for are refused."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard

from dexkit.errors import DexkitError, SessionError
from dexkit.messages import message_type
from dexkit.messages.unitree_hg import MotorState_
from dexkit.traces import Recorder, open_trace
from dexkit.traces.bag_metadata import BAG
from dexkit.traces.sessions import bag_checks
from dexkit.traces.sessions.rosbag import export_bag, import_bag
from dexkit.traces.writer import RecordingWriter

HG = "unitree_hg::msg::dds_::HandState_"
Change = Callable[[Path], None]


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small bag of each storage: ``sqlite3`` and ``mcap``."""
    folder = tmp_path_factory.mktemp("bags")
    source = folder / "part.mcap"
    mt = message_type(HG)
    payload = mt.encode(mt.of_motors([MotorState_()] * 7))
    with Recorder(source) as recorder:
        for i in range(200):
            recorder.put("rt/dex3/left/state", HG, payload, 10**18 + i)
    for storage in ("sqlite3", "mcap"):
        export_bag(open_trace(source), folder / storage, storage=storage)
    return folder


def database(bag: Path) -> Path:
    return next(bag.glob("*.db3"))


def metadata(change: Callable[[str], str]) -> Change:
    def apply(bag: Path) -> None:
        path = bag / "metadata.yaml"
        path.write_text(change(path.read_text()))

    return apply


def sql(*statements: str) -> Change:
    def apply(bag: Path) -> None:
        with sqlite3.connect(database(bag)) as db:
            for statement in statements:
                db.execute(statement)
            db.commit()
        db.close()

    return apply


def packed(mode: str, pack: Callable[[bytes], bytes]) -> Change:
    """The bag's file, or each message, packed."""

    def apply(bag: Path) -> None:
        path, text = database(bag), (bag / "metadata.yaml").read_text()
        if mode == "FILE":
            path.with_name(f"{path.name}.zstd").write_bytes(pack(path.read_bytes()))
            path.unlink()
            text = text.replace(path.name, f"{path.name}.zstd")
        else:
            with sqlite3.connect(path) as db:
                db.create_function("pack", 1, pack)
                db.execute("UPDATE messages SET data = pack(data)")
                db.commit()
            db.close()
        text = text.replace("compression_format: ''", "compression_format: zstd")
        text = text.replace("compression_mode: ''", f"compression_mode: {mode}")
        (bag / "metadata.yaml").write_text(text)

    return apply


def bomb(stated: bool) -> Callable[[bytes], bytes]:
    def pack(_: bytes) -> bytes:
        made = zstandard.ZstdCompressor(write_content_size=stated)
        zeros = bytes(64 << 20)
        if stated:
            return made.compress(zeros)
        whole = made.compressobj()
        return whole.compress(zeros) + whole.flush()

    kept: list[bytes] = []
    return lambda data: kept[0] if kept else kept.append(pack(data)) or kept[0]  # type: ignore[func-returns-value]


def cyclic(bag: Path) -> None:
    """A page of the messages' table that leads to itself."""
    path = database(bag)
    with sqlite3.connect(path) as db:
        (root,) = db.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        ).fetchone()
        (size,) = db.execute("PRAGMA page_size").fetchone()
    db.close()
    data = bytearray(path.read_bytes())
    at = (root - 1) * size
    assert data[at] == 5, "the root is not an inner page"
    data[at + 8 : at + 12] = root.to_bytes(4, "big")
    path.write_bytes(data)


def other_name(bag: Path) -> None:
    path = database(bag)
    odd = "..%2Foutside.db3"
    shutil.copy(path, bag.parent / "outside.db3")
    path.rename(bag / odd)
    metadata(lambda text: text.replace(path.name, odd))(bag)


def without_end(bag: Path) -> None:
    sql("ALTER TABLE messages RENAME TO m2")(bag)
    sql(
        "CREATE VIEW messages AS WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM r) "
        "SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM r"
    )(bag)


LAUGHS = "a0: &a0 [x,x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1},*a{i - 1}]\n" for i in range(1, 60))
HOSTILE: dict[str, tuple[Change, str]] = {
    "aliases": (metadata(lambda text: LAUGHS + text), "aliases"),
    "deep": (metadata(lambda text: f"{text}\nz: {'[' * 5000}{']' * 5000}\n"), "nested|valid"),
    "deep blocks": (metadata(lambda text: "- " * 5000 + "\n"), "nested"),
    "tag": (metadata(lambda text: f"{text}\nx: !!python/object/apply:os.system [x]\n"), "valid"),
    "number": (metadata(lambda text: f"%YAML 1.1\n---\n{text}\nx: {'1:' * 10**5}1\n"), "digits"),
    "long": (metadata(lambda text: text + "x:\n" + "- \n" * 10_000), "too long"),
    "no files": (metadata(lambda text: text.replace("relative_file_paths", "x")), "does not name"),
    "no bag": (metadata(lambda text: "[1]"), "not the metadata"),
    "deep QoS": (metadata(lambda text: text.replace(
        "offered_qos_profiles: []", f"offered_qos_profiles: '{'[' * 5000}'")), "QoS"),
    "QoS of the database": (sql(f"UPDATE topics SET offered_qos_profiles = '{'[' * 5000}'"), "QoS"),
    "large metadata": (metadata(lambda text: text + " " * (5 << 20)), "larger than 4 MB"),
    "file, stated": (packed("FILE", bomb(True)), "unpacks to more than"),
    "file, not stated": (packed("FILE", bomb(False)), "unpacks to more than"),
    "file, no zstd": (packed("FILE", lambda data: b"(\xb5/\xfd" + data), "cannot be unpacked"),
    "message, stated": (packed("MESSAGE", bomb(True)), "unpack to more than"),
    "message, not stated": (packed("MESSAGE", bomb(False)), "unpack to more than"),
    "view without end": (without_end, "not a table"),
    "computed column": (sql(
        "ALTER TABLE messages RENAME TO m2",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, "
        "data AS (zeroblob(100000000)))",
        "INSERT INTO messages SELECT id, topic_id, timestamp FROM m2"), "computed"),
    "large default": (sql(
        "ALTER TABLE messages RENAME TO m2",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp)",
        "INSERT INTO messages SELECT id, topic_id, timestamp FROM m2",
        f"ALTER TABLE messages ADD COLUMN data DEFAULT x'{'00' * 400_000}'"), "more data than"),
    "virtual table": (sql(
        "ALTER TABLE messages RENAME TO m2",
        "CREATE VIRTUAL TABLE messages USING rtree(id, topic_id, timestamp)"), "not a table"),
    "topics with one number": (sql(
        "ALTER TABLE topics RENAME TO t2",
        "CREATE TABLE topics AS SELECT * FROM t2 UNION ALL SELECT * FROM t2"), "one number"),
    "many topics": (sql(
        "WITH RECURSIVE r(i) AS (SELECT 100 UNION ALL SELECT i+1 FROM r WHERE i < 5000) "
        "INSERT INTO topics SELECT i, i, 'x', 'cdr', '', '' FROM r"), "more than 4096"),
    "page that leads to itself": (cyclic, "[Tt]ree|[Pp]age|malformed"),
    "name that SQLite decodes": (other_name, "characters"),
    "no database": (lambda bag: database(bag).write_bytes(b"x" * 100) and None, "neither"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_bag_is_refused(
    tmp_path: Path, bags: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    bag = tmp_path / "bag"
    shutil.copytree(bags / "sqlite3", bag)
    monkeypatch.setattr(bag_checks, "_MOST_EVENTS", 10_000)
    change, why = HOSTILE[name]
    change(bag)
    with pytest.raises(SessionError, match=why):
        import_bag(bag, tmp_path / "out.mcap")
    assert {p.name for p in tmp_path.iterdir()} <= {"bag", "tmp", "outside.db3"}
    assert not list((tmp_path / "tmp").iterdir()), "left in the temporary folder"


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_a_compressed_bag_is_read(tmp_path: Path, bags: Path, mode: str) -> None:
    def content(bag: Path) -> list[Any]:
        out = tmp_path / "out.mcap"
        import_bag(bag, out, overwrite=True)
        return [(m.topic, m.log_time_ns, m.data) for m in open_trace(out).messages()]

    bag = tmp_path / "bag"
    shutil.copytree(bags / "sqlite3", bag)
    packed(mode, lambda data: zstandard.compress(data))(bag)
    assert content(bag) == content(bags / "sqlite3")


def test_chunks_of_an_mcap_bag_unpack_to_what_they_say(tmp_path: Path, bags: Path) -> None:
    bag = tmp_path / "bag"
    shutil.copytree(bags / "mcap", bag)
    path = next(bag.glob("*.mcap"))
    data = bytearray(path.read_bytes())
    data[200] ^= 255
    path.write_bytes(data)
    with pytest.raises(DexkitError) as raised:
        import_bag(bag, tmp_path / "out.mcap")
    assert "ROS 2 bag" in str(raised.value)
    assert "dexkit cut" in raised.value.hint


@pytest.mark.parametrize(
    "text",
    [
        "custom_data: &a {dexkit.metadata x: *a}",
        "dexkit.metadata x: [" * 10_000,
        "custom_data: {dexkit.metadata dexkit_import: 1" + "0" * 100_000 + "}",
        "dexkit.metadata " * 10**6,
    ],
)
def test_a_hostile_copy_of_the_metadata_is_a_warning(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.add_metadata(BAG, {"serialized_metadata": text})
    trace = open_trace(path)
    assert list(trace.metadata) == [BAG]
    assert any("metadata cannot be read" in w for w in trace.warnings)


@pytest.mark.parametrize("text", ["custom_data: [dexkit.metadata x]", "- dexkit.metadata x"])
def test_other_custom_data_are_no_records(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.add_metadata(BAG, {"serialized_metadata": text})
    trace = open_trace(path)
    assert list(trace.metadata) == [BAG]
    assert not any("metadata" in w for w in trace.warnings)
