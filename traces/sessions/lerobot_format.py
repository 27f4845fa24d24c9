"""Names and formats shared by reading and writing LeRobot datasets (docs/sources/sessions.md#c)."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

from dexkit.errors import ExtraMissing, SessionError

__all__ = [
    "ACTION",
    "COLUMNS",
    "EXTENSION",
    "PICTURES",
    "PRESSURE",
    "STATE_COLUMN",
    "parquet_library",
    "read_parquet",
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


def parquet_library() -> tuple[ModuleType, Any]:
    """(pyarrow, pyarrow.parquet)

    :raises ExtraMissing: it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ExtraMissing(
            "Parquet files need the library pyarrow", hint="pip install 'dexkit[lerobot]'"
        ) from error
    return pyarrow, pyarrow.parquet


def read_parquet(path: Path) -> Any:
    """The table in a Parquet file.

    :raises ExtraMissing: pyarrow is not installed.
    :raises SessionError: it is missing, no ordinary file, or no Parquet.
    """
    arrow, parquet = parquet_library()
    try:
        if not path.is_file():  # a pipe would be waited for
            why = "is no ordinary file" if path.exists() else "is missing"
            raise SessionError(f"{path} {why}")
        table = parquet.read_table(path)
        table.column_names  # noqa: B018 - decodes them
    except (OSError, ValueError, arrow.lib.ArrowException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SessionError(f"{path} cannot be read as Parquet: {reason}") from error
    return table
