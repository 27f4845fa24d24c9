"""The metadata record of an imported recording: its source, and which data are missing."""

from __future__ import annotations

from collections.abc import Mapping

from dexkit.traces.names import dds_topic

__all__ = ["EPOCH_NS", "NOMINAL", "RECORD", "absent_fields", "absent_key"]

RECORD = "dexkit_import"
"""Name of the metadata record."""
NOMINAL = "nominal"
"""Value of its ``clock``: the source has no times, only a rate that was asked for."""
EPOCH_NS = 86_400 * 10**9
"""Begin of nominal times in a session without a date: 1970-01-02, because 0 means "unknown"."""
_ABSENT = "absent "


def absent_key(topic: str) -> str:
    """Key of the list of fields of a topic's messages that the source does not have."""
    return f"{_ABSENT}{topic}"


def absent_fields(record: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """By topic, the fields that are 0 because the source does not have them."""
    return {
        dds_topic(key.removeprefix(_ABSENT)): frozenset(value.split())
        for key, value in record.items()
        if key.startswith(_ABSENT)
    }
