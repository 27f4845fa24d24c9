"""Parquet tables with columns of other types, lengths, names and values."""

from __future__ import annotations

import io
import random
from collections.abc import Callable, Sequence
from typing import Any

from tools.campaign.mutate import ODD, mutator

__all__ = ["damaged_parquet", "rows_of", "written"]

_LISTS: tuple[Any, ...] = ([], [0.0], [0.5] * 28, [float("nan")] * 28, [1e308] * 28, [None], None)
_COMPRESSIONS = ("none", "zstd", "gzip", "snappy")


def written(table: Any, compression: str = "zstd") -> bytes:
    """A table as the bytes of a file."""
    from pyarrow import parquet

    out = io.BytesIO()
    parquet.write_table(table, out, compression=compression)
    return out.getvalue()


def rows_of(data: bytes) -> list[dict[str, Any]]:
    """The rows in such bytes."""
    from pyarrow import parquet

    found: list[dict[str, Any]] = parquet.read_table(io.BytesIO(data)).to_pylist()
    return found


def damaged_parquet(
    data: bytes, rng: random.Random, words: Sequence[str] = ()
) -> Callable[[], bytes]:
    """Makes another damaged file of the table in ``data`` at each call.

    :param words: names of columns, and texts in them.
    """
    import pyarrow as arrow
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(data))
    words = [word.encode("utf-8", "replace").decode() for word in words]
    bytewise = mutator([data], rng)

    def make() -> bytes:
        if rng.random() < 0.3:
            return bytewise()
        found = table
        for _ in range(1 + rng.getrandbits(1)):
            found = _changed(found, rng, words)
        try:
            return written(found, rng.choice(_COMPRESSIONS))
        except arrow.ArrowException:  # Parquet has no such values
            return bytewise()

    return make


def _changed(table: Any, rng: random.Random, words: Sequence[str]) -> Any:
    import pyarrow as arrow

    names = list(table.column_names)
    if not names:
        return table
    at = rng.randrange(len(names))
    kind = rng.randrange(8)
    if kind == 0:
        return table.drop_columns([names[at]]) if names.count(names[at]) == 1 else table
    if kind == 1:
        names[at] = rng.choice((*names, *words, "", "x.y"))
        return table.rename_columns(names)
    if kind == 2:
        return table.slice(0, rng.choice((0, 1, 2)))
    if kind == 3:  # all rows again, or in another order
        return arrow.concat_tables([table.slice(rng.randrange(3)), table])
    if kind == 4:
        return table.append_column(rng.choice((*names, *words)), _column(rng, len(table), words))
    if kind == 5:  # some values of the same type
        try:
            values = table.column(at).to_pylist()
            for _ in range(rng.choice((1, 3)) if values else 0):
                values[rng.randrange(len(values))] = rng.choice((*ODD, *words, *_LISTS))
            column = arrow.array(values, type=rng.choice((table.schema.types[at], None)))
        except (arrow.ArrowException, OverflowError, TypeError, ValueError):
            return table
        return table.set_column(at, names[at], column)
    return table.set_column(at, names[at], _column(rng, len(table), words))


def _column(rng: random.Random, count: int, words: Sequence[str]) -> Any:
    """A column of some type."""
    import pyarrow as arrow

    lists = arrow.list_(arrow.float64())
    bytes_ = rng.choice((b"", b"\xff\xfe", b"\x89PNG\r\n\x1a\n", b"\xff\xd8" + bytes(40)))
    word = rng.choice((*words, "x", "-1", "9" * 400))
    kinds: tuple[Callable[[], Any], ...] = (
        lambda: arrow.nulls(count),
        lambda: arrow.array([rng.choice((0, 1, -1, 2**62, -(2**63))) for _ in range(count)]),
        lambda: arrow.array([2**64 - 1] * count, arrow.uint64()),
        lambda: arrow.array([rng.choice((0.0, 1e308, float("nan"), float("inf")))] * count),
        lambda: arrow.array([word] * count),
        lambda: arrow.array([word] * count).dictionary_encode(),
        lambda: arrow.array([bytes_] * count, arrow.binary()),
        # a text that is no UTF-8
        lambda: arrow.array([b"\xff"] * count, arrow.binary()).view(arrow.string()),
        lambda: arrow.array([rng.random() < 0.5] * count),
        lambda: arrow.array([rng.choice(_LISTS) for _ in range(count)], lists),
        lambda: arrow.array([[[1.0], [2.0]]] * count),
        lambda: arrow.array([{"bytes": bytes_, "path": word}] * count),
        lambda: arrow.array([{"a": {"b": [1]}}] * count),
        lambda: arrow.array([[("a", 1)]] * count, arrow.map_(arrow.string(), arrow.int64())),
        lambda: arrow.array([2**62] * count, arrow.timestamp("ns")),
        lambda: arrow.array([2**62] * count, arrow.timestamp("s", tz="UTC")),
        lambda: arrow.array([2**30] * count, arrow.date32()),
        lambda: arrow.array([1] * count, arrow.duration("s")),
        lambda: arrow.array([None] * count, arrow.float32()),
        lambda: arrow.array([10**30] * count, arrow.decimal128(38, 0)),
    )  # fmt: skip
    return rng.choice(kinds)()
