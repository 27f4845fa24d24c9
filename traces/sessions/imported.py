"""The metadata record of an imported recording: its source, and which data are missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

from dexkit.documents import parse_json
from dexkit.errors import SessionError
from dexkit.traces.names import dds_topic
from dexkit.traces.reader import Trace
from dexkit.traces.sessions.paths import file_name
from dexkit.traces.sessions.typed import to_record

__all__ = [
    "EPOCH_NS",
    "MEASURED",
    "NOMINAL",
    "RECORD",
    "ImportRecord",
    "absent_fields",
    "absent_key",
    "absent_of",
    "import_record",
    "import_records",
]

RECORD = "dexkit_import"
"""Name of the metadata record."""
NOMINAL = "nominal"
"""Value of its ``clock``: the source has no times, only a rate that was asked for."""
MEASURED = "measured"
"""Value of ``clock``: the source has times."""
EPOCH_NS = 86_400 * 10**9
"""Begin of nominal times in a session without a date: 1970-01-02, because 0 means "unknown"."""
_ABSENT = "absent "
# Values of the record that are JSON.
_JSON = ("cameras", "info", "names", "text")


class ImportRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The record of an import, as far as other commands use it.

    :param pictures_folder: of the session, relative to the source that was imported.
    :param cameras: by name, the group of its pictures.
    :param names: by part, its name in the episode; None if it was no episode.
    :param aligned: how the times were found in a recording of the wire; empty if they were not.
    """

    format: str = "recording"
    clock: Literal["nominal", "measured"] = "measured"
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1e9)] = 30.0
    first_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] | None = None
    task: str = ""
    aligned: str = ""
    pictures_folder: str = "."
    cameras: dict[str, Literal["colors", "depths"]] = {}
    names: dict[str, str] | None = None
    info: dict[str, Any] = {}
    text: dict[str, Any] = {}

    def __post_init__(self) -> None:
        for name in self.cameras:
            if file_name(name) != name:
                raise ValueError("cameras: a name that no file can have")


def import_record(trace: Trace) -> ImportRecord:
    """The record of a recording's import; the defaults if it was not imported.

    :raises SessionError: it is not what ``dexkit import`` writes; with its place.
    """
    origin = f"{trace.path}: metadata {RECORD}"
    found: dict[str, Any] = {}
    for key, text in trace.metadata.get(RECORD, {}).items():
        if key in _JSON:
            found[key] = parse_json(text, f"{origin}, {key},", error=SessionError, finite=False)
        elif key in ImportRecord.__struct_fields__:
            found[key] = text
    return to_record(found, ImportRecord, origin, texts=True)


def absent_key(topic: str) -> str:
    """Key of the list of fields of a topic's messages that the source does not have."""
    return f"{_ABSENT}{topic}"


def import_records(metadata: Mapping[str, Mapping[str, str]]) -> list[Mapping[str, str]]:
    """The records of the imports that a recording was made of; several, if it was merged.

    :param metadata: of the recording.
    """
    # dexkit merge adds the file's name where records differ
    return [r for name, r in metadata.items() if name == RECORD or name.startswith(f"{RECORD} (")]


def absent_of(record: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """By topic that an import made of frames, the fields that are 0 because the source does not
    have them.

    ``q``, or ``left.q`` where both hands share the topic and the source has it of the other one.
    """
    return {
        dds_topic(key.removeprefix(_ABSENT)): frozenset(value.split())
        for key, value in record.items()
        if key.startswith(_ABSENT)
    }


def absent_fields(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, frozenset[str]]:
    """What :func:`absent_of` says, of all imports that a recording was made of."""
    found: dict[str, frozenset[str]] = {}
    for record in import_records(metadata):
        for topic, absent in absent_of(record).items():
            found[topic] = found.get(topic, frozenset()) | absent
    return found
