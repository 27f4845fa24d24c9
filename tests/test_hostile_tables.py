"""Tables that would take more memory or time than their size accounts for are refused."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dexkit.errors import SessionError
from dexkit.traces.sessions import topic_tables
from dexkit.traces.sessions.lerobot_format import parquet_pieces, read_parquet
from dexkit.traces.sessions.topic_tables import import_tables

TIMES = "log_time_ns,publish_time_ns"


def constant(path: Path) -> None:
    """Five million rows that do not change."""
    table = pa.table({name: np.zeros(500_000, np.int64) for name in "ab"})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as writer:
        for _ in range(10):
            writer.write_table(table)


def wide(path: Path) -> None:
    """Few rows, each with a vector of a million zeros."""
    values = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(10**7, np.int8)), 10**6)
    pq.write_table(pa.table({"a": values}), path, compression="zstd")


def one_text_in_many_rows(path: Path) -> None:
    text = pa.array(["x" * 2**20])
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2000, np.int32)), text)
    pq.write_table(pa.table({"a": column}), path, compression="zstd", store_schema=False)


def one_packed_text(path: Path) -> None:
    pq.write_table(pa.table({"a": [b"x" * 2**25]}), path, compression="zstd")


def no_columns(path: Path) -> None:
    pq.write_table(pa.table({"a": np.zeros(10**7, np.int8)}), path)


@pytest.mark.parametrize(
    "make", [constant, wide, one_text_in_many_rows, one_packed_text, no_columns]
)
def test_a_parquet_file_has_as_much_data_as_its_size_accounts_for(
    tmp_path: Path, make: Callable[[Path], None]
) -> None:
    path = tmp_path / "a.parquet"
    make(path)
    before = pa.total_allocated_bytes()

    def read() -> None:
        for _ in parquet_pieces(path):
            assert pa.total_allocated_bytes() - before < 400 * 2**20

    with pytest.raises(SessionError, match="times as much data"):
        read()
    with pytest.raises(SessionError, match="times as much data"):
        read_parquet(path)


def tables(folder: Path, content: str | bytes) -> Path:
    folder.mkdir()
    entry = {"topic": "rt/x", "type": "x", "file": "x.csv", "columns": "payload"}
    (folder / "session.json").write_text(json.dumps({"dexkit_tables": 1, "topics": [entry]}))
    data = content if isinstance(content, bytes) else content.encode()
    (folder / "x.csv").write_bytes(data)
    return folder


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (f"{TIMES},payload{',' * 70_000}\n", "more than 65536"),
        (f"{TIMES},payload\n{'x' * 5000}", "a line of more than"),
        (f"{TIMES},payload{',' * 900}\n" + "1\n" * 10_000, "no message"),
        (f"{TIMES},payload\n\xff".encode("latin-1"), "not UTF-8"),
        (f"{TIMES},payload\n\0,\0", ""),
    ],
    ids=["columns", "line", "short rows", "no text", "zeros"],
)
def test_a_hostile_csv_is_refused(
    tmp_path: Path, content: str | bytes, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if why == "a line of more than":
        monkeypatch.setattr(topic_tables, "_LONGEST_LINE", 1000)
    source = tables(tmp_path / "t", content)
    tracemalloc.start()
    try:
        with pytest.raises(SessionError) as raised:
            import_tables(source, tmp_path / "out.mcap")
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20
    finally:
        tracemalloc.stop()
    assert why in f"{raised.value} {raised.value.hint}"
    assert not (tmp_path / "out.mcap").exists()


_READ_DAMAGED = """
import io, sys
from pathlib import Path
import pyarrow as pa, pyarrow.parquet as pq
from dexkit.errors import SessionError
from dexkit.traces.sessions.lerobot_format import parquet_pieces

columns = {"number": [0.5, None], "text": ["a", "a"], "list": [[1.0], [2.0]]}
out, path, refused = io.BytesIO(), Path(sys.argv[1]), 0
pq.write_table(pa.table(columns), out)
whole = out.getvalue()
footer = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
for at in range(footer, len(whole)):
    for bit in (1, 2, 16):
        data = bytearray(whole)
        data[at] ^= bit
        path.write_bytes(data)
        try:
            list(parquet_pieces(path))
        except SessionError:
            refused += 1
print(refused)
"""


def test_no_bit_of_a_footer_ends_the_process(tmp_path: Path) -> None:
    # in a process of its own: the library ends it where it is asked about some columns
    done = subprocess.run(
        [sys.executable, "-c", _READ_DAMAGED, tmp_path / "x.parquet"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 100
