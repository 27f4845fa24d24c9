"""The metadata records that ``dexkit export --to rosbag2`` puts into a bag.

A bag has one place for them, the custom data of its ``metadata.yaml``, of which a bag of mcap files
has a copy in each file. Without them a recording would be taken for what a recorder saw, though its
messages were made from the frames of a data set.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from dexkit.errors import SessionError

__all__ = ["BAG", "custom_data", "records_of", "records_of_copy"]

BAG = "rosbag2"
"""Name of the metadata record that is the copy."""
_COPY = "serialized_metadata"
_PREFIX = "dexkit.metadata "
_LARGEST = 4 * 2**20


def custom_data(records: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """The records as a bag's custom data."""
    return {f"{_PREFIX}{name}": json.dumps(values) for name, values in records.items()}


def records_of(custom: object) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """The records in a bag's custom data, and the other custom data."""
    records: dict[str, dict[str, str]] = {}
    others: dict[str, str] = {}
    for key, value in custom.items() if isinstance(custom, dict) else ():
        values = _texts(value) if str(key).startswith(_PREFIX) else None
        if values is None:
            others[str(key)] = str(value)
        else:
            records[str(key).removeprefix(_PREFIX)] = values
    return records, others


def records_of_copy(copy: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """The records in the copy that an mcap file has, its metadata record :data:`BAG`.

    :raises SessionError: it cannot be read, or the library that reads YAML is not installed.
    """
    text = copy.get(_COPY, "")
    if _PREFIX not in text:
        return {}
    if len(text) > _LARGEST:
        raise SessionError(f"it has more than {_LARGEST} characters")
    from dexkit.traces.sessions.bag_checks import parse_yaml  # few recordings are such bags

    try:
        document = parse_yaml(text, "it")
    except ModuleNotFoundError as error:
        raise SessionError("that needs pip install 'dexkit[rosbag]'") from error
    return records_of(document.get("custom_data") if isinstance(document, dict) else None)[0]


def _texts(value: object) -> dict[str, str] | None:
    try:
        found = json.loads(str(value))
    except (ValueError, RecursionError):
        return None
    if isinstance(found, dict) and all(isinstance(v, str) for v in found.values()):
        return found
    return None
