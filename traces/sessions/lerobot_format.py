"""Names and formats shared by reading and writing LeRobot datasets (docs/sources/sessions.md#c)."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from dexkit.documents import open_ordinary
from dexkit.errors import ExtraMissing, SessionError
from dexkit.traces.container import MAX_RATIO, SPARE

__all__ = [
    "ACTION",
    "COLUMNS",
    "EXTENSION",
    "PICTURES",
    "PRESSURE",
    "STATE_COLUMN",
    "parquet_library",
    "parquet_pieces",
    "read_parquet",
    "write_json",
]

ACTION, STATE_COLUMN = "action", "observation.state"
PICTURES = "observation.images."
COLUMNS = {
    ("state", "q"): STATE_COLUMN,
    ("state", "dq"): "observation.velocity",
    ("state", "tau"): "observation.effort",
    ("command", "q"): ACTION,
}
"""The feature of each kind and field; velocity and effort are written only if all states have
them. ``observation.velocity`` and ``observation.effort`` are unitree_lerobot's names."""
PRESSURE = "observation.pressure"
EXTENSION = "dexkit"
"""Key of ``meta/info.json`` that other programs ignore."""

_LEAST_ROW = 8  # bytes that a row is taken to have
_ROWS_AT_ONCE, _VALUES_AT_ONCE, _TEXTS_AT_ONCE = 65_536, 2**20, 64 * 2**20


def parquet_library() -> tuple[ModuleType, Any]:
    """(pyarrow, pyarrow.parquet)

    :raises ExtraMissing: it is not installed.
    :raises SessionError: it cannot be loaded: too little memory, for example.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        raise ExtraMissing(
            "Parquet files need the library pyarrow", hint="pip install 'dexkit[lerobot]'"
        ) from error
    except ImportError as error:
        raise SessionError(f"the library pyarrow cannot be loaded: {error}") from error
    return pyarrow, pyarrow.parquet


def read_parquet(
    path: Path,
    wanted: Callable[[str], bool] = lambda _: True,
    *,
    episodes: tuple[int, int] | None = None,
) -> Any:
    """The table in a Parquet file, or those of its columns whose name is wanted.

    :param episodes: the first and the last that are wanted: groups of rows that have none of them,
        by what the file states, are left out.
    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: as :func:`parquet_pieces`.
    """
    arrow, _ = parquet_library()
    return arrow.concat_tables(list(parquet_pieces(path, wanted, episodes=episodes)))


def parquet_pieces(
    path: Path,
    wanted: Callable[[str], bool] = lambda _: True,
    *,
    episodes: tuple[int, int] | None = None,
) -> Iterator[Any]:
    """The table in a Parquet file, some rows at a time; at least one piece, which may be empty.

    :param wanted: whether a column of that name is.
    :param episodes: as of :func:`read_parquet`.
    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: it is missing, no ordinary file, no Parquet, or its rows take more memory
        than its size accounts for: a column that does not change takes next to none in a file.
    """
    arrow, parquet = parquet_library()
    with open_ordinary(path, error=SessionError) as source:
        left = MAX_RATIO * os.fstat(source.fileno()).st_size + SPARE
        too_large = SessionError(
            f"{path} has more than {MAX_RATIO} times as much data as its size",
            hint="is it damaged? If not, write its rows to several files",
        )
        try:
            with parquet.ParquetFile(source, pre_buffer=False) as file:
                names = [name for name in file.schema_arrow.names if wanted(name)]
                if len(set(names)) < len(names):
                    raise SessionError(f"{path} has two columns of one name")
                if file.metadata.num_rows * _LEAST_ROW > left or _unpacked(file) > left:
                    raise too_large
                yield file.schema_arrow.empty_table().select(names)
                for group in range(file.metadata.num_row_groups):
                    if episodes and not _may_hold(file.metadata.row_group(group), episodes):
                        continue
                    # the library ends the process when it is asked about a column that it cannot
                    # read, and raises an error when it reads it
                    if next(file.iter_batches(1, [group]), None) is None:
                        continue
                    for batch in file.iter_batches(
                        _rows_at_once(file.metadata.row_group(group)),
                        [group],
                        columns=names,
                        # Arrow ends the process where it cannot start threads (ulimit -v)
                        use_threads=False,
                    ):
                        left -= max(batch.nbytes, batch.num_rows * _LEAST_ROW)
                        if left < 0:
                            raise too_large
                        yield arrow.Table.from_batches([batch]).select(names)
        except (OSError, ValueError, arrow.lib.ArrowException) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise SessionError(f"{path} cannot be read as Parquet: {reason}") from error


def _may_hold(group: Any, episodes: tuple[int, int]) -> bool:
    """Whether a row group may have rows of these episodes, by its statistics."""
    for i in range(group.num_columns):
        column = group.column(i)
        if column.path_in_schema == "episode_index":
            stated = column.statistics
            if stated is None or not stated.has_min_max:
                return True
            return bool(stated.min <= episodes[1] and stated.max >= episodes[0])
    return True


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file as LeRobot does; half of a surrogate pair is escaped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document, indent=4, ensure_ascii=False) + "\n"
    path.write_bytes(text.encode("utf-8", "backslashreplace"))


def _unpacked(file: Any) -> int:
    """Bytes of the pages of a Parquet file, unpacked, as it says."""
    groups = (file.metadata.row_group(i) for i in range(file.metadata.num_row_groups))
    return sum(int(group.total_byte_size) for group in groups)


def _rows_at_once(group: Any) -> int:
    """Rows of a row group that are decoded at once: about a million values, and 64 MB of texts.

    A long text may be in many rows, and in the file once.
    """
    columns = [group.column(i) for i in range(group.num_columns)]
    each = sum(c.num_values for c in columns) // max(1, group.num_rows)
    repeated = [c.total_uncompressed_size for c in columns if _repeats_texts(c)]
    by_text = (_TEXTS_AT_ONCE // max(1, max(repeated))) if repeated else _ROWS_AT_ONCE
    by_value = _VALUES_AT_ONCE // max(1, int(each))
    return max(1, min(_ROWS_AT_ONCE, by_value, max(8, int(by_text))))


def _repeats_texts(column: Any) -> bool:
    return "BYTE_ARRAY" in column.physical_type and bool(
        {"RLE_DICTIONARY", "PLAIN_DICTIONARY"} & set(column.encodings)
    )
