"""Names and formats shared by reading and writing LeRobot datasets (docs/sources/sessions.md#c)."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from dexkit.errors import ExtraMissing

__all__ = [
    "ACTION",
    "COLUMNS",
    "EXTENSION",
    "PICTURES",
    "PRESSURE",
    "STATE_COLUMN",
    "parquet_library",
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
